"""What is wrong in a manifest is reported with its location, its value and what was expected, all at once."""

import re
import tomllib
from pathlib import Path

import pytest

from sceneloom.errors import DataError
from sceneloom.formats.rig.manifest import RECORDS, Faults, Kind, read_record
from sceneloom.formats.rig.spec import FORMAT

from .conftest import BY_RATE, CAMERA_MODEL, FIELDS, SCALE, TUM

AS_CSV = 'file = "poses.txt"\nform = "csv"'
PAGE = Path(__file__).parents[4] / "docs" / "formats" / "rig.md"


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("times = { pattern", "time = { pattern", r"sensors\[0\] \(top\)\.time: unknown; did you mean 'times'\?"),
        ('ego = "base"', 'egoo = "base"', r"egoo: unknown; did you mean 'ego'\?"),
        ('axes = "flu"', "width = 8", r"sensors\[1\] \(front\)\.width: unknown; did you mean camera_model\.width\?"),
        ('type = "lidar"', 'type = "lidr"', r"sensors\[0\] \(top\)\.type: 'lidr'; expected one of lidar, .*'lidar'\?"),
        ('type = "lidar"\n', "", r"sensors\[0\] \(top\)\.type: missing; expected one of lidar, camera"),
        ('type = "lidar"', 'tipe = "lidar"', r"type: missing; .*; 'tipe' is unknown: is it meant"),
        ("intensity_max = 255", "intensity_max = 0", r"intensity_max: 0; expected a number, above 0"),
        ("intensity_max = 255", 'intensity_max = "1"', r"intensity_max: '1'; expected a number"),
        ("[1.0, 0.0, 2.0]", "[1.0, 0.0]", r"transforms\[0\]\.translation: a list of 2; expected a list of 3 numbers"),
        ("[1.0, 0.0, 2.0]", "[1.0, nan, 2.0]", r"translation: still to be filled in: origin of `from` seen in `to`"),
        ("fx = 6.0", "fx = inf", r"sensors\[1\] \(front\)\.camera_model\.fx: Infinity; expected a number"),
        ("fx = 6.0", "fx = 1e999999999999", r"sensors\[1\] \(front\)\.camera_model\.fx: Infinity"),
        ('from = "top"\n', "", r"transforms\[0\]\.from: missing; expected text in quotes"),
        ('form = "tum"', 'form = "tun"', r"trajectories\[0\]\.form: 'tun'; expected one of tum, kitti, csv; did"),
        ('files = "top/*.bin"', "files = []", r"sensors\[0\] \(top\)\.files: a list of 0; expected text"),
        ('files = "top/*.bin"', "files = [3]", r"sensors\[0\] \(top\)\.files: 3; expected text"),
        ("start_s = 1532402927.65", "start_s = 1e12", r"times\.start_s: 1E\+12; expected seconds"),
        ("[[transforms]]", "[transforms]", r"transforms: a table of 4; expected a list of tables: one `"),
        ('id = "front"', 'id = "top"', r"sensors\[1\] \(top\)\.id: 'top' is also that of sensors\[0\]"),
        ('form = "tum"', 'form = "tum"\nname = "lidar"', "'lidar' stands for a computed trajectory"),
        ('ego = "base"', 'ego = "base"\nroot = "raw"', "root: 'raw': no such folder"),
        (CAMERA_MODEL, "cy = 2.5, width = 8, height = 8 }", "for 8x8, the images are 8x6, another shape"),
        (CAMERA_MODEL, "cy = 2.5, width = 6, height = 8 }", r"for 6x8, the images are 8x6, .* exchanged\?"),
        (CAMERA_MODEL, "cy = 2.5 }\nshutter_roll_s = 33", "shutter_roll_s: 33 s; expected at most 1 s"),
        ('files = "front/*.png"', 'files = "front/*.png"\nvideo = "front.mkv"', "files and video; expected one"),
        ('files = "front/*.png"\n', "", "neither files nor video"),
        ('{ to = "top", ', "{ ", "neither to nor from; expected `to`"),
        (SCALE, "intensity_max = 255\nsweep_s = 100", "sweep_s: 100; expected the duration of a sweep, at most 60 s"),
        (FIELDS, 'fields = ["x:int99"]', "'x:int99'; expected a name, or name:type"),
        (FIELDS, 'dtype = "float64"', "has no effect without `fields`"),
        (FIELDS, 'use = { brightness = "a" }', r"use\.brightness: unknown; expected some of x, y, z"),
        (SCALE, 'use = { ring = "line" }', "no such column for ring; the file has x y z intensity"),
        (FIELDS, 'fields = ["x", "y", "z"]', "64 bytes are 5 points of 12 bytes"),
        (BY_RATE, "times = {}", "none of them; expected exactly one of pattern, csv, lines, rate_hz"),
        (BY_RATE, 'times = { rate_hz = 10, lines = "t.txt" }', "lines, rate_hz; expected exactly one"),
        (BY_RATE, 'times = { pattern = "{index}" }', "expected `rate_hz` beside {index}"),
        (BY_RATE, 'times = { pattern = "{ns}", rate_hz = 10 }', "expected {index} in the pattern beside `rate_hz`"),
        (BY_RATE, "times = { container = true }", "container; expected one of pattern, csv, lines, rate_hz here"),
        (BY_RATE, 'times = { pattern = "a{ns}" }', "'0.png' does not fit the pattern 'a{ns}'"),
        (BY_RATE, 'times = { csv = "none.csv" }', "times.csv: 'none.csv': no such file"),
        (BY_RATE, 'times = { csv = "poses.txt", column = "tim" }', "it has timestamp, .*did you mean 'timestamp'"),
        (BY_RATE, "times = { rate_hz = 1e-12 }", "beyond the year 2261"),
        (BY_RATE, "times = { rate_hz = 10, start_s = 9.1e9 }\ntime_offset_s = 9e9", "are beyond the year 2261"),
        (TUM, 'file = "poses.txt"\nform = "kitti"', "times: missing; a kitti file has no times"),
        (TUM, f'{AS_CSV}\ncolumns = {{ w = "tx" }}', "columns.w: unknown; expected some of time, x"),
        (TUM, f'{AS_CSV}\ncolumns = {{ x = "t_x" }}', "no column 't_x'.*did you mean 'tx'"),
        (TUM, 'file = "poses.txt"\nform = "tum"\nframe = "imu"', "no transforms lead from frame 'imu'"),
    ],
)  # fmt: skip
def test_a_fault_is_reported_with_location_value_and_what_was_expected(refused, old, new, problem):
    refused(problem, (old, new))


