"""Logs of Argoverse 2: what their tables state is in the scene, number for number."""

import pickle
import sys
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.errors import DataError, MissingExtraError, OptionError
from sceneloom.formats.argoverse2.reader import read_columns
from sceneloom.formats.base import files as base_files
from sceneloom.formats.base.registry import drives_of
from sceneloom.scene.annotations_at import CuboidAngles

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed")
feather = pytest.importorskip("pyarrow.feather", reason="pyarrow is not installed")

FIRST_NS = 315_966_265_259_836_123
NEAR = 1e-9
"""Two ways of float64 through rotations, of numbers up to 6000."""

UP = Rotation.from_euler("z", -0.6, degrees=True)
DOWN = Rotation.from_euler("xyz", [180, 0.2, 11], degrees=True)
CAMERA = Rotation.from_quat([-0.5, 0.5, -0.5, 0.5])
MOUNTS = {
    "up_lidar": ([1.35, 0.0, 1.64], UP),
    "down_lidar": ([1.35, 0.0, 1.53], DOWN),
    "ring_front_center": ([1.63, 0.0, 1.4], CAMERA),
}


MOUNTINGS, CAMERA_MODELS = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
BOX = Rotation.from_euler("z", 40, degrees=True)


def table(path, **columns):
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), str(path), compression="lz4")


def poses(locations, rotations):
    columns = np.hstack([locations, [rotation.as_quat() for rotation in rotations]]).T
    return dict(zip(["tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"], columns, strict=True))


def ego_pose(timestamp_ns):
    s = (timestamp_ns - FIRST_NS) / 1e9
    return [5172.0 + 10 * s, 2419.0, 66.9], Rotation.from_euler("ZYX", [-28 + 6 * s, 1, 2], degrees=True)


def sweep(k):
    rng, count = np.random.default_rng(k), 30 + k
    return {
        **{axis: rng.uniform(-50, 50, count).astype(np.float16) for axis in "xyz"},
        "intensity": rng.integers(0, 256, count).astype(np.uint8),
        "laser_number": rng.integers(0, 64, count).astype(np.uint8),
        "offset_ns": np.sort(rng.integers(0, 100_000_000, count)).astype(np.int32),
    }


def write_log(log):
    timestamps = np.array([FIRST_NS + 10_000_000 * k for k in range(-3, 14)])
    timestamps = np.random.default_rng(5).permutation(timestamps)  # logs are nearly sorted, and not quite
    located = poses(*zip(*map(ego_pose, timestamps.tolist()), strict=True))
    table(log / "city_SE3_egovehicle.feather", timestamp_ns=timestamps, **located)
    table(log / MOUNTINGS, sensor_name=list(MOUNTS), **poses(*zip(*MOUNTS.values(), strict=True)))
    camera_model = {"fx_px": 60.0, "fy_px": 61.0, "cx_px": 31.0, "cy_px": 24.0, "k1": -0.24, "k2": -0.2, "k3": 0.3}
    table(
        log / CAMERA_MODELS,
        sensor_name=["ring_front_center"],
        **{name: [value] for name, value in camera_model.items()},
        height_px=np.array([48], np.uint16),
        width_px=np.array([64], np.uint16),
    )
    for k in range(2):
        table(log / "sensors" / "lidar" / f"{FIRST_NS + 100_000_000 * k}.feather", **sweep(k))
    images = log / "sensors" / "cameras" / "ring_front_center"
    images.mkdir(parents=True)
    for k in range(3):
        Image.new("RGB", (64, 48), (60 * k, 0, 0)).save(images / f"{FIRST_NS + 50_000_000 * k}.jpg")
    table(
        log / "annotations.feather",
        timestamp_ns=[FIRST_NS, FIRST_NS + 100_000_000, FIRST_NS],
        track_uuid=["car", "car", "sign"],
        category=["REGULAR_VEHICLE", "REGULAR_VEHICLE", "SIGN"],
        length_m=[4.5, 4.5, 0.2],
        width_m=[1.9, 1.9, 0.7],
        height_m=[1.6, 1.6, 0.8],
        **poses([[10.0, 2.0, 0.5], [9.0, 2.0, 0.5], [30.0, 0.0, 1.0]], [BOX] * 3),
        num_interior_pts=[12, 9, 1],
    )
    return log


@pytest.fixture
def log(tmp_path):
    return write_log(tmp_path / "7fab2350")


