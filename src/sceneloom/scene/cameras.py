"""Cameras and their images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import UInt8Array, as_array, check_array, hold_timestamp
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.frames import Kept, LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Coordinates, Identifier, SensorType
from sceneloom.stages import stage


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """One image of a camera.

    Attributes:
        timestamp_ns: mid-exposure of the middle row [ns].
        camera: the camera model at that time.
        decode: makes the image, (height, width, 3) uint8 red green blue; called anew each time.
        mount: `ego_from_camera` where this image has a mounting of its own, else None.
        extras: further fields of the file, by name.
        encoded: gives the JPEG file that the image is decoded from, for those who copy it; None where there is none.
    """

    timestamp_ns: int
    camera: Camera
    decode: Callable[[], UInt8Array]
    mount: RigidTransform | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    encoded: Callable[[], bytes] | None = None

    def __post_init__(self) -> None:
        hold_timestamp(self, "image.timestamp_ns")

    @classmethod
    def of(cls, timestamp_ns: int, camera: Camera, rgb: UInt8Array) -> "CameraImage":
        """Wrap an image that is already in memory."""
        shape = (camera.height, camera.width, 3)
        rgb = as_array("image.rgb", rgb, shape, np.uint8)
        check_array("image.rgb", rgb, shape, np.uint8)
        return cls(timestamp_ns, camera, Kept(rgb))

    @property
    def rgb(self) -> UInt8Array:
        """The image, (height, width, 3) uint8, decoded now; keep it if you need it twice."""
        with stage("reading"):
            return self.decode()

    def loaded(self) -> "CameraImage":
        """The same image, decoded now and kept in memory.

        Raises:
            DataError: it cannot be decoded.
        """
        return self if isinstance(self.decode, Kept) else replace(self, decode=Kept(self.decode()))


@dataclass(frozen=True, slots=True, eq=False)
class VideoContent:
    """The encoded video behind a camera's images, for those who copy it without decoding.

    Attributes:
        open: gives a new seekable binary file over the video's bytes.
        codec: "h264", "hevc", "ffv1", … as FFmpeg calls it.
        frame_indices: which images of the video the camera's frames are, in order; None for all of them.
    """

    open: Callable[[], BinaryIO]
    codec: str
    frame_indices: tuple[int, ...] | None = None

    def chosen(self, rows: slice, count: int) -> "VideoContent":
        """The video of a camera that keeps some of its frames.

        Args:
            rows: which.
            count: how many it had.
        """
        if range(count)[rows] == range(count):
            return self
        indices = range(count) if self.frame_indices is None else self.frame_indices
        return replace(self, frame_indices=tuple(indices[rows]))


@dataclass(frozen=True, slots=True, eq=False)
class CameraSensor:
    """A camera.

    Attributes:
        id: unique among the scene's sensors.
        camera: the camera model (an image can have one of its own).
        images: the images in time order, decoded when asked for.
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
    images: LazyFrames[CameraImage]
    poses: Poses | None = None
    mount: RigidTransform | None = None
    coordinates: Coordinates = Coordinates.WORLD
    video: VideoContent | None = None
    fps: float | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> SensorType:
        """`camera`."""
        return SensorType.CAMERA
