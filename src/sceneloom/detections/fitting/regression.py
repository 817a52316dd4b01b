"""Two small regressions: of what comes true, and of how large errors are."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array

_ROUNDS = 200
_SMALL = 1e-8
_EXACT = 1e-3
"""Errors below are none [m or rad]."""


def fit_odds(
    features: Float64Array, came_true: BoolArray, *, expected: Float64Array, weights: Float64Array
) -> Float64Array:
    """Fit the logarithm of odds as a sum of features, by Newton's steps on the penalised likelihood.

    Args:
        features: (N, K), the first column of ones.
        came_true: (N,).
        expected: (K,), what coefficients are where data state nothing.
        weights: (K,), as how many examples' worth that counts.

    Returns:
        (K,) float64, those of features after the first 0 or more: surer signs never make less likely.

    Source: le Cessie and van Houwelingen 1992, "Ridge Estimators in Logistic Regression".
    """
    found = expected.copy()
    loss = _loss(features, came_true, found, expected, weights)
    for _ in range(_ROUNDS):
        shares = 1.0 / (1.0 + np.exp(-features @ found))
        slope = features.T @ (shares - came_true) + weights * (found - expected)
        curve = (features * (shares * (1.0 - shares))[:, None]).T @ features + np.diag(weights)
        step, size = np.linalg.solve(curve + _SMALL * np.eye(len(found)), slope), 1.0
        while size > _SMALL:
            tried = found - size * step
            tried[1:] = np.maximum(tried[1:], 0.0)
            after = _loss(features, came_true, tried, expected, weights)
            if after <= loss:
                break
            size /= 2.0
        else:
            break
        if loss - after < _SMALL:
            return tried
        found, loss = tried, after
    return found


def _loss(
    features: Float64Array,
    came_true: BoolArray,
    found: Float64Array,
    expected: Float64Array,
    weights: Float64Array,
) -> float:
    odds = features @ found
    return float(
        (np.logaddexp(0.0, odds) - odds * came_true).sum() + (weights * (found - expected) ** 2).sum() / 2
    )


def fit_deviations(
    features: Float64Array, errors: Float64Array, *, weights: Float64Array, degrees_of_freedom: float
) -> Float64Array:
    """Fit logarithms of deviations as sums of features, for errors that follow a Student distribution together.

    Args:
        features: (N, K), the first column of ones.
        errors: (N, D).
        weights: (N,), of the examples.
        degrees_of_freedom: ν of the distribution.

    Returns:
        (D, K) float64 of its scales.

    Source: Fisher's scoring of the likelihood of Lange, Little and Taylor 1989, "Robust Statistical Modeling
    Using the t Distribution".
    """
    dimensions = errors.shape[1]
    found = np.zeros((dimensions, features.shape[1]))
    found[:, 0] = np.log(np.median(np.abs(errors), axis=0) + 1e-3)
    weighted = features * weights[:, None]
    curve = features.T @ weighted + 1e-3 * weights.sum() * np.diag([0.0, *np.ones(features.shape[1] - 1)])
    for _ in range(_ROUNDS):
        squares = (errors**2 + _EXACT**2) * np.exp(-2.0 * features @ found.T)
        shrunk = (degrees_of_freedom + dimensions) / (degrees_of_freedom + squares.sum(axis=1))
        slope = weighted.T @ np.minimum(shrunk[:, None] * squares - 1.0, 4.0)
        step = np.linalg.solve(curve, slope).T / 2.0
        found += step
        if np.abs(step).max() < 1e-6:
            break
    return found


def weighted_quantile(values: Float64Array, weights: Float64Array, share: float) -> float:
    """Give the value below which a share of the weight lies."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][min(int(np.searchsorted(below, share)), len(order) - 1)])
