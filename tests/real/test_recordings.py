"""The recordings that were made from real logs, held against their sources: scenes, samples, and written again."""

import json
import statistics
import struct
from itertools import pairwise

import numpy as np
import pytest

import sceneloom
from sceneloom.cameras import project
from sceneloom.motion.ego_trajectory import find_ego_motion
from sceneloom.scene import GnssSensor, ImuSensor

KITTI, PANDASET, OXTS = "kitti_drive", "pandaset", "kitti_oxts_0000"


@pytest.fixture
def scene(drive, request):
    """The recording whose name the test has as its parameter."""
    with sceneloom.open(drive(f"recordings/{request.param}")) as scene:
        yield scene


def of(name):
    return pytest.mark.parametrize("scene", [name], indirect=True)


@of(KITTI)
def test_kitti_drive_has_images_half_a_sweep_apart_its_calibration_the_points_of_its_files_and_a_trajectory(
    scene, drive
):
    assert (scene.warnings, scene.trajectories) == ((), {})
    lidar, camera = scene.lidars[0], scene.cameras[0]
    assert lidar.frames.timestamps_ns.tolist() == [100_000_000 * k for k in range(12)]
    assert camera.images.timestamps_ns.tolist() == [100_000_000 * k + 50_000_000 for k in range(12)]
    assert (lidar.poses, camera.poses) == (None, None)
    assert (camera.camera.width, camera.camera.height, camera.camera.model) == (1242, 374, "pinhole")
    assert (camera.camera.fx, camera.camera.cx, camera.camera.cy) == (721.5377, 609.5593, 172.854)
    assert [image.rgb.shape for image in camera.images] == [(374, 1242, 3)] * 12
    known = json.loads((drive(f"recordings/{KITTI}") / "calibration.json").read_text())
    camera_from_imu, lidar_from_imu = known["cameras"][0]["imuToCamera"], known["lidars"][0]["imuToLidar"]
    for sensor, sensor_from_imu in ((camera, camera_from_imu), (lidar, lidar_from_imu)):
        # the source gives seven digits, so its rotations are orthonormal to about 1e-7
        np.testing.assert_allclose(sensor.mount.matrix, np.linalg.inv(sensor_from_imu), atol=1e-6)
    camera_from_lidar = np.array(camera_from_imu) @ np.linalg.inv(lidar_from_imu)
    for k, sample in enumerate(scene.samples()):
        assert (sample.index, sample.sweep.timestamp_ns, sample.missing) == (k, k * 100_000_000, {})
        assert sample.images["camera0"].timestamp_ns == k * 100_000_000 + 50_000_000
        # the middle of the rotation, but for the points that never came back
        assert abs(sample.time_differences_ns["camera0"]) < 10_000_000
        assert sample.world_from_lidar is None
        # the file's matrices are rounded, ours are made orthonormal
        np.testing.assert_allclose(sample.camera_from_points["camera0"].matrix, camera_from_lidar, atol=1e-5)
    assert k == 11
    for k, frame in enumerate(lidar.frames):
        content = (drive(f"recordings/{KITTI}") / "lidar" / f"{k:06d}.bin").read_bytes()
        records = list(struct.iter_unpack("<fffBHd", content))
        assert len(frame.points) == len(records)
        x, y, z, intensity, ring, time = records[1000]
        assert frame.points.positions[1000].tolist() == [x, y, z]
        assert (frame.points.intensities[1000], frame.points.rings[1000]) == (intensity, ring)
        assert frame.points.timestamps_ns[1000] == round(time * 1e9)
        assert frame.reference_ns == round(statistics.median_high(record[5] for record in records) * 1e9)
        timestamps = frame.points.timestamps_ns - frame.timestamp_ns
        # the times were derived from azimuths in single precision, which is worth 100 ns of a sweep
        assert -100 < timestamps.min() < timestamps.max() < 100_000_000 + 100
    samples = scene.samples(trajectory=find_ego_motion(scene))
    assert samples.trajectory == "lidar"
    steps = [sample.world_from_lidar.inverse() @ later.world_from_lidar for sample, later in pairwise(samples)]
    # it crawls ahead, about as fast all the time
    forward = [step.translation[0] for step in steps]
    assert 0.1 < min(forward) <= max(forward) < 0.3
    assert max(abs(step.translation[1]) for step in steps) < 0.03


