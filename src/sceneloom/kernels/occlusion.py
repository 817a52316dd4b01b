"""Which points of a sparse cloud nearer points hide from a camera; `colouring.visibility` derives the rule."""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, float64, int64, types, void

from sceneloom.arrays import BoolArray, Float32Array, Int64Array
from sceneloom.kernels.direction_grid import INNER, keep_nearest, place_in_cells

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_SLACK = 0.999
"""Rounding may put a point a hair beyond the border of its cell; cells count as so much nearer to each other."""

_NOTHING, _ONE, _QUARTER, _BEHIND = float32(0.0), float32(1.0), float32(0.25), float32(1e-3)


@numba.njit(**INNER)
def _list_cells(radius: float, cell: float, columns: int) -> tuple[Int64Array, Float32Array, Int64Array]:
    """List the cells that hold anything within a radius of a point of the middle cell.

    Returns:
        offsets: (K,) int64, added to a cell's number.
        clearances: (K,) float32 [rad], least distance between a point there and one of the middle cell.
        quadrants: (K,) int64, the bits of the quadrants (see `_search_window`) in which a point there can be.
    """
    border = int64(math.ceil(radius / cell))
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
            clearance = cell * _SLACK * math.sqrt(float64(gap_x * gap_x + gap_y * gap_y))
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
) -> Float32Array:
    """Bound for each cell the inverse range that hides from opposite sides what lies in it.

    Each quadrant takes the largest inverse range in it, less what a surface gains on the way; of two opposite
    quadrants the smaller counts, of the two pairs the larger.
    """
    offsets, clearances, quadrants = cells
    bound = np.zeros_like(nearest)
    width = columns - 2 * border
    rows = np.empty((4, width), np.float32)
    for row in range(border, nearest.shape[0] // columns - border):
        start = row * columns + border
        rows[:] = _NOTHING
        for k in range(offsets.shape[0]):
            source = nearest[start + offsets[k] : start + offsets[k] + width]
            for quadrant in range(4):
                if quadrants[k] >> quadrant & 1:
                    _raise_to(rows[quadrant], source, float32(slope * clearances[k]))
        for i in range(width):
            bound[start + i] = max(min(rows[0, i], rows[2, i]), min(rows[1, i], rows[3, i]))
    return bound


@numba.njit(**INNER)
def _bound_near(nearest: Float32Array, columns: int, border: int, offsets: Int64Array) -> Float32Array:
    """Bound for each cell the inverse range of anything that is very near to a point in it."""
    bound = np.zeros_like(nearest)
    width = columns - 2 * border
    for row in range(border, nearest.shape[0] // columns - border):
        start = row * columns + border
        for k in range(offsets.shape[0]):
            first = start + offsets[k]
            _raise_to(bound[start : start + width], nearest[first : first + width], _NOTHING)
    return bound


@numba.njit(**INNER)
def _hides(excess: Any, squared: Any, limit_squared: Any, slope_squared: Any) -> Any:
    """Say whether something hides: nearer by an excess that no surface gains over so short a distance."""
    return (excess > _NOTHING) & (squared <= limit_squared) & (excess * excess > slope_squared * squared)


@numba.njit(**INNER)
def _search_near(
    a: float, b: float, cell: int, threshold: float, nearest: Float32Array, places: Float32Array,
    offsets: Int64Array, near_squared: float, slope_squared: float,
) -> bool:  # fmt: skip
    """Say whether anything very near to direction (a, b) hides what lies there."""
    hidden = False
    # Without branches: whether a cell hides cannot be predicted, and a wrong guess costs more than the sums.
    for k in range(offsets.shape[0]):
        c = cell + offsets[k]
        x, y = places[c, 0] - a, places[c, 1] - b
        hidden |= _hides(nearest[c] - threshold, x * x + y * y, near_squared, slope_squared)
    return hidden


@numba.njit(**INNER)
def _search_window(
    a: float, b: float, cell: int, threshold: float, nearest: Float32Array, places: Float32Array,
    offsets: Int64Array, window_squared: float, slope_squared: float,
) -> bool:  # fmt: skip
    """Say whether things in opposite quadrants around direction (a, b) hide what lies there.

    Each quadrant holds one of its two borders, so that opposite steps fall into opposite quadrants.
    """
    first = second = third = fourth = False
    for k in range(offsets.shape[0]):
        c = cell + offsets[k]
        x, y = places[c, 0] - a, places[c, 1] - b
        hides = _hides(nearest[c] - threshold, x * x + y * y, window_squared, slope_squared)
        first |= hides & (x > _NOTHING) & (y >= _NOTHING)
        second |= hides & (x <= _NOTHING) & (y > _NOTHING)
        third |= hides & (x < _NOTHING) & (y <= _NOTHING)
        fourth |= hides & (x >= _NOTHING) & (y < _NOTHING)
    return (first & third) | (second & fourth)


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
        directions: (M, 2) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; a point with 0 takes no part and is not visible.
        cell: size of a cell [rad], at least 0.001, which bounds the memory.
        window: within it two things on opposite sides of a point hide it [rad].
        near: within it a single thing hides [rad], at most `window`.
        slope: largest gradient of the inverse range on a surface that does not hide itself [1/m/rad].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        visible: (M,), written.
    """
    border = int64(math.ceil(window / cell))
    cells, columns, rows = place_in_cells(directions, inverse_ranges, cell, border)
    nearest, places = keep_nearest(directions, inverse_ranges, cells, columns * rows)
    around = _list_cells(window, cell, columns)
    beside = _list_cells(min(near, window), cell, columns)[0]
    from_opposite = _bound_hiding(nearest, columns, border, around, slope)
    from_near = _bound_near(nearest, columns, border, beside)
    window_squared, near_squared = float32(window * window), float32(min(near, window) ** 2)
    absolute, share = float32(margin), float32(margin_share)
    for i in range(cells.shape[0]):
        c = cells[i]
        visible[i] = c >= 0
        if c < 0:
            continue
        inverse = inverse_ranges[i]
        threshold = inverse + absolute * inverse * inverse + share * inverse
        is_near, is_between = from_near[c] > threshold, from_opposite[c] > threshold
        if is_near or is_between:
            a, b = directions[i, 0], directions[i, 1]
            slope_squared = float32(slope * slope) / max(_ONE - _QUARTER * (a * a + b * b), _BEHIND)
            visible[i] = not (
                (
                    is_near
                    and _search_near(a, b, c, threshold, nearest, places, beside, near_squared, slope_squared)
                )
                or (
                    is_between
                    and _search_window(
                        a, b, c, threshold, nearest, places, around[0], window_squared, slope_squared
                    )
                )
            )
