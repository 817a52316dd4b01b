"""Which points of a sparse cloud nearer points hide from a camera; `colouring.visibility` derives the rule."""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, float64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Int64Array
from sceneloom.kernels.direction_grid import BLOCK, INNER, fit_grid, keep_nearest, number_cells

INLINED = {**INNER, "inline": "always"}
"""Options of what is called point by point: a call would count references to every array it is given."""

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_SLACK = 0.999
"""Rounding may put a point a hair beyond the border of its cell; cells count as so much nearer to each other."""

_CHUNK = 4096
"""Cells whose bounds are made at once, in the nearest cache."""

_NOTHING, _ONE, _QUARTER, _BEHIND = float32(0.0), float32(1.0), float32(0.25), float32(1e-3)


@numba.njit(**INNER)
def _list_cells(radius: float, cell: float, columns: int) -> tuple[Int64Array, Float32Array, Int64Array]:
    """List the cells that hold anything within a radius of a point of the middle cell.

    Returns:
        offsets: (K,) int64, added to a cell's number.
        clearances: (K,) float32 [rad], least distance between a point there and one of the middle cell.
        quadrants: (K,) int64, the bits of the quadrants (see `_search_window`) in which a point there can be.
    """
    border = np.int64(math.ceil(radius / cell))
    size = (2 * border + 1) ** 2
    offsets, clearances, quadrants = (
        np.empty(size, np.int64),
        np.empty(size, np.float32),
        np.empty(size, np.int64),
    )
    count = 0
    for dy in range(-border, border + 1):
        for dx in range(-border, border + 1):
            gap_x, gap_y = max(abs(dx) - 1, 0), max(abs(dy) - 1, 0)
            clearance = cell * _SLACK * math.sqrt(np.float64(gap_x * gap_x + gap_y * gap_y))
            if clearance <= radius:
                offsets[count], clearances[count] = dy * columns + dx, clearance
                quadrants[count] = (
                    (dx >= 0 and dy >= 0) * 1
                    + (dx <= 0 and dy >= 0) * 2
                    + (dx <= 0 and dy <= 0) * 4
                    + (dx >= 0 and dy <= 0) * 8
                )
                count += 1
    return offsets[:count], clearances[:count], quadrants[:count]


@numba.njit(**INNER)
def _raise_to(target: Float32Array, source: Float32Array, drop: float) -> None:
    """Lift `target` to `source - drop` where that is larger."""
    for i in range(target.shape[0]):
        value, largest = source[i] - drop, target[i]
        target[i] = max(largest, value)


@numba.njit(**INNER)
def _bound_hiding(
    nearest: Float32Array,
    columns: int,
    border: int,
    cells: tuple[Int64Array, Float32Array, Int64Array],
    slope: float,
) -> tuple[Float32Array, Float32Array]:
    """Bound for each cell the inverse range of what can hide anything in it.

    Returns:
        from_near: (cells,) float32 [1/m], the largest inverse range in it and the eight around it.
        from_opposite: (cells,) float32 [1/m]. Each quadrant takes the largest inverse range in it, less what a
            surface gains on the way; of two opposite quadrants the smaller counts, of the two pairs the larger.
    """
    offsets, clearances, quadrants = cells
    from_near, from_opposite = np.zeros_like(nearest), np.zeros_like(nearest)
    largest = np.empty((4, _CHUNK), np.float32)
    margin = border * (columns + 1)
    # Rows are taken as one long line: what reaches over their ends meets empty cells only.
    for start in range(margin, nearest.shape[0] - margin, _CHUNK):
        size = min(_CHUNK, nearest.shape[0] - margin - start)
        largest[:] = _NOTHING
        for k in range(offsets.shape[0]):
            first = start + offsets[k]
            for quadrant in range(4):
                if quadrants[k] >> quadrant & 1:
                    drop = np.float32(slope * clearances[k])
                    _raise_to(largest[quadrant, :size], nearest[first : first + size], drop)
        _pair(largest, from_opposite[start : start + size])
        for step in (-columns, 0, columns):
            for first in range(start + step - 1, start + step + 2):
                _raise_to(from_near[start : start + size], nearest[first : first + size], _NOTHING)
    return from_near, from_opposite


@numba.njit(**INNER)
def _pair(largest: Float32Array, from_opposite: Float32Array) -> None:
    """Write the larger of the smaller of the opposite quadrants."""
    for i in range(from_opposite.shape[0]):
        from_opposite[i] = max(min(largest[0, i], largest[2, i]), min(largest[1, i], largest[3, i]))


@numba.njit(**INLINED)
def _hides(excess: Any, squared: Any, limit_squared: Any, slope_squared: Any) -> Any:
    """Say whether something hides: nearer by an excess that no surface gains over so short a distance."""
    return (excess > _NOTHING) & (squared <= limit_squared) & (excess * excess > slope_squared * squared)


