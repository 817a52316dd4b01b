"""What the text files of a recording state: the lines of `data.jsonl` as columns, and its calibration."""

import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from math import nan
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any, BinaryIO, NamedTuple, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Raw, Struct, structs

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity, open_file, read_bytes
from sceneloom.geometry.rigid import GREATEST_ERROR, SILENT_ERROR, RigidTransform, nearest_rotation
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.warnings import WarningKind

FARTHEST_TIME = 9.2e9
"""Times within plus or minus this fit into int64 nanoseconds [s]."""

DECODER_FAULTS = (msgspec.MsgspecError, ValueError, RecursionError)
"""What decoding of bytes that nobody checked may raise."""

_PATH = re.compile(r"(?P<what>.*) - at `\$(?P<path>.*)`", re.DOTALL)
_STEP = re.compile(r"\.([^.\[\]]+)|\[(\d+)\]")
_NO_NUMBER = re.compile(rb"\bnan\b|\binf", re.IGNORECASE)
_LONGEST_QUOTE = 60

_TYPE_COMPLAINT = re.compile(
    r"Expected `(?P<wanted>[a-z |]+)`(?: (?P<bound>[<>]=?) (?P<number>\S+)|, got `(?P<got>\w+)`)"
)

_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "str": "a text",
    "bool": "true or false",
    "object": "an object",
    "array": "a list",
}

_BOUNDS = {"<=": " of at most ", ">=": " of at least ", "<": " below ", ">": " above "}
BYTE_ORDER_MARK = b"\xef\xbb\xbf"

_OTHER_FILES = {
    b"\xff\xfe": "is text in UTF-16",
    b"\xfe\xff": "is text in UTF-16",
    b"\x1f\x8b": "is compressed by gzip",
    b"PK\x03\x04": "is a zip archive",
    b"SQLite format 3\0": "is a database",
    b"\x28\xb5\x2f\xfd": "is compressed by zstd",
    b"BZh": "is compressed by bzip2",
    b"\xfd7zXZ\0": "is compressed by xz",
}
"""How files begin that are none of text in UTF-8."""

_OTHER_BEGINNINGS = {BYTE_ORDER_MARK: "begins with a byte order mark", **_OTHER_FILES}

_UNITS = ((1e18, "nanoseconds"), (1e15, "microseconds"), (1e12, "milliseconds"))
"""Times of our days are beyond these numbers, in these units."""


def json_problem(error: Exception, text: bytes, *, prefix: str = "") -> str:
    """Describe why a text is not the JSON that was expected, path first; `json_fault` describes the arguments."""
    return ": ".join(part for part in json_fault(error, text, prefix=prefix) if part)


def json_fault(error: Exception, text: bytes, *, prefix: str = "") -> tuple[str, str]:
    """Report where a text is not the JSON that was expected, and why.

    Args:
        error: what the decoder raised.
        text: what it was given.
        prefix: path of the text inside the data.

    Returns:
        The path of the value that is wrong, and the value with what was expected; where the text is no JSON at all,
        the prefix and the beginning of the text.
    """
    if isinstance(error, RecursionError):
        return prefix, f"{quote(text)}: nested too deeply"
    if not isinstance(error, msgspec.ValidationError):
        return prefix, _no_json(error, text)
    match = _PATH.fullmatch(str(error))
    what, path = (match["what"], match["path"]) if match else (str(error), "")
    value = _value_at(path, text)
    return f"{prefix}{path}".lstrip("."), f"{value}: {_in_words(what, value)}"


def note_mark(text: bytes, path: Path, ledger: Ledger) -> None:
    """Note a byte order mark at the beginning of a file of JSON, which is read over it."""
    if text.startswith(BYTE_ORDER_MARK):
        message = "begins with a byte order mark, which JSON must not have; it was skipped"
        ledger.note(WarningKind.REPAIRED, "byte-order-mark", str(path), message)


def other_file(beginning: bytes) -> str | None:
    """Report what a file is that does not begin as text in UTF-8 does; None where nothing is known of that.

    Args:
        beginning: its first bytes, 16 or more where it has so many.
    """
    halves = {bytes(byte != 0 for byte in beginning[start:4:2]) for start in (0, 1)}
    if len(beginning) >= 4 and halves == {b"\0\0", b"\1\1"}:
        return "is text in UTF-16"
    return next((reported for start, reported in _OTHER_FILES.items() if beginning.startswith(start)), None)


def _no_json(error: Exception, text: bytes) -> str:
    if not text.strip():
        return "empty; expected a JSON object"
    for beginning, reported in _OTHER_BEGINNINGS.items():
        if text.startswith(beginning):
            return f"{reported}; expected plain JSON in UTF-8"
    hint = "; NaN and Infinity are no JSON numbers" if _NO_NUMBER.search(text) else ""
    if text.rstrip().endswith(b"},") or text.strip() == b"[":
        hint = "; a log is no list: expected one object a line, and no commas between them"
    elif text.strip() == b"{":
        hint = "; expected each object in one line"
    return f"{quote(text)}: not a JSON object: {error}{hint}"


