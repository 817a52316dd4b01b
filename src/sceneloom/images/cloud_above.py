"""A cloud from above: a map in metres with its grid, the ego trajectory and its location."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, UInt8Array
from sceneloom.images.canvas import ACCENT, BACKGROUND, FAINT_INK, INK, LINE, Canvas, PilImage, text_height
from sceneloom.images.clouds import check_size, choose_reach, cloud_caption, drawn_cloud, sample_polyline
from sceneloom.images.depth_scale import COARSE_DIGITS, round_down, round_up
from sceneloom.images.ego import EgoPosition, middle_of
from sceneloom.images.scale_bar import draw_caption, draw_length_bar, draw_strip, strip_height
from sceneloom.images.stamping import draw_discs

SIZE_PX = (1280, 900)
_GROUND = (31, 34, 41)
_GRID = (52, 57, 66)
_PATH = (255, 190, 92)
_SMALL = 0.86
_SPACING_LETTERS = 6.0
_BAR_LETTERS = 14.0
_FAR_PX = 100_000.0
_REACH_PERCENT, _FARTHEST_REACH = 94.0, 50.0


_MOST_LINES = 1000
"""More than this no grid has: its locations are so far off that there are no numbers for its lines."""


@dataclass(frozen=True, slots=True)
class MapLayout:
    """Where the world lies on the map: x of the world to the right, y up.

    Attributes:
        left, top, width, height: the map's rectangle in the image [px].
        center_world: x and y in the map's middle [m].
        px_per_m: scale.
    """

    left: int
    top: int
    width: int
    height: int
    center_world: tuple[float, float]
    px_per_m: float

    def pixels(self, points_world: FloatArray) -> Float64Array:
        """Give (N, 2) pixels [px], counted from the rectangle's corner, of (N, 2 or 3) world points [m]."""
        right = (points_world[:, 0] - self.center_world[0]) * self.px_per_m + (self.width - 1) / 2
        down = (self.center_world[1] - points_world[:, 1]) * self.px_per_m + (self.height - 1) / 2
        return np.column_stack([right, down])

    def grid(self, axis: int, spacing: float) -> list[tuple[float, int]]:
        """Give the grid lines across an axis of the world: (coordinate [m], column or row in the rectangle [px])."""
        half = ((self.width, self.height)[axis] - 1) / 2 / self.px_per_m
        middle = self.center_world[axis]
        first, last = np.ceil((middle - half) / spacing), np.floor((middle + half) / spacing)
        numbers = np.arange(first, last + 1) if last - first < _MOST_LINES else np.zeros(0)
        locations = np.repeat(np.array([self.center_world]), len(numbers), axis=0)
        locations[:, axis] = numbers * spacing
        pixels = self.pixels(locations)[:, axis]
        return [
            (float(at) + 0.0, round(float(pixel)))
            for at, pixel in zip(numbers * spacing, pixels, strict=True)
        ]


def layout_map(center_world: tuple[float, float], reach: float, size_px: tuple[int, int]) -> MapLayout:
    """Choose the map's rectangle in an image.

    Args:
        center_world: x and y in the map's middle [m].
        reach: from the middle to the upper edge [m].
        size_px: width and height of the image.
    """
    left, top, width, height = _rectangle(size_px, text_height(*size_px))
    return MapLayout(left, top, width, height, center_world, height / 2 / reach)


def draw_cloud_above(
    points_world: FloatArray,
    colors: UInt8Array | None,
    *,
    camera_index: UInt8Array | None = None,
    ego: EgoPosition | None = None,
    ego_path: FloatArray | None = None,
    caption: Sequence[str] = ("cloud from above",),
    reach: float | None = None,
    size_px: tuple[int, int] = SIZE_PX,
    over: Callable[[Canvas, MapLayout], None] | None = None,
) -> PilImage:
    """Draw a cloud as a map: x of the world to the right, y up, the higher point over the lower.

    Args:
        points_world: (N, 3) float [m]; rows that are not finite are left out.
        colors: (N, 3) uint8, or None; points without a colour are grey, the lighter the higher.
        camera_index: (N,) uint8, 255 for a point that no camera saw.
        ego: the map's middle, marked by an arrow; by default the middle of the points, without a mark.
        ego_path: (K, 3) float [m], the ego trajectory through the world.
        caption: one or two lines; to one alone what the cloud holds is added.
        reach: from the map's middle to its upper edge [m]; by default it holds most of the points.
        size_px: width and height of the image, at least 320x240.
        over: draws more onto the map.

    Raises:
        ArrayError: the arrays do not fit together.
        OptionError: the reach or the size cannot be drawn.
    """
    cloud = drawn_cloud(points_world, colors, camera_index)
    location = ego or middle_of(cloud.points_world)
    check_size(size_px)
    text_px = text_height(*size_px)
    _, _, width, height = _rectangle(size_px, text_px)
    chosen = choose_reach(
        reach,
        cloud.points_world,
        location,
        percent=_REACH_PERCENT,
        farthest=_FARTHEST_REACH,
        aspect=width / height,
    )
    layout = layout_map(
        (float(location.position_world[0]), float(location.position_world[1])), chosen, size_px
    )
    spacing = round_up(_SPACING_LETTERS * text_px / layout.px_per_m, COARSE_DIGITS)
    drawn = _timestamped(
        _grid_image(layout, spacing), layout, cloud.points_world, cloud.colours, _radius(layout)
    )
    if ego_path is not None:
        drawn = _with_path(drawn, layout, ego_path, text_px)
    plot = Canvas.of(drawn, text_px=text_px)
    if over is not None:
        over(plot, layout)
    if ego is not None:
        _draw_ego(plot, layout, location)
    _draw_compass(plot)
    return _framed(plot, layout, spacing, size_px, cloud_caption(caption, cloud))


