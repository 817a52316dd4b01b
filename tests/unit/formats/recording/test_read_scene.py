"""A recording as a scene: recognising, options, the frame tree, and folders that are no recording."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.errors import DataError, OptionError
from sceneloom.formats import open_scene
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.scene import Coordinates, PointsFrame, SensorType

IMU_LINE = '{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":0}'
POINT = (1.0, 2.0, 3.0, 4, 5, 0.0)
IMU_TO_SENSOR = np.array([[0.0, -1, 0, 0.5], [0, 0, -1, 1.5], [1, 0, 0, -0.25], [0, 0, 0, 1]])


def pose_line(time: float, rotation: Rotation, position: np.ndarray) -> dict[str, Any]:
    orientation = dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))
    pose = {"position": dict(zip("xyz", position.tolist(), strict=True)), "orientation": orientation}
    return {"groundTruth": pose, "time": time}


def sweep(time: float) -> dict[str, Any]:
    return {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": time}


@pytest.mark.parametrize("name", ["", "data.jsonl"])
def test_a_folder_or_its_lines_name_a_recording(recording, name):
    recording.lines([IMU_LINE])
    path = recording.path / name
    assert FORMAT.sniff(path)
    with open_scene(path) as scene:
        assert scene.format == "recording"
        assert scene.source == str(recording.path)
        assert [(sensor.id, sensor.type) for sensor in scene.sensors] == [("imu", SensorType.IMU)]


def test_other_paths_are_not_recognised(recording, tmp_path):
    (tmp_path / "other.jsonl").write_text('{"speed": 1.5, "time": 0.0}\n')
    for path in (recording.path, tmp_path / "other.jsonl", tmp_path / "missing"):
        assert not FORMAT.sniff(path)


def test_a_folder_that_is_none_or_empty_is_an_error(recording, tmp_path):
    for name in ("drive", "missing", "missing/data.jsonl"):
        with pytest.raises(DataError, match=r"expected a recording's folder"):
            FORMAT.open(tmp_path / name)
    with pytest.raises(DataError, match=r"data\.jsonl: is empty"):
        recording.lines([]).open(lenient=True)


def test_unknown_options_and_values_are_refused(recording):
    recording.lines([IMU_LINE])
    for options, problem in (
        ({"speed": 2}, "option 'speed'; opening a recording takes lenient, altitude"),
        ({"altitude": "moon"}, "altitude 'moon'; expected one of: wgs84, msl"),
        ({"camera_shift": "both"}, "camera_shift 'both'; expected one of: ignore, apply, subtract"),
        ({"image_index": "nearest"}, "image_index 'nearest'; expected one of: auto, number, first, line"),
    ):
        with pytest.raises(OptionError, match=problem):
            recording.open(**options)
    with recording.open() as scene, pytest.raises(OptionError, match="option 'speed'; writing"):
        FORMAT.write(scene, recording.path.with_name("copy"), speed=2)


def test_altitudes_and_settings_of_the_vendors_software_are_recorded(recording):
    path = recording.lines([IMU_LINE]).path / "vio_config.yaml"
    path.write_text("useSlam: true  # yes\n")
    for altitude in ("wgs84", "msl"):
        metadata = recording.open(altitude=altitude).metadata["recording"]
        assert (metadata["altitude"], metadata["vio_config"]) == (altitude, "useSlam: true  # yes\n")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(DataError, match=r"vio_config\.yaml: cannot be read as text"):
        recording.open()
    assert [warning.code for warning in recording.open(lenient=True).warnings] == ["unreadable-vio-config"]


def test_sensor_poses_are_the_trajectory_after_the_mounting_at_the_sensors_own_times(recording, pinhole):
    rng = np.random.default_rng(5)
    times = np.array([0.0, 0.1, 0.2])
    rotations = Rotation.random(3, rng)
    positions = rng.normal(size=(3, 3))
    lines = [pose_line(t, rotations[k], positions[k]) for k, t in enumerate(times)]
    lines += [sweep(0.05), {"frames": [{"cameraInd": 0, "time": 0.125}], "number": 0, "time": 0.1}]
    recording.points("0.bin", [POINT]).video("data.mkv", 1).lines(sorted(lines, key=lambda line: line["time"]))
    matrix = IMU_TO_SENSOR.tolist()
    recording.calibration([pinhole | {"imuToCamera": matrix}], lidars=[{"imuToLidar": matrix}])
    with recording.open() as scene:
        for sensor, time in ((scene.lidars[0], 0.05), (scene.cameras[0], 0.125)):
            assert sensor.coordinates is Coordinates.WORLD
            assert sensor.poses.timestamps_ns.tolist() == [round(time * 1e9)]
            world_from_ego = np.eye(4)
            world_from_ego[:3, :3] = Slerp(times, rotations)([time]).as_matrix()[0]
            world_from_ego[:3, 3] = [np.interp(time, times, positions[:, axis]) for axis in range(3)]
            expected = world_from_ego @ np.linalg.inv(IMU_TO_SENSOR)
            found = Rotation.from_quat(sensor.poses.quaternions_xyzw[0]).as_matrix()
            # float64 throughout
            np.testing.assert_allclose(found, expected[:3, :3], atol=1e-12)
            np.testing.assert_allclose(sensor.poses.positions[0], expected[:3, 3], atol=1e-12)
        assert scene.lidars[0].points_frame is PointsFrame.SENSOR


def test_frames_beyond_the_trajectory_get_no_pose(recording):
    still = Rotation.identity()
    recording.points("0.bin", [POINT]).calibration(lidars=[{"imuToLidar": np.eye(4).tolist()}])
    lines = [sweep(0.0), pose_line(0.1, still, np.zeros(3)), sweep(0.2), pose_line(0.3, still, np.ones(3)), sweep(0.4)]
    lidar = recording.lines(lines).open().lidars[0]
    assert len(lidar.frames) == 3
    assert lidar.poses.timestamps_ns.tolist() == [200_000_000]
    np.testing.assert_allclose(lidar.poses.positions, [[0.5, 0.5, 0.5]], atol=1e-12)
    for late in ([pose_line(5.0, still, np.zeros(3))], []):
        assert recording.lines([sweep(0.0), *late]).open().lidars[0].poses is None


def test_a_lines_own_mounting_counts_for_its_pose(recording, pinhole):
    lines = [pose_line(t, Rotation.identity(), np.zeros(3)) for t in (0.0, 1.0)]
    entries = [{"cameraInd": 0}, {"cameraInd": 0, "imuToCamera": IMU_TO_SENSOR.tolist()}]
    lines += [{"frames": [entry], "number": k, "time": 0.25 + 0.25 * k} for k, entry in enumerate(entries)]
    recording.video("data.mkv", 2).lines(sorted(lines, key=lambda line: line["time"])).calibration([pinhole])
    with recording.open() as scene:
        poses = scene.cameras[0].poses
        expected = [[0.0, 0.0, 0.0], np.linalg.inv(IMU_TO_SENSOR)[:3, 3]]
        np.testing.assert_allclose(poses.positions, expected, atol=1e-12)
