"""The report job: metrics and images collected from a drive, rendered into one self-contained HTML page."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime
from functools import partial
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from sceneloom.checks.validation import ValidationReport, open_subject, validate
from sceneloom.errors import DataError, MissingExtraError, OptionError, SceneloomError, how_to_install, without_folders
from sceneloom.formats.base.files import path_or_url, read_bytes, size_on_disk
from sceneloom.formats.base.losses import Loss
from sceneloom.formats.base.output import check_output, replacing
from sceneloom.formats.base.registry import PART
from sceneloom.motion.ego_trajectory import find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.report.annotations import Labels
from sceneloom.report.content import Figures, plain
from sceneloom.report.coverage import Coverage
from sceneloom.report.drive_report import DriveReport
from sceneloom.report.fusion import CalibrationCheck, Fusion
from sceneloom.report.timing import Timing
from sceneloom.report.trajectory import Metrics, Trajectories
from sceneloom.scene.ego import needs_ego
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.summary import SceneSummary, summarise
from sceneloom.scene.types import Progress
from sceneloom.stages import stage
from sceneloom.visualization.canvas import counting_left_out


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSettings:
    """How a report is made.

    Attributes:
        trajectory: name of the ego trajectory; "lidar" or "gnss" to estimate it; None for the drive's first, else one
            that is estimated if that is quick.
        heading: "motion" to derive orientations where the trajectory has positions only.
        truth: a trajectory, a scene with cuboids, or KITTI's text that the drive is compared with.
        compare: trajectories to be estimated and compared with the drive's own: "lidar", "gnss".
        losses: a loss report as `sceneloom convert --loss` writes it.
        quick: read no more than a few frames: no validation of frames, no calibration check.
        images: how many the page may hold.
        title: of the page; None for the drive's name.
    """

    trajectory: str | None = None
    heading: str | None = None
    truth: str | Path | None = None
    compare: tuple[str, ...] = ()
    losses: Path | None = None
    quick: bool = False
    images: int = 24
    title: str | None = None

    def __post_init__(self) -> None:
        if self.images < 0:
            raise OptionError(f"images {self.images}; expected 0 or more")
        unknown = [name for name in self.compare if name not in {"lidar", "gnss"}]
        if unknown:
            raise OptionError(f"compare {unknown[0]!r}; expected lidar or gnss")

    @property
    def stated(self) -> dict[str, Any]:
        """Those that are not the usual ones, by name."""
        names = (each.name for each in fields(self))
        return {name: getattr(self, name) for name in names if getattr(self, name) != getattr(_USUAL, name)}


_USUAL = ReportSettings()
_MOST_SWEEPS_FOR_A_TRAJECTORY = 200
"""The ego trajectory of longer drives is estimated from their sweeps only on request: it takes a while."""
_MOST_FRAMES_VALIDATED = 6000
"""Frames and images of drives with more are not read by the rules: `sceneloom validate` does that."""
_STEPS = 10
_Part = TypeVar("_Part")


@dataclass(slots=True)
class Collected:
    """A report in numbers, and its images."""

    report: DriveReport
    figures: Figures


def collect(
    source: str | Path | Scene,
    settings: ReportSettings,
    *,
    reading: Mapping[str, Any] | None = None,
    made: datetime | None = None,
    progress: Progress | None = None,
) -> Collected:
    """Look at a drive.

    Args:
        source: a file or folder, the URL of a scene file, or a scene that is open.
        reading: reading options of the format, `start` and `stop` of a part among them; what is broken is passed over
            and reported.
        made: when the report is stated to be made; None for now.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known.
        DataError: nothing of the drive can be read, the loss report cannot, or the truth cannot be compared with it.
    """
    if settings.truth is not None and not Path(settings.truth).exists():
        raise DataError(settings.truth, "", "no such file or folder; expected what the drive is compared with")
    losses = () if settings.losses is None else read_losses(settings.losses)
    if isinstance(source, Scene):
        return _Collector(source, None, settings, dict(reading or {}), progress, made).collect(losses)
    where = path_or_url(source)
    with stage("opening"):
        opened = open_subject(where, **(reading or {})).scene
    with opened as scene:
        return _Collector(scene, where, settings, dict(reading or {}), progress, made).collect(losses)


def read_losses(path: Path) -> tuple[Loss, ...]:
    """Read a loss report in JSON.

    Raises:
        DataError: it cannot be read, or is none.
    """
    content = read_bytes(path)
    try:
        reported = msgspec.json.decode(content)
        listed = reported if isinstance(reported, list) else reported["losses"]
        listed = listed if isinstance(listed, list) else listed["losses"]
        return msgspec.convert(listed, tuple[Loss, ...], strict=False)
    except (msgspec.MsgspecError, UnicodeError, RecursionError, KeyError, TypeError) as error:
        raise DataError(path, "", f"is no loss report: {error}") from error


@dataclass(slots=True)
class _Collector:
    """Collects part by part; what cannot be reported is noted with the reason."""

    scene: Scene
    where: Path | str | None
    settings: ReportSettings
    reading: dict[str, Any]
    progress: Progress | None
    made: datetime | None
    left_out: dict[str, str] = field(default_factory=dict)
    sampling: list[str] = field(default_factory=list)
    done: int = 0

    def collect(self, losses: tuple[Loss, ...]) -> Collected:
        validation = self.part("findings", self._validation, None)
        self.scene = self.part("corrections", self.scene.corrected, self.scene)
        found = self._estimate_trajectory()
        path = self.where if isinstance(self.where, Path) and self.where.exists() else None
        scene = self.scene
        bare = SceneSummary(  # what is known of a scene whose first frames cannot be read
            source=scene.source,
            format=scene.format,
            start_ns=None,
            duration=0.0,
            size_bytes=None,
            sensors=(),
            trajectories=(),
            annotations={},
            warnings=scene.warnings,
        )
        size = partial(size_on_disk, path) if path is not None else lambda: None
        summary = self.part("contents", lambda: summarise(scene, size_bytes=size()), bare)
        start_ns = summary.start_ns or 0
        figures = Figures(self.settings.images)
        coverage = self.part("coverage", lambda: Coverage.of(self.scene), Coverage())
        none: tuple[Any, ...] = ()
        if self.settings.quick:
            self.left_out["calibration"] = "not checked: a quick report was asked for"
        check = (lambda: none) if self.settings.quick else partial(CalibrationCheck.of, self.scene)
        calibration = self.part("calibration", check, none)
        with counting_left_out() as left:
            fusion = self.part("fusion", lambda: self._fusion(figures), None)
            labels = self.part("annotations", lambda: self._labels(start_ns, figures), None)
        self.sampling += left.lines
        report = DriveReport.of(
            scene,
            path,
            {**self.settings.stated, **self.reading},
            made=self.made,
            name=self.settings.title or Path(str(self.scene.source)).name or str(self.scene.source),
            summary=summary,
            timing=Timing.of(self.scene, start_ns=start_ns),
            trajectories=self.part(
                "trajectory",
                lambda: Trajectories.of(self.scene, start_ns=start_ns, found_now=found),
                Trajectories(trajectories=()),
            ),
            coverage=coverage,
            calibration=calibration,
            fusion=fusion,
            labels=labels,
            metrics=self.part("truth", self._metrics, Metrics(), required=self.settings.truth is not None),
            validation=validation,
            conversions=self.part("conversions", lambda: DriveReport.conversions_of(scene), none),
            losses=losses,
            sampling=tuple(self.sampling),
            left_out=self.left_out,
        )
        return Collected(report, figures)

    def part(self, name: str, work: Callable[[], _Part], otherwise: _Part, *, required: bool = False) -> _Part:
        """Do a part of the work; note why where it cannot be done, unless it is `required`."""
        try:
            with stage(name):
                found = work()
        except SceneloomError as error:
            if required:
                raise
            self.left_out[name] = str(error)
            found = otherwise
        self.done += 1
        if self.progress is not None:
            self.progress(min(self.done, _STEPS), _STEPS)
        return found

    def _validation(self) -> ValidationReport:
        read = {"lidar", "radar", "camera", "depth_camera"}
        count = sum(len(frame_times(sensor)) for sensor in self.scene.sensors if str(sensor.type) in read)
        frames = not self.settings.quick and count <= _MOST_FRAMES_VALIDATED
        if not frames:
            self.sampling.append(f"the rules read none of {count:,} frames and images; `sceneloom validate` reads all")
        source = self.scene if self.where is None else self.where
        options = {key: value for key, value in self.reading.items() if key != "lenient"}
        return validate(source, frames=frames, **(options if self.where is not None else {}))

    def _estimate_trajectory(self) -> frozenset[str]:
        """Put the ego trajectory that is asked for, or has to be found, first; gives the names of those found."""
        name = self.settings.trajectory
        try:
            if not needs_ego(self.scene) and name is None:
                return frozenset()
            computed = is_computed(self.scene, name)
            sweeps = sum(len(lidar.frames) for lidar in self.scene.lidars)
            if computed and name is None and sweeps > _MOST_SWEEPS_FOR_A_TRAJECTORY:
                self.left_out["trajectory"] = (
                    "the drive has no trajectory, and finding one from so many sweeps takes a while: state "
                    "`--trajectory lidar` or `--trajectory gnss`"
                )
                return frozenset()
            ego = find_ego_motion(self.scene, name=name, heading=self.settings.heading, lenient=True)
        except SceneloomError as error:
            self.left_out["trajectory"] = str(error)
            return frozenset()
        self.scene = with_trajectory_estimated(self.scene, ego)
        return frozenset([ego.name]) if computed else frozenset()

    def _fusion(self, figures: Figures) -> Fusion | None:
        if not any(len(lidar.frames) for lidar in self.scene.lidars):
            return None
        found = Fusion.sampled(self.scene, figures)
        if found.sweeps < found.of:
            self.sampling.append(f"{found.sweeps} of {found.of:,} sweeps were fused for numbers and images")
        return found

    def _labels(self, start_ns: int, figures: Figures) -> Labels | None:
        found = Labels.measured(self.scene, start_ns=start_ns)
        if found is None:
            return None
        if found.moments < found.of:
            self.sampling.append(f"boxes were looked at in {found.moments} of {found.of:,} moments")
        try:
            Labels.draw(self.scene, figures)
        except SceneloomError as error:
            found = msgspec.structs.replace(found, skipped=(*found.skipped, f"images: {error}"))
        return found

    def _metrics(self) -> Metrics:
        is_part = not self.reading.keys().isdisjoint(PART)
        if is_part and self.settings.truth is not None:
            self.sampling.append("objects are compared with a truth in whole drives only; this is a part of one")
        return Metrics.of(
            self.scene, source=None if is_part else self.where, truth=self.settings.truth, compare=self.settings.compare
        )


_MARKS = {"sound": "✔", "look": "▲", "faulty": "✖"}


def _check_extra() -> Any:
    """Give the package that fills the template; matplotlib, which draws, is looked for, too."""
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError(f"a report needs jinja2: {how_to_install('report')}") from None
    if find_spec("matplotlib") is None:
        raise MissingExtraError(f"a report needs matplotlib: {how_to_install('report')}")
    return jinja2


def render_page(report: DriveReport, figures: Figures) -> str:
    """Put a report into its page.

    Raises:
        MissingExtraError: what fills the template is not installed.
    """
    jinja2, source = _check_extra(), report.summary.source
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=partial(_plain, whole=source if "/" in source or "\\" in source else "", name=report.name),
        loader=jinja2.FunctionLoader(_resource),
    )
    shown, further = report.verdict.first_advices
    page: str = environment.get_template("report.html.j2").render(
        report=report,
        style=_resource("style.css"),
        sections=list(report.sections(figures)),
        leads=[*figures.of("calibration")[:1], *figures.of("fusion")[-1:]],
        marks=_MARKS,
        advices=shown,
        more_advices=further,
    )
    return page


def _resource(name: str) -> str:
    return files("sceneloom.report").joinpath(name).read_text("utf-8")


def _plain(value: Any, *, whole: str, name: str) -> Any:
    """Take out what no page may hold, and where on its machine the drive lies; markup of our own stays as it is."""
    if not isinstance(value, str) or hasattr(value, "__html__"):
        return value
    if whole:
        value = value.replace(f"{whole}/", "").replace(whole, name)
    return plain(value)


def write_report(
    source: str | Path | Scene,
    output: str | Path | None = None,
    *,
    numbers: str | Path | None = None,
    settings: ReportSettings | None = None,
    overwrite: bool = False,
    made: datetime | None = None,
    progress: Progress | None = None,
    **reading: Any,
) -> DriveReport:
    """Look at a drive, and write a page of HTML that can be sent, and its numbers as JSON.

    The page is one file that asks for nothing from outside. What is broken in the drive is passed over and reported.

    Args:
        source: a file or folder, the URL of a scene file, or a scene that is open.
        output: the page, a name that ends in .html; None for none.
        numbers: the numbers, a name that ends in .json; None for none.
        made: when the report is stated to be made; None for now.
        reading: reading options of the format; `start` and `stop`, seconds between which the drive counts.

    Returns:
        The numbers.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known, or a name has another suffix.
        OutputError: an output exists, or cannot be written.
        MissingExtraError: what fills the page is not installed.
        DataError: nothing of the drive can be read.
    """
    wanted = [
        (Path(target), suffix) for target, suffix in ((output, ".html"), (numbers, ".json")) if target is not None
    ]
    for target, suffix in wanted:
        if target.suffix.lower() != suffix:
            raise OptionError(f"{target}: suffix {target.suffix!r}; expected a name that ends in {suffix}")
        check_output(target, overwrite=overwrite)
    if output is not None:
        _check_extra()
    found = collect(source, settings or ReportSettings(), reading=reading, made=made, progress=progress)
    contents: dict[str, Callable[[], bytes]] = {
        # ids may hold halves of characters, which no file of Unicode can
        ".html": lambda: render_page(found.report, found.figures).encode("utf-8", "replace"),
        ".json": lambda: _numbers_as_json(found.report),
    }
    for target, suffix in wanted:
        with stage("drawing the page"):
            content = contents[suffix]()
        with replacing(target, overwrite=overwrite) as draft:
            draft.write_bytes(content)
    return found.report


def _numbers_as_json(report: DriveReport) -> bytes:
    """The numbers of a report as JSON, for people to read, too; without the folders above the drive."""
    source = report.summary.source
    try:
        text = msgspec.json.format(msgspec.json.encode(report), indent=1).decode()
    except UnicodeEncodeError:
        # ids may hold halves of characters, which this encoder escapes
        text = json.dumps(msgspec.to_builtins(report), indent=1)
    return without_folders(text, source).encode() + b"\n"
