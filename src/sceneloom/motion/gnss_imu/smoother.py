"""GNSS/IMU smoothing: the ego trajectory that fits GNSS fixes, IMU samples and lidar odometry best."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.errors import PoseError
from sceneloom.geometry.geodesy import normal_gravity
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
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    chain_covariances,
    preintegrate_until,
    solve_chain,
)
from sceneloom.motion.ego_trajectory import gnss_receivers
from sceneloom.motion.gnss_imu.measurements import (
    CLOSEST_NS,
    DEFAULTS,
    Fixes,
    GnssFixes,
    InertialSamples,
    Preintegrated,
    SmootherSettings,
    crossed_with,
    knot_times,
)
from sceneloom.motion.imu import QUIET_FORCE, QUIET_RATE, WHITE, find_stationary
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene
from sceneloom.warnings import DataWarning, WarningKind

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
        rotations = matrix_from_quaternion(quaternion_from_rotation_vector(step[:, ROTATION]))
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
class _Equations:
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


def equations(chain: Chain, states: States, weights: Float64Array) -> _Equations:
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
    return _Equations(blocks, couplings, right, cost, fix_residuals)


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
    blocks[0, ROTATION, ROTATION] += np.eye(3) * _UNKNOWN_ROTATION**-2
    if not chain.measured.any():
        k = next((int(one.locations[0]) for one in chain.relative if len(one.locations)), 0)
        slope = np.cross(states.rotations[k], [0.0, 0.0, -1.0])[:2]
        tilt = states.rotations[k][:2, 2]
        blocks[k, ROTATION, ROTATION] += slope.T @ slope * _TILT**-2
        right[k, ROTATION] -= slope.T @ tilt * _TILT**-2
        cost += float(tilt @ tilt) * _TILT**-2
    return cost


def _add_motion(chain: Chain, states: States, normal: tuple[Float64Array, Float64Array, Float64Array]) -> float:
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
    equations: _Equations
    damping: float


def step(
    chain: Chain, states: States, weights: Float64Array, damping: float, *, here: _Equations | None = None
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


def _covariances(chain: Chain, states: States, weights: Float64Array) -> tuple[Float64Array, Float64Array]:
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
    trajectory = np.diff(states.positions, axis=0) - seconds * states.velocities[:-1] - 0.5 * seconds**2 * down
    felt, gone = (np.einsum("nji,nj->ni", before, vector) for vector in (gain, trajectory))
    rotation = rotation_vector_from_quaternion(quaternion_from_matrix(apart))
    residuals = np.hstack([rotation, felt - inertial.gains, gone - inertial.trajectories])
    residuals[:, 3:] -= changes[:, 3:]
    first, second = np.zeros((len(seconds), 9, SIZE)), np.zeros((len(seconds), 9, SIZE))
    first[:, :3, ROTATION], second[:, :3, ROTATION] = (
        -np.swapaxes(relative, 1, 2),
        np.eye(3),
    )
    first[:, 3:6, ROTATION], first[:, 6:9, ROTATION] = (
        -crossed_with(felt),
        -crossed_with(gone),
    )
    first[:, 3:6, VELOCITY], second[:, 3:6, VELOCITY] = -inverse, inverse
    first[:, 6:9, POSITION], second[:, 6:9, POSITION] = -inverse, inverse
    first[:, 6:9, VELOCITY] = -seconds[:, :, None] * inverse
    first[:, :, 9:] = -inertial.slopes
    return residuals, first, second


_HUBER = 1.5
"""Standard deviations from which on a fix loses weight while the states are still far off."""

_MOST_STEPS = 30

_SETTLED = 1e-4
"""Change of the cost, relative to it, below which no further step is gone."""

_MOST_ROUNDS, _FEW_STEPS, _MOST_CHANGES = 25, 4, 3
"""Rounds of leaving out and taking back, steps in each, and how often one fix may change."""

_READMITTED, _AROUND = 0.7, 2
"""A fix comes back well inside the gate; of so many neighbours on each side only the worst goes at a time."""

_MEDIAN_FLAT, _MEDIAN_UP, _MEDIAN_ROOT = 1.3863, 0.4549, 0.888
"""Medians of chi-square with two degrees of freedom, with one, and of the root of a third of it with three."""

_DECLARED_WORTH = 1.0
"""The accuracy that a receiver reports counts as this many measurements of it."""

_INERTIAL_WORTH = 6.0
"""What the samples report their noise counts as this many measurements of it."""

_LEAST_SCALE, _LARGEST_SCALE = 1e-3, 1e3


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """States that fit a chain's measurements.

    Attributes:
        chain: the measurements, their noise as found.
        states: which fit them.
        weights: (F,) of the fixes, 0 to 1.
        cost: weighted sum of squares.
    """

    chain: Chain
    states: States
    weights: Float64Array
    cost: float


def _squares(fixes: Fixes, residuals: Float64Array) -> Float64Array:
    """(F,) squared distance of each fix in standard deviations."""
    distance: Float64Array = ((residuals / fixes.sigmas) ** 2).sum(axis=1)
    return distance


def _fit_gently(chain: Chain, states: States, *, steps: int = _MOST_STEPS) -> _Fit:
    """Fit with weights that fall off slowly (Huber 1964), so that no start is too far off."""
    return _fitted(chain, states, steps)


def _fit_sternly(fit: _Fit, *, scaled: bool) -> _Fit:
    """Fit with fixes that have a state or none: those that jump lose it, worst first, and may get it back.

    Each fix is held against where the others state that it should be, in standard deviations, so that one at an end or
    in a gap, which bends the trajectory towards itself, is found as well. Until the noise is scaled, the median of
    these distances reports it, which half of the fixes cannot spoil.

    Args:
        fit: to begin with.
        scaled: whether the fixes' noise is known from their residuals.

    Source: Baarda 1968, "A Testing Procedure for Use in Geodetic Networks"; for the gate in two dimensions, the
    distribution of Rayleigh.
    """
    states, weights = fit.states, fit.weights
    changes = np.zeros(len(weights), np.int64)
    for number in range(_MOST_ROUNDS):
        if number:
            states = _settled(fit.chain, states, weights, _FEW_STEPS).states
        ratios = _gate_ratios(_Fit(fit.chain, states, weights, 0.0), scaled=scaled)
        allowed = changes < _MOST_CHANGES
        dropped = (ratios > 1.0) & (weights > 0) & _is_worst_around(np.where(weights > 0, ratios, -np.inf)) & allowed
        taken = (ratios < _READMITTED) & (weights == 0) & allowed
        full = np.where(dropped, 0.0, np.where(taken | (weights > 0), 1.0, 0.0))
        if number and (full == weights).all():
            break
        changes += (full > 0) != (weights > 0)
        weights = full
    return _settled(fit.chain, states, weights, _MOST_STEPS)


def _gate_ratios(fit: _Fit, *, scaled: bool) -> Float64Array:
    """(F,) squared distances of the fixes from where the others put them, in units of the gate's."""
    chain, fixes = fit.chain, fit.chain.fixes
    own, _ = _covariances(chain, fit.states, fit.weights)
    spread = fixes.variances(fit.states.rotations, own)
    residuals = equations(chain, fit.states, fit.weights).fix_residuals
    known = np.where(fit.weights[:, None] > 0, -fit.weights[:, None] * spread, spread)
    apart = residuals**2 / np.maximum(fixes.sigmas**2 + known, 0.05 * fixes.sigmas**2)
    flat, up = apart[:, :2].sum(axis=1), apart[:, 2]
    rare = math.erfc(chain.settings.gate / math.sqrt(2.0))
    ratios = np.empty(len(fixes))
    for receiver in np.unique(fixes.receivers):
        rows = fixes.receivers == receiver
        if not scaled:
            flat[rows] /= max(np.median(flat[rows]) / _MEDIAN_FLAT, _LEAST_SCALE**2)
            up[rows] /= max(np.median(up[rows]) / _MEDIAN_UP, _LEAST_SCALE**2)
        taken = np.clip(known[rows] / fixes.sigmas[rows] ** 2, -1.0, 0.0)
        free = (fit.weights[rows, None] * (1.0 + taken)).sum(axis=0)
        across = _rarity(flat[rows], float(free[:2].sum()), 2, scaled=scaled)
        along_up = _rarity(up[rows], float(free[2]), 1, scaled=scaled)
        ratios[rows] = np.maximum(across, along_up) / -math.log(rare)
    return ratios


