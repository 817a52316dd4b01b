"""Rotations inside compiled loops: their exponential, their logarithm, and its slope."""

import math

from numba import float64, types

from sceneloom.arrays import Float64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.surface_map import INNER

_V, _M = float64[::1], float64[:, ::1]
_SMALL = 1e-5
"""Angles [rad] below which the next term of the series is below rounding."""


@kernel(types.void(_V, _M), **INNER)
def rotation_of_vector(vector: Float64Array, matrix: Float64Array) -> None:
    """Write the rotation matrix of a rotation vector. Source: Rodrigues 1840."""
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if angle2 < _SMALL * _SMALL:
        a, b = 1.0 - angle2 / 6.0, 0.5
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


@kernel(types.void(_M, _V), **INNER)
def rotation_vector(matrix: Float64Array, vector: Float64Array) -> None:
    """Write the rotation vector of a rotation matrix, its angle at most π."""
    x, y, z = matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
    sine2, cosine2 = math.sqrt(x * x + y * y + z * z), matrix[0, 0] + matrix[1, 1] + matrix[2, 2] - 1.0
    angle = math.atan2(sine2, cosine2)
    if cosine2 > -1.999:
        scale = 0.5 if sine2 < _SMALL else angle / sine2
        vector[0], vector[1], vector[2] = scale * x, scale * y, scale * z
        return
    # near half a rotation the axis is the column of R + Rᵀ + (1 - trace) I with the largest diagonal
    best = 0
    for k in range(1, 3):
        if matrix[k, k] > matrix[best, best]:
            best = k
    norm2 = 0.0
    for k in range(3):
        vector[k] = matrix[k, best] + matrix[best, k]
    vector[best] += 1.0 - (matrix[0, 0] + matrix[1, 1] + matrix[2, 2])
    for k in range(3):
        norm2 += vector[k] * vector[k]
    sign = 1.0 if vector[0] * x + vector[1] * y + vector[2] * z >= 0.0 else -1.0
    scale = sign * angle / math.sqrt(norm2)
    for k in range(3):
        vector[k] *= scale


@kernel(types.void(_V, float64, _M), **INNER)
def right_slope(vector: Float64Array, sign: float, matrix: Float64Array) -> None:
    """Write J with Exp(v + δ) ≈ Exp(v) Exp(J δ) for sign 1, and for sign -1 the inverse of it.

    Source: Chirikjian 2012, "Stochastic Models, Information Theory, and Lie Groups 2", section 10.6.
    """
    x, y, z = vector[0], vector[1], vector[2]
    angle2 = x * x + y * y + z * z
    if sign > 0.0:
        if angle2 < _SMALL * _SMALL:
            a, b = -0.5, 1.0 / 6.0
        else:
            angle = math.sqrt(angle2)
            a, b = -(1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    elif angle2 < _SMALL * _SMALL:
        a, b = 0.5, 1.0 / 12.0
    else:
        angle = math.sqrt(angle2)
        a = 0.5
        b = 1.0 / angle2 - 0.5 / (angle * math.tan(0.5 * angle))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = 1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)


@kernel(types.void(_M, _M, _M), **INNER)
def times(first: Float64Array, second: Float64Array, product: Float64Array) -> None:
    """Write the product of two (3, 3) matrices into a third."""
    for i in range(3):
        for j in range(3):
            product[i, j] = (
                first[i, 0] * second[0, j] + first[i, 1] * second[1, j] + first[i, 2] * second[2, j]
            )


@kernel(types.void(_M, _M, _M), **INNER)
def transposed_times(first: Float64Array, second: Float64Array, product: Float64Array) -> None:
    """Write the product of the transposed first and the second (3, 3) matrix into a third."""
    for i in range(3):
        for j in range(3):
            product[i, j] = (
                first[0, i] * second[0, j] + first[1, i] * second[1, j] + first[2, i] * second[2, j]
            )


@kernel(types.void(_M, _V, _M), **INNER)
def times_cross(matrix: Float64Array, vector: Float64Array, product: Float64Array) -> None:
    """Write matrix · [vector]×, (3, 3), where [v]× w = v × w."""
    x, y, z = vector[0], vector[1], vector[2]
    for i in range(3):
        a, b, c = matrix[i, 0], matrix[i, 1], matrix[i, 2]
        product[i, 0], product[i, 1], product[i, 2] = b * z - c * y, c * x - a * z, a * y - b * x
