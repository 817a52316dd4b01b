"""A drawing surface: pixels from NumPy, text and lines from Pillow, and many small discs drawn at once.

The nearer over the farther.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, UInt8Array
from sceneloom.warnings import DataWarning, skipped

PilImage = Image.Image
Colour = tuple[int, int, int]
_Box = tuple[float, float, float, float]
BACKGROUND: Colour = (17, 19, 23)
STRIP: Colour = (27, 30, 36)
INK: Colour = (232, 234, 237)
FAINT_INK: Colour = (158, 164, 173)
LINE: Colour = (92, 98, 108)
ACCENT: Colour = (255, 122, 69)
_FINE = 4  # polygons are filled on a grid this much finer and averaged


@dataclass(slots=True)
class LeftOut:
    """How much of which kind has no location in images, as its coordinates are not finite; counted in each image."""

    counts: Counter[str] = field(default_factory=Counter)

    @property
    def lines(self) -> tuple[str, ...]:
        """A line for each kind."""
        return tuple(f"{count:,} {kind} {_NOT_FINITE}" for kind, count in self.counts.items())

    @property
    def warnings(self) -> tuple[DataWarning, ...]:
        """A warning for each kind."""
        return tuple(skipped("not-drawn", "images", f"{k} {_NOT_FINITE}", count=n) for k, n in self.counts.items())


_NOT_FINITE = "whose coordinates are not finite are not drawn, counted in each image"


_LEFT_OUT: ContextVar[LeftOut | None] = ContextVar("left out of images", default=None)


@contextmanager
def counting_left_out() -> Iterator[LeftOut]:
    """Count what images that are drawn inside leave out."""
    found = LeftOut()
    token = _LEFT_OUT.set(found)
    try:
        yield found
    finally:
        _LEFT_OUT.reset(token)


def leave_out(kind: str, count: int) -> None:
    """Note that an image has no field for so many of a kind, where somebody counts them."""
    found = _LEFT_OUT.get()
    if found is not None and count:
        found.counts[kind] += int(count)


@dataclass(slots=True)
class Canvas:
    """An image being drawn; everything is placed in pixels from its top-left corner.

    Attributes:
        text_px: height of the letters [px].
    """

    image: PilImage
    text_px: int

    @classmethod
    def of(cls, pixels: UInt8Array, *, text_px: int) -> "Canvas":
        """Start with (H, W, 3) uint8 pixels."""
        return cls(Image.fromarray(pixels), text_px)

    @classmethod
    def blank(cls, width: int, height: int, *, text_px: int, colour: Colour = BACKGROUND) -> "Canvas":
        """Start with one colour everywhere."""
        return cls(Image.new("RGB", (width, height), colour), text_px)

    def paste(self, pixels: "UInt8Array | Canvas", left: int, top: int) -> None:
        """Put (H, W, 3) uint8 pixels, or what another canvas holds, at a location."""
        self.image.paste(pixels.image if isinstance(pixels, Canvas) else Image.fromarray(pixels), (left, top))

    def rectangle(self, box: _Box, *, fill: Colour | None = None, outline: Colour | None = None) -> None:
        """Draw a rectangle from its first to its last pixel (left, top, right, bottom)."""
        ImageDraw.Draw(self.image).rectangle(box, fill=fill, outline=outline)

    def line(self, points: Sequence[tuple[float, float]], colour: Colour, *, width: int = 1) -> None:
        """Draw a line through two or more points."""
        ImageDraw.Draw(self.image).line(points, fill=colour, width=width, joint="curve")

    def polygon(self, corners: Sequence[tuple[float, float]], colour: Colour, *, opacity: float = 1.0) -> None:
        """Fill a polygon, with smooth edges; below an opacity of 1 what is there shines through."""
        columns, rows = zip(*corners, strict=True)
        left, top = max(int(min(columns)), 0) - 1, max(int(min(rows)), 0) - 1
        width = min(int(max(columns)), self.image.width) + 2 - left
        height = min(int(max(rows)), self.image.height) + 2 - top
        if width <= 0 or height <= 0:
            return
        mask = Image.new("L", (width * _FINE, height * _FINE))
        # The centre of pixel p is p, and its left edge p - 0.5.
        fine = [((u - left + 0.5) * _FINE - 0.5, (v - top + 0.5) * _FINE - 0.5) for u, v in corners]
        ImageDraw.Draw(mask).polygon(fine, fill=round(255 * opacity))
        self.image.paste(colour, (left, top), mask.resize((width, height), Image.Resampling.BOX))

    def arrow(self, tail: tuple[float, float], tip: tuple[float, float], colour: Colour, *, width: float) -> None:
        """Draw an arrow of a given shaft width [px]."""
        along = np.subtract(tip, tail)
        along = along / max(float(np.hypot(*along)), 1e-9)
        across = np.array([-along[1], along[0]]) * width
        neck = np.asarray(tip) - along * 3.4 * width
        corners = [
            tail + across / 2, neck + across / 2, neck + 1.6 * across, tip,
            neck - 1.6 * across, neck - across / 2, tail - across / 2,
        ]  # fmt: skip
        self.polygon([(float(u), float(v)) for u, v in corners], colour)

    def text(
        self, location: tuple[float, float], text: str, *, anchor: str = "la", colour: Colour = INK, scale: float = 1.0
    ) -> None:
        """Write one line; `anchor` is Pillow's two letters: l m r across, a m s d down."""
        ImageDraw.Draw(self.image).text(location, text, fill=colour, font=self._font(scale), anchor=anchor)

    def disc(self, center: tuple[float, float], radius: float, colour: Colour) -> None:
        """Fill a disc of a radius [px]."""
        column, row = center
        box = (column - radius, row - radius, column + radius, row + radius)
        ImageDraw.Draw(self.image).ellipse(box, fill=colour)

    def marks(self, pixels: Float64Array, colour: Colour, radius: float) -> int:
        """Draw a disc of a radius [px] at each of (N, 2) pixels that are on the canvas; gives how many those are."""
        shown = pixels[((pixels >= 0) & (pixels < self.image.size)).all(axis=1)].tolist()
        for column, row in shown:
            self.disc((column, row), radius, colour)
        return len(shown)

    def label(self, location: tuple[float, float], text: str, *, colour: Colour = INK, scale: float = 1.0) -> None:
        """Write one line around a location, on a dark plate that sets it off from an image."""
        half, line = self.text_width(text, scale=scale) / 2 + 3, 0.62 * self.text_px * scale + 2
        column, row = location
        corners = [
            (column - half, row - line), (column + half, row - line),
            (column + half, row + line), (column - half, row + line),
        ]  # fmt: skip
        self.polygon(corners, BACKGROUND, opacity=0.7)
        self.text(location, text, anchor="mm", colour=colour, scale=scale)

    def text_width(self, text: str, *, scale: float = 1.0) -> float:
        """Width of a line of text [px]."""
        return float(self._font(scale).getlength(text))

    def fitted(self, text: str, width: float, *, scale: float = 1.0) -> str:
        """Give the text on one line, its end cut off and marked where it is wider than `width` [px]."""
        line = " ".join(text.split())
        if self.text_width(line, scale=scale) <= width:
            return line
        kept = len(line)
        while kept and self.text_width(line[:kept].rstrip() + "...", scale=scale) > width:
            kept -= 1
        return line[:kept].rstrip() + "..." if kept else ""

    def _font(self, scale: float) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
        return ImageFont.load_default(size=max(11.0, self.text_px * scale))


