"""Projected points: the pixel index that each falls into.

And its direction and inverse range as seen from the camera.
"""

import math
from typing import Any

import numba
import numpy as np
from numba import float32, float64, int32, int64, types, void

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int32Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

PART: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of functions that are compiled, and cached, as parts of others."""

BLOCK = 256
"""Points whose pixels are picked at once, by SIMD."""

_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_LOW, _NOTHING, _HALF = np.float32(-0.5), np.float32(0.0), np.float32(0.5)


@numba.njit(**PART, inline="always")
def _round(value: Any) -> Any:
    """Round a number from -0.5 on, halves upward; 0.49999997 + 0.5 would be 1 in float32."""
    whole = np.int32(value)
    return np.int32(whole + np.int32(value - np.float32(whole) >= _HALF))


@numba.njit(**PART)
def number_pixels(flat_pixels: Float32Array, width: int, height: int, numbers: AnyArray) -> None:
    """Write the number of the nearest pixel, counted row by row; -1 outside the image and for NaN.

    The image reaches from -0.5 to size - 0.5; its far border, which rounding to float32 can produce, counts with
    the last row or column.

    Args:
        flat_pixels: (2 M,) [px], u and v alternately.
        width: [px].
        height: [px].
        numbers: (M,) int32, written.
    """
    right, bottom = np.float32(width - 0.5), np.float32(height - 0.5)
    last_column, last_row, columns = np.int32(width - 1), np.int32(height - 1), np.int32(width)
    for i in range(numbers.shape[0]):
        u, v = flat_pixels[2 * i], flat_pixels[2 * i + 1]
        inside = (u >= _LOW) & (u <= right) & (v >= _LOW) & (v <= bottom)
        # In 32 bits at each step: Numba would go on in 64, of which vectors hold half.
        column = np.int32(min(_round(u if inside else _NOTHING), last_column))
        row = np.int32(min(_round(v if inside else _NOTHING), last_row))
        number = np.int32(np.int32(row * columns) + column)
        numbers[i] = number if inside else np.int32(-1)


@kernel(void(_IN_F32_2D, int64, int64, int32[::1]), cache=True, nogil=True, error_model="numpy")
def _number_pixels(pixels: Float32Array, width: int, height: int, numbers: AnyArray) -> None:
    number_pixels(pixels.reshape(pixels.size), width, height, numbers)


def pixel_numbers(pixels: Float32Array, width: int, height: int) -> Int32Array:
    """Give what `number_pixels` writes.

    Args:
        pixels: (M, 2) float32 [px].
        width: [px].
        height: [px].

    Returns:
        (M,) int32.
    """
    numbers = np.empty(len(pixels), np.int32)
    _number_pixels(pixels, width, height, numbers)
    return numbers


_IN_F64_2D = types.Array(float64, 2, "C", readonly=True)

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)

_INNER: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False}
"""Options of functions that are compiled as parts of others: the fast mathematics of those would be theirs, too."""

_DIRECTIONS_NOTHING, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)

_BEHIND = np.float32(1e-6)
"""Least value of 1 + cos θ: keeps the map finite for a point straight behind the camera."""

_NEAREST, _FARTHEST = np.float32(1e-6), np.float32(1e9)
"""Ranges that give a direction [m]."""

_BLOCK = 512
"""Points that are taken at once: their coordinates lie side by side, in the nearest cache, for vector instructions."""


@numba.njit(**_INNER)
def _gather(
    points_world: Float64Array, point_ids: Int64Array, x: Float64Array, y: Float64Array, z: Float64Array
) -> None:
    """Put the coordinates of some points side by side, NaN for those that do not exist."""
    count = np.uint64(points_world.shape[0])
    for i in range(point_ids.shape[0]):
        k = np.uint64(point_ids[i])
        if k < count:
            x[i], y[i], z[i] = points_world[k, 0], points_world[k, 1], points_world[k, 2]
        else:
            x[i] = y[i] = z[i] = math.nan


@numba.njit(**_INNER)
def _move(
    x_world: Float64Array, y_world: Float64Array, z_world: Float64Array, pose: tuple[float, ...],
    x_camera: Float32Array, y_camera: Float32Array, z_camera: Float32Array,
) -> None:  # fmt: skip
    """Take as many points into the camera frame as the outputs have room for."""
    for i in range(x_camera.shape[0]):
        px, py, pz = x_world[i], y_world[i], z_world[i]
        x_camera[i] = np.float32(pose[0] * px + pose[1] * py + pose[2] * pz + pose[3])
        y_camera[i] = np.float32(pose[4] * px + pose[5] * py + pose[6] * pz + pose[7])
        z_camera[i] = np.float32(pose[8] * px + pose[9] * py + pose[10] * pz + pose[11])


@numba.njit(**_INNER)
def rotation_to_directions(
    rightward: Float32Array, downward: Float32Array, z_camera: Float32Array, inverse_ranges: Float32Array
) -> None:
    """Put directions in the position of coordinates x and y in the camera frame; see `map_directions`."""
    for i in range(inverse_ranges.shape[0]):
        x, y, z = rightward[i], downward[i], z_camera[i]
        range_m = math.sqrt(x * x + y * y + z * z)
        # 2 sin(θ/2) / sin θ = sqrt(2 / (1 + cos θ)), with one division for this and for the inverse range.
        ahead = range_m + z
        ahead = max(_BEHIND * range_m, ahead)
        shared = _ONE / (range_m * ahead)
        scale = math.sqrt(_TWO * shared)
        known = (range_m > _NEAREST) & (range_m < _FARTHEST)
        rightward[i] = x * scale if known else _DIRECTIONS_NOTHING
        downward[i] = y * scale if known else _DIRECTIONS_NOTHING
        inverse_ranges[i] = shared * ahead if known else _DIRECTIONS_NOTHING


@kernel(
    void(_IN_F64_2D, _IN_I64_1D, _IN_F64_2D, float32[::1], float32[::1], float32[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _map_all(
    points_world: Float64Array,
    point_ids: Int64Array,
    camera_from_world: Float64Array,
    rightward: Float32Array,
    downward: Float32Array,
    inverse_ranges: Float32Array,
) -> None:
    """Map the points with the given ids."""
    m = camera_from_world
    pose = (
        m[0, 0], m[0, 1], m[0, 2], m[0, 3],
        m[1, 0], m[1, 1], m[1, 2], m[1, 3],
        m[2, 0], m[2, 1], m[2, 2], m[2, 3],
    )  # fmt: skip
    x, y, z, depths = np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK), np.empty(_BLOCK, np.float32)
    for start in range(0, point_ids.shape[0], _BLOCK):
        stop = min(start + _BLOCK, point_ids.shape[0])
        _gather(points_world, point_ids[start:stop], x, y, z)
        right, down = rightward[start:stop], downward[start:stop]
        _move(x, y, z, pose, right, down, depths)
        rotation_to_directions(right, down, depths, inverse_ranges[start:stop])


def map_directions(
    points_world: Float64Array,
    point_ids: Int64Array,
    camera_from_world: Float64Array,
    directions: Float32Array,
    inverse_ranges: Float32Array,
    *,
    thread_pool: ThreadPool = ALONE,
) -> None:
    """Write the direction and the inverse range of the points with the given ids.

    The map is Lambert's azimuthal one around the optical axis: a direction at angle θ off the axis lies at radius
    2 sin(θ/2). Its scale is cos(θ/2) along the radius and 1/cos(θ/2) across it, so that a distance in it is nearly an
    angle, whatever the camera model does to pixels.

    Args:
        points_world: (N, 3) [m].
        point_ids: (M,), rows of `points_world`.
        camera_from_world: (3, 4) or (4, 4).
        directions: (2, M), written: rightward and downward, inside the disc of radius 2.
        inverse_ranges: (M,) [1/m], written; 0 for a point that is not finite, lies in the camera's centre, or
            does not exist.
        thread_pool: the threads that share the points.

    Source: J. P. Snyder, Map Projections - A Working Manual, 1987, eq. 24-1 and 24-2.
    """
    thread_pool.share(
        len(point_ids),
        lambda _, a, b: _map_all(
            points_world,
            point_ids[a:b],
            camera_from_world,
            directions[0, a:b],
            directions[1, a:b],
            inverse_ranges[a:b],
        ),
    )
