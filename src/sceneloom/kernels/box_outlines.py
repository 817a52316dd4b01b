"""What bounds boxes in an image: their edges as curves of any camera model.

And corners of the image that look at them.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array
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
