"""Lidar odometry: the ego trajectory from lidar sweeps alone, each registered onto a local map of surfaces."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType

import numpy as np
import small_gicp

from sceneloom.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from sceneloom.errors import ArrayError, DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
    slerp,
)
from sceneloom.kernels.scan_matching import (
    SIDE,
    accumulate_normal_equations,
    describe_surfaces,
    fill_table,
    insert_points,
    move_points,
    thin_points,
)
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.point_times import RawTimes, timed_frame
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, sweep_period_ns
from sceneloom.scene.types import PointsFrame
from sceneloom.warnings import DataWarning, WarningKind


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
"""Locations of the four errors in a covariance of the state."""


@dataclass(frozen=True, slots=True, eq=False)
class _MotionState:
    """The ego's pose and motion at one time.

    Attributes:
        timestamp_ns: [ns].
        rotation: (3, 3) `world_from_ego`.
        position: (3,) [m], world frame.
        yaw_rate: (3,) [rad/s], world axes.
        velocity: (3,) [m/s], world axes.
        covariance: (12, 12) of a small rotation, a small shift, and changes of the angular velocity and the velocity,
            all along the world's axes.
    """

    timestamp_ns: int
    rotation: Float64Array
    position: Float64Array
    yaw_rate: Float64Array
    velocity: Float64Array
    covariance: Float64Array

    def at(self, timestamp_ns: int) -> tuple[Float64Array, Float64Array]:
        """Rotation and position at another time, at constant velocity and angular velocity in the ego's own frame."""
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        rotated = _rotation_matrix(self.yaw_rate * dt)
        bend = 0.5 * dt * dt * np.cross(self.yaw_rate, self.velocity)
        return rotated @ self.rotation, self.position + dt * self.velocity + bend

    def move(
        self, points_ego: Float64Array, seconds: Float64Array, points_world: Float64Array, arms: Float64Array
    ) -> None:
        """Take points into the world, each at its own time.

        Args:
            points_ego: (N, 3) float64 [m].
            seconds: (N,) float64, times after the state's.
            points_world: (N, 3) float64 [m], written.
            arms: (N, 3) float64 [m], written: from the ego to each point, along the world's axes.
        """
        move_points(
            points_ego,
            seconds,
            self.rotation,
            self.position,
            self.yaw_rate,
            self.velocity,
            points_world,
            arms,
        )

    def predicted(self, timestamp_ns: int, acceleration: float, yaw_acceleration: float) -> "_MotionState":
        """The state at a later time, with what accelerations of the given size add to its uncertainty.

        Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, piecewise constant white acceleration.
        """
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        rotation, position = self.at(timestamp_ns)
        rotated = _rotation_matrix(self.yaw_rate * dt)
        step = np.eye(12)
        step[_ROTATION, _YAW_RATE] = step[_SHIFT, _VELOCITY] = dt * np.eye(3)
        noise = np.zeros((12, 12))
        for value, rate, size in (
            (_ROTATION, _YAW_RATE, yaw_acceleration),
            (_SHIFT, _VELOCITY, acceleration),
        ):
            gain = np.array([0.5 * dt * dt, dt])[:, None] * size
            for a, first in enumerate((value, rate)):
                for b, second in enumerate((value, rate)):
                    noise[first, second] = float(gain[a, 0] * gain[b, 0]) * np.eye(3)
        return _MotionState(
            timestamp_ns,
            rotation,
            position,
            self.yaw_rate,
            rotated @ self.velocity,
            step @ self.covariance @ step.T + noise,
        )

    def changed(self, step: Float64Array) -> "_MotionState":
        """The state after small changes, (12,)."""
        rotation = _rotation_matrix(step[_ROTATION]) @ self.rotation
        return replace(
            self,
            rotation=rotation,
            position=self.position + step[_SHIFT],
            yaw_rate=self.yaw_rate + step[_YAW_RATE],
            velocity=self.velocity + step[_VELOCITY],
        )

    def minus(self, other: "_MotionState") -> Float64Array:
        """The changes, (12,), that lead from another state to this one."""
        return np.concatenate(
            [
                _rotation_vector(self.rotation @ other.rotation.T),
                self.position - other.position,
                self.yaw_rate - other.yaw_rate,
                self.velocity - other.velocity,
            ]
        )


def _rotation_matrix(rotation_vector: Float64Array) -> Float64Array:
    """The (3, 3) rotation about a (3,) vector by its length [rad]."""
    return matrix_from_quaternion(quaternion_from_rotation_vector(rotation_vector))


def _rotation_vector(rotation: Float64Array) -> Float64Array:
    """The (3,) rotation vector of a (3, 3) rotation."""
    return rotation_vector_from_quaternion(quaternion_from_matrix(rotation))


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """The usable points of a sweep.

    Attributes:
        timestamp_ns: the middle of its time, to which its pose refers [ns].
        first_ns, last_ns: of all its points [ns].
        points_ego: (N, 3) float64 [m], each as measured at its own time.
        seconds: (N,) float64, after `timestamp_ns`.
        chosen: (M,) int64, the points to register, evenly spread.
    """

    timestamp_ns: int
    first_ns: int
    last_ns: int
    points_ego: Float64Array
    seconds: Float64Array
    chosen: Int64Array


