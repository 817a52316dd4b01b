"""Colours of a cloud out of all images that show it."""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.colouring.results import FusedView
from sceneloom.errors import OptionError
from sceneloom.kernels.point_colours import paint_points
from sceneloom.kernels.thread_pool import ThreadPool

NO_CAMERA = 255
"""In `camera_index`: no image shows the point; its colour is then 255, 255, 255."""


def colour_points(
    count: int, views: Sequence[FusedView], camera_indices: Sequence[int], *, threads: int = 1
) -> tuple[UInt8Array, UInt8Array]:
    """Give each point the colour of its nearest pixel.

    Among the images in which a point is visible, the one counts in which it is nearest to the image's centre,
    in units of half the image's diagonal: camera models are sharpest and best calibrated there. Of equally near ones
    the first.

    Args:
        count: number of points of the cloud.
        views: the cloud in each image.
        camera_indices: what to write into `camera_index`, one for each view, 0 to 254.
        threads: how many share the points.

    Returns:
        colors: (count, 3) uint8, red green blue; 255, 255, 255 where no image shows the point.
        camera_index: (count,) uint8; 255 where no image shows the point.

    Raises:
        OptionError: the indices are not as many as the views, or out of range.
    """
    if len(views) != len(camera_indices):
        raise OptionError(f"{len(camera_indices)} camera indices for {len(views)} views; expected one each")
    colors, camera_index = _blank(count, ThreadPool.of(threads, count))
    eccentricities = np.full(count if len(views) > 1 else 0, np.inf)
    for view, index in zip(views, camera_indices, strict=True):
        if not 0 <= index < NO_CAMERA:
            raise OptionError(f"camera {view.camera_id!r}: index {index}; expected 0 to {NO_CAMERA - 1}")
        rgb = np.ascontiguousarray(view.rgb)
        _paint(
            view,
            rgb,
            index,
            eccentricities,
            colors,
            camera_index,
            ThreadPool.of(threads, len(view.point_ids)),
        )
    return colors, camera_index


def _blank(count: int, thread_pool: ThreadPool) -> tuple[UInt8Array, UInt8Array]:
    """Give colours and cameras of points that no image shows."""
    colors, camera_index = np.empty((count, 3), np.uint8), np.empty(count, np.uint8)

    def fill(_: int, a: int, b: int) -> None:
        colors[a:b].fill(255)
        camera_index[a:b].fill(NO_CAMERA)

    thread_pool.share(count, fill)
    return colors, camera_index


def _paint(
    view: FusedView,
    rgb: UInt8Array,
    index: int,
    eccentricities: Float64Array,
    colors: UInt8Array,
    camera_index: UInt8Array,
    thread_pool: ThreadPool,
) -> None:
    """Paint the points of one image, which are all different: threads write to different rows."""

    def paint(_: int, a: int, b: int) -> None:
        ids, pixels, numbers = view.point_ids[a:b], view.pixels[a:b], view.pixel_numbers[a:b]
        visible = view.visible[a:b]
        paint_points(ids, pixels, numbers, visible, rgb, index, eccentricities, colors, camera_index)

    thread_pool.share(len(view.point_ids), paint)
