"""Colours of pictures onto the points seen in them."""

import numba
from numba import boolean, float32, float64, int64, types, uint8, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from sceneloom.kernels.depth_images import pixel_index

_IN_I64_1D = types.Array(int64, 1, "C", readonly=True)
_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)
_IN_BOOL_1D = types.Array(boolean, 1, "C", readonly=True)
_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)


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
        eccentricities: (N,), updated: least squared distance so far from a picture's centre, in half diagonals.
        colors: (N, 3), updated.
        camera_index: (N,), updated.
    """
    height, width = rgb.shape[0], rgb.shape[1]
    colours = rgb.reshape(height * width, 3)
    center_u, center_v = 0.5 * (width - 1), 0.5 * (height - 1)
    per_square = 4.0 / float64(width * width + height * height)
    for i in range(point_ids.shape[0]):
        k = point_ids[i]
        if not visible[i] or k < 0 or k >= eccentricities.shape[0]:
            continue
        p = pixel_index(pixels[i, 0], pixels[i, 1], width, height)
        du, dv = pixels[i, 0] - center_u, pixels[i, 1] - center_v
        eccentricity = (du * du + dv * dv) * per_square
        if p >= 0 and eccentricity < eccentricities[k]:
            eccentricities[k] = eccentricity
            camera_index[k] = camera
            colors[k, 0], colors[k, 1], colors[k, 2] = colours[p, 0], colours[p, 1], colours[p, 2]