def _in_words(complaint: str, value: str) -> str:
    """The decoder's complaint about a value, types by their names in everyday words, not a programming language's."""
    match = _TYPE_COMPLAINT.fullmatch(complaint)
    if match is None:
        return complaint
    if match["number"] is not None and abs(float(match["number"])) == FARTHEST_TIME:
        return f"expected seconds, within ±{FARTHEST_TIME:g}{_unit_in_question(value)}"
    types = [_TYPES.get(name, name) for name in match["wanted"].split(" | ") if name != "null"]
    got = f", not {_TYPES.get(match['got'], match['got'])}" if match["got"] else ""
    return f"expected {' or '.join(types)}{_BOUNDS.get(match['bound'], '')}{match['number'] or ''}{got}"


def _unit_in_question(value: str) -> str:
    try:
        number = float(value)
    except ValueError:
        return ""
    return next((f"; this looks like {unit}" for least, unit in _UNITS if number > least), "")


def _value_at(path: str, text: bytes) -> str:
    try:
        value: Any = msgspec.json.decode(text)
        for key, index in _STEP.findall(path):
            value = value[key] if key else value[int(index)]
        return quote(msgspec.json.encode(value))
    except (*DECODER_FAULTS, KeyError, IndexError, TypeError):
        return quote(text)


def quote(text: bytes) -> str:
    """Show the beginning of a text that may be anything, in one line."""
    shown = " ".join(text.decode("utf-8", "backslashreplace").split())
    return shown if len(shown) <= _LONGEST_QUOTE else f"{shown[:_LONGEST_QUOTE]}…"


Origin = tuple[str, str]
"""Root key and name of a trajectory or of a satellite receiver."""

GPS_ORIGIN: Origin = ("gps", "gps")
_GROUND_TRUTH: Origin = ("groundTruth", "groundTruth")

BAROMETER = "barometer"
"""Name of the IMU's stream of air pressure [hPa]."""

RECEIVER = "gnss"
"""Id of the receiver of `gps` lines."""


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
class _CameraColumns:
    """One camera's entries in the `frames` lines."""

    rows: "array[int]" = field(default_factory=lambda: array("q"))  # which frames line each entry is in
    seconds: "array[float]" = field(default_factory=lambda: array("d"))  # time of each image [s]
    # which of `FrameColumns.texts` holds its camera model and its `imuToCamera`, -1 for none of its own
    parameters: "array[int]" = field(default_factory=lambda: array("q"))
    mounts: "array[int]" = field(default_factory=lambda: array("q"))
    missing: "array[int]" = field(default_factory=lambda: array("b"))  # 1 where there is no image (`missingBitmap`)


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
    cameras: dict[int, _CameraColumns] = field(default_factory=dict)
    texts: dict[bytes, int] = field(default_factory=dict)

    def append(
        self, seconds: float, entries: "Sequence[_FrameEntry]", number: int, line: int, offset: int = -1
    ) -> None:
        """Add a line; `offset` is -1 for one that says nothing but these columns."""
        row = len(self.numbers)
        for entry in entries:
            camera = self.cameras.get(entry.cameraInd) or self.cameras.setdefault(entry.cameraInd, _CameraColumns())
            camera.rows.append(row)
            camera.seconds.append(seconds if entry.time is None else entry.time)
            camera.parameters.append(self._text_index(entry.cameraParameters))
            camera.mounts.append(self._text_index(entry.imuToCamera))
            camera.missing.append(entry.missingBitmap)
        self.numbers.append(number)
        self.seconds.append(seconds)
        self.lines.append(line)
        self.offsets.append(offset)

    def of_camera(self, index: int) -> _CameraColumns:
        """The entries of a camera, none where no line has it."""
        return self.cameras.get(index, _CameraColumns())

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

    def imu_streams(self) -> dict[str, Columns]:
        """The streams of the IMU by their names in the scene."""
        streams = dict(self.sensors)
        if len(self.barometer):
            if BAROMETER in streams:
                streams[f"sensor:{BAROMETER}"] = streams.pop(BAROMETER)
            streams[BAROMETER] = self.barometer
        return streams

    def satellite_receivers(self) -> dict[str, tuple[Origin, Columns]]:
        """The satellite receivers by their ids, each with the root key and name of its lines."""
        found: dict[str, tuple[Origin, Columns]] = {}
        if len(self.gnss):
            found[RECEIVER] = (GPS_ORIGIN, self.gnss)
        for (root, name), stream in self.receivers.items():
            taken = name in found or name in {RECEIVER, "imu"} or name.startswith(("camera", "lidar"))
            found[f"{root}:{name}" if taken else name] = ((root, name), stream)
        return found

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