def test_all_faults_are_reported_at_once(refused):
    refused(r"2 faults", ('ego = "base"', 'egoo = "base"'), ("rate_hz = 10", "rate_hz = -1"))
    both = r"transforms\[0\](.|\n)*sensors\[1\] \(front\)\.extrinsic"
    refused(both, ("0.0, 1.0]", "0.0, 9.0]"), ("[0.5, 0", "[1e7, 0"))
    refused(
        r"3 faults\n.*trajectories\[0\].file: 'path.txt': no such file.*\n"
        r".*sensors\[0\] \(top\).files: 'tip/\*.bin': no such files.* has the folders front, top\n"
        r".*sensors\[1\] \(front\): no focal length",
        *(("top/*.bin", "tip/*.bin"), ("fx = 6.0,", ""), ('file = "poses.txt"', 'file = "path.txt"')),
    )


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"ego = base\n", r"is no TOML: .*line 1"),
        (b"ego = '\xff'", "byte 7: is no UTF-8 text"),
        (b"a = " + b"[" * 5000, "is no TOML"),
        (b"", "sensors: missing; expected a list of tables: the sensors"),
        (b"sensors = []", "an empty list; expected at least one"),
    ],
)
def test_a_file_that_is_no_manifest_is_reported(folder, content, problem):
    (folder / "rig.toml").write_bytes(content)
    with pytest.raises(DataError, match=problem):
        FORMAT.open(folder)


@pytest.mark.parametrize("record", RECORDS)
def test_every_field_stands_in_the_documentation(record):
    page = PAGE.read_text("utf-8")
    missing = [field.name for field in RECORDS[record] if f"`{field.name}`" not in page]
    missing += [word for field in RECORDS[record] for word in field.choices[:6] if f"`{word}`" not in page]
    assert not missing


def test_manifests_in_the_documentation_are_right():
    blocks = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 3
    for block in blocks:
        faults = Faults(PAGE)
        raw = tomllib.loads(block)
        read_record({"sensors": [], **raw}, "rig", "", faults)
        faults.raise_all()


def test_the_table_of_fields_is_sound():
    for name, fields in RECORDS.items():
        names = [field.name for field in fields]
        assert len(set(names)) == len(names), name
        for field in fields:
            assert field.about
            assert (field.kind is Kind.CHOICE) == bool(field.choices)
            assert (field.kind in {Kind.VECTOR, Kind.MATRIX}) == bool(field.shapes)
            assert (field.kind in {Kind.RECORD, Kind.RECORDS}) == bool(field.record)
