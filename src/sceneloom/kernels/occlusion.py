"""Which points of a sparse cloud nearer points hide from a camera; `colouring.visibility` derives the rule."""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, float64, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.kernels.direction_grid import BLOCK, INNER, fit_grid, fraction, keep_nearest, number_cells

INLINED = {**INNER, "inline": "always"}
"""Options of what is called point by point: a call would count references to every array it is given."""

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)
_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_SLACK = np.float32(0.001)
"""Rounding may put a point a hair beyond the border of its cell; cells count as so much nearer to each other."""

_CHUNK = 4096
"""Cells whose bounds are made at once, in the nearest cache."""

_NOTHING, _ONE, _QUARTER, _BEHIND = np.float32(0.0), np.float32(1.0), np.float32(0.25), np.float32(1e-3)


@numba.njit(**INNER)
def _list_cells(
    reach_x: float, reach_y: float, radius: float, columns: int
) -> tuple[Int64Array, Float32Array, Float32Array, Int64Array]:
    """List the cells that hold anything near to a point of the middle cell; lengths are in cells.

    Args:
        reach_x, reach_y: how far to the right or left, and up or down, it may be.
        radius: how far in all.
        columns: of the grid.

    Returns:
        offsets: (K,) int64, added to a cell's number.
        right, down: (K,) float32, the same as columns and rows.
        quadrants: (K,) int64, the bits of the quadrants (see `_search_window`) in which a point there can be.
    """
    border = math.ceil(max(reach_x, reach_y))
    size = (2 * border + 1) ** 2
    offsets, quadrants = np.empty(size, np.int64), np.empty(size, np.int64)
    right, down = np.empty(size, np.float32), np.empty(size, np.float32)
    count = 0
    for dy in range(-border, border + 1):
        for dx in range(-border, border + 1):
            gap_x, gap_y = _gap(dx), _gap(dy)
            if gap_x <= reach_x and gap_y <= reach_y and math.sqrt(gap_x * gap_x + gap_y * gap_y) <= radius:
                offsets[count], right[count], down[count] = dy * columns + dx, dx, dy
                quadrants[count] = (
                    (dx >= 0 and dy >= 0) * 1
                    + (dx <= 0 and dy >= 0) * 2
                    + (dx <= 0 and dy <= 0) * 4
                    + (dx >= 0 and dy <= 0) * 8
                )
                count += 1
    return offsets[:count], right[:count], down[:count], quadrants[:count]


@numba.njit(**INNER)
def _gap(step: float) -> Any:
    """Give the least distance between points of cells so many columns or rows apart."""
    return max(abs(np.float32(step)) - _ONE - _SLACK, _NOTHING)


@numba.njit(**INNER)
def _raise_to(target: Float32Array, source: Float32Array, drop: Any) -> None:
    """Lift `target` to `source - drop` where that is larger."""
    for i in range(target.shape[0]):
        target[i] = max(source[i] - drop, target[i])


@numba.njit(**INNER)
def _raise_by_places(
    target: Float32Array, source: Float32Array, right: Float32Array, down: Float32Array,
    step_x: Any, step_y: Any, reach_x: Any, reach_y: Any, slope: Any,
) -> None:  # fmt: skip
    """Lift `target` to what `source`, so many steps away, still has within reach at the border of the target's cell."""
    sign_x, sign_y = np.float32(np.sign(step_x)), np.float32(np.sign(step_y))
    # Steps to the right: step - 1 whole cells and the part before the point; to the left: the part behind it.
    from_x = abs(step_x) - _SLACK - (_ONE if sign_x > _NOTHING else _NOTHING)
    from_y = abs(step_y) - _SLACK - (_ONE if sign_y > _NOTHING else _NOTHING)
    for i in range(target.shape[0]):
        gap_x, gap_y = max(from_x + sign_x * right[i], _NOTHING), max(from_y + sign_y * down[i], _NOTHING)
        value = source[i] - slope * np.float32(math.sqrt(gap_x * gap_x + gap_y * gap_y))
        value = value if (gap_x <= reach_x) & (gap_y <= reach_y) else _NOTHING
        target[i] = max(value, target[i])


@numba.njit(**INNER)
def _pair(largest: Float32Array, from_opposite: Float32Array) -> None:
    """Write the larger of the smaller of the opposite quadrants."""
    for i in range(from_opposite.shape[0]):
        from_opposite[i] = max(min(largest[0, i], largest[2, i]), min(largest[1, i], largest[3, i]))


