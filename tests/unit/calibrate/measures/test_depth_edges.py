"""Edges in depth, of sweeps whose surfaces are known."""

import numpy as np

from sceneloom.calibrate.frames import CalibrationFrame, find_scan_order
from sceneloom.calibrate.measures import DepthEdges, find_depth_edges
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.casting import directions_at

CAMERA_FROM_LIDAR = RigidTransform(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))
STEP = np.radians(0.5)
AZIMUTHS = STEP * (np.arange(80) - 39.5)
ELEVATIONS = np.radians(-4.0 + 1.0 * np.arange(9))


def edges_of(ranges: np.ndarray) -> DepthEdges:
    """Edges in a sweep of (9, 80) ranges, lowest line first."""
    rotations, heights = np.meshgrid(AZIMUTHS, ELEVATIONS)
    points = directions_at(rotations.ravel(), heights.ravel()) * ranges.reshape(-1, 1)
    rings = np.repeat(np.arange(9, dtype=np.uint16), 80)
    frame = CalibrationFrame(
        camera_id="camera0",
        lidar_id="lidar",
        index=0,
        image_ns=0,
        sweep_ns=0,
        camera=Camera("pinhole", 64, 32, 40.0, 40.0, 31.5, 15.5),
        camera_from_lidar=CAMERA_FROM_LIDAR,
        points_lidar=points,
        intensities=None,
        seconds=None,
        scan=find_scan_order(points, rings),
        grey=np.zeros((32, 64), np.float32),
        rgb=np.zeros((32, 64, 3), np.uint8),
    )
    return find_depth_edges(frame, np.arange(len(points)))


def test_a_board_before_a_wall_has_edges_halfway_between_its_points_and_those_of_the_wall() -> None:
    ranges = np.full((9, 80), 20.0)
    ranges[:, 30:50] = 5.0
    edges = edges_of(ranges)
    azimuths = np.arctan2(edges.points_lidar[:, 1], edges.points_lidar[:, 0])
    assert len(azimuths) == 18  # on the left and on the right of each line
    np.testing.assert_allclose(np.sort(np.abs(azimuths)), 10 * STEP, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar, axis=1), 5.0, rtol=1e-9)


def test_an_edge_of_a_slanting_wall_lies_on_it() -> None:
    """A wall that recedes ends; its end is farther than the last point on it."""
    ranges = np.full(80, 60.0)
    ranges[20:] = (6.0 / np.cos(AZIMUTHS - 1.0))[20:]
    edges = edges_of(ranges / np.cos(ELEVATIONS)[:, None])
    assert len(edges.weights) == 9
    azimuths = np.arctan2(edges.points_lidar[:, 1], edges.points_lidar[:, 0])
    np.testing.assert_allclose(azimuths, 0.5 * (AZIMUTHS[19] + AZIMUTHS[20]), atol=1e-9)
    # the last point is 0.2 m nearer; chords between a plane's points leave millimetres
    there = 6.0 / np.cos(azimuths - 1.0)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar[:, :2], axis=1), there, rtol=1e-3)


def test_a_plane_that_recedes_steeply_has_no_edges() -> None:
    """A roof half a metre below: from line to line the range grows by metres."""
    heights = np.append(0.5 / np.sin(-ELEVATIONS[:4]), np.full(5, 100.0))
    assert len(edges_of(np.repeat(heights[:, None], 80, axis=1)).weights) == 0


def test_a_surface_that_is_seen_in_one_line_behind_another_has_no_edge() -> None:
    """Nothing reports how far it goes on: a roof whose far end lies behind its near one."""
    ranges = np.full((9, 80), 50.0)
    ranges[:4], ranges[4] = 8.0, 11.0
    edges = edges_of(ranges)
    np.testing.assert_allclose(np.linalg.norm(edges.points_lidar, axis=1), 8.0, rtol=1e-9)
