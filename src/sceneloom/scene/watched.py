"""A scene that tells of each frame that is read, for those who count or show how far they are."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from sceneloom.scene.cameras import CameraSensor, Picture
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier

AnyFrame = LidarFrame | RadarFrame | Picture | DepthFrame
Told = Callable[[Identifier, int, AnyFrame], None]
"""Is told the sensor's id, the frame's number, and the frame."""

Framed = TypeVar("Framed", LidarFrame, RadarFrame, Picture, DepthFrame)


@dataclass(frozen=True, slots=True, eq=False)
class _Watched(Generic[Framed]):
    """Reads frames and tells of them."""

    frames: LazyFrames[Framed]
    sensor_id: Identifier
    told: Told

    def __call__(self, k: int) -> Framed:
        frame = self.frames[k]
        self.told(self.sensor_id, k, frame)
        return frame


def watched(scene: Scene, told: Told) -> Scene:
    """Give the same scene, which tells of each sweep, radar cycle, picture and depth image when it is read."""
    return replace(scene, sensors=tuple(_watched_sensor(sensor, told) for sensor in scene.sensors))


def _watched_sensor(sensor: Sensor, told: Told) -> Sensor:
    if isinstance(sensor, LidarSensor):
        sweeps = sensor.frames
        return replace(sensor, frames=LazyFrames(sweeps.timestamps_ns, _Watched(sweeps, sensor.id, told)))
    if isinstance(sensor, RadarSensor):
        cycles = sensor.frames
        return replace(sensor, frames=LazyFrames(cycles.timestamps_ns, _Watched(cycles, sensor.id, told)))
    if isinstance(sensor, CameraSensor):
        pictures = sensor.pictures
        seen = LazyFrames(pictures.timestamps_ns, _Watched(pictures, sensor.id, told))
        return replace(sensor, pictures=seen)
    if isinstance(sensor, DepthCameraSensor):
        images = sensor.frames
        return replace(sensor, frames=LazyFrames(images.timestamps_ns, _Watched(images, sensor.id, told)))
    return sensor
