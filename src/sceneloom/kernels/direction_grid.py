"""A grid of cells over the directions in which a camera sees points."""

import math
from typing import Any

import numba
import numpy as np

from sceneloom.arrays import AnyArray, Float32Array

INNER: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of the functions that are compiled, and cached, as parts of others."""

BLOCK = 512
"""Points whose cells are numbered at once, by vector instructions."""

_EDGE = np.float32(2.1)
"""No direction lies farther than this from the axis in the equal-area map."""
_NOTHING, _ENDLESS = np.float32(0.0), np.float32(math.inf)
_NONE, _FAR = np.int32(-1), np.int32(2**30)
_LOW = 0x7FFFFFFF


@numba.njit(**INNER)
def _is_placed(a: Any, b: Any, inverse_range: Any) -> Any:
    """Say whether a point takes part; NaN does not."""
    return (inverse_range > _NOTHING) & (inverse_range < _ENDLESS) & (abs(a) <= _EDGE) & (abs(b) <= _EDGE)


@numba.njit(**INNER)
def _step(value: Any, placed: Any, per_cell: Any) -> Any:
    """Count cells from the edge of the map."""
    return np.int32((value if placed else _NOTHING) * per_cell + _EDGE * per_cell)


@numba.njit(**INNER)
def fraction(value: Any, per_cell: Any) -> Any:
    """Give how far into its cell a direction lies, 0 to 1."""
    steps = value * per_cell + _EDGE * per_cell
    return steps - np.float32(np.int32(steps))


@numba.njit(**INNER)
def fit_grid(
    directions: Float32Array, inverse_ranges: Float32Array, cell: float, border: int
) -> tuple[Any, Any, Any, int, int]:
    """Fit the smallest grid around all points that has `border` empty cells on each side.

    Args:
        directions: (2, M) in the equal-area map.
        inverse_ranges: (M,) [1/m]; only points between zero and infinity take part.
        cell: size of a cell [rad].
        border: cells, at least 1.

    Returns:
        per_cell: 1 / cell.
        first_column, first_row: of the grid, counted from the edge of the map.
        columns, rows: of the grid, border included.
    """
    per_cell = np.float32(1.0 / cell)
    rightward, downward = directions[0], directions[1]
    left, right, top, bottom = _FAR, _NONE, _FAR, _NONE
    for i in range(inverse_ranges.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        column, row = _step(a, placed, per_cell), _step(b, placed, per_cell)
        left, right = min(left, column if placed else _FAR), max(right, column if placed else _NONE)
        top, bottom = min(top, row if placed else _FAR), max(bottom, row if placed else _NONE)
    columns = max(int(right - left), 0) + 1 + 2 * border
    rows = max(int(bottom - top), 0) + 1 + 2 * border
    return per_cell, np.int32(left - border), np.int32(top - border), columns, rows


@numba.njit(**INNER)
def number_cells(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, int32 row * columns + column; 0, where no other point is, if it takes no part."""
    per_cell, first_column, first_row, columns, _ = grid
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        column, row = _step(a, placed, per_cell) - first_column, _step(b, placed, per_cell) - first_row
        numbers[i] = row * np.int32(columns) + column if placed else np.int32(0)


@numba.njit(**INNER)
def keep_nearest(
    directions: Float32Array, inverse_ranges: Float32Array, grid: tuple[Any, Any, Any, int, int]
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Keep the nearest point of each cell, the first of equally near ones.

    Returns:
        nearest: (rows * columns,) float32 [1/m], its inverse range, 0 where the cell is empty.
        right, down: (rows * columns,) float32, how far into the cell it lies, 0 to 1.
    """
    # The bits of positive floats are ordered as the floats are, so range and number fit one integer, whose maximum
    # is taken without a branch.
    keys, numbers = np.zeros(grid[3] * grid[4], np.int64), np.empty(BLOCK, np.int32)
    rightward, downward, bits = directions[0], directions[1], inverse_ranges.view(np.int32)
    for start in range(0, bits.shape[0], BLOCK):
        stop = min(start + BLOCK, bits.shape[0])
        block, block_bits = numbers[: stop - start], bits[start:stop]
        number_cells(rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], grid, block)
        for k in range(block.shape[0]):
            cell = np.uint32(block[k])
            key = (np.int64(block_bits[k]) << 32) | np.int64(_LOW - start - k)
            keys[cell] = max(key, keys[cell])
    keys[0] = 0
    nearest = np.empty(keys.shape[0], np.float32)
    right, down = np.zeros_like(nearest), np.zeros_like(nearest)
    nearest_bits = nearest.view(np.int32)
    for c in range(keys.shape[0]):
        nearest_bits[c] = keys[c] >> 32
    for c in range(keys.shape[0]):
        if nearest_bits[c] > 0:
            holder = np.uint32(_LOW - (keys[c] & _LOW))
            right[c], down[c] = fraction(rightward[holder], grid[0]), fraction(downward[holder], grid[0])
    return nearest, right, down
