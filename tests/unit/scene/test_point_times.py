"""What the times of a sweep's points can be, and what is made of them."""

from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import sceneloom
from sceneloom.motion.deskew import PointTimesStatistics
from sceneloom.scene import LidarFrame, LidarPoints, WarningKind
from sceneloom.scene.point_times import PointTimes, RawTimes, TimedFrame, TimesFound, timed_frame

PERIOD = 100_000_000
EPOCH = 1_700_000_000_123_456_789
CLOCKS = pytest.mark.parametrize("clock", [EPOCH, 3_000_000_000, 15_000_000_000, 250_000_000_000])


def times_of_sweep(count: int = 1000, span: int = PERIOD) -> np.ndarray:
    """In no order, as those of many lasers are; the first is 0 and the last the span."""
    times = np.linspace(0, span, count).astype(np.int64)
    return np.random.default_rng(1).permutation(times)


def sweep(timestamp_ns: int, times_ns: np.ndarray | None) -> LidarFrame:
    count = 5 if times_ns is None else len(times_ns)
    return LidarFrame(timestamp_ns, LidarPoints(np.ones((count, 3), np.float32), timestamps_ns=times_ns))


def judged(timestamp_ns: int, times_ns: np.ndarray | None, previous: RawTimes | None = None) -> TimedFrame:
    return timed_frame(sweep(timestamp_ns, times_ns), PERIOD, previous=previous)


