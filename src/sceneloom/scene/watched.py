"""A scene that reports each frame that is read, for those who count or show how far they are."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from sceneloom.scene.cameras import CameraImage, CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier

AnyFrame = LidarFrame | RadarFrame | CameraImage | DepthFrame
Reported = Callable[[Identifier, int, AnyFrame], None]
"""Is reported the sensor's id, the frame's number, and the frame."""

Framed = TypeVar("Framed", LidarFrame, RadarFrame, CameraImage, DepthFrame)


@dataclass(frozen=True, slots=True, eq=False)
class _Watched(Generic[Framed]):
    """Reads frames and reports them."""

    frames: LazyFrames[Framed]
    sensor_id: Identifier
    reported: Reported

    def __call__(self, k: int) -> Framed:
        frame = self.frames[k]
        self.reported(self.sensor_id, k, frame)
        return frame


def watched(scene: Scene, reported: Reported) -> Scene:
    """Give the same scene, which reports each sweep, radar cycle, image and depth image when it is read."""
    return replace(scene, sensors=tuple(_watched_sensor(sensor, reported) for sensor in scene.sensors))


def _watched_sensor(sensor: Sensor, reported: Reported) -> Sensor:
    if isinstance(sensor, LidarSensor):
        sweeps = sensor.frames
        return replace(sensor, frames=LazyFrames(sweeps.timestamps_ns, _Watched(sweeps, sensor.id, reported)))
    if isinstance(sensor, RadarSensor):
        cycles = sensor.frames
        return replace(sensor, frames=LazyFrames(cycles.timestamps_ns, _Watched(cycles, sensor.id, reported)))
    if isinstance(sensor, CameraSensor):
        camera_images = sensor.images
        seen = LazyFrames(camera_images.timestamps_ns, _Watched(camera_images, sensor.id, reported))
        return replace(sensor, images=seen)
    if isinstance(sensor, DepthCameraSensor):
        images = sensor.frames
        return replace(sensor, frames=LazyFrames(images.timestamps_ns, _Watched(images, sensor.id, reported)))
    return sensor
