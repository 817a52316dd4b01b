"""Timestamps of seconds and nanoseconds."""

import pytest

from sceneloom.db34t import Timestamp
from sceneloom.errors import DataError

EXAMPLE = Timestamp(1595682678, 715705367)


def test_the_example_of_the_tables_keeps_every_nanosecond():
    assert EXAMPLE.nanoseconds == 1595682678715705367
    assert str(EXAMPLE) == "1595682678.715705367"
    assert Timestamp.of(1595682678715705367) == EXAMPLE
    assert Timestamp.parse("1595682678.715705367") == EXAMPLE


def test_leading_zeros_of_the_nanoseconds_are_written():
    assert str(Timestamp(7, 5)) == "7.000000005"


def test_times_are_ordered():
    assert Timestamp(1, 999999999) < Timestamp(2, 0) < Timestamp(2, 1)


@pytest.mark.parametrize(
    ("s", "ns"), [(0, 10**9), (-1, 0), (2**32, 0), (0, -1), (1.5, 0), (0, "5"), (True, 0)]
)
def test_numbers_out_of_range_are_refused(s, ns):
    with pytest.raises(DataError, match="expected"):
        Timestamp(s, ns)


@pytest.mark.parametrize("timestamp_ns", [-1, 2**32 * 10**9, 1.5])
def test_times_that_no_timestamp_can_state_are_refused(timestamp_ns):
    with pytest.raises(DataError, match="expected 0 to"):
        Timestamp.of(timestamp_ns)


def test_the_latest_time_fits():
    assert Timestamp.of(2**32 * 10**9 - 1) == Timestamp(2**32 - 1, 10**9 - 1)


@pytest.mark.parametrize(
    "text",
    ["1.5", "1595682678", "1.0000000001", " 1.000000000", "-1.000000000", "٣.000000000", 1595682678.7, None],
)
def test_a_text_that_could_be_read_two_ways_is_refused(text):
    with pytest.raises(DataError, match="expected"):
        Timestamp.parse(text)


def test_seconds_beyond_32_bits_are_refused_in_a_text():
    with pytest.raises(DataError, match="expected a uint32"):
        Timestamp.parse("4294967296.000000000")