@CLOCKS
@pytest.mark.parametrize(
    ("first", "span"),
    [
        # timestamped at the start, at the end, in the middle; a tenth of the period; a flash in several parts
        *((0, PERIOD), (-PERIOD, PERIOD), (-PERIOD // 2, PERIOD), (0, PERIOD // 10), (-PERIOD // 3, PERIOD // 1000)),
        # timestamped late, ten sweeps gathered, timestamped early, nanoseconds
        *((-5 * PERIOD, PERIOD), (-9 * PERIOD, 10 * PERIOD), (2 * PERIOD, PERIOD), (0, 3)),
    ],
)
def test_conventions_are_no_faults_and_nothing_is_touched(clock: int, first: int, span: int) -> None:
    frame = sweep(clock, clock + first + times_of_sweep(span=span))
    timed = timed_frame(frame, PERIOD)
    assert (timed.verdict, timed.found.untimed) == (PointTimes.ABSOLUTE, False)
    assert timed.frame is frame


def test_one_time_for_all_points_is_believed_near_the_timestamp_and_states_nothing_elsewhere() -> None:
    flash = judged(EPOCH, np.full(10, EPOCH + PERIOD // 2))
    assert (flash.verdict, flash.frame.points.timestamps_ns is None) == (PointTimes.ABSOLUTE, False)
    assert judged(EPOCH, None).verdict is PointTimes.ABSENT
    assert judged(EPOCH, np.zeros(0, np.int64)).verdict is PointTimes.ABSOLUTE
    for time in (0, EPOCH - 2 * PERIOD):
        timed = judged(EPOCH, np.full(10, time))
        assert (timed.verdict, timed.found.untimed) == (PointTimes.EQUAL, True)
        assert timed.frame.points.timestamps_ns is None
    # zero is no time however near the timestamp is
    assert judged(PERIOD // 2, np.zeros(10, np.int64)).verdict is PointTimes.EQUAL
    assert judged(0, np.zeros(10, np.int64)).verdict is PointTimes.ABSOLUTE


UNITS = pytest.mark.parametrize("factor", [Fraction(1000), Fraction(10**6), Fraction(1, 1000), Fraction(1, 10**6)])


def in_unit(times_ns: np.ndarray, factor: Fraction) -> np.ndarray:
    """What a reader makes of the times that takes one unit for another."""
    return np.array([round(time * factor) for time in times_ns.tolist()], np.int64)


@UNITS
@pytest.mark.parametrize("span", [PERIOD, 6 * PERIOD // 10, 19 * PERIOD // 10])
def test_times_in_a_wrong_unit_are_brought_into_the_right_one(factor: Fraction, span: int) -> None:
    clock = 250_000_000_000  # times a million it still fits 64 bits
    true = clock + times_of_sweep(span=span)
    timed = judged(clock, in_unit(true, factor))
    assert (timed.verdict, timed.found.factor, timed.found.relative) == (PointTimes.WRONG_UNIT, factor, False)
    # what a coarser unit has rounded away does not come back
    coarse = max(float(1 / factor), 1.0)
    np.testing.assert_allclose(timed.frame.points.timestamps_ns - clock, true - clock, rtol=0, atol=coarse / 2)


@CLOCKS
@pytest.mark.parametrize("factor", [Fraction(10) ** power for power in (0, 3, 6, 9, -3, -6)])
def test_times_from_zero_count_from_the_timestamp_in_whatever_unit(clock: int, factor: Fraction) -> None:
    verdict = PointTimes.RELATIVE if factor == 1 else PointTimes.WRONG_UNIT
    usual = product((0, -PERIOD, -PERIOD // 2), (PERIOD, PERIOD // 10))
    for first, span in usual if factor == 1 else [(0, PERIOD)]:
        relative = first + times_of_sweep(span=span)
        timed = judged(clock, in_unit(relative, factor))
        assert timed.found == TimesFound(verdict, factor, relative=factor != 1)
        repaired, coarse = timed.frame.points.timestamps_ns - clock, max(float(1 / factor), 1.0)
        np.testing.assert_allclose(repaired, relative, rtol=0, atol=coarse / 2 if factor != 1 else 0)


def test_another_clock_is_set_by_the_first_point_and_times_that_fit_nothing_are_left_out() -> None:
    since_boot = 123_456_000_000_000 + times_of_sweep()
    timed = judged(EPOCH, since_boot)
    assert timed.verdict is PointTimes.OTHER_CLOCK
    np.testing.assert_array_equal(timed.frame.points.timestamps_ns, EPOCH + times_of_sweep())
    for span in [PERIOD // 300, 17 * PERIOD, 40_000 * PERIOD]:
        timed = judged(EPOCH, 123_456_000_000_000 + times_of_sweep(span=span))
        assert (timed.verdict, timed.found.untimed) == (PointTimes.UNKNOWN, True)
        assert timed.frame.points.timestamps_ns is None
    micros = EPOCH // 1000 + times_of_sweep() // 1000
    timed = judged(EPOCH, micros)
    assert (timed.verdict, timed.found.factor) == (PointTimes.WRONG_UNIT, Fraction(1, 1000))
    np.testing.assert_array_equal(timed.frame.points.timestamps_ns, micros * 1000)
    # long scans, unknown periods and extreme times
    assert judged(EPOCH, EPOCH + times_of_sweep(span=1000 * PERIOD)).verdict is PointTimes.ABSOLUTE
    # an unknown period is taken to be a tenth of a second
    assert timed_frame(sweep(EPOCH, times_of_sweep()), 0).verdict is PointTimes.RELATIVE
    extremes = np.array([-(2**63), 2**63 - 1] * 50, np.int64)
    assert judged(EPOCH, extremes).verdict is PointTimes.UNKNOWN
    assert judged(-EPOCH, np.full(3, 2**63 - 1)).verdict is PointTimes.EQUAL


def test_strays_get_the_time_of_their_sweep_and_hide_neither_a_wrong_unit_nor_times_from_zero() -> None:
    for stray in [0, EPOCH - 50 * PERIOD, 2**62]:
        true = EPOCH + times_of_sweep()
        times = true.copy()
        times[[3, 500, 999]] = stray
        timed = judged(EPOCH, times)
        assert timed.found == TimesFound(strays=3)
        repaired = timed.frame.points.timestamps_ns
        np.testing.assert_array_equal(np.delete(repaired, [3, 500, 999]), np.delete(true, [3, 500, 999]))
        assert np.abs(repaired[[3, 500, 999]] - (EPOCH + PERIOD // 2)).max() < PERIOD // 100
    relative = times_of_sweep()
    for factor, kind in ((1, PointTimes.RELATIVE), (1000, PointTimes.WRONG_UNIT)):
        times = relative * factor
        times[[3, 500]] = EPOCH
        timed = judged(EPOCH, times)
        assert (timed.verdict, timed.found.strays) == (kind, 2)
        kept = np.delete(timed.frame.points.timestamps_ns, [3, 500])
        np.testing.assert_array_equal(kept, np.delete(relative, [3, 500]) + EPOCH)


def test_a_drive_from_zero_on_is_read_alike_throughout_and_one_that_is_timestamped_late_believed() -> None:
    for factor in [1, Fraction(1, 1000), 1000]:
        # Sweep 1 alone could be absolute, timestamped at its end; the sweep before says that the times do not go on.
        relative, previous = times_of_sweep(), None
        for k in range(20):
            timed = judged(k * PERIOD, in_unit(relative, Fraction(factor)), previous)
            previous = timed.raw
            if k > 0:  # nothing comes before the first, where counting from the timestamp is counting from zero
                atol = 500 if factor < 1 else 0
                np.testing.assert_allclose(timed.frame.points.timestamps_ns, relative + k * PERIOD, rtol=0, atol=atol)
    for late in [0, PERIOD, 5 * PERIOD]:
        previous = None
        for k in range(20):
            frame = sweep(k * PERIOD + late, k * PERIOD + times_of_sweep())
            timed = timed_frame(frame, PERIOD, previous=previous)
            previous = timed.raw
            if k > 0 or late < 2 * PERIOD:
                assert timed.frame is frame


def test_everything_but_sound_and_absent_times_is_reported_once() -> None:
    statistics = PointTimesStatistics()
    relative = times_of_sweep()
    strays = EPOCH + relative
    strays[:4] = 0
    for times in (None, EPOCH + relative, relative, relative, relative * 1000, strays, np.zeros(3, np.int64)):
        statistics.add(judged(EPOCH, times).found)
    reported = {warning.code: (warning.kind, warning.count) for warning in statistics.warnings()}
    assert reported == {
        "relative-point-times": (WarningKind.ASSUMED, 2),
        "unit-of-point-times": (WarningKind.REPAIRED, 1),
        "times-of-points": (WarningKind.ASSUMED, 1),
        "stray-point-times": (WarningKind.REPAIRED, 4),
    }
    unit = next(warning.message for warning in statistics.warnings() if warning.code == "unit-of-point-times")
    assert "1000 times too large" in unit
    assert "relative to the sweep's time" in unit


@pytest.mark.parametrize("recording", ["kitti_drive", "pandaset"])
def test_real_drives_are_believed(data_dir: Path, recording: str) -> None:
    with sceneloom.open(data_dir / "recordings" / recording) as scene:
        lidar, previous = scene.lidars[0], None
        period_ns = int(np.median(np.diff(lidar.frames.timestamps_ns)))
        for frame in lidar.frames:
            timed = timed_frame(frame, period_ns, previous=previous)
            previous = timed.raw
            assert timed.frame is frame
