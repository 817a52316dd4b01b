"""Putting many small discs into an image at once, the nearer over the farther, with soft edges."""

from collections.abc import Iterator
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from sceneloom.arrays import BoolArray, Float32Array, FloatArray, Int64Array, UInt8Array

_FINE = 2
"""Each pixel is sampled at 2 x 2 locations, so that the edges of discs look smooth."""


def draw_discs(
    image: UInt8Array,
    pixels: FloatArray,
    depths: FloatArray,
    colours: UInt8Array,
    radii_px: FloatArray | float,
) -> UInt8Array:
    """Draw one disc per point over an image.

    Args:
        image: (H, W, 3) uint8, left as it is.
        pixels: (N, 2) float [px], centres of the discs; parts outside the image are cut off.
        depths: (N,) float, what decides which disc covers which: the smaller is drawn over the larger.
        colours: (N, 3) uint8.
        radii_px: (N,) or one float [px].

    Returns:
        (H, W, 3) uint8, a new image.
    """
    height, width = image.shape[:2]
    owners = _owners(height * _FINE, width * _FINE, *_fine_discs(pixels, depths, radii_px))
    return _blend(image, owners, colours[np.argsort(-depths, kind="stable")])


def draw_crosses(
    image: UInt8Array, pixels: FloatArray, colour: tuple[int, int, int], *, arm_px: int = 2
) -> UInt8Array:
    """Draw a small diagonal cross of one colour at each of (N, 2) pixels; gives a new image."""
    height, width = image.shape[:2]
    marked = image.copy()
    columns, rows = np.rint(pixels).astype(np.int64).T
    for step in range(-arm_px, arm_px + 1):
        for row_step in {step, -step}:
            inside = _inside(columns + step, rows + row_step, width, height)
            marked[rows[inside] + row_step, columns[inside] + step] = colour
    return marked


def _fine_discs(
    pixels: FloatArray, depths: FloatArray, radii_px: FloatArray | float
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Give columns, rows and radii on the fine grid, the farthest disc first.

    Columns and rows count the corners between fine cells: a disc then lies evenly around the centre of a pixel.
    """
    order = np.argsort(-depths, kind="stable")
    radii = np.broadcast_to(np.asarray(radii_px, np.float64), (len(order),))[order]
    # A disc of about one pixel, were it spread over two, would take half of each pixel's colour from below.
    centers = np.where(radii[:, None] < 1.0, np.rint(pixels[order]), pixels[order])
    fine = np.rint((centers + 0.5) * _FINE).astype(np.int64)
    return fine[:, 0], fine[:, 1], np.maximum(np.rint(radii * _FINE), 1).astype(np.int64)


def _owners(
    height: int, width: int, columns: Int64Array, rows: Int64Array, radii: Int64Array
) -> NDArray[np.int32]:
    """Give for each cell the 1-based number of the last disc that covers it, 0 for none, (height, width)."""
    owners = np.zeros(height * width, np.int32)
    numbers = np.arange(1, len(columns) + 1, dtype=np.int32)
    for radius in np.unique(radii):
        chosen = radii == radius
        u, v, n = columns[chosen], rows[chosen], numbers[chosen]
        for du, dv in _disc(int(radius)):
            inside = _inside(u + du, v + dv, width, height)
            np.maximum.at(owners, (v[inside] + dv) * width + u[inside] + du, n[inside])
    return owners.reshape(height, width)


def _disc(radius: int) -> Iterator[tuple[int, int]]:
    """Give the steps from a corner to all cells whose centres lie in a disc around it."""
    reach = range(-radius, radius)
    return ((du, dv) for dv in reach for du in reach if (du + 0.5) ** 2 + (dv + 0.5) ** 2 <= radius**2)


def _inside(columns: Int64Array, rows: Int64Array, width: int, height: int) -> BoolArray:
    return np.asarray((columns >= 0) & (columns < width) & (rows >= 0) & (rows < height))


def _blend(image: UInt8Array, owners: NDArray[np.int32], colours: UInt8Array) -> UInt8Array:
    """Mix each pixel of the colours of its fine cells; cells without a disc show the image."""
    cells = [owners[down::_FINE, right::_FINE] for down in range(_FINE) for right in range(_FINE)]
    rows, columns = np.nonzero(reduce(np.bitwise_or, cells))
    below = image[rows, columns]
    total: Float32Array = np.zeros((len(rows), 3), np.float32)
    for cell in cells:
        owner = cell[rows, columns]
        total += np.where((owner > 0)[:, None], colours[owner - 1], below)
    blended = image.copy()
    blended[rows, columns] = np.rint(total / len(cells))
    return blended
