"""Which points of a sparse cloud nearer points hide from a camera; `colouring.visibility` derives the rule."""

import math

import numba
import numpy as np
from numba import boolean, float32, float64, types, void

from sceneloom.arrays import BoolArray, Float32Array, Int64Array
from sceneloom.kernels.direction_grid import INNER, MINIMUM_CELL, place_in_cells

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

CELLS_PER_WINDOW = 3
"""Cells along half a window. Each cell keeps its nearest point only: with 3 the decisions on simulated streets are
those of a search over all points, with 2 one hidden point in a hundred is lost."""

_ROUNDING = 1.0 + 1e-6
"""Keeps the bound in float32 above the exact one."""

_OPPOSITE_02, _OPPOSITE_13 = 0b0101, 0b1010
"""Pairs of opposite quadrants, as bits."""


@numba.njit(**INNER)
def _keep_nearest(inverse_ranges: Float32Array, cells: Int64Array, count: int) -> tuple[Float32Array, Int64Array]:
    """Give the largest inverse range of each cell, 0 where it is empty, and the point that has it, the first of equals."""
    nearest = np.zeros(count, np.float32)
    holders = np.empty(count, np.int64)
    for i in range(cells.shape[0]):
        c = cells[i]
        if c >= 0 and inverse_ranges[i] > nearest[c]:
            nearest[c] = inverse_ranges[i]
            holders[c] = i
    return nearest, holders


@numba.njit(**INNER)
def _list_window(border: int, cell: float, columns: int) -> tuple[Int64Array, Float32Array]:
    """List the cells that a window of `border` cells around a point of the middle cell can touch, nearest first.

    Returns:
        offsets: (K,) int64, added to a cell's number; the first is 0.
        clearances: (K,) float32 [rad], least distance between a point there and one of the middle cell.
    """
    side = 2 * border + 1
    offsets, clearances = np.empty(side * side, np.int64), np.empty(side * side, np.float32)
    distances = np.empty(side * side, np.int64)
    count = 0
    for dy in range(-border, border + 1):
        for dx in range(-border, border + 1):
            gap_x, gap_y = max(abs(dx) - 1, 0), max(abs(dy) - 1, 0)
            if gap_x * gap_x + gap_y * gap_y <= border * border:
                offsets[count], distances[count] = dy * columns + dx, dx * dx + dy * dy
                clearances[count] = cell * math.sqrt(gap_x * gap_x + gap_y * gap_y)
                count += 1
    nearest_first = np.argsort(distances[:count], kind="mergesort")
    return offsets[:count][nearest_first], clearances[:count][nearest_first]


@numba.njit(**INNER)
def _spread_cones(
    nearest: Float32Array, columns: int, border: int, offsets: Int64Array, clearances: Float32Array, slope: float
) -> Float32Array:
    """Bound for each cell what hides anything in it: the largest inverse range around, less the slope on the way."""
    bound = np.zeros_like(nearest)
    width = columns - 2 * border
    for row in range(border, nearest.shape[0] // columns - border):
        start = row * columns + border
        target = bound[start : start + width]
        for k in range(offsets.shape[0]):
            source = nearest[start + offsets[k] : start + offsets[k] + width]
            drop = float32(slope * clearances[k])
            for i in range(width):
                value, largest = source[i] - drop, target[i]
                target[i] = value if value > largest else largest
    return bound


@numba.njit(**INNER)
def _quadrant(rightward: float, downward: float) -> int:
    """Give the bit of a quadrant; each holds one of its two borders, so that opposite steps fall into opposite ones."""
    if rightward > 0.0:
        return 1 if downward >= 0.0 else 8
    if downward > 0.0:
        return 2
    return 4 if rightward < 0.0 else 8


@numba.njit(**INNER)
def _is_hidden(
    i: int, cell: int, threshold: float, directions: Float32Array, nearest: Float32Array, holders: Int64Array,
    offsets: Int64Array, window: float, near: float, slope: float,
) -> bool:  # fmt: skip
    """Look at the nearest points of the cells around one point: one very near, or two on opposite sides, hide it."""
    a, b = float64(directions[i, 0]), float64(directions[i, 1])
    slope_squared = slope * slope / max(1.0 - 0.25 * (a * a + b * b), 1e-3)
    quadrants = 0
    for k in range(offsets.shape[0]):
        excess = nearest[cell + offsets[k]] - threshold
        if excess <= 0.0:
            continue
        j = holders[cell + offsets[k]]
        rightward, downward = directions[j, 0] - a, directions[j, 1] - b
        squared = rightward * rightward + downward * downward
        if squared > window * window or excess * excess <= slope_squared * squared:
            continue
        if squared <= near * near:
            return True
        quadrants |= _quadrant(rightward, downward)
        if quadrants & _OPPOSITE_02 == _OPPOSITE_02 or quadrants & _OPPOSITE_13 == _OPPOSITE_13:
            return True
    return False


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, float64, float64, float64, float64, float64, boolean[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def mark_unhidden(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    window: float,
    near: float,
    slope: float,
    margin: float,
    margin_share: float,
    visible: BoolArray,
) -> None:
    """Write which points no nearer points hide.

    Args:
        directions: (M, 2) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; a point with 0 takes no part and is not visible.
        window: farthest direction in which something can hide a point [rad].
        near: within it a single point hides [rad].
        slope: largest gradient of the inverse range on a surface that does not hide itself [1/m/rad].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        visible: (M,), written.
    """
    cell = max(window / CELLS_PER_WINDOW, MINIMUM_CELL)
    border = int(math.ceil(window / cell - 1e-9))
    cells, columns, rows = place_in_cells(directions, inverse_ranges, cell, border)
    nearest, holders = _keep_nearest(inverse_ranges, cells, columns * rows)
    offsets, clearances = _list_window(border, cell, columns)
    bound = _spread_cones(nearest, columns, border, offsets, clearances, slope)
    for i in range(cells.shape[0]):
        c = cells[i]
        if c < 0:
            visible[i] = False
            continue
        inverse = float64(inverse_ranges[i])
        threshold = inverse + margin * inverse * inverse + margin_share * inverse
        visible[i] = _ROUNDING * bound[c] <= threshold or not _is_hidden(
            i, c, threshold, directions, nearest, holders, offsets, window, near, slope
        )
