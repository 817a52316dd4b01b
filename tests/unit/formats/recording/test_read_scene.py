"""A recording as a scene: recognising, options, the frame tree, and folders that are no recording."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.checks import validate
from sceneloom.errors import DataError, OptionError, UnknownFormatError
from sceneloom.formats import open_scene
from sceneloom.formats.base.registry import find_format
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.formats.recording.vio_config import KNOWN_KEYS, read_vio_config
from sceneloom.scene import Coordinates, PointsFrame, SensorType

IMU_LINE = '{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":0}'
POINT = (1.0, 2.0, 3.0, 4, 5, 0.0)
IMU_TO_SENSOR = np.array([[0.0, -1, 0, 0.5], [0, 0, -1, 1.5], [1, 0, 0, -0.25], [0, 0, 0, 1]])


def pose_line(time, rotation, position):
    orientation = dict(zip("xyzw", rotation.as_quat().tolist(), strict=True))
    pose = {"position": dict(zip("xyz", position.tolist(), strict=True)), "orientation": orientation}
    return {"groundTruth": pose, "time": time}


def sweep(time):
    return {"lidar": {"model": "RoboSense M1 XYZIRT", "dataFile": "0.bin"}, "time": time}


def test_a_folder_or_its_lines_name_a_recording_and_one_that_is_none_or_empty_is_an_error(recording, tmp_path):
    (tmp_path / "other.jsonl").write_text('{"speed": 1.5, "time": 0.0}\n')
    for path in (recording.path, tmp_path / "other.jsonl", tmp_path / "missing"):
        assert not FORMAT.sniff(path)
    for name in ("drive", "missing", "missing/data.jsonl"):
        with pytest.raises(DataError, match=r"expected a recording's folder"):
            FORMAT.open(tmp_path / name)
    with pytest.raises(DataError, match=r"data\.jsonl: is empty"):
        recording.lines([]).open(lenient=True)
    recording.lines([IMU_LINE])
    for path in (recording.path, recording.path / "data.jsonl"):
        assert FORMAT.sniff(path)
        with open_scene(path) as scene:
            assert (scene.format, scene.source) == ("recording", str(recording.path))
            assert [(sensor.id, sensor.type) for sensor in scene.sensors] == [("imu", SensorType.IMU)]


def test_altitudes_and_settings_are_recorded_and_unknown_options_and_values_refused(recording):
    path = recording.lines([IMU_LINE]).path / "vio_config.yaml"
    path.write_text("useSlam: true  # yes\n")
    for altitude in ("wgs84", "msl"):
        metadata = recording.open(altitude=altitude).metadata["recording"]
        assert (metadata["altitude"], metadata["vio_config"]) == (altitude, "useSlam: true  # yes\n")
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
    # frames beyond the trajectory get no pose
    still = Rotation.identity()
    recording.calibration(lidars=[{"imuToLidar": np.eye(4).tolist()}])
    lines = [sweep(0.0), pose_line(0.1, still, np.zeros(3)), sweep(0.2), pose_line(0.3, still, np.ones(3)), sweep(0.4)]
    lidar = recording.lines(lines).open().lidars[0]
    assert len(lidar.frames) == 3
    assert lidar.poses.timestamps_ns.tolist() == [200_000_000]
    np.testing.assert_allclose(lidar.poses.positions, [[0.5, 0.5, 0.5]], atol=1e-12)
    for late in ([pose_line(5.0, still, np.zeros(3))], []):
        assert recording.lines([sweep(0.0), *late]).open().lidars[0].poses is None
    # and a line's own mounting counts for its pose
    lines = [pose_line(t, still, np.zeros(3)) for t in (0.0, 1.0)]
    entries = [{"cameraInd": 0}, {"cameraInd": 0, "imuToCamera": IMU_TO_SENSOR.tolist()}]
    lines += [{"frames": [entry], "number": k, "time": 0.25 + 0.25 * k} for k, entry in enumerate(entries)]
    recording.video("data.mkv", 2).lines(sorted(lines, key=lambda line: line["time"])).calibration([pinhole])
    with recording.open() as scene:
        poses = scene.cameras[0].poses
        expected = [[0.0, 0.0, 0.0], np.linalg.inv(IMU_TO_SENSOR)[:3, 3]]
        np.testing.assert_allclose(poses.positions, expected, atol=1e-12)


# set: wrapper-base of the vendor's ROS 2 node, with a comment, a list in each form and a quoted text
TEXT = """\
# set: wrapper-base
---
trackChiTestOutlierR: 3
useSlam: True   # find loops
parameterSets: ['wrapper-base', "oak-d"]
imuToCameraMatrix:
  - 1.0
  - 0.0
stereoCameraTranslation:
- 0.1
- 0.0
"ffmpegVideoCodec": "libx264 -crf 15 # fast"

