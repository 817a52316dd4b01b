"""How far apart the scan lines of a cloud appear to a camera."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int64, types, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.kernels.direction_grid import BLOCK, INNER, fit_grid, number_cells

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

SECTORS = 8


@numba.njit(**INNER)
def _occupy(
    directions: Float32Array, inverse_ranges: Float32Array, grid: tuple[Any, Any, Any, int, int]
) -> BoolArray:
    """Mark the cells that hold a point."""
    occupied, numbers = np.zeros(grid[3] * grid[4], np.bool_), np.empty(BLOCK, np.int32)
    rightward, downward = directions[0], directions[1]
    for start in range(0, inverse_ranges.shape[0], BLOCK):
        stop = min(start + BLOCK, inverse_ranges.shape[0])
        block = numbers[: stop - start]
        number_cells(rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], grid, block)
        for k in range(block.shape[0]):
            occupied[np.uint32(block[k])] = True
    occupied[0] = False
    return occupied


@numba.njit(**INNER)
def _list_disc(reach: int, columns: int) -> tuple[Int64Array, Int64Array, Float64Array]:
    """List the cells around a middle one, nearest first: what to add to its number, their sector and distance."""
    side = 2 * reach + 1
    offsets, sectors = np.empty(side * side, np.int64), np.empty(side * side, np.int64)
    distances = np.empty(side * side)
    count = 0
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            squared = dx * dx + dy * dy
            if 0 < squared <= reach * reach:
                turn = math.atan2(float(dy), float(dx)) / (2.0 * math.pi)
                offsets[count] = dy * columns + dx
                sectors[count] = math.floor(SECTORS * turn + 0.5) % SECTORS
                distances[count] = math.sqrt(float(squared))
                count += 1
    order = np.argsort(distances[:count], kind="mergesort")
    return offsets[:count][order], sectors[:count][order], distances[:count][order]


@numba.njit(**INNER)
def _find_next(
    occupied: BoolArray,
    cell: int,
    offsets: Int64Array,
    sectors: Int64Array,
    distances: Float64Array,
    found: Float64Array,
) -> None:
    """Write the distance in cells to the nearest occupied cell of each sector, NaN for none."""
    found[:] = math.nan
    missing = SECTORS
    for k in range(offsets.shape[0]):
        if occupied[cell + offsets[k]] and math.isnan(found[sectors[k]]):
            found[sectors[k]] = distances[k]
            missing -= 1
            if missing == 0:
                return


@numba.njit(**INNER)
def _mean_of_middle(values: Float64Array) -> float:
    """Average the middle half of the values: robust as the median, but not bound to whole cells."""
    ordered = np.sort(values)
    return float(np.mean(ordered[ordered.shape[0] // 4 : ordered.shape[0] - ordered.shape[0] // 4]))


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, float64, int64, int64, float64[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def measure_spacing(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    cell: float,
    reach: int,
    samples: int,
    spacings: Float64Array,
) -> None:
    """Measure how far apart the points of a cloud appear along four axes.

    Around some points, evenly drawn from the cloud, the nearest neighbour in each of eight sectors is looked for;
    opposite sectors make an axis.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; 0 for a point that takes no part.
        cell: resolution of the measurement [rad]; nothing nearer is told apart.
        reach: farthest neighbour looked for [cells].
        samples: around so many points.
        spacings: (4,) [rad], written: mean of the middle half of the distances along the axes at 0, 45, 90 and 135
            degrees from rightward to downward; NaN where fewer than half of the neighbours are within reach.
    """
    grid = fit_grid(directions, inverse_ranges, cell, reach)
    occupied = _occupy(directions, inverse_ranges, grid)
    offsets, sectors, distances = _list_disc(reach, grid[3])
    found = np.full((samples, SECTORS), math.nan)
    count, number = inverse_ranges.shape[0], np.empty(1, np.int32)
    for s in range(min(samples, count)):
        i = s * count // min(samples, count)
        number_cells(
            directions[0, i : i + 1], directions[1, i : i + 1], inverse_ranges[i : i + 1], grid, number
        )
        if number[0] > 0:
            _find_next(occupied, number[0], offsets, sectors, distances, found[s])
    for axis in range(SECTORS // 2):
        steps = np.concatenate((found[:, axis], found[:, axis + SECTORS // 2]))
        steps = steps[~np.isnan(steps)]
        spacings[axis] = cell * _mean_of_middle(steps) if steps.shape[0] >= samples else math.nan
