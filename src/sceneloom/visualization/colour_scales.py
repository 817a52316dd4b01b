"""From values to colours: colour maps interpolated in OKLab, a logarithmic depth scale.

And the strip under an image, with its caption and scale bar.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, UInt8Array, read_only
from sceneloom.errors import OptionError
from sceneloom.visualization.canvas import FAINT_INK, STRIP, Canvas, PilImage, text_height

_LMS_FROM_LINEAR_RGB = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_OKLAB_FROM_ROOT_LMS = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
_STEPS = 256
_FINE_STEPS = 4096

ANCHORS: Mapping[str, tuple[tuple[float, float, float], ...]] = MappingProxyType(
    {
        "beacon": (
            (0.96, 0.095, 106.0),
            (0.85, 0.140, 80.0),
            (0.75, 0.160, 50.0),
            (0.66, 0.205, 10.0),
            (0.61, 0.205, -42.0),
            (0.58, 0.165, -78.0),
            (0.55, 0.120, -112.0),
            (0.52, 0.085, -160.0),
        ),
        "lagoon": (
            (0.95, 0.130, 106.0),
            (0.85, 0.165, 135.0),
            (0.75, 0.120, 180.0),
            (0.65, 0.118, 230.0),
            (0.54, 0.168, 262.0),
            (0.43, 0.200, 285.0),
        ),
    }
)
"""Anchors of each map from value 0 (near) to 1 (far): lightness, chroma, hue [deg] of OKLab in polar form.

"beacon" runs through the warm hues to violet and teal: no street is pink, so its points stand out from images.
"lagoon" runs from yellow through green to blue, for those who report red from green badly.
"""


@dataclass(frozen=True, slots=True, eq=False)
class ColourMap:
    """Colours for the numbers from 0 to 1.

    Attributes:
        name: one of `ANCHORS`.
        table: (256, 3) uint8 red green blue, in equal steps of perceived difference.
    """

    name: str
    table: UInt8Array

    def colours(self, fractions: FloatArray) -> UInt8Array:
        """Give (..., 3) uint8 colours of (...) fractions; those outside [0, 1] take the colour of the nearer end."""
        steps = np.clip(np.rint(np.asarray(fractions) * (_STEPS - 1)), 0, _STEPS - 1)
        return np.asarray(self.table[steps.astype(np.intp)], np.uint8)


@cache
def colour_map(name: str) -> ColourMap:
    """Compute the map of that name.

    Raises:
        OptionError: there is none of that name.
    """
    if name not in ANCHORS:
        raise OptionError(f"colour map {name!r}; there are {', '.join(ANCHORS)}")
    polar = _smooth_curve(np.array(ANCHORS[name]))
    lightness, chroma, hue = polar[:, 0], polar[:, 1], np.deg2rad(polar[:, 2])
    curve = np.column_stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)])
    return ColourMap(name, read_only(srgb_from_oklab(_equal_steps(curve))))


def oklab_from_srgb(rgb: UInt8Array) -> Float64Array:
    """Convert (..., 3) uint8 sRGB colours to OKLab: lightness 0 to 1, green-red, blue-yellow."""
    coded = np.asarray(rgb, np.float64) / 255.0
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.cbrt(linear @ _LMS_FROM_LINEAR_RGB.T) @ _OKLAB_FROM_ROOT_LMS.T)


def srgb_from_oklab(oklab: Float64Array) -> UInt8Array:
    """Convert (..., 3) OKLab colours to uint8 sRGB; what no screen can show is clipped per channel."""
    lms = (oklab @ np.linalg.inv(_OKLAB_FROM_ROOT_LMS).T) ** 3
    linear = np.clip(lms @ np.linalg.inv(_LMS_FROM_LINEAR_RGB).T, 0.0, 1.0)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(coded * 255.0), np.uint8)


def _smooth_curve(anchors: Float64Array) -> Float64Array:
    """Draw a smooth curve through (A, 3) anchors, (F, 3); each coordinate stays monotone between its anchors."""
    # Source: Fritsch and Carlson, "Monotone piecewise cubic interpolation", 1980: cubic Hermite, tangents limited to
    # three times the smaller neighbouring slope
    slopes = np.diff(anchors, axis=0)
    limits = 3.0 * np.minimum(np.abs(slopes[:-1]), np.abs(slopes[1:]))
    same_sense = np.sign(slopes[:-1]) == np.sign(slopes[1:])
    inner = np.where(same_sense, np.clip((slopes[:-1] + slopes[1:]) / 2.0, -limits, limits), 0.0)
    tangents = np.concatenate([slopes[:1], inner, slopes[-1:]])
    at = np.linspace(0.0, len(anchors) - 1, _FINE_STEPS)
    piece = np.minimum(at.astype(np.intp), len(anchors) - 2)
    t = (at - piece)[:, None]
    start, stop = anchors[piece], anchors[piece + 1]
    bend = t * (1 - t)
    return np.asarray(
        start + (stop - start) * t * t * (3 - 2 * t) + bend * ((1 - t) * tangents[piece] - t * tangents[piece + 1])
    )


def _equal_steps(curve: Float64Array) -> Float64Array:
    """Choose points along a curve at equal distances, (256, 3)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    wanted = np.linspace(0.0, lengths[-1], _STEPS)
    return np.column_stack([np.interp(wanted, lengths, column) for column in curve.T])


