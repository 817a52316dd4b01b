"""A file of points as it is: named columns, whatever they mean."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError

MOST_POINTS = 1 << 28
"""Files that claim more points are refused: a damaged head can claim any number."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The points of one file, column by column.

    Attributes:
        file: where they come from, for messages.
        count: number of points N.
        columns: (N,) or (N, K) arrays by the file's own names, of the file's own dtypes in native byte order.
        head: what else the file says, by the words of its kind.
    """

    file: Path
    count: int
    columns: Mapping[str, AnyArray]
    head: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


def columns_of(records: AnyArray) -> dict[str, AnyArray]:
    """Take a structured array apart into columns of native byte order; fields named `_` are padding."""
    names = records.dtype.names or ()
    return {
        name: np.ascontiguousarray(column, column.dtype.newbyteorder("="))
        for name in names
        if not name.startswith("_") and (column := records[name]).dtype.names is None
    }


def unique_names(names: list[str]) -> list[str]:
    """Give repeated names a number, since a structured array has no two fields of one name; `_` stays padding."""
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 else f"{name}~{seen[name]}")
    return unique


def check_count(path: Path, location: str, count: int) -> None:
    """Refuse a number of points that no sweep has.

    Raises:
        DataError: it is negative or larger than `MOST_POINTS`.
    """
    if not 0 <= count <= MOST_POINTS:
        raise DataError(path, location, f"{count} points; expected 0 to {MOST_POINTS}")


def check_end(path: Path, left: bytes, location: int, reported: str) -> None:
    """Refuse bytes behind the last point that a head declares: they may be points that it does not count.

    Args:
        path: for messages.
        left: what stands behind the last point; zeros and blanks fill files up, and are no points.
        location: where they begin [byte].
        reported: the points that the head declares.

    Raises:
        DataError: there is anything else.
    """
    if left.strip(b"\0\t\r\n "):
        problem = (
            f"{len(left)} bytes behind the last of {reported}; expected none: is the count of the head wrong?"
        )
        raise DataError(path, f"byte {location}", problem)
