"""Tests of sweeps that position what images alone show, in a system that is sent both."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.fusion.system import FusionSystem, SeenBoxes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Boxes2D, Boxes3D, LidarFrame, LidarPoints
from sceneloom.scene.poses import Poses, PoseSource

CAMERA = Camera("pinhole", 1200, 400, 700.0, 700.0, 599.5, 199.5)
PERIOD_NS = 100_000_000
STILL = Poses.identity()
AT_EGO = PoseSource(STILL, RigidTransform.identity())
EGO_FROM_CAMERA = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
# a pedestrian of 1.72 m, 15 m ahead, by height; the points state 12 m
PEDESTRIAN = Boxes2D(0, np.array([[590.0, 199.0, 610.0, 279.3]]), np.array([0.9]), ("pedestrian",))


def a_sweep(time_ns, distance=12.0):
    """Points of a flat thing that fills the box."""
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-1.7, 0.3, 9)))
    points = np.column_stack([np.full(len(y), distance), y, z]).astype(np.float32)
    return LidarFrame(time_ns, LidarPoints(points))


@pytest.fixture
def system():
    made = FusionSystem()
    made.add_lidar("lidar", AT_EGO, period_ns=PERIOD_NS, location=AT_EGO)
    made.add_camera("camera", PoseSource(STILL, EGO_FROM_CAMERA), index=0)
    return made


def found(system, time_ns, sweep=None):
    """Send boxes of a time, and before them a sweep; gives the objects."""
    if sweep is not None:
        system.send("lidar", sweep)
    system.send("lidar", Boxes3D.empty(time_ns))
    system.send("camera", SeenBoxes(Boxes2D(time_ns, *_columns()), CAMERA))
    system.flush()
    return system.get_detections().fused


def _columns():
    return PEDESTRIAN.corners_xyxy, PEDESTRIAN.scores, PEDESTRIAN.labels


def test_from_the_first_boxes_on_sweeps_location_what_images_alone_show(system):
    assert found(system, 0, a_sweep(0)).by_points is None
    fused = found(system, PERIOD_NS, a_sweep(PERIOD_NS))
    assert fused.by_points.tolist() == [True]
    # a body is a quarter of 0.65 m behind its surface
    assert fused.centers[0, 0] == pytest.approx(12.16, abs=0.1)


def test_sweeps_of_other_times_state_nothing(system):
    found(system, 0)
    assert found(system, 5 * PERIOD_NS, a_sweep(PERIOD_NS)).by_points is None


def test_after_a_clock_was_set_back_old_sweeps_are_gone(system):
    found(system, 0)
    system.send("lidar", a_sweep(PERIOD_NS))
    system.restart(PERIOD_NS)
    assert found(system, PERIOD_NS).by_points is None


def test_points_in_the_egos_frame_are_taken_to_the_lidar():
    system = FusionSystem()
    mount = RigidTransform(np.eye(3), np.array([2.0, 0.0, 0.0]))
    system.add_lidar("lidar", AT_EGO, period_ns=PERIOD_NS, location=PoseSource(STILL, mount))
    camera = mount @ EGO_FROM_CAMERA
    system.add_camera("camera", PoseSource(STILL, camera), index=0)
    found(system, 0)
    fused = found(system, PERIOD_NS, a_sweep(PERIOD_NS, distance=14.0))
    assert fused.by_points.tolist() == [True]
    assert fused.centers[0, 0] == pytest.approx(12.16, abs=0.1)
