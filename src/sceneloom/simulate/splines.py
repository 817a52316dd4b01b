"""Uniform quintic B-splines: curves with four continuous derivatives, exact at any time."""

from math import comb, factorial

import numpy as np
from numpy.polynomial import polynomial

from sceneloom.arrays import Float64Array, Int64Array

DEGREE = 5


def _basis_rows() -> Float64Array:
    """Coefficients (6, 6) of the uniform quintic B-spline: row j weighs control point i + j, powers ascending.

    Source: Schoenberg 1946: N(x) = 1/5! Σ (-1)^k C(6, k) max(x - k, 0)^5.
    """
    rows = np.zeros((DEGREE + 1, DEGREE + 1))
    for j in range(DEGREE + 1):
        for k in range(DEGREE - j + 1):
            power = polynomial.polypow([DEGREE - j - k, 1.0], DEGREE)
            rows[j] += (-1) ** k * comb(DEGREE + 1, k) / factorial(DEGREE) * power
    return rows


BASIS = _basis_rows()


def spline_derivatives(
    control_points: Float64Array, which: Int64Array, along: Float64Array, *, orders: int
) -> tuple[Float64Array, ...]:
    """Give splines and their derivatives by the knot number.

    Args:
        control_points: (K, N, C) float64; control point i weighs most at knot number i - 2.
        which: (*S,) int64, which spline.
        along: (*S) float64, knot number; the shapes of `which` and `along` are broadcast.
        orders: how many: 1 for the values alone, 2 with the first derivative.

    Returns:
        `orders` arrays (*S, C) float64.
    """
    which, along = np.broadcast_arrays(which, along)
    piece = np.clip(np.floor(along).astype(np.int64), 0, control_points.shape[1] - DEGREE - 1)
    gathered = control_points[which[..., None], piece[..., None] + np.arange(DEGREE + 1)]
    answers = []
    for order in range(orders):
        coefficients = polynomial.polyder(BASIS, order, axis=1)
        weights = np.moveaxis(polynomial.polyval(along - piece, coefficients.T), 0, -1)
        answers.append(np.einsum("...j,...jc->...c", weights, gathered))
    return tuple(answers)


def spline_grid(control_points: Float64Array, along: Float64Array) -> Float64Array:
    """Give all of K splines (K, N, C) at all of M knot numbers (M,), (M, K, C) float64, as `spline_derivatives`."""
    splines, count, channels = control_points.shape
    piece = np.clip(np.floor(along).astype(np.int64), 0, count - DEGREE - 1)
    weights = polynomial.polyval(along - piece, BASIS.T).T
    values = np.empty((len(along), splines, channels))
    for first in np.unique(piece):
        rows = piece == first
        control = np.moveaxis(control_points[:, first : first + DEGREE + 1], 1, 0).reshape(DEGREE + 1, -1)
        values[rows] = (weights[rows] @ control).reshape(-1, splines, channels)
    return values


def control_points_through(samples: Float64Array) -> Float64Array:
    """Give control points (..., N, C) of splines that pass samples (..., N, C) at the knots to fourth order.

    A spline whose control points are the samples lags by a quarter of their second difference: the variance of the
    basis, 6 / 12, halved. The ends keep their samples.
    """
    control = samples.copy()
    control[..., 1:-1, :] -= 0.25 * np.diff(samples, 2, axis=-2)
    return control