@numba.njit(**INLINED)
def _search_near(
    a: float, b: float, cell: int, columns: int, threshold: float, nearest: Float32Array, places: Float32Array,
    near_squared: float, slope_squared: float,
) -> bool:  # fmt: skip
    """Say whether anything very near to direction (a, b) hides what lies there."""
    hidden = False
    # Without branches: whether a cell hides cannot be predicted, and a wrong guess costs more than the sums.
    for row in range(3):
        first = np.uint32(cell + row * columns - columns - 1)
        for k in range(3):
            c = np.uint32(first + np.uint32(k))
            x, y = places[c, 0] - a, places[c, 1] - b
            hidden |= _hides(nearest[c] - threshold, x * x + y * y, near_squared, slope_squared)
    return hidden


@numba.njit(**INLINED)
def _search_window(
    a: float, b: float, cell: int, threshold: float, nearest: Float32Array, places: Float32Array,
    offsets: Int64Array, window_squared: float, slope_squared: float,
) -> bool:  # fmt: skip
    """Say whether things in opposite quadrants around direction (a, b) hide what lies there.

    Each quadrant holds one of its two borders, so that opposite steps fall into opposite quadrants.
    """
    first = second = third = fourth = False
    for k in range(offsets.shape[0]):
        c = np.uint32(cell + offsets[k])
        x, y = places[c, 0] - a, places[c, 1] - b
        hides = _hides(nearest[c] - threshold, x * x + y * y, window_squared, slope_squared)
        first |= hides & (x > _NOTHING) & (y >= _NOTHING)
        second |= hides & (x <= _NOTHING) & (y > _NOTHING)
        third |= hides & (x < _NOTHING) & (y <= _NOTHING)
        fourth |= hides & (x >= _NOTHING) & (y < _NOTHING)
    return (first & third) | (second & fourth)


@numba.njit(**INNER)
def _decide(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, cells: AnyArray,
    nearest: Float32Array, places: Float32Array, from_near: Float32Array, from_opposite: Float32Array,
    columns: int, offsets: Int64Array, limits: tuple[Any, ...], visible: BoolArray,
) -> None:  # fmt: skip
    """Write which points of a block are not hidden; most of them only need the two bounds of their cells."""
    window_squared, near_squared, steepest, margin, margin_share = limits
    for i in range(cells.shape[0]):
        c, inverse = np.uint32(cells[i]), inverse_ranges[i]
        visible[i] = c > 0
        threshold = inverse + margin * inverse * inverse + margin_share * inverse
        is_near, is_between = from_near[c] > threshold, from_opposite[c] > threshold
        if not ((is_near or is_between) and c > 0):
            continue
        a, b = rightward[i], downward[i]
        slope_squared = steepest / max(_ONE - _QUARTER * (a * a + b * b), _BEHIND)
        if is_near and _search_near(
            a, b, c, columns, threshold, nearest, places, near_squared, slope_squared
        ):
            visible[i] = False
        elif is_between:
            visible[i] = not _search_window(
                a, b, c, threshold, nearest, places, offsets, window_squared, slope_squared
            )


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, float64, float64, float64, float64, float64, float64, boolean[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def mark_unhidden(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    cell: float,
    window: float,
    near: float,
    slope: float,
    margin: float,
    margin_share: float,
    visible: BoolArray,
) -> None:
    """Write which points no nearer points hide.

    Only the nearest point of each cell can hide others. Two bounds per cell let most points pass with one read each.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; a point with 0 takes no part and is not visible.
        cell: size of a cell [rad], at least `near`, and at least 0.001, which bounds the memory.
        window: within it two things on opposite sides of a point hide it [rad].
        near: within it a single thing hides [rad].
        slope: largest gradient of the inverse range on a surface that does not hide itself [1/m/rad].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        visible: (M,), written.
    """
    border = math.ceil(window / cell)
    grid = fit_grid(directions, inverse_ranges, cell, border)
    nearest, places = keep_nearest(directions, inverse_ranges, grid)
    around = _list_cells(window, cell, grid[3])
    from_near, from_opposite = _bound_hiding(nearest, grid[3], border, around, slope)
    limits = (
        np.float32(window * window),
        np.float32(near * near),
        np.float32(slope * slope),
        np.float32(margin),
        np.float32(margin_share),
    )
    rightward, downward, numbers = directions[0], directions[1], np.empty(BLOCK, np.int32)
    for start in range(0, inverse_ranges.shape[0], BLOCK):
        stop = min(start + BLOCK, inverse_ranges.shape[0])
        a, b, inverse, block = (
            rightward[start:stop],
            downward[start:stop],
            inverse_ranges[start:stop],
            numbers[: stop - start],
        )
        number_cells(a, b, inverse, grid, block)
        _decide(
            a, b, inverse, block, nearest, places, from_near, from_opposite, grid[3], around[0], limits,
            visible[start:stop],
        )  # fmt: skip