@of(PANDASET)
def test_pandaset_sensors_follow_the_ego_and_see_as_many_points_as_were_counted(scene):
    assert scene.warnings == ()
    truth, lidar = scene.trajectories["groundTruth"], scene.lidars[0]
    assert truth.timestamps_ns.tolist() == [100_000_000 * k for k in range(5)]
    # this lidar is given in the ego frame, and the points share their sweep's time, so that it is the reference
    np.testing.assert_allclose(lidar.poses.positions, truth.positions, atol=1e-12)
    assert [frame.reference_ns for frame in lidar.frames] == [100_000_000 * k for k in range(5)]
    assert [len(frame.points) for frame in lidar.frames] == [168814, 168751, 169439, 167351, 167316]
    assert [camera.id for camera in scene.cameras] == ["camera0", "camera1", "camera2"]
    for camera in scene.cameras:
        assert (len(camera.images), len(camera.poses.timestamps_ns)) == (5, 5)
        assert camera.images[4].rgb.shape == (1080, 1920, 3)
    samples = list(scene.samples())
    shares = [
        [
            project(sample.cameras[camera_id], transform.apply(sample.sweep.points.positions))[1].mean()
            for camera_id, transform in sample.camera_from_points.items()
        ]
        for sample in samples
    ]
    # the figures are of frames of the same drive, to a tenth of a per cent, of all frames together
    np.testing.assert_allclose(np.mean(shares, axis=0), [0.400, 0.218, 0.145], atol=0.003)
    arrays = [sample.arrays() for sample in samples]
    for name in arrays[0]:  # they can be stacked but for their points
        assert len({array[name].shape for array in arrays}) == 1 or name.startswith("lidar."), name
        assert len({array[name].dtype for array in arrays}) == 1, name


@of(OXTS)
def test_kitti_oxts_is_a_scene_of_motion_only(scene, drive):
    assert scene.warnings == ()
    imu, gnss = scene.sensors
    assert isinstance(imu, ImuSensor)
    assert isinstance(gnss, GnssSensor)
    assert {name: len(stream) for name, stream in imu.streams.items()} == {"accelerometer": 154, "gyroscope": 154}
    assert gnss.timestamps_ns.tolist() == [round(0.1 * k * 1e9) for k in range(154)]
    assert len(scene.trajectories["groundTruth"].positions) == 154
    fixes = [line["gps"] for line in lines_of(drive(f"recordings/{OXTS}")) if "gps" in line]
    expected = [[fix["latitude"], fix["longitude"], fix["altitude"]] for fix in fixes]
    np.testing.assert_array_equal(gnss.positions_lla, expected)


def lines_of(folder):
    lines = [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]
    return sorted(lines, key=lambda line: (line["time"], json.dumps(line, sort_keys=True)))


def files_of(folder, *, videos):
    """The content of the files that are a recording's own, but for its lines; a README says where it is from."""
    found = {}
    for path in folder.rglob("*.*"):
        if path.name not in ("README.txt", "data.jsonl") and (videos or path.suffix in (".json", ".bin")):
            content = path.read_bytes()
            found[path.relative_to(folder)] = json.loads(content) if path.suffix == ".json" else content
    return found


@pytest.mark.parametrize("name", [KITTI, PANDASET, OXTS])
def test_a_real_recording_written_again_at_once_or_through_a_scene_file_is_the_same(drive, tmp_path, name):
    source = drive(f"recordings/{name}")
    report = sceneloom.convert(source, tmp_path / "again")
    assert {loss.field for loss in report.losses} <= {"replay"}
    assert lines_of(tmp_path / "again") == lines_of(source)
    assert files_of(tmp_path / "again", videos=True) == files_of(source, videos=True)
    sceneloom.convert(source, tmp_path / "scene.sfs")
    sceneloom.convert(tmp_path / "scene.sfs", tmp_path / "through")
    if name != KITTI:
        assert lines_of(tmp_path / "through") == lines_of(source)
        kept, through = files_of(source, videos=False), files_of(tmp_path / "through", videos=False)
        assert {file: through[file] for file in kept} == kept
        return
    for line, again in zip(lines_of(source), lines_of(tmp_path / "through"), strict=True):
        # sweeps begin with their earliest point, rounded down to a microsecond
        assert abs(line.pop("time") - again.pop("time")) <= 2.5e-6
        assert line == again