def _rarity(distances: Float64Array, free: float, axes: int, *, scaled: bool) -> Float64Array:
    """How rare distances are, as minus the logarithm; for one axis as if it were two, which is nearly the same.

    Where the noise comes from the residuals, one that jumps has its share in it: the fewer there are, the more.

    Source: Pope 1976, "The Statistics of Residuals and the Detection of Outliers", for two axes in closed form.
    """
    rarity: Float64Array = 0.5 * distances
    if scaled and free > axes + 1.0:
        rarity = -0.5 * (free - axes) * np.log(np.maximum(1.0 - distances / free, 1e-12))
    return rarity


def _is_worst_around(ratios: Float64Array) -> BoolArray:
    padded = np.pad(ratios, _AROUND, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1)
    worst: BoolArray = ratios >= windows.max(axis=1)
    return worst


def _settled(chain: Chain, states: States, weights: Float64Array, steps: int) -> _Fit:
    """Go steps with given weights until nothing changes."""
    damping = 0.0
    here = equations(chain, states, weights)
    for _ in range(steps):
        gone = step(chain, states, weights, damping, here=here)
        settled = here.cost - gone.equations.cost <= _SETTLED * here.cost
        states, damping, here = gone.states, gone.damping, gone.equations
        if settled:
            break
    return _Fit(chain, states, weights, here.cost)


def _fitted(chain: Chain, states: States, steps: int) -> _Fit:
    damping, cost = 1e-4, np.inf
    weights = np.ones(len(chain.fixes))
    here = equations(chain, states, weights)
    for _ in range(steps):
        roots = np.sqrt(np.maximum(_squares(chain.fixes, here.fix_residuals) / 3.0, 1e-30))
        middle = float(np.median(roots)) if len(roots) else _MEDIAN_ROOT
        bend = _HUBER * max(middle / _MEDIAN_ROOT, _LEAST_SCALE)
        weights = np.minimum(1.0, bend / roots)
        gone = step(chain, states, weights, damping)
        states, damping, here = gone.states, gone.damping, gone.equations
        total = _huber_cost(chain, here, weights, bend)
        if abs(cost - total) <= _SETTLED * total:
            break
        cost = total
    return _Fit(chain, states, weights, total)


def _huber_cost(chain: Chain, here: _Equations, weights: Float64Array, bend: float) -> float:
    distances = _squares(chain.fixes, here.fix_residuals)
    quadratic = float((weights * distances).sum())
    roots = np.sqrt(distances / 3.0)
    huber = np.where(roots <= bend, distances, 3.0 * (2.0 * bend * roots - bend**2))
    return here.cost - quadratic + float(huber.sum())


def _rescaled(fit: _Fit) -> tuple[_Fit, Float64Array]:
    """Scale the fixes' noise to what their residuals show.

    Returns:
        The fit, with the new noise in its chain, and (F, 2) the factors, horizontal and vertical.

    Source: Förstner 1979, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten": the sum of squares over
    the redundancy, which the states' own covariance reports.
    """
    chain, fixes = fit.chain, fit.chain.fixes
    own, _ = _covariances(chain, fit.states, fit.weights)
    spread = fixes.variances(fit.states.rotations, own)
    residuals = equations(chain, fit.states, fit.weights).fix_residuals
    share = (fit.weights[:, None] / fixes.sigmas**2) * spread
    redundancy = fit.weights[:, None] * np.clip(1.0 - share, 0.0, 1.0)
    weighted = fit.weights[:, None] * (residuals / fixes.sigmas) ** 2
    factors = np.ones((len(fixes), 2))
    for receiver in np.unique(fixes.receivers):
        rows = fixes.receivers == receiver
        for column, axes in enumerate((slice(0, 2), slice(2, 3))):
            total = weighted[rows, axes].sum() + _DECLARED_WORTH
            free = redundancy[rows, axes].sum() + _DECLARED_WORTH
            factors[rows, column] = np.clip(np.sqrt(total / free), _LEAST_SCALE, _LARGEST_SCALE)
    sigmas = np.maximum(fixes.sigmas * factors[:, [0, 0, 1]], chain.settings.least_fix_noise)
    return replace(fit, chain=replace(chain, fixes=replace(fixes, sigmas=sigmas))), factors


def _inertial_factors(fit: _Fit) -> Float64Array:
    """(2,) factors by which the IMU's noise, of angular velocity and force, shows to be larger than taken; at least 1.

    Source: Förstner 1979, as in `_rescaled`; the rotation's share of velocity and trajectory is taken out first.
    """
    chain = fit.chain
    rows = np.flatnonzero(chain.measured)
    if len(rows) == 0:
        return np.ones(2)
    own, between = _covariances(chain, fit.states, fit.weights)
    residuals, first, second = inertial_residuals(chain, fit.states)
    whitened = np.linalg.inv(np.linalg.cholesky(chain.inertial.covariances[rows]))
    residuals = np.einsum("nij,nj->ni", whitened, residuals[rows])
    first, second = whitened @ first[rows], whitened @ second[rows]
    early, late, cross = own[rows], own[rows + 1], between[rows]
    taken = np.einsum("nij,njk,nik->ni", first, early, first)
    taken += np.einsum("nij,njk,nik->ni", second, late, second)
    taken += 2.0 * np.einsum("nij,njk,nik->ni", first, cross, second)
    redundancy = np.clip(1.0 - taken, 0.0, 1.0)
    factors = np.ones(2)
    for k, columns in enumerate((slice(0, 3), slice(3, 9))):
        total = (residuals[:, columns] ** 2).sum() + _INERTIAL_WORTH
        free = redundancy[:, columns].sum() + _INERTIAL_WORTH
        factors[k] = np.clip(np.sqrt(total / free), 1.0, _LARGEST_SCALE)
    return factors


_FIRST_TRAJECTORY, _FIRST_SECONDS, _FIRST_KNOTS = 30.0, 10.0, 12
"""The first piece that is fitted lasts so long and reaches so far [m], as far as there is as much."""

_SPAN = 1.0
"""Gains of velocity are compared over this time [s], so that the noise of velocities counts less."""

_QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)

_SURELY_BETTER = 9.0
"""A start that needs the ego to look elsewhere than ahead has to fit better by so much: three standard deviations."""


def _coasted(chain: Chain, states: States) -> _Fit:
    """Fit the fixes alone, and find their noise."""
    fit = _fit_gently(chain, states)
    for _ in range(3):
        fit, _ = _rescaled(fit)
        fit = _fit_gently(fit.chain, fit.states)
    return fit


def _stationary_states(chain: Chain, gyroscope_bias: Float64Array | None = None) -> States:
    """States at the fixes, level, looking east, without speed."""
    count = len(chain.knots_ns)
    fixes = chain.fixes
    start_ns = chain.knots_ns[0]
    seconds, reported = (chain.knots_ns - start_ns) * 1e-9, (fixes.timestamps_ns - start_ns) * 1e-9
    positions = np.stack([np.interp(seconds, reported, column) for column in fixes.positions.T], axis=1)
    biases = np.zeros((count, 6))
    if gyroscope_bias is not None:
        biases[:, :3] = gyroscope_bias
    return States(np.tile(np.eye(3), (count, 1, 1)), positions, np.zeros((count, 3)), biases)


