"""A small synthetic drive with injected gaps, and the report of it, made once."""

from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.report.page import ReportSettings, collect, render_page
from sceneloom.scene import (
    CameraImage,
    CameraSensor,
    CuboidAnnotation,
    CuboidPath,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    Poses,
    Scene,
    Trajectory,
)
from sceneloom.simulate import Faults, SensorFaults, camera_mount, simulate_street

MADE = datetime(2024, 5, 6, 9, 8, 9, tzinfo=timezone(timedelta(hours=2)))
T0 = 1_000_000_000
LOST = (4, 5, 11)
"""Numbers of the images that are lost: two gaps, three images."""


@pytest.fixture(scope="session")
def drive():
    """Sixteen sweeps, and a camera that loses three of its images; none of them is made."""
    return simulate_street(1, frames=16, faults=Faults({"camera0": SensorFaults(lost_frames=LOST)}))


@pytest.fixture(scope="session")
def short():
    """Four sweeps of a wall ahead and of the ground, images of a camera, a straight trajectory, and two boxes."""
    times = T0 + np.arange(4) * 100_000_000
    trajectory = Poses(times, np.outer(np.arange(4), [0.5, 0.0, 0.0]), np.tile([0.0, 0.0, 0.0, 1.0], (4, 1)))
    camera_model = Camera("pinhole", 120, 80, 60.0, 60.0, 59.5, 39.5)
    noise = np.random.default_rng(3).integers(0, 255, (80, 120, 3), np.uint8)
    images = LazyFrames.of([CameraImage.of(int(t), camera_model, noise) for t in times], times.tolist())
    sweeps = LazyFrames.of([LidarFrame(int(t), LidarPoints(wall_and_ground())) for t in times], times.tolist())
    boxes = tuple(
        CuboidAnnotation(name, CuboidPath(times[:1], np.array([row], np.float64)), label=name, stationary=True)
        for name, row in (("car", [2, 2, 2, 9, 0, 1, 0, 0, 0]), ("bin", [1, 1, 1, 5, 30, 0, 0, 0, 0]))
    )
    return Scene(
        (
            LidarSensor("lidar", sweeps, mount=RigidTransform(np.eye(3), np.array([0.0, 0.0, 2.0]))),
            CameraSensor("camera0", camera_model, images, mount=camera_mount(position=(0.0, 0.0, 2.0))),
        ),
        annotations=boxes,
        trajectories={
            "trajectory": Trajectory(
                "trajectory", trajectory.timestamps_ns, trajectory.positions, trajectory.quaternions_xyzw
            )
        },
        metadata={"sceneloom": {"euler_unit": "degrees", "euler_order": "xyz"}},
        source="a short drive",
    )


def wall_and_ground():
    """A wall 20 m ahead of the lidar, 30 by 4 m, and the ground 2 m below it all around, (1560, 3) float32 [m]."""
    y, z = np.meshgrid(np.linspace(-15, 15, 60), np.linspace(-2, 2, 20))
    wall = np.column_stack([np.full(y.size, 20.0), y.ravel(), z.ravel()])
    angles, ranges = np.meshgrid(np.radians(np.arange(0.5, 360, 10)), np.linspace(4, 22, 10))
    ground = np.column_stack([(ranges * np.cos(angles)).ravel(), (ranges * np.sin(angles)).ravel(), np.full(360, -2.0)])
    return np.concatenate([wall, ground]).astype(np.float32)


@pytest.fixture(scope="session")
def collected(short):
    """The report of the short drive in numbers and images."""
    return collect(short, ReportSettings(quick=True), made=MADE)


@pytest.fixture(scope="session")
def page(collected):
    """Its page."""
    return render_page(collected.report, collected.figures)
