"""Chains of blocks against the same matrix written out."""

import numpy as np
import pytest

from sceneloom.kernels.imu_chain import chain_covariances, solve_chain


def chain(count: int, n: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Blocks, couplings, right side, and the whole matrix: Jᵀ J with J tying neighbours only."""
    rng = np.random.default_rng(seed)
    whole = np.zeros((count * n, count * n))
    for k in range(count):
        slopes = np.zeros((2 * n, count * n))
        slopes[:, k * n : (k + 2) * n] = rng.standard_normal((2 * n, min(2, count - k) * n))
        whole += slopes.T @ slopes
    grid = whole.reshape(count, n, count, n).swapaxes(1, 2)
    blocks = np.stack([grid[k, k] for k in range(count)])
    couplings = np.stack([grid[k, k + 1] for k in range(count - 1)]) if count > 1 else np.zeros((0, n, n))
    return blocks, couplings, rng.standard_normal((count, n)), whole


@pytest.mark.parametrize(("count", "n"), [(1, 3), (2, 15), (40, 15), (100, 4)])
def test_solution_and_covariances_are_those_of_the_whole_matrix(count, n):
    blocks, couplings, right, whole = chain(count, n, count)
    factors, gains, solution = np.empty_like(blocks), np.empty_like(couplings), np.empty_like(right)
    assert solve_chain(blocks, couplings, right, 0.0, factors, gains, solution) == -1
    expected = np.linalg.solve(whole, right.ravel()).reshape(right.shape)
    # float64 with condition numbers of some thousands
    assert np.allclose(solution, expected, rtol=1e-8, atol=1e-9)
    own, between = np.empty_like(blocks), np.empty_like(couplings)
    chain_covariances(factors, gains, own, between)
    inverse = np.linalg.inv(whole).reshape(count, n, count, n).swapaxes(1, 2)
    for k in range(count):
        assert np.allclose(own[k], inverse[k, k], rtol=1e-7, atol=1e-9)
        if k + 1 < count:
            assert np.allclose(between[k], inverse[k, k + 1], rtol=1e-7, atol=1e-9)


def test_damping_adds_its_share_of_the_diagonal():
    blocks, couplings, right, whole = chain(5, 3, 0)
    factors, gains, solution = np.empty_like(blocks), np.empty_like(couplings), np.empty_like(right)
    solve_chain(blocks, couplings, right, 0.5, factors, gains, solution)
    expected = np.linalg.solve(whole + 0.5 * np.diag(np.diag(whole)), right.ravel())
    assert np.allclose(solution.ravel(), expected, rtol=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_reported_with_its_block():
    blocks, couplings, right, _ = chain(4, 3, 1)
    blocks[2] -= 1e3 * np.eye(3)
    factors, gains, solution = np.empty_like(blocks), np.empty_like(couplings), np.empty_like(right)
    assert solve_chain(blocks, couplings, right, 0.0, factors, gains, solution) == 2
