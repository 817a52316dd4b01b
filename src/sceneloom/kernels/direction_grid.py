"""A grid of cells over the directions in which a camera sees points."""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, int32, int64

from sceneloom.arrays import AnyArray, Float32Array

INNER: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of the functions that are compiled, and cached, as parts of others."""

_EDGE = float32(2.1)
"""No direction lies farther than this from the axis in the equal-area map."""

_LOW = 0x7FFFFFFF


@numba.njit(**INNER)
def _bound_directions(directions: Float32Array) -> tuple[Any, Any, Any, Any]:
    """Give left, right, top and bottom of the directions inside the map; NaN has no say."""
    left, right, top, bottom = _EDGE, -_EDGE, _EDGE, -_EDGE
    for i in range(directions.shape[0]):
        a, b = directions[i, 0], directions[i, 1]
        left = min(left, a)
        right = max(right, a)
        top = min(top, b)
        bottom = max(bottom, b)
    return max(left, -_EDGE), min(right, _EDGE), max(top, -_EDGE), min(bottom, _EDGE)


@numba.njit(**INNER)
def place_in_cells(
    directions: Float32Array, inverse_ranges: Float32Array, cell: float, border: int
) -> tuple[AnyArray, int, int]:
    """Number the cell of each point in the smallest grid that has `border` empty cells all around.

    Args:
        directions: (M, 2) in the equal-area map.
        inverse_ranges: (M,) [1/m]; only points between zero and infinity are placed.
        cell: size of a cell [rad].
        border: cells.

    Returns:
        cells: (M,) int32, row * columns + column; -1 for a point that is not placed.
        columns, rows: of the grid, border included.
    """
    left, right, top, bottom = _bound_directions(directions)
    cells = np.empty(inverse_ranges.shape[0], np.int32)
    per_cell = float32(1.0 / cell)
    columns = int64((max(right, left) - left) * per_cell) + 1 + 2 * border
    rows = int64((max(bottom, top) - top) * per_cell) + 1 + 2 * border
    for i in range(inverse_ranges.shape[0]):
        a, b = directions[i, 0], directions[i, 1]
        if 0.0 < inverse_ranges[i] < math.inf and left <= a <= right and top <= b <= bottom:
            row, column = int32((b - top) * per_cell) + border, int32((a - left) * per_cell) + border
            cells[i] = row * columns + column
        else:
            cells[i] = -1
    return cells, columns, rows


@numba.njit(**INNER)
def keep_nearest(
    directions: Float32Array, inverse_ranges: Float32Array, cells: AnyArray, count: int
) -> tuple[Float32Array, Float32Array]:
    """Keep the nearest point of each cell, the first of equally near ones.

    Returns:
        nearest: (count,) float32 [1/m], its inverse range, 0 where the cell is empty.
        places: (count, 2) float32, its direction.
    """
    # The bits of positive floats are ordered as the floats are, so range and number fit one integer, whose maximum
    # is taken without a branch.
    keys = np.zeros(count, np.int64)
    bits = inverse_ranges.view(np.int32)
    for i in range(cells.shape[0]):
        if cells[i] >= 0:
            key, largest = (int64(bits[i]) << 32) | (_LOW - i), keys[cells[i]]
            keys[cells[i]] = max(largest, key)
    nearest, places = np.zeros(count, np.float32), np.zeros((count, 2), np.float32)
    for c in range(count):
        if keys[c] > 0:
            holder = _LOW - (keys[c] & _LOW)
            nearest[c] = inverse_ranges[holder]
            places[c, 0], places[c, 1] = directions[holder, 0], directions[holder, 1]
    return nearest, places
