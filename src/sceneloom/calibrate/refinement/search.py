"""The search for the calibration that a set of frames agrees with best, from wide looks to narrow ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.calibrate.measures.candidate import COUNT, UNITS
from sceneloom.calibrate.refinement.hill import FARTHEST, Hill
from sceneloom.calibrate.refinement.objective import Level, Linearised

ROTATIONS = np.arange(3)
_STARTS = 200
_KEPT = (8, 3, 1)
"""So many candidates are followed up after each look."""
_ROUNDS = 2
_MOST_ROTATED = (12_000, 16_000, 24_000)
_MOST_MOVED = (40_000, 160_000)
"""Points that count at each look, for the rotations alone and for all numbers; few report rotates.

And wide maps are smooth.
"""
_MOST_STEPS = 10
_FIRST_STEP, _LONGEST_STEP, _SMALLEST_STEP, _FARTHEST_CLIMB = 0.3, 1.0, 0.01, 2.0
"""Of a climb, in widths of the blur; the maps are smooth over about so much."""
_SEED = 7
_LAST_STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where a search ended.

    Attributes:
        numbers: (8,) float64, as of a `Change`.
        free: (P,) int64, which of them were searched.
        weights: (C,) of the channels there.
        inverse: (P, P), inverse of minus the second derivatives of the objective by units, at the last level.
        last: the last level around these numbers.
    """

    numbers: Float64Array
    free: AnyArray
    weights: Float64Array
    inverse: Float64Array
    last: Linearised


def search(
    levels: Sequence[Level],
    frames: AnyArray,
    free: AnyArray,
    *,
    thinned: int = 1,
) -> Found:
    """Find the best candidate near the stated calibration.

    Rotates are searched first, from many beginnings, for they move what is far away as well as what is near; then all
    numbers together from there.

    Args:
        levels: from wide to narrow.
        frames: (F,) bool, which of them count.
        free: (P,) int64, which of the eight numbers are searched.
        thinned: one point of so many counts.
    """
    most = [count // thinned for count in _MOST_ROTATED]
    best = _rotated([level.part(frames, most=count) for level, count in zip(levels, most, strict=True)])
    most = [count // thinned for count in _MOST_MOVED]
    parts = [level.part(frames, most=count) for level, count in zip(levels[1:], most, strict=True)]
    for level in parts:
        best = _climb(level, free, best)
    return _polished(parts[-1], free, best)


def _rotated(levels: Sequence[Level]) -> Float64Array:
    """The best rotate of the stated calibration."""
    found = _beginnings(levels[0])
    for number, level in enumerate(levels):
        climbed = [_climb(level, ROTATIONS, begun) for begun in found]
        found = _best(level, climbed)[: _KEPT[number]]
    return found[0]


def _beginnings(level: Level) -> list[Float64Array]:
    """The stated calibration, and the best of some others rotated from it."""
    around = level.around(np.zeros(COUNT), ROTATIONS)
    drawn = np.random.default_rng(_SEED).normal(0.0, 0.5, (_STARTS, len(ROTATIONS))) * FARTHEST[ROTATIONS]
    best = np.argsort([-_stationary(around, step) for step in drawn])[: _KEPT[0] - 1]
    return [np.zeros(COUNT), *(_spread(ROTATIONS, drawn[k]) for k in best)]


def _best(level: Level, found: Sequence[Float64Array]) -> list[Float64Array]:
    """Those found, the best first."""
    stationary = [
        _stationary(level.around(numbers, ROTATIONS), np.zeros(len(ROTATIONS))) for numbers in found
    ]
    return [found[k] for k in np.argsort(stationary)[::-1]]


def _stationary(linearised: Linearised, step: Float64Array) -> float:
    """How far the channels together stand above 0, in standard deviations; weights play no part, so it compares."""
    sums = linearised.sums(step)
    scores = sums.values.sum(axis=0) / np.sqrt(np.maximum(sums.squares.sum(axis=0), 1e-9))
    return float(scores.sum())


def _spread(free: AnyArray, step: Float64Array) -> Float64Array:
    """A step in units as a change of all eight numbers."""
    numbers = np.zeros(COUNT)
    numbers[free] = step * UNITS[free]
    return numbers


def _climb(level: Level, free: AnyArray, numbers: Float64Array) -> Float64Array:
    """Go uphill at one level, with pixels linearised anew in each round."""
    for _ in range(_ROUNDS):
        hill = Hill.around(level, free, numbers)
        step = _descended(hill)
        numbers = numbers + _spread(free, hill.basis @ step)
        if np.abs(step).max() < 0.05:
            break
    return numbers


def _descended(hill: Hill) -> Float64Array:
    """Where a quasi-Newton descent of minus the objective ends; a library's would wake threads for eight numbers.

    Source: the update of Broyden, Fletcher, Goldfarb and Shanno, with halved steps (Nocedal and Wright 2006,
    algorithm 6.1).
    """
    here = np.zeros(len(hill.basis))
    value, slope = hill.downwards(here)
    inverse = np.eye(len(here)) * (_FIRST_STEP / max(float(np.sqrt((slope**2).sum())), 1e-12))
    for _ in range(_MOST_STEPS):
        trajectory = -(inverse * slope).sum(axis=1)
        trajectory *= min(1.0, _LONGEST_STEP / max(float(np.sqrt((trajectory**2).sum())), 1e-12))
        for share in (1.0, 0.5, 0.25, 0.125):
            ahead = here + share * trajectory
            value_ahead, slope_ahead = hill.downwards(ahead)
            if value_ahead < value:
                break
        else:
            break
        moved, bent = ahead - here, slope_ahead - slope
        product = float((moved * bent).sum())
        if product > 1e-12:
            left = np.eye(len(here)) - np.outer(moved, bent) / product
            inverse = left @ inverse @ left.T + np.outer(moved, moved) / product
        here, value, slope = ahead, value_ahead, slope_ahead
        if np.abs(moved).max() < _SMALLEST_STEP or np.abs(here).max() > _FARTHEST_CLIMB:
            break
    return here


def _polished(level: Level, free: AnyArray, numbers: Float64Array) -> Found:
    """Newton's steps to the top, which long narrow ridges need; none that leads down."""
    for _ in range(_LAST_STEPS):
        hill = Hill.around(level, free, numbers)
        value, slope = hill.downwards(np.zeros(len(free)))
        step = np.clip(-hill.inverse_curvature() @ slope, -1.0, 1.0)
        share = next((part for part in (1.0, 0.5, 0.25) if hill.downwards(part * step)[0] < value), 0.0)
        numbers = numbers + _spread(free, hill.basis @ (share * step))
        if np.abs(share * step).max() < _SMALLEST_STEP:
            break
    hill = Hill.around(level, free, numbers)
    inverse = hill.basis @ hill.inverse_curvature() @ hill.basis.T
    return Found(numbers, free, hill.weights, inverse, hill.linearised)
