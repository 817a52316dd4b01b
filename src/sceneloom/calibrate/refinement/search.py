"""The search for the calibration that a set of frames agrees with best, from wide looks to narrow ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.calibrate.measures.candidate import COUNT, UNITS
from sceneloom.calibrate.refinement.objective import Level, Linearised

_FARTHEST = np.array([6.0, 6.0, 6.0, 3.0, 3.0, 3.0, 2.0, 2.5])
"""How far a calibration is usually off, in units: 1.5 degrees, 15 cm, 2 % of the focal length, 50 ms."""
_STARTS = 48
_KEPT = 3
_ROUNDS = (2, 2, 2, 3)
_SEED = 7


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where a search ended.

    Attributes:
        numbers: (8,) float64, as of a `Change`.
        free: (P,) int64, which of them were searched.
        value: of the objective at the last level.
        weights: (C,) of the channels there.
        last: the last level around these numbers.
    """

    numbers: Float64Array
    free: AnyArray
    value: float
    weights: Float64Array
    last: Linearised


def search(levels: Sequence[Level], free: AnyArray, start: Float64Array) -> Found:
    """Find the best candidate near a start.

    Args:
        levels: from wide to narrow.
        free: (P,) int64, which of the eight numbers are searched.
        start: (8,).
    """
    found: list[tuple[float, Float64Array]] = [(0.0, begun) for begun in _beginnings(levels[0], free, start)]
    weights = np.zeros(0)
    for number, level in enumerate(levels):
        climbed = []
        for _, numbers in found:
            value, numbers, weights = _climb(level, free, numbers, start, _ROUNDS[number % len(_ROUNDS)])
            climbed.append((value, numbers))
        climbed.sort(key=lambda one: -one[0])
        found = climbed[: max(_KEPT - number, 1)]
    value, best = found[0]
    last = levels[-1].around(best, free)
    return Found(best, free, value, last.channel_weights(np.zeros(len(free))), last)


def _beginnings(level: Level, free: AnyArray, start: Float64Array) -> list[Float64Array]:
    """The start, and the best of some others drawn around it, at the widest look."""
    linearised = level.around(start, free)
    drawn = np.random.default_rng(_SEED).normal(0.0, 0.5, (_STARTS, len(free))) * _FARTHEST[free]
    weights = np.maximum(linearised.channel_weights(np.zeros(len(free))), 0.0)
    if not weights.any():
        weights = np.ones_like(weights)
    values = [(linearised.sums(step).values.sum(axis=0) * weights).sum() for step in drawn]
    best = np.argsort(values)[::-1][: _KEPT - 1]
    return [start, *(start + _spread(free, drawn[k]) for k in best)]


def _spread(free: AnyArray, step: Float64Array) -> Float64Array:
    """A step in units as a change of all eight numbers."""
    numbers = np.zeros(COUNT)
    numbers[free] = step * UNITS[free]
    return numbers


def _climb(
    level: Level, free: AnyArray, numbers: Float64Array, start: Float64Array, rounds: int
) -> tuple[float, Float64Array, Float64Array]:
    """Go uphill at one level, with pixels linearised anew in each round."""
    value, weights = 0.0, np.zeros(0)
    for _ in range(rounds):
        linearised = level.around(numbers, free)
        weights = linearised.channel_weights(np.zeros(len(free)))
        offset = ((numbers - start) / UNITS)[free]

        def downhill(step: Float64Array) -> tuple[float, Float64Array]:
            value, slope = evaluate(linearised, weights, _FARTHEST[free], offset, step)  # noqa: B023
            return -value, -slope

        reach = [(-2.0, 2.0)] * len(free)
        result = minimize(downhill, np.zeros(len(free)), jac=True, method="L-BFGS-B", bounds=reach)
        numbers = numbers + _spread(free, result.x)
        value = -float(result.fun)
        if np.abs(result.x).max() < 0.02:
            break
    return value, numbers, weights


def evaluate(
    linearised: Linearised,
    weights: Float64Array,
    reach: Float64Array,
    offset: Float64Array,
    step: Float64Array,
) -> tuple[float, Float64Array]:
    """Give the objective and its slope at a step, with what speaks against going far from the start.

    Args:
        weights: (C,) of the channels.
        reach: (P,) how far calibrations are usually off, in units.
        offset: (P,) how far the linearised candidate is from the start, in units.
        step: (P,) from the candidate, in units.
    """
    sums = linearised.sums(step)
    away = (offset + step) / reach
    value = float((sums.values.sum(axis=0) * weights).sum() - 0.5 * away @ away)
    return value, np.einsum("fcp,c->p", sums.gradients, weights) - away / reach