class _FrameEntry(Struct, gc=False):
    """One camera's part of a `frames` line."""

    cameraInd: SensorIndex  # noqa: N815 - the format's own word
    time: _Seconds | None = None
    cameraParameters: Raw = Raw()  # noqa: N815 - the format's own word
    imuToCamera: Raw = Raw()  # noqa: N815 - the format's own word
    missingBitmap: bool = False  # noqa: N815 - the format's own word


ENTRY_KEYS = frozenset(_FrameEntry.__struct_fields__)


class Line(Struct, kw_only=True, gc=False):
    """A line, whatever else may be in it."""

    time: _Seconds | None = None
    sensor: SensorSample | None = None
    gps: GnssFix | None = None
    groundTruth: Pose | None = None  # noqa: N815 - the format's own word
    pose: NamedPose | None = None
    lidar: Sweep | None = None
    barometer: Pressure | None = None
    frames: Sequence[_FrameEntry] | None = None
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


class _ExactEntry(_FrameEntry, forbid_unknown_fields=True, gc=False):
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

XYZIRT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")]
)
"""One return: position [m], intensity, laser, time [s, the recording's clock]; 23 bytes, packed.

Source: "Model: RoboSense M1 XYZIRT" of the recording format's description.
"""


def view(numbers: "array[float]") -> Float64Array:
    """Give the numbers as an array without copying them; the column cannot grow while it is in use."""
    return np.frombuffer(numbers, np.float64) if numbers else np.zeros(0)


def _is_sorted(seconds: Float64Array) -> bool:
    """Whether no time is less than the one before."""
    return bool((seconds[1:] >= seconds[:-1]).all())


def time_order(seconds: Float64Array) -> Int64Array:
    """Give the order that sorts by time and keeps the order of equal times, (N,) int64."""
    if _is_sorted(seconds):
        return np.arange(len(seconds), dtype=np.int64)
    return np.argsort(seconds, kind="stable").astype(np.int64)


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


def _are_plain(entries: Sequence[_FrameEntry]) -> bool:
    """Whether entries name each camera once, and have no camera model, mounting or missing image of their own."""
    own = any(entry.cameraParameters or entry.imuToCamera or entry.missingBitmap for entry in entries)
    return not own and len({entry.cameraInd for entry in entries}) == len(entries)


def _is_plain_entry(entry: dict[str, Any]) -> bool:
    """Whether an entry says nothing but what `_CameraColumns` hold; those without an image are kept, too."""
    return entry.keys() <= ENTRY_KEYS and entry.get("missingBitmap") is not True


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


def _check_frames(entries: Sequence[_FrameEntry], number: int | None) -> None:
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


CALIBRATION_FILE = "calibration.json"
PARAMETERS_FILE = "parameters.txt"

_MatrixNumbers = list[float | list[float]]
"""A matrix as JSON has it: rows of four (or three) numbers, or sixteen (or nine) numbers column by column."""

_SIZES: Mapping[int, int] = {16: 4, 9: 3}
"""Rows of a flat matrix by how many numbers it has, column by column. Nine are a rotation alone.
Source: `imuToCameraMatrix` in `codegen/parameter_definitions.c` of HybVIO."""

_LAST_ROW_ERROR = 1e-6
_LARGEST_ELEMENT = 2.0
_FARTHEST = 1e6


