"""How a lidar's scan lines lie in a camera's view, and how far occlusion must reach to bridge them."""

from dataclasses import dataclass
from functools import lru_cache
from math import cos, pi, radians, sin

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.spacing import find_neighbours

_CELL = radians(0.1)
_REACH_CELLS = 25
_SAMPLES = 256
_SECTORS = 8

_WINDOW_PER_SPACING = 1.15
_NEAR_PER_SPACING_ACROSS, _NEAR_PER_SPACING_ALONG = 0.9, 1.2
_WINDOWS_DEG, _NEARS_DEG = (0.3, 2.5), (0.1, 2.0)
_USUAL_WINDOW_DEG, _USUAL_NEAR_DEG = 0.5, 0.16


@dataclass(frozen=True, slots=True)
class Reach:
    """How far occlusion reaches in the equal-area map of directions.

    Attributes:
        window: for two things on opposite sides [rad].
        across, along: for one thing alone, across the scan lines and along them [rad].
        angle: of the axis across the scan lines, from rightward to downward.
    """

    window: float
    across: float
    along: float
    angle: float = 0.0

    @property
    def ellipse(self) -> tuple[float, float, float]:
        """p, q, r of p x² + q x y + r y² <= 1, the directions in which one thing alone hides [1/rad²]."""
        c, s, p, r = cos(self.angle), sin(self.angle), self.across**-2, self.along**-2
        return p * c * c + r * s * s, 2 * (p - r) * c * s, p * s * s + r * c * c


def measure_spacings(directions: Float32Array, inverse_ranges: Float32Array) -> Float64Array:
    """Measure how far apart the points of a cloud appear along four axes.

    Around some points the nearest neighbour in each of eight sectors is looked for; opposite sectors make an axis.

    Args:
        directions: (2, M) float32 in the equal-area map [rad].
        inverse_ranges: (M,) float32 [1/m]; 0 for a point that takes no part.

    Returns:
        (4,) float64 [rad], mean of the middle half of the distances along the axes at 0, 45, 90 and 135 degrees from
        rightward to downward, 0.1 to 2.5 degrees; NaN where fewer than half of the neighbours are so near.
    """
    found = np.empty((_SAMPLES, _SECTORS))
    find_neighbours(directions, inverse_ranges, _CELL, *_disc(), found)
    axes = np.concatenate([found[:, : _SECTORS // 2], found[:, _SECTORS // 2 :]])
    return np.array([_mean_of_middle(steps[~np.isnan(steps)]) for steps in axes.T])


def fit_reach(spacings: Float64Array) -> Reach:
    """Fit the reach to spacings along the four axes: of the two upright pairs of axes, the one that differs more."""
    ratios = np.abs(np.log(spacings[:2] / spacings[2:]))
    if np.isnan(ratios).all():
        return Reach(radians(_USUAL_WINDOW_DEG), radians(_USUAL_NEAR_DEG), radians(_USUAL_NEAR_DEG))
    pair = int(np.nanargmax(ratios))
    axis = pair if spacings[pair] > spacings[pair + 2] else pair + 2
    across, along = np.degrees([spacings[axis], spacings[(axis + 2) % 4]])
    return Reach(
        radians(np.clip(_WINDOW_PER_SPACING * across, *_WINDOWS_DEG)),
        radians(np.clip(_NEAR_PER_SPACING_ACROSS * across, *_NEARS_DEG)),
        radians(np.clip(_NEAR_PER_SPACING_ALONG * along, *_NEARS_DEG)),
        axis * pi / 4,
    )


@lru_cache(maxsize=1)
def _disc() -> tuple[Int64Array, Int64Array, Int64Array, Float64Array]:
    """Give columns, rows, sectors and distances [rad] of the cells around one, nearest first."""
    down, right = np.mgrid[-_REACH_CELLS : _REACH_CELLS + 1, -_REACH_CELLS : _REACH_CELLS + 1].reshape(2, -1)
    distances = np.hypot(right, down)
    order = np.argsort(distances, kind="stable")
    order = order[(distances[order] > 0) & (distances[order] <= _REACH_CELLS)]
    sectors = np.floor(np.arctan2(down, right) * _SECTORS / (2 * pi) + 0.5).astype(np.int64) % _SECTORS
    return right[order], down[order], sectors[order], distances[order] * _CELL


def _mean_of_middle(steps: Float64Array) -> float:
    """Average the middle half: robust as the median, but not bound to whole cells. NaN for too few."""
    if len(steps) < _SAMPLES:
        return np.nan
    ordered = np.sort(steps)
    return float(ordered[len(steps) // 4 : len(steps) - len(steps) // 4].mean())
