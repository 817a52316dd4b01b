"""The streams of a recording as rules look at them: times and values in order of time, and where each stands."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.checks.subject import Subject
from sceneloom.formats.recording.column_arrays import is_sorted, lines_of, time_order
from sceneloom.formats.recording.columns import Columns, LineLog, RecordingColumns
from sceneloom.formats.recording.number_sensors import RECEIVER, imu_streams, receivers

FEWEST_FOR_A_RATE = 4
"""Fewer samples do not report what is usual."""

_SAME_TIME = 0.5e-9
"""Times closer than this [s] are one time: the scene counts nanoseconds."""


class Kind(StrEnum):
    """What a stream is of; a sensor's word is the format's own."""

    CAMERA = "camera"
    LIDAR = "lidar"
    ACCELEROMETER = "accelerometer"
    GYROSCOPE = "gyroscope"
    MAGNETOMETER = "magnetometer"
    BAROMETER = "barometer"
    TEMPERATURE = "imuTemperature"
    GNSS = "gnss"
    POSES = "poses"
    OTHER = "other"

    @classmethod
    def of_sensor(cls, name: str) -> "Kind":
        """The kind of `sensor` lines of a type."""
        return cls(name) if name in _SENSORS else cls.OTHER


_SENSORS = frozenset({"accelerometer", "gyroscope", "magnetometer", "barometer", "imuTemperature"})


@dataclass(frozen=True, eq=False)
class Stream:
    """A stream in the order of its times.

    Attributes:
        name: as messages state it: "accelerometer", "gps", "groundTruth", "camera0", "lidar".
        kind: what it is of.
        file_seconds: (N,) float64 [s], in the order of the file.
        file_values: (N, K) float64 in the order of the file; None for images and sweeps.
        code: of the stream in `log`.
        log: which line each sample was read from.
        known_lines: (N,) int64, line of each in the order of the file, where that is known beforehand.
        file: name of the file that it stands in.
    """

    name: str
    kind: Kind
    file_seconds: Float64Array
    file_values: Float64Array | None = None
    code: int = 0
    log: LineLog | None = None
    known_lines: Int64Array | None = None
    file: str = "data.jsonl"

    def __len__(self) -> int:
        return len(self.file_seconds)

    @cached_property
    def file_lines(self) -> Int64Array | None:
        """(N,) int64, line of each in the order of the file; None where it cannot be reported."""
        if self.known_lines is not None or self.log is None:
            return self.known_lines
        lines = lines_of(self.log, self.code)
        return lines if len(lines) == len(self) else None

    @cached_property
    def order(self) -> Int64Array:
        """(N,) int64, row of the file's order that each row was."""
        return time_order(self.file_seconds)

    @cached_property
    def seconds(self) -> Float64Array:
        """(N,) float64 [s], ascending."""
        return self.file_seconds if is_sorted(self.file_seconds) else self.file_seconds[self.order]

    @property
    def values(self) -> Float64Array:
        """(N, K) float64, in the order of `seconds`; (N, 0) for images and sweeps."""
        if self.file_values is None:
            return np.zeros((len(self), 0))
        return self.file_values if is_sorted(self.file_seconds) else self.file_values[self.order]

    @cached_property
    def intervals(self) -> Float64Array:
        """(N - 1,) float64 [s], from each time to the next; 0 for one and the same time."""
        steps = np.diff(self.seconds)
        steps[steps < _SAME_TIME] = 0.0
        return steps

    @cached_property
    def period(self) -> float | None:
        """The usual interval [s]; None where the times report none."""
        if len(self) < FEWEST_FOR_A_RATE:
            return None
        median = float(np.median(self.intervals))
        return median if median > 0 else None

    @property
    def whole(self) -> str:
        """Where findings about all of it are reported."""
        return f"{self.file}: {self.name}"

    def at(self, row: int) -> str:
        """A sample in words; `row` counts in the order of `seconds`."""
        return f"{self.name} at {self.seconds[row]:.6f} s"


def streams_of(subject: Subject) -> tuple[Stream, ...]:
    """All streams of the recording that have samples; none where the subject is no recording."""
    return subject.table("streams of the recording", _make_streams)


def streams_of_kind(subject: Subject, *kinds: Kind) -> Iterator[Stream]:
    """Those of some kinds."""
    return (stream for stream in streams_of(subject) if stream.kind in kinds)


def location(stream: Stream, row: int) -> str:
    """Where a sample stands: its line, if that is known; `row` counts in the order of `seconds`."""
    return location_in_file(stream, int(stream.order[row]))


def location_in_file(stream: Stream, row: int) -> str:
    """As `location`; `row` counts in the order of the file."""
    lines = stream.file_lines
    return stream.whole if lines is None else f"{stream.file}: line {lines[row]}"


def _make_streams(subject: Subject) -> tuple[Stream, ...]:
    if subject.recording is None:
        return ()
    columns, file = subject.recording.columns, subject.recording.data_name
    found = (*_frames(columns), *_lidars(columns), *_sensors(columns), *_fixes(columns), *_poses(columns))
    return tuple(replace(stream, file=file) for stream in found if len(stream))


def _frames(columns: RecordingColumns) -> Iterator[Stream]:
    lines = np.asarray(columns.frames.lines, np.int64)
    for index, camera in sorted(columns.frames.cameras.items()):
        there = np.asarray(camera.missing, np.int8) == 0
        rows = np.asarray(camera.rows, np.int64)[there]
        seconds = np.asarray(camera.seconds, np.float64)[there]
        yield Stream(f"camera{index}", Kind.CAMERA, seconds, known_lines=lines[rows])


def _lidars(columns: RecordingColumns) -> Iterator[Stream]:
    for index, lidar in sorted(columns.lidars.items()):
        name = f"lidar{index}" if len(columns.lidars) > 1 else "lidar"
        seconds, lines = np.asarray(lidar.sweeps.seconds), np.asarray(lidar.lines, np.int64)
        yield Stream(name, Kind.LIDAR, seconds, known_lines=lines)


def _sensors(columns: RecordingColumns) -> Iterator[Stream]:
    for name, stream in imu_streams(columns).items():
        yield _of_columns(name, Kind.of_sensor(name), stream, columns.log)


def _fixes(columns: RecordingColumns) -> Iterator[Stream]:
    for name, (_, stream) in receivers(columns).items():
        yield _of_columns("gps" if name == RECEIVER else name, Kind.GNSS, stream, columns.log)


def _poses(columns: RecordingColumns) -> Iterator[Stream]:
    for (root, name), poses in columns.poses.items():
        reported = name if name == root or not root else f"{root} {name}"
        yield _of_columns(reported, Kind.POSES, poses.samples, columns.log)


def _of_columns(name: str, kind: Kind, columns: Columns, log: LineLog) -> Stream:
    seconds = np.asarray(columns.seconds, np.float64)
    values = np.asarray(columns.values, np.float64).reshape(len(seconds), columns.width)
    return Stream(name, kind, seconds, values, columns.code, log)
