"""States that fit most fixes: those that jump lose their say, and how good the others are the data tell."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.motion.gnss_imu.chain import (
    Chain,
    Equations,
    Fixes,
    States,
    covariances,
    equations,
    inertial_residuals,
    step,
)

_HUBER = 1.5
"""Standard deviations from which on a fix loses weight while the states are still far off."""
_MOST_STEPS = 30
_SETTLED = 1e-5
"""Change of the cost, relative to it, below which no further step is gone."""
_NARROWING = 1.6
"""Factor by which the gate narrows in each step. Source: Yang et al. 2020 take 1.4."""
_DECLARED_WORTH = 1.0
"""The accuracy that a receiver tells counts as this many measurements of it."""
_INERTIAL_WORTH = 6.0
"""What the samples tell of their noise counts as this many measurements of it."""
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


def gate_square(gate: float) -> float:
    """The squared distance in three dimensions that is as rare as `gate` standard deviations.

    Source: Wilson and Hilferty 1931, "The Distribution of Chi-Square".
    """
    return 3.0 * float(1.0 - 2.0 / 27.0 + gate * (2.0 / 27.0) ** 0.5) ** 3


def fit_gently(chain: Chain, states: States, *, steps: int = _MOST_STEPS) -> Fit:
    """Fit with weights that fall off slowly (Huber 1964), so that no start is too far off."""
    return _fitted(chain, states, steps)


def fit_sternly(chain: Chain, states: States) -> Fit:
    """Fit with a gate that narrows until what lies outside has no say at all, and what lies inside all of it.

    What was left out first comes back where the states move towards it.

    Source: Yang, Antonante, Tzoumas and Carlone 2020, "Graduated Non-Convexity for Robust Spatial Perception", section
    IV, truncated least squares.
    """
    gate = gate_square(chain.settings.gate)
    distances = squares(chain.fixes, equations(chain, states, np.ones(len(chain.fixes))).fix_residuals)
    largest = float(distances.max(initial=0.0))
    damping, narrow = 0.0, gate / max(2.0 * largest - gate, 1e-9)
    while largest > gate and narrow < 1e4:
        weights = _truncated(distances, gate, narrow)
        gone = step(chain, states, weights, damping)
        states, damping = gone.states, gone.damping
        distances = squares(chain.fixes, gone.before.fix_residuals)
        narrow *= _NARROWING
    return _settled(chain, states, gate)


def _truncated(distances: Float64Array, gate: float, narrow: float) -> Float64Array:
    inner, outer = narrow / (narrow + 1.0) * gate, (narrow + 1.0) / narrow * gate
    between = np.sqrt(gate * narrow * (narrow + 1.0) / np.maximum(distances, 1e-30)) - narrow
    weights: Float64Array = np.where(
        distances <= inner, 1.0, np.where(distances >= outer, 0.0, np.clip(between, 0, 1))
    )
    return weights


def _settled(chain: Chain, states: States, gate: float) -> Fit:
    """Steps with all or nothing until nothing changes."""
    damping, cost = 0.0, np.inf
    weights = np.ones(len(chain.fixes))
    distances = squares(chain.fixes, equations(chain, states, weights).fix_residuals)
    for _ in range(_MOST_STEPS):
        weights = (distances <= gate).astype(np.float64)
        gone = step(chain, states, weights, damping)
        states, damping = gone.states, gone.damping
        distances = squares(chain.fixes, equations(chain, states, weights).fix_residuals)
        if abs(cost - gone.cost) <= _SETTLED * gone.cost and ((distances <= gate) == (weights > 0)).all():
            break
        cost = gone.cost
    return Fit(chain, states, weights, gone.cost)


def _fitted(chain: Chain, states: States, steps: int) -> Fit:
    damping, cost = 1e-4, np.inf
    weights = np.ones(len(chain.fixes))
    here: Equations | None = None
    for _ in range(steps):
        here = here or equations(chain, states, weights)
        weights = np.minimum(
            1.0, _HUBER / np.sqrt(np.maximum(squares(chain.fixes, here.fix_residuals) / 3.0, 1e-30))
        )
        gone = step(chain, states, weights, damping)
        states, damping = gone.states, gone.damping
        here = equations(chain, states, weights)
        total = _huber_cost(chain, here, weights)
        if abs(cost - total) <= _SETTLED * total:
            break
        cost = total
    return Fit(chain, states, weights, total)


def _huber_cost(chain: Chain, here: Equations, weights: Float64Array) -> float:
    distances = squares(chain.fixes, here.fix_residuals)
    quadratic = float((weights * distances).sum())
    roots = np.sqrt(distances / 3.0)
    huber = np.where(roots <= _HUBER, distances, 3.0 * (2.0 * _HUBER * roots - _HUBER**2))
    return here.cost - quadratic + float(huber.sum())


def rescaled(fit: Fit) -> tuple[Fit, Float64Array]:
    """Scale the fixes' noise to what their residuals show.

    Returns:
        The fit, with the new noise in its chain, and (F, 2) the factors, horizontal and vertical.

    Source: Förstner 1979, "Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten": the sum of squares over
    the redundancy, which the states' own covariance tells.
    """
    chain, fixes = fit.chain, fit.chain.fixes
    own, _ = covariances(chain, fit.states, fit.weights)
    spread = _fix_variances(chain, fit.states, own)
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


def _fix_variances(chain: Chain, states: States, own: Float64Array) -> Float64Array:
    """(F, 3) variances of where the antennas are, as the states tell."""
    places, levers = chain.fixes.places, chain.fixes.levers
    pose = own[places][:, :6, :6]
    slopes = np.zeros((len(places), 3, 6))
    slopes[:, :, 3:] = np.eye(3)
    for axis in range(3):
        unit = np.eye(3)[axis]
        slopes[:, :, axis] = np.einsum("nij,nj->ni", states.rotations[places], np.cross(unit, levers))
    variances: Float64Array = np.einsum("nij,njk,nik->ni", slopes, pose, slopes)
    return variances


def inertial_factors(fit: Fit) -> Float64Array:
    """(2,) factors by which the IMU's noise, of turn rate and force, shows to be larger than taken; at least 1.

    Source: Förstner 1979, as in `rescaled`; the turn's share of velocity and way is taken out first.
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
