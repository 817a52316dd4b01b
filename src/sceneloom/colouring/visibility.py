"""Which points of a sparse cloud a camera sees: occlusion that bridges the gaps between scan lines, even or uneven.

A z-buffer over the pixels removes almost nothing: points are several pixels apart, so between two scan lines on a car
the street behind it shows through. A gap between the samples of one surface must be told from a gap between two
surfaces. The rule here rests on two facts.

**Inverse range is bounded on a surface.** A plane at distance d from the camera, seen in the unit direction u, is at
range ρ with 1/ρ = n·u / d. Between two directions an angle α apart, 1/ρ therefore changes by at most α/d, however
grazing the view. So a point Q can only hide a point P, α away, if

    1/ρ_Q - 1/ρ_P  >  α / surface_distance  +  m,      m = margin / ρ_P² + margin_share / ρ_P

where m is how much nearer Q must be (in metres and as a share of the range, for noise and calibration). No surface
whose plane is at least `surface_distance` away from the camera hides itself: not the road seen at grazing angle, not
the wall along it. The larger this distance may be, the more is found between scan lines that are far apart; the
steepest changes from point to point in the cloud itself show how near its surfaces pass the camera, which mostly is
its height.

**Hidden points are within silhouettes.** P is hidden if one such Q is so near in direction that no other sample of
Q's surface can be expected between them, or if two of them are in opposite quadrants around P within a window. Q on
one side only, and farther away, is a neighbour beyond a silhouette: P is the background beside it and stays visible.
How near is near depends on the lidar: an ellipse of 0.95 spacings across the scan lines and 1.3 along them (between the
last line on a roof and the next, which misses it, nothing shows where the roof ends; a wrong colour is the worse
loss), less 0.08 degrees, within which no calibration tells on which side of an outline a point is. The window reaches
a little over one spacing of the scan lines. Since lidars differ, and mountings rotate and tilt them, the spacings and
their axes are measured in the cloud, as the camera sees it.

**The lidar saw P.** So no edge of Q's surface reached P as the lidar saw the two: between them the edge may be
anywhere. From the lidar to the camera Q shifts against P by the difference of their inverse ranges times the baseline
across the line of sight. Only if P has come as near to Q as 0.85 of what they were apart, or gone behind it, can the
edge cover it now; where lidar and camera look at a kerb or a ditch from nearly the same position, the road behind it
stays visible. This is asked of one Q alone, where the lidar's position is known; without that, surfaces must be taken
to pass the camera at half a metre, since uneven ground would hide itself otherwise.

**Uneven lines.** Many lidars have lines a sixth of a degree apart in the middle and a degree or more above and below;
rosettes are dense in the middle. One reach for all points would be too short for the sparse part or too long for the
dense one, so each point hides with the reach of its own part of the lidar's view. There, spacings do not depend on
what stands where: seen from the camera the lines on a near object lie between those on things far behind it.

Directions are compared in Lambert's equal-area map around the optical axis, in which distances are nearly angles. The
rule therefore holds for every camera model and resolution alike. To be fast, only the nearest point in each cell of a
grid over that map can hide others; cells are 0.16 degrees wide, or a sixth of the reach.

What the lidar could not see hides nothing: high above the camera it looks over parked cars, and up to 33 % of what they
hide pass. docs/fusion.md has the figures on simulated streets.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from math import cos, degrees, isfinite, isnan, log, pi, radians, sin
from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float32, float64, int32, int64, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, check_array
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.errors import OptionError
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.projection import map_directions
from sceneloom.kernels.signatures import (
    IN_F32_1D,
    IN_F32_2D,
    IN_F64_1D,
    IN_F64_2D,
    IN_I32_1D,
    IN_I32_2D,
    IN_I64_1D,
    IN_I64_2D,
    inlined,
    part,
)
from sceneloom.kernels.thread_pool import ALONE, Phase, ThreadPool

Looks = tuple[Float32Array, Float32Array]
"""Where a camera sees M points: directions (2, M) in the equal-area map [rad], inverse ranges (M,) [1/m]."""

_CELL_DEG = 0.16
_NEARING = 0.85
_STRAIGHTNESS = 0.5
_MOST_THREADS = 256
_UNKNOWN_EYES = (np.zeros((0, 3)), np.zeros(0, np.float32))


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilitySettings:
    """What counts as hidden behind a nearer surface.

    Attributes:
        enabled: False leaves a plain z-buffer over the pixels.
        window_deg: how far points on opposite sides of another may be from it to hide it [deg]; None for 1.15 times
            the spacing of the scan lines, measured from the cloud, between 0.3 and 3.
        near_deg: within this one point alone hides another [deg]; None for 0.95 times the spacing of the scan lines
            across them and 1.3 times the spacing of the points along them, less 0.08, measured, between 0.1 and 2.4.
        surface_distance: surfaces whose plane passes the camera farther away than this never hide themselves [m];
            less than the height of the camera above the ground. None: with known positions of the lidar, four fifths
            of what is measured in the cloud, between 0.1 and 1.5; 0.5 otherwise.
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        threads: number of threads for one cloud; the result is the same.

    Raises:
        OptionError: a number is negative, not finite, or 0 where it must not be.
    """

    enabled: bool = True
    window_deg: float | None = None
    near_deg: float | None = None
    surface_distance: float | None = None
    margin: float = 0.15
    margin_share: float = 0.01
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("surface_distance", "margin", "margin_share"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value >= 0):
                raise OptionError(f"{name} {value}; expected a finite number that is not negative")
        if self.surface_distance == 0:
            raise OptionError(f"surface_distance {self.surface_distance}; expected a positive distance in metres")
        if not 1 <= self.threads <= _MOST_THREADS:
            raise OptionError(f"threads {self.threads}; expected 1 to {_MOST_THREADS}")
        for name in ("window_deg", "near_deg"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 45:
                raise OptionError(f"{name} {value}; expected more than 0 and at most 45")


def find_visible(
    points_world: Float64Array,
    point_ids: Int64Array,
    camera_from_world: Float64Array,
    settings: VisibilitySettings,
    *,
    trajectory: LidarTrajectory | None = None,
    looks: Looks | None = None,
) -> BoolArray:
    """Find the points that the camera sees, as far as the points themselves hide one another.

    Args:
        points_world: (N, 3) float64 [m], contiguous.
        point_ids: (M,) int64, those in the image; only they hide one another.
        camera_from_world: (3, 4) or (4, 4) float64, contiguous.
        settings: of the rule; `enabled` is ignored.
        trajectory: where the lidar was when it measured the N points; None where unknown.
        looks: the result of `map_directions` for the M points, where known.

    Returns:
        (M,) bool.

    Raises:
        ArrayError: `trajectory` is that of another number of points.
    """
    thread_pool = ThreadPool.of(settings.threads, len(point_ids))
    directions, inverse_ranges = looks or _look(points_world, point_ids, camera_from_world, thread_pool)
    eyes, fractions = _UNKNOWN_EYES
    if trajectory is not None:
        check_array("trajectory.fractions", trajectory.fractions, (len(points_world),), np.float32)
        eyes, fractions = _in_camera(trajectory.ends_world, camera_from_world), trajectory.fractions

    def seen_by_lidar() -> Float32Array:
        """Directions (2, M) in which the lidar saw the points, around the camera's axis."""
        if trajectory is None:
            return directions
        share = fractions[point_ids, None].astype(np.float64)
        from_eyes = _in_camera(points_world[point_ids], camera_from_world)
        from_eyes -= eyes[0] + share * (eyes[1] - eyes[0])
        return _look(from_eyes, np.arange(len(from_eyes)), np.eye(4), ALONE)[0]

    extent = measure_extent(directions, inverse_ranges, thread_pool=thread_pool)
    window, near, distance = settings.window_deg, settings.near_deg, settings.surface_distance
    if distance is None and trajectory is None:
        distance = _USUAL_SURFACE_DISTANCE
    passes = [fit_reach(None).given(window, near).hiding(inverse_ranges)]
    if window is None or near is None or distance is None:
        neighbours = look_around(directions, inverse_ranges, extent=extent, thread_pool=thread_pool)
        if distance is None:
            margins = _STRAIGHTNESS * settings.margin, _STRAIGHTNESS * settings.margin_share
            distance = measure_surface_distance(neighbours, directions, inverse_ranges, *margins)
        lines = find_lines(measure_spacings(neighbours))
        passes = [fit_reach(lines).given(window, near).hiding(inverse_ranges)]
        if lines is not None and (window is None or near is None) and are_uneven(neighbours):
            parts = split_by_spacing(seen_by_lidar(), inverse_ranges, lines)
            if len(parts) > 1:
                passes = [
                    own.reach.given(window, near).hiding(np.where(members, inverse_ranges, np.float32(0.0)))
                    for own, members in parts
                ]
    visible = np.empty(len(point_ids), np.bool_)
    mark_unhidden(
        directions, inverse_ranges, passes, extent, 1.0 / distance, settings.margin, settings.margin_share, eyes,
        point_ids, fractions, _NEARING, visible, thread_pool=thread_pool,
    )  # fmt: skip
    return visible


