"""A `rig.toml` as records, the files that it names below one folder, and the timestamps of each sensor's files."""

import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes, why_no_file
from sceneloom.formats.base.text_tables import (
    FARTHEST_NS,
    FILE_COLUMNS,
    TIME_COLUMNS,
    NamePattern,
    Table,
    TimestampError,
    parse_timestamp,
    read_lines,
    read_table,
    shifted,
)
from sceneloom.formats.rig.schema import Faults, Record, read_record
from sceneloom.warnings import WarningKind

_NAMED = (("sensors", "id"), ("trajectories", "name"))

_LARGEST_MANIFEST = 16_000_000

_LARGEST_EXPONENT = 40


@dataclass(frozen=True, slots=True)
class Manifest:
    """A manifest that the table of fields finds nothing wrong with.

    Attributes:
        path: the file.
        record: its fields.
    """

    path: Path
    record: Record

    @property
    def ego(self) -> str:
        """The frame that moves through the world."""
        return str(self.record.get("ego", "base"))

    def faults(self) -> Faults:
        """A collection of faults that knows what the parts are called."""
        faults = Faults(self.path)
        for name, key in _NAMED:
            faults.labels.update(
                {location: record[key] for location, record in self.records(name) if key in record}
            )
        return faults

    def records(self, name: str) -> list[tuple[str, Record]]:
        """The tables of a list, each with its location."""
        return [(f"{name}[{k}]", record) for k, record in enumerate(self.record.get(name, []))]