def _oriented(chain: Chain, coasting: States) -> _Fit:
    """Fit fixes and IMU: a first piece from several headings, then more and more of the drive around it."""
    count = len(chain.knots_ns)
    first, last = _first_piece(chain, coasting)
    fit = _best_of_headings(chain.part(first, last), coasting.part(first, last))
    while first > 0 or last < count:
        length = last - first
        earlier, later = max(first - length, 0), min(last + length, count)
        states = _extended(chain, coasting, fit.states, first, last, earlier, later)
        fit = _fit_gently(chain.part(earlier, later), states)
        first, last = earlier, later
    return fit


def _first_piece(chain: Chain, states: States) -> tuple[int, int]:
    """The first knots over which the IMU measured without a gap and the ego moved far enough, else the longest."""
    seconds = np.concatenate([[0.0], np.cumsum(chain.seconds)])
    trajectory = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(states.positions, axis=0), axis=1))])
    longest = (0, min(2, len(seconds)))
    for first, last in _measured_runs(chain):
        enough = (trajectory[first:last] - trajectory[first] >= _FIRST_TRAJECTORY) & (
            seconds[first:last] - seconds[first] >= _FIRST_SECONDS
        )
        enough &= np.arange(last - first) >= _FIRST_KNOTS
        if enough.any():
            stop = first + int(np.argmax(enough)) + 1
            start = int(np.searchsorted(trajectory, trajectory[stop - 1] - 1.5 * _FIRST_TRAJECTORY))
            start = min(start, int(np.searchsorted(seconds, seconds[stop - 1] - _FIRST_SECONDS)))
            return max(first, start), stop
        if trajectory[last - 1] - trajectory[first] > trajectory[longest[1] - 1] - trajectory[longest[0]]:
            longest = (first, last)
    return longest


def _measured_runs(chain: Chain) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chain.measured, [False]]).astype(np.int8)))
    return [(int(start), int(stop) + 1) for start, stop in edges.reshape(-1, 2)]


def _best_of_headings(chain: Chain, states: States) -> _Fit:
    """Try where the ego may have looked; where several fit alike, it looked where it went."""
    rotated = _rotated_by_gyroscope(chain)
    level = _wahba(chain, states, rotated)
    headings = [_along_motion(states, level @ rotated)]
    headings += [_about_up(angle) @ level for angle in _QUARTERS]
    fits = []
    for first in headings:
        begun = replace(states, rotations=np.ascontiguousarray(first @ rotated))
        fits.append(_fit_gently(chain, begun))
    best = min(fits, key=lambda fit: fit.cost)
    return fits[0] if fits[0].cost <= best.cost + _SURELY_BETTER else best


def _rotated_by_gyroscope(chain: Chain) -> Float64Array:
    """(K, 3, 3) `first_from_body` by the gyroscope alone, as preintegrated."""
    inertial = chain.inertial
    rotated = np.empty((len(chain.knots_ns), 3, 3))
    rotated[0] = np.eye(3)
    for k in range(len(chain.measured)):
        rotated[k + 1] = rotated[k] @ inertial.rotations[k] if chain.measured[k] else rotated[k]
    return rotated


def _wahba(chain: Chain, states: States, rotated: Float64Array) -> Float64Array:
    """The orientation at the first knot by which the felt gains of velocity become those of the fixes, and gravity.

    Source: Wahba 1965, solved as by Markley 1988, "Attitude Determination using Vector Observations and the Singular
    Value Decomposition".
    """
    seconds = chain.seconds
    felt = np.einsum("kij,kj->ki", rotated[:-1], chain.inertial.gains)
    seen = np.diff(states.velocities, axis=0) + seconds[:, None] * [0.0, 0.0, chain.gravity]
    felt, seen = felt[chain.measured], seen[chain.measured]
    span = np.floor(np.cumsum(seconds[chain.measured]) / _SPAN).astype(np.int64)
    felt, seen = _sums(span, felt), _sums(span, seen)
    u, _, vt = np.linalg.svd(seen.T @ felt)
    rotation: Float64Array = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rotation


def _sums(groups: Int64Array, values: Float64Array) -> Float64Array:
    return np.stack([np.bincount(groups, column) for column in values.T], axis=1)


def _along_motion(states: States, rotations: Float64Array) -> Float64Array:
    """The first orientation rotated about up so that on the whole the body looks where it goes."""
    ahead = rotations[:, :2, 0]
    speed = states.velocities[:, :2]
    cosine = (ahead * speed).sum()
    sine = (ahead[:, 0] * speed[:, 1] - ahead[:, 1] * speed[:, 0]).sum()
    rotated: Float64Array = _about_up(float(np.arctan2(sine, cosine))) @ rotations[0]
    return rotated


def _about_up(angle: float) -> Float64Array:
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _extended(chain: Chain, coasting: States, known: States, first: int, last: int, earlier: int, later: int) -> States:
    """Carry orientations on by the gyroscope, beyond both ends of what is known; the rest comes from the fixes."""
    rotations = np.empty((later - earlier, 3, 3))
    rotations[first - earlier : last - earlier] = known.rotations
    biases = np.empty((later - earlier, 6))
    biases[: first - earlier], biases[last - earlier :] = known.biases[0], known.biases[-1]
    biases[first - earlier : last - earlier] = known.biases
    for k in range(last - 1, later - 1):
        rotations[k + 1 - earlier] = rotations[k - earlier] @ _rotation(chain, k, known.biases[-1])
    for k in range(first - 1, earlier - 1, -1):
        rotations[k - earlier] = rotations[k + 1 - earlier] @ _rotation(chain, k, known.biases[0]).T
    before, after = coasting.part(earlier, first), coasting.part(last, later)
    joined = before.joined(known).joined(after)
    return States(rotations, joined.positions, joined.velocities, biases)


def _rotation(chain: Chain, k: int, bias: Float64Array) -> Float64Array:
    if not chain.measured[k]:
        return np.eye(3)
    inertial = chain.inertial
    vector = inertial.slopes[k, :3] @ (bias - inertial.biases[k])
    rotated: Float64Array = inertial.rotations[k] @ matrix_from_quaternion(quaternion_from_rotation_vector(vector))
    return rotated


_SECONDS, _LEAST_SAMPLES = 1.0, 15
"""The IMU is judged over so long, and so many samples at least."""

_YAW_RATE = 0.02
"""Mean angular velocity of a stand, the bias taken off, at most [rad/s]."""

_SPEED, _DEVIATIONS = 0.2, 3.0
"""Speed that fixes may leave to a stand: at most this [m/s] and so many standard deviations more."""

_STILL_SPEED, _STILL_ROTATION, _STILL_TRAJECTORY = 0.02, 2e-4, 2e-3
"""How far a stand is none [m/s], and from one state to the next [rad] and [m]."""

_WIDE = 1.5
"""Excess of the variance over that of white noise that a low number of samples leaves to chance."""


