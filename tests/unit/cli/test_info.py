"""What `sceneloom info` states of where sensors are mounted."""

import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.cli.info import mounting_text
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraSensor, ImuSensor, LazyFrames, LidarSensor, Scene, Trajectory, VectorSamples
from sceneloom.scene.ego import ego_axes

CAMERA_MODEL = Camera("pinhole", 8, 6, 6.0, 6.0, 3.5, 2.5)
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the optical frame's right, down and forward on an ego of x ahead, y left, z up."""


def mount(rotation):
    return RigidTransform.from_quaternion(np.array([1.5, -0.25, 2.0]), Rotation.from_matrix(rotation).as_quat())


def camera(rotation):
    return CameraSensor("c", LazyFrames.of([], []), CAMERA_MODEL, mount=mount(rotation))


def test_sensors_are_known_by_where_they_look_and_how_they_are_rotated():
    looks = {0: "ahead", 50: "ahead left", 90: "left", -90: "right", 180: "back", -140: "back right"}
    for yaw_deg, words in looks.items():
        rotated = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ OPTICAL
        assert mounting_text(camera(rotated)) == f"mounted on the ego at (1.50, -0.25, 2.00) m, looks {words}"
    # an extrinsic of the wrong way and a quaternion of the wrong order show themselves
    assert "looks right, lying on its side" in mounting_text(camera(OPTICAL.T))
    rotated = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ OPTICAL
    wrong = Rotation.from_quat(np.roll(Rotation.from_matrix(rotated).as_quat(), 1)).as_matrix()
    assert "looks left" not in mounting_text(camera(wrong))
    lidars = {(0, 0, 90): "its x axis points left", (180, 0, 0): "upside down", (90, 0, 0): "lying on its side"}
    for euler_deg, words in lidars.items():
        rotation = Rotation.from_euler("xyz", euler_deg, degrees=True).as_matrix()
        assert mounting_text(LidarSensor("l", LazyFrames.of([], []), mount=mount(rotation))).endswith(f", {words}")
    sensor = LidarSensor("l", LazyFrames.of([], []), mount=RigidTransform.identity())
    assert mounting_text(sensor) == "mounted on the ego"
    assert mounting_text(LidarSensor("l", LazyFrames.of([], []))) is None


def test_fuse_notes_a_camera_that_sees_no_point(call, recording, tmp_path):
    drive = shutil.copytree(recording, tmp_path / "drive")
    calibration = json.loads((drive / "calibration.json").read_text())
    matrix = calibration["cameras"][0]["imuToCamera"]
    matrix[1], matrix[2] = matrix[2], [-number for number in matrix[1]]  # so that it looks at the sky
    (drive / "calibration.json").write_text(json.dumps(calibration))
    assert "looks ahead" in call("info", recording).out
    assert "looks up" in call("info", drive).out
    outcome = call("fuse", drive, "-o", tmp_path / "a.sfs")
    assert "no point falls into the images of camera0" in outcome.err
    assert "no point falls" not in call("fuse", recording, "-o", tmp_path / "b.sfs").err


def drive_of(rotation, *, format="recording", metres=20.0, **fields):
    """A vehicle that goes east on a level road; `rotation` takes its body into the ego's frame."""
    count = 11
    times = np.arange(count, dtype=np.int64) * 10**8
    positions = np.linspace([0.0, 0, 0], [metres, 0, 0], count)
    world_from_ego = np.tile(rotation.inv().as_quat(), (count, 1))
    trajectories = {"groundTruth": Trajectory("groundTruth", times, positions, world_from_ego)}
    return Scene((), trajectories=trajectories, format=format, **fields)


ROTATIONS = {
    "x ahead": Rotation.identity(),
    "y ahead": Rotation.from_euler("z", 90, degrees=True),
    "back": Rotation.from_euler("z", 180, degrees=True),
    "camera axes": Rotation.from_matrix(OPTICAL.T),
    "odd": Rotation.from_euler("zyx", [40, -70, 130], degrees=True),
}


@pytest.mark.parametrize("name", ROTATIONS)
def test_in_a_recording_motion_and_the_world_s_up_state_where_a_camera_looks(name):
    rotation = ROTATIONS[name]
    for yaw_deg, words in {0: "ahead", 90: "left", -90: "right", 180: "back", 45: "ahead left"}.items():
        assert str(worded(drive_of(rotation), rotation, yaw_deg)).endswith(f"m, looks {words}")
    for metres in (0.0, 0.3):  # of its axes it says nothing
        scene = drive_of(ROTATIONS["x ahead"], metres=metres)
        assert str(worded(scene, ROTATIONS["x ahead"], 0)).endswith("looks ahead if the ego's x axis is ahead")


def worded(scene, rotation, yaw_deg):
    body_from_camera = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ OPTICAL
    return mounting_text(camera(rotation.as_matrix() @ body_from_camera), ego_axes(scene))


def test_axes_are_those_of_the_accelerometer_or_of_the_format_whatever_the_motion():
    rotation = ROTATIONS["odd"]
    gravity = rotation.apply([0.0, 0.0, 9.81])
    imu = ImuSensor("imu", {"accelerometer": VectorSamples([0, 1], [gravity, gravity])})
    reported = {"recording": {"calibration": {"imuForward": rotation.apply([1.0, 0, 0]).tolist()}}}
    scene = Scene((imu,), metadata=reported, format="recording")
    assert str(worded(scene, rotation, 90)).endswith("looks left")
    assert str(worded(scene, rotation, 0)).endswith("looks ahead")
    for degrees in (180, 20):
        rotation = Rotation.from_euler("z", degrees, degrees=True)
        axes = ego_axes(drive_of(rotation, format="nuscenes"))
        np.testing.assert_allclose(axes.body_from_ego, np.eye(3), atol=1e-12)
        assert axes.known
    rotation = ROTATIONS["y ahead"]
    assert str(worded(drive_of(rotation, format="pandaset"), rotation, 90)).endswith("looks left")
    imu = ImuSensor("imu", {"accelerometer": VectorSamples([0, 1], [[np.nan] * 3, [1e300] * 3])})
    for scene in (drive_of(ROTATIONS["x ahead"], metres=1e300), Scene((imu,), format="recording")):
        assert not ego_axes(scene).known
