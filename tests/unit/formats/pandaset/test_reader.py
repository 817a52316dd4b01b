"""Drives of PandaSet, by the description of its development kit, and their pickles, of which nothing is ever called."""

import gzip
import json
import pickle
import pickletools
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.errors import DataError, OptionError
from sceneloom.formats.base.registry import drives_of
from sceneloom.formats.pandaset import pickles
from sceneloom.formats.pandaset.pickles import PickledFrame
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.annotations_at import CuboidAngles

FRAMES = Path(__file__).parent / "frames" / "pandas_1"
VERSIONS = ["pandas_1", "pandas_2", "pandas_3"]
FIRST_S = 1_557_539_924.5
FIRST_NS = 1_557_539_924_500_000_000
NEAR = 1e-9
"""Two ways of float64 through rotations, of numbers up to 100."""


def lidar_pose(k):
    return [2.0 * k, 10.0 - k, 0.5], Rotation.from_euler("ZYX", [50 + k, 2, -1], degrees=True)


def camera_pose(k):
    location, rotation = lidar_pose(k)
    there = np.array(location) + rotation.apply([0.0, 0.5, -0.1])
    return there.tolist(), rotation * Rotation.from_euler("x", -np.pi / 2)


def poses(of, count=2):
    found = []
    for location, rotation in map(of, range(count)):
        heading = dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))
        found.append({"position": dict(zip("xyz", location, strict=True)), "heading": heading})
    return found


def put(path, thing):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(thing), "utf-8")


def write_drive(drive, frames=FRAMES):
    for kind, folder in (("lidar", "lidar"), ("cuboids", "annotations/cuboids"), ("semseg", "annotations/semseg")):
        (drive / folder).mkdir(parents=True)
        for k in range(2):
            shutil.copy(frames / f"{kind}_{k}.pkl.gz", drive / folder / f"{k:02d}.pkl.gz")
    times = [FIRST_S, FIRST_S + 0.1]
    put(drive / "lidar" / "timestamps.json", times)
    put(drive / "lidar" / "poses.json", poses(lidar_pose))
    put(drive / "annotations" / "semseg" / "classes.json", {"5": "Vegetation", "6": "Ground", "7": "Road"})
    camera = drive / "camera" / "front_camera"
    put(camera / "intrinsics.json", {"fx": 60.0, "fy": 61.0, "cx": 31.0, "cy": 23.0})
    put(camera / "poses.json", poses(camera_pose))
    put(camera / "timestamps.json", [FIRST_S + 0.05, FIRST_S + 0.15])
    for k in range(2):
        Image.new("RGB", (64, 48), (100 * k, 0, 0)).save(camera / f"{k:02d}.jpg")
    fix = {"lat": 37.776089291519924, "long": -122.39931707791749, "height": 2.95, "xvel": 0.5, "yvel": 7.0}
    put(drive / "meta" / "gps.json", [fix, {**fix, "xvel": 0.75}])
    put(drive / "meta" / "timestamps.json", times)
    return drive


@pytest.fixture
def drive(tmp_path):
    return write_drive(tmp_path / "002")


@pytest.fixture
def scene(drive):
    return sceneloom.open(drive)


def test_points_in_the_world_go_to_the_lidar_that_measured_them_and_sensors_are_where_their_poses_state(scene):
    row = np.arange(13)
    for sensor_id, chosen in (("main_pandar64", row < 8), ("front_gt", row >= 8)):
        lidar = scene.sensor(sensor_id)
        points = lidar.frames[1].points
        assert lidar.points_frame == "world"
        positions = np.stack([101.0 + row * 1.25, -40.0 + row * 0.5, row / 8.0], axis=1)
        assert np.array_equal(points.positions, positions[chosen].astype(np.float32))
        assert points.intensities.tolist() == (row * 20 % 256)[chosen].tolist()
        away = points.timestamps_ns - (FIRST_NS + 100_000_000 + row * 1_000_000)[chosen]
        assert np.abs(away).max() < 300  # seconds since 1970 in float64 are steps of 238 ns
    lidar, camera, trajectory = scene.sensor("main_pandar64"), scene.cameras[0], scene.trajectories["pose"]
    for k in range(2):
        for sensor, pose in ((lidar, lidar_pose(k)), (camera, camera_pose(k))):
            assert np.allclose(sensor.poses.positions[k], pose[0])
            assert (Rotation.from_quat(sensor.poses.quaternions_xyzw[k]).inv() * pose[1]).magnitude() < NEAR
        ego = Rotation.from_quat(trajectory.quaternions_xyzw[k])  # it looks along the lidar's y
        assert np.allclose(ego.apply([1, 0, 0]), lidar_pose(k)[1].apply([0, 1, 0]))
        mounted = RigidTransform.from_quaternion(trajectory.positions[k], trajectory.quaternions_xyzw[k]) @ lidar.mount
        own = RigidTransform.from_quaternion(lidar.poses.positions[k], lidar.poses.quaternions_xyzw[k])
        assert np.allclose(mounted.matrix, own.matrix, atol=NEAR)
    assert camera.id == "front_camera"
    assert camera.images.timestamps_ns.tolist() == [FIRST_NS + 50_000_000, FIRST_NS + 150_000_000]
    assert (camera.camera.model, camera.camera.width, camera.camera.fy) == ("pinhole", 64, 61.0)
    assert camera.images[1].rgb.shape == (48, 64, 3)
    for frames in (scene.lidars[1].frames, camera.images):
        assert pickle.loads(pickle.dumps(frames))[1].timestamp_ns == frames[1].timestamp_ns
    receiver = scene.sensor("gps")
    assert receiver.positions_lla[0].tolist() == [37.776089291519924, -122.39931707791749, 2.95]
    assert receiver.extras["xvel"] == (0.5, 0.75)


