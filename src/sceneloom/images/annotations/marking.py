"""Drawing figures onto images and maps: lines, tinted areas, marks, and names that do not cover each other."""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.images.annotations.figures import Figure
from sceneloom.images.canvas import BACKGROUND, Canvas, Colour
from sceneloom.images.views import image_canvas, subdued
from sceneloom.scene.sample import Sample
from sceneloom.scene.types import Identifier

_TINT = 0.28
_SMALL = 0.8

Name = tuple[Figure, Float64Array]
"""A figure, and the pixel at which its name goes."""


def image(sample: Sample, camera_id: Identifier) -> Canvas:
    """Begin with a subdued image of a sample; with an empty one of its size where there is none.

    Raises:
        DataError: the image cannot be decoded.
    """
    image, camera = sample.images[camera_id], sample.cameras[camera_id]
    if image is None:
        return image_canvas(np.full((camera.height, camera.width, 3), BACKGROUND, np.uint8))
    return image_canvas(subdued(image.rgb))


def draw_figure(canvas: Canvas, seen: Figure, *, thickness: int) -> list[Name]:
    """Draw a figure whose vertices are pixels; gives the position of its name if anything of it lies on the canvas."""
    size = canvas.image.size
    parts = [*seen.lines, *seen.areas, *([] if seen.marks is None else [seen.marks])]
    if not any(((part > -1) & (part < size)).all(axis=1).any() for part in parts):
        return []
    for area in seen.areas:
        canvas.polygon(_tuples(_clamped(area, size)), seen.colour, opacity=_TINT)
    for line in seen.lines:
        canvas.line(_tuples(_clamped(line, size)), seen.colour, width=thickness)
    if seen.marks is not None:
        draw_marks(canvas, seen.marks, seen.colour, 1.2 + 1.6 * thickness)
    anchor = seen.anchor
    return [] if anchor is None or not np.isfinite(anchor).all() else [(seen, anchor)]


def draw_marks(canvas: Canvas, pixels: Float64Array, colour: Colour, radius: float) -> int:
    """Draw a disc of a radius [px] at each of (N, 2) pixels that are on the canvas; gives how many those are."""
    finite = pixels[np.isfinite(pixels).all(axis=1)]
    shown = finite[((finite >= 0) & (finite < canvas.image.size)).all(axis=1)]
    for location in _tuples(shown):
        canvas.disc(location, radius, colour)
    return len(shown)


def write_names(canvas: Canvas, names: list[Name]) -> None:
    """Write names, lower ones first; one that would cover another is left out."""
    taken: list[tuple[float, float, float]] = []
    for figure, (column, row) in sorted(names, key=lambda item: -float(item[1][1])):
        text = canvas.fitted(figure.name, 0.4 * canvas.image.width, scale=_SMALL)
        half = canvas.text_width(text, scale=_SMALL) / 2 + 3
        line = 1.1 * canvas.text_px
        location = float(np.clip(column, half, max(canvas.image.width - half, half)))
        level = float(np.clip(row - 0.7 * line, line, canvas.image.height - line))
        if all(abs(location - p) > half + h or abs(level - v) > line for p, v, h in taken):
            canvas.label((location, level), text, colour=figure.colour, scale=_SMALL)
            taken.append((location, level, half))


def _clamped(pixels: Float64Array, size: tuple[int, int]) -> Float64Array:
    """Keep coordinates within what Pillow can draw."""
    reach = 4.0 * max(size)
    return np.clip(pixels, -reach, reach)


def _tuples(pixels: Float64Array) -> list[tuple[float, float]]:
    return [(float(column), float(row)) for column, row in pixels]
