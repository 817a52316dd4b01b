"""Blurs of whole pictures: Gaussians, and boxes whose cost does not depend on their width."""

import numpy as np
from numba import float32, int64, types

from sceneloom.arrays import Float32Array
from sceneloom.kernels.cache import kernel

_IMAGE = types.Array(float32, 2, "C", readonly=True)
_TAPS = types.Array(float32, 1, "C", readonly=True)


def blur(image: Float32Array, width: float, *, reach: float = 3.0) -> Float32Array:
    """Blur by a Gaussian; pictures are mirrored at their borders.

    Args:
        image: (H, W) float32.
        width: its standard deviation [px].
        reach: so many standard deviations count.

    Returns:
        (H, W) float32.
    """
    radius = int(reach * width + 0.5)
    taps = np.exp(-0.5 * (np.arange(-radius, radius + 1) / width) ** 2)
    return _blurred(np.ascontiguousarray(image, np.float32), (taps / taps.sum()).astype(np.float32))


def box_means(image: Float32Array, size: int) -> Float32Array:
    """Average over a square; the outermost pixels go on beyond the border.

    Args:
        image: (H, W) float32.
        size: side of the square [px], odd.

    Returns:
        (H, W) float32.
    """
    return _boxed(np.ascontiguousarray(image, np.float32), size // 2)


@kernel(float32[:, ::1](_IMAGE, _TAPS), cache=True, nogil=True)
def _blurred(image: Float32Array, taps: Float32Array) -> Float32Array:
    height, width = image.shape
    radius = taps.shape[0] // 2
    done = np.zeros((height, width), np.float32)
    padded = np.empty(width + 2 * radius, np.float32)
    for row in range(height):
        padded[:] = 0.0
        middle = padded[radius : radius + width]
        for k in range(taps.shape[0]):
            source = (row + k - radius) % (2 * height)
            source = min(source, 2 * height - 1 - source)
            tap, line = taps[k], image[source]
            for column in range(width):
                middle[column] += tap * line[column]
        for beyond in range(radius):
            left, right = beyond % (2 * width), (width - 1 - beyond) % (2 * width)
            padded[radius - 1 - beyond] = middle[min(left, 2 * width - 1 - left)]
            padded[radius + width + beyond] = middle[min(right, 2 * width - 1 - right)]
        target = done[row]
        for k in range(taps.shape[0]):
            tap, shifted = taps[k], padded[k : k + width]
            for column in range(width):
                target[column] += tap * shifted[column]
    return done


@kernel(float32[:, ::1](_IMAGE, int64), cache=True, nogil=True)
def _boxed(image: Float32Array, radius: int) -> Float32Array:
    height, width = image.shape
    scale = 1.0 / (2 * radius + 1) ** 2
    done = np.empty((height, width), np.float32)
    columns = np.zeros(width, np.float64)
    for k in range(-radius, radius + 1):
        line = image[min(max(k, 0), height - 1)]
        for column in range(width):
            columns[column] += line[column]
    for row in range(height):
        total = 0.0
        for k in range(-radius, radius + 1):
            total += columns[min(max(k, 0), width - 1)]
        for column in range(width):
            done[row, column] = total * scale
            total += columns[min(column + radius + 1, width - 1)] - columns[max(column - radius, 0)]
        entering, leaving = image[min(row + radius + 1, height - 1)], image[max(row - radius, 0)]
        for column in range(width):
            columns[column] += entering[column] - leaving[column]
    return done
