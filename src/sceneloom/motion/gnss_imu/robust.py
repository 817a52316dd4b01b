"""Robust estimation of the states: outlying fixes lose weight, noise levels are estimated, and the initial states."""

import math
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector
from sceneloom.motion.gnss_imu.chain import (
    Chain,
    Equations,
    States,
    covariances,
    equations,
    inertial_residuals,
    step,
)
from sceneloom.motion.gnss_imu.measurements import Fixes, fix_variances

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
class Fit:
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


def fit_gently(chain: Chain, states: States, *, steps: int = _MOST_STEPS) -> Fit:
    """Fit with weights that fall off slowly (Huber 1964), so that no start is too far off."""
    return _fitted(chain, states, steps)


def fit_sternly(fit: Fit, *, scaled: bool) -> Fit:
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
        ratios = _gate_ratios(Fit(fit.chain, states, weights, 0.0), scaled=scaled)
        allowed = changes < _MOST_CHANGES
        dropped = (
            (ratios > 1.0)
            & (weights > 0)
            & _is_worst_around(np.where(weights > 0, ratios, -np.inf))
            & allowed
        )
        taken = (ratios < _READMITTED) & (weights == 0) & allowed
        full = np.where(dropped, 0.0, np.where(taken | (weights > 0), 1.0, 0.0))
        if number and (full == weights).all():
            break
        changes += (full > 0) != (weights > 0)
        weights = full
    return _settled(fit.chain, states, weights, _MOST_STEPS)


def _gate_ratios(fit: Fit, *, scaled: bool) -> Float64Array:
    """(F,) squared distances of the fixes from where the others put them, in units of the gate's."""
    chain, fixes = fit.chain, fit.chain.fixes
    own, _ = covariances(chain, fit.states, fit.weights)
    spread = fix_variances(fixes, fit.states.rotations, own)
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


def _settled(chain: Chain, states: States, weights: Float64Array, steps: int) -> Fit:
    """Go steps with given weights until nothing changes."""
    damping = 0.0
    here = equations(chain, states, weights)
    for _ in range(steps):
        gone = step(chain, states, weights, damping, here=here)
        settled = here.cost - gone.equations.cost <= _SETTLED * here.cost
        states, damping, here = gone.states, gone.damping, gone.equations
        if settled:
            break
    return Fit(chain, states, weights, here.cost)


def _fitted(chain: Chain, states: States, steps: int) -> Fit:
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
    return Fit(chain, states, weights, total)


def _huber_cost(chain: Chain, here: Equations, weights: Float64Array, bend: float) -> float:
    distances = _squares(chain.fixes, here.fix_residuals)
    quadratic = float((weights * distances).sum())
    roots = np.sqrt(distances / 3.0)
    huber = np.where(roots <= bend, distances, 3.0 * (2.0 * bend * roots - bend**2))
    return here.cost - quadratic + float(huber.sum())


def rescaled(fit: Fit) -> tuple[Fit, Float64Array]:
    """Scale the fixes' noise to what their residuals show.

    Returns:
        The fit, with the new noise in its chain, and (F, 2) the factors, horizontal and vertical.

    Source: Förstner 1979, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten": the sum of squares over
    the redundancy, which the states' own covariance reports.
    """
    chain, fixes = fit.chain, fit.chain.fixes
    own, _ = covariances(chain, fit.states, fit.weights)
    spread = fix_variances(fixes, fit.states.rotations, own)
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


def inertial_factors(fit: Fit) -> Float64Array:
    """(2,) factors by which the IMU's noise, of yaw rate and force, shows to be larger than taken; at least 1.

    Source: Förstner 1979, as in `rescaled`; the rotation's share of velocity and trajectory is taken out first.
    """
    chain = fit.chain
    rows = np.flatnonzero(chain.measured)
    if len(rows) == 0:
        return np.ones(2)
    own, between = covariances(chain, fit.states, fit.weights)
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


def coasted(chain: Chain, states: States) -> Fit:
    """Fit the fixes alone, and find their noise."""
    fit = fit_gently(chain, states)
    for _ in range(3):
        fit, _ = rescaled(fit)
        fit = fit_gently(fit.chain, fit.states)
    return fit


def stationary_states(chain: Chain, gyroscope_bias: Float64Array | None = None) -> States:
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


def oriented(chain: Chain, coasting: States) -> Fit:
    """Fit fixes and IMU: a first piece from several headings, then more and more of the drive around it."""
    count = len(chain.knots_ns)
    first, last = _first_piece(chain, coasting)
    fit = _best_of_headings(chain.part(first, last), coasting.part(first, last))
    while first > 0 or last < count:
        length = last - first
        earlier, later = max(first - length, 0), min(last + length, count)
        states = _extended(chain, coasting, fit.states, first, last, earlier, later)
        fit = fit_gently(chain.part(earlier, later), states)
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


def _best_of_headings(chain: Chain, states: States) -> Fit:
    """Try where the ego may have looked; where several fit alike, it looked where it went."""
    rotated = _rotated_by_gyroscope(chain)
    level = _wahba(chain, states, rotated)
    headings = [_along_motion(states, level @ rotated)]
    headings += [_about_up(angle) @ level for angle in _QUARTERS]
    fits = []
    for first in headings:
        begun = replace(states, rotations=np.ascontiguousarray(first @ rotated))
        fits.append(fit_gently(chain, begun))
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


def _extended(
    chain: Chain, coasting: States, known: States, first: int, last: int, earlier: int, later: int
) -> States:
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
    rotated: Float64Array = inertial.rotations[k] @ matrix_from_quaternion(
        quaternion_from_rotation_vector(vector)
    )
    return rotated
