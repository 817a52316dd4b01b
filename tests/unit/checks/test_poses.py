"""Rules about poses of sensors and the ego, and about corrections."""

from dataclasses import replace

import numpy as np
import pytest

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


def trajectory(sound, name="ego"):
    path = sound.path()
    return {name: Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)}


def test_a_sound_scene_keeps_all_of_them(sound, keeps):
    mounted = sound.lidar(id="mounted", poses=None, mount=MOUNT)
    scene = sound.scene(sound.lidar(), sound.camera(), mounted, sound.odometry(), trajectories=trajectory(sound))
    assert keeps(scene, POSE_RULES)


def test_a_sensor_without_poses_and_mounting_is_found(sound, found):
    scene = sound.scene(sound.lidar(poses=None))
    assert [path for path, _ in found(scene, "sensor-placed")] == ["sensors[0].poses"]


def test_a_mounted_sensor_without_any_ego_trajectory_is_reported(sound, found):
    scene = sound.scene(sound.lidar(poses=None, mount=MOUNT))
    assert found(scene, "sensor-placed") == []
    [(path, message)] = found(scene, "ego-trajectory-known")
    assert path == "trajectories"
    assert "sensors[0]" in message


def test_frames_beyond_the_poses_are_counted(sound, found):
    scene = sound.scene(sound.lidar(sound.times(9)))
    [(path, message)] = found(scene, "poses-cover-frames")
    assert path == "sensors[0].frames[7]"
    assert message.startswith("2 of 9 frames")
    within = sound.scene(sound.lidar(sound.times(7)))
    assert found(within, "poses-cover-frames") == []


def test_a_pose_off_its_trajectory_is_found_at_both_steps(sound, found):
    path = sound.path(sound.times(12))
    positions = path.positions.copy()
    positions[5] += [0, 4.0, 0]
    scene = sound.scene(sound.lidar(poses=replace(path, positions=positions)))
    assert [location for location, _ in found(scene, "poses-jump")] == [
        "sensors[0].poses.values[5]",
        "sensors[0].poses.values[6]",
    ]


def test_braking_a_noisy_fix_and_stationary_are_no_jumps(sound, found):
    times = np.arange(200) * PERIOD
    seconds = times / 1e9
    speed = np.clip(20 - 8 * seconds, 0, None)
    along = np.cumsum(speed * 0.1)
    rng = np.random.default_rng(2)
    positions = np.column_stack([along, np.zeros(200), np.zeros(200)]) + rng.normal(0, 0.1, (200, 3))
    assert found(sound.scene(sound.lidar(poses=sound.path(times, positions=positions))), "poses-jump") == []


def test_a_trajectory_that_jumps_is_found_once(sound, found):
    trajectories = trajectory(sound, "vio")
    positions = trajectories["vio"].positions.copy()
    positions[3:] += [0, 0, 40.0]
    trajectories["vio"] = replace(trajectories["vio"], positions=positions)
    assert [location for location, _ in found(sound.scene(trajectories=trajectories), "poses-jump")] == [
        "trajectories[vio].values[3]"
    ]


@pytest.mark.parametrize(("degrees", "wrong"), [(10.0, False), (80.0, True)])
def test_a_rotated_pose_is_found(sound, found, degrees, wrong):
    quaternions = np.tile([0.0, 0, 0, 1], (6, 1))
    quaternions[3] = quaternion_from_rotation_vector(np.array([0, 0, np.radians(degrees)]))
    poses = sound.path(quaternions_xyzw=quaternions)
    locations = [location for location, _ in found(sound.scene(sound.lidar(poses=poses)), "poses-rotation")]
    assert locations == (["sensors[0].poses.values[3]", "sensors[0].poses.values[4]"] if wrong else [])


def test_opposite_quaternions_are_the_same_rotation(sound, found):
    quaternions = np.tile([0.0, 0, 0, 1], (6, 1))
    quaternions[::2] *= -1
    poses = sound.path(quaternions_xyzw=quaternions)
    assert found(sound.scene(sound.lidar(poses=poses)), "poses-rotation") == []


def test_a_trajectory_that_goes_back_in_time_is_found(sound, found):
    trajectories = trajectory(sound)
    times = trajectories["ego"].timestamps_ns.copy()
    times[2] = times[1]
    trajectories["ego"] = replace(trajectories["ego"], timestamps_ns=times)
    assert [p for p, _ in found(sound.scene(trajectories=trajectories), "trajectory-times-increasing")] == [
        "trajectories[ego][2]"
    ]


