"""Time that is stationary now and then, so that a car on a smooth curve stops and drives on as smoothly."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError

_RISE = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""A step from 0 to 1 over [0, 1], flat to the second derivative at both ends.

Source: Hermite interpolation of degree five; 10 x³ - 15 x⁴ + 6 x⁵."""
_AREA = polynomial.polyint(_RISE)
_SLOPE = polynomial.polyder(_RISE)


@dataclass(frozen=True, slots=True)
class Stop:
    """A while in which the car stands.

    Attributes:
        at_s: when it stands [s], after the start of the drive; it brakes before.
        for_s: for how long [s].

    Raises:
        OptionError: a number is not finite, or `for_s` is negative.
    """

    at_s: float
    for_s: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.at_s) and np.isfinite(self.for_s) and self.for_s >= 0):
            raise OptionError(f"stop at {self.at_s} s for {self.for_s} s; expected finite, not negative")


@dataclass(frozen=True, slots=True, eq=False)
class TimeWarp:
    """How far a drive with stops has come, in seconds of the same drive without.

    The pace falls from 1 to 0 over `ramp` seconds before a stop and rises again after it, with two continuous
    derivatives; during a stop the answer is the same to the last bit.

    Attributes:
        begins, ends: (S,) float64 [s], in order, apart by twice the ramp at least.
        ramp: time for braking and for starting [s].
    """

    begins: Float64Array
    ends: Float64Array
    ramp: float

    @classmethod
    def of(cls, stops: Sequence[Stop], *, ramp: float) -> "TimeWarp":
        """Put stops in order.

        Raises:
            OptionError: there is no time to start and to brake between two of them.
        """
        ordered = sorted(stops, key=lambda stop: stop.at_s)
        begins = np.array([stop.at_s for stop in ordered], np.float64)
        ends = np.array([stop.at_s + stop.for_s for stop in ordered], np.float64)
        if (begins[1:] - ends[:-1] < 2 * ramp).any():
            raise OptionError(f"stops at {begins.tolist()} s; expected {2 * ramp} s between two at least")
        return cls(begins, ends, ramp)

    def at(self, seconds: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Give the warped time [s], its pace and the pace's slope [1/s] at (M,) times [s]; time 0 stays 0."""
        seconds = np.asarray(seconds, np.float64)
        return self._time(seconds) - self._time(np.zeros(1)), self._pace(seconds, 0), self._pace(seconds, 1)

    def _time(self, seconds: Float64Array) -> Float64Array:
        """The warped time up to a constant: what is driven at full pace, less what the ramps lose."""
        if not len(self.begins):
            return seconds
        time: Float64Array = np.minimum(seconds, self.begins[0])
        for end, begin in zip(self.ends, [*self.begins[1:], np.inf], strict=True):
            time = time + np.clip(seconds - end, 0.0, begin - end)
        for begin, end in zip(self.begins, self.ends, strict=True):
            braked = np.clip((seconds - begin) / self.ramp + 1.0, 0.0, 1.0)
            started = np.clip((seconds - end) / self.ramp, 0.0, 1.0)
            lost = polynomial.polyval(braked, _AREA) + started - polynomial.polyval(started, _AREA)
            time = time - self.ramp * lost
        return time

    def _pace(self, seconds: Float64Array, order: int) -> Float64Array:
        """The warped time's first derivative or, with order 1, its second."""
        rise = (_RISE, _SLOPE / self.ramp)[order]
        pace = np.full(seconds.shape, 1.0 - order)
        for begin, end in zip(self.begins, self.ends, strict=True):
            braked = np.clip((seconds - begin) / self.ramp + 1.0, 0.0, 1.0)
            started = np.clip((seconds - end) / self.ramp, 0.0, 1.0)
            pace = pace - polynomial.polyval(braked, rise) + polynomial.polyval(started, rise)
        return pace
