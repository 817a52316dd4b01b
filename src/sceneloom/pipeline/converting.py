"""The convert job: from one format to another through the scene, with what the target format lost, field by field."""

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import (
    LossError,
    OptionError,
    UnknownFormatError,
    check_option_names,
    redacted,
    without_folders,
)
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
from sceneloom.formats.trajectories.table import (
    TRAJECTORY_FORMS,
    find_form,
    form_for_output,
    read_trajectory_file,
    split_name,
    write_trajectory,
)
from sceneloom.formats.trajectories.trajectory_file import TrajectoryFile
from sceneloom.scene.cameras import CameraSensor, DepthFrame
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.contents import (
    IMU_STREAMS,
    KINDS,
    MODEL_FIELDS,
    AnyFrame,
    Counting,
    contents_of,
    watched,
)
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.types import Identifier, Progress
from sceneloom.stages import stage
from sceneloom.warnings import DataWarning

_TIMESTAMPS = (
    "timestamp_ns",
    "timestamps_ns",
    "start_ns",
    "duration_ns",
    "durations_ns",
    "poses",
    "attributes",
)

_TOGETHER: Mapping[str, tuple[str, ...]] = {
    "timestamps": _TIMESTAMPS,
    "sensors[], annotations[], attributes[]": _TIMESTAMPS,
    "file_seconds": ("file_seconds",),
}
"""Words for the fields of one meaning in all sensors, trajectories and annotations, and their last parts."""

_WORDS = (
    (re.compile(r"\.images(\[\])?\.content$"), ".images.rgb"),
    (re.compile(r"\.timestamp(s?)$"), r".timestamp\1_ns"),
    (re.compile(r"^(sensors\[.*\])\.intrinsics"), r"\1.camera"),
)
"""Words of the Sensor Fusion Scene format for fields that have other names in the model."""

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
    # of all kinds, those that have such a field; the others have no further field of that name
    found = [field for name in names for field in _at_or_below(name)]
    return tuple(dict.fromkeys(found or [field for name in names for field in _above(name)]))


def _by_kind(location: str, kinds: Mapping[str, str]) -> list[str]:
    """The location with a kind instead of the id; several where all of them are meant."""
    owner = max(
        (key for key in kinds if location == key or location.startswith(f"{key}.")), key=len, default=None
    )
    if owner is not None:
        return [_plain(kinds[owner] + location[len(owner) :])]
    several = _SEVERAL.match(location)
    if several is None:
        return [_plain(location)]
    return [
        _plain(kind + location[several.end() :])
        for kind in KINDS.values()
        if kind.startswith(several.group(1))
    ]


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


def _at_or_below(name: str) -> list[str]:
    """The field of that name, or those below it."""
    return [field for field in MODEL_FIELDS if field == name or field.startswith(f"{name}.")]


def _above(name: str) -> list[str]:
    """The field that one of that name is a part of; further fields are `extras`."""
    above = name.rpartition(".")[0]
    while above:
        for field in (above, f"{above}.extras"):
            if field in MODEL_FIELDS:
                return [field]
        above = above.rpartition(".")[0]
    return []


_LOSSES = (Support.APPROXIMATED, Support.DROPPED)
"""The supports that lose something: what is converted is off by no more than the rounding of its new form."""


class _FieldSupport(msgspec.Struct, frozen=True, kw_only=True):
    """One field of the source, and what became of it.

    Attributes:
        field: its name out of `MODEL_FIELDS`; the location that a format reported where it is none of them.
        is_: what it is, for a person.
        count: how many objects or frames of the source hold it.
        support: the worst that happened to one of them.
        how: how they were converted or approximated, or why they were dropped; empty where all are kept.
        largest_error: how far the worst value is off, in the unit that `how` names; None where that means nothing.
    """

    field: str
    is_: str = msgspec.field(name="is")
    count: int
    support: Support
    how: tuple[str, ...] = ()
    largest_error: float | None = None


def field_supports(
    contents: Mapping[str, int], supports: Supports, losses: Iterable[Loss], kinds: Mapping[str, str]
) -> tuple[_FieldSupport, ...]:
    """Report of every field that a scene holds what became of it.

    Args:
        contents: how many objects or frames hold each field.
        supports: what the format does with each field, whatever the scene.
        losses: what the writing reported.
        kinds: of the scene's sensors and annotations, as `kinds_by_id` gives them.

    Returns:
        One for each field of `contents`, then one for each loss that is about none of them.
    """
    reported: dict[str, list[Loss]] = {}
    for loss in losses:
        meant = [field for field in fields_meant(loss.field, kinds) if field in contents]
        for field in meant or [loss.field]:
            reported.setdefault(field, []).append(loss)
    known = [
        _support(field, count, holding_of(supports, field), reported.pop(field, []))
        for field, count in contents.items()
    ]
    return (*known, *(_beside(location, lines) for location, lines in reported.items()))