def _look(
    points_world: Float64Array, point_ids: Int64Array, camera_from_world: Float64Array, thread_pool: ThreadPool
) -> Looks:
    directions, inverse_ranges = np.empty((2, len(point_ids)), np.float32), np.empty(len(point_ids), np.float32)
    map_directions(points_world, point_ids, camera_from_world, directions, inverse_ranges, thread_pool=thread_pool)
    return directions, inverse_ranges


def _in_camera(points_world: Float64Array, camera_from_world: Float64Array) -> Float64Array:
    return np.ascontiguousarray(points_world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])


_CELL = radians(0.1)
_REACH_CELLS = 25
_SPARSEST = _CELL * _REACH_CELLS  # neighbours farther away are not found [rad]
_SAMPLES = 256
_SECTORS = 8
_WINDOW_PER_SPACING = 1.15
_NEAR_PER_SPACING_ACROSS, _NEAR_PER_SPACING_ALONG, _OUTLINE_DEG = 0.95, 1.3, 0.08
_WINDOWS_DEG, _NEARS_DEG = (0.3, 3.0), (0.1, 2.4)
_USUAL_WINDOW_DEG, _USUAL_NEAR_DEG = 0.5, 0.16
_CELLS_PER_REACH = 6  # cells of the grid in which points are compared, per reach
_USUAL_SURFACE_DISTANCE = 0.5  # where nothing was measured [m]: below the height of nearly all cameras
_SURFACE_DISTANCES = (0.1, 1.5)
_OF_SURFACE_DISTANCE, _STEEPER_THAN, _FEWEST_SURFACES = 0.8, 0.95, 32


@dataclass(frozen=True, slots=True)
class _Reach:
    """How far occlusion reaches in the equal-area map of directions."""

    window: float  # for two points on opposite sides [rad]
    across: float  # for one point alone, across the scan lines [rad]
    along: float  # and along them [rad]
    angle: float = 0.0  # of the axis across the scan lines, from rightward to downward

    def hiding(self, inverse_ranges: Float32Array) -> "Hiding":
        """What points with these inverse ranges hide, (M,) float32 [1/m], 0 for one that shall hide none."""
        cell = max(max(self.window, self.across, self.along) / _CELLS_PER_REACH, radians(_CELL_DEG))
        c, s, p, r = cos(self.angle), sin(self.angle), self.across**-2, self.along**-2
        ellipse = p * c * c + r * s * s, 2 * (p - r) * c * s, p * s * s + r * c * c
        return Hiding(inverse_ranges, cell, self.window, *ellipse)

    def given(self, window_deg: float | None, near_deg: float | None) -> "_Reach":
        """The same with what is given instead of what was measured."""
        reach = self if near_deg is None else _Reach(self.window, radians(near_deg), radians(near_deg))
        return reach if window_deg is None else replace(reach, window=radians(window_deg))


