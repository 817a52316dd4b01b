"""Voxels: a map of surfaces with the mean and spread of the points in each voxel, and one point kept per voxel."""

import math
from typing import Any

import numba
import numpy as np
from numba import float64, int32, int64, types, uint8

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

INNER: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
"""How the functions that only other kernels call are compiled."""

SIDE = 4
"""A cube is cut into this many parts along each axis; each part takes a few points, so that near scan lines, which
are dense, do not outweigh the rest."""

_LINE_SHARE, _THIN_SHARE = 0.04, 0.1
"""Of the largest eigenvalue: a middle one below the first is that of a line; one above the second states nothing."""

_STEEP = 0.7
"""A line is steep where its direction has at least this z."""

_HALF_KEY = 1 << 20

_READ_F64_2D = types.Array(float64, 2, "C", readonly=True)


@numba.njit(inline="always", **INNER)
def pack_key(ix: int, iy: int, iz: int) -> int:
    """One number for the cube (ix, iy, iz), each within ±2^20."""
    return ((ix + _HALF_KEY) << 42) | ((iy + _HALF_KEY) << 21) | (iz + _HALF_KEY)


@numba.njit(inline="always", **INNER)
def first_location(key: int, mask: int) -> Any:
    """Where the search for a key begins in the table.

    Source: Steele, Lea and Flood 2014, the mixing of SplitMix64.
    """
    h = np.uint64(key)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64(h >> np.uint64(20)) & mask


@kernel(int64(int64, int32[::1], int64[::1]), **INNER)
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


@kernel(types.void(int64, int64[::1], int32[::1]), cache=True, nogil=True)
def fill_table(count: int, keys: Int64Array, table: AnyArray) -> None:
    """Write the first `count` cubes into an empty table (-1 everywhere) whose length is a power of two."""
    mask = table.shape[0] - 1
    for cube in range(count):
        location = first_location(keys[cube], mask)
        while table[location] >= 0:
            location = (location + 1) & mask
        table[location] = cube


