"""Checks of small arrays, against NumPy."""

import numpy as np
import pytest

from sceneloom.kernels.number_checks import all_within, first_zero, in_order


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.uint32])
@pytest.mark.parametrize("above", [False, True])
def test_numbers_are_in_range_where_numpy_says_so(dtype, above):
    for values in ([], [0], [1, 2], [0, 3], [4], [2**31 - 1]):
        array = np.array(values, dtype)
        for low, high in ((0.0, 3.0), (-np.inf, np.inf), (1.0, np.inf)):
            expected = bool(((array > low if above else array >= low) & (array <= high)).all())
            assert all_within(array, low, high, above) == expected


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_in_no_range(odd):
    assert not all_within(np.array([1.0, odd], np.float32), -np.inf, np.inf, False)


def test_the_first_vector_that_is_0_is_found():
    assert first_zero(np.array([[0, 1, 0], [0, 0, -0.0], [0, 0, 0]], np.float32)) == 1
    assert first_zero(np.array([[0, 0, np.nan]], np.float32)) == -1


def test_edges_may_meet_but_not_pass_each_other():
    assert in_order(np.array([[1, 2, 1, 2], [0, 0, 5, 6]], np.uint32))
    assert not in_order(np.array([[0, 0, 5, 6], [2, 2, 1, 3]], np.uint32))
    assert not in_order(np.array([[2, 2, 3, 1]], np.uint32))
