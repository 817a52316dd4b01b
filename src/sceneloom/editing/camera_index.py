"""The camera that coloured each point, when the cameras of a scene change locations."""

from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import OptionError
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of

UNSEEN = 255
"""The `camera_index` of a point that no camera coloured."""


@dataclass(frozen=True, slots=True, eq=False)
class RecountedFrames:
    """Reads sweeps and counts the cameras of their points anew; what `LazyFrames` asks for.

    Attributes:
        frames: as they were.
        table: (256,) uint8, new number of each camera by its old one.
    """

    frames: LazyFrames[LidarFrame]
    table: UInt8Array

    def __call__(self, k: int) -> LidarFrame:
        """Read sweep `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame = self.frames[k]
        index = frame.points.camera_index
        if index is None:
            return frame
        return replace(frame, points=replace(frame.points, camera_index=self.table[index]))


def recounted(lidar: LidarSensor, numbers: dict[int, int]) -> LidarSensor:
    """Give a lidar whose points name their cameras by new numbers, by the old ones; of others, no camera.

    Raises:
        OptionError: a number is beyond those that a point can bear.
    """
    if max(numbers.values(), default=0) >= UNSEEN:
        raise OptionError(f"{max(numbers.values()) + 1} cameras; points can name {UNSEEN} at most")
    table = np.full(256, UNSEEN, np.uint8)
    for old, new in numbers.items():
        table[old] = new
    timestamps_ns = lidar.frames.timestamps_ns
    return replace(lidar, frames=LazyFrames(timestamps_ns, RecountedFrames(lidar.frames, table)))


def without_cameras(scene: Scene, kept: Scene) -> Scene:
    """The scene `kept`, made of `scene` by leaving out sensors: its points name the cameras by their new locations."""
    locations = {key_of(camera.id): k for k, camera in enumerate(kept.cameras)}
    old = [key_of(camera.id) for camera in scene.cameras]
    numbers = {k: locations[key] for k, key in enumerate(old) if key in locations}
    if len(numbers) == len(old):
        return kept
    sensors = tuple(
        recounted(sensor, numbers) if isinstance(sensor, LidarSensor) else sensor for sensor in kept.sensors
    )
    return replace(kept, sensors=sensors)
