"""What the lines of a recording state, as growing columns, one set per stream; small per sample, and no text."""

from array import array
from dataclasses import dataclass, field

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


NOTHING, TEXT, SEVERAL = 0, 1, 2
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
        codes: by line, the code of the stream that took it, or `NOTHING`, `TEXT`, `SEVERAL`.
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
