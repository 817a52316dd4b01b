"""Delaunay triangulation of points with whole coordinates: exact, by insertion.

Each point goes to its location by walking over the triangles from that of the point before. The triangles whose
circumcircle holds it are taken away, and the hole is closed with triangles around it. With coordinates below
`MOST_EXTENT` both predicates are exact in 64 bits, so the hole is always star-shaped and nothing can go wrong.

Source: Bowyer 1981 and Watson 1981, The Computer Journal 24 (2).
"""

from typing import Any

import numba
import numpy as np
from numba import int32, int64, types, void

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.kernels.cache import kernel

MOST_EXTENT = 29_000
"""Largest difference of two coordinates, corners included: 12 times its fourth power stays below 2⁶³."""

_CURVE_SIDE = 1 << 15

CORNERS = 4
"""The first points are the corners of a rectangle that holds all others."""

_IN_I64_2D = types.Array(int64, 2, "C", readonly=True)
_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)
_PART: dict[str, Any] = {"nogil": True, "inline": "always", "error_model": "numpy"}


@numba.njit(**_PART)
def _rotation(points: Int64Array, a: int, b: int, p: int) -> int:
    """Positive where p lies to the side of the line from a to b that inner points of triangles lie on."""
    rotation_of_vector: int = (points[b, 0] - points[a, 0]) * (points[p, 1] - points[a, 1]) - (
        points[b, 1] - points[a, 1]
    ) * (points[p, 0] - points[a, 0])
    return rotation_of_vector


@numba.njit(**_PART)
def _in_circle(points: Int64Array, corners: AnyArray, p: int) -> bool:
    ax, ay = points[corners[0], 0] - points[p, 0], points[corners[0], 1] - points[p, 1]
    bx, by = points[corners[1], 0] - points[p, 0], points[corners[1], 1] - points[p, 1]
    cx, cy = points[corners[2], 0] - points[p, 0], points[corners[2], 1] - points[p, 1]
    a, b, c = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    return bool(ax * (by * c - cy * b) - ay * (bx * c - cx * b) + a * (bx * cy - cx * by) > 0)


@numba.njit(**_PART)
def _locate(points: Int64Array, triangles: AnyArray, beside: AnyArray, start: int, p: int) -> int:
    """Walk to the triangle that holds the point."""
    at, rotated = start, True
    while rotated:
        rotated = False
        for k in range(3):
            a, b = triangles[at, (k + 1) % 3], triangles[at, (k + 2) % 3]
            if _rotation(points, a, b, p) < 0:
                at, rotated = beside[at, k], True
                break
    return at


@numba.njit(**_PART)
def _open_hole(
    points: Int64Array,
    triangles: AnyArray,
    beside: AnyArray,
    first: int,
    p: int,
    marks: AnyArray,
    hole: AnyArray,
    rim: AnyArray,
) -> tuple[int, int]:
    """List the triangles whose circle holds the point, and the rim: (from, to, triangle beyond) of each edge."""
    hole[0], marks[first], taken, edges, done = first, p, 1, 0, 0
    while done < taken:
        at = hole[done]
        done += 1
        for k in range(3):
            other = beside[at, k]
            if other >= 0 and marks[other] == p:
                continue
            if other >= 0 and _in_circle(points, triangles[other], p):
                marks[other] = p
                hole[taken] = other
                taken += 1
            else:
                rim[edges, 0], rim[edges, 1] = triangles[at, (k + 1) % 3], triangles[at, (k + 2) % 3]
                rim[edges, 2] = other
                edges += 1
    return taken, edges


@numba.njit(**_PART)
def _close_hole(
    triangles: AnyArray,
    beside: AnyArray,
    count: int,
    p: int,
    hole: AnyArray,
    taken: int,
    rim: AnyArray,
    edges: int,
    starting: AnyArray,
    marks: AnyArray,
) -> int:
    """Fill the hole with a fan around the point; triangle k of it stands on edge k of the rim."""
    for k in range(edges):
        new = hole[k] if k < taken else count + k - taken
        a, b, beyond = rim[k, 0], rim[k, 1], rim[k, 2]
        triangles[new, 0], triangles[new, 1], triangles[new, 2] = a, b, p
        beside[new, 2] = beyond
        marks[new] = -1
        starting[a] = new
        if beyond >= 0:
            for m in range(3):
                if triangles[beyond, (m + 1) % 3] == b and triangles[beyond, (m + 2) % 3] == a:
                    beside[beyond, m] = new
    for k in range(edges):
        new = hole[k] if k < taken else count + k - taken
        following = starting[rim[k, 1]]
        beside[new, 0] = following
        beside[following, 1] = new
    return count + edges - taken


@kernel(int64(_IN_I64_2D, _IN_I64_1D, int32[:, ::1]), cache=True, nogil=True, error_model="numpy")
def triangulate(points: Int64Array, order: Int64Array, triangles: AnyArray) -> int:
    """Triangulate points so that no circumcircle holds another point.

    Args:
        points: (4 + N, 2); the first four are corners (left top, right top, right bottom, left bottom) of a rectangle
            inside which all others lie.
        order: (N,) the rows of the others in the order of their insertion, best along a curve that fills the plane.
        triangles: (2 N + 2, 3), written: rows of `points`, all rotating the same way.

    Returns:
        How many triangles were written. Those of the corners are among them; the second of two equal points is in none.
    """
    most = triangles.shape[0]
    beside, marks = np.full((most, 3), -1, np.int32), np.full(most, -1, np.int32)
    hole, rim = np.empty(most, np.int32), np.empty((most + 2, 3), np.int32)
    starting = np.empty(points.shape[0], np.int32)
    triangles[0, 0], triangles[0, 1], triangles[0, 2] = 0, 1, 2
    triangles[1, 0], triangles[1, 1], triangles[1, 2] = 0, 2, 3
    beside[0, 1], beside[1, 2] = 1, 0
    count, at = 2, 0
    for i in range(order.shape[0]):
        p = order[i]
        at = _locate(points, triangles, beside, at, p)
        known = False
        for k in range(3):
            corner = triangles[at, k]
            known |= points[corner, 0] == points[p, 0] and points[corner, 1] == points[p, 1]
        if known:
            continue
        taken, edges = _open_hole(points, triangles, beside, at, p, marks, hole, rim)
        count = _close_hole(triangles, beside, count, p, hole, taken, rim, edges, starting, marks)
        at = starting[rim[0, 0]]
    return count


@kernel(void(_IN_I64_2D, int64[::1]), cache=True, nogil=True)
def hilbert_codes(points: Int64Array, codes: Int64Array) -> None:
    """Number points along a curve that fills the plane, so that neighbours in the order lie near each other.

    Args:
        points: (N, 2), 0 to 2¹⁵ - 1.
        codes: (N,), written.

    Source: Hilbert 1891, Mathematische Annalen 38.
    """
    for i in range(points.shape[0]):
        x, y, code = points[i, 0], points[i, 1], int64(0)
        side = _CURVE_SIDE >> 1
        while side > 0:
            right, below = int64((x & side) > 0), int64((y & side) > 0)
            code += side * side * ((3 * right) ^ below)
            if below == 0:
                if right == 1:
                    x, y = _CURVE_SIDE - 1 - x, _CURVE_SIDE - 1 - y
                x, y = y, x
            side >>= 1
        codes[i] = code