def text_height(width: int, height: int) -> int:
    """Choose a height of letters [px] that reads well on a image of that size."""
    return int(np.clip(round(0.6 * width / 60 + 0.4 * height / 34), 12, 30))


def seconds_text(timestamp_ns: int) -> str:
    """Write a time as seconds with milliseconds, rounded down, exact at any size."""
    whole, part = divmod(timestamp_ns // 1_000_000, 1000)
    if whole < 0 and part:
        whole, part = whole + 1, 1000 - part
        return f"{'-' if whole == 0 else ''}{whole}.{part:03d} s"
    return f"{whole}.{part:03d} s"


def several(count: int, noun: str) -> str:
    """Write a count with its noun, thousands set apart: "1 point", "12,345 points"."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


_STAMPING_FINE = 2  # each pixel is sampled at 2 x 2 locations, so that the edges of discs look smooth


def draw_discs(
    image: UInt8Array, pixels: FloatArray, depths: FloatArray, colours: UInt8Array, radii_px: FloatArray | float
) -> UInt8Array:
    """Draw one disc per point over an image.

    Args:
        image: (H, W, 3) uint8, left as it is.
        pixels: (N, 2) float [px], centres of the discs; parts outside the image are cut off.
        depths: (N,) float, what decides which disc covers which: the smaller is drawn over the larger.
        colours: (N, 3) uint8.
        radii_px: (N,) or one float [px].

    Returns:
        (H, W, 3) uint8, a new image.
    """
    height, width = image.shape[:2]
    owners = _owners(height * _STAMPING_FINE, width * _STAMPING_FINE, *_fine_discs(pixels, depths, radii_px))
    return _blend(image, owners, colours[np.argsort(-depths, kind="stable")])


def draw_crosses(image: UInt8Array, pixels: FloatArray, colour: tuple[int, int, int], *, arm_px: int = 2) -> UInt8Array:
    """Draw a small diagonal cross of one colour at each of (N, 2) pixels; gives a new image."""
    height, width = image.shape[:2]
    marked = image.copy()
    columns, rows = np.rint(pixels).astype(np.int64).T
    for step in range(-arm_px, arm_px + 1):
        for row_step in {step, -step}:
            inside = _inside(columns + step, rows + row_step, width, height)
            marked[rows[inside] + row_step, columns[inside] + step] = colour
    return marked


def _fine_discs(
    pixels: FloatArray, depths: FloatArray, radii_px: FloatArray | float
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Give columns, rows and radii on the fine grid, the farthest disc first."""
    # columns and rows count the corners between fine cells: a disc then lies evenly around the centre of a pixel
    order = np.argsort(-depths, kind="stable")
    radii = np.broadcast_to(np.asarray(radii_px, np.float64), (len(order),))[order]
    # A disc of about one pixel, were it spread over two, would take half of each pixel's colour from below.
    centers = np.where(radii[:, None] < 1.0, np.rint(pixels[order]), pixels[order])
    fine = np.rint((centers + 0.5) * _STAMPING_FINE).astype(np.int64)
    return fine[:, 0], fine[:, 1], np.maximum(np.rint(radii * _STAMPING_FINE), 1).astype(np.int64)


def _owners(height: int, width: int, columns: Int64Array, rows: Int64Array, radii: Int64Array) -> NDArray[np.int32]:
    """Give for each cell the 1-based number of the last disc that covers it, 0 for none, (height, width)."""
    owners = np.zeros(height * width, np.int32)
    numbers = np.arange(1, len(columns) + 1, dtype=np.int32)
    for radius in np.unique(radii):
        chosen = radii == radius
        u, v, n = columns[chosen], rows[chosen], numbers[chosen]
        for du, dv in _disc(int(radius)):
            inside = _inside(u + du, v + dv, width, height)
            np.maximum.at(owners, (v[inside] + dv) * width + u[inside] + du, n[inside])
    return owners.reshape(height, width)


def _disc(radius: int) -> Iterator[tuple[int, int]]:
    """Give the steps from a corner to all cells whose centres lie in a disc around it."""
    reach = range(-radius, radius)
    return ((du, dv) for dv in reach for du in reach if (du + 0.5) ** 2 + (dv + 0.5) ** 2 <= radius**2)


def _inside(columns: Int64Array, rows: Int64Array, width: int, height: int) -> BoolArray:
    return np.asarray((columns >= 0) & (columns < width) & (rows >= 0) & (rows < height))


def _blend(image: UInt8Array, owners: NDArray[np.int32], colours: UInt8Array) -> UInt8Array:
    """Mix each pixel of the colours of its fine cells; cells without a disc show the image."""
    cells = [
        owners[down::_STAMPING_FINE, right::_STAMPING_FINE]
        for down in range(_STAMPING_FINE)
        for right in range(_STAMPING_FINE)
    ]
    rows, columns = np.nonzero(reduce(np.bitwise_or, cells))
    below = image[rows, columns]
    total: Float32Array = np.zeros((len(rows), 3), np.float32)
    for cell in cells:
        owner = cell[rows, columns]
        total += np.where((owner > 0)[:, None], colours[owner - 1], below)
    blended = image.copy()
    blended[rows, columns] = np.rint(total / len(cells))
    return blended
