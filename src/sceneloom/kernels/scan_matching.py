"""How a sweep fits onto a map of surfaces, and what would make it fit better, while the lidar moves."""

import math

import numpy as np
from numba import float64, int32, int64, types

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.poses import rotation_of_vector
from sceneloom.kernels.surface_map import INNER, find_cube, first_location, pack_key

SUPPORT = 0.25
"""A surface has a quarter of its weight 2 standard deviations from its middle, along the surface."""
_READ_F64_1D = types.Array(float64, 1, "C", readonly=True)
_READ_F64_2D = types.Array(float64, 2, "C", readonly=True)


@kernel(int64(_READ_F64_2D, float64, int64[::1]), cache=True, nogil=True)
def thin_points(points: Float64Array, leaf: float, chosen: Int64Array) -> int:
    """Choose one point of each cube of side `leaf` [m]: the first that fell into it.

    Args:
        points: (N, 3) [m], finite.
        chosen: (N,) the chosen points' numbers are written here, ascending.

    Returns:
        How many were chosen.
    """
    length = 1024
    while length < 2 * points.shape[0]:
        length *= 2
    mask, count = length - 1, 0
    taken = np.full(length, -1, np.int64)
    for i in range(points.shape[0]):
        key = pack_key(
            math.floor(points[i, 0] / leaf),
            math.floor(points[i, 1] / leaf),
            math.floor(points[i, 2] / leaf),
        )
        location = first_location(key, mask)
        while taken[location] >= 0 and taken[location] != key:
            location = (location + 1) & mask
        if taken[location] < 0:
            taken[location] = key
            chosen[count] = i
            count += 1
    return count


