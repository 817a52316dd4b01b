"""Which points of a sparse cloud a camera sees: occlusion that bridges the gaps between scan lines, even or uneven.

Many have lines a sixth of a degree apart in the middle and a degree or more above and below; rosettes are dense in the
middle. A reach for all of them would be too short for the sparse part, behind which everything shows through, or too
long for the dense one. How far a surface may go on beyond its last sample is a matter of the lines that hit it, so each
point hides with the reach of its own part of the lidar's view. There, spacings do not depend on what stands where: seen
from the camera the lines on a near thing lie between those on things far behind it.

A z-buffer over the pixels removes almost nothing: points lie several pixels apart, so between two scan lines on a car
the street behind it shows through. What must be reported is a gap between the samples of one surface from a gap between
two surfaces. The rule here rests on two facts.

**Inverse range is tame on a surface.** A plane at distance d from the camera, seen in the unit direction u, lies at
range ρ with 1/ρ = n·u / d. Between two directions an angle α apart, 1/ρ therefore changes by at most α/d, however
grazing the view. So a point Q can only hide a point P, α away, if

    1/ρ_Q - 1/ρ_P  >  α / surface_distance  +  m,      m = margin / ρ_P² + margin_share / ρ_P

where m is what Q must be nearer (in metres and as a share of the range, for noise and calibration). No surface whose
plane is at least `surface_distance` away from the camera hides itself: not the road seen at grazing angle, not the wall
along it. The larger this distance may be, the more is found between scan lines that are far apart; the steepest changes
from point to point in the cloud itself report how near its surfaces pass the camera, which mostly is its height.

**Hidden points lie within silhouettes.** P is hidden if one such Q is so near in direction that no other sample of
Q's surface can be expected between them, or if two of them lie in opposite quadrants around P within a window. Q on
one side only, and farther away, is a neighbour beyond a silhouette: P is the background beside it and stays. How near
is near depends on the lidar: an ellipse of 0.95 spacings across the scan lines and 1.3 along them (between the last
line on a roof and the next, which misses it, nothing reports where the roof ends; the point that is coloured wrongly is
the worse loss), less 0.08 degrees, within which no calibration says on which side of an outline a point lies. The
window reaches a little over one spacing of the scan lines. Since lidars differ, and mountings rotate and tilt them, the
spacings and their axes are measured in the cloud, as the camera sees it. Where lines lie close together in one part of
a lidar's view and far apart in another, each point hides with the reach of its own part (`uneven_lines`).

**The lidar saw P.** So no edge of Q's surface reached P as the lidar saw the two: between them the edge may be
anywhere. From the lidar to the camera Q shifts against P by the difference of their inverse ranges times the eye's
trajectory across the line of sight. Only if P has come as near to Q as 0.85 of what they were apart, or gone behind it,
can the edge cover it now; where lidar and camera look at a kerb or a ditch from nearly the same location, the road
behind it stays. This is asked of one Q alone, where it is known from where the lidar measured; without that, surfaces
must be taken to pass the camera at half a metre, since uneven ground would hide itself otherwise.

Directions are compared in Lambert's equal-area map around the optical axis, in which distances are nearly angles. The
rule therefore holds for every camera model and resolution alike. To be fast, only the nearest point in each cell of a
grid over that map can hide others; cells are 0.16 degrees wide, or a sixth of the reach.

On simulated streets, 2 px from outlines and more, where it is known from where the lidar measured: of the hidden points
whose concealing surface the lidar could see, lidars of 64 lines let at most 0.5 % pass, of 128 lines 1.2 %, of uneven
lines 0.3 to 1.6 %, of 32 lines 1 to 3 %, of 16 lines (2 degrees apart) up to 12 %; of the visible ones 0.2 to 0.6 % are
lost, 0.5 to 2.8 %, and 1 to 2 %. What the lidar could not see conceals nothing: high above the camera it looks over
parked cars, and up to 33 % of what they hide pass. The figures stand in docs/fusion.md.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import cos, degrees, isfinite, isnan, log, pi, radians, sin

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, check_array
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.errors import OptionError
from sceneloom.kernels.direction_grid import (
    find_neighbours,
    find_slopes,
    measure_across,
    measure_along_axes,
    measure_extent,
)
from sceneloom.kernels.occlusion import mark_unhidden
from sceneloom.kernels.projection import map_directions
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

_CELL = radians(0.1)

_REACH_CELLS = 25

_SPARSEST = _CELL * _REACH_CELLS
"""Neighbours farther away are not found [rad]."""

_SAMPLES = 256

_SECTORS = 8

_WINDOW_PER_SPACING = 1.15

_NEAR_PER_SPACING_ACROSS, _NEAR_PER_SPACING_ALONG, _OUTLINE_DEG = 0.95, 1.3, 0.08

_WINDOWS_DEG, _NEARS_DEG = (0.3, 3.0), (0.1, 2.4)

_USUAL_WINDOW_DEG, _USUAL_NEAR_DEG = 0.5, 0.16

_CELLS_PER_REACH = 6
"""How fine the grid is in which points are compared."""

_USUAL_SURFACE_DISTANCE = 0.5
"""Where nothing was measured [m]: below the height of nearly all cameras."""

_SURFACE_DISTANCES = (0.1, 1.5)

_OF_SURFACE_DISTANCE, _STEEPER_THAN, _FEWEST_SURFACES = 0.8, 0.95, 32


@dataclass(frozen=True, slots=True)
class _Reach:
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
    def reach(self) -> "_Reach":
        """How far occlusion must reach to bridge them."""
        across, along = degrees(self.across), degrees(self.along)
        window = _bounded(_WINDOW_PER_SPACING * across, *_WINDOWS_DEG)
        # Of the points of a cell only the nearest counts, so that what is near reaches a cell at least.
        least = max(_NEARS_DEG[0], window / _CELLS_PER_REACH)
        return _Reach(
            radians(window),
            radians(_bounded(_NEAR_PER_SPACING_ACROSS * across - _OUTLINE_DEG, *_NEARS_DEG)),
            radians(_bounded(_NEAR_PER_SPACING_ALONG * along - _OUTLINE_DEG, least, _NEARS_DEG[1])),
            self.angle,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Neighbours:
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
) -> _Neighbours:
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
    return _Neighbours(points, ids[:drawn], distances[:drawn])


def measure_spacings(neighbours: _Neighbours) -> Float64Array:
    """Measure how far apart the points of a cloud appear along four axes.

    Returns:
        (4,) float64 [rad], mean of the middle half of the distances along the axes at 0, 45, 90 and 135 degrees from
        rightward to downward, 0.1 to 2.5 degrees; NaN where fewer than half of the neighbours are so near.
    """
    spacings = np.empty(_SECTORS // 2)
    measure_along_axes(neighbours.distances, _CELL, _REACH_CELLS, _SAMPLES, spacings)
    return spacings


def measure_surface_distance(
    neighbours: _Neighbours,
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
        return _USUAL_SURFACE_DISTANCE
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


def fit_reach(lines: ScanLines | None) -> _Reach:
    """Fit the reach to scan lines; a usual one where there are none."""
    if lines is None:
        return _Reach(radians(_USUAL_WINDOW_DEG), radians(_USUAL_NEAR_DEG), radians(_USUAL_NEAR_DEG))
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


_UNEVEN = 2.5
"""How many times as far apart sparse neighbours are as dense ones. Where all lines lie alike, what stands before what
and the bending of a fisheye make that up to 2.1; lidars as above have 4.1 and more (simulated streets, PandaSet)."""

_DENSE, _SPARSE = 15.0, 93.0

_FEWEST = 64

_SPARSER_THAN = 1.5

_UNEVEN_LINES_SAMPLES = 2048

_TILE_ACROSS, _TILE_ALONG = radians(1.0), radians(8.0)

_LEAST_IN_TILE = 2

_LEAST_KNOWN = 5

_STEP = log(2.0)

_LEAST_SHARE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Points whose scan lines lie alike.

    Attributes:
        lines: how.
        members: (M,) bool.
    """

    lines: ScanLines
    members: BoolArray


