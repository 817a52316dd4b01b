"""A short simulated drive, shared by the tests of the main job."""

from dataclasses import replace

import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.scene import CameraSensor, LazyFrames, LidarSensor
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

SMALL = Camera("pinhole", 160, 96, 90.0, 90.0, 79.5, 47.5)


@pytest.fixture(scope="session")
def keep():
    """Makes the sweeps and images of a simulated scene once, and not whenever a test asks for them."""
    return lambda scene: replace(scene, sensors=tuple(map(kept, scene.sensors)))


@pytest.fixture(scope="session")
def drive(keep):
    """Four sweeps of a coarse lidar and two small cameras."""
    cameras = (CameraSpec(SMALL, camera_mount()), CameraSpec(SMALL, camera_mount(yaw_deg=70.0), 30_000_000))
    return keep(simulate_street(3, frames=4, lidar=LidarSpec(beams=16, steps=240), cameras=cameras).scene)


def kept(sensor):
    """The sensor with its sweeps or images in memory."""
    if isinstance(sensor, LidarSensor):
        return replace(sensor, frames=LazyFrames.of(list(sensor.frames), sensor.frames.timestamps_ns))
    if isinstance(sensor, CameraSensor):
        images = [p.loaded() for p in sensor.images]
        return replace(sensor, images=LazyFrames.of(images, sensor.images.timestamps_ns))
    return sensor
