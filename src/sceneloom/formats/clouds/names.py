"""Names of files that are times, or numbers, or neither."""

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from types import MappingProxyType

from sceneloom.formats.clouds.points import UNITS_NS

_NANOSECOND_DIGITS = 19
"""So many digits, zeros before them included, are nanoseconds whatever they state: all of an int64 in order."""

_NUMBER = re.compile(r"(?P<number>(?:^-)?\d+(?:\.\d+)?)$", re.ASCII)
_PAIR = re.compile(r"(?:^|\D)(?P<seconds>\d{9,10})[_.-](?P<nanoseconds>\d{9})$", re.ASCII)
_FIRST_S, _LAST_S = 631_152_000, 4_102_444_800
"""A number that lies between the years 1990 and 2100 in some unit is a time in that unit [s]."""

_FARTHEST_NS = 9_200_000_000_000_000_000

_SUFFIXES: Mapping[str, int] = MappingProxyType({".pcd.bin": 2})
"""Endings of several parts, and how many they have."""


def stem_of(name: str) -> str:
    """The name of a file without its ending."""
    parts = next((count for ending, count in _SUFFIXES.items() if name.lower().endswith(ending)), 1)
    for _ in range(parts):
        name = name.rpartition(".")[0] or name
    return name


def times_of_names(stems: Sequence[str]) -> list[int] | None:
    """Read the times [ns] that names end with; None where one of them does not, or they are plain numbers.

    A time is a number of 19 digits (nanoseconds), one with a point (seconds), seconds and nanoseconds with a sign
    between, or a whole number that lies between the years 1990 and 2100 in some unit, the same for all names.
    """
    pairs = [_PAIR.search(stem) for stem in stems]
    if stems and all(pairs):
        return [int(pair["seconds"]) * 10**9 + int(pair["nanoseconds"]) for pair in pairs if pair is not None]
    numbers = _trailing(stems)
    unit_ns = None if not numbers else _unit_ns(numbers)
    if numbers is None or unit_ns is None:
        return None
    times = [int((Decimal(number) * unit_ns).to_integral_value()) for number in numbers]
    return times if max(map(abs, times)) <= _FARTHEST_NS else None


def numbers_of_names(stems: Sequence[str]) -> list[int] | None:
    """Read the whole numbers that names end with; None where one has none, or two have the same."""
    found = _trailing(stems)
    if found is None or any("." in number or len(number) > 18 for number in found):
        return None
    numbers = [int(number) for number in found]
    return numbers if len(set(numbers)) == len(numbers) and min(numbers, default=0) >= 0 else None


def _trailing(stems: Sequence[str]) -> list[str] | None:
    found = [_NUMBER.search(stem) for stem in stems]
    return [match["number"] for match in found if match is not None] if all(found) else None


def _unit_ns(numbers: Sequence[str]) -> int | None:
    """Nanoseconds in the unit of some numbers; None where they are no times."""
    if any("." in number for number in numbers):
        return UNITS_NS["seconds"]
    if all(len(number.lstrip("-")) == _NANOSECOND_DIGITS for number in numbers):
        return 1
    values = [int(number) for number in numbers]
    for unit_ns in UNITS_NS.values():
        per_second = 10**9 // unit_ns
        if all(_FIRST_S <= value // per_second <= _LAST_S for value in values):
            return unit_ns
    return None


def name_of_time(timestamp_ns: int) -> str:
    """The name of a file of a time [ns], which is read back as that time."""
    return f"{timestamp_ns:020d}" if timestamp_ns < 0 else f"{timestamp_ns:019d}"
