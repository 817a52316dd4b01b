"""Whether the times of a sweep's points can be believed, and what they mean where they cannot be taken as they are.

The criteria, strongest first: where the times lie on the clock against the sweep's own timestamp; whether they lie at
zero while the timestamp does not; how long they last against the sweep period. Conventions differ, and none of these is
a fault: sweeps timestamped at their start, middle or end, or seconds late after a network; points measured in a tenth
of the period, or all at once; several sweeps gathered under one timestamp.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from fractions import Fraction

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.scene import NOMINAL_PERIOD_NS

NEAR_PERIODS = 2
"""A timestamp so many periods before the first point or after the last one is the sweep's own in any convention."""

LONGEST_LAG_NS = 10_000_000_000
"""Times so far from the timestamp are still believed, unless they count from zero.

What timestamps late is late alike.
"""

MOST_PERIODS = 400
"""Points gathered over more periods than this look like times in a unit 1000 times too small: half of 1000, nearly."""

LONGEST_SCAN_NS = 3_600_000_000_000
"""A scanner that stands may measure one cloud for an hour; what reaches further is no time."""

LEAST_SHARE = 100
"""Times from zero that last less than this part of a period are no times of a sweep."""

_STRAY_SHARE = 20  # the first and the last of so many parts of the points do not decide what the times of a sweep are
_SAMPLE = 4096  # about so many points report where most of the times lie
_FACTORS = tuple(Fraction(1000) ** power for power in (-1, 1, -2, 2, 3))
"""How many times too large times can be that were read in another unit out of s, ms, µs and ns. Seconds read as
nanoseconds are not among them: within a sweep all are equal."""


class PointTimes(StrEnum):
    """What the times of a sweep's points are."""

    ABSOLUTE = "absolute"
    """On the scene's clock, as they should be."""
    ABSENT = "absent"
    """The points have none."""
    EQUAL = "equal"
    """All the same, and not the sweep's own: they state nothing."""
    RELATIVE = "relative"
    """Counted from the sweep's timestamp."""
    OTHER_CLOCK = "other-clock"
    """As long as a sweep lasts, but on a clock that the timestamp does not come from."""
    WRONG_UNIT = "wrong-unit"
    """Multiplied by a power of 1000."""
    UNKNOWN = "unknown"
    """None of these."""


@dataclass(frozen=True, slots=True)
class TimesFound:
    """What was found out about the times of one sweep.

    Attributes:
        kind: what they are.
        factor: how many times too large they are; 1 but for `WRONG_UNIT`.
        relative: whether those of a wrong unit count from the sweep's timestamp.
        strays: points of some other time, far from the sweep's; they were given the median of the others.
    """

    kind: PointTimes = PointTimes.ABSOLUTE
    factor: Fraction = Fraction(1)
    relative: bool = False
    strays: int = 0

    @property
    def untimed(self) -> bool:
        """Whether times were there and had to be left out."""
        return self.kind in {PointTimes.EQUAL, PointTimes.UNKNOWN}


SOUND = TimesFound()


@dataclass(frozen=True, slots=True)
class RawTimes:
    """The timestamp of a sweep and its earliest point time as the source gives them [ns]."""

    timestamp_ns: int
    first_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class TimedFrame:
    """A sweep whose point times are on the scene's clock, or absent.

    Attributes:
        frame: the very frame that was judged where its times could be taken as they are.
        found: what its times were.
        raw: what the judgement of the next sweep may need; None where the points had no times.
    """

    frame: LidarFrame
    found: TimesFound = SOUND
    raw: RawTimes | None = None

    @property
    def verdict(self) -> PointTimes:
        """What the times were."""
        return self.found.kind


