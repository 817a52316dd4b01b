"""Which points of a sparse cloud are occluded by nearer points: bounds per grid cell, the search around each point.

And all steps together.
"""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, float64, int32, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.direction_grid import INNER, fraction, keep_nearest, position_grid, read_keys
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

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
def _occlusion_bounds_join_squares(nearest: Float32Array, columns: int, border: int) -> Float32Array:
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
def _occlusion_bounds_bound_hiding(
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
    levels, largest = (
        _occlusion_bounds_join_squares(nearest, columns, border),
        np.empty((4, _CHUNK), np.float32),
    )
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


_BLOCK = 2048
"""Points that are picked from at once: few of them stay, and what is begun anew for each block is shared by many."""

_INLINED = {**INNER, "inline": "always"}
"""Options of what is called point by point: a call would count references to every array it is given."""

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)

_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)

_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_OCCLUSION_SEARCH_NOTHING, _OCCLUSION_SEARCH_ONE, _QUARTER, _BEHIND = (
    np.float32(0.0),
    np.float32(1.0),
    np.float32(0.25),
    np.float32(1e-3),
)

_STATIC = np.float32(math.inf)


@numba.njit(**INNER)
def _list_cells(size_x: int, size_y: int, columns: int) -> tuple[Int64Array, Float32Array, Float32Array]:
    """List the cells of a window so many to each side of a middle one, the middle first, then ring by ring.

    Returns:
        offsets: (K,) int64, from the number of the middle cell.
        right, down: (K,) float32, the same as columns and rows.
    """
    count, size = 0, (2 * size_x + 1) * (2 * size_y + 1)
    offsets, right, down = np.empty(size, np.int64), np.empty(size, np.float32), np.empty(size, np.float32)
    for ring in range(max(size_x, size_y) + 1):
        for dy in range(-min(ring, size_y), min(ring, size_y) + 1):
            for dx in range(-min(ring, size_x), min(ring, size_x) + 1):
                if max(abs(dx), abs(dy)) == ring:
                    offsets[count], right[count], down[count] = dy * columns + dx, dx, dy
                    count += 1
    return offsets, right, down


@numba.njit(**INNER)
def _shift(
    rightward: Float32Array, downward: Float32Array, eye_fractions: Float32Array, eyes: Float64Array, per_cell: Any,
) -> None:  # fmt: skip
    """Put shifts [cells m] in the position of directions: of what lies there, per inverse range, when the eye moves.

    It moves from the lidar to the camera.

    Source: the derivative of Snyder 1987, eq. 24-1 and 24-2, along the part of the eye's trajectory across the line of
        sight.
    """
    first_x, first_y, first_z = np.float32(eyes[0, 0]), np.float32(eyes[0, 1]), np.float32(eyes[0, 2])
    trajectory_x, trajectory_y, trajectory_z = (
        np.float32(eyes[1, 0] - eyes[0, 0]), np.float32(eyes[1, 1] - eyes[0, 1]), np.float32(eyes[1, 2] - eyes[0, 2])
    )  # fmt: skip
    for n in range(eye_fractions.shape[0]):
        squared = rightward[n] * rightward[n] + downward[n] * downward[n]
        half = np.float32(math.sqrt(max(_OCCLUSION_SEARCH_ONE - _QUARTER * squared, _BEHIND)))
        scale, x, y = _OCCLUSION_SEARCH_ONE / half, half * rightward[n], half * downward[n]
        z = _OCCLUSION_SEARCH_ONE - np.float32(0.5) * squared
        eye_x = first_x + eye_fractions[n] * trajectory_x
        eye_y = first_y + eye_fractions[n] * trajectory_y
        eye_z = first_z + eye_fractions[n] * trajectory_z
        along = x * eye_x + y * eye_y + z * eye_z
        across = along + _QUARTER * scale * scale * (eye_z - along * z)
        scale *= per_cell
        rightward[n], downward[n] = (eye_x - x * across) * scale, (eye_y - y * across) * scale


@numba.njit(**_INLINED)
def _threshold(inverse: Any, limits: tuple[Any, Any, Any, Any]) -> Any:
    """Give the inverse range beyond which something is nearer than a point."""
    return inverse + limits[2] * inverse * inverse + limits[3] * inverse


