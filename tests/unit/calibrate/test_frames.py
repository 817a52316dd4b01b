"""Frames of a calibration, and their scan order."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.calibrate.frames import CalibrationFrame, calibration_frames, find_scan_order
from sceneloom.calibrate.measures import Change, find_depth_edges
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, OptionError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.frames import LazyFrames
from sceneloom.simulate import CameraSpec, LidarSpec, simulate_street
from sceneloom.simulate.lidar_radar import directions_at

AHEAD = Camera("pinhole", 96, 64, 60.0, 60.0, 47.5, 31.5)


@pytest.fixture(scope="module")
def drive():
    """Four sweeps from a moving car, without noise."""
    exact = LidarSpec(beams=12, steps=180, range_sigma=0.0)
    return simulate_street(5, frames=4, lidar=exact, cameras=(CameraSpec(AHEAD),))


def test_points_and_motion_are_those_of_the_truth_when_the_image_was_taken_and_later_ones_see_from_farther_on(drive):
    frame = calibration_frames(drive.scene, most=2)[1]
    sweep = next(k for k, lidar in enumerate(drive.scene.lidars[0].frames) if lidar.reference_ns == frame.sweep_ns)
    truth_world = drive.truth.clean_points_world(sweep).positions_world
    assert frame.world_from_lidar is not None
    # float32 positions and a trajectory of 100 Hz: millimetres
    np.testing.assert_allclose(frame.world_from_lidar.apply(frame.points_lidar), truth_world, atol=0.01)
    ego = drive.truth.path.at(np.array([frame.image_ns]))
    assert frame.twist_lidar is not None
    # the lidar's mounting rotates with the ego, so that speeds differ by a lever of 2 m times the yaw rate
    assert np.linalg.norm(frame.twist_lidar[3:]) == pytest.approx(float(np.linalg.norm(ego.velocities[0])), abs=0.5)
    assert frame.scan is not None
    assert frame.scan.count == 12  # lines are the rings of the sensor
    assert (np.diff(frame.scan.lines) >= 0).all()
    frame = calibration_frames(drive.scene, most=1)[0]
    assert frame.world_from_lidar is not None
    stated = frame.camera_from_lidar.matrix
    later = Change((*(0.0,) * 7, 0.05)).camera_from_points(frame)
    poses = drive.scene.trajectories["groundTruth"].poses.interpolate(
        np.array([frame.image_ns, frame.image_ns + 50_000_000])
    )
    moved = float(np.linalg.norm(np.diff(poses.positions, axis=0)))
    shift = np.linalg.inv(stated) @ later
    # a straight trajectory for 50 ms: within 2 cm of the curved one
    assert float(np.linalg.norm(shift[:3, 3])) == pytest.approx(moved, abs=0.02)
    moved = Change((0.0, 0.0, np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0, 0.0)).camera_from_lidar(np.eye(4))
    np.testing.assert_allclose(moved[:3, 3], [1.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(moved[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)


def with_camera(scene, **changes):
    sensors = [replace(s, **changes) if s.id == "camera0" else s for s in scene.sensors]
    return replace(scene, sensors=tuple(sensors))


def test_frames_are_spread_over_the_drive_with_a_trajectory_or_without_and_what_does_not_fit_is_refused(drive):
    assert [frame.index for frame in calibration_frames(drive.scene, most=2)] == [0, 3]
    assert len(calibration_frames(drive.scene, most=100)) == 4
    with pytest.raises(OptionError, match="0 frames"):
        calibration_frames(drive.scene, most=0)
    with pytest.raises(OptionError, match=r"'left'.*'camera0'"):
        calibration_frames(drive.scene, "left")
    with pytest.raises(OptionError, match=r"'roof'.*'lidar'"):
        calibration_frames(drive.scene, None, "roof")
    first = drive.scene.cameras[0].images[0]
    small = CameraImage(first.timestamp_ns, AHEAD, lambda: np.zeros((32, 48, 3), np.uint8))
    late = replace(first, timestamp_ns=first.timestamp_ns + 60_000_000_000)
    for image, problem in ((small, "48x32 pixels; expected 96x64"), (late, "none with a sweep")):
        with pytest.raises(DataError, match=problem):
            calibration_frames(with_camera(drive.scene, images=LazyFrames.of([image], [image.timestamp_ns])))
    with pytest.raises(PoseError, match="not known"):
        calibration_frames(with_camera(drive.scene, mount=None, poses=None))
    first = drive.scene.lidars[0].frames[0]
    stationary = replace(drive.scene.lidars[0], frames=LazyFrames.of([first], [first.timestamp_ns]))
    sensors = tuple(stationary if s.id == "lidar" else s for s in drive.scene.sensors)
    scene = replace(drive.scene, sensors=sensors, trajectories={})
    frame = calibration_frames(scene, most=1)[0]
    assert len(frame.points_lidar) == len(first.points)


def scanned(lines=16, steps=360):
    """Points on a round wall, line after line from below, each a full rotation from the front."""
    rings = np.repeat(np.arange(lines), steps)
    azimuths = np.tile(np.linspace(0.001, 2 * np.pi - 0.001, steps), lines)
    elevations, ranges = np.radians(-15.0 + 2.0 * rings), 10.0 + 0.3 * np.sin(7 * azimuths)
    directions = [np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths), np.sin(elevations)]
    return (ranges * np.array(directions)).T.copy(), rings


def test_lines_are_reported_by_rings_by_the_order_of_the_file_or_by_elevations_if_there_are_any():
    points, rings = scanned()
    shuffled, plain = np.random.default_rng(1).permutation(len(points)), np.arange(len(points))
    for order, known in ((plain, rings.astype(np.uint16)), (plain, None), (shuffled, None)):
        scan = find_scan_order(points[order], known)
        assert scan is not None
        assert scan.count == 16
        assert (rings[order][scan.order] == scan.lines).all()
    scan = find_scan_order(points, None)
    assert scan is not None
    same = np.diff(scan.lines) == 0
    assert (np.diff(scan.azimuths)[same] > 0).all()
    assert find_scan_order(np.random.default_rng(2).normal(size=(5000, 3)) * 10.0, None) is None
    assert find_scan_order(scanned()[0][:20], None) is None
    assert find_scan_order(np.zeros((500, 3)), None) is None


CAMERA_FROM_LIDAR = RigidTransform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
STEP = np.radians(0.5)
AZIMUTHS = STEP * (np.arange(80) - 39.5)
ELEVATIONS = np.radians(-4.0 + 1.0 * np.arange(9))


def edges_of(ranges):
    """Edges in a sweep of (9, 80) ranges, lowest line first."""
    rotations, heights = np.meshgrid(AZIMUTHS, ELEVATIONS)
    points = directions_at(rotations.ravel(), heights.ravel()) * ranges.reshape(-1, 1)
    rings = np.repeat(np.arange(9, dtype=np.uint16), 80)
    images = {"grey": np.zeros((32, 64), np.float32), "rgb": np.zeros((32, 64, 3), np.uint8)}
    frame = CalibrationFrame(
        **{"camera_id": "camera0", "lidar_id": "lidar", "index": 0, "image_ns": 0, "sweep_ns": 0, **images},
        camera=Camera("pinhole", 64, 32, 40.0, 40.0, 31.5, 15.5),
        camera_from_lidar=CAMERA_FROM_LIDAR,
        points_lidar=points,
        intensities=None,
        seconds=None,
        scan=find_scan_order(points, rings),
    )
    return find_depth_edges(frame, np.arange(len(points)))


def test_edges_lie_halfway_between_a_board_and_a_wall_and_on_walls_that_recede_but_not_on_steep_planes():
    ranges = np.full((9, 80), 20.0)
    ranges[:, 30:50] = 5.0
    edges = edges_of(ranges)
    azimuths = np.arctan2(edges.points_lidar[:, 1], edges.points_lidar[:, 0])
    assert len(azimuths) == 18  # on the left and on the right of each line
    np.testing.assert_allclose(np.sort(np.abs(azimuths)), 10 * STEP, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar, axis=1), 5.0, rtol=1e-9)
    ranges = np.full(80, 60.0)
    ranges[20:] = (6.0 / np.cos(AZIMUTHS - 1.0))[20:]
    edges = edges_of(ranges / np.cos(ELEVATIONS)[:, None])
    assert len(edges.weights) == 9
    azimuths = np.arctan2(edges.points_lidar[:, 1], edges.points_lidar[:, 0])
    np.testing.assert_allclose(azimuths, 0.5 * (AZIMUTHS[19] + AZIMUTHS[20]), atol=1e-9)
    # the last point is 0.2 m nearer; chords between a plane's points leave millimetres
    there = 6.0 / np.cos(azimuths - 1.0)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar[:, :2], axis=1), there, rtol=1e-3)
    # a roof half a metre below: from line to line the range grows by metres
    heights = np.append(0.5 / np.sin(-ELEVATIONS[:4]), np.full(5, 100.0))
    assert len(edges_of(np.repeat(heights[:, None], 80, axis=1)).weights) == 0
    # nothing reports how far it goes on: a roof whose far end lies behind its near one
    ranges = np.full((9, 80), 50.0)
    ranges[:4], ranges[4] = 8.0, 11.0
    edges = edges_of(ranges)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar, axis=1), 8.0, rtol=1e-9)
