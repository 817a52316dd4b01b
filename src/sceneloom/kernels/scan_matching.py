"""How a sweep fits onto a map of surfaces, and what would make it fit better, while the lidar moves."""

import math

import numpy as np
from numba import float64, int32, int64, types, uint8

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.poses import rotation_of_vector
from sceneloom.kernels.signatures import IN_F64_1D, IN_F64_2D, inlined
from sceneloom.kernels.voxels import first_location

SUPPORT = 0.25
"""A surface has a quarter of its weight 2 standard deviations from its middle, along the surface."""


@kernel(types.void(IN_F64_2D, IN_F64_1D, IN_F64_2D, IN_F64_1D, IN_F64_1D, IN_F64_1D, float64[:, ::1], float64[:, ::1]))
def move_points(
    points_ego: Float64Array, seconds: Float64Array, rotation: Float64Array, position: Float64Array,
    yaw_rate: Float64Array, velocity: Float64Array, points_world: Float64Array, arms: Float64Array,
) -> None:  # fmt: skip
    """Take points of a rotating, moving ego into the world, each at its own time.

    p_world(t) = position + t v + t²/2 (ω × v) + Exp(t ω) R p_ego: a constant velocity in the ego's own frame, to the
    second order in t.

    `points_ego` (N, 3) [m]; `seconds` (N,) time of each point after the pose's; `rotation`, `position` (3, 3) and (3,)
    [m], `world_from_ego`; `yaw_rate`, `velocity` (3,) [rad/s] and [m/s], world axes, at the pose's time; `points_world`
    (N, 3), written here; `arms` (N, 3), written here: from the ego to the points, world axes.
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


@kernel(types.void(float64, float64, float64, float64, float64, int32[::1], int64[::1], float64[:, ::1], float64[::1]))
def _meet_surfaces(
    x: float, y: float, z: float, leaf: float, inverse2: float, table: AnyArray, keys: Int64Array,
    surfaces: Float64Array, met: Float64Array,
) -> None:  # fmt: skip
    """Sum what the surfaces of the eight cubes around a location state about a point there.

    A surface counts where its own points lie: the weight falls with the distance along it, in standard deviations.

    `inverse2`: 1 / scale², of the robust weight; `met` (12,) written here: Σ w W r (3), Σ w W (6), Σ w, Σ w s², Σ a.
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
            dx * (s[9] * dx + 2.0 * (s[10] * dy + s[11] * dz)) + dy * (s[12] * dy + 2.0 * s[13] * dz) + s[14] * dz * dz
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


@kernel(types.void(float64[:, :, ::1]))
def _mirror(matrices: Float64Array) -> None:
    """Fill the lower halves of symmetric matrices."""
    for k in range(matrices.shape[0]):
        for r in range(6):
            for c in range(r):
                matrices[k, r, c] = matrices[k, c, r]


@kernel(types.void(
    IN_F64_1D, float64, float64[::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1]
))  # fmt: skip
def _add_point(
    arm: Float64Array, t: float, met: Float64Array, j: Float64Array, wj: Float64Array, information: Float64Array,
    gradient: Float64Array,
) -> None:  # fmt: skip
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


@kernel(types.void(
    IN_F64_2D, IN_F64_2D, IN_F64_1D, float64, float64, int32[::1], int64[::1], float64[:, ::1], float64, int32[::1],
    int64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[::1]
))  # fmt: skip
def accumulate_normal_equations(
    points_world: Float64Array, arms: Float64Array, seconds: Float64Array, scale: float, fine_leaf: float,
    fine_table: AnyArray, fine_keys: Int64Array, fine_surfaces: Float64Array, coarse_leaf: float,
    coarse_table: AnyArray, coarse_keys: Int64Array, coarse_surfaces: Float64Array, information: Float64Array,
    gradient: Float64Array, sums: Float64Array,
) -> None:  # fmt: skip
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


SIDE = 4
"""A cube is cut into this many parts along each axis; each part takes a few points, so that near scan lines, which
are dense, do not outweigh the rest."""

_LINE_SHARE, _THIN_SHARE = 0.04, 0.1
"""Of the largest eigenvalue: a middle one below the first is that of a line; one above the second states nothing."""

_STEEP = 0.7  # a line is steep where its direction has at least this z
_HALF_KEY = 1 << 20


