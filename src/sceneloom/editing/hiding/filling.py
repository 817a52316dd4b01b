"""What takes the position of the pixels in a box: nothing from which they could be reported again."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
from sceneloom.errors import OptionError

CELLS = 4
"""A hidden box keeps at most so many mean values along its longer side, each way of a colour."""

_LEAST_CELL = 4
"""No mean is of fewer pixels along a side, but at the box's last row and column [px]."""


def filled(image: UInt8Array, boxes: Int64Array, *, fill: str = "blur") -> UInt8Array:
    """Give a copy of an image whose boxes are hidden, one after the other.

    Args:
        image: (H, W) or (H, W, C) uint8.
        boxes: (K, 4) int64 [px], rows left, top, right, bottom of pixels, right and bottom exclusive, in the image.
        fill: "blur": the means of at most 4 x 4 cells, with smooth changes between them; "pixelate": the same with
            the cells' edges; "black": nothing at all.

    Raises:
        OptionError: there is no such fill.
    """
    paint = FILLS.get(fill)
    if paint is None:
        raise OptionError(f"fill {fill!r}; expected one of {', '.join(FILLS)}")
    hidden = np.array(image, np.uint8)
    for left, top, right, bottom in boxes.tolist():
        region = hidden[top:bottom, left:right]
        if region.size:
            region[...] = paint(region)
    return hidden


def _blurred(region: UInt8Array) -> UInt8Array:
    rows, columns = _cells(region)
    means = _means(region, rows, columns)
    down, across = _weights(rows, region.shape[0]), _weights(columns, region.shape[1])
    smooth = np.einsum("ra,ab...,cb->rc...", down, means, across, optimize=True)
    return np.asarray(np.clip(np.rint(smooth), 0, 255), np.uint8)


def _pixelated(region: UInt8Array) -> UInt8Array:
    rows, columns = _cells(region)
    means = np.asarray(np.rint(_means(region, rows, columns)), np.uint8)
    height, width = region.shape[:2]
    spread = np.repeat(means, np.diff([*rows, height]), axis=0)
    return np.asarray(np.repeat(spread, np.diff([*columns, width]), axis=1), np.uint8)


def _blackened(region: UInt8Array) -> UInt8Array:
    return np.zeros_like(region)


FILLS: Mapping[str, Callable[[UInt8Array], UInt8Array]] = MappingProxyType(
    {"blur": _blurred, "pixelate": _pixelated, "black": _blackened}
)
"""The ways to hide, by name."""


def _cells(region: UInt8Array) -> tuple[Int64Array, Int64Array]:
    """Where the square cells of a region begin, in rows and in columns [px]."""
    height, width = region.shape[:2]
    side = max(-(-max(height, width) // CELLS), _LEAST_CELL)
    return np.arange(0, height, side), np.arange(0, width, side)


def _means(region: UInt8Array, rows: Int64Array, columns: Int64Array) -> Float64Array:
    """The mean of each cell, (rows, columns, ...)."""
    height, width = region.shape[:2]
    sums = np.add.reduceat(np.add.reduceat(region.astype(np.float64), rows, axis=0), columns, axis=1)
    counts = np.outer(np.diff([*rows, height]), np.diff([*columns, width]))
    means: Float64Array = sums / counts.reshape(counts.shape + (1,) * (region.ndim - 2))
    return means


def _weights(starts: Int64Array, length: int) -> Float64Array:
    """How much of each cell's mean each pixel shows, (length, cells): linear between the middles of the cells."""
    middles = (starts + np.array([*starts[1:], length]) - 1) / 2.0
    pixels = np.arange(length)
    return np.stack([np.interp(pixels, middles, row) for row in np.eye(len(starts))], axis=1)
