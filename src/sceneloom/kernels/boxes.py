"""Boxes in space: their outlines in an image, corners in another frame, points inside boxes and viewing cones.

And occlusion by other boxes.
"""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int64, njit, types, void

from sceneloom.arrays import Float32Array, Float64Array, FloatArray, Int64Array
from sceneloom.kernels.cache import kernel

_FLAT = 1e-12
"""An edge that covers no more than this angle points at the camera [rad]."""


@njit(nogil=True, error_model="numpy", inline="always")
def _unit(x, y, z):  # type: ignore[no-untyped-def]
    length = np.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


@njit(nogil=True, error_model="numpy", inline="always")
def _arc(units, first, last):  # type: ignore[no-untyped-def]
    """Where an edge heads at a right angle to its beginning, and how far [rad]."""
    ax, ay, az = units[first, 0], units[first, 1], units[first, 2]
    bx, by, bz = units[last, 0], units[last, 1], units[last, 2]
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    cosine, sine = ax * bx + ay * by + az * bz, np.sqrt(cx * cx + cy * cy + cz * cz)
    if sine > _FLAT:
        tx, ty, tz = (bx - cosine * ax) / sine, (by - cosine * ay) / sine, (bz - cosine * az) / sine
    else:
        tx, ty, tz = 0.0, 0.0, 0.0
    return tx, ty, tz, np.arctan2(sine, cosine)


