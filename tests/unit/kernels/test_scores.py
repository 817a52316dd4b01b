"""The optimal assignment against SciPy's, ties included."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from sceneloom.kernels.scores import best_columns


def check(gains):
    rows, columns = linear_sum_assignment(gains, maximize=True)
    paired = np.full(len(gains), -1)
    paired[rows] = columns
    assert best_columns(gains).tolist() == paired.tolist()


@pytest.mark.parametrize("kind", ["any", "whole numbers", "mostly none", "negative"])
def test_rows_get_the_columns_that_scipy_gives_them(kind):
    rng = np.random.default_rng(1)
    for _ in range(150):
        gains = rng.random(rng.integers(0, 14, 2))
        if kind == "whole numbers":
            gains = np.round(3 * gains)
        elif kind == "mostly none":
            gains[gains < 0.7] = 0.0
        elif kind == "negative":
            gains -= 0.5
        check(gains)


@pytest.mark.parametrize("shape", [(60, 80), (80, 60), (3, 0), (0, 3)])
def test_large_and_empty_tables_are_assigned_as_by_scipy(shape):
    check(np.random.default_rng(2).random(shape))
