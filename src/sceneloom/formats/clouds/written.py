"""Points on their trajectory into a file, piece by piece, and the columns that every kind of file gives them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, UInt8Array, UInt16Array, check_array

NO_LABEL = 65535
"""In `labels`: nothing is stated for the point."""


@dataclass(frozen=True, slots=True, eq=False)
class WrittenPoints:
    """Some points of a cloud; all chunks of one file have the same columns.

    Attributes:
        positions_world: (N, 3) float64 [m].
        colors: (N, 3) uint8, red, green, blue, or None.
        intensities: (N,) uint8, or None.
        timestamps_ns: (N,) int64 [ns], or None.
        labels: (N,) uint16, number of a class, `NO_LABEL` for none; or None.
        extras: further columns, (N,) each, by name.
    """

    positions_world: Float64Array
    colors: UInt8Array | None = None
    intensities: UInt8Array | None = None
    timestamps_ns: Int64Array | None = None
    labels: UInt16Array | None = None
    extras: Mapping[str, AnyArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = check_array("positions_world", self.positions_world, (None, 3), np.float64)
        check_array("colors", self.colors, (count, 3), np.uint8, optional=True)
        check_array("intensities", self.intensities, (count,), np.uint8, optional=True)
        check_array("timestamps_ns", self.timestamps_ns, (count,), np.int64, optional=True)
        check_array("labels", self.labels, (count,), np.uint16, optional=True)

    def __len__(self) -> int:
        return len(self.positions_world)


class CloudWriter(Protocol):
    """An open file of points."""

    def add(self, points: WrittenPoints, /) -> None:
        """Write some more points."""
        ...

    def close(self) -> None:
        """Complete the file; its head says how many points there are."""
        ...


Column = tuple[str, str, Callable[[WrittenPoints], AnyArray | None]]
"""Name, dtype and values of a column; None where the points do not have it."""


def seconds(points: WrittenPoints) -> Float64Array | None:
    """Times of points [s]; a float64 holds those of today's epoch to a quarter of a microsecond."""
    return None if points.timestamps_ns is None else points.timestamps_ns.astype(np.float64) * 1e-9


def _color(channel: int) -> Callable[[WrittenPoints], AnyArray | None]:
    return lambda points: None if points.colors is None else points.colors[:, channel]


COLORS: tuple[Column, ...] = (
    ("red", "u1", _color(0)),
    ("green", "u1", _color(1)),
    ("blue", "u1", _color(2)),
)
MEASURED: tuple[Column, ...] = (
    ("intensity", "u1", lambda points: points.intensities),
    ("time", "f8", seconds),
    ("label", "u2", lambda points: points.labels),
)


def records_of(points: WrittenPoints, columns: tuple[Column, ...]) -> AnyArray:
    """Lay the columns that points have side by side, packed, little-endian; those of `extras` come last."""
    found = [(name, kind, values) for name, kind, take in columns if (values := take(points)) is not None]
    found += [(name, column.dtype.str[1:], column) for name, column in points.extras.items()]
    records = np.empty(len(points), [(name, f"<{kind}") for name, kind, _ in found])
    for name, _, values in found:
        records[name] = values
    return records