@numba.njit(**INNER)
def _pick(
    inverse_ranges: Float32Array, numbers: AnyArray, from_any: Float32Array, limits: tuple[Any, Any, Any, Any],
    visible: BoolArray, picked: AnyArray, thresholds: Float32Array,
) -> int:  # fmt: skip
    """List the points of a block that something may hide; let all others be seen that are in a cell."""
    for i in range(numbers.shape[0]):
        visible[i] = numbers[i] > 0
        # Nothing exceeds what is static.
        thresholds[i] = _threshold(inverse_ranges[i], limits) if numbers[i] > 0 else _STATIC
    count = 0
    for i in range(numbers.shape[0]):
        if from_any[np.uint32(numbers[i])] > thresholds[i]:
            picked[count] = i
            count += 1
    return count


@numba.njit(**INNER)
def _gather(
    picked: AnyArray, rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    numbers: AnyArray, per_cell: Any, limits: tuple[Any, Any, Any, Any], cells: AnyArray, room: Float32Array,
) -> None:  # fmt: skip
    """Put side by side what is asked of the listed points: cell, location in it, threshold, square of the slope."""
    for k in range(picked.shape[0]):
        i = np.uint32(picked[k])
        a, b = rightward[i], downward[i]
        cells[k] = numbers[i]
        room[0, k], room[1, k] = fraction(a, per_cell), fraction(b, per_cell)
        room[2, k] = _threshold(inverse_ranges[i], limits)
        room[3, k] = limits[1] / max(_OCCLUSION_SEARCH_ONE - _QUARTER * (a * a + b * b), _BEHIND)


@numba.njit(**_INLINED)
def _gains(excess: Any, x: Any, y: Any, slope_squared: Any) -> Any:
    """Report whether something is nearer by more than a surface gains over so short a distance."""
    return excess * excess > slope_squared * (x * x + y * y)


@numba.njit(**_INLINED)
def _in_ellipse(x: Any, y: Any, near: tuple[Any, Any, Any]) -> Any:
    return near[0] * (x * x) + near[1] * (x * y) + near[2] * (y * y) <= _OCCLUSION_SEARCH_ONE


@numba.njit(**INNER)
def _search_beside(
    cells: AnyArray, a: Float32Array, b: Float32Array, thresholds: Float32Array, slopes_squared: Float32Array,
    nearest: Float32Array, right: Float32Array, down: Float32Array,
    window: tuple[Int64Array, Float32Array, Float32Array], near: tuple[Any, Any, Any],
    alone: AnyArray, others: AnyArray,
) -> tuple[int, int]:  # fmt: skip
    """List the points that anything in the ellipse around them hides, and the others; give how many each are."""
    hidden, free = 0, 0
    for k in range(cells.shape[0]):
        found = False
        for j in range(window[0].shape[0]):
            c = np.uint64(cells[k] + window[0][j])
            excess = nearest[c] - thresholds[k]
            if excess > _OCCLUSION_SEARCH_NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                if _in_ellipse(x, y, near) and _gains(excess, x, y, slopes_squared[k]):
                    found = True
                    break
        alone[hidden], others[free] = k, k
        hidden += found
        free += not found
    return hidden, free


@numba.njit(**INNER)
def _search_nearing(
    listed: AnyArray, cells: AnyArray, a: Float32Array, b: Float32Array, thresholds: Float32Array,
    slopes_squared: Float32Array, nearest: Float32Array, right: Float32Array, down: Float32Array,
    window: tuple[Int64Array, Float32Array, Float32Array], near: tuple[Any, Any, Any],
    inverse_ranges: Float32Array, shift_x: Float32Array, shift_y: Float32Array, nearing: Any,
    others: AnyArray, free: int,
) -> int:  # fmt: skip
    """Add those of the listed points to `others` that nothing hides which came nearer from the lidar to the camera."""
    for n in range(listed.shape[0]):
        k = np.uint32(listed[n])
        found = False
        for j in range(window[0].shape[0]):
            c = np.uint64(cells[k] + window[0][j])
            excess = nearest[c] - thresholds[k]
            if excess > _OCCLUSION_SEARCH_NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                gained = nearest[c] - inverse_ranges[n]
                x_from, y_from = x - gained * shift_x[n], y - gained * shift_y[n]
                came = x * x_from + y * y_from <= nearing * (x_from * x_from + y_from * y_from)
                if came and _in_ellipse(x, y, near) and _gains(excess, x, y, slopes_squared[k]):
                    found = True
                    break
        others[free] = k
        free += not found
    return free