def test_points_of_both_lidars_are_distinguished_by_their_lasers_or_given_as_one(log):
    scene = sceneloom.open(log)
    rows = sweep(1)
    for sensor_id, chosen in (("up_lidar", rows["laser_number"] < 32), ("down_lidar", rows["laser_number"] >= 32)):
        lidar = scene.sensor(sensor_id)
        points = lidar.frames[1].points
        assert lidar.points_frame == "ego"
        assert np.array_equal(points.positions, np.stack([rows[a][chosen] for a in "xyz"], axis=1))
        found = {"laser_number": points.rings, "intensity": points.intensities, "offset_ns": points.extras["offset_ns"]}
        for name, values in found.items():
            assert values.tolist() == rows[name][chosen].tolist()
        # they were moved to where the ego was at the timestamp: moving them again would be wrong
        assert set(points.timestamps_ns.tolist()) == {FIRST_NS + 100_000_000}
    for reported in (True, "true", "yes"):
        scene = sceneloom.open(log, one_lidar=reported)
        assert [lidar.id for lidar in scene.lidars] == ["lidar"]
        assert len(scene.lidars[0].frames[1].points) == 31
        assert "lidars-joined" in {warning.code for warning in scene.warnings}
    with pytest.raises(OptionError, match="one_lidar 'both'; expected true or false"):
        sceneloom.open(log, one_lidar="both")


def test_sensors_and_boxes_are_where_the_ego_and_their_mountings_state(log):
    scene = sceneloom.open(log)
    times = scene.trajectories["pose"].timestamps_ns.tolist()
    assert times == [FIRST_NS + 10_000_000 * k for k in range(-3, 14)]
    for name, (location, rotation) in MOUNTS.items():
        sensor = scene.sensor(name)
        assert np.allclose(sensor.mount.matrix[:3, 3], location)
        for k, timestamp in enumerate(sensor.poses.timestamps_ns.tolist()):
            ego, ego_rotation = ego_pose(timestamp)
            assert np.allclose(sensor.poses.positions[k], ego + ego_rotation.apply(location), atol=NEAR)
            found = Rotation.from_quat(sensor.poses.quaternions_xyzw[k])
            assert (found.inv() * ego_rotation * rotation).magnitude() < NEAR
    for frames in (scene.lidars[0].frames, scene.cameras[0].images):
        assert pickle.loads(pickle.dumps(frames))[1].timestamp_ns == frames[1].timestamp_ns
    car, sign = scene.annotations
    assert (car.id, car.label, sign.label) == ("car", "REGULAR_VEHICLE", "SIGN")
    assert car.attributes[0].values == (12, 9)
    for k, location in enumerate([[10.0, 2.0, 0.5], [9.0, 2.0, 0.5]]):
        ego, rotation = ego_pose(FIRST_NS + 100_000_000 * k)
        row = car.path.values[k]
        assert row[:3].tolist() == [4.5, 1.9, 1.6]
        assert np.allclose(row[3:6], ego + rotation.apply(location), atol=NEAR)
        found = Rotation.from_quat(CuboidAngles.of(scene).quaternions(row[6:]))
        assert (found.inv() * rotation * BOX).magnitude() < NEAR


def test_images_are_undistorted_unless_somebody_says_otherwise_and_faults_of_frames_reported_when_they_are_read(log):
    camera = sceneloom.open(log).cameras[0]
    assert (camera.camera.model, camera.camera.coefficients) == ("pinhole", ())
    assert camera.extras["k1"] == -0.24
    assert camera.images[2].rgb.shape == (48, 64, 3)
    camera_model = sceneloom.open(log, distorted=True).cameras[0].camera
    assert camera_model.model == "brown_conrady"
    assert camera_model.coefficients[:6] == (-0.24, -0.2, 0.0, 0.0, 0.3, 0.0)
    cut(f"sensors/lidar/{FIRST_NS}.feather")(log)
    content = BytesIO()
    Image.new("RGB", (32, 48)).save(content, "JPEG")
    (log / "sensors/cameras/ring_front_center" / f"{FIRST_NS}.jpg").write_bytes(content.getvalue())
    scene = sceneloom.open(log)
    with pytest.raises(DataError, match=f"{FIRST_NS}.feather: is no whole feather file"):
        scene.lidars[0].frames[0]
    with pytest.raises(DataError, match="is 32x48; expected 64x48"):
        _ = scene.cameras[0].images[0].rgb


def test_one_of_several_logs_has_to_be_chosen(tmp_path):
    for name in ("one", "two"):
        write_log(tmp_path / name)
    with pytest.raises(OptionError, match="2 logs; choose one with `--sequence NAME`: one, two"):
        sceneloom.open(tmp_path)
    assert drives_of(tmp_path) == [tmp_path / "one", tmp_path / "two"]
    with pytest.raises(OptionError, match="no log 'three'; it has one, two"):
        sceneloom.open(tmp_path, sequence="three")
    assert sceneloom.open(tmp_path, sequence="two").metadata["argoverse2"]["log"] == "two"


def without(name):
    return lambda log: (log / name).unlink()


def cut(name):
    def change(log):
        (path,) = log.glob(name)
        path.write_bytes(path.read_bytes()[:-40])

    return change


def changed(name, **columns):
    def change(log):
        whole = feather.read_table(str(log / name)).to_pydict() | columns
        table(log / name, **{key: value for key, value in whole.items() if value is not None})

    return change


