"""`data.jsonl`: the shapes of its lines, the columns that they are read into line by line, and these as arrays."""

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, BinaryIO, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from sceneloom.arrays import Float64Array, Int64Array, UInt16Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.text_tables import nanoseconds
from sceneloom.formats.recording.json_faults import (
    BYTE_ORDER_MARK,
    DECODER_FAULTS,
    FARTHEST_TIME,
    json_problem,
    other_file,
    quote,
)
from sceneloom.formats.recording.legacy import has_old_frame, with_frames
from sceneloom.warnings import WarningKind


@dataclass(slots=True, eq=False)
class Columns:
    """A stream of `width` numbers with a time each, in the order of the file.

    Attributes:
        width: numbers per sample.
        code: what stands for this stream in `LineLog.codes`.
        seconds: times [s].
        values: the samples one after another.
        further: by row, the text of a line that holds more than these columns do.
    """

    width: int
    code: int = 0
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    further: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.seconds)

    def append(self, seconds: float, values: list[float]) -> None:
        """Add a sample."""
        self.seconds.append(seconds)
        self.values.fromlist(values)


@dataclass(slots=True, eq=False)
class PoseColumns:
    """The lines of one trajectory.

    Attributes:
        samples: x y z [m], then the quaternion x y z w, NaN where a line has none.
        lines: number of each sample's line.
    """

    samples: Columns = field(default_factory=lambda: Columns(7))
    lines: "array[int]" = field(default_factory=lambda: array("q"))


@dataclass(slots=True, eq=False)
class LidarColumns:
    """The lines of one lidar.

    Attributes:
        model: the first line's word for the layout of its files.
        sweeps: no values, the times only.
        files: `dataFile` of each line.
        lines: number of each line.
    """

    model: str
    sweeps: Columns = field(default_factory=lambda: Columns(0))
    files: list[str] = field(default_factory=list)
    lines: "array[int]" = field(default_factory=lambda: array("q"))


@dataclass(slots=True, eq=False)
class CameraColumns:
    """One camera's entries in the `frames` lines.

    Attributes:
        rows: which frames line each entry is in.
        seconds: time of each image [s].
        parameters: which of `FrameColumns.texts` holds its camera model, -1 for none of its own.
        mounts: the same for its `imuToCamera`.
        missing: 1 where there is no image (`missingBitmap`).
    """

    rows: "array[int]" = field(default_factory=lambda: array("q"))
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    parameters: "array[int]" = field(default_factory=lambda: array("q"))
    mounts: "array[int]" = field(default_factory=lambda: array("q"))
    missing: "array[int]" = field(default_factory=lambda: array("b"))


@dataclass(slots=True, eq=False)
class FrameColumns:
    """The `frames` lines.

    Attributes:
        code: what stands for these lines in `LineLog.codes`.
        numbers: `number` of each line.
        seconds: `time` of each line [s].
        lines: number of each line in the file.
        offsets: byte at which a line begins that says more than the columns hold, -1 for others.
        cameras: entries by `cameraInd`.
        texts: every different text of `cameraParameters` and `imuToCamera`, with its location in this order.
    """

    code: int = 0
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    lines: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))
    cameras: dict[int, CameraColumns] = field(default_factory=dict)
    texts: dict[bytes, int] = field(default_factory=dict)

    def text_index(self, text: bytes) -> int:
        """Give the position of a text, -1 for none."""
        return self.texts.setdefault(text, len(self.texts)) if text else -1


_NOTHING, TEXT, SEVERAL = 0, 1, 2
"""Codes of lines that nothing was taken from, that are kept as text, and that several streams have a part in."""

_MOST_STREAMS = 60_000


@dataclass(slots=True, eq=False)
class SharedLine:
    """A line that more than one stream has a part in.

    Attributes:
        text: all of it.
        rows: code and row of each sample that it brought; a line of images has no row here.
    """

    text: str
    rows: list[tuple[int, int]] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class LineLog:
    """What became of each line of the file, in its order.

    Attributes:
        codes: by line, the code of the stream that took it, or `_NOTHING`, `TEXT`, `SEVERAL`.
        shared: lines of several streams, by number.
        last_code: the greatest code that is given away.
    """

    codes: "array[int]" = field(default_factory=lambda: array("H"))
    shared: dict[int, SharedLine] = field(default_factory=dict)
    last_code: int = SEVERAL

    @property
    def is_full(self) -> bool:
        """Whether no further stream can be distinguished from the others."""
        return self.last_code >= _MOST_STREAMS

    def new_code(self) -> int:
        """Give away the next code."""
        self.last_code += 1
        return self.last_code


