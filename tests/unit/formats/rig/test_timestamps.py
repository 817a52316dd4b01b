"""Times written as text keep every nanosecond."""

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp
from sceneloom.formats.rig.reader import NamePattern


@pytest.mark.parametrize(
    ("text", "unit", "timestamp_ns"),
    [
        ("1532402927.647951001", None, 1_532_402_927_647_951_001),
        ("1532402927647951001", "nanoseconds", 1_532_402_927_647_951_001),
        ("1532402927647951", "microseconds", 1_532_402_927_647_951_000),
        ("1532402927647.951", "milliseconds", 1_532_402_927_647_951_000),
        ("-0.5", "seconds", -500_000_000),
        ("1.5e9", "seconds", 1_500_000_000_000_000_000),
        ("0.0000000005", "seconds", 0),
        ("2011-09-26 13:02:25.594360375", None, 1_317_042_145_594_360_375),
        ("2011-09-26T15:02:25,594360375+02:00", None, 1_317_042_145_594_360_375),
        ("2011-09-26T13:02:25Z", "seconds", 1_317_042_145_000_000_000),
        (' "12.25" ', None, 12_250_000_000),
    ],
)
def test_numbers_and_dates_become_nanoseconds(text, unit, timestamp_ns):
    assert parse_timestamp(text, unit) == timestamp_ns


@given(st.integers(-8_000_000_000_000_000, 8_000_000_000_000_000))
def test_dates_agree_with_the_standard_library(microseconds):
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)
    assert parse_timestamp(moment.isoformat(" ", "microseconds"), None) == microseconds * 1000


@pytest.mark.parametrize("text", ["", "x", "nan", "inf", "1_000", "1e400", "2011-13-26 13:02:25", "12:30"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(TimestampError):
        parse_timestamp(text, None)


def test_a_number_of_another_unit_is_refused_and_the_unit_is_named():
    with pytest.raises(TimestampError, match='is `unit = "nanoseconds"` meant'):
        parse_timestamp("1532402927647951001", None)
    with pytest.raises(TimestampError, match='is `unit = "microseconds"` meant'):
        parse_timestamp("1532402927647951", "seconds")


@pytest.mark.parametrize(
    ("pattern", "name", "timestamp_ns"),
    [
        ("{ns}", "1532402927647951001.pcd", 1_532_402_927_647_951_001),
        ("{ns}.pcd", "1532402927647951001.pcd", 1_532_402_927_647_951_001),
        ("{s}", "12.5.png", 12_500_000_000),
        ("{s}_{ns}", "12_000000005.bin", 12_000_000_005),
        ("{s}.{ms}", "12.250.bin", 12_250_000_000),
        ("*__{us}", "n015-2018-07-24-11-22-45+0800__CAM_FRONT__1532402927612460.jpg", 1_532_402_927_612_460_000),
        ("*{us}", "n015-2018-07-24__LIDAR_TOP__1532402927647951.pcd.bin", 1_532_402_927_647_951_000),
        ("frame*-{ms}-rect", "frame0012-1500-rect.png", 1_500_000_000),
    ],
)  # fmt: skip
def test_names_give_their_times(pattern, name, timestamp_ns):
    assert NamePattern(pattern).read(name) == timestamp_ns


def test_an_index_is_read_as_a_number():
    pattern = NamePattern("frame_{index}")
    assert pattern.indexed
    assert pattern.read("frame_000012.png") == 12


@pytest.mark.parametrize("pattern", ["", "x", "{}", "{seconds}", "{ns}{ns}", "{index}_{ns}"])
def test_patterns_without_sense_are_refused(pattern):
    with pytest.raises(TimestampError, match="expected some of"):
        NamePattern(pattern)


def test_times_that_add_up_beyond_all_bounds_are_refused():
    with pytest.raises(TimestampError, match="beyond the year 2261"):
        NamePattern("{s}_{ns}").read(f"9000000000_{9 * 10**18}.bin")


@pytest.mark.parametrize("name", ["a12.png", "12a.png", ".png", "١٢.png"])
def test_names_that_do_not_fit_are_refused(name):
    with pytest.raises(TimestampError, match="does not fit the pattern"):
        NamePattern("{ns}").read(name)


def test_a_name_of_another_unit_is_refused_and_the_placeholder_is_named():
    with pytest.raises(TimestampError, match=r"milliseconds; expected a time near ours; is `\{ns\}` meant"):
        NamePattern("{ms}").read("1700000000000000000.pcd")


@pytest.mark.parametrize("text", ["0001-01-01 00:00:00+14:00", "9999-12-31 23:59:59-14:00"])
def test_dates_at_the_ends_of_the_calendar_are_refused(text):
    with pytest.raises(TimestampError, match="expected a date"):
        parse_timestamp(text, None)
