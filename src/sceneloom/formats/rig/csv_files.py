"""Text files with columns: CSV with commas, semicolons, tabs or blanks, and the names of columns in the first line."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.files import read_bytes
from sceneloom.formats.rig.timestamps import TimestampError, parse_timestamp

FILE_COLUMNS = ("file", "filename", "file_name", "path", "image", "image_name", "pcd", "cloud", "name")
_UNIT_ENDINGS = {"_ns": "nanoseconds", "_us": "microseconds", "_ms": "milliseconds", "_s": "seconds"}
_SECONDS = ("seconds", "secs", "sec", "stamp_sec", "stamp_secs")
TIME_COLUMNS = (
    *(
        f"{name}{ending}"
        for name in ("timestamp", "time", "t", "timestamp")
        for ending in ("", *_UNIT_ENDINGS)
    ),
    *(*_SECONDS, "nanoseconds", "utc"),
)
"""Names by which columns are known."""

_PARTS_OF_SECONDS = (
    *("nanoseconds", "nanosecs", "nanosec", "nsecs", "nsec"),
    *("stamp_nanosec", "stamp_nanosecs", "stamp_nsec", "stamp_nsecs"),
)
"""Columns that stand beside one of whole seconds, as messages of ROS have them, and go on from it."""

_DELIMITERS = (",", ";", "\t")


@dataclass(frozen=True, slots=True)
class Table:
    """The rows of a file as texts.

    Attributes:
        path: the file.
        names: of the columns, as in the file; empty where it has no first line of names.
        rows: the values.
        lines: number of each row's line.
    """

    path: Path
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    def find(self, wanted: Sequence[str]) -> int | None:
        """The first column that has one of some names, whatever the case."""
        lower = [name.lower() for name in self.names]
        return next((lower.index(name) for name in wanted if name in lower), None)

    def column(self, name: str) -> int:
        """The column of a name.

        Raises:
            DataError: there is none.
        """
        if name in self.names:
            return self.names.index(name)
        close = get_close_matches(name, self.names, 1, 0.5)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise DataError(self.path, "line 1", f"no column {name!r}; it has {', '.join(self.names)}{hint}")

    def timestamps(self, column: int, unit: str | None) -> Int64Array:
        """The times of a column, (N,) int64 [ns]; without a unit the ending of the column's name reports it.

        To a column of whole seconds that of the nanoseconds is added, where there is one.

        Raises:
            DataError: a value is no time.
        """
        name = self.names[column].lower() if self.names else ""
        ending = next((u for end, u in _UNIT_ENDINGS.items() if name.endswith(end)), None)
        ending = "nanoseconds" if name == "nanoseconds" else ending
        timestamps = np.empty(len(self.rows), np.int64)
        for k, row in enumerate(self.rows):
            try:
                timestamps[k] = parse_timestamp(row[column], unit or ending)
            except TimestampError as error:
                raise DataError(self.path, f"line {self.lines[k]}", str(error)) from None
        parts = self.find(_PARTS_OF_SECONDS) if name in _SECONDS and unit in {None, "seconds"} else None
        return timestamps if parts is None else timestamps + self._nanoseconds(parts, timestamps)

    def _nanoseconds(self, column: int, seconds_ns: Int64Array) -> Int64Array:
        """The column that goes on from one of whole seconds, (N,) int64 [ns]."""
        for k, row in enumerate(self.rows):
            text, location = row[column], f"line {self.lines[k]}"
            if not (text.isascii() and text.isdigit() and len(text) <= 9):
                problem = f"{self.names[column]}: {text[:40]!r}; expected a whole number from 0 to 999999999"
                raise DataError(self.path, location, problem)
            if seconds_ns[k] % 1_000_000_000:
                problem = f"{seconds_ns[k] / 1e9:.9f} s beside a column {self.names[column]}; expected whole seconds"
                raise DataError(self.path, location, problem)
        return np.array([int(row[column]) for row in self.rows], np.int64)

    def numbers(self, columns: Sequence[int]) -> Float64Array:
        """Some columns as (N, len(columns)) float64.

        Raises:
            DataError: a value is no finite number.
        """
        values = np.empty((len(self.rows), len(columns)))
        for j, column in enumerate(columns):
            try:
                values[:, j] = [float(row[column]) for row in self.rows]
            except ValueError:
                values[:, j] = [_number(row[column]) for row in self.rows]
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            k, column = int(wrong[0][0]), columns[int(wrong[0][1])]
            name = self.names[column] if self.names else f"column {column + 1}"
            problem = f"{name}: {self.rows[k][column][:40]!r}; expected a finite number"
            raise DataError(self.path, f"line {self.lines[k]}", problem)
        return values


def read_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file that are neither blank nor a comment, each with its number.

    Raises:
        DataError: the file cannot be read or is no text.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text") from error
    lines = enumerate(text.replace("\r\n", "\n").split("\n"), 1)
    return [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]


def read_table(path: Path, *, named: bool = True) -> Table:
    """Read a file with columns.

    Args:
        named: whether the first line holds the names of the columns; it may then begin with `#`.

    Raises:
        DataError: the file cannot be read, is empty, or its lines differ in length.
    """
    lines = read_lines(path)
    if named:
        lines = _with_commented_names(path, lines)
    if not lines:
        raise DataError(path, "", "is empty; expected a line of names and lines of values")
    delimiter = next((sign for sign in _DELIMITERS if sign in lines[0][1]), None)
    rows = [_cells(line, delimiter) for _, line in lines]
    for (number, _), row in zip(lines, rows, strict=True):
        if len(row) != len(rows[0]):
            raise DataError(path, f"line {number}", f"{len(row)} values; expected {len(rows[0])}")
    names = rows.pop(0) if named else ()
    numbers = [number for number, _ in lines][len(lines) - len(rows) :]
    return Table(path, names, tuple(rows), tuple(numbers))


def _with_commented_names(path: Path, lines: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Take the comment right above the first values for the names of the columns, if those begin with a number."""
    if not lines or _is_number(lines[0][1].replace(",", " ").replace(";", " ").split()[:1]) is False:
        return lines
    above = read_bytes(path).decode("utf-8-sig").replace("\r\n", "\n").split("\n")[: lines[0][0] - 1]
    comments = [line.lstrip("# \t") for line in above if line.strip()]
    if not comments:
        raise DataError(path, "line 1", f"{lines[0][1][:60]!r}; expected the names of the columns")
    return [(lines[0][0] - 1, comments[-1]), *lines]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _is_number(words: list[str]) -> bool:
    try:
        float(words[0])
    except (ValueError, IndexError):
        return False
    return True


def _cells(line: str, delimiter: str | None) -> tuple[str, ...]:
    if delimiter is None:
        return tuple(line.split())
    if '"' not in line:
        # nearly all lines: long records of an IMU are read in half the time
        return tuple(map(str.strip, line.split(delimiter)))
    try:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except (csv.Error, StopIteration):
        cells = line.split(delimiter)
    return tuple(cell.strip() for cell in cells)


def pick_columns(
    table: Table, wanted: Mapping[str, Sequence[str]], named: Mapping[str, str], location: str, manifest: Path
) -> dict[str, int]:
    """Find the columns of a table by what they are.

    Args:
        wanted: known names by what a column is.
        named: names that the manifest says, by what a column is.
        location: of `columns` in the manifest, for messages.

    Raises:
        DataError: the manifest names something else, or a column that the file does not have.
    """
    for role in named:
        if role not in wanted:
            close = get_close_matches(role, wanted, 1, 0.5)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise DataError(
                manifest, f"{location}.{role}", f"unknown; expected some of {', '.join(wanted)}{hint}"
            )
    columns = {role: table.column(name) for role, name in named.items()}
    for role, names in wanted.items():
        found = table.find(names)
        if role not in columns and found is not None:
            columns[role] = found
    return columns