def boxes(**columns):
    return changed("annotations.feather", **columns)


FRONT = "ring_front_center"
FAULTS = [
    (without("city_SE3_egovehicle.feather"), "city_SE3_egovehicle.feather: is not there"),
    (without(MOUNTINGS), "egovehicle_SE3_sensor.feather: is not there"),
    (without(CAMERA_MODELS), "is not there; expected the camera models of ring_front_center"),
    (changed(CAMERA_MODELS, sensor_name=["x"]), "no camera 'ring_front_center'; it has x"),
    (cut("city_SE3_egovehicle.feather"), "is no whole feather file"),
    (boxes(height_m=None), "no column height_m; it has timestamp_ns"),
    (boxes(length_m=["a"] * 3), "length_m: values of type string"),
    (boxes(length_m=[1.0, None, 1.0]), "length_m: 1 values are missing"),
    (boxes(width_m=[1.0, 0.0, 1.0]), r"row 1: length_m, width_m, height_m"),
    (boxes(qx=[0.0, 3.0, 0.0]), r"row 1: qx, qy, qz, qw: .*expected 1"),
    (boxes(tx_m=[0.0, 0.0, np.inf]), "tx_m: row 2 is not finite"),
    (boxes(timestamp_ns=[FIRST_NS, 5, FIRST_NS]), "row 1 is at 5 ns; expected a time of which the ego's pose is known"),
    (boxes(timestamp_ns=[FIRST_NS] * 3), f"row 1: track 'car' has two boxes at {FIRST_NS} ns"),
    (
        changed(MOUNTINGS, sensor_name=["up_lidar", "lidar", "camera"]),
        "no sensor 'down_lidar'; it has up_lidar, lidar, ",
    ),
    (
        lambda log: [file.unlink() for file in log.glob("sensors/lidar/*")],
        "sensors/lidar: no sweep; expected files such",
    ),
    (
        lambda log: table(log / "sensors/lidar/first.feather", **sweep(0)),
        "first.feather: expected files named after their",
    ),
    (lambda log: [without(name)(log) for name in ("city_SE3_egovehicle.feather", MOUNTINGS)], "has sensors/lidar/"),
]


@pytest.mark.parametrize(("change", "message"), FAULTS)
def test_what_is_wrong_with_a_log_is_reported_with_its_location(log, change, message):
    change(log)
    with pytest.raises(DataError, match=message):
        sceneloom.open(log)


def test_boxes_of_other_times_can_be_left_out_and_without_pyarrow_the_extra_is_named(log, monkeypatch):
    boxes(timestamp_ns=[FIRST_NS, 5, FIRST_NS])(log)
    scene = sceneloom.open(log, lenient=True)
    assert [len(cuboid.path.values) for cuboid in scene.annotations] == [1, 1]
    assert {warning.code: warning.count for warning in scene.warnings}["boxes-without-pose"] == 1
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(MissingExtraError, match=r"sceneloom\[argoverse\]"):
        sceneloom.open(log)


@pytest.mark.parametrize("gone", [(MOUNTINGS,), (CAMERA_MODELS,), (MOUNTINGS, CAMERA_MODELS)])
@pytest.mark.parametrize("how", [without, cut])
def test_a_lenient_reading_does_without_calibration(log, gone, how):
    for name in gone:
        how(name)(log)
    with sceneloom.open(log, lenient=True) as scene:
        assert [len(lidar.frames[0].points.positions) > 0 for lidar in scene.lidars] == [True, True]
        assert all((lidar.mount is None) is (MOUNTINGS in gone) for lidar in scene.lidars)
        assert len(scene.cameras) == int(CAMERA_MODELS not in gone)
        codes = {warning.code for warning in scene.warnings}
        assert codes >= {"mountings-missing" if name == MOUNTINGS else "camera-models-missing" for name in gone}


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_columns_that_declare_far_more_than_their_bytes_are_refused_before_they_are_unpacked(
    tmp_path, monkeypatch, compression
):
    path = tmp_path / "table.feather"
    words = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10**6, np.int32)), ["car"])
    table = pa.table({"x": np.zeros(10**6), "word": words})
    feather.write_feather(table, path, compression=compression)
    assert len(read_columns(path, {"x": np.float64})["x"]) == 10**6
    monkeypatch.setattr(base_files, "ALWAYS_UNPACKED", 10**6)
    monkeypatch.setattr(feather, "read_table", lambda *_, **__: pytest.fail("it was unpacked"))
    with pytest.raises(DataError, match="bytes that unpack to"):
        read_columns(path, {"x": np.float64})
    monkeypatch.undo()
    feather.write_feather(pa.table({"x": np.arange(10.0)}), path, compression="uncompressed")
    assert read_columns(path, {"x": np.float64})["x"].tolist() == list(range(10))