@dataclass(slots=True, eq=False)
class RecordingColumns:
    """All lines of a recording.

    Attributes:
        sensors: streams by `sensor.type`.
        gnss: latitude, longitude [deg], altitude [m], accuracy and vertical accuracy [m], NaN where not given.
        receivers: the same of satellite receivers under other root keys, by root key and name.
        barometer: `barometer` lines [hPa].
        poses: trajectories by the root key of their lines ("" for poses at the root itself) and their name.
        lidars: by `lidarInd`.
        frames: the `frames` lines.
        other_lines: the text of lines that hold none of these.
        other_seconds: the time of each of those lines [s], NaN where it has none.
        other_keys: how many of those lines have which first key.
        log: what became of each line.
    """

    sensors: dict[str, Columns] = field(default_factory=dict)
    gnss: Columns = field(default_factory=lambda: Columns(5))
    receivers: dict[tuple[str, str], Columns] = field(default_factory=dict)
    barometer: Columns = field(default_factory=lambda: Columns(1))
    poses: dict[tuple[str, str], PoseColumns] = field(default_factory=dict)
    lidars: dict[int, LidarColumns] = field(default_factory=dict)
    frames: FrameColumns = field(default_factory=FrameColumns)
    other_lines: list[str] = field(default_factory=list)
    other_seconds: "array[float]" = field(default_factory=lambda: array("d"))
    other_keys: dict[str, int] = field(default_factory=dict)
    log: LineLog = field(default_factory=LineLog)

    def streams(self) -> dict[tuple[str, ...], Columns]:
        """All streams of numbers, by what reports them apart."""
        return {
            **{("sensor", name): stream for name, stream in self.sensors.items()},
            ("gps",): self.gnss,
            ("barometer",): self.barometer,
            **{("receiver", *origin): stream for origin, stream in self.receivers.items()},
            **{("pose", *origin): stream.samples for origin, stream in self.poses.items()},
            **{("lidar", str(index)): lidar.sweeps for index, lidar in self.lidars.items()},
        }


_Seconds = Annotated[float, Meta(ge=-FARTHEST_TIME, le=FARTHEST_TIME)]

_Metres = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""A position; the bounds keep the arithmetic with it from overflowing."""

SensorIndex = Annotated[int, Meta(ge=0, le=254)]
_FrameNumber = Annotated[int, Meta(ge=-(2**60), le=2**60)]


class Point(Struct, gc=False):
    """`position`."""

    x: _Metres
    y: _Metres
    z: _Metres


class ExactPoint(Point, forbid_unknown_fields=True, gc=False):
    """`position` and nothing else."""


class Quaternion(Struct, gc=False):
    """`orientation`."""

    x: float
    y: float
    z: float
    w: float


class ExactQuaternion(Quaternion, forbid_unknown_fields=True, gc=False):
    """`orientation` and nothing else."""


class Pose(Struct, gc=False):
    """Where the device was: `groundTruth` or the output of a method."""

    position: Point
    orientation: Quaternion | None = None


class ExactPose(Pose, forbid_unknown_fields=True, gc=False):
    """A pose and nothing else."""

    position: ExactPoint
    orientation: ExactQuaternion | UnsetType = UNSET  # type: ignore[assignment]


class NamedPose(Pose, gc=False):
    """`pose`: the output of the method that it names."""

    name: str | None = None


class ExactNamedPose(NamedPose, forbid_unknown_fields=True, gc=False):
    """A named pose and nothing else."""

    position: ExactPoint
    orientation: ExactQuaternion | UnsetType = UNSET  # type: ignore[assignment]
    name: str | UnsetType = UNSET  # type: ignore[assignment]


class SensorSample(Struct, gc=False):
    """`sensor`: one sample of an N-axis sensor."""

    type: str
    values: list[float]


class ExactSensorSample(SensorSample, forbid_unknown_fields=True, gc=False):
    """A sample and nothing else."""


class GnssFix(Struct, gc=False):
    """`gps`: degrees and metres."""

    latitude: float
    longitude: float
    altitude: float
    accuracy: float | None = None
    verticalAccuracy: float | None = None  # noqa: N815 - the format's own word


class ExactGnssFix(GnssFix, forbid_unknown_fields=True, gc=False):
    """A fix and nothing else."""

    accuracy: float | UnsetType = UNSET  # type: ignore[assignment]
    verticalAccuracy: float | UnsetType = UNSET  # type: ignore[assignment]  # noqa: N815 - the format's own word


class Pressure(Struct, gc=False):
    """`barometer`: the pressure of the air."""

    pressureHectopascals: float  # noqa: N815 - the format's own word


class ExactPressure(Pressure, forbid_unknown_fields=True, gc=False):
    """A pressure and nothing else."""


class Sweep(Struct, gc=False):
    """`lidar`: one file of points."""

    model: str
    dataFile: str  # noqa: N815 - the format's own word
    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars


class ExactSweep(Sweep, forbid_unknown_fields=True, gc=False):
    """A sweep and nothing else; the first lidar's index is not written."""

    lidarInd: Annotated[int, Meta(ge=1, le=254)] | UnsetType = UNSET  # type: ignore[assignment]  # noqa: N815


class FrameEntry(Struct, gc=False):
    """One camera's part of a `frames` line."""

    cameraInd: SensorIndex  # noqa: N815 - the format's own word
    time: _Seconds | None = None
    cameraParameters: Raw = Raw()  # noqa: N815 - the format's own word
    imuToCamera: Raw = Raw()  # noqa: N815 - the format's own word
    missingBitmap: bool = False  # noqa: N815 - the format's own word


class ExactFrameEntry(FrameEntry, forbid_unknown_fields=True, gc=False):
    """An entry and nothing else."""

    time: _Seconds | UnsetType = UNSET  # type: ignore[assignment]
    missingBitmap: bool | UnsetType = UNSET  # type: ignore[assignment]  # noqa: N815 - the format's own word