def has_sensors(path: Path) -> bool:
    """Whether a file is TOML with sensors in it."""
    try:
        return "sensors" in _parse(path)
    except DataError:
        return False


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        DataError: the file cannot be read, is no TOML, or has faults; all of them are reported at once.
    """
    raw = _parse(path)
    faults = Faults(path)
    record = read_record(raw, "rig", "", faults)
    _check_ids(record, faults)
    faults.raise_all()
    return Manifest(path, record)


def _check_ids(record: Record, faults: Faults) -> None:
    for name, key in _NAMED:
        seen: dict[str, int] = {}
        for k, inner in enumerate(record.get(name, [])):
            identifier = inner.get(key)
            if identifier in seen:
                faults.add(f"{name}[{k}].{key}", f"{identifier!r} is also that of {name}[{seen[identifier]}]")
            elif identifier is not None:
                seen[identifier] = k
    if record.get("sensors") == []:
        faults.add("sensors", "an empty list; expected at least one `[[sensors]]`")


def _parse(path: Path) -> Record:
    try:
        size = path.stat().st_size
        if size > _LARGEST_MANIFEST:
            raise DataError(path, "", f"{size} bytes; expected a manifest of at most {_LARGEST_MANIFEST}")
        text = read_bytes(path).decode("utf-8-sig")
        return tomllib.loads(text.replace("\r\n", "\n"), parse_float=_decimal)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text; expected TOML") from error
    except (ValueError, RecursionError) as error:
        broken = "key part" in str(error) or "inline table" in str(error)
        hint = "; a table in { } has to stand in one line" if broken else ""
        raise DataError(path, "", f"is no TOML: {error}{hint}") from error


def _decimal(text: str) -> Decimal:
    """Keep all digits of a number, so that no time is rounded; numbers beyond all reason are infinite or zero."""
    try:
        number = Decimal(text)
    except InvalidOperation:
        return Decimal("Infinity")
    if not number.is_finite() or number == 0:
        return number
    if abs(number.adjusted()) <= _LARGEST_EXPONENT:
        return number
    return Decimal("Infinity") if number.adjusted() > 0 else Decimal(0)


_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True)
class Root:
    """A folder whose files a manifest may name.

    Attributes:
        folder: resolved.
        manifest: for messages.
    """

    folder: Path
    manifest: Path

    def file(self, name: str, location: str) -> Path:
        """Find one file.

        Raises:
            DataError: there is no such file, or it lies outside the folder.
        """
        path = self.folder / self._checked(name, location)
        if not path.is_file():
            raise DataError(self.manifest, location, f"{name!r}: {why_no_file(path)} in {self.folder}")
        self._check_inside([path], location)
        return path

    def files(self, patterns: Sequence[str], location: str) -> list[Path]:
        """Find the files of some patterns, in the order in which people number them: 2 before 10.

        Raises:
            DataError: there is none, one is no regular file, or one lies outside the folder.
        """
        found: set[Path] = set()
        for pattern in patterns:
            try:
                matches = [
                    path for path in self.folder.glob(self._checked(pattern, location)) if not path.is_dir()
                ]
            except (ValueError, NotImplementedError, IndexError, re.error) as error:
                raise DataError(self.manifest, location, f"{pattern!r} is no pattern: {error}") from error
            if not matches:
                raise DataError(
                    self.manifest,
                    location,
                    f"{pattern!r}: no such files in {self.folder}{self._hint(pattern)}",
                )
            found.update(matches)
        files = sorted(found, key=natural_key)
        odd = next((path for path in files if not path.is_file()), None)
        if odd is not None:
            raise DataError(self.manifest, location, f"{self.relative(odd)!r}: {why_no_file(odd)}")
        self._check_inside(files, location)
        return files

    def relative(self, path: Path) -> str:
        """What a file is called seen from the folder."""
        # of many thousands of files, each asked for: cutting the text is ten times as fast as `relative_to`
        return str(path)[len(str(self.folder)) :].lstrip(os.sep).replace(os.sep, "/")

    def _checked(self, name: str, location: str) -> str:
        windows = PureWindowsPath(name)
        outside = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
        if outside:
            problem = f"{name!r}; expected a path below {self.folder}; name another folder with `root`"
            raise DataError(self.manifest, location, problem)
        return name

    def _check_inside(self, files: Sequence[Path], location: str) -> None:
        """Refuse links that lead out; folders are looked up once each."""
        resolved: dict[Path, bool] = {}
        for path in files:
            if path.parent not in resolved:
                resolved[path.parent] = path.parent.resolve().is_relative_to(self.folder)
            inside = resolved[path.parent]
            if inside and path.is_symlink():
                inside = path.resolve().is_relative_to(self.folder)
            if not inside:
                problem = (
                    f"{self.relative(path)!r} leads out of {self.folder} by a link, to {path.resolve()}; "
                    "name the folder that the files are in as `root`"
                )
                raise DataError(self.manifest, location, problem)

    def _hint(self, pattern: str) -> str:
        """Report what there is instead of a pattern without matches."""
        folder = self.folder
        for part in PurePosixPath(pattern).parts[:-1]:
            if any(sign in part for sign in "*?["):
                break
            if not (folder / part).is_dir():
                return f"; {folder.name or folder} has {_folders_in(folder)}{_spelling_hint(pattern)}"
            folder /= part
        suffixes = sorted({entry.suffix for entry in folder.iterdir() if entry.is_file() and entry.suffix})
        held = ", ".join("*" + suffix for suffix in suffixes[:10]) or "no files"
        also = f" and {_folders_in(folder)}" if folder == self.folder else ""
        return f"; {folder.name or folder} has {held}{also}{_spelling_hint(pattern)}"


def _folders_in(folder: Path) -> str:
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    return f"the folders {', '.join(names[:10])}" if names else "no folders"


def _spelling_hint(pattern: str) -> str:
    """Explain signs that mean something else in a pattern than in a name."""
    if "\\" in pattern:
        return "; folders are parted by /, also on Windows"
    return "; [ ] stand for a choice of signs: write [[] for the sign [" if "[" in pattern else ""


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Order numbers inside names by their value."""
    parts = _DIGITS.split(path.as_posix())
    return tuple(
        (1, int(part), part) if part.isdecimal() and part.isascii() else (0, 0, part) for part in parts
    )


def open_root(manifest: Path, names: Sequence[str | None], location: str) -> Root:
    """Find the folder of some files.

    Args:
        manifest: the manifest, from whose folder a relative root is seen.
        names: `root` of the sensor and of the manifest, None where not stated; the first that is stated counts.

    Raises:
        DataError: there is no such folder.
    """
    name = next((name for name in names if name is not None), None)
    folder = manifest.parent if name is None else manifest.parent / Path(name).expanduser()
    try:
        resolved = folder.resolve()
    except (OSError, RuntimeError) as error:
        raise DataError(manifest, location, f"{name!r} cannot be read: {error}") from error
    if not resolved.is_dir():
        raise DataError(manifest, location, f"{name!r}: no such folder; expected the folder of the files")
    return Root(resolved, manifest)


_TIMES_TRAJECTORIES = ("pattern", "csv", "lines", "rate_hz", "container")
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
            trajectory
            for trajectory in _TIMES_TRAJECTORIES
            if self.record.get(trajectory) not in (None, False)
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