@numba.njit(**INNER)
def _search_between(
    listed: AnyArray, picked: AnyArray, cells: AnyArray, a: Float32Array, b: Float32Array,
    thresholds: Float32Array, slopes_squared: Float32Array, nearest: Float32Array, right: Float32Array,
    down: Float32Array, window: tuple[Int64Array, Float32Array, Float32Array], window_squared: Any,
    visible: BoolArray,
) -> None:  # fmt: skip
    """Write which of the listed points things in opposite quadrants around them do not hide."""
    for n in range(listed.shape[0]):
        k = np.uint32(listed[n])
        # Each quadrant holds one of its two borders, so that opposite directions lie in opposite quadrants.
        first, second, third, fourth, hidden = False, False, False, False, False
        for j in range(window[0].shape[0]):
            c = np.uint64(cells[k] + window[0][j])
            excess = nearest[c] - thresholds[k]
            if excess > _OCCLUSION_SEARCH_NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                if x * x + y * y <= window_squared and _gains(excess, x, y, slopes_squared[k]):
                    first |= (x > _OCCLUSION_SEARCH_NOTHING) & (y >= _OCCLUSION_SEARCH_NOTHING)
                    second |= (x <= _OCCLUSION_SEARCH_NOTHING) & (y > _OCCLUSION_SEARCH_NOTHING)
                    third |= (x < _OCCLUSION_SEARCH_NOTHING) & (y <= _OCCLUSION_SEARCH_NOTHING)
                    fourth |= (x >= _OCCLUSION_SEARCH_NOTHING) & (y < _OCCLUSION_SEARCH_NOTHING)
                    hidden = (first & third) | (second & fourth)
                    if hidden:
                        break
        visible[picked[k]] = not hidden


@numba.njit(**INNER)
def _keep_bounded(
    listed: AnyArray, picked: AnyArray, cells: AnyArray, thresholds: Float32Array, from_opposite: Float32Array,
    visible: BoolArray,
) -> int:  # fmt: skip
    """Keep those listed that things in opposite quadrants may hide, and let the others be seen; give their count."""
    count = 0
    for n in range(listed.shape[0]):
        k = np.uint32(listed[n])
        visible[picked[k]] = True
        listed[count] = k
        count += from_opposite[np.uint32(cells[k])] > thresholds[k]
    return count


@numba.njit(**INNER)
def _gather_trajectories(
    listed: AnyArray, picked: AnyArray, rightward: Float32Array, downward: Float32Array,
    inverse_ranges: Float32Array, point_ids: Int64Array, fractions: Float32Array, room: Float32Array,
) -> None:  # fmt: skip
    """Put side by side inverse range, direction and how far along the lidar was, of the listed points."""
    for n in range(listed.shape[0]):
        i = np.uint32(picked[listed[n]])
        room[0, n], room[1, n], room[2, n] = inverse_ranges[i], rightward[i], downward[i]
        room[3, n] = fractions[point_ids[i]]


@numba.njit(**INNER)
def _decide(
    picked: AnyArray, rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array,
    numbers: AnyArray, per_cell: Any, nearest: Float32Array, right: Float32Array, down: Float32Array,
    from_opposite: Float32Array,
    beside: tuple[Int64Array, Float32Array, Float32Array], around: tuple[Int64Array, Float32Array, Float32Array],
    near: tuple[Any, Any, Any], limits: tuple[Any, Any, Any, Any],
    eyes: Float64Array, point_ids: Int64Array, fractions: Float32Array, nearing: Any, visible: BoolArray,
    lists: AnyArray, room: Float32Array,
) -> None:  # fmt: skip
    """Write which of the listed points of a block are not hidden."""
    count = picked.shape[0]
    cells, alone, others, a, b = lists[0, :count], lists[1], lists[2], room[0], room[1]
    _gather(picked, rightward, downward, inverse_ranges, numbers, per_cell, limits, cells, room)
    hidden, free = _search_beside(
        cells, a, b, room[2], room[3], nearest, right, down, beside, near, alone, others
    )
    for n in range(hidden):
        visible[picked[alone[n]]] = False
    if eyes.shape[0] > 0:
        _gather_trajectories(
            alone[:hidden], picked, rightward, downward, inverse_ranges, point_ids, fractions, room[4:]
        )
        _shift(room[5], room[6], room[7, :hidden], eyes, per_cell)
        free = _search_nearing(
            alone[:hidden], cells, a, b, room[2], room[3], nearest, right, down, beside, near,
            room[4], room[5], room[6], nearing, others, free,
        )  # fmt: skip
    free = _keep_bounded(others[:free], picked, cells, room[2], from_opposite, visible)
    _search_between(
        others[:free], picked, cells, a, b, room[2], room[3], nearest, right, down, around, limits[0], visible
    )


