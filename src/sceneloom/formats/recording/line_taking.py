"""From a decoded line to the columns: what a line holds is looked through first, then all of it is taken."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from typing import Any, TypeVar

from msgspec import UnsetType

from sceneloom.formats.recording.columns import (
    CameraColumns,
    Columns,
    LidarColumns,
    PoseColumns,
    RecordingColumns,
)
from sceneloom.formats.recording.lidar_words import LIDAR_MODELS, problem_of_name
from sceneloom.formats.recording.line_shapes import (
    FrameEntry,
    FrequentLine,
    GnssFix,
    Line,
    Pose,
    SensorSample,
    Sweep,
)

SENSOR_WIDTHS: Mapping[str, int] = {
    "accelerometer": 3,
    "gyroscope": 3,
    "magnetometer": 3,
    "imuTemperature": 1,
}
"""How many values a sample of each sensor has; of others the first sample decides."""

Origin = tuple[str, str]
"""Root key and name of a trajectory or of a receiver."""

Value = TypeVar("Value")


class UnfitLineError(ValueError):
    """A line is valid JSON, but does not state what a line of its kind has to."""


@dataclass(slots=True)
class ParsedLines:
    """What a line brought.

    Attributes:
        seconds: its time.
        streams: those that it gave a sample, each as many times as it did.
        frames: whether it reported images.
        leftover: whether it says something that no stream took.
    """

    seconds: float
    streams: list[Columns] = field(default_factory=list)
    frames: bool = False
    leftover: bool = False


def take_line(
    columns: RecordingColumns,
    line: Line | FrequentLine,
    number: int,
    *,
    poses: Sequence[tuple[Origin, Pose]] = (),
    fixes: Sequence[tuple[Origin, GnssFix]] = (),
    offset: Callable[[], int] | None = None,
) -> ParsedLines:
    """Put all that a line says into the columns, or, where a part of it is wrong, nothing.

    Args:
        number: of the line in the file.
        poses: those under keys that have no shape of their own.
        fixes: likewise.
        offset: gives the byte at which the line begins, where it says more than the columns hold.

    Raises:
        UnfitLineError: it has no time, or a part of it does not state what it has to.
    """
    seconds = line.time
    if seconds is None:
        raise UnfitLineError("time: missing; expected seconds")
    parsed_lines = ParsedLines(seconds)
    sample, sweep, entries = given(line.sensor), given(getattr(line, "lidar", None)), given(line.frames)
    _check(columns, sample, sweep, entries, given(line.number))
    if sample is not None:
        _take_sample(columns, parsed_lines, sample)
    for origin, pose in [*_own_poses(line), *poses]:
        parsed_lines.streams.append(_take_pose(columns, seconds, pose, origin, number))
    for origin, fix in [*_own_fixes(line), *fixes]:
        parsed_lines.streams.append(_take_fix(columns, seconds, fix, origin))
    barometer = given(getattr(line, "barometer", None))
    if barometer is not None:
        parsed_lines.streams.append(
            _append(columns, columns.barometer, seconds, [barometer.pressureHectopascals])
        )
    if sweep is not None:
        parsed_lines.streams.append(_take_sweep(columns, seconds, sweep, number))
    if entries is not None:
        at = -1 if offset is None else offset()
        take_frames(columns, seconds, entries, given(line.number) or 0, line=number, offset=at)
        parsed_lines.frames = True
    parsed_lines.leftover |= given(line.number) is not None and entries is None
    return parsed_lines


def given(value: Value | UnsetType | None) -> Value | None:
    """What a shape holds, None for what it holds none of."""
    return None if isinstance(value, UnsetType) else value


def _own_poses(line: Line | FrequentLine) -> list[tuple[Origin, Pose]]:
    truth, pose = given(line.groundTruth), given(getattr(line, "pose", None))
    found: list[tuple[Origin, Pose]] = []
    if truth is not None:
        found.append((("groundTruth", "groundTruth"), truth))
    if pose is not None:
        found.append((("pose", given(pose.name) or "pose"), pose))
    return found


def _own_fixes(line: Line | FrequentLine) -> list[tuple[Origin, GnssFix]]:
    fix = given(getattr(line, "gps", None))
    return [] if fix is None else [(("gps", "gps"), fix)]


def _check(
    columns: RecordingColumns,
    sample: SensorSample | None,
    sweep: Sweep | None,
    entries: Sequence[FrameEntry] | None,
    number: int | None,
) -> None:
    if sample is not None:
        _check_sample(sample)
    if sweep is not None:
        _check_sweep(sweep)
    if entries is not None:
        check_frames(entries, number)
    if columns.log.is_full:
        raise UnfitLineError("the file names more streams than are distinguished")


def _check_sample(sample: SensorSample) -> None:
    width = SENSOR_WIDTHS.get(sample.type)
    if not sample.values or (width is not None and len(sample.values) != width):
        expected = "at least one" if width is None else str(width)
        raise UnfitLineError(f"sensor.values: {sample.values}; expected {expected} of {sample.type!r}")


def _take_sample(columns: RecordingColumns, parsed_lines: ParsedLines, sample: SensorSample) -> None:
    """Add a sample; of a sensor that the format does not name, samples of another width are left as text."""
    values = list(sample.values)
    stream = columns.sensors.get(sample.type)
    if stream is None:
        stream = columns.sensors.setdefault(sample.type, Columns(len(values)))
    if len(values) == stream.width:
        parsed_lines.streams.append(_append(columns, stream, parsed_lines.seconds, values))
    else:
        parsed_lines.leftover = True


def _append(columns: RecordingColumns, stream: Columns, seconds: float, values: list[float]) -> Columns:
    if not stream.code:
        stream.code = columns.log.new_code()
    stream.append(seconds, values)
    return stream


def _take_fix(columns: RecordingColumns, seconds: float, fix: GnssFix, origin: Origin) -> Columns:
    accuracies = [nan if given(value) is None else value for value in (fix.accuracy, fix.verticalAccuracy)]
    stream = columns.gnss if origin == ("gps", "gps") else columns.receivers.get(origin)
    if stream is None:
        stream = columns.receivers.setdefault(origin, Columns(5))
    values: list[Any] = [fix.latitude, fix.longitude, fix.altitude, *accuracies]
    return _append(columns, stream, seconds, values)


def _take_pose(columns: RecordingColumns, seconds: float, pose: Pose, origin: Origin, line: int) -> Columns:
    trajectory = columns.poses.get(origin)
    if trajectory is None:
        trajectory = columns.poses.setdefault(origin, PoseColumns())
    position, rotation = pose.position, given(pose.orientation)
    quaternion = (
        (nan, nan, nan, nan) if rotation is None else (rotation.x, rotation.y, rotation.z, rotation.w)
    )
    trajectory.lines.append(line)
    return _append(columns, trajectory.samples, seconds, [position.x, position.y, position.z, *quaternion])


def _check_sweep(sweep: Sweep) -> None:
    if sweep.model not in LIDAR_MODELS:
        known = ", ".join(map(repr, LIDAR_MODELS))
        raise UnfitLineError(f"lidar.model: {sweep.model!r}; expected one of: {known}")
    problem = problem_of_name(sweep.dataFile)
    if problem:
        raise UnfitLineError(problem)


def _take_sweep(columns: RecordingColumns, seconds: float, sweep: Sweep, line: int) -> Columns:
    index = given(sweep.lidarInd) or 0
    lidar = columns.lidars.get(index)
    if lidar is None:
        lidar = columns.lidars.setdefault(index, LidarColumns(sweep.model))
    lidar.files.append(sweep.dataFile)
    lidar.lines.append(line)
    return _append(columns, lidar.sweeps, seconds, [])


def check_frames(entries: Sequence[FrameEntry], number: int | None) -> None:
    """Look through the images that a line reports.

    Raises:
        UnfitLineError: it has no number, or names a camera twice.
    """
    if number is None:
        raise UnfitLineError("number: missing; expected the frame's number, which says which image is meant")
    indices = [entry.cameraInd for entry in entries]
    if len(set(indices)) != len(indices):
        raise UnfitLineError(f"frames[].cameraInd: {indices}; expected each camera once")


def take_frames(
    columns: RecordingColumns,
    seconds: float,
    entries: Sequence[FrameEntry],
    number: int,
    *,
    line: int,
    offset: int = -1,
) -> None:
    """Add a line of images.

    Args:
        line: its number in the file.
        offset: byte at which it begins, where it says more than the columns hold, else -1.

    Raises:
        UnfitLineError: it names a camera twice.
    """
    check_frames(entries, number)
    frames = columns.frames
    if not frames.code:
        frames.code = columns.log.new_code()
    row, cameras = len(frames.numbers), frames.cameras
    for entry in entries:
        camera = cameras.get(entry.cameraInd)
        if camera is None:
            camera = cameras.setdefault(entry.cameraInd, CameraColumns())
        time, camera_model, mount = given(entry.time), entry.cameraParameters, entry.imuToCamera
        camera.rows.append(row)
        camera.seconds.append(seconds if time is None else time)
        camera.parameters.append(frames.text_index(bytes(camera_model)) if camera_model else -1)
        camera.mounts.append(frames.text_index(bytes(mount)) if mount else -1)
        camera.missing.append(entry.missingBitmap is True)
    frames.numbers.append(number)
    frames.seconds.append(seconds)
    frames.lines.append(line)
    frames.offsets.append(offset)