def rigid_transform(numbers: _MatrixNumbers, location: str, ledger: Ledger) -> RigidTransform:
    """Read a 4x4 matrix, rows of four or sixteen numbers column by column, or a 3x3 one, which is a rotation alone.

    Args:
        location: file and path of the matrix, for messages.
        ledger: takes the warning of a rotation that had to be normalised.

    Raises:
        CalibrationError: it is no such matrix, or not rigid.
    """
    rows = [row for row in numbers if isinstance(row, list)]
    size = len(rows) or _SIZES.get(len(numbers), 0)
    if size not in _SIZES.values() or (rows and [len(row) for row in rows] != [size] * len(numbers)):
        shape = f"{len(numbers)} rows" if rows else f"{len(numbers)} numbers"
        raise CalibrationError(f"{location}: {shape}; expected 4 rows of 4 numbers, or 16 numbers column by column")
    matrix = np.eye(4)
    matrix[:size, :size] = rows or np.array(numbers, np.float64).reshape(size, size).T
    if not np.isfinite(matrix).all():
        raise CalibrationError(f"{location}: a number is not finite; expected 4x4 finite numbers")
    if not (np.abs(matrix[3] - [0, 0, 0, 1]) <= _LAST_ROW_ERROR).all():
        hint = "; is it transposed?" if (matrix[:3, 3] == 0).all() else ""
        raise CalibrationError(f"{location}: last row {matrix[3].tolist()}; expected 0, 0, 0, 1{hint}")
    # the arithmetic of the checks to come must not overflow
    largest, farthest = np.abs(matrix[:3, :3]).max(), np.abs(matrix[:3, 3]).max()
    if largest > _LARGEST_ELEMENT:
        raise CalibrationError(f"{location}: rotation holds {largest:g}; expected numbers from -1 to 1")
    if farthest > _FARTHEST:
        raise CalibrationError(f"{location}: translation holds {farthest:g}; expected metres within {_FARTHEST:g}")
    rotation, error = nearest_rotation(matrix[:3, :3])
    if not error <= GREATEST_ERROR:
        problem = "mirrored or singular" if error == float("inf") else f"off by {error:.2g}"
        raise CalibrationError(
            f"{location}: rotation {problem}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        )
    if error > SILENT_ERROR:
        message = f"rotation off by {error:.2g} (max abs of R Rᵀ - I); the nearest rotation was taken"
        ledger.note(WarningKind.REPAIRED, "rotation-normalised", location, message)
    return RigidTransform(rotation, matrix[:3, 3].copy())


class CameraParameters(Struct, frozen=True):
    """The camera model of an entry in `calibration.json` or of a `cameraParameters`; None for what is not stated.

    Source: "Calibration format" of the recording format's description; `distortionModel` is the word of its lines.
    """

    model: str | None = None
    distortionModel: str | None = None  # noqa: N815 - the format's own word
    distortionCoefficients: list[float] | None = None  # noqa: N815 - the format's own word
    focalLengthX: float | None = None  # noqa: N815 - the format's own word
    focalLengthY: float | None = None  # noqa: N815 - the format's own word
    focalLength: float | None = None  # noqa: N815 - the word of old recordings, for both
    principalPointX: float | None = None  # noqa: N815 - the format's own word
    principalPointY: float | None = None  # noqa: N815 - the format's own word
    imageWidth: int | float | None = None  # noqa: N815 - the format's own word
    imageHeight: int | float | None = None  # noqa: N815 - the format's own word

    @property
    def has_size(self) -> bool:
        """Whether the image size is stated."""
        return self.imageWidth is not None and self.imageHeight is not None

    @property
    def model_name(self) -> str | None:
        """The model under either of its keys."""
        return self.distortionModel if self.model is None else self.model

    def with_both_focal_lengths(self) -> "CameraParameters":
        """The same camera model, one focal length for both axes reported as two."""
        if self.focalLength is None or (self.focalLengthX, self.focalLengthY) != (None, None):
            return self
        both = self.focalLength
        return structs.replace(self, focalLength=None, focalLengthX=both, focalLengthY=both)

    def over(self, base: "CameraParameters") -> "CameraParameters":
        """These parameters, and those of `base` where they state nothing.

        The coefficients of the base hold for a camera model of its own model only, and its image size for focal lengths
        and a principal point of its own only: whole parameters without a size are those of the images as they are.
        """
        own = (self.focalLengthX, self.focalLengthY, self.principalPointX, self.principalPointY)
        if all(value is not None for value in own):
            base = structs.replace(base, imageWidth=None, imageHeight=None)
        stated = {name: value for name, value in structs.asdict(self).items() if value is not None}
        if self.model_name is not None:
            same = base.model_name is not None and _plain(base.model_name) == _plain(self.model_name)
            kept = base.distortionCoefficients if same else None
            base = structs.replace(base, model=None, distortionModel=None, distortionCoefficients=kept)
        return structs.replace(base, **stated)


class _Reading(NamedTuple):
    """Our model, and which of the format's coefficients it takes in order; -1 for one that is 0."""

    model: str
    taken: tuple[int, ...] | None = None


_RADIAL = _Reading("brown_conrady", (0, 1, -1, -1, 2))  # k1 k2 k3 become k1 k2 p1 p2 k3

_PRISM_AND_TILT = _Reading("brown_conrady", (*range(8), -1, -1, *range(8, 14)))
"""After the eight of the rational model come lx ly of ours, which the format does not have."""

CAMERA_MODEL_READINGS: Mapping[str, Mapping[int, _Reading]] = {
    "pinhole": {0: _Reading("pinhole"), 3: _RADIAL},
    "brown-conrady": {5: _Reading("brown_conrady"), 8: _Reading("brown_conrady"), 14: _PRISM_AND_TILT},
    "kannala-brandt4": dict.fromkeys((0, 4), _Reading("fisheye")),
    "kannala-brandt18": dict.fromkeys((0, 4, 18), _Reading("kannala_brandt18")),
    "omnidir": {6: _Reading("omnidir")},
}
"""By the format's name of a model and its number of coefficients: our model, and our order of them. The orders of
`kannala_brandt18` (k0-k3 l1-l3 i1-i4 m1-m3 j1-j4) and `omnidir` (k1 k2 s xi p1 p2) are the format's own.

Source: the models that the vendor's software knows, as docs/CONVENTIONS.md lists them.
"""


@lru_cache(maxsize=64)
def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


_SPELLINGS = {_plain(name): name for name in CAMERA_MODEL_READINGS}


def camera_model(parameters: CameraParameters, image_size: tuple[int, int] | None, location: str) -> Camera:
    """Build the camera model, for the calibrated image size.

    Args:
        image_size: width and height of the images [px], which stand in where the calibration names none.
        location: file and path of the parameters, for messages.

    Raises:
        CalibrationError: a number is missing or impossible, or the model is unknown.
    """
    name, known = parameters.model_name, ", ".join(CAMERA_MODEL_READINGS)
    readings = None if name is None else CAMERA_MODEL_READINGS.get(_SPELLINGS.get(_plain(name), ""))
    if readings is None:
        raise CalibrationError(
            f"{location}.model: {'missing' if name is None else repr(name)}; expected one of: {known}"
        )
    given = tuple(map(float, parameters.distortionCoefficients or ()))
    if len(given) not in readings:
        counts = " or ".join(map(str, readings))
        problem = f"{len(given)} numbers; expected {counts} for {name!r}"
        raise CalibrationError(f"{location}.distortionCoefficients: {problem}")
    reading = readings[len(given)]
    coefficients = given if reading.taken is None else tuple(0.0 if k < 0 else given[k] for k in reading.taken)
    size: Any = image_size
    if parameters.has_size:
        size = (parameters.imageWidth, parameters.imageHeight)
        if any(number != int(number) or number <= 0 for number in size):
            problem = f"imageWidth, imageHeight {size}; expected positive whole numbers of pixels"
            raise CalibrationError(f"{location}: {problem}")
    if size is None:
        raise CalibrationError(f"{location}: no imageWidth and imageHeight, and no image to take them from")
    p, numbers = parameters, ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
    missing = next((number for number in numbers if getattr(p, number) is None), None)
    if missing is not None:
        raise CalibrationError(f"{location}.{missing}: missing; expected a number of pixels")
    fx, fy, cx, cy = (float(getattr(p, number)) for number in numbers)
    try:
        return Camera(reading.model, int(size[0]), int(size[1]), fx, fy, cx, cy, coefficients)
    except CalibrationError as error:
        raise CalibrationError(f"{location}: {error}") from error


_SHORTEST = 1e-6
_SAME_MATRIX = 1e-6  # elements of two matrices that are closer are the same number, written with other digits
_Duration = Annotated[float, Meta(ge=0, le=10)]  # how long an image takes [s]
_Shift = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Value = TypeVar("_Value")


class CameraEntry(CameraParameters, frozen=True):
    """One of `cameras`, as far as it is used here; the text of the format calls the matrix `imuToCameraMatrix`."""

    imuToCamera: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraMatrix: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToCameraShiftSeconds: _Shift | None = None  # noqa: N815 - the format's own word
    shutterRollTimeSeconds: _Duration | None = None  # noqa: N815 - the format's own word
    rollingShutterLeftToRight: bool | None = None  # noqa: N815 - the format's own word
    exposureTimeSeconds: _Duration | None = None  # noqa: N815 - the format's own word


class LidarEntry(Struct, frozen=True):
    """One of `lidars`, as far as it is used here."""

    lidarInd: SensorIndex = 0  # noqa: N815 - as `cameraInd`; our extension for several lidars
    imuToLidar: _MatrixNumbers | None = None  # noqa: N815 - the format's own word
    imuToLidarMatrix: _MatrixNumbers | None = None  # noqa: N815 - as the cameras' word


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera of the calibration.

    Attributes:
        location: file and path of the entry, for messages.
        parameters: the camera model.
        camera_from_imu: the mounting, or None where the entry has none.
        shift: `imuToCameraShiftSeconds` [s], 0 where the entry has none.
        entry: all of the entry, as the file has it.
    """

    location: str
    parameters: CameraParameters
    camera_from_imu: RigidTransform | None = None
    shift: float = 0.0
    entry: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class LidarCalibration:
    """A lidar of the calibration; `lidar_from_imu` is None where the entry has no mounting."""

    location: str
    lidar_from_imu: RigidTransform | None = None
    entry: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class _RigCalibration:
    """The fields at the root of a `calibration.json`; None for what is not stated."""

    output_from_imu: RigidTransform | None = None  # `imuToOutput`, to the frame of the vendor's poses
    gnss_from_imu: RigidTransform | None = None  # `imuToGnss`, to the receiver's antenna
    magnetometer_from_imu: RigidTransform | None = None  # `imuToMagnetometer`
    forward_imu: Float64Array | None = None  # `imuForward`, (3,), unit: the driving direction in the IMU's frame


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A whole calibration; empty where the recording has none.

    Attributes:
        path: where the file is, or would be.
        cameras: by `cameraInd`, which is the index in the list.
        lidars: by `lidarInd`.
        rig: what it says of the device as a whole.
        content: all of the file.
    """

    path: Path
    cameras: Mapping[int, CameraCalibration] = field(default_factory=dict)
    lidars: Mapping[int, LidarCalibration] = field(default_factory=dict)
    rig: _RigCalibration = field(default_factory=_RigCalibration)
    content: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class RecordingContents:
    """What was read of a recording before its sensors are built.

    Attributes:
        folder: where its files are.
        data_path: its lines, `data.jsonl`.
        data_file: the same, as it was when its lines were read.
        alone: whether that file is all there is, and nothing beside it belongs to it.
        columns: its lines.
        calibration: its `calibration.json`.
        trajectories: by root key and name of their lines.
        ego_path: `world_from_ego` of the default trajectory, or None.
        ledger: takes warnings and faults.
        camera_shift: what becomes of `imuToCameraShiftSeconds`, an option of reading.
        image_index: which image a `frames` line means, an option of reading.
    """

    folder: Path
    data_path: Path
    data_file: FileIdentity
    alone: bool
    columns: RecordingColumns
    calibration: Calibration
    trajectories: Mapping[Origin, Trajectory]
    ego_path: Poses | None
    ledger: Ledger
    camera_shift: str
    image_index: str

    @property
    def data_name(self) -> str:
        """Name of the file of the lines."""
        return self.data_path.name


def read_calibration(folder: Path, ledger: Ledger, data_path: Path, other_lines: Iterable[str] | None) -> Calibration:
    """Read the calibration of a recording; one without the file has what older forms state, or an empty one.

    Args:
        folder: the recording.
        ledger: takes warnings and faults.
        data_path: its lines.
        other_lines: those of them that hold no record; old recordings state there how cameras are mounted. None for
            lines by themselves, which no calibration belongs to.

    Raises:
        DataError: the file cannot be read, is no JSON object, or an entry has a value of the wrong type.
        CalibrationError: a mounting is not rigid.
    """
    path, doubts = folder / CALIBRATION_FILE, list[str]()
    if other_lines is None:
        return Calibration(path)
    is_old = not path.exists()
    try:
        content = _old_content(folder, other_lines, doubts) if is_old else _read_object(path, ledger)
    except DataError as error:
        ledger.refuse("unreadable-calibration", error)
        return Calibration(path)
    if not content:
        return Calibration(path)
    if is_old:
        path = folder / PARAMETERS_FILE if (folder / PARAMETERS_FILE).is_file() else data_path
        first = f"no {CALIBRATION_FILE}; camera models and mountings were taken from an older form"
        for message in (first, *doubts):
            ledger.note(WarningKind.ASSUMED, "old-calibration", str(path), message)
    reader = _Reader(path, ledger)
    cameras, lidars = dict[int, CameraCalibration](), dict[int, LidarCalibration]()
    for k, location, item, camera, mount in reader.entries(content, "cameras", CameraEntry, "imuToCamera"):
        cameras[k] = CameraCalibration(location, camera, mount, camera.imuToCameraShiftSeconds or 0.0, item)
    for k, location, item, lidar, mount in reader.entries(content, "lidars", LidarEntry, "imuToLidar"):
        if lidar.lidarInd in lidars:
            problem = f"lidarInd {lidar.lidarInd} is used twice; expected each once (absent means 0)"
            ledger.fault("repeated-lidars", DataError(path, f"lidars[{k}]", problem))
        else:
            lidars[lidar.lidarInd] = LidarCalibration(location, mount, item)
    return Calibration(path, cameras, lidars, reader.rig(content), content)


def _read_object(path: Path, ledger: Ledger) -> Mapping[str, Any]:
    try:
        text = read_bytes(path)
        note_mark(text, path, ledger)
        text = text.removeprefix(BYTE_ORDER_MARK)
        content = msgspec.json.decode(text)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror}") from error
    except DECODER_FAULTS as error:
        raise DataError(path, "", json_problem(error, text)) from error
    if not isinstance(content, dict):
        raise DataError(path, "", f"a JSON {type(content).__name__}; expected an object with `cameras`")
    for name in ("cameras", "lidars"):
        if not isinstance(content.get(name), list | None):
            raise DataError(path, name, f"{type(content[name]).__name__}; expected a list of objects")
    return content


