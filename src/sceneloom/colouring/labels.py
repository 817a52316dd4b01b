"""Labels of images transferred to the visible points, and labels of points into images.

Labels are never mixed: a point takes that of its nearest pixel, several images vote, and of equally many votes those
count more whose images are nearer in time. In an image, the nearest visible point of a pixel counts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import float32, int64, types, uint16, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt16Array, check_array
from sceneloom.colouring.blending import view_weights
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError, OptionError
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import IN_BOOL_1D, IN_F32_1D, IN_F32_2D, IN_I64_1D, IN_U16_1D, IN_U16_2D

NO_LABEL = 65535
"""Of a point that no label image shows."""


def paint_labels(
    points_world: Float64Array,
    views: Sequence[FusedView],
    label_images: Sequence[UInt16Array | None],
    *,
    timestamps_ns: Int64Array | None = None,
) -> UInt16Array:
    """Give each point the label at its nearest pixel in most of the images that show it.

    Args:
        points_world: (N, 3) float64 [m].
        views: the cloud in each image.
        label_images: (H, W) uint16 for each view, in the size of its image; None where there is none.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the images.

    Returns:
        (N,) uint16, `NO_LABEL` for points in no label image, and for a class of that number.

    Raises:
        ArrayError: the arrays do not fit together.
    """
    count = check_array("points_world", points_world, (None, 3), np.float64)
    if len(views) != len(label_images):
        raise ArrayError(f"{len(label_images)} label images for {len(views)} views; expected one each, or None")
    reported = [pair for pair in zip(views, label_images, strict=True) if pair[1] is not None]
    votes = np.full((len(reported), count), NO_LABEL, np.uint16)
    trust = np.zeros((len(reported), count), np.float32)
    for k, (view, image) in enumerate(reported):
        check_array("label_image", image, (view.camera.height, view.camera.width), np.uint16)
        weights = view_weights(view, timestamps_ns)
        take_labels(view.point_ids, view.pixels, weights, np.ascontiguousarray(image), votes[k], trust[k])
    labels = np.full(count, NO_LABEL, np.uint16)
    count_votes(votes, trust, NO_LABEL, labels)
    return labels


@dataclass(slots=True, eq=False)
class LabelCanvas:
    """An image into which the labels of clouds are drawn, one cloud after another.

    Attributes:
        labels: (H, W) uint16, 0 where no labelled point is.
        radius_px: of the square that a point fills beside its pixel.
    """

    labels: UInt16Array
    radius_px: int = 0
    _depths: Float32Array = field(init=False)

    def __post_init__(self) -> None:
        if not 0 <= self.radius_px <= 100:
            raise OptionError(f"radius_px {self.radius_px}; expected 0 to 100")
        self._depths = np.full(self.labels.shape, np.inf, np.float32)

    @classmethod
    def blank(cls, width: int, height: int, *, radius_px: int = 0) -> "LabelCanvas":
        """A canvas for an image of that size.

        Raises:
            OptionError: the radius is out of bounds.
        """
        return cls(np.zeros((height, width), np.uint16), radius_px)

    def draw(self, view: FusedView, labels: UInt16Array) -> None:
        """Draw the points of a view that are visible; `labels` (N,) is that of each point, `NO_LABEL` for none.

        Raises:
            ArrayError: the arrays do not fit together.
        """
        check_array("labels", labels, (len(view.points_world),), np.uint16)
        check_array("view", view.depth_image, self.labels.shape, np.float32)
        draw_labels(
            view.point_ids, view.pixels, view.depths, view.visible, labels, NO_LABEL, self.radius_px, self._depths,
            self.labels,
        )  # fmt: skip


@kernel(void(IN_I64_1D, IN_F32_2D, IN_F32_1D, IN_U16_2D, uint16[::1], float32[::1]))
def take_labels(
    point_ids: Int64Array, pixels: Float32Array, weights: Float32Array, labels: UInt16Array, votes: UInt16Array,
    trust: Float32Array,
) -> None:  # fmt: skip
    """Give each point that an image shows the label of its nearest pixel.

    `point_ids` (M,), rows of the outputs; `pixels` (M, 2) [px]; `weights` (M,), 0 for points that are not visible,
    which are passed over; `labels` (H, W); `votes`, `trust` (N,), written where the image shows the point.
    """
    height, width = labels.shape
    for i in range(point_ids.shape[0]):
        if weights[i] > 0.0:
            column = min(max(math.floor(pixels[i, 0] + 0.5), 0), width - 1)
            row = min(max(math.floor(pixels[i, 1] + 0.5), 0), height - 1)
            votes[point_ids[i]] = labels[row, column]
            trust[point_ids[i]] = weights[i]


@kernel(void(IN_U16_2D, types.Array(float32, 2, "C", readonly=True), uint16, uint16[::1]))
def count_votes(votes: UInt16Array, trust: Float32Array, none: int, labels: UInt16Array) -> None:
    """Give each point the label that most images give it; of equally many the one that is trusted more.

    `votes` (V, N), `none` where an image says nothing; `trust` (V, N); `none`: what stands for no label; `labels` (N,),
    written.
    """
    for i in range(votes.shape[1]):
        labels[i] = none
        most, surest = 0, np.float32(0.0)
        for a in range(votes.shape[0]):
            if votes[a, i] == none:
                continue
            count, sure = 0, np.float32(0.0)
            for b in range(votes.shape[0]):
                if votes[b, i] == votes[a, i]:
                    count += 1
                    sure += trust[b, i]
            if count > most or (count == most and sure > surest):
                most, surest, labels[i] = count, sure, votes[a, i]


@kernel(void(IN_I64_1D, IN_F32_2D, IN_F32_1D, IN_BOOL_1D, IN_U16_1D, uint16, int64, float32[:, ::1], uint16[:, ::1]))
def draw_labels(
    point_ids: Int64Array, pixels: Float32Array, depths: Float32Array, visible: BoolArray, labels: UInt16Array,
    none: int, radius_px: int, depth_image: Float32Array, label_image: UInt16Array,
) -> None:  # fmt: skip
    """Draw the labels of visible points into an image, each as a square; the nearest point of a pixel counts.

    Points without a label cover what is behind them, too, and leave their pixels as they are.

    `point_ids` (M,), rows of `labels`; `pixels` (M, 2) [px]; `depths` (M,) [m]; `visible` (M,); `labels` (N,), `none`
    for points without one; `none`: what stands for no label; `radius_px`: of the square beside the pixel itself;
    `depth_image` (H, W) [m], updated: depth of the nearest point drawn so far, infinite for none; `label_image` (H, W),
    updated; 0 where no labelled point is.
    """
    height, width = label_image.shape
    for i in range(point_ids.shape[0]):
        if not visible[i]:
            continue
        label = labels[point_ids[i]]
        column = min(max(math.floor(pixels[i, 0] + 0.5), 0), width - 1)
        row = min(max(math.floor(pixels[i, 1] + 0.5), 0), height - 1)
        for r in range(max(row - radius_px, 0), min(row + radius_px + 1, height)):
            for c in range(max(column - radius_px, 0), min(column + radius_px + 1, width)):
                if depths[i] < depth_image[r, c]:
                    depth_image[r, c] = depths[i]
                    label_image[r, c] = 0 if label == none else label