def _usable_sweep(
    timestamp_ns: int,
    positions_ego: FloatArray,
    timestamps_ns: Int64Array | None,
    configuration: OdometryConfiguration,
) -> _Sweep:
    """Leave out what is no number, too near or too far, and choose the points to register."""
    if timestamps_ns is None or len(timestamps_ns) == 0:
        first_ns = last_ns = timestamp_ns
    else:
        first_ns, last_ns = int(timestamps_ns.min()), int(timestamps_ns.max())
    middle_ns = (first_ns + last_ns) // 2
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.einsum("ij,ij->i", positions_ego, positions_ego)
    usable = np.flatnonzero((squared > configuration.nearest**2) & (squared < configuration.farthest**2))
    points = np.asarray(positions_ego[usable], np.float64)
    offsets_ns = np.zeros(len(points), np.int64) if timestamps_ns is None else timestamps_ns[usable] - middle_ns
    chosen = np.empty(len(points), np.int64)
    count = thin_points(points, configuration.spacing, chosen)
    return _Sweep(middle_ns, first_ns, last_ns, points, np.asarray(offsets_ns * 1e-9), chosen[:count])


_FIRST_ROOM = 1 << 15

_LEAST_POINTS = 5.0
"""Points that a cube needs before it says where its surface is."""

_MOST_HITS = 3
"""Points that each part of a cube takes: what is full stays as it was measured first, so a stationary ego changes
nothing, and the map does not follow the poses that were found with it."""


class SurfaceLevel:
    """Cubes of space of one size, with the mean and the spread of the points in them."""

    def __init__(self, leaf: float, noise: float) -> None:
        """Start empty, with cubes of side `leaf` [m] for points with a standard deviation `noise` [m]."""
        self.leaf, self._noise = leaf, noise
        self.count = 0
        self.keys = np.zeros(_FIRST_ROOM, np.int64)
        self.table = np.full(4 * _FIRST_ROOM, -1, np.int32)
        self.surfaces = np.zeros((_FIRST_ROOM, 15))
        self._moments = np.zeros((_FIRST_ROOM, 10))
        self._hits = np.zeros((_FIRST_ROOM, SIDE**3), np.uint8)
        self._touched = np.zeros(_FIRST_ROOM, np.uint8)

    def insert(self, points_world: Float64Array) -> None:
        """Add (N, 3) finite points [m]."""
        progress = np.array([0, self.count], np.int64)
        while True:
            insert_points(
                points_world,
                progress,
                self.leaf,
                _MOST_HITS,
                self.table,
                self.keys,
                self._moments,
                self._hits,
                self._touched,
            )
            self.count = int(progress[1])
            if progress[0] == len(points_world):
                break
            self._resize(np.arange(self.count), 2 * len(self.keys))
        describe_surfaces(
            self.count,
            self.leaf,
            self._noise,
            _LEAST_POINTS,
            self.keys,
            self._moments,
            self._touched,
            self.surfaces,
        )

    def drop_beyond(self, position_world: Float64Array, reach: float) -> None:
        """Forget the cubes farther than `reach` [m] from a location, and return the memory they took."""
        keys = self.keys[: self.count]
        parts = np.stack([(keys >> 42), (keys >> 21), keys], axis=1) & ((1 << 21) - 1)
        centers = (parts - (1 << 20) + 0.5) * self.leaf
        kept = np.flatnonzero(((centers - position_world) ** 2).sum(axis=1) <= reach * reach)
        room = _FIRST_ROOM
        while room < 1.5 * len(kept):
            room *= 2
        self._resize(kept, room)

    def _resize(self, kept: Int64Array, room: int) -> None:
        for name in ("keys", "surfaces", "_moments", "_hits", "_touched"):
            old = getattr(self, name)
            new = np.zeros((room, *old.shape[1:]), old.dtype)
            new[: len(kept)] = old[kept]
            setattr(self, name, new)
        self.count = len(kept)
        self.table = np.full(4 * room, -1, np.int32)
        fill_table(self.count, self.keys, self.table)


_COARSE = 4.0
"""How many times larger the cubes of the second level are: near scan lines a few metres apart lie in one of them."""


class LocalMap:
    """Two levels of surfaces: small cubes for what is measured densely, large ones for the rest."""

    def __init__(self, cube: float, noise: float) -> None:
        """Start empty, with small cubes of side `cube` [m]."""
        self.fine, self.coarse = SurfaceLevel(cube, noise), SurfaceLevel(_COARSE * cube, noise)

    @property
    def is_empty(self) -> bool:
        """Whether nothing was inserted yet."""
        return self.fine.count == 0

    def insert(self, points_world: Float64Array) -> None:
        """Add (N, 3) finite points [m]."""
        for level in (self.fine, self.coarse):
            level.insert(points_world)

    def drop_beyond(self, position_world: Float64Array, reach: float) -> None:
        """Forget what lies farther than `reach` [m] from a location."""
        for level in (self.fine, self.coarse):
            level.drop_beyond(position_world, reach)


_MOST_STEPS = 20

_SCALES = (10.0, 5.0, 3.0)
"""Of the weight, in standard deviations, in the first steps and from then on."""

_ROTATION_DONE, _SHIFT_DONE = 2e-5, 5e-4
"""A step below these [rad], [m] is the last one."""

_POINTS_PER_MEASUREMENT = 10.0
"""Neighbouring points share the errors of the surface they lie on; so many count as one."""


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """What fitting a sweep gave.

    Attributes:
        state: pose and motion, with their covariance given the map.
        information: (6, 6) of the pose by the sweep alone.
        matched: share of the points that met a surface.
        agreeing: share of those that lie on it, within 3 standard deviations.
        steps: how many were made.
    """

    state: _MotionState
    information: Float64Array
    matched: float
    agreeing: float
    steps: int


