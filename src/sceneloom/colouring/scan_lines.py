"""How a lidar's scan lines lie in a camera's view, and how far occlusion must reach to bridge them."""

from dataclasses import dataclass
from functools import lru_cache
from math import cos, degrees, isnan, log, pi, radians, sin

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array
from sceneloom.kernels.direction_grid import measure_extent
from sceneloom.kernels.spacing import find_neighbours, find_slopes, measure_along_axes
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

_CELL = radians(0.1)
_REACH_CELLS = 25
SPARSEST = _CELL * _REACH_CELLS
"""Neighbours farther away are not found [rad]."""
_SAMPLES = 256
_SECTORS = 8

_WINDOW_PER_SPACING = 1.15
_NEAR_PER_SPACING_ACROSS, _NEAR_PER_SPACING_ALONG, _OUTLINE_DEG = 0.95, 1.3, 0.08
_WINDOWS_DEG, _NEARS_DEG = (0.3, 3.0), (0.1, 2.4)
_USUAL_WINDOW_DEG, _USUAL_NEAR_DEG = 0.5, 0.16

CELLS_PER_REACH = 6
"""How fine the grid is in which points are compared."""

USUAL_SURFACE_DISTANCE = 0.5
"""Where nothing was measured [m]: below the height of nearly all cameras."""
_SURFACE_DISTANCES = (0.1, 1.5)
_OF_SURFACE_DISTANCE, _STEEPER_THAN, _FEWEST_SURFACES = 0.8, 0.95, 32


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