@dataclass(frozen=True, slots=True)
class _Reader:
    """Reads the parts of one file; faults go to the ledger."""

    path: Path
    ledger: Ledger

    def entries(
        self, content: Mapping[str, Any], name: str, shape: type[_Value], matrix_key: str
    ) -> Iterator[tuple[int, str, Any, _Value, RigidTransform | None]]:
        """Index, location, text, values and mounting of the usable entries of a list."""
        for k, item in enumerate(content.get(name) or ()):
            location = f"{name}[{k}]"
            try:
                entry = self.converted(location, item, shape)
                mount = self._mount(location, {key: getattr(entry, key) for key in (matrix_key, f"{matrix_key}Matrix")})
            except (DataError, CalibrationError) as error:
                self.ledger.fault("unusable-calibrations", error)
            else:
                yield k, f"{self.path}: {location}", item, entry, mount

    def _mount(self, entry: str, matrices: Mapping[str, _MatrixNumbers | None]) -> RigidTransform | None:
        """The matrix under one of two keys; where they differ, that is a fault, and the first counts."""
        found = {
            key: rigid_transform(matrix, f"{self.path}: {entry}.{key}", self.ledger)
            for key, matrix in matrices.items()
            if matrix is not None
        }
        if not found:
            return None
        (key, first), *others = found.items()
        for other, second in others:
            apart = float(np.abs(first.matrix - second.matrix).max())
            if apart > _SAME_MATRIX:
                problem = (
                    f"differs from {key} by up to {apart:.3g}; expected one of the two, or the same numbers in both"
                )
                self.ledger.fault("contradicting-mounts", DataError(self.path, f"{entry}.{other}", problem))
        return first

    def rig(self, content: Mapping[str, Any]) -> _RigCalibration:
        """What a calibration says of the whole device; its poses are taken as those of the IMU."""
        readings: Mapping[str, Callable[[str, object], Any]] = {
            "imuToOutput": self._transform,
            "imuToGnss": self._transform_or_position,
            "imuToMagnetometer": self._transform,
            "imuForward": self._direction,
        }
        found: dict[str, Any] = dict.fromkeys(readings)
        for name, read in readings.items():
            if content.get(name) is not None:
                try:
                    found[name] = read(name, content[name])
                except (DataError, CalibrationError) as error:
                    self.ledger.fault("unusable-calibrations", error)
        output = found["imuToOutput"]
        if output is not None and not np.allclose(output.matrix, np.eye(4)):
            message = "imuToOutput is not the identity; the poses of all lines are taken as those of the IMU"
            self.ledger.note(WarningKind.ASSUMED, "poses-of-imu", f"{self.path}: imuToOutput", message)
        return _RigCalibration(*found.values())

    def _transform(self, name: str, value: object) -> RigidTransform:
        return rigid_transform(self.converted(name, value, _MatrixNumbers), f"{self.path}: {name}", self.ledger)

    def _transform_or_position(self, name: str, value: object) -> RigidTransform:
        """A matrix, or the antenna's position in the IMU's frame as the vendor's recorders take it."""
        if isinstance(value, list) and (len(value) != 3 or any(isinstance(number, list) for number in value)):
            return self._transform(name, value)
        position_imu = self._vector(name, value)
        message = f"{name} is a vector: taken to be where the antenna is, in the IMU's frame"
        self.ledger.note(WarningKind.ASSUMED, "antenna-location", f"{self.path}: {name}", message)
        return RigidTransform(np.eye(3), -position_imu)

    def _direction(self, name: str, value: object) -> Float64Array:
        vector = self._vector(name, value)
        length = float(np.linalg.norm(vector))
        if length < _SHORTEST:
            raise CalibrationError(f"{self.path}: {name}: {vector.tolist()}; expected a direction")
        return read_only(vector / length)

    def _vector(self, name: str, value: object) -> Float64Array:
        if isinstance(value, dict):
            numbers = list(structs.astuple(self.converted(name, value, Point)))
        else:
            numbers = self.converted(name, value, list[float])
        if len(numbers) != 3 or not all(abs(number) <= _FARTHEST for number in numbers):
            raise CalibrationError(f"{self.path}: {name}: {numbers}; expected three numbers within {_FARTHEST:g}")
        return np.array(numbers, np.float64)

    def converted(self, location: str, value: object, shape: type[_Value]) -> _Value:
        try:
            return msgspec.convert(value, shape)
        except DECODER_FAULTS as error:
            raise DataError(self.path, *json_fault(error, msgspec.json.encode(value), prefix=location)) from error


