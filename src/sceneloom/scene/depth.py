"""Cameras that measure depth, and their images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, as_array, check_array, hold_timestamp
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import VideoContent
from sceneloom.scene.frames import Kept, LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Coordinates, Identifier, SensorType


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """One depth image.

    Attributes:
        timestamp_ns: mid-exposure of the middle row [ns].
        camera: the camera model at that time; a depth stands in the camera's own, distorted grid.
        decode: makes the image, (height, width) float32, z [m] along the optical axis, 0 for none; called anew each
            time.
        scale: metres per step where the source has whole steps, so that writing loses nothing; None where it has not.
        mount: `ego_from_camera` where this image has a mounting of its own, else None.
        extras: further fields of the file, by name.
    """

    timestamp_ns: int
    camera: Camera
    decode: Callable[[], Float32Array]
    scale: float | None = None
    mount: RigidTransform | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_timestamp(self, "frame.timestamp_ns")

    @classmethod
    def of(cls, timestamp_ns: int, camera: Camera, depth: Float32Array) -> "DepthFrame":
        """Wrap an image that is already in memory, (height, width) float32 [m], 0 for none."""
        shape = (camera.height, camera.width)
        depth = as_array("frame.depth", depth, shape, np.float32)
        check_array("frame.depth", depth, shape, np.float32)
        return cls(timestamp_ns, camera, Kept(depth))

    @property
    def depth(self) -> Float32Array:
        """The image, (height, width) float32 [m], decoded now; keep it if you need it twice."""
        return self.decode()

    def loaded(self) -> "DepthFrame":
        """The same image, decoded now and kept in memory.

        Raises:
            DataError: it cannot be decoded.
        """
        return self if isinstance(self.decode, Kept) else replace(self, decode=Kept(self.decode()))


@dataclass(frozen=True, slots=True, eq=False)
class DepthCameraSensor:
    """A camera that measures depth.

    Attributes:
        id: unique among the scene's sensors.
        camera: the camera model (an image can have one of its own).
        frames: the depth images in time order, decoded when asked for.
        poses: camera (x right, y down, z forward) to `coordinates` frame, or None.
        mount: `ego_from_camera`, where the source knows a rigid mounting.
        coordinates: the frame that `poses` lead into.
        video: the encoded video, where the images come from one.
        fps: nominal images a second, or None.
        parent_id: id of the parent sensor, or None.
        extras: further fields of the file, by name.
    """

    id: Identifier
    camera: Camera
    frames: LazyFrames[DepthFrame]
    poses: Poses | None = None
    mount: RigidTransform | None = None
    coordinates: Coordinates = Coordinates.WORLD
    video: VideoContent | None = None
    fps: float | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> SensorType:
        """`depth_camera`."""
        return SensorType.DEPTH_CAMERA
