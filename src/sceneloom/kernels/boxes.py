"""Points inside boxes that may move."""

import math

import numpy as np
from numba import float64, int64, void

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_2D, IN_F64_2D, inlined, part

_MOST_CELLS = 1 << 18
_MOST_ENTRIES = 1 << 25
_SMALLEST_CELL = 0.5

_CELLS_PER_BOX = 0.25
"""Cells of a quarter of the usual box's length: fewer make points meet boxes that they are far from."""


@part
def _bounds(centers: Float64Array, rotations: Float64Array, halves: Float64Array) -> Float64Array:
    """Lowest and highest x and y of each box over all knots, (B, 4); of boxes that move, of spheres around them."""
    knots, boxes = centers.shape[0], centers.shape[1]
    bounds = np.empty((boxes, 4))
    for b in range(boxes):
        bounds[b, 0] = bounds[b, 1] = math.inf
        bounds[b, 2] = bounds[b, 3] = -math.inf
        for k in range(knots):
            for axis in range(2):
                reach = 0.0
                for c in range(3):
                    trajectory = 1.0 if knots > 1 else abs(rotations[k, b, axis, c])
                    reach += (trajectory * halves[k, b, c]) ** (2 if knots > 1 else 1)
                reach = math.sqrt(reach) if knots > 1 else reach
                bounds[b, axis] = min(bounds[b, axis], centers[k, b, axis] - reach)
                bounds[b, axis + 2] = max(bounds[b, axis + 2], centers[k, b, axis] + reach)
    return bounds


@part
def _grid(bounds: Float64Array) -> tuple[float, float, float, int, int, Int64Array, Int64Array]:
    """Lay a grid over the boxes: its corner, size of a cell, columns and rows, and which boxes touch each cell."""
    low_x, low_y, high_x, high_y, lengths = math.inf, math.inf, -math.inf, -math.inf, 0.0
    for b in range(len(bounds)):
        low_x, low_y = min(low_x, bounds[b, 0]), min(low_y, bounds[b, 1])
        high_x, high_y = max(high_x, bounds[b, 2]), max(high_y, bounds[b, 3])
        lengths += max(bounds[b, 2] - bounds[b, 0], bounds[b, 3] - bounds[b, 1])
    cell = max(_SMALLEST_CELL, _CELLS_PER_BOX * lengths / len(bounds))
    cell = max(cell, math.sqrt((high_x - low_x) * (high_y - low_y) / _MOST_CELLS))
    cell = max(cell, max(high_x - low_x, high_y - low_y) / _MOST_CELLS)
    while True:
        columns, rows = int((high_x - low_x) / cell) + 1, int((high_y - low_y) / cell) + 1
        entries = 0.0
        for b in range(len(bounds)):
            entries += ((bounds[b, 2] - bounds[b, 0]) / cell + 2) * ((bounds[b, 3] - bounds[b, 1]) / cell + 2)
        if entries <= _MOST_ENTRIES or columns * rows == 1:
            break
        cell *= 2.0
    starts = np.zeros(columns * rows + 1, np.int64)
    for attempt in range(2):
        if attempt == 1:
            listed = np.empty(starts[-1], np.int64)
        for b in range(len(bounds)):
            first_x, last_x = int((bounds[b, 0] - low_x) / cell), int((bounds[b, 2] - low_x) / cell)
            first_y, last_y = int((bounds[b, 1] - low_y) / cell), int((bounds[b, 3] - low_y) / cell)
            for x in range(first_x, min(last_x, columns - 1) + 1):
                for y in range(first_y, min(last_y, rows - 1) + 1):
                    if attempt == 0:
                        starts[x * rows + y + 1] += 1
                    else:
                        listed[starts[x * rows + y]] = b
                        starts[x * rows + y] += 1
        if attempt == 0:
            starts = np.cumsum(starts)
    starts[1:] = starts[:-1].copy()
    starts[0] = 0
    return low_x, low_y, cell, columns, rows, starts, listed


@inlined
def _in_box(  # type: ignore[no-untyped-def]
    x, y, z, b, knot, share, centers, rotations, halves
):
    """Whether a point is in a box, its faces included, at a share of the time from one knot to the next."""
    after = min(knot + 1, centers.shape[0] - 1)
    dx = x - (centers[knot, b, 0] + share * (centers[after, b, 0] - centers[knot, b, 0]))
    dy = y - (centers[knot, b, 1] + share * (centers[after, b, 1] - centers[knot, b, 1]))
    dz = z - (centers[knot, b, 2] + share * (centers[after, b, 2] - centers[knot, b, 2]))
    for c in range(3):
        ax = rotations[knot, b, 0, c] + share * (rotations[after, b, 0, c] - rotations[knot, b, 0, c])
        ay = rotations[knot, b, 1, c] + share * (rotations[after, b, 1, c] - rotations[knot, b, 1, c])
        az = rotations[knot, b, 2, c] + share * (rotations[after, b, 2, c] - rotations[knot, b, 2, c])
        half = halves[knot, b, c] + share * (halves[after, b, c] - halves[knot, b, c])
        if share > 0.0:
            half *= math.sqrt(ax * ax + ay * ay + az * az)
        if not abs(ax * dx + ay * dy + az * dz) <= half:
            return False
    return True


_REST = (float64[::1], float64[:, :, ::1], float64[:, :, :, ::1], float64[:, :, ::1], int64[::1], int64[::1])


@kernel([void(IN_F32_2D, *_REST), void(IN_F64_2D, *_REST)])
def find_points_in_boxes(
    points: FloatArray, locations: Float64Array, centers: Float64Array, rotations: Float64Array, halves: Float64Array,
    stops: Int64Array, point_ids: Int64Array,
) -> None:  # fmt: skip
    """Count the points in each box, and list them if there is room.

    Args:
        points: (N, 3) [m], in the frame of the centres; one with a NaN lies nowhere.
        locations: (N,) where on the boxes' trajectory each point was measured: 1.25 is a quarter of the trajectory from
            knot 1 to knot 2; (0,) for boxes at knot 0.
        centers: (K, B, 3) [m], the boxes at K knots, B >= 1, all finite; between knots they go straight.
        rotations: (K, B, 3, 3), whose columns are the boxes' axes; from knot to knot they rotate by a few degrees.
        halves: (K, B, 3) [m], half of length, width and height.
        stops: (B,) added to: the points of each box. Where `point_ids` is to be filled: where in it each box's begin,
            and afterwards end.
        point_ids: filled with the rows of the points of each box, rising; (0,) to count only.
    """
    knots, moving, listing = centers.shape[0], locations.shape[0] > 0, point_ids.shape[0] > 0
    low_x, low_y, cell, columns, rows, starts, listed = _grid(_bounds(centers, rotations, halves))
    knot, share = 0, 0.0
    for i in range(points.shape[0]):
        x, y, z = float64(points[i, 0]), float64(points[i, 1]), float64(points[i, 2])
        column, row = (x - low_x) / cell, (y - low_y) / cell
        if not (0.0 <= column < columns and 0.0 <= row < rows):
            continue
        if moving:
            knot = min(max(int(locations[i]), 0), knots - 1)
            share = min(max(locations[i] - knot, 0.0), 1.0)
        number = int(column) * rows + int(row)
        for k in range(starts[number], starts[number + 1]):
            b = listed[k]
            if _in_box(x, y, z, b, knot, share, centers, rotations, halves):
                if listing:
                    point_ids[stops[b]] = i
                stops[b] += 1
