"""From a drive to the numbers and images of its report."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from sceneloom.checks.opening import open_subject
from sceneloom.checks.report import ValidationReport
from sceneloom.checks.validation import validate
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.loss import Loss
from sceneloom.formats.size import size_on_disk
from sceneloom.formats.table import PART
from sceneloom.formats.urls import path_or_url
from sceneloom.images.canvas import counting_left_out
from sceneloom.motion.ego_motion import find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.report.figures import Figures
from sceneloom.report.numbers.calibration import check_cameras
from sceneloom.report.numbers.conversions import conversions_of
from sceneloom.report.numbers.drive import DriveReport
from sceneloom.report.numbers.fusing import Fusion, fuse_some
from sceneloom.report.numbers.labelled import draw_labels
from sceneloom.report.numbers.labels import Labels, labels_of
from sceneloom.report.numbers.metrics import Metrics, metrics_of
from sceneloom.report.numbers.provenance import provenance_of
from sceneloom.report.numbers.surroundings import Coverage, coverage_of
from sceneloom.report.numbers.timing import timing_of
from sceneloom.report.numbers.trajectories import Trajectories, trajectories_of
from sceneloom.report.numbers.verdict import Evidence, verdict_of
from sceneloom.report.settings import ReportSettings
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import needs_ego
from sceneloom.scene.span import frame_times
from sceneloom.scene.summary import SceneSummary, summarise
from sceneloom.scene.types import Progress
from sceneloom.stages import stage

MOST_SWEEPS_FOR_A_TRAJECTORY = 200
"""The ego trajectory is found from the sweeps of longer drives only where that is asked for: it takes a while."""
MOST_FRAMES_VALIDATED = 6000
"""Frames and images of drives with more are not read by the rules: `sceneloom validate` does that."""
STEPS = 10

Part = TypeVar("Part")


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
        settings: what is asked for.
        reading: reading options of the format, `start` and `stop` of a part among them; what is broken is passed over
            and reported.
        made: when the report is stated to be made; None for now.
        progress: reported how many of the steps are done.

    Raises:
        UnknownFormatError: no format fits the path.
        OptionError: an option or its value is not known.
        DataError: nothing of the drive can be read, the loss report cannot, or the truth cannot be compared with it.
    """
    if settings.truth is not None and not Path(settings.truth).exists():
        raise DataError(settings.truth, "", "no such file or folder; expected what the drive is held against")
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
    """Collects part by part; what cannot be reported is noted with the reason, and the rest goes on."""

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
        summary = self.part("contents", self._summary, None) or _no_summary(self.scene)
        start_ns = summary.start_ns or 0
        figures = Figures(self.settings.images)
        coverage = self.part("coverage", lambda: coverage_of(self.scene), Coverage())
        calibration = self.part("calibration", self._calibration, ())
        with counting_left_out() as left:
            fusion = self.part("fusion", lambda: self._fusion(figures), None)
            labels = self.part("annotations", lambda: self._labels(start_ns, figures), None)
        self.sampling += left.lines
        evidence = Evidence(
            summary=summary,
            timing=timing_of(self.scene, start_ns=start_ns),
            trajectories=self.part(
                "trajectory",
                lambda: trajectories_of(self.scene, start_ns=start_ns, found_now=found),
                Trajectories(trajectories=()),
            ),
            coverage=coverage,
            calibration=calibration,
            fusion=fusion,
            labels=labels,
            metrics=self.part("truth", self._metrics, Metrics(), required=self.settings.truth is not None),
            validation=validation,
            left_out=self.left_out,
        )
        return Collected(self._report(evidence, losses), figures)

    def part(self, name: str, work: Callable[[], Part], otherwise: Part, *, required: bool = False) -> Part:
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
            self.progress(min(self.done, STEPS), STEPS)
        return found

    def _report(self, evidence: Evidence, losses: tuple[Loss, ...]) -> DriveReport:
        path = self.where if isinstance(self.where, Path) and self.where.exists() else None
        name = self.settings.title or Path(str(self.scene.source)).name or str(self.scene.source)
        return DriveReport(
            name=name,
            verdict=verdict_of(evidence),
            summary=evidence.summary,
            timing=evidence.timing,
            trajectories=evidence.trajectories,
            coverage=evidence.coverage,
            calibration=tuple(evidence.calibration),
            fusion=evidence.fusion,
            labels=evidence.labels,
            metrics=evidence.metrics,
            validation=evidence.validation,
            conversions=self.part("conversions", lambda: conversions_of(self.scene), ()),
            losses=losses,
            warnings=self.scene.warnings,
            provenance=provenance_of(
                self.scene, path, {**self.settings.stated, **self.reading}, made=self.made
            ),
            sampling=tuple(self.sampling),
            left_out=self.left_out,
        )

    def _summary(self) -> SceneSummary:
        size = size_on_disk(self.where) if isinstance(self.where, Path) and self.where.exists() else None
        return summarise(self.scene, size_bytes=size)

    def _validation(self) -> ValidationReport:
        count = sum(len(frame_times(sensor)) for sensor in self.scene.sensors if _is_read(sensor))
        frames = not self.settings.quick and count <= MOST_FRAMES_VALIDATED
        if not frames:
            self.sampling.append(
                f"the rules read none of {count:,} frames and images; `sceneloom validate` reads all"
            )
        source = self.scene if self.where is None else self.where
        options = {key: value for key, value in self.reading.items() if key != "lenient"}
        return validate(source, frames=frames, **(options if self.where is not None else {}))

    def _estimate_trajectory(self) -> frozenset[str]:
        """Put the ego trajectory that is asked for, or that has to be found, first.

        Gives the names of trajectories found.
        """
        name = self.settings.trajectory
        try:
            if not needs_ego(self.scene) and name is None:
                return frozenset()
            computed = is_computed(self.scene, name)
            if computed and name is None and self._takes_long():
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

    def _takes_long(self) -> bool:
        return sum(len(lidar.frames) for lidar in self.scene.lidars) > MOST_SWEEPS_FOR_A_TRAJECTORY

    def _calibration(self) -> Any:
        if self.settings.quick:
            self.left_out["calibration"] = "not checked: a quick report was asked for"
            return ()
        return check_cameras(self.scene)

    def _fusion(self, figures: Figures) -> Fusion | None:
        if not any(len(lidar.frames) for lidar in self.scene.lidars):
            return None
        found = fuse_some(self.scene, figures)
        if found.sweeps < found.of:
            self.sampling.append(f"{found.sweeps} of {found.of:,} sweeps were fused for numbers and images")
        return found

    def _labels(self, start_ns: int, figures: Figures) -> Labels | None:
        found = labels_of(self.scene, start_ns=start_ns)
        if found is None:
            return None
        if found.moments < found.of:
            self.sampling.append(f"boxes were looked at in {found.moments} of {found.of:,} moments")
        try:
            draw_labels(self.scene, figures)
        except SceneloomError as error:
            found = msgspec.structs.replace(found, skipped=(*found.skipped, f"images: {error}"))
        return found

    def _metrics(self) -> Metrics:
        is_part = not self.reading.keys().isdisjoint(PART)
        if is_part and self.settings.truth is not None:
            self.sampling.append(
                "objects are held against a truth in whole drives only; this is a part of one"
            )
        return metrics_of(
            self.scene,
            source=None if is_part else self.where,
            truth=self.settings.truth,
            compare=self.settings.compare,
        )


def _is_read(sensor: Any) -> bool:
    return str(sensor.type) in {"lidar", "radar", "camera", "depth_camera"}


def _no_summary(scene: Scene) -> SceneSummary:
    """What is known of a scene whose first frames cannot be read."""
    return SceneSummary(
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
