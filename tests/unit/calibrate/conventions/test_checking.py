"""Files and drives whose conventions are as they state, and others."""

import json
from dataclasses import replace

import numpy as np
import pytest

import sceneloom
from sceneloom.calibrate.conventions import check_drive, check_file
from sceneloom.calibrate.frames import calibration_frames
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LazyFrames
from sceneloom.simulate import simulate_street


@pytest.fixture(scope="module")
def scene():
    """What is sensed is made when it is asked for, and each test asks again: here it is kept."""
    scene = simulate_street(4, frames=3).scene
    (camera,), (lidar,) = scene.cameras, scene.lidars
    images = [p.loaded() for p in camera.images]
    kept = {
        camera.id: replace(camera, images=LazyFrames.of(images, camera.images.timestamps_ns)),
        lidar.id: replace(lidar, frames=LazyFrames.of(list(lidar.frames), lidar.frames.timestamps_ns)),
    }
    return replace(scene, sensors=tuple(kept.get(sensor.id, sensor) for sensor in scene.sensors))


def _mounted(scene, **mounts):
    """The scene with other mountings of its sensors."""
    sensors = tuple(
        replace(sensor, poses=None, mount=mounts[sensor.id]) if sensor.id in mounts else sensor
        for sensor in scene.sensors
    )
    return replace(scene, sensors=sensors)


def test_a_drive_that_is_right_is_reported_to_be_as_read(scene):
    report = check_drive(scene)
    assert [found.as_read for found in report.extrinsics] == [True]
    assert all(found.stated in found.possible for found in report.points)
    assert {found.kind for found in report.times} >= {"lidar", "camera", "imu"}
    assert all("seconds" in found.possible for found in report.times)
    assert not report.wrong


def test_a_camera_whose_mounting_was_reversed_is_reported(scene):
    frame = calibration_frames(scene, most=1)[0]
    upside = RigidTransform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    lidar_mount = next(sensor.mount for sensor in scene.lidars)
    wrong = lidar_mount @ frame.camera_from_lidar.inverse() @ upside
    report = check_drive(_mounted(scene, camera0=wrong))
    assert [found.as_read for found in report.extrinsics] == [False]
    assert report.extrinsics[0].possible["camera axes"] == ("x right, y up, z backward",)
    assert report.wrong


def test_timestamps_in_milliseconds_read_as_seconds_are_reported(scene):
    imu = next(sensor for sensor in scene.sensors if sensor.type == "imu")
    slow = {
        name: replace(stream, timestamps_ns=stream.timestamps_ns * 1000)
        for name, stream in imu.streams.items()
    }
    report = check_drive(replace(scene, sensors=(replace(imu, streams=slow),)))
    assert [found.possible for found in report.times] == [("milliseconds",)]
    assert report.wrong


def test_a_file_is_judged_by_a_drive(scene, tmp_path):
    truth = calibration_frames(scene, most=1)[0].camera_from_lidar
    lidar_from_camera = truth.inverse()
    path = tmp_path / "rig.json"
    quaternion = np.roll(lidar_from_camera.quaternion_xyzw, 1)
    pose = {"translation": lidar_from_camera.translation.tolist(), "rotation": quaternion.tolist()}
    path.write_text(json.dumps({"front": pose}), "utf-8")
    reported = []
    (found,) = check_file(path, scene, progress=lambda done, total: reported.append((done, total))).extrinsics
    assert (found.location, found.camera, found.decided) == ("front", "camera0", True)
    assert found.possible["quaternion"] == ("w x y z",)
    assert found.possible["direction"] == ("lidar from camera",)
    np.testing.assert_allclose(found.camera_from_lidar, truth.matrix, atol=1e-6)  # rounding of the text
    assert reported == [(1, 1)]


def test_a_file_alone_is_judged_by_what_vehicles_have(tmp_path):
    path = tmp_path / "rig.txt"
    path.write_text("Tr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n", "utf-8")
    (found,) = check_file(path).extrinsics
    assert found.possible["direction"] == ("camera from lidar",)
    assert found.camera is None


def test_a_file_without_an_extrinsic_is_refused(scene, tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("nothing here", "utf-8")
    with pytest.raises(DataError, match=r"notes\.txt: no extrinsic"):
        check_file(path, scene)


@pytest.mark.parametrize("recording", ["kitti_drive", pytest.param("pandaset", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_nothing_of_real_recordings_is_reported_to_be_wrong(data_dir, recording):
    with sceneloom.open(data_dir / "recordings" / recording) as drive:
        report = check_drive(drive)
    assert not report.wrong
    assert all(found.as_read in {True, None} for found in report.extrinsics)
