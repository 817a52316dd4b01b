"""Images of completed depth images: image, depths, and how far they can be trusted, one above another."""

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.colouring.results import FusedView
from sceneloom.depth.results import DenseDepth
from sceneloom.images.canvas import PilImage, seconds_text
from sceneloom.images.depth_scale import DepthScale
from sceneloom.images.views import NO_DEPTH, framed, image_canvas, view_scale


def draw_dense_depth(view: FusedView, dense: DenseDepth, *, scale: DepthScale | None = None) -> PilImage:
    """Draw a completed depth image below its image, and its confidence below it: black 0, white 1.

    Args:
        view: the sweep in the image.
        dense: what was made of it.
        scale: the colours of the depths; by default chosen to hold the view's own depths.
    """
    used = scale or view_scale(view)
    known = dense.depths > 0
    depths: UInt8Array = np.full((*dense.depths.shape, 3), NO_DEPTH, np.uint8)
    depths[known] = used.colours(dense.depths[known])
    grey = np.rint(dense.confidence * 255).astype(np.uint8)
    sheet = np.concatenate([view.rgb, depths, np.repeat(grey[..., None], 3, axis=2)])
    share, sure = 100.0 * known.mean(), 100.0 * (dense.confidence >= 0.9).mean()
    lines = [
        f"{view.camera_id} · {seconds_text(view.timestamp_ns)}",
        f"{share:.1f} % with depth, {sure:.1f} % surer than 0.9",
    ]
    return framed(image_canvas(sheet), lines, scale=used)
