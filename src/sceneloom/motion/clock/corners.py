"""Corners from one image to the next."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, UInt8Array

LARGEST_WIDTH = 720
"""Wider images are shrunk by a whole number: a tenth of a small pixel is enough, and they are quicker."""

_CELLS = 500
"""About so many corners, one in each cell of a grid, so that they are spread over the image."""

_HALF_WINDOW = 7
_ROUNDS = 20
_LEAST_STRENGTH = 4.0
"""Mean squared gradient along the weaker direction [grey levels²]: well above the noise of an image."""

_FARTHEST_BACK = 0.25
"""A corner that is followed back comes at most so far from where it was [px]. Source: Kalal, Mikolajczyk and Matas
2010, "Forward-Backward Error"."""

_SMALLEST = 48
"""No image of the pyramid is narrower or lower [px]."""

_BLUR = np.array([1.0, 4.0, 6.0, 4.0, 1.0], np.float32) / 16.0
"""Source: Burt and Adelson 1983, a = 0.375."""


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """An image in grey, and smaller and smaller.

    Attributes:
        levels: (h, w) float32 each, halved from one to the next.
        shrunk: by how much the first is smaller than the image.
    """

    levels: tuple[Float32Array, ...]
    shrunk: int

    @classmethod
    def of(cls, rgb: UInt8Array) -> "Pyramid":
        """Make it of an image (H, W, 3)."""
        shrunk = -(-rgb.shape[1] // LARGEST_WIDTH)
        height, width = rgb.shape[0] // shrunk, rgb.shape[1] // shrunk
        small = rgb[: height * shrunk, : width * shrunk].astype(np.float32) @ _GREY
        if shrunk > 1:
            small = _shrunk(small, shrunk)
        levels = [np.ascontiguousarray(small, np.float32)]
        while min(levels[-1].shape) >= 2 * _SMALLEST:
            levels.append(_halved(levels[-1]))
        return cls(tuple(levels), shrunk)

    def outer(self, pixels: Float64Array) -> Float64Array:
        """Take locations (N, 2) of the first level into the image [px]."""
        return (pixels + 0.5) * self.shrunk - 0.5


_GREY = np.array([0.299, 0.587, 0.114], np.float32)
"""Source: ITU-R BT.601, luma."""


def _shrunk(grey: Float32Array, times: int) -> Float32Array:
    """The means of squares of so many pixels a side."""
    height, width = grey.shape
    squares = grey.reshape(height // times, times, width // times, times)
    means: Float32Array = squares.mean(axis=(1, 3), dtype=np.float32)
    return means


def _halved(grey: Float32Array) -> Float32Array:
    height, width = grey.shape
    wide: Float32Array = np.pad(grey, ((2, 2), (2, 2)), mode="edge")
    upright = np.zeros((height, width + 4), np.float32)
    blurred = np.zeros((height, width), np.float32)
    for k, weight in enumerate(_BLUR):
        upright += weight * wide[k : k + height]
    for k, weight in enumerate(_BLUR):
        blurred += weight * upright[:, k : k + width]
    return np.ascontiguousarray(blurred[::2, ::2], np.float32)


def find_corners(pyramid: Pyramid) -> Float32Array:
    """Find corners spread over an image: (N, 2) float32 [px] of the first level."""
    from sceneloom.kernels.feature_tracking import corner_strengths

    grey = pyramid.levels[0]
    strengths = np.empty_like(grey)
    corner_strengths(grey, 2, strengths)
    border = _HALF_WINDOW + 2
    strengths[:border] = strengths[-border:] = 0.0
    strengths[:, :border] = strengths[:, -border:] = 0.0
    height, width = grey.shape
    cell = max(8, int(np.sqrt(height * width / _CELLS)))
    rows, columns = height // cell, width // cell
    if rows == 0 or columns == 0:
        return np.zeros((0, 2), np.float32)
    squares = strengths[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    cells = squares.transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = cells.argmax(axis=1)
    strong = cells[np.arange(len(cells)), best] > _LEAST_STRENGTH
    numbers = np.flatnonzero(strong)
    v = numbers // columns * cell + best[strong] // cell
    u = numbers % columns * cell + best[strong] % cell
    return np.stack([u, v], axis=1).astype(np.float32)


def followed(first: Pyramid, second: Pyramid, corners: Float32Array) -> tuple[Float32Array, BoolArray]:
    """Find corners (N, 2) of one image in the next one, there and back again.

    Returns:
        (N, 2) float32 [px] of the first level, and (N,) bool whether each was found.
    """
    there, found = _through_levels(first, second, corners)
    back, found_back = _through_levels(second, first, there)
    near = np.linalg.norm(back - corners, axis=1) <= _FARTHEST_BACK
    return there, found & found_back & near


def _through_levels(first: Pyramid, second: Pyramid, corners: Float32Array) -> tuple[Float32Array, BoolArray]:
    """From the smallest image to the largest. Source: Bouguet 2000."""
    from sceneloom.kernels.feature_tracking import follow_corners

    count = min(len(first.levels), len(second.levels))
    found = np.zeros(len(corners), np.bool_)
    guesses = (corners / 2 ** (count - 1)).astype(np.float32)
    for level in reversed(range(count)):
        pixels = np.ascontiguousarray(corners / 2**level, np.float32)
        guesses = np.ascontiguousarray(guesses)
        before = guesses.copy()
        follow_corners(
            first.levels[level], second.levels[level], pixels, _HALF_WINDOW, _ROUNDS, guesses, found
        )
        if level:
            # what is lost in a small image may be found in a larger one
            lost = ~found
            guesses[lost] = before[lost]
            guesses = guesses * 2
    return guesses, found
