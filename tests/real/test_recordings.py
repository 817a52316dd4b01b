"""The recordings that were made from real logs, held against what their sources state."""

import json
import statistics
import struct
from pathlib import Path

import numpy as np
import pytest

from sceneloom.cameras import project
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.scene import GnssSensor, ImuSensor, Scene


def open_recording(data_dir: Path, name: str) -> Scene:
    folder = data_dir / "recordings" / name
    if not folder.is_dir():
        pytest.skip(f"no recording at {folder}")
    return FORMAT.open(folder)


def calibrated(data_dir: Path, name: str, key: str, index: int, matrix: str) -> np.ndarray:
    content = json.loads((data_dir / "recordings" / name / "calibration.json").read_text())
    return np.array(content[key][index][matrix])


def test_kitti_drive_has_twelve_sweeps_and_images_half_a_sweep_apart(data_dir):
    with open_recording(data_dir, "kitti_drive") as scene:
        assert scene.warnings == ()
        assert scene.trajectories == {}
        lidar, camera = scene.lidars[0], scene.cameras[0]
        assert lidar.frames.timestamps_ns.tolist() == [100_000_000 * k for k in range(12)]
        assert camera.images.timestamps_ns.tolist() == [100_000_000 * k + 50_000_000 for k in range(12)]
        assert lidar.poses is None
        assert camera.poses is None
        assert (camera.camera.width, camera.camera.height, camera.camera.model) == (1242, 374, "pinhole")
        assert (camera.camera.fx, camera.camera.cx, camera.camera.cy) == (721.5377, 609.5593, 172.854)
        for index, image in enumerate(camera.images):
            assert image.rgb.shape == (374, 1242, 3), index


def test_kitti_drive_points_are_those_of_the_files_and_lie_within_their_sweep(data_dir):
    folder = data_dir / "recordings" / "kitti_drive"
    with open_recording(data_dir, "kitti_drive") as scene:
        for k, frame in enumerate(scene.lidars[0].frames):
            content = (folder / "lidar" / f"{k:06d}.bin").read_bytes()
            assert len(frame.points) == len(content) // 23
            x, y, z, intensity, ring, time = struct.unpack_from("<fffBHd", content, 23 * 1000)
            assert frame.points.positions[1000].tolist() == [x, y, z]
            assert frame.points.intensities is not None
            assert frame.points.rings is not None
            assert frame.points.timestamps_ns is not None
            assert (frame.points.intensities[1000], frame.points.rings[1000]) == (intensity, ring)
            assert frame.points.timestamps_ns[1000] == round(time * 1e9)
            timestamps = frame.points.timestamps_ns - frame.timestamp_ns
            # the times were derived from azimuths in single precision, which is worth 100 ns of a sweep
            assert timestamps.min() > -100
            assert timestamps.max() < 100_000_000 + 100


def test_the_reference_of_a_sweep_is_the_median_of_its_files_point_times(data_dir):
    content = (data_dir / "recordings" / "kitti_drive" / "lidar" / "000003.bin").read_bytes()
    times = [record[5] for record in struct.iter_unpack("<fffBHd", content)]
    with open_recording(data_dir, "kitti_drive") as scene:
        assert scene.lidars[0].frames[3].reference_ns == round(statistics.median_high(times) * 1e9)


def test_kitti_drive_mountings_are_the_inverse_of_the_files_matrices(data_dir):
    with open_recording(data_dir, "kitti_drive") as scene:
        for sensor, key, matrix in (
            (scene.cameras[0], "cameras", "imuToCamera"),
            (scene.lidars[0], "lidars", "imuToLidar"),
        ):
            assert sensor.mount is not None
            expected = np.linalg.inv(calibrated(data_dir, "kitti_drive", key, 0, matrix))
            # the source gives seven digits, so its rotations are orthonormal to about 1e-7
            np.testing.assert_allclose(sensor.mount.matrix, expected, atol=1e-6)


def test_pandaset_sensors_follow_the_ego(data_dir):
    with open_recording(data_dir, "pandaset") as scene:
        assert scene.warnings == ()
        truth = scene.trajectories["groundTruth"]
        assert truth.timestamps_ns.tolist() == [100_000_000 * k for k in range(5)]
        lidar = scene.lidars[0]
        assert lidar.poses is not None
        # this lidar is given in the ego frame
        np.testing.assert_allclose(lidar.poses.positions, truth.positions, atol=1e-12)
        assert [camera.id for camera in scene.cameras] == ["camera0", "camera1", "camera2"]
        for camera in scene.cameras:
            assert len(camera.images) == 5
            assert camera.images[4].rgb.shape == (1080, 1920, 3)
            assert camera.poses is not None
            assert len(camera.poses.timestamps_ns) == 5


def test_pandaset_points_share_their_sweeps_time_so_that_it_is_the_reference(data_dir):
    with open_recording(data_dir, "pandaset") as scene:
        frames = scene.lidars[0].frames
        assert [frame.reference_ns for frame in frames] == [100_000_000 * k for k in range(5)]
        assert [len(frame.points) for frame in frames] == [168814, 168751, 169439, 167351, 167316]


@pytest.mark.parametrize(("camera", "share"), [(0, 40.0), (1, 21.8), (2, 14.5)])
def test_pandaset_points_fall_into_each_image_as_its_source_counted(data_dir, camera, share):
    with open_recording(data_dir, "pandaset") as scene:
        sensor = scene.cameras[camera]
        assert sensor.mount is not None
        inside = total = 0
        for frame in scene.lidars[0].frames:
            points_camera = sensor.mount.inverse().apply(frame.points.positions)
            inside += int(project(sensor.camera, points_camera)[1].sum())
            total += len(points_camera)
        # the counted shares are rounded to a tenth, and vary between sweeps
        assert abs(100.0 * inside / total - share) < 0.5


def test_kitti_oxts_is_a_scene_of_motion_only(data_dir):
    with open_recording(data_dir, "kitti_oxts_0000") as scene:
        assert scene.warnings == ()
        imu, gnss = scene.sensors
        assert isinstance(imu, ImuSensor)
        assert isinstance(gnss, GnssSensor)
        assert {name: len(stream) for name, stream in imu.streams.items()} == {"accelerometer": 154, "gyroscope": 154}
        assert gnss.timestamps_ns.tolist() == [round(0.1 * k * 1e9) for k in range(154)]
        assert len(scene.trajectories["groundTruth"].positions) == 154
        lines = (data_dir / "recordings" / "kitti_oxts_0000" / "data.jsonl").read_text().splitlines()
        fixes = [record["gps"] for record in map(json.loads, lines) if "gps" in record]
        expected = [[fix["latitude"], fix["longitude"], fix["altitude"]] for fix in fixes]
        np.testing.assert_array_equal(gnss.positions_lla, expected)
