"""Depths of points into the pixels of a picture."""

import math
from typing import Any

import numba
import numpy as np
from numba import boolean, float32, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array
from sceneloom.kernels.crew import ALONE, Crew
from sceneloom.kernels.fetching import fetch
from sceneloom.kernels.pixel_numbers import BLOCK, PART, number_pixels

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)

_NOTHING, _ENDLESS = np.float32(0.0), np.float32(math.inf)


@numba.njit(**PART)
def _cross_out(numbers: AnyArray, first: Any, size: Any, depths: Float32Array, visible: BoolArray) -> None:
    """Count pixels from `first` on; write -1 beyond so many, and for what makes no depth."""
    for i in range(numbers.shape[0]):
        place = np.int32(numbers[i] - first)
        drawn = (place >= 0) & (place < size) & (depths[i] > _NOTHING) & (depths[i] < _ENDLESS) & visible[i]
        numbers[i] = place if drawn else np.int32(-1)


@numba.njit(**PART)
def _lower(numbers: AnyArray, depths: Float32Array, coming: AnyArray, image: Float32Array) -> None:
    """Lower the pixels of a block of points, and ask for those of the block that is coming."""
    for i in range(depths.shape[0]):
        fetch(image, np.int64(coming[i]))
        if numbers[i] >= 0:
            depth, p = depths[i], np.uint64(numbers[i])
            there = image[p]
            image[p] = depth if (there == _NOTHING) | (depth < there) else there


@numba.njit(**PART)
def _compare(numbers: AnyArray, depths: Float32Array, image: Float32Array, visible: BoolArray) -> None:
    for i in range(numbers.shape[0]):
        nearest = image[np.uint32(numbers[i])] if numbers[i] >= 0 else -_ENDLESS
        visible[i] = (numbers[i] >= 0) & (depths[i] <= max(nearest, _NOTHING))


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, _IN_BOOL_1D, int64, int64, float32[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _draw_rows(
    pixels: Float32Array, depths: Float32Array, visible: BoolArray, top: int, bottom: int, depth_image: Float32Array
) -> None:  # fmt: skip
    """Draw what falls into some rows of the image."""
    height, width = depth_image.shape
    flat_pixels, image = pixels.reshape(pixels.size), depth_image.reshape(depth_image.size)
    first, rows = np.int32(top * width), image[top * width : bottom * width]
    numbers, coming = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32)
    for start in range(0, depths.shape[0] + BLOCK, BLOCK):
        stop = min(start + BLOCK, depths.shape[0])
        if start < stop:
            block = coming[: stop - start]
            number_pixels(flat_pixels[2 * start : 2 * stop], width, height, block)
            _cross_out(block, first, np.int32(rows.shape[0]), depths[start:stop], visible[start:stop])
        _lower(numbers, depths[max(start - BLOCK, 0) : min(start, depths.shape[0])], coming, rows)
        numbers, coming = coming, numbers


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
        crew: the threads that share the rows of the image.
    """
    crew.share(
        len(depth_image),
        lambda _, top, bottom: _draw_rows(pixels, depths, visible, top, bottom, depth_image),
    )


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
