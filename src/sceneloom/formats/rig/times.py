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
from sceneloom.formats.rig.stamps import FARTHEST_NS, NamePattern, StampError, parse_stamp, shifted
from sceneloom.scene.notices import NoticeKind

WAYS = ("pattern", "csv", "lines", "rate_hz", "container")
"""The fields of `times` that each say where stamps come from; a pattern of indices needs a rate beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Stamps:
    """Which items of a sensor are used, and when they are of.

    Attributes:
        chosen: (N,) int64, index among the files or pictures, in the order of time.
        timestamps_ns: (N,) int64 [ns], strictly increasing.
    """

    chosen: Int64Array
    timestamps_ns: Int64Array


def drop_unreadable(stamps: Stamps, read: Callable[[int], object], ledger: Ledger) -> Stamps:
    """Leave out the first files as long as they cannot be read: what a sensor is like is seen in its first one.

    Args:
        stamps: of at least one file.
        read: looks into one file, by its index among all files.
        ledger: of a lenient reading; in another one the first file is as good as any, and nothing is tried.

    Raises:
        DataError: no file can be read; the last one's fault.
    """
    if not ledger.lenient:
        return stamps
    for row, k in enumerate(stamps.chosen.tolist()):
        try:
            read(k)
        except DataError as error:
            if row == len(stamps.chosen) - 1:
                raise
            ledger.fault("unreadable-files", error)
        else:
            return Stamps(stamps.chosen[row:], stamps.timestamps_ns[row:])
    return stamps


@dataclass(frozen=True, slots=True)
class TimeSource:
    """What the stamps of one sensor are read with.

    Attributes:
        record: the `times` of the sensor.
        place: where it stands in the manifest.
        manifest: the file, for messages.
        root: folder of the sensor's files.
        offset_ns: added to every stamp [ns].
        ledger: takes notices, and faults in a lenient reading.
    """

    record: Record
    place: str
    manifest: Path
    root: Root
    offset_ns: int
    ledger: Ledger

    def stamp_files(self, files: Sequence[Path]) -> Stamps:
        """Give the times of files, which stand in the order of their names.

        Raises:
            DataError: a time is missing, no time, or that of two files.
        """
        way = self._way(("pattern", "csv", "lines", "rate_hz"))
        names = [self.root.relative(path) for path in files]
        chosen, times = _WAYS[way](self, names)
        return self._in_order(chosen, times, names)

    def stamp_pictures(self, count: int, container_ns: Callable[[], Int64Array], name: str) -> Stamps:
        """Give the times of the pictures of a video, which have numbers in place of names.

        Args:
            count: how many pictures it has.
            container_ns: gives the times that the video has itself.
            name: of the video, for messages.
        """
        way = self._way(("csv", "lines", "rate_hz", "container"))
        names = [f"{name} picture {k}" for k in range(count)]
        if way == "container":
            stamps = shifted(container_ns(), self._start_ns(), self.manifest, f"{self.place}.start_s")
            return self._in_order(np.arange(count), stamps, names)
        if way == "csv":
            chosen, times = self._in_parallel(*self._csv_times(), count)
        else:
            chosen, times = _WAYS[way](self, names)
        return self._in_order(chosen, times, names)

    def _way(self, possible: Sequence[str]) -> str:
        said = [way for way in WAYS if self.record.get(way) not in (None, False)]
        indexed = said == ["pattern", "rate_hz"]
        if len(said) != 1 and not indexed:
            found = ", ".join(said) or "none of them"
            raise DataError(
                self.manifest, self.place, f"{found}; expected exactly one of {', '.join(possible)}"
            )
        if said[0] not in possible:
            raise DataError(
                self.manifest, self.place, f"{said[0]}; expected one of {', '.join(possible)} here"
            )
        return said[0]

    def _start_ns(self) -> int:
        return int(self.record.get("start_s", 0))

    def _evenly(self, indices: Sequence[int]) -> Int64Array:
        """Times of numbered files, rounded once each, so that no error adds up."""
        period = Decimal(10**9) / Decimal(str(self.record["rate_hz"]))
        stamps = [int((index * period).to_integral_value()) + self._start_ns() for index in indices]
        if stamps and max(map(abs, stamps)) > FARTHEST_NS:
            raise DataError(
                self.manifest, self.place, f"index {max(indices)}: its time is beyond the year 2261"
            )
        return np.array(stamps, np.int64)

    def by_pattern(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Read the times out of the names."""
        where = f"{self.place}.pattern"
        try:
            pattern = NamePattern(self.record["pattern"])
        except StampError as error:
            raise DataError(self.manifest, where, str(error)) from None
        if pattern.indexed != ("rate_hz" in self.record):
            expected = (
                "`rate_hz` beside {index}" if pattern.indexed else "{index} in the pattern beside `rate_hz`"
            )
            raise DataError(self.manifest, self.place, f"{self.record['pattern']!r}; expected {expected}")
        chosen, values = [], []
        for k, name in enumerate(names):
            try:
                values.append(pattern.read(name.rpartition("/")[2]))
                chosen.append(k)
            except StampError as error:
                self.ledger.fault("names-without-time", DataError(self.manifest, where, str(error)))
        times = self._evenly(values) if pattern.indexed else np.array(values, np.int64)
        return np.array(chosen, np.int64), times

    def by_rate(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Count the files."""
        return np.arange(len(names)), self._evenly(range(len(names)))

    def by_lines(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Take one line of a text file per file."""
        path = self.root.file(self.record["lines"], f"{self.place}.lines")
        return self._in_parallel(path, line_stamps(path, self.record.get("unit")), len(names))

    def by_csv(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Take the rows of a CSV file, by the names of files in them where there are, else in parallel."""
        table, path = self._table()
        stamps = table.stamps(self._time_column(table), self.record.get("unit"))
        column = self._file_column(table)
        if column is None:
            return self._in_parallel(path, stamps, len(names))
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
        return np.array(chosen, np.int64), stamps[rows]

    def _note_unused(self, path: Path, count: int) -> None:
        if count:
            message = "has no time for some files; they were left out"
            self.ledger.note(NoticeKind.SKIPPED, "files-without-time", str(path), message, count=count)

    def _table(self) -> tuple[Table, Path]:
        path = self.root.file(self.record["csv"], f"{self.place}.csv")
        return read_table(path), path

    def _csv_times(self) -> tuple[Path, Int64Array]:
        table, path = self._table()
        return path, table.stamps(self._time_column(table), self.record.get("unit"))

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

    def _in_parallel(self, path: Path, stamps: Int64Array, count: int) -> tuple[Int64Array, Int64Array]:
        if len(stamps) != count:
            problem = f"{len(stamps)} times for {count} files or pictures; expected as many"
            self.ledger.fault("counts-disagree", DataError(path, "", problem), count=abs(count - len(stamps)))
        used = min(len(stamps), count)
        return np.arange(used), stamps[:used]

    def _in_order(self, chosen: Int64Array, times: Int64Array, names: Sequence[str]) -> Stamps:
        stamps = shifted(times, self.offset_ns, self.manifest, self.place)
        if len(stamps) > 1 and (stamps[1:] < stamps[:-1]).any():
            message = "times run backwards in the order of the names; sorted by time"
            place = f"{self.manifest}: {self.place}"
            back = int((stamps[1:] < stamps[:-1]).sum())
            self.ledger.note(NoticeKind.REPAIRED, "files-sorted", place, message, count=back)
        order = np.argsort(stamps, kind="stable")
        chosen, stamps = chosen[order], stamps[order]
        repeated = np.flatnonzero(np.diff(stamps) == 0) + 1
        if len(repeated):
            k = int(repeated[0])
            problem = (
                f"{names[chosen[k - 1]]!r} and {names[chosen[k]]!r} have the same time, {stamps[k] / 1e9:.9f} s; "
                "expected one file per time"
            )
            self.ledger.fault(
                "repeated-times", DataError(self.manifest, self.place, problem), count=len(repeated)
            )
            kept = np.ones(len(stamps), np.bool_)
            kept[repeated] = False
            chosen, stamps = chosen[kept], stamps[kept]
        return Stamps(chosen, stamps)


_WAYS: Mapping[str, Callable[[TimeSource, Sequence[str]], tuple[Int64Array, Int64Array]]] = {
    "pattern": TimeSource.by_pattern,
    "csv": TimeSource.by_csv,
    "lines": TimeSource.by_lines,
    "rate_hz": TimeSource.by_rate,
}


def line_stamps(path: Path, unit: str | None) -> Int64Array:
    """The times of a text file with one per line, (N,) int64 [ns].

    Raises:
        DataError: a line is no time.
    """
    stamps = []
    for number, line in read_lines(path):
        try:
            stamps.append(parse_stamp(line, unit))
        except StampError as error:
            raise DataError(path, f"line {number}", str(error)) from None
    return np.array(stamps, np.int64)
