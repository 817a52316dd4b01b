"""The search, around the points of a cloud, for nearer ones that hide them; `occlusion` has all steps."""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, float64, int32, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.direction_grid import INNER, fraction

_BLOCK = 2048
"""Points that are picked from at once: few of them stay, and what is begun anew for each block is shared by many."""

INLINED = {**INNER, "inline": "always"}
"""Options of what is called point by point: a call would count references to every array it is given."""

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)
_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)
_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_NOTHING, _ONE, _QUARTER, _BEHIND = np.float32(0.0), np.float32(1.0), np.float32(0.25), np.float32(1e-3)
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
        half = np.float32(math.sqrt(max(_ONE - _QUARTER * squared, _BEHIND)))
        scale, x, y = _ONE / half, half * rightward[n], half * downward[n]
        z = _ONE - np.float32(0.5) * squared
        eye_x = first_x + eye_fractions[n] * trajectory_x
        eye_y = first_y + eye_fractions[n] * trajectory_y
        eye_z = first_z + eye_fractions[n] * trajectory_z
        along = x * eye_x + y * eye_y + z * eye_z
        across = along + _QUARTER * scale * scale * (eye_z - along * z)
        scale *= per_cell
        rightward[n], downward[n] = (eye_x - x * across) * scale, (eye_y - y * across) * scale


@numba.njit(**INLINED)
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
        room[3, k] = limits[1] / max(_ONE - _QUARTER * (a * a + b * b), _BEHIND)


@numba.njit(**INLINED)
def _gains(excess: Any, x: Any, y: Any, slope_squared: Any) -> Any:
    """Report whether something is nearer by more than a surface gains over so short a distance."""
    return excess * excess > slope_squared * (x * x + y * y)


@numba.njit(**INLINED)
def _in_ellipse(x: Any, y: Any, near: tuple[Any, Any, Any]) -> Any:
    return near[0] * (x * x) + near[1] * (x * y) + near[2] * (y * y) <= _ONE


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
            if excess > _NOTHING:
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
            if excess > _NOTHING:
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
            if excess > _NOTHING:
                x, y = right[c] + (window[1][j] - a[k]), down[c] + (window[2][j] - b[k])
                if x * x + y * y <= window_squared and _gains(excess, x, y, slopes_squared[k]):
                    first |= (x > _NOTHING) & (y >= _NOTHING)
                    second |= (x <= _NOTHING) & (y > _NOTHING)
                    third |= (x < _NOTHING) & (y <= _NOTHING)
                    fourth |= (x >= _NOTHING) & (y < _NOTHING)
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
def search_hiding(
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
