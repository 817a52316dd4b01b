"""Red, green and blue of pictures whose colour has half the resolution of their brightness, in 16-bit numbers."""

from typing import Any

import numba
import numpy as np
from numba import int16, int64, types, uint8, void

from sceneloom.arrays import Int64Array, UInt8Array

FRACTION_BITS = 5
"""Of a level. With one more, the sum of brightness and colour would leave 16 bits."""

_ROUNDED = 1 << (FRACTION_BITS - 1)
_CENTRE_4 = 512
"""Colour that is none, in quarters of a level."""

_PART: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}
_READ_2D = types.Array(uint8, 2, "C", readonly=True)


# compiled by itself: in place, the product becomes one of 64 bits
@numba.njit(int16(int16, int16), nogil=True, error_model="numpy")
def _high(a, b):  # type: ignore[no-untyped-def]
    """The upper half of the product of two 16-bit numbers, rounded down: one instruction for many pixels."""
    return np.int16(np.int32(np.int32(a) * np.int32(b)) >> 16)


@numba.njit(**_PART)
def _between(near, far):  # type: ignore[no-untyped-def]
    """Colour of a row a quarter of the way to the next one, without its middle, filling 16 bits."""
    return np.int16(np.int16(3 * np.int16(near) + np.int16(far) - _CENTRE_4) << 6)


@numba.njit(**_PART)
def _scale(near, far, factor, scaled):  # type: ignore[no-untyped-def]
    for k in range(len(scaled)):
        scaled[k] = _high(_between(near[k], far[k]), factor)


@numba.njit(**_PART)
def _scale_both(near, far, factor, near_2, far_2, factor_2, scaled):  # type: ignore[no-untyped-def]
    for k in range(len(scaled)):
        first = _high(_between(near[k], far[k]), factor)
        second = _high(_between(near_2[k], far_2[k]), factor_2)
        scaled[k] = np.int16(first + second + np.int16(1))


@numba.njit(**_PART)
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


@numba.njit(**_PART)
def _level(value):  # type: ignore[no-untyped-def]
    level = np.int16(value >> FRACTION_BITS)
    return np.uint8(min(max(level, np.int16(0)), np.int16(255)))


@numba.njit(
    void(_READ_2D, _READ_2D, _READ_2D, int64[::1], int64, uint8[:, ::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def rgb_from_halved_chroma(
    luma: UInt8Array,
    blue: UInt8Array,
    red: UInt8Array,
    factors: Int64Array,
    half_columns: int,
    rgb: UInt8Array,
) -> None:
    """Turn brightness and halved colours into red, green and blue; colours are linearly interpolated.

    A sample of colour lies midway between two rows, and on the even column or midway between two columns.

    Args:
        luma: (height, at least width), whose first columns are the picture's.
        blue, red: (height / 2, at least width / 2), differences of blue and red from brightness.
        factors: (6,) below 32768, the formula's factors as `conversion_factors` gives them.
        half_columns: how far right of the even column a sample of colour lies, in halves of a pixel: 0 or 1.
        rgb: (height, 3 width), filled; both sizes even.
    """
    height, width = rgb.shape[0], rgb.shape[1] // 3
    half = width // 2
    scaled = np.empty(half, np.int16)
    reds, greens, blues = np.empty(width, np.int16), np.empty(width, np.int16), np.empty(width, np.int16)
    gain, offset = np.int16(factors[0]), np.int16(factors[1])
    for row in range(height):
        near = row // 2
        far = min(max(near - 1 + 2 * (row % 2), 0), height // 2 - 1)
        _scale(red[near], red[far], np.int16(factors[2]), scaled)
        _spread(scaled, reds, half_columns)
        _scale(blue[near], blue[far], np.int16(factors[5]), scaled)
        _spread(scaled, blues, half_columns)
        _scale_both(
            blue[near], blue[far], np.int16(factors[3]), red[near], red[far], np.int16(factors[4]), scaled
        )
        _spread(scaled, greens, half_columns)
        bright, line = luma[row], rgb[row]
        for x in range(width):
            level = np.int16(_high(np.int16(np.int16(bright[x]) << 7), gain) + offset)
            line[3 * x] = _level(np.int16(level + reds[x]))
            line[3 * x + 1] = _level(np.int16(level + greens[x]))
            line[3 * x + 2] = _level(np.int16(level + blues[x]))


def conversion_factors(red_share: float, blue_share: float, *, full: bool) -> Int64Array:
    """Put the formula's factors into fixed point.

    Args:
        red_share, blue_share: of red and blue in brightness.
        full: whether brightness has the levels 0 to 255, not 16 to 235.

    Returns:
        (6,): gain and offset of brightness; red of the red difference; green of the blue and of the red difference;
        blue of the blue difference.

    Source: ITU-R BT.601-7 and BT.709-6, clause 3; ITU-T H.264, E.2.1, `video_full_range_flag`.
    """
    darkest, luma_gain, chroma_gain = (0, 1.0, 1.0) if full else (16, 255 / 219, 255 / 224)
    green_share = 1 - red_share - blue_share
    red, blue = 2 * (1 - red_share) * chroma_gain, 2 * (1 - blue_share) * chroma_gain
    unit = 1 << FRACTION_BITS
    differences = np.array([red, -blue_share / green_share * blue, -red_share / green_share * red, blue])
    # the two products of a sum are rounded down: half a unit each
    offset = round(-darkest * luma_gain * unit) + _ROUNDED + 1
    # brightness comes seven bits up and colour, in quarters, six: a product gives its upper 16 of 32 bits
    gain = luma_gain * unit * (1 << 16 - 7)
    scaled = np.rint(differences * unit / 4 * (1 << 16 - 6))
    return np.array([round(gain), offset, *scaled], np.int64)
