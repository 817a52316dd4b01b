"""Sequences of the Zenseact Open Dataset, built to its development kit, whose formulas say what is expected."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.cameras.projection import project
from sceneloom.errors import DataError
from sceneloom.scene.annotations_at import CuboidAngles

SECOND = 1_655_212_990  # 2022-06-14T13:23:10Z
LIDAR = Rotation.from_euler("z", -90.4, degrees=True), [1.27, 0.02, 2.09]
CAMERA = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]) * Rotation.from_euler("x", 0.01), [1.9, 0.0, 1.31]
K, D = [[60.0, 0.0, 32.4, 0.0], [0.0, 60.5, 24.1, 0.0], [0.0, 0.0, 1.0, 0.0]], [0.03, -0.02, 0.004, -0.001]
SWEEPS_US, IMAGES_US = (100_000, 200_000), (105_000, 205_000)
TURNED, CENTER, SIZE = Rotation.from_euler("zyx", [1.2, 0.02, 0.01]), [2.0, 14.0, -1.1], [4.4, 1.8, 1.5]


def matrix(rotation, location):
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation.as_matrix(), location
    return found.tolist()


def ego(micros):
    s = micros / 1e6
    return Rotation.from_euler("ZYX", [0.2 * s, 0.01, 0.0]), [9.0 * s, 0.3 * s, 0.0]


def name(micros, suffix):
    return f"000002_romeo_2022-06-14T13:23:10.{micros:06d}Z{suffix}"


def records(micros):
    kinds = [(axis, np.float32) for axis in "xyz"]
    kinds += [("timestamp", np.int64), ("intensity", np.uint8), ("diode_index", np.uint8)]
    rng, found = np.random.default_rng(micros), np.zeros(40, kinds)
    for axis in "xyz":
        found[axis] = rng.uniform(-40, 40, 40)
    found["timestamp"] = np.sort(rng.integers(-50_000, 50_000, 40))
    found["intensity"], found["diode_index"] = rng.integers(0, 256, 40), rng.integers(0, 128, 40)
    return found


def texts():
    """The JSON files of a sequence."""
    about = {"extrinsics": matrix(*CAMERA), "lidar_extrinsics": matrix(*LIDAR), "intrinsics": K, "distortion": D}
    about |= {"undistortion": D, "image_dimensions": [64, 48], "field_of_view": [120.0, 67.0]}
    times = range(0, 320_000, 10_000)
    poses = [matrix(*ego(micros)) for micros in times]
    path = f"sequences/000002/lidar_velodyne/{name(SWEEPS_US[1], '.npy')}"
    lidar = [{"filepath": path, "time": "2022-06-14T13:23:10.200000Z", "is_compensated": True}]
    turned = dict(zip(("qx", "qy", "qz", "qw"), TURNED.as_quat().tolist(), strict=True))
    car = {"annotation_uuid": "car", "class": "Vehicle", "type": "Car", "unclear": False, "occlusion_ratio": "None"}
    car |= {"location_3d": {"type": "Point", "coordinates": CENTER}}
    car |= {f"size_3d_{key}": value for key, value in zip(("length", "width", "height"), SIZE, strict=True)}
    car |= {f"orientation_3d_{key}": value for key, value in turned.items()}
    sign = {"annotation_uuid": "sign", "class": "TrafficSign", "unclear": True}
    points = {"type": "MultiPoint", "coordinates": [[10.5, 20.0], [14.0, 18.5], [18.0, 21.0], [12.0, 26.0]]}
    return {
        "calibration.json": {"FC": about},
        "metadata.json": {"sequence_id": "000002", "country_code": "PL"},
        "ego_motion.json": {"poses": poses, "timestamps": [SECOND + micros / 1e6 for micros in times]},
        "info.json": {"keyframe_time": "2022-06-14T13:23:10.204000Z", "lidar_frames": {"velodyne": lidar}},
        "annotations/object_detection.json": [{"geometry": points, "properties": one} for one in (car, sign)],
    }


def write_sequence(folder):
    for inner in ("camera_front_blur", "lidar_velodyne", "annotations"):
        (folder / inner).mkdir(parents=True)
    for file, content in texts().items():
        (folder / file).write_text(json.dumps(content))
    for micros in SWEEPS_US:
        np.save(folder / "lidar_velodyne" / name(micros, ".npy"), records(micros))
    for micros in IMAGES_US:
        Image.new("RGB", (64, 48), (micros // 1000, 0, 0)).save(folder / "camera_front_blur" / name(micros, ".jpg"))
    return folder


@pytest.fixture
def folder(tmp_path):
    return write_sequence(tmp_path / "sequences" / "000002")


def test_points_images_and_sensors_are_as_the_files_state(folder):
    scene = sceneloom.open(folder.parent)
    lidar, camera = scene.sensors
    for frame, micros, moved in zip(lidar.frames, SWEEPS_US, (False, True), strict=True):
        rows, core = records(micros), SECOND * 10**9 + 1000 * micros
        assert np.array_equal(frame.points.positions, np.stack([rows[axis] for axis in "xyz"], axis=1))
        measured = core + 1000 * rows["timestamp"]
        assert np.array_equal(frame.points.timestamps_ns, np.full(40, core) if moved else measured)
        assert np.array_equal(frame.points.intensities, rows["intensity"])
        assert np.array_equal(frame.points.rings, rows["diode_index"])
        assert frame.timestamp_ns == core
    assert camera.images.timestamps_ns.tolist() == [SECOND * 10**9 + 1000 * micros for micros in IMAGES_US]
    assert abs(int(camera.images[1].rgb[0, 0, 0]) - 205) < 4
    for sensor, micros, (rotation, location) in ((lidar, SWEEPS_US[1], LIDAR), (camera, IMAGES_US[1], CAMERA)):
        turned, here = ego(micros)
        assert np.allclose(sensor.poses.positions[1], turned.apply(location) + here, atol=1e-4)
        assert (Rotation.from_quat(sensor.poses.quaternions_xyzw[1]).inv() * turned * rotation).magnitude() < 1e-5
    assert scene.metadata["zod"]["country_code"] == "PL"


def test_images_are_projected_as_by_the_development_kit(folder):
    camera = sceneloom.open(folder).sensor("camera_front").camera
    points = np.array([[0.4, -0.3, 1.0], [-0.2, 0.1, 2.0]])
    sides = np.hypot(points[:, 0], points[:, 1])
    angles = np.arctan2(sides, points[:, 2])
    bent = angles * (1 + sum(d * angles ** (2 * k) for k, d in enumerate(D, 1)))
    pixels, visible = project(camera, points)
    expected = points[:, :2] / sides[:, None] * bent[:, None] * [K[0][0], K[1][1]] + [K[0][2], K[1][2]]
    assert visible.all()
    assert np.allclose(pixels, expected, atol=1e-6)


def test_objects_are_at_the_key_frame_in_the_world_and_in_its_image(folder):
    scene = sceneloom.open(folder)
    car, seen, sign = scene.annotations
    assert (car.id, car.label, seen.id, sign.id) == ("car", "Vehicle", "car:2d", "sign:2d")
    assert [(one.name, one.values) for one in sign.attributes] == [("unclear", ("true",))]
    turned, here = ego(SWEEPS_US[1])
    rotation, location = LIDAR
    row = car.path.values[0]
    assert car.path.timestamps_ns.tolist() == [SECOND * 10**9 + 1000 * SWEEPS_US[1]]
    assert row[:3].tolist() == SIZE
    assert np.allclose(row[3:6], turned.apply(rotation.apply(CENTER) + location) + here, atol=1e-4)
    found = Rotation.from_quat(CuboidAngles.of(scene).quaternions(row[6:]))
    assert (found.inv() * turned * rotation * TURNED).magnitude() < 1e-5
    assert seen.path.values.tolist() == [[10.5, 18.5, 7.5, 7.5]]
    assert seen.path.timestamps_ns.tolist() == [SECOND * 10**9 + 1000 * IMAGES_US[1]]


def test_what_is_missing_is_named(folder):
    (folder / "ego_motion.json").unlink()
    scene = sceneloom.open(folder)
    assert {"no-poses", "cuboids-without-pose"} <= {warning.code for warning in scene.warnings}
    assert [annotation.type for annotation in scene.annotations] == ["box_2d", "box_2d"]
    (folder / "lidar_velodyne" / "sweep.npy").touch()
    with pytest.raises(DataError, match="expected a name such as"):
        sceneloom.open(folder)
