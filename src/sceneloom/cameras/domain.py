"""How far from the axis a camera model can be trusted: up to where its mapping folds and two points share a pixel."""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sceneloom.cameras.compiled import PART
from sceneloom.cameras.formulas import distort

_DIRECTIONS = 180
_STEPS = 200
_ROUNDS = 3
_VANISHED = 1e-30
_JUST_INSIDE = 1.0 - 1e-9
_WIDEST = math.radians(89.9999)
"""How far out of a chart without a rim a bent camera model is looked at, and trusted: the arctangent of a radius."""


def first_positive_root(polynomial: ArrayLike) -> float:
    """Give the smallest positive real root, infinity where there is none.

    Args:
        polynomial: coefficients, the highest power first.
    """
    coefficients = np.asarray(polynomial, np.float64)
    # Nearly vanished ones have no root within reach, but would overflow the division by the leading one.
    kept = np.where(np.abs(coefficients) < _VANISHED * np.abs(coefficients).max(), 0.0, coefficients)
    # Found as the largest inverse root: a root far out, of a small leading number, then spoils nothing near zero.
    inverses = np.roots(kept[::-1])
    largest = inverses.real[inverses.imag == 0].max(initial=0.0)
    return float(1.0 / largest) if largest > 0.0 else math.inf


@njit(**PART)
def _rotations_nothing_back(radius, camera_model):  # type: ignore[no-untyped-def]
    """Report whether, on a circle of the chart, each small step is taken to one within 90 degrees of it.

    Where that holds all over a disk, no two of its locations are taken to one: the step from one to the other would
    have to be rotated back on its way. The slopes of camera models are symmetric or nearly so, and then it ends just
    where the area factor vanishes, which is the fold.
    """
    for k in range(_DIRECTIONS):
        about = 2.0 * math.pi * k / _DIRECTIONS
        _, _, xx, xy, yx, yy = distort(radius * math.cos(about), radius * math.sin(about), camera_model)
        if not (xx > 0.0 and yy > 0.0 and 4.0 * xx * yy > (xy + yx) * (xy + yx)):
            return False
    return True


@njit(**PART)
def radius_without_fold(camera_model):  # type: ignore[no-untyped-def]
    """Give the radius of the disk of the chart, `camera model.limit` at most.

    On which no two locations are taken to one.

    Decentring and prism terms, however small, fold a chart without a rim somewhere, so that such a disk always ends.
    """
    low, high = 0.0, min(_JUST_INSIDE * math.atan(camera_model.limit), _WIDEST)
    for attempt in range(_ROUNDS):
        step, folded = (high - low) / (_STEPS - 1), -1
        for k in range(_STEPS):
            if not _rotations_nothing_back(math.tan(low + k * step), camera_model):
                folded = k
                break
        if folded < 0:
            return min(camera_model.limit, math.tan(_WIDEST)) if attempt == 0 else math.tan(low)
        low, high = low + max(folded - 1, 0) * step, low + folded * step
    return math.tan(low)
