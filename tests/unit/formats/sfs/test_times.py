"""Many times at once become the timestamps that each of them has alone."""

import numpy as np
import pytest

from sceneloom.formats.sfs.clock import INT64_MIN, FileClock, TimeRangeError, chosen_offset_ns


def near_halves(start_ns, span_ns, count=2_000):
    """Times of which many lie on or beside a whole or half microsecond."""
    rng = np.random.default_rng(3)
    whole = rng.integers(0, span_ns // 500, count) * 500
    return start_ns + whole + rng.integers(-1, 2, count).clip(-whole)


@pytest.mark.parametrize("offset_ns", [0, 1_700_000_000_000_000_000, -5_000])
@pytest.mark.parametrize("start_ns", [0, 1_001, 3_000_000_500])
@pytest.mark.parametrize("span_ns", [100_000_000, 4_200_000_000, 60_000_000_000])
@pytest.mark.parametrize("dtype", [np.uint32, np.int64])
def test_timestamps_of_many_are_those_of_each(offset_ns, start_ns, span_ns, dtype):
    clock = FileClock(1_000, offset_ns)
    times_ns = near_halves(offset_ns + start_ns, span_ns)
    timestamps, inexact = clock.timestamp_array(times_ns, dtype=dtype)
    assert timestamps.dtype == dtype
    assert timestamps.tolist() == [clock.timestamp(time) for time in times_ns.tolist()]
    assert inexact == sum((time - offset_ns) % 1_000 != 0 for time in times_ns.tolist())


@pytest.mark.parametrize("dtype", [np.uint32, np.int64])
def test_exact_times_are_counted_as_exact_and_nanoseconds_pass_as_they_are(dtype):
    times_ns, span_ns = 7_000 + 1_000 * np.arange(20_000), (7_000, 7_000 + 19_999_000)
    timestamps, inexact = FileClock(1_000, 7_000).timestamp_array(times_ns, dtype=dtype, span_ns=span_ns)
    np.testing.assert_array_equal(timestamps, np.arange(20_000))
    assert inexact == 0
    timestamps, inexact = FileClock(1, 5).timestamp_array(np.array([5, 2**62], np.int64), dtype=np.uint64)
    assert (timestamps.tolist(), inexact) == ([0, 2**62 - 5], 0)


def test_a_span_beyond_64_bits_is_refused():
    clock = FileClock(1_000, -(2**62))
    with pytest.raises(TimeRangeError):
        clock.timestamp_array(np.array([2**62 + 2**61], np.int64))
    with pytest.raises(TimeRangeError):
        clock.timestamps_of_span(0, 2**62 + 2**61)


@pytest.mark.parametrize("tick_ns", [1, 1_000])
@pytest.mark.parametrize("dtype", [np.uint32, np.int64])
def test_the_earliest_times_of_64_bits_have_timestamps(tick_ns, dtype):
    """Their offset, in whole seconds, lies before every time that 64 bits hold."""
    times_ns = INT64_MIN + np.array([400, 1_307, 1_308, 2_000, 10_000_000], np.int64)
    clock = FileClock(tick_ns, chosen_offset_ns(INT64_MIN))
    timestamps, inexact = clock.timestamp_array(times_ns, dtype=dtype)
    assert timestamps.dtype == dtype
    assert timestamps.tolist() == [clock.timestamp(time) for time in times_ns.tolist()]
    assert inexact == (0 if tick_ns == 1 else 5)
    np.testing.assert_allclose(clock.absolute_array(timestamps) - INT64_MIN, times_ns - INT64_MIN, atol=tick_ns // 2)
