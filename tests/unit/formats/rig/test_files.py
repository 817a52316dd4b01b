"""The files of a rig: found below one folder, and their times by names, by a list, or evenly, to the nanosecond."""

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp
from sceneloom.formats.rig.reader import NamePattern

from .conftest import BY_NAME, BY_RATE, LIDAR_FILES, codes

OUTSIDE = "expected a path below .*; name another folder with `root`"
LOCATED = r"sensors\[0\] \(top\)\.files: "
LINES = (BY_RATE, 'times = { lines = "t.txt" }')
CSV = (BY_RATE, 'times = { csv = "t.csv" }')


@pytest.mark.parametrize(
    ("pattern", "problem"),
    [
        *((pattern, OUTSIDE) for pattern in ("'../top/*.bin'", "'/top/*.bin'", "'top/../../x/*.bin'")),
        *((pattern, OUTSIDE) for pattern in ("'C:/top/*.bin'", r"'\\host\top\*.bin'")),
        *((pattern, LOCATED) for pattern in ("'a**b/*.bin'", "'['", "'nowhere/*.bin'", "'.'")),
        ("'top/*.pcd'", LOCATED + r"'top/\*\.pcd': no such files in .*; top has \*\.bin"),
        ("'top\\*.bin'", "and the folders front, top; folders are separated by /"),
        ('"top[1]/*.bin"', r"and the folders front, top; \[ \] stand for a choice of characters: write \[\[\]"),
        ('"*.bin"', r"has \*\.toml, \*\.txt and the folders front, top$"),
        ('"top/*.bin"\nroot = "bare"', "bare has no folders"),
    ],
)
def test_patterns_without_files_are_refused_and_what_there_is_instead_is_reported(refused, folder, pattern, problem):
    if "bare" in pattern:
        (folder / "bare").mkdir()
    refused(problem, (LIDAR_FILES, f"files = {pattern}"))


def test_links_that_lead_out_are_refused_and_a_root_is_named_in_their_location(
    refused, opened, folder, tmp_path_factory
):
    elsewhere = tmp_path_factory.mktemp("disk")
    for name in ("poses.txt", "top"):
        (folder / name).rename(elsewhere / name)
        (folder / name).symlink_to(elsewhere / name)
        refused(f"{name}.*leads out of .* by a link, to .*; name the folder .* as `root`")
        if name == "poses.txt":
            (folder / name).unlink()
            (elsewhere / name).rename(folder / name)
    scene = opened((LIDAR_FILES, f'{LIDAR_FILES}\nroot = "{elsewhere}"'))
    assert (len(scene.lidars[0].frames), codes(scene)) == (3, ["root-elsewhere"])


def test_links_inside_the_folder_are_followed_and_all_files_may_lie_below_another_root_and_are_taken_once(
    opened, folder
):
    (folder / "top").rename(folder / "kept")
    (folder / "top").symlink_to(folder / "kept")
    assert len(opened().lidars[0].frames) == 3
    (folder / "top").unlink()
    (folder / "raw").mkdir()
    for name, new in (("kept", "top"), ("front", "front"), ("poses.txt", "poses.txt")):
        (folder / name).rename(folder / "raw" / new)
    scene = opened(('ego = "base"', 'ego = "base"\nroot = "raw"'), (LIDAR_FILES, 'files = ["top/*.bin", "**/*0.bin"]'))
    assert (len(scene.sensors), len(scene.lidars[0].frames), scene.warnings) == (2, 3, ())


def image_times(scene):
    return scene.cameras[0].images.timestamps_ns.tolist()


def first_reds(scene):
    return [int(image.rgb[0, 0, 0]) for image in scene.cameras[0].images]


def test_numbers_in_names_count_as_people_count_offsets_are_exact_and_a_rate_does_not_add_up_its_rounding(
    opened, folder
):
    for k, path in enumerate(sorted((folder / "top").iterdir())):
        path.rename(folder / "top" / f"{2**62 + k}.bin")
    found = opened((BY_NAME, BY_NAME + "\ntime_offset_s = -0.000000001")).lidars[0].frames.timestamps_ns
    assert found.tolist() == [2**62 - 1, 2**62, 2**62 + 1]
    (folder / "front" / "1.png").rename(folder / "front" / "10.png")
    assert first_reds(opened()) == [0, 20, 10]
    scene = opened((BY_RATE, 'times = { pattern = "{index}", rate_hz = 10, start_s = 5 }'))
    assert image_times(scene) == [5_000_000_000, 5_200_000_000, 6_000_000_000]
    for k in range(3, 1001):
        (folder / "front" / f"{k}.png").write_bytes((folder / "front" / "0.png").read_bytes())
    times = image_times(opened((BY_RATE, "times = { rate_hz = 30 }")))
    assert (times[1], times[999]) == (33_333_333, 33_300_000_000)


