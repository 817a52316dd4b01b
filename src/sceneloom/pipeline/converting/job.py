"""From one format to another, through the scene."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import LossError, OptionError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.output import check_output
from sceneloom.formats.remote.uploads import uploading
from sceneloom.formats.spec import FormatSpec
from sceneloom.formats.table import (
    PART,
    format_for_output,
    format_named,
    format_names,
    open_scene,
    scene_for,
    write_in,
    written_formats,
)
from sceneloom.formats.trajectories.table import TRAJECTORY_FORMS, form_for_output
from sceneloom.formats.urls import is_url
from sceneloom.pipeline.converting.field_names import kinds_by_id
from sceneloom.pipeline.converting.report import ConversionReport, check_report_name, write_report
from sceneloom.pipeline.converting.strictly import check_nothing_lost, write_strictly
from sceneloom.pipeline.converting.supports import field_supports
from sceneloom.pipeline.converting.trajectories import (
    ChosenTrajectory,
    chosen_trajectory,
    drive_of,
    holds_trajectory_only,
    is_trajectory_file,
)
from sceneloom.redaction import redacted
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.counting import Counting
from sceneloom.scene.depth import DepthFrame
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Identifier, Progress
from sceneloom.scene.watched import AnyFrame, watched
from sceneloom.stages import stage


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
        if to in TRAJECTORY_FORMS or (to is None and is_trajectory_file(to_target.location)):
            _refuse_part(to_target.location, options)
            if "format" in options:
                options.setdefault("form", options.pop("format"))
            estimated_trajectory = chosen_trajectory(source, trajectory, options, writing, progress)
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
    check_report_name(path)
    check_output(path, overwrite=overwrite)
    return partial(write_report, path=path, overwrite=overwrite)


def _write_trajectory(
    source: str | Path, estimated_trajectory: ChosenTrajectory, to: str | None, target: _Target
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
    if reading.get("form") in TRAJECTORY_FORMS or holds_trajectory_only(source):
        _refuse_part(source, reading)
        opened = drive_of(source, trajectory, reading)
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
        check_nothing_lost(expected)
        return write_strictly(written, target.location, judged, overwrite=target.overwrite)


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
