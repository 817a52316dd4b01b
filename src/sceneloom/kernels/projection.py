"""Projected points: the pixel that each falls into, its direction and inverse range, depth images, sampled colours."""

import math
from typing import Any

import numpy as np
from numba import float32, float64, int32, int64, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import (
    IN_BOOL_1D,
    IN_F32_1D,
    IN_F32_2D,
    IN_F64_2D,
    IN_I32_1D,
    IN_I64_1D,
    IN_U8_3D,
    inlined,
    part,
)
from sceneloom.kernels.thread_pool import ALONE, Phase, ThreadPool

BLOCK = 256
"""Points whose pixels are found at once, by SIMD."""

_NOTHING = np.float32(0.0)
_LOW, _HALF = np.float32(-0.5), np.float32(0.5)


@inlined
def _round(value: Any) -> Any:
    """Round a number from -0.5 on, halves upward; 0.49999997 + 0.5 would be 1 in float32."""
    whole = np.int32(value)
    return np.int32(whole + np.int32(value - np.float32(whole) >= _HALF))


@part
def number_pixels(flat_pixels: Float32Array, width: int, height: int, numbers: AnyArray) -> None:
    """Write the number of the nearest pixel, counted row by row; -1 outside the image and for NaN.

    The image reaches from -0.5 to size - 0.5; its far border, which rounding to float32 can produce, counts with
    the last row or column.

    `flat_pixels` (2 M,) [px], u and v alternately; `numbers` (M,) int32, written.
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


@kernel(void(IN_F32_2D, int64, int64, int32[::1]))
def _number_pixels(pixels: Float32Array, width: int, height: int, numbers: AnyArray) -> None:
    number_pixels(pixels.reshape(pixels.size), width, height, numbers)


def pixel_numbers(pixels: Float32Array, width: int, height: int) -> Int32Array:
    """The numbers (M,) int32 that `number_pixels` writes for pixels (M, 2) float32."""
    numbers = np.empty(len(pixels), np.int32)
    _number_pixels(pixels, width, height, numbers)
    return numbers


_ONE, _TWO = np.float32(1.0), np.float32(2.0)
_BEHIND = np.float32(1e-6)  # least value of 1 + cos θ: keeps the map finite for a point straight behind the camera
_NEAREST, _FARTHEST = np.float32(1e-6), np.float32(1e9)  # ranges that give a direction [m]

_BLOCK = 512
"""Points that are taken at once: their coordinates lie side by side, in the nearest cache, for vector instructions."""


@part
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


@part
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


@part
def write_directions(
    rightward: Float32Array, downward: Float32Array, z_camera: Float32Array, inverse_ranges: Float32Array
) -> None:
    """Replace coordinates x and y in the camera frame by directions; see `map_directions`."""
    for i in range(inverse_ranges.shape[0]):
        x, y, z = rightward[i], downward[i], z_camera[i]
        range_m = math.sqrt(x * x + y * y + z * z)
        # 2 sin(θ/2) / sin θ = sqrt(2 / (1 + cos θ)), with one division for this and for the inverse range.
        ahead = range_m + z
        ahead = max(_BEHIND * range_m, ahead)
        shared = _ONE / (range_m * ahead)
        scale = math.sqrt(_TWO * shared)
        known = (range_m > _NEAREST) & (range_m < _FARTHEST)
        rightward[i] = x * scale if known else _NOTHING
        downward[i] = y * scale if known else _NOTHING
        inverse_ranges[i] = shared * ahead if known else _NOTHING


@kernel(void(IN_F64_2D, IN_I64_1D, IN_F64_2D, float32[::1], float32[::1], float32[::1]))
def _map_all(
    points_world: Float64Array, point_ids: Int64Array, camera_from_world: Float64Array, rightward: Float32Array,
    downward: Float32Array, inverse_ranges: Float32Array,
) -> None:  # fmt: skip
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
        write_directions(right, down, depths, inverse_ranges[start:stop])


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

    def project(_: int, a: int, b: int) -> None:
        right, down = directions[0, a:b], directions[1, a:b]
        _map_all(points_world, point_ids[a:b], camera_from_world, right, down, inverse_ranges[a:b])

    thread_pool.share(Phase(len(point_ids), project))


_INFINITE = np.float32(math.inf)


@part
def _pick(
    numbers: Int32Array, depths: Float32Array, visible: BoolArray, first: int, size: int, locations: AnyArray
) -> None:
    """Write where in some rows of the image the points are drawn; -1 for those that are not."""
    for i in range(locations.shape[0]):
        drawn = (depths[i] > _NOTHING) & (depths[i] < _INFINITE) & visible[i]
        location = np.int32(numbers[i] - np.int32(first))
        locations[i] = location if drawn & (np.uint32(location) < np.uint32(size)) else np.int32(-1)


@part
def _draw(locations: AnyArray, depths: Float32Array, rows: Float32Array) -> None:
    for i in range(depths.shape[0]):
        if locations[i] >= 0:
            depth, p = depths[i], np.uint64(locations[i])
            there = rows[p]
            rows[p] = depth if (there == _NOTHING) | (depth < there) else there


@kernel(void(IN_I32_1D, IN_F32_1D, IN_BOOL_1D, int64, int64, float32[:, ::1]))
def _draw_rows(
    numbers: Int32Array, depths: Float32Array, visible: BoolArray, top: int, bottom: int, depth_image: AnyArray
) -> None:
    """Draw what falls into some rows of the image."""
    width, count = depth_image.shape[1], depths.shape[0]
    first, rows = top * width, depth_image.reshape(depth_image.size)[top * width : bottom * width]
    locations = np.empty(BLOCK, np.int32)
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        block = locations[: stop - start]
        _pick(numbers[start:stop], depths[start:stop], visible[start:stop], first, rows.shape[0], block)
        _draw(block, depths[start:stop], rows)


def draw_depths(
    pixel_numbers: Int32Array,
    depths: Float32Array,
    visible: BoolArray,
    depth_image: Float32Array,
    *,
    thread_pool: ThreadPool = ALONE,
) -> None:
    """Lower each pixel of the depth image to the least positive depth of the visible points in it.

    Args:
        pixel_numbers: (M,), counted row by row; negative outside the image.
        depths: (M,) [m].
        visible: (M,); other points make no depth.
        depth_image: (H, W) [m], 0 for nothing; written.
        thread_pool: the threads that share the rows of the image.
    """

    def draw(_: int, top: int, bottom: int) -> None:
        _draw_rows(pixel_numbers, depths, visible, top, bottom, depth_image)

    thread_pool.share(Phase(len(depth_image), draw))


@kernel(void(IN_F32_2D, IN_U8_3D, float64, float32[:, ::1]))
def sample_footprints(pixels: Float32Array, rgb: UInt8Array, width_px: float, colors: Float32Array) -> None:
    """Average colours over squares around positions; pixels count by the share of them that a square covers.

    A square of one pixel is bilinear interpolation. What is outside of the image does not count.

    `pixels` (M, 2) [px], finite, in the image; `rgb` (H, W, 3); `width_px`: side of the squares, at least 1; `colors`
    (M, 3), written, 0 to 255.
    """
    height, width, half = rgb.shape[0], rgb.shape[1], 0.5 * width_px
    for i in range(pixels.shape[0]):
        u, v = min(max(pixels[i, 0], -0.5), width - 0.5), min(max(pixels[i, 1], -0.5), height - 0.5)
        first, last = max(math.floor(u - half + 0.5), 0), min(math.floor(u + half + 0.5), width - 1)
        red, green, blue, total = 0.0, 0.0, 0.0, 0.0
        for row in range(max(math.floor(v - half + 0.5), 0), min(math.floor(v + half + 0.5), height - 1) + 1):
            down = min(row + 0.5, v + half) - max(row - 0.5, v - half)
            for column in range(first, last + 1):
                share = down * (min(column + 0.5, u + half) - max(column - 0.5, u - half))
                red += share * rgb[row, column, 0]
                green += share * rgb[row, column, 1]
                blue += share * rgb[row, column, 2]
                total += share
        colors[i, 0], colors[i, 1], colors[i, 2] = red / total, green / total, blue / total