def lost(supports: Iterable[_FieldSupport]) -> tuple[_FieldSupport, ...]:
    """Those that are not wholly in the target."""
    return tuple(support for support in supports if support.support in _LOSSES)


def _support(field: str, count: int, holding: Holding | None, lines: list[Loss]) -> _FieldSupport:
    supports = [Support.KEPT if line.kept else line.support for line in lines]
    how = [_stated(line, field) for line in lines]
    if holding is not None:
        supports.append(holding.support)
        how += [holding.how] if holding.how and holding.how not in {line.what for line in lines} else []
    return _FieldSupport(
        field=field,
        is_=MODEL_FIELDS.get(field, ""),
        count=count,
        support=max(supports, key=SEVERITY.__getitem__, default=Support.KEPT),
        how=tuple(dict.fromkeys(how)),
        largest_error=max(
            (line.largest_error for line in lines if line.largest_error is not None), default=None
        ),
    )


def _beside(location: str, lines: list[Loss]) -> _FieldSupport:
    return _support(location, sum(line.count for line in lines), None, lines)


def _stated(line: Loss, field: str) -> str:
    """What happened, and where unless that is what the field is called."""
    location = "" if line.field == field else f"{line.field}: "
    times = f" ({line.count} times)" if line.count > 1 else ""
    return f"{location}{line.what}{times}" + (f"; it is in {line.kept}" if line.kept else "")


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


_REPORT_SUFFIXES = (".json", ".md", ".txt")


def _check_report_name(path: Path) -> None:
    """Refuse a name for a report that does not state how to write it.

    Raises:
        OptionError: its suffix is none of those of reports.
    """
    if path.suffix.lower() not in _REPORT_SUFFIXES:
        raise OptionError(
            f"{path}: suffix {path.suffix!r}; a loss report is written as {', '.join(_REPORT_SUFFIXES)}"
        )


def _write_report(report: ConversionReport, path: Path, *, overwrite: bool = False) -> None:
    """Write what became of every field: as JSON, as Markdown or as text, as the suffix says.

    Raises:
        OptionError: the suffix is none of those of reports.
        OutputError: the file exists, or cannot be written.
    """
    _check_report_name(path)
    both = f"{report.source} + {report.target}"
    with replacing(path, overwrite=overwrite) as draft:
        if path.suffix.lower() == ".json":
            text = msgspec.json.format(msgspec.json.encode(report), indent=2).decode()
            draft.write_text(without_folders(text, both) + "\n", encoding="utf-8", newline="\n")
        else:
            lines = _markdown(report) if path.suffix.lower() == ".md" else _text(report)
            text = without_folders("\n".join([*lines, ""]), both)
            draft.write_text(text, encoding="utf-8", newline="\n")


def headline(report: ConversionReport) -> str:
    """From where to where, on one line."""
    not_written = "" if report.written else " (not written)"
    return f"{report.source} ({report.source_format}) → {report.target} ({report.target_format}){not_written}"


def support_rows(fields: Iterable[_FieldSupport]) -> list[tuple[str, str, str]]:
    """One row for each field: its name, how many objects or frames hold it, and what happened to it."""
    return [(field.field, str(field.count), _explained(field)) for field in fields]


def short_rows(fields: Iterable[_FieldSupport]) -> list[tuple[str, str, str]]:
    """As `support_rows`, with one row for all fields of a kind to which the same happened, by what their names share.

    Rows that name an option as a remedy come first: the others may not be shown.
    """
    together: dict[tuple[str, str], list[_FieldSupport]] = {}
    for field in fields:
        kind = ".".join(field.field.split(".")[:2])
        together.setdefault((kind, _explained(field)), []).append(field)
    return sorted(
        (
            support_rows(same)[0]
            if len(same) == 1
            else (f"{_beginning(same)}.*", f"{len(same)} fields", reported)
            for (_, reported), same in together.items()
        ),
        key=lambda row: "`--" not in row[2],
    )


def _beginning(fields: Iterable[_FieldSupport]) -> str:
    """What the names have in common, up to a dot."""
    names = [field.field.split(".") for field in fields]
    shared = [parts[0] for parts in zip(*names, strict=False) if len(set(parts)) == 1]
    return ".".join(shared)


