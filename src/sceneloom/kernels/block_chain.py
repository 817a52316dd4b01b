"""Normal equations of a chain of states, in which each is tied to its neighbours only: solved in linear time."""

import math

import numpy as np
from numba import boolean, float64, int64, types

from sceneloom.arrays import Float64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.surface_map import INNER

_M = float64[:, ::1]
_READ_2D = types.Array(float64, 2, "C", readonly=True)
_READ_3D = types.Array(float64, 3, "C", readonly=True)


@kernel(boolean(_M), **INNER)
def _factor(matrix: Float64Array) -> bool:
    """Put the Cholesky factor into the lower half; False where the matrix is not positive definite."""
    n = matrix.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 0.0:
            return False
        root = math.sqrt(pivot)
        matrix[j, j] = root
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / root
    return True


@kernel(types.void(_M, _M), **INNER)
def _solve_columns(factor: Float64Array, right: Float64Array) -> None:
    """Put the solution of L Lᵀ X = B instead of B, (n, m)."""
    n, m = right.shape
    for i in range(n):
        for k in range(i):
            share = factor[i, k]
            for j in range(m):
                right[i, j] -= share * right[k, j]
        scale = 1.0 / factor[i, i]
        for j in range(m):
            right[i, j] *= scale
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            share = factor[k, i]
            for j in range(m):
                right[i, j] -= share * right[k, j]
        scale = 1.0 / factor[i, i]
        for j in range(m):
            right[i, j] *= scale


@kernel(
    int64(_READ_3D, _READ_3D, _READ_2D, float64, float64[:, :, ::1], float64[:, :, ::1], _M),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def solve_chain(
    blocks: Float64Array,
    couplings: Float64Array,
    right: Float64Array,
    damping: float,
    factors: Float64Array,
    gains: Float64Array,
    solution: Float64Array,
) -> int:
    """Solve H x = b for a symmetric H of blocks on the diagonal and beside it.

    Args:
        blocks: (K, n, n) the diagonal; `damping` times their own diagonals are added.
        couplings: (K - 1, n, n), row block i, column block i + 1.
        right: (K, n).
        factors: (K, n, n), written here: Cholesky factors of the pivots, in the lower halves.
        gains: (K - 1, n, n), written here: pivot⁻¹ · coupling.
        solution: (K, n), written here.

    Returns:
        -1, or the first block at which H is not positive definite.

    Source: Golub and Van Loan 2013, "Matrix Computations", 4.5, block elimination.
    """
    count, n = right.shape
    column = np.empty((n, 1))
    for i in range(count):
        factors[i] = blocks[i]
        for k in range(n):
            factors[i, k, k] += damping * blocks[i, k, k]
            solution[i, k] = right[i, k]
        if i > 0:
            coupling, gain = couplings[i - 1], gains[i - 1]
            for j in range(n):
                for r in range(n):
                    tied = coupling[j, r]
                    if tied != 0.0:
                        for c in range(r + 1):
                            factors[i, r, c] -= tied * gain[j, c]
                        solution[i, r] -= tied * column[j, 0]
        if not _factor(factors[i]):
            return i
        if i + 1 < count:
            gains[i] = couplings[i]
            _solve_columns(factors[i], gains[i])
        column[:, 0] = solution[i]
        _solve_columns(factors[i], column)
        solution[i] = column[:, 0]
    for i in range(count - 2, -1, -1):
        for r in range(n):
            total = solution[i, r]
            for c in range(n):
                total -= gains[i, r, c] * solution[i + 1, c]
            solution[i, r] = total
    return -1


@kernel(
    types.void(_READ_3D, _READ_3D, float64[:, :, ::1], float64[:, :, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def chain_covariances(
    factors: Float64Array, gains: Float64Array, covariances: Float64Array, between: Float64Array
) -> None:
    """Give those blocks of H⁻¹ that lie where H has some, from what `solve_chain` left with no damping.

    Args:
        factors, gains: as there.
        covariances: (K, n, n), written here: of each state.
        between: (K - 1, n, n), written here: of each state with the next.

    Source: Takahashi, Fagan and Chin 1973, the entries of the inverse of a sparse matrix; for a chain the same as the
    smoother of Rauch, Tung and Striebel 1965.
    """
    count, n = factors.shape[0], factors.shape[1]
    pivot = np.empty((n, n))
    for i in range(count - 1, -1, -1):
        pivot[:] = factors[i]
        own = np.eye(n)
        _solve_columns(pivot, own)
        covariances[i] = own
        if i + 1 == count:
            continue
        for r in range(n):
            for c in range(n):
                total = 0.0
                for k in range(n):
                    total -= gains[i, r, k] * covariances[i + 1, k, c]
                between[i, r, c] = total
        for r in range(n):
            for c in range(r + 1):
                total = 0.0
                for k in range(n):
                    total -= between[i, r, k] * gains[i, c, k]
                covariances[i, r, c] += total
                if c != r:
                    covariances[i, c, r] = covariances[i, r, c]
