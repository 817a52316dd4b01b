"""`data.jsonl`: the shapes of its lines, the columns that they are read into line by line, and these as arrays."""

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, BinaryIO, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, Raw, Struct

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.text_tables import nanoseconds
from sceneloom.formats.recording.json_faults import (
    BYTE_ORDER_MARK,
    DECODER_FAULTS,
    FARTHEST_TIME,
    json_problem,
    note_mark,
    other_file,
    quote,
)
from sceneloom.warnings import WarningKind

Origin = tuple[str, str]
"""Root key and name of a trajectory or of a satellite receiver."""

GPS_ORIGIN: Origin = ("gps", "gps")
_GROUND_TRUTH: Origin = ("groundTruth", "groundTruth")


@dataclass(slots=True, eq=False)
class Columns:
    """A stream of records with a time each, in the order of the file.

    Attributes:
        width: numbers per record.
        seconds: times [s].
        values: the numbers of one record after another.
        lines: number of the line that each record was read from.
        texts: `dataFile` of sweeps, the whole text of lines without records; empty for other streams.
        further: by row, the text of a line that says more than these columns hold.
    """

    width: int
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    lines: "array[int]" = field(default_factory=lambda: array("I"))
    texts: list[str] = field(default_factory=list)
    further: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.seconds)

    def append(self, seconds: float, values: Sequence[float], line: int) -> None:
        """Add a record."""
        self.seconds.append(seconds)
        self.values.extend(values)
        self.lines.append(line)


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
        numbers: `number` of each line.
        seconds: `time` of each line [s].
        lines: number of each line in the file.
        offsets: byte at which a line begins that says more than the columns hold, -1 for others.
        cameras: entries by `cameraInd`.
        texts: every different text of `cameraParameters` and `imuToCamera`, with its index.
    """

    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    lines: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))
    cameras: dict[int, CameraColumns] = field(default_factory=dict)
    texts: dict[bytes, int] = field(default_factory=dict)

    def append(self, seconds: float, entries: "Sequence[FrameEntry]", number: int, line: int, offset: int = -1) -> None:
        """Add a line; `offset` is -1 for one that says nothing but these columns."""
        row = len(self.numbers)
        for entry in entries:
            camera = self.cameras.get(entry.cameraInd)
            if camera is None:
                camera = self.cameras[entry.cameraInd] = CameraColumns()
            camera.rows.append(row)
            camera.seconds.append(seconds if entry.time is None else entry.time)
            camera.parameters.append(self._text_index(entry.cameraParameters))
            camera.mounts.append(self._text_index(entry.imuToCamera))
            camera.missing.append(entry.missingBitmap)
        self.numbers.append(number)
        self.seconds.append(seconds)
        self.lines.append(line)
        self.offsets.append(offset)

    def _text_index(self, text: Raw) -> int:
        return self.texts.setdefault(bytes(text), len(self.texts)) if text else -1


@dataclass(slots=True, eq=False)
class RecordingColumns:
    """All lines of a recording.

    Attributes:
        sensors: streams by `sensor.type`.
        gnss: latitude, longitude [deg], altitude [m], accuracy and vertical accuracy [m], NaN where not given.
        receivers: the same of satellite receivers under other root keys, by root key and name.
        barometer: `barometer` lines [hPa].
        poses: x y z [m], then the quaternion x y z w, NaN where a line has none, by the root key of the lines ("" for
            poses at the root itself) and the name of the trajectory.
        lidars: by `lidarInd`; no values, times and files only.
        frames: the `frames` lines.
        other: lines that hold none of these; NaN for those without a time.
        other_keys: how many of those lines have which first key.
        count: how many lines the file has.
    """

    sensors: dict[str, Columns] = field(default_factory=dict)
    gnss: Columns = field(default_factory=lambda: Columns(5))
    receivers: dict[Origin, Columns] = field(default_factory=dict)
    barometer: Columns = field(default_factory=lambda: Columns(1))
    poses: dict[Origin, Columns] = field(default_factory=dict)
    lidars: dict[int, Columns] = field(default_factory=dict)
    frames: FrameColumns = field(default_factory=FrameColumns)
    other: Columns = field(default_factory=lambda: Columns(0))
    other_keys: dict[str, int] = field(default_factory=dict)
    count: int = 0

    def streams(self) -> list[Columns]:
        """All streams but the frames lines."""
        groups = (self.sensors, self.receivers, self.poses, self.lidars)
        return [self.gnss, self.barometer, self.other, *(stream for group in groups for stream in group.values())]


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


class Quaternion(Struct, gc=False):
    """`orientation`."""

    x: float
    y: float
    z: float
    w: float


class Pose(Struct, gc=False):
    """Where the device was: `groundTruth` or the output of a method."""

    position: Point
    orientation: Quaternion | None = None

    def values(self) -> list[float]:
        """Position x y z [m], and the quaternion x y z w, NaN where there is none."""
        p, q = self.position, self.orientation
        return [p.x, p.y, p.z, nan, nan, nan, nan] if q is None else [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


class NamedPose(Pose, gc=False):
    """`pose`: the output of the method that it names."""

    name: str | None = None


class SensorSample(Struct, gc=False):
    """`sensor`: one sample of an N-axis sensor."""

    type: str
    values: list[float]


class GnssFix(Struct, gc=False):
    """`gps`: degrees and metres."""

    latitude: float
    longitude: float
    altitude: float
    accuracy: float | None = None
    verticalAccuracy: float | None = None  # noqa: N815 - the format's own word

    def values(self) -> list[float]:
        """Latitude, longitude, altitude, accuracy and vertical accuracy, NaN where not given."""
        accuracies = [nan if value is None else value for value in (self.accuracy, self.verticalAccuracy)]
        return [self.latitude, self.longitude, self.altitude, *accuracies]


class Pressure(Struct, gc=False):
    """`barometer`: the pressure of the air."""

    pressureHectopascals: float  # noqa: N815 - the format's own word


class Sweep(Struct, gc=False):
    """`lidar`: one file of points."""

    model: str
    dataFile: str  # noqa: N815 - the format's own word
    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars


class FrameEntry(Struct, gc=False):
    """One camera's part of a `frames` line."""

    cameraInd: SensorIndex  # noqa: N815 - the format's own word
    time: _Seconds | None = None
    cameraParameters: Raw = Raw()  # noqa: N815 - the format's own word
    imuToCamera: Raw = Raw()  # noqa: N815 - the format's own word
    missingBitmap: bool = False  # noqa: N815 - the format's own word


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


