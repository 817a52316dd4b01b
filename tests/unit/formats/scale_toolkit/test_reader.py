"""Folders of Scale's lidar toolkit: clouds, images and poses that share the names of frames."""

import json
import pickle

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import sceneloom
from sceneloom.errors import DataError, OptionError

NEAR = 1e-9
"""Two ways of float64 through rotations."""

CAMERA = ([0.1, 0.5, 1.8], Rotation.from_euler("x", -90, degrees=True))


def trajectory(k):
    return [1.5 * k, 2.0, 0.1], Rotation.from_euler("ZYX", [10.0 * k, 1, 2], degrees=True)


def put(path, location, rotation):
    path.parent.mkdir(parents=True, exist_ok=True)
    x, y, z, w = rotation.as_quat().tolist()
    path.write_text(json.dumps({"heading": [w, x, y, z], "position": location}), "utf-8")


def cloud(k):
    rng = np.random.default_rng(k)
    rows = rng.uniform(1, 20, (6 + k, 4)).astype(np.float32)
    rows[:, 3] = rng.integers(0, 256, 6 + k)
    return rows


def write_folder(folder, names=("1", "2", "10")):
    front = folder / "cameras" / "front"
    put(front / "extrinsics.json", *CAMERA)
    (front / "intrinsics.json").write_text(json.dumps({"fx": 60, "fy": 61.0, "cx": 31, "cy": 23, "k1": 0.1}))
    (folder / "pointcloud").mkdir()
    (folder / "radar_points").mkdir()
    for k, name in enumerate(names):
        rows = cloud(k)
        head = "".join(f"property float {axis}\n" for axis in "xyzi")
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{head}end_header\n"
        (folder / "pointcloud" / f"{name}.ply").write_bytes(head.encode() + rows.tobytes())
        put(folder / "poses" / f"{name}.json", *trajectory(k))
        Image.new("RGB", (64, 48), (60 * k, 0, 0)).save(front / f"{name}.jpg")
        (folder / "radar_points" / f"{name}.txt").write_text(f"1, 2, 3, 0, 3, 4, {k + 2}\n4, 5, 6, 0, 0, 0, 1\n\n")
    return folder


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path / "drive")


def test_frames_are_in_the_order_of_their_numbers_and_keep_gaps(folder):
    scene = sceneloom.open(folder)
    assert scene.format == "scale-toolkit"
    for frames in (scene.lidars[0].frames, scene.cameras[0].images, scene.sensor("radar").frames):
        assert pickle.loads(pickle.dumps(frames))[1].timestamp_ns == frames[1].timestamp_ns
    assert scene.lidars[0].frames.timestamps_ns.tolist() == [0, 100_000_000, 900_000_000]
    assert "nominal-times" in {warning.code for warning in scene.warnings}
    slow = sceneloom.open(folder, rate_hz=2.0)
    assert slow.lidars[0].frames.timestamps_ns.tolist() == [0, 500_000_000, 4_500_000_000]
    with pytest.raises(OptionError, match="rate_hz 0"):
        sceneloom.open(folder, rate_hz=0)
    for digits in (13, 16, 19):  # long names are times
        name = "1557539924123456789"[:digits]
        scene = sceneloom.open(write_folder(folder.parent / name, (name,)))
        assert scene.lidars[0].frames.timestamps_ns.tolist() == [int(name.ljust(19, "0"))]
        assert "names-are-times" in {warning.code for warning in scene.warnings}


def test_points_are_in_the_frame_of_the_ego_cameras_along_its_poses_and_radar_points_have_speeds(folder):
    scene = sceneloom.open(folder)
    lidar, camera, radar = scene.lidars[0], scene.cameras[0], scene.sensor("radar").frames[1].points
    assert lidar.points_frame == "ego"
    points = lidar.frames[2].points
    assert np.array_equal(np.column_stack([points.positions, points.intensities]), cloud(2))
    for k in range(3):
        location, rotation = trajectory(k)
        assert np.allclose(scene.trajectories["pose"].positions[k], location)
        assert np.allclose(camera.poses.positions[k], np.array(location) + rotation.apply(CAMERA[0]), atol=NEAR)
        found = Rotation.from_quat(camera.poses.quaternions_xyzw[k])
        assert (found.inv() * rotation * CAMERA[1]).magnitude() < NEAR
    assert (camera.camera.model, camera.camera.fx, camera.camera.width) == ("pinhole", 60.0, 64)
    assert camera.extras["k1"] == 0.1  # kept, and not used
    assert "camera-model-entries" in {warning.code for warning in scene.warnings}
    assert camera.images[1].rgb.shape == (48, 64, 3)
    assert radar.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert np.allclose(radar.directions, [[0, 0.6, 0.8], [1, 0, 0]])
    assert radar.lengths.tolist() == [3.0, 0.0]


POSE, INTRINSICS = "poses/2.json", "cameras/front/intrinsics.json"
FAULTS = [
    (POSE, None, r"poses/2.json: is not there"),
    (POSE, '{"heading": [2, 0, 0, 0], "position": [0, 0, 0]}', r"2.json: heading: \[2.0, 0.0, .*\] has the length 2"),
    (POSE, '{"heading": [1, 0, 0, 0], "position": [0, "a", 0]}', r"position: \[0, 'a', 0\]; expected 3 numbers"),
    (POSE, "{", "poses/2.json: line 1, column 2: is no JSON: the file ends within its first value"),
    ("cameras/front/extrinsics.json", None, "extrinsics.json: is not there"),
    (INTRINSICS, '{"fx": 1}', r"fx, fy, cx, cy are \[1, None"),
    ("pointcloud/1.pcd", "", r"1.ply: 1.pcd is of the same frame"),
    ("pointcloud/1.ply", "ply\n", r"1.ply"),
    ("pointcloud/01.ply", "ply\n", "stands for the same time as 0?1"),
]


@pytest.mark.parametrize(("name", "text", "message"), FAULTS)
def test_what_is_wrong_with_a_folder_is_reported_with_its_location(folder, name, text, message):
    (folder / name).unlink(missing_ok=True)
    if text is not None:
        (folder / name).write_text(text)
    with pytest.raises(DataError, match=message):
        sceneloom.open(folder)


def test_poses_and_cameras_at_fault_are_left_out_and_counted_by_a_lenient_reading(folder):
    (folder / "radar_points" / "1.txt").write_text("1, 2, 3, 0, 3, 4, 2\n1, 2\n")
    with pytest.raises(DataError, match=r"1.txt: line 2: '1, 2'; expected"):  # when it is read
        sceneloom.open(folder).sensor("radar").frames[0]
    for name in (POSE, "cameras/front/extrinsics.json"):
        (folder / name).unlink()
    scene = sceneloom.open(folder, lenient=True)
    assert len(scene.trajectories["pose"].timestamps_ns) == 2
    assert scene.cameras == ()
    assert {"poses", "cameras"} <= {warning.code for warning in scene.warnings}