def _fit_sweep(points_ego: Float64Array, seconds: Float64Array, prior: _MotionState, local_map: LocalMap) -> _Fit:
    """Find the state that agrees best with the prior and with the map.

    Args:
        points_ego: (N, 3) float64 [m], each as measured at its own time.
        seconds: (N,) float64, times after the prior's.

    Source: Bell and Cathey 1993: the iterated Kalman filter's update is this Gauss-Newton optimisation.
    """
    prior_information = np.linalg.inv(prior.covariance)
    state, count = prior, len(points_ego)
    fine, coarse = local_map.fine, local_map.coarse
    points_world, arms = np.empty((count, 3)), np.empty((count, 3))
    information, gradient, sums = np.empty((3, 6, 6)), np.empty((2, 6)), np.empty(4)
    for step in range(_MOST_STEPS):
        state.move(points_ego, seconds, points_world, arms)
        accumulate_normal_equations(
            points_world,
            arms,
            seconds,
            _SCALES[min(step, len(_SCALES) - 1)],
            fine.leaf,
            fine.table,
            fine.keys,
            fine.surfaces,
            coarse.leaf,
            coarse.table,
            coarse.keys,
            coarse.surfaces,
            information,
            gradient,
            sums,
        )
        measured = np.block([[information[0], information[1]], [information[1], information[2]]])
        total = measured / _POINTS_PER_MEASUREMENT + prior_information
        slope = gradient.ravel() / _POINTS_PER_MEASUREMENT + prior_information @ state.minus(prior)
        change = np.asarray(-np.linalg.solve(total, slope), np.float64)
        state = state.changed(change)
        if (
            step >= len(_SCALES) - 1
            and np.linalg.norm(change[:3]) < _ROTATION_DONE
            and np.linalg.norm(change[3:6]) < _SHIFT_DONE
        ):
            break
    covariance = np.linalg.inv(total)
    return _Fit(
        replace(state, covariance=0.5 * (covariance + covariance.T)),
        information[0] / _POINTS_PER_MEASUREMENT,
        sums[0] / max(count, 1),
        sums[3] / max(sums[0], 1.0),
        step + 1,
    )


_SPACING = 0.5
_NEIGHBOURS = 15

_REACHES = (5.0, 1.5)
"""Points farther apart than this [m] do not belong together: first roughly, then closely."""

_SPEEDS = (0.0, 10.0, 20.0, 30.0, -5.0)
"""Speeds along the ego's x axis [m/s] to begin from where nothing is known: matching alone finds a few metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A motion that may be the right one.

    Attributes:
        rotation, translation: (3, 3) and (3,) [m], `earlier_from_later`.
        misfit: mean squared distance of the points that found a partner, larger where fewer did.
    """

    rotation: Float64Array
    translation: Float64Array
    misfit: float


def _guess_motion(
    earlier: Float64Array, later: Float64Array, seconds: float, *, speeds: Sequence[float]
) -> list[Guess]:
    """Match two sweeps, (N, 3) and (M, 3) [m] in the ego frame, from several speeds; the best guess comes first.

    One thread, so that equal sweeps give equal guesses.

    Source: Segal, Haehnel and Thrun 2009, "Generalized-ICP"; Koide 2024, "small_gicp".
    """
    target, tree = small_gicp.preprocess_points(earlier, _SPACING, _NEIGHBOURS, 1)
    source, _ = small_gicp.preprocess_points(later, _SPACING, _NEIGHBOURS, 1)
    guesses = []
    for speed in speeds:
        pose = np.eye(4)
        pose[0, 3] = speed * seconds
        for reach in _REACHES:
            result = small_gicp.align(
                target,
                source,
                tree,
                pose,
                registration_type="GICP",
                max_correspondence_distance=reach,
                num_threads=1,
            )
            pose = np.asarray(result.T_target_source)
        share = result.num_inliers / max(source.size(), 1)
        if share > 0:
            misfit = float(result.error) / max(result.num_inliers, 1) / share**2
            guesses.append(Guess(pose[:3, :3].copy(), pose[:3, 3].copy(), misfit))
    return sorted(guesses, key=lambda guess: guess.misfit)


_UNKNOWN_ROTATION_RATE, _UNKNOWN_SPEED = 0.5, 20.0

_GUESSED_ROTATION_RATE, _GUESSED_SPEED = 0.1, 1.0
"""Standard deviations [rad/s], [m/s] before and after a first guess."""

_STANDSTILL_ROTATION, _STANDSTILL_SHIFT = 1e-4, 1e-3
"""How well a pose is known that is so by definition [rad], [m]."""

_STARTING_ROUNDS = 3
_LEAST_MATCHED, _LEAST_AGREEING = 0.3, 0.5
_GAP_PERIODS, _LEAST_GAP = 5.0, 0.5
_LONGEST_PREDICTION = 2.0
_MOST_FAILURES = 5
_DROP_EVERY = 10.0
_RENEWAL_TRAJECTORY = 15.0