def _stops(
    fit: _Fit, own: Float64Array, samples: InertialSamples
) -> tuple[tuple[BodySpeeds, ...], tuple[RelativePoses, ...]]:
    """Give what is known of the states at which the ego stands, as measurements.

    The IMU is quiet, and what is left is noise without sway; the fixes leave no speed. A smooth even drive passes the
    first test, hence the second.

    Args:
        own: (K, 15, 15) covariances of the states.

    Source: Skog, Händel, Nilsson and Rantakokko 2010, "Zero-Velocity Detection - An Algorithm Evaluation"; as in
    `motion.stationary`.
    """
    still = _stands(fit, own, samples)
    rows = np.flatnonzero(still)
    if len(rows) < 2:
        return (), ()
    axes = np.tile(np.eye(3), (len(rows), 1))
    count = len(axes)
    speeds = BodySpeeds(np.repeat(rows, 3), axes, np.zeros(count), np.full(count, _STILL_SPEED))
    locations = np.flatnonzero(still[:-1] & still[1:])
    information = np.diag(np.repeat([_STILL_ROTATION**-2, _STILL_TRAJECTORY**-2], 3))
    relative = RelativePoses(
        locations,
        np.tile(np.eye(3), (len(locations), 1, 1)),
        np.zeros((len(locations), 3)),
        np.tile(information, (len(locations), 1, 1)),
    )
    return (speeds,), (relative,)


def _stands(fit: _Fit, own: Float64Array, samples: InertialSamples) -> BoolArray:
    chain, states = fit.chain, fit.states
    quiet = _quiet(samples, chain.knots_ns, states.biases)
    speed = np.linalg.norm(states.velocities, axis=1)
    unsure = np.sqrt(np.einsum("kii->k", own[:, VELOCITY, VELOCITY]))
    inside = np.ones(len(quiet), np.bool_)
    inside[:-1] &= chain.measured
    inside[1:] &= chain.measured
    still: BoolArray = quiet & inside & (speed < _SPEED + _DEVIATIONS * unsure)
    return still