class _ExactPoint(Point, forbid_unknown_fields=True, gc=False):
    pass


class _ExactQuaternion(Quaternion, forbid_unknown_fields=True, gc=False):
    pass


class _ExactPose(Pose, forbid_unknown_fields=True, gc=False):
    position: _ExactPoint
    orientation: _ExactQuaternion | None = None


class _ExactSample(SensorSample, forbid_unknown_fields=True, gc=False):
    pass


class _ExactEntry(FrameEntry, forbid_unknown_fields=True, gc=False):
    pass


class _FrequentLine(Struct, kw_only=True, forbid_unknown_fields=True, gc=False):
    """What most lines are: the fewer fields a shape has, the sooner it is clear that a line has none but one."""

    time: _Seconds
    sensor: _ExactSample | None = None
    groundTruth: _ExactPose | None = None  # noqa: N815 - the format's own word
    frames: Sequence[_ExactEntry] | None = None
    number: _FrameNumber | None = None


ROOT_KEYS = frozenset(Line.__struct_fields__)
"""The keys at the root of a line that have a shape of their own."""

RECORD_KEYS = ROOT_KEYS - {"time", "number"}
"""Those of them that state what a line is about."""

LIDAR_MODELS = ("RoboSense M1 XYZIRT",)
"""The layouts of files that the format describes."""


@dataclass(frozen=True, slots=True, eq=False)
class SortedColumns:
    """A stream in the order of its times, read-only.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        seconds: (N,) float64 [s], as the file has them.
        values: (N, K) float64.
        lines: (N,) int64, number of the line that each was read from.
        order: (N,) int64, row of the file's order that each row was.
    """

    timestamps_ns: Int64Array
    seconds: Float64Array
    values: Float64Array
    lines: Int64Array
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
    """Give a stream sorted by time, records of one time in the order of the file."""
    seconds = view(stream.seconds)
    values = view(stream.values).reshape(len(seconds), stream.width)
    lines, order = np.asarray(stream.lines, np.int64), time_order(seconds)
    if not is_sorted(seconds):
        seconds, values, lines = seconds[order], values[order], lines[order]
    arrays = (nanoseconds(seconds), seconds, values, lines, order)
    return SortedColumns(*map(read_only, arrays))


