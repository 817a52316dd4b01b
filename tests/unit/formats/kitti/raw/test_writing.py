"""Drives of KITTI's raw data that are read and written again: the same files, as far as they state something."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.formats import open_scene, write_scene
from sceneloom.simulate import LidarSpec, simulate_street

KEPT = (
    "calib_cam_to_cam.txt",
    "calib_velo_to_cam.txt",
    "calib_imu_to_velo.txt",
    "DRIVE/image_02/timestamps.txt",
    "DRIVE/velodyne_points/timestamps.txt",
    "DRIVE/velodyne_points/timestamps_start.txt",
    "DRIVE/velodyne_points/timestamps_end.txt",
    "DRIVE/oxts/timestamps.txt",
)


def words(path):
    """The words of a file, numbers as numbers."""
    found = []
    for word in path.read_text().split():
        try:
            found.append(float(word))
        except ValueError:
            found.append(word)
    return found


@pytest.mark.parametrize(("kind", "size"), [("sync", (36, 28)), ("extract", (40, 30))])
def test_a_drive_comes_back_file_by_file(raw_folder, tmp_path, kind, size):
    drive = f"2011_09_26_drive_0001_{kind}"
    root = raw_folder(drive=drive, size=size)
    losses = write_scene(open_scene(root), tmp_path / "out", format="kitti-raw")
    day, again = root / "2011_09_26", tmp_path / "out/2011_09_26"
    for name in (name.replace("DRIVE", drive) for name in KEPT):
        assert (again / name).read_text() == (day / name).read_text(), name
    for k in range(2):
        image, sweep = f"{drive}/image_02/data/{k:010d}.png", f"{drive}/velodyne_points/data/{k:010d}.bin"
        assert (again / image).read_bytes() == (day / image).read_bytes()
        np.testing.assert_allclose(
            np.fromfile(again / sweep, np.float32), np.fromfile(day / sweep, np.float32), atol=1 / 510
        )  # reflectance has 256 steps
        line = f"{drive}/oxts/data/{k:010d}.txt"
        np.testing.assert_allclose(words(again / line), words(day / line), rtol=1e-12, atol=1e-14)
    assert not [loss for loss in losses if loss.field.startswith("sensors")]


def test_tracklets_and_times_of_points_come_back(raw_folder, tmp_path):
    before = open_scene(raw_folder())
    write_scene(before, tmp_path / "out", format="kitti-raw")
    after = open_scene(tmp_path / "out")
    for one, other in zip(before.sensor("velodyne").frames, after.sensor("velodyne").frames, strict=True):
        assert other.timestamp_ns == one.timestamp_ns
        np.testing.assert_array_equal(other.points.timestamps_ns, one.points.timestamps_ns)
    (box,), (again,) = before.annotations, after.annotations
    np.testing.assert_array_equal(again.path.timestamps_ns, box.path.timestamps_ns)
    np.testing.assert_allclose(again.path.values, box.path.values, atol=1e-9)
    reported = {attribute.name: attribute.values for attribute in box.attributes}
    assert {attribute.name: attribute.values for attribute in again.attributes} == reported


def test_a_changed_camera_model_makes_new_calibration_files(raw_folder, tmp_path):
    scene = open_scene(raw_folder())
    camera = scene.sensor("camera2")
    camera_model = replace(camera.camera, fx=49.0)
    changed = replace(
        scene,
        sensors=tuple(replace(s, camera=camera_model) if s.id == "camera2" else s for s in scene.sensors),
    )
    write_scene(changed, tmp_path / "out", format="kitti-raw")
    again = open_scene(tmp_path / "out").sensor("camera2")
    assert again.camera == camera_model
    np.testing.assert_allclose(again.mount.matrix, camera.mount.matrix, atol=1e-12)


def test_boxes_of_the_last_sweep_lie_on_the_way(tmp_path):
    drive = simulate_street(
        4, frames=18, lidar=LidarSpec(beams=8, steps=450), cameras=()
    )  # moments jitter by 0.2 ms
    write_scene(drive.scene, tmp_path / "out", format="kitti-raw")
    after = open_scene(tmp_path / "out")
    assert not [warning for warning in after.warnings if warning.code == "boxes-beyond-trajectory"]
    lidar = after.sensor("velodyne")
    np.testing.assert_array_equal(lidar.poses.timestamps_ns, lidar.frames.timestamps_ns)
    np.testing.assert_array_equal(after.trajectories["oxts"].timestamps_ns, lidar.frames.timestamps_ns)