@kernel(
    "Tuple((float64[:,::1], int64[::1]))(float64[:,:,::1], Array(int64, 2, 'C', readonly=True), "
    "Array(float64, 1, 'C', readonly=True), Array(int64, 1, 'C', readonly=True))",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def sample_edges(
    corners: Float64Array, edges: Int64Array, limits: Float64Array, steps: Int64Array
) -> tuple[Float64Array, Int64Array]:
    """Follow the edges of boxes in equal angles as seen from the origin.

    Args:
        corners: (B, 8, 3) [m], none at the origin, no edge through it.
        edges: (E, 2), the corners that each edge joins.
        limits: (L,) [rad], rising; how much the longest edge of a box covers at most for it to get …
        steps: (L,) … so many steps along each edge.

    Returns:
        directions: (P, 3) float64, unit: edge by edge of box by box, both ends included.
        starts: (B + 1,) int64, where the directions of each box begin.
    """
    boxes, count = len(corners), len(edges)
    starts = np.zeros(boxes + 1, np.int64)
    units, arcs = np.empty((boxes, 8, 3)), np.empty((boxes, count, 4))
    for b in range(boxes):
        for c in range(8):
            units[b, c, 0], units[b, c, 1], units[b, c, 2] = _unit(
                corners[b, c, 0], corners[b, c, 1], corners[b, c, 2]
            )
        longest = 0.0
        for e in range(count):
            tx, ty, tz, angle = _arc(units[b], edges[e, 0], edges[e, 1])
            arcs[b, e, 0], arcs[b, e, 1], arcs[b, e, 2], arcs[b, e, 3] = tx, ty, tz, angle
            longest = max(longest, angle)
        k = 0
        while k < len(limits) - 1 and longest > limits[k]:
            k += 1
        starts[b + 1] = starts[b] + count * (steps[k] + 1)
    directions = np.empty((starts[boxes], 3))
    for b in range(boxes):
        samples = (starts[b + 1] - starts[b]) // count
        for e in range(count):
            first = edges[e, 0]
            ax, ay, az = units[b, first, 0], units[b, first, 1], units[b, first, 2]
            tx, ty, tz, angle = arcs[b, e, 0], arcs[b, e, 1], arcs[b, e, 2], arcs[b, e, 3]
            step_cosine, step_sine = np.cos(angle / (samples - 1)), np.sin(angle / (samples - 1))
            cosine, sine, row = 1.0, 0.0, starts[b] + e * samples
            for k in range(samples):
                directions[row + k, 0] = cosine * ax + sine * tx
                directions[row + k, 1] = cosine * ay + sine * ty
                directions[row + k, 2] = cosine * az + sine * tz
                cosine, sine = (
                    cosine * step_cosine - sine * step_sine,
                    sine * step_cosine + cosine * step_sine,
                )
    return directions, starts


@njit(nogil=True, error_model="numpy", inline="always")
def _extend(extents, b, u0, v0, u1, v1, width, height):  # type: ignore[no-untyped-def]
    """Let the bounds of a box hold the part of a segment that lies in the image.

    Source: Liang and Barsky 1984, "A New Concept and Method for Line Clipping".
    """
    du, dv, enter, leave = u1 - u0, v1 - v0, 0.0, 1.0
    # a segment along a border is between that pair of borders for ever, or never
    if du == 0.0:
        if u0 < 0.0 or u0 > width:
            return
    else:
        low, high = -u0 / du, (width - u0) / du
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    if dv == 0.0:
        if v0 < 0.0 or v0 > height:
            return
    else:
        low, high = -v0 / dv, (height - v0) / dv
        enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
    if enter <= leave:
        for share in (enter, leave):
            u, v = u0 + share * du, v0 + share * dv
            extents[b, 0], extents[b, 1] = min(extents[b, 0], u), min(extents[b, 1], v)
            extents[b, 2], extents[b, 3] = max(extents[b, 2], u), max(extents[b, 3], v)


@njit(nogil=True, error_model="numpy", inline="always")
def _bulge(before, middle, after):  # type: ignore[no-untyped-def]
    """Where a parabola through three locations rotates; the middle one where it does not rotate near it."""
    bend, slope = before - 2.0 * middle + after, (after - before) / 2.0
    if bend != 0.0 and abs(slope) <= abs(bend):
        return middle - slope * slope / (2.0 * bend)
    return middle


@kernel(
    "Tuple((float64[:,::1], float64[::1], int64[:,::1]))(float64[:,::1], int64[::1], int64, float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def bound_edges(
    pixels: Float64Array, starts: Int64Array, count: int, width: float, height: float
) -> tuple[Float64Array, Float64Array, Int64Array]:
    """Bound the edges of boxes within the image.

    Args:
        pixels: (P, 2) [px], corner convention, of `sample_edges`; NaN beyond the camera model.
        starts: (B + 1,), where those of each box begin.
        count: edges of each box.
        width, height: of the image [px].

    Returns:
        extents: (B, 4) float64 [px], left, top, right, bottom; infinities the wrong way round where no edge is in the
            image.
        shares: (B,) float64, which share of the directions the image shows.
        leaving: (L, 3) int64, steps in which an edge leaves the camera model: the box, the row within and the row
            beyond.
    """
    boxes, lost = len(starts) - 1, 0
    extents, shares = np.empty((boxes, 4)), np.empty(boxes)
    leaving = np.empty((len(pixels), 3), np.int64)
    for b in range(boxes):
        extents[b, 0] = extents[b, 1] = np.inf
        extents[b, 2] = extents[b, 3] = -np.inf
        samples, inside = (starts[b + 1] - starts[b]) // count, 0
        for e in range(count):
            first = starts[b] + e * samples
            for k in range(first, first + samples):
                u, v = pixels[k, 0], pixels[k, 1]
                within = 0.0 <= u <= width and 0.0 <= v <= height
                inside += within
                if within and first < k < first + samples - 1:
                    # how far curved edges reach between their samples
                    rotation_u = _bulge(pixels[k - 1, 0], u, pixels[k + 1, 0])
                    rotation_v = _bulge(pixels[k - 1, 1], v, pixels[k + 1, 1])
                    extents[b, 0], extents[b, 2] = (
                        min(extents[b, 0], rotation_u),
                        max(extents[b, 2], rotation_u),
                    )
                    extents[b, 1], extents[b, 3] = (
                        min(extents[b, 1], rotation_v),
                        max(extents[b, 3], rotation_v),
                    )
                if k == first:
                    continue
                here, before = np.isfinite(u), np.isfinite(pixels[k - 1, 0])
                if here and before:
                    _extend(extents, b, pixels[k - 1, 0], pixels[k - 1, 1], u, v, width, height)
                elif here or before:
                    leaving[lost, 0] = b
                    leaving[lost, 1], leaving[lost, 2] = (k, k - 1) if here else (k - 1, k)
                    lost += 1
        shares[b] = inside / max(starts[b + 1] - starts[b], 1)
        extents[b, 0], extents[b, 1] = max(extents[b, 0], 0.0), max(extents[b, 1], 0.0)
        extents[b, 2], extents[b, 3] = min(extents[b, 2], width), min(extents[b, 3], height)
    return extents, shares, leaving[:lost].copy()


@kernel(
    "void(float64[:,::1], int64[:,::1], float64[:,::1], float64[:,::1], float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def extend_bounds(
    extents: Float64Array,
    leaving: Int64Array,
    begin: Float64Array,
    end: Float64Array,
    width: float,
    height: float,
) -> None:
    """Let bounds hold the last parts of edges that leave the camera model.

    Args:
        extents: (B, 4) [px], changed.
        leaving: (L, 3) of `bound_edges`.
        begin, end: (L, 2) [px], corner convention, where those parts begin and end.
        width, height: of the image [px].
    """
    for k in range(len(leaving)):
        _extend(extents, leaving[k, 0], begin[k, 0], begin[k, 1], end[k, 0], end[k, 1], width, height)


@kernel(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def halve_steps(
    known: Float64Array, unknown: Float64Array, middles: Float64Array, pixels: Float64Array
) -> None:
    """Take the half of each step in which it leaves the camera model, and give the middle of that.

    Args:
        known, unknown: (L, 3), changed: directions within the camera model and beyond it.
        middles: (L, 3), unit, between them; changed.
        pixels: (L, 2), where those are in the image; NaN beyond the camera model.
    """
    for k in range(len(known)):
        if np.isfinite(pixels[k, 0]):
            known[k] = middles[k]
        else:
            unknown[k] = middles[k]
        x, y, z = _unit(known[k, 0] + unknown[k, 0], known[k, 1] + unknown[k, 1], known[k, 2] + unknown[k, 2])
        middles[k, 0], middles[k, 1], middles[k, 2] = x, y, z


@kernel(
    "void(float64[:,::1], float64[:,:,::1], Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 2, 'C', readonly=True))",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def extend_to_corners(
    extents: Float64Array, corners: Float64Array, locations: Float64Array, rays: Float64Array
) -> None:
    """Let bounds hold those corners of the image that look at a box.

    Args:
        extents: (B, 4) [px], changed.
        corners: (B, 8, 3) [m], in the order of `geometry.boxes.CORNER_SIGNS`.
        locations: (C, 2) [px], corner convention.
        rays: (C, 3), along which they look; NaN for none.

    Source: Kay and Kajiya 1986, "Ray Tracing Complex Scenes": a ray is in a box while it is between all pairs of faces.
    """
    for b in range(len(extents)):
        for c in range(len(rays)):
            enter, leave = -np.inf, np.inf
            for axis in range(3):
                last = 1 if axis == 0 else (3 if axis == 1 else 4)
                along, middle, square = 0.0, 0.0, 0.0
                for k in range(3):
                    half = (corners[b, 0, k] - corners[b, last, k]) / 2.0
                    along += half * rays[c, k]
                    middle += half * (corners[b, 0, k] + corners[b, 6, k]) / 2.0
                    square += half * half
                first, second = (middle - square) / along, (middle + square) / along
                enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
            if enter <= leave and enter > 0.0 and np.isfinite(rays[c, 0]):
                extents[b, 0], extents[b, 2] = (
                    min(extents[b, 0], locations[c, 0]),
                    max(extents[b, 2], locations[c, 0]),
                )
                extents[b, 1], extents[b, 3] = (
                    min(extents[b, 1], locations[c, 1]),
                    max(extents[b, 3], locations[c, 1]),
                )


_PART: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}

_BEHIND = 1e-9
"""Of two boxes that begin at the same location, to this share of the distance, neither hides the other."""


@numba.njit(**_PART)
def _centre(k, b, centers, lines, drifts):  # type: ignore[no-untyped-def]
    """Where a box is from where ray k begins, while the line of the ray was taken."""
    x, y, z = centers[b, 0], centers[b, 1], centers[b, 2]
    if len(lines):
        x += lines[k, 3] * drifts[b, 0] - lines[k, 0]
        y += lines[k, 3] * drifts[b, 1] - lines[k, 1]
        z += lines[k, 3] * drifts[b, 2] - lines[k, 2]
    return x, y, z


@numba.njit(**_PART)
def _crossing(x, y, z, centre, b, rotations, halves):  # type: ignore[no-untyped-def]
    """Where a ray from the origin enters and leaves a box, in lengths of the ray; the first is larger if it misses."""
    near, far = -np.inf, np.inf
    for axis in range(3):
        along = rotations[b, 0, axis] * x + rotations[b, 1, axis] * y + rotations[b, 2, axis] * z
        middle = (
            rotations[b, 0, axis] * centre[0]
            + rotations[b, 1, axis] * centre[1]
            + rotations[b, 2, axis] * centre[2]
        )
        if along == 0.0:
            if abs(middle) > halves[b, axis]:
                return 1.0, 0.0
            continue
        first, last = (middle - halves[b, axis]) / along, (middle + halves[b, axis]) / along
        near, far = max(near, min(first, last)), min(far, max(first, last))
    return near, far


@numba.njit(**_PART)
def _entry(x, y, z, centre, b, rotations, halves):  # type: ignore[no-untyped-def]
    """Where a ray from the origin enters a box, in lengths of the ray; infinity where it misses it or starts in it."""
    near, far = _crossing(x, y, z, centre, b, rotations, halves)
    if near <= far and near > 0.0:
        return near
    return np.inf


@kernel(
    "void(float64[:,::1], int64[::1], float64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], "
    "float64[:,::1], int64[::1], int64[::1], int64[::1], int64[::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def count_observations(
    rays: Float64Array,
    ray_starts: Int64Array,
    centers: Float64Array,
    rotations: Float64Array,
    halves: Float64Array,
    lines: Float64Array,
    drifts: Float64Array,
    rival_starts: Int64Array,
    rivals: Int64Array,
    met: Int64Array,
    hidden: Int64Array,
) -> None:
    """Count the rays that meet each box, and those of them that meet another one before.

    Args:
        rays: (R, 3) from the origin, or from where `lines` says; one with a NaN meets nothing.
        ray_starts: (B + 1,), which rays belong to each box.
        centers: (B, 3) [m].
        rotations: (B, 3, 3), whose columns are the boxes' axes.
        halves: (B, 3) [m], half of length, width and height.
        lines: (R, 4), of a rolling shutter, where each ray begins [m], and at which share of the time in which the
            image was taken, -0.5 to 0.5; (0, 4) where it was taken at once.
        drifts: (B, 3) [m], how far the boxes go in that time; of no account without `lines`.
        rival_starts: (B + 1,), which of `rivals` belong to each box.
        rivals: numbers of the boxes that may stand before it.
        met: (B,), filled.
        hidden: (B,), filled.

    Source: Kay and Kajiya 1986, "Ray Tracing Complex Scenes": a ray is in a box while it is between all pairs of faces.
    """
    for b in range(len(centers)):
        met[b] = hidden[b] = 0
        for k in range(ray_starts[b], ray_starts[b + 1]):
            x, y, z = rays[k, 0], rays[k, 1], rays[k, 2]
            own = _entry(x, y, z, _centre(k, b, centers, lines, drifts), b, rotations, halves)
            if not own < np.inf:
                continue
            met[b] += 1
            for r in range(rival_starts[b], rival_starts[b + 1]):
                rival = rivals[r]
                centre = _centre(k, rival, centers, lines, drifts)
                if _entry(x, y, z, centre, rival, rotations, halves) < own * (1.0 - _BEHIND):
                    hidden[b] += 1
                    break


@kernel(
    "void(float64[:,::1], float64[:,::1], float64[:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], "
    "float64[:,::1], float64[:,::1], float64, int64[:,::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def count_evidence(
    points: Float64Array,
    pixels: Float64Array,
    extents: Float64Array,
    centers: Float64Array,
    rotations: Float64Array,
    halves: Float64Array,
    lines: Float64Array,
    drifts: Float64Array,
    margin: float,
    evidence: Int64Array,
) -> None:
    """Count the points that lie before each box, as the camera sees them, and those that lie on or in it.

    Args:
        points: (N, 3) [m], from where the camera saw them: the origin, or where `lines` says.
        pixels: (N, 2) [px], where they are in the image; NaN for those that are not.
        extents: (B, 4) [px], left, top, right, bottom of each box in the image.
        centers, rotations, halves, lines, drifts: as in `count_observations`, a ray being that to a point.
        margin: how far outside its faces a point still counts as on a box [m].
        evidence: (B, 2), filled: points before it, points on it.
    """
    evidence[:] = 0
    for i in range(len(points)):
        u, v = pixels[i, 0], pixels[i, 1]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        slack = margin / np.sqrt(x * x + y * y + z * z)
        for b in range(len(centers)):
            if extents[b, 0] <= u <= extents[b, 2] and extents[b, 1] <= v <= extents[b, 3]:
                centre = _centre(i, b, centers, lines, drifts)
                near, far = _crossing(x, y, z, centre, b, rotations, halves)
                if near <= far and far > 0.0:
                    if near - slack > 1.0:
                        evidence[b, 0] += 1
                    elif far + slack >= 1.0:
                        evidence[b, 1] += 1


_MOST_CELLS = 1 << 18

_MOST_ENTRIES = 1 << 25

_SMALLEST_CELL = 0.5

_CELLS_PER_BOX = 0.25
"""Cells of a quarter of the usual box's length: fewer make points meet boxes that they are far from."""

_POINTS_IN_BOXES_PART: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}


@numba.njit(nogil=True, cache=True, error_model="numpy")
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


@numba.njit(nogil=True, cache=True, error_model="numpy")
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
    for rotation_of_vector in range(2):
        if rotation_of_vector == 1:
            listed = np.empty(starts[-1], np.int64)
        for b in range(len(bounds)):
            first_x, last_x = int((bounds[b, 0] - low_x) / cell), int((bounds[b, 2] - low_x) / cell)
            first_y, last_y = int((bounds[b, 1] - low_y) / cell), int((bounds[b, 3] - low_y) / cell)
            for x in range(first_x, min(last_x, columns - 1) + 1):
                for y in range(first_y, min(last_y, rows - 1) + 1):
                    if rotation_of_vector == 0:
                        starts[x * rows + y + 1] += 1
                    else:
                        listed[starts[x * rows + y]] = b
                        starts[x * rows + y] += 1
        if rotation_of_vector == 0:
            starts = np.cumsum(starts)
    starts[1:] = starts[:-1].copy()
    starts[0] = 0
    return low_x, low_y, cell, columns, rows, starts, listed


@numba.njit(**_POINTS_IN_BOXES_PART)
def _in_box(  # type: ignore[no-untyped-def]
    x, y, z, b, knot, share, centers, rotations, halves
):
    """Report whether a point lies in a box, its faces included.

    At a share of the trajectory from one knot to the next.
    """
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


_ROWS_F32 = types.Array(float32, 2, "C", readonly=True)

_ROWS_F64 = types.Array(float64, 2, "C", readonly=True)

_REST = (float64[::1], float64[:, :, ::1], float64[:, :, :, ::1], float64[:, :, ::1], int64[::1], int64[::1])


@kernel([void(_ROWS_F32, *_REST), void(_ROWS_F64, *_REST)], nogil=True, cache=True, error_model="numpy")
def find_points_in_boxes(
    points: FloatArray,
    locations: Float64Array,
    centers: Float64Array,
    rotations: Float64Array,
    halves: Float64Array,
    stops: Int64Array,
    point_ids: Int64Array,
) -> None:
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


_CLOUD, _TABLE = "Array(float32, 2, 'C', readonly=True)", "Array(float64, 2, 'C', readonly=True)"

_VECTOR = "Array(float64, 1, 'C', readonly=True)"


@kernel(
    f"int64[::1]({_CLOUD}, {_VECTOR}, {_TABLE}, {_VECTOR})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def points_in_cones(
    points: Float32Array, apex: Float64Array, axes: Float64Array, cosines: Float64Array
) -> Int64Array:
    """Choose the points that lie in any of the cones.

    Args:
        points: (N, 3) [m]; those that are not finite lie in none.
        apex: (3,) [m], where all cones begin.
        axes: (L, 3), unit, where they lead.
        cosines: (L,), of the angles between their axes and their sides, above 0.

    Returns:
        (M,) int64, rising, which points.
    """
    kept, count = np.empty(len(points), np.int64), 0
    for n in range(len(points)):
        x, y, z = points[n, 0] - apex[0], points[n, 1] - apex[1], points[n, 2] - apex[2]
        square = x * x + y * y + z * z
        for k in range(len(axes)):
            along = x * axes[k, 0] + y * axes[k, 1] + z * axes[k, 2]
            if along > 0.0 and along * along >= cosines[k] * cosines[k] * square and square < np.inf:
                kept[count] = n
                count += 1
                break
    return kept[:count]