def _explained(field: _FieldSupport) -> str:
    """What happened to a field, and by how much its worst value is off."""
    reported = "; ".join(field.how)
    worst = "" if field.largest_error is None else f"largest error {field.largest_error:.3g}"
    return "; ".join(filter(None, (reported, worst)))


def support_groups(report: ConversionReport) -> list[tuple[str, tuple[_FieldSupport, ...], bool]]:
    """The fields by what became of them, the worst first: a title, them, and whether there is more to state of them."""
    kept = report.of_support(Support.KEPT)
    groups = [
        (str(support), report.of_support(support), True)
        for support in reversed(Support)
        if support != Support.KEPT
    ]
    groups += [
        ("kept aside, where other programs do not look", tuple(field for field in kept if field.how), True),
        ("kept", tuple(field for field in kept if not field.how), False),
    ]
    return [group for group in groups if group[1]]


def _text(report: ConversionReport) -> list[str]:
    lines = [headline(report)]
    for title, fields, _ in support_groups(report):
        lines += ["", f"{title} ({len(fields)})"]
        lines += [
            f"  {name} [{count}]" + (f": {how}" if how else "") for name, count, how in support_rows(fields)
        ]
    return lines


def _markdown(report: ConversionReport) -> list[str]:
    lines = [f"# {headline(report)}"]
    for title, fields, _ in support_groups(report):
        lines += [
            "",
            f"## {title[0].upper()}{title[1:]}",
            "| field | held by | how |",
            "| --- | ---: | --- |",
        ]
        lines += [f"| `{name}` | {count} | {_cell(how)} |" for name, count, how in support_rows(fields)]
    return lines


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


_NAMED = 6
"""How many fields a message names."""

_Judged = Callable[[LossReport], ConversionReport]
"""Makes the report of a conversion out of what the writing reported."""


def _check_nothing_lost(report: ConversionReport) -> None:
    """Refuse a conversion that does not keep every field.

    Raises:
        LossError: naming the fields; it bears the report.
    """
    gone = lost(report.fields)
    if gone:
        raise LossError(report.target, _problem(gone, report.target_format), report)


def _write_strictly(
    write: Callable[[Path], LossReport], target: Path, judged: _Judged, *, overwrite: bool
) -> ConversionReport:
    """Write beside the target, and let it take the target's location if nothing was lost.

    Args:
        write: writes to a path.
        target: where the output shall be in the end.
        judged: makes the report.
        overwrite: whether something there may be replaced.

    Raises:
        LossError: something was lost; nothing is left behind.
        OutputError: the target exists, or cannot be written.
    """
    with on_trial(target, overwrite=overwrite) as (draft, accept):
        report = judged(write(draft))
        _check_nothing_lost(report)
        if accept():
            return report
    return judged(write(target))


def _problem(gone: Iterable[_FieldSupport], target_format: str) -> str:
    fields = list(gone)
    named = "; ".join(
        f"{field.field} ({field.support}{': ' + field.how[0] if field.how else ''})"
        for field in fields[:_NAMED]
    )
    further = f"; and {len(fields) - _NAMED} more" if len(fields) > _NAMED else ""
    return (
        f"is not written, since {target_format} would not hold all: {named}{further}; state what to leave out first "
        "(`sceneloom edit`), choose a format that holds it (`sceneloom formats NAME`), or convert without `--strict`"
    )


_WRITING = ("optical", "origin_lla")

_OF_FILES = ("form", "name", "times", "rate_hz", "unit", "origin_lla", "optical", "corrections")
"""Reading options that are about trajectories, not about scenes."""


def _is_trajectory_file(path: Path) -> bool:
    """Whether a path to be written has the suffix of a form of trajectories."""
    return any(path.suffix.lower() in form.suffixes for form in TRAJECTORY_FORMS.values())


def _holds_trajectory_only(path: str | Path) -> bool:
    """Whether what is there is a file of a trajectory, and no scene; logs of JSON lines are both, thus scenes."""
    if is_url(path) or not Path(path).is_file():
        return False
    try:
        form = find_form(path)
    except UnknownFormatError:
        return False
    return form is not None and not claims_of(Path(path))


@dataclass(frozen=True, slots=True, eq=False)
class _ChosenTrajectory:
    """A trajectory on its way to a file of its own.

    Attributes:
        content: what is written.
        contents: how much of each field the source holds.
        kinds: of the source's sensors and annotations, as `kinds_by_id` gives them.
        losses: the source's other trajectories.
    """

    content: TrajectoryFile
    contents: Mapping[str, int]
    kinds: Mapping[str, str] = field(default_factory=dict)
    losses: tuple[Loss, ...] = ()

    def write(self, location: Path, *, form: str, overwrite: bool, **writing: Any) -> LossReport:
        """Write the file.

        Raises:
            OptionError: the trajectory lacks what the form needs.
            OutputError: the file exists, or cannot be written.
        """
        return write_trajectory(self.content, location, form=form, overwrite=overwrite, **writing)


