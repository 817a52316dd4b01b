"""The clock of a file: its unit, its offset, and exact integer conversion to and from nanoseconds."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.errors import OptionError

TICKS_NS: Mapping[str, int] = MappingProxyType({"microseconds": 1_000, "nanoseconds": 1})
"""Length of one tick of each unit that we write [ns]."""

READABLE_TICKS_NS: Mapping[str, int] = MappingProxyType({**TICKS_NS, "microsecond": 1_000, "nanosecond": 1})
"""The same for the spellings that we read."""

INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1
UINT32_MAX, UINT64_MAX = 2**32 - 1, 2**64 - 1
_SMALL_START_NS = 10_000_000_000  # a scene that starts within so many nanoseconds of its clock's zero needs no offset
_SECOND_NS = 1_000_000_000
_PIECE = 1 << 13

_EXACT_QUOTIENT = 2**50
"""Below it a quotient in float64 is off by less than a thousandth, so that it rounds as the exact one does."""


class TimeRangeError(OptionError):
    """A time does not fit the integers that must hold it; readers turn it into a fault of the file."""


class StaticTime(int):
    """The time of something that holds at all times [ns]; it is written as one that the file can hold."""


@dataclass(frozen=True, slots=True)
class FileClock:
    """`nanoseconds = timestamp · tick_ns + offset_ns`.

    Attributes:
        tick_ns: length of the file's unit of time [ns].
        offset_ns: the absolute time of timestamp 0 [ns]; negative only for scenes that begin before time zero.
    """

    tick_ns: int
    offset_ns: int

    def absolute_ns(self, timestamp: float) -> int:
        """Give the absolute time of a timestamp.

        Raises:
            TimeRangeError: it is not finite, or does not fit 64 bits.
        """
        return _checked_ns(scaled(timestamp, self.tick_ns) + self.offset_ns)

    def absolute_array(self, timestamps: AnyArray) -> Int64Array:
        """Give the absolute times of an integer array of timestamps, (N,) int64 [ns].

        Raises:
            TimeRangeError: one of them does not fit 64 bits.
        """
        if timestamps.size:
            self.absolute_ns(int(timestamps.min()))
            self.absolute_ns(int(timestamps.max()))
        if self.offset_ns == 0 or not self._offset_fits:
            return self._absolute_exactly(timestamps)
        highest = 0 if timestamps.size == 0 else max(abs(int(timestamps.min())), abs(int(timestamps.max())))
        if highest * self.tick_ns > INT64_MAX:
            return self._absolute_exactly(timestamps)
        absolute_ns = timestamps.astype(np.int64)
        absolute_ns *= self.tick_ns
        absolute_ns += self.offset_ns
        return absolute_ns

    @property
    def _offset_fits(self) -> bool:
        """Whether arrays can be shifted by the offset: one in whole seconds may lie before all times of 64 bits."""
        return INT64_MIN <= self.offset_ns <= INT64_MAX

    def _absolute_exactly(self, timestamps: AnyArray) -> Int64Array:
        if self.offset_ns == 0:
            absolute_ns = timestamps.astype(np.int64)
            absolute_ns *= self.tick_ns
            return absolute_ns
        return np.array([self.absolute_ns(timestamp) for timestamp in timestamps.tolist()], np.int64)

    def timestamp(self, timestamp_ns: int) -> int:
        """Give the nearest timestamp of an absolute time; halves go to the even one."""
        quotient, rest = divmod(timestamp_ns - self.offset_ns, self.tick_ns)
        return quotient + (2 * rest > self.tick_ns or (2 * rest == self.tick_ns and quotient % 2 == 1))

    def timestamps_of_span(self, first_ns: int, last_ns: int) -> tuple[int, int]:
        """Give the nearest timestamps of the earliest and the latest of many times.

        Raises:
            TimeRangeError: the span from the offset to one of them does not fit 64 bits.
        """
        for timestamp_ns in (first_ns, last_ns):
            _checked_ns(timestamp_ns - self.offset_ns)
        return self.timestamp(first_ns), self.timestamp(last_ns)

    def timestamp_array(
        self,
        timestamps_ns: Int64Array,
        *,
        dtype: type[np.integer[Any]] = np.int64,
        span_ns: tuple[int, int] | None = None,
    ) -> tuple[AnyArray, int]:
        """Give the nearest timestamps, (N,), halves to even, and how many were not exact.

        Args:
            timestamps_ns: (N,) int64 [ns].
            dtype: of the timestamps; the caller knows that it holds them.
            span_ns: the earliest and the latest time, where the caller knows them already [ns].

        Raises:
            TimeRangeError: the span from the offset to a time does not fit 64 bits.
        """
        if timestamps_ns.size == 0:
            return np.zeros(0, dtype), 0
        first_ns, last_ns = span_ns or (int(timestamps_ns.min()), int(timestamps_ns.max()))
        lowest, highest = _checked_ns(first_ns - self.offset_ns), _checked_ns(last_ns - self.offset_ns)
        if not self._offset_fits:
            return self._timestamps_exactly(timestamps_ns, dtype)
        if dtype is np.uint32 and lowest >= 0 and highest - lowest < UINT32_MAX - 4 * self.tick_ns:
            return self._timestamps_of_sweep(timestamps_ns, lowest)
        if self.tick_ns > 1 and lowest > -_EXACT_QUOTIENT and highest < _EXACT_QUOTIENT:
            return self._nearest_timestamps(timestamps_ns, dtype)
        since_offset = timestamps_ns - self.offset_ns
        if self.tick_ns == 1:
            return since_offset.astype(dtype, copy=False), 0
        quotient = since_offset // self.tick_ns
        # a half goes up only where that makes the timestamp even; ticks are of even length
        timestamps = (since_offset + (quotient & 1) + (self.tick_ns // 2 - 1)) // self.tick_ns
        inexact = int(np.count_nonzero(since_offset - quotient * self.tick_ns))
        return timestamps.astype(dtype, copy=False), inexact

    def _timestamps_exactly(self, timestamps_ns: Int64Array, dtype: type[np.integer[Any]]) -> tuple[AnyArray, int]:
        times_ns = timestamps_ns.tolist()
        inexact = sum((time_ns - self.offset_ns) % self.tick_ns != 0 for time_ns in times_ns)
        return np.array([self.timestamp(time_ns) for time_ns in times_ns], dtype), inexact

    def _timestamps_of_sweep(self, timestamps_ns: Int64Array, lowest: int) -> tuple[AnyArray, int]:
        """Divide in 32 bits, in half the time, what lies within 4 s of `lowest`, the earliest, from the offset [ns]."""
        tick = np.uint32(self.tick_ns)
        first = lowest // (2 * self.tick_ns) * 2  # an even timestamp, so that it does not change what is even
        start_ns = self.offset_ns + first * self.tick_ns
        since = np.empty(len(timestamps_ns), np.uint32)
        np.subtract(timestamps_ns, start_ns, out=since, casting="unsafe")
        timestamps = since // tick
        inexact = int(np.count_nonzero(since != timestamps * tick))
        if inexact:
            # a half goes up only where that makes the timestamp even; ticks are of even length or 1
            since += timestamps & np.uint32(1)
            since += np.uint32(self.tick_ns // 2 - 1)
            timestamps = since // tick
        timestamps += np.uint32(first)
        return timestamps, inexact

    def _nearest_timestamps(self, timestamps_ns: Int64Array, dtype: type[np.integer[Any]]) -> tuple[AnyArray, int]:
        """Divide in float64, piece by piece: fresh memory for every step would take longer than the steps."""
        timestamps, inexact = np.empty(len(timestamps_ns), dtype), 0
        since, quotients, nearest = np.empty(_PIECE, np.int64), np.empty(_PIECE), np.empty(_PIECE)
        for start in range(0, len(timestamps_ns), _PIECE):
            piece = timestamps_ns[start : start + _PIECE]
            part = slice(0, len(piece))
            np.subtract(piece, self.offset_ns, out=since[part])
            np.divide(since[part], self.tick_ns, out=quotients[part])
            np.rint(quotients[part], out=nearest[part])
            # a whole quotient is exact, and no other one is near enough to a whole number to look like one
            inexact += int(np.count_nonzero(quotients[part] != nearest[part]))
            timestamps[start : start + _PIECE] = nearest[part]
        return timestamps, inexact

    def duration_ns(self, duration: float) -> int | float:
        """Give a duration of the file in nanoseconds: an integer, if that is the same number when it is written."""
        whole_ns = _checked_ns(scaled(duration, self.tick_ns))
        return whole_ns if self.duration(whole_ns) == duration else duration * self.tick_ns

    def duration(self, duration_ns: float) -> int | float:
        """Give a duration in the file's unit: an integer where it is one."""
        if isinstance(duration_ns, int) and duration_ns % self.tick_ns == 0:
            return duration_ns // self.tick_ns
        return duration_ns / self.tick_ns