def line_seconds(columns: RecordingColumns) -> Float64Array:
    """Give the time of each line in the order of the file, (N,) float64 [s], NaN for lines without one."""
    seconds = np.full(columns.count, np.nan)
    streams = [(stream.lines, stream.seconds) for stream in columns.streams()]
    for lines, times in (*streams, (columns.frames.lines, columns.frames.seconds)):
        seconds[np.asarray(lines, np.int64) - 1] = view(times)
    return seconds


_SENSOR_WIDTHS: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3, "imuTemperature": 1}
"""How many values a sample of each sensor has; of others the first sample decides."""

_OUTPUT_TRAJECTORY = "output"
"""Name of the trajectory of lines with a position at their root, as the vendor's software puts out."""

_RECEIVER_KEYS = frozenset({"rtkgps", "groundTruth", "pose"})
"""Root keys beside `gps` under which the format has satellite fixes."""

_BLANK = "blank-lines"  # the code of a line that is blank: a fault, but at the end of the file

_BLANK_LINE = "blank; expected a JSON object"
_NO_SUBJECT = {"time", "number"}

_decode_frequent = msgspec.json.Decoder(_FrequentLine).decode
_decode_line = msgspec.json.Decoder(Line).decode
_decode_any = msgspec.json.Decoder().decode
_encode = msgspec.json.encode


class _UnfitLineError(ValueError):
    """A line is valid JSON, but does not state what a line of its kind has to."""


class _Record(NamedTuple):
    """A record of a line: the root keys that hold it, its stream, its numbers, and whether they say more than these."""

    keys: tuple[str, ...]
    streams: dict[Any, Columns]
    name: Any
    values: Sequence[float]
    says_more: bool
    file: str | None = None


class _LineReader:
    """Takes lines apart into columns; what is wrong with them is noted by code and line, not raised."""

    def __init__(self) -> None:
        self.columns = RecordingColumns()
        self.faults: list[tuple[str, int, str]] = []
        self._lines: Sequence[bytes] = ()
        self._first, self._reached, self._offset = 0, 0, 0

    def read(self, lines: Sequence[bytes], offset: int) -> None:
        """Take the next lines of the file, without their line feeds; the first begins at byte `offset`."""
        self._lines, self._first, self._reached, self._offset = lines, self.columns.count, 0, offset
        decoded = map(_decode_frequent, lines)
        while True:
            try:
                self._take_frequent(decoded)
            except DECODER_FAULTS:
                self.columns.count += 1
                self._take_any(self.columns.count)
            else:
                return

    def _take_frequent(self, decoded: Iterator[_FrequentLine]) -> None:
        """Take lines until one is of another shape; nearly all of the time of reading goes by in here."""
        columns, number = self.columns, self.columns.count
        sensors, frames, ground_truth = columns.sensors, columns.frames, columns.poses.get(_GROUND_TRUTH)
        try:
            for line in decoded:
                number += 1
                sample, pose, entries = line.sensor, line.groundTruth, line.frames
                if sample is not None:
                    # nothing but a sample: asking for each of the others takes less time than counting
                    if pose is None and entries is None and line.number is None:
                        stream = sensors.get(sample.type)
                        if stream is not None and len(sample.values) == stream.width:
                            stream.seconds.append(line.time)
                            stream.values.fromlist(sample.values)
                            stream.lines.append(number)
                            continue
                elif pose is not None:
                    if ground_truth is not None and entries is None and line.number is None:
                        ground_truth.seconds.append(line.time)
                        ground_truth.values.fromlist(pose.values())
                        ground_truth.lines.append(number)
                        continue
                elif entries is not None and line.number is not None and _are_plain(entries):
                    frames.append(line.time, entries, line.number, number)
                    continue
                self._take_any(number)
                ground_truth = columns.poses.get(_GROUND_TRUTH)
        finally:
            columns.count = number

    def _take_any(self, number: int) -> None:
        """Take a line that may be broken, wrong, or say anything."""
        text = self._lines[number - self._first - 1]
        try:
            self._take(text, number)
        except _UnfitLineError as error:
            self._fault("unfit-lines" if text.strip() else _BLANK, number, str(error))
        except msgspec.ValidationError as error:
            self._fault("unfit-lines", number, json_problem(error, text))
        except DECODER_FAULTS as error:
            self._fault("broken-lines", number, json_problem(error, text))

    def _fault(self, code: str, number: int, problem: str) -> None:
        self.faults.append((code, number, problem))

    def _take(self, text: bytes, number: int) -> None:
        """Put all that a line says into the columns or, where a part of it is wrong, nothing."""
        given, columns = _object(text), self.columns
        content = with_frames(given)
        if content is not given:
            text = _encode(content)
        poses, fixes = list(_other_poses(content)), list(_other_fixes(content))
        elsewhere = {key for found in fixes for key in found.keys}
        if not _is_pressure(content.get("barometer")):
            elsewhere.add("barometer")
        shaped = {key: value for key, value in content.items() if key not in elsewhere}
        line = _decode_line(text if len(shaped) == len(content) else _encode(shaped))
        if not poses and not fixes and all(getattr(line, key) is None for key in RECORD_KEYS):
            self._keep_text(text, line.time, content, number)
            return
        seconds, entries = line.time, line.frames
        if seconds is None:
            raise _UnfitLineError("time: missing; expected seconds")
        records = list(_records(columns, line, content, poses, fixes))
        known = record_keys(content) | ({"time"} if entries is None else {"time", "number"})
        if entries is not None:
            _check_frames(entries, line.number)
            says_more = not content.keys() <= known or not all(map(_is_plain_entry, content["frames"]))
            offset = self._begin(number) if says_more else -1
            columns.frames.append(seconds, entries, line.number or 0, number, offset)
            known |= content.keys()
        if line.sensor is not None and not any("sensor" in record.keys for record in records):
            kept = content if not records and entries is None else {"sensor": content["sensor"], "time": seconds}
            self._keep_text(_encode(kept), seconds, kept, number)
        for record in records:
            stream = record.streams.setdefault(record.name, Columns(len(record.values)))
            rest = content.keys() - known
            if record.says_more or rest:
                own = {"time", *record.keys, *rest}
                stream.further[len(stream)] = _encode({k: v for k, v in content.items() if k in own}).decode()
                known |= rest
            stream.append(seconds, record.values, number)
            if record.file is not None:
                stream.texts.append(record.file)

    def _begin(self, number: int) -> int:
        """Byte at which a line begins."""
        location = number - self._first - 1
        self._offset += sum(map(len, self._lines[self._reached : location])) + location - self._reached
        self._reached = location
        return self._offset

    def _keep_text(self, text: bytes, seconds: float | None, content: dict[str, Any], number: int) -> None:
        columns = self.columns
        columns.other.append(nan if seconds is None else seconds, (), number)
        columns.other.texts.append(text.decode().strip())
        key = next((key for key in content if key not in _NO_SUBJECT), "")
        columns.other_keys[key] = columns.other_keys.get(key, 0) + 1