def _quiet(samples: InertialSamples, knots_ns: Int64Array, biases: Float64Array) -> BoolArray:
    """Whether the IMU is quiet around each state."""
    count = len(samples.timestamps_ns)
    width = max(round(_SECONDS / samples.period), _LEAST_SAMPLES)
    if count <= width:
        return np.zeros(len(knots_ns), np.bool_)
    values = samples.values - samples.values.mean(axis=0)
    sums = _running(values)
    squares = _running(values**2)
    steps = _running(np.vstack([np.diff(values, axis=0) ** 2, np.zeros((1, 6))]))
    middle = np.searchsorted(samples.timestamps_ns, knots_ns)
    first = np.clip(middle - width // 2, 0, count - width)
    mean = (sums[first + width] - sums[first]) / width
    variance = np.maximum((squares[first + width] - squares[first]) / width - mean**2, 0.0)
    successive = (steps[first + width - 1] - steps[first]) / (width - 1)
    calm = (variance < np.repeat([QUIET_RATE**2, QUIET_FORCE**2], 3)).all(axis=1)
    white = (variance <= _WIDE * WHITE * successive / 2 + 1e-20).all(axis=1)
    rate = mean[:, :3] + samples.values.mean(axis=0)[:3] - biases[:, :3]
    quiet: BoolArray = calm & white & (np.abs(rate) < _YAW_RATE).all(axis=1)
    return quiet


def _running(values: Float64Array) -> Float64Array:
    sums: Float64Array = np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    return sums


_EVERY = 1.0
"""The knowledge is used this often [s]: what is wrong with it stays wrong for about so long."""

_SLIP, _AXIS, _LEVER = 0.1, 0.02, 0.5
"""It is wrong by a slip [m/s], a share of the speed since the axis is not exactly the body's, and the angular velocity
times a lever [m], since the axle that does not slip is elsewhere."""

_MOVING = 2.0
"""Speed from which on a direction of motion counts [m/s]."""

_LEAST_ROTATION, _LEAST_KNOTS = np.radians(40.0), 8
"""To show that it holds, the ego has to rotate so far while it moves, over so many states."""

_FAST = 5.0
"""Or it moves so fast on the whole [m/s], along its x axis."""

_LARGEST_SHARE = 0.3
"""Sideways speeds have to be known to be below this share of the speed."""

_LARGEST_MISFIT = 2.0
"""Mean square of sideways speeds in units of what they may be."""


def _vehicle_speeds(fit: _Fit, own: Float64Array, samples: InertialSamples, *, asked: bool | None) -> BodySpeeds | None:
    """Give the knowledge as measurements, if the states show that it holds, or if it is asked for.

    It has to be seen in rotations, or at speed along the x axis: on a straight trajectory every body moves along one of
        its axes.

    Args:
        own: (K, 15, 15) covariances of the states.
        asked: True to have it in any case, False to have it in none, None for the states to decide.

    Source: Dissanayake, Sukkarieh, Nebot and Durrant-Whyte 2001, "The Aiding of a Low-Cost Strapdown Inertial
    Measurement Unit Using Vehicle Model Constraints for Land Vehicle Applications"; the test is ours.
    """
    if asked is False:
        return None
    chain, states = fit.chain, fit.states
    inside = np.einsum("nji,nj->ni", states.rotations, states.velocities)
    rates = _rates(chain, states, samples)
    rows = _spread_out(chain)
    if asked:
        return _speeds(rows, np.array([1.0, 0.0, 0.0]), inside, rates)
    for axis in _axes(inside):
        speeds = _speeds(rows, axis, inside, rates)
        if _shows(speeds, states, own, inside):
            return speeds
    return None


def _misfit(speeds: BodySpeeds, states: States) -> float:
    """Mean square of how far states are from it, in units of what they may be."""
    inside = np.einsum("nji,nj->ni", states.rotations[speeds.locations], states.velocities[speeds.locations])
    apart = (speeds.axes * inside).sum(axis=1) - speeds.speeds
    return float(((apart / speeds.sigmas) ** 2).mean())


def _axes(inside: Float64Array) -> list[Float64Array]:
    """The axes along which the body may move: its own x, and that along which it did most."""
    found = np.linalg.eigh(inside.T @ inside)[1][:, 2]
    return [np.array([1.0, 0.0, 0.0]), found * np.sign(inside.sum(axis=0) @ found or 1.0)]


def _spread_out(chain: Chain) -> Int64Array:
    seconds = (chain.knots_ns - chain.knots_ns[0]) * 1e-9
    _, rows = np.unique(np.floor(seconds / _EVERY + 1e-6), return_index=True)
    chosen: Int64Array = rows
    return chosen


def _rates(chain: Chain, states: States, samples: InertialSamples) -> Float64Array:
    """(K, 3) angular velocities at the states [rad/s]."""
    start = samples.timestamps_ns[0]
    times, knots = (samples.timestamps_ns - start) * 1e-9, (chain.knots_ns - start) * 1e-9
    rates = np.stack([np.interp(knots, times, samples.values[:, k]) for k in range(3)], axis=1)
    rotating: Float64Array = rates - states.biases[:, :3]
    return rotating


def _speeds(rows: Int64Array, axis: Float64Array, inside: Float64Array, rates: Float64Array) -> BodySpeeds:
    """No speed across an axis, at some states."""
    across = np.linalg.svd(axis[None])[2][1:]
    sigma = np.sqrt(
        _SLIP**2
        + (_AXIS * np.linalg.norm(inside[rows], axis=1)) ** 2
        + (_LEVER * np.linalg.norm(rates[rows], axis=1)) ** 2
    )
    locations = np.repeat(rows, 2)
    return BodySpeeds(locations, np.tile(across, (len(rows), 1)), np.zeros(len(locations)), np.repeat(sigma, 2))


def _shows(speeds: BodySpeeds, states: States, own: Float64Array, inside: Float64Array) -> bool:
    locations, axes = speeds.locations, speeds.axes
    speed = np.linalg.norm(inside[locations], axis=1)
    moving = speed > _MOVING
    if moving.sum() < 2 * _LEAST_KNOTS:
        return False
    rotating = _rotated(states, np.unique(locations[moving])) >= _LEAST_ROTATION
    fast = speed[moving].mean() >= _FAST and abs(axes[:, 0]).max() < 1e-6
    if not (rotating or fast):
        return False
    u = inside[locations]
    slopes = np.zeros((len(locations), 15))
    slopes[:, ROTATION] = np.cross(axes, u)
    slopes[:, VELOCITY] = np.einsum("nij,nj->ni", states.rotations[locations], axes)
    variance = np.einsum("ni,nij,nj->n", slopes, own[locations], slopes)
    sideways = (axes * u).sum(axis=1)
    known = np.sqrt((sideways**2 + variance)[moving].mean()) < _LARGEST_SHARE * np.sqrt((speed[moving] ** 2).mean())
    agrees = (sideways**2 / (variance + speeds.sigmas**2))[moving].mean() < _LARGEST_MISFIT
    return bool(known and agrees)


def _rotated(states: States, rows: Int64Array) -> float:
    """By how much the directions of motion at some states span [rad]."""
    direction = np.unwrap(np.arctan2(states.velocities[rows, 1], states.velocities[rows, 0]))
    return float(np.ptp(direction))


_LIDAR_STEPS_LEAST_ROTATION, _LEAST_TRAJECTORY = 3e-4, 5e-3
"""No step is believed to be better [rad] and [m]: what a fit onto the map repeats to."""

_ROUNDS = 8
"""Rounds of weighting the fixes by how they agree (L1)."""


def _lidar_steps(lidar: Trajectory, knots_ns: Int64Array) -> RelativePoses:
    """Give the steps from each state to the next within the odometry's trajectory, with what they add to its errors."""
    found = lidar.poses.interpolate(knots_ns)
    inside = found.coverage == 0
    locations = np.flatnonzero(inside[:-1] & inside[1:])
    rotations = np.full((len(knots_ns), 3, 3), np.nan)
    rotations[inside] = matrix_from_quaternion(found.quaternions_xyzw[inside])
    before, after = rotations[locations], rotations[locations + 1]
    steps = found.positions[locations + 1] - found.positions[locations]
    delta_rotations = np.swapaxes(before, 1, 2) @ after
    trajectories = np.einsum("nji,nj->ni", before, steps)
    added = _added(lidar, knots_ns, locations, steps)
    covariances = np.zeros((len(locations), 6, 6))
    covariances[:, :3, :3] = np.swapaxes(after, 1, 2) @ added[:, :3, :3] @ after
    covariances[:, 3:, 3:] = np.swapaxes(before, 1, 2) @ added[:, 3:, 3:] @ before
    covariances += np.diag(np.repeat([_LIDAR_STEPS_LEAST_ROTATION**2, _LEAST_TRAJECTORY**2], 3))
    return RelativePoses(locations, delta_rotations, trajectories, np.asarray(np.linalg.inv(covariances), np.float64))


def _added(lidar: Trajectory, knots_ns: Int64Array, locations: Int64Array, steps: Float64Array) -> Float64Array:
    """What the odometry's covariance grows by in each step beyond what the error before it makes of it, (F, 6, 6)."""
    if lidar.covariances is None:
        return np.zeros((len(locations), 6, 6))
    rows = np.clip(np.searchsorted(lidar.timestamps_ns, knots_ns), 0, len(lidar.timestamps_ns) - 1)
    known = lidar.covariances[rows]
    levers = np.tile(np.eye(6), (len(locations), 1, 1))
    x, y, z = steps.T
    nothing = np.zeros(len(locations))
    levers[:, 3:, :3] = np.stack([nothing, z, -y, -z, nothing, x, y, -x, nothing], axis=1).reshape(-1, 3, 3)
    grown = known[locations + 1] - levers @ known[locations] @ np.swapaxes(levers, 1, 2)
    values, axes = np.linalg.eigh(0.5 * (grown + np.swapaxes(grown, 1, 2)))
    positive: Float64Array = (axes * np.maximum(values, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return positive


def _led_by_lidar(lidar: Trajectory, knots_ns: Int64Array, fixes: Fixes) -> Float64Array:
    """Give orientations of the states, (K, 3, 3): the odometry's, its world rotated about up onto the fixes."""
    known = lidar.poses.held(knots_ns)
    here, there = known.positions[fixes.locations, :2], fixes.positions[:, :2]
    weights = np.ones(len(fixes))
    angle = 0.0
    for _ in range(_ROUNDS):
        share = weights / weights.sum()
        one, other = here - share @ here, there - share @ there
        dot = (share[:, None] * one * other).sum()
        cross = (share * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])).sum()
        angle = float(np.arctan2(cross, dot))
        cosine, sine = np.cos(angle), np.sin(angle)
        apart = np.hypot(*(one @ np.array([[cosine, sine], [-sine, cosine]]) - other).T)
        weights = 1.0 / np.maximum(apart, 0.1)
    delta_rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rotations: Float64Array = delta_rotation @ matrix_from_quaternion(known.quaternions_xyzw)
    return rotations


_SMOOTHER_ROUNDS = 4
"""So often the noise is reported anew from the residuals."""

_CONTRADICTED = 3.0
"""Mean square misfit of what is known of wheels, in units of what it may be, from which on it does not hold."""


@dataclass(frozen=True, slots=True, eq=False)
class _Smoothed:
    """What the smoother found.

    Attributes:
        fit: states at the knots, and what they fit.
        own: (K, 15, 15) covariances of the states, in the order of `kernels.motion_chain`.
        densities: (K - 1, 2) of the IMU's white noise, as found, (rad/s)²/Hz and (m/s²)²/Hz.
    """

    fit: _Fit
    own: Float64Array
    densities: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _Measurements:
    """What a drive offers to the smoother.

    Attributes:
        fixes: at least two.
        samples: of the IMU, or None.
        lidar: the trajectory by lidar odometry, or None.
        gravity: [m/s²].
        gyroscope_bias: (3,) [rad/s] to begin with, or None.
    """

    fixes: GnssFixes
    samples: InertialSamples | None
    lidar: Trajectory | None
    gravity: float
    gyroscope_bias: Float64Array | None


def _smoothed(drive: _Measurements, settings: SmootherSettings) -> _Smoothed:
    """Find the states that fit everything best."""
    chain, densities = _chain(drive, settings)
    coasting, chain = _begun(drive, chain)
    if drive.samples is not None:
        fit, densities = _refined(_oriented(chain, coasting.states), drive, drive.samples, densities)
    elif drive.lidar is not None:
        rotations = _led_by_lidar(drive.lidar, chain.knots_ns, chain.fixes)
        fit = _cleaned(_fit_gently(chain, replace(coasting.states, rotations=rotations)))
    else:
        fit = _cleaned(coasting)
    own, _ = _covariances(fit.chain, fit.states, fit.weights)
    return _Smoothed(fit, own, densities)


def _begun(drive: _Measurements, chain: Chain) -> tuple[_Fit, Chain]:
    """States by the fixes that have one alone, without an IMU, and the noise that these fixes show in the chain's."""
    unmeasured = np.zeros_like(chain.measured)
    fixes = drive.fixes.carried(chain.knots_ns, unmeasured, None, biases=chain.inertial.biases, gravity=drive.gravity)
    near = np.abs(fixes.seconds) <= CLOSEST_NS * 1e-9
    alone = replace(chain, measured=unmeasured, relative=(), fixes=fixes.chosen(near))
    coasting = _coasted(alone, _stationary_states(alone, drive.gyroscope_bias))
    sigmas = chain.fixes.sigmas.copy()
    for receiver in np.unique(fixes.receivers[near]):
        rows = fixes.receivers == receiver
        found = coasting.chain.fixes.sigmas[rows[near]]
        sigmas[rows] *= np.median(found / fixes.sigmas[near & rows], axis=0)
        sigmas[near & rows] = found
    return coasting, replace(chain, fixes=replace(chain.fixes, sigmas=sigmas))


def _cleaned(fit: _Fit) -> _Fit:
    """Fit again with fixes that jump left out and the noise as found."""
    fit = _fit_sternly(fit, scaled=False)
    for _ in range(_SMOOTHER_ROUNDS):
        fit = _fit_sternly(_rescaled(fit)[0], scaled=True)
    return fit


def _refined(
    fit: _Fit, drive: _Measurements, samples: InertialSamples, densities: Float64Array
) -> tuple[_Fit, Float64Array]:
    """Fit again with biases and noise as found, fixes that jump left out, and what is known of wheels and stands."""
    lidar = fit.chain.relative
    fit = _fit_sternly(fit, scaled=False)
    for number in range(_SMOOTHER_ROUNDS):
        densities = densities * _inertial_factors(fit) ** 2
        fit, _ = _rescaled(fit)
        begun = bool(fit.chain.speeds)
        chain = _knowing(fit, samples, lidar) if number >= _SMOOTHER_ROUNDS - 2 else fit.chain
        chain = _felt_anew(chain, drive.fixes, samples, fit.states.biases[:-1], densities)
        fit = replace(fit, chain=chain)
        if chain.speeds and not begun:
            # what bent the trajectory towards itself is seen against stiffer ways
            fit = _fit_sternly(_fit_gently(fit.chain, fit.states), scaled=False)
        else:
            fit = _fit_sternly(fit, scaled=True)
    believed = tuple(one for one in fit.chain.speeds if _misfit(one, fit.states) <= _CONTRADICTED)
    if len(believed) < len(fit.chain.speeds):
        fit = _fit_sternly(replace(fit, chain=replace(fit.chain, speeds=believed, relative=lidar)), scaled=True)
    return fit, densities


def _felt_anew(
    chain: Chain, fixes: GnssFixes, samples: InertialSamples, biases: Float64Array, densities: Float64Array
) -> Chain:
    """The measurements with what the IMU felt summed up with other biases and noise."""
    knots = chain.knots_ns
    inertial = samples.preintegrated(knots, biases=biases, densities=densities)
    carried = fixes.carried(
        knots, chain.measured, samples, biases=biases, gravity=chain.gravity, sigmas=chain.fixes.sigmas
    )
    return replace(chain, inertial=inertial, fixes=carried)


def _knowing(fit: _Fit, samples: InertialSamples, lidar: tuple[RelativePoses, ...]) -> Chain:
    """The measurements with what is known of an ego on wheels and of one that stands, where the states show it."""
    own, _ = _covariances(fit.chain, fit.states, fit.weights)
    wheels = _vehicle_speeds(fit, own, samples, asked=fit.chain.settings.vehicle)
    still, unmoved = _stops(fit, own, samples)
    speeds = still if wheels is None else (wheels, *still)
    return replace(fit.chain, speeds=speeds, relative=(*lidar, *unmoved))


def _chain(drive: _Measurements, settings: SmootherSettings) -> tuple[Chain, Float64Array]:
    fixes, samples, lidar = drive.fixes, drive.samples, drive.lidar
    further = np.empty(0, np.int64) if samples is not None or lidar is None else lidar.timestamps_ns
    knots = knot_times(fixes.timestamps_ns, samples, further, settings)
    count = len(knots) - 1
    biases = np.zeros((count, 6))
    if drive.gyroscope_bias is not None:
        biases[:, :3] = drive.gyroscope_bias
    if samples is None:
        measured, inertial, densities = np.zeros(count, np.bool_), _nothing_felt(biases), np.zeros((count, 2))
    else:
        measured = samples.is_measured(knots[:-1], knots[1:])
        densities = samples.noise_densities((knots[:-1] + knots[1:]) // 2, settings)
        inertial = samples.preintegrated(knots, biases=biases, densities=densities)
    carried = fixes.carried(knots, measured, samples, biases=biases, gravity=drive.gravity)
    relative = () if lidar is None else (_lidar_steps(lidar, knots),)
    return Chain(knots, measured, inertial, carried, drive.gravity, settings, relative), densities


def _nothing_felt(biases: Float64Array) -> Preintegrated:
    count = len(biases)
    rotations = np.tile(np.eye(3), (count, 1, 1))
    covariance = np.tile(np.eye(9), (count, 1, 1))
    nothing = np.zeros((count, 3))
    return Preintegrated(rotations, nothing, nothing.copy(), np.zeros((count, 9, 6)), covariance, biases)


_LEAST_FIXES = 8

_ALIKE, _LEAST_ALIKE = 1.3, 0.3
"""Residuals of neighbours are alike where their correlation is above so many standard deviations of that of white
noise, 1/√n, and above the second number; those of a smoother with white noise are rather unlike."""

_MOST_ALIKE = 0.98

_FARTHEST = 3.0
"""Fixes further apart in time [s] are no neighbours."""

_AXES = (slice(0, 2), slice(2, 3))


@dataclass(frozen=True, slots=True, eq=False)
class _Wander:
    """The slow error of the fixes along some axes.

    Attributes:
        sigma: its standard deviation [m].
        seconds: the time after which it has forgotten itself but for 1/e.
        alike: correlation of neighbouring residuals.
        times_ns: (F,) int64 [ns] of the fixes that went in.
        values: (F, axes) [m], the slow error at each.
    """

    sigma: float
    seconds: float
    alike: float
    times_ns: Int64Array
    values: Float64Array

    def at(self, times_ns: Int64Array) -> Float64Array:
        """Give it at some times, (N, axes) [m]: the mean between and beyond the fixes.

        Source: Rasmussen and Williams 2006, "Gaussian Processes for Machine Learning", 4.2.1, the exponential
        covariance, whose process is that of Ornstein and Uhlenbeck 1930 and needs the two neighbours only.
        """
        after = np.searchsorted(self.times_ns, times_ns)
        before, after = np.clip(after - 1, 0, None), np.clip(after, None, len(self.times_ns) - 1)
        one = np.exp(-np.abs(times_ns - self.times_ns[before]) * 1e-9 / self.seconds)
        other = np.exp(-np.abs(self.times_ns[after] - times_ns) * 1e-9 / self.seconds)
        both = np.where(before == after, 0.0, one * other)
        left = np.maximum(1.0 - both**2, 1e-12)
        inside = times_ns <= self.times_ns[-1]
        weights = np.stack([one - both * other, other - both * one]) / left
        weights[:, before == after] = np.stack([one, 0.0 * one])[:, before == after]
        weights[:, ~inside] = np.stack(
            [0.0 * one, np.exp(-np.abs(times_ns - self.times_ns[-1]) * 1e-9 / self.seconds)]
        )[:, ~inside]
        found: Float64Array = weights[0][:, None] * self.values[before] + weights[1][:, None] * self.values[after]
        return found


def _wandering(fit: _Fit) -> tuple[_Wander | None, _Wander | None]:
    """Find the slow error across and in height, where residuals of neighbouring fixes are alike."""
    fixes = fit.chain.fixes
    rows = np.flatnonzero(fit.weights > 0)
    if len(rows) < _LEAST_FIXES or len(np.unique(fixes.receivers)) > 1:
        return None, None
    residuals = -equations(fit.chain, fit.states, fit.weights).fix_residuals[rows]
    times = fixes.timestamps_ns[rows]
    across, height = (_wander(times, residuals[:, axes]) for axes in _AXES)
    return across, height


def _wander(times_ns: Int64Array, residuals: Float64Array) -> _Wander | None:
    steps = np.diff(times_ns) * 1e-9
    near = (steps > 0) & (steps <= max(_FARTHEST, 1.5 * float(np.median(steps))))
    variance = float((residuals**2).mean())
    if near.sum() < _LEAST_FIXES or variance == 0.0:
        return None
    alike = float((residuals[1:] * residuals[:-1])[near].mean()) / variance
    if alike < max(_LEAST_ALIKE, _ALIKE / np.sqrt(near.sum() * residuals.shape[1])):
        return None
    alike = min(alike, _MOST_ALIKE)
    seconds = -float(np.median(steps[near])) / np.log(alike)
    return _Wander(np.sqrt(variance), seconds, alike, times_ns, residuals)


_COASTING_STEP_NS = 100_000_000
"""Poses lie no farther apart where no IMU measured [ns]."""


@dataclass(frozen=True, slots=True, eq=False)
class _SmoothedTrajectory:
    """The motion at N times.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        rotations: (N, 3, 3) `world_from_body`.
        positions, velocities: (N, 3) [m] and [m/s], world.
        biases: (N, 6) of gyroscope [rad/s] and accelerometer [m/s²].
    """

    timestamps_ns: Int64Array
    rotations: Float64Array
    positions: Float64Array
    velocities: Float64Array
    biases: Float64Array


def _trajectory_times(chain: Chain, samples: InertialSamples | None) -> Int64Array:
    """The times of the states, of the IMU's samples between them, and some where it measured none."""
    times = [chain.knots_ns]
    if samples is not None:
        inside = samples.timestamps_ns
        times.append(inside[(inside >= chain.knots_ns[0]) & (inside <= chain.knots_ns[-1])])
    for k in np.flatnonzero(~chain.measured):
        start, stop = int(chain.knots_ns[k]), int(chain.knots_ns[k + 1])
        times.append(np.arange(start, stop, _COASTING_STEP_NS, dtype=np.int64))
    return np.unique(np.concatenate(times))


def _trajectory_between(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array
) -> _SmoothedTrajectory:
    """Give the motion at some times from the first state to the last.

    From each state the IMU leads on; what is missing at the next one is spread over the time between: of the rotation
    evenly, of position and velocity by the cubic that is the likeliest for white errors of the acceleration.

    Source: the cubic is the mean of the integrated Brownian bridge, Barfoot 2017, "State Estimation for Robotics",
    11.1.4 (white noise on acceleration).
    """
    knots = np.clip(np.searchsorted(chain.knots_ns, times_ns, side="right") - 1, 0, len(chain.measured) - 1)
    delta_rotations, gains, trajectories = _felt(chain, states, samples, times_ns, knots)
    all_knots = np.arange(len(chain.measured))
    end_rotations, end_gains, end_trajectories = _felt(chain, states, samples, chain.knots_ns[1:], all_knots)
    elapsed = np.asarray((times_ns - chain.knots_ns[knots]) * 1e-9, np.float64)
    rotations, positions, velocities = _led(chain, states, knots, elapsed, delta_rotations, gains, trajectories)
    ends = _led(chain, states, all_knots, chain.seconds, end_rotations, end_gains, end_trajectories)
    missing_rotation = rotation_vector_from_quaternion(
        quaternion_from_matrix(np.swapaxes(ends[0], 1, 2) @ states.rotations[1:])
    )
    missing_trajectory, missing_speed = states.positions[1:] - ends[1], states.velocities[1:] - ends[2]
    length = chain.seconds[knots][:, None]
    share = elapsed[:, None] / length
    rotated = matrix_from_quaternion(quaternion_from_rotation_vector(share * missing_rotation[knots]))
    trajectory, speed = missing_trajectory[knots], missing_speed[knots]
    positions += share**2 * (3.0 - 2.0 * share) * trajectory + share**2 * (share - 1.0) * length * speed
    velocities += 6.0 * share * (1.0 - share) * trajectory / length + share * (3.0 * share - 2.0) * speed
    biases = states.biases[knots] + share * (states.biases[knots + 1] - states.biases[knots])
    return _SmoothedTrajectory(times_ns, rotations @ rotated, positions, velocities, biases)


def _felt(
    chain: Chain, states: States, samples: InertialSamples | None, times_ns: Int64Array, knots: Int64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """What the IMU measured from the knot to each time; nothing where there is none."""
    count = len(times_ns)
    delta_rotations, gains, trajectories = (
        np.tile(np.eye(3), (count, 1, 1)),
        np.zeros((count, 3)),
        np.zeros((count, 3)),
    )
    if samples is not None:
        preintegrate_until(
            samples.timestamps_ns, samples.values, chain.knots_ns, np.ascontiguousarray(states.biases[:-1]), times_ns,
            knots, delta_rotations, gains, trajectories, np.empty((0, 9, 6)),
        )  # fmt: skip
    unmeasured = ~chain.measured[knots]
    delta_rotations[unmeasured], gains[unmeasured], trajectories[unmeasured] = np.eye(3), 0.0, 0.0
    return delta_rotations, gains, trajectories


def _led(
    chain: Chain, states: States, knots: Int64Array, elapsed: Float64Array, delta_rotations: Float64Array,
    gains: Float64Array, trajectories: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:  # fmt: skip
    """Rotation, position and velocity to which what was felt leads from the knot."""
    pull = np.where(chain.measured[knots], -chain.gravity, 0.0)[:, None] * [0.0, 0.0, 1.0]
    start, t = states.rotations[knots], elapsed[:, None]
    speed = states.velocities[knots]
    positions = states.positions[knots] + t * speed + 0.5 * t**2 * pull
    positions += np.einsum("nij,nj->ni", start, trajectories)
    velocities = speed + t * pull + np.einsum("nij,nj->ni", start, gains)
    return start @ delta_rotations, positions, velocities


def _pose_covariances(chain: Chain, states: States, own: Float64Array, trajectory: _SmoothedTrajectory) -> Float64Array:
    """Give the covariances of a small rotation [rad] and shift [m] about the world's axes, (N, 6, 6).

    They are those of the states; between two, which are at most a second apart, in proportion to the time.
    """
    axes = np.zeros((len(own), 6, 6))
    axes[:, :3, :3], axes[:, 3:, 3:] = states.rotations, np.eye(3)
    at_knots = axes @ own[:, :6, :6] @ np.swapaxes(axes, 1, 2)
    knots = np.clip(np.searchsorted(chain.knots_ns, trajectory.timestamps_ns, side="right") - 1, 0, len(own) - 2)
    share = ((trajectory.timestamps_ns - chain.knots_ns[knots]) * 1e-9 / chain.seconds[knots])[:, None, None]
    covariances: Float64Array = (1.0 - share) * at_knots[knots] + share * at_knots[knots + 1]
    return covariances


NAME = "gnss"
"""The trajectory's name."""

_UNSURE_HEADING = np.radians(15.0)
"""Standard deviation of the heading from which on it counts as not known."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssImuRun:
    """What fixes and IMU report the ego trajectory.

    Attributes:
        trajectory: `world_from_ego` under the name "gnss", at the IMU's rate, with covariances; without orientations
            where there is no IMU. The world's axes are east, north and up at the origin.
        origin_lla: (3,) the first fix: latitude, longitude [deg], height above the ellipsoid [m].
        velocities: (N, 3) [m/s], world.
        biases: (N, 6) of gyroscope [rad/s] and accelerometer [m/s²], ego frame.
        knots_ns: (K,) [ns], times of the states.
        covariances: (K, 15, 15) of the states: rotate about the ego's axes, position, velocity, the two biases.
        fixes: which went in.
        used: (F,) bool, which of them were not left out as jumps.
        fix_sigmas: (F, 3) [m] east, north, up: their noise as found.
        warnings: what was assumed, repaired or left out.
    """

    trajectory: Trajectory
    origin_lla: Float64Array
    velocities: Float64Array
    biases: Float64Array
    knots_ns: Int64Array
    covariances: Float64Array
    fixes: GnssFixes
    used: BoolArray
    fix_sigmas: Float64Array
    warnings: tuple[DataWarning, ...]


def gnss_imu_motion(
    scene: Scene, *, lidar: Trajectory | None = None, settings: SmootherSettings = DEFAULTS
) -> GnssImuRun:
    """Find the ego trajectory from its satellite fixes, and from its IMU where it has one.

    Args:
        lidar: the trajectory by lidar odometry, whose steps are taken in, too.

    Raises:
        PoseError: fewer than two fixes are usable.
    """
    if not gnss_receivers(scene):
        raise PoseError(f"{scene.source}: no usable GNSS fixes in it; expected two or more")
    fixes = GnssFixes.of(scene, settings)
    if len(fixes) < 2:
        raise PoseError(f"{scene.source}: {len(fixes)} usable GNSS fix; expected two or more")
    samples = InertialSamples.of_scene(scene)
    gravity = settings.gravity or normal_gravity(float(fixes.origin_lla[0]), float(fixes.origin_lla[2]))
    fixes.check_times(scene.source, samples)
    bias = None if samples is None else _stationary_bias(samples)
    drive = _Measurements(fixes, samples, lidar, gravity, bias)
    return _run(scene, drive, _smoothed(drive, settings))


def _stationary_bias(samples: InertialSamples) -> Float64Array | None:
    times, values = samples.timestamps_ns, samples.values
    stationary = find_stationary(times, values[:, :3], times, values[:, 3:])
    return None if stationary is None else stationary.rate


def _run(scene: Scene, drive: _Measurements, result: _Smoothed) -> GnssImuRun:
    fixes, samples = drive.fixes, drive.samples
    fit = result.fit
    smoothed = _trajectory_between(fit.chain, fit.states, samples, _trajectory_times(fit.chain, samples))
    poses = _pose_covariances(fit.chain, fit.states, result.own, smoothed)
    offset = _common_offset(fixes, fit.chain.fixes.sigmas)
    positions = smoothed.positions
    if drive.lidar is None:
        positions, poses, offset = _with_wander(_wandering(fit), smoothed, poses, offset)
    poses[:, 3:, 3:] += np.diag(offset**2)
    trajectory = Trajectory(
        NAME,
        smoothed.timestamps_ns,
        positions,
        None if samples is None and drive.lidar is None else quaternion_from_matrix(smoothed.rotations),
        covariances=poses,
    )
    used = fit.weights > 0.5
    run = GnssImuRun(
        trajectory, fixes.origin_lla, smoothed.velocities, smoothed.biases,
        fit.chain.knots_ns, result.own, fixes, used,
        fit.chain.fixes.sigmas, fixes.warnings,
    )  # fmt: skip
    return replace(run, warnings=(*fixes.warnings, *_notes(scene, run, drive, offset)))


def _with_wander(
    wander: tuple[_Wander | None, _Wander | None],
    smoothed: _SmoothedTrajectory,
    poses: Float64Array,
    offset: Float64Array,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Positions as the receiver would report them, its slow errors included, and what these do to the covariances.

    Errors that are alike count as fewer: with a correlation ρ of neighbours, the variance of a mean is larger by
    (1 + ρ) / (1 - ρ). What fixes across report (location, orientation) grows by their factor, the height by its own.
    """
    positions, offset, growth = smoothed.positions.copy(), offset.copy(), np.ones(6)
    for slow, axes, grown in zip(wander, (slice(0, 2), slice(2, 3)), ([0, 1, 2, 3, 4], [5]), strict=True):
        if slow is None:
            continue
        positions[:, axes] += slow.at(smoothed.timestamps_ns)
        offset[axes] = np.maximum(offset[axes], slow.sigma)
        growth[grown] = np.sqrt((1.0 + slow.alike) / (1.0 - slow.alike))
    return positions, growth[:, None] * poses * growth, offset


def _common_offset(fixes: GnssFixes, sigmas: Float64Array) -> Float64Array:
    """(3,) [m] by which all fixes may be off together: what receivers report beyond the noise that is seen.

    Fixes wander slowly with satellites and air; that shows in the accuracy reported, not in how fixes agree.
    """
    if not fixes.reported.any():
        return np.zeros(3)
    reported, seen = (
        np.median(fixes.sigmas[fixes.reported], axis=0),
        np.median(sigmas[fixes.reported], axis=0),
    )
    rest = np.sqrt(np.maximum(reported**2 - seen**2, 0.0))
    offset: Float64Array = np.where(seen < 0.6 * reported, rest, 0.0)
    return offset


def _notes(scene: Scene, run: GnssImuRun, drive: _Measurements, offset: Float64Array) -> list[DataWarning]:
    location, samples = scene.source, drive.samples
    reported = [_how(location, run, drive)]
    lost = int((~run.used).sum())
    if lost:
        message = f"{lost} of {len(run.used)} fixes left out, off the trajectory by more than the rest allows"
        reported.append(_warning(WarningKind.SKIPPED, "gnss-jumps", location, message, lost))
    if offset.any():
        message = (
            f"the fixes agree better with their neighbours than the accuracy that they report; those of some time may "
            f"be "
            f"off together by {offset[0]:.2f} m across and {offset[2]:.2f} m in height (one standard deviation), which "
            "stands in the covariances"
        )
        reported.append(_warning(WarningKind.ASSUMED, "gnss-common-offset", location, message))
    if samples is not None and len(samples.gaps_ns):
        message = "the IMU has gaps; in them the ego was taken to go on evenly between what is known"
        reported.append(_warning(WarningKind.ASSUMED, "imu-gaps", location, message, len(samples.gaps_ns)))
    if samples is not None and samples.left_out:
        message = "samples that are no numbers, or not later than the one before, were left out"
        reported.append(_warning(WarningKind.REPAIRED, "imu-samples", location, message, samples.left_out))
    heading = run.trajectory.covariances
    if samples is not None and heading is not None and np.sqrt(heading[:, 2, 2].min()) > _UNSURE_HEADING:
        message = (
            f"the ego moved too little to report its heading, which is known to "
            f"{np.degrees(np.sqrt(heading[:, 2, 2].min())):.0f} degrees at best; it was taken to look where it goes"
        )
        reported.append(_warning(WarningKind.ASSUMED, "heading-unknown", location, message))
    return reported


def _how(location: str, run: GnssImuRun, drive: _Measurements) -> DataWarning:
    sigma = np.median(run.fix_sigmas[run.used], axis=0) if run.used.any() else run.fix_sigmas[0]
    latitude, longitude, height = run.origin_lla
    message = (
        f"{len(run.used)} fixes{_WITH[drive.samples is not None, drive.lidar is not None]} gave the trajectory of "
        f"the ego; noise of the fixes as found {sigma[0]:.2f} m across, {sigma[2]:.2f} m in height; the world's axes "
        f"are east, north and up at the first fix, {latitude:.7f}, {longitude:.7f}, {height:.2f} m"
    )
    return _warning(WarningKind.ASSUMED, "trajectory-from-gnss", location, message)


_WITH = {
    (False, False): " alone, without an IMU,",
    (True, False): " and the IMU",
    (False, True): " and the lidar's sweeps",
    (True, True): ", the IMU and the lidar's sweeps",
}


def _warning(kind: WarningKind, code: str, location: str, message: str, count: int = 1) -> DataWarning:
    return DataWarning(kind=kind, code=code, location=location, message=message, count=count)
