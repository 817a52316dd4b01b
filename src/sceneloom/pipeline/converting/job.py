"""From one format to another, through the scene."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from sceneloom.errors import OptionError
from sceneloom.formats.loss import LossReport
from sceneloom.formats.table import Format, format_and_place, format_for_output, format_named, format_names
from sceneloom.formats.trajectories import TRAJECTORY_FORMS
from sceneloom.pipeline.converting.trajectories import (
    holds_trajectory_only,
    is_trajectory_file,
    write_drive,
    write_trajectory_file,
)
from sceneloom.scene import CameraSensor, Identifier, LidarSensor, Notice, RadarSensor, Scene
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Progress
from sceneloom.scene.watched import AnyFrame, watched


class ConversionReport(msgspec.Struct, frozen=True, kw_only=True):
    """One conversion.

    Attributes:
        source, source_format: what was read, and as what.
        target, target_format: what was written, and as what.
        notices: what was assumed, repaired or left out on reading.
        losses: what the target could not hold.
    """

    source: str
    source_format: str
    target: str
    target_format: str
    notices: tuple[Notice, ...]
    losses: LossReport


def convert(
    source: str | Path,
    target: str | Path,
    *,
    to: str | None = None,
    trajectory: str | None = None,
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
        target: a file or folder; its suffix chooses the format unless `to` names it.
        to: name of the target's format, or form of trajectories.
        trajectory: name of the trajectory, where a file of trajectories is written or read.
        overwrite: whether a target that exists may be replaced.
        reading: reading options of the source's format.
        progress: told after each sweep, radar cycle and single picture that is written, how many are done of how many.
        writing: writing options of the target's format.

    Raises:
        UnknownFormatError: no format fits the source.
        DataError: the source is wrong.
        OptionError: there is no format or form `to`, or `trajectory` is named where a whole drive is written.
        OutputError: the target exists, or cannot be written.
    """
    place, options = Path(target), dict(reading or {})
    if to in TRAJECTORY_FORMS or (to is None and is_trajectory_file(place)):
        told = write_trajectory_file(
            source,
            place,
            name=trajectory,
            to=to,
            overwrite=overwrite,
            reading=options,
            writing=writing,
            progress=progress,
        )
        return _report(source, place, *told)
    if to is not None and to not in format_names():
        known = ", ".join((*format_names(), *TRAJECTORY_FORMS))
        raise OptionError(f"no format or form {to!r}; there are {known}")
    writer = format_for_output(place) if to is None else format_named(to)
    if options.get("form") in TRAJECTORY_FORMS or holds_trajectory_only(source):
        write = partial(_write, writer, place, overwrite=overwrite, **writing)
        told = write_drive(source, write, name=trajectory, reading=options)
        return _report(source, place, told[0], writer.name, *told[2:])
    if trajectory is not None:
        files = ", ".join(TRAJECTORY_FORMS)
        raise OptionError(
            f"trajectory {trajectory!r}: {target} gets all that {source} holds; one of its trajectories is written to "
            f"files of the forms {files}"
        )
    reader, origin = format_and_place(source)
    with reader.open(origin, **options) as scene:
        losses = _write(writer, place, _telling(scene, progress), overwrite=overwrite, **writing)
        return _report(source, place, reader.name, writer.name, scene.notices, losses)


def _write(writer: Format, place: Path, scene: Scene, **writing: Any) -> LossReport:
    return writer.write(scene, place, **writing)


def _report(
    source: str | Path,
    target: Path,
    source_format: str,
    target_format: str,
    notices: tuple[Notice, ...],
    losses: LossReport,
) -> ConversionReport:
    return ConversionReport(
        source=str(source),
        source_format=source_format,
        target=str(target),
        target_format=target_format,
        notices=notices,
        losses=losses,
    )


def _telling(scene: Scene, progress: Progress | None) -> Scene:
    """The scene that tells how many of its frames have been read; pictures of a video are written all at once."""
    if progress is None:
        return scene
    total = sum(
        len(frame_times(sensor))
        for sensor in scene.sensors
        if isinstance(sensor, LidarSensor | RadarSensor)
        or (isinstance(sensor, CameraSensor) and sensor.video is None)
    )
    read: set[tuple[type, Identifier, int]] = set()

    def told(sensor_id: Identifier, k: int, frame: AnyFrame) -> None:
        del frame
        read.add((type(sensor_id), sensor_id, k))
        progress(min(len(read), total), total)

    return watched(scene, told)
