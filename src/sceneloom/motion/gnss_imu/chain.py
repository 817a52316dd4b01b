"""A chain of motion states, what was measured of them, and the states that fit it best."""

from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from sceneloom.kernels import imu_chain as kernels
from sceneloom.kernels.imu_chain import (
    ACCELEROMETER,
    GYROSCOPE,
    MOTION_CHAIN_ROTATION,
    POSITION,
    SIZE,
    VELOCITY,
    chain_covariances,
    solve_chain,
)
from sceneloom.motion.gnss_imu.measurements import Fixes, Preintegrated, SmootherSettings, crossed_with

_MAX_DAMPINGS = 12
_LARGEST_DAMPING = 1e3
"""Where this many times the diagonal does not make equations solvable, they hold no numbers."""
_UNKNOWN_SPEED, _UNKNOWN_ROTATION, _TILT = 100.0, np.pi, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """K states.

    Attributes:
        rotations: (K, 3, 3) `world_from_body`.
        positions, velocities: (K, 3) [m] and [m/s], world.
        biases: (K, 6) of the gyroscope [rad/s] and of the accelerometer [m/s²].
    """

    rotations: Float64Array
    positions: Float64Array
    velocities: Float64Array
    biases: Float64Array

    def __post_init__(self) -> None:
        for name in ("rotations", "positions", "velocities", "biases"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))

    def stepped(self, step: Float64Array) -> "States":
        """Go a step, (K, 15) in the order of `kernels.motion_chain`."""
        rotations = matrix_from_quaternion(quaternion_from_rotation_vector(step[:, MOTION_CHAIN_ROTATION]))
        return States(
            self.rotations @ rotations,
            self.positions + step[:, POSITION],
            self.velocities + step[:, VELOCITY],
            self.biases + step[:, 9:],
        )

    def part(self, first: int, last: int) -> "States":
        """States `first` to `last`, without the latter."""
        rows = slice(first, last)
        return States(
            self.rotations[rows].copy(),
            self.positions[rows].copy(),
            self.velocities[rows].copy(),
            self.biases[rows].copy(),
        )

    def joined(self, later: "States") -> "States":
        """These states and then others."""
        return States(
            np.concatenate([self.rotations, later.rotations]),
            np.concatenate([self.positions, later.positions]),
            np.concatenate([self.velocities, later.velocities]),
            np.concatenate([self.biases, later.biases]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RelativePoses:
    """Measured poses of states as seen from those before, `earlier_from_later`.

    Attributes:
        locations: (F,) int64, the earlier states.
        rotations: (F, 3, 3); ways: (F, 3) [m].
        information: (F, 6, 6) of rotation [rad] and trajectory.
    """

    locations: Int64Array
    rotations: Float64Array
    trajectories: Float64Array
    information: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class BodySpeeds:
    """Known speeds along axes of the body.

    Attributes:
        locations: (F,) int64, the states.
        axes: (F, 3) unit vectors in the body; speeds: (F,) [m/s]; sigmas: (F,) [m/s].
    """

    locations: Int64Array
    axes: Float64Array
    speeds: Float64Array
    sigmas: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Everything that was measured of K states.

    Attributes:
        knots_ns: (K,) int64 [ns], their times.
        measured: (K - 1,) bool, between which an IMU measured.
        inertial: what it measured, for all K - 1 intervals; what stands in the others does not count.
        fixes, relative, speeds: further measurements.
        gravity: [m/s²], down the world's z axis.
        settings: noise that is taken for granted.
        information: (K - 1, 9, 9) of what the IMU measured.
    """

    knots_ns: Int64Array
    measured: BoolArray
    inertial: Preintegrated
    fixes: Fixes
    gravity: float
    settings: SmootherSettings
    relative: tuple[RelativePoses, ...] = ()
    speeds: tuple[BodySpeeds, ...] = ()
    information: Float64Array = field(init=False)

    def __post_init__(self) -> None:
        information = np.zeros((len(self.measured), 9, 9))
        if self.measured.any():
            information[self.measured] = np.linalg.inv(self.inertial.covariances[self.measured])
        object.__setattr__(self, "information", information)

    @property
    def seconds(self) -> Float64Array:
        """(K - 1,) between the states."""
        seconds: Float64Array = np.diff(self.knots_ns) * 1e-9
        return seconds

    def part(self, first: int, last: int) -> "Chain":
        """What was measured of states `first` to `last`, without the latter."""
        rows = slice(first, last - 1)
        return replace(
            self,
            knots_ns=self.knots_ns[first:last],
            measured=self.measured[rows],
            inertial=self.inertial.part(rows),
            fixes=self.fixes.within(first, last),
            relative=tuple(_relative_within(one, first, last) for one in self.relative),
            speeds=tuple(_speeds_within(one, first, last) for one in self.speeds),
        )


def _relative_within(one: RelativePoses, first: int, last: int) -> RelativePoses:
    inside = (one.locations >= first) & (one.locations < last - 1)
    return RelativePoses(
        one.locations[inside] - first,
        one.rotations[inside],
        one.trajectories[inside],
        one.information[inside],
    )


def _speeds_within(one: BodySpeeds, first: int, last: int) -> BodySpeeds:
    inside = (one.locations >= first) & (one.locations < last)
    return BodySpeeds(one.locations[inside] - first, one.axes[inside], one.speeds[inside], one.sigmas[inside])


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Normal equations around some states, and how well these fit.

    Attributes:
        blocks, couplings, right: (K, 15, 15), (K - 1, 15, 15), (K, 15).
        cost: weighted sum of squares.
        fix_residuals: (F, 3) [m].
    """

    blocks: Float64Array
    couplings: Float64Array
    right: Float64Array
    cost: float
    fix_residuals: Float64Array


def equations(chain: Chain, states: States, weights: Float64Array) -> Equations:
    """Linearise everything that was measured around some states.

    Args:
        weights: (F,) of the fixes, 0 to 1.
    """
    count = len(states.positions)
    blocks, couplings = np.zeros((count, SIZE, SIZE)), np.zeros((count - 1, SIZE, SIZE))
    right = np.zeros((count, SIZE))
    normal = (blocks, couplings, right)
    cost = _add_priors(chain, states, blocks, right)
    cost += _add_motion(chain, states, normal)
    for relative in chain.relative:
        residuals = np.empty((len(relative.locations), 6))
        cost += kernels.add_relative_poses(
            states.rotations, states.positions, relative.locations, relative.rotations, relative.trajectories,
            relative.information, *normal, residuals,
        )  # fmt: skip
    for speeds in chain.speeds:
        speed_residuals = np.empty(len(speeds.locations))
        cost += kernels.add_body_speeds(
            states.rotations, states.velocities, speeds.locations, speeds.axes, speeds.speeds,
            speeds.sigmas**-2.0, blocks, right, speed_residuals,
        )  # fmt: skip
    fixes = chain.fixes
    fix_residuals = np.empty((len(fixes), 3))
    cost += kernels.add_fixes(
        states.rotations, states.positions, states.velocities, states.biases, fixes.locations, fixes.seconds,
        fixes.positions, fixes.levers, fixes.falls, fixes.slopes, fixes.biases,
        weights[:, None] * fixes.sigmas**-2.0, blocks, right, fix_residuals,
    )  # fmt: skip
    return Equations(blocks, couplings, right, cost, fix_residuals)


def _add_priors(chain: Chain, states: States, blocks: Float64Array, right: Float64Array) -> float:
    """What is known of the first state before anything was measured; without an IMU, that it stands about upright."""
    settings = chain.settings
    cost = 0.0
    for rows, value, sigma in (
        (VELOCITY, states.velocities[0], _UNKNOWN_SPEED),
        (GYROSCOPE, states.biases[0, :3], settings.gyroscope_bias),
        (ACCELEROMETER, states.biases[0, 3:], settings.accelerometer_bias),
    ):
        blocks[0, rows, rows] += np.eye(3) * sigma**-2
        right[0, rows] -= value * sigma**-2
        cost += float(value @ value) * sigma**-2
    blocks[0, MOTION_CHAIN_ROTATION, MOTION_CHAIN_ROTATION] += np.eye(3) * _UNKNOWN_ROTATION**-2
    if not chain.measured.any():
        k = next((int(one.locations[0]) for one in chain.relative if len(one.locations)), 0)
        slope = np.cross(states.rotations[k], [0.0, 0.0, -1.0])[:2]
        tilt = states.rotations[k][:2, 2]
        blocks[k, MOTION_CHAIN_ROTATION, MOTION_CHAIN_ROTATION] += slope.T @ slope * _TILT**-2
        right[k, MOTION_CHAIN_ROTATION] -= slope.T @ tilt * _TILT**-2
        cost += float(tilt @ tilt) * _TILT**-2
    return cost


def _add_motion(
    chain: Chain, states: States, normal: tuple[Float64Array, Float64Array, Float64Array]
) -> float:
    settings, seconds, inertial = chain.settings, chain.seconds, chain.inertial
    walks = np.repeat([settings.gyroscope_walk, settings.accelerometer_walk], 3)
    walk = 1.0 / (seconds[:, None] * walks**2)
    cost = kernels.add_walk(states.biases, walk, *normal)
    cost += kernels.add_inertial(
        states.rotations, states.positions, states.velocities, states.biases, seconds, chain.gravity,
        np.flatnonzero(chain.measured), inertial.rotations, inertial.gains, inertial.trajectories, inertial.slopes,
        chain.information, inertial.biases, *normal,
    )  # fmt: skip
    coasting = np.flatnonzero(~chain.measured)
    if len(coasting) == 0:
        return float(cost)
    cost += kernels.add_coasting(
        states.positions, states.velocities, seconds, coasting, settings.acceleration**2, *normal
    )
    rotations = np.tile(np.eye(3), (len(coasting), 1, 1))
    information = np.zeros((len(coasting), 6, 6))
    information[:, :3, :3] = np.eye(3) / (settings.rotating**2 * seconds[coasting, None, None])
    cost += kernels.add_relative_poses(
        states.rotations, states.positions, coasting, rotations, np.zeros((len(coasting), 3)), information, *normal,
        np.empty((len(coasting), 6)),
    )  # fmt: skip
    return float(cost)


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A step towards states that fit better.

    Attributes:
        states: after the step.
        equations: around these, with the weights of the step.
        damping: with which the step was found, to begin the next with.
    """

    states: States
    equations: Equations
    damping: float


def step(
    chain: Chain, states: States, weights: Float64Array, damping: float, *, here: Equations | None = None
) -> Step:
    """Go one step of Levenberg and Marquardt; where no step helps, none is gone.

    Args:
        here: equations around the states with these weights, where they are known already.

    Source: Madsen, Nielsen and Tingleff 2004, "Methods for Non-Linear Least Squares Problems", 3.2.
    """
    here = equations(chain, states, weights) if here is None else here
    factors, gains = np.empty_like(here.blocks), np.empty_like(here.couplings)
    solution = np.empty_like(here.right)
    for _ in range(_MAX_DAMPINGS):
        failed = solve_chain(here.blocks, here.couplings, here.right, damping, factors, gains, solution)
        if failed < 0 and np.isfinite(solution).all():
            stepped = states.stepped(solution)
            there = equations(chain, stepped, weights)
            if there.cost <= here.cost * (1.0 + 1e-12) + 1e-12:
                return Step(stepped, there, 0.0 if damping < 1e-8 else damping / 10.0)
        damping = max(10.0 * damping, 1e-6)
    return Step(states, here, damping)


def covariances(chain: Chain, states: States, weights: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Give the covariance of each state, (K, 15, 15), and with the next, (K - 1, 15, 15).

    Raises:
        PoseError: the equations hold what is no number.
    """
    here = equations(chain, states, weights)
    factors, gains = np.empty_like(here.blocks), np.empty_like(here.couplings)
    damping, solution = 0.0, np.empty_like(here.right)
    while solve_chain(here.blocks, here.couplings, here.right, damping, factors, gains, solution) >= 0:
        if damping > _LARGEST_DAMPING:
            raise PoseError("the measurements leave the trajectory open: their equations have no solution")
        damping = max(10.0 * damping, 1e-14)
    own, between = np.empty_like(here.blocks), np.empty_like(here.couplings)
    chain_covariances(factors, gains, own, between)
    return own, between


def inertial_residuals(chain: Chain, states: States) -> tuple[Float64Array, Float64Array, Float64Array]:
    """How far the states are from what the IMU measured: (K - 1, 9), and slopes by both states, (K - 1, 9, 15).

    The slopes of the rotation leave out what is second order in its residual.
    """
    seconds, inertial = chain.seconds[:, None], chain.inertial
    changes = np.einsum("nij,nj->ni", inertial.slopes, states.biases[:-1] - inertial.biases)
    before, inverse = states.rotations[:-1], np.swapaxes(states.rotations[:-1], 1, 2)
    relative = inverse @ states.rotations[1:]
    expected = inertial.rotations @ matrix_from_quaternion(quaternion_from_rotation_vector(changes[:, :3]))
    apart = np.swapaxes(expected, 1, 2) @ relative
    down = np.array([0.0, 0.0, -chain.gravity])
    gain = np.diff(states.velocities, axis=0) - seconds * down
    trajectory = (
        np.diff(states.positions, axis=0) - seconds * states.velocities[:-1] - 0.5 * seconds**2 * down
    )
    felt, gone = (np.einsum("nji,nj->ni", before, vector) for vector in (gain, trajectory))
    rotation = rotation_vector_from_quaternion(quaternion_from_matrix(apart))
    residuals = np.hstack([rotation, felt - inertial.gains, gone - inertial.trajectories])
    residuals[:, 3:] -= changes[:, 3:]
    first, second = np.zeros((len(seconds), 9, SIZE)), np.zeros((len(seconds), 9, SIZE))
    first[:, :3, MOTION_CHAIN_ROTATION], second[:, :3, MOTION_CHAIN_ROTATION] = (
        -np.swapaxes(relative, 1, 2),
        np.eye(3),
    )
    first[:, 3:6, MOTION_CHAIN_ROTATION], first[:, 6:9, MOTION_CHAIN_ROTATION] = (
        -crossed_with(felt),
        -crossed_with(gone),
    )
    first[:, 3:6, VELOCITY], second[:, 3:6, VELOCITY] = -inverse, inverse
    first[:, 6:9, POSITION], second[:, 6:9, POSITION] = -inverse, inverse
    first[:, 6:9, VELOCITY] = -seconds[:, :, None] * inverse
    first[:, :, 9:] = -inertial.slopes
    return residuals, first, second
