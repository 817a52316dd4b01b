"""Images: RGB from YUV with halved chroma, bilinear resampling."""

from typing import Any

import numpy as np
from numba import boolean, int16, int64, uint8, void

from sceneloom.arrays import BoolArray, Float32Array, Int64Array, UInt8Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_F32_3D, IN_U8_2D, IN_U8_3D, inlined, part

_FRACTION_BITS = 5  # of a level. With one more, the sum of brightness and colour would leave 16 bits.


# compiled by itself: in place, the product becomes one of 64 bits
@kernel(int16(int16, int16))
def _high(a: Any, b: Any) -> Any:
    """The upper half of the product of two 16-bit numbers, rounded down: one instruction for many pixels."""
    return np.int16(np.int32(np.int32(a) * np.int32(b)) >> 16)


@inlined
def _centred(level):  # type: ignore[no-untyped-def]
    """A level without its middle, filling 16 bits."""
    return np.int16(np.int16(np.int16(level) - 128) << 8)


@part
def _scale(colour, factor, scaled):  # type: ignore[no-untyped-def]
    for k in range(len(scaled)):
        scaled[k] = _high(_centred(colour[k]), factor)


@part
def _scale_both(blue, blue_factor, red, red_factor, scaled):  # type: ignore[no-untyped-def]
    for k in range(len(scaled)):
        of_blue, of_red = _high(_centred(blue[k]), blue_factor), _high(_centred(red[k]), red_factor)
        scaled[k] = np.int16(of_blue + of_red + np.int16(1))


@part
def _spread(scaled, spread, half_columns):  # type: ignore[no-untyped-def]
    """Give each pixel of a row its colour: linear between samples on even columns, or midway between two columns."""
    last = len(scaled) - 1
    if half_columns == 1:
        spread[0], spread[2 * last + 1] = scaled[0], scaled[last]
        for k in range(last):
            a, b = scaled[k], scaled[k + 1]
            step = np.int16(b - a)
            spread[2 * k + 1] = np.int16(a + np.int16(np.int16(step + 2) >> 2))
            spread[2 * k + 2] = np.int16(b - np.int16(np.int16(step + 2) >> 2))
    else:
        for k in range(last):
            a, b = scaled[k], scaled[k + 1]
            spread[2 * k] = a
            spread[2 * k + 1] = np.int16(np.int16(a + b + 1) >> 1)
        spread[2 * last] = spread[2 * last + 1] = scaled[last]


@inlined
def _level(bright, near, far):  # type: ignore[no-untyped-def]
    """A pixel's level, from its brightness and the colours of the rows of samples next to it."""
    colour = np.int16(near + np.int16(np.int16(far - near + 2) >> 2))
    level = np.int16(np.int16(bright + colour) >> _FRACTION_BITS)
    return np.uint8(min(max(level, np.int16(0)), np.int16(255)))


@part
def _spread_colours(blue, red, factors, half_columns, scaled, spread):  # type: ignore[no-untyped-def]
    """Give each column what one row of samples adds to red, green and blue."""
    _scale(red, np.int16(factors[2]), scaled)
    _spread(scaled, spread[0], half_columns)
    _scale_both(blue, np.int16(factors[3]), red, np.int16(factors[4]), scaled)
    _spread(scaled, spread[1], half_columns)
    _scale(blue, np.int16(factors[5]), scaled)
    _spread(scaled, spread[2], half_columns)


@part
def _paint(luma, near, far, factors, line):  # type: ignore[no-untyped-def]
    """Fill a row of pixels, a quarter of the way from one row of samples to the next one."""
    gain, offset = np.int16(factors[0]), np.int16(factors[1])
    reds, greens, blues = near[0], near[1], near[2]
    far_reds, far_greens, far_blues = far[0], far[1], far[2]
    for x in range(len(line) // 3):
        bright = np.int16(_high(_centred(luma[x]), gain) + offset)
        line[3 * x] = _level(bright, reds[x], far_reds[x])
        line[3 * x + 1] = _level(bright, greens[x], far_greens[x])
        line[3 * x + 2] = _level(bright, blues[x], far_blues[x])


@kernel(void(IN_U8_2D, IN_U8_2D, IN_U8_2D, int64[::1], int64, uint8[:, ::1]))
def rgb_from_halved_chroma(
    luma: UInt8Array, blue: UInt8Array, red: UInt8Array, factors: Int64Array, half_columns: int, rgb: UInt8Array
) -> None:
    """Rotate brightness and halved colours into red, green and blue; colours are linearly interpolated.

    A sample of colour lies midway between two rows, and on the even column or midway between two columns.

    Args:
        luma: (height, at least width), whose first columns are the image's.
        blue, red: (height / 2, at least width / 2), differences of blue and red from brightness.
        factors: (6,) below 32768, the formula's factors of `formats.video.reader`.
        half_columns: how far right of the even column a sample of colour lies, in halves of a pixel: 0 or 1.
        rgb: (height, 3 width), filled; both sizes even.
    """
    height, width = rgb.shape[0], rgb.shape[1] // 3
    half = width // 2
    scaled = np.empty(half, np.int16)
    spread = np.empty((2, 3, width), np.int16)
    for k in range(height // 2 + 1):
        latest = min(k, height // 2 - 1)
        if k == latest:
            _spread_colours(blue[k], red[k], factors, half_columns, scaled, spread[k % 2])
        before, after = spread[max(k - 1, 0) % 2], spread[latest % 2]
        if k > 0:
            _paint(luma[2 * k - 1], before, after, factors, rgb[2 * k - 1])
        if k == latest:
            _paint(luma[2 * k], after, before, factors, rgb[2 * k])


@kernel(void(IN_U8_3D, IN_F32_3D, uint8[:, :, ::1], boolean[:, ::1]))
def resample_bilinear(rgb: UInt8Array, locations: Float32Array, out: UInt8Array, filled: BoolArray) -> None:
    """Fill an image with what another one shows at given locations; what has no location there is left as it is.

    An image reaches half a pixel beyond the centres of its border pixels; there the border's colour holds.

    `rgb` (H, W, C), the image; `locations` (h, w, 2) [px], column and row in `rgb` of each new pixel; NaN for none;
    `out` (h, w, C), written where `rgb` has something; `filled` (h, w), written everywhere: whether it has.
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
