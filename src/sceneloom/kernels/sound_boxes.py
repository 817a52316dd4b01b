"""Which boxes have numbers that can be reckoned with, and those numbers side by side."""

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_IN_1D, _IN_2D = (f"Array(float64, {n}, 'C', readonly=True)" for n in (1, 2))
_OUT = "Tuple((float64[:,::1], int64[::1]))"


@kernel(f"{_OUT}({_IN_2D}, {_IN_2D}, {_IN_1D})", nogil=True, cache=True, error_model="numpy")
def boxes_with_place(
    centers: Float64Array, sizes: Float64Array, yaws: Float64Array
) -> tuple[Float64Array, Int64Array]:
    """Take those boxes in space that have finite numbers, and sizes above 0.

    Args:
        centers, sizes: (N, 3) [m].
        yaws: (N,) [rad].

    Returns:
        (M, 7) float64, middle, size and heading of those, and (M,) int64, which they are.
    """
    boxes, rows, count = np.empty((len(yaws), 7)), np.empty(len(yaws), np.int64), 0
    for n in range(len(yaws)):
        good = np.isfinite(yaws[n])
        for i in range(3):
            good = good and np.isfinite(centers[n, i]) and np.isfinite(sizes[n, i]) and sizes[n, i] > 0.0
            boxes[count, i], boxes[count, 3 + i] = centers[n, i], sizes[n, i]
        boxes[count, 6], rows[count] = yaws[n], n
        count += good
    return boxes[:count], rows[:count]


@kernel(f"{_OUT}({_IN_2D})", nogil=True, cache=True, error_model="numpy")
def boxes_with_area(corners: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Take those boxes in a picture that have finite edges, right and lower ones beyond left and upper ones.

    Args:
        corners: (N, 4) [px], left, upper, right and lower edge.

    Returns:
        (M, 4) float64 [px], their edges, and (M,) int64, which they are.
    """
    boxes, rows, count = np.empty((len(corners), 4)), np.empty(len(corners), np.int64), 0
    for n in range(len(corners)):
        good = corners[n, 2] > corners[n, 0] and corners[n, 3] > corners[n, 1]
        for k in range(4):
            good = good and np.isfinite(corners[n, k])
            boxes[count, k] = corners[n, k]
        rows[count] = n
        count += good
    return boxes[:count], rows[:count]