class Outcome(StrEnum):
    """How a pose came about."""

    STARTED = "started"
    """The first sweep of a map."""
    FITTED = "fitted"
    """The sweep was fitted onto the map."""
    TOO_FEW = "too-few-points"
    """The sweep holds too few usable points: predicted."""
    MISFIT = "misfit"
    """The sweep does not fit onto the map: predicted."""
    RESTARTED = "restarted"
    """A new map was begun at the predicted pose: after a gap in time, or where sweeps kept misfitting."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """What one sweep reported.

    Attributes:
        state: pose and motion in the middle of the sweep, in a world that is the ego's pose at the first sweep.
        covariance: (6, 6) of a small rotation, then a small shift along the world's axes, relative to the first pose.
        outcome: how it came about.
        first_ns, last_ns: the span of the sweep's points [ns].
        first_state: pose and motion of the sweep that the map began with, where this sweep reported it; else None.
    """

    state: _MotionState
    covariance: Float64Array
    outcome: Outcome
    first_ns: int
    last_ns: int
    first_state: _MotionState | None = None


class LidarOdometry:
    """Follows the ego by its sweeps; memory does not grow with the drive, equal sweeps give equal poses."""

    def __init__(self, configuration: OdometryConfiguration | None = None) -> None:
        """Start without a map."""
        self.configuration = configuration or OdometryConfiguration()
        self._map = self._new_map()
        self._state: _MotionState | None = None
        self._anchor: _Sweep | None = None
        """The sweep that the map began with, until a second one reports how the ego moved during it."""
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
            positions_ego: (N, 3) float [m], ego frame, each point as measured at its own time; what is not finite is
                left out.
            timestamps_ns: (N,) int64 [ns], or None where not known: then all are taken as measured at once.

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
        sweep = _usable_sweep(timestamp_ns, positions_ego, timestamps_ns, self.configuration)
        if self._state is not None and sweep.timestamp_ns <= self._state.timestamp_ns:
            return None
        if self._state is None or self._map.is_empty:
            return self._begin(sweep)
        seconds = (sweep.timestamp_ns - self._state.timestamp_ns) * 1e-9
        gap = self._is_gap(seconds)
        prior = self._predict(self._state, sweep.timestamp_ns)
        if not gap:
            self._periods = [*self._periods[-20:], seconds]
        if len(sweep.chosen) < self.configuration.least_points:
            return self._predicted(sweep, prior, Outcome.TOO_FEW)
        if gap:
            return self._restart(sweep, prior)
        if self._anchor is not None:
            return self._second(sweep, self._state, self._anchor)
        return self._follow(sweep, prior)

    def _new_map(self) -> LocalMap:
        return LocalMap(self.configuration.cube, self.configuration.range_noise)

    def _is_gap(self, seconds: float) -> bool:
        usual = float(np.median(self._periods)) if self._periods else seconds
        return seconds > max(_GAP_PERIODS * usual, _LEAST_GAP)

    def _predict(self, state: _MotionState, timestamp_ns: int) -> _MotionState:
        """Go on with the last motion; over long gaps the ego stays where it was after two seconds."""
        settings = self.configuration
        reach_ns = state.timestamp_ns + int(_LONGEST_PREDICTION * 1e9)
        if timestamp_ns <= reach_ns:
            return state.predicted(timestamp_ns, settings.acceleration, settings.yaw_acceleration)
        stopped = state.predicted(reach_ns, settings.acceleration, settings.yaw_acceleration)
        grown = state.predicted(timestamp_ns, settings.acceleration, settings.yaw_acceleration).covariance
        return replace(stopped, timestamp_ns=timestamp_ns, covariance=grown)

    def _begin(self, sweep: _Sweep) -> PoseEstimate:
        """The first sweep with enough points defines the world; until it comes, all poses are the identity."""
        state = _MotionState(sweep.timestamp_ns, np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), _unknown_motion())
        self._state = state
        if len(sweep.chosen) < self.configuration.least_points:
            return PoseEstimate(state, self._drift.copy(), Outcome.TOO_FEW, sweep.first_ns, sweep.last_ns)
        self._start_map(sweep, state)
        return PoseEstimate(state, self._drift.copy(), Outcome.STARTED, sweep.first_ns, sweep.last_ns)

    def _start_map(self, sweep: _Sweep, state: _MotionState) -> None:
        self._map = self._new_map()
        self._map.insert(_to_world(sweep, state))
        self._anchor, self._last_good, self._failures = sweep, (sweep, state), 0
        self._cleaned_at = state.position

    def _restart(self, sweep: _Sweep, prior: _MotionState) -> PoseEstimate:
        """Begin a new map where the ego should be by now; all that is not known of that is drift from here on."""
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
        """Find the motion by the first two sweeps; deskew the first by it, begin the map anew, and find it again."""
        before = self._last_good[1] if self._last_good else state
        seconds = (sweep.timestamp_ns - before.timestamp_ns) * 1e-9
        motions = self._first_motions(anchor, sweep, before, seconds)
        fits = [self._fit_first(anchor, sweep, before, motion) for motion in motions]
        fit, first = max(fits, key=lambda entry: entry[0].matched * entry[0].agreeing)
        self._map = self._new_map()
        self._map.insert(_to_world(anchor, first))
        self._anchor = None
        self._drift = self._drift + fit.state.covariance[:6, :6]
        return replace(self._accept(sweep, fit), first_state=first)

    def _fit_first(
        self, anchor: _Sweep, sweep: _Sweep, before: _MotionState, first: _MotionState
    ) -> tuple[_Fit, _MotionState]:
        """Fit the second sweep onto the first, which is deskewed better each time."""
        for _ in range(_STARTING_ROUNDS):
            self._map = self._new_map()
            self._map.insert(_to_world(anchor, first))
            fit = self._fit(sweep, self._predict(first, sweep.timestamp_ns))
            first = _moved_between(before, fit.state)
        return fit, first

    def _first_motions(self, anchor: _Sweep, sweep: _Sweep, before: _MotionState, seconds: float) -> list[_MotionState]:
        """What the motion may be: as it was before the start, and what matching the two sweeps says."""
        motions = [before]
        guesses = _guess_motion(
            anchor.points_ego[anchor.chosen], sweep.points_ego[sweep.chosen], seconds, speeds=_SPEEDS
        )
        for guess in guesses[:1]:
            later = replace(
                before,
                timestamp_ns=sweep.timestamp_ns,
                rotation=before.rotation @ guess.rotation,
                position=before.position + before.rotation @ guess.translation,
            )
            motions.append(_moved_between(before, later))
        return motions

    def _fit(self, sweep: _Sweep, prior: _MotionState) -> _Fit:
        return _fit_sweep(sweep.points_ego[sweep.chosen], sweep.seconds[sweep.chosen], prior, self._map)

    def _follow(self, sweep: _Sweep, prior: _MotionState) -> PoseEstimate:
        fit = self._fit(sweep, prior)
        if not _is_good(fit) and self._last_good is not None:
            fit = self._fit_from_guess(sweep, prior, fit, *self._last_good)
        if _is_good(fit):
            return self._accept(sweep, fit)
        self._failures += 1
        if self._failures > _MOST_FAILURES:
            return self._restart(sweep, prior)
        return self._predicted(sweep, prior, Outcome.MISFIT)

    def _fit_from_guess(self, sweep: _Sweep, prior: _MotionState, fit: _Fit, last: _Sweep, state: _MotionState) -> _Fit:
        """Fit again from where matching with the last good sweep puts the ego, if that is better."""
        seconds = (sweep.timestamp_ns - state.timestamp_ns) * 1e-9
        speed = float(prior.rotation[:, 0] @ prior.velocity)
        guesses = _guess_motion(last.points_ego[last.chosen], sweep.points_ego[sweep.chosen], seconds, speeds=(speed,))
        for guess in guesses[:1]:
            moved = replace(
                prior,
                rotation=state.rotation @ guess.rotation,
                position=state.position + state.rotation @ guess.translation,
            )
            other = self._fit(sweep, moved)
            if other.matched * other.agreeing > fit.matched * fit.agreeing:
                return other
        return fit

    def _accept(self, sweep: _Sweep, fit: _Fit) -> PoseEstimate:
        """Go on from a good fit, and add the sweep to the map."""
        state = fit.state
        before = self._state or state
        trajectory = float(np.linalg.norm(state.position - before.position))
        self._drift = self._carried_drift(state)
        self._drift += fit.state.covariance[:6, :6] * min(1.0, trajectory / _RENEWAL_TRAJECTORY)
        self._state, self._last_good, self._failures = state, (sweep, state), 0
        self._map.insert(_to_world(sweep, state))
        if np.linalg.norm(state.position - self._cleaned_at) > _DROP_EVERY:
            self._map.drop_beyond(state.position, self.configuration.map_reach)
            self._cleaned_at = state.position
        covariance = self._drift + state.covariance[:6, :6]
        return PoseEstimate(state, covariance, Outcome.FITTED, sweep.first_ns, sweep.last_ns)

    def _carried_drift(self, state: _MotionState) -> Float64Array:
        """The drift so far, seen from a new position: an error of the orientation moves what lies farther on."""
        before = self._state.position if self._state is not None else state.position
        return carried_covariance(self._drift, state.position - before)


def carried_covariance(covariance: Float64Array, trajectory: Float64Array) -> Float64Array:
    """The covariance (6, 6) of a rotation and a shift, seen from a location that lies (3,) [m] farther on."""
    x, y, z = trajectory
    lever = np.eye(6)
    lever[_SHIFT, _ROTATION] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    carried: Float64Array = lever @ covariance @ lever.T
    return carried


def _to_world(sweep: _Sweep, state: _MotionState) -> Float64Array:
    points_world, arms = np.empty_like(sweep.points_ego), np.empty_like(sweep.points_ego)
    state.move(sweep.points_ego, sweep.seconds, points_world, arms)
    return points_world


def _is_good(fit: _Fit) -> bool:
    return fit.matched >= _LEAST_MATCHED and fit.agreeing >= _LEAST_AGREEING


def _unknown_motion() -> Float64Array:
    return _motion_covariance(_UNKNOWN_ROTATION_RATE, _UNKNOWN_SPEED)


def _motion_covariance(yaw_rate: float, speed: float) -> Float64Array:
    deviations = np.empty(12)
    deviations[_ROTATION], deviations[_SHIFT] = _STANDSTILL_ROTATION, _STANDSTILL_SHIFT
    deviations[_YAW_RATE], deviations[_VELOCITY] = yaw_rate, speed
    return np.diag(deviations**2)


def _moved_between(first: _MotionState, second: _MotionState) -> _MotionState:
    """The first state with the constant motion that leads to the second one's pose.

    What the skew of the sweeps says is left aside: two sweeps that are skewed alike fit well.
    """
    seconds = (second.timestamp_ns - first.timestamp_ns) * 1e-9
    yaw_rate = _rotation_vector(second.rotation @ first.rotation.T) / seconds
    chord = (second.position - first.position) / seconds
    velocity = chord - 0.5 * seconds * np.cross(yaw_rate, chord)
    covariance = _motion_covariance(_GUESSED_ROTATION_RATE, _GUESSED_SPEED)
    return replace(first, yaw_rate=yaw_rate, velocity=velocity, covariance=covariance)


_SAME_PERIOD = 0.75
"""Sweeps that begin within this part of a period of one another belong together."""


@dataclass(frozen=True, slots=True, eq=False)
class EgoCloud:
    """What the lidars measured in one period.

    Attributes:
        timestamp_ns: start of the first of its sweeps [ns].
        positions_ego: (N, 3) float [m], each as measured at its own time.
        timestamps_ns: (N,) int64 [ns], or None where no point's time is known.
    """

    timestamp_ns: int
    positions_ego: FloatArray
    timestamps_ns: Int64Array | None


@dataclass(slots=True)
class _Source:
    """A lidar that odometry can use."""

    lidar: LidarSensor
    ego_from_points: RigidTransform
    period_ns: int
    raw: RawTimes | None = None
    statistics: PointTimesStatistics = field(default_factory=PointTimesStatistics)
    unreadable: int = 0
    empty: int = 0
    repeated: int = 0
    _latest: FloatArray | None = None

    def note(self, frame: LidarFrame) -> None:
        """Count sweeps without returns, and those that are the one before over again."""
        positions = frame.points.positions
        if len(positions) == 0:
            self.empty += 1
        elif self._latest is not None and np.array_equal(positions, self._latest, equal_nan=True):
            self.repeated += 1
        self._latest = positions

    def warnings(self) -> list[DataWarning]:
        """What there is to state of the lidar's sweeps."""
        location, count = f"sensors[{self.lidar.id}].frames", len(self.lidar.frames)
        notes = (
            ("odometry-sweep-unreadable", self.unreadable, f"of {count} sweeps these cannot be read"),
            (
                "sweeps-without-returns",
                self.empty,
                f"of {count} sweeps these have no returns; was the lidar blind?",
            ),
            (
                "repeated-sweeps",
                self.repeated,
                f"of {count} sweeps these hold exactly the points of the one before, as if it stood; was it stuck?",
            ),
        )
        return [
            *self.statistics.warnings(f"{location}[].points.timestamps"),
            *(
                DataWarning(kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=found)
                for code, found, message in notes
                if found
            ),
        ]


