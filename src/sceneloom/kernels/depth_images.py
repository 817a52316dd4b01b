"""Depths of points into the pixels of an image."""

import math

import numba
import numpy as np
from numba import boolean, float32, int32, int64, types, void

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Int32Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.pixel_numbers import BLOCK, PART
from sceneloom.kernels.thread_pool import ALONE, ThreadPool

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_I32_1D = types.Array(int32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)

_NOTHING, _STATIC = np.float32(0.0), np.float32(math.inf)


@numba.njit(**PART)
def _pick(
    numbers: Int32Array, depths: Float32Array, visible: BoolArray, first: int, size: int, locations: AnyArray
) -> None:
    """Write where in some rows of the image the points are drawn; -1 for those that are not."""
    for i in range(locations.shape[0]):
        drawn = (depths[i] > _NOTHING) & (depths[i] < _STATIC) & visible[i]
        location = np.int32(numbers[i] - np.int32(first))
        locations[i] = location if drawn & (np.uint32(location) < np.uint32(size)) else np.int32(-1)


@numba.njit(**PART)
def _draw(locations: AnyArray, depths: Float32Array, rows: Float32Array) -> None:
    for i in range(depths.shape[0]):
        if locations[i] >= 0:
            depth, p = depths[i], np.uint64(locations[i])
            there = rows[p]
            rows[p] = depth if (there == _NOTHING) | (depth < there) else there


@kernel(
    void(_IN_I32_1D, _IN_F32_1D, _IN_BOOL_1D, int64, int64, float32[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _draw_rows(
    numbers: Int32Array,
    depths: Float32Array,
    visible: BoolArray,
    top: int,
    bottom: int,
    depth_image: AnyArray,
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
    rows = len(depth_image)
    thread_pool.share(
        rows, lambda _, top, bottom: _draw_rows(pixel_numbers, depths, visible, top, bottom, depth_image)
    )


@kernel(void(_IN_I32_1D, _IN_F32_1D, _IN_F32_2D, boolean[::1]), cache=True, nogil=True, error_model="numpy")
def mark_nearest(
    pixel_numbers: Int32Array, depths: Float32Array, depth_image: Float32Array, visible: BoolArray
) -> None:
    """Mark the points that are the nearest of their pixel, as a z-buffer over all of them says.

    Args:
        pixel_numbers: (M,), counted row by row; negative outside the image.
        depths: (M,) [m].
        depth_image: (H, W) [m], least depth of each pixel, 0 for nothing.
        visible: (M,), written; equally near points are all visible, and so is a point of a very wide camera model that
            lies beside or behind the camera (depth <= 0), with which no depth can be compared.
    """
    image = depth_image.reshape(depth_image.size)
    for i in range(depths.shape[0]):
        inside = (pixel_numbers[i] >= 0) & (pixel_numbers[i] < image.shape[0])
        nearest = image[np.uint32(pixel_numbers[i])] if inside else -_STATIC
        visible[i] = inside & (depths[i] <= max(nearest, _NOTHING))
