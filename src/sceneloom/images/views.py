"""Images of what one camera sees of a lidar frame: its points over the image, and their depths alone."""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import Float32Array, UInt8Array
from sceneloom.colouring.results import FusedView
from sceneloom.images.canvas import Canvas, PilImage, count_text, seconds_text, text_height
from sceneloom.images.depth_scale import DepthScale
from sceneloom.images.scale_bar import draw_caption, draw_depth_bar, draw_strip, strip_height
from sceneloom.images.stamping import draw_crosses, draw_discs

LEAST_WIDTH_PX = 520
"""Narrower images get a canvas of this width, so that caption and scale fit below them."""
NO_DEPTH = (10, 11, 14)
"""Colour of the pixels of a depth image that hold no depth: darker than any colour of the maps."""
HIDDEN = (176, 178, 184)

_LARGEST_RADIUS_PX = 4.0
_MOST_COVER = 0.35
"""Share of the image that the discs may cover together, so that the image can be seen between them."""
_GREYNESS = 0.45
_BRIGHTNESS = 0.62
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


def draw_overlay(view: FusedView, *, scale: DepthScale | None = None, show_hidden: bool = False) -> PilImage:
    """Draw the points over the image as discs coloured by depth, the nearer over the farther.

    Args:
        scale: the colours of the depths; by default chosen to hold the view's own depths.
        show_hidden: mark the points behind nearer surfaces with small grey crosses.

    Returns:
        The image, its pixels where they were, with a strip of caption and scale bar below it.
    """
    used = scale or view_scale(view)
    drawn = subdued(view.rgb)
    if show_hidden:
        drawn = draw_crosses(drawn, view.pixels[~view.visible], HIDDEN, arm_px=round(disc_radius(view)))
    depths = view.depths[view.visible]
    radius = disc_radius(view)
    drawn = draw_discs(drawn, view.pixels[view.visible], depths, used.colours(depths), radius)
    hidden = len(view.depths) - len(depths)
    counts = f"{count_text(len(depths), 'point')}, {hidden:,} more hidden" + (
        " (crosses)" if show_hidden else ""
    )
    return framed(image_canvas(drawn), [_title(view), counts], scale=used)


def draw_depth_image(view: FusedView, *, scale: DepthScale | None = None) -> PilImage:
    """Draw the depth image, each depth enlarged to a small disc; nearly black where there is none.

    Args:
        scale: the colours of the depths; by default chosen to hold the view's own depths.

    Returns:
        The depth image, its pixels where they were, with a strip of caption and scale bar below it.
    """
    used = scale or view_scale(view)
    rows, columns = np.nonzero(view.depth_image > 0)
    depths: Float32Array = view.depth_image[rows, columns]
    empty: UInt8Array = np.full((*view.depth_image.shape, 3), NO_DEPTH, np.uint8)
    pixels = np.column_stack([columns, rows]).astype(np.float32)
    drawn = draw_discs(empty, pixels, depths, used.colours(depths), max(1.0, disc_radius(view)))
    share = 100.0 * len(depths) / view.depth_image.size
    counts = f"{count_text(len(depths), 'pixel')} with depth, {share:.2g} %"
    return framed(image_canvas(drawn), [_title(view), counts], scale=used)


def view_scale(view: FusedView) -> DepthScale:
    """Choose the depth scale that suits the visible points of a view."""
    return DepthScale.of(view.depths[view.visible])


def disc_radius(view: FusedView) -> float:
    """Choose the radius of the discs [px], in half pixels: larger on larger images, smaller for dense points."""
    width, height = view.camera.width, view.camera.height
    by_size = min(width / 950.0, _LARGEST_RADIUS_PX)
    by_density = np.sqrt(_MOST_COVER * width * height / (np.pi * max(len(view.depths), 1)))
    return float(max(round(2 * min(max(by_size, 1.0), by_density)) / 2, 0.5))


def _title(view: FusedView) -> str:
    return f"{view.camera_id} · {seconds_text(view.timestamp_ns)}"


def subdued(rgb: UInt8Array) -> UInt8Array:
    """Take colour and brightness off an image, so that what is drawn over it stands out."""
    grey = (rgb @ _LUMA)[..., None]
    return np.asarray(_BRIGHTNESS * (_GREYNESS * grey + (1.0 - _GREYNESS) * rgb.astype(np.float32)), np.uint8)


def framed(plot: Canvas, lines: Sequence[str], *, scale: DepthScale | None = None) -> PilImage:
    """Add a strip below an image, with the caption, and with the bar of its depths where it shows any."""
    width, height = plot.image.size
    canvas = Canvas.blank(
        max(width, LEAST_WIDTH_PX), height + strip_height(plot.text_px), text_px=plot.text_px
    )
    canvas.paste(plot, 0, 0)
    draw_strip(canvas, height)
    room = canvas.image.width if scale is None else draw_depth_bar(canvas, height, scale)
    draw_caption(canvas, height, room, lines)
    return canvas.image


def image_canvas(pixels: UInt8Array) -> Canvas:
    """Begin to draw on (H, W, 3) uint8 pixels, with letters that fit the image and the strip below it."""
    height, width = pixels.shape[:2]
    return Canvas.of(pixels, text_px=text_height(max(width, LEAST_WIDTH_PX), height))
