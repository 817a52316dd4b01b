"""The least sum of squares of a smooth function, by Levenberg's and Marquardt's method."""

from collections.abc import Callable

import numpy as np

from sceneloom.arrays import Float64Array

_ROUNDS = 60
_STEP = 1e-6
_ENOUGH = 1e-6
_NOTHING = 1e-13
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e12


def minimised(
    residuals: Callable[[Float64Array], Float64Array], start: Float64Array, scale: Float64Array
) -> Float64Array:
    """Search the values at which the sum of squared residuals is least, near a start.

    Steps that lead where a residual is not finite are not taken.

    Args:
        residuals: gives (M,) float64 for (N,) values.
        start: (N,), where all residuals are finite.
        scale: (N,), by how much each value may change without changing everything.

    Source: Marquardt 1963, "An Algorithm for Least-Squares Estimation of Nonlinear Parameters".
    """
    from sceneloom.kernels.triangle import triangle_of

    values, off = start.copy(), residuals(start)
    damping = _FIRST_DAMPING
    for _ in range(_ROUNDS):
        slopes = _slopes(residuals, values, scale)
        if not np.isfinite(slopes).all():
            break
        # a value that changes nothing stays as it is
        lengths = np.linalg.norm(slopes, axis=0)
        lengths[lengths <= _NOTHING * lengths.max(initial=0.0)] = np.inf
        triangle = triangle_of(np.ascontiguousarray(np.column_stack([slopes / lengths, off]).T))
        before = float(off @ off)
        while damping < _LARGEST_DAMPING:
            trial = values + _damped_step(triangle, damping) / lengths
            trial_off = residuals(trial)
            after = float(trial_off @ trial_off)
            if after < before:
                break
            damping *= 10.0
        else:
            break
        values, off = trial, trial_off
        damping = max(damping / 10.0, 1e-15)
        if before - after <= _ENOUGH * before:
            break
    return values


def _slopes(
    residuals: Callable[[Float64Array], Float64Array], values: Float64Array, scale: Float64Array
) -> Float64Array:
    """Derivatives (M, N) of the residuals, by central differences."""
    steps = np.diag(_STEP * scale)
    columns = [(residuals(values + step) - residuals(values - step)) / (2.0 * step.sum()) for step in steps]
    return np.stack(columns, axis=1)


def _damped_step(triangle: Float64Array, damping: float) -> Float64Array:
    """Solve the damped linear problem as one of least squares, which squares no condition number.

    Args:
        triangle: (N + 1, N + 1), upper triangular: slopes and residuals, turned so that most of their rows vanish.
        damping: 0 for the undamped problem.
    """
    count = triangle.shape[1] - 1
    rows = np.concatenate([triangle[:, :count], np.sqrt(damping) * np.eye(count)])
    wanted = np.concatenate([-triangle[:, count], np.zeros(count)])
    step: Float64Array = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return step
