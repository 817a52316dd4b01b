"""Timestamps written as text, brought to integer nanoseconds without rounding through floating point."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.clouds.points import UNITS_NS

FARTHEST_NS = 9_200_000_000_000_000_000
"""Timestamps within plus or minus this fit into int64."""

_DATE = re.compile(
    r"(?P<date>\d{4}-\d\d-\d\d)[T _](?P<time>\d\d:\d\d:\d\d)(?:[.,](?P<fraction>\d+))?\s*(?P<zone>Z|z|[+-]\d\d:?\d\d)?"
)
_LONGEST = 60

PLACEHOLDERS: Mapping[str, str] = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
}
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
        raise TimestampError(
            f"{text!r} {unit or 'seconds'}; expected a time near ours{_unit_hint(number, unit, hint)}"
        )
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


def shifted(timestamps_ns: Int64Array, offset_ns: int, file: object, location: str) -> Int64Array:
    """Add an offset to timestamps.

    Raises:
        DataError: a sum is beyond the year 2261.
    """
    ends = (int(timestamps_ns.min()), int(timestamps_ns.max())) if len(timestamps_ns) else (0,)
    if max(abs(end + offset_ns) for end in ends) > FARTHEST_NS:
        raise DataError(file, location, f"times with {offset_ns / 1e9:g} s added are beyond the year 2261")
    return timestamps_ns + offset_ns


class NamePattern:
    """A pattern of file names with numbers in it: `{s}_{ns}`, `*__{us}`, `frame_{index}`.

    `*` stands for any text. Units that are named add up. The pattern has to fit the whole name, or the whole name
    without its endings.

    Attributes:
        indexed: whether the names hold an index instead of a time.
    """

    def __init__(self, pattern: str) -> None:
        """Compile the pattern.

        Raises:
            TimestampError: it names nothing, something unknown, or something twice.
        """
        self._text = pattern
        expression, names = "", []
        for part in re.split(r"(\{[^{}]*\}|\*)", pattern):
            if part == "*":
                expression += ".*?"
            elif part.startswith("{") and part.endswith("}"):
                names.append(part[1:-1])
                digits = r"\d+\.\d+|\d+" if part == "{s}" else r"\d+"
                expression += f"(?P<{part[1:-1]}>{digits})" if names[-1] in (*PLACEHOLDERS, "index") else ""
            else:
                expression += re.escape(part)
        known = ", ".join(f"{{{name}}}" for name in (*PLACEHOLDERS, "index"))
        unknown = [name for name in names if name not in (*PLACEHOLDERS, "index")]
        if unknown or not names or len(set(names)) != len(names) or ("index" in names and len(names) > 1):
            raise TimestampError(f"{pattern!r}; expected some of {known}, each once, {{index}} alone")
        self.indexed = names == ["index"]
        self._expression = re.compile(expression, re.ASCII)

    def read(self, name: str) -> int:
        """Read the time [ns], or the index, out of a file name.

        Raises:
            TimestampError: the name does not fit.
        """
        match = self._match(name)
        if match is None:
            raise TimestampError(f"{name!r} does not fit the pattern {self._text!r}")
        if self.indexed:
            return int(match["index"][:18])
        timestamp_ns = sum(
            parse_timestamp(text, PLACEHOLDERS[unit], hint="`{{{sign}}}`")
            for unit, text in match.groupdict().items()
        )
        if timestamp_ns > FARTHEST_NS:
            raise TimestampError(f"{name!r} gives a time beyond the year 2261 by the pattern {self._text!r}")
        return timestamp_ns

    def _match(self, name: str) -> "re.Match[str] | None":
        while name:
            match = self._expression.fullmatch(name)
            if match is not None or "." not in name:
                return match
            name = name.rpartition(".")[0]
        return None
