"""The fewest keyframes that give an upright box over time, chosen among the times at which it is known."""

import math

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_NEAR_HALF_ROTATION = math.radians(179.0)
"""Which trajectory is the shorter one is for rounding to state beyond this [rad]."""


@njit(nogil=True, error_model="numpy", inline="always")
def _shortest(angle):  # type: ignore[no-untyped-def]
    """The same rotation, from -π to π [rad]."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@njit(nogil=True, error_model="numpy")
def _reports(times, boxes, location, rotation_of_vector, a, b):  # type: ignore[no-untyped-def]
    """Report whether two keyframes report all rows between them: straight centre and size, rotated the shorter arc."""
    if b == a + 1:
        return True
    rotated = _shortest(boxes[b, 6] - boxes[a, 6])
    if abs(rotated) > _NEAR_HALF_ROTATION:
        return False
    for k in range(a + 1, b):
        share = (times[k] - times[a]) / (times[b] - times[a])
        away = larger = 0.0
        for c in range(3):
            away += (boxes[a, c] + share * (boxes[b, c] - boxes[a, c]) - boxes[k, c]) ** 2
            larger += (boxes[a, c + 3] + share * (boxes[b, c + 3] - boxes[a, c + 3]) - boxes[k, c + 3]) ** 2
        apart = abs(_shortest(boxes[a, 6] + share * rotated - boxes[k, 6]))
        if not (
            away <= location * location and larger <= location * location and apart <= rotation_of_vector
        ):
            return False
    return True


@kernel(
    "int64[::1](int64[::1], float64[:,::1], float64, float64)", nogil=True, cache=True, error_model="numpy"
)
def fewest_keyframes(
    times: Int64Array, boxes: Float64Array, location: float, rotation_of_vector: float
) -> Int64Array:
    """Choose the fewest rows of a box over time from which interpolation gives all others within tolerances.

    The rows are joined wherever two of them report all between them, and the trajectory of the fewest joints from the
    first to the last is taken: a search in breadth, which looks at the farthest row first.

    Args:
        times: (K,) int64, rising.
        boxes: (K, 7), centre and size [m] and heading [rad].
        location: largest distance of centres, and of sizes as vectors [m].
        rotation_of_vector: largest difference of headings [rad].

    Returns:
        (N,) int64, rising, the first and the last row among them.

    Source: Imai and Iri 1988, "Polygonal approximations of a curve", which the shortest arc over such joints is.
    """
    count = len(times)
    if count < 3:
        return np.arange(count)
    before, queue = np.full(count, -1), np.zeros(count, np.int64)
    head, tail = 0, 1
    while head < tail and before[count - 1] < 0:
        a = queue[head]
        head += 1
        for b in range(count - 1, a, -1):
            if before[b] < 0 and _reports(times, boxes, location, rotation_of_vector, a, b):
                before[b], queue[tail] = a, b
                tail += 1
    kept, row = np.empty(count, np.int64), count - 1
    found = 0
    while row > 0:
        kept[found] = row
        found, row = found + 1, before[row]
    kept[found] = 0
    return kept[: found + 1][::-1].copy()
