"""States that fit most fixes: those that jump lose their state, and how good the others are the data report."""

import math
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.motion.gnss_imu.carried_fixes import Fixes, fix_variances
from sceneloom.motion.gnss_imu.chain import (
    Chain,
    Equations,
    States,
    covariances,
    equations,
    inertial_residuals,
    step,
)

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


def squares(fixes: Fixes, residuals: Float64Array) -> Float64Array:
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
        roots = np.sqrt(np.maximum(squares(chain.fixes, here.fix_residuals) / 3.0, 1e-30))
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
    distances = squares(chain.fixes, here.fix_residuals)
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
