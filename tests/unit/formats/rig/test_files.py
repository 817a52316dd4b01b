"""Manifests: all faults are reported with location, value and what was expected; and manifests to begin with."""

import re
import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import sceneloom
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.base.text_tables import TimestampError, parse_timestamp
from sceneloom.formats.rig.reader import RECORDS, Faults, Kind, NamePattern, read_record
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.formats.rig.template import TEMPLATE, quoted, survey, template_text, write_template

from .conftest import BY_NAME, BY_RATE, CAMERA_MODEL, FIELDS, LIDAR_FILES, MANIFEST, SCALE, START_NS, TUM, codes

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


def test_all_faults_are_reported_at_once_and_a_file_that_is_no_manifest(refused, folder):
    for content, problem in (
        (b"ego = base\n", r"is no TOML: .*line 1"),
        (b"ego = '\xff'", "byte 7: is no UTF-8 text"),
        (b"a = " + b"[" * 5000, "is no TOML"),
        (b"", "sensors: missing; expected a list of tables: the sensors"),
        (b"sensors = []", "an empty list; expected at least one"),
    ):
        (folder / "rig.toml").write_bytes(content)
        with pytest.raises(DataError, match=problem):
            FORMAT.open(folder)
    refused(r"2 faults", ('ego = "base"', 'egoo = "base"'), ("rate_hz = 10", "rate_hz = -1"))
    both = r"transforms\[0\](.|\n)*sensors\[1\] \(front\)\.extrinsic"
    refused(both, ("0.0, 1.0]", "0.0, 9.0]"), ("[0.5, 0", "[1e7, 0"))
    refused(
        r"3 faults\n.*trajectories\[0\].file: 'path.txt': no such file.*\n"
        r".*sensors\[0\] \(top\).files: 'tip/\*.bin': no such files.* has the folders front, top\n"
        r".*sensors\[1\] \(front\): no focal length",
        *(("top/*.bin", "tip/*.bin"), ("fx = 6.0,", ""), ('file = "poses.txt"', 'file = "path.txt"')),
    )


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


def filled(text):
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
    # lines that are commented out are right as well, and no field is unknown
    lines = [re.sub(r"^# (?=[a-z_]+ = (?!R)|\[\[)", "", line) for line in TEMPLATE.splitlines()]
    left_out = r"times = \{ (csv|lines|rate_hz)|root = |point_times|fields"
    text = filled("\n".join(line for line in lines if not re.match(left_out, line)))
    text = text.replace('timestamp = "start"', 'timestamp = "end"').replace("width = 1920", "width = 64")
    (clouds_and_images / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    (clouds_and_images / "rig.toml").write_text(text.replace("1080", "48"))
    assert [*sceneloom.open(clouds_and_images).trajectories] == ["pose"]
    known = {*tomllib.loads(MANIFEST)["sensors"][0], "timestamp", "extrinsic"}
    assert set(tomllib.loads(TEMPLATE)["sensors"][0]) <= known


def test_a_look_into_a_folder_gives_a_manifest_that_opens_once_it_is_filled_in(clouds_and_images, tmp_path_factory):
    above = clouds_and_images.parent / f"{clouds_and_images.name}.toml"
    for path in (above, tmp_path_factory.mktemp("x") / "rig.toml", clouds_and_images / "rig.toml"):
        write_template(path, folder=clouds_and_images)
        path.write_text(filled(path.read_text()))
        scene = FORMAT.open(path)
        found = [(sensor.id, sensor.type) for sensor in scene.sensors]
        assert found == [("lidar_top", "lidar"), ("cam_front", "camera")]
        assert scene.cameras[0].images.timestamps_ns.tolist() == [START_NS, START_NS + 1]
        assert ("root" in tomllib.loads(path.read_text())) == (path.parent != clouds_and_images)


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


def test_trajectories_motion_sensors_and_lists_of_times_beside_the_files_are_found(clouds_and_images):
    for name, text, form in (
        ("tum.txt", "0 0 0 0 0 0 0 1\n", "tum"),
        ("kitti.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "kitti"),
        ("trajectory.csv", "time,x,y,z\n0,1,2,3\n", "csv"),
        ("imu.csv", "time,ax,ay,az\n0,1,2,3\n", "imu"),
        ("gnss.csv", "time,lat,lon,alt\n0,1,2,3\n", "gnss"),
    ):
        (clouds_and_images / name).write_text(text)
        found = survey(clouds_and_images)
        trajectories = [(trajectory.file, trajectory.form) for trajectory in found.trajectories]
        sensors = [(f"{sensor.id}.csv", sensor.type) for sensor in found.sensors if sensor.type in {"imu", "gnss"}]
        assert trajectories + sensors == [(name, form)]
        (clouds_and_images / name).unlink()
    (clouds_and_images / "lidar_top" / "timestamps.txt").write_text("2011-09-26 13:02:25.5\n2011-09-26 13:02:25.6\n")
    rows = "".join(f"{path.name},{k}\n" for k, path in enumerate((clouds_and_images / "cam_front").iterdir()))
    (clouds_and_images / "front.csv").write_text("image,time\n" + rows)
    lidar, camera = survey(clouds_and_images).sensors
    assert lidar.times == {"lines": "lidar_top/timestamps.txt"}
    assert camera.times == {"csv": "front.csv", "column": "time"}


def test_files_of_several_sensors_are_distinguished_and_layouts_without_a_head_guessed_from_their_numbers(tmp_path):
    for folder, files, ids, counts in (
        # several sensors in one folder
        ("a", [f"n015__CAM_{name}__{START_NS + k}.pcd" for name in ("FRONT", "BACK") for k in range(2)],
         {"CAM_FRONT", "CAM_BACK"}, [2, 2]),
        # signs of patterns in names
        ("b", [f"run [1]/{START_NS}.pcd", f"run 1/{START_NS}.pcd"], None, [1, 1]),
    ):  # fmt: skip
        for file in files:
            (tmp_path / folder / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / folder / file).write_bytes(PCD)
        found = survey(tmp_path / folder).sensors
        assert len({sensor.id for sensor in found}) == 2
        assert ids is None or {sensor.id for sensor in found} == ids
        assert [len(list((tmp_path / folder).glob(sensor.files["files"]))) for sensor in found] == counts
    rng = np.random.default_rng(0)
    for name, columns in (("four", 4), ("five", 5)):
        (tmp_path / "c" / name).mkdir(parents=True)
        rows = rng.uniform(1.0, 50.0, (25, columns)).astype("<f4")
        if columns == 5:
            rows[:, 3:] = rng.integers(1000, 2000, (25, 2))
        (tmp_path / "c" / name / "0.bin").write_bytes(rows.tobytes())
    five, four = survey(tmp_path / "c").sensors
    assert any('"intensity"]' in line for line in four.further)
    assert any('"intensity", "ring"]' in line for line in five.further)


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


def test_links_that_lead_out_are_refused_and_those_inside_the_folder_or_to_another_root_followed(
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
    (folder / "top").unlink()
    (elsewhere / "top").rename(folder / "kept")
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