@pytest.mark.parametrize(
    ("name", "text", "times", "expected_ns", "reds", "code"),
    [
        ("t.csv", "timestamp_us;image\n300;front/2.png\n100;0\n200;1.png\n",
         'csv = "t.csv", column = "timestamp_us"', [100_000, 200_000, 300_000], [0, 10, 20], "files-sorted"),
        ("t.csv", "# a comment\nTimestamp\n0.5\n0.75\n1\n",
         'csv = "t.csv"', [500_000_000, 750_000_000, 1_000_000_000], [0, 10, 20], None),
        ("front/t.txt", "2018-07-24 03:28:47.700000001\r\n2018-07-24 03:28:47.8\r\n2018-07-24 03:28:47.900000000\r\n",
         'lines = "front/t.txt"', [1_532_402_927_700_000_001, 1_532_402_927_800_000_000, 1_532_402_927_900_000_000],
         [0, 10, 20], None),
        ("t.txt", "3\n1\n2\n", 'lines = "t.txt"', [1_000_000_000, 2_000_000_000, 3_000_000_000], [10, 20, 0],
         "files-sorted"),
    ],
)  # fmt: skip
def test_lists_give_times_by_file_name_or_in_parallel(opened, folder, name, text, times, expected_ns, reds, code):
    (folder / name).write_bytes(text.encode())
    scene = opened((BY_RATE, f"times = {{ {times} }}"))
    assert (image_times(scene), first_reds(scene)) == (expected_ns, reds)
    assert (code in codes(scene)) if code else ("files-sorted" not in codes(scene))
    assert [warning.count for warning in scene.warnings if warning.code == "files-sorted"] in ([], [1], [2])


@pytest.mark.parametrize(
    ("name", "text", "change", "problem", "kept_ns", "expected_codes"),
    [
        ("t.csv", "time,file\n1,0.png\n2,9.png\n", CSV, r"t\.csv: line 3: '9.png' is none of the sensor's files",
         [1_000_000_000], {"rows-without-file", "files-without-time"}),
        ("t.txt", "1\n2\n", LINES, r"t\.txt: 2 times for 3 files",
         [1_000_000_000, 2_000_000_000], {"counts-disagree"}),
        ("t.txt", "1\n2\n2.0\n", LINES, r"'front/1.png' and 'front/2.png' have the same time",
         [1_000_000_000, 2_000_000_000], {"repeated-times"}),
        ("t.txt", "1\n2\nthree\n", LINES, r"t\.txt: line 3: 'three'; expected a number, or a date", None, None),
    ],
)  # fmt: skip
def test_times_that_do_not_fit_the_files_are_refused_and_left_out_by_a_lenient_reading(
    refused, opened, folder, name, text, change, problem, kept_ns, expected_codes
):
    (folder / name).write_text(text)
    refused(problem, change)
    if kept_ns is not None:
        scene = opened(change, lenient=True)
        assert (image_times(scene), first_reds(scene)) == (kept_ns, [0, 10][: len(kept_ns)])
        assert expected_codes <= set(codes(scene))


@pytest.mark.parametrize(
    ("text", "unit", "expected"),
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
        *((text, None, ".") for text in ("", "x", "nan", "inf", "1_000", "1e400", "2011-13-26 13:02:25", "12:30")),
        *((text, None, "expected a date") for text in ("0001-01-01 00:00:00+14:00", "9999-12-31 23:59:59-14:00")),
        ("1532402927647951001", None, 'is `unit = "nanoseconds"` meant'),
        ("1532402927647951", "seconds", 'is `unit = "microseconds"` meant'),
    ],
)
def test_numbers_and_dates_become_nanoseconds_and_what_is_no_time_is_refused_with_the_unit_that_is_meant(
    text, unit, expected
):
    if isinstance(expected, int):
        assert parse_timestamp(text, unit) == expected
    else:
        with pytest.raises(TimestampError, match=expected):
            parse_timestamp(text, unit)


@given(st.integers(-8_000_000_000_000_000, 8_000_000_000_000_000))
def test_dates_agree_with_the_standard_library(microseconds):
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=microseconds)
    assert parse_timestamp(moment.isoformat(" ", "microseconds"), None) == microseconds * 1000


FITS_NOT = "does not fit the pattern"


@pytest.mark.parametrize(
    ("pattern", "name", "expected"),
    [
        ("{ns}", "1532402927647951001.pcd", 1_532_402_927_647_951_001),
        ("{ns}.pcd", "1532402927647951001.pcd", 1_532_402_927_647_951_001),
        ("{s}", "12.5.png", 12_500_000_000),
        ("{s}_{ns}", "12_000000005.bin", 12_000_000_005),
        ("{s}.{ms}", "12.250.bin", 12_250_000_000),
        ("*__{us}", "n015-2018-07-24-11-22-45+0800__CAM_FRONT__1532402927612460.jpg", 1_532_402_927_612_460_000),
        ("*{us}", "n015-2018-07-24__LIDAR_TOP__1532402927647951.pcd.bin", 1_532_402_927_647_951_000),
        ("frame*-{ms}-rect", "frame0012-1500-rect.png", 1_500_000_000),
        ("frame_{index}", "frame_000012.png", 12),
        *((pattern, "x", "expected some of") for pattern in ("", "x", "{}", "{seconds}", "{ns}{ns}", "{index}_{ns}")),
        *(("{ns}", name, FITS_NOT) for name in ("a12.png", "12a.png", ".png", "١٢.png")),
        ("{s}_{ns}", f"9000000000_{9 * 10**18}.bin", "beyond the year 2261"),
        ("{ms}", "1700000000000000000.pcd", r"milliseconds; expected a time near ours; is `\{ns\}` meant"),
    ],
)
def test_names_give_their_times_or_their_index_and_those_that_do_not_fit_are_refused(pattern, name, expected):
    if isinstance(expected, int):
        found = NamePattern(pattern)
        assert (found.read(name), found.indexed) == (expected, "index" in pattern)
    else:
        with pytest.raises(TimestampError, match=expected):
            NamePattern(pattern).read(name)