@pytest.mark.parametrize("version", VERSIONS)
def test_boxes_keep_their_corners_and_what_is_stated_about_them(tmp_path, version):
    scene = sceneloom.open(write_drive(tmp_path / "002", FRAMES.parent / version))
    first, second, walker = (a for a in scene.annotations if a.type == "cuboid")
    assert (first.id, first.label, first.stationary, walker.stationary) == ("car-0", "Car", False, True)
    for k in range(2):
        # corners as the development kit makes them: width along x, length along y, rotated about z
        yaw = 0.25 + 0.1 * k
        local = np.array([[x, y, z] for x in (-0.95, 0.95) for y in (-2.3, 2.3) for z in (-0.8, 0.8)])
        expected = Rotation.from_euler("z", yaw).apply(local) + np.array([10.0 + k, 20.0, 1.0])
        row = first.path.values[k]
        half = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * row[:3] / 2
        rotation = Rotation.from_quat(CuboidAngles.of(scene).quaternions(row[6:]))
        ours = rotation.apply(half) + row[3:6]
        assert np.allclose(sorted(ours.tolist()), sorted(expected.tolist()), atol=1e-9)
        # the front is where the length points
        assert np.allclose(rotation.apply([1, 0, 0]), Rotation.from_euler("z", yaw).apply([0, 1, 0]), atol=1e-9)
    stated = {path.name: path.values for path in first.attributes}
    assert stated == {"object_motion": ("Moving",), "sibling_id": ("car-1",), "sensor_id": ("main_pandar64",)}
    assert {path.name: path.values for path in second.attributes}["camera_used"] == (0, 2)
    assert {path.name: path.values for path in walker.attributes} == {"pedestrian_age": ("Child", "Adult")}
    assert first.path.timestamps_ns.tolist() == [FIRST_NS, FIRST_NS + 100_000_000]


def test_classes_count_the_points_of_each_lidar_also_in_a_scene_file(scene, tmp_path):
    vegetation, ground, road = (a for a in scene.annotations if a.type == "labeled_points")
    assert (vegetation.label, ground.label, road.is_instance) == ("Vegetation", "Ground", False)
    found = [(part.sensor_id, part.sensor_frame) for part in ground.labeled_points]
    assert found == [("main_pandar64", 0), ("front_gt", 0), ("main_pandar64", 1), ("front_gt", 1)]
    classes = np.arange(13) % 3 + 5
    assert ground.labeled_points[2].point_ids.tolist() == np.flatnonzero(classes[:8] == 6).tolist()
    assert ground.labeled_points[3].point_ids.tolist() == np.flatnonzero(classes[8:] == 6).tolist()
    assert len(pickle.loads(pickle.dumps(road)).labeled_points) == len(road.labeled_points)
    sceneloom.write(scene, tmp_path / "a.sfs", time_unit="nanoseconds")
    with sceneloom.open(tmp_path / "a.sfs") as again:
        assert np.array_equal(again.lidars[1].frames[0].points.positions, scene.lidars[1].frames[0].points.positions)
        assert np.allclose(again.annotations[0].path.values, scene.annotations[0].path.values)
        assert again.annotations[-1].labeled_points[1].point_ids.tolist() == [0, 3]


