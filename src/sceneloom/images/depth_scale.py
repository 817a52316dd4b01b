"""From depths to colours: a logarithmic scale between two round numbers, and the ticks that label it."""

from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, UInt8Array
from sceneloom.errors import OptionError
from sceneloom.images.colour_maps import ColourMap, colour_map

ROUND_DIGITS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
COARSE_DIGITS = (1.0, 2.0, 5.0)
_TICK_RANKS = ((1.0,), (2.0, 5.0), (3.0,), (1.5, 4.0, 6.0, 8.0))
_ENDS_PERCENT = (0.5, 99.5)


@dataclass(frozen=True, slots=True)
class DepthScale:
    """Colours depths on a logarithmic scale, so that one metre counts more near than far.

    Attributes:
        near, far: depths [m] of the two ends of the colour map; depths beyond take the colour of the nearer end.
        map: the colours from near to far.

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
            return np.asarray(
                np.log(np.asarray(depths, np.float64) / self.near) / np.log(self.far / self.near)
            )

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
