"""Bounds on what can hide anything in each cell of a grid: they spare most points the search through their cells."""

import math
from typing import Any

import numba
import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.kernels.direction_grid import INNER

_SLACK = np.float32(0.001)
"""Rounding may put a point a hair beyond the border of its cell; cells count as so much nearer to each other."""

_CHUNK = 1024
"""Cells whose bounds are made at once, in the nearest cache."""

_NOTHING, _ONE = np.float32(0.0), np.float32(1.0)


@numba.njit(**INNER)
def _drop_upright(
    dropped: Float32Array, source: Float32Array, down: Float32Array, from_y: Any, sign: Any, reach: Any, slope: Any
) -> None:  # fmt: skip
    """Write what the cells of one row still have at the border of the next row, `from_y + sign * down` away."""
    for i in range(dropped.shape[0]):
        gap = max(from_y + sign * down[i], _NOTHING)
        dropped[i] = source[i] - slope * gap if gap <= reach else _NOTHING


@numba.njit(**INNER)
def _raise_to_three(target: Float32Array, source: Float32Array) -> None:
    """Lift `target` to the largest of the three cells around its location, which lies one farther in `source`."""
    for i in range(target.shape[0]):
        target[i] = max(target[i], source[i], source[i + 1], source[i + 2])


@numba.njit(**INNER)
def _raise_along(
    target: Float32Array, source: Float32Array, right: Float32Array, reach: Any, slope: Any
) -> None:
    """Lift `target` to its own cell, and to what the cells on both sides still have at its border."""
    for i in range(target.shape[0]):
        from_left = max(_ONE - _SLACK - right[i], _NOTHING)
        from_right = max(right[i + 2] - _SLACK, _NOTHING)
        left = source[i] - slope * from_left if from_left <= reach else _NOTHING
        other = source[i + 2] - slope * from_right if from_right <= reach else _NOTHING
        target[i] = max(target[i], source[i + 1], left, other)


@numba.njit(**INNER)
def _raise_by_locations(
    target: Float32Array, start: int, columns: int, nearest: Float32Array, right: Float32Array,
    down: Float32Array, reach_x: Any, reach_y: Any, slope: Any, room: Float32Array,
) -> None:  # fmt: skip
    """Lift the bounds of a run of cells to what hides alone in the same cell or the eight around it.

    What a surface gains on the way is taken along the rows or up and down alone, which is no more than all of it.
    """
    size = target.shape[0] + 2
    first = start - 1
    _raise_along(target, nearest[first : first + size], right[first : first + size], reach_x, slope)
    for first, from_y, sign in (
        (start - 1 - columns, _ONE - _SLACK, -_ONE),
        (start - 1 + columns, -_SLACK, _ONE),
    ):
        _drop_upright(
            room[:size],
            nearest[first : first + size],
            down[first : first + size],
            from_y,
            sign,
            reach_y,
            slope,
        )
        _raise_to_three(target, room[:size])


@numba.njit(**INNER)
def _join_squares(joined: Float32Array, squares: Float32Array, below: Float32Array) -> None:
    """Join the largest of squares of cells to that of squares one wider; `below` begins a row farther down."""
    for i in range(joined.shape[0] - 1):
        joined[i] = max(squares[i], squares[i + 1], below[i], below[i + 1])


@numba.njit(**INNER)
def join_squares(nearest: Float32Array, columns: int, border: int) -> Float32Array:
    """Give the largest inverse range of all squares of cells.

    Returns:
        (border, cells) float32 [1/m]: of the squares of 2, 3, … border + 1 cells a side, right and down of each cell.
    """
    levels = np.empty((border, nearest.shape[0]), np.float32)
    last = nearest
    for k in range(border):
        whole = nearest.shape[0] - columns
        levels[k, whole:] = _NOTHING
        _join_squares(levels[k, :whole], last[:whole], last[columns:])
        levels[k, whole - 1] = _NOTHING
        last = levels[k]
    return levels


@numba.njit(**INNER)
def _raise_to(target: Float32Array, source: Float32Array, drop: Any) -> None:
    """Lift `target` to `source - drop` where that is larger."""
    for i in range(target.shape[0]):
        target[i] = max(source[i] - drop, target[i])


@numba.njit(**INNER)
def _pair(largest: Float32Array, from_opposite: Float32Array) -> None:
    """Write the larger of the smaller of the opposite quadrants."""
    for i in range(from_opposite.shape[0]):
        from_opposite[i] = max(min(largest[0, i], largest[2, i]), min(largest[1, i], largest[3, i]))


@numba.njit(**INNER)
def _raise_by_squares(
    levels: Float32Array, columns: int, size: int, slope: Any, start: int,
    from_any: Float32Array, from_opposite: Float32Array, largest: Float32Array,
) -> None:  # fmt: skip
    """Bound a run of cells from `start` on by the squares around them, less what a surface gains on the way to them.

    A single thing may be `size` cells away; what lies in the next cells is left out of `from_any`.
    """
    count = from_any.shape[0]
    largest[:], from_any[:] = _NOTHING, _NOTHING
    for k in range(1, levels.shape[0] + 1):
        drop, level = slope * max(np.float32(k) - _ONE - _SLACK, _NOTHING), levels[k - 1]
        for quadrant, corner in enumerate((0, -k, -k - k * columns, -k * columns)):
            square = level[start + corner : start + corner + count]
            _raise_to(largest[quadrant, :count], square, drop)
            if 1 < k <= size:
                _raise_to(from_any, square, drop)
    _pair(largest, from_opposite)
    _raise_to(from_any, from_opposite, _NOTHING)


@numba.njit(**INNER)
def bound_hiding(
    nearest: Float32Array, right: Float32Array, down: Float32Array, columns: int, border: int, slope: Any,
    reach_x: Any, reach_y: Any, from_any: Float32Array, from_opposite: Float32Array,
) -> None:  # fmt: skip
    """Bound for each cell of some rows the inverse range of what can hide anything in it.

    Args:
        nearest, right, down: (cells,) float32, as of `direction_grid`, with `border` rows more above and below.
        columns, border: of the grid.
        slope: what a surface may gain [1/m/cell].
        reach_x, reach_y: how far a single thing hides [cells].
        from_any: (cells,) float32 [1/m], written: of what hides alone or with another; the first and the last
            `border` are left.
        from_opposite: (cells,) float32 [1/m], written likewise: of what hides with another: the smaller of two
            opposite quadrants, the larger of the two pairs.
    """
    levels, largest = join_squares(nearest, columns, border), np.empty((4, _CHUNK), np.float32)
    room = np.empty(_CHUNK + 2, np.float32)
    margin, above, size = border * (columns + 1), border * columns, math.ceil(max(reach_x, reach_y))
    # Rows are taken as one long line: what reaches over their ends meets empty cells only.
    for start in range(margin, nearest.shape[0] - margin, _CHUNK):
        stop = min(start + _CHUNK, nearest.shape[0] - margin)
        bounded, opposite = (
            from_any[start - above : stop - above],
            from_opposite[start - above : stop - above],
        )
        _raise_by_squares(levels, columns, size, slope, start, bounded, opposite, largest)
        _raise_by_locations(bounded, start, columns, nearest, right, down, reach_x, reach_y, slope, room)