@dataclass(slots=True)
class SceneSweeps:
    """Gives the clouds of a scene one after another and remembers what had to be stated about them.

    Attributes:
        groups: the sweeps that make each cloud: number of the lidar, number of the frame.
        warnings: what was assumed, repaired or left out of the whole scene.
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
            cloud = self._cloud(group)
            if cloud is not None:
                yield row, cloud

    def counted_warnings(self) -> tuple[DataWarning, ...]:
        """Notes on the clouds that were read; `warnings` are those on the whole scene."""
        of_lidars = [warning for source in self.sources for warning in source.warnings()]
        return (*of_lidars, *self._untimed_warning())

    def _untimed_warning(self) -> list[DataWarning]:
        if not self.untimed:
            return []
        message = (
            "points without times of their own were taken as measured at once, at their sweep's time: "
            "what the ego moved during a sweep stays in its points and in the poses"
        )
        return [
            DataWarning(
                kind=WarningKind.ASSUMED,
                code="odometry-without-point-times",
                location=self.scene.source,
                message=message,
                count=self.untimed,
            )
        ]

    def _cloud(self, group: list[tuple[int, int]]) -> EgoCloud | None:
        parts = []
        for number, index in group:
            source = self.sources[number]
            frame = self._read(source, index)
            if frame is not None:
                parts.append((frame, source.ego_from_points.apply(frame.points.positions)))
        if not parts:
            return None
        start_ns = min(frame.timestamp_ns for frame, _ in parts)
        positions = np.concatenate([points for _, points in parts])
        if len(positions) and all(frame.points.timestamps_ns is None for frame, _ in parts):
            return EgoCloud(start_ns, positions, None)
        return EgoCloud(start_ns, positions, np.concatenate([_times(frame) for frame, _ in parts]))

    def _read(self, source: _Source, index: int) -> LidarFrame | None:
        try:
            frame = source.lidar.frames[index]
        except DataError:
            if not self.lenient:
                raise
            source.unreadable += 1
            return None
        source.note(frame)
        timed = timed_frame(frame, source.period_ns, previous=source.raw)
        source.raw = timed.raw or source.raw
        source.statistics.add(timed.found)
        if timed.frame.points.timestamps_ns is None and len(frame.points):
            self.untimed += 1
        return timed.frame


def _times(frame: LidarFrame) -> Int64Array:
    times = frame.points.timestamps_ns
    return np.full(len(frame.points), frame.timestamp_ns, np.int64) if times is None else times


def _skipped(code: str, location: str, message: str, count: int = 1) -> DataWarning:
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


def _usable_sources(scene: Scene, warnings: list[DataWarning]) -> list[_Source]:
    """The lidars whose points can be brought into the ego frame.

    Raises:
        PoseError: there is none.
    """
    lidars = [lidar for lidar in scene.lidars if len(lidar.frames)]
    if not lidars:
        raise PoseError(
            f"{scene.source}: no lidar sweeps in it, so lidar odometry has nothing to go by; "
            "choose another trajectory with `--trajectory NAME`"
        )
    raw = [lidar for lidar in lidars if lidar.points_frame is not PointsFrame.WORLD]
    if not raw:
        raise PoseError(
            f"{scene.source}: the lidar points are in the world already, so their motion is known and taken out; "
            "use the scene's own trajectory, or state `--points-frame sensor` if they are not"
        )
    mounted = [(lidar, mount) for lidar in raw if (mount := _ego_from_points(lidar)) is not None]
    if not mounted:
        mounted = [(raw[0], RigidTransform.identity())]
        message = f"lidar {raw[0].id!r} has no mounting on the ego; the lidar was taken as the ego"
        warnings.append(
            DataWarning(
                kind=WarningKind.ASSUMED,
                code="lidar-is-the-ego",
                location=f"sensors[{raw[0].id}]",
                message=message,
            )
        )
    used = {id(lidar) for lidar, _ in mounted}
    for lidar in lidars:
        if id(lidar) not in used:
            why = "its points are in the world already" if lidar not in raw else "its mounting is not known"
            message = f"lidar {lidar.id!r} was left out of the odometry: {why}"
            warnings.append(_skipped("lidar-left-out-of-odometry", f"sensors[{lidar.id}]", message))
    return [_Source(lidar, mount, sweep_period_ns(lidar)) for lidar, mount in mounted]


def _ego_from_points(lidar: LidarSensor) -> RigidTransform | None:
    return RigidTransform.identity() if lidar.points_frame is PointsFrame.EGO else lidar.mount


def _grouped(sources: list[_Source], warnings: list[DataWarning]) -> list[list[tuple[int, int]]]:
    """Sweeps in the order of their time, those within one period together; a slow lidar once in each group."""
    longest_ns = max(source.period_ns for source in sources)
    entries = []
    for number, source in enumerate(sources):
        timestamps = source.lidar.frames.timestamps_ns
        order = np.argsort(timestamps, kind="stable")
        location = f"sensors[{source.lidar.id}].frames"
        if (order != np.arange(len(order))).any():
            message = "sweeps were not in the order of their time; they were taken in that order"
            warnings.append(
                DataWarning(kind=WarningKind.REPAIRED, code="sweeps-sorted", location=location, message=message)
            )
        fresh = np.diff(timestamps[order], prepend=timestamps[order[0]] - 1) > 0
        if not fresh.all():
            message = "sweeps with the time of the one before were left out of the odometry"
            warnings.append(_skipped("sweeps-of-one-time", location, message, int((~fresh).sum())))
        entries += [(int(timestamps[k]), number, int(k)) for k in order[fresh]]
    groups: list[list[tuple[int, int]]] = []
    start_ns, latest = 0, dict[int, int]()
    for timestamp_ns, number, index in sorted(entries):
        period_ns = sources[number].period_ns
        is_slow = period_ns >= _SAME_PERIOD * longest_ns
        if groups and timestamp_ns - start_ns < _SAME_PERIOD * longest_ns and not (is_slow and number in latest):
            groups[-1].append((number, index))
        else:
            groups.append([(number, index)])
            start_ns, latest = timestamp_ns, {}
        latest[number] = timestamp_ns
    return groups


def _trajectory_of(name: str, estimates: list[PoseEstimate]) -> Trajectory:
    """Lay a path through the sweeps' poses, from the first point to the last, that begins with the identity.

    There is a knot in the middle of every sweep, and one between two sweeps half-way in time, where both motions
    meet. Where the sweeps are far apart in time, each motion ends with its own points.

    Args:
        estimates: at least one, in the order of their time.
    """
    knots: list[tuple[int, Float64Array, Float64Array, int]] = []
    for k, estimate in enumerate(estimates):
        before = estimates[k - 1] if k else None
        if before is None:
            knots.append(_own(estimate, estimate.first_ns, k))
        else:
            knots += _between(before, estimate, k)
        knots.append(_own(estimate, estimate.state.timestamp_ns, k))
    knots.append(_own(estimates[-1], estimates[-1].last_ns, len(estimates) - 1))
    return _from_first_pose(name, knots, estimates)


def _own(estimate: PoseEstimate, timestamp_ns: int, k: int) -> tuple[int, Float64Array, Float64Array, int]:
    rotation, position = estimate.state.at(timestamp_ns)
    return timestamp_ns, position, quaternion_from_matrix(rotation), k


def _between(before: PoseEstimate, after: PoseEstimate, k: int) -> list[tuple[int, Float64Array, Float64Array, int]]:
    """The knots between the middles of two sweeps."""
    middles_ns = before.state.timestamp_ns, after.state.timestamp_ns
    longest_ns = 2 * max(before.last_ns - before.first_ns, after.last_ns - after.first_ns)
    if 0 < longest_ns < middles_ns[1] - middles_ns[0]:
        return [_own(before, before.last_ns, k - 1), _own(after, after.first_ns, k)]
    halfway_ns = sum(middles_ns) // 2
    _, first_position, first_rotation, _ = _own(before, halfway_ns, k - 1)
    _, second_position, second_rotation, _ = _own(after, halfway_ns, k)
    return [
        (
            halfway_ns,
            0.5 * (first_position + second_position),
            slerp(first_rotation, second_rotation, 0.5),
            k - 1,
        )
    ]


def _from_first_pose(
    name: str, knots: list[tuple[int, Float64Array, Float64Array, int]], estimates: list[PoseEstimate]
) -> Trajectory:
    """Move the world's origin and axes to the first knot's pose."""
    times = np.array([knot[0] for knot in knots], np.int64)
    kept = np.concatenate([[0], 1 + np.flatnonzero(_rises(times))])
    positions = np.array([knots[k][1] for k in kept])
    quaternions = np.array([knots[k][2] for k in kept])
    origin = RigidTransform.from_quaternion(positions[0], quaternions[0]).inverse()
    axes = np.kron(np.eye(2), origin.rotation)
    covariances = np.array([axes @ estimates[knots[k][3]].covariance @ axes.T for k in kept])
    return Trajectory(
        name,
        times[kept],
        origin.apply(positions),
        multiply_quaternions(origin.quaternion_xyzw, quaternions),
        covariances=covariances,
    )


def _rises(times: Int64Array) -> BoolArray:
    """Which times are later than every one before, but for the first: overlapping sweeps may put a knot too early."""
    return times[1:] > np.maximum.accumulate(times)[:-1]


NAME = "lidar"
"""The trajectory's name."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """What lidar odometry made of a scene.

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
    """Find the ego trajectory through a scene from its lidar sweeps.

    Args:
        configuration: settings; the defaults hold for everything.
        progress: reported after each cloud how many are done and how many there are.
        lenient: leave sweeps out that cannot be read, with a warning.

    Raises:
        PoseError: the scene has no lidar sweeps, their points are in the world already, or none has returns.
        DataError: a sweep cannot be read, and this is not lenient.
    """
    sweeps = SceneSweeps.of(scene, lenient=lenient)
    settings = configuration or OdometryConfiguration()
    odometry = LidarOdometry(settings)
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
            f"{scene.source}: none of {len(sweeps)} lidar sweeps has enough returns to go by; "
            "choose another trajectory with `--trajectory NAME`"
        )
    counts = Counter(estimate.outcome for estimate in estimates)
    if not counts[Outcome.FITTED]:
        estimates = [_of_unknown_motion(estimate, settings) for estimate in estimates]
    warnings = (*sweeps.warnings, *sweeps.counted_warnings(), *_notes(counts, late, scene.source))
    return OdometryRun(_trajectory_of(NAME, estimates), warnings)