def _rectangle(size_px: tuple[int, int], text_px: int) -> tuple[int, int, int, int]:
    """Leave room for the labels and the strip: left, top, width, height of the map [px]."""
    left, top = round(3.4 * text_px), round(0.8 * text_px)
    return left, top, size_px[0] - left - top, size_px[1] - top - round(1.9 * text_px) - strip_height(text_px)


def _radius(layout: MapLayout) -> float:
    """Choose the discs' radius [px]: about 6 cm, within what can be seen and what does not smear."""
    return float(np.clip(0.06 * layout.px_per_m, 1.0, 2.0))


def _grid_image(layout: MapLayout, spacing: float) -> UInt8Array:
    image: UInt8Array = np.full((layout.height, layout.width, 3), _GROUND, np.uint8)
    for _, column in layout.grid(0, spacing):
        image[:, column] = _GRID
    for _, row in layout.grid(1, spacing):
        image[row] = _GRID
    return image


def _timestamped(
    image: UInt8Array, layout: MapLayout, points_world: Float64Array, colours: UInt8Array, radius: float
) -> UInt8Array:
    """Timestamp points into the map, the higher over the lower; those far outside are passed over."""
    pixels = layout.pixels(points_world)
    near = (np.abs(pixels) < _FAR_PX).all(axis=1)
    return draw_discs(image, pixels[near], -points_world[near, 2], colours[near], radius)


def _with_path(image: UInt8Array, layout: MapLayout, ego_path: FloatArray, text_px: int) -> UInt8Array:
    line = sample_polyline(ego_path, 0.5 / layout.px_per_m)
    colours: UInt8Array = np.full((len(line), 3), _PATH, np.uint8)
    return _timestamped(image, layout, line, colours, max(1.0, text_px / 13))


def _draw_ego(plot: Canvas, layout: MapLayout, location: EgoPosition) -> None:
    """Mark the ego with an arrowhead, the same size in the image at every scale, on a dark rim."""
    for letters, colour in ((2.1, BACKGROUND), (1.6, ACCENT)):
        corners = layout.pixels(location.arrow(letters * plot.text_px / layout.px_per_m))
        plot.polygon([(float(u), float(v)) for u, v in corners], colour)


def _draw_compass(plot: Canvas) -> None:
    """Show the directions of the world's x and y in the upper right corner."""
    size = plot.text_px
    right = plot.image.width - 1
    plot.rectangle((right - 5.2 * size, 0.6 * size, right - 0.6 * size, 5.2 * size), fill=BACKGROUND)
    corner = (right - 4.3 * size, 4.3 * size)
    for step, name, anchor in (((2.4, 0.0), "x", "lm"), ((0.0, -2.4), "y", "ms")):
        tip = (corner[0] + step[0] * size, corner[1] + step[1] * size)
        plot.arrow(corner, tip, INK, width=size / 8)
        plot.text(
            (tip[0] + 0.1 * step[0] * size, tip[1] + 0.1 * step[1] * size), name, anchor=anchor, scale=_SMALL
        )


def _framed(
    plot: Canvas, layout: MapLayout, spacing: float, size_px: tuple[int, int], caption: Sequence[str]
) -> PilImage:
    """Put the map into the image, with the labels of its grid, the caption and the scale bar."""
    canvas = Canvas.blank(*size_px, text_px=plot.text_px)
    canvas.paste(plot, layout.left, layout.top)
    bottom = layout.top + layout.height
    canvas.rectangle((layout.left - 1, layout.top - 1, layout.left + layout.width, bottom), outline=LINE)
    _label_grid(canvas, layout, spacing)
    top = size_px[1] - strip_height(plot.text_px)
    draw_strip(canvas, top)
    length = round_down(_BAR_LETTERS * plot.text_px / layout.px_per_m, COARSE_DIGITS)
    draw_caption(canvas, top, draw_length_bar(canvas, top, length, layout.px_per_m), caption)
    return canvas.image


def _label_grid(canvas: Canvas, layout: MapLayout, spacing: float) -> None:
    """Write the coordinates [m] of the grid lines below and left of the map."""
    size = canvas.text_px
    for at, column in layout.grid(0, spacing):
        label = f"{at:g}"
        half = canvas.text_width(label, scale=_SMALL) / 2
        middle = layout.left + column
        if half < middle < canvas.image.width - half:
            location = (middle, layout.top + layout.height + 0.9 * size)
            canvas.text(location, label, anchor="mm", colour=FAINT_INK, scale=_SMALL)
    for at, row in layout.grid(1, spacing):
        beside = (layout.left - 0.5 * size, layout.top + row)
        canvas.text(beside, f"{at:g}", anchor="rm", colour=FAINT_INK, scale=_SMALL)