@dataclass(frozen=True, slots=True)
class ScanLines:
    """How the scan lines of a lidar lie in a view.

    Attributes:
        across: from line to line [rad].
        along: from point to point on a line [rad].
        angle: of the axis across the lines, from rightward to downward.
    """

    across: float
    along: float
    angle: float

    @property
    def reach(self) -> "Reach":
        """How far occlusion must reach to bridge them."""
        across, along = degrees(self.across), degrees(self.along)
        window = _bounded(_WINDOW_PER_SPACING * across, *_WINDOWS_DEG)
        # Of the points of a cell only the nearest counts, so that what is near reaches a cell at least.
        least = max(_NEARS_DEG[0], window / CELLS_PER_REACH)
        return Reach(
            radians(window),
            radians(_bounded(_NEAR_PER_SPACING_ACROSS * across - _OUTLINE_DEG, *_NEARS_DEG)),
            radians(_bounded(_NEAR_PER_SPACING_ALONG * along - _OUTLINE_DEG, least, _NEARS_DEG[1])),
            self.angle,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """The next point in each of eight sectors around some points of a cloud; opposite sectors make an axis.

    Attributes:
        points: (S,) int64, the points that were looked around.
        ids: (S, 8) int64, a point in the nearest occupied cell of each sector; -1 for none within reach.
        distances: (S, 8) float64 [rad], how far that cell is; NaN for none.
    """

    points: Int64Array
    ids: Int64Array
    distances: Float64Array


def look_around(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    *,
    extent: Float32Array | None = None,
    samples: int = _SAMPLES,
    thread_pool: ThreadPool = ALONE,
) -> Neighbours:
    """Find the neighbours of some points, evenly drawn from a cloud.

    Args:
        directions: (2, M) float32 in the equal-area map [rad].
        inverse_ranges: (M,) float32 [1/m]; 0 for a point that takes no part.
        extent: (4,) of the cloud, where it is known what `measure_extent` gives.
        samples: how many points; of fewer each one.
        thread_pool: the threads that share the cloud.
    """
    if extent is None:
        extent = measure_extent(directions, inverse_ranges, thread_pool=thread_pool)
    distances, ids = np.empty((samples, _SECTORS)), np.empty((samples, _SECTORS), np.int64)
    find_neighbours(
        directions, inverse_ranges, extent, _CELL, *_disc(), distances, ids, thread_pool=thread_pool
    )
    drawn = min(samples, len(inverse_ranges))
    points = np.arange(drawn) * len(inverse_ranges) // max(drawn, 1)
    return Neighbours(points, ids[:drawn], distances[:drawn])


def measure_spacings(neighbours: Neighbours) -> Float64Array:
    """Measure how far apart the points of a cloud appear along four axes.

    Returns:
        (4,) float64 [rad], mean of the middle half of the distances along the axes at 0, 45, 90 and 135 degrees from
        rightward to downward, 0.1 to 2.5 degrees; NaN where fewer than half of the neighbours are so near.
    """
    spacings = np.empty(_SECTORS // 2)
    measure_along_axes(neighbours.distances, _CELL, _REACH_CELLS, _SAMPLES, spacings)
    return spacings


def measure_surface_distance(
    neighbours: Neighbours,
    directions: Float32Array,
    inverse_ranges: Float32Array,
    margin: float,
    margin_share: float,
) -> float:
    """Measure how near the planes of the surfaces in a cloud pass the camera: mostly the height above the ground.

    The inverse range changes along a plane by at most one over that distance for each radian. It is taken where a point
    lies on one line with its neighbours on both sides, so that the three are of one surface.

    Args:
        neighbours: of some points.
        directions: (2, M) float32 in the equal-area map [rad].
        inverse_ranges: (M,) float32 [1/m].
        margin: how far from the line a point may lie [m] …
        margin_share: … plus this share of its range.

    Returns:
        Four fifths of the distance that 95 % of the surfaces keep, 0.1 to 1.5 m; 0.5 where too few were found.
    """
    slopes = np.empty(len(neighbours.points))
    find_slopes(
        directions,
        inverse_ranges,
        neighbours.points,
        neighbours.ids,
        _CELL * 1e-3,
        margin,
        margin_share,
        slopes,
    )
    slopes.sort()
    known = int(slopes.searchsorted(np.inf))
    if known < _FEWEST_SURFACES:
        return USUAL_SURFACE_DISTANCE
    steepest = max(float(slopes[int(_STEEPER_THAN * known)]), 1e-3)
    return _bounded(_OF_SURFACE_DISTANCE / steepest, *_SURFACE_DISTANCES)


def find_lines(spacings: Float64Array) -> ScanLines | None:
    """Report the lines from spacings along the four axes: of the two upright pairs of axes.

    The one that differs more.
    """
    along_axes = spacings.tolist()
    ratios = {pair: abs(log(along_axes[pair] / along_axes[pair + 2])) for pair in range(2)}
    reported = [pair for pair, ratio in ratios.items() if not isnan(ratio)]
    if not reported:
        return None
    pair = max(reported, key=ratios.__getitem__)
    axis = pair if along_axes[pair] > along_axes[pair + 2] else pair + 2
    return ScanLines(along_axes[axis], along_axes[(axis + 2) % 4], axis * pi / 4)


def fit_reach(lines: ScanLines | None) -> Reach:
    """Fit the reach to scan lines; a usual one where there are none."""
    if lines is None:
        return Reach(radians(_USUAL_WINDOW_DEG), radians(_USUAL_NEAR_DEG), radians(_USUAL_NEAR_DEG))
    return lines.reach


def _bounded(value: float, least: float, most: float) -> float:
    return min(max(value, least), most)


@lru_cache(maxsize=1)
def _disc() -> tuple[Int64Array, Int64Array, Int64Array, Float64Array]:
    """Give columns, rows, sectors and distances [rad] of the cells around one, nearest first."""
    down, right = np.mgrid[-_REACH_CELLS : _REACH_CELLS + 1, -_REACH_CELLS : _REACH_CELLS + 1].reshape(2, -1)
    distances = np.hypot(right, down)
    order = np.argsort(distances, kind="stable")
    order = order[(distances[order] > 0) & (distances[order] <= _REACH_CELLS)]
    sectors = np.floor(np.arctan2(down, right) * _SECTORS / (2 * pi) + 0.5).astype(np.int64) % _SECTORS
    return right[order], down[order], sectors[order], distances[order] * _CELL
