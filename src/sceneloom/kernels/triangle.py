"""A tall matrix turned into a triangle, column by column, on one thread: small enough that more would only wait."""

import math

import numpy as np
from numba import float64, types

from sceneloom.arrays import Float64Array
from sceneloom.kernels.cache import kernel

_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)


@kernel(
    float64[:, ::1](_IN_F64_2D), cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"}
)
def triangle_of(columns: Float64Array) -> Float64Array:
    """Give R of the decomposition A = Q R, by Householder's reflections.

    Args:
        columns: (N, M), the columns of A as rows.

    Returns:
        (N, N), upper triangular; rows beyond M are zeros.

    Source: Golub and Van Loan 2013, "Matrix Computations", algorithm 5.2.1.
    """
    count, length = columns.shape
    rest = columns.copy()
    triangle = np.zeros((count, count))
    for k in range(min(count, length)):
        square = 0.0
        for i in range(k, length):
            square += rest[k, i] * rest[k, i]
        size = -math.copysign(math.sqrt(square), rest[k, k])
        rest[k, k] -= size
        # half the squared length of the reflection's normal
        half = -size * rest[k, k]
        triangle[k, k] = size
        for j in range(k + 1, count):
            product = 0.0
            if half > 0.0:
                for i in range(k, length):
                    product += rest[k, i] * rest[j, i]
                share = product / half
                for i in range(k, length):
                    rest[j, i] -= share * rest[k, i]
            triangle[k, j] = rest[j, k]
    return triangle
