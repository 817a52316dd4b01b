"""Which boxes have numbers that can be reckoned with."""

import numpy as np
from numba import njit, types

from sceneloom.arrays import BoolArray, Float64Array

_IN_1D, _IN_2D = (types.Array(types.float64, n, "C", readonly=True) for n in (1, 2))
_OUT = types.Array(types.boolean, 1, "C")


@njit(_OUT(_IN_2D, _IN_2D, _IN_1D), nogil=True, cache=True, error_model="numpy")
def have_place(centers: Float64Array, sizes: Float64Array, yaws: Float64Array) -> BoolArray:
    """Say which boxes in space have finite numbers, and sizes above 0.

    Args:
        centers, sizes: (N, 3) [m].
        yaws: (N,) [rad].
    """
    sound = np.empty(len(yaws), np.bool_)
    for n in range(len(yaws)):
        good = np.isfinite(yaws[n])
        for i in range(3):
            good = good and np.isfinite(centers[n, i]) and np.isfinite(sizes[n, i]) and sizes[n, i] > 0.0
        sound[n] = good
    return sound


@njit(_OUT(_IN_2D), nogil=True, cache=True, error_model="numpy")
def have_area(corners: Float64Array) -> BoolArray:
    """Say which boxes in a picture have finite edges, right and lower ones beyond left and upper ones.

    Args:
        corners: (N, 4) [px], left, upper, right and lower edge.
    """
    sound = np.empty(len(corners), np.bool_)
    for n in range(len(corners)):
        good = corners[n, 2] > corners[n, 0] and corners[n, 3] > corners[n, 1]
        for k in range(4):
            good = good and np.isfinite(corners[n, k])
        sound[n] = good
    return sound
