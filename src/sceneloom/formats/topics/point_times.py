"""What the times of points mean, found from their type and range; no driver's word is needed for it."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.formats.clouds.points import UNITS_NS, PointTimes

_LONGEST_SWEEP_NS = 1_500_000_000
"""No lidar rotates more slowly."""

_SHORTEST_SWEEP_NS = 1_000_000
"""Times over less than this are not those of a sweep, but one time with noise."""

_USUAL_SWEEP_NS = 100_000_000

_ORDERS = {
    "f": ("seconds", "milliseconds", "microseconds", "nanoseconds"),
    "i": ("nanoseconds", "microseconds", "milliseconds", "seconds"),
    "u": ("nanoseconds", "microseconds", "milliseconds", "seconds"),
}
"""Units by kind of number, the likeliest first."""


@dataclass(frozen=True, slots=True)
class FoundTimes:
    """What the times of points mean, and where the first and last of a sweep lie from its timestamp [ns]."""

    meaning: PointTimes
    first_ns: int
    last_ns: int


def find_point_times(
    name: str, values: AnyArray, timestamp_ns: int, sweep_ns: int | None
) -> FoundTimes | None:
    """Find the unit and the zero of a column of times.

    They have to lie within one and a half seconds of the timestamp, over a millisecond or more. Of several readings,
    the one whose sweep lasts most nearly as long as it takes from timestamp to timestamp counts.

    Args:
        name: of the column.
        values: (N,) of the points with a return.
        timestamp_ns: of the message [ns].
        sweep_ns: from message to message [ns], where that is known.

    Returns:
        None where no unit fits.
    """
    if values.ndim != 1 or values.dtype.kind not in _ORDERS or len(values) < 2:
        return None
    exact = values.dtype.kind != "f"
    low, high = values.min(), values.max()
    if not exact and not (np.isfinite(low) and np.isfinite(high)):
        return None
    found: list[tuple[float, int, FoundTimes]] = []
    for order, unit in enumerate(_ORDERS[values.dtype.kind]):
        for rank, (reference, zero_ns) in enumerate((("timestamp", 0), ("clock", timestamp_ns))):
            first, last = (
                _nanoseconds(value, UNITS_NS[unit], exact=exact) - zero_ns for value in (low, high)
            )
            if max(abs(first), abs(last)) > _LONGEST_SWEEP_NS or last - first < _SHORTEST_SWEEP_NS:
                continue
            badness = abs(np.log((last - first) / (sweep_ns or _USUAL_SWEEP_NS)))
            found.append(
                (
                    round(float(badness), 1),
                    order * 2 + rank,
                    FoundTimes(PointTimes(unit, reference, name), first, last),
                )
            )
    return min(found, key=lambda row: row[:2])[2] if found else None


def _nanoseconds(value: AnyArray, unit_ns: int, *, exact: bool) -> int:
    return int(value) * unit_ns if exact else round(float(value) * unit_ns)
