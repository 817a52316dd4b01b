"""Lidar odometry: the ego trajectory from lidar sweeps alone, each registered onto a local map of surfaces."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise, product
from types import MappingProxyType

import numpy as np
import small_gicp
from numba import float64, int32, int64, types, uint8

from sceneloom.arrays import AnyArray, Float64Array, FloatArray, Int64Array
from sceneloom.errors import ArrayError, DataError, OptionError, PoseError
from sceneloom.geometry.rigid import (
    RigidTransform,
    matrix_from_rotation_vector,
    multiply_quaternions,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
    slerp,
)
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.poses import rotation_of_vector
from sceneloom.kernels.signatures import IN_F64_1D, IN_F64_2D, inlined
from sceneloom.kernels.voxels import first_location, first_of_cubes, number_cubes
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, sweep_period_ns
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import DataWarning, assumed, repaired, skipped

NAME = "lidar"
"""Name of the trajectory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryConfiguration:
    """Settings of lidar odometry; the defaults are meant for every lidar on every road vehicle.

    Attributes:
        cube: side of the cubes that the map cuts space into [m].
        spacing: of a sweep, one point per cube of this side is registered [m].
        nearest, farthest: points nearer or farther than this are not used [m]: the ego itself, and noise.
        map_reach: what lies farther from the ego is dropped from the map [m].
        range_noise: standard deviation of a point across a flat surface [m].
        acceleration: how fast the velocity usually changes [m/s²].
        yaw_acceleration: how fast the angular velocity usually changes [rad/s²].
        least_points: a sweep with fewer usable points is not registered.

    Raises:
        OptionError: a number is not positive, or farthest is not beyond nearest.
    """

    cube: float = 1.0
    spacing: float = 0.75
    nearest: float = 1.5
    farthest: float = 120.0
    map_reach: float = 120.0
    range_noise: float = 0.02
    acceleration: float = 3.0
    yaw_acceleration: float = 1.0
    least_points: int = 200

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not getattr(self, name) > 0:
                raise OptionError(f"odometry.{name}: {getattr(self, name)}; expected a positive number")
        if self.farthest <= self.nearest:
            raise OptionError(f"odometry.farthest: {self.farthest} m; expected more than nearest, {self.nearest} m")


_ROTATION, _SHIFT, _YAW_RATE, _VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""Rows of the state's covariance."""


@dataclass(frozen=True, slots=True, eq=False)
class _MotionState:
    """The ego's pose and motion at one time."""

    timestamp_ns: int  # [ns]
    rotation: Float64Array  # (3, 3) `world_from_ego`
    position: Float64Array  # (3,) [m], world frame
    yaw_rate: Float64Array  # (3,) angular velocity [rad/s], world axes
    velocity: Float64Array  # (3,) [m/s], world axes
    covariance: Float64Array  # (12, 12) of rotation, translation, changes of both velocities; world axes

    def at(self, timestamp_ns: int) -> tuple[Float64Array, Float64Array]:
        """Rotation and position at another time, at constant velocity and angular velocity in the ego frame."""
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        bend = 0.5 * dt * dt * np.cross(self.yaw_rate, self.velocity)
        rotation = matrix_from_rotation_vector(self.yaw_rate * dt) @ self.rotation
        return rotation, self.position + dt * self.velocity + bend

    def predicted(self, timestamp_ns: int, configuration: OdometryConfiguration) -> "_MotionState":
        """The state at a later time; accelerations add to its uncertainty."""
        # Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, piecewise constant white acceleration
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        rotation, position = self.at(timestamp_ns)
        step = np.eye(12)
        step[_ROTATION, _YAW_RATE] = step[_SHIFT, _VELOCITY] = dt * np.eye(3)
        noise = np.zeros((12, 12))
        for value, rate, size in (
            (_ROTATION, _YAW_RATE, configuration.yaw_acceleration),
            (_SHIFT, _VELOCITY, configuration.acceleration),
        ):
            gains = (value, 0.5 * dt * dt * size), (rate, dt * size)
            for (first, a), (second, b) in product(gains, gains):
                noise[first, second] = a * b * np.eye(3)
        velocity = matrix_from_rotation_vector(self.yaw_rate * dt) @ self.velocity
        covariance = step @ self.covariance @ step.T + noise
        return _MotionState(timestamp_ns, rotation, position, self.yaw_rate, velocity, covariance)

    def changed(self, step: Float64Array) -> "_MotionState":
        """The state after small changes, (12,)."""
        return replace(
            self,
            rotation=matrix_from_rotation_vector(step[_ROTATION]) @ self.rotation,
            position=self.position + step[_SHIFT],
            yaw_rate=self.yaw_rate + step[_YAW_RATE],
            velocity=self.velocity + step[_VELOCITY],
        )

    def minus(self, other: "_MotionState") -> Float64Array:
        """The changes, (12,), that lead from another state to this one."""
        rotation = rotation_vector_from_matrix(self.rotation @ other.rotation.T)
        position, yaw_rate = self.position - other.position, self.yaw_rate - other.yaw_rate
        return np.concatenate([rotation, position, yaw_rate, self.velocity - other.velocity])

    def moved(self, rotation: Float64Array, translation: Float64Array) -> "_MotionState":
        """The state with its pose changed by a motion in the ego frame."""
        position = self.position + self.rotation @ translation
        return replace(self, rotation=self.rotation @ rotation, position=position)


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """The usable points of a sweep."""

    timestamp_ns: int  # the middle of its time, to which its pose refers [ns]
    first_ns: int  # first of all its points [ns]
    last_ns: int  # last of them [ns]
    points_ego: Float64Array  # (N, 3) float64 [m], each as measured at its own time
    seconds: Float64Array  # (N,) float64, after `timestamp_ns`
    chosen: Int64Array  # (M,) int64, the points to register, evenly spread

    @classmethod
    def of(
        cls,
        timestamp_ns: int,
        positions_ego: FloatArray,
        timestamps_ns: Int64Array | None,
        configuration: OdometryConfiguration,
    ) -> "_Sweep":
        """Leave out points that are not finite, too near or too far, and choose those to register."""
        first_ns = last_ns = timestamp_ns
        if timestamps_ns is not None and len(timestamps_ns):
            first_ns, last_ns = int(timestamps_ns.min()), int(timestamps_ns.max())
        middle_ns = (first_ns + last_ns) // 2
        with np.errstate(over="ignore", invalid="ignore"):
            squared = np.einsum("ij,ij->i", positions_ego, positions_ego)
        usable = np.flatnonzero((squared > configuration.nearest**2) & (squared < configuration.farthest**2))
        points = np.asarray(positions_ego[usable], np.float64)
        offsets_ns = np.zeros(len(points), np.int64) if timestamps_ns is None else timestamps_ns[usable] - middle_ns
        numbers = np.empty(len(points), np.int64)
        chosen = np.empty(number_cubes(points, configuration.spacing, numbers), np.int64)
        first_of_cubes(numbers, chosen)
        return cls(middle_ns, first_ns, last_ns, points, np.asarray(offsets_ns * 1e-9), chosen)

    @property
    def chosen_points(self) -> Float64Array:
        """(M, 3) [m], ego frame."""
        return self.points_ego[self.chosen]

    def to_world(self, state: _MotionState) -> Float64Array:
        """The points (N, 3) [m], each by the pose at its own time."""
        return _to_world(state, self.points_ego, self.seconds)[0]