def _decoded(text: bytes, line: int, path: Path, key: str, shape: type[_Value]) -> _Value:
    try:
        return msgspec.json.decode(text, type=shape)
    except DECODER_FAULTS as error:
        raise DataError(path, f"line {line}", json_problem(error, text, prefix=f"frames[].{key}")) from error


def read_parameters(text: bytes, line: int, *, path: Path) -> CameraParameters:
    """Read a `cameraParameters`.

    Raises:
        DataError: it is no object, or a value has the wrong type.
    """
    return _decoded(text, line, path, "cameraParameters", CameraParameters).with_both_focal_lengths()


def read_mount(text: bytes, line: int, *, path: Path, ledger: Ledger) -> RigidTransform:
    """Read an `imuToCamera` of a line; gives `ego_from_camera`.

    Raises:
        DataError: it is no matrix.
        CalibrationError: it is not rigid.
    """
    numbers = _decoded(text, line, path, "imuToCamera", _MatrixNumbers)
    return rigid_transform(numbers, f"{path}: line {line}: frames[].imuToCamera", ledger).inverse()


_FISHEYE = "kannala-brandt4"
_FISHEYE_IN_LINES = "KANNALA_BRANDT4"
_FISHEYE_COUNT = 4
_MOST_CAMERAS = 2
_LONGEST = 1 << 22


