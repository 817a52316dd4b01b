"""Which points of a sparse cloud a camera can see.

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
from math import isfinite, radians

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, check_array
from sceneloom.colouring.lidar_trajectory import LidarTrajectory
from sceneloom.colouring.scan_lines import (
    CELLS_PER_REACH,
    USUAL_SURFACE_DISTANCE,
    Reach,
    find_lines,
    fit_reach,
    look_around,
    measure_spacings,
    measure_surface_distance,
)
from sceneloom.colouring.uneven_lines import Part, are_uneven, split_by_spacing
from sceneloom.errors import OptionError
from sceneloom.kernels.direction_grid import measure_extent
from sceneloom.kernels.directions import map_directions
from sceneloom.kernels.occlusion import mark_unhidden
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

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
            max(max(reach.window, reach.across, reach.along) / CELLS_PER_REACH, radians(_CELL_DEG)),
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
) -> tuple[list[tuple[Reach, Float32Array]], float]:
    """Take the settings' reach and surface distance, or measure in the cloud what they leave open.

    Returns:
        passes: each reach with the inverse ranges of the points that hide so far, (M,) float32, 0 for the others.
        surface_distance: of all of them [m].
    """
    window, near, distance = settings.window_deg, settings.near_deg, settings.surface_distance
    if distance is None and not from_lidar.known:
        distance = USUAL_SURFACE_DISTANCE
    if window is not None and near is not None and distance is not None:
        return [(Reach(radians(window), radians(near), radians(near)), inverse_ranges)], distance
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
    part: Part, inverse_ranges: Float32Array, window_deg: float | None, near_deg: float | None
) -> tuple[Reach, Float32Array]:
    hiding = np.where(part.members, inverse_ranges, np.float32(0.0))
    return _with(part.lines.reach, window_deg, near_deg), hiding


def _with(measured: Reach, window_deg: float | None, near_deg: float | None) -> Reach:
    """Take what is given instead of what was measured."""
    if near_deg is not None:
        measured = Reach(measured.window, radians(near_deg), radians(near_deg))
    return measured if window_deg is None else replace(measured, window=radians(window_deg))
