"""A short simulated drive, shared by the tests of the main job."""

from dataclasses import replace

import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.scene import CameraSensor, LazyFrames, LidarSensor, Picture, Scene, Sensor
from sceneloom.simulate import CameraSpec, LidarSpec, camera_mount, simulate_street

SMALL = Camera("pinhole", 160, 96, 90.0, 90.0, 79.5, 47.5)


@pytest.fixture(scope="session")
def drive() -> Scene:
    """Four sweeps of a coarse lidar and two small cameras."""
    cameras = (
        CameraSpec(SMALL, camera_mount()),
        CameraSpec(SMALL, camera_mount(yaw_deg=70.0), 30_000_000),
    )
    scene = simulate_street(3, frames=4, lidar=LidarSpec(beams=16, steps=240), cameras=cameras).scene
    return replace(scene, sensors=tuple(map(kept, scene.sensors)))


def kept(sensor: Sensor) -> Sensor:
    """The sensor with its sweeps or pictures made once, and not whenever a test asks for them."""
    if isinstance(sensor, LidarSensor):
        return replace(sensor, frames=LazyFrames.of(list(sensor.frames), sensor.frames.timestamps_ns))
    if isinstance(sensor, CameraSensor):
        pictures = [Picture.of(p.timestamp_ns, p.camera, p.rgb) for p in sensor.pictures]
        return replace(sensor, pictures=LazyFrames.of(pictures, sensor.pictures.timestamps_ns))
    return sensor