def test_one_of_several_drives_has_to_be_chosen(tmp_path):
    for name in ("001", "002"):
        write_drive(tmp_path / name)
    with pytest.raises(OptionError, match="2 drives; choose one with `--sequence NAME`: 001, 002"):
        sceneloom.open(tmp_path)
    assert drives_of(tmp_path) == [tmp_path / "001", tmp_path / "002"]
    assert drives_of(tmp_path / "001") == drives_of(tmp_path, read_as="nuscenes") == ()
    assert sceneloom.open(tmp_path, sequence="002").metadata["pandaset"]["sequence"] == "002"


CAMERA, POSES, CUBOIDS = "camera/front_camera", "lidar/poses.json", "annotations/cuboids/00.pkl.gz"
ORIGIN, NO_HEADING = {"x": 0.0, "y": 0.0, "z": 0.0}, {"heading": {"w": 2.0, "x": 0.0, "y": 0.0, "z": 0.0}}
FAULTS = [
    (POSES, None, "lidar/poses.json: is not there"),
    (f"{CAMERA}/timestamps.json", None, "timestamps.json: is not there"),
    ("lidar/timestamps.json", [FIRST_S], "1 times; expected 2, one for each frame"),
    ("lidar/timestamps.json", [2.0, 1.0], r"\[1\]: 1.0 after 2.0; expected later"),
    ("lidar/timestamps.json", [1.5e12, 1.6e12], "expected seconds"),
    (POSES, poses(lidar_pose, 1), "1 poses; expected 2"),
    (POSES, [{"position": ORIGIN}] * 2, r"\$\[0\]: Object missing required field `heading`"),
    (POSES, [poses(lidar_pose)[0] | NO_HEADING] * 2, r"\[0\].heading: w, x, y, z = \[2.0, .*\]; expected length 1"),
    (POSES, b"[{", "poses.json: line 1, column 3: is no JSON: the file ends within \\[0\\]"),
    (f"{CAMERA}/intrinsics.json", None, "intrinsics.json: is not there"),
    (f"{CAMERA}/intrinsics.json", {"fx": 0.0, "fy": 1.0, "cx": 1.0, "cy": 1.0}, "focal lengths 0.0, 1.0"),
    ("annotations/cuboids/07.pkl.gz", FRAMES / "cuboids_0.pkl.gz", "07.pkl.gz: there is no sweep of this number"),
    (CUBOIDS, FRAMES / "lidar_0.pkl.gz", "no column 'dimensions.x'; it has x, y, z, i, t, d"),
    (CUBOIDS, (FRAMES / "cuboids_0.pkl.gz").read_bytes()[:200], "cuboids/00.pkl.gz: is no whole gzip file"),
    ("annotations/semseg/classes.json", None, "semseg/classes.json: is not there"),
]


@pytest.mark.parametrize(("name", "thing", "message"), FAULTS)
def test_what_is_wrong_with_a_drive_is_reported_with_its_location(drive, name, thing, message):
    (drive / name).unlink(missing_ok=True)
    if isinstance(thing, bytes | Path):
        (drive / name).write_bytes(thing if isinstance(thing, bytes) else thing.read_bytes())
    elif thing is not None:
        put(drive / name, thing)
    with pytest.raises(DataError, match=message):
        sceneloom.open(drive)


def test_a_camera_without_images_and_half_a_drive_are_reported(drive):
    for file in (drive / CAMERA).glob("*.jpg"):
        file.unlink()
    with pytest.raises(DataError, match="front_camera: no image"):
        sceneloom.open(drive)
    shutil.rmtree(drive / "lidar")
    shutil.rmtree(drive / "annotations")
    (drive / CAMERA / "00.jpg").touch()
    with pytest.raises(DataError, match="has camera/front_camera/ as PandaSet has, but no lidar/"):
        sceneloom.open(drive)


@pytest.mark.parametrize(
    ("kind", "source", "problem"),
    [
        ("lidar", "cuboids/00", "00.pkl.gz: no column 'x'"),
        ("annotations/semseg", "cuboids/00", "00.pkl.gz: no column 'class'"),
        ("annotations/semseg", "semseg/01", "13 rows; expected 12, one for each point of 00.pkl.gz"),
    ],
)
def test_sweeps_and_classes_are_read_and_faults_reported_when_somebody_asks(drive, kind, source, problem):
    shutil.copy(drive / f"annotations/{source}.pkl.gz", drive / kind / "00.pkl.gz")
    (drive / "annotations/cuboids/00.pkl.gz").write_bytes(b"no pickle")
    scene = sceneloom.open(drive, lenient=True)
    with pytest.raises(DataError, match=problem):
        _ = scene.lidars[0].frames[0] if kind == "lidar" else list(scene.annotations[-1].labeled_points)
    # files of boxes at fault are left out, and counted
    assert len(scene.annotations[0].path.values) == 1
    assert {warning.code: warning.count for warning in scene.warnings}["cuboids"] == 1


