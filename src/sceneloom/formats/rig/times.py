"""When each file of a sensor was recorded, by what its `times` says."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.rig.csv_files import FILE_COLUMNS, TIME_COLUMNS, Table, read_lines, read_table
from sceneloom.formats.rig.records import Record
from sceneloom.formats.rig.roots import Root
from sceneloom.formats.rig.timestamps import (
    FARTHEST_NS,
    NamePattern,
    TimestampError,
    parse_timestamp,
    shifted,
)
from sceneloom.scene.warnings import WarningKind

TRAJECTORIES = ("pattern", "csv", "lines", "rate_hz", "container")
"""The fields of `times` that each state where timestamps come from; a pattern of indices needs a rate beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Timestamps:
    """Which items of a sensor are used, and when they are of.

    Attributes:
        chosen: (N,) int64, index among the files or images, in the order of time.
        timestamps_ns: (N,) int64 [ns], strictly increasing.
    """

    chosen: Int64Array
    timestamps_ns: Int64Array


def drop_unreadable(timestamps: Timestamps, read: Callable[[int], object], ledger: Ledger) -> Timestamps:
    """Leave out the first files as long as they cannot be read: what a sensor is like is seen in its first one.

    Args:
        timestamps: of at least one file.
        read: looks into one file, by its index among all files.
        ledger: of a lenient reading; in another one the first file is as good as any, and nothing is tried.

    Raises:
        DataError: no file can be read; the last one's fault.
    """
    if not ledger.lenient:
        return timestamps
    for row, k in enumerate(timestamps.chosen.tolist()):
        try:
            read(k)
        except DataError as error:
            if row == len(timestamps.chosen) - 1:
                raise
            ledger.fault("unreadable-files", error)
        else:
            return Timestamps(timestamps.chosen[row:], timestamps.timestamps_ns[row:])
    return timestamps


