"""Manifests: all faults are reported with location, value and what was expected; and manifests to begin with."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.rig.reader import RECORDS, Faults, Kind, read_record
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.formats.rig.template import TEMPLATE, quoted, survey, template_text, write_template

from .conftest import BY_RATE, CAMERA_MODEL, FIELDS, MANIFEST, SCALE, START_NS, TUM

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


def test_the_table_of_fields_is_sound_each_stands_in_the_documentation_and_manifests_there_are_right():
    page = PAGE.read_text("utf-8")
    for name, fields in RECORDS.items():
        assert len({field.name for field in fields}) == len(fields), name
        for field in fields:
            assert [word for word in (field.name, *field.choices[:6]) if f"`{word}`" not in page] == [], name
            assert field.about
            assert (field.kind is Kind.CHOICE) == bool(field.choices)
            assert (field.kind in {Kind.VECTOR, Kind.MATRIX}) == bool(field.shapes)
            assert (field.kind in {Kind.RECORD, Kind.RECORDS}) == bool(field.record)
    blocks = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) >= 3
    for block in blocks:
        faults = Faults(PAGE)
        read_record({"sensors": [], **tomllib.loads(block)}, "rig", "", faults)
        faults.raise_all()


PCD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nDATA binary\n" + np.ones(3, "<f4").tobytes()


def filled(text: str) -> str:
    """Fill in what a template leaves open, as a person would."""
    text = text.replace("quaternion_xyzw = [nan, nan, nan, nan]", "quaternion_xyzw = [0, 0, 0, 1]")
    rows = iter(["[0, 0, 1, 0.5]", "[-1, 0, 0, 0]", "[0, -1, 0, 0]"])
    text = re.sub(r"(?m)^    \[nan, nan, nan, nan\]", lambda _: f"    {next(rows)}", text)
    text = re.sub(r"(fx|fy) = nan", r"\1 = 60.0", text)
    return text.replace("rate_hz = nan", "rate_hz = 10").replace("nan", "0.0")


@pytest.fixture
def clouds_and_images(tmp_path):
    for name in ("lidar_top", "cam_front"):
        (tmp_path / name).mkdir()
    for k in range(2):
        (tmp_path / "lidar_top" / f"{START_NS + k}.pcd").write_bytes(PCD)
        Image.new("RGB", (64, 48)).save(tmp_path / "cam_front" / f"{START_NS + k}.jpg")
    return tmp_path


def test_the_template_opens_once_it_is_filled_in_and_says_before_what_is_left(clouds_and_images):
    write_template(clouds_and_images / "rig.toml")
    left = (
        r"sensors\[0\] \(lidar_top\): still to be filled in: extrinsic.translation, extrinsic.quaternion_xyzw(.|\n)*"
        r"sensors\[1\] \(cam_front\): still to be filled in: camera_model.fx"
    )
    with pytest.raises(DataError, match=left):
        sceneloom.open(clouds_and_images)
    (clouds_and_images / "rig.toml").write_text(filled(TEMPLATE))
    scene = sceneloom.open(clouds_and_images)
    assert [sensor.id for sensor in scene.sensors] == ["lidar_top", "cam_front"]
    assert scene.lidars[0].frames.timestamps_ns.tolist() == [START_NS, START_NS + 1]
    np.testing.assert_allclose(scene.cameras[0].mount.translation, [0.5, 0, 0])


def test_lines_that_are_commented_out_are_right_as_well_and_no_field_is_unknown(clouds_and_images):
    lines = [re.sub(r"^# (?=[a-z_]+ = (?!R)|\[\[)", "", line) for line in TEMPLATE.splitlines()]
    left_out = r"times = \{ (csv|lines|rate_hz)|root = |point_times|fields"
    text = filled("\n".join(line for line in lines if not re.match(left_out, line)))
    text = text.replace('timestamp = "start"', 'timestamp = "end"').replace("width = 1920", "width = 64")
    (clouds_and_images / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    (clouds_and_images / "rig.toml").write_text(text.replace("1080", "48"))
    assert [*sceneloom.open(clouds_and_images).trajectories] == ["pose"]
    known = {*tomllib.loads(MANIFEST)["sensors"][0], "timestamp", "extrinsic"}
    assert set(tomllib.loads(TEMPLATE)["sensors"][0]) <= known


@pytest.mark.parametrize("location", ["inside", "above", "elsewhere"])
def test_a_look_into_a_folder_gives_a_manifest_that_opens_once_it_is_filled_in(
    clouds_and_images, location, tmp_path_factory
):
    path = {
        "inside": clouds_and_images / "rig.toml",
        "above": clouds_and_images.parent / f"{clouds_and_images.name}.toml",
        "elsewhere": tmp_path_factory.mktemp("x") / "rig.toml",
    }[location]
    write_template(path, folder=clouds_and_images)
    path.write_text(filled(path.read_text()))
    scene = FORMAT.open(path)
    assert [(sensor.id, sensor.type) for sensor in scene.sensors] == [("lidar_top", "lidar"), ("cam_front", "camera")]
    assert scene.cameras[0].images.timestamps_ns.tolist() == [START_NS, START_NS + 1]
    assert ("root" in tomllib.loads(path.read_text())) == (location != "inside")


def test_a_template_is_a_toml_file_replaces_none_unless_reported_to_and_needs_clouds_or_images(tmp_path):
    write_template(tmp_path / "rig.toml")
    write_template(tmp_path / "rig.toml", overwrite=True)
    for failing, error, problem in (
        (lambda: write_template(tmp_path / "rig.toml"), OutputError, "exists already"),
        (lambda: write_template(tmp_path / "rig.json"), OptionError, r"expected a name that ends with \.toml"),
        (lambda: template_text(folder=tmp_path), DataError, "no clouds, images or videos"),
        (lambda: template_text(folder=tmp_path / "none"), DataError, "no such folder"),
    ):
        with pytest.raises(error, match=problem):
            failing()


@pytest.mark.parametrize(
    ("names", "pattern", "expected_ns"),
    [
        ("1532402927647951000", "{ns}", [1_532_402_927_647_951_000]),
        ("1532402927647951", "{us}", [1_532_402_927_647_951_000]),
        ("1532402927647", "{ms}", [1_532_402_927_647_000_000]),
        ("1532402927", "{s}", [1_532_402_927_000_000_000]),
        ("1532402927_647951000", "{s}_{ns}", [1_532_402_927_647_951_000]),
        ("1532402927-647951", "{s}-{us}", [1_532_402_927_647_951_000]),
        ("top_1532402927.6479510_raw", "*{s}_raw", [1_532_402_927_647_951_000]),
        ("top_1532402927647951000_raw", "*{ns}_raw", [1_532_402_927_647_951_000]),
        # the pattern that the first name reports reads the others
        ("1532402927.647951 1532402928.5", "{s}", [1_532_402_927_647_951_000, 1_532_402_928_500_000_000]),
        ("0000000001050000000 0000000001150000000", None, [1_050_000_000, 1_150_000_000]),
        ("1532402927647951000_000001 1532402927747951000_000002", None,
         [1_532_402_927_647_951_000, 1_532_402_927_747_951_000]),
        # numbered names ask for a rate
        ("000000 000001", "{index}", None), ("0000000000 0000000001", "{index}", None),
        ("scan_1 scan_2", "*{index}", None),
    ],
)  # fmt: skip
def test_times_are_distinguished_from_names_and_those_patterns_read_them(tmp_path, names, pattern, expected_ns):
    for name in names.split():
        (tmp_path / f"{name}.pcd").write_bytes(PCD)
    (found,) = survey(tmp_path).sensors
    assert pattern in (None, found.times["pattern"])
    if expected_ns is None:
        assert np.isnan(found.times["rate_hz"])
    else:
        assert set(found.times) == {"pattern"}
        (tmp_path / "rig.toml").write_text(filled(template_text(folder=tmp_path)))
        assert FORMAT.open(tmp_path).lidars[0].frames.timestamps_ns.tolist() == expected_ns


def test_lists_of_times_beside_the_files_are_found(clouds_and_images):
    (clouds_and_images / "lidar_top" / "timestamps.txt").write_text("2011-09-26 13:02:25.5\n2011-09-26 13:02:25.6\n")
    rows = "".join(f"{path.name},{k}\n" for k, path in enumerate((clouds_and_images / "cam_front").iterdir()))
    (clouds_and_images / "front.csv").write_text("image,time\n" + rows)
    lidar, camera = survey(clouds_and_images).sensors
    assert lidar.times == {"lines": "lidar_top/timestamps.txt"}
    assert camera.times == {"csv": "front.csv", "column": "time"}


@pytest.mark.parametrize(
    ("files", "ids", "counts"),
    [
        # several sensors in one folder
        ([f"n015__CAM_{name}__{START_NS + k}.pcd" for name in ("FRONT", "BACK") for k in range(2)],
         {"CAM_FRONT", "CAM_BACK"}, [2, 2]),
        # signs of patterns in names
        ([f"run [1]/{START_NS}.pcd", f"run 1/{START_NS}.pcd"], None, [1, 1]),
    ],
)  # fmt: skip
def test_files_of_several_sensors_are_distinguished(tmp_path, files, ids, counts):
    for file in files:
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(PCD)
    found = survey(tmp_path).sensors
    assert len({sensor.id for sensor in found}) == 2
    assert ids is None or {sensor.id for sensor in found} == ids
    assert [len(list(tmp_path.glob(sensor.files["files"]))) for sensor in found] == counts


def test_layouts_of_files_without_a_head_are_guessed_from_their_numbers(tmp_path):
    rng = np.random.default_rng(0)
    for name, columns in (("four", 4), ("five", 5)):
        (tmp_path / name).mkdir()
        rows = rng.uniform(1.0, 50.0, (25, columns)).astype("<f4")
        if columns == 5:
            rows[:, 3:] = rng.integers(1000, 2000, (25, 2))
        (tmp_path / name / "0.bin").write_bytes(rows.tobytes())
    five, four = survey(tmp_path).sensors
    assert any('"intensity"]' in line for line in four.further)
    assert any('"intensity", "ring"]' in line for line in five.further)


@pytest.mark.parametrize(
    ("name", "text", "form"),
    [
        ("tum.txt", "0 0 0 0 0 0 0 1\n", "tum"),
        ("kitti.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "kitti"),
        ("trajectory.csv", "time,x,y,z\n0,1,2,3\n", "csv"),
        ("imu.csv", "time,ax,ay,az\n0,1,2,3\n", "imu"),
        ("gnss.csv", "time,lat,lon,alt\n0,1,2,3\n", "gnss"),
    ],
)
def test_trajectories_and_motion_sensors_are_found(clouds_and_images, name, text, form):
    (clouds_and_images / name).write_text(text)
    found = survey(clouds_and_images)
    trajectories = [(trajectory.file, trajectory.form) for trajectory in found.trajectories]
    sensors = [(f"{sensor.id}.csv", sensor.type) for sensor in found.sensors if sensor.type in {"imu", "gnss"}]
    assert trajectories + sensors == [(name, form)]


def test_strange_names_are_written_as_toml_reads_them_and_leave_the_template_readable(clouds_and_images):
    for text in ("plain", 'with "quotes"', "back\\slash", "it's", "new\nline", "ümlaut", "both ' and \"", "del\x7f"):
        assert tomllib.loads(f"x = {quoted(text)}")["x"] == text
    strange = PCD.replace(b"x y z", b"x y z\x00\x7f")
    (clouds_and_images / "lidar_top" / f"{START_NS}.pcd").write_bytes(strange)
    text = template_text(folder=clouds_and_images)
    assert "z?? float32" in text
    assert [sensor["id"] for sensor in tomllib.loads(text)["sensors"]] == ["lidar_top", "cam_front"]


def test_columns_that_are_not_known_by_name_are_offered_as_comments_that_work_or_asked_for(tmp_path):
    for k in range(2):
        times = np.array([0.0, 50.0, 99.0], "f4")
        np.savez(tmp_path / f"{k}.npz", pts=np.ones((3, 3), "f4"), refl=np.ones(3, "f4"), dt_ms=times)
    text = template_text(folder=tmp_path)
    assert '# use = { intensity = "refl" }' in text
    assert '# point_times = { field = "dt_ms", unit = "milliseconds" }' in text
    taken = text.replace("# use", "use").replace("# point_times", "point_times")
    (tmp_path / "rig.toml").write_text(taken.replace("rate_hz = nan", "rate_hz = 10"))
    points = sceneloom.open(tmp_path).lidars[0].frames[1].points
    assert points.intensities.tolist() == [255] * 3
    np.testing.assert_allclose(points.timestamps_ns, [100e6, 150e6, 199e6], atol=10)
    (tmp_path / "1.npz").unlink()
    np.savez(tmp_path / "0.npz", East=np.ones(3), North=np.ones(3), Up=np.ones(3))
    assert '# use = { x = "?", y = "?", z = "?" }   # needed: which of East North Up' in template_text(folder=tmp_path)