def _old_content(folder: Path, other_lines: Iterable[str], doubts: list[str]) -> Mapping[str, Any]:
    """What stands in for a `calibration.json`, in its words; `parameters.txt` counts before the lines."""
    entries = _entries_of_lines(other_lines)
    path = folder / PARAMETERS_FILE
    if path.is_file():
        for index, entry in _entries_of_parameters(path, doubts).items():
            entries.setdefault(index, {}).update(entry)
    for index, entry in entries.items():
        if "model" not in entry:
            entry["model"] = "pinhole"
            doubts.append(f"camera {index} is taken for a pinhole: no model is stated")
    return {"cameras": [entries.get(index, {}) for index in range(max(entries) + 1)]} if entries else {}


def _entries_of_lines(other_lines: Iterable[str]) -> dict[int, dict[str, Any]]:
    """By camera, what lines like `{"cameraInd": 0, "imuToCamera": [...]}` state."""
    entries: dict[int, dict[str, Any]] = {}
    for text in other_lines:
        try:
            line = msgspec.json.decode(text) if '"cameraInd"' in text else {}
        except DECODER_FAULTS:
            continue
        index = line.get("cameraInd") if isinstance(line, dict) else None
        if not isinstance(index, int) or not 0 <= index < _MOST_CAMERAS:
            continue
        stated = {"imuToCamera": line["imuToCamera"]} if "imuToCamera" in line else {}
        coefficients = line.get("coeffs")
        if _FISHEYE_IN_LINES in str(line.get("model")) and isinstance(coefficients, list):
            # some recorders wrote a fifth coefficient that is zero
            count = _FISHEYE_COUNT if coefficients[_FISHEYE_COUNT:] == [0] else None
            stated |= {"model": _FISHEYE, "distortionCoefficients": coefficients[:count]}
        if stated:
            entries.setdefault(index, {}).update(stated)
    return entries