def _chosen_trajectory(
    source: str | Path,
    name: str | None,
    reading: Mapping[str, Any],
    writing: Mapping[str, Any],
    progress: Progress | None,
) -> _ChosenTrajectory:
    """Read the trajectory that is to be written, and see what else its source holds.

    Raises:
        OptionError: an option of writing is one of scenes, or there is no trajectory of that name.
        DataError: the source is wrong.
    """
    check_option_names("writing a trajectory", writing, _WRITING)
    content = read_trajectory_file(source, name=name, progress=progress, **reading)
    if content.form in TRAJECTORY_FORMS:
        return _ChosenTrajectory(content, contents_of(_drive(content, str(source), None)))
    form, location = format_and_location(split_name(source)[0], format=content.form)
    with form.open(
        location, **{key: value for key, value in reading.items() if key not in _OF_FILES}
    ) as scene:
        others = [trajectory for trajectory in scene.trajectories if trajectory != content.trajectory.name]
        what = f"not written: the file holds {content.trajectory.name!r}"
        losses = tuple(Loss(field=f"trajectories[{trajectory}]", what=what) for trajectory in others)
        return _ChosenTrajectory(content, contents_of(scene), kinds_by_id(scene), losses)


def _drive_of(source: str | Path, name: str | None, reading: Mapping[str, Any]) -> Scene:
    """Make a scene that holds nothing but the trajectory of a file.

    Raises:
        DataError: the source is wrong.
    """
    return _drive(read_trajectory_file(source, name=name, **reading), str(source), name)


def _drive(content: TrajectoryFile, source: str, name: str | None) -> Scene:
    if content.fixes is not None:
        fixes = replace(content.fixes, id="gnss")
        return Scene((fixes,), source=source, format=content.form, warnings=content.warnings)
    trajectory = content.trajectory if name is None else replace(content.trajectory, name=name)
    return Scene(
        (),
        trajectories={trajectory.name: trajectory},
        source=source,
        format=content.form,
        warnings=content.warnings,
    )


@dataclass(frozen=True, slots=True)
class _Target:
    """Where and how the output is written."""

    location: Path
    strict: bool
    overwrite: bool
    writing: Mapping[str, Any]


def convert(
    source: str | Path,
    target: str | Path,
    *,
    to: str | None = None,
    trajectory: str | None = None,
    strict: bool = False,
    loss: str | Path | None = None,
    overwrite: bool = False,
    reading: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
    **writing: Any,
) -> ConversionReport:
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
        overwrite: whether a target that exists may be replaced.
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
            report = convert(
                source,
                draft,
                to=to,
                trajectory=trajectory,
                strict=strict,
                loss=loss,
                reading=reading,
                progress=progress,
                **writing,
            )
        return msgspec.structs.replace(report, target=redacted(target))
    to_target = _Target(Path(target), strict, overwrite, writing)
    listing = None if loss is None else _listing(Path(loss), overwrite=overwrite)
    options = dict(reading or {})
    try:
        if to in TRAJECTORY_FORMS or (to is None and _is_trajectory_file(to_target.location)):
            _refuse_part(to_target.location, options)
            if "format" in options:
                options.setdefault("form", options.pop("format"))
            estimated_trajectory = _chosen_trajectory(source, trajectory, options, writing, progress)
            report = _write_trajectory(source, estimated_trajectory, to, to_target)
        else:
            report = _write_drive(source, to_target, to, trajectory, options, progress)
    except LossError as error:
        if listing is not None:
            listing(error.report)
        raise
    if listing is not None:
        listing(report)
    return report


def _listing(path: Path, *, overwrite: bool) -> Callable[[ConversionReport], None]:
    """What writes the list of losses; a name that it cannot have is refused before anything is read."""
    _check_report_name(path)
    check_output(path, overwrite=overwrite)
    return partial(_write_report, path=path, overwrite=overwrite)


