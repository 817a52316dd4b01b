"""The convert job: from one format to another through the scene, with what the target format lost, field by field."""

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import LossError, OptionError, UnknownFormatError, check_option_names, redacted, without_folders
from sceneloom.formats.base.files import is_url
from sceneloom.formats.base.losses import SEVERITY, Holding, Loss, LossReport, Support, Supports, holding_of
from sceneloom.formats.base.output import check_output, on_trial, replacing
from sceneloom.formats.base.registry import (
    PART,
    claims_of,
    format_and_location,
    format_for_output,
    format_named,
    format_names,
    open_scene,
    scene_for,
    write_in,
    written_formats,
)
from sceneloom.formats.base.spec import FormatSpec
from sceneloom.formats.remote.uploads import uploading
from sceneloom.formats.trajectories.table import TRAJECTORY_FORMS, read_trajectory_file, split_name, write_trajectory
from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
from sceneloom.scene.cameras import CameraSensor, DepthFrame
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.contents import IMU_STREAMS, KINDS, MODEL_FIELDS, AnyFrame, Counting, watched
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, Progress
from sceneloom.stages import stage
from sceneloom.warnings import DataWarning

_TIMESTAMPS = ("timestamp_ns", "timestamps_ns", "start_ns", "duration_ns", "durations_ns", "poses", "attributes")
_TOGETHER: Mapping[str, tuple[str, ...]] = {
    "timestamps": _TIMESTAMPS,
    "sensors[], annotations[], attributes[]": _TIMESTAMPS,
    "file_seconds": ("file_seconds",),
}  # words for the fields of one meaning in all sensors, trajectories and annotations, and their last parts
_WORDS = (
    (re.compile(r"\.images(\[\])?\.content$"), ".images.rgb"),
    (re.compile(r"\.timestamp(s?)$"), r".timestamp\1_ns"),
    (re.compile(r"^(sensors\[.*\])\.intrinsics"), r"\1.camera"),
)  # words of the Sensor Fusion Scene format for fields that have other names in the model
_SEVERAL = re.compile(r"^(sensors|annotations)\[(.*?)\](?=\.|$)")
_STREAM = re.compile(r"^(sensors\.imu\.streams)\.([^.]+)")
_TRAJECTORY = re.compile(r"^trajectories(?:\[.*?\](?=\.|$)|\.([^.]+))")
_INDEX = re.compile(r"\[[^\]]*\]")


def kinds_by_id(scene: Scene) -> dict[str, str]:
    """The kind of each sensor and annotation, by `sensors[ID]` or `annotations[ID]`, else with its type for an ID."""
    several = {"sensors": scene.sensors, "annotations": scene.annotations}
    items = [(name, item) for name, found in several.items() for item in found]
    by_type = {f"{name}[{item.type}]": KINDS[type(item)] for name, item in items}
    return {**by_type, **{f"{name}[{item.id}]": KINDS[type(item)] for name, item in items}}


def fields_meant(location: str, kinds: Mapping[str, str]) -> tuple[str, ...]:
    """Give the fields of the model that a location in the scene is or holds; none if it is no such location.

    Args:
        location: the field of a loss, as a name of `MODEL_FIELDS`, the beginning of one, or with ids and indices in it.
        kinds: of the scene, as `kinds_by_id` gives them.
    """
    if location == "sensors":
        return ("sensors.order",)
    if location in _TOGETHER:
        return tuple(field for field in MODEL_FIELDS if field.rpartition(".")[2] in _TOGETHER[location])
    for pattern, ours in _WORDS:
        location = pattern.sub(ours, location)
    names = _by_kind(location, kinds)
    # of all kinds, those that have such a field; the others have no extra field of that name
    found = [field for name in names for field in MODEL_FIELDS if field == name or field.startswith(f"{name}.")]
    return tuple(dict.fromkeys(found or [field for name in names for field in _above(name)]))


def _by_kind(location: str, kinds: Mapping[str, str]) -> list[str]:
    """The location with a kind instead of the id; several where all of them are meant."""
    owner = max((key for key in kinds if location == key or location.startswith(f"{key}.")), key=len, default=None)
    if owner is not None:
        return [_plain(kinds[owner] + location[len(owner) :])]
    all_of = _SEVERAL.match(location)
    if all_of is None:
        return [_plain(location)]
    return [_plain(kind + location[all_of.end() :]) for kind in KINDS.values() if kind.startswith(all_of[1])]