@numba.njit(**INNER)
def _bound_hiding(
    nearest: Float32Array, right: Float32Array, down: Float32Array, columns: int, border: int, slope: Any,
    beside: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    around: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    reach_x: Any, reach_y: Any,
) -> tuple[Float32Array, Float32Array]:  # fmt: skip
    """Bound for each cell the inverse range of what can hide anything in it.

    Returns:
        from_near: (cells,) float32 [1/m], the largest inverse range beside it, less what a surface gains on the way.
        from_opposite: (cells,) float32 [1/m], the same of each quadrant around it; of two opposite quadrants the
            smaller counts, of the two pairs the larger.
    """
    from_near, from_opposite = np.zeros_like(nearest), np.zeros_like(nearest)
    largest = np.empty((4, _CHUNK), np.float32)
    margin = border * (columns + 1)
    # Rows are taken as one long line: what reaches over their ends meets empty cells only.
    for start in range(margin, nearest.shape[0] - margin, _CHUNK):
        size = min(_CHUNK, nearest.shape[0] - margin - start)
        largest[:] = _NOTHING
        for k in range(around[0].shape[0]):
            first, gap_x, gap_y = start + around[0][k], _gap(around[1][k]), _gap(around[2][k])
            drop = slope * np.float32(math.sqrt(gap_x * gap_x + gap_y * gap_y))
            for quadrant in range(4):
                if around[3][k] >> quadrant & 1:
                    _raise_to(largest[quadrant, :size], nearest[first : first + size], drop)
        _pair(largest, from_opposite[start : start + size])
        for k in range(beside[0].shape[0]):
            first = start + beside[0][k]
            last = first + size
            _raise_by_places(
                from_near[start : start + size], nearest[first:last], right[first:last], down[first:last],
                beside[1][k], beside[2][k], reach_x, reach_y, slope,
            )  # fmt: skip
    return from_near, from_opposite


@numba.njit(**INLINED)
def _hides(excess: Any, squared: Any, slope_squared: Any) -> Any:
    """Say whether something hides: nearer by an excess that no surface gains over so short a distance."""
    return (excess > _NOTHING) & (excess * excess > slope_squared * squared)


@numba.njit(**INLINED)
def _search_near(
    a: Any, b: Any, cell: int, threshold: Any, slope_squared: Any, nearest: Float32Array, right: Float32Array,
    down: Float32Array, beside: tuple[Int64Array, Float32Array, Float32Array, Int64Array], near: tuple[Any, Any, Any],
) -> bool:  # fmt: skip
    """Say whether anything in the ellipse around the place (a, b) in a cell hides what lies there."""
    hidden = False
    # Without branches: whether a cell hides cannot be predicted, and a wrong guess costs more than the sums.
    for k in range(beside[0].shape[0]):
        c = np.uint32(cell + beside[0][k])
        x, y = beside[1][k] + right[c] - a, beside[2][k] + down[c] - b
        inside = near[0] * x * x + near[1] * x * y + near[2] * y * y <= _ONE
        hidden |= inside & _hides(nearest[c] - threshold, x * x + y * y, slope_squared)
    return hidden


@numba.njit(**INLINED)
def _search_nearing(
    a: Any, b: Any, cell: int, inverse: Any, threshold: Any, slope_squared: Any, nearest: Float32Array,
    right: Float32Array, down: Float32Array, beside: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    near: tuple[Any, Any, Any], shift_x: Any, shift_y: Any, nearing: Any,
) -> bool:  # fmt: skip
    """Say the same of what came nearer on the eye's way from the lidar to the camera.

    On that way something of inverse range w shifts by w times `shift` [cells m], against what is infinitely far.
    """
    nearer = False
    for k in range(beside[0].shape[0]):
        c = np.uint32(cell + beside[0][k])
        x, y = beside[1][k] + right[c] - a, beside[2][k] + down[c] - b
        inside = near[0] * x * x + near[1] * x * y + near[2] * y * y <= _ONE
        gained = nearest[c] - inverse
        from_x, from_y = x - gained * shift_x, y - gained * shift_y
        inside &= x * from_x + y * from_y <= nearing * (from_x * from_x + from_y * from_y)
        nearer |= inside & _hides(nearest[c] - threshold, x * x + y * y, slope_squared)
    return nearer