class Line(Struct, kw_only=True, gc=False):
    """A line, whatever else may be in it."""

    time: _Seconds | None = None
    sensor: SensorSample | None = None
    gps: GnssFix | None = None
    groundTruth: Pose | None = None  # noqa: N815 - the format's own word
    pose: NamedPose | None = None
    lidar: Sweep | None = None
    barometer: Pressure | None = None
    frames: Sequence[FrameEntry] | None = None
    number: _FrameNumber | None = None


class FrequentLine(Struct, kw_only=True, forbid_unknown_fields=True, gc=False):
    """What most lines are: the fewer fields a shape has, the sooner it is clear that a line has none but one."""

    time: _Seconds
    sensor: ExactSensorSample | UnsetType = UNSET
    groundTruth: ExactPose | UnsetType = UNSET  # noqa: N815 - the format's own word
    frames: Sequence[ExactFrameEntry] | UnsetType = UNSET
    number: _FrameNumber | UnsetType = UNSET


class ExactLine(FrequentLine, kw_only=True, forbid_unknown_fields=True, gc=False):
    """A line that the columns can hold."""

    gps: ExactGnssFix | UnsetType = UNSET
    pose: ExactNamedPose | UnsetType = UNSET
    lidar: ExactSweep | UnsetType = UNSET
    barometer: ExactPressure | UnsetType = UNSET


ROOT_KEYS = frozenset(field.name for field in msgspec.structs.fields(Line))
"""The keys at the root of a line that have a shape of their own."""

RECORD_KEYS = ROOT_KEYS - {"time", "number"}
"""Those of them that state what a line is about."""

LIDAR_MODELS = ("RoboSense M1 XYZIRT",)
"""The layouts of files that the format describes."""


def problem_of_name(name: str) -> str | None:
    """Report what is wrong with a `dataFile`: empty, absolute, leading up, or no file name at all; None for nothing."""
    windows = PureWindowsPath(name)
    leads_out = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
    if leads_out or not name.strip() or "\0" in name:
        return f"lidar.dataFile: {name!r}; expected a path inside the recording's folder"
    return None


@dataclass(frozen=True, slots=True, eq=False)
class SortedColumns:
    """A stream in the order of its times, read-only.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        seconds: (N,) float64 [s], as the file has them.
        values: (N, K) float64.
        order: (N,) int64, row of the file's order that each row was.
    """

    timestamps_ns: Int64Array
    seconds: Float64Array
    values: Float64Array
    order: Int64Array


def view(numbers: "array[float]") -> Float64Array:
    """Give the numbers as an array without copying them; the column cannot grow while it is in use."""
    return np.frombuffer(numbers, np.float64) if numbers else np.zeros(0)


def is_sorted(seconds: Float64Array) -> bool:
    """Whether no time is less than the one before."""
    return bool((seconds[1:] >= seconds[:-1]).all())


def time_order(seconds: Float64Array) -> Int64Array:
    """Give the order that sorts by time and keeps the order of equal times, (N,) int64."""
    if is_sorted(seconds):
        return np.arange(len(seconds), dtype=np.int64)
    return np.argsort(seconds, kind="stable").astype(np.int64)


def by_time(stream: Columns) -> SortedColumns:
    """Give a stream sorted by time, samples of one time in the order of the file."""
    seconds = view(stream.seconds)
    values = view(stream.values).reshape(len(seconds), stream.width)
    order = time_order(seconds)
    if not is_sorted(seconds):
        seconds, values = seconds[order], values[order]
    return SortedColumns(read_only(nanoseconds(seconds)), read_only(seconds), read_only(values), read_only(order))


def row_keys(stream: Columns, rows: Sequence[int]) -> list[str]:
    """Name rows by their time [ns], as text; of several samples of one time, the second is `TIME#1`."""
    if not rows:
        return []
    timestamps = by_time(stream).timestamps_ns
    locations = np.empty(len(timestamps), np.int64)
    locations[time_order(view(stream.seconds))] = np.arange(len(timestamps))
    chosen = locations[np.asarray(rows, np.int64)]
    counts = chosen - np.searchsorted(timestamps, timestamps[chosen], "left")
    return [_row_key(*pair) for pair in zip(timestamps[chosen].tolist(), counts.tolist(), strict=True)]


def _row_key(timestamp_ns: int, count: int) -> str:
    """Name a sample: its time [ns], and how many samples of that time come before it, if any do."""
    return f"{timestamp_ns}#{count}" if count else str(timestamp_ns)


def further_by_time(stream: Columns) -> dict[str, str]:
    """Give the texts of lines that state more than a stream holds, by the key of their row."""
    rows = sorted(stream.further)
    return {key: stream.further[row] for key, row in zip(row_keys(stream, rows), rows, strict=True)}


def lines_of(log: LineLog, code: int) -> Int64Array:
    """Give the number of the line that each row of a stream was read from, (N,) int64, counted from 1."""
    lines: Int64Array = np.flatnonzero(_codes(log) == code)
    lines += 1
    beside = [(row, line) for line, shared in log.shared.items() for own, row in shared.rows if own == code]
    if not beside:
        return lines
    rows = sorted(beside)
    return np.insert(lines, [row - k for k, (row, _) in enumerate(rows)], [line for _, line in rows])


