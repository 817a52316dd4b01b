"""What cameras of colours and of depths have in common: shots in time order, and often a video behind them."""

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames

ShootingSensor = CameraSensor | DepthCameraSensor
"""A camera of colours, or of depths."""
Shot = CameraImage | DepthFrame
"""What it takes."""

Shooting = TypeVar("Shooting", CameraSensor, DepthCameraSensor)


def shots_of(sensor: ShootingSensor) -> LazyFrames[Any]:
    """The images of a camera, or the images of one that measures depth."""
    return sensor.images if isinstance(sensor, CameraSensor) else sensor.frames


def mounts_of_shots(sensor: ShootingSensor) -> list[RigidTransform | None] | None:
    """`ego_from_camera` of each image, its own or else the camera's; None where they are all the camera's."""
    own = [shot.mount for shot in shots_of(sensor)]
    if all(mount is None or _equal(mount, sensor.mount) for mount in own):
        return None
    return [sensor.mount if mount is None else mount for mount in own]


def _equal(a: RigidTransform, b: RigidTransform | None) -> bool:
    return a is b or (b is not None and np.array_equal(a.matrix, b.matrix))


def with_shots(sensor: Shooting, shots: LazyFrames[Any], video: VideoContent | None) -> Shooting:
    """The same camera with other shots, and the video that they come from, if any."""
    if isinstance(sensor, CameraSensor):
        return replace(sensor, images=shots, video=video)
    return replace(sensor, frames=shots, video=video)


def chosen_shots(sensor: Shooting, rows: slice) -> Shooting:
    """The same camera with some of its shots; its video stays, and says which of its images they are."""
    shots = shots_of(sensor)
    video = None if sensor.video is None else sensor.video.chosen(rows, len(shots))
    return with_shots(sensor, shots[rows], video)