@kernel(
    types.void(
        _READ_F64_2D, int64[::1], float64, int64, int32[::1], int64[::1], float64[:, ::1], uint8[:, ::1],
        uint8[::1],
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def insert_points(
    points_world: Float64Array,
    progress: Int64Array,
    leaf: float,
    most_hits: int,
    table: AnyArray,
    keys: Int64Array,
    moments: Float64Array,
    hits: AnyArray,
    touched: AnyArray,
) -> None:
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


@kernel(types.void(float64[:, ::1], float64[:, ::1]), **INNER)
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


@kernel(types.void(float64, float64, float64, float64, float64[::1]), **INNER)
def _add_square(weight: float, x: float, y: float, z: float, sums: Float64Array) -> None:
    """Add weight times the outer product of a vector with itself: xx xy xz yy yz zz."""
    sums[0] += weight * x * x
    sums[1] += weight * x * y
    sums[2] += weight * x * z
    sums[3] += weight * y * y
    sums[4] += weight * y * z
    sums[5] += weight * z * z


@kernel(types.void(float64[:, ::1], float64[:, ::1], float64, float64[::1]), **INNER)
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


@kernel(
    types.void(int64, float64, float64, float64, int64[::1], float64[:, ::1], uint8[::1], float64[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def describe_surfaces(
    count: int,
    leaf: float,
    noise: float,
    least_points: float,
    keys: Int64Array,
    moments: Float64Array,
    touched: AnyArray,
    surfaces: Float64Array,
) -> None:
    """Find mean and information of the points of every touched cube, and take its mark off.

    A cube informs across its surface alone: the direction of least spread counts as much as that spread is small
    against the largest. What is thin in two directions (poles, trunks) informs in both, if it is steep; a level one
    is a scan line on a surface whose slope is not known, and informs about nothing.

    Args:
        noise: standard deviation of a point across a flat surface [m].
        least_points: a cube with fewer points informs about nothing.
        surfaces: (C, 15) mean x y z [m], world; information xx xy xz yy yz zz [1/m²], zero where there is none; inverse
            of the spread along the surface, xx xy xz yy yz zz [1/m²].
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


MOST_CUBES = 2.0**62
"""Cubes along an axis whose numbers a point may bear: beyond, an int64 does not hold them."""

EQUALLY_NEAR = 1.0 - 1e-9
"""Squared distances nearer to each other than this are equal: the mean of two points is as near to one as to the other,
and its rounding must not decide."""


@kernel(int64(_READ_F64_2D, float64, int64[::1]), cache=True, nogil=True, error_model="numpy")
def number_cubes(points: Float64Array, side: float, numbers: Int64Array) -> int:
    """Number the cubes of side `side` [m] that points fall into, in the order in which they are met.

    A cube holds its lower faces and not its upper ones, on either side of the origin.

    Args:
        points: (N, 3) [m]; one that is not finite, or too far away to be reported, falls into none.
        numbers: (N,) number of each point's cube is written here, -1 for none.

    Returns:
        How many cubes there are.
    """
    length = 1024
    while length < 2 * points.shape[0]:
        length *= 2
    mask, count = length - 1, 0
    table = np.full(length, -1, np.int64)
    cubes = np.empty((points.shape[0], 3), np.int64)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] / side, points[i, 1] / side, points[i, 2] / side
        if not (abs(x) < MOST_CUBES and abs(y) < MOST_CUBES and abs(z) < MOST_CUBES):
            numbers[i] = -1
            continue
        ix, iy, iz = math.floor(x), math.floor(y), math.floor(z)
        location = first_location(ix * 73856093 ^ iy * 19349663 ^ iz * 83492791, mask)
        while table[location] >= 0:
            k = table[location]
            if cubes[k, 0] == ix and cubes[k, 1] == iy and cubes[k, 2] == iz:
                break
            location = (location + 1) & mask
        if table[location] < 0:
            table[location] = count
            cubes[count, 0], cubes[count, 1], cubes[count, 2] = ix, iy, iz
            count += 1
        numbers[i] = table[location]
    return count


@kernel(types.void(int64[::1], int64[::1]), cache=True, nogil=True)
def first_of_cubes(numbers: Int64Array, chosen: Int64Array) -> None:
    """Write the row of the first point of each cube to `chosen` (C,); `numbers` (N,) as `number_cubes` gives them."""
    count = 0
    for i in range(numbers.shape[0]):
        if numbers[i] == count:
            chosen[count] = i
            count += 1


@kernel(types.void(_READ_F64_2D, int64[::1], int64[::1]), cache=True, nogil=True, error_model="numpy")
def nearest_of_cubes(points: Float64Array, numbers: Int64Array, chosen: Int64Array) -> None:
    """Write the row of that point of each cube to `chosen` which is nearest to the mean of the cube's points.

    Of equally near ones it is the first.

    Args:
        points: (N, 3) [m].
        numbers: (N,) as `number_cubes` gives them.
        chosen: (C,) the rows of the first points; those of the nearest ones afterwards.
    """
    count = chosen.shape[0]
    means, held = np.zeros((count, 3)), np.zeros(count)
    for i in range(points.shape[0]):
        cube = numbers[i]
        if cube >= 0:
            held[cube] += 1.0
            for axis in range(3):
                # relative to the first point, so that the sum loses no digits far from the origin
                means[cube, axis] += points[i, axis] - points[chosen[cube], axis]
    for cube in range(count):
        for axis in range(3):
            means[cube, axis] = points[chosen[cube], axis] + means[cube, axis] / held[cube]
    least = np.full(count, np.inf)
    for i in range(points.shape[0]):
        cube = numbers[i]
        if cube < 0:
            continue
        apart = 0.0
        for axis in range(3):
            away = points[i, axis] - means[cube, axis]
            apart += away * away
        if apart < least[cube] * EQUALLY_NEAR:
            least[cube] = apart
            chosen[cube] = i