def timed_frame(frame: LidarFrame, period_ns: int, *, previous: RawTimes | None = None) -> TimedFrame:
    """Judge the times of a sweep's points, and bring them onto the scene's clock.

    Args:
        period_ns: the time from sweep to sweep; 0 where it is not known.
        previous: `raw` of the sweep before of the same lidar. Near the clock's zero, times from zero may count from
            the timestamp or be absolute and timestamped late; then it decides: absolute times went on as the timestamps
            did.
    """
    times = frame.points.timestamps_ns
    if times is None:
        return TimedFrame(frame, TimesFound(PointTimes.ABSENT))
    if len(times) == 0:
        return TimedFrame(frame)
    sweep = _Sweep.of(times, frame.timestamp_ns, period_ns if period_ns > 0 else NOMINAL_PERIOD_NS, previous)
    raw = RawTimes(frame.timestamp_ns, sweep.first_ns)
    found = sweep.judged()
    if found.untimed:
        return TimedFrame(_with_times(frame, None), found, raw)
    if found == SOUND:
        return TimedFrame(frame, found, raw)
    return TimedFrame(_with_times(frame, sweep.repaired(times, found)), found, raw)


def _with_times(frame: LidarFrame, times_ns: Int64Array | None) -> LidarFrame:
    return replace(frame, points=replace(frame.points, timestamps_ns=times_ns))