def _to_world(
    state: _MotionState, points_ego: Float64Array, seconds: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Points (N, 3) [m] in the world, each (N,) seconds after the state; the arms from the ego to them, world axes."""
    points_world, arms = np.empty_like(points_ego), np.empty_like(points_ego)
    move_points(points_ego, seconds, state.rotation, state.position, state.yaw_rate, state.velocity, points_world, arms)
    return points_world, arms


_INITIAL_CAPACITY = 1 << 15
_LEAST_POINTS = 5.0  # points that a cube needs for a surface

_MOST_HITS = 3
"""Points that each part of a cube takes: a full part stays as it was measured first, so that a stationary ego changes
nothing, and the map does not follow the poses that were estimated with it."""


class SurfaceLevel:
    """Cubes of space of one size, with the mean and the spread of the points in them."""

    def __init__(self, leaf: float, noise: float) -> None:
        """Start empty, with cubes of side `leaf` [m] for points with a standard deviation `noise` [m]."""
        self.leaf, self._noise = leaf, noise
        self.count = 0
        self.keys = np.zeros(_INITIAL_CAPACITY, np.int64)
        self.table = np.full(4 * _INITIAL_CAPACITY, -1, np.int32)
        self.surfaces = np.zeros((_INITIAL_CAPACITY, 15))
        self._moments = np.zeros((_INITIAL_CAPACITY, 10))
        self._hits = np.zeros((_INITIAL_CAPACITY, _SIDE**3), np.uint8)
        self._touched = np.zeros(_INITIAL_CAPACITY, np.uint8)

    def insert(self, points_world: Float64Array) -> None:
        """Add (N, 3) finite points [m]."""
        progress = np.array([0, self.count], np.int64)
        while True:
            _insert_points(
                points_world, progress, self.leaf, _MOST_HITS, self.table, self.keys, self._moments, self._hits,
                self._touched,
            )  # fmt: skip
            self.count = int(progress[1])
            if progress[0] == len(points_world):
                break
            self._resize(np.arange(self.count), 2 * len(self.keys))
        _describe_surfaces(
            self.count, self.leaf, self._noise, _LEAST_POINTS, self.keys, self._moments, self._touched, self.surfaces
        )

    @property
    def lookup(self) -> tuple[float, AnyArray, Int64Array, Float64Array]:
        """Side of the cubes, hash table, keys and surfaces, as kernels take them."""
        return self.leaf, self.table, self.keys, self.surfaces

    def drop_beyond(self, position_world: Float64Array, reach: float) -> None:
        """Drop the cubes farther than `reach` [m] from a position, and free their memory."""
        keys = self.keys[: self.count]
        parts = np.stack([(keys >> 42), (keys >> 21), keys], axis=1) & ((1 << 21) - 1)
        centers = (parts - (1 << 20) + 0.5) * self.leaf
        kept = np.flatnonzero(((centers - position_world) ** 2).sum(axis=1) <= reach * reach)
        capacity = _INITIAL_CAPACITY
        while capacity < 1.5 * len(kept):
            capacity *= 2
        self._resize(kept, capacity)

    def _resize(self, kept: Int64Array, capacity: int) -> None:
        for name in ("keys", "surfaces", "_moments", "_hits", "_touched"):
            old = getattr(self, name)
            new = np.zeros((capacity, *old.shape[1:]), old.dtype)
            new[: len(kept)] = old[kept]
            setattr(self, name, new)
        self.count = len(kept)
        self.table = np.full(4 * capacity, -1, np.int32)
        _fill_table(self.count, self.keys, self.table)


_COARSE = 4.0
"""How many times larger the cubes of the second level are: near scan lines a few metres apart lie in one of them."""


class LocalMap:
    """Two levels of surfaces: small cubes of side `cube` [m] for dense points, large ones for the rest."""

    def __init__(self, cube: float, noise: float) -> None:
        """Start empty."""
        self.levels = SurfaceLevel(cube, noise), SurfaceLevel(_COARSE * cube, noise)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was inserted yet."""
        return self.levels[0].count == 0

    def insert(self, points_world: Float64Array) -> None:
        """Add (N, 3) finite points [m]."""
        for level in self.levels:
            level.insert(points_world)

    def drop_beyond(self, position_world: Float64Array, reach: float) -> None:
        """Drop what is farther than `reach` [m] from a position."""
        for level in self.levels:
            level.drop_beyond(position_world, reach)


_MOST_STEPS = 20
_SCALES = (10.0, 5.0, 3.0)  # of the weight, in standard deviations, in the first steps and from then on
_ROTATION_DONE, _SHIFT_DONE = 2e-5, 5e-4  # a step below these [rad], [m] is the last one
_POINTS_PER_MEASUREMENT = 10.0  # neighbouring points share the errors of the surface they lie on; so many count as one
_LEAST_MATCHED, _LEAST_AGREEING = 0.3, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A sweep fitted onto the map."""

    state: _MotionState  # pose and motion, with their covariance given the map
    matched: float  # share of the points that met a surface
    agreeing: float  # share of those that lie on it, within 3 standard deviations

    @property
    def is_good(self) -> bool:
        """Whether it can be trusted."""
        return self.matched >= _LEAST_MATCHED and self.agreeing >= _LEAST_AGREEING

    @property
    def score(self) -> float:
        """Share of the points that lie on a surface."""
        return self.matched * self.agreeing


def _fit_sweep(sweep: _Sweep, prior: _MotionState, local_map: LocalMap) -> _Fit:
    """Find the state that agrees best with prior and map: the iterated Kalman update (Bell and Cathey 1993)."""
    points_ego, seconds = sweep.chosen_points, sweep.seconds[sweep.chosen]
    prior_information = np.linalg.inv(prior.covariance)
    state = prior
    fine, coarse = (level.lookup for level in local_map.levels)
    information, gradient, sums = np.empty((3, 6, 6)), np.empty((2, 6)), np.empty(4)
    for step in range(_MOST_STEPS):
        points_world, arms = _to_world(state, points_ego, seconds)
        scale = _SCALES[min(step, len(_SCALES) - 1)]
        accumulate_normal_equations(points_world, arms, seconds, scale, *fine, *coarse, information, gradient, sums)
        measured = np.block([[information[0], information[1]], [information[1], information[2]]])
        total = measured / _POINTS_PER_MEASUREMENT + prior_information
        slope = gradient.ravel() / _POINTS_PER_MEASUREMENT + prior_information @ state.minus(prior)
        change = np.asarray(-np.linalg.solve(total, slope), np.float64)
        state = state.changed(change)
        small = np.linalg.norm(change[:3]) < _ROTATION_DONE and np.linalg.norm(change[3:6]) < _SHIFT_DONE
        if step >= len(_SCALES) - 1 and small:
            break
    covariance = np.linalg.inv(total)
    state = replace(state, covariance=0.5 * (covariance + covariance.T))
    return _Fit(state, sums[0] / max(len(points_ego), 1), sums[3] / max(sums[0], 1.0))


_SPACING = 0.5
_NEIGHBOURS = 15
_REACHES = (5.0, 1.5)  # points farther apart than this [m] do not belong together: first roughly, then closely

_SPEEDS = (0.0, 10.0, 20.0, 30.0, -5.0)
"""Speeds along the ego's x axis [m/s] to begin from where nothing is known: matching alone converges over a few
metres."""


def _match(
    earlier: _Sweep, later: _Sweep, seconds: float, speeds: Sequence[float]
) -> tuple[Float64Array, Float64Array] | None:
    """Match two sweeps from several speeds: `earlier_from_later`, rotation (3, 3) and translation (3,) [m]."""
    # the best has the least mean squared distance of points with a partner, larger where fewer have one; one thread, so
    # that equal sweeps give equal results
    # Source: Segal, Haehnel and Thrun 2009, "Generalized-ICP"; Koide 2024, "small_gicp"
    target, tree = small_gicp.preprocess_points(earlier.chosen_points, _SPACING, _NEIGHBOURS, 1)
    source, _ = small_gicp.preprocess_points(later.chosen_points, _SPACING, _NEIGHBOURS, 1)
    least, best = np.inf, None
    for speed in speeds:
        pose = np.eye(4)
        pose[0, 3] = speed * seconds
        for reach in _REACHES:
            result = small_gicp.align(
                target, source, tree, pose, registration_type="GICP", max_correspondence_distance=reach, num_threads=1
            )
            pose = np.asarray(result.T_target_source)
        share = result.num_inliers / max(source.size(), 1)
        if share > 0:
            misfit = float(result.error) / max(result.num_inliers, 1) / share**2
            if misfit < least:
                least, best = misfit, (pose[:3, :3].copy(), pose[:3, 3].copy())
    return best


_UNKNOWN_ROTATION_RATE, _UNKNOWN_SPEED = 0.5, 20.0
_GUESSED_ROTATION_RATE, _GUESSED_SPEED = 0.1, 1.0  # standard deviations [rad/s], [m/s] before and after a first guess
_ORIGIN_ROTATION, _ORIGIN_SHIFT = 1e-4, 1e-3  # standard deviations of a pose that is known by definition [rad], [m]
_STARTING_ROUNDS = 3
_GAP_PERIODS, _LEAST_GAP = 5.0, 0.5
_LONGEST_PREDICTION = 2.0
_MOST_FAILURES = 5
_DROP_EVERY = 10.0
_RENEWAL_DISTANCE = 15.0


class Outcome(StrEnum):
    """How a pose was found."""

    STARTED = "started"
    """The first sweep of a map."""
    FITTED = "fitted"
    """The sweep was fitted onto the map."""
    TOO_FEW = "too-few-points"
    """The sweep has too few usable points: predicted."""
    MISFIT = "misfit"
    """The sweep does not fit onto the map: predicted."""
    RESTARTED = "restarted"
    """A new map was begun at the predicted pose: after a gap in time, or after repeated misfits."""


_BEGINNINGS = (Outcome.STARTED, Outcome.RESTARTED)


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """The estimate from one sweep.

    Attributes:
        state: pose and motion in the middle of the sweep, in a world that is the ego's pose at the first sweep.
        covariance: (6, 6) of a small rotation, then a small translation along the world's axes, relative to the first
            pose.
        outcome: how it was found.
        first_ns, last_ns: the span of the sweep's points [ns].
        first_state: pose and motion of the sweep that the map began with, where this sweep determined it; else None.
    """

    state: _MotionState
    covariance: Float64Array
    outcome: Outcome
    first_ns: int
    last_ns: int
    first_state: _MotionState | None = None

    def knot(self, timestamp_ns: int) -> "_Knot":
        """The pose at a time near the sweep."""
        rotation, position = self.state.at(timestamp_ns)
        return _Knot(timestamp_ns, position, quaternion_from_matrix(rotation), self.covariance)


class LidarOdometry:
    """Follows the ego by its sweeps; memory does not grow with the drive, equal sweeps give equal poses."""

    def __init__(self, configuration: OdometryConfiguration | None = None) -> None:
        """Start without a map."""
        self.configuration = configuration or OdometryConfiguration()
        self._map = self._new_map()
        self._state: _MotionState | None = None
        self._anchor: _Sweep | None = None
        """The sweep that the map began with, until a second one determines how the ego moved during it."""
        self._last_good: tuple[_Sweep, _MotionState] | None = None
        self._drift = np.zeros((6, 6))
        self._periods: list[float] = []
        self._failures = 0
        self._cleaned_at = np.zeros(3)

    def add(
        self, timestamp_ns: int, positions_ego: FloatArray, timestamps_ns: Int64Array | None = None
    ) -> PoseEstimate | None:
        """Take the next sweep.

        Args:
            timestamp_ns: start of the sweep [ns].
            positions_ego: (N, 3) float [m], ego frame, each point as measured at its own time; non-finite ones are
                left out.
            timestamps_ns: (N,) int64 [ns], or None where unknown: then all are taken as measured at once.

        Returns:
            The ego's pose in the middle of the sweep; None for a sweep whose middle is not later than that of the one
            before, which changes nothing.

        Raises:
            ArrayError: shapes do not fit.
        """
        if positions_ego.ndim != 2 or positions_ego.shape[1] != 3:
            raise ArrayError(f"positions_ego: {positions_ego.shape}; expected (N, 3)")
        if timestamps_ns is not None and timestamps_ns.shape != positions_ego.shape[:1]:
            raise ArrayError(f"timestamps_ns: {timestamps_ns.shape}; expected ({len(positions_ego)},)")
        sweep = _Sweep.of(timestamp_ns, positions_ego, timestamps_ns, self.configuration)
        state = self._state
        if state is not None and sweep.timestamp_ns <= state.timestamp_ns:
            return None
        has_few = len(sweep.chosen) < self.configuration.least_points
        if state is None or self._map.is_empty:
            return self._begin(sweep, has_few=has_few)
        seconds = (sweep.timestamp_ns - state.timestamp_ns) * 1e-9
        usual = float(np.median(self._periods)) if self._periods else seconds
        is_gap = seconds > max(_GAP_PERIODS * usual, _LEAST_GAP)
        prior = self._predict(state, sweep.timestamp_ns)
        if not is_gap:
            self._periods = [*self._periods[-20:], seconds]
        if has_few:
            return self._predicted(sweep, prior, Outcome.TOO_FEW)
        if is_gap:
            return self._restart(sweep, prior)
        if self._anchor is not None:
            return self._second(sweep, state, self._anchor)
        return self._follow(sweep, prior)

    def _new_map(self) -> LocalMap:
        return LocalMap(self.configuration.cube, self.configuration.range_noise)

    def _predict(self, state: _MotionState, timestamp_ns: int) -> _MotionState:
        """Continue the last motion; over long gaps the ego stays where it was after two seconds."""
        limit_ns = state.timestamp_ns + int(_LONGEST_PREDICTION * 1e9)
        predicted = state.predicted(timestamp_ns, self.configuration)
        if timestamp_ns <= limit_ns:
            return predicted
        stopped = state.predicted(limit_ns, self.configuration)
        return replace(stopped, timestamp_ns=timestamp_ns, covariance=predicted.covariance)

    def _begin(self, sweep: _Sweep, *, has_few: bool) -> PoseEstimate:
        """The first sweep with enough points defines the world; until it comes, all poses are the identity."""
        state = _MotionState(sweep.timestamp_ns, np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), _unknown_motion())
        self._state = state
        if not has_few:
            self._start_map(sweep, state)
        outcome = Outcome.TOO_FEW if has_few else Outcome.STARTED
        return PoseEstimate(state, self._drift.copy(), outcome, sweep.first_ns, sweep.last_ns)

    def _start_map(self, sweep: _Sweep, state: _MotionState) -> None:
        self._map = self._new_map()
        self._map.insert(sweep.to_world(state))
        self._anchor, self._last_good, self._failures = sweep, (sweep, state), 0
        self._cleaned_at = state.position

    def _restart(self, sweep: _Sweep, prior: _MotionState) -> PoseEstimate:
        """Begin a new map at the predicted pose, whose uncertainty is drift from here on."""
        self._drift = self._carried_drift(prior) + prior.covariance[:6, :6]
        state = replace(prior, covariance=_unknown_motion())
        self._start_map(sweep, state)
        self._state = state
        return PoseEstimate(state, self._drift.copy(), Outcome.RESTARTED, sweep.first_ns, sweep.last_ns)

    def _predicted(self, sweep: _Sweep, prior: _MotionState, outcome: Outcome) -> PoseEstimate:
        self._drift = self._carried_drift(prior)
        self._state = prior
        covariance = self._drift + prior.covariance[:6, :6]
        return PoseEstimate(prior, covariance, outcome, sweep.first_ns, sweep.last_ns)

    def _second(self, sweep: _Sweep, state: _MotionState, anchor: _Sweep) -> PoseEstimate:
        """Estimate the motion from the first two sweeps; deskew the first with it, begin the map anew, and repeat."""
        before = self._last_good[1] if self._last_good else state
        seconds = (sweep.timestamp_ns - before.timestamp_ns) * 1e-9
        # the motion as it was before the start, and that by which the two sweeps match
        motions = [before]
        match = _match(anchor, sweep, seconds, _SPEEDS)
        if match is not None:
            motions.append(_moved_between(before, replace(before.moved(*match), timestamp_ns=sweep.timestamp_ns)))
        fits = [self._fit_first(anchor, sweep, before, motion) for motion in motions]
        fit, first = max(fits, key=lambda entry: entry[0].score)
        self._map = self._new_map()
        self._map.insert(anchor.to_world(first))
        self._anchor = None
        self._drift = self._drift + fit.state.covariance[:6, :6]
        return replace(self._accept(sweep, fit), first_state=first)

    def _fit_first(
        self, anchor: _Sweep, sweep: _Sweep, before: _MotionState, first: _MotionState
    ) -> tuple[_Fit, _MotionState]:
        """Fit the second sweep onto the first, which is deskewed better each time."""
        for _ in range(_STARTING_ROUNDS):
            local_map = self._new_map()
            local_map.insert(anchor.to_world(first))
            fit = _fit_sweep(sweep, self._predict(first, sweep.timestamp_ns), local_map)
            first = _moved_between(before, fit.state)
        return fit, first

    def _follow(self, sweep: _Sweep, prior: _MotionState) -> PoseEstimate:
        fit = _fit_sweep(sweep, prior, self._map)
        if not fit.is_good and self._last_good is not None:
            # again from where matching with the last good sweep puts the ego
            last, state = self._last_good
            seconds = (sweep.timestamp_ns - state.timestamp_ns) * 1e-9
            match = _match(last, sweep, seconds, (float(prior.rotation[:, 0] @ prior.velocity),))
            if match is not None:
                moved = state.moved(*match)
                other = _fit_sweep(sweep, replace(prior, rotation=moved.rotation, position=moved.position), self._map)
                fit = max(fit, other, key=lambda one: one.score)
        if fit.is_good:
            return self._accept(sweep, fit)
        self._failures += 1
        if self._failures > _MOST_FAILURES:
            return self._restart(sweep, prior)
        return self._predicted(sweep, prior, Outcome.MISFIT)

    def _accept(self, sweep: _Sweep, fit: _Fit) -> PoseEstimate:
        """Continue from a good fit, and add the sweep to the map."""
        state = fit.state
        before = self._state or state
        distance = float(np.linalg.norm(state.position - before.position))
        self._drift = self._carried_drift(state)
        self._drift += state.covariance[:6, :6] * min(1.0, distance / _RENEWAL_DISTANCE)
        self._state, self._last_good, self._failures = state, (sweep, state), 0
        self._map.insert(sweep.to_world(state))
        if np.linalg.norm(state.position - self._cleaned_at) > _DROP_EVERY:
            self._map.drop_beyond(state.position, self.configuration.map_reach)
            self._cleaned_at = state.position
        covariance = self._drift + state.covariance[:6, :6]
        return PoseEstimate(state, covariance, Outcome.FITTED, sweep.first_ns, sweep.last_ns)

    def _carried_drift(self, state: _MotionState) -> Float64Array:
        """The drift so far, seen from a new position: an error of the orientation moves what lies farther on."""
        before = self._state.position if self._state is not None else state.position
        x, y, z = state.position - before
        lever = np.eye(6)
        lever[_SHIFT, _ROTATION] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return np.asarray(lever @ self._drift @ lever.T, np.float64)


def _unknown_motion() -> Float64Array:
    return _motion_covariance(_UNKNOWN_ROTATION_RATE, _UNKNOWN_SPEED)


def _motion_covariance(yaw_rate: float, speed: float) -> Float64Array:
    return np.diag(np.repeat([_ORIGIN_ROTATION, _ORIGIN_SHIFT, yaw_rate, speed], 3) ** 2)


def _moved_between(first: _MotionState, second: _MotionState) -> _MotionState:
    """The first state with the motion that leads to the second's pose; two sweeps skewed alike fit well, so no skew."""
    seconds = (second.timestamp_ns - first.timestamp_ns) * 1e-9
    yaw_rate = rotation_vector_from_matrix(second.rotation @ first.rotation.T) / seconds
    chord = (second.position - first.position) / seconds
    velocity = chord - 0.5 * seconds * np.cross(yaw_rate, chord)
    covariance = _motion_covariance(_GUESSED_ROTATION_RATE, _GUESSED_SPEED)
    return replace(first, yaw_rate=yaw_rate, velocity=velocity, covariance=covariance)


_SAME_PERIOD = 0.75  # sweeps that begin within this part of a period of one another belong together


@dataclass(frozen=True, slots=True, eq=False)
class EgoCloud:
    """The points of all lidars in one period."""

    timestamp_ns: int  # start of the first of its sweeps [ns]
    positions_ego: FloatArray  # (N, 3) float [m], each as measured at its own time
    timestamps_ns: Int64Array | None  # (N,) int64 [ns], or None where no point's time is known


_SWEEP_NOTES = {
    "odometry-sweep-unreadable": "of {} sweeps these cannot be read",
    "sweeps-without-returns": "of {} sweeps these have no returns; was the lidar blind?",
    "repeated-sweeps": "of {} sweeps these repeat the points of the one before, as if stationary; was the lidar stuck?",
}


@dataclass(slots=True)
class _Source:
    """A lidar that odometry can use, and the counts of `_SWEEP_NOTES`."""

    lidar: LidarSensor
    ego_from_points: RigidTransform
    period_ns: int
    raw: RawTimes | None = None
    statistics: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    counts: Counter[str] = field(default_factory=Counter)
    _latest: FloatArray | None = None

    def read(self, index: int, *, lenient: bool) -> LidarFrame | None:
        """Read a sweep, with point times as far as they are known; None if `lenient` and it cannot be read."""
        try:
            frame = self.lidar.frames[index]
        except DataError:
            if not lenient:
                raise
            self.counts["odometry-sweep-unreadable"] += 1
            return None
        positions = frame.points.positions
        if len(positions) == 0:
            self.counts["sweeps-without-returns"] += 1
        elif self._latest is not None and np.array_equal(positions, self._latest, equal_nan=True):
            self.counts["repeated-sweeps"] += 1
        self._latest = positions
        timed = timed_frame(frame, self.period_ns, previous=self.raw)
        self.raw = timed.raw or self.raw
        self.statistics.add(timed.found)
        return timed.frame

    def warnings(self) -> Iterator[DataWarning]:
        """The warnings about the sweeps that were read."""
        location, count = f"sensors[{self.lidar.id}].frames", len(self.lidar.frames)
        yield from self.statistics.warnings(f"{location}[].points.timestamps")
        for code, message in _SWEEP_NOTES.items():
            if self.counts[code]:
                yield assumed(code, location, message.format(count), count=self.counts[code])


@dataclass(slots=True)
class SceneSweeps:
    """The clouds of a scene one after another, and the warnings about them.

    Attributes:
        groups: the sweeps of each cloud: number of the lidar, number of the frame.
        warnings: about the whole scene.
    """

    scene: Scene
    lenient: bool
    sources: list[_Source]
    groups: list[list[tuple[int, int]]]
    warnings: list[DataWarning]
    untimed: int = 0

    @classmethod
    def of(cls, scene: Scene, *, lenient: bool = False) -> "SceneSweeps":
        """Find the lidars that odometry can use, and which of their sweeps belong together.

        Raises:
            PoseError: there is none.
        """
        warnings: list[DataWarning] = []
        sources = _usable_sources(scene, warnings)
        return cls(scene, lenient, sources, _grouped(sources, warnings), warnings)

    def __len__(self) -> int:
        return len(self.groups)

    def clouds(self) -> Iterator[tuple[int, EgoCloud]]:
        """Read clouds in the order of their time, each with its number.

        Raises:
            DataError: a sweep cannot be read, and this is not lenient.
        """
        for row, group in enumerate(self.groups):
            parts = []
            for number, index in group:
                source = self.sources[number]
                frame = source.read(index, lenient=self.lenient)
                if frame is not None:
                    self.untimed += frame.points.timestamps_ns is None and len(frame.points) > 0
                    parts.append((frame, source.ego_from_points.apply(frame.points.positions)))
            if not parts:
                continue
            start_ns = min(frame.timestamp_ns for frame, _ in parts)
            positions, times = np.concatenate([points for _, points in parts]), None
            if not len(positions) or any(frame.points.timestamps_ns is not None for frame, _ in parts):
                times = np.concatenate([frame.point_times_ns for frame, _ in parts])
            yield row, EgoCloud(start_ns, positions, times)

    def counted_warnings(self) -> Iterator[DataWarning]:
        """The warnings about the clouds that were read."""
        for source in self.sources:
            yield from source.warnings()
        if self.untimed:
            message = (
                "points without times of their own were taken as measured at once, at their sweep's time: "
                "the ego's motion during a sweep remains in its points and in the poses"
            )
            code = "odometry-without-point-times"
            yield assumed(code, self.scene.source, message, count=self.untimed)


def _usable_sources(scene: Scene, warnings: list[DataWarning]) -> list[_Source]:
    """The lidars whose points can be transformed into the ego frame, at least one."""
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    if not lidars:
        raise PoseError(
            f"{scene.source}: no lidar sweeps in it for lidar odometry; "
            "choose another trajectory with `--trajectory NAME`"
        )
    raw = [lidar for lidar in lidars if lidar.points_frame is not PointsFrame.WORLD]
    if not raw:
        raise PoseError(
            f"{scene.source}: the lidar points are in world coordinates already, without the ego's motion; "
            "use the scene's own trajectory, or state `--points-frame sensor` if they are not"
        )
    identity = RigidTransform.identity()
    mounts = [identity if lidar.points_frame is PointsFrame.EGO else lidar.mount for lidar in raw]
    mounted = [(lidar, mount) for lidar, mount in zip(raw, mounts, strict=True) if mount is not None]
    if not mounted:
        mounted = [(raw[0], identity)]
        message = f"lidar {raw[0].id!r} has no mounting on the ego; the lidar was taken as the ego"
        warnings.append(assumed("lidar-is-the-ego", f"sensors[{raw[0].id}]", message))
    used = {id(lidar) for lidar, _ in mounted}
    for lidar in lidars:
        if id(lidar) not in used:
            why = "its points are in world coordinates already" if lidar not in raw else "its mounting is unknown"
            message = f"lidar {lidar.id!r} was left out of the odometry: {why}"
            warnings.append(skipped("lidar-left-out-of-odometry", f"sensors[{lidar.id}]", message))
    return [_Source(lidar, mount, sweep_period_ns(lidar)) for lidar, mount in mounted]


def _grouped(sources: list[_Source], warnings: list[DataWarning]) -> list[list[tuple[int, int]]]:
    """Sweeps in the order of their time, those within one period together; a slow lidar once in each group."""
    longest_ns = max(source.period_ns for source in sources)
    entries = []
    for number, source in enumerate(sources):
        timestamps = source.lidar.frames.timestamps_ns
        order = np.argsort(timestamps, kind="stable")
        location = f"sensors[{source.lidar.id}].frames"
        if (order != np.arange(len(order))).any():
            message = "sweeps were not in the order of their time; they were sorted"
            warnings.append(repaired("sweeps-sorted", location, message))
        fresh = np.diff(timestamps[order], prepend=timestamps[order[0]] - 1) > 0
        if not fresh.all():
            message = "sweeps with the time of the one before were left out of the odometry"
            warnings.append(skipped("sweeps-of-one-time", location, message, count=int((~fresh).sum())))
        entries += [(int(timestamps[k]), number, int(k)) for k in order[fresh]]
    groups: list[list[tuple[int, int]]] = []
    start_ns, latest = 0, set[int]()
    for timestamp_ns, number, index in sorted(entries):
        is_slow = sources[number].period_ns >= _SAME_PERIOD * longest_ns
        if groups and timestamp_ns - start_ns < _SAME_PERIOD * longest_ns and not (is_slow and number in latest):
            groups[-1].append((number, index))
        else:
            groups.append([(number, index)])
            start_ns, latest = timestamp_ns, set()
        latest.add(number)
    return groups


@dataclass(frozen=True, slots=True, eq=False)
class _Knot:
    """A pose of the trajectory, with its covariance (6, 6)."""

    timestamp_ns: int
    position: Float64Array
    quaternion_xyzw: Float64Array
    covariance: Float64Array


def _trajectory_of(estimates: list[PoseEstimate]) -> Trajectory:
    """A trajectory through the poses of at least one sweep, in order of time, that begins with the identity."""
    # knots: in the middle of every sweep, and half-way between two, where both motions meet; where the sweeps are far
    # apart in time, each motion ends with its own points
    first, last = estimates[0], estimates[-1]
    knots = [first.knot(first.first_ns), first.knot(first.state.timestamp_ns)]
    for before, after in pairwise(estimates):
        knots += [*_between(before, after), after.knot(after.state.timestamp_ns)]
    knots.append(last.knot(last.last_ns))
    # overlapping sweeps may put a knot too early
    times = np.array([knot.timestamp_ns for knot in knots], np.int64)
    later = times[1:] > np.maximum.accumulate(times)[:-1]
    knots = [knots[0], *(knot for knot, is_later in zip(knots[1:], later, strict=True) if is_later)]
    origin = RigidTransform.from_quaternion(knots[0].position, knots[0].quaternion_xyzw).inverse()
    axes = np.kron(np.eye(2), origin.rotation)
    return Trajectory(
        NAME,
        np.array([knot.timestamp_ns for knot in knots], np.int64),
        origin.apply(np.array([knot.position for knot in knots])),
        multiply_quaternions(origin.quaternion_xyzw, np.array([knot.quaternion_xyzw for knot in knots])),
        covariances=np.array([axes @ knot.covariance @ axes.T for knot in knots]),
    )


def _between(before: PoseEstimate, after: PoseEstimate) -> list[_Knot]:
    """The knots between the middles of two sweeps."""
    middles_ns = before.state.timestamp_ns, after.state.timestamp_ns
    longest_ns = 2 * max(before.last_ns - before.first_ns, after.last_ns - after.first_ns)
    if 0 < longest_ns < middles_ns[1] - middles_ns[0]:
        return [before.knot(before.last_ns), after.knot(after.first_ns)]
    halfway_ns = sum(middles_ns) // 2
    first, second = before.knot(halfway_ns), after.knot(halfway_ns)
    rotation = slerp(first.quaternion_xyzw, second.quaternion_xyzw, 0.5)
    return [replace(first, position=0.5 * (first.position + second.position), quaternion_xyzw=rotation)]


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """The result of lidar odometry.

    Attributes:
        trajectory: `world_from_ego` under the name "lidar", from the first point's time to the last one's, with
            covariances; the world is the ego's first pose.
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    warnings: tuple[DataWarning, ...]


def lidar_odometry(
    scene: Scene,
    *,
    configuration: OdometryConfiguration | None = None,
    progress: Callable[[int, int], None] | None = None,
    lenient: bool = False,
) -> OdometryRun:
    """Estimate the ego trajectory from the lidar sweeps of a scene.

    Args:
        configuration: settings; the defaults hold for everything.
        progress: called after each cloud with how many are done and how many there are.
        lenient: leave sweeps out that cannot be read, with a warning.

    Raises:
        PoseError: the scene has no lidar sweeps, their points are in world coordinates, or none has returns.
        DataError: a sweep cannot be read, and this is not lenient.
    """
    sweeps = SceneSweeps.of(scene, lenient=lenient)
    odometry = LidarOdometry(configuration)
    settings = odometry.configuration
    estimates: list[PoseEstimate] = []
    late = 0
    for row, cloud in sweeps.clouds():
        estimate = odometry.add(cloud.timestamp_ns, cloud.positions_ego, cloud.timestamps_ns)
        if estimate is None:
            late += 1
        else:
            _append(estimates, estimate, settings)
        if progress is not None:
            progress(row + 1, len(sweeps))
    if not any(estimate.outcome in _BEGINNINGS for estimate in estimates):
        raise PoseError(
            f"{scene.source}: none of {len(sweeps)} lidar sweeps has enough returns; "
            "choose another trajectory with `--trajectory NAME`"
        )
    counts = Counter(estimate.outcome for estimate in estimates)
    if not counts[Outcome.FITTED]:
        estimates = [_of_unknown_motion(estimate, settings) for estimate in estimates]
    warnings = (*sweeps.warnings, *sweeps.counted_warnings(), *_notes(counts, late, scene.source))
    return OdometryRun(_trajectory_of(estimates), warnings)


def _append(estimates: list[PoseEstimate], estimate: PoseEstimate, settings: OdometryConfiguration) -> None:
    """Add an estimate, and replace that of the sweep that the map began with, where this sweep determined it."""
    # sweeps before the very first map get the poses from which its motion comes
    first = estimate.first_state
    if first is not None:
        begun_at = max(k for k, earlier in enumerate(estimates) if earlier.outcome in _BEGINNINGS)
        estimates[begun_at] = replace(estimates[begun_at], state=first)
        if estimates[begun_at].outcome is Outcome.STARTED:
            for k, earlier in enumerate(estimates[:begun_at]):
                state = first.predicted(earlier.state.timestamp_ns, settings)
                estimates[k] = replace(earlier, state=state, covariance=state.covariance[:6, :6])
    estimates.append(estimate)


def _of_unknown_motion(estimate: PoseEstimate, settings: OdometryConfiguration) -> PoseEstimate:
    """Covariance of the ego pose at the end of a sweep that could not be compared with any other."""
    later = estimate.state.predicted(max(estimate.last_ns, estimate.state.timestamp_ns), settings)
    return replace(estimate, covariance=estimate.covariance + later.covariance[:6, :6])


_NOTES: Mapping[Outcome, tuple[str, str]] = MappingProxyType(
    {
        Outcome.TOO_FEW: (
            "odometry-too-few-points",
            "sweeps with too few usable points: their poses continue the motion before, with growing covariances",
        ),
        Outcome.MISFIT: (
            "odometry-misfit",
            "sweeps that do not fit onto the map: their poses continue the motion before, with growing covariances",
        ),
        Outcome.RESTARTED: (
            "odometry-restarted",
            "a gap in time or many misfits: a new map was begun at the predicted pose, with larger covariances",
        ),
    }
)  # code and message of the warning about each outcome that is not a fit


def _notes(counts: Counter[Outcome], late: int, location: str) -> Iterator[DataWarning]:
    for outcome, (code, message) in _NOTES.items():
        if counts[outcome]:
            yield assumed(code, location, message, count=counts[outcome])
    if not counts[Outcome.FITTED]:
        message = "no two sweeps could be compared, so the motion is unknown; the ego was taken as stationary"
        yield assumed("odometry-without-motion", location, message)
    if late:
        message = "sweeps whose middle is not later than that of the sweep before were left out of the odometry"
        yield skipped("odometry-late-sweep", location, message, count=late)


_SUPPORT = 0.25
"""A surface has a quarter of its weight 2 standard deviations from its middle, along the surface."""


@kernel(types.void(IN_F64_2D, IN_F64_1D, IN_F64_2D, IN_F64_1D, IN_F64_1D, IN_F64_1D, float64[:, ::1], float64[:, ::1]))
def move_points(
    points_ego: Float64Array, seconds: Float64Array, rotation: Float64Array, position: Float64Array,
    yaw_rate: Float64Array, velocity: Float64Array, points_world: Float64Array, arms: Float64Array,
) -> None:  # fmt: skip
    """Take points of a rotating, moving ego into the world, each at its own time.

    p_world(t) = position + t v + t²/2 (ω × v) + Exp(t ω) R p_ego: a constant velocity in the ego's own frame, to the
    second order in t.

    `points_ego` (N, 3) [m]; `seconds` (N,) time of each point after the pose's; `rotation`, `position` (3, 3) and (3,)
    [m], `world_from_ego`; `yaw_rate`, `velocity` (3,) [rad/s] and [m/s], world axes, at the pose's time; `points_world`
    (N, 3), written here; `arms` (N, 3), written here: from the ego to the points, world axes.
    """
    rotated, step = np.empty((3, 3)), np.empty(3)
    cx = yaw_rate[1] * velocity[2] - yaw_rate[2] * velocity[1]
    cy = yaw_rate[2] * velocity[0] - yaw_rate[0] * velocity[2]
    cz = yaw_rate[0] * velocity[1] - yaw_rate[1] * velocity[0]
    last = math.nan
    for i in range(points_ego.shape[0]):
        t = seconds[i]
        if t != last:
            for k in range(3):
                step[k] = t * yaw_rate[k]
            rotation_of_vector(step, rotated)
            last = t
        px, py, pz = points_ego[i, 0], points_ego[i, 1], points_ego[i, 2]
        x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
        y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
        z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
        ax = rotated[0, 0] * x + rotated[0, 1] * y + rotated[0, 2] * z
        ay = rotated[1, 0] * x + rotated[1, 1] * y + rotated[1, 2] * z
        az = rotated[2, 0] * x + rotated[2, 1] * y + rotated[2, 2] * z
        arms[i, 0], arms[i, 1], arms[i, 2] = ax, ay, az
        half = 0.5 * t * t
        points_world[i, 0] = position[0] + t * velocity[0] + half * cx + ax
        points_world[i, 1] = position[1] + t * velocity[1] + half * cy + ay
        points_world[i, 2] = position[2] + t * velocity[2] + half * cz + az


@kernel(types.void(float64, float64, float64, float64, float64, int32[::1], int64[::1], float64[:, ::1], float64[::1]))
def _meet_surfaces(
    x: float, y: float, z: float, leaf: float, inverse2: float, table: AnyArray, keys: Int64Array,
    surfaces: Float64Array, met: Float64Array,
) -> None:  # fmt: skip
    """Sum what the surfaces of the eight cubes around a location state about a point there.

    A surface counts where its own points lie: the weight falls with the distance along it, in standard deviations.

    `inverse2`: 1 / scale², of the robust weight; `met` (12,) written here: Σ w W r (3), Σ w W (6), Σ w, Σ w s², Σ a.
    """
    met[:] = 0.0
    ix, iy, iz = math.floor(x / leaf - 0.5), math.floor(y / leaf - 0.5), math.floor(z / leaf - 0.5)
    for k in range(8):
        key = _pack_key(ix + (k & 1), iy + ((k >> 1) & 1), iz + (k >> 2))
        cube = _find_cube(key, table, keys)
        if cube < 0:
            continue
        s = surfaces[cube]
        if s[3] + s[6] + s[8] == 0.0:
            continue
        dx, dy, dz = x - s[0], y - s[1], z - s[2]
        rx = s[3] * dx + s[4] * dy + s[5] * dz
        ry = s[4] * dx + s[6] * dy + s[7] * dz
        rz = s[5] * dx + s[7] * dy + s[8] * dz
        squared = dx * rx + dy * ry + dz * rz
        along = (
            dx * (s[9] * dx + 2.0 * (s[10] * dy + s[11] * dz)) + dy * (s[12] * dy + 2.0 * s[13] * dz) + s[14] * dz * dz
        )
        near = 1.0 / (1.0 + _SUPPORT * along)
        near *= near
        w = 1.0 / (1.0 + squared * inverse2)
        w *= w * near
        met[0] += w * rx
        met[1] += w * ry
        met[2] += w * rz
        for c in range(6):
            met[3 + c] += w * s[3 + c]
        met[9] += w
        met[10] += w * squared
        met[11] += near


@kernel(types.void(float64[:, :, ::1]))
def _mirror(matrices: Float64Array) -> None:
    """Fill the lower halves of symmetric matrices."""
    for k in range(matrices.shape[0]):
        for r in range(6):
            for c in range(r):
                matrices[k, r, c] = matrices[k, c, r]


@kernel(types.void(
    IN_F64_1D, float64, float64[::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1]
))  # fmt: skip
def _add_point(
    arm: Float64Array, t: float, met: Float64Array, j: Float64Array, wj: Float64Array, information: Float64Array,
    gradient: Float64Array,
) -> None:  # fmt: skip
    """Add what surfaces state about one point: `met` as `_meet_surfaces` gives it; `j` and `wj` are room for work."""
    # -[arm]x, so that a rotation about the world's axes moves the point by rotation x arm
    j[0, 1], j[0, 2] = arm[2], -arm[1]
    j[1, 0], j[1, 2] = -arm[2], arm[0]
    j[2, 0], j[2, 1] = arm[1], -arm[0]
    for c in range(6):
        wj[0, c] = met[3] * j[0, c] + met[4] * j[1, c] + met[5] * j[2, c]
        wj[1, c] = met[4] * j[0, c] + met[6] * j[1, c] + met[7] * j[2, c]
        wj[2, c] = met[5] * j[0, c] + met[7] * j[1, c] + met[8] * j[2, c]
    for r in range(6):
        g = j[0, r] * met[0] + j[1, r] * met[1] + j[2, r] * met[2]
        gradient[0, r] += g
        gradient[1, r] += t * g
        for c in range(r, 6):
            h = j[0, r] * wj[0, c] + j[1, r] * wj[1, c] + j[2, r] * wj[2, c]
            information[0, r, c] += h
            information[1, r, c] += t * h
            information[2, r, c] += t * t * h


@kernel(types.void(
    IN_F64_2D, IN_F64_2D, IN_F64_1D, float64, float64, int32[::1], int64[::1], float64[:, ::1], float64, int32[::1],
    int64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[::1]
))  # fmt: skip
def accumulate_normal_equations(
    points_world: Float64Array, arms: Float64Array, seconds: Float64Array, scale: float, fine_leaf: float,
    fine_table: AnyArray, fine_keys: Int64Array, fine_surfaces: Float64Array, coarse_leaf: float,
    coarse_table: AnyArray, coarse_keys: Int64Array, coarse_surfaces: Float64Array, information: Float64Array,
    gradient: Float64Array, sums: Float64Array,
) -> None:  # fmt: skip
    """Sum what each point says about a small rotation and shift of the ego, and about their rates.

    What the fine surfaces around a point do not cover is left to the coarse ones.

    Args:
        points_world, arms, seconds: as `move_points` gives them.
        scale: residuals of this many standard deviations lose most of their weight.
        fine_leaf, coarse_leaf: sides of the cubes [m]; tables, keys and surfaces are those of the map's two levels.
        information: (3, 6, 6) written here: Σ w Jᵀ W J, the same times t, and times t², for a rotation, then a shift.
        gradient: (2, 6) written here: Σ w Jᵀ W r, and the same times t.
        sums: (4,) written here: points with a surface, Σ w, Σ w s², points that agree with theirs.
    """
    information[:] = 0.0
    gradient[:] = 0.0
    sums[:] = 0.0
    j, wj, met, rest = np.zeros((3, 6)), np.empty((3, 6)), np.empty(12), np.empty(12)
    j[0, 3] = j[1, 4] = j[2, 5] = 1.0
    inverse2 = 1.0 / (scale * scale)
    for i in range(points_world.shape[0]):
        x, y, z = points_world[i, 0], points_world[i, 1], points_world[i, 2]
        _meet_surfaces(x, y, z, fine_leaf, inverse2, fine_table, fine_keys, fine_surfaces, met)
        if met[11] < 1.0:
            _meet_surfaces(x, y, z, coarse_leaf, inverse2, coarse_table, coarse_keys, coarse_surfaces, rest)
            share = (1.0 - met[11]) / max(1.0, rest[11])
            for c in range(12):
                met[c] += share * rest[c]
        if met[11] == 0.0:
            continue
        share = 1.0 / max(1.0, met[11])
        for c in range(11):
            met[c] *= share
        sums[0] += 1.0
        sums[1] += met[9]
        sums[2] += met[10]
        # a robust weight above a quarter: within `scale` standard deviations
        if 4.0 * met[9] > min(1.0, met[11]):
            sums[3] += 1.0
        _add_point(arms[i], seconds[i], met, j, wj, information, gradient)
    _mirror(information)


_SIDE = 4
"""A cube is cut into this many parts along each axis; each part takes a few points, so that near scan lines, which
are dense, do not outweigh the rest."""

_LINE_SHARE, _THIN_SHARE = 0.04, 0.1
"""Of the largest eigenvalue: a middle one below the first is that of a line; one above the second states nothing."""

_STEEP = 0.7  # a line is steep where its direction has at least this z
_HALF_KEY = 1 << 20


@inlined
def _pack_key(ix: int, iy: int, iz: int) -> int:
    """One number for the cube (ix, iy, iz), each within ±2^20."""
    return ((ix + _HALF_KEY) << 42) | ((iy + _HALF_KEY) << 21) | (iz + _HALF_KEY)


@kernel(int64(int64, int32[::1], int64[::1]))
def _find_cube(key: int, table: AnyArray, keys: Int64Array) -> int:
    """The number of the cube with a key, or -1."""
    mask = table.shape[0] - 1
    location = first_location(key, mask)
    while True:
        cube = table[location]
        if cube < 0:
            return -1
        if keys[cube] == key:
            return int(cube)
        location = (location + 1) & mask


@kernel(types.void(int64, int64[::1], int32[::1]))
def _fill_table(count: int, keys: Int64Array, table: AnyArray) -> None:
    """Write the first `count` cubes into an empty table (-1 everywhere) whose length is a power of two."""
    mask = table.shape[0] - 1
    for cube in range(count):
        location = first_location(keys[cube], mask)
        while table[location] >= 0:
            location = (location + 1) & mask
        table[location] = cube


@kernel(types.void(
    IN_F64_2D, int64[::1], float64, int64, int32[::1], int64[::1], float64[:, ::1], uint8[:, ::1], uint8[::1]
))  # fmt: skip
def _insert_points(
    points_world: Float64Array, progress: Int64Array, leaf: float, most_hits: int, table: AnyArray, keys: Int64Array,
    moments: Float64Array, hits: AnyArray, touched: AnyArray,
) -> None:  # fmt: skip
    """Add points to the cubes that they fall into, until the room for new cubes is used up.

    Args:
        points_world: (N, 3) [m], finite.
        progress: (2,) the first point to add, and the cubes in use; afterwards the first point that was not added (N
            when all were), and the cubes in use then.
        leaf: side of a cube [m].
        most_hits: points that each of the SIDE³ parts of a cube takes.
        table: power-of-two length, cube number or -1.
        keys: (C,) of the cubes.
        moments: (C, 10) number of points, sums of x y z and of xx xy xz yy yz zz about the cube's middle.
        hits: (C, SIDE³) points in each part.
        touched: (C,) set to 1 where a cube got a point.
    """
    mask = table.shape[0] - 1
    count = progress[1]
    for i in range(progress[0], points_world.shape[0]):
        x, y, z = points_world[i, 0] / leaf, points_world[i, 1] / leaf, points_world[i, 2] / leaf
        fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
        key = _pack_key(fx, fy, fz)
        location = first_location(key, mask)
        while table[location] >= 0 and keys[table[location]] != key:
            location = (location + 1) & mask
        cube = int(table[location])
        if cube < 0:
            if count >= keys.shape[0]:
                progress[0], progress[1] = i, count
                return
            cube = count
            table[location] = cube
            keys[cube] = key
            moments[cube] = 0.0
            hits[cube] = 0
            count += 1
        # just below a border, x - fx may round to 1
        px, py = min(int((x - fx) * _SIDE), _SIDE - 1), min(int((y - fy) * _SIDE), _SIDE - 1)
        pz = min(int((z - fz) * _SIDE), _SIDE - 1)
        part = (px * _SIDE + py) * _SIDE + pz
        if hits[cube, part] >= most_hits:
            continue
        hits[cube, part] += 1
        touched[cube] = 1
        dx, dy, dz = (x - fx - 0.5) * leaf, (y - fy - 0.5) * leaf, (z - fz - 0.5) * leaf
        m = moments[cube]
        m[0] += 1.0
        m[1] += dx
        m[2] += dy
        m[3] += dz
        m[4] += dx * dx
        m[5] += dx * dy
        m[6] += dx * dz
        m[7] += dy * dy
        m[8] += dy * dz
        m[9] += dz * dz
    progress[0], progress[1] = points_world.shape[0], count


@kernel(types.void(float64[:, ::1], float64[:, ::1]))
def _diagonalise(a: Float64Array, v: Float64Array) -> None:
    """Rotate a symmetric (3, 3) matrix into the diagonal of its eigenvalues and `v` into its eigenvectors (columns).

    Source: Golub and Van Loan, "Matrix Computations", section 8.5: cyclic Jacobi rotations.
    """
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    scale = a[0, 0] + a[1, 1] + a[2, 2]
    for _ in range(8):
        if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) <= 1e-12 * scale:
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                tau = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                for k in range(3):
                    kp, kq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * kp - s * kq, s * kp + c * kq
                for k in range(3):
                    pk, qk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * pk - s * qk, s * pk + c * qk
                for k in range(3):
                    kp, kq = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * kp - s * kq, s * kp + c * kq


@kernel(types.void(float64, float64, float64, float64, float64[::1]))
def _add_square(weight: float, x: float, y: float, z: float, sums: Float64Array) -> None:
    """Add weight times the outer product of a vector with itself: xx xy xz yy yz zz."""
    sums[0] += weight * x * x
    sums[1] += weight * x * y
    sums[2] += weight * x * z
    sums[3] += weight * y * y
    sums[4] += weight * y * z
    sums[5] += weight * z * z


@kernel(types.void(float64[:, ::1], float64[:, ::1], float64, float64[::1]))
def _inform(a: Float64Array, v: Float64Array, noise: float, surface: Float64Array) -> None:
    """Write what a spread, given by its eigenvalues (diagonal of `a`) and eigenvectors, reports about a surface."""
    e = 0 if a[0, 0] >= a[1, 1] else 1
    long = e if a[e, e] >= a[2, 2] else 2
    e, f = (long + 1) % 3, (long + 2) % 3
    middle, short = (e, f) if a[e, e] >= a[f, f] else (f, e)
    largest = a[long, long]
    if largest < 4.0 * noise * noise:
        return
    is_steep = abs(v[2, long]) >= _STEEP
    if a[middle, middle] <= _LINE_SHARE * largest and not is_steep:
        return
    for axis in (short, middle):
        share = 1.0 - a[axis, axis] / (_THIN_SHARE * largest)
        if share > 0.0 and (axis == short or is_steep):
            weight = share / (max(a[axis, axis], 0.0) + noise * noise)
            _add_square(weight, v[0, axis], v[1, axis], v[2, axis], surface[3:9])
    for axis in (long, middle):
        weight = 1.0 / max(a[axis, axis], noise * noise)
        _add_square(weight, v[0, axis], v[1, axis], v[2, axis], surface[9:15])


@kernel(types.void(int64, float64, float64, float64, int64[::1], float64[:, ::1], uint8[::1], float64[:, ::1]))
def _describe_surfaces(
    count: int, leaf: float, noise: float, least_points: float, keys: Int64Array, moments: Float64Array,
    touched: AnyArray, surfaces: Float64Array,
) -> None:  # fmt: skip
    """Find mean and information of the points of every touched cube, and take its mark off.

    A cube informs across its surface alone: the direction of least spread counts as much as that spread is small
    against the largest. What is thin in two directions (poles, trunks) informs in both, if it is steep; a level one
    is a scan line on a surface whose slope is not known, and informs about nothing.

    `noise`: standard deviation of a point across a flat surface [m]; `least_points`: a cube with fewer points informs
    about nothing; `surfaces` (C, 15) mean x y z [m], world; information xx xy xz yy yz zz [1/m²], zero where there is
    none; inverse of the spread along the surface, xx xy xz yy yz zz [1/m²].
    """
    a, v = np.empty((3, 3)), np.empty((3, 3))
    mask = (1 << 21) - 1
    for cube in range(count):
        if touched[cube] == 0:
            continue
        touched[cube] = 0
        m, out = moments[cube], surfaces[cube]
        out[:] = 0.0
        if m[0] < least_points:
            continue
        n = m[0]
        mx, my, mz = m[1] / n, m[2] / n, m[3] / n
        key = keys[cube]
        out[0] = (((key >> 42) & mask) - _HALF_KEY + 0.5) * leaf + mx
        out[1] = (((key >> 21) & mask) - _HALF_KEY + 0.5) * leaf + my
        out[2] = ((key & mask) - _HALF_KEY + 0.5) * leaf + mz
        a[0, 0], a[0, 1], a[0, 2] = m[4] / n - mx * mx, m[5] / n - mx * my, m[6] / n - mx * mz
        a[1, 1], a[1, 2], a[2, 2] = m[7] / n - my * my, m[8] / n - my * mz, m[9] / n - mz * mz
        a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
        _diagonalise(a, v)
        _inform(a, v, noise, out)
