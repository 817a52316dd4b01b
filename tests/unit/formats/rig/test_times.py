"""When files were recorded: by their names, by a list, or evenly."""

import numpy as np
import pytest

from sceneloom.errors import DataError

from .conftest import START_NS

BY_RATE = "times = { rate_hz = 10, start_s = 1532402927.65 }"
BY_NAME = 'times = { pattern = "{ns}" }'


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
    assert "files-sorted" in [warning.code for warning in scene.warnings]


def test_a_csv_without_file_names_goes_in_parallel(opened, folder):
    (folder / "t.csv").write_text("# a comment\nTimestamp\n0.5\n0.75\n1\n")
    assert image_times(opened((BY_RATE, 'times = { csv = "t.csv" }'))) == [
        500_000_000,
        750_000_000,
        1_000_000_000,
    ]


def test_rows_without_file_are_faults_and_files_without_row_are_left_out(opened, folder):
    (folder / "t.csv").write_text("time,file\n1,0.png\n2,9.png\n")
    pair = (BY_RATE, 'times = { csv = "t.csv" }')
    with pytest.raises(DataError, match=r"t\.csv: line 3: '9.png' is none of the sensor's files"):
        opened(pair)
    scene = opened(pair, lenient=True)
    assert image_times(scene) == [1_000_000_000]
    assert {"rows-without-file", "files-without-time"} <= {warning.code for warning in scene.warnings}


def test_lines_hold_dates_as_kitti_has_them(opened, folder):
    lines = ["2018-07-24 03:28:47.700000001", "2018-07-24 03:28:47.8", "2018-07-24 03:28:47.900000000"]
    (folder / "front" / "timestamps.txt").write_text("\r\n".join(lines) + "\r\n")
    scene = opened((BY_RATE, 'times = { lines = "front/timestamps.txt" }'))
    assert image_times(scene)[:2] == [1_532_402_927_700_000_001, 1_532_402_927_800_000_000]


def test_counts_that_disagree_are_reported_with_both(opened, folder):
    (folder / "t.txt").write_text("1\n2\n")
    pair = (BY_RATE, 'times = { lines = "t.txt" }')
    with pytest.raises(DataError, match=r"t\.txt: 2 times for 3 files"):
        opened(pair)
    assert image_times(opened(pair, lenient=True)) == [1_000_000_000, 2_000_000_000]


def test_a_line_that_is_no_time_is_reported_with_its_number(opened, folder):
    (folder / "t.txt").write_text("1\n2\nthree\n")
    with pytest.raises(DataError, match=r"t\.txt: line 3: 'three'; expected a number, or a date"):
        opened((BY_RATE, 'times = { lines = "t.txt" }'))


def test_two_files_of_one_time_are_refused(opened, folder):
    (folder / "t.txt").write_text("1\n2\n2.0\n")
    pair = (BY_RATE, 'times = { lines = "t.txt" }')
    with pytest.raises(DataError, match=r"'front/1.png' and 'front/2.png' have the same time"):
        opened(pair)
    assert first_reds(opened(pair, lenient=True)) == [0, 10]


def test_times_that_run_backwards_are_sorted_with_a_warning(opened, folder):
    (folder / "t.txt").write_text("3\n1\n2\n")
    scene = opened((BY_RATE, 'times = { lines = "t.txt" }'))
    assert first_reds(scene) == [10, 20, 0]
    assert ("files-sorted", 1) in [(n.code, n.count) for n in scene.warnings]


def test_an_offset_is_added_exactly(opened):
    scene = opened((BY_NAME, BY_NAME + "\ntime_offset_s = -0.000000001"))
    assert scene.lidars[0].frames.timestamps_ns[0] == START_NS - 1


@pytest.mark.parametrize(
    ("times", "problem"),
    [
        ("{}", "none of them; expected exactly one of pattern, csv, lines, rate_hz"),
        ('{ rate_hz = 10, lines = "t.txt" }', "lines, rate_hz; expected exactly one"),
        ('{ pattern = "{index}" }', "expected `rate_hz` beside {index}"),
        ('{ pattern = "{ns}", rate_hz = 10 }', "expected {index} in the pattern beside `rate_hz`"),
        ("{ container = true }", "container; expected one of pattern, csv, lines, rate_hz here"),
        ('{ pattern = "a{ns}" }', "'0.png' does not fit the pattern 'a{ns}'"),
        ('{ csv = "none.csv" }', r"times.csv: 'none.csv': no such file"),
        (
            '{ csv = "poses.txt", column = "tim" }',
            r"no column 'tim'; it has timestamp, .*did you mean 'timestamp'",
        ),
        ("{ rate_hz = 1e-12 }", "beyond the year 2261"),
        ("{ rate_hz = 10, start_s = 9.1e9 }\ntime_offset_s = 9e9", "are beyond the year 2261"),
    ],
)
def test_times_that_state_too_much_or_too_little_are_reported(opened, times, problem):
    with pytest.raises(DataError, match=problem):
        opened((BY_RATE, f"times = {times}"))


def test_large_timestamps_never_pass_through_floating_point(opened, folder):
    for k, path in enumerate(sorted((folder / "top").iterdir())):
        path.rename(folder / "top" / f"{2**62 + k}.bin")
    found = opened().lidars[0].frames.timestamps_ns
    np.testing.assert_array_equal(found, np.array([2**62, 2**62 + 1, 2**62 + 2]))