@dataclass(frozen=True, slots=True)
class ScanLines:
    """The scan lines of a lidar in a view."""

    across: float  # from line to line [rad]
    along: float  # from point to point on a line [rad]
    angle: float  # of the axis across the lines, from rightward to downward

    @property
    def reach(self) -> _Reach:
        """The reach of occlusion that bridges them."""
        across, along = degrees(self.across), degrees(self.along)
        window = _bounded(_WINDOW_PER_SPACING * across, *_WINDOWS_DEG)
        # Of the points of a cell only the nearest counts, so that one point reaches a cell at least.
        least = max(_NEARS_DEG[0], window / _CELLS_PER_REACH)
        return _Reach(
            radians(window),
            radians(_bounded(_NEAR_PER_SPACING_ACROSS * across - _OUTLINE_DEG, *_NEARS_DEG)),
            radians(_bounded(_NEAR_PER_SPACING_ALONG * along - _OUTLINE_DEG, least, _NEARS_DEG[1])),
            self.angle,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Neighbours:
    """The next point in each of eight sectors around some points of a cloud; opposite sectors make an axis."""

    points: Int64Array  # (S,) int64, the points in the middle
    ids: Int64Array  # (S, 8) int64, a point in the nearest occupied cell of each sector; -1 for none within reach
    distances: Float64Array  # (S, 8) float64 [rad], how far that cell is; NaN for none


def look_around(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    *,
    extent: Float32Array | None = None,
    samples: int = _SAMPLES,
    thread_pool: ThreadPool = ALONE,
) -> _Neighbours:
    """Find the neighbours of some points, evenly drawn from a cloud.

    Args:
        directions: (2, M) float32 in the equal-area map [rad].
        inverse_ranges: (M,) float32 [1/m]; 0 for a point that is ignored.
        extent: (4,) of the cloud, as of `measure_extent`, where known.
        samples: how many points; all where there are fewer.
        thread_pool: the threads that share the cloud.
    """
    if extent is None:
        extent = measure_extent(directions, inverse_ranges, thread_pool=thread_pool)
    distances, ids = np.empty((samples, _SECTORS)), np.empty((samples, _SECTORS), np.int64)
    find_neighbours(directions, inverse_ranges, extent, _CELL, *_disc(), distances, ids, thread_pool=thread_pool)
    drawn = min(samples, len(inverse_ranges))
    points = np.arange(drawn) * len(inverse_ranges) // max(drawn, 1)
    return _Neighbours(points, ids[:drawn], distances[:drawn])


def measure_spacings(neighbours: _Neighbours) -> Float64Array:
    """Measure how far apart the points of a cloud appear along four axes.

    Returns:
        (4,) float64 [rad], mean of the middle half of the distances along the axes at 0, 45, 90 and 135 degrees from
        rightward to downward, 0.1 to 2.5 degrees; NaN where fewer than half of the neighbours are so near.
    """
    # opposite sectors make an axis; the middle half is as robust as the median, but not bound to whole cells
    axes = _SECTORS // 2
    ordered = np.sort(neighbours.distances.T.reshape(2, axes, -1).swapaxes(0, 1).reshape(axes, -1))
    spacings = np.full(axes, np.nan)
    for axis, known in enumerate(np.isfinite(ordered).sum(axis=1).tolist()):
        if known >= _SAMPLES:
            spacings[axis] = ordered[axis, known // 4 : known - known // 4].mean()
    return spacings


def measure_surface_distance(
    neighbours: _Neighbours, directions: Float32Array, inverse_ranges: Float32Array, margin: float, margin_share: float
) -> float:
    """Measure how near the planes of the surfaces in a cloud pass the camera: mostly the height above the ground.

    The inverse range changes along a plane by at most one over that distance for each radian. It is taken where a point
    is on one line with its neighbours on both sides, so that the three are of one surface.

    Args:
        neighbours: of some points.
        directions: (2, M) float32 in the equal-area map [rad].
        inverse_ranges: (M,) float32 [1/m].
        margin: how far from the line a point may be [m] …
        margin_share: … plus this share of its range.

    Returns:
        Four fifths of the distance that 95 % of the surfaces keep, 0.1 to 1.5 m; 0.5 where too few were found.
    """
    slopes = np.empty(len(neighbours.points))
    find_slopes(
        directions, inverse_ranges, neighbours.points, neighbours.ids, _CELL * 1e-3, margin, margin_share, slopes
    )
    slopes.sort()
    known = int(slopes.searchsorted(np.inf))
    if known < _FEWEST_SURFACES:
        return _USUAL_SURFACE_DISTANCE
    steepest = max(float(slopes[int(_STEEPER_THAN * known)]), 1e-3)
    return _bounded(_OF_SURFACE_DISTANCE / steepest, *_SURFACE_DISTANCES)


def find_lines(spacings: Float64Array) -> ScanLines | None:
    """The scan lines from spacings along the four axes: of the two perpendicular pairs the one that differs more."""
    along_axes = spacings.tolist()
    ratios = {pair: abs(log(along_axes[pair] / along_axes[pair + 2])) for pair in range(2)}
    known = [pair for pair, ratio in ratios.items() if not isnan(ratio)]
    if not known:
        return None
    pair = max(known, key=ratios.__getitem__)
    axis = pair if along_axes[pair] > along_axes[pair + 2] else pair + 2
    return ScanLines(along_axes[axis], along_axes[(axis + 2) % 4], axis * pi / 4)


def fit_reach(lines: ScanLines | None) -> _Reach:
    """The reach for scan lines; a usual one where there are none."""
    if lines is None:
        return _Reach(radians(_USUAL_WINDOW_DEG), radians(_USUAL_NEAR_DEG), radians(_USUAL_NEAR_DEG))
    return lines.reach


def _bounded(value: float, least: float, most: float) -> float:
    return min(max(value, least), most)


@lru_cache(maxsize=1)
def _disc() -> tuple[Int64Array, Int64Array, Int64Array, Float64Array]:
    """Columns, rows, sectors and distances [rad] of the cells around one, nearest first."""
    down, right = np.mgrid[-_REACH_CELLS : _REACH_CELLS + 1, -_REACH_CELLS : _REACH_CELLS + 1].reshape(2, -1)
    distances = np.hypot(right, down)
    order = np.argsort(distances, kind="stable")
    order = order[(distances[order] > 0) & (distances[order] <= _REACH_CELLS)]
    sectors = np.floor(np.arctan2(down, right) * _SECTORS / (2 * pi) + 0.5).astype(np.int64) % _SECTORS
    return right[order], down[order], sectors[order], distances[order] * _CELL


_UNEVEN = 2.5
"""Least ratio of sparse to dense spacings of uneven lines. With even lines, occlusions and a fisheye's distortion make
that up to 2.1; lidars as above have 4.1 and more (simulated streets, PandaSet)."""

_DENSE, _SPARSE = 15.0, 93.0
_FEWEST = 64
_SPARSER_THAN = 1.5
_SAMPLES_OF_PARTS = 2048
_TILE_ACROSS, _TILE_ALONG = radians(1.0), radians(8.0)
_LEAST_IN_TILE = 2
_LEAST_KNOWN = 5
_STEP = log(2.0)
_LEAST_SHARE = 0.01


def are_uneven(neighbours: _Neighbours) -> bool:
    """Whether the lines around some points differ so much that one reach does not fit all."""
    spacings = _around(neighbours)
    spacings.sort()
    known = spacings[: int(spacings.searchsorted(np.inf))]
    if len(known) < _FEWEST:
        return False
    percentiles = np.array([_DENSE, _SPARSE]) / 100 * (len(known) - 1)
    dense, sparse = np.interp(percentiles, np.arange(len(known)), known).tolist()
    return bool(sparse > _UNEVEN * dense)


def split_by_spacing(
    directions: Float32Array, inverse_ranges: Float32Array, lines: ScanLines
) -> list[tuple[ScanLines, BoolArray]]:
    """Split a cloud by how far apart its scan lines are at its points.

    Args:
        directions: (2, M) float32 [rad], in which the lidar saw the points, in the equal-area map.
        inverse_ranges: (M,) float32 [1/m]; 0 for a point that is ignored.
        lines: of the cloud as a whole, in case that too few points show its sparse lines.

    Returns:
        Parts in which spacings are equal within a factor of two, with their members (M,); less than a hundredth of the
        points makes no part.
    """
    neighbours = look_around(directions, inverse_ranges, samples=_SAMPLES_OF_PARTS)
    of_samples = _around(neighbours)
    lines = _sparse_lines(neighbours, of_samples, lines)
    tiles, columns = _tiles(directions, lines.angle)
    spacings = _spread(of_samples, tiles[neighbours.points], int(tiles.max()) // columns + 1, columns)
    # There are few tiles: all is decided for them, each weighted by its points.
    counts = np.bincount(tiles, minlength=len(spacings))
    steps = np.rint(np.log(spacings / _median(spacings, counts)) / _STEP).astype(np.int64)
    found, which = np.unique(steps, return_inverse=True)
    points = np.bincount(which, weights=counts)
    kept = found[(points >= _LEAST_SHARE * counts.sum()) & (points > 0)]
    # steps with too few points join the nearest one
    nearest = kept[np.argmin(np.abs(found[:, None] - kept), axis=1)][which]
    parts = []
    for step in kept.tolist():
        inside = nearest == step
        across = _median(spacings[inside], counts[inside])
        parts.append((ScanLines(across, lines.along, lines.angle), inside[tiles]))
    return parts


def _median(values: Float64Array, counts: Int64Array) -> float:
    """The median of values, each repeated so many times."""
    order = np.argsort(values)
    behind = np.cumsum(counts[order])
    middle = np.searchsorted(behind, [(behind[-1] - 1) // 2, behind[-1] // 2], side="right")
    return float(values[order][middle].mean())


def _sparse_lines(neighbours: _Neighbours, spacings: Float64Array, lines: ScanLines) -> ScanLines:
    """The lines where they are far apart: dense ones look much the same across and along."""
    known = spacings[np.isfinite(spacings)]
    sparse = spacings > _SPARSER_THAN * (np.median(known) if len(known) else np.inf)
    if np.count_nonzero(sparse) < _FEWEST:
        return lines
    found = neighbours.distances[sparse]
    distances = np.where(np.isnan(found), _SPARSEST, found)
    half = distances.shape[1] // 2
    axes = np.median(np.concatenate([distances[:, :half], distances[:, half:]]), axis=0)
    along = int(np.argmin(axes))
    across = (along + half // 2) % half
    return ScanLines(float(axes[across]), float(axes[along]), across * pi / half)


def _around(neighbours: _Neighbours) -> Float64Array:
    """The spacing of the lines around each point [rad], in any direction; NaN where few neighbours are in reach."""
    # of eight sectors two look along the line, the others to the next lines: the upper quartile is across
    ordered = np.sort(neighbours.distances, axis=1)
    known = np.isfinite(ordered).sum(axis=1)
    quartiles = ordered[np.arange(len(known)), 3 * known // 4 - (known == 0)]
    return np.asarray(np.where(known >= _LEAST_KNOWN, quartiles, np.nan), np.float64)


def _tiles(directions: Float32Array, angle: float) -> tuple[Int64Array, int]:
    """Numbers (M,) of the tiles, long along the lines, that points are in, and how many tiles are side by side."""
    c, s = cos(angle), sin(angle)
    across = np.floor((c * directions[0] + s * directions[1]) / _TILE_ACROSS).astype(np.int64)
    along = np.floor((c * directions[1] - s * directions[0]) / _TILE_ALONG).astype(np.int64)
    columns = int(np.ptp(along)) + 1
    return (across - across.min()) * columns + along - along.min(), columns


def _spread(spacings: Float64Array, tiles: Int64Array, rows: int, columns: int) -> Float64Array:
    """For each tile the median spacing of the samples in it; without samples that of the nearest row of tiles."""
    field = np.full((rows, columns), np.nan)
    values = np.where(np.isnan(spacings), _SPARSEST, spacings)
    order = np.lexsort((values, tiles))
    found, first, counts = np.unique(tiles[order], return_index=True, return_counts=True)
    medians = 0.5 * (values[order][first + (counts - 1) // 2] + values[order][first + counts // 2])
    enough = counts >= _LEAST_IN_TILE
    field.ravel()[found[enough]] = medians[enough]
    known = np.flatnonzero(np.isfinite(field).any(axis=1))
    if len(known) == 0:
        return np.full(field.size, _SPARSEST)
    of_rows = np.nanmedian(field[known], axis=1)
    nearest = np.argmin(np.abs(np.arange(rows)[:, None] - known), axis=1)
    return np.asarray(np.where(np.isnan(field), of_rows[nearest][:, None], field).ravel(), np.float64)


_SLACK = np.float32(0.001)
"""Rounding may put a point a hair beyond the border of its cell; cells count as so much nearer to each other."""

_CHUNK = 1024  # cells whose bounds are computed at once, within the nearest cache
_NOTHING, _ONE, _INFINITE = np.float32(0.0), np.float32(1.0), np.float32(math.inf)


@part
def _drop_upright(
    dropped: Float32Array, source: Float32Array, down: Float32Array, from_y: Any, sign: Any, reach: Any, slope: Any
) -> None:  # fmt: skip
    """Write what the cells of one row still have at the border of the next row, `from_y + sign * down` away."""
    for i in range(dropped.shape[0]):
        gap = max(from_y + sign * down[i], _NOTHING)
        dropped[i] = source[i] - slope * gap if gap <= reach else _NOTHING


@part
def _raise_to_three(target: Float32Array, source: Float32Array) -> None:
    """Raise `target` to the largest of the three cells around it, which are one farther in `source`."""
    for i in range(target.shape[0]):
        target[i] = max(target[i], source[i], source[i + 1], source[i + 2])


@part
def _raise_along(target: Float32Array, source: Float32Array, right: Float32Array, reach: Any, slope: Any) -> None:
    """Raise `target` to its own cell, and to what the cells on both sides still have at its border."""
    for i in range(target.shape[0]):
        from_left = max(_ONE - _SLACK - right[i], _NOTHING)
        from_right = max(right[i + 2] - _SLACK, _NOTHING)
        left = source[i] - slope * from_left if from_left <= reach else _NOTHING
        other = source[i + 2] - slope * from_right if from_right <= reach else _NOTHING
        target[i] = max(target[i], source[i + 1], left, other)


@part
def _raise_by_locations(
    target: Float32Array, start: int, columns: int, nearest: Float32Array, right: Float32Array,
    down: Float32Array, reach_x: Any, reach_y: Any, slope: Any, room: Float32Array,
) -> None:  # fmt: skip
    """Raise the bounds of a run of cells to what hides alone in the same cell or the eight around it."""
    # what a surface gains on the way is counted along rows or columns alone, which is no more than all of it
    size = target.shape[0] + 2
    first = start - 1
    _raise_along(target, nearest[first : first + size], right[first : first + size], reach_x, slope)
    for first, from_y, sign in ((start - 1 - columns, _ONE - _SLACK, -_ONE), (start - 1 + columns, -_SLACK, _ONE)):
        _drop_upright(
            room[:size], nearest[first : first + size], down[first : first + size], from_y, sign, reach_y, slope
        )
        _raise_to_three(target, room[:size])


@part
def _raise_to_pairs(joined: Float32Array, squares: Float32Array, below: Float32Array) -> None:
    """Join the largest of squares of cells to that of squares one wider; `below` begins a row farther down."""
    for i in range(joined.shape[0] - 1):
        joined[i] = max(squares[i], squares[i + 1], below[i], below[i + 1])


@part
def _join_squares(nearest: Float32Array, columns: int, border: int) -> Float32Array:
    """The largest inverse range (border, cells) [1/m] of the squares of 2, 3, … cells right and down of each cell."""
    levels = np.empty((border, nearest.shape[0]), np.float32)
    last = nearest
    for k in range(border):
        whole = nearest.shape[0] - columns
        levels[k, whole:] = _NOTHING
        _raise_to_pairs(levels[k, :whole], last[:whole], last[columns:])
        levels[k, whole - 1] = _NOTHING
        last = levels[k]
    return levels


@part
def _raise_to(target: Float32Array, source: Float32Array, drop: Any) -> None:
    """Raise `target` to `source - drop` where that is larger."""
    for i in range(target.shape[0]):
        target[i] = max(source[i] - drop, target[i])


@part
def _pair(largest: Float32Array, from_opposite: Float32Array) -> None:
    """Write the larger of the smaller of the opposite quadrants."""
    for i in range(from_opposite.shape[0]):
        from_opposite[i] = max(min(largest[0, i], largest[2, i]), min(largest[1, i], largest[3, i]))


@part
def _raise_by_squares(
    levels: Float32Array, columns: int, size: int, slope: Any, start: int,
    from_any: Float32Array, from_opposite: Float32Array, largest: Float32Array,
) -> None:  # fmt: skip
    """Bound a run of cells by the squares around them, less what a surface gains on the way to them."""
    # a single thing may be `size` cells away; what lies in the next cells is left out of `from_any`
    count = from_any.shape[0]
    largest[:], from_any[:] = _NOTHING, _NOTHING
    for k in range(1, levels.shape[0] + 1):
        drop, level = slope * max(np.float32(k) - _ONE - _SLACK, _NOTHING), levels[k - 1]
        for quadrant, corner in enumerate((0, -k, -k - k * columns, -k * columns)):
            square = level[start + corner : start + corner + count]
            _raise_to(largest[quadrant, :count], square, drop)
            if 1 < k <= size:
                _raise_to(from_any, square, drop)
    _pair(largest, from_opposite)
    _raise_to(from_any, from_opposite, _NOTHING)


@part
def _bound_cells(
    nearest: Float32Array, right: Float32Array, down: Float32Array, columns: int, border: int, slope: Any,
    reach_x: Any, reach_y: Any, from_any: Float32Array, from_opposite: Float32Array,
) -> None:  # fmt: skip
    """Bound for each cell of some rows the inverse range of what can hide anything in it."""
    # arrays (cells,) as of `direction_grid`, with `border` rows more above and below; `slope`: what a surface may gain
    # [1/m/cell]; `reach_x`, `reach_y`: how far a single thing hides [cells]; written: `from_any` [1/m], of what hides
    # alone or with another, and `from_opposite`, of what hides with another: the smaller of two opposite quadrants, the
    # larger of the two pairs
    levels, largest = (_join_squares(nearest, columns, border), np.empty((4, _CHUNK), np.float32))
    room = np.empty(_CHUNK + 2, np.float32)
    margin, above, size = border * (columns + 1), border * columns, math.ceil(max(reach_x, reach_y))
    # Rows are taken as one long line: what reaches over their ends meets empty cells only.
    for start in range(margin, nearest.shape[0] - margin, _CHUNK):
        stop = min(start + _CHUNK, nearest.shape[0] - margin)
        bounded, opposite = (from_any[start - above : stop - above], from_opposite[start - above : stop - above])
        _raise_by_squares(levels, columns, size, slope, start, bounded, opposite, largest)
        _raise_by_locations(bounded, start, columns, nearest, right, down, reach_x, reach_y, slope, room)


_POINTS_AT_ONCE = 2048  # points of a block: few of them need a search, whose fixed costs a block shares
_QUARTER, _BEHIND = np.float32(0.25), np.float32(1e-3)


@part
def _list_cells(size_x: int, size_y: int, columns: int) -> tuple[Int64Array, Float32Array, Float32Array]:
    """List the cells of a window, ring by ring: offsets (K,) from the middle cell, and as columns and rows."""
    count, size = 0, (2 * size_x + 1) * (2 * size_y + 1)
    offsets, right, down = np.empty(size, np.int64), np.empty(size, np.float32), np.empty(size, np.float32)
    for ring in range(max(size_x, size_y) + 1):
        for dy in range(-min(ring, size_y), min(ring, size_y) + 1):
            for dx in range(-min(ring, size_x), min(ring, size_x) + 1):
                if max(abs(dx), abs(dy)) == ring:
                    offsets[count], right[count], down[count] = dy * columns + dx, dx, dy
                    count += 1
    return offsets, right, down


@part
def _shift(
    rightward: Float32Array, downward: Float32Array, eye_fractions: Float32Array, eyes: Float64Array, per_cell: Any,
) -> None:  # fmt: skip
    """Replace directions by the shifts [cells m] there, per inverse range, when the eye moves from lidar to camera."""
    # Source: the derivative of Snyder 1987, eq. 24-1 and 24-2, along the eye's motion across the line of sight
    first_x, first_y, first_z = np.float32(eyes[0, 0]), np.float32(eyes[0, 1]), np.float32(eyes[0, 2])
    moved_x, moved_y = np.float32(eyes[1, 0] - eyes[0, 0]), np.float32(eyes[1, 1] - eyes[0, 1])
    moved_z = np.float32(eyes[1, 2] - eyes[0, 2])
    for n in range(eye_fractions.shape[0]):
        squared = rightward[n] * rightward[n] + downward[n] * downward[n]
        half = np.float32(math.sqrt(max(_ONE - _QUARTER * squared, _BEHIND)))
        scale, x, y = _ONE / half, half * rightward[n], half * downward[n]
        z = _ONE - np.float32(0.5) * squared
        eye_x = first_x + eye_fractions[n] * moved_x
        eye_y = first_y + eye_fractions[n] * moved_y
        eye_z = first_z + eye_fractions[n] * moved_z
        along = x * eye_x + y * eye_y + z * eye_z
        across = along + _QUARTER * scale * scale * (eye_z - along * z)
        scale *= per_cell
        rightward[n], downward[n] = (eye_x - x * across) * scale, (eye_y - y * across) * scale


@inlined
def _threshold(inverse: Any, limits: tuple[Any, Any, Any, Any]) -> Any:
    """The inverse range beyond which something is nearer than a point."""
    return inverse + limits[2] * inverse * inverse + limits[3] * inverse


@part
def _pick(
    inverse_ranges: Float32Array, numbers: AnyArray, from_any: Float32Array, limits: tuple[Any, Any, Any, Any],
    visible: BoolArray, picked: AnyArray, thresholds: Float32Array,
) -> int:  # fmt: skip
    """List the points of a block that something may hide; mark all others in a cell as visible."""
    for i in range(numbers.shape[0]):
        visible[i] = numbers[i] > 0
        # Nothing exceeds infinity.
        thresholds[i] = _threshold(inverse_ranges[i], limits) if numbers[i] > 0 else _INFINITE
    count = 0
    for i in range(numbers.shape[0]):
        if from_any[np.uint32(numbers[i])] > thresholds[i]:
            picked[count] = i
            count += 1
    return count


@part
def _gather(
    picked: AnyArray, rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    numbers: AnyArray, per_cell: Any, limits: tuple[Any, Any, Any, Any], cells: AnyArray, room: Float32Array,
) -> None:  # fmt: skip
    """Put side by side what the search needs of the listed points: cell, position in it, threshold, squared slope."""
    for k in range(picked.shape[0]):
        i = np.uint32(picked[k])
        a, b = rightward[i], downward[i]
        cells[k] = numbers[i]
        room[0, k], room[1, k] = fraction(a, per_cell), fraction(b, per_cell)
        room[2, k] = _threshold(inverse_ranges[i], limits)
        room[3, k] = limits[1] / max(_ONE - _QUARTER * (a * a + b * b), _BEHIND)


@inlined
def _gains(excess: Any, x: Any, y: Any, slope_squared: Any) -> Any:
    """Whether something is nearer by more than a surface gains over so short a distance."""
    return excess * excess > slope_squared * (x * x + y * y)


@inlined
def _in_ellipse(x: Any, y: Any, near: tuple[Any, Any, Any]) -> Any:
    return near[0] * (x * x) + near[1] * (x * y) + near[2] * (y * y) <= _ONE


@part
def _search_beside(
    cells: AnyArray, a: Float32Array, b: Float32Array, thresholds: Float32Array, slopes_squared: Float32Array,
    nearest: Float32Array, right: Float32Array, down: Float32Array,
    window: tuple[Int64Array, Float32Array, Float32Array], near: tuple[Any, Any, Any],
    alone: AnyArray, others: AnyArray,
) -> tuple[int, int]:  # fmt: skip
    """List the points that anything in the ellipse around them hides, and the others; return their counts."""
    hidden, free = 0, 0
    for k in range(cells.shape[0]):
        found = False
        for j in range(window[0].shape[0]):
            c = np.uint64(cells[k] + window[0][j])
            excess = nearest[c] - thresholds[k]
            if excess > _NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                if _in_ellipse(x, y, near) and _gains(excess, x, y, slopes_squared[k]):
                    found = True
                    break
        alone[hidden], others[free] = k, k
        hidden += found
        free += not found
    return hidden, free


@part
def _search_nearing(
    listed: AnyArray, cells: AnyArray, a: Float32Array, b: Float32Array, thresholds: Float32Array,
    slopes_squared: Float32Array, nearest: Float32Array, right: Float32Array, down: Float32Array,
    window: tuple[Int64Array, Float32Array, Float32Array], near: tuple[Any, Any, Any],
    inverse_ranges: Float32Array, shift_x: Float32Array, shift_y: Float32Array, nearing: Any,
    others: AnyArray, free: int,
) -> int:  # fmt: skip
    """Add those listed points to `others` that nothing hides which came nearer from the lidar to the camera."""
    for n in range(listed.shape[0]):
        k = np.uint32(listed[n])
        found = False
        for j in range(window[0].shape[0]):
            c = np.uint64(cells[k] + window[0][j])
            excess = nearest[c] - thresholds[k]
            if excess > _NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                gained = nearest[c] - inverse_ranges[n]
                x_from, y_from = x - gained * shift_x[n], y - gained * shift_y[n]
                came = x * x_from + y * y_from <= nearing * (x_from * x_from + y_from * y_from)
                if came and _in_ellipse(x, y, near) and _gains(excess, x, y, slopes_squared[k]):
                    found = True
                    break
        others[free] = k
        free += not found
    return free


@part
def _search_between(
    listed: AnyArray, picked: AnyArray, cells: AnyArray, a: Float32Array, b: Float32Array,
    thresholds: Float32Array, slopes_squared: Float32Array, nearest: Float32Array, right: Float32Array,
    down: Float32Array, window: tuple[Int64Array, Float32Array, Float32Array], window_squared: Any,
    visible: BoolArray,
) -> None:  # fmt: skip
    """Write which of the listed points are not hidden by points in opposite quadrants around them."""
    for n in range(listed.shape[0]):
        k = np.uint32(listed[n])
        # Each quadrant holds one of its two borders, so that opposite directions lie in opposite quadrants.
        first, second, third, fourth, hidden = False, False, False, False, False
        for j in range(window[0].shape[0]):
            c = np.uint64(cells[k] + window[0][j])
            excess = nearest[c] - thresholds[k]
            if excess > _NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                if x * x + y * y <= window_squared and _gains(excess, x, y, slopes_squared[k]):
                    first |= (x > _NOTHING) & (y >= _NOTHING)
                    second |= (x <= _NOTHING) & (y > _NOTHING)
                    third |= (x < _NOTHING) & (y <= _NOTHING)
                    fourth |= (x >= _NOTHING) & (y < _NOTHING)
                    hidden = (first & third) | (second & fourth)
                    if hidden:
                        break
        visible[picked[k]] = not hidden


@part
def _keep_bounded(
    listed: AnyArray, picked: AnyArray, cells: AnyArray, thresholds: Float32Array, from_opposite: Float32Array,
    visible: BoolArray,
) -> int:  # fmt: skip
    """Keep those listed that points in opposite quadrants may hide, mark the others as visible; return the count."""
    count = 0
    for n in range(listed.shape[0]):
        k = np.uint32(listed[n])
        visible[picked[k]] = True
        listed[count] = k
        count += from_opposite[np.uint32(cells[k])] > thresholds[k]
    return count


@part
def _gather_motions(
    listed: AnyArray, picked: AnyArray, rightward: Float32Array, downward: Float32Array,
    inverse_ranges: Float32Array, point_ids: Int64Array, fractions: Float32Array, room: Float32Array,
) -> None:  # fmt: skip
    """Put side by side inverse range, direction and fraction of the lidar's motion of the listed points."""
    for n in range(listed.shape[0]):
        i = np.uint32(picked[listed[n]])
        room[0, n], room[1, n], room[2, n] = inverse_ranges[i], rightward[i], downward[i]
        room[3, n] = fractions[point_ids[i]]


@part
def _decide(
    picked: AnyArray, rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    numbers: AnyArray, per_cell: Any, nearest: Float32Array, right: Float32Array, down: Float32Array,
    from_opposite: Float32Array,
    beside: tuple[Int64Array, Float32Array, Float32Array], around: tuple[Int64Array, Float32Array, Float32Array],
    near: tuple[Any, Any, Any], limits: tuple[Any, Any, Any, Any],
    eyes: Float64Array, point_ids: Int64Array, fractions: Float32Array, nearing: Any, visible: BoolArray,
    lists: AnyArray, room: Float32Array,
) -> None:  # fmt: skip
    """Write which of the listed points of a block are not hidden."""
    count = picked.shape[0]
    cells, alone, others, a, b = lists[0, :count], lists[1], lists[2], room[0], room[1]
    _gather(picked, rightward, downward, inverse_ranges, numbers, per_cell, limits, cells, room)
    hidden, free = _search_beside(cells, a, b, room[2], room[3], nearest, right, down, beside, near, alone, others)
    for n in range(hidden):
        visible[picked[alone[n]]] = False
    if eyes.shape[0] > 0:
        _gather_motions(alone[:hidden], picked, rightward, downward, inverse_ranges, point_ids, fractions, room[4:])
        _shift(room[5], room[6], room[7, :hidden], eyes, per_cell)
        free = _search_nearing(
            alone[:hidden], cells, a, b, room[2], room[3], nearest, right, down, beside, near,
            room[4], room[5], room[6], nearing, others, free,
        )  # fmt: skip
    free = _keep_bounded(others[:free], picked, cells, room[2], from_opposite, visible)
    _search_between(
        others[:free], picked, cells, a, b, room[2], room[3], nearest, right, down, around, limits[0], visible
    )


@kernel(void(
    IN_F32_2D, IN_F32_1D, IN_I32_1D, float64, int64, IN_F32_2D, IN_F32_2D, int64, int64, int64, IN_F32_1D, IN_F64_2D,
    IN_I64_1D, IN_F32_1D, boolean[::1], int64, int64, int64
))  # fmt: skip
def _search_hiding(
    directions: Float32Array, inverse_ranges: Float32Array, numbers: AnyArray, per_cell: float, columns: int,
    held: Float32Array, bounds: Float32Array, size_x: int, size_y: int, border: int, limits: Float32Array,
    eyes: Float64Array, point_ids: Int64Array, fractions: Float32Array, visible: BoolArray, _: int, a: int, b: int,
) -> None:  # fmt: skip
    """Write which of the points from a to b nothing hides; most of them only need the bounds of their cells."""
    # `numbers` (M,) cells, 0 for none; `held` (3, cells) inverse range, and how far right and down; `bounds` (2, cells)
    # of `_bound_cells`; `size_x`, `size_y`: how far single things hide [cells]; `limits` (8,) in cells: squares of
    # window and slope; margin and its share; p, q, r of the ellipse; nearing; the others as of `mark_unhidden`
    pitch, share = np.float32(per_cell), limits[7]
    rightward, downward = directions[0], directions[1]
    nearest, right, down, from_any, from_opposite = held[0], held[1], held[2], bounds[0], bounds[1]
    rule, near = (limits[0], limits[1], limits[2], limits[3]), (limits[4], limits[5], limits[6])
    beside, around = _list_cells(size_x, size_y, columns), _list_cells(border, border, columns)
    picked, lists, room = (
        np.empty(_POINTS_AT_ONCE, np.int32), np.empty((3, _POINTS_AT_ONCE + 1), np.int32),
        np.empty((8, _POINTS_AT_ONCE), np.float32),
    )  # fmt: skip
    for start in range(a, b, _POINTS_AT_ONCE):
        stop = min(start + _POINTS_AT_ONCE, b)
        seen, inverse, block = visible[start:stop], inverse_ranges[start:stop], numbers[start:stop]
        found = _pick(inverse, block, from_any, rule, seen, picked, room[2])
        _decide(
            picked[:found], rightward[start:stop], downward[start:stop], inverse, block, pitch,
            nearest, right, down, from_opposite, beside, around, near, rule,
            eyes, point_ids[start:stop], fractions, share, seen, lists, room,
        )  # fmt: skip


_ROUNDS = 4  # chunks for each thread: some parts of a cloud hide much and others nothing


@kernel(void(
    IN_F32_2D, IN_F32_1D, IN_F32_1D, float64, int64, int64, int64, int64, int32[::1], int64[:, ::1], int64, int64, int64
))  # fmt: skip
def _keep_nearest(
    directions: Float32Array, inverse_ranges: Float32Array, hiding: Float32Array, cell: float, first_column: int,
    first_row: int, columns: int, rows: int, numbers: AnyArray, keys: AnyArray, part: int, a: int, b: int,
) -> None:  # fmt: skip
    """Number the cells of the points from a to b, and write for each cell the key of its nearest; 0 where none is."""
    own = keys[part]
    own[:] = 0
    grid = (np.float32(1.0 / cell), np.int32(first_column), np.int32(first_row), columns, rows)
    keep_nearest(directions[0, a:b], directions[1, a:b], inverse_ranges[a:b], hiding[a:b], grid, numbers[a:b], own)
    own[0] = 0


@kernel(void(int64[:, ::1], float32[:, ::1], int64, int64, int64))
def _read_keys(keys: AnyArray, held: Float32Array, _: int, a: int, b: int) -> None:
    """Unpack the largest keys of the cells from a to b out of several tables."""
    whole = keys[0, a:b]
    for part in range(1, keys.shape[0]):
        other = keys[part, a:b]
        for c in range(whole.shape[0]):
            whole[c] = max(whole[c], other[c])
    read_keys(whole, held[0, a:b], held[1, a:b], held[2, a:b])


@kernel(void(IN_F32_2D, int64, int64, float64, float64, float64, float32[:, ::1], int64, int64, int64))
def _bound_hiding(
    held: Float32Array, columns: int, border: int, slope: float, reach_x: float, reach_y: float, bounds: Float32Array,
    _: int, first: int, last: int,
) -> None:  # fmt: skip
    """Write the bounds of the cells of some rows, which are counted without the border; each needs those around it."""
    a, b, c, d = first * columns, (first + border) * columns, (last + border) * columns, (last + 2 * border) * columns
    _bound_cells(
        held[0, a:d], held[1, a:d], held[2, a:d], columns, border, np.float32(slope), np.float32(reach_x),
        np.float32(reach_y), bounds[0, b:c], bounds[1, b:c],
    )  # fmt: skip


class Hiding(NamedTuple):
    """Which points may hide others, and how far that reaches in the equal-area map.

    Attributes:
        inverse_ranges: (M,) float32 [1/m]; 0 for those that hide none.
        cell: size of a cell in which only the nearest point hides [rad], at least 0.001, which bounds the memory.
        window: within it two points on opposite sides of another hide it [rad].
        near_xx, near_xy, near_yy: p, q, r of the ellipse p x² + q x y + r y² <= 1 in which a single point hides
            [1/rad²].
    """

    inverse_ranges: Float32Array
    cell: float
    window: float
    near_xx: float
    near_xy: float
    near_yy: float


def mark_unhidden(
    directions: Float32Array, inverse_ranges: Float32Array, passes: Sequence[Hiding], extent: Float32Array,
    slope: float, margin: float, margin_share: float, eyes: Float64Array, point_ids: Int64Array,
    fractions: Float32Array, nearing: float, visible: BoolArray, *, thread_pool: ThreadPool = ALONE,
) -> None:  # fmt: skip
    """Write which points no nearer points hide.

    Only the nearest point of each cell can hide others. Two bounds per cell let most points pass with one read each.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; a point with 0 is ignored and not visible.
        passes: a point is visible that none of them hides.
        extent: (4,) of the points, as of `measure_extent`.
        slope: largest gradient of the inverse range on a surface that does not hide itself [1/m/rad].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        eyes: (2, 3) [m], camera frame, first and last position of the lidar; (0, 3) where unknown.
        point_ids: (M,), each point's row in `fractions`.
        fractions: (N,), how far between its two positions the lidar was, 0 to 1.
        nearing: to what share of its distance as the lidar saw it a single point must have come to hide; ignored
            without `eyes`.
        visible: (M,), written.
        thread_pool: the threads that share the work; the result is the same.
    """
    count, shapes = len(inverse_ranges), []
    for one in passes:
        # From here on lengths are in cells.
        xx, xy, yy = (near * one.cell * one.cell for near in (one.near_xx, one.near_xy, one.near_yy))
        area, radius = xx * yy - 0.25 * xy * xy, one.window / one.cell
        reach_x, reach_y = math.sqrt(yy / area), math.sqrt(xx / area)
        border = max(math.ceil(radius), math.ceil(reach_x), math.ceil(reach_y))
        limits = np.array(
            [radius * radius, (slope * one.cell) ** 2, margin, margin_share, xx, xy, yy, nearing], np.float32
        )
        shapes.append((reach_x, reach_y, border, limits, position_grid(extent, one.cell, border)))
    # one room for all passes, which come one after the other
    most = max(columns * rows for *_, (_, _, columns, rows) in shapes)
    keys_room, numbers = np.empty(thread_pool.size * most, np.int64), np.empty(count, np.int32)
    held_room, bounds_room = np.empty(3 * most, np.float32), np.empty(2 * most, np.float32)
    seen, phases = np.empty((len(passes), count), np.bool_), []
    for one, (reach_x, reach_y, border, limits, (first_column, first_row, columns, rows)), found in zip(
        passes, shapes, seen, strict=True
    ):
        cells = columns * rows
        keys = keys_room[: thread_pool.size * cells].reshape(-1, cells)
        held, bounds = held_room[: 3 * cells].reshape(3, cells), bounds_room[: 2 * cells].reshape(2, cells)
        keep = partial(
            _keep_nearest, directions, inverse_ranges, one.inverse_ranges, one.cell, first_column, first_row, columns,
            rows, numbers, keys,
        )  # fmt: skip
        bound = partial(_bound_hiding, held, columns, border, slope * one.cell, reach_x, reach_y, bounds)
        search = partial(
            _search_hiding, directions, inverse_ranges, numbers, 1.0 / one.cell, columns, held, bounds,
            math.ceil(reach_x), math.ceil(reach_y), border, limits, eyes, point_ids, fractions, found,
        )  # fmt: skip
        phases += [
            Phase(count, keep), Phase(cells, partial(_read_keys, keys, held)), Phase(rows - 2 * border, bound),
            Phase(count, search, rounds=_ROUNDS),
        ]  # fmt: skip
    thread_pool.share(*phases)
    seen.all(axis=0, out=visible)


_BLOCK = 512  # points whose cells are numbered at once, by SIMD
_EDGE = np.float32(2.1)  # no direction is farther than this from the axis in the equal-area map
_LEAST, _GREATEST, _SIGN = np.int32(-(2**31)), np.int32(2**31 - 1), np.int32(31)
_PARTS, _LAST_PART = np.float32(65536.0), np.int32(0xFFFF)

_PART = np.float32(1.0 / 65536.0)
"""Resolution of the position in a cell: that of float32, but for the far edge of the map."""


@part
def _is_placed(a: Any, b: Any, inverse_range: Any) -> Any:
    """Whether a point counts; NaN does not."""
    return (inverse_range > _NOTHING) & (inverse_range < _INFINITE) & (abs(a) <= _EDGE) & (abs(b) <= _EDGE)


@part
def _step(value: Any, placed: Any, per_cell: Any) -> Any:
    """Count cells from the edge of the map."""
    return np.int32((value if placed else _NOTHING) * per_cell + _EDGE * per_cell)


@part
def fraction(value: Any, per_cell: Any) -> Any:
    """How far into its cell a direction is, 0 to 1."""
    steps = value * per_cell + _EDGE * per_cell
    return steps - np.float32(np.int32(steps))


@part
def _number(column: Any, row: Any, grid: tuple[Any, Any, Any, int, int]) -> Any:
    """The number of a cell; in 32 bits at each step, as Numba would go on in 64, of which vectors hold half."""
    _, first_column, first_row, columns, _ = grid
    before = np.int32(np.int32(row - first_row) * np.int32(columns))
    return np.int32(before + np.int32(column - first_column))


@part
def _order(bits: Any) -> Any:
    """Turn the bits of a float into an integer that is ordered as the floats are, and back."""
    return np.int32(bits ^ np.int32(np.int32(bits >> _SIGN) & _GREATEST))


@kernel(void(IN_F32_2D, IN_F32_1D, float32[:, ::1], int64, int64, int64))
def _measure_extent(
    directions: Float32Array, inverse_ranges: Float32Array, extents: Float32Array, part: int, first: int, last: int
) -> None:
    """Write the extent of some points; by integers, since SIMD finds no least of floats that may be NaN."""
    rightward, downward, known = directions[0, first:last], directions[1, first:last], inverse_ranges[first:last]
    extent = extents[part]
    a_bits, b_bits, found = rightward.view(np.int32), downward.view(np.int32), extent.view(np.int32)
    left, right, top, bottom = _GREATEST, _LEAST, _GREATEST, _LEAST
    for i in range(known.shape[0]):
        placed = _is_placed(rightward[i], downward[i], known[i])
        a, b = _order(a_bits[i]), _order(b_bits[i])
        left, right = min(left, a if placed else _GREATEST), max(right, a if placed else _LEAST)
        top, bottom = min(top, b if placed else _GREATEST), max(bottom, b if placed else _LEAST)
    if left <= right:
        found[0], found[1], found[2], found[3] = _order(left), _order(right), _order(top), _order(bottom)
    else:
        extent[0] = extent[2] = _INFINITE
        extent[1] = extent[3] = -_INFINITE


def measure_extent(
    directions: Float32Array, inverse_ranges: Float32Array, *, thread_pool: ThreadPool = ALONE
) -> Float32Array:
    """Measure the extent of points in the equal-area map.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; only points between zero and infinity count.
        thread_pool: the threads that share the points.

    Returns:
        (4,) float32 [rad]: the least and the greatest rightward, the least and the greatest downward; infinity and
        minus infinity where no point counts.
    """
    found = np.empty((thread_pool.size, 4), np.float32)
    thread_pool.share(Phase(len(inverse_ranges), partial(_measure_extent, directions, inverse_ranges, found)))
    extent: Float32Array = found.min(axis=0)
    extent[1::2] = found[:, 1::2].max(axis=0)
    return extent


@part
def _fit_grid(extent: Float32Array, cell: float, border: int) -> tuple[Any, Any, Any, int, int]:
    """Fit the smallest grid with `border` empty cells around what `measure_extent` gives for some points."""
    # gives 1 / cell [1/rad], the first column and row, counted from the edge of the map, and how many there are
    per_cell, some = np.float32(1.0 / cell), extent[0] <= extent[1]
    left, right = _step(extent[0], some, per_cell), _step(extent[1], some, per_cell)
    top, bottom = _step(extent[2], some, per_cell), _step(extent[3], some, per_cell)
    columns, rows = int(right - left) + 1 + 2 * border, int(bottom - top) + 1 + 2 * border
    return per_cell, np.int32(left - border), np.int32(top - border), columns, rows


@kernel(void(IN_F32_1D, float64, int64, int64[::1]))
def _position_grid(extent: Float32Array, cell: float, border: int, grid: AnyArray) -> None:
    _, grid[0], grid[1], grid[2], grid[3] = _fit_grid(extent, cell, border)


def position_grid(extent: Float32Array, cell: float, border: int) -> list[int]:
    """First column and row, columns and rows of the grid that `_fit_grid` fits."""
    grid = np.empty(4, np.int64)
    _position_grid(extent, cell, border, grid)
    return list(grid.tolist())


@part
def _number_cells(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, row * columns + column; 0, where no other point is, for one that does not count."""
    per_cell = grid[0]
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        number = _number(_step(a, placed, per_cell), _step(b, placed, per_cell), grid)
        numbers[i] = number if placed else np.int32(0)


@part
def _rank(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, counting: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, and its key: inverse range, then how far right and down in the cell."""
    # bits of positive floats are ordered as the floats, so the largest key is that of the nearest point, and of equally
    # near ones that of the one farther right
    per_cell, bits = grid[0], counting.view(np.int32)
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        steps_a = (a if placed else _NOTHING) * per_cell + _EDGE * per_cell
        steps_b = (b if placed else _NOTHING) * per_cell + _EDGE * per_cell
        column, row = np.int32(steps_a), np.int32(steps_b)
        right = np.int32((steps_a - np.float32(column)) * _PARTS)
        down = np.int32((steps_b - np.float32(row)) * _PARTS)
        number = _number(column, row, grid)
        numbers[i] = number if placed else np.int32(0)
        keys[i] = (np.int64(bits[i]) << 32) | (np.int64(right) << 16) | np.int64(down)


@part
def keep_nearest(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, counting: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, and raise the key of each cell to that of its nearest point.

    `rightward`, `downward`, `inverse_ranges` (M,) float32, as of `measure_extent`; `counting` (M,) float32 [1/m], by
    what they count as near; 0 for a point that is nearer than none; `grid`: what `_fit_grid` gives; `numbers` (M,)
    int32, written; 0, where no point is, for a point that takes no part; `keys` (cells,) int64, raised.
    """
    block_keys = np.empty(_BLOCK, np.int64)
    for start in range(0, numbers.shape[0], _BLOCK):
        stop = min(start + _BLOCK, numbers.shape[0])
        block = numbers[start:stop]
        _rank(
            rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], counting[start:stop], grid,
            block, block_keys,
        )  # fmt: skip
        for k in range(block.shape[0]):
            cell = np.uint32(block[k])
            keys[cell] = max(block_keys[k], keys[cell])


@part
def read_keys(keys: AnyArray, nearest: Float32Array, right: Float32Array, down: Float32Array) -> None:
    """Take keys apart.

    `keys` (cells,) int64; `nearest` (cells,) float32 [1/m], written: inverse range of the nearest point, 0 where the
    cell is empty; `right`, `down` (cells,) float32, written: how far into the cell it lies, 0 to 1.
    """
    nearest_bits = nearest.view(np.int32)
    for c in range(keys.shape[0]):
        nearest_bits[c] = np.int32(keys[c] >> 32)
        right[c] = np.float32(np.int32(keys[c] >> 16) & _LAST_PART) * _PART
        down[c] = np.float32(np.int32(keys[c]) & _LAST_PART) * _PART


@kernel(void(
    IN_F32_2D, IN_F32_1D, IN_F32_1D, float64, int64, int32[::1], int32[:, ::1], int64, int64, int64
))  # fmt: skip
def _occupy(
    directions: Float32Array, inverse_ranges: Float32Array, extent: Float32Array, cell: float, border: int,
    sampled: AnyArray, holders: AnyArray, part: int, first: int, last: int,
) -> None:  # fmt: skip
    """Put the numbers of points, from 1, into their cells (0: none), one row of `holders` a part; the last holds."""
    # the cells of evenly drawn points go to `sampled`; 0 for a point without a cell
    grid, numbers = _fit_grid(extent, cell, border), np.empty(_BLOCK, np.int32)
    count, own = inverse_ranges.shape[0], holders[part]
    own[:] = 0
    samples = min(sampled.shape[0], count)
    taken = -(-first * samples // count)
    for start in range(first, last, _BLOCK):
        stop = min(start + _BLOCK, last)
        block = numbers[: stop - start]
        _number_cells(directions[0, start:stop], directions[1, start:stop], inverse_ranges[start:stop], grid, block)
        for k in range(block.shape[0]):
            own[np.uint32(block[k])] = start + k + 1
        while taken < samples and taken * count // samples < stop:
            sampled[taken] = block[taken * count // samples - start]
            taken += 1
    own[0] = 0


@kernel(void(IN_I32_2D, int64, IN_I32_1D, IN_I64_1D, IN_I64_1D, IN_I64_1D, IN_F64_1D, float64[:, ::1], int64[:, ::1]))
def _find_holders(
    holders: Int32Array, columns: int, sampled: Int32Array, right: Int64Array, down: Int64Array, sectors: Int64Array,
    distances: Float64Array, found: Float64Array, neighbours: Int64Array,
) -> None:  # fmt: skip
    """Search around the sampled cells for those that any of the threads found occupied."""
    found[:], neighbours[:] = math.nan, -1
    offsets = np.empty(right.shape[0], np.int32)
    for k in range(offsets.shape[0]):
        offsets[k] = down[k] * columns + right[k]
    for s in range(sampled.shape[0]):
        missing = found.shape[1] if sampled[s] > 0 else 0
        for k in range(offsets.shape[0] if missing > 0 else 0):
            location = np.uint32(sampled[s] + offsets[k])
            holder = holders[0, location]
            for part in range(1, holders.shape[0]):
                holder = max(holder, holders[part, location])
            if holder > 0 and neighbours[s, sectors[k]] < 0:
                found[s, sectors[k]], neighbours[s, sectors[k]] = distances[k], holder - 1
                missing -= 1
                if missing == 0:
                    break


def find_neighbours(
    directions: Float32Array, inverse_ranges: Float32Array, extent: Float32Array, cell: float, right: Int64Array,
    down: Int64Array, sectors: Int64Array, distances: Float64Array, found: Float64Array, neighbours: Int64Array, *,
    thread_pool: ThreadPool = ALONE,
) -> None:  # fmt: skip
    """Write how far it is from some points, evenly drawn from the cloud, to the next point in each sector.

    Sample s of S is point s * M // S; of fewer points than S, every one is drawn once.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; 0 for a point that is ignored.
        extent: (4,) of the points, as of `measure_extent`.
        cell: resolution [rad]; points in one cell are not distinguished.
        right, down: (K,) columns and rows to the cells that are searched, the nearest first.
        sectors: (K,) number of the sector of such a cell.
        distances: (K,) how far such a cell is, in any unit.
        found: (samples, sectors), written: the distance of the first occupied cell; NaN for none.
        neighbours: (samples, sectors), written: a point in that cell; -1 for none.
        thread_pool: the threads that share the points; the result is the same.
    """
    reach = int(max(1, np.abs(right).max(), np.abs(down).max()))
    _, _, columns, rows = position_grid(extent, cell, reach)
    sampled, holders = np.zeros(len(found), np.int32), np.empty((thread_pool.size, columns * rows), np.int32)
    occupy = partial(_occupy, directions, inverse_ranges, extent, cell, reach, sampled, holders)
    thread_pool.share(Phase(len(inverse_ranges), occupy))
    _find_holders(holders, columns, sampled, right, down, sectors, distances, found, neighbours)


@part
def _slope(
    directions: Float32Array, inverse_ranges: Float32Array, own: int, one: int, other: int, nothing: float,
    margin: float, margin_share: float,
) -> float:  # fmt: skip
    """The slope of the inverse range from one neighbour to the other, NaN where the point is not on their line."""
    x, y, inverse = (float64(directions[0, own]), float64(directions[1, own]), float64(inverse_ranges[own]))
    to_one = math.hypot(directions[0, one] - x, directions[1, one] - y)
    to_other = math.hypot(directions[0, other] - x, directions[1, other] - y)
    apart = max(to_one + to_other, nothing)
    first, second = float64(inverse_ranges[one]), float64(inverse_ranges[other])
    off = abs(inverse - (first * to_other + second * to_one) / apart)
    # The map widens angles off its axis by up to 1 / cos(θ/2).
    scale = math.sqrt(max(1.0 - 0.25 * (x * x + y * y), 0.0))
    straight = off <= margin * inverse * inverse + margin_share * inverse
    return scale * abs(first - second) / apart if straight else math.nan


@kernel(void(IN_F32_2D, IN_F32_1D, IN_I64_1D, IN_I64_2D, float64, float64, float64, float64[::1]))
def find_slopes(
    directions: Float32Array, inverse_ranges: Float32Array, points: Int64Array, neighbours: Int64Array, nothing: float,
    margin: float, margin_share: float, slopes: Float64Array,
) -> None:  # fmt: skip
    """Write how fast the inverse range changes around some points, along the straightest steepest line there.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m].
        points: (S,) rows of `inverse_ranges`.
        neighbours: (S, sectors), likewise, -1 for none; sectors half of their number apart are opposite.
        nothing: neighbours nearer than this together count as so far apart [rad].
        margin: how far from the line between two opposite neighbours a point may lie [m] …
        margin_share: … plus this share of its range.
        slopes: (S,) [1/m/rad], written: the largest of all lines, NaN for a point that lies on none.
    """
    half = neighbours.shape[1] // 2
    for s in range(points.shape[0]):
        slopes[s] = math.nan
        for axis in range(half):
            one, other = neighbours[s, axis], neighbours[s, axis + half]
            if one >= 0 and other >= 0:
                slope = _slope(directions, inverse_ranges, points[s], one, other, nothing, margin, margin_share)
                slopes[s] = slopes[s] if slope <= slopes[s] or math.isnan(slope) else slope