@kernel(
    types.void(
        _READ_F64_2D, _READ_F64_1D, _READ_F64_2D, _READ_F64_1D, _READ_F64_1D, _READ_F64_1D, float64[:, ::1],
        float64[:, ::1],
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def move_points(
    points_ego: Float64Array,
    seconds: Float64Array,
    rotation: Float64Array,
    position: Float64Array,
    yaw_rate: Float64Array,
    velocity: Float64Array,
    points_world: Float64Array,
    arms: Float64Array,
) -> None:
    """Take points of a rotating, moving ego into the world, each at its own time.

    p_world(t) = position + t v + t²/2 (ω × v) + Exp(t ω) R p_ego: a constant velocity in the ego's own frame, to the
    second order in t.

    Args:
        points_ego: (N, 3) [m].
        seconds: (N,) time of each point after the pose's.
        rotation, position: (3, 3) and (3,) [m], `world_from_ego`.
        yaw_rate, velocity: (3,) [rad/s] and [m/s], world axes, at the pose's time.
        points_world: (N, 3), written here.
        arms: (N, 3), written here: from the ego to the points, world axes.
    """
    rotated, step = np.empty((3, 3)), np.empty(3)
    cx = yaw_rate[1] * velocity[2] - yaw_rate[2] * velocity[1]
    cy = yaw_rate[2] * velocity[0] - yaw_rate[0] * velocity[2]
    cz = yaw_rate[0] * velocity[1] - yaw_rate[1] * velocity[0]
    last = math.nan
    for i in range(points_ego.shape[0]):
        t = seconds[i]
        if t != last:
            for k in range(3):
                step[k] = t * yaw_rate[k]
            rotation_of_vector(step, rotated)
            last = t
        px, py, pz = points_ego[i, 0], points_ego[i, 1], points_ego[i, 2]
        x = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
        y = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
        z = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
        ax = rotated[0, 0] * x + rotated[0, 1] * y + rotated[0, 2] * z
        ay = rotated[1, 0] * x + rotated[1, 1] * y + rotated[1, 2] * z
        az = rotated[2, 0] * x + rotated[2, 1] * y + rotated[2, 2] * z
        arms[i, 0], arms[i, 1], arms[i, 2] = ax, ay, az
        half = 0.5 * t * t
        points_world[i, 0] = position[0] + t * velocity[0] + half * cx + ax
        points_world[i, 1] = position[1] + t * velocity[1] + half * cy + ay
        points_world[i, 2] = position[2] + t * velocity[2] + half * cz + az


@kernel(
    types.void(
        float64, float64, float64, float64, float64, int32[::1], int64[::1], float64[:, ::1], float64[::1]
    ),
    **INNER,
)  # fmt: skip
def _meet_surfaces(
    x: float,
    y: float,
    z: float,
    leaf: float,
    inverse2: float,
    table: AnyArray,
    keys: Int64Array,
    surfaces: Float64Array,
    met: Float64Array,
) -> None:
    """Sum what the surfaces of the eight cubes around a location state about a point there.

    A surface counts where its own points lie: the weight falls with the distance along it, in standard deviations.

    Args:
        inverse2: 1 / scale², of the robust weight.
        met: (12,) written here: Σ w W r (3), Σ w W (6), Σ w, Σ w s², Σ a.
    """
    met[:] = 0.0
    ix, iy, iz = math.floor(x / leaf - 0.5), math.floor(y / leaf - 0.5), math.floor(z / leaf - 0.5)
    for k in range(8):
        key = pack_key(ix + (k & 1), iy + ((k >> 1) & 1), iz + (k >> 2))
        cube = find_cube(key, table, keys)
        if cube < 0:
            continue
        s = surfaces[cube]
        if s[3] + s[6] + s[8] == 0.0:
            continue
        dx, dy, dz = x - s[0], y - s[1], z - s[2]
        rx = s[3] * dx + s[4] * dy + s[5] * dz
        ry = s[4] * dx + s[6] * dy + s[7] * dz
        rz = s[5] * dx + s[7] * dy + s[8] * dz
        squared = dx * rx + dy * ry + dz * rz
        along = (
            dx * (s[9] * dx + 2.0 * (s[10] * dy + s[11] * dz))
            + dy * (s[12] * dy + 2.0 * s[13] * dz)
            + s[14] * dz * dz
        )
        near = 1.0 / (1.0 + SUPPORT * along)
        near *= near
        w = 1.0 / (1.0 + squared * inverse2)
        w *= w * near
        met[0] += w * rx
        met[1] += w * ry
        met[2] += w * rz
        for c in range(6):
            met[3 + c] += w * s[3 + c]
        met[9] += w
        met[10] += w * squared
        met[11] += near


@kernel(types.void(float64[:, :, ::1]), **INNER)
def _mirror(matrices: Float64Array) -> None:
    """Fill the lower halves of symmetric matrices."""
    for k in range(matrices.shape[0]):
        for r in range(6):
            for c in range(r):
                matrices[k, r, c] = matrices[k, c, r]


@kernel(
    types.void(
        _READ_F64_1D, float64, float64[::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1]
    ),
    **INNER,
)  # fmt: skip
def _add_point(
    arm: Float64Array,
    t: float,
    met: Float64Array,
    j: Float64Array,
    wj: Float64Array,
    information: Float64Array,
    gradient: Float64Array,
) -> None:
    """Add what surfaces state about one point: `met` as `_meet_surfaces` gives it; `j` and `wj` are room for work."""
    # -[arm]x, so that a rotation about the world's axes moves the point by rotation x arm
    j[0, 1], j[0, 2] = arm[2], -arm[1]
    j[1, 0], j[1, 2] = -arm[2], arm[0]
    j[2, 0], j[2, 1] = arm[1], -arm[0]
    for c in range(6):
        wj[0, c] = met[3] * j[0, c] + met[4] * j[1, c] + met[5] * j[2, c]
        wj[1, c] = met[4] * j[0, c] + met[6] * j[1, c] + met[7] * j[2, c]
        wj[2, c] = met[5] * j[0, c] + met[7] * j[1, c] + met[8] * j[2, c]
    for r in range(6):
        g = j[0, r] * met[0] + j[1, r] * met[1] + j[2, r] * met[2]
        gradient[0, r] += g
        gradient[1, r] += t * g
        for c in range(r, 6):
            h = j[0, r] * wj[0, c] + j[1, r] * wj[1, c] + j[2, r] * wj[2, c]
            information[0, r, c] += h
            information[1, r, c] += t * h
            information[2, r, c] += t * t * h


@kernel(
    types.void(
        _READ_F64_2D, _READ_F64_2D, _READ_F64_1D, float64, float64, int32[::1], int64[::1], float64[:, ::1], float64,
        int32[::1], int64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)  # fmt: skip
def accumulate_normal_equations(
    points_world: Float64Array,
    arms: Float64Array,
    seconds: Float64Array,
    scale: float,
    fine_leaf: float,
    fine_table: AnyArray,
    fine_keys: Int64Array,
    fine_surfaces: Float64Array,
    coarse_leaf: float,
    coarse_table: AnyArray,
    coarse_keys: Int64Array,
    coarse_surfaces: Float64Array,
    information: Float64Array,
    gradient: Float64Array,
    sums: Float64Array,
) -> None:
    """Sum what each point says about a small rotation and shift of the ego, and about their rates.

    What the fine surfaces around a point do not cover is left to the coarse ones.

    Args:
        points_world, arms, seconds: as `move_points` gives them.
        scale: residuals of this many standard deviations lose most of their weight.
        fine_leaf, coarse_leaf: sides of the cubes [m]; tables, keys and surfaces are those of the map's two levels.
        information: (3, 6, 6) written here: Σ w Jᵀ W J, the same times t, and times t², for a rotation, then a shift.
        gradient: (2, 6) written here: Σ w Jᵀ W r, and the same times t.
        sums: (4,) written here: points with a surface, Σ w, Σ w s², points that agree with theirs.
    """
    information[:] = 0.0
    gradient[:] = 0.0
    sums[:] = 0.0
    j, wj, met, rest = np.zeros((3, 6)), np.empty((3, 6)), np.empty(12), np.empty(12)
    j[0, 3] = j[1, 4] = j[2, 5] = 1.0
    inverse2 = 1.0 / (scale * scale)
    for i in range(points_world.shape[0]):
        x, y, z = points_world[i, 0], points_world[i, 1], points_world[i, 2]
        _meet_surfaces(x, y, z, fine_leaf, inverse2, fine_table, fine_keys, fine_surfaces, met)
        if met[11] < 1.0:
            _meet_surfaces(x, y, z, coarse_leaf, inverse2, coarse_table, coarse_keys, coarse_surfaces, rest)
            share = (1.0 - met[11]) / max(1.0, rest[11])
            for c in range(12):
                met[c] += share * rest[c]
        if met[11] == 0.0:
            continue
        share = 1.0 / max(1.0, met[11])
        for c in range(11):
            met[c] *= share
        sums[0] += 1.0
        sums[1] += met[9]
        sums[2] += met[10]
        # a robust weight above a quarter: within `scale` standard deviations
        if 4.0 * met[9] > min(1.0, met[11]):
            sums[3] += 1.0
        _add_point(arms[i], seconds[i], met, j, wj, information, gradient)
    _mirror(information)
