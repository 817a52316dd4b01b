"""Tables of text: CSV and other columns, timestamps read as integer nanoseconds.

And times and numbers written as the shortest exact decimals.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from math import isfinite
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.files import read_bytes

UNITS_NS: Mapping[str, int] = MappingProxyType(
    {"seconds": 1_000_000_000, "milliseconds": 1_000_000, "microseconds": 1_000, "nanoseconds": 1}
)
"""Nanoseconds in each unit of time."""

FARTHEST_NS = 9_200_000_000_000_000_000
"""Timestamps within plus or minus this fit into int64."""

_DATE = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T _](?P<time>\d\d:\d\d:\d\d)(?:[.,](?P<fraction>\d+))?\s*(?P<zone>Z|z|[+-]\d\d:?\d\d)?"
)

_LONGEST = 60

PLACEHOLDERS: Mapping[str, str] = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
"""What may stand between braces in a pattern of names, and its unit."""


class TimestampError(ValueError):
    """A text is no timestamp."""


def parse_timestamp(text: str, unit: str | None, *, hint: str = '`unit = "{unit}"`') -> int:
    """Read a timestamp, a number of some unit or a date with a time of day, in nanoseconds.

    Args:
        text: as in a file.
        unit: of a number; None: seconds. Dates have none; without a zone they are taken as UTC.
        hint: how one says the unit that would fit, with `{unit}` or `{sign}` in it.

    Raises:
        TimestampError: it is neither, or beyond the year 2261.
    """
    text = text.strip().strip('"').strip()
    match = _DATE.fullmatch(text)
    if match:
        return _of_date(match)
    try:
        number = Decimal(text) if len(text) <= _LONGEST and "_" not in text else Decimal("nan")
    except InvalidOperation:
        number = Decimal("nan")
    if not number.is_finite() or number.adjusted() > 30:
        raise TimestampError(f"{text[:40]!r}; expected a number, or a date as 2011-09-26 13:02:25.594")
    timestamp_ns = int((number * UNITS_NS[unit or "seconds"]).to_integral_value())
    if abs(timestamp_ns) > FARTHEST_NS:
        raise TimestampError(f"{text!r} {unit or 'seconds'}; expected a time near ours{_unit_hint(number, unit, hint)}")
    return timestamp_ns


def _unit_hint(number: Decimal, unit: str | None, hint: str) -> str:
    fits = [name for name, ns in UNITS_NS.items() if name != unit and abs(number) * ns <= FARTHEST_NS]
    likely = [name for name in fits if abs(number) * UNITS_NS[name] > Decimal(10) ** 17]
    if not fits:
        return ""
    fit = (likely or fits)[0]
    sign = next(sign for sign, name in PLACEHOLDERS.items() if name == fit)
    return f"; is {hint.format(unit=fit, sign=sign)} meant?"


def _of_date(match: "re.Match[str]") -> int:
    zone = (match["zone"] or "Z").upper().replace("Z", "+00:00")
    try:
        moment = datetime.fromisoformat(f"{match['date']}T{match['time']}{zone}")
    except ValueError as error:
        raise TimestampError(f"{match[0]!r}: {error}") from None
    seconds = moment - datetime(1970, 1, 1, tzinfo=UTC)
    fraction = Decimal(f"0.{match['fraction'] or 0}") * 10**9
    timestamp_ns = (seconds.days * 86_400 + seconds.seconds) * 10**9 + int(fraction.to_integral_value())
    if abs(timestamp_ns) > FARTHEST_NS:
        raise TimestampError(f"{match[0]!r}; expected a date before 2261")
    return timestamp_ns


FILE_COLUMNS = ("file", "filename", "file_name", "path", "image", "image_name", "pcd", "cloud", "name")
_UNIT_ENDINGS = {"_ns": "nanoseconds", "_us": "microseconds", "_ms": "milliseconds", "_s": "seconds"}
_SECONDS = ("seconds", "secs", "sec", "stamp_sec", "stamp_secs")

TIME_COLUMNS = (
    *(f"{name}{ending}" for name in ("timestamp", "time", "t", "timestamp") for ending in ("", *_UNIT_ENDINGS)),
    *(*_SECONDS, "nanoseconds", "utc"),
)
"""Names by which columns are known."""

POSE_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "x": ("x", "tx", "px", "pos_x", "position_x", "p_x", "x_m"),
    "y": ("y", "ty", "py", "pos_y", "position_y", "p_y", "y_m"),
    "z": ("z", "tz", "pz", "pos_z", "position_z", "p_z", "z_m"),
    "qx": ("qx", "q_x", "orientation_x", "quat_x", "rot_x"),
    "qy": ("qy", "q_y", "orientation_y", "quat_y", "rot_y"),
    "qz": ("qz", "q_z", "orientation_z", "quat_z", "rot_z"),
    "qw": ("qw", "q_w", "orientation_w", "quat_w", "rot_w"),
}
"""The columns of a CSV file by what they are."""

GNSS_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "latitude": ("latitude", "lat", "latitude_deg"),
    "longitude": ("longitude", "lon", "lng", "long", "longitude_deg"),
    "altitude": ("altitude", "alt", "height", "altitude_m", "ellipsoidal_height"),
    "accuracy": ("accuracy", "horizontal_accuracy", "hacc", "accuracy_m"),
    "vertical_accuracy": ("vertical_accuracy", "vacc", "vertical_accuracy_m"),
}

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
            raise DataError(manifest, f"{location}.{role}", f"unknown; expected some of {', '.join(wanted)}{hint}")
    columns = {role: table.column(name) for role, name in named.items()}
    for role, names in wanted.items():
        found = table.find(names)
        if role not in columns and found is not None:
            columns[role] = found
    return columns


_SECOND_NS = 1_000_000_000

_EXACT_BELOW_NS = 2**53  # below this, a 64-bit number holds every nanosecond, and dividing it rounds once

_SHORT_FROM_NS, _SHORT_BELOW_NS = 10**6, 10**15
"""Between these, a time has 15 digits at most: the shortest text that means its number is the time itself, with no
exponent."""

_encode = msgspec.json.Encoder().encode


def exact_seconds(timestamps_ns: Int64Array) -> Float64Array:
    """Give the 64-bit numbers that are nearest to times, (N,) float64 [s].

    Of times beyond 104 days the part below a second is divided alone: that is off by 2^-54 at most, while a decimal of
    nine digits keeps at least 2^-51 from every value halfway between two numbers there, or is one.
    """
    whole, rest = np.divmod(timestamps_ns, _SECOND_NS)
    small = np.abs(timestamps_ns) < _EXACT_BELOW_NS
    seconds: Float64Array = np.where(small, timestamps_ns / 1e9, whole + rest / 1e9)
    return seconds


def _holds_time(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> BoolArray:
    """Report which numbers of a file still mean their times, (N,) bool."""
    if file_seconds is None:
        return np.zeros(len(timestamps_ns), np.bool_)
    within = np.abs(file_seconds) < 9.2e9
    found = nanoseconds(np.where(within, file_seconds, 0.0)) == timestamps_ns
    return np.asarray(within & found, np.bool_)


def written_seconds(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> Float64Array:
    """Give the numbers that readers make of written times, (N,) float64 [s]."""
    seconds = exact_seconds(timestamps_ns)
    if file_seconds is None:
        return seconds
    return np.where(_holds_time(timestamps_ns, file_seconds), file_seconds, seconds)


def seconds_texts(timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> list[str]:
    """Write times as seconds: the file's own numbers where they still mean the time, else its exact decimals.

    Args:
        timestamps_ns: (N,) int64 [ns].
        file_seconds: (N,) float64 [s], or None.
    """
    size = np.abs(timestamps_ns)
    short = (size >= _SHORT_FROM_NS) & (size < _SHORT_BELOW_NS)
    short |= _holds_time(timestamps_ns, file_seconds)
    if short.all():
        return _number_texts(written_seconds(timestamps_ns, file_seconds))
    texts = _decimal_texts(timestamps_ns)
    if short.any():
        numbers = _number_texts(written_seconds(timestamps_ns, file_seconds)[short])
        for k, text in zip(np.flatnonzero(short).tolist(), numbers, strict=True):
            texts[k] = text
    return texts


def _decimal_texts(timestamps_ns: Int64Array) -> list[str]:
    """Write times as exact decimals: their nanoseconds with a point before the last nine digits."""
    texts = _encode(timestamps_ns.tolist()).decode()[1:-1].split(",")
    decimals = [f"{text[:-9]}.{text[-9:]}".rstrip("0") for text in texts]
    odd = (np.abs(timestamps_ns) < _SECOND_NS) | (timestamps_ns % _SECOND_NS == 0)
    for k in np.flatnonzero(odd).tolist():
        decimals[k] = _decimal_text(int(timestamps_ns[k]))
    return decimals


def _decimal_text(timestamp_ns: int) -> str:
    """Write a time as the shortest decimal that means exactly this time."""
    whole, rest = divmod(abs(timestamp_ns), _SECOND_NS)
    sign = "-" if timestamp_ns < 0 else ""
    return f"{sign}{whole}.{rest:09d}".rstrip("0") if rest else f"{sign}{whole}.0"


def _number_texts(numbers: Float64Array) -> list[str]:
    """Write finite numbers, (N,) float64, each as the shortest text that is read as it."""
    return _encode(numbers.tolist()).decode()[1:-1].split(",") if len(numbers) else []


def seconds_text(timestamp_ns: int, file_seconds: float | None = None) -> str:
    """Write a time as seconds.

    Args:
        timestamp_ns: the time [ns].
        file_seconds: the number that the time was read from, written back where it still means the same time.

    Returns:
        The shortest decimal that means exactly this time.
    """
    if file_seconds is not None and means(file_seconds, timestamp_ns):
        return repr(float(file_seconds))
    return _decimal_text(timestamp_ns)


def means(seconds: float, timestamp_ns: int) -> bool:
    """Whether a number of seconds is read as this time."""
    return isfinite(seconds) and round(seconds * 1e9) == timestamp_ns


class TimeWriter:
    """Writes times and notes which of them a 64-bit number of seconds cannot hold.

    Attributes:
        inexact: how many times are read back as another nanosecond.
        worst_ns: by how much at most [ns].
    """

    def __init__(self) -> None:
        """Begin with no time written."""
        self.inexact = 0
        self.worst_ns = 0

    def text(self, timestamp_ns: int, file_seconds: float | None = None) -> str:
        """Write a time as `seconds_text` does."""
        text = seconds_text(timestamp_ns, file_seconds)
        error = abs(round(float(text) * 1e9) - timestamp_ns)
        if error:
            self.inexact += 1
            self.worst_ns = max(self.worst_ns, error)
        return text

    def texts(self, timestamps_ns: Int64Array, file_seconds: Float64Array | None) -> list[str]:
        """Write many times, (N,) int64 [ns], with the numbers that they were read from, (N,) float64 [s]."""
        errors = np.abs(nanoseconds(written_seconds(timestamps_ns, file_seconds)) - timestamps_ns)
        self.inexact += int(np.count_nonzero(errors))
        self.worst_ns = max(self.worst_ns, int(errors.max(initial=0)))
        return seconds_texts(timestamps_ns, file_seconds)

    def raw(self, timestamp_ns: int, file_seconds: float | None = None) -> msgspec.Raw:
        """The same, ready to be put into JSON."""
        return msgspec.Raw(self.text(timestamp_ns, file_seconds).encode())


def nanoseconds(seconds: Float64Array) -> Int64Array:
    """Bring seconds to the scene's clock: round(t · 1e9), halves to even, cut to 64 bits."""
    scaled = seconds * 1e9
    np.rint(scaled, out=scaled)
    return np.clip(scaled, -(2.0**63), 2.0**63 - 1024, out=scaled).astype(np.int64)


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
