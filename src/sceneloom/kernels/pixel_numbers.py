"""The pixel in which a point falls, as one number."""

from typing import Any

import numba
import numpy as np
from numba import float32, int32, int64, types, void

from sceneloom.arrays import AnyArray, Float32Array, Int32Array
from sceneloom.kernels.cache import kernel

PART: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of functions that are compiled, and cached, as parts of others."""

BLOCK = 256
"""Points whose pixels are picked at once, by SIMD."""

_IN_F32_2D = types.Array(float32, 2, "C", readonly=True)

_LOW, _NOTHING, _HALF = np.float32(-0.5), np.float32(0.0), np.float32(0.5)


@numba.njit(**PART, inline="always")
def _round(value: Any) -> Any:
    """Round a number from -0.5 on, halves upward; 0.49999997 + 0.5 would be 1 in float32."""
    whole = np.int32(value)
    return np.int32(whole + np.int32(value - np.float32(whole) >= _HALF))


@numba.njit(**PART)
def number_pixels(flat_pixels: Float32Array, width: int, height: int, numbers: AnyArray) -> None:
    """Write the number of the nearest pixel, counted row by row; -1 outside the image and for NaN.

    The image reaches from -0.5 to size - 0.5; its far border, which rounding to float32 can produce, counts with
    the last row or column.

    Args:
        flat_pixels: (2 M,) [px], u and v alternately.
        width: [px].
        height: [px].
        numbers: (M,) int32, written.
    """
    right, bottom = np.float32(width - 0.5), np.float32(height - 0.5)
    last_column, last_row, columns = np.int32(width - 1), np.int32(height - 1), np.int32(width)
    for i in range(numbers.shape[0]):
        u, v = flat_pixels[2 * i], flat_pixels[2 * i + 1]
        inside = (u >= _LOW) & (u <= right) & (v >= _LOW) & (v <= bottom)
        # In 32 bits at each step: Numba would go on in 64, of which vectors hold half.
        column = np.int32(min(_round(u if inside else _NOTHING), last_column))
        row = np.int32(min(_round(v if inside else _NOTHING), last_row))
        number = np.int32(np.int32(row * columns) + column)
        numbers[i] = number if inside else np.int32(-1)


@kernel(void(_IN_F32_2D, int64, int64, int32[::1]), cache=True, nogil=True, error_model="numpy")
def _number_pixels(pixels: Float32Array, width: int, height: int, numbers: AnyArray) -> None:
    number_pixels(pixels.reshape(pixels.size), width, height, numbers)


def pixel_numbers(pixels: Float32Array, width: int, height: int) -> Int32Array:
    """Give what `number_pixels` writes.

    Args:
        pixels: (M, 2) float32 [px].
        width: [px].
        height: [px].

    Returns:
        (M,) int32.
    """
    numbers = np.empty(len(pixels), np.int32)
    _number_pixels(pixels, width, height, numbers)
    return numbers
