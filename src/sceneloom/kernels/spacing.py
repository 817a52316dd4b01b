"""The nearest neighbours of a cloud's points in several directions, as a camera sees them."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int64, types, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array
from sceneloom.kernels.direction_grid import BLOCK, INNER, fit_grid, number_cells

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_F64_1D = types.Array(float64, 1, "C", readonly=True)
_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)


@numba.njit(**INNER)
def _occupy(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    grid: tuple[Any, Any, Any, int, int],
    sampled: AnyArray,
) -> AnyArray:
    """Put the number of a point, from 1, into its cell; write the cells of evenly drawn points to `sampled`.

    The last point in a cell holds it; cells without a point hold 0, and so does `sampled` for a point without a cell.
    """
    holders, numbers = np.zeros(grid[3] * grid[4], np.int32), np.empty(BLOCK, np.int32)
    rightward, downward, count = directions[0], directions[1], inverse_ranges.shape[0]
    sampled[:] = 0
    samples, taken = min(sampled.shape[0], count), 0
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        block = numbers[: stop - start]
        number_cells(rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], grid, block)
        for k in range(block.shape[0]):
            holders[np.uint32(block[k])] = start + k + 1
        while taken < samples and taken * count // samples < stop:
            sampled[taken] = block[taken * count // samples - start]
            taken += 1
    holders[0] = 0
    return holders


@numba.njit(
    void(
        _IN_F32_2D, _IN_F32_1D, float64, _IN_I64_1D, _IN_I64_1D, _IN_I64_1D, _IN_F64_1D, float64[:, ::1],
        int64[:, ::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def find_neighbours(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    cell: float,
    right: Int64Array,
    down: Int64Array,
    sectors: Int64Array,
    distances: Float64Array,
    found: Float64Array,
    neighbours: Int64Array,
) -> None:
    """Write how far it is from some points, evenly drawn from the cloud, to the next point in each sector.

    Sample s of S is point s * M // S; of fewer points than S, every one is drawn once.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; 0 for a point that takes no part.
        cell: resolution [rad]; what lies in one cell is not told apart.
        right, down: (K,) columns and rows to the cells that are looked at, the nearest first.
        sectors: (K,) number of the sector in which such a cell lies.
        distances: (K,) how far such a cell is, in any unit.
        found: (samples, sectors), written: the distance of the first occupied cell; NaN for none.
        neighbours: (samples, sectors), written: a point in that cell; -1 for none.
    """
    reach = 1
    for k in range(right.shape[0]):
        reach = max(reach, abs(right[k]), abs(down[k]))
    grid, sampled = fit_grid(directions, inverse_ranges, cell, reach), np.empty(found.shape[0], np.int32)
    holders = _occupy(directions, inverse_ranges, grid, sampled)
    found[:], neighbours[:] = math.nan, -1
    for s in range(sampled.shape[0]):
        missing = found.shape[1] if sampled[s] > 0 else 0
        for k in range(right.shape[0]):
            if missing == 0:
                break
            holder = holders[sampled[s] + down[k] * grid[3] + right[k]]
            if holder > 0 and neighbours[s, sectors[k]] < 0:
                found[s, sectors[k]], neighbours[s, sectors[k]] = distances[k], holder - 1
                missing -= 1
