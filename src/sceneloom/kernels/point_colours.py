"""Colours of images onto the points seen in them."""

import numba
import numpy as np
from numba import boolean, float32, float64, int32, int64, types, uint8, void

from sceneloom.arrays import (
    AnyArray,
    BoolArray,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
)
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.pixel_numbers import BLOCK, PART

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)
_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)
_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)

_GREEN, _BLUE = np.uint64(1), np.uint64(2)


@numba.njit(**PART)
def _pick(
    pixel_numbers: Int32Array, size: int, visible: BoolArray, point_ids: Int64Array, count: int, numbers: AnyArray
) -> None:  # fmt: skip
    """Write the points' pixels, of which there are `size`; -1 for points that are unseen or do not exist."""
    for i in range(numbers.shape[0]):
        inside = np.uint32(pixel_numbers[i]) < np.uint32(size)
        painted = inside & visible[i] & (np.uint64(point_ids[i]) < np.uint64(count))
        numbers[i] = pixel_numbers[i] if painted else np.int32(-1)


@numba.njit(**PART)
def _choose(
    point_ids: Int64Array, flat_pixels: Float32Array, width: int, height: int, eccentricities: Float64Array,
    numbers: AnyArray,
) -> None:  # fmt: skip
    """Cross out, likewise, points that were seen more centrally before."""
    center_u, center_v = 0.5 * (width - 1), 0.5 * (height - 1)
    per_square = 4.0 / np.float64(width * width + height * height)
    for i in range(numbers.shape[0]):
        if numbers[i] < 0:
            continue
        k = np.uint64(point_ids[i])
        du, dv = flat_pixels[2 * i] - center_u, flat_pixels[2 * i + 1] - center_v
        eccentricity = (du * du + dv * dv) * per_square
        if eccentricity < eccentricities[k]:
            eccentricities[k] = eccentricity
        else:
            numbers[i] = -1


@numba.njit(**PART)
def _paint(
    numbers: AnyArray, point_ids: Int64Array, flat_rgb: UInt8Array, camera: int, flat_colors: UInt8Array,
    camera_index: UInt8Array,
) -> None:  # fmt: skip
    """Copy the colours of the pixels of a block of points."""
    for i in range(point_ids.shape[0]):
        if numbers[i] >= 0:
            k = np.uint64(point_ids[i])
            source, target = np.uint64(3) * np.uint64(numbers[i]), np.uint64(3) * k
            # Read as one before written, since for the compiler a colour might lie where the next is read.
            red, green, blue = flat_rgb[source], flat_rgb[source + _GREEN], flat_rgb[source + _BLUE]
            flat_colors[target], flat_colors[target + _GREEN], flat_colors[target + _BLUE] = red, green, blue
            camera_index[k] = camera


@kernel(
    void(
        _IN_I64_1D,
        _IN_F32_2D,
        _IN_I32_1D,
        _IN_BOOL_1D,
        _IN_U8_3D,
        uint8,
        float64[::1],
        uint8[:, ::1],
        uint8[::1],
    ),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def paint_points(
    point_ids: Int64Array,
    pixels: Float32Array,
    pixel_numbers: Int32Array,
    visible: BoolArray,
    rgb: UInt8Array,
    camera: int,
    eccentricities: Float64Array,
    colors: UInt8Array,
    camera_index: UInt8Array,
) -> None:
    """Give each visible point its nearest pixel's colour if this image shows it more centrally than those before.

    Args:
        point_ids: (M,), rows of the outputs.
        pixels: (M, 2) [px].
        pixel_numbers: (M,), the nearest ones, counted row by row; negative outside the image.
        visible: (M,).
        rgb: (H, W, 3), the image.
        camera: number to write into `camera_index`.
        eccentricities: (N,), updated: least squared distance so far from an image's centre, in half diagonals; or
            (0,) where this image is the only one.
        colors: (N, 3), updated.
        camera_index: (N,), updated.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    flat_pixels, flat_rgb, flat_colors = (
        pixels.reshape(pixels.size),
        rgb.reshape(rgb.size),
        colors.reshape(colors.size),
    )
    count = point_ids.shape[0]
    numbers, size = np.empty(BLOCK, np.int32), width * height
    for start in range(0, count, BLOCK):
        stop = min(start + BLOCK, count)
        block, ids = numbers[: stop - start], point_ids[start:stop]
        _pick(pixel_numbers[start:stop], size, visible[start:stop], ids, camera_index.shape[0], block)
        if eccentricities.shape[0] > 0:
            _choose(ids, flat_pixels[2 * start : 2 * stop], width, height, eccentricities, block)
        _paint(block, ids, flat_rgb, camera, flat_colors, camera_index)
