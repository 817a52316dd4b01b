"""The nearest neighbours of a cloud's points in several directions, as a camera sees them."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
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
) -> BoolArray:
    """Mark the cells that hold a point; write those of evenly drawn points to `sampled`, 0 for one without a cell."""
    occupied, numbers = np.zeros(grid[3] * grid[4], np.bool_), np.empty(BLOCK, np.int32)
    rightward, downward, count = directions[0], directions[1], inverse_ranges.shape[0]
    sampled[:] = 0
    samples, taken = min(sampled.shape[0], count), 0
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        block = numbers[: stop - start]
        number_cells(rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], grid, block)
        for k in range(block.shape[0]):
            occupied[np.uint32(block[k])] = True
        while taken < samples and taken * count // samples < stop:
            sampled[taken] = block[taken * count // samples - start]
            taken += 1
    occupied[0] = False
    return occupied


@numba.njit(
    void(
        _IN_F32_2D, _IN_F32_1D, float64, _IN_I64_1D, _IN_I64_1D, _IN_I64_1D, _IN_F64_1D, float64[:, ::1]
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
) -> None:
    """Write how far it is from some points, evenly drawn from the cloud, to the next point in each sector.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; 0 for a point that takes no part.
        cell: resolution [rad]; what lies in one cell is not told apart.
        right, down: (K,) columns and rows to the cells that are looked at, the nearest first.
        sectors: (K,) number of the sector in which such a cell lies.
        distances: (K,) how far such a cell is, in any unit.
        found: (samples, sectors), written: the distance of the first occupied cell; NaN for none.
    """
    reach = 1
    for k in range(right.shape[0]):
        reach = max(reach, abs(right[k]), abs(down[k]))
    grid, sampled = fit_grid(directions, inverse_ranges, cell, reach), np.empty(found.shape[0], np.int32)
    occupied = _occupy(directions, inverse_ranges, grid, sampled)
    found[:] = math.nan
    for s in range(sampled.shape[0]):
        missing = found.shape[1] if sampled[s] > 0 else 0
        for k in range(right.shape[0]):
            if missing == 0:
                break
            if occupied[sampled[s] + down[k] * grid[3] + right[k]] and math.isnan(found[s, sectors[k]]):
                found[s, sectors[k]] = distances[k]
                missing -= 1
