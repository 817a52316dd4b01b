"""How an offset goes on over a long drive."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from sceneloom.arrays import Float64Array


@dataclass(frozen=True, slots=True)
class Line:
    """An offset [s] in the middle, and how much it grows in a second."""

    offset: float
    slope: float


STEEPEST = 1e-3
"""No clock is off by more; steeper lines go through wrong lags."""


def robust_line(times: Float64Array, offsets: Float64Array) -> Line:
    """Lay a line through offsets (N,) [s] at times (N,) [s], of which nearly half may be wrong.

    Source: Siegel 1982, "Robust Regression Using Repeated Medians"; of its slopes those of clocks count.
    """
    slopes = [
        (offsets[j] - offsets[i]) / (times[j] - times[i])
        for i, j in combinations(range(len(times)), 2)
        if abs(offsets[j] - offsets[i]) <= STEEPEST * abs(times[j] - times[i]) + 1e-12
    ]
    slope = float(np.median(slopes)) if slopes else 0.0
    levels = offsets - slope * times
    return Line(float(_densest(levels)), slope)


def _densest(values: Float64Array) -> float:
    """The median of the half that lies closest together. Source: Rousseeuw 1984, least median of squares."""
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    begin = int(np.argmin(widths))
    return float(np.median(ordered[begin : begin + half]))
