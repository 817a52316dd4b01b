"""Boxes as whole pixels of images: wider by a margin, cut to the image, counted where nothing stays of them."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.hiding.boxes import Hiding
from sceneloom.errors import OptionError


@dataclass(frozen=True, slots=True, eq=False)
class HiddenRegions:
    """What is hidden in each image of a camera.

    Attributes:
        pixels: by the number of the image, (K, 4) int64 left, top, right, bottom [px], right and bottom exclusive.
        outside: how many boxes lie outside of their images or have no size.
        cut: how many reach beyond an edge of theirs.
    """

    pixels: dict[int, Int64Array]
    outside: int
    cut: int


def hidden_regions(hiding: Hiding, width: int, height: int, *, margin: float = 0.1) -> HiddenRegions:
    """Widen boxes, and find the pixels that they touch.

    Args:
        hiding: the boxes.
        width, height: of the images [px].
        margin: by what share of its width and height a box grows on each side.

    Raises:
        OptionError: the margin is negative or no number.
    """
    if not 0.0 <= margin < float("inf"):
        raise OptionError(f"margin {margin}; expected 0 or more")
    low, high = hiding.boxes[:, :2], hiding.boxes[:, 2:]
    size = (width, height)
    there = np.all((high > low) & (high > 0.0) & (low < size), axis=1)
    cut = there & np.any((low < 0.0) | (high > size), axis=1)
    wider = (high - low) * margin
    corners = _whole(low - wider, high + wider, size)
    pixels = {
        int(image): corners[there & (hiding.images == image)] for image in np.unique(hiding.images[there])
    }
    return HiddenRegions(pixels, int((~there).sum()), int(cut.sum()))


def _whole(low: Float64Array, high: Float64Array, size: tuple[int, int]) -> Int64Array:
    """The even pixels around boxes: colours of most videos stand for two by two."""
    least = np.clip(2 * np.floor(low / 2), 0, size)
    most = np.clip(2 * np.ceil(high / 2), 0, size)
    return np.concatenate([least, most], axis=1).astype(np.int64)