@kernel(
    void(
        _IN_F32_1D, _IN_F32_1D, _IN_F32_1D, _IN_I32_1D, float64, int64, _IN_F32_1D, _IN_F32_1D, _IN_F32_1D,
        _IN_F32_1D, _IN_F32_1D, int64, int64, int64, _IN_F32_1D, _IN_F64_2D, _IN_I64_1D, _IN_F32_1D, boolean[::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def _search_hiding(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, numbers: AnyArray,
    per_cell: float, columns: int, nearest: Float32Array, right: Float32Array, down: Float32Array,
    from_any: Float32Array, from_opposite: Float32Array, size_x: int, size_y: int, border: int,
    limits: Float32Array, eyes: Float64Array, point_ids: Int64Array, fractions: Float32Array, visible: BoolArray,
) -> None:  # fmt: skip
    """Write which points nothing hides; most of them only need the bounds of their cells.

    Args:
        rightward, downward, inverse_ranges: (M,) points, as of `occlusion.mark_unhidden`.
        numbers: (M,) int32, their cells, 0 for none.
        per_cell: cells in a radian.
        columns: of the grid.
        nearest, right, down: (cells,) what the cells hold.
        from_any, from_opposite: (cells,) their bounds.
        size_x, size_y: how many columns and rows away a single thing hides.
        border: how many cells away anything hides.
        limits: (8,) in cells: square of the window, square of the slope; margin and its share; p, q, r of the ellipse;
            nearing.
        eyes, point_ids, fractions: as of `occlusion.mark_unhidden`.
        visible: (M,), written.
    """
    count, pitch, share = inverse_ranges.shape[0], np.float32(per_cell), limits[7]
    rule, near = (limits[0], limits[1], limits[2], limits[3]), (limits[4], limits[5], limits[6])
    beside, around = _list_cells(size_x, size_y, columns), _list_cells(border, border, columns)
    picked, lists, room = (
        np.empty(_BLOCK, np.int32), np.empty((3, _BLOCK + 1), np.int32), np.empty((8, _BLOCK), np.float32)
    )  # fmt: skip
    for start in range(0, count, _BLOCK):
        stop = min(start + _BLOCK, count)
        seen, inverse, block = visible[start:stop], inverse_ranges[start:stop], numbers[start:stop]
        found = _pick(inverse, block, from_any, rule, seen, picked, room[2])
        _decide(
            picked[:found], rightward[start:stop], downward[start:stop], inverse, block, pitch,
            nearest, right, down, from_opposite, beside, around, near, rule,
            eyes, point_ids[start:stop], fractions, share, seen, lists, room,
        )  # fmt: skip


_ROUNDS = 4
"""Some parts of a cloud hide much and others nothing: each thread takes so many chunks."""

_KERNEL: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


@kernel(
    void(
        _IN_F32_1D, _IN_F32_1D, _IN_F32_1D, _IN_F32_1D, float64, int64, int64, int64, int64, int32[::1], int64[::1]
    ),
    **_KERNEL,
)  # fmt: skip
def _keep_nearest(
    rightward: Float32Array, downward: Float32Array, inverse_ranges: Float32Array, hiding: Float32Array, cell: float,
    first_column: int, first_row: int, columns: int, rows: int, numbers: AnyArray, keys: AnyArray,
) -> None:  # fmt: skip
    """Number the cells of some points, and write for each cell the key of its nearest; 0 where none is."""
    keys[:] = 0
    grid = (np.float32(1.0 / cell), np.int32(first_column), np.int32(first_row), columns, rows)
    keep_nearest(rightward, downward, inverse_ranges, hiding, grid, numbers, keys)
    keys[0] = 0


@kernel(void(int64[:, ::1], int64, int64, float32[::1], float32[::1], float32[::1]), **_KERNEL)
def _read_keys(
    keys: AnyArray, start: int, stop: int, nearest: Float32Array, right: Float32Array, down: Float32Array
) -> None:
    """Take the largest keys of some cells apart, out of several tables."""
    whole = keys[0, start:stop]
    for part in range(1, keys.shape[0]):
        other = keys[part, start:stop]
        for c in range(whole.shape[0]):
            whole[c] = max(whole[c], other[c])
    read_keys(whole, nearest[start:stop], right[start:stop], down[start:stop])


@kernel(
    void(
        _IN_F32_1D, _IN_F32_1D, _IN_F32_1D, int64, int64, float64, float64, float64, float32[::1], float32[::1]
    ),
    **_KERNEL,
)  # fmt: skip
def _bound_hiding(
    nearest: Float32Array, right: Float32Array, down: Float32Array, columns: int, border: int, slope: float,
    reach_x: float, reach_y: float, from_any: Float32Array, from_opposite: Float32Array,
) -> None:  # fmt: skip
    """Write the bounds of some rows' cells, `border` rows in from both ends."""
    _occlusion_bounds_bound_hiding(
        nearest, right, down, columns, border, np.float32(slope), np.float32(reach_x), np.float32(reach_y),
        from_any, from_opposite,
    )  # fmt: skip


def mark_unhidden(
    directions: Float32Array,
    inverse_ranges: Float32Array,
    hiding: Float32Array,
    extent: Float32Array,
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
    *,
    thread_pool: ThreadPool = ALONE,
) -> None:
    """Write which points no nearer points hide.

    Only the nearest point of each cell can hide others. Two bounds per cell let most points pass with one read each.

    Args:
        directions: (2, M) in the equal-area map [rad].
        inverse_ranges: (M,) [1/m]; a point with 0 takes no part and is not visible.
        hiding: (M,) [1/m], the same for points that may hide others, 0 for those that shall not.
        extent: (4,) of the points, as of `direction_grid.measure_extent`.
        cell: size of a cell [rad], at least 0.001, which bounds the memory.
        window: within it two things on opposite sides of a point hide it [rad].
        near_xx, near_xy, near_yy: p, q, r of the ellipse p x² + q x y + r y² <= 1 in which a single thing hides
            [1/rad²].
        slope: largest gradient of the inverse range on a surface that does not hide itself [1/m/rad].
        margin: how much nearer than a point something must be to hide it [m] …
        margin_share: … plus this share of the point's range.
        eyes: (2, 3) [m], camera frame, where the lidar was first and last; (0, 3) where that is not known.
        point_ids: (M,), each point's row in `fractions`.
        fractions: (N,), how far between its two locations the lidar was, 0 to 1.
        nearing: to what share of its distance in the lidar's eyes a single thing must have come to hide; of no account
            where `eyes` are not known.
        visible: (M,), written.
        thread_pool: the threads that share the work; what comes out is the same.
    """
    # From here on lengths are in cells.
    xx, xy, yy = near_xx * cell * cell, near_xy * cell * cell, near_yy * cell * cell
    area = xx * yy - 0.25 * xy * xy
    reach_x, reach_y, radius = math.sqrt(yy / area), math.sqrt(xx / area), window / cell
    size_x, size_y = math.ceil(reach_x), math.ceil(reach_y)
    border = max(math.ceil(radius), size_x, size_y)
    points = directions[0], directions[1], inverse_ranges
    first_column, first_row, columns, rows = position_grid(extent, cell, border)
    cells, numbers = columns * rows, np.empty(len(inverse_ranges), np.int32)
    keys = np.empty((thread_pool.size, cells), np.int64)

    def keep(part: int, a: int, b: int) -> None:
        some, corner = _some(points, a, b), (cell, first_column, first_row)
        _keep_nearest(*some, hiding[a:b], *corner, columns, rows, numbers[a:b], keys[part])

    thread_pool.share(len(numbers), keep)
    held, bounds = np.empty((3, cells), np.float32), np.empty((2, cells), np.float32)
    thread_pool.share(cells, lambda _, a, b: _read_keys(keys, a, b, held[0], held[1], held[2]))

    def bound(_: int, first: int, last: int) -> None:
        # Each has the rows around its own as well.
        around = _some((held[0], held[1], held[2]), first * columns, (last + 2 * border) * columns)
        own = slice((first + border) * columns, (last + border) * columns)
        reach = (slope * cell, reach_x, reach_y)
        _bound_hiding(*around, columns, border, *reach, bounds[0, own], bounds[1, own])

    thread_pool.share(rows - 2 * border, bound)
    limits = (radius * radius, (slope * cell) ** 2, margin, margin_share, xx, xy, yy, nearing)
    rule = np.array(limits, np.float32)

    def search(_: int, a: int, b: int) -> None:
        _search_hiding(
            *_some(points, a, b), numbers[a:b], 1.0 / cell, columns, held[0], held[1], held[2],
            bounds[0], bounds[1], size_x, size_y, border, rule, eyes, point_ids[a:b], fractions, visible[a:b],
        )  # fmt: skip

    thread_pool.share(len(numbers), search, rounds=_ROUNDS)


_Rows = tuple[Float32Array, Float32Array, Float32Array]


def _some(rows: _Rows, start: int, stop: int) -> _Rows:
    return rows[0][start:stop], rows[1][start:stop], rows[2][start:stop]