ROUND_DIGITS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
COARSE_DIGITS = (1.0, 2.0, 5.0)
_TICK_RANKS = ((1.0,), (2.0, 5.0), (3.0,), (1.5, 4.0, 6.0, 8.0))
_ENDS_PERCENT = (0.5, 99.5)


@dataclass(frozen=True, slots=True)
class DepthScale:
    """Colours depths on a logarithmic scale, so that one metre counts more near than far.

    Attributes:
        near, far: depths [m] of the two ends of the colour map; depths beyond take the colour of the nearer end.

    Raises:
        OptionError: not 0 < near < far < infinity.
    """

    near: float
    far: float
    map: ColourMap = field(default_factory=lambda: colour_map("beacon"))

    def __post_init__(self) -> None:
        if not 0.0 < self.near < self.far < float("inf"):
            raise OptionError(f"depth scale from {self.near} to {self.far} m; expected 0 < near < far")

    @classmethod
    def of(cls, depths: FloatArray) -> "DepthScale":
        """Choose round ends that hold nearly all of the given depths [m]; those that are not positive do not count."""
        known = depths[np.isfinite(depths) & (depths > 0)]
        if len(known) == 0:
            return cls(2.0, 80.0)
        lowest, highest = np.percentile(known, _ENDS_PERCENT)
        near, far = round_down(float(lowest)), round_up(float(highest))
        return cls(near, far if far > near else round_up(near * 1.01))

    def fractions(self, depths: FloatArray) -> Float64Array:
        """Give where depths [m] lie between the ends, 0 for `near`, 1 for `far`; unlimited."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(np.asarray(depths, np.float64) / self.near) / np.log(self.far / self.near))

    def colours(self, depths: FloatArray) -> UInt8Array:
        """Give (..., 3) uint8 colours of (...) depths [m]."""
        return self.map.colours(self.fractions(depths))

    def ticks(self) -> list[float]:
        """Give depths [m] worth a label, the most welcome first: the ends, decades, 2 and 5, then the rest."""
        decades = 10.0 ** np.arange(np.floor(np.log10(self.near)), np.ceil(np.log10(self.far)) + 1)
        inner = [
            round(float(digit * decade), 9)
            for digits in _TICK_RANKS
            for decade in decades
            for digit in digits
            if self.near * 1.001 < digit * decade < self.far * 0.999
        ]
        return [self.near, self.far, *inner]


def round_down(value: float, digits: tuple[float, ...] = ROUND_DIGITS) -> float:
    """Give the largest product of one of the digits and a power of ten that is not above a positive value."""
    decade = 10.0 ** np.floor(np.log10(value))
    below = [digit for digit in digits if digit * decade <= value * (1 + 1e-9)]
    return round(float((below or digits)[-1] * decade), 9)


def round_up(value: float, digits: tuple[float, ...] = ROUND_DIGITS) -> float:
    """Give the smallest product of one of the digits and a power of ten that is not below a positive value."""
    decade = 10.0 ** np.floor(np.log10(value))
    above = [digit for digit in digits if digit * decade >= value * (1 - 1e-9)]
    return round(float((*above, 10.0)[0] * decade), 9)


_LEAST_WIDTH_PX = 520  # narrower images get a canvas of this width, so that caption and scale fit below them
_STRIP_LINES = 3.6  # height of the strip in heights of its letters
_SMALL = 0.86
_BAR_SHARE = 0.46
_BAR_MOST_LETTERS = 40


def framed(plot: Canvas, lines: Sequence[str], *, scale: DepthScale | None = None) -> PilImage:
    """Add a strip below an image, with the caption, and with the bar of its depths where it shows any."""
    width, height = plot.image.size
    canvas = Canvas.blank(max(width, _LEAST_WIDTH_PX), height + strip_height(plot.text_px), text_px=plot.text_px)
    canvas.paste(plot, 0, 0)
    draw_strip(canvas, height)
    room = canvas.image.width if scale is None else _draw_depth_bar(canvas, height, scale)
    draw_caption(canvas, height, room, lines)
    return canvas.image


def image_canvas(pixels: UInt8Array) -> Canvas:
    """Begin to draw on (H, W, 3) uint8 pixels, with letters that fit the image and the strip below it."""
    height, width = pixels.shape[:2]
    return Canvas.of(pixels, text_px=text_height(max(width, _LEAST_WIDTH_PX), height))


def strip_height(text_px: int) -> int:
    """Height of the strip [px]."""
    return round(_STRIP_LINES * text_px)


def draw_strip(canvas: Canvas, top: int) -> None:
    """Fill the strip from row `top` to the end of the canvas."""
    canvas.rectangle((0, top, canvas.image.width - 1, canvas.image.height - 1), fill=STRIP)


def draw_caption(canvas: Canvas, top: int, width: float, lines: Sequence[str]) -> None:
    """Write up to two lines at the left of the strip, cut to `width` [px]."""
    size = canvas.text_px
    title, *details = lines
    canvas.text((size, top + 1.3 * size), canvas.fitted(title, width - 2 * size), anchor="lm")
    for detail in details[:1]:
        text = canvas.fitted(detail, width - 2 * size, scale=_SMALL)
        canvas.text((size, top + 2.5 * size), text, anchor="lm", colour=FAINT_INK, scale=_SMALL)


def _bar_span(canvas: Canvas) -> tuple[int, int]:
    """Columns [px] of the first and last colour of the scale bar."""
    size = canvas.text_px
    length = min(round(_BAR_SHARE * canvas.image.width), _BAR_MOST_LETTERS * size)
    last = canvas.image.width - 1 - 2 * size
    return last - length, last


def _draw_depth_bar(canvas: Canvas, top: int, scale: DepthScale) -> float:
    """Draw the colour map with its depths at the right of the strip; gives the width left for the caption [px]."""
    size = canvas.text_px
    first, last = _bar_span(canvas)
    head, foot = top + round(0.7 * size), top + round(1.75 * size)
    colours = scale.map.colours(np.linspace(0.0, 1.0, last - first + 1))
    canvas.paste(np.repeat(colours[None], foot - head, axis=0), first, head)
    for depth, label, location in placed_ticks(canvas, scale, first, last):
        column = first + round(float(scale.fractions(np.array(depth))) * (last - first))
        canvas.line([(column, foot), (column, foot + round(0.3 * size))], FAINT_INK)
        canvas.text((location, top + 2.7 * size), label, anchor="mm", scale=_SMALL)
    title = "depth"
    canvas.text((first - 0.7 * size, (head + foot) / 2), title, anchor="rm", colour=FAINT_INK, scale=_SMALL)
    return first - 1.4 * size - canvas.text_width(title, scale=_SMALL)


def placed_ticks(canvas: Canvas, scale: DepthScale, first: int, last: int) -> list[tuple[float, str, float]]:
    """Choose the ticks whose labels do not touch: (depth [m], label, column of the label's middle [px])."""
    gap = 0.7 * canvas.text_px
    taken: list[tuple[float, float]] = []
    placed = []
    for depth in scale.ticks():
        label = f"{depth:g} m" if depth == scale.far else f"{depth:g}"
        middle = first + float(scale.fractions(np.array(depth))) * (last - first)
        half = canvas.text_width(label, scale=_SMALL) / 2 + gap / 2
        if all(middle + half <= left or middle - half >= right for left, right in taken):
            taken.append((middle - half, middle + half))
            placed.append((depth, label, middle))
    return placed
