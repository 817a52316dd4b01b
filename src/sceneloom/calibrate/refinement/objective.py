"""How well points fall onto an image, as a smooth function of a few numbers with its derivatives.

Each channel compares its points with a map of the image that was blurred to some width and freed of what is wider:
a candidate that moves non-finite points in particular gets 0. If a point that is where it belongs meets the mean value
m of its map, and the map's values vary by v, then m/v times the value is the logarithm of how much likelier the point's
location is than any other (both normal): channels are weighted by that, so the best-matching ones count most.

Source: edges of clouds against blurred edges of images: Levinson and Thrun 2013; intensity against brightness:
Pandey, McBride, Savarese and Eustice 2012; Gaussian scale space, coarse to fine: Witkin, Terzopoulos and Kass 1987.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array
from sceneloom.calibrate.measures.images import blur, box_means, evened
from sceneloom.calibrate.refinement.cues import CHANNELS, LEVEL_MAP, Cues
from sceneloom.calibrate.refinement.moving_pixels import moving_pixels
from sceneloom.kernels.aligned_maps import sum_maps

WIDTHS_PX = (6.0, 3.0, 1.0)
"""How far camera_images are blurred [px of the measured camera_image], from the first look to the last."""
_STRIDES = {6.0: 3, 3.0: 2, 1.0: 1}
"""So many pixels of an image are one of the map: a wide blur leaves nothing between them."""

_WIDER = 4.0
_BRIGHTNESS_SHARE = 0.5
"""Contrasts are known where their points are, edges between two points: brightness is blurred less than edges."""
_CELL_WIDTHS = 2.0
"""Points of a channel within so many widths see the same of an image: they count as one."""


def fill_maps(cues: Cues, width: float, maps: Float32Array) -> None:
    """Blur an image: edges by direction, then brightness.

    Args:
        width: of the blur [px of the image].
        maps: (K, H, W) float32, filled.
    """
    camera_image, stride = cues.features.image, _STRIDES[width]
    for k, image in enumerate(camera_image.edges["fine"]):
        maps[k] = _band(_reduced(image, stride), width / stride)
    maps[LEVEL_MAP] = _band(_reduced(evened(camera_image.grey), stride), _BRIGHTNESS_SHARE * width / stride)


def _reduced(image: Float32Array, stride: int) -> Float32Array:
    """Average blocks of pixels; what is left over at the right and the bottom is cut."""
    height, width = (max(size // stride, 1) * min(stride, size) for size in image.shape)
    if stride == 1:
        return image
    blocks = [
        image[row:height:stride, column:width:stride]
        for row in range(min(stride, height))
        for column in range(min(stride, width))
    ]
    return np.asarray(sum(blocks[1:], start=blocks[0]) / np.float32(len(blocks)), np.float32)


def _band(image: Float32Array, width: float) -> Float32Array:
    """Blur, and take off what a blur of several times the width leaves: two boxes are nearly a Gaussian."""
    box = 2 * round(_WIDER * width * np.sqrt(6.0) / 2.0) + 1
    return np.asarray(blur(image, width) - box_means(box_means(image, box), box), np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """All frames at one width.

    Attributes:
        cues: of each frame.
        width: of the blur [px].
        maps: (F K, H, W) float32.
        rows: (N,) int32, the map of each point.
        groups: (N,) int32, frame and channel of each point.
        weights: (N,) float32.
        chosen: (N,) int64, number of each point among those of all frames; None where all are there.
    """

    cues: tuple[Cues, ...]
    width: float
    maps: Float32Array
    rows: AnyArray
    groups: AnyArray
    weights: Float32Array
    chosen: AnyArray | None = None

    @classmethod
    def of(cls, cues: Sequence[Cues], width: float) -> "Level":
        """Blur all images, which must be of one size."""
        height, across = _reduced(cues[0].features.image.grey, _STRIDES[width]).shape
        kinds = LEVEL_MAP + 1
        maps = np.empty((len(cues) * kinds, height, across), np.float32)
        for k, one in enumerate(cues):
            fill_maps(one, width, maps[k * kinds : (k + 1) * kinds])
        return cls(
            tuple(cues),
            width,
            maps,
            np.concatenate([one.maps + kinds * k for k, one in enumerate(cues)]).astype(np.int32),
            np.concatenate([one.channels + len(CHANNELS) * k for k, one in enumerate(cues)]).astype(np.int32),
            np.concatenate([one.weights for one in cues]),
        )

    def part(self, frames: AnyArray, *, most: int | None = None) -> "Level":
        """Keep the points of some frames, (F,) bool, evenly drawn about so many of them; the maps are shared."""
        kept = np.flatnonzero(frames[self.groups // len(CHANNELS)])
        if most is not None:
            kept = kept[:: max(-(-len(kept) // most), 1)]
        return replace(self, chosen=kept if self.chosen is None else self.chosen[kept], **self._rows(kept))

    def _rows(self, kept: AnyArray) -> dict[str, Any]:
        return {"rows": self.rows[kept], "groups": self.groups[kept], "weights": self.weights[kept]}

    def around(self, numbers: Float64Array, free: AnyArray) -> "Linearised":
        """Take pixels and their derivatives at a candidate, (8,) numbers, for those of them that are free, (P,)."""
        stride = _STRIDES[self.width]
        chosen = np.arange(len(self.groups)) if self.chosen is None else self.chosen
        begins = np.cumsum([0, *(len(one.weights) for one in self.cues)])
        of = np.searchsorted(chosen, begins)
        pixels, slopes = (
            np.empty((len(chosen), 2), np.float32),
            np.empty((len(chosen), 2, len(free)), np.float32),
        )
        for k, one in enumerate(self.cues):
            own = slice(of[k], of[k + 1])
            if of[k] < of[k + 1]:
                found, trajectories = moving_pixels(one, chosen[own] - begins[k], numbers, free)
                pixels[own] = (found + 0.5) / stride - 0.5
                slopes[own] = trajectories / stride
        return Linearised(self, pixels, slopes)


@dataclass(frozen=True, slots=True, eq=False)
class Sums:
    """What a candidate came to, by frame and channel.

    Attributes:
        values: (F, C) float64, weighted sums of the maps' values.
        squares: (F, C) float64, sums of their squares.
        gradients: (F, C, P) float64, derivatives of the values, each by its unit.
    """

    values: Float64Array
    squares: Float64Array
    gradients: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """A level around a candidate: pixels move straight with the numbers.

    Attributes:
        level: the level.
        pixels: (N, 2) float32 [px of the maps].
        slopes: (N, 2, P) float32, by unit.
    """

    level: Level
    pixels: Float32Array
    slopes: Float32Array

    def sums(self, step: Float64Array) -> Sums:
        """Evaluate at a step, (P,) in units, from the candidate."""
        shape = len(self.level.cues), len(CHANNELS)
        count = shape[0] * shape[1]
        values, squares = np.zeros(count), np.zeros(count)
        gradients = np.zeros((count, self.slopes.shape[2]))
        sum_maps(
            self.pixels, self.slopes, np.ascontiguousarray(step, np.float64), self.level.weights,
            self.level.rows, self.level.groups, self.level.maps, values, squares, gradients,
        )  # fmt: skip
        return Sums(values.reshape(shape), squares.reshape(shape), gradients.reshape(*shape, -1))

    def channel_weights(self, step: Float64Array) -> Float64Array:
        """What each channel counts at a step, (C,): m/v of its values, times the share of points that report news.

        A channel whose points do not fit better than others would gets 0.
        """
        sums = self.sums(step)
        counts, distinct = self._counts()
        safe = np.maximum(counts, 1.0)
        means = sums.values.sum(axis=0) / safe
        variances = np.maximum(sums.squares.sum(axis=0) / safe - means**2, 1e-12)
        return np.asarray(np.maximum(means, 0.0) / variances * distinct / safe, np.float64)

    def motion_form(self) -> Float64Array:
        """The mean square of how far pixels move with a step in units, as a quadratic form (P, P) [blur widths]."""
        rows = self._inside()
        if len(rows) == 0:
            return np.zeros((self.slopes.shape[2],) * 2)
        scale = _STRIDES[self.level.width] / self.level.width
        moved = np.float64(scale) * self.slopes[rows].reshape(2 * len(rows), -1)
        form: Float64Array = np.einsum("ip,iq->pq", moved, moved) / len(rows)
        return form

    def _inside(self) -> AnyArray:
        """Rows of the points in the images."""
        size = np.array(self.level.maps.shape[:0:-1])
        with np.errstate(invalid="ignore"):
            return np.flatnonzero(((self.pixels >= 0.0) & (self.pixels < size - 1)).all(axis=1))

    def _counts(self) -> tuple[Float64Array, Float64Array]:
        """How many points of each channel fall into the images, and into how many cells of a few widths."""
        cell = _CELL_WIDTHS * self.level.width / _STRIDES[self.level.width]
        inside = self._inside()
        groups = self.level.groups[inside]
        cells = (self.pixels[inside] / np.float32(cell)).astype(np.int32)
        across, down = (int(size / cell) + 1 for size in self.level.maps.shape[:0:-1])
        taken = np.zeros((len(self.level.cues), len(CHANNELS), across * down), np.bool_)
        taken.reshape(-1)[(groups * np.int64(down) + cells[:, 1]) * across + cells[:, 0]] = True
        counts = np.bincount(groups % len(CHANNELS), minlength=len(CHANNELS)).astype(np.float64)
        return counts, taken.sum(axis=(0, 2)).astype(np.float64)