def _object(text: bytes) -> dict[str, Any]:
    if not text.strip():
        raise _UnfitLineError(_BLANK_LINE)
    text.decode()  # the decoder does not look at bytes that it only copies
    content = _decode_any(text)
    if not isinstance(content, dict):
        raise _UnfitLineError(f"{quote(text)}: expected a JSON object")
    return content


def with_frames(line: dict[str, Any]) -> dict[str, Any]:
    """The line with `frames`, where it has its one image under `frame`, as old recordings with one camera do."""
    if "frames" in line or not isinstance(line.get("frame"), dict):
        return line
    return {**{k: v for k, v in line.items() if k != "frame"}, "frames": [{**line["frame"], "cameraInd": 0}]}


def _are_plain(entries: Sequence[FrameEntry]) -> bool:
    """Whether entries name each camera once, and have no camera model, mounting or missing image of their own."""
    own = any(entry.cameraParameters or entry.imuToCamera or entry.missingBitmap for entry in entries)
    return not own and len({entry.cameraInd for entry in entries}) == len(entries)


def _is_plain_entry(entry: dict[str, Any]) -> bool:
    """Whether an entry says nothing but what `CameraColumns` hold; those without an image are kept, too."""
    return entry.keys() <= set(FrameEntry.__struct_fields__) and entry.get("missingBitmap") is not True


def _is_pressure(value: object) -> bool:
    """Whether what stands under `barometer` reports the pressure of the air."""
    return isinstance(value, dict) and "pressureHectopascals" in value


def record_keys(content: Mapping[str, Any]) -> set[str]:
    """The root keys of a sound line under which records stand, those of images among them."""
    keys = {key for key in RECORD_KEYS if content.get(key) is not None}
    if not _is_pressure(content.get("barometer")):
        keys.discard("barometer")
    return keys.union(*(found.keys for found in (*_other_poses(content), *_other_fixes(content))))


