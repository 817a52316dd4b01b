"""The unit of time stamps, told by how often a sensor can measure and in which years it can have done so."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

UNITS_NS: Mapping[str, int] = MappingProxyType(
    {"seconds": 1_000_000_000, "milliseconds": 1_000_000, "microseconds": 1_000, "nanoseconds": 1}
)
"""Units of time [ns]."""

RATES_HZ: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "lidar": (1.0, 100.0),
        "camera": (0.5, 500.0),
        "radar": (1.0, 200.0),
        "imu": (10.0, 8000.0),
        "gnss": (0.1, 100.0),
    }
)
"""How often sensors of a kind measure. The two bounds of a kind lie less than 1,000 apart, but for slow cameras and
IMUs at their limits, so that of units a thousand apart mostly one fits."""

_YEARS_S = (315_532_800.0, 4_102_444_800.0)
"""From 1980, when the time of satellites begins, to 2100, in seconds after 1970."""

_LEAST_EPOCH_S = 1e8
"""Larger numbers of seconds than this count from an epoch: no drive lasts three years."""


def time_units(stamps: Sequence[float], kind: str) -> tuple[str, ...]:
    """List the units in which time stamps of a sensor make sense; several where they leave it open.

    Args:
        stamps: of successive measurements, in any order, in an unknown unit.
        kind: a key of `RATES_HZ`.

    Returns:
        Names out of `UNITS_NS`; none where no unit fits, or fewer than two stamps differ.
    """
    times = np.unique(np.asarray(stamps, np.float64))
    times = times[np.isfinite(times)]
    if len(times) < 2:
        return ()
    step = float(np.median(np.diff(times)))
    slowest, fastest = RATES_HZ[kind]
    found = [
        unit
        for unit, unit_ns in UNITS_NS.items()
        if slowest <= 1e9 / (step * unit_ns) <= fastest and _is_a_date(float(times[0]) * unit_ns * 1e-9)
    ]
    return tuple(found)


def _is_a_date(seconds: float) -> bool:
    """Say whether a time is one of our age, or too small to count from an epoch at all."""
    return abs(seconds) < _LEAST_EPOCH_S or _YEARS_S[0] <= seconds <= _YEARS_S[1]