def _plain(location: str) -> str:
    """The location without indices, names of trajectories and of streams that have no rows of their own."""
    trajectory = _TRAJECTORY.match(location)
    if trajectory is not None and f"trajectories.{trajectory.group(1)}" not in MODEL_FIELDS:
        location = "trajectories" + location[trajectory.end() :]
    location = _INDEX.sub("", location)
    stream = _STREAM.match(location)
    if stream is not None and stream.group(2) not in (*IMU_STREAMS, "other"):
        location = f"{stream.group(1)}.other{location[stream.end() :]}"
    return location


def _above(name: str) -> list[str]:
    """The field that one of that name is a part of; unknown fields are `extras`."""
    while name := name.rpartition(".")[0]:
        for field in (name, f"{name}.extras"):
            if field in MODEL_FIELDS:
                return [field]
    return []


_LOSSES = (Support.APPROXIMATED, Support.DROPPED)
"""The supports that lose something: what is converted is off by no more than the rounding of its new form."""


class _FieldSupport(msgspec.Struct, frozen=True, kw_only=True):
    """One field of the source, and what became of it."""

    field: str
    is_: str = msgspec.field(name="is")
    count: int
    support: Support
    how: tuple[str, ...] = ()
    largest_error: float | None = None  # of the worst value, in the unit that `how` names, where that means something

    @property
    def explained(self) -> str:
        """What happened to it, and by how much its worst value is off."""
        worst = "" if self.largest_error is None else f"largest error {self.largest_error:.3g}"
        return "; ".join(filter(None, (*self.how, worst)))


def field_supports(
    contents: Mapping[str, int], supports: Supports, losses: Iterable[Loss], kinds: Mapping[str, str]
) -> tuple[_FieldSupport, ...]:
    """Report of every field that a scene holds what became of it.

    Args:
        contents: how many objects or frames hold each field.
        supports: what the format does with each field, whatever the scene.
        kinds: of the scene's sensors and annotations, as `kinds_by_id` gives them.

    Returns:
        One for each field of `contents`, then one for each loss that is about none of them.
    """
    reported: dict[str, list[Loss]] = {field: [] for field in contents}
    for loss in losses:
        meant = [field for field in fields_meant(loss.field, kinds) if field in contents]
        for field in meant or [loss.field]:
            reported.setdefault(field, []).append(loss)
    return tuple(
        _support(field, contents[field], holding_of(supports, field), lines)
        if field in contents
        else _support(field, sum(line.count for line in lines), None, lines)
        for field, lines in reported.items()
    )


def lost(supports: Iterable[_FieldSupport]) -> tuple[_FieldSupport, ...]:
    """Those that are not wholly in the target."""
    return tuple(support for support in supports if support.support in _LOSSES)


def _support(field: str, count: int, holding: Holding | None, lines: list[Loss]) -> _FieldSupport:
    supports = [Support.KEPT if line.kept else line.support for line in lines]
    how = []
    for line in lines:
        location = "" if line.field == field else f"{line.field}: "
        times = f" ({line.count} times)" if line.count > 1 else ""
        how.append(f"{location}{line.what}{times}" + (f"; it is in {line.kept}" if line.kept else ""))
    if holding is not None:
        supports.append(holding.support)
        how += [holding.how] if holding.how and holding.how not in {line.what for line in lines} else []
    return _FieldSupport(
        field=field,
        is_=MODEL_FIELDS.get(field, ""),
        count=count,
        support=max(supports, key=SEVERITY.__getitem__, default=Support.KEPT),
        how=tuple(dict.fromkeys(how)),
        largest_error=max((line.largest_error for line in lines if line.largest_error is not None), default=None),
    )


class ConversionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One conversion.

    Attributes:
        source, source_format: what was read, and as what.
        target, target_format: what was written, and as what.
        warnings: what was assumed, repaired or left out on reading.
        losses: what the writing reported this scene, location by location.
        fields: every field that the source holds, and what became of it.
        written: whether the target is there; false where losing something was refused.
    """

    source: str
    source_format: str
    target: str
    target_format: str
    warnings: tuple[DataWarning, ...]
    losses: LossReport
    fields: tuple[_FieldSupport, ...] = ()
    written: bool = True

    def of_support(self, support: Support) -> tuple[_FieldSupport, ...]:
        """The fields that this became of."""
        return tuple(field for field in self.fields if field.support == support)

    @property
    def lost(self) -> tuple[_FieldSupport, ...]:
        """The fields that are not wholly in the target."""
        return lost(self.fields)

    @property
    def headline(self) -> str:
        """From where to where, on one line."""
        not_written = "" if self.written else " (not written)"
        return f"{self.source} ({self.source_format}) → {self.target} ({self.target_format}){not_written}"

    @property
    def groups(self) -> "tuple[_Group, ...]":
        """The fields by what became of them, the worst first."""
        kept = self.of_support(Support.KEPT)
        groups = [
            *(_Group(str(one), self.of_support(one)) for one in reversed(Support) if one != Support.KEPT),
            _Group("kept aside, where other programs do not look", tuple(field for field in kept if field.how)),
            _Group("kept", tuple(field for field in kept if not field.how), explained=False),
        ]
        return tuple(group for group in groups if group.fields)


@dataclass(frozen=True, slots=True)
class _Group:
    """Fields of which the same became."""

    title: str
    fields: tuple[_FieldSupport, ...]
    explained: bool = True

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """One row for each field: its name, how many objects or frames hold it, and what happened to it."""
        return [(field.field, str(field.count), field.explained) for field in self.fields]

    @property
    def short_rows(self) -> list[tuple[str, str, str]]:
        """With one row for fields of a kind to which the same happened; those with an option as a remedy come first."""
        together: dict[tuple[str, ...], list[tuple[str, str, str]]] = {}
        for row in self.rows:
            owner = row[0].split(".")[:-1][:2]
            together.setdefault((*owner, row[2]), []).append(row)
        rows = []
        for same in together.values():
            parts = zip(*(name.split(".") for name, _, _ in same), strict=False)
            shared = ".".join(part[0] for part in parts if len(set(part)) == 1)
            rows.append(same[0] if len(same) == 1 else (f"{shared}.*", f"{len(same)} fields", same[0][2]))
        return sorted(rows, key=lambda row: "`--" not in row[2])


_REPORT_SUFFIXES = (".json", ".md", ".txt")


def _write_report(report: ConversionReport, path: Path, *, overwrite: bool = False) -> None:
    """Write what became of every field: as JSON, as Markdown or as text, as the suffix says."""
    if path.suffix.lower() == ".json":
        lines = [msgspec.json.format(msgspec.json.encode(report), indent=2).decode()]
    elif path.suffix.lower() == ".md":
        lines = [f"# {report.headline}"]
        for group in report.groups:
            title = f"## {group.title[0].upper()}{group.title[1:]}"
            lines += ["", title, "| field | held by | how |", "| --- | ---: | --- |"]
            cells = ((name, count, how.replace("|", "\\|").replace("\n", " ")) for name, count, how in group.rows)
            lines += [f"| `{name}` | {count} | {how} |" for name, count, how in cells]
    else:
        lines = [report.headline]
        for group in report.groups:
            lines += ["", f"{group.title} ({len(group.fields)})"]
            lines += [f"  {name} [{count}]" + (f": {how}" if how else "") for name, count, how in group.rows]
    with replacing(path, overwrite=overwrite) as draft:
        text = without_folders("\n".join([*lines, ""]), f"{report.source} + {report.target}")
        draft.write_text(text, encoding="utf-8", newline="\n")


_WRITING = ("optical", "origin_lla")
_OF_FILES = ("form", "name", "times", "rate_hz", "unit", "origin_lla", "optical", "corrections")
"""Reading options that are about trajectories, not about scenes."""
_NAMED = 6  # how many fields a message names


@dataclass(slots=True, eq=False)
class _Conversion:
    """One call of `convert`; a target that may lose nothing is written beside its path first."""

    source: str | Path
    target: Path
    to: str | None
    trajectory: str | None
    strict: bool
    overwrite: bool
    reading: dict[str, Any]
    writing: dict[str, Any]
    progress: Progress | None

    def run(
        self,
        source_format: str,
        target_format: str,
        warnings: tuple[DataWarning, ...],
        contents: Callable[[], Mapping[str, int]],
        supports: Supports,
        kinds: Mapping[str, str],
        write: Callable[..., LossReport],
        known: tuple[Loss, ...] = (),
    ) -> ConversionReport:
        """Write the target, and report; `known` is lost whatever the writing reports."""

        def report(losses: LossReport | None) -> ConversionReport:
            """The report, before (None) or after the writing."""
            found = LossReport() if losses is None else losses
            found = LossReport.of([*known, *found]) if known else found
            return ConversionReport(
                source=str(self.source),
                source_format=source_format,
                target=str(self.target),
                target_format=target_format,
                warnings=warnings,
                losses=LossReport() if losses is None else found,
                fields=field_supports(contents(), supports, found, kinds),
                written=losses is not None,
            )

        write = partial(write, overwrite=self.overwrite, **self.writing)
        with stage("writing"):
            if self.strict:
                _refuse_losses(report(None))
                with on_trial(self.target, overwrite=self.overwrite) as (draft, accept):
                    tried = report(write(draft))
                    _refuse_losses(tried)
                    if accept():
                        return tried
            return report(write(self.target))

    def write_trajectory(self) -> ConversionReport:
        """Write one trajectory of a source to a file of its own; what else the source holds is lost."""
        reading = self.reading
        _refuse_part(self.target, reading)
        if "format" in reading:
            reading.setdefault("form", reading.pop("format"))
        check_option_names("writing a trajectory", self.writing, _WRITING)
        content = read_trajectory_file(self.source, name=self.trajectory, progress=self.progress, **reading)
        form = TRAJECTORY_FORMS.for_output(self.target) if self.to is None else TRAJECTORY_FORMS[self.to]
        kinds: Mapping[str, str] = {}
        losses: tuple[Loss, ...] = ()
        if content.form in TRAJECTORY_FORMS:
            contents = Counting(_drive(content, str(self.source), None)).counts()
        else:
            spec, location = format_and_location(split_name(self.source)[0], format=content.form)
            options = {key: value for key, value in reading.items() if key not in _OF_FILES}
            with spec.open(location, **options) as scene:
                contents, kinds = Counting(scene).counts(), kinds_by_id(scene)
                what = f"not written: the file holds {content.trajectory.name!r}"
                others = (other for other in scene.trajectories if other != content.trajectory.name)
                losses = tuple(Loss(field=f"trajectories[{other}]", what=what) for other in others)
        supports = form.supports if content.fixes is None else form.fix_supports
        write = partial(write_trajectory, content, form=form.name)
        return self.run(content.form, form.name, content.warnings, lambda: contents, supports, kinds, write, losses)

    def write_drive(self) -> ConversionReport:
        """Write a drive, or a scene that holds nothing but the trajectory of a file."""
        writer, trajectory = _writer(self.target, self.to), self.trajectory
        opened: AbstractContextManager[Scene]
        if self.reading.get("form") in TRAJECTORY_FORMS or _holds_trajectory_only(self.source):
            _refuse_part(self.source, self.reading)
            content = read_trajectory_file(self.source, name=trajectory, **self.reading)
            opened = _drive(content, str(self.source), trajectory)
        else:
            if trajectory is not None and not writer.along_trajectory:
                files = ", ".join(TRAJECTORY_FORMS)
                raise OptionError(
                    f"trajectory {trajectory!r}: {self.target} gets all that {self.source} holds; one of its "
                    f"trajectories is written to files of the forms {files}"
                )
            if trajectory is not None:
                self.writing["trajectory"] = trajectory
            opened = open_scene(self.source, **self.reading)
        with opened as read:
            scene = scene_for(writer, read)
            counting = Counting(_with_progress(scene, self.progress))
            writer.check_output(self.target)
            write = partial(write_in, writer, counting.scene)
            kinds = kinds_by_id(scene)
            return self.run(scene.format, writer.name, scene.warnings, counting.counts, writer.supports, kinds, write)


def _refuse_losses(report: ConversionReport) -> None:
    """Refuse a conversion that does not keep every field; the error has the report."""
    gone = report.lost
    if not gone:
        return
    named = "; ".join(
        f"{field.field} ({field.support}{': ' + field.how[0] if field.how else ''})" for field in gone[:_NAMED]
    )
    more = f"; and {len(gone) - _NAMED} more" if len(gone) > _NAMED else ""
    problem = (
        f"is not written, since {report.target_format} would not hold all: {named}{more}; name what to leave out "
        "first (`sceneloom edit`), choose a format that holds it (`sceneloom formats NAME`), or convert without "
        "`--strict`"
    )
    raise LossError(report.target, problem, report)


def convert(
    source: str | Path, target: str | Path, *, to: str | None = None, trajectory: str | None = None,
    strict: bool = False, loss: str | Path | None = None, overwrite: bool = False,
    reading: Mapping[str, Any] | None = None, progress: Progress | None = None, **writing: Any,
) -> ConversionReport:  # fmt: skip
    """Read a recording or a scene and write it in another format, without fusing anything.

    A target that is a file of trajectories (`.tum`, `.kitti`, `.csv`, `.jsonl`) gets one trajectory of the source; a
    source that is one becomes a drive with nothing else in it.

    Args:
        source: a file or folder.
        target: a file or folder, or the URL of one in a store; its suffix chooses the format unless `to` names it.
        to: name of the target's format, or form of trajectories.
        trajectory: name of the trajectory, where a file of trajectories is written or read, or things are placed in
            the world along one (COLMAP, nerfstudio, nuScenes, clouds), which may be "gnss", "lidar" or "identity".
        strict: refuse to lose anything: what the format never holds before anything is written, what shows only while
            writing so that nothing is left behind.
        loss: a file for what becomes of every field: `.json`, `.md` or `.txt`; written also where `strict` refuses.
        reading: reading options of the source's format; `format`, its name, where the content does not decide; `start`
            and `stop`, seconds between which a drive counts.
        progress: reported after each sweep, radar cycle and single image that is written, how many are done of how
            many.
        writing: writing options of the target's format.

    Raises:
        UnknownFormatError: no format fits the source.
        DataError: the source is wrong.
        OptionError: there is no format or form `to`, it is only read, several have the target's suffix, `trajectory`
            is named where a whole drive is written that needs none, or a part is asked for of a trajectory.
        LossError: something would be lost, and `strict` was stated.
        OutputError: the target exists, or cannot be written.
    """
    if is_url(target):
        with uploading(str(target), overwrite=overwrite) as draft:
            own = {"to": to, "trajectory": trajectory, "strict": strict, "loss": loss, "reading": reading}
            report = convert(source, draft, **own, progress=progress, **writing)  # type: ignore[arg-type]
        return msgspec.structs.replace(report, target=redacted(target))
    listing = None if loss is None else Path(loss)
    if listing is not None:
        # a name that it cannot have is refused before anything is read
        if listing.suffix.lower() not in _REPORT_SUFFIXES:
            expected = ", ".join(_REPORT_SUFFIXES)
            raise OptionError(f"{listing}: suffix {listing.suffix!r}; a loss report is written as {expected}")
        check_output(listing, overwrite=overwrite)
    path = Path(target)
    conversion = _Conversion(source, path, to, trajectory, strict, overwrite, dict(reading or {}), writing, progress)
    suffixes = {suffix for form in TRAJECTORY_FORMS.values() for suffix in form.suffixes}
    try:
        if to in TRAJECTORY_FORMS or (to is None and path.suffix.lower() in suffixes):
            report = conversion.write_trajectory()
        else:
            report = conversion.write_drive()
    except LossError as error:
        if listing is not None:
            _write_report(error.report, listing, overwrite=overwrite)
        raise
    if listing is not None:
        _write_report(report, listing, overwrite=overwrite)
    return report


def _holds_trajectory_only(path: str | Path) -> bool:
    """Whether what is there is a file of a trajectory, and no scene; logs of JSON lines are both, thus scenes."""
    if is_url(path) or not Path(path).is_file():
        return False
    try:
        form = TRAJECTORY_FORMS.of_file(path)
    except UnknownFormatError:
        return False
    return form is not None and not claims_of(Path(path))


def _drive(content: TrajectoryFile, source: str, name: str | None) -> Scene:
    """A scene that holds nothing but the trajectory of a file, or its fixes."""
    made: dict[str, Any] = {"source": source, "format": content.form, "warnings": content.warnings}
    if content.fixes is not None:
        return Scene((replace(content.fixes, id="gnss"),), **made)
    trajectory = content.trajectory if name is None else replace(content.trajectory, name=name)
    return Scene((), trajectories={trajectory.name: trajectory}, **made)


def _refuse_part(location: str | Path, reading: Mapping[str, Any]) -> None:
    if not reading.keys().isdisjoint(PART):
        raise OptionError(
            f"{redacted(location)}: a trajectory is read and written whole; expected a drive, or no start and stop"
        )


def _writer(location: Path, to: str | None) -> FormatSpec:
    if to is None:
        return format_for_output(location)
    known = ", ".join((*written_formats(), *TRAJECTORY_FORMS))
    if to not in format_names():
        raise OptionError(f"no format or form {to!r}; there are {known}")
    form = format_named(to)
    if not form.writes:
        raise OptionError(f"{location}: the format {to} is only read; written are {known}")
    return form


def _with_progress(scene: Scene, progress: Progress | None) -> Scene:
    """The scene that reports how many of its frames have been read; images of a video are written all at once."""
    if progress is None:
        return scene
    total = sum(
        len(frame_times(sensor))
        for sensor in scene.sensors
        if isinstance(sensor, LidarSensor | RadarSensor) or (isinstance(sensor, CameraSensor) and sensor.video is None)
    )
    read: set[tuple[type, Identifier, int]] = set()

    def reported(sensor_id: Identifier, k: int, frame: AnyFrame) -> None:
        if isinstance(frame, DepthFrame):
            return
        read.add((type(sensor_id), sensor_id, k))
        progress(min(len(read), total), total)

    return watched(scene, reported)
