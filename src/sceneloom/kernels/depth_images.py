"""Depths of points into the pixels of a picture."""

import math

import numba
import numpy as np
from numba import boolean, float32, int32, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array
from sceneloom.kernels.crew import ALONE, Crew
from sceneloom.kernels.fetching import fetch
from sceneloom.kernels.pixel_numbers import BLOCK, PART, number_pixels

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)

_AHEAD = 256
"""So many points before a pixel is needed it is asked for."""

_NOTHING, _ENDLESS = np.float32(0.0), np.float32(math.inf)


@numba.njit(**PART)
def _cross_out(numbers: AnyArray, depths: Float32Array, visible: BoolArray) -> None:
    """Write -1 for what makes no depth."""
    for i in range(numbers.shape[0]):
        drawn = (depths[i] > _NOTHING) & (depths[i] < _ENDLESS) & visible[i]
        numbers[i] = numbers[i] if drawn else np.int32(-1)


@numba.njit(**PART)
def _compare(numbers: AnyArray, depths: Float32Array, image: Float32Array, visible: BoolArray) -> None:
    for i in range(numbers.shape[0]):
        nearest = image[np.uint32(numbers[i])] if numbers[i] >= 0 else -_ENDLESS
        visible[i] = (numbers[i] >= 0) & (depths[i] <= max(nearest, _NOTHING))


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, _IN_BOOL_1D, int64, int64, int32[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _number_drawn(
    pixels: Float32Array, depths: Float32Array, visible: BoolArray, width: int, height: int, numbers: AnyArray
) -> None:
    """Write the pixels of some points, -1 for those that make no depth."""
    flat_pixels = pixels.reshape(pixels.size)
    for start in range(0, numbers.shape[0], BLOCK):
        stop = min(start + BLOCK, numbers.shape[0])
        block = numbers[start:stop]
        number_pixels(flat_pixels[2 * start : 2 * stop], width, height, block)
        _cross_out(block, depths[start:stop], visible[start:stop])


@numba.njit(
    void(_IN_I32_1D, _IN_F32_1D, int64, int64, float32[:, ::1]), cache=True, nogil=True, error_model="numpy"
)
def _draw_rows(
    numbers: AnyArray, depths: Float32Array, top: int, bottom: int, depth_image: Float32Array
) -> None:
    """Draw what falls into some rows of the image."""
    width, last = depth_image.shape[1], numbers.shape[0] - 1
    rows = depth_image.reshape(depth_image.size)[top * width : bottom * width]
    first, size = np.int64(top * width), np.int64(rows.shape[0])
    for i in range(numbers.shape[0]):
        coming = np.int64(numbers[min(i + _AHEAD, last)]) - first
        fetch(rows, coming if (coming >= 0) & (coming < size) else 0)
        place = np.int64(numbers[i]) - first
        if (place >= 0) & (place < size):
            depth, p = depths[i], np.uint64(place)
            there = rows[p]
            rows[p] = depth if (there == _NOTHING) | (depth < there) else there


def draw_depths(
    pixels: Float32Array,
    depths: Float32Array,
    visible: BoolArray,
    depth_image: Float32Array,
    *,
    crew: Crew = ALONE,
) -> None:
    """Lower each pixel of the depth image to the least positive depth of the visible points in it.

    Args:
        pixels: (M, 2) [px].
        depths: (M,) [m].
        visible: (M,); other points make no depth.
        depth_image: (H, W) [m], 0 for nothing; written.
        crew: the threads that share the points, and then the rows of the image.
    """
    height, width = depth_image.shape
    numbers = np.empty(len(depths), np.int32)

    def number(_: int, a: int, b: int) -> None:
        _number_drawn(pixels[a:b], depths[a:b], visible[a:b], width, height, numbers[a:b])

    crew.share(len(numbers), number)
    crew.share(height, lambda _, top, bottom: _draw_rows(numbers, depths, top, bottom, depth_image))


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, _IN_F32_2D, boolean[::1]), cache=True, nogil=True, error_model="numpy"
)
def mark_nearest(
    pixels: Float32Array, depths: Float32Array, depth_image: Float32Array, visible: BoolArray
) -> None:
    """Mark the points that are the nearest of their pixel, as a z-buffer over all of them says.

    Args:
        pixels: (M, 2) [px].
        depths: (M,) [m].
        depth_image: (H, W) [m], least depth of each pixel, 0 for nothing.
        visible: (M,), written; equally near points are all visible, and so is a point of a very wide lens that
            lies beside or behind the camera (depth <= 0), with which no depth can be compared.
    """
    height, width = depth_image.shape
    flat_pixels, image = pixels.reshape(pixels.size), depth_image.reshape(depth_image.size)
    numbers = np.empty(BLOCK, np.int32)
    for start in range(0, depths.shape[0], BLOCK):
        stop = min(start + BLOCK, depths.shape[0])
        block = numbers[: stop - start]
        number_pixels(flat_pixels[2 * start : 2 * stop], width, height, block)
        _compare(block, depths[start:stop], image, visible[start:stop])