def _records(
    columns: RecordingColumns, line: Line, content: dict[str, Any], poses: "list[_Found]", fixes: "list[_Found]"
) -> Iterator[_Record]:
    """The records of a line but its images; a sample of another width than its stream is none."""
    if line.sensor is not None:
        kind, values = line.sensor.type, line.sensor.values
        width, known = _SENSOR_WIDTHS.get(kind), columns.sensors.get(kind)
        if not values or (width is not None and len(values) != width):
            expected = "at least one" if width is None else str(width)
            raise _UnfitLineError(f"sensor.values: {values}; expected {expected} of {kind!r}")
        if known is None or len(values) == known.width:
            says_more = _says_more(content["sensor"], line.sensor)
            yield _Record(("sensor",), columns.sensors, kind, values, says_more)
    own_poses = {"groundTruth": line.groundTruth, "pose": line.pose}
    for key, pose in own_poses.items():
        if pose is not None:
            name = pose.name or key if isinstance(pose, NamedPose) else key
            poses.append(_Found((key,), (key, name), pose, _says_more(content[key], pose)))
    for found in poses:
        yield _Record(found.keys, columns.poses, found.origin, found.record.values(), found.says_more)
    if line.gps is not None:
        fixes.append(_Found(("gps",), GPS_ORIGIN, line.gps, _says_more(content["gps"], line.gps)))
    for found in fixes:
        streams = {GPS_ORIGIN: columns.gnss} if found.origin == GPS_ORIGIN else columns.receivers
        yield _Record(found.keys, streams, found.origin, found.record.values(), found.says_more)
    if line.barometer is not None:
        says_more = _says_more(content["barometer"], line.barometer)
        stream, values = {"barometer": columns.barometer}, [line.barometer.pressureHectopascals]
        yield _Record(("barometer",), stream, "barometer", values, says_more)
    if line.lidar is not None:
        if line.lidar.model not in LIDAR_MODELS:
            known_models = ", ".join(map(repr, LIDAR_MODELS))
            raise _UnfitLineError(f"lidar.model: {line.lidar.model!r}; expected one of: {known_models}")
        if not _is_inside(line.lidar.dataFile):
            raise _UnfitLineError(
                f"lidar.dataFile: {line.lidar.dataFile!r}; expected a path inside the recording's folder"
            )
        says_more = _says_more(content["lidar"], line.lidar)
        yield _Record(("lidar",), columns.lidars, line.lidar.lidarInd, [], says_more, line.lidar.dataFile)


def _is_inside(name: str) -> bool:
    """Whether a `dataFile` is a path that does not lead out of the folder."""
    windows = PureWindowsPath(name)
    leads_out = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
    return bool(name.strip()) and "\0" not in name and not leads_out


def _check_frames(entries: Sequence[FrameEntry], number: int | None) -> None:
    if number is None:
        raise _UnfitLineError("number: missing; expected the frame's number, which says which image is meant")
    indices = [entry.cameraInd for entry in entries]
    if len(set(indices)) != len(indices):
        raise _UnfitLineError(f"frames[].cameraInd: {indices}; expected each camera once")


class _Found(NamedTuple):
    """A pose or fix in a line: the root keys that hold it, its origin, and whether it has unknown keys."""

    keys: tuple[str, ...]
    origin: Origin
    record: Pose | GnssFix
    says_more: bool


def _other_poses(content: Mapping[str, Any]) -> Iterator[_Found]:
    """Find the poses of a line under root keys without a shape of their own, or at the root itself."""
    for key, value in content.items():
        if key not in ROOT_KEYS and isinstance(value, dict) and isinstance(value.get("position"), dict):
            yield _found((key,), (key, key), value, Pose)
    if isinstance(content.get("position"), dict):
        fields = {key: content[key] for key in ("position", "orientation") if key in content}
        yield _found(tuple(fields), ("", _OUTPUT_TRAJECTORY), fields, Pose)
    enu = content.get("gnssEnu")
    mean = enu.get("mean") if isinstance(enu, dict) else None
    if isinstance(mean, list):
        # metres to the east, north and up of a point that the log does not report
        if len(mean) != 3:
            raise _UnfitLineError(f"gnssEnu.mean: {mean}; expected 3 numbers (east, north, up)")
        position = {"position": dict(zip("xyz", mean, strict=True))}
        found = _found(("gnssEnu",), ("gnssEnu", "gnssEnu"), position, Pose)
        yield found._replace(says_more=len(content["gnssEnu"]) > 1)