@numba.njit(**INLINED)
def _shift(
    rightward: Any, downward: Any, eyes: Float64Array, fraction: Any, per_cell: Any
) -> tuple[Any, Any]:
    """Give the shift [cells m], per inverse range, of what lies in a direction when the eye moves to the camera.

    Source: the derivative of Snyder 1987, eq. 24-1 and 24-2, along the part of the eye's way across the line of sight.
    """
    squared = rightward * rightward + downward * downward
    half = np.float32(math.sqrt(max(_ONE - _QUARTER * squared, _BEHIND)))
    scale, x, y, z = _ONE / half, half * rightward, half * downward, _ONE - np.float32(0.5) * squared
    eye_x = np.float32(eyes[0, 0]) + fraction * np.float32(eyes[1, 0] - eyes[0, 0])
    eye_y = np.float32(eyes[0, 1]) + fraction * np.float32(eyes[1, 1] - eyes[0, 1])
    eye_z = np.float32(eyes[0, 2]) + fraction * np.float32(eyes[1, 2] - eyes[0, 2])
    along = x * eye_x + y * eye_y + z * eye_z
    across = along + _QUARTER * scale * scale * (eye_z - along * z)
    scale *= per_cell
    return (eye_x - x * across) * scale, (eye_y - y * across) * scale


@numba.njit(**INLINED)
def _search_window(
    a: Any, b: Any, cell: int, threshold: Any, slope_squared: Any, nearest: Float32Array, right: Float32Array,
    down: Float32Array, around: tuple[Int64Array, Float32Array, Float32Array, Int64Array], window_squared: Any,
) -> bool:  # fmt: skip
    """Say whether things in opposite quadrants around the place (a, b) in a cell hide what lies there.

    Each quadrant holds one of its two borders, so that opposite steps fall into opposite quadrants.
    """
    first = second = third = fourth = False
    for k in range(around[0].shape[0]):
        c = np.uint32(cell + around[0][k])
        x, y = around[1][k] + right[c] - a, around[2][k] + down[c] - b
        squared = x * x + y * y
        hides = (squared <= window_squared) & _hides(nearest[c] - threshold, squared, slope_squared)
        first |= hides & (x > _NOTHING) & (y >= _NOTHING)
        second |= hides & (x <= _NOTHING) & (y > _NOTHING)
        third |= hides & (x < _NOTHING) & (y <= _NOTHING)
        fourth |= hides & (x >= _NOTHING) & (y < _NOTHING)
    return (first & third) | (second & fourth)


@numba.njit(**INNER)
def _decide(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, cells: AnyArray, per_cell: Any,
    nearest: Float32Array, right: Float32Array, down: Float32Array,
    from_near: Float32Array, from_opposite: Float32Array,
    beside: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    around: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    near: tuple[Any, Any, Any], limits: tuple[Any, Any, Any, Any], visible: BoolArray, alone: AnyArray,
) -> int:  # fmt: skip
    """Write which points of a block are not hidden; most of them only need the two bounds of their cells.

    The numbers of those that one thing alone hides are written to `alone`; how many there are is returned.
    """
    window_squared, steepest, margin, margin_share = limits
    count = 0
    for i in range(cells.shape[0]):
        c, inverse = np.uint32(cells[i]), inverse_ranges[i]
        visible[i] = c > 0
        threshold = inverse + margin * inverse * inverse + margin_share * inverse
        is_near, is_between = from_near[c] > threshold, from_opposite[c] > threshold
        if not ((is_near or is_between) and c > 0):
            continue
        off_axis = rightward[i] * rightward[i] + downward[i] * downward[i]
        slope_squared = steepest / max(_ONE - _QUARTER * off_axis, _BEHIND)
        a, b = fraction(rightward[i], per_cell), fraction(downward[i], per_cell)
        if is_near and _search_near(a, b, c, threshold, slope_squared, nearest, right, down, beside, near):
            visible[i] = False
            alone[count] = i
            count += 1
        elif is_between:
            visible[i] = not _search_window(
                a, b, c, threshold, slope_squared, nearest, right, down, around, window_squared
            )
    return count


