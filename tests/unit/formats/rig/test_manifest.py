"""What is wrong in a manifest is reported with its location, its value and what was expected, all at once."""

import re
import tomllib
from pathlib import Path

import pytest

from sceneloom.errors import DataError
from sceneloom.formats.rig.manifest import RECORDS, Faults, Kind, read_record

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
    ],
)  # fmt: skip
def test_a_fault_is_reported_with_location_value_and_what_was_expected(opened, old, new, problem):
    with pytest.raises(DataError, match=problem):
        opened((old, new))
    with pytest.raises(DataError, match=r"[23] faults"):
        opened((old, new), ("rate_hz = 10", "rate_hz = -1"))


def test_a_file_that_is_no_toml_is_reported_with_its_line(folder, opened):
    (folder / "rig.toml").write_text("ego = base\n")
    from sceneloom.formats.rig.spec import FORMAT

    with pytest.raises(DataError, match=r"is no TOML: .*line 1"):
        FORMAT.open(folder)
    (folder / "rig.toml").write_bytes(b"ego = '\xff'")
    with pytest.raises(DataError, match="byte 7: is no UTF-8 text"):
        FORMAT.open(folder)
    (folder / "rig.toml").write_text("a = " + "[" * 5000)
    with pytest.raises(DataError, match="is no TOML"):
        FORMAT.open(folder)


def test_an_empty_manifest_says_what_is_missing(folder):
    from sceneloom.formats.rig.spec import FORMAT

    (folder / "rig.toml").write_text("")
    with pytest.raises(DataError, match="sensors: missing; expected a list of tables: the sensors"):
        FORMAT.open(folder)
    (folder / "rig.toml").write_text("sensors = []")
    with pytest.raises(DataError, match="an empty list; expected at least one"):
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
