"""Frames of simulated drives against where the truth says that their points are."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.calibrate.frames import calibration_frames, moved_by
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.scene import Scene
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.frames import LazyFrames
from sceneloom.simulate import CameraSpec, LidarSpec, SimulatedDrive, simulate_street

AHEAD = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    """Four sweeps from a moving car, without noise."""
    exact = LidarSpec(beams=12, steps=180, range_sigma=0.0)
    return simulate_street(5, frames=4, lidar=exact, cameras=(CameraSpec(AHEAD),))


def test_points_lie_where_they_were_when_the_image_was_taken(drive):
    frame = calibration_frames(drive.scene, most=2)[1]
    sweep = next(
        k for k, lidar in enumerate(drive.scene.lidars[0].frames) if lidar.reference_ns == frame.sweep_ns
    )
    truth_world = drive.truth.clean_points_world(sweep).positions_world
    assert frame.world_from_lidar is not None
    # float32 positions and a trajectory of 100 Hz: millimetres
    np.testing.assert_allclose(frame.world_from_lidar.apply(frame.points_lidar), truth_world, atol=0.01)


def test_the_motion_at_the_image_is_that_of_the_truth(drive):
    frame = calibration_frames(drive.scene, most=1)[0]
    ego = drive.truth.path.at(np.array([frame.image_ns]))
    assert frame.twist_lidar is not None
    # the lidar's mounting rotates with the ego, so that speeds differ by a lever of 2 m times the yaw rate
    assert np.linalg.norm(frame.twist_lidar[3:]) == pytest.approx(
        float(np.linalg.norm(ego.velocities[0])), abs=0.5
    )


def test_a_later_image_sees_the_points_from_farther_on(drive):
    frame = calibration_frames(drive.scene, most=1)[0]
    assert frame.world_from_lidar is not None
    stated = frame.camera_from_lidar.matrix
    later = frame.camera_from_points(stated, later=0.05)
    poses = drive.scene.trajectories["groundTruth"].poses.interpolate(
        np.array([frame.image_ns, frame.image_ns + 50_000_000])
    )
    moved = float(np.linalg.norm(np.diff(poses.positions, axis=0)))
    shift = np.linalg.inv(stated) @ later
    # a straight trajectory for 50 ms: within 2 cm of the curved one
    assert float(np.linalg.norm(shift[:3, 3])) == pytest.approx(moved, abs=0.02)


def test_a_screw_of_a_quarter_rotation_is_a_quarter_circle():
    moved = moved_by(np.array([0.0, 0.0, np.pi / 2, np.pi / 2, 0.0, 0.0]))
    np.testing.assert_allclose(moved[:3, 3], [1.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(moved[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)


def test_frames_are_spread_over_the_drive_and_no_more_than_asked(drive):
    assert [frame.index for frame in calibration_frames(drive.scene, most=2)] == [0, 3]
    assert len(calibration_frames(drive.scene, most=100)) == 4
    with pytest.raises(OptionError, match="0 frames"):
        calibration_frames(drive.scene, most=0)


def test_unknown_sensors_are_named_with_those_that_are_there(drive):
    with pytest.raises(OptionError, match=r"'left'.*'camera0'"):
        calibration_frames(drive.scene, "left")
    with pytest.raises(OptionError, match=r"'roof'.*'lidar'"):
        calibration_frames(drive.scene, None, "roof")


def with_camera(scene: Scene, **changes: object) -> Scene:
    """The scene with another camera0."""
    sensors = [replace(s, **changes) if s.id == "camera0" else s for s in scene.sensors]
    return replace(scene, sensors=tuple(sensors))


def test_images_of_another_size_than_calibrated_are_refused(drive):
    first = drive.scene.cameras[0].images[0]
    small = CameraImage(first.timestamp_ns, AHEAD, lambda: np.zeros((32, 48, 3), np.uint8))
    scene = with_camera(drive.scene, images=LazyFrames.of([small], [first.timestamp_ns]))
    with pytest.raises(DataError, match="48x32 pixels; expected 96x64"):
        calibration_frames(scene)


def test_images_that_no_sweep_is_near_are_an_error(drive):
    first = drive.scene.cameras[0].images[0]
    late = replace(first, timestamp_ns=first.timestamp_ns + 60_000_000_000)
    scene = with_camera(drive.scene, images=LazyFrames.of([late], [late.timestamp_ns]))
    with pytest.raises(DataError, match="none with a sweep"):
        calibration_frames(scene)


def test_a_camera_without_location_is_an_error(drive):
    with pytest.raises(PoseError, match="not known"):
        calibration_frames(with_camera(drive.scene, mount=None, poses=None))


def test_without_a_trajectory_the_mountings_relate_points_as_measured(drive):
    first = drive.scene.lidars[0].frames[0]
    stationary = replace(drive.scene.lidars[0], frames=LazyFrames.of([first], [first.timestamp_ns]))
    sensors = tuple(stationary if s.id == "lidar" else s for s in drive.scene.sensors)
    scene = replace(drive.scene, sensors=sensors, trajectories={})
    frame = calibration_frames(scene, most=1)[0]
    assert len(frame.points_lidar) == len(first.points)


def test_scan_lines_are_the_rings_of_the_sensor(drive):
    frame = calibration_frames(drive.scene, most=1)[0]
    assert frame.scan is not None
    assert frame.scan.count == 12
    assert (np.diff(frame.scan.lines) >= 0).all()
