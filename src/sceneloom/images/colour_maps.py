"""Colour maps computed from a few anchors in OKLab, where equal distances look equally different.

A map is a smooth curve through its anchors, cut into steps of equal length, so that a step in the value looks the
same wherever it lies on the scale. Lightness rises (or falls) along the whole curve: the order of two values can be
reported without a legend, in print without colours, and by people who see few colours.

Source: Björn Ottosson, "A perceptual color space for image processing", 2020 (matrices of OKLab); IEC 61966-2-1
(transfer curve of sRGB).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, UInt8Array, read_only
from sceneloom.errors import OptionError

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
    """Draw a smooth curve through (A, 3) anchors, (F, 3).

    Each coordinate stays monotone between its anchors: cubic Hermite chunks with tangents limited to three times
    the smaller neighbouring slope.

    Source: Fritsch and Carlson, "Monotone piecewise cubic interpolation", 1980.
    """
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
        start
        + (stop - start) * t * t * (3 - 2 * t)
        + bend * ((1 - t) * tangents[piece] - t * tangents[piece + 1])
    )


def _equal_steps(curve: Float64Array) -> Float64Array:
    """Choose points along a curve at equal distances, (256, 3)."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    wanted = np.linspace(0.0, lengths[-1], _STEPS)
    return np.column_stack([np.interp(wanted, lengths, column) for column in curve.T])
