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
_PARTS, _LAST_PART = np.float32(65536.0), np.int32(0xFFFF)
_PART = np.float32(1.0 / 65536.0)
"""How finely the place in a cell is kept: float32 knows it no better, but at the far edge of the map."""


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
def _number(column: Any, row: Any, grid: tuple[Any, Any, Any, int, int]) -> Any:
    """Give the number of a cell; in 32 bits at each step, as Numba would go on in 64, of which vectors hold half."""
    _, first_column, first_row, columns, _ = grid
    before = np.int32(np.int32(row - first_row) * np.int32(columns))
    return np.int32(before + np.int32(column - first_column))


@numba.njit(**INNER)
def span(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, per_cell: Any
) -> tuple[Any, Any, Any, Any]:
    """Give the first and the last column and row in which a point lies, counted from the edge of the map.

    Where no point takes part, the first is 2^30 and the last -1.
    """
    left, right, top, bottom = _FAR, _NONE, _FAR, _NONE
    for i in range(inverse_ranges.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        column, row = _step(a, placed, per_cell), _step(b, placed, per_cell)
        left, right = min(left, column if placed else _FAR), max(right, column if placed else _NONE)
        top, bottom = min(top, row if placed else _FAR), max(bottom, row if placed else _NONE)
    return left, right, top, bottom


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
    left, right, top, bottom = span(directions[0], directions[1], inverse_ranges, per_cell)
    columns, rows = max(int(right - left), 0) + 1 + 2 * border, max(int(bottom - top), 0) + 1 + 2 * border
    return per_cell, np.int32(left - border), np.int32(top - border), columns, rows


@numba.njit(**INNER)
def number_cells(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, int32 row * columns + column; 0, where no other point is, if it takes no part."""
    per_cell = grid[0]
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        number = _number(_step(a, placed, per_cell), _step(b, placed, per_cell), grid)
        numbers[i] = number if placed else np.int32(0)


@numba.njit(**INNER)
def _rank(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, counting: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, as `number_cells`, and its key: inverse range, then how far right and down in the cell.

    The bits of positive floats are ordered as the floats are, so all fits one integer, whose maximum is that of the
    nearest point. Of equally near ones it is the one farther right.
    """
    per_cell, bits = grid[0], counting.view(np.int32)
    for i in range(numbers.shape[0]):
        a, b = rightward[i], downward[i]
        placed = _is_placed(a, b, inverse_ranges[i])
        steps_a = (a if placed else _NOTHING) * per_cell + _EDGE * per_cell
        steps_b = (b if placed else _NOTHING) * per_cell + _EDGE * per_cell
        column, row = np.int32(steps_a), np.int32(steps_b)
        right = np.int32((steps_a - np.float32(column)) * _PARTS)
        down = np.int32((steps_b - np.float32(row)) * _PARTS)
        number = _number(column, row, grid)
        numbers[i] = number if placed else np.int32(0)
        keys[i] = (np.int64(bits[i]) << 32) | (np.int64(right) << 16) | np.int64(down)


@numba.njit(**INNER)
def keep_nearest(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, counting: Float32Array,
    grid: tuple[Any, Any, Any, int, int], numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Write each point's cell, and raise the key of each cell to that of its nearest point.

    Args:
        rightward, downward, inverse_ranges: (M,) float32, as of `fit_grid`.
        counting: (M,) float32 [1/m], by what they count as near; 0 for a point that is nearer than none.
        grid: what `fit_grid` gives.
        numbers: (M,) int32, written; 0, where no point is, for a point that takes no part.
        keys: (cells,) int64, raised.
    """
    block_keys = np.empty(BLOCK, np.int64)
    for start in range(0, numbers.shape[0], BLOCK):
        stop = min(start + BLOCK, numbers.shape[0])
        block = numbers[start:stop]
        _rank(
            rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], counting[start:stop], grid,
            block, block_keys,
        )  # fmt: skip
        for k in range(block.shape[0]):
            cell = np.uint32(block[k])
            keys[cell] = max(block_keys[k], keys[cell])


@numba.njit(**INNER)
def read_keys(keys: AnyArray, nearest: Float32Array, right: Float32Array, down: Float32Array) -> None:
    """Take keys apart.

    Args:
        keys: (cells,) int64.
        nearest: (cells,) float32 [1/m], written: inverse range of the nearest point, 0 where the cell is empty.
        right, down: (cells,) float32, written: how far into the cell it lies, 0 to 1.
    """
    nearest_bits = nearest.view(np.int32)
    for c in range(keys.shape[0]):
        nearest_bits[c] = np.int32(keys[c] >> 32)
        right[c] = np.float32(np.int32(keys[c] >> 16) & _LAST_PART) * _PART
        down[c] = np.float32(np.int32(keys[c]) & _LAST_PART) * _PART
