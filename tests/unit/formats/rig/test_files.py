"""The files of a rig: found below one folder, and their times by names, by a list, or evenly, to the nanosecond."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.errors import DataError
from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp
from sceneloom.formats.rig.reader import NamePattern

from .conftest import BY_NAME, BY_RATE, LIDAR_FILES, START_NS, codes


@pytest.mark.parametrize(
    "pattern", ["../top/*.bin", "/top/*.bin", "top/../../x/*.bin", "C:/top/*.bin", r"\\\\host\\top\\*.bin"]
)
def test_patterns_that_lead_out_are_refused(refused, pattern):
    refused(r"expected a path below .*; name another folder with `root`", (LIDAR_FILES, f'files = "{pattern}"'))


@pytest.mark.parametrize("pattern", ["a**b/*.bin", "[", "top/*.pcd", "nowhere/*.bin", "."])
def test_patterns_without_files_or_sense_are_reported(refused, pattern):
    refused(r"sensors\[0\] \(top\)\.files: ", (LIDAR_FILES, f'files = "{pattern}"'))


def test_what_there_is_instead_of_a_missing_file_is_reported(refused):
    refused(r"'top/\*\.pcd': no such files in .*; top has \*\.bin", (LIDAR_FILES, 'files = "top/*.pcd"'))


def test_links_that_lead_out_are_refused_and_a_root_is_named_in_their_location(
    refused, opened, folder, tmp_path_factory
):
    elsewhere = tmp_path_factory.mktemp("disk")
    (folder / "top").rename(elsewhere / "top")
    (folder / "top").symlink_to(elsewhere / "top")
    refused(r"leads out of .* by a link, to .*; name the folder .* as `root`")
    scene = opened((LIDAR_FILES, f'{LIDAR_FILES}\nroot = "{elsewhere}"'))
    assert len(scene.lidars[0].frames) == 3
    assert codes(scene) == ["root-elsewhere"]


def test_a_single_file_may_not_be_a_link_that_leads_out(refused, folder, tmp_path_factory):
    outside = tmp_path_factory.mktemp("disk") / "poses.txt"
    (folder / "poses.txt").rename(outside)
    (folder / "poses.txt").symlink_to(outside)
    refused("'poses.txt' leads out of")


def test_links_inside_the_folder_are_followed(opened, folder):
    (folder / "top").rename(folder / "kept")
    (folder / "top").symlink_to(folder / "kept")
    assert len(opened().lidars[0].frames) == 3


def test_all_files_may_lie_below_another_root(opened, folder):
    (folder / "raw").mkdir()
    for name in ("top", "front", "poses.txt"):
        (folder / name).rename(folder / "raw" / name)
    scene = opened(('ego = "base"', 'ego = "base"\nroot = "raw"'))
    assert len(scene.sensors) == 2
    assert scene.warnings == ()


def test_files_of_several_patterns_are_each_taken_once(opened):
    assert len(opened((LIDAR_FILES, 'files = ["top/*.bin", "**/*0.bin"]')).lidars[0].frames) == 3


@pytest.mark.parametrize(
    ("pattern", "reported"),
    [
        ("'top\\*.bin'", "and the folders front, top; folders are separated by /"),
        ('"top[1]/*.bin"', r"and the folders front, top; \[ \] stand for a choice of characters: write \[\[\]"),
        ('"*.bin"', r"has \*\.toml, \*\.txt and the folders front, top$"),
    ],
)
def test_what_kept_a_pattern_from_fitting_is_reported(opened, pattern, reported):
    with pytest.raises(DataError, match=reported):
        opened(('"top/*.bin"', pattern))


def test_a_folder_without_folders_is_stated_to_have_none(refused, folder):
    (folder / "bare").mkdir()
    refused("bare has no folders", ('files = "top/*.bin"', 'files = "top/*.bin"\nroot = "bare"'))


def image_times(scene):
    return scene.cameras[0].images.timestamps_ns.tolist()


def first_reds(scene):
    return [int(image.rgb[0, 0, 0]) for image in scene.cameras[0].images]


def test_a_rate_does_not_add_up_its_rounding(opened, folder):
    for k in range(3, 1000):
        (folder / "front" / f"{k}.png").write_bytes((folder / "front" / "0.png").read_bytes())
    scene = opened((BY_RATE, "times = { rate_hz = 30 }"))
    assert image_times(scene)[999] == 33_300_000_000
    assert image_times(scene)[1] == 33_333_333


def test_indices_in_names_count_from_the_start(opened, folder):
    (folder / "front" / "2.png").rename(folder / "front" / "7.png")
    scene = opened((BY_RATE, 'times = { pattern = "{index}", rate_hz = 10, start_s = 5 }'))
    assert image_times(scene) == [5_000_000_000, 5_100_000_000, 5_700_000_000]


def test_files_are_counted_as_people_count(opened, folder):
    (folder / "front" / "1.png").rename(folder / "front" / "10.png")
    assert first_reds(opened()) == [0, 20, 10]


def test_a_csv_with_file_names_may_have_any_order(opened, folder):
    (folder / "t.csv").write_text("timestamp_us;image\n300;front/2.png\n100;0\n200;1.png\n")
    scene = opened((BY_RATE, 'times = { csv = "t.csv", column = "timestamp_us" }'))
    assert image_times(scene) == [100_000, 200_000, 300_000]
    assert first_reds(scene) == [0, 10, 20]
    assert "files-sorted" in codes(scene)


def test_a_csv_without_file_names_goes_in_parallel(opened, folder):
    (folder / "t.csv").write_text("# a comment\nTimestamp\n0.5\n0.75\n1\n")
    assert image_times(opened((BY_RATE, 'times = { csv = "t.csv" }'))) == [500_000_000, 750_000_000, 1_000_000_000]


def test_rows_without_file_are_faults_and_files_without_row_are_left_out(refused, opened, folder):
    (folder / "t.csv").write_text("time,file\n1,0.png\n2,9.png\n")
    pair = (BY_RATE, 'times = { csv = "t.csv" }')
    refused(r"t\.csv: line 3: '9.png' is none of the sensor's files", pair)
    scene = opened(pair, lenient=True)
    assert image_times(scene) == [1_000_000_000]
    assert {"rows-without-file", "files-without-time"} <= set(codes(scene))


def test_lines_hold_dates_as_kitti_has_them(opened, folder):
    lines = ["2018-07-24 03:28:47.700000001", "2018-07-24 03:28:47.8", "2018-07-24 03:28:47.900000000"]
    (folder / "front" / "timestamps.txt").write_text("\r\n".join(lines) + "\r\n")
    scene = opened((BY_RATE, 'times = { lines = "front/timestamps.txt" }'))
    assert image_times(scene)[:2] == [1_532_402_927_700_000_001, 1_532_402_927_800_000_000]


def test_counts_that_disagree_are_reported_with_both(refused, opened, folder):
    (folder / "t.txt").write_text("1\n2\n")
    pair = (BY_RATE, 'times = { lines = "t.txt" }')
    refused(r"t\.txt: 2 times for 3 files", pair)
    assert image_times(opened(pair, lenient=True)) == [1_000_000_000, 2_000_000_000]


def test_a_line_that_is_no_time_is_reported_with_its_number(refused, folder):
    (folder / "t.txt").write_text("1\n2\nthree\n")
    refused(r"t\.txt: line 3: 'three'; expected a number, or a date", (BY_RATE, 'times = { lines = "t.txt" }'))


def test_two_files_of_one_time_are_refused(refused, opened, folder):
    (folder / "t.txt").write_text("1\n2\n2.0\n")
    pair = (BY_RATE, 'times = { lines = "t.txt" }')
    refused(r"'front/1.png' and 'front/2.png' have the same time", pair)
    assert first_reds(opened(pair, lenient=True)) == [0, 10]


def test_times_that_run_backwards_are_sorted_with_a_warning(opened, folder):
    (folder / "t.txt").write_text("3\n1\n2\n")
    scene = opened((BY_RATE, 'times = { lines = "t.txt" }'))
    assert first_reds(scene) == [10, 20, 0]
    assert ("files-sorted", 1) in [(n.code, n.count) for n in scene.warnings]


def test_an_offset_is_added_exactly(opened):
    scene = opened((BY_NAME, BY_NAME + "\ntime_offset_s = -0.000000001"))
    assert scene.lidars[0].frames.timestamps_ns[0] == START_NS - 1


def test_large_timestamps_never_pass_through_floating_point(opened, folder):
    for k, path in enumerate(sorted((folder / "top").iterdir())):
        path.rename(folder / "top" / f"{2**62 + k}.bin")
    found = opened().lidars[0].frames.timestamps_ns
    np.testing.assert_array_equal(found, np.array([2**62, 2**62 + 1, 2**62 + 2]))


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
