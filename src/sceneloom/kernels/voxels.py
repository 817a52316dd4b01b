"""Voxels: a map of surfaces with the mean and spread of the points in each voxel, and one point kept per voxel."""

import math
from typing import Any

import numpy as np
from numba import float64, int64, types

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F64_2D, inlined


@inlined
def first_location(key: int, mask: int) -> Any:
    """Where the search for a key begins in the table.

    Source: Steele, Lea and Flood 2014, the mixing of SplitMix64.
    """
    h = np.uint64(key)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.int64(h >> np.uint64(20)) & mask


MOST_CUBES = 2.0**62
"""Cubes along an axis whose numbers a point may bear: beyond, an int64 does not hold them."""

EQUALLY_NEAR = 1.0 - 1e-9
"""Squared distances nearer to each other than this are equal: the mean of two points is as near to one as to the other,
and its rounding must not decide."""


@kernel(int64(IN_F64_2D, float64, int64[::1]))
def number_cubes(points: Float64Array, side: float, numbers: Int64Array) -> int:
    """Number the cubes of side `side` [m] that points fall into, in the order in which they are met.

    A cube holds its lower faces and not its upper ones, on either side of the origin.

    `points` (N, 3) [m]; one that is not finite, or too far away to be reported, falls into none; `numbers` (N,) number
    of each point's cube is written here, -1 for none. Returns how many cubes there are.
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


@kernel(types.void(int64[::1], int64[::1]))
def first_of_cubes(numbers: Int64Array, chosen: Int64Array) -> None:
    """Write the row of the first point of each cube to `chosen` (C,); `numbers` (N,) as `number_cubes` gives them."""
    count = 0
    for i in range(numbers.shape[0]):
        if numbers[i] == count:
            chosen[count] = i
            count += 1


@kernel(types.void(IN_F64_2D, int64[::1], int64[::1]))
def nearest_of_cubes(points: Float64Array, numbers: Int64Array, chosen: Int64Array) -> None:
    """Write the row of that point of each cube to `chosen` which is nearest to the mean of the cube's points.

    Of equally near ones it is the first.

    `points` (N, 3) [m]; `numbers` (N,) as `number_cubes` gives them; `chosen` (C,) the rows of the first points; those
    of the nearest ones afterwards.
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
