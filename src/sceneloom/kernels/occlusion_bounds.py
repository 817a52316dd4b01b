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

_NOTHING, _ONE, _DIAGONAL = np.float32(0.0), np.float32(1.0), np.float32(math.sqrt(0.5) * (1 - 1e-6))


@numba.njit(**INNER)
def _raise_by_places(
    target: Float32Array, source: Float32Array, right: Float32Array, down: Float32Array,
    step_x: Any, step_y: Any, reach_x: Any, reach_y: Any, slope: Any,
) -> None:  # fmt: skip
    """Lift `target` to what `source`, so many steps away, still has within reach at the border of the target's cell.

    The way there is taken as that to the nearest side of an octagon, which is no longer and needs no root.
    """
    sign_x, sign_y = np.float32(np.sign(step_x)), np.float32(np.sign(step_y))
    # Steps to the right: step - 1 whole cells and the part before the point; to the left: the part behind it.
    from_x = abs(step_x) - _SLACK - (_ONE if sign_x > _NOTHING else _NOTHING)
    from_y = abs(step_y) - _SLACK - (_ONE if sign_y > _NOTHING else _NOTHING)
    for i in range(target.shape[0]):
        gap_x, gap_y = max(from_x + sign_x * right[i], _NOTHING), max(from_y + sign_y * down[i], _NOTHING)
        gap = max(gap_x, gap_y, (gap_x + gap_y) * _DIAGONAL)
        value = source[i] - slope * gap
        value = value if (gap_x <= reach_x) & (gap_y <= reach_y) else _NOTHING
        target[i] = max(value, target[i])


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
    reach_x: Any, reach_y: Any,
) -> tuple[Float32Array, Float32Array]:  # fmt: skip
    """Bound for each cell the inverse range of what can hide anything in it.

    Args:
        nearest, right, down: (cells,) float32, as of `direction_grid`.
        columns, border: of the grid.
        slope: what a surface may gain [1/m/cell].
        reach_x, reach_y: how far a single thing hides [cells].

    Returns:
        from_any: (cells,) float32 [1/m], of what hides alone or with another.
        from_opposite: (cells,) float32 [1/m], of what hides with another: the smaller of two opposite quadrants, the
            larger of the two pairs.
    """
    from_any, from_opposite = np.zeros_like(nearest), np.zeros_like(nearest)
    levels, largest = join_squares(nearest, columns, border), np.empty((4, _CHUNK), np.float32)
    margin, size = border * (columns + 1), math.ceil(max(reach_x, reach_y))
    # Rows are taken as one long line: what reaches over their ends meets empty cells only.
    for start in range(margin, nearest.shape[0] - margin, _CHUNK):
        stop = min(start + _CHUNK, nearest.shape[0] - margin)
        bounded = from_any[start:stop]
        _raise_by_squares(levels, columns, size, slope, start, bounded, from_opposite[start:stop], largest)
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                first, last = start + dy * columns + dx, stop + dy * columns + dx
                _raise_by_places(
                    bounded, nearest[first:last], right[first:last], down[first:last],
                    np.float32(dx), np.float32(dy), reach_x, reach_y, slope,
                )  # fmt: skip
    return from_any, from_opposite
