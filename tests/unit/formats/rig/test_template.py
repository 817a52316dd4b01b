"""Manifests to begin with: the template, and what a look into a folder finds."""

import re
import tomllib

import numpy as np
import pytest
from PIL import Image

import sceneloom
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.rig.spec import FORMAT
from sceneloom.formats.rig.template import TEMPLATE, quoted, survey, template_text, write_template

from .conftest import MANIFEST, START_NS

PCD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nDATA binary\n" + np.ones(3, "<f4").tobytes()


def filled(text: str) -> str:
    """Fill in what a template leaves open, as a person would."""
    text = text.replace("quaternion_xyzw = [nan, nan, nan, nan]", "quaternion_xyzw = [0, 0, 0, 1]")
    rows = iter(["[0, 0, 1, 0.5]", "[-1, 0, 0, 0]", "[0, -1, 0, 0]"])
    text = re.sub(r"(?m)^    \[nan, nan, nan, nan\]", lambda _: f"    {next(rows)}", text)
    text = re.sub(r"(fx|fy) = nan", r"\1 = 60.0", text)
    return text.replace("rate_hz = nan", "rate_hz = 10").replace("nan", "0.0")


def opened_timestamps(folder):
    """Open a folder with the manifest that a look into it gives."""
    (folder / "rig.toml").write_text(filled(template_text(folder=folder)))
    return FORMAT.open(folder).lidars[0].frames.timestamps_ns.tolist()


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


def test_a_template_is_a_toml_file_and_replaces_none_unless_reported_to(tmp_path):
    write_template(tmp_path / "rig.toml")
    with pytest.raises(OutputError, match="exists already"):
        write_template(tmp_path / "rig.toml")
    write_template(tmp_path / "rig.toml", overwrite=True)
    with pytest.raises(OptionError, match=r"expected a name that ends with \.toml"):
        write_template(tmp_path / "rig.json")


def test_a_folder_without_clouds_and_images_is_refused(tmp_path):
    with pytest.raises(DataError, match="no clouds, images or videos"):
        template_text(folder=tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        template_text(folder=tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("1532402927647951000", "{ns}"),
        ("1532402927647951", "{us}"),
        ("1532402927647", "{ms}"),
        ("1532402927", "{s}"),
        ("1532402927_647951000", "{s}_{ns}"),
        ("1532402927-647951", "{s}-{us}"),
        ("1532402927.647951", "{s}"),
        ("top_1532402927.6479510_raw", "*{s}_raw"),
        ("top_1532402927647951000_raw", "*{ns}_raw"),
    ],
)
def test_times_are_distinguished_from_names_and_those_patterns_read_them(tmp_path, name, pattern):
    (tmp_path / f"{name}.pcd").write_bytes(PCD)
    (found,) = survey(tmp_path).sensors
    assert found.times == {"pattern": pattern}
    assert abs(opened_timestamps(tmp_path)[0] - START_NS) < 1_000_000_000


@pytest.mark.parametrize(
    ("names", "expected_ns"),
    [
        (["0000000001050000000", "0000000001150000000"], [1_050_000_000, 1_150_000_000]),
        (["1532402927.647951", "1532402928.5"], [1_532_402_927_647_951_000, 1_532_402_928_500_000_000]),
        (["1532402927647951000_000001", "1532402927747951000_000002"],
         [1_532_402_927_647_951_000, 1_532_402_927_747_951_000]),
    ],
)  # fmt: skip
def test_the_pattern_that_the_first_name_reports_reads_the_others(tmp_path, names, expected_ns):
    for name in names:
        (tmp_path / f"{name}.pcd").write_bytes(PCD)
    assert opened_timestamps(tmp_path) == expected_ns


@pytest.mark.parametrize("names", [["000000", "000001"], ["0000000000", "0000000001"], ["scan_1", "scan_2"]])
def test_numbered_names_ask_for_a_rate(tmp_path, names):
    for name in names:
        (tmp_path / f"{name}.pcd").write_bytes(PCD)
    (found,) = survey(tmp_path).sensors
    assert found.times["pattern"] in {"{index}", "*{index}"}
    assert np.isnan(found.times["rate_hz"])


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


@pytest.mark.parametrize(
    "text", ["plain", 'with "quotes"', "back\\slash", "it's", "new\nline", "ümlaut", "both ' and \"", "del\x7f"]
)
def test_strange_names_are_written_as_toml_reads_them(text):
    assert tomllib.loads(f"x = {quoted(text)}")["x"] == text


def test_columns_with_strange_names_leave_the_template_readable(clouds_and_images):
    strange = PCD.replace(b"x y z", b"x y z\x00\x7f")
    (clouds_and_images / "lidar_top" / f"{START_NS}.pcd").write_bytes(strange)
    text = template_text(folder=clouds_and_images)
    assert "z?? float32" in text
    assert [sensor["id"] for sensor in tomllib.loads(text)["sensors"]] == ["lidar_top", "cam_front"]


def test_columns_that_are_not_known_by_name_are_offered_as_comments_that_work(tmp_path):
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


def test_columns_of_locations_that_are_not_known_by_name_are_asked_for(tmp_path):
    np.savez(tmp_path / "0.npz", East=np.ones(3), North=np.ones(3), Up=np.ones(3))
    assert '# use = { x = "?", y = "?", z = "?" }   # needed: which of East North Up' in template_text(folder=tmp_path)
