"""Colours of pictures onto the points seen in them."""

from typing import Any

import numba
import numpy as np
from numba import boolean, float32, float64, int64, types, uint8, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.pixel_numbers import BLOCK, PART, number_pixels

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)
_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)

_MOSTLY = 0.9
"""If so many of a block are seen, to guess that each is takes less time than to list them."""


@numba.njit(**PART)
def _choose(
    point_ids: Int64Array, flat_pixels: Float32Array, visible: BoolArray, width: int, height: int,
    eccentricities: Float64Array, numbers: AnyArray,
) -> None:  # fmt: skip
    """Cross out, by pixel number -1, points that are unseen, do not exist, or were seen more centrally before."""
    center_u, center_v = 0.5 * (width - 1), 0.5 * (height - 1)
    per_square = 4.0 / np.float64(width * width + height * height)
    for i in range(numbers.shape[0]):
        k = np.uint64(point_ids[i])
        if numbers[i] < 0 or not visible[i] or k >= np.uint64(eccentricities.shape[0]):
            numbers[i] = -1
            continue
        du, dv = flat_pixels[2 * i] - center_u, flat_pixels[2 * i + 1] - center_v
        eccentricity = (du * du + dv * dv) * per_square
        if eccentricity < eccentricities[k]:
            eccentricities[k] = eccentricity
        else:
            numbers[i] = -1


@numba.njit(**PART, inline="always")
def _copy(flat_rgb: UInt8Array, source: Any, flat_colors: UInt8Array, target: Any) -> None:
    flat_colors[target] = flat_rgb[source]
    flat_colors[target + np.uint64(1)] = flat_rgb[source + np.uint32(1)]
    flat_colors[target + np.uint64(2)] = flat_rgb[source + np.uint32(2)]


@numba.njit(**PART)
def _paint(
    point_ids: Int64Array, numbers: AnyArray, visible: BoolArray, flat_rgb: UInt8Array, camera: int,
    flat_colors: UInt8Array, camera_index: UInt8Array, sources: AnyArray, targets: AnyArray,
) -> None:  # fmt: skip
    """Copy the colours of the numbered pixels."""
    known, count = np.uint64(camera_index.shape[0]), 0
    seen = 0
    for i in range(numbers.shape[0]):
        seen += visible[i]
    if seen > _MOSTLY * numbers.shape[0]:
        for i in range(numbers.shape[0]):
            k = np.uint64(point_ids[i])
            if numbers[i] >= 0 and visible[i] and k < known:
                _copy(flat_rgb, np.uint32(3) * np.uint32(numbers[i]), flat_colors, np.uint64(3) * k)
                camera_index[k] = camera
        return
    # First listed, without guessing which ones are seen, then copied: many pixels are on their way from memory at once.
    for i in range(numbers.shape[0]):
        k = np.uint64(point_ids[i])
        sources[count], targets[count] = numbers[i], k
        count += (numbers[i] >= 0) & visible[i] & (k < known)
    for n in range(count):
        _copy(flat_rgb, np.uint32(3) * sources[n], flat_colors, np.uint64(3) * targets[n])
        camera_index[targets[n]] = camera


@numba.njit(
    void(_IN_I64_1D, _IN_F32_2D, _IN_BOOL_1D, _IN_U8_3D, uint8, float64[::1], uint8[:, ::1], uint8[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def paint_points(
    point_ids: Int64Array,
    pixels: Float32Array,
    visible: BoolArray,
    rgb: UInt8Array,
    camera: int,
    eccentricities: Float64Array,
    colors: UInt8Array,
    camera_index: UInt8Array,
) -> None:
    """Give each visible point its nearest pixel's colour if this picture shows it more centrally than those before.

    Args:
        point_ids: (M,), rows of the outputs.
        pixels: (M, 2) [px].
        visible: (M,).
        rgb: (H, W, 3), the picture.
        camera: number to write into `camera_index`.
        eccentricities: (N,), updated: least squared distance so far from a picture's centre, in half diagonals; or
            (0,) where this picture is the only one.
        colors: (N, 3), updated.
        camera_index: (N,), updated.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    flat_pixels, flat_rgb, flat_colors = (
        pixels.reshape(pixels.size),
        rgb.reshape(rgb.size),
        colors.reshape(colors.size),
    )
    numbers, sources = np.empty(BLOCK, np.int32), np.empty(BLOCK + 1, np.uint32)
    targets = np.empty(BLOCK + 1, np.uint64)
    for start in range(0, point_ids.shape[0], BLOCK):
        stop = min(start + BLOCK, point_ids.shape[0])
        block, ids, seen = numbers[: stop - start], point_ids[start:stop], visible[start:stop]
        number_pixels(flat_pixels[2 * start : 2 * stop], width, height, block)
        if eccentricities.shape[0] > 0:
            _choose(ids, flat_pixels[2 * start : 2 * stop], seen, width, height, eccentricities, block)
        _paint(ids, block, seen, flat_rgb, camera, flat_colors, camera_index, sources, targets)
