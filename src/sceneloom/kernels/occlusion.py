"""Which points of a sparse cloud nearer points hide from a camera; `colouring.visibility` derives the rule."""

import math
from typing import Any

import numpy as np
from numba import float32, float64, int32, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.direction_grid import keep_nearest, position_grid, read_keys
from sceneloom.kernels.occlusion_bounds import bound_hiding
from sceneloom.kernels.occlusion_search import search_hiding
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
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
    bound_hiding(
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
        search_hiding(
            *_some(points, a, b), numbers[a:b], 1.0 / cell, columns, held[0], held[1], held[2],
            bounds[0], bounds[1], size_x, size_y, border, rule, eyes, point_ids[a:b], fractions, visible[a:b],
        )  # fmt: skip

    thread_pool.share(len(numbers), search, rounds=_ROUNDS)


_Rows = tuple[Float32Array, Float32Array, Float32Array]


def _some(rows: _Rows, start: int, stop: int) -> _Rows:
    return rows[0][start:stop], rows[1][start:stop], rows[2][start:stop]
