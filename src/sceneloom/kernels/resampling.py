"""Images on another grid: each new pixel is blended from the four old ones around its location."""

import numpy as np
from numba import boolean, float32, types, uint8, void

from sceneloom.arrays import BoolArray, Float32Array, UInt8Array
from sceneloom.kernels.cache import kernel

_IN_F32_3D = types.Array(float32, 3, "C", readonly=True)
_IN_U8_3D = types.Array(uint8, 3, "C", readonly=True)


@kernel(
    void(_IN_U8_3D, _IN_F32_3D, uint8[:, :, ::1], boolean[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def resample_bilinear(rgb: UInt8Array, locations: Float32Array, out: UInt8Array, filled: BoolArray) -> None:
    """Fill an image with what another one shows at given locations; what has no location there is left as it is.

    An image reaches half a pixel beyond the centres of its border pixels; there the border's colour holds.

    Args:
        rgb: (H, W, C), the image.
        locations: (h, w, 2) [px], column and row in `rgb` of each new pixel; NaN for none.
        out: (h, w, C), written where `rgb` has something.
        filled: (h, w), written everywhere: whether it has.
    """
    height, width, channels = rgb.shape
    flat = rgb.reshape(rgb.size)
    one = np.float32(1.0)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    line = np.int64(width * channels)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            u, v = locations[i, j, 0], locations[i, j, 1]
            inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
            filled[i, j] = inside
            if not inside:
                continue
            u, v = min(max(u, np.float32(0.0)), right), min(max(v, np.float32(0.0)), bottom)
            column, row = np.int64(u), np.int64(v)
            to_right, to_below = u - np.float32(column), v - np.float32(row)
            first = np.uint64(row * line + column * channels)
            step = np.uint64(channels if column < width - 1 else 0)
            below = first + np.uint64(line if row < height - 1 else 0)
            for c in range(channels):
                k = np.uint64(c)
                above_value = (one - to_right) * np.float32(flat[first + k]) + to_right * np.float32(
                    flat[first + step + k]
                )
                below_value = (one - to_right) * np.float32(flat[below + k]) + to_right * np.float32(
                    flat[below + step + k]
                )
                value = (one - to_below) * above_value + to_below * below_value
                out[i, j, c] = np.uint8(value + np.float32(0.5))
