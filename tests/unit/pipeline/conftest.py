"""A short simulated drive, shared by the tests of the main job."""

from dataclasses import replace

import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.scene import CameraSensor, GnssSensor, LazyFrames, LidarSensor
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


def with_lidar(scene, **changes):
    """The scene with fields of its lidars changed."""
    sensors = tuple(replace(s, **changes) if isinstance(s, LidarSensor) else s for s in scene.sensors)
    return replace(scene, sensors=sensors)


def with_frames(scene, edit):
    """The scene with what a function makes of each sweep, when it is read, and of its number."""
    frames = scene.lidars[0].frames
    return with_lidar(scene, frames=LazyFrames(frames.timestamps_ns, lambda k: edit(frames[k], k)))


def without_trajectory(scene):
    """The scene with nothing to find the trajectory by but its sweeps."""
    return replace(scene, trajectories={}, sensors=tuple(s for s in scene.sensors if not isinstance(s, GnssSensor)))


def shortened(trajectory, stop_ns):
    """The trajectory up to a time."""
    part = trajectory.timestamps_ns <= stop_ns
    names = ("timestamps_ns", "positions", "quaternions_xyzw")
    return replace(trajectory, **{name: getattr(trajectory, name)[part] for name in names})
