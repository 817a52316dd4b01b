"""Folders that we write, read by pykitti: the same points, images, times, locations and calibrations."""

import numpy as np
import pytest
from tests.peers import python_with

from sceneloom.cameras.camera import Camera
from sceneloom.formats import open_scene, write_scene
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

PROGRAM = """
import json, sys, types
for name in ("cv2", "pandas"):  # its reader of tracking wants them, which is not asked here
    sys.modules[name] = types.ModuleType(name)
import numpy as np
import pykitti
drive = getattr(pykitti, sys.argv[1])(*sys.argv[2:])
found = {
    "points": [drive.get_velo(k).tolist() for k in range(len(drive.velo_files))],
    "image": np.asarray(drive.get_cam2(1)).tolist(),
    "K": drive.calib.K_cam2.tolist(), "cam2_velo": drive.calib.T_cam2_velo.tolist(),
}
if sys.argv[1] == "raw":
    found["times"] = [t.strftime("%Y-%m-%d %H:%M:%S.%f") for t in drive.timestamps]
    found["trajectory"] = [o.T_w_imu.tolist() for o in drive.oxts]
    found["velo_imu"] = drive.calib.T_velo_imu.tolist()
    found["accelerations"] = [o.packet.az for o in drive.oxts]
else:
    found["times"] = [t.total_seconds() for t in drive.timestamps]
    found["poses"] = [p.tolist() for p in drive.poses]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def drive():
    camera = CameraSpec(Camera("pinhole", 160, 48, 90.0, 90.0, 79.5, 23.5), camera_mount())
    return simulate_street(5, frames=3, lidar=LidarSpec(beams=8, steps=90), cameras=(camera,)).scene


def check_common(found, back):
    lidar, camera = back.lidars[0], back.cameras[0]
    for reported, frame in zip(found["points"], lidar.frames, strict=True):
        np.testing.assert_array_equal(np.array(reported, np.float32)[:, :3], frame.points.positions)
        np.testing.assert_allclose(np.array(reported)[:, 3] * 255, frame.points.intensities, atol=1e-4)
    np.testing.assert_array_equal(found["image"], camera.images[1].rgb)
    np.testing.assert_allclose(found["K"], camera.camera.matrix, atol=1e-12)
    camera_from_lidar = camera.mount.inverse() @ lidar.mount
    np.testing.assert_allclose(found["cam2_velo"], camera_from_lidar.matrix, atol=1e-12)


@pytest.fixture(scope="session")
def pykitti_python():
    return python_with("pykitti", "SCENELOOM_PYKITTI_PYTHON")


def test_raw_drives_are_read_there(pykitti_python, ask, drive, tmp_path):
    write_scene(drive, tmp_path / "out", format="kitti-raw", kind="sync")
    back = open_scene(tmp_path / "out")
    found = ask(pykitti_python, PROGRAM, "raw", tmp_path / "out", "1970_01_01", "0001")
    check_common(found, back)
    trajectory = back.trajectories["oxts"]
    times = np.array(found["times"], "datetime64[us]").astype(np.int64)
    np.testing.assert_array_equal(times, trajectory.timestamps_ns // 1000)
    np.testing.assert_allclose(found["velo_imu"], back.lidars[0].mount.inverse().matrix, atol=1e-12)
    np.testing.assert_array_equal(found["accelerations"], back.sensor("imu").streams["accelerometer"].values[:, 2])
    poses = trajectory.poses.interpolate(trajectory.timestamps_ns)
    for reported, position in zip(found["trajectory"], poses.positions, strict=True):
        # theirs is a Mercator projection on a sphere: 0.7 % off the ellipsoid's metres at the equator
        np.testing.assert_allclose(np.array(reported)[:3, 3], position, atol=0.01 * (1 + np.linalg.norm(position)))


def test_odometry_sequences_are_read_there(pykitti_python, ask, drive, tmp_path):
    write_scene(drive, tmp_path / "out", format="kitti-odometry")
    back = open_scene(tmp_path / "out")
    found = ask(pykitti_python, PROGRAM, "odometry", tmp_path / "out", "00")
    # of cameras 1 to 3 they take the horizontal shift only; of a single camera there is none
    check_common(found, back)
    np.testing.assert_allclose(found["times"], back.lidars[0].frames.timestamps_ns / 1e9, atol=1e-6)
    camera_from_lidar = (back.cameras[0].mount.inverse() @ back.lidars[0].mount).matrix
    trajectory = back.trajectories["groundTruth"].poses.interpolate(back.lidars[0].frames.timestamps_ns)
    for reported, position in zip(found["poses"], trajectory.positions, strict=True):
        lidar_pose = np.linalg.inv(camera_from_lidar) @ np.array(reported) @ camera_from_lidar
        np.testing.assert_allclose(lidar_pose[:3, 3], position, atol=1e-9)