visualR:0.01
"""


def test_settings_are_read_with_their_lines():
    config = read_vio_config(TEXT)
    assert [(s.key, s.value, s.line) for s in config.settings] == [
        ("trackChiTestOutlierR", "3", 3),
        ("useSlam", "True", 4),
        ("parameterSets", "['wrapper-base', \"oak-d\"]", 5),
        ("imuToCameraMatrix", "", 6),
        ("stereoCameraTranslation", "", 9),
        ("ffmpegVideoCodec", '"libx264 -crf 15 # fast"', 12),
    ]
    # YAML takes a colon without a blank for a part of a text, so this is no setting
    assert dict(config.strange) == {14: "visualR:0.01"}
    assert len(KNOWN_KEYS) > 250
    assert config.unknown_keys == read_vio_config("").unknown_keys == []
    text = "odometry:\n  visualR: 0.1\nUseSlam: true\nuseStereo: no\nsomething else: 1\n"
    assert read_vio_config(text).unknown_keys == ["odometry", "UseSlam", "something else"]


# a line as the vendor's software puts it out, the numbers shortened
OUTPUT = (
    '{"acceleration":{"x":0.0001,"y":-4e-05,"z":2e-05},"angularVelocity":{"x":0.014,"y":-0.02,"z":-0.023},'
    '"orientation":{"w":-0.384162,"x":0.453153,"y":-0.603051,"z":0.532354},'
    '"position":{"x":-0.01,"y":-0.14,"z":0.046},"status":"TRACKING","time":7323.558535104899,'
    '"velocity":{"x":-0.0099,"y":-0.0042,"z":-0.0094},"positionCovariance":[[0.1,0,0],[0,0.2,0],[0,0,0.3]]}'
)


@pytest.fixture
def output(tmp_path):
    lines = [json.loads(OUTPUT) for _ in range(3)]
    for k, line in enumerate(lines):
        line["time"] += 0.5 * k
        line["position"]["x"] += 0.5 * k
    path = tmp_path / "out.jsonl"
    path.write_text("\n".join(map(json.dumps, lines)) + "\n")
    return path


def test_a_file_of_output_or_of_poses_under_the_name_of_a_method_is_a_scene_with_a_trajectory(output):
    assert find_format(output).name == "recording"
    with FORMAT.open(output) as scene:
        assert (scene.source, list(scene.trajectories), scene.sensors) == (str(output), ["output"], ())
        trajectory = scene.trajectories["output"]
        np.testing.assert_allclose(trajectory.positions, [[x, -0.14, 0.046] for x in (-0.01, 0.49, 0.99)])
        np.testing.assert_array_equal(trajectory.quaternions_xyzw[0], [0.453153, -0.603051, 0.532354, -0.384162])
        assert trajectory.timestamps_ns[0] == 7323558535105
        # what a trajectory has no field for is kept word by word
        kept = scene.metadata["recording"]["further_keys"]["trajectories.output"]
        assert json.loads(kept["7323558535105"]) == json.loads(OUTPUT)
    path = output.with_name("results.json")
    for root, fields, name in (
        ("output", {}, "output"),
        ("pose", {"name": "basalt"}, "basalt"),
        ("groundTruth", {}, "groundTruth"),
        ("arkit", {"orientation": {"w": 1, "x": 0, "y": 0, "z": 0}}, "arkit"),
    ):
        path.write_text(json.dumps({root: {**fields, "position": {"x": 1, "y": 2, "z": 3}}, "time": 0.5}) + "\n")
        assert FORMAT.sniff(path)
        with FORMAT.open(path) as scene:
            assert list(scene.trajectories) == [name]
    with output.open("a") as file:
        file.write(OUTPUT.replace('"x":-0.01,', "") + "\n")
    with pytest.raises(DataError, match=r"out\.jsonl: line 4: .*position"):
        FORMAT.open(output)
    (error,) = (f for f in validate(output).findings if f.severity == "error")
    assert (error.rule, error.path.partition(": ")[0], "line 4" in error.path) == ("unfit-lines", "out.jsonl", True)


def test_what_lies_beside_output_is_not_its_own_and_beside_a_log_of_any_name_it_is(output, recording, pinhole):
    recording.lines([{"frames": [{"cameraInd": 0}], "number": 0, "time": 0.0}]).calibration([pinhole])
    recording.video("data.mkv", 1)
    (recording.path / "vio_config.yaml").write_text("useSlam: True\n")
    output.rename(recording.path / "out.jsonl")
    with FORMAT.open(recording.path / "out.jsonl") as scene:
        assert scene.sensors == ()
        assert not {"calibration", "vio_config"} & scene.metadata["recording"].keys()
        assert {warning.code for warning in scene.warnings} == {"further-keys-kept"}
    (recording.path / "data.jsonl").rename(recording.path / "log.jsonl")
    with FORMAT.open(recording.path / "log.jsonl") as scene:
        assert [camera.id for camera in scene.cameras] == ["camera0"]


def test_other_files_are_no_logs_and_what_keeps_a_folder_from_being_a_recording_is_reported(tmp_path):
    path, scene_file = tmp_path / "other.jsonl", '{"version":"1.0","sensors":[]}\n'
    for text in ("", "{}\n", '{"time":1}\n', scene_file, "[1]\n", '"time"\n', "{broken\n", "\0" * 99):
        path.write_text(text)
        assert not FORMAT.sniff(path)
        with pytest.raises(UnknownFormatError):
            find_format(path)
    path.unlink()
    for name, reported in (
        ("data.jsonl.gz", "there is data.jsonl.gz: unpack it to data.jsonl"),
        ("Data.JSONL", "there is Data.JSONL: is it the recording's data.jsonl?"),
        ("log.jsonl", "there is log.jsonl: is it the recording's data.jsonl?"),
    ):
        (tmp_path / name).write_text(OUTPUT)
        with pytest.raises(UnknownFormatError) as caught:
            find_format(tmp_path)
        assert reported in caught.value.problem
        (tmp_path / name).unlink()
