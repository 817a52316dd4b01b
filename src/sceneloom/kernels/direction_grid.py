"""A grid of cells over the directions in which a camera sees points."""

import math
from typing import Any

import numba
import numpy as np

from sceneloom.arrays import Float32Array, Int64Array

INNER: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of the functions that are compiled, and cached, as parts of others."""

MINIMUM_CELL = 1e-3
"""Least size of a cell [rad]: bounds the memory of the grid, whatever the caller asks for."""

_EDGE = 2.1
"""No direction lies farther than this from the axis in the equal-area map."""


@numba.njit(**INNER)
def has_direction(directions: Float32Array, inverse_ranges: Float32Array, i: int) -> bool:
    """Say whether a point takes part at all."""
    return (
        0.0 < inverse_ranges[i] < math.inf and abs(directions[i, 0]) <= _EDGE and abs(directions[i, 1]) <= _EDGE
    )


@numba.njit(**INNER)
def place_in_cells(
    directions: Float32Array, inverse_ranges: Float32Array, cell: float, border: int
) -> tuple[Int64Array, int, int]:
    """Number the cell of each point in the smallest grid that has `border` empty cells all around.

    Args:
        directions: (M, 2) in the equal-area map.
        inverse_ranges: (M,) [1/m].
        cell: size of a cell [rad].
        border: cells.

    Returns:
        cells: (M,) int64, row * columns + column; -1 for a point without direction.
        columns: of the grid, 0 where no point has a direction.
        rows: likewise.
    """
    left, right, top, bottom = math.inf, -math.inf, math.inf, -math.inf
    for i in range(inverse_ranges.shape[0]):
        if has_direction(directions, inverse_ranges, i):
            left, right = min(left, directions[i, 0]), max(right, directions[i, 0])
            top, bottom = min(top, directions[i, 1]), max(bottom, directions[i, 1])
    cells = np.full(inverse_ranges.shape[0], -1, np.int64)
    if left > right:
        return cells, 0, 0
    columns = int(math.floor((right - left) / cell)) + 1 + 2 * border
    rows = int(math.floor((bottom - top) / cell)) + 1 + 2 * border
    for i in range(inverse_ranges.shape[0]):
        if has_direction(directions, inverse_ranges, i):
            column = int(math.floor((directions[i, 0] - left) / cell)) + border
            row = int(math.floor((directions[i, 1] - top) / cell)) + border
            cells[i] = row * columns + column
    return cells, columns, rows
