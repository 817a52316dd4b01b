"""A short simulated drive, shared by the tests of the main job."""

import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.scene import Scene
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

SMALL = Camera("pinhole", 160, 96, 90.0, 90.0, 79.5, 47.5)


@pytest.fixture(scope="session")
def drive() -> Scene:
    """Four sweeps of a coarse lidar and two small cameras."""
    cameras = (
        CameraSpec(SMALL, camera_mount()),
        CameraSpec(SMALL, camera_mount(yaw_deg=70.0), 30_000_000),
    )
    return simulate_street(3, frames=4, lidar=LidarSpec(beams=16, steps=240), cameras=cameras).scene
