"""From a decoded line to the columns: one function per kind of line."""

from collections.abc import Mapping, Sequence
from math import nan

from sceneloom.formats.recording.columns import (
    CameraColumns,
    Columns,
    LidarColumns,
    PoseColumns,
    RecordingColumns,
)
from sceneloom.formats.recording.lidar_files import LIDAR_MODELS, problem_of_name
from sceneloom.formats.recording.line_shapes import FrameEntry, GnssFix, Line, Pose, SensorSample, Sweep

SENSOR_WIDTHS: Mapping[str, int] = {
    "accelerometer": 3,
    "gyroscope": 3,
    "magnetometer": 3,
    "imuTemperature": 1,
}
"""How many values a sample of each sensor has; of others the first sample decides."""


class UnfitLineError(ValueError):
    """A line is valid JSON, but does not say what a line of its kind has to."""


def take_line(
    columns: RecordingColumns, line: Line, number: int, *, offset: int = -1
) -> tuple[Columns | None, float]:
    """Put all that a line says into the columns.

    Args:
        number: of the line in the file.
        offset: byte at which a line begins that says more than its shape, else -1.

    Returns:
        The stream that grew, of several the last, None for a line of pictures only or of nothing known; and the time.

    Raises:
        UnfitLineError: it has no time, or a part of it does not say what it has to.
    """
    seconds, stream = line.time, None
    if seconds is None:
        raise UnfitLineError("time: missing; expected seconds")
    sample = line.sensor
    if sample is not None:
        stream = take_sample(columns, seconds, sample)
    if line.gps is not None:
        stream = take_fix(columns, seconds, line.gps)
    if line.groundTruth is not None:
        stream = take_pose(columns, seconds, line.groundTruth, ("groundTruth", "groundTruth"), number)
    if line.pose is not None:
        stream = take_pose(columns, seconds, line.pose, ("pose", line.pose.name or "pose"), number)
    if line.lidar is not None:
        stream = take_sweep(columns, seconds, line.lidar, number)
    if line.frames is not None:
        take_frames(columns, seconds, line.frames, line.number, line=number, offset=offset)
    return stream, seconds


def take_sample(columns: RecordingColumns, seconds: float, sample: SensorSample) -> Columns:
    """Add a sample of an N-axis sensor to its stream.

    Raises:
        UnfitLineError: the number of values is not that of the stream.
    """
    values = sample.values
    stream = columns.sensors.get(sample.type)
    if stream is None or len(values) != stream.width:
        stream = _stream_for(columns, sample)
    # the loop over all lines spends its time here: not `append`, a call less
    stream.seconds.append(seconds)
    stream.values.fromlist(values)
    return stream


def _stream_for(columns: RecordingColumns, sample: SensorSample) -> Columns:
    known = columns.sensors.get(sample.type)
    width = known.width if known else SENSOR_WIDTHS.get(sample.type, len(sample.values))
    if len(sample.values) != width or width == 0:
        expected = str(width) if width else "at least one"
        raise UnfitLineError(f"sensor.values: {sample.values}; expected {expected} of {sample.type!r}")
    return columns.sensors.setdefault(sample.type, Columns(width))


def take_fix(columns: RecordingColumns, seconds: float, fix: GnssFix) -> Columns:
    """Add a fix of the satellite receiver."""
    accuracies = (nan if value is None else value for value in (fix.accuracy, fix.verticalAccuracy))
    columns.gnss.append(seconds, [fix.latitude, fix.longitude, fix.altitude, *accuracies])
    return columns.gnss


def take_pose(
    columns: RecordingColumns, seconds: float, pose: Pose, origin: tuple[str, str], line: int
) -> Columns:
    """Add a pose to the trajectory of that root key and name."""
    trajectory = columns.poses.get(origin)
    if trajectory is None:
        trajectory = columns.poses.setdefault(origin, PoseColumns())
    position, turn = pose.position, pose.orientation
    quaternion = (nan, nan, nan, nan) if turn is None else (turn.x, turn.y, turn.z, turn.w)
    trajectory.samples.append(seconds, [position.x, position.y, position.z, *quaternion])
    trajectory.lines.append(line)
    return trajectory.samples


def take_sweep(columns: RecordingColumns, seconds: float, sweep: Sweep, line: int) -> Columns:
    """Add a sweep of a lidar.

    Raises:
        UnfitLineError: the model is unknown, or the file's name leads out of the folder.
    """
    if sweep.model not in LIDAR_MODELS:
        known = ", ".join(map(repr, LIDAR_MODELS))
        raise UnfitLineError(f"lidar.model: {sweep.model!r}; expected one of: {known}")
    problem = problem_of_name(sweep.dataFile)
    if problem:
        raise UnfitLineError(problem)
    lidar = columns.lidars.setdefault(sweep.lidarInd, LidarColumns(sweep.model))
    lidar.sweeps.append(seconds, [])
    lidar.files.append(sweep.dataFile)
    lidar.lines.append(line)
    return lidar.sweeps


def take_frames(
    columns: RecordingColumns,
    seconds: float,
    entries: Sequence[FrameEntry],
    number: int | None,
    *,
    line: int,
    offset: int,
) -> None:
    """Add a line of pictures.

    Args:
        line: its number in the file.
        offset: byte at which it begins, where it says more than the columns hold, else -1.

    Raises:
        UnfitLineError: it has no number, or names a camera twice.
    """
    if number is None:
        raise UnfitLineError(
            "number: missing; expected the frame's number, which says which picture is meant"
        )
    indices = [entry.cameraInd for entry in entries]
    if len(set(indices)) != len(indices):
        raise UnfitLineError(f"frames[].cameraInd: {indices}; expected each camera once")
    frames = columns.frames
    for entry in entries:
        camera = frames.cameras.setdefault(entry.cameraInd, CameraColumns())
        camera.rows.append(len(frames.numbers))
        camera.seconds.append(seconds if entry.time is None else entry.time)
        camera.parameters.append(frames.text_index(bytes(entry.cameraParameters)))
        camera.mounts.append(frames.text_index(bytes(entry.imuToCamera)))
        camera.missing.append(entry.missingBitmap)
    frames.numbers.append(number)
    frames.seconds.append(seconds)
    frames.lines.append(line)
    frames.offsets.append(offset)
