"""The triangle of a matrix, against LAPACK's and by what it stands for."""

import numpy as np
import pytest

from sceneloom.kernels.triangle import triangle_of


@pytest.mark.parametrize("shape", [(50, 7), (7, 7), (1, 1), (300, 1)])
def test_triangles_are_those_of_lapack_but_for_signs(shape):
    matrix = np.random.default_rng(0).normal(size=shape)
    ours, theirs = triangle_of(np.ascontiguousarray(matrix.T)), np.linalg.qr(matrix, mode="r")
    assert np.allclose(np.abs(ours), np.abs(theirs), rtol=1e-12, atol=1e-12)
    assert np.allclose(ours.T @ ours, matrix.T @ matrix)


def test_a_flat_matrix_has_zeros_below():
    matrix = np.random.default_rng(1).normal(size=(3, 5))
    ours = triangle_of(np.ascontiguousarray(matrix.T))
    assert np.allclose(ours.T @ ours, matrix.T @ matrix)
    assert not ours[3:].any()


def test_columns_of_zeros_do_no_harm():
    matrix = np.random.default_rng(2).normal(size=(20, 4))
    matrix[:, 1] = 0.0
    ours = triangle_of(np.ascontiguousarray(matrix.T))
    assert np.allclose(ours.T @ ours, matrix.T @ matrix)
    assert not triangle_of(np.zeros((3, 10))).any()


def test_nearly_equal_columns_keep_what_is_between_them():
    tall = np.random.default_rng(3).normal(size=(40, 1))
    matrix = np.column_stack([tall, tall + 1e-9 * np.random.default_rng(4).normal(size=(40, 1))])
    ours = triangle_of(np.ascontiguousarray(matrix.T))
    assert abs(ours[1, 1]) == pytest.approx(abs(np.linalg.qr(matrix, mode="r")[1, 1]), rel=1e-5)