def _write_trajectory(
    source: str | Path, estimated_trajectory: _ChosenTrajectory, to: str | None, target: _Target
) -> ConversionReport:
    form = form_for_output(target.location) if to is None else TRAJECTORY_FORMS[to]
    supports = form.supports if estimated_trajectory.content.fixes is None else form.fix_supports
    blank = ConversionReport(
        source=str(source),
        source_format=estimated_trajectory.content.form,
        target=str(target.location),
        target_format=form.name,
        warnings=estimated_trajectory.content.warnings,
        losses=LossReport(),
        fields=field_supports(
            estimated_trajectory.contents, supports, estimated_trajectory.losses, estimated_trajectory.kinds
        ),
        written=False,
    )

    def judged(reported: LossReport) -> ConversionReport:
        losses = LossReport.of([*estimated_trajectory.losses, *reported])
        found = field_supports(estimated_trajectory.contents, supports, losses, estimated_trajectory.kinds)
        return msgspec.structs.replace(blank, losses=losses, fields=found, written=True)

    return _written(partial(estimated_trajectory.write, form=form.name), blank, judged, target)


def _write_drive(
    source: str | Path,
    target: _Target,
    to: str | None,
    trajectory: str | None,
    reading: dict[str, Any],
    progress: Progress | None,
) -> ConversionReport:
    writer = _writer(target.location, to)
    opened: AbstractContextManager[Scene]
    if reading.get("form") in TRAJECTORY_FORMS or _holds_trajectory_only(source):
        _refuse_part(source, reading)
        opened = _drive_of(source, trajectory, reading)
    elif trajectory is not None and writer.along_trajectory:
        target = replace(target, writing={**target.writing, "trajectory": trajectory})
        opened = open_scene(source, **reading)
    elif trajectory is not None:
        files = ", ".join(TRAJECTORY_FORMS)
        raise OptionError(
            f"trajectory {trajectory!r}: {target.location} gets all that {source} holds; one of its trajectories is "
            f"written to files of the forms {files}"
        )
    else:
        opened = open_scene(source, **reading)
    with opened as scene:
        return _write_scene(source, scene, writer, target, progress)


def _refuse_part(location: str | Path, reading: Mapping[str, Any]) -> None:
    if not reading.keys().isdisjoint(PART):
        raise OptionError(
            f"{redacted(location)}: a trajectory is read and written whole; expected a drive, or no start and stop"
        )


def _write_scene(
    source: str | Path, scene: Scene, writer: FormatSpec, target: _Target, progress: Progress | None
) -> ConversionReport:
    scene = scene_for(writer, scene)
    counting = Counting(_telling(scene, progress))
    blank = ConversionReport(
        source=str(source),
        source_format=scene.format,
        target=str(target.location),
        target_format=writer.name,
        warnings=scene.warnings,
        losses=LossReport(),
        fields=field_supports(counting.counts(), writer.supports, (), {}),
        written=False,
    )

    def judged(losses: LossReport) -> ConversionReport:
        found = field_supports(counting.counts(), writer.supports, losses, kinds_by_id(scene))
        return msgspec.structs.replace(blank, losses=losses, fields=found, written=True)

    writer.check_output(target.location)
    return _written(partial(_written_scene, writer, counting.scene), blank, judged, target)


def _written_scene(writer: FormatSpec, scene: Scene, location: Path, **writing: Any) -> LossReport:
    return write_in(writer, scene, location, **writing)


def _written(
    write: Callable[..., LossReport],
    expected: ConversionReport,
    judged: Callable[[LossReport], ConversionReport],
    target: _Target,
) -> ConversionReport:
    written = partial(write, overwrite=target.overwrite, **target.writing)
    with stage("writing"):
        if not target.strict:
            return judged(written(target.location))
        _check_nothing_lost(expected)
        return _write_strictly(written, target.location, judged, overwrite=target.overwrite)


def _writer(location: Path, to: str | None) -> FormatSpec:
    if to is None:
        return format_for_output(location)
    if to not in format_names():
        known = ", ".join((*written_formats(), *TRAJECTORY_FORMS))
        raise OptionError(f"no format or form {to!r}; there are {known}")
    form = format_named(to)
    if not form.writes:
        known = ", ".join((*written_formats(), *TRAJECTORY_FORMS))
        raise OptionError(f"{location}: the format {to} is only read; written are {known}")
    return form


def _telling(scene: Scene, progress: Progress | None) -> Scene:
    """The scene that reports how many of its frames have been read; images of a video are written all at once."""
    if progress is None:
        return scene
    total = sum(
        len(frame_times(sensor))
        for sensor in scene.sensors
        if isinstance(sensor, LidarSensor | RadarSensor)
        or (isinstance(sensor, CameraSensor) and sensor.video is None)
    )
    read: set[tuple[type, Identifier, int]] = set()

    def reported(sensor_id: Identifier, k: int, frame: AnyFrame) -> None:
        if isinstance(frame, DepthFrame):
            return
        read.add((type(sensor_id), sensor_id, k))
        progress(min(len(read), total), total)

    return watched(scene, reported)