def point_times_dtype(clock: FileClock) -> np.dtype[Any]:
    """The dtype that the times of points have: uint64 where the unit is the nanosecond, else uint32.

    Source: `timestamps` in "Lidar Sensor" of the description.
    """
    return np.dtype(np.uint64 if clock.tick_ns == 1 else np.uint32)


def _checked_ns(timestamp_ns: int) -> int:
    """Pass a time on if it fits 64 bits; else a TimeRangeError."""
    if not INT64_MIN <= timestamp_ns <= INT64_MAX:
        raise TimeRangeError(f"{timestamp_ns} ns does not fit 64 bits")
    return timestamp_ns


def scaled(value: float, tick_ns: int) -> int:
    """Multiply a number of ticks by their length without losing digits of its whole part.

    Raises:
        TimeRangeError: the number is not finite.
    """
    if isinstance(value, int):
        return value * tick_ns
    if not abs(value) < float("inf"):
        raise TimeRangeError(f"{value} is not a time")
    whole = int(value)
    return whole * tick_ns + round((value - whole) * tick_ns)


def chosen_offset_ns(first_ns: int) -> int:
    """Choose the offset of a scene's clock from its earliest time.

    Whole seconds, so that rounding to a unit does not depend on it; 0 for scenes that start near zero; negative,
    on whole seconds too, for scenes that start before it.
    """
    if 0 <= first_ns < _SMALL_START_NS:
        return 0
    return first_ns // _SECOND_NS * _SECOND_NS


EARLIEST_OFFSET_NS = chosen_offset_ns(INT64_MIN)
"""The offset of a scene whose first time is the earliest of 64 bits [ns]."""