def _append(estimates: list[PoseEstimate], estimate: PoseEstimate, settings: OdometryConfiguration) -> None:
    """Add an estimate; what it reports about the sweep that the map began with replaces what was not known then.

    Sweeps before the very first map get the poses from which its motion comes.
    """
    first = estimate.first_state
    if first is not None:
        begun_at = max(k for k, earlier in enumerate(estimates) if earlier.outcome in _BEGINNINGS)
        estimates[begun_at] = replace(estimates[begun_at], state=first)
        if estimates[begun_at].outcome is Outcome.STARTED:
            estimates[:begun_at] = [_led_back(earlier, first, settings) for earlier in estimates[:begun_at]]
    estimates.append(estimate)


def _led_back(earlier: PoseEstimate, first: _MotionState, settings: OdometryConfiguration) -> PoseEstimate:
    state = first.predicted(earlier.state.timestamp_ns, settings.acceleration, settings.yaw_acceleration)
    return replace(earlier, state=state, covariance=state.covariance[:6, :6])


def _of_unknown_motion(estimate: PoseEstimate, settings: OdometryConfiguration) -> PoseEstimate:
    """Covariance of the ego pose at the end of a sweep that could not be compared with any other."""
    later = estimate.state.predicted(
        max(estimate.last_ns, estimate.state.timestamp_ns), settings.acceleration, settings.yaw_acceleration
    )
    return replace(estimate, covariance=estimate.covariance + later.covariance[:6, :6])