@dataclass(frozen=True, slots=True)
class _Sweep:
    """The times of a sweep in a few numbers [ns]: `first` and `last` of its points without those of some other time."""

    timestamp_ns: int
    period_ns: int
    first_ns: int
    last_ns: int
    median_ns: int
    strays: int
    previous: RawTimes | None

    @classmethod
    def of(cls, times: Int64Array, timestamp_ns: int, period_ns: int, previous: RawTimes | None) -> "_Sweep":
        first_ns, last_ns = int(times.min()), int(times.max())
        if last_ns - first_ns <= NEAR_PERIODS * period_ns or len(times) < _STRAY_SHARE:
            return cls(timestamp_ns, period_ns, first_ns, last_ns, first_ns, 0, previous)
        sample = np.sort(times[:: max(1, len(times) // _SAMPLE)])
        aside = len(sample) // _STRAY_SHARE
        low, high = int(sample[aside]), int(sample[-1 - aside])
        margin = max(high - low, NEAR_PERIODS * period_ns)
        inside = times[(times >= low - margin) & (times <= high + margin)]
        first_ns, last_ns, middle = int(inside.min()), int(inside.max()), int(sample[len(sample) // 2])
        return cls(timestamp_ns, period_ns, first_ns, last_ns, middle, len(times) - len(inside), previous)

    @property
    def span_ns(self) -> int:
        return self.last_ns - self.first_ns

    def judged(self) -> TimesFound:
        if self.span_ns == 0:
            # all points of a flash may have one time near the timestamp; zero is written where no time is known
            unknown = self.first_ns == 0 and self.timestamp_ns != 0
            if unknown or abs(self.first_ns - self.timestamp_ns) > self.period_ns:
                return TimesFound(PointTimes.EQUAL)
            return TimesFound(strays=self.strays)
        kind = self._kind()
        return kind if kind.untimed else replace(kind, strays=self.strays)

    def _kind(self) -> TimesFound:
        if self._counts_from_timestamp():
            return TimesFound(PointTimes.RELATIVE)
        near = self._is_near_timestamp() and self._went_on() is not False
        gathered_at_most = self.span_ns <= MOST_PERIODS * self.period_ns
        if near and gathered_at_most:
            return SOUND
        unit = self._unit()
        if unit is not None:
            return unit
        is_late = gathered_at_most and self._is_near_timestamp(reach_ns=LONGEST_LAG_NS)
        if is_late or (near and self.span_ns <= LONGEST_SCAN_NS):
            return SOUND
        shortest_ns, longest_ns = self.period_ns / LEAST_SHARE, NEAR_PERIODS * self.period_ns
        lasts = shortest_ns <= self.span_ns <= longest_ns
        return TimesFound(PointTimes.OTHER_CLOCK if lasts else PointTimes.UNKNOWN)

    def _is_near_timestamp(self, factor: Fraction = Fraction(1), *, reach_ns: int = 0) -> bool:
        return self._is_near(self.timestamp_ns, factor, reach_ns=reach_ns)

    def _is_near(self, time_ns: int, factor: Fraction = Fraction(1), *, reach_ns: int = 0) -> bool:
        reach_ns = reach_ns or NEAR_PERIODS * self.period_ns
        return self.first_ns / factor - reach_ns <= time_ns <= self.last_ns / factor + reach_ns

    def _went_on(self, factor: Fraction = Fraction(1)) -> bool | None:
        """Whether the times advanced since the sweep before as the timestamp did; None where that cannot be stated."""
        if self.previous is None or self.timestamp_ns <= self.previous.timestamp_ns:
            return None
        advance_ns = self.timestamp_ns - self.previous.timestamp_ns
        return 2 * (self.first_ns - self.previous.first_ns) >= advance_ns * factor

    def _counts_from_timestamp(self) -> bool:
        """Whether the times lie around zero while the timestamps do not, and do not continue as the timestamps do."""
        reach_ns = 1.5 * self.period_ns
        if not self._timestamp_is_near_zero():
            # of gathered sweeps, too; but nearer to zero than to the timestamp
            reach_ns = max(reach_ns, min(MOST_PERIODS * self.period_ns, abs(self.timestamp_ns) / 4))
        starts_at_zero = self._is_near(0) and self._lies_around_zero(reach_ns)
        if self.timestamp_ns == 0 or not starts_at_zero:
            return False
        if self.span_ns * LEAST_SHARE < self.period_ns:
            return False
        went_on = self._went_on()
        return not self._is_near_timestamp() if went_on is None else not went_on

    def _timestamp_is_near_zero(self) -> bool:
        return abs(self.timestamp_ns) <= LONGEST_LAG_NS

    def _lies_around_zero(self, reach_ns: float) -> bool:
        return -reach_ns <= self.first_ns and self.last_ns <= reach_ns

    def _unit(self) -> TimesFound | None:
        """A wrong unit, if one moves the times to the timestamp, or makes them as long as a sweep from zero on."""
        for factor in _FACTORS:
            if self._is_near_timestamp(factor) and self._went_on(factor) is not False and self._lasts(factor):
                return TimesFound(PointTimes.WRONG_UNIT, factor)
        for factor in _FACTORS:
            period = float(self.period_ns * factor)
            as_long = period <= 2 * self.span_ns <= 4 * period
            if as_long and self._lies_around_zero(1.5 * period):
                return TimesFound(PointTimes.WRONG_UNIT, factor, relative=True)
        return None

    def _lasts(self, factor: Fraction) -> bool:
        """Whether the times last as long as those of a sweep; near zero any unit brings them near the timestamp."""
        shortest = Fraction(1, 2) if self._timestamp_is_near_zero() else Fraction(1, LEAST_SHARE)
        period = self.period_ns * factor
        return shortest * period <= self.span_ns <= NEAR_PERIODS * period

    def repaired(self, times: Int64Array, found: TimesFound) -> Int64Array:
        """The times on the scene's clock, exact where they are too small, rounded where they are too large."""
        repaired = times
        if found.strays:
            inside = (times >= self.first_ns) & (times <= self.last_ns)
            repaired = np.where(inside, times, self.median_ns)
        if found.factor < 1:
            repaired = repaired * int(1 / found.factor)
        elif found.factor > 1:
            repaired = (repaired + int(found.factor) // 2) // int(found.factor)
        if found.kind is PointTimes.RELATIVE or found.relative:
            repaired = repaired + self.timestamp_ns
        elif found.kind is PointTimes.OTHER_CLOCK:
            repaired = repaired - self.first_ns + self.timestamp_ns
        return np.asarray(repaired, np.int64)