def _entries_of_parameters(path: Path, doubts: list[str]) -> dict[int, dict[str, Any]]:
    """By camera, what `parameters.txt` (lines of `name value;`) states; names of the second begin with `second`."""
    try:
        with open_file(path) as file:
            text = file.read(_LONGEST).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(path, "", f"cannot be read as text: {error}") from error
    values: dict[str, str] = {}
    for part in text.split(";"):
        words = part.split()
        if words and (len(words) != 2 or words[0] in values):
            problem = "expected a name and a value, each name once, with `;` behind them"
            raise DataError(path, " ".join(words)[:60], problem)
        if words:
            values[words[0]] = words[1]
    entries = {index: _entry_of_parameters(values, path, index) for index in range(_MOST_CAMERAS)}
    entries = {index: entry for index, entry in entries.items() if entry}
    if values.get("videoRotation", "NONE") != "NONE":
        for entry in entries.values():
            entry.pop("imuToCamera", None)
        doubts.append("videoRotation rotates the mountings in a way that is not known here; they are left out")
    return entries


def _entry_of_parameters(values: Mapping[str, str], path: Path, index: int) -> dict[str, Any]:
    def read(name: str, convert: Callable[[str], Any]) -> Any:
        key = f"second{name[0].upper()}{name[1:]}" if index else name
        try:
            return convert(values[key]) if key in values else None
        except ValueError as error:
            raise DataError(path, key, f"{values[key][:60]!r}; expected numbers") from error

    def numbers(text: str) -> list[float]:
        return [float(number) for number in text.split(",")]

    def pixels(text: str) -> float | None:
        """-1 stands for a length that is not stated."""
        return None if float(text) < 0 else float(text)

    focal, matrix = read("focalLength", pixels), read("imuToCameraMatrix", numbers) or ()
    stated = {
        "focalLengthX": read("focalLengthX", pixels) or focal,
        "focalLengthY": read("focalLengthY", pixels) or focal,
        "principalPointX": read("principalPointX", pixels),
        "principalPointY": read("principalPointY", pixels),
        # nine or sixteen numbers column by column; fewer stand for a mounting that is not stated
        "imuToCamera": matrix if len(matrix) > 1 else None,
        "imuToCameraShiftSeconds": read("imuToCameraShiftSeconds", float),
    }
    entry: dict[str, Any] = {name: value for name, value in stated.items() if value is not None}
    coefficients = read("distortionCoeffs", numbers) or []
    is_fisheye = values.get("fisheyeCamera") == "true"
    if coefficients or (entry and is_fisheye):
        # a single zero stands for no distortion
        entry["distortionCoefficients"] = [] if coefficients == [0.0] else coefficients
        entry["model"] = _FISHEYE if is_fisheye else "pinhole"
    return entry