def line_seconds(columns: RecordingColumns) -> Float64Array:
    """Give the time of each line in the order of the file, (N,) float64 [s], NaN for lines without one."""
    codes, frames = _codes(columns.log), columns.frames
    seconds = np.full(len(codes), np.nan)
    in_several = {code for shared in columns.log.shared.values() for code, _ in shared.rows}
    for stream in columns.streams().values():
        if stream.code in in_several:
            seconds[lines_of(columns.log, stream.code) - 1] = view(stream.seconds)
        elif len(stream):
            seconds[codes == stream.code] = view(stream.seconds)
    if len(frames.seconds):
        seconds[np.frombuffer(frames.lines, np.int64) - 1] = view(frames.seconds)
    if columns.other_lines:
        seconds[codes == TEXT] = view(columns.other_seconds)
    return seconds


def _codes(log: LineLog) -> UInt16Array:
    return np.frombuffer(log.codes, np.uint16) if log.codes else np.zeros(0, np.uint16)


_SENSOR_WIDTHS: Mapping[str, int] = {
    "accelerometer": 3,
    "gyroscope": 3,
    "magnetometer": 3,
    "imuTemperature": 1,
}
"""How many values a sample of each sensor has; of others the first sample decides."""

Origin = tuple[str, str]
"""Root key and name of a trajectory or of a receiver."""

_Value = TypeVar("_Value")


class _UnfitLineError(ValueError):
    """A line is valid JSON, but does not state what a line of its kind has to."""


@dataclass(slots=True)
class _ParsedLines:
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


def _take_line(
    columns: RecordingColumns,
    line: Line | FrequentLine,
    number: int,
    *,
    poses: Sequence[tuple[Origin, Pose]] = (),
    fixes: Sequence[tuple[Origin, GnssFix]] = (),
    offset: Callable[[], int] | None = None,
) -> _ParsedLines:
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
        raise _UnfitLineError("time: missing; expected seconds")
    parsed_lines = _ParsedLines(seconds)
    sample, sweep, entries = _given(line.sensor), _given(getattr(line, "lidar", None)), _given(line.frames)
    _check(columns, sample, sweep, entries, _given(line.number))
    if sample is not None:
        _take_sample(columns, parsed_lines, sample)
    for origin, pose in [*_own_poses(line), *poses]:
        parsed_lines.streams.append(_take_pose(columns, seconds, pose, origin, number))
    for origin, fix in [*_own_fixes(line), *fixes]:
        parsed_lines.streams.append(_take_fix(columns, seconds, fix, origin))
    barometer = _given(getattr(line, "barometer", None))
    if barometer is not None:
        parsed_lines.streams.append(_append(columns, columns.barometer, seconds, [barometer.pressureHectopascals]))
    if sweep is not None:
        parsed_lines.streams.append(_take_sweep(columns, seconds, sweep, number))
    if entries is not None:
        at = -1 if offset is None else offset()
        _take_frames(columns, seconds, entries, _given(line.number) or 0, line=number, offset=at)
        parsed_lines.frames = True
    parsed_lines.leftover |= _given(line.number) is not None and entries is None
    return parsed_lines


def _given(value: _Value | UnsetType | None) -> _Value | None:
    """What a shape holds, None for what it holds none of."""
    return None if isinstance(value, UnsetType) else value


def _own_poses(line: Line | FrequentLine) -> list[tuple[Origin, Pose]]:
    truth, pose = _given(line.groundTruth), _given(getattr(line, "pose", None))
    found: list[tuple[Origin, Pose]] = []
    if truth is not None:
        found.append((("groundTruth", "groundTruth"), truth))
    if pose is not None:
        found.append((("pose", _given(pose.name) or "pose"), pose))
    return found


def _own_fixes(line: Line | FrequentLine) -> list[tuple[Origin, GnssFix]]:
    fix = _given(getattr(line, "gps", None))
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
        _check_frames(entries, number)
    if columns.log.is_full:
        raise _UnfitLineError("the file names more streams than are distinguished")


def _check_sample(sample: SensorSample) -> None:
    width = _SENSOR_WIDTHS.get(sample.type)
    if not sample.values or (width is not None and len(sample.values) != width):
        expected = "at least one" if width is None else str(width)
        raise _UnfitLineError(f"sensor.values: {sample.values}; expected {expected} of {sample.type!r}")


def _take_sample(columns: RecordingColumns, parsed_lines: _ParsedLines, sample: SensorSample) -> None:
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
    accuracies = [nan if _given(value) is None else value for value in (fix.accuracy, fix.verticalAccuracy)]
    stream = columns.gnss if origin == ("gps", "gps") else columns.receivers.get(origin)
    if stream is None:
        stream = columns.receivers.setdefault(origin, Columns(5))
    values: list[Any] = [fix.latitude, fix.longitude, fix.altitude, *accuracies]
    return _append(columns, stream, seconds, values)


def _take_pose(columns: RecordingColumns, seconds: float, pose: Pose, origin: Origin, line: int) -> Columns:
    trajectory = columns.poses.get(origin)
    if trajectory is None:
        trajectory = columns.poses.setdefault(origin, PoseColumns())
    position, rotation = pose.position, _given(pose.orientation)
    quaternion = (nan, nan, nan, nan) if rotation is None else (rotation.x, rotation.y, rotation.z, rotation.w)
    trajectory.lines.append(line)
    return _append(columns, trajectory.samples, seconds, [position.x, position.y, position.z, *quaternion])


