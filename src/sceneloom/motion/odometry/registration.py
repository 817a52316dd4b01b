"""Registration of a sweep onto the local surface map: settings, motion state, usable points, first guess and fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import small_gicp

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.errors import OptionError
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.kernels.scan_matching import accumulate_normal_equations, move_points, thin_points
from sceneloom.kernels.surface_map import SIDE, describe_surfaces, fill_table, insert_points


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
        yaw_acceleration: how fast the yaw rate usually changes [rad/s²].
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
            raise OptionError(
                f"odometry.farthest: {self.farthest} m; expected more than nearest, {self.nearest} m"
            )


ROTATION, SHIFT, YAW_RATE, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""Locations of the four errors in a covariance of the state."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """The ego's pose and motion at one time.

    Attributes:
        timestamp_ns: [ns].
        rotation: (3, 3) `world_from_ego`.
        position: (3,) [m], world frame.
        yaw_rate: (3,) [rad/s], world axes.
        velocity: (3,) [m/s], world axes.
        covariance: (12, 12) of a small rotation, a small shift, and changes of the yaw rate and the velocity, all along
            the world's axes.
    """

    timestamp_ns: int
    rotation: Float64Array
    position: Float64Array
    yaw_rate: Float64Array
    velocity: Float64Array
    covariance: Float64Array

    def at(self, timestamp_ns: int) -> tuple[Float64Array, Float64Array]:
        """Rotation and position at another time, at constant velocity and yaw rate in the ego's own frame."""
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

    def predicted(self, timestamp_ns: int, acceleration: float, yaw_acceleration: float) -> "MotionState":
        """The state at a later time, with what accelerations of the given size add to its uncertainty.

        Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.3.2, piecewise constant white acceleration.
        """
        dt = (timestamp_ns - self.timestamp_ns) * 1e-9
        rotation, position = self.at(timestamp_ns)
        rotated = _rotation_matrix(self.yaw_rate * dt)
        step = np.eye(12)
        step[ROTATION, YAW_RATE] = step[SHIFT, VELOCITY] = dt * np.eye(3)
        noise = np.zeros((12, 12))
        for value, rate, size in ((ROTATION, YAW_RATE, yaw_acceleration), (SHIFT, VELOCITY, acceleration)):
            gain = np.array([0.5 * dt * dt, dt])[:, None] * size
            for a, first in enumerate((value, rate)):
                for b, second in enumerate((value, rate)):
                    noise[first, second] = float(gain[a, 0] * gain[b, 0]) * np.eye(3)
        return MotionState(
            timestamp_ns,
            rotation,
            position,
            self.yaw_rate,
            rotated @ self.velocity,
            step @ self.covariance @ step.T + noise,
        )

    def changed(self, step: Float64Array) -> "MotionState":
        """The state after small changes, (12,)."""
        rotation = _rotation_matrix(step[ROTATION]) @ self.rotation
        return replace(
            self,
            rotation=rotation,
            position=self.position + step[SHIFT],
            yaw_rate=self.yaw_rate + step[YAW_RATE],
            velocity=self.velocity + step[VELOCITY],
        )

    def minus(self, other: "MotionState") -> Float64Array:
        """The changes, (12,), that lead from another state to this one."""
        return np.concatenate(
            [
                rotation_vector(self.rotation @ other.rotation.T),
                self.position - other.position,
                self.yaw_rate - other.yaw_rate,
                self.velocity - other.velocity,
            ]
        )


def _rotation_matrix(rotation_vector: Float64Array) -> Float64Array:
    """The (3, 3) rotation about a (3,) vector by its length [rad]."""
    return matrix_from_quaternion(quaternion_from_rotation_vector(rotation_vector))


def rotation_vector(rotation: Float64Array) -> Float64Array:
    """The (3,) rotation vector of a (3, 3) rotation."""
    return rotation_vector_from_quaternion(quaternion_from_matrix(rotation))


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
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


def usable_sweep(
    timestamp_ns: int,
    positions_ego: FloatArray,
    timestamps_ns: Int64Array | None,
    configuration: OdometryConfiguration,
) -> Sweep:
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
    offsets_ns = (
        np.zeros(len(points), np.int64) if timestamps_ns is None else timestamps_ns[usable] - middle_ns
    )
    chosen = np.empty(len(points), np.int64)
    count = thin_points(points, configuration.spacing, chosen)
    return Sweep(middle_ns, first_ns, last_ns, points, np.asarray(offsets_ns * 1e-9), chosen[:count])


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
class Fit:
    """What fitting a sweep gave.

    Attributes:
        state: pose and motion, with their covariance given the map.
        information: (6, 6) of the pose by the sweep alone.
        matched: share of the points that met a surface.
        agreeing: share of those that lie on it, within 3 standard deviations.
        steps: how many were made.
    """

    state: MotionState
    information: Float64Array
    matched: float
    agreeing: float
    steps: int


def fit_sweep(
    points_ego: Float64Array, seconds: Float64Array, prior: MotionState, local_map: LocalMap
) -> Fit:
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
    return Fit(
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

SPEEDS = (0.0, 10.0, 20.0, 30.0, -5.0)
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


def guess_motion(
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
