"""Least squares with nuisances of which something is known before, against generalised least squares."""

import numpy as np
import pytest

from sceneloom.motion.clock.comparison import Linearised, fit, misfit_of

ROWS, WINDOWS = 60, 3
SIGMA = 0.3
"""Standard deviation of the noise; half of what the fit is reported, lest weights fall."""


@pytest.fixture(scope="module")
def problem():
    """A line's two numbers, kicks that add up in each window, free levels."""
    draw = np.random.default_rng(3)
    windows = np.repeat(np.arange(WINDOWS), ROWS // WINDOWS)
    since = np.arange(ROWS) % (ROWS // WINDOWS)
    slopes = draw.standard_normal((ROWS, 2))
    kicks = np.maximum(since[:, None] - np.arange(0, 20, 4), 0.0)
    columns = np.hstack([np.ones((ROWS, 1)), kicks])
    expected = np.array([np.inf, *[0.05] * 5])
    amounts = np.hstack([draw.standard_normal((WINDOWS, 1)), 0.05 * draw.standard_normal((WINDOWS, 5))])
    values = slopes @ [1.0, -2.0] + (columns * amounts[windows]).sum(axis=1)
    return windows, slopes, columns, expected, values + SIGMA * np.clip(draw.standard_normal(ROWS), -1.5, 1.5)


def model_of(problem):
    _, slopes, columns, expected, values = problem

    def model(parameters, amounts):
        del amounts
        return Linearised(
            (values - slopes @ parameters)[:, None],
            slopes[:, None, :],
            columns[:, None, :],
            np.ones(ROWS, np.bool_),
            expected,
        )

    return model


def oracle(problem):
    """Whatever is known of the kicks is a covariance of the rows; levels are parameters like others."""
    windows, slopes, columns, expected, values = problem
    same = windows[:, None] == windows
    covariance = (2 * SIGMA) ** 2 * np.eye(ROWS) + same * (columns[:, 1:] @ columns[:, 1:].T) * expected[
        1
    ] ** 2
    design = np.hstack([slopes, (windows[:, None] == np.arange(WINDOWS)) * 1.0])
    weights = np.linalg.inv(covariance)
    information = design.T @ weights @ design
    found = np.linalg.solve(information, design.T @ weights @ values)
    left = values - design @ found
    return found[:2], np.linalg.inv(np.linalg.inv(information)[:2, :2]), float(left @ weights @ left)


def test_nuisances_of_known_size_make_generalised_least_squares(problem):
    found = fit(
        model_of(problem),
        np.zeros(2),
        np.full(2, np.inf),
        problem[0],
        whiten=False,
        scales=np.array([2 * SIGMA]),
    )
    parameters, information, misfit = oracle(problem)
    # the normal equations are damped by 1e-10
    np.testing.assert_allclose(found.parameters, parameters, atol=1e-7)
    np.testing.assert_allclose(found.information, information, rtol=1e-6)
    assert found.misfit == pytest.approx(misfit, rel=1e-6)
    again = misfit_of(model_of(problem), found.parameters, problem[0], scales=np.array([2 * SIGMA]))
    assert again == pytest.approx(misfit, rel=1e-6)
