"""The shapes of the lines in `data.jsonl`, the columns that they are read into, these columns as arrays.

And faults of the JSON decoder in plain words.
"""

import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath, PureWindowsPath
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Raw, Struct, UnsetType

from sceneloom.arrays import Float64Array, Int64Array, UInt16Array, read_only

FARTHEST_TIME = 9.2e9
"""Times within plus or minus this fit into int64 nanoseconds [s]."""


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
    return f"expected {' or '.join(types)}{_BOUNDS.get(match['bound'], '')}{match['number'] or ''}{_got(match['got'])}"


def _unit_in_question(value: str) -> str:
    try:
        number = float(value)
    except ValueError:
        return ""
    return next((f"; this looks like {unit}" for least, unit in _UNITS if number > least), "")


def _got(name: str | None) -> str:
    return "" if name is None else f", not {_TYPES.get(name, name)}"


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


def nanoseconds(seconds: Float64Array) -> Int64Array:
    """Bring seconds to the scene's clock: round(t · 1e9), halves to even, cut to 64 bits."""
    scaled = seconds * 1e9
    np.rint(scaled, out=scaled)
    return np.clip(scaled, -(2.0**63), 2.0**63 - 1024, out=scaled).astype(np.int64)


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
    return SortedColumns(
        read_only(nanoseconds(seconds)), read_only(seconds), read_only(values), read_only(order)
    )


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