@pytest.mark.parametrize("version", VERSIONS)
def test_frames_of_every_pandas_give_the_columns_that_were_written(tmp_path, version):
    lidar = PickledFrame.read(FRAMES.parent / version / "lidar_1.pkl.gz")
    row = np.arange(13)
    assert list(lidar.columns) == list("xyzitd")
    assert lidar.columns["x"].tolist() == (101.0 + row * 1.25).tolist()
    assert lidar.columns["d"].tolist() == [0] * 8 + [1] * 5
    assert not lidar.columns["x"].flags.writeable
    cuboids = PickledFrame.read(FRAMES.parent / version / "cuboids_0.pkl.gz")
    assert cuboids.columns["label"].tolist() == ["Car", "Car", "Pedestrian"]
    assert cuboids.columns["stationary"].tolist() == [False, False, True]
    assert cuboids.columns["dimensions.y"].tolist() == [4.6, 4.6, 0.7]
    plain = gzip.decompress((FRAMES.parent / version / "lidar_0.pkl.gz").read_bytes())  # a file that is not packed
    assert PickledFrame.read(written(tmp_path / "00.pkl", plain)).count == 12


class Calls:
    """Unpickled in the usual way, it would call."""

    def __init__(self, function, *arguments):
        self.what = function, arguments

    def __reduce__(self):
        return self.what


def written(path, thing, **options):
    path.write_bytes(thing if isinstance(thing, bytes) else pickle.dumps(thing, **options))
    return path


def named(name):
    """A pickle that asks for what a module calls so."""
    return b"\x80\x04" + b"".join(b"\x8c" + bytes([len(word)]) + word for word in name.encode().split()) + b"\x93."


FOREIGN = ("builtins eval", "os system", "numpy load", "pandas eval", "pandas.io.common os.system")


@pytest.mark.parametrize("protocol", [2, 4, 5])
def test_what_a_pickle_asks_to_be_called_is_not_called(tmp_path, protocol):
    mark = tmp_path / "called"
    path = written(tmp_path / "a.pkl", [Calls(Path.touch, mark)], protocol=protocol)
    with pytest.raises(DataError, match=r"asks for .*, which no frame of numbers and texts needs; it was not"):
        PickledFrame.read(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        *((named(name), f"asks for {name.replace(' ', '.')}") for name in FOREIGN),
        # the objects that stand for names cannot be changed by a file
        (b"\x80\x04" + b"cbuiltins\nslice\n" + b"}\x8c\x05_makeK\x01sb.", "changes what it must not"),
        (b"\x80\x02Psecret\n.", "operation PERSID"),
        (b"\x80\x02Nr\xff\xff\xff\x7f.", "things to remember"),
        *((pickle.dumps(thing), "a pandas frame|operation") for thing in ([1, 2], {"a": 1}, "text", None, b"bytes", 5)),
    ],
)
def test_names_operations_and_things_that_no_frame_needs_are_refused(tmp_path, content, problem):
    with pytest.raises(DataError, match=problem):
        PickledFrame.read(written(tmp_path / "a.pkl", content))
    assert pickles._NAMED["slice"](1, 2) == slice(1, 2)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_that_is_cut_off_or_has_a_flipped_byte_is_a_data_error_or_read(tmp_path, version):
    whole, rng = gzip.decompress((FRAMES.parent / version / "cuboids_1.pkl.gz").read_bytes()), np.random.default_rng(3)
    for stop in range(0, len(whole) - 1, 83):
        with pytest.raises(DataError):
            PickledFrame.read(written(tmp_path / "a.pkl", whole[:stop]))
    for location in rng.integers(0, len(whole), 50).tolist():
        changed = bytearray(whole)
        changed[location] ^= 1 << int(rng.integers(8))
        with suppress(DataError):
            PickledFrame.read(written(tmp_path / "a.pkl", bytes(changed)))


def test_the_golden_frames_hold_only_what_the_reader_allows_and_too_much_content_is_refused(tmp_path, monkeypatch):
    for path in sorted(FRAMES.parent.glob("*/*.pkl.gz")):
        found = {operation.name for operation, _, _ in pickletools.genops(gzip.decompress(path.read_bytes()))}
        assert found <= pickles._OPERATIONS
    monkeypatch.setattr(pickles, "LARGEST", 1000)
    with pytest.raises(DataError, match="more than 1000 bytes"):
        PickledFrame.read(written(tmp_path / "a.pkl.gz", gzip.compress(bytes(5000))))
