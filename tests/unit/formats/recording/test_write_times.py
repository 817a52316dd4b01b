"""Times are written as the shortest decimal seconds that mean them, or as the numbers that they came from."""

from decimal import Decimal

import numpy as np
import pytest

from sceneloom.formats.base.text_tables import TimeWriter, means, seconds_text
from sceneloom.formats.recording.write_lines import writing_order


@pytest.mark.parametrize(
    ("timestamp_ns", "text"),
    [
        (0, "0.0"),
        (1, "0.000000001"),
        (-1, "-0.000000001"),
        (100_000_000, "0.1"),
        (-1_500_000_000, "-1.5"),
        (1_444_770_263, "1.444770263"),
        (1_700_000_000_123_456_789, "1700000000.123456789"),
        (7_000_000_000, "7.0"),
    ],
)
def test_a_time_is_written_with_as_many_digits_as_it_has(timestamp_ns, text):
    assert seconds_text(timestamp_ns) == text
    assert Decimal(text) * 10**9 == timestamp_ns


@pytest.mark.parametrize("seconds", [1.444770263671875, 0.1 + 0.2, 1e-7, -3.25, 1700000000.1234567, 5.0])
def test_the_number_that_a_time_came_from_is_written_back(seconds):
    timestamp_ns = round(seconds * 1e9)
    assert float(seconds_text(timestamp_ns, seconds)) == seconds


@pytest.mark.parametrize("seconds", [1.5, float("nan"), float("inf")])
def test_a_number_that_no_longer_means_the_time_is_not_written(seconds):
    assert not means(seconds, 2_000_000_000)
    assert seconds_text(2_000_000_000, seconds) == "2.0"


def test_times_that_a_64_bit_number_cannot_hold_are_counted():
    times = TimeWriter()
    assert times.text(123_456_789) == "0.123456789"
    assert times.inexact == 0
    assert times.text(1_700_000_000_123_456_789) == "1700000000.123456789"
    assert times.inexact == 1
    # neighbouring numbers near 1.7e9 are 2^-22 s apart
    assert 0 < times.worst_ns <= 2**-22 / 2 * 1e9 + 128


def test_samples_of_one_nanosecond_are_written_in_the_order_of_their_numbers():
    timestamps = np.array([5, 1, 1, 1], np.int64)
    seconds = np.array([5e-9, 1.4e-9, 0.6e-9, 1e-9])
    assert writing_order(timestamps, seconds).tolist() == [2, 3, 1, 0]
    assert writing_order(timestamps, None).tolist() == [1, 2, 3, 0]