def _check_sweep(sweep: Sweep) -> None:
    if sweep.model not in LIDAR_MODELS:
        known = ", ".join(map(repr, LIDAR_MODELS))
        raise _UnfitLineError(f"lidar.model: {sweep.model!r}; expected one of: {known}")
    problem = problem_of_name(sweep.dataFile)
    if problem:
        raise _UnfitLineError(problem)


def _take_sweep(columns: RecordingColumns, seconds: float, sweep: Sweep, line: int) -> Columns:
    index = _given(sweep.lidarInd) or 0
    lidar = columns.lidars.get(index)
    if lidar is None:
        lidar = columns.lidars.setdefault(index, LidarColumns(sweep.model))
    lidar.files.append(sweep.dataFile)
    lidar.lines.append(line)
    return _append(columns, lidar.sweeps, seconds, [])


def _check_frames(entries: Sequence[FrameEntry], number: int | None) -> None:
    """Look through the images that a line reports.

    Raises:
        UnfitLineError: it has no number, or names a camera twice.
    """
    if number is None:
        raise _UnfitLineError("number: missing; expected the frame's number, which says which image is meant")
    indices = [entry.cameraInd for entry in entries]
    if len(set(indices)) != len(indices):
        raise _UnfitLineError(f"frames[].cameraInd: {indices}; expected each camera once")