@dataclass(frozen=True, slots=True)
class TimeSource:
    """What the timestamps of one sensor are read with.

    Attributes:
        record: the `times` of the sensor.
        location: where it stands in the manifest.
        manifest: the file, for messages.
        root: folder of the sensor's files.
        offset_ns: added to every timestamp [ns].
        ledger: takes warnings, and faults in a lenient reading.
    """

    record: Record
    location: str
    manifest: Path
    root: Root
    offset_ns: int
    ledger: Ledger

    def timestamp_files(self, files: Sequence[Path]) -> Timestamps:
        """Give the times of files, which stand in the order of their names.

        Raises:
            DataError: a time is missing, no time, or that of two files.
        """
        trajectory = self._trajectory(("pattern", "csv", "lines", "rate_hz"))
        names = [self.root.relative(path) for path in files]
        chosen, times = _TRAJECTORIES[trajectory](self, names)
        return self._in_order(chosen, times, names)

    def timestamp_images(self, count: int, container_ns: Callable[[], Int64Array], name: str) -> Timestamps:
        """Give the times of the images of a video, which have numbers instead of names.

        Args:
            count: how many images it has.
            container_ns: gives the times that the video has itself.
            name: of the video, for messages.
        """
        trajectory = self._trajectory(("csv", "lines", "rate_hz", "container"))
        names = [f"{name} image {k}" for k in range(count)]
        if trajectory == "container":
            timestamps = shifted(container_ns(), self._start_ns(), self.manifest, f"{self.location}.start_s")
            return self._in_order(np.arange(count), timestamps, names)
        if trajectory == "csv":
            chosen, times = self._in_parallel(*self._csv_times(), count)
        else:
            chosen, times = _TRAJECTORIES[trajectory](self, names)
        return self._in_order(chosen, times, names)

    def _trajectory(self, possible: Sequence[str]) -> str:
        stated = [
            trajectory for trajectory in TRAJECTORIES if self.record.get(trajectory) not in (None, False)
        ]
        indexed = stated == ["pattern", "rate_hz"]
        if len(stated) != 1 and not indexed:
            found = ", ".join(stated) or "none of them"
            raise DataError(
                self.manifest, self.location, f"{found}; expected exactly one of {', '.join(possible)}"
            )
        if stated[0] not in possible:
            raise DataError(
                self.manifest, self.location, f"{stated[0]}; expected one of {', '.join(possible)} here"
            )
        return stated[0]

    def _start_ns(self) -> int:
        return int(self.record.get("start_s", 0))

    def _evenly(self, indices: Sequence[int]) -> Int64Array:
        """Times of numbered files, rounded once each, so that no error adds up."""
        period = Decimal(10**9) / Decimal(str(self.record["rate_hz"]))
        timestamps = [int((index * period).to_integral_value()) + self._start_ns() for index in indices]
        if timestamps and max(map(abs, timestamps)) > FARTHEST_NS:
            raise DataError(
                self.manifest, self.location, f"index {max(indices)}: its time is beyond the year 2261"
            )
        return np.array(timestamps, np.int64)

    def by_pattern(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Read the times out of the names."""
        where = f"{self.location}.pattern"
        try:
            pattern = NamePattern(self.record["pattern"])
        except TimestampError as error:
            raise DataError(self.manifest, where, str(error)) from None
        if pattern.indexed != ("rate_hz" in self.record):
            expected = (
                "`rate_hz` beside {index}" if pattern.indexed else "{index} in the pattern beside `rate_hz`"
            )
            raise DataError(self.manifest, self.location, f"{self.record['pattern']!r}; expected {expected}")
        chosen, values = [], []
        for k, name in enumerate(names):
            try:
                values.append(pattern.read(name.rpartition("/")[2]))
                chosen.append(k)
            except TimestampError as error:
                self.ledger.fault("names-without-time", DataError(self.manifest, where, str(error)))
        times = self._evenly(values) if pattern.indexed else np.array(values, np.int64)
        return np.array(chosen, np.int64), times

    def by_rate(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Count the files."""
        return np.arange(len(names)), self._evenly(range(len(names)))

    def by_lines(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Take one line of a text file per file."""
        path = self.root.file(self.record["lines"], f"{self.location}.lines")
        return self._in_parallel(path, line_timestamps(path, self.record.get("unit")), len(names))

    def by_csv(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Take the rows of a CSV file, by the names of files in them where there are, else in parallel."""
        table, path = self._table()
        timestamps = table.timestamps(self._time_column(table), self.record.get("unit"))
        column = self._file_column(table)
        if column is None:
            return self._in_parallel(path, timestamps, len(names))
        known: dict[str, list[int]] = {}
        for k, name in enumerate(names):
            base = name.rpartition("/")[2]
            for key in {name, base, base.rpartition(".")[0] or base}:
                known.setdefault(key, []).append(k)
        chosen, rows = [], []
        for row, cells in enumerate(table.rows):
            wanted = cells[column].replace("\\", "/").removeprefix("./")
            match = known.get(wanted) or known.get(wanted.rpartition("/")[2]) or []
            if len(match) == 1:
                chosen.append(match[0])
                rows.append(row)
                continue
            problem = f"{cells[column]!r} is {len(match) or 'none'} of the sensor's files"
            fault = DataError(path, f"line {table.lines[row]}", f"{problem}; expected exactly one")
            self.ledger.fault("rows-without-file", fault)
        self._note_unused(path, len(names) - len(set(chosen)))
        return np.array(chosen, np.int64), timestamps[rows]

    def _note_unused(self, path: Path, count: int) -> None:
        if count:
            message = "has no time for some files; they were left out"
            self.ledger.note(WarningKind.SKIPPED, "files-without-time", str(path), message, count=count)

    def _table(self) -> tuple[Table, Path]:
        path = self.root.file(self.record["csv"], f"{self.location}.csv")
        return read_table(path), path

    def _csv_times(self) -> tuple[Path, Int64Array]:
        table, path = self._table()
        return path, table.timestamps(self._time_column(table), self.record.get("unit"))

    def _time_column(self, table: Table) -> int:
        name = self.record.get("column")
        found = table.find(TIME_COLUMNS) if name is None else table.column(name)
        if found is None:
            problem = f"no column of times among {', '.join(table.names)}; name it with `column`"
            raise DataError(table.path, "line 1", problem)
        return found

    def _file_column(self, table: Table) -> int | None:
        name = self.record.get("file_column")
        return table.find(FILE_COLUMNS) if name is None else table.column(name)

    def _in_parallel(self, path: Path, timestamps: Int64Array, count: int) -> tuple[Int64Array, Int64Array]:
        if len(timestamps) != count:
            problem = f"{len(timestamps)} times for {count} files or images; expected as many"
            self.ledger.fault(
                "counts-disagree", DataError(path, "", problem), count=abs(count - len(timestamps))
            )
        used = min(len(timestamps), count)
        return np.arange(used), timestamps[:used]

    def _in_order(self, chosen: Int64Array, times: Int64Array, names: Sequence[str]) -> Timestamps:
        timestamps = shifted(times, self.offset_ns, self.manifest, self.location)
        if len(timestamps) > 1 and (timestamps[1:] < timestamps[:-1]).any():
            message = "times run backwards in the order of the names; sorted by time"
            location = f"{self.manifest}: {self.location}"
            back = int((timestamps[1:] < timestamps[:-1]).sum())
            self.ledger.note(WarningKind.REPAIRED, "files-sorted", location, message, count=back)
        order = np.argsort(timestamps, kind="stable")
        chosen, timestamps = chosen[order], timestamps[order]
        repeated = np.flatnonzero(np.diff(timestamps) == 0) + 1
        if len(repeated):
            k = int(repeated[0])
            problem = (
                f"{names[chosen[k - 1]]!r} and {names[chosen[k]]!r} have the same time, {timestamps[k] / 1e9:.9f} s; "
                "expected one file per time"
            )
            self.ledger.fault(
                "repeated-times", DataError(self.manifest, self.location, problem), count=len(repeated)
            )
            kept = np.ones(len(timestamps), np.bool_)
            kept[repeated] = False
            chosen, timestamps = chosen[kept], timestamps[kept]
        return Timestamps(chosen, timestamps)


_TRAJECTORIES: Mapping[str, Callable[[TimeSource, Sequence[str]], tuple[Int64Array, Int64Array]]] = {
    "pattern": TimeSource.by_pattern,
    "csv": TimeSource.by_csv,
    "lines": TimeSource.by_lines,
    "rate_hz": TimeSource.by_rate,
}


def line_timestamps(path: Path, unit: str | None) -> Int64Array:
    """The times of a text file with one per line, (N,) int64 [ns].

    Raises:
        DataError: a line is no time.
    """
    timestamps = []
    for number, line in read_lines(path):
        try:
            timestamps.append(parse_timestamp(line, unit))
        except TimestampError as error:
            raise DataError(path, f"line {number}", str(error)) from None
    return np.array(timestamps, np.int64)
