"""Depths of points into the pixels of a picture."""

import math

import numba
from numba import boolean, float32, int64, types, void

from sceneloom.arrays import BoolArray, Float32Array

_IN_F32_1D = types.Array(float32, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)


@numba.njit(int64(float32, float32, int64, int64), cache=True, nogil=True, inline="always")
def pixel_index(u: float, v: float, width: int, height: int) -> int:
    """Give the number, row by row, of the pixel nearest to (u, v) [px]; -1 outside the picture and for NaN.

    The picture reaches from -0.5 to size - 0.5; its far border, which rounding to float32 can produce, counts with
    the last row or column.
    """
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        return -1
    column, row = int(u + 0.5), int(v + 0.5)
    return min(row, height - 1) * width + min(column, width - 1)


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, _IN_BOOL_1D, float32[:, ::1]), cache=True, nogil=True, error_model="numpy"
)
def draw_depths(
    pixels: Float32Array, depths: Float32Array, visible: BoolArray, depth_image: Float32Array
) -> None:
    """Lower each pixel of the depth image to the least positive depth of the visible points in it.

    Args:
        pixels: (M, 2) [px].
        depths: (M,) [m].
        visible: (M,); other points make no depth.
        depth_image: (H, W) [m], 0 for nothing; written.
    """
    height, width = depth_image.shape
    image = depth_image.reshape(height * width)
    for i in range(pixels.shape[0]):
        z = depths[i]
        if not (visible[i] and 0.0 < z < math.inf):
            continue
        p = pixel_index(pixels[i, 0], pixels[i, 1], width, height)
        if p >= 0 and (image[p] == 0.0 or z < image[p]):
            image[p] = z


@numba.njit(
    void(_IN_F32_2D, _IN_F32_1D, types.Array(float32, 2, "C", readonly=True), boolean[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
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
    image = depth_image.reshape(height * width)
    for i in range(pixels.shape[0]):
        p = pixel_index(pixels[i, 0], pixels[i, 1], width, height)
        visible[i] = p >= 0 and depths[i] <= max(image[p], float32(0.0))