def test_ego_coordinates_need_an_odometry_sensor(sound, found):
    on_ego = sound.lidar(coordinates=Coordinates.EGO, points_frame=PointsFrame.EGO)
    assert [path for path, _ in found(sound.scene(on_ego), "ego-odometry")] == ["sensors[0].coordinates"]
    rider_association = replace(on_ego, coordinates=Coordinates.WORLD)
    assert [path for path, _ in found(sound.scene(rider_association), "ego-points-placed")] == ["sensors[0]"]
    assert found(sound.scene(rider_association, sound.odometry()), "ego-points-placed") == []
    assert found(sound.scene(on_ego, sound.odometry()), "ego-odometry") == []


def test_several_odometry_sensors_need_a_parent_that_says_which(sound, found):
    two = (sound.odometry(id="wheels"), sound.odometry(id=2))
    on_ego = sound.camera(coordinates=Coordinates.EGO)
    [(path, message)] = found(sound.scene(on_ego, *two), "ego-odometry-unique")
    assert path == "sensors[0].parent_id"
    assert "'wheels', 2" in message
    named = sound.camera(coordinates=Coordinates.EGO, parent_id=2)
    assert found(sound.scene(named, *two), "ego-odometry-unique") == []
    assert found(sound.scene(replace(named, parent_id="2"), *two), "ego-odometry-unique")


def test_a_sound_scene_keeps_all_rules_about_corrections(sound, keeps):
    annotations = (
        LocalizationAdjustment("a", sound.path(np.array([PERIOD, 4 * PERIOD]))),
        CameraCalibration("c", "front", time_offset_ns=5),
        CameraCalibration("d", "back", intrinsics=sound.camera().camera),
    )
    scene = sound.scene(sound.lidar(), sound.camera(), sound.camera(id="back"), annotations=annotations)
    assert keeps(scene, [rule for rule in CORRECTION_RULES if rule.id != "corrections-not-applied"])


def test_a_second_adjustment_is_found(sound, found):
    scene = sound.scene(annotations=tuple(LocalizationAdjustment(k, sound.path()) for k in "ab"))
    assert [path for path, _ in found(scene, "localization-adjustments-several")] == ["annotations[1]"]


def test_an_adjustment_that_ends_more_than_a_sweep_too_soon_is_found(sound, found):
    for last, hits in ((4 * PERIOD, 0), (4 * PERIOD - 1, 1)):
        adjustment = LocalizationAdjustment("a", sound.path(np.array([0, last])))
        assert len(found(sound.scene(annotations=(adjustment,)), "localization-adjustment-short")) == hits


def test_an_adjustment_need_not_cover_what_inertial_sensors_measured_before_and_after(sound, found):
    timestamps = np.arange(-20, 40) * PERIOD
    imu = ImuSensor("imu", {"gyroscope": VectorSamples(timestamps, np.zeros((60, 3)))})
    adjustment = LocalizationAdjustment("a", sound.path(np.array([0, 5 * PERIOD])))
    scene = sound.scene(sound.lidar(), imu, annotations=(adjustment,))
    assert found(scene, "localization-adjustment-short") == []


def test_an_adjustment_of_one_pose_may_hold_throughout(sound, found):
    adjustment = LocalizationAdjustment("a", sound.path(np.array([0])))
    assert found(sound.scene(annotations=(adjustment,)), "localization-adjustment-short") == []


def test_a_second_calibration_of_a_camera_is_found(sound, found):
    first = CameraCalibration("c", "front", time_offset_ns=5)
    scene = sound.scene(annotations=(first, replace(first, id="d")))
    assert [path for path, _ in found(scene, "camera-calibrations-several")] == ["annotations[1]"]


def test_a_calibration_that_says_nothing_is_found(sound, found):
    scene = sound.scene(annotations=(CameraCalibration("c", "front"), CameraCalibration("d", "front", sound.path())))
    assert [path for path, _ in found(scene, "camera-calibration-empty")] == ["annotations[0]"]


def test_a_calibrated_camera_model_for_other_images_is_found(sound, found):
    camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
    scene = sound.scene(annotations=(CameraCalibration("c", "front", intrinsics=camera_model),))
    assert found(scene, "camera-calibration-size") == [
        ("annotations[0].intrinsics", "64 x 48 px; the camera's images are 32 x 24 px")
    ]