@inlined
def pack_key(ix: int, iy: int, iz: int) -> int:
    """One number for the cube (ix, iy, iz), each within ±2^20."""
    return ((ix + _HALF_KEY) << 42) | ((iy + _HALF_KEY) << 21) | (iz + _HALF_KEY)


@kernel(int64(int64, int32[::1], int64[::1]))
def find_cube(key: int, table: AnyArray, keys: Int64Array) -> int:
    """The number of the cube with a key, or -1."""
    mask = table.shape[0] - 1
    location = first_location(key, mask)
    while True:
        cube = table[location]
        if cube < 0:
            return -1
        if keys[cube] == key:
            return int(cube)
        location = (location + 1) & mask


@kernel(types.void(int64, int64[::1], int32[::1]))
def fill_table(count: int, keys: Int64Array, table: AnyArray) -> None:
    """Write the first `count` cubes into an empty table (-1 everywhere) whose length is a power of two."""
    mask = table.shape[0] - 1
    for cube in range(count):
        location = first_location(keys[cube], mask)
        while table[location] >= 0:
            location = (location + 1) & mask
        table[location] = cube


@kernel(types.void(
    IN_F64_2D, int64[::1], float64, int64, int32[::1], int64[::1], float64[:, ::1], uint8[:, ::1], uint8[::1]
))  # fmt: skip
def insert_points(
    points_world: Float64Array, progress: Int64Array, leaf: float, most_hits: int, table: AnyArray, keys: Int64Array,
    moments: Float64Array, hits: AnyArray, touched: AnyArray,
) -> None:  # fmt: skip
    """Add points to the cubes that they fall into, until the room for new cubes is used up.

    Args:
        points_world: (N, 3) [m], finite.
        progress: (2,) the first point to add, and the cubes in use; afterwards the first point that was not added (N
            when all were), and the cubes in use then.
        leaf: side of a cube [m].
        most_hits: points that each of the SIDE³ parts of a cube takes.
        table: power-of-two length, cube number or -1.
        keys: (C,) of the cubes.
        moments: (C, 10) number of points, sums of x y z and of xx xy xz yy yz zz about the cube's middle.
        hits: (C, SIDE³) points in each part.
        touched: (C,) set to 1 where a cube got a point.
    """
    mask = table.shape[0] - 1
    count = progress[1]
    for i in range(progress[0], points_world.shape[0]):
        x, y, z = points_world[i, 0] / leaf, points_world[i, 1] / leaf, points_world[i, 2] / leaf
        fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
        key = pack_key(fx, fy, fz)
        location = first_location(key, mask)
        while table[location] >= 0 and keys[table[location]] != key:
            location = (location + 1) & mask
        cube = int(table[location])
        if cube < 0:
            if count >= keys.shape[0]:
                progress[0], progress[1] = i, count
                return
            cube = count
            table[location] = cube
            keys[cube] = key
            moments[cube] = 0.0
            hits[cube] = 0
            count += 1
        # just below a border, x - fx may round to 1
        px, py = min(int((x - fx) * SIDE), SIDE - 1), min(int((y - fy) * SIDE), SIDE - 1)
        pz = min(int((z - fz) * SIDE), SIDE - 1)
        part = (px * SIDE + py) * SIDE + pz
        if hits[cube, part] >= most_hits:
            continue
        hits[cube, part] += 1
        touched[cube] = 1
        dx, dy, dz = (x - fx - 0.5) * leaf, (y - fy - 0.5) * leaf, (z - fz - 0.5) * leaf
        m = moments[cube]
        m[0] += 1.0
        m[1] += dx
        m[2] += dy
        m[3] += dz
        m[4] += dx * dx
        m[5] += dx * dy
        m[6] += dx * dz
        m[7] += dy * dy
        m[8] += dy * dz
        m[9] += dz * dz
    progress[0], progress[1] = points_world.shape[0], count


@kernel(types.void(float64[:, ::1], float64[:, ::1]))
def _diagonalise(a: Float64Array, v: Float64Array) -> None:
    """Rotate a symmetric (3, 3) matrix into the diagonal of its eigenvalues and `v` into its eigenvectors (columns).

    Source: Golub and Van Loan, "Matrix Computations", section 8.5: cyclic Jacobi rotations.
    """
    for i in range(3):
        for j in range(3):
            v[i, j] = 1.0 if i == j else 0.0
    scale = a[0, 0] + a[1, 1] + a[2, 2]
    for _ in range(8):
        if abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2]) <= 1e-12 * scale:
            return
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                tau = (a[q, q] - a[p, p]) / (2.0 * a[p, q])
                t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                for k in range(3):
                    kp, kq = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * kp - s * kq, s * kp + c * kq
                for k in range(3):
                    pk, qk = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * pk - s * qk, s * pk + c * qk
                for k in range(3):
                    kp, kq = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * kp - s * kq, s * kp + c * kq


