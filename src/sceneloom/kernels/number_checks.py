"""Whether small arrays hold what they should: numbers in range, edges in order, vectors that are not 0."""

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, UInt32Array
from sceneloom.kernels.cache import kernel

_TYPES = ("float32", "int32", "uint32")


@kernel(
    [f"boolean(Array({name}, 1, 'C', readonly=True), float64, float64, boolean)" for name in _TYPES],
    nogil=True,
    cache=True,
    error_model="numpy",
)
def all_within(values: AnyArray, low: float, high: float, above: bool) -> bool:  # noqa: FBT001 - compiled, no keywords
    """Say whether all numbers are finite and in a range.

    Args:
        values: (N,).
        low, high: the smallest and largest number that is; infinite for none.
        above: `low` itself is not in range.
    """
    for k in range(len(values)):
        value = np.float64(values[k])
        if not (low <= value <= high and np.isfinite(value)) or (above and value == low):
            return False
    return True


@kernel("int64(Array(float32, 2, 'C', readonly=True))", nogil=True, cache=True, error_model="numpy")
def first_zero(vectors: Float32Array) -> int:
    """Give the first row of (N, K) that is 0 all along; -1 where none is."""
    for n in range(len(vectors)):
        zero = True
        for k in range(vectors.shape[1]):
            zero = zero and vectors[n, k] == 0.0
        if zero:
            return n
    return -1


@kernel("boolean(Array(uint32, 2, 'C', readonly=True))", nogil=True, cache=True, error_model="numpy")
def in_order(corners_xyxy: UInt32Array) -> bool:
    """Say whether no right edge of (N, 4) boxes is before the left one, and no lower edge above the upper one."""
    for n in range(len(corners_xyxy)):
        if corners_xyxy[n, 2] < corners_xyxy[n, 0] or corners_xyxy[n, 3] < corners_xyxy[n, 1]:
            return False
    return True
