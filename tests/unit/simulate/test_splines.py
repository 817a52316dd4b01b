import numpy as np
from scipy.interpolate import BSpline

from sceneloom.simulate.trajectory import control_points_through, spline_derivatives, spline_grid

CONTROL = np.random.default_rng(0).normal(size=(3, 20, 2))
ALONG = np.random.default_rng(1).uniform(0, 15, 40)


def test_splines_and_their_slopes_are_those_of_scipy():
    knots = np.arange(-5.0, 21.0)
    for k in range(3):
        expected = BSpline(knots, CONTROL[k], 5)
        values, slopes = spline_derivatives(CONTROL, np.full(40, k), ALONG, orders=2)
        # Sums of six products of numbers below 3.
        np.testing.assert_allclose(values, expected(ALONG), atol=1e-13)
        np.testing.assert_allclose(slopes, expected(ALONG, 1), atol=1e-13)


def test_a_grid_of_times_and_splines_is_the_same_as_one_by_one():
    grid = spline_grid(CONTROL, ALONG)
    (single,) = spline_derivatives(CONTROL, np.arange(3)[None, :], ALONG[:, None], orders=1)
    np.testing.assert_allclose(grid, single, atol=1e-13)


def test_splines_pass_cubics_through_their_samples():
    at = np.arange(20) - 2.0
    cubic = np.stack([0.3 * at**3 - 2 * at**2 + at, 5.0 - at], axis=1)[None]
    (values,) = spline_derivatives(
        control_points_through(cubic), np.zeros(1, np.int64), np.arange(1.0, 14.0), orders=1
    )
    # The first and last control point keep their samples: two knots from either end nothing is left of that.
    np.testing.assert_allclose(values, cubic[0, 3:16], atol=1e-9)
