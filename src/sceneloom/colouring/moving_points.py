"""Points on moving objects: found by rays of other sweeps that pass through them, or by annotated boxes that move.

A point is voted free by another sweep whose rays pass it closely, all of them on to something clearly farther, and met
by one that measures something at its position. What is stationary is met again and again; what moves is elsewhere when
the other sweeps look. A sweep is compared with some before and some after it, so that little has to be kept. What moves
later than the last of these is not found, such as a parked car that leaves a minute after.

Votes of single points are noisy at outlines and where scan lines are far apart; neighbours decide with them.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np
from numba import int32, uint8, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array, check_array
from sceneloom.colouring.results import LidarTrajectory
from sceneloom.geometry.rigid import matrix_from_quaternion
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_1D, IN_F32_2D, IN_F64_1D, IN_F64_2D, IN_I32_2D, inlined
from sceneloom.kernels.voxels import number_cubes
from sceneloom.scene.annotations import CuboidAnnotation
from sceneloom.scene.annotations_at import CuboidAngles, CuboidPoses, cuboid_poses
from sceneloom.scene.scene import Scene

LAGS = (2, 5, 10, 15)
"""A sweep is compared with those so many sweeps before and after it."""

_LONG_DRIVE = 21  # shorter drives are compared over shorter times


def lags_for(sweeps: int) -> tuple[int, ...]:
    """The lags for a drive of so many sweeps, so that each has others to be compared with."""
    share = min(1.0, max(sweeps - 1, 1) / (_LONG_DRIVE - 1))
    return tuple(sorted({max(1, round(lag * share)) for lag in LAGS}))


_CELL_DEG = 0.5
_SURFACE_DISTANCE = 1.0  # surfaces pass the lidar at this distance or more [m]: lidars stand higher above the road
_MARGIN, _MARGIN_SHARE = 0.3, 0.01
_ASIDE = 0.2
_FARTHEST = 80.0
_NUMBERS = np.array([_SURFACE_DISTANCE, _MARGIN, _MARGIN_SHARE, _ASIDE, _FARTHEST])
_FEWEST_FREE = 2
_FREE_PER_MET = 0.5
_CUBE = 0.5

_SPECK, _MOSTLY = 0.12, 0.5
"""In a cube of neighbours, shares of moving points below which none of them is, and above which all are that were not
met."""

_Load = TypeVar("_Load")


@dataclass(frozen=True, slots=True, eq=False)
class SeenSweep:
    """A sweep by the directions in which it was measured."""

    points_world: Float32Array  # (N, 3) float32 [m]
    trajectory: LidarTrajectory  # of the lidar during it
    nearest: AnyArray  # (rows, columns) int32, the nearest point in each cell of directions

    @classmethod
    def of(cls, points_world: Float32Array, trajectory: LidarTrajectory) -> "SeenSweep":
        """Sort a sweep (N, 3) float32 [m] by directions."""
        check_array("points_world", points_world, (len(trajectory.fractions), 3), np.float32)
        columns = round(360 / _CELL_DEG)
        nearest = np.empty((columns // 2, columns), np.int32)
        points = np.ascontiguousarray(points_world)
        fill_directions(points, trajectory.fractions, np.ascontiguousarray(trajectory.ends_world), nearest)
        return cls(points, trajectory, nearest)


@dataclass(slots=True, eq=False)
class _Waiting(Generic[_Load]):
    """A sweep whose votes are not complete yet."""

    load: _Load
    sweep: SeenSweep | None
    free: UInt8Array
    met: UInt8Array


@dataclass(slots=True)
class MovingPoints(Generic[_Load]):
    """Finds moving points in a stream of sweeps, each of which is returned once those after it have been seen.

    Memory depends on the sweeps in between, not on the drive.

    Attributes:
        lags: so many sweeps before and after each one are compared with it, ascending.
    """

    lags: tuple[int, ...] = LAGS
    _window: deque[_Waiting[_Load]] = field(default_factory=deque)
    _due: int = 0

    def add(
        self, load: _Load, points_world: Float32Array, trajectory: LidarTrajectory | None
    ) -> Iterator[tuple[_Load, BoolArray]]:
        """Add a sweep of one lidar; return those that are judged now.

        Args:
            load: what belongs to the sweep and is returned with it.
            points_world: (N, 3) float32 [m].
            trajectory: of the lidar; None where unknown: then no points of it count as moving.

        Yields:
            The load of a sweep, and which of its points move, (N,) bool.
        """
        count = check_array("points_world", points_world, (None, 3), np.float32)
        sweep = None if trajectory is None else SeenSweep.of(points_world, trajectory)
        now = _Waiting(load, sweep, np.zeros(count, np.uint8), np.zeros(count, np.uint8))
        self._window.append(now)
        for lag in self.lags:
            if lag < len(self._window):
                before = self._window[-1 - lag]
                _vote(now, before)
                _vote(before, now)
        self._due += 1
        if self._due > self.lags[-1]:
            self._due -= 1
            yield self._judged(self._window[-1 - self.lags[-1]])
        if len(self._window) > 2 * self.lags[-1]:
            self._window.popleft()

    def flush(self) -> Iterator[tuple[_Load, BoolArray]]:
        """Return the sweeps that still wait, at the end of the stream."""
        waiting = list(self._window)[len(self._window) - self._due :]
        self._window.clear()
        self._due = 0
        for each in waiting:
            yield self._judged(each)

    def _judged(self, waiting: _Waiting[_Load]) -> tuple[_Load, BoolArray]:
        """Decide which points of a sweep move, by their own votes and those of their neighbours."""
        free, met = waiting.free, waiting.met
        if waiting.sweep is None:
            return waiting.load, np.zeros(len(free), np.bool_)
        own = (free >= _FEWEST_FREE) & (free > _FREE_PER_MET * met)
        numbers = np.empty(len(free), np.int64)
        count = number_cubes(waiting.sweep.points_world.astype(np.float64), _CUBE, numbers)
        inside = numbers >= 0
        held = np.bincount(numbers[inside], minlength=count)
        share = np.bincount(numbers[inside], own[inside], count) / np.maximum(held, 1)
        around = np.append(share, 0.0)[numbers]
        return waiting.load, (own & (around >= _SPECK)) | ((around >= _MOSTLY) & (met <= free))


def _vote(points: _Waiting[_Load], others: _Waiting[_Load]) -> None:
    if points.sweep is None or others.sweep is None:
        return
    other = others.sweep
    vote_free_space(
        points.sweep.points_world, other.points_world, other.trajectory.fractions,
        np.ascontiguousarray(other.trajectory.ends_world), other.nearest, _NUMBERS, points.free, points.met,
    )  # fmt: skip


_MOVES = 1.0
"""A box moves if its centre is ever so far from its first position [m]; annotations are more accurate than that."""

_ROOM = 0.15  # boxes are enlarged by this on all sides but below [m]: they are drawn around most points, not around all
_GROUND = 0.08  # points so near to the bottom of a box belong to the road [m]


@dataclass(frozen=True, slots=True, eq=False)
class MovingBoxes:
    """The cuboids of a scene that move."""

    cuboids: tuple[CuboidAnnotation, ...]  # the annotations, centres in the world
    angles: CuboidAngles  # convention of their angles

    @classmethod
    def of(cls, scene: Scene) -> "MovingBoxes":
        """Choose the cuboids that leave their first position."""
        cuboids = (each for each in scene.annotations if isinstance(each, CuboidAnnotation))
        return cls(tuple(each for each in cuboids if _moves(each)), CuboidAngles.of(scene))

    def inside(self, points_world: Float64Array, timestamps_ns: Int64Array) -> BoolArray:
        """Which points are in one of them at their own time.

        Args:
            points_world: (N, 3) float64 [m].
            timestamps_ns: (N,) int64 [ns].
        """
        found = np.zeros(len(points_world), np.bool_)
        if len(points_world) == 0:
            return found
        ends_ns = [int(timestamps_ns.min()), int(timestamps_ns.max())]
        for cuboid in self.cuboids:
            rows = self._near(cuboid, points_world, ends_ns)
            if len(rows):
                poses = cuboid_poses(cuboid, timestamps_ns[rows], angles=self.angles)
                found[rows] |= _within(points_world[rows], poses)
        return found

    def _near(self, cuboid: CuboidAnnotation, points_world: Float64Array, ends_ns: Sequence[int]) -> Int64Array:
        """Points within reach of the box between two times."""
        poses = cuboid_poses(cuboid, ends_ns, angles=self.angles)
        if not poses.there.any():
            return np.zeros(0, np.int64)
        centers, sizes = poses.centers_world[poses.there], poses.sizes_lwh[poses.there]
        reach = np.linalg.norm(sizes, axis=1).max() / 2 + _ROOM * 2 + np.ptp(centers, axis=0).max()
        apart = np.abs(points_world - centers.mean(axis=0)).max(axis=1)
        # a box that comes or goes within the sweep is known at one end only
        return np.flatnonzero(apart <= reach + (0.0 if poses.there.all() else 5.0))


def _moves(cuboid: CuboidAnnotation) -> bool:
    centers = cuboid.path.values[:, 3:6]
    if cuboid.stationary or len(centers) < 2:
        return False
    with np.errstate(invalid="ignore"):
        return bool(np.nanmax(np.linalg.norm(centers - centers[0], axis=1)) > _MOVES)


def _within(points_world: Float64Array, poses: CuboidPoses) -> BoolArray:
    inside = np.zeros(len(points_world), np.bool_)
    there = np.flatnonzero(poses.there)
    world_from_box = matrix_from_quaternion(poses.quaternions_xyzw[there])
    apart = points_world[there] - poses.centers_world[there]
    in_box = np.einsum("nij,ni->nj", world_from_box, apart)
    halves = poses.sizes_lwh[there] / 2
    above = in_box[:, 2] >= np.minimum(_GROUND, halves[:, 2]) - halves[:, 2]
    inside[there] = (np.abs(in_box) <= halves + _ROOM).all(axis=1) & above
    return inside


@inlined
def _cell(x: float, y: float, z: float, distance: float, rows: int, columns: int) -> tuple[int, int]:
    """Row and column of a direction: rows by elevation from the nadir, columns by azimuth."""
    column = int((math.atan2(y, x) / (2.0 * math.pi) + 0.5) * columns)
    row = int((math.asin(min(max(z / distance, -1.0), 1.0)) / math.pi + 0.5) * rows)
    return min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)


@kernel(void(IN_F32_2D, IN_F32_1D, IN_F64_2D, int32[:, ::1]))
def fill_directions(
    points_world: Float32Array, fractions: Float32Array, ends_world: Float64Array, nearest: AnyArray
) -> None:
    """Sort a sweep by the directions in which it was measured: the nearest point of each cell.

    `points_world` (N, 3) [m]; `fractions` (N,), how far along its trajectory the lidar was at each point; `ends_world`
    (2, 3) [m], the ends of that way; `nearest` (rows, columns), rows of points are written, -1 for none.
    """
    rows, columns = nearest.shape
    distances = np.full((rows, columns), np.inf)
    nearest[:] = -1
    for i in range(points_world.shape[0]):
        share = fractions[i]
        x = points_world[i, 0] - (ends_world[0, 0] + share * (ends_world[1, 0] - ends_world[0, 0]))
        y = points_world[i, 1] - (ends_world[0, 1] + share * (ends_world[1, 1] - ends_world[0, 1]))
        z = points_world[i, 2] - (ends_world[0, 2] + share * (ends_world[1, 2] - ends_world[0, 2]))
        distance = math.sqrt(x * x + y * y + z * z)
        if not 0.1 < distance < math.inf:
            continue
        row, column = _cell(x, y, z, distance, rows, columns)
        if distance < distances[row, column]:
            distances[row, column] = distance
            nearest[row, column] = i


@inlined
def _near(row: int, column: int, nearest: AnyArray) -> int:
    """Some point of the cells around one, or -1."""
    rows, columns = nearest.shape
    for location in range(9):
        r, c = row + location // 3 - 1, (column + location % 3 - 1) % columns
        if 0 <= r < rows and nearest[r, c] >= 0:
            return int(nearest[r, c])
    return -1


@inlined
def _vote_of(
    x: float, y: float, z: float, distance: float, row: int, column: int, others_world: Float32Array,
    fractions: Float32Array, ends_world: Float64Array, nearest: AnyArray, numbers: Float64Array,
) -> int:  # fmt: skip
    """What rays around a direction state of a point: 1 they pass through, 2 they meet something there, 0 nothing."""
    rows, columns = nearest.shape
    inverse = 1.0 / distance
    margin = numbers[1] * inverse * inverse + numbers[2] * inverse
    through, stopped = False, False
    for location in range(9):
        r, c = row + location // 3 - 1, (column + location % 3 - 1) % columns
        if not 0 <= r < rows or nearest[r, c] < 0:
            continue
        k = nearest[r, c]
        ox = others_world[k, 0] - (ends_world[0, 0] + fractions[k] * (ends_world[1, 0] - ends_world[0, 0]))
        oy = others_world[k, 1] - (ends_world[0, 1] + fractions[k] * (ends_world[1, 1] - ends_world[0, 1]))
        oz = others_world[k, 2] - (ends_world[0, 2] + fractions[k] * (ends_world[1, 2] - ends_world[0, 2]))
        away = math.sqrt(ox * ox + oy * oy + oz * oz)
        ax, ay, az = ox / away - x * inverse, oy / away - y * inverse, oz / away - z * inverse
        angle = math.sqrt(ax * ax + ay * ay + az * az)
        nearer = 1.0 / away - inverse
        step, beside = angle / numbers[0] + margin, angle * distance <= numbers[3]
        if abs(nearer) <= step and beside:
            return 2
        through = through or (nearer < -step and beside)
        stopped = stopped or nearer >= -step
    return 1 if through and not stopped else 0


@kernel(void(IN_F32_2D, IN_F32_2D, IN_F32_1D, IN_F64_2D, IN_I32_2D, IN_F64_1D, uint8[::1], uint8[::1]))
def vote_free_space(
    points_world: Float32Array, others_world: Float32Array, fractions: Float32Array, ends_world: Float64Array,
    nearest: AnyArray, numbers: Float64Array, free: UInt8Array, met: UInt8Array,
) -> None:  # fmt: skip
    """Count for each point whether another sweep looked through its location, or met something there.

    Inverse range changes on a surface by at most the angle over the distance at which its plane passes the lidar; what
    changes by more lies before or behind it. Rays that pass a point too far aside state nothing.

    `points_world` (N, 3) [m]; `others_world`, `fractions`, `ends_world`, `nearest`: the other sweep, as for and from
    `fill_directions`; `numbers`: distance at which surfaces pass the lidar [m], margin [m], margin as a share of the
    range, how far aside a ray may pass a point [m], farthest range [m]; `free`, `met` (N,), counted up by 1.
    """
    rows, columns = nearest.shape
    for i in range(points_world.shape[0]):
        share, looks = 0.5, 0
        x, y, z, distance, row, column = 0.0, 0.0, 0.0, 0.0, 0, 0
        # where the lidar was when it looked this way is known once it is known which way that is
        while looks < 2:
            x = points_world[i, 0] - (ends_world[0, 0] + share * (ends_world[1, 0] - ends_world[0, 0]))
            y = points_world[i, 1] - (ends_world[0, 1] + share * (ends_world[1, 1] - ends_world[0, 1]))
            z = points_world[i, 2] - (ends_world[0, 2] + share * (ends_world[1, 2] - ends_world[0, 2]))
            distance = math.sqrt(x * x + y * y + z * z)
            if not 0.5 < distance < numbers[4]:
                break
            row, column = _cell(x, y, z, distance, rows, columns)
            found = _near(row, column, nearest)
            if found < 0:
                break
            share = fractions[found]
            looks += 1
        if looks < 2:
            continue
        vote = _vote_of(
            x, y, z, distance, row, column, others_world, fractions, ends_world, nearest, numbers
        )  # fmt: skip
        if vote == 2:
            met[i] = min(met[i] + 1, 255)
        elif vote == 1:
            free[i] = min(free[i] + 1, 255)
