"""A grid of cells over the directions in which a camera sees points."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int64, types, void

from sceneloom.arrays import AnyArray, Float32Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

INNER: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of the functions that are compiled, and cached, as parts of others."""

BLOCK = 512
"""Points whose cells are numbered at once, by vector instructions."""

_EDGE = np.float32(2.1)
"""No direction lies farther than this from the axis in the equal-area map."""
_NOTHING, _STATIC = np.float32(0.0), np.float32(math.inf)
_LEAST, _GREATEST, _SIGN = np.int32(-(2**31)), np.int32(2**31 - 1), np.int32(31)
_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_PARTS, _LAST_PART = np.float32(65536.0), np.int32(0xFFFF)
_PART = np.float32(1.0 / 65536.0)
"""How finely the location in a cell is kept: float32 knows it no better, but at the far edge of the map."""


@numba.njit(**INNER)
def _is_placed(a: Any, b: Any, inverse_range: Any) -> Any:
    """Report whether a point takes part; NaN does not."""
    return (inverse_range > _NOTHING) & (inverse_range < _STATIC) & (abs(a) <= _EDGE) & (abs(b) <= _EDGE)


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
def _order(bits: Any) -> Any:
    """Rotate the bits of a float into an integer that is ordered as the floats are, and back."""
    return np.int32(bits ^ np.int32(np.int32(bits >> _SIGN) & _GREATEST))


@kernel(void(_IN_F32_1D, _IN_F32_1D, _IN_F32_1D, float32[::1]), cache=True, nogil=True, error_model="numpy")
def _measure_extent(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, extent: Float32Array
) -> None:
    """Write the extent of some points; by integers, since vectors find no least of floats that may be NaN."""
    a_bits, b_bits, found = rightward.view(np.int32), downward.view(np.int32), extent.view(np.int32)
    left, right, top, bottom = _GREATEST, _LEAST, _GREATEST, _LEAST
    for i in range(inverse_ranges.shape[0]):
        placed = _is_placed(rightward[i], downward[i], inverse_ranges[i])
        a, b = _order(a_bits[i]), _order(b_bits[i])
        left, right = min(left, a if placed else _GREATEST), max(right, a if placed else _LEAST)
        top, bottom = min(top, b if placed else _GREATEST), max(bottom, b if placed else _LEAST)
    if left <= right:
        found[0], found[1], found[2], found[3] = _order(left), _order(right), _order(top), _order(bottom)
    else:
        extent[0] = extent[2] = _STATIC
        extent[1] = extent[3] = -_STATIC


def measure_extent(
    directions: Float32Array, inverse_ranges: Float32Array, *, thread_pool: ThreadPool = ALONE
) -> Float32Array:
    """Give how far points reach in the equal-area map.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; only points between zero and infinity take part.
        thread_pool: the threads that share the points.

    Returns:
        (4,) float32 [rad]: the least and the greatest rightward, the least and the greatest downward; infinity and
        minus infinity where no point takes part.
    """
    found = np.empty((thread_pool.size, 4), np.float32)

    def measure(part: int, a: int, b: int) -> None:
        _measure_extent(directions[0, a:b], directions[1, a:b], inverse_ranges[a:b], found[part])

    thread_pool.share(len(inverse_ranges), measure)
    extent: Float32Array = found.min(axis=0)
    extent[1::2] = found[:, 1::2].max(axis=0)
    return extent


@numba.njit(**INNER)
def fit_grid(extent: Float32Array, cell: float, border: int) -> tuple[Any, Any, Any, int, int]:
    """Fit the smallest grid around some points that has `border` empty cells on each side.

    Args:
        extent: what `measure_extent` gives for them.
        cell: size of a cell [rad].
        border: cells, at least 1.

    Returns:
        per_cell: 1 / cell.
        first_column, first_row: of the grid, counted from the edge of the map.
        columns, rows: of the grid, border included.
    """
    per_cell, some = np.float32(1.0 / cell), extent[0] <= extent[1]
    left, right = _step(extent[0], some, per_cell), _step(extent[1], some, per_cell)
    top, bottom = _step(extent[2], some, per_cell), _step(extent[3], some, per_cell)
    columns, rows = int(right - left) + 1 + 2 * border, int(bottom - top) + 1 + 2 * border
    return per_cell, np.int32(left - border), np.int32(top - border), columns, rows


@kernel(void(_IN_F32_1D, float64, int64, int64[::1]), cache=True, nogil=True, error_model="numpy")
def _position_grid(extent: Float32Array, cell: float, border: int, grid: AnyArray) -> None:
    _, grid[0], grid[1], grid[2], grid[3] = fit_grid(extent, cell, border)


def position_grid(extent: Float32Array, cell: float, border: int) -> list[int]:
    """Give what `fit_grid` gives but for the first: first column and row, columns and rows."""
    grid = np.empty(4, np.int64)
    _position_grid(extent, cell, border, grid)
    first_and_sizes: list[int] = grid.tolist()
    return first_and_sizes


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
        rightward, downward, inverse_ranges: (M,) float32, as of `measure_extent`.
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