@numba.njit(**INNER)
def _decide_again(
    alone: AnyArray, fractions: Float32Array, eyes: Float64Array, nearing: Any, point_ids: Int64Array,
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, cells: AnyArray, per_cell: Any,
    nearest: Float32Array, right: Float32Array, down: Float32Array, from_opposite: Float32Array,
    beside: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    around: tuple[Int64Array, Float32Array, Float32Array, Int64Array],
    near: tuple[Any, Any, Any], limits: tuple[Any, Any, Any, Any], visible: BoolArray,
) -> None:  # fmt: skip
    """Let points be seen again whose only hiding thing came no nearer from the lidar to the camera."""
    window_squared, steepest, margin, margin_share = limits
    for k in range(alone.shape[0]):
        i = alone[k]
        c, inverse = np.uint32(cells[i]), inverse_ranges[i]
        threshold = inverse + margin * inverse * inverse + margin_share * inverse
        off_axis = rightward[i] * rightward[i] + downward[i] * downward[i]
        slope_squared = steepest / max(_ONE - _QUARTER * off_axis, _BEHIND)
        a, b = fraction(rightward[i], per_cell), fraction(downward[i], per_cell)
        shift_x, shift_y = _shift(rightward[i], downward[i], eyes, fractions[point_ids[i]], per_cell)
        visible[i] = not (
            _search_nearing(
                a, b, c, inverse, threshold, slope_squared, nearest, right, down, beside, near,
                shift_x, shift_y, nearing,
            )
            or (from_opposite[c] > threshold and _search_window(
                a, b, c, threshold, slope_squared, nearest, right, down, around, window_squared
            ))
        )  # fmt: skip


@numba.njit(
    void(
        _IN_F32_2D, _IN_F32_1D, float64, float64, float64, float64, float64, float64, float64, float64,
        _IN_F64_2D, _IN_I64_1D, _IN_F32_1D, float64, boolean[::1]
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def mark_unhidden(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    cell: float,
    window: float,
    near_xx: float,
    near_xy: float,
    near_yy: float,
    slope: float,
    margin: float,
    margin_share: float,
    eyes: Float64Array,
    point_ids: Int64Array,
    fractions: Float32Array,
    nearing: float,
    visible: BoolArray,
) -> None:
    """Write which points no nearer points hide.

    Only the nearest point of each cell can hide others. Two bounds per cell let most points pass with one read each.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; a point with 0 takes no part and is not visible.
        cell: size of a cell [rad], at least 0.001, which bounds the memory.
        window: within it two things on opposite sides of a point hide it [rad].
        near_xx, near_xy, near_yy: p, q, r of the ellipse p x² + q x y + r y² <= 1 in which a single thing hides
            [1/rad²].
        slope: largest gradient of the inverse range on a surface that does not hide itself [1/m/rad].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        eyes: (2, 3) [m], camera frame, where the lidar was first and last; (0, 3) where that is not known.
        point_ids: (M,), each point's row in `fractions`.
        fractions: (N,), how far between its two places the lidar was, 0 to 1.
        nearing: to what share of its distance in the lidar's eyes a single thing must have come to hide; of no account
            where `eyes` are not known.
        visible: (M,), written.
    """
    # From here on lengths are in cells.
    xx, xy, yy = near_xx * cell * cell, near_xy * cell * cell, near_yy * cell * cell
    area = xx * yy - 0.25 * xy * xy
    reach_x, reach_y, radius = math.sqrt(yy / area), math.sqrt(xx / area), window / cell
    border = math.ceil(max(radius, reach_x, reach_y))
    grid = fit_grid(directions, inverse_ranges, cell, border)
    nearest, right, down = keep_nearest(directions, inverse_ranges, grid)
    around = _list_cells(radius, radius, radius, grid[3])
    beside = _list_cells(reach_x, reach_y, math.inf, grid[3])
    from_near, from_opposite = _bound_hiding(
        nearest, right, down, grid[3], border, np.float32(slope * cell), beside, around,
        np.float32(reach_x), np.float32(reach_y),
    )  # fmt: skip
    near = (np.float32(xx), np.float32(xy), np.float32(yy))
    steepest = np.float32(slope * cell * slope * cell)
    limits = (np.float32(radius * radius), steepest, np.float32(margin), np.float32(margin_share))
    rightward, downward, numbers = directions[0], directions[1], np.empty(BLOCK, np.int32)
    alone, known_way = np.empty(BLOCK, np.int32), eyes.shape[0] > 0
    for start in range(0, inverse_ranges.shape[0], BLOCK):
        stop = min(start + BLOCK, inverse_ranges.shape[0])
        a, b, inverse, block = (
            rightward[start:stop], downward[start:stop], inverse_ranges[start:stop], numbers[: stop - start]
        )  # fmt: skip
        number_cells(a, b, inverse, grid, block)
        count = _decide(
            a, b, inverse, block, grid[0], nearest, right, down, from_near, from_opposite, beside, around, near,
            limits, visible[start:stop], alone,
        )  # fmt: skip
        if known_way and count > 0:
            _decide_again(
                alone[:count], fractions, eyes, np.float32(nearing), point_ids[start:stop],
                a, b, inverse, block, grid[0], nearest, right, down, from_opposite, beside, around, near, limits,
                visible[start:stop],
            )  # fmt: skip
