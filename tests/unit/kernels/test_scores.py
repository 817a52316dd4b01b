"""The optimal assignment against SciPy's, ties included."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from sceneloom.kernels.scores import best_columns


def columns_by_scipy(gains: np.ndarray) -> np.ndarray:
    rows, columns = linear_sum_assignment(gains, maximize=True)
    paired = np.full(len(gains), -1)
    paired[rows] = columns
    return paired


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
        assert best_columns(gains).tolist() == columns_by_scipy(gains).tolist()


@pytest.mark.parametrize("shape", [(60, 80), (80, 60)])
def test_a_large_table_is_assigned_as_by_scipy(shape):
    gains = np.random.default_rng(2).random(shape)
    assert best_columns(gains).tolist() == columns_by_scipy(gains).tolist()


def test_a_table_without_columns_pairs_nothing():
    assert best_columns(np.zeros((3, 0))).tolist() == [-1, -1, -1]
    assert best_columns(np.zeros((0, 3))).tolist() == []
