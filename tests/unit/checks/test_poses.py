"""Rules about poses of sensors and the ego, and about corrections."""

from dataclasses import replace

import numpy as np

from sceneloom.cameras.camera import Camera
from sceneloom.checks.poses import CORRECTION_RULES, POSE_RULES
from sceneloom.geometry.rigid import RigidTransform, quaternion_from_rotation_vector
from sceneloom.scene import (
    CameraCalibration,
    Coordinates,
    ImuSensor,
    LocalizationAdjustment,
    PointsFrame,
    Trajectory,
    VectorSamples,
)

PERIOD = 100_000_000
MOUNT = RigidTransform(np.eye(3), np.zeros(3))
CALIBRATION = CameraCalibration("c", "front", time_offset_ns=5)
WIDE = CameraCalibration("c", "front", intrinsics=Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5))


def trajectory(s, *, row=0, up=0.0, early_ns=0):
    """A scene with one trajectory, of which the rows from one on are higher, or one is earlier."""
    path = s.path()
    positions, times = path.positions.copy(), path.timestamps_ns.copy()
    positions[row:, 2] += up
    times[row] -= early_ns
    return s.scene(trajectories={"ego": Trajectory("ego", times, positions, path.quaternions_xyzw)})


def moved(s, count, row, left):
    """A lidar of which one pose is farther to the left."""
    path = s.path(s.times(count))
    positions = path.positions.copy()
    positions[row, 1] += left
    return s.lidar(poses=replace(path, positions=positions))


def braking(s):
    """A lidar that brakes and then stands, by fixes with noise."""
    times = np.arange(200) * PERIOD
    along = np.cumsum(np.clip(20 - 8 * times / 1e9, 0, None) * 0.1)
    positions = np.column_stack([along, np.zeros((200, 2))]) + np.random.default_rng(2).normal(0, 0.1, (200, 3))
    return s.lidar(poses=s.path(times, positions=positions))


def rotated(s, degrees, signs=1):
    quaternions = np.tile([0.0, 0, 0, 1], (6, 1))
    quaternions[3] = quaternion_from_rotation_vector(np.array([0, 0, np.radians(degrees)]))
    quaternions[::2] *= signs
    return s.lidar(poses=s.path(quaternions_xyzw=quaternions))


def on_ego(s, coordinates=Coordinates.EGO):
    return s.lidar(coordinates=coordinates, points_frame=PointsFrame.EGO)


def camera_of_two(s, parent_id=None):
    camera = s.camera(coordinates=Coordinates.EGO, parent_id=parent_id)
    return camera, s.odometry(id="wheels"), s.odometry(id=2)


def adjusted(s, *times, name="a"):
    return LocalizationAdjustment(name, s.path(np.array(times)))


def imu(first, stop):
    times = np.arange(first, stop) * PERIOD
    return ImuSensor("imu", {"gyroscope": VectorSamples(times, np.zeros((len(times), 3)))})


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    mounted = sound.lidar(id="mounted", poses=None, mount=MOUNT)
    sensors = sound.lidar(), sound.camera(), mounted, sound.odometry()
    assert keeps(replace(trajectory(sound), sensors=sensors), POSE_RULES)
    other = CameraCalibration("d", "back", intrinsics=sound.camera().camera)
    sensors = sound.lidar(), sound.camera(), sound.camera(id="back")
    scene = sound.scene(*sensors, adjusted(sound, PERIOD, 4 * PERIOD), CALIBRATION, other)
    assert keeps(scene, [rule for rule in CORRECTION_RULES if rule.id != "corrections-not-applied"])


def test_corrections(check, sound):
    check("localization-adjustments-several", "annotations[1]", adjusted(sound, 0), adjusted(sound, 0, name="b"))
    # it may end a sweep too soon, hold throughout with one pose, and not cover what only the IMU measured
    check("localization-adjustment-short", "", adjusted(sound, 0, 4 * PERIOD))
    check("localization-adjustment-short", "annotations[0].poses", adjusted(sound, 0, 4 * PERIOD - 1))
    check("localization-adjustment-short", "", adjusted(sound, 0))
    check("localization-adjustment-short", "", sound.lidar(), imu(-20, 40), adjusted(sound, 0, 5 * PERIOD))
    check("camera-calibrations-several", "annotations[1]", CALIBRATION, replace(CALIBRATION, id="d"))
    check(
        "camera-calibration-empty",
        "annotations[0]",
        CameraCalibration("c", "front"),
        CameraCalibration("d", "front", sound.path()),
    )
    check("camera-calibration-size", "annotations[0].intrinsics: 64 x 48 px; the camera's images are 32 x 24 px", WIDE)


def test_poses(check, sound):
    check("sensor-placed", "sensors[0].poses", sound.lidar(poses=None))
    check("sensor-placed", "", sound.lidar(poses=None, mount=MOUNT))
    check("ego-trajectory-known", "trajectories: sensors[0]", sound.lidar(poses=None, mount=MOUNT))
    check("poses-cover-frames", "sensors[0].frames[7]: 2 of 9 frames", sound.lidar(sound.times(9)))
    check("poses-cover-frames", "", sound.lidar(sound.times(7)))
    # what is off is found at both steps, what jumps for good once
    check("poses-jump", ["sensors[0].poses.values[5]", "sensors[0].poses.values[6]"], moved(sound, 12, 5, 4.0))
    check("poses-jump", "trajectories[ego].values[3]", trajectory(sound, row=3, up=40.0))
    check("poses-jump", "", braking(sound))
    check("poses-rotation", "", rotated(sound, 10.0))
    check("poses-rotation", ["sensors[0].poses.values[3]", "sensors[0].poses.values[4]"], rotated(sound, 80.0))
    check("poses-rotation", "", rotated(sound, 0.0, signs=-1))
    check("trajectory-times-increasing", "trajectories[ego][2]", trajectory(sound, row=2, early_ns=PERIOD))
    check("ego-odometry", "sensors[0].coordinates", on_ego(sound))
    check("ego-odometry", "", on_ego(sound), sound.odometry())
    check("ego-points-placed", "sensors[0]", on_ego(sound, Coordinates.WORLD))
    check("ego-points-placed", "", on_ego(sound, Coordinates.WORLD), sound.odometry())
    check("ego-odometry-unique", "sensors[0].parent_id: 'wheels', 2", *camera_of_two(sound))
    check("ego-odometry-unique", "", *camera_of_two(sound, 2))
    check("ego-odometry-unique", "sensors[0].parent_id", *camera_of_two(sound, "2"))