def are_uneven(neighbours: _Neighbours) -> bool:
    """Report whether the lines around some points lie so differently that one reach does not fit all."""
    spacings = _around(neighbours)
    spacings.sort()
    known = spacings[: int(spacings.searchsorted(np.inf))]
    if len(known) < _FEWEST:
        return False
    return _percentile(known, _SPARSE) > _UNEVEN * _percentile(known, _DENSE)


def split_by_spacing(directions: Float32Array, inverse_ranges: Float32Array, lines: ScanLines) -> list[_Part]:
    """Split a cloud by how far apart its scan lines are where its points lie.

    Args:
        directions: (2, M) float32 [rad], where the lidar saw the points, in the equal-area map.
        inverse_ranges: (M,) float32 [1/m]; 0 for a point that takes no part.
        lines: of the cloud as a whole, in case that too few points report how its sparse lines lie.

    Returns:
        Parts in which spacings are alike within a factor of two; less than a hundredth of the points makes no part.
    """
    neighbours = look_around(directions, inverse_ranges, samples=_UNEVEN_LINES_SAMPLES)
    of_samples = _around(neighbours)
    lines = _sparse_lines(neighbours, of_samples, lines)
    tiles, columns = _tiles(directions, lines.angle)
    spacings = _spread(of_samples, tiles[neighbours.points], int(tiles.max()) // columns + 1, columns)
    # Tiles are few beside points: all is decided for them, each as often as it has points.
    counts = np.bincount(tiles, minlength=len(spacings))
    steps = np.rint(np.log(spacings / _median(spacings, counts)) / _STEP).astype(np.int64)
    parts = []
    for step in _filled(steps, counts):
        inside = steps == step
        across = _median(spacings[inside], counts[inside])
        parts.append(_Part(ScanLines(across, lines.along, lines.angle), inside[tiles]))
    return parts


def _percentile(ordered: Float64Array, share: float) -> float:
    """Give the value below which so many per cent lie, linearly between two."""
    location = share / 100 * (len(ordered) - 1)
    below = int(location)
    above = min(below + 1, len(ordered) - 1)
    least, most = float(ordered[below]), float(ordered[above])
    return least + (location - below) * (most - least)


def _median(values: Float64Array, counts: Int64Array) -> float:
    """Give the median of values each of which is there so many times."""
    order = np.argsort(values)
    behind = np.cumsum(counts[order])
    middle = np.searchsorted(behind, [(behind[-1] - 1) // 2, behind[-1] // 2], side="right")
    return float(values[order][middle].mean())


def _sparse_lines(neighbours: _Neighbours, spacings: Float64Array, lines: ScanLines) -> ScanLines:
    """Report how lines lie from where they are far apart: dense ones look much the same across and along."""
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


def _filled(steps: Int64Array, counts: Int64Array) -> list[int]:
    """Give the steps that have enough points, and let those of the others join the nearest of them, in place."""
    found, which = np.unique(steps, return_inverse=True)
    points = np.bincount(which, weights=counts)
    kept = found[(points >= _LEAST_SHARE * counts.sum()) & (points > 0)]
    nearest = kept[np.argmin(np.abs(found[:, None] - kept), axis=1)]
    steps[:] = nearest[np.searchsorted(found, steps)]
    filled: list[int] = kept.tolist()
    return filled


def _around(neighbours: _Neighbours) -> Float64Array:
    """Give the spacing of the lines around each point [rad], whichever trajectory they lie; NaN where few are in reach.

    Of eight sectors two look along the line, the others to the next lines: the upper quartile is across.
    """
    spacings = np.empty(len(neighbours.points))
    measure_across(neighbours.distances, _LEAST_KNOWN, spacings)
    return spacings


def _tiles(directions: Float32Array, angle: float) -> tuple[Int64Array, int]:
    """Number the tiles, long along the lines, that points lie in, (M,), and state how many lie side by side."""
    c, s = cos(angle), sin(angle)
    across = np.floor((c * directions[0] + s * directions[1]) / _TILE_ACROSS).astype(np.int64)
    along = np.floor((c * directions[1] - s * directions[0]) / _TILE_ALONG).astype(np.int64)
    columns = int(np.ptp(along)) + 1
    return (across - across.min()) * columns + along - along.min(), columns


def _spread(spacings: Float64Array, tiles: Int64Array, rows: int, columns: int) -> Float64Array:
    """Give each tile the median spacing of the samples in it; without, that of the nearest row of tiles."""
    field = np.full((rows, columns), np.nan)
    reported, medians = _medians(tiles, np.where(np.isnan(spacings), _SPARSEST, spacings))
    field.ravel()[reported] = medians
    known = np.flatnonzero(np.isfinite(field).any(axis=1))
    if len(known) == 0:
        return np.full(field.size, _SPARSEST)
    of_rows = np.nanmedian(field[known], axis=1)
    nearest = np.argmin(np.abs(np.arange(rows)[:, None] - known), axis=1)
    whole = np.where(np.isnan(field), of_rows[nearest][:, None], field)
    spread: Float64Array = whole.ravel()
    return spread


def _medians(groups: Int64Array, values: Float64Array) -> tuple[Int64Array, Float64Array]:
    """Give the groups that have enough values, rising, and their medians."""
    order = np.lexsort((values, groups))
    found, first, counts = np.unique(groups[order], return_index=True, return_counts=True)
    medians = 0.5 * (values[order][first + (counts - 1) // 2] + values[order][first + counts // 2])
    enough = counts >= _LEAST_IN_TILE
    return found[enough], medians[enough]


Looks = tuple[Float32Array, Float32Array]
"""Where a camera sees M points: directions (2, M) in the equal-area map [rad], inverse ranges (M,) [1/m]."""

_CELL_DEG = 0.16

_NEARING = 0.85

_STRAIGHTNESS = 0.5

_MOST_THREADS = 256

_NO_TRAJECTORY = (np.zeros((0, 3)), np.zeros(0, np.float32))


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilitySettings:
    """What counts as hidden behind a nearer surface.

    Attributes:
        enabled: False leaves a plain z-buffer over the pixels.
        window_deg: how far things on opposite sides of a point may be from it to hide it [deg]; None for 1.15 times
            the spacing of the scan lines, measured from the cloud, between 0.3 and 3.
        near_deg: within this one thing alone hides a point [deg]; None for 0.95 times the spacing of the scan lines
            across them and 1.3 times the spacing of the points along them, less 0.08, measured, between 0.1 and 2.4.
        surface_distance: surfaces whose plane passes the camera farther away than this never hide themselves [m];
            less than the height of the camera above the ground. None: where it is known from where the lidar measured,
            four fifths of what is measured in the cloud, between 0.1 and 1.5; 0.5 otherwise.
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        threads: how many share the work on one cloud; what they find is the same.

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
            raise OptionError(
                f"surface_distance {self.surface_distance}; expected a positive distance in metres"
            )
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
    """Report which of some points the camera sees, as far as these points themselves can state.

    Args:
        points_world: (N, 3) float64 [m], contiguous.
        point_ids: (M,) int64, those that fall into the image; only they hide one another.
        camera_from_world: (3, 4) or (4, 4) float64, contiguous.
        settings: the rule's numbers; `enabled` is not looked at.
        trajectory: from where the lidar measured the N points; None where that is not known.
        looks: what `map_directions` gives for the M points, where it is known already.

    Returns:
        (M,) bool.

    Raises:
        ArrayError: `trajectory` is that of another number of points.
    """
    if trajectory is not None:
        check_array("trajectory.fractions", trajectory.fractions, (len(points_world),), np.float32)
    thread_pool = ThreadPool.of(settings.threads, len(point_ids))
    directions, inverse_ranges = (
        _look(points_world, point_ids, camera_from_world, thread_pool) if looks is None else looks
    )
    visible = np.zeros(len(point_ids), np.bool_)
    eyes, fractions = (
        _NO_TRAJECTORY
        if trajectory is None
        else (_in_camera(trajectory.ends_world, camera_from_world), trajectory.fractions)
    )
    from_lidar = _FromLidar(points_world, point_ids, camera_from_world, eyes, fractions)
    extent = measure_extent(directions, inverse_ranges, thread_pool=thread_pool)
    passes, surface_distance = _measure(directions, inverse_ranges, extent, settings, from_lidar, thread_pool)
    for number, (reach, hiding) in enumerate(passes):
        seen = np.empty(len(point_ids), np.bool_)
        mark_unhidden(
            directions,
            inverse_ranges,
            hiding,
            extent,
            max(max(reach.window, reach.across, reach.along) / _CELLS_PER_REACH, radians(_CELL_DEG)),
            reach.window,
            *reach.ellipse,
            1.0 / surface_distance,
            settings.margin,
            settings.margin_share,
            eyes,
            point_ids,
            fractions,
            _NEARING,
            seen,
            thread_pool=thread_pool,
        )
        visible = seen if number == 0 else visible & seen
    return visible


def _look(
    points_world: Float64Array,
    point_ids: Int64Array,
    camera_from_world: Float64Array,
    thread_pool: ThreadPool,
) -> Looks:
    directions, inverse_ranges = (
        np.empty((2, len(point_ids)), np.float32),
        np.empty(len(point_ids), np.float32),
    )
    map_directions(
        points_world, point_ids, camera_from_world, directions, inverse_ranges, thread_pool=thread_pool
    )
    return directions, inverse_ranges


@dataclass(frozen=True, slots=True, eq=False)
class _FromLidar:
    """Points, and from where the lidar measured them; arguments of `find_visible`, eyes in the camera frame."""

    points_world: Float64Array
    point_ids: Int64Array
    camera_from_world: Float64Array
    eyes: Float64Array
    fractions: Float32Array

    @property
    def known(self) -> bool:
        """Whether it is known from where."""
        return len(self.eyes) > 0

    def directions(self) -> Float32Array:
        """Where the lidar saw the points, (2, M) in the equal-area map around the camera's axis [rad]."""
        share = self.fractions[self.point_ids, None].astype(np.float64)
        from_eyes = _in_camera(self.points_world[self.point_ids], self.camera_from_world)
        from_eyes -= self.eyes[0] + share * (self.eyes[1] - self.eyes[0])
        return _look(from_eyes, np.arange(len(from_eyes)), np.eye(4), ALONE)[0]


def _in_camera(points_world: Float64Array, camera_from_world: Float64Array) -> Float64Array:
    moved: Float64Array = points_world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    return np.ascontiguousarray(moved)


def _measure(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    extent: Float32Array,
    settings: VisibilitySettings,
    from_lidar: _FromLidar,
    thread_pool: ThreadPool,
) -> tuple[list[tuple[_Reach, Float32Array]], float]:
    """Take the settings' reach and surface distance, or measure in the cloud what they leave open.

    Returns:
        passes: each reach with the inverse ranges of the points that hide so far, (M,) float32, 0 for the others.
        surface_distance: of all of them [m].
    """
    window, near, distance = settings.window_deg, settings.near_deg, settings.surface_distance
    if distance is None and not from_lidar.known:
        distance = _USUAL_SURFACE_DISTANCE
    if window is not None and near is not None and distance is not None:
        return [(_Reach(radians(window), radians(near), radians(near)), inverse_ranges)], distance
    neighbours = look_around(directions, inverse_ranges, extent=extent, thread_pool=thread_pool)
    if distance is None:
        margins = _STRAIGHTNESS * settings.margin, _STRAIGHTNESS * settings.margin_share
        distance = measure_surface_distance(neighbours, directions, inverse_ranges, *margins)
    spacings = measure_spacings(neighbours)
    lines = find_lines(spacings)
    if lines is not None and (window is None or near is None) and are_uneven(neighbours):
        seen = from_lidar.directions() if from_lidar.known else directions
        parts = split_by_spacing(seen, inverse_ranges, lines)
        if len(parts) > 1:
            return [_pass(part, inverse_ranges, window, near) for part in parts], distance
    return [(_with(fit_reach(lines), window, near), inverse_ranges)], distance


def _pass(
    part: _Part, inverse_ranges: Float32Array, window_deg: float | None, near_deg: float | None
) -> tuple[_Reach, Float32Array]:
    hiding = np.where(part.members, inverse_ranges, np.float32(0.0))
    return _with(part.lines.reach, window_deg, near_deg), hiding


def _with(measured: _Reach, window_deg: float | None, near_deg: float | None) -> _Reach:
    """Take what is given instead of what was measured."""
    if near_deg is not None:
        measured = _Reach(measured.window, radians(near_deg), radians(near_deg))
    return measured if window_deg is None else replace(measured, window=radians(window_deg))