@kernel(types.void(float64, float64, float64, float64, float64[::1]))
def _add_square(weight: float, x: float, y: float, z: float, sums: Float64Array) -> None:
    """Add weight times the outer product of a vector with itself: xx xy xz yy yz zz."""
    sums[0] += weight * x * x
    sums[1] += weight * x * y
    sums[2] += weight * x * z
    sums[3] += weight * y * y
    sums[4] += weight * y * z
    sums[5] += weight * z * z


@kernel(types.void(float64[:, ::1], float64[:, ::1], float64, float64[::1]))
def _inform(a: Float64Array, v: Float64Array, noise: float, surface: Float64Array) -> None:
    """Write what a spread, given by its eigenvalues (diagonal of `a`) and eigenvectors, reports about a surface."""
    e = 0 if a[0, 0] >= a[1, 1] else 1
    long = e if a[e, e] >= a[2, 2] else 2
    e, f = (long + 1) % 3, (long + 2) % 3
    middle, short = (e, f) if a[e, e] >= a[f, f] else (f, e)
    largest = a[long, long]
    if largest < 4.0 * noise * noise:
        return
    is_steep = abs(v[2, long]) >= _STEEP
    if a[middle, middle] <= _LINE_SHARE * largest and not is_steep:
        return
    for axis in (short, middle):
        share = 1.0 - a[axis, axis] / (_THIN_SHARE * largest)
        if share > 0.0 and (axis == short or is_steep):
            weight = share / (max(a[axis, axis], 0.0) + noise * noise)
            _add_square(weight, v[0, axis], v[1, axis], v[2, axis], surface[3:9])
    for axis in (long, middle):
        weight = 1.0 / max(a[axis, axis], noise * noise)
        _add_square(weight, v[0, axis], v[1, axis], v[2, axis], surface[9:15])


@kernel(types.void(int64, float64, float64, float64, int64[::1], float64[:, ::1], uint8[::1], float64[:, ::1]))
def describe_surfaces(
    count: int, leaf: float, noise: float, least_points: float, keys: Int64Array, moments: Float64Array,
    touched: AnyArray, surfaces: Float64Array,
) -> None:  # fmt: skip
    """Find mean and information of the points of every touched cube, and take its mark off.

    A cube informs across its surface alone: the direction of least spread counts as much as that spread is small
    against the largest. What is thin in two directions (poles, trunks) informs in both, if it is steep; a level one
    is a scan line on a surface whose slope is not known, and informs about nothing.

    `noise`: standard deviation of a point across a flat surface [m]; `least_points`: a cube with fewer points informs
    about nothing; `surfaces` (C, 15) mean x y z [m], world; information xx xy xz yy yz zz [1/m²], zero where there is
    none; inverse of the spread along the surface, xx xy xz yy yz zz [1/m²].
    """
    a, v = np.empty((3, 3)), np.empty((3, 3))
    mask = (1 << 21) - 1
    for cube in range(count):
        if touched[cube] == 0:
            continue
        touched[cube] = 0
        m, out = moments[cube], surfaces[cube]
        out[:] = 0.0
        if m[0] < least_points:
            continue
        n = m[0]
        mx, my, mz = m[1] / n, m[2] / n, m[3] / n
        key = keys[cube]
        out[0] = (((key >> 42) & mask) - _HALF_KEY + 0.5) * leaf + mx
        out[1] = (((key >> 21) & mask) - _HALF_KEY + 0.5) * leaf + my
        out[2] = ((key & mask) - _HALF_KEY + 0.5) * leaf + mz
        a[0, 0], a[0, 1], a[0, 2] = m[4] / n - mx * mx, m[5] / n - mx * my, m[6] / n - mx * mz
        a[1, 1], a[1, 2], a[2, 2] = m[7] / n - my * my, m[8] / n - my * mz, m[9] / n - mz * mz
        a[1, 0], a[2, 0], a[2, 1] = a[0, 1], a[0, 2], a[1, 2]
        _diagonalise(a, v)
        _inform(a, v, noise, out)
