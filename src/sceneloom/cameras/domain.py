"""How far from the axis a lens can be trusted: up to where its mapping folds and two points share a pixel."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import Float64Array

_DIRECTIONS = 72
_STEPS = 200
_ROUNDS = 3
_VANISHED = 1e-30
_JUST_INSIDE = 1.0 - 1e-9
_WIDEST = math.radians(89.9)

Slopes = Callable[[Float64Array, Float64Array], tuple[Float64Array, ...]]
"""Gives dx'/dx, dx'/dy, dy'/dx, dy'/dy at points (x, y) of the plane z = 1."""


def first_positive_root(polynomial: ArrayLike) -> float:
    """Give the smallest positive real root, infinity where there is none.

    Args:
        polynomial: coefficients, the highest power first.
    """
    coefficients = np.asarray(polynomial, np.float64)
    # Nearly vanished ones have no root within reach, but would overflow the division by the leading one.
    kept = np.where(np.abs(coefficients) < _VANISHED * np.abs(coefficients).max(), 0.0, coefficients)
    roots = np.roots(kept)
    real = roots.real[roots.imag == 0]
    return float(real[real > 0].min(initial=math.inf))


def radius_without_fold(slopes: Slopes, limit: float) -> float:
    """Search the disk of radius `limit` for the circle on which the mapping's area factor first vanishes.

    Returns:
        The radius up to which the factor is positive in all directions, `limit` where it is so everywhere.
    """
    directions = np.linspace(0.0, 2.0 * math.pi, _DIRECTIONS, endpoint=False)
    beyond, low, high = limit, 0.0, min(_JUST_INSIDE * math.atan(limit), _WIDEST)
    for _ in range(_ROUNDS):
        radii = np.tan(np.linspace(low, high, _STEPS))
        xx, xy, yx, yy = slopes(np.outer(radii, np.cos(directions)), np.outer(radii, np.sin(directions)))
        folded = np.flatnonzero(~(xx * yy - xy * yx > 0.0).all(axis=1))
        if len(folded) == 0:
            return beyond
        beyond, before = float(radii[folded[0]]), float(radii[max(folded[0] - 1, 0)])
        low, high = math.atan(before), math.atan(beyond)
    return math.tan(low)