_BEGINNINGS = (Outcome.STARTED, Outcome.RESTARTED)

_NOTES: Mapping[Outcome, tuple[str, str]] = MappingProxyType(
    {
        Outcome.TOO_FEW: (
            "odometry-too-few-points",
            "sweeps with too few usable points: their poses go on with the motion before, and their covariances grow",
        ),
        Outcome.MISFIT: (
            "odometry-misfit",
            "sweeps that do not fit onto the map: their poses go on with the motion before, and their covariances grow",
        ),
        Outcome.RESTARTED: (
            "odometry-restarted",
            "a gap in time or many misfits: new map begun where the motion before leads, with grown covariances",
        ),
    }
)
"""Code and message of the warning about each outcome that is not a fit."""


def _notes(counts: Counter[Outcome], late: int, location: str) -> list[DataWarning]:
    warnings = [
        DataWarning(kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=counts[outcome])
        for outcome, (code, message) in _NOTES.items()
        if counts[outcome]
    ]
    if not counts[Outcome.FITTED]:
        message = "no two sweeps could be compared, so nothing is known of the motion; the ego was taken as stationary"
        warnings.append(
            DataWarning(kind=WarningKind.ASSUMED, code="odometry-without-motion", location=location, message=message)
        )
    if late:
        message = "sweeps whose middle is not later than that of the sweep before were left out of the odometry"
        warnings.append(
            DataWarning(
                kind=WarningKind.SKIPPED,
                code="odometry-late-sweep",
                location=location,
                message=message,
                count=late,
            )
        )
    return warnings
