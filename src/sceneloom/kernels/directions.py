"""Where points lie as seen from a camera: direction in an equal-area map of the sphere, and inverse range."""

import math

import numba
from numba import float32, int64, types, void

from sceneloom.arrays import Float32Array, Float64Array, Int64Array

_IN_F64_2D = types.Array(types.float64, 2, "C", readonly=True)
_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_BEHIND = 1e-6
"""Least value of 1 + cos θ: keeps the map finite for a point straight behind the camera."""


@numba.njit(
    void(_IN_F64_2D, _IN_I64_1D, _IN_F64_2D, float32[:, ::1], float32[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def map_directions(
    points_world: Float64Array,
    point_ids: Int64Array,
    camera_from_world: Float64Array,
    directions: Float32Array,
    inverse_ranges: Float32Array,
) -> None:
    """Write the direction and the inverse range of the points with the given ids.

    The map is Lambert's azimuthal one around the optical axis: a direction at angle θ off the axis lies at radius
    2 sin(θ/2). Its scale is within cos(θ/2) of 1 [1/rad] everywhere, so a distance in it is an angle, whatever the
    lens does to pixels.

    Args:
        points_world: (N, 3) [m].
        point_ids: (M,), rows of `points_world`.
        camera_from_world: (3, 4) or (4, 4).
        directions: (M, 2), written: rightward and downward, inside the disc of radius 2.
        inverse_ranges: (M,) [1/m], written; 0 for a point that is not finite, lies in the camera's centre, or
            does not exist.

    Source: J. P. Snyder, Map Projections - A Working Manual, 1987, eq. 24-2.
    """
    m = camera_from_world
    for i in range(point_ids.shape[0]):
        directions[i, 0] = directions[i, 1] = inverse_ranges[i] = 0.0
        k = point_ids[i]
        if k < 0 or k >= points_world.shape[0]:
            continue
        px, py, pz = points_world[k, 0], points_world[k, 1], points_world[k, 2]
        x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
        y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
        squared = x * x + y * y + z * z
        if not (1e-12 < squared < 1e18):
            continue
        inverse = 1.0 / math.sqrt(squared)
        scale = inverse * math.sqrt(2.0 / max(1.0 + z * inverse, _BEHIND))
        directions[i, 0] = x * scale
        directions[i, 1] = y * scale
        inverse_ranges[i] = inverse