def _other_fixes(content: Mapping[str, Any]) -> Iterator[_Found]:
    """Find the fixes of satellite receivers under root keys other than `gps`."""
    for key, value in content.items():
        if not isinstance(value, dict) or "position" in value:
            continue
        if key in _RECEIVER_KEYS:
            is_fix = {"latitude", "longitude"} <= value.keys()
        else:
            numbers = [value.get(name) for name in ("latitude", "longitude", "altitude")]
            is_fix = key not in ROOT_KEYS and all(isinstance(number, int | float) for number in numbers)
        if is_fix:
            name = value.get("name") if key == "pose" else None
            known = {k: v for k, v in value.items() if k != "name"} if key == "pose" else value
            yield _found((key,), (key, name if isinstance(name, str) and name else key), known, GnssFix)


def _found(keys: tuple[str, ...], origin: Origin, value: dict[str, Any], shape: type[Pose | GnssFix]) -> _Found:
    try:
        record = msgspec.convert(value, shape)
    except msgspec.ValidationError as error:
        raise _UnfitLineError(json_problem(error, _encode(value), prefix=origin[0])) from error
    return _Found(keys, origin, record, _says_more(value, record))


def _says_more(value: Any, record: object) -> bool:
    """Whether an object has keys that the record which was made of it does not have."""
    if not isinstance(record, Struct):
        return False
    fields = record.__struct_fields__
    return any(key not in fields or _says_more(part, getattr(record, key)) for key, part in value.items())


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
    reader, pending = _LineReader(), list[int]()
    try:
        with open_file(path) as file:
            beginning = file.read(16)
            # of a file that is no text there would be no line that is right
            problem = other_file(beginning)
            if problem is not None:
                raise DataError(path, "", f"{problem}; expected lines of JSON in UTF-8: unpack or export it as such")
            note_mark(beginning, path, ledger)
            for lines, offset in _blocks_of_lines(file, path):
                reader.read(lines, offset)
                _pass_faults(reader, pending, path, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    columns = reader.columns
    if columns.count == len(pending):
        raise DataError(path, "", "is empty; expected JSON lines: record or export it again")
    if pending:
        location, message = f"{path}: line {pending[0]}", "blank lines at the end were left out"
        ledger.note(WarningKind.REPAIRED, "blank-lines-at-end", location, message, count=len(pending))
    _note_order(columns, path, ledger)
    _note_other_lines(columns, path, ledger)
    return columns


def _pass_faults(reader: _LineReader, pending: list[int], path: Path, ledger: Ledger) -> None:
    """Report what is wrong with the lines of a block; blank ones are pending until another line follows them."""

    def report_blank_lines() -> None:
        for number in pending:
            ledger.fault("unfit-lines", DataError(path, f"line {number}", _BLANK_LINE))
        pending.clear()

    for code, number, problem in reader.faults:
        if pending and number != pending[-1] + 1:
            report_blank_lines()
        if code == _BLANK:
            pending.append(number)
            continue
        report_blank_lines()
        ledger.fault(code, DataError(path, f"line {number}", problem))
    reader.faults.clear()
    if pending and pending[-1] != reader.columns.count:
        report_blank_lines()


def _blocks_of_lines(file: BinaryIO, path: Path) -> Iterator[tuple[list[bytes], int]]:
    """Some lines at a time without their line feeds and byte order mark, with the byte at which the first begins."""
    file.seek(0)
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
    numbers = np.flatnonzero(~np.isnan(seconds))
    seconds = seconds[numbers]
    backwards = np.flatnonzero(seconds[1:] < seconds[:-1]) + 1
    if len(backwards):
        location, message = f"{path}: line {numbers[backwards[0]] + 1}", "is earlier than the line before"
        message = f"time {message}; all streams were sorted by time"
        ledger.note(WarningKind.REPAIRED, "lines-sorted", location, message, count=len(backwards))


def _note_other_lines(columns: RecordingColumns, path: Path, ledger: Ledger) -> None:
    if not len(columns.other):
        return
    counts = sorted(columns.other_keys.items(), key=lambda item: -item[1])
    shown = ", ".join(f"{count} of {key or 'no key'!r}" for key, count in counts[:_KEYS_SHOWN])
    more = ", …" if len(counts) > _KEYS_SHOWN else ""
    message = f"unknown lines ({shown}{more}) are not used; their text is preserved"
    ledger.note(WarningKind.SKIPPED, "lines-kept-as-text", str(path), message, count=len(columns.other))