def _take_frames(
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
    _check_frames(entries, number)
    frames = columns.frames
    if not frames.code:
        frames.code = columns.log.new_code()
    row, cameras = len(frames.numbers), frames.cameras
    for entry in entries:
        camera = cameras.get(entry.cameraInd)
        if camera is None:
            camera = cameras.setdefault(entry.cameraInd, CameraColumns())
        time, camera_model, mount = _given(entry.time), entry.cameraParameters, entry.imuToCamera
        camera.rows.append(row)
        camera.seconds.append(seconds if time is None else time)
        camera.parameters.append(frames.text_index(bytes(camera_model)) if camera_model else -1)
        camera.mounts.append(frames.text_index(bytes(mount)) if mount else -1)
        camera.missing.append(entry.missingBitmap is True)
    frames.numbers.append(number)
    frames.seconds.append(seconds)
    frames.lines.append(line)
    frames.offsets.append(offset)


_Shape = TypeVar("_Shape", Pose, GnssFix)

_OUTPUT_TRAJECTORY = "output"
"""Name of the trajectory of lines with a position at their root, as the vendor's software puts out."""

_FIXED_KEYS = frozenset({"rtkgps", "groundTruth", "pose"})
"""Root keys that hold poses or fixes, beside `gps`."""


def _is_pressure(value: object) -> bool:
    """Whether what stands under `barometer` reports the pressure of the air."""
    return isinstance(value, dict) and "pressureHectopascals" in value


def _other_poses(content: dict[str, Any]) -> list[tuple[Origin, Pose, bool]]:
    """Find the poses of a line under any root key without a shape of its own, or at the root itself.

    Returns:
        Of each its origin, and whether the line holds nothing else.

    Raises:
        UnfitLineError: a position or an orientation is incomplete.
    """
    poses = [
        _pose(value, (key, key), says_all=set(content) == {"time", key})
        for key, value in content.items()
        if key not in ROOT_KEYS and isinstance(value, dict) and isinstance(value.get("position"), dict)
    ]
    if isinstance(content.get("position"), dict):
        fields = {key: value for key, value in content.items() if key != "time"}
        poses.append(_pose(fields, ("", _OUTPUT_TRAJECTORY), says_all="time" in content))
    mean = content["gnssEnu"].get("mean") if isinstance(content.get("gnssEnu"), dict) else None
    if isinstance(mean, list):
        says_all = set(content) == {"time", "gnssEnu"} and len(content["gnssEnu"]) == 1
        poses.append(_east_north_up(mean, says_all=says_all))
    return poses


def _pose(value: dict[str, Any], origin: Origin, *, says_all: bool) -> tuple[Origin, Pose, bool]:
    return origin, *_shaped(value, ExactPose, Pose, location=origin[0], says_all=says_all)


def _east_north_up(mean: list[Any], *, says_all: bool) -> tuple[Origin, Pose, bool]:
    """`gnssEnu`: where a receiver was, metres to the east, north and up of a point that the log does not report."""
    if len(mean) != 3:
        raise _UnfitLineError(f"gnssEnu.mean: {mean}; expected 3 numbers (east, north, up)")
    position = dict(zip("xyz", mean, strict=True))
    origin, pose, _ = _pose({"position": position}, ("gnssEnu", "gnssEnu"), says_all=True)
    return origin, pose, says_all


def _other_fixes(content: dict[str, Any]) -> list[tuple[Origin, GnssFix, bool]]:
    """Find the fixes of satellite receivers under root keys other than `gps`.

    Raises:
        UnfitLineError: a fix is incomplete, under a key of the format; others may mean something else.
    """
    return [
        _fix(key, value, says_all=set(content) == {"time", key})
        for key, value in content.items()
        if isinstance(value, dict) and "position" not in value and _may_be_fix(key, value)
    ]


def _may_be_fix(key: str, value: dict[str, Any]) -> bool:
    if key in _FIXED_KEYS:
        return {"latitude", "longitude"} <= value.keys()
    numbers = [value.get(name) for name in ("latitude", "longitude", "altitude")]
    return key not in ROOT_KEYS and all(isinstance(number, int | float) for number in numbers)


def _fix(key: str, value: dict[str, Any], *, says_all: bool) -> tuple[Origin, GnssFix, bool]:
    name = value.get("name") if key == "pose" else None
    origin = (key, name if isinstance(name, str) and name else key)
    return origin, *_shaped(value, ExactGnssFix, GnssFix, location=key, says_all=says_all)


def _shaped(
    value: dict[str, Any], exact: type[_Shape], wider: type[_Shape], *, location: str, says_all: bool
) -> tuple[_Shape, bool]:
    """The record in the exact shape, else in the one that allows for more, which then says less than the line."""
    try:
        return msgspec.convert(value, exact), says_all
    except msgspec.ValidationError:
        pass
    try:
        return msgspec.convert(value, wider), False
    except msgspec.ValidationError as error:
        raise _UnfitLineError(json_problem(error, msgspec.json.encode(value), prefix=location)) from error


_decode_frequent = msgspec.json.Decoder(FrequentLine).decode
_decode_exact = msgspec.json.Decoder(ExactLine).decode
_decode_open = msgspec.json.Decoder(Line).decode
_decode_any = msgspec.json.Decoder().decode
_GROUND_TRUTH = ("groundTruth", "groundTruth")

_BLANK = "blank-lines"
"""The code of a line that is blank: a fault, but at the end of the file."""

_BLANK_LINE = "blank; expected a JSON object"
_NO_SUBJECT = {"time", "number"}
_NO_ROTATION = ExactQuaternion(nan, nan, nan, nan)


class _BlankLineError(_UnfitLineError):
    """A line holds nothing."""


_Bound = tuple["array[float]", "array[float]", int, int]


class _LineReader:
    """Takes lines apart into columns; what is wrong with them is noted, not raised.

    Attributes:
        columns: what was read so far.
        faults: code, number of the line and problem of each line that nothing was taken from.
    """

    def __init__(self) -> None:
        """Begin with no lines."""
        self.columns = RecordingColumns()
        self.faults: list[tuple[str, int, str]] = []
        self._bound: dict[str, _Bound] = {}
        self._truth: PoseColumns | None = None
        self._lines: Sequence[bytes] = ()
        self._first, self._reached, self._offset = 0, 0, 0

    def read(self, lines: Sequence[bytes], offset: int) -> None:
        """Take the next lines of the file.

        Args:
            lines: without their line feeds.
            offset: byte at which the first one begins.
        """
        if len(self._bound) != len(self.columns.sensors):
            self.bind()
        codes = self.columns.log.codes
        self._lines, self._first, self._reached, self._offset = lines, len(codes), 0, offset
        decoded = map(_decode_frequent, lines)
        while True:
            try:
                self._take_frequent(decoded)
            except DECODER_FAULTS:
                self._take_infrequent()
            else:
                return

    def bind(self) -> None:
        """Have the usual lines put right into the columns; called anew whenever these were put instead of others."""
        for name, stream in self.columns.sensors.items():
            self._bound[name] = (stream.seconds, stream.values, stream.width, stream.code)
        self._truth = self.columns.poses.get(_GROUND_TRUTH)

    def _take_frequent(self, decoded: Iterator[FrequentLine]) -> None:
        """Take lines until one is of another kind; nearly all of the time of reading goes by in here."""
        codes, bound = self.columns.log.codes, self._bound
        take_truth, take_images = self._take_truth, self._take_images
        for line in decoded:
            sample = line.sensor
            if sample is not UNSET:
                # nothing but a sample: asking for each of the others takes less time than counting
                if line.groundTruth is line.frames is line.number is UNSET:
                    stream = bound.get(sample.type)
                    numbers = sample.values
                    if stream is not None and len(numbers) == stream[2]:
                        stream[0].append(line.time)
                        stream[1].fromlist(numbers)
                        codes.append(stream[3])
                        continue
            elif line.groundTruth is not UNSET:
                if line.frames is line.number is UNSET:
                    take_truth(line)
                    continue
            elif line.frames is not UNSET:
                take_images(line)
                continue
            self._take_exact(line)

    def _take_truth(self, line: FrequentLine) -> None:
        """Take a line that is a pose of the ground truth alone."""
        trajectory, pose = self._truth, line.groundTruth
        if trajectory is None or pose is UNSET:
            self._take_exact(line)
            return
        position, rotation = pose.position, pose.orientation
        if isinstance(rotation, UnsetType):
            rotation = _NO_ROTATION
        samples, codes = trajectory.samples, self.columns.log.codes
        samples.seconds.append(line.time)
        samples.values.fromlist([position.x, position.y, position.z, rotation.x, rotation.y, rotation.z, rotation.w])
        codes.append(samples.code)
        trajectory.lines.append(len(codes))

    def _take_images(self, line: FrequentLine) -> None:
        """Take a line that reports images alone, without camera models and mountings of their own."""
        entries, number, frames = line.frames, line.number, self.columns.frames
        if number is UNSET or not frames.code or entries is UNSET:
            self._take_exact(line)
            return
        for entry in entries:
            if entry.cameraParameters or entry.imuToCamera or entry.missingBitmap is not UNSET:
                self._take_exact(line)
                return
        codes = self.columns.log.codes
        try:
            _take_frames(self.columns, line.time, entries, number, line=len(codes) + 1)
        except _UnfitLineError as error:
            self._fault("unfit-lines", str(error))
        else:
            codes.append(frames.code)

    @property
    def _text(self) -> bytes:
        return self._lines[len(self.columns.log.codes) - self._first]

    @property
    def _number(self) -> int:
        return len(self.columns.log.codes) + 1

    def _begin(self) -> int:
        """Byte at which the line begins."""
        location = len(self.columns.log.codes) - self._first
        self._offset += sum(map(len, self._lines[self._reached : location])) + location - self._reached
        self._reached = location
        return self._offset

    def _take_infrequent(self) -> None:
        try:
            line = _decode_exact(self._text)
        except DECODER_FAULTS:
            self._take_inexact(self._text)
        else:
            self._take_exact(line)

    def _take_exact(self, line: FrequentLine) -> None:
        """Take a line that says nothing but what the columns hold, or several such things."""
        try:
            offset = self._begin if line.frames is not UNSET and _says_more(line, self._text) else None
            parsed_lines = _take_line(self.columns, line, self._number, offset=offset)
        except _UnfitLineError as error:
            self._fault("unfit-lines", str(error))
        except UnicodeDecodeError as error:
            self._fault("broken-lines", json_problem(error, self._text))
        else:
            self._note(parsed_lines, says_more=parsed_lines.leftover)

    def _take_inexact(self, text: bytes) -> None:
        """Take a line that is broken, wrong, or says more than the exact shapes hold."""
        try:
            self._take_open(text, _decode_object(text))
        except _BlankLineError as error:
            self._fault(_BLANK, str(error))
        except _UnfitLineError as error:
            self._fault("unfit-lines", str(error))
        except msgspec.ValidationError as error:
            self._fault("unfit-lines", json_problem(error, text))
        except DECODER_FAULTS as error:
            self._fault("broken-lines", json_problem(error, text))

    def _take_open(self, text: bytes, content: dict[str, Any]) -> None:
        if has_old_frame(content):
            content = with_frames(content)
            text = msgspec.json.encode(content)
        poses, fixes = _other_poses(content), _other_fixes(content)
        own = {origin[0] for origin, _, _ in fixes} & ROOT_KEYS
        if not _is_pressure(content.get("barometer")):
            own |= {"barometer"} & content.keys()
        if own:
            text = msgspec.json.encode({key: value for key, value in content.items() if key not in own})
        line = _decode_open(text)
        if not poses and not fixes and all(getattr(line, key) is None for key in RECORD_KEYS):
            self._keep_text(line.time, next((key for key in content if key not in _NO_SUBJECT), ""))
            return
        parsed_lines = _take_line(
            self.columns,
            line,
            self._number,
            poses=[(origin, pose) for origin, pose, _ in poses],
            fixes=[(origin, fix) for origin, fix, _ in fixes],
            offset=self._begin,
        )
        simple = [*poses, *fixes]
        self._note(parsed_lines, says_more=not (len(simple) == 1 and simple[0][2]))

    def _note(self, parsed_lines: _ParsedLines, *, says_more: bool) -> None:
        """Note which streams took a line, and keep its text where it says more than one of them holds."""
        log, streams = self.columns.log, parsed_lines.streams
        if any(len(stream) == 1 for stream in streams):  # the next ones are taken fast
            self.bind()
        if not streams and not parsed_lines.frames:
            self._keep_text(parsed_lines.seconds, "" if not parsed_lines.leftover else "sensor")
        elif len(streams) + parsed_lines.frames > 1:
            rows = [(stream.code, len(stream) - 1) for stream in streams]
            log.shared[self._number] = SharedLine(self._text.decode(), rows)
            log.codes.append(SEVERAL)
        elif parsed_lines.frames:
            log.codes.append(self.columns.frames.code)
        else:
            stream = streams[0]
            if says_more:
                stream.further[len(stream) - 1] = self._text.decode()
            log.codes.append(stream.code)

    def _keep_text(self, seconds: float | None, key: str) -> None:
        columns = self.columns
        columns.other_lines.append(self._text.decode().strip())
        columns.other_seconds.append(nan if seconds is None else seconds)
        columns.other_keys[key] = columns.other_keys.get(key, 0) + 1
        columns.log.codes.append(TEXT)

    def _fault(self, code: str, problem: str) -> None:
        self.faults.append((code, self._number, problem))
        self.columns.log.codes.append(0)


def _says_more(line: FrequentLine, text: bytes) -> bool:
    """Whether a line of images says what its columns do not hold.

    Raises:
        UnicodeDecodeError: it is no text; the decoder leaves out what it only copies.
    """
    text.decode()
    beside = (getattr(line, key, UNSET) for key in RECORD_KEYS if key != "frames")
    entries = () if line.frames is UNSET else line.frames
    return any(value is not UNSET for value in beside) or any(entry.missingBitmap is not UNSET for entry in entries)


def _decode_object(text: bytes) -> dict[str, Any]:
    if not text.strip():
        raise _BlankLineError(_BLANK_LINE)
    text.decode()
    content = _decode_any(text)
    if not isinstance(content, dict):
        raise _UnfitLineError(f"{quote(text)}: expected a JSON object")
    return content


_BLOCK = 1 << 16
_LONGEST_LINE = 1 << 26
_KEYS_SHOWN = 10


def read_lines(path: Path, ledger: Ledger) -> RecordingColumns:
    """Read all lines.

    Args:
        path: `data.jsonl`.
        ledger: takes warnings, and the faults of single lines.

    Raises:
        DataError: the file cannot be read or is empty; or a line is wrong and the reading is not lenient.
    """
    try:
        _check_beginning(path, ledger)
        columns, blank = _read(path, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    count = len(columns.log.codes)
    if count == blank:
        raise DataError(path, "", "is empty; expected JSON lines: record or export it again")
    if blank:
        location, message = f"{path}: line {count - blank + 1}", "blank lines at the end were left out"
        ledger.note(WarningKind.REPAIRED, "blank-lines-at-end", location, message, count=blank)
    _note_order(columns, path, ledger)
    _note_other_lines(columns, path, ledger)
    return columns


def _check_beginning(path: Path, ledger: Ledger) -> None:
    """Refuse a file that is no text at once: of its lines there would be none that is right."""
    with open_file(path) as file:
        beginning = file.read(16)
    reported = other_file(beginning)
    if reported is not None:
        raise DataError(path, "", f"{reported}; expected lines of JSON in UTF-8: unpack or export it as such")
    note_mark(beginning, path, ledger)


def note_mark(text: bytes, path: Path, ledger: Ledger) -> None:
    """Note a byte order mark at the beginning of a file of JSON, which is read over it."""
    if text.startswith(BYTE_ORDER_MARK):
        message = "begins with a byte order mark, which JSON must not have; it was passed over"
        ledger.note(WarningKind.REPAIRED, "byte-order-mark", str(path), message)


def _read(path: Path, ledger: Ledger) -> tuple[RecordingColumns, int]:
    """Give the columns, and how many lines at the end are blank, which is no fault there."""
    reader, ended = _LineReader(), 0
    with open_file(path) as file:
        for lines, offset in _blocks_of_lines(file, path):
            before = len(reader.columns.log.codes)
            reader.read(lines, offset)
            count, faults = len(reader.columns.log.codes), reader.faults
            blank = 0
            while blank < len(faults) and faults[-1 - blank][:2] == (_BLANK, count - blank):
                blank += 1
            if blank < count - before:
                # so the blank lines before are none at the end
                for number in range(ended + 1, before + 1):
                    _pass_fault((_BLANK, number, _BLANK_LINE), path, ledger)
                for fault in faults[: len(faults) - blank]:
                    _pass_fault(fault, path, ledger)
                ended = count - blank
            faults.clear()
    return reader.columns, len(reader.columns.log.codes) - ended


def _pass_fault(fault: tuple[str, int, str], path: Path, ledger: Ledger) -> None:
    code, number, problem = fault
    ledger.fault("unfit-lines" if code == _BLANK else code, DataError(path, f"line {number}", problem))


def _blocks_of_lines(file: BinaryIO, path: Path) -> Iterator[tuple[list[bytes], int]]:
    """Give the lines of a file without their line feeds, some at a time, without a byte order mark before the first.

    Args:
        file: the file, from its beginning.
        path: what messages call it.

    Returns:
        Lines, and the byte at which the first of them begins.

    Raises:
        DataError: a line is longer than 64 MiB, so this is no file of lines.
    """
    mark = len(BYTE_ORDER_MARK) if file.read(len(BYTE_ORDER_MARK)) == BYTE_ORDER_MARK else 0
    file.seek(mark)
    offset, parts, length = mark, list[bytes](), 0
    while block := file.read(_BLOCK):
        last = block.rfind(b"\n") + 1
        if last:
            text = b"".join([*parts, block[:last]])
            yield text.split(b"\n")[:-1], offset
            offset += len(text)
            parts, length = [], 0
        parts.append(block[last:])
        length += len(block) - last
        if length > _LONGEST_LINE:
            raise DataError(path, "", f"a line is longer than {_LONGEST_LINE} bytes; expected JSON lines")
    if length:
        yield [b"".join(parts)], offset


def _note_order(columns: RecordingColumns, path: Path, ledger: Ledger) -> None:
    seconds = line_seconds(columns)
    numbers = None
    if np.isnan(seconds).any():
        numbers = np.flatnonzero(~np.isnan(seconds))
        seconds = seconds[numbers]
    backwards = np.flatnonzero(seconds[1:] < seconds[:-1]) + 1
    if numbers is not None:
        backwards = numbers[backwards]
    if len(backwards):
        ledger.note(
            WarningKind.REPAIRED,
            "lines-sorted",
            f"{path}: line {backwards[0] + 1}",
            "time is earlier than that of the line before; all streams were sorted by time",
            count=len(backwards),
        )


def _note_other_lines(columns: RecordingColumns, path: Path, ledger: Ledger) -> None:
    if not columns.other_lines:
        return
    counts = sorted(columns.other_keys.items(), key=lambda item: -item[1])
    shown = ", ".join(f"{count} of {key or 'no key'!r}" for key, count in counts[:_KEYS_SHOWN])
    more = ", …" if len(counts) > _KEYS_SHOWN else ""
    ledger.note(
        WarningKind.SKIPPED,
        "lines-kept-as-text",
        str(path),
        f"nothing here computes with these lines: {shown}{more}; their text is kept",
        count=len(columns.other_lines),
    )
