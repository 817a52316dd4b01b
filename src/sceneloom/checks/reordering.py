"""Frames of a sensor in another order, or some of them, for fixes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene, Sensor


@dataclass(frozen=True, slots=True, eq=False)
class _Reordered:
    """Reads the frames of another sequence in another order; goes to other processes as those do."""

    read: Callable[[int], Any]
    order: tuple[int, ...]

    def __call__(self, k: int) -> Any:
        return self.read(self.order[k])


def sorted_frames(frames: LazyFrames[Any]) -> LazyFrames[Any]:
    """The same frames in the order of their times; those of one time stay as they are among each other."""
    return chosen_frames(frames, np.argsort(frames.timestamps_ns, kind="stable").astype(np.int64))


def chosen_frames(frames: LazyFrames[Any], rows: Int64Array) -> LazyFrames[Any]:
    """Some of the frames, (M,) numbers of them, in that order."""
    read = _Reordered(frames.__getitem__, tuple(rows.tolist()))
    return LazyFrames(frames.timestamps_ns[rows], read)


def is_sorted(frames: LazyFrames[Any]) -> bool:
    """Whether the frames stand in the order of their times."""
    timestamps_ns = frames.timestamps_ns
    return not (timestamps_ns[1:] < timestamps_ns[:-1]).any()


def with_sorted_frames(scene: Scene) -> Scene:
    """Sort the frames of every sensor by time; images of a video stay, since the video has its own order."""
    sensors = tuple(map(_sorted, scene.sensors))
    changed = any(new is not old for new, old in zip(sensors, scene.sensors, strict=True))
    return replace(scene, sensors=sensors) if changed else scene


def _sorted(sensor: Sensor) -> Sensor:
    if isinstance(sensor, LidarSensor) and not is_sorted(sensor.frames):
        return replace(sensor, frames=sorted_frames(sensor.frames))
    if isinstance(sensor, RadarSensor) and not is_sorted(sensor.frames):
        return replace(sensor, frames=sorted_frames(sensor.frames))
    if isinstance(sensor, CameraSensor) and sensor.video is None and not is_sorted(sensor.images):
        return replace(sensor, images=sorted_frames(sensor.images))
    if isinstance(sensor, DepthCameraSensor) and sensor.video is None and not is_sorted(sensor.frames):
        return replace(sensor, frames=sorted_frames(sensor.frames))
    return sensor
