"""What the lines of a recording say, as growing columns, one set per stream; small per sample, and no text."""

from array import array
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only

FARTHEST_TIME = 9.2e9
"""Times within plus or minus this fit into int64 nanoseconds [s]."""


def nanoseconds(seconds: Float64Array) -> Int64Array:
    """Bring seconds to the scene's clock: round(t · 1e9), halves to even."""
    return np.rint(seconds * 1e9).astype(np.int64)


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
        seconds: times [s].
        values: the samples one after another.
        further: by row, the text of a line that holds more than these columns do.
    """

    width: int
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

    def further_by_time(self) -> dict[str, str]:
        """Give the texts by their sample's time [ns], as text; of samples with one time, the last one's."""
        stamps = nanoseconds(view(self.seconds))
        return {str(stamps[row]): text for row, text in self.further.items()}


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
        numbers: `number` of each line.
        seconds: `time` of each line [s].
        lines: number of each line in the file.
        offsets: byte at which a line begins that says more than the columns hold, -1 for others.
        cameras: entries by `cameraInd`.
        texts: every different text of `cameraParameters` and `imuToCamera`, with its place in this order.
    """

    numbers: "array[int]" = field(default_factory=lambda: array("q"))
    seconds: "array[float]" = field(default_factory=lambda: array("d"))
    lines: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))
    cameras: dict[int, CameraColumns] = field(default_factory=dict)
    texts: dict[bytes, int] = field(default_factory=dict)

    def text_index(self, text: bytes) -> int:
        """Give the place of a text, -1 for none."""
        return self.texts.setdefault(text, len(self.texts)) if text else -1


@dataclass(slots=True, eq=False)
class RecordingColumns:
    """All lines of a recording.

    Attributes:
        sensors: streams by `sensor.type`.
        gnss: latitude, longitude [deg], altitude [m], accuracy and vertical accuracy [m], NaN where not given.
        poses: trajectories by the root key of their lines ("" for poses at the root itself) and their name.
        lidars: by `lidarInd`.
        frames: the `frames` lines.
        other_lines: the text of lines that hold none of these.
        other_keys: how many of those lines have which first key.
    """

    sensors: dict[str, Columns] = field(default_factory=dict)
    gnss: Columns = field(default_factory=lambda: Columns(5))
    poses: dict[tuple[str, str], PoseColumns] = field(default_factory=dict)
    lidars: dict[int, LidarColumns] = field(default_factory=dict)
    frames: FrameColumns = field(default_factory=FrameColumns)
    other_lines: list[str] = field(default_factory=list)
    other_keys: dict[str, int] = field(default_factory=dict)
