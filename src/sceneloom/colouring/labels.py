"""Labels of images onto the points that they show, and of points into images, with one and the same visibility.

A label is never mixed: a point takes that of its nearest pixel, several images vote, and of equally many votes those
count more whose images show the point better. In an image, the nearest visible point of a pixel counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt16Array, check_array
from sceneloom.colouring.blending import BlendSettings, view_weights
from sceneloom.colouring.results import FusedView
from sceneloom.errors import ArrayError, OptionError
from sceneloom.kernels.colours import count_votes, draw_labels, take_labels

NO_LABEL = 65535
"""Of a point that no label image shows."""


def paint_labels(
    points_world: Float64Array,
    views: Sequence[FusedView],
    label_images: Sequence[UInt16Array | None],
    *,
    settings: BlendSettings | None = None,
    timestamps_ns: Int64Array | None = None,
) -> UInt16Array:
    """Give each point the label that most of the images which show it have at its nearest pixel.

    Args:
        points_world: (N, 3) float64 [m].
        views: the cloud in each image.
        label_images: (H, W) uint16 for each view, of the size of its image; None where there is none.
        settings: the weights that decide between equally many votes; None for the usual ones.
        timestamps_ns: (N,) int64 [ns], when each point was measured; None: with the images.

    Returns:
        (N,) uint16, `NO_LABEL` for points that no label image shows. A class of that number means the same.

    Raises:
        ArrayError: the arrays do not fit together.
    """
    count = check_array("points_world", points_world, (None, 3), np.float64)
    if len(views) != len(label_images):
        raise ArrayError(
            f"{len(label_images)} label images for {len(views)} views; expected one each, or None"
        )
    points, chosen = np.ascontiguousarray(points_world), settings or BlendSettings()
    reported = [pair for pair in zip(views, label_images, strict=True) if pair[1] is not None]
    votes = np.full((len(reported), count), NO_LABEL, np.uint16)
    trust = np.zeros((len(reported), count), np.float32)
    for k, (view, image) in enumerate(reported):
        check_array("label_image", image, (view.camera.height, view.camera.width), np.uint16)
        weights = view_weights(points, view, chosen, timestamps_ns=timestamps_ns)
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
            view.point_ids,
            view.pixels,
            view.depths,
            view.visible,
            labels,
            NO_LABEL,
            self.radius_px,
            self._depths,
            self.labels,
        )
