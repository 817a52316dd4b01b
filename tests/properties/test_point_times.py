"""Whatever the times of points are: what is made of them is of the sweep, and is left alone the second time."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.scene import LidarFrame, LidarPoints
from sceneloom.scene.point_times import LONGEST_LAG_NS, MOST_PERIODS, PointTimes, timed_frame

INT64 = st.integers(-(2**63), 2**63 - 1)
TIMESTAMPS = st.integers(-(2**61), 2**61) | st.integers(-(10**11), 10**11)
PERIODS = st.integers(0, 10**10)


def sweep(timestamp_ns, times):
    positions = np.zeros((len(times), 3), np.float32)
    return LidarFrame(timestamp_ns, LidarPoints(positions, timestamps_ns=np.array(times, np.int64)))


@given(timestamp=TIMESTAMPS, times=st.lists(INT64, max_size=50), period=PERIODS)
def test_any_times_at_all_are_judged(timestamp, times, period):
    timed = timed_frame(sweep(timestamp, times), period)
    points = timed.frame.points
    assert points.timestamps_ns is None or len(points.timestamps_ns) == len(times)
    assert (points.timestamps_ns is None) == timed.found.untimed


@given(
    timestamp=TIMESTAMPS,
    period=st.integers(10**6, 10**10),
    span=st.floats(0.001, 500.0),
    location=st.sampled_from(["timestamp", "zero", "elsewhere"]),
    shift=st.floats(-3.0, 3.0),
    unit=st.sampled_from([1, 10**3, 10**6]),
    coarse=st.booleans(),
    strays=st.lists(st.tuples(st.integers(0, 99), INT64), max_size=4),
)
def test_times_that_were_put_right_are_sound_afterwards(timestamp, period, span, location, shift, unit, coarse, strays):
    start = {"timestamp": timestamp, "zero": 0, "elsewhere": timestamp // 3 + 10**13}[location] + int(shift * period)
    true = [start + int(span * period * k / 99) for k in range(100)]
    scaled = [time // unit if coarse else time * unit for time in true]
    times = [min(max(time, -(2**63)), 2**63 - 1) for time in scaled]
    for k, stray in strays:
        times[k] = stray
    once = timed_frame(sweep(timestamp, times), period)
    if once.frame.points.timestamps_ns is None:
        assert once.found.untimed
        return
    if once.found.strays == 0 and once.verdict is not PointTimes.ABSOLUTE:
        farthest = np.abs(once.frame.points.timestamps_ns.astype(float) - timestamp).max()
        assert farthest <= max(LONGEST_LAG_NS, (MOST_PERIODS + 2) * period) * 1.01
    again = timed_frame(once.frame, period)
    assert again.verdict is PointTimes.ABSOLUTE


@given(
    begin=st.integers(-(2**60), 2**60) | st.integers(-(10**12), 10**12),
    period=st.integers(10**7, 10**9),
    span=st.floats(0.0005, 12.0),
    lags=st.lists(st.floats(-9.0, 9.0), min_size=1, max_size=4),
)
def test_absolute_times_are_believed_however_late_their_timestamps_are(begin, period, span, lags):
    previous = None
    for k, lag in enumerate(lags):
        start = begin + k * period
        times = [start + int(span * period * step / 99) for step in range(100)]
        timestamp = start + int(lag * 1e9)
        timed = timed_frame(sweep(timestamp, times), period, previous=previous)
        previous = timed.raw
        at_the_zero_of_a_clock = min(abs(times[0]), abs(times[-1])) < 3 * period or times[0] < 0 < times[-1]
        assert timed.verdict is PointTimes.ABSOLUTE or at_the_zero_of_a_clock
