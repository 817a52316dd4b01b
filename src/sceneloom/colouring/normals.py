"""Which way surfaces face, as far as the points of one sweep report cheaply: one plane for each cube of space."""

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, check_array
from sceneloom.kernels.voxels import number_cubes

_NEAR_SIDE, _NEAR = 0.4, 12.0
"""Up to so far from the sensor cubes have the smallest side [m]; it doubles with the distance, as the gaps do."""
_LEVELS = 4
_FEWEST = 5
_FLAT, _LINE = 0.1, 0.02
"""Of the eigenvalues of a plane's spread, the least is at most the first share of the middle one; and the middle one
at least the second share of the greatest, or else the points lie on a line, as those of one scan line do."""


def estimate_normals(points_world: Float64Array, eye_world: Float64Array) -> Float32Array:
    """Estimate the normal of the surface that each point lies on, of either sign.

    Args:
        points_world: (N, 3) float64 [m].
        eye_world: (3,) float64 [m], from where they were measured, nearly.

    Returns:
        (N, 3) float32 unit vectors; 0 where the points around one make no plane.
    """
    check_array("points_world", points_world, (None, 3), np.float64)
    points = np.ascontiguousarray(points_world)
    normals = np.zeros((len(points), 3), np.float32)
    distances = np.linalg.norm(points - eye_world, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        levels = np.clip(np.ceil(np.log2(distances / _NEAR)), 0, _LEVELS - 1)
    for level in range(_LEVELS):
        rows = np.flatnonzero(levels == level)
        if len(rows):
            normals[rows] = _normals(points[rows], _NEAR_SIDE * 2.0**level)
    return normals


def _normals(points_world: Float64Array, side: float) -> Float32Array:
    numbers = np.empty(len(points_world), np.int64)
    count = number_cubes(points_world, side, numbers)
    normals = np.zeros((count + 1, 3), np.float32)
    if count:
        found, flat = _planes(points_world, numbers, count)
        normals[:count][flat] = found[flat]
    # a point in no cube has the number -1, the last row
    return normals[numbers]


def _planes(points_world: Float64Array, numbers: Int64Array, count: int) -> tuple[Float64Array, BoolArray]:
    """The least axis of the spread in each cube, (count, 3), and whether it is that of a plane."""
    rows = np.flatnonzero(numbers >= 0)
    inside, cubes = points_world[rows], numbers[rows]
    held = np.bincount(cubes, minlength=count)
    means = np.stack([np.bincount(cubes, inside[:, k], count) for k in range(3)], axis=1) / held[:, None]
    apart = inside - means[cubes]
    spread = np.empty((count, 3, 3))
    for a in range(3):
        for b in range(a, 3):
            spread[:, a, b] = spread[:, b, a] = np.bincount(cubes, apart[:, a] * apart[:, b], count)
    values, axes = np.linalg.eigh(spread)
    flat = (held >= _FEWEST) & (values[:, 0] <= _FLAT * values[:, 1]) & (values[:, 1] >= _LINE * values[:, 2])
    return axes[:, :, 0], flat
