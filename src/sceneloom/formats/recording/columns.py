"""What the lines of a recording say, as growing columns, one set per stream; small per sample, and no text."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only

FARTHEST_TIME = 9.2e9
"""Times within plus or minus this fit into int64 nanoseconds [s]."""


def nanoseconds(seconds: Float64Array) -> Int64Array:
    """Bring seconds to the scene's clock: round(t · 1e9), halves to even."""
    scaled = seconds * 1e9
    return np.rint(scaled, out=scaled).astype(np.int64)


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


@dataclass(slots=True, eq=False)
class Columns:
    """A stream of `width` numbers with a time each, in the order of the file.

    Attributes:
        width: numbers per sample.
        code: what stands for this stream in `LineLog.codes`.
        form: the first line that says nothing but a sample, as text.
        seconds: times [s].
        values: the samples one after another.
        further: by row, the text of a line that holds more than these columns do.
    """

    width: int
    code: int = 0
    form: str | None = None
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    further: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.seconds)

    def append(self, seconds: float, values: list[float]) -> None:
        """Add a sample."""
        self.seconds.append(seconds)
        self.values.fromlist(values)

    def by_time(self) -> SortedColumns:
        """Give the stream sorted by time, samples of one time in the order of the file."""
        seconds = view(self.seconds)
        values = view(self.values).reshape(len(seconds), self.width)
        order = time_order(seconds)
        if not is_sorted(seconds):
            seconds, values = seconds[order], values[order]
        return SortedColumns(
            read_only(nanoseconds(seconds)), read_only(seconds), read_only(values), read_only(order)
        )

    def row_keys(self, rows: Sequence[int]) -> list[str]:
        """Name rows by their time [ns], as text; of several samples of one time, the second is `TIME#1`."""
        if not rows:
            return []
        stamps = self.by_time().timestamps_ns
        places = np.empty(len(stamps), np.int64)
        places[time_order(view(self.seconds))] = np.arange(len(stamps))
        chosen = places[np.asarray(rows, np.int64)]
        counts = chosen - np.searchsorted(stamps, stamps[chosen], "left")
        return [row_key(*pair) for pair in zip(stamps[chosen].tolist(), counts.tolist(), strict=True)]

    def further_by_time(self) -> dict[str, str]:
        """Give the texts by the key of their row."""
        rows = sorted(self.further)
        return {key: self.further[row] for key, row in zip(self.row_keys(rows), rows, strict=True)}


def row_key(timestamp_ns: int, count: int) -> str:
    """Name a sample: its time [ns], and how many samples of that time come before it, if any do."""
    return f"{timestamp_ns}#{count}" if count else str(timestamp_ns)


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
        seconds: time of each picture [s].
        parameters: which of `FrameColumns.texts` holds its lens, -1 for none of its own.
        mounts: the same for its `imuToCamera`.
        missing: 1 where there is no picture (`missingBitmap`).
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
        texts: every different text of `cameraParameters` and `imuToCamera`, with its place in this order.
    """

    code: int = 0
    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    lines: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))
    cameras: dict[int, CameraColumns] = field(default_factory=dict)
    texts: dict[bytes, int] = field(default_factory=dict)

    def text_index(self, text: bytes) -> int:
        """Give the place of a text, -1 for none."""
        return self.texts.setdefault(text, len(self.texts)) if text else -1


NOTHING, TEXT, SEVERAL = 0, 1, 2
"""Codes of lines that nothing was taken from, that are kept as text, and that several streams have a part in."""

_MOST_STREAMS = 60_000


@dataclass(slots=True, eq=False)
class SharedLine:
    """A line that more than one stream has a part in.

    Attributes:
        text: all of it.
        rows: code and row of each sample that it brought; a line of pictures has no row here.
    """

    text: str
    rows: list[tuple[int, int]] = field(default_factory=list)


@dataclass(slots=True, eq=False)
class LineLog:
    """What became of each line of the file, in its order.

    Attributes:
        codes: by line, the code of the stream that took it, or `NOTHING`, `TEXT`, `SEVERAL`.
        shared: lines of several streams, by number.
        last_code: the greatest code that is given away.
    """

    codes: "array[int]" = field(default_factory=lambda: array("H"))
    shared: dict[int, SharedLine] = field(default_factory=dict)
    last_code: int = SEVERAL

    @property
    def is_full(self) -> bool:
        """Whether no further stream can be told from the others."""
        return self.last_code >= _MOST_STREAMS

    def new_code(self) -> int:
        """Give away the next code."""
        self.last_code += 1
        return self.last_code

    def lines_of(self, code: int) -> Int64Array:
        """Give the number of the line that each row of a stream was read from, (N,) int64, counted from 1."""
        codes = np.frombuffer(self.codes, np.uint16) if self.codes else np.zeros(0, np.uint16)
        lines: Int64Array = np.flatnonzero(codes == code)
        lines += 1
        beside = [
            (row, line) for line, shared in self.shared.items() for own, row in shared.rows if own == code
        ]
        if not beside:
            return lines
        rows = sorted(beside)
        return np.insert(lines, [row - k for k, (row, _) in enumerate(rows)], [line for _, line in rows])


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
        """All streams of numbers, by what tells them apart."""
        return {
            **{("sensor", name): stream for name, stream in self.sensors.items()},
            ("gps",): self.gnss,
            ("barometer",): self.barometer,
            **{("receiver", *origin): stream for origin, stream in self.receivers.items()},
            **{("pose", *origin): stream.samples for origin, stream in self.poses.items()},
            **{("lidar", str(index)): lidar.sweeps for index, lidar in self.lidars.items()},
        }

    def line_seconds(self) -> Float64Array:
        """Give the time of each line in the order of the file, (N,) float64 [s], NaN for lines without one."""
        codes = np.frombuffer(self.log.codes, np.uint16) if self.log.codes else np.zeros(0, np.uint16)
        seconds = np.full(len(codes), np.nan)
        in_several = {code for shared in self.log.shared.values() for code, _ in shared.rows}
        for stream in self.streams().values():
            if stream.code in in_several:
                seconds[self.log.lines_of(stream.code) - 1] = view(stream.seconds)
            elif len(stream):
                seconds[codes == stream.code] = view(stream.seconds)
        if len(self.frames.seconds):
            seconds[np.frombuffer(self.frames.lines, np.int64) - 1] = view(self.frames.seconds)
        if self.other_lines:
            seconds[codes == TEXT] = view(self.other_seconds)
        return seconds
