"""Where points lie as seen from a camera: direction in an equal-area map of the sphere, and inverse range."""

import math

import numba
from numba import float32, float64, int64, types, void

from sceneloom.arrays import Float32Array, Float64Array, Int64Array

_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)
_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_NOTHING, _ONE, _TWO = float32(0.0), float32(1.0), float32(2.0)
_BEHIND = float32(1e-6)
"""Least value of 1 + cos θ: keeps the map finite for a point straight behind the camera."""
_NEAREST, _FARTHEST = float32(1e-6), float32(1e9)
"""Ranges that give a direction [m]."""


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
    2 sin(θ/2). Its scale is cos(θ/2) along the radius and 1/cos(θ/2) across it, so that a distance in it is nearly an
    angle, whatever the lens does to pixels.

    Args:
        points_world: (N, 3) [m].
        point_ids: (M,), rows of `points_world`.
        camera_from_world: (3, 4) or (4, 4).
        directions: (M, 2), written: rightward and downward, inside the disc of radius 2.
        inverse_ranges: (M,) [1/m], written; 0 for a point that is not finite, lies in the camera's centre, or
            does not exist.

    Source: J. P. Snyder, Map Projections - A Working Manual, 1987, eq. 24-1 and 24-2.
    """
    m = camera_from_world
    for i in range(point_ids.shape[0]):
        directions[i, 0] = directions[i, 1] = inverse_ranges[i] = _NOTHING
        k = point_ids[i]
        if k < 0 or k >= points_world.shape[0]:
            continue
        px, py, pz = points_world[k, 0], points_world[k, 1], points_world[k, 2]
        x = float32(m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3])
        y = float32(m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3])
        z = float32(m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3])
        range_m = math.sqrt(x * x + y * y + z * z)
        if not _NEAREST < range_m < _FARTHEST:
            continue
        # 2 sin(θ/2) / sin θ = sqrt(2 / (1 + cos θ)), with one division for this and for the inverse range.
        ahead = max(range_m + z, _BEHIND * range_m)
        shared = _ONE / (range_m * ahead)
        scale = math.sqrt(_TWO * shared)
        directions[i, 0] = x * scale
        directions[i, 1] = y * scale
        inverse_ranges[i] = shared * ahead
