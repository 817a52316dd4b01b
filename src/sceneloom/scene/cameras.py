"""Cameras and depth cameras, their images and shutters."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, BinaryIO, ClassVar, Generic, TypeVar, cast

import numpy as np

from sceneloom.arrays import (
    Float32Array,
    Float64Array,
    FloatArray,
    Int64Array,
    UInt8Array,
    as_array,
    check_array,
    hold_timestamp,
    read_only,
)
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.frames import Array_co, LazyFrames
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Coordinates, Identifier, SensorType
from sceneloom.stages import in_stage


@dataclass(frozen=True, slots=True, eq=False)
class Kept(Generic[Array_co]):
    """Gives an image that is in memory; others cannot write into it."""

    image: Array_co

    def __call__(self) -> Array_co:
        """Give a view that refuses writing."""
        return cast("Array_co", read_only(self.image))


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
        if type(self.timestamp_ns) is not int or self.timestamp_ns.bit_length() > 63:
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
        return in_stage("reading", self.decode)

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

    type: ClassVar[SensorType] = SensorType.CAMERA


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
    """A camera that measures depth; fields as in `CameraSensor`, depth images as `frames`."""

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

    type: ClassVar[SensorType] = SensorType.DEPTH_CAMERA


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


LONGEST_ROLL_S = 1.0
"""What takes longer from an image's first line to its last is no shutter, but another unit [s]."""


@dataclass(frozen=True, slots=True)
class Shutter:
    """How long an image's lines are taken one after the other, and which way.

    Attributes:
        seconds: from the first edge of the image to the last; 0 where all lines are taken at once.
        over_columns: the lines are columns, from the left, instead of rows from the top.
    """

    seconds: float = 0.0
    over_columns: bool = False

    @classmethod
    def of(cls, camera: CameraSensor) -> "Shutter":
        """Take what the calibration says of it: `shutterRollTimeSeconds`, `rollingShutterLeftToRight`."""
        entry = camera.extras.get("calibration")
        if not isinstance(entry, dict):
            return cls()
        seconds = entry.get("shutterRollTimeSeconds")
        if not isinstance(seconds, int | float) or not 0 <= seconds <= LONGEST_ROLL_S:
            return cls()
        return cls(float(seconds), entry.get("rollingShutterLeftToRight") is True)

    def line_count(self, camera: Camera) -> int:
        """How many lines an image has."""
        return camera.width if self.over_columns else camera.height

    def delays(self, lines: FloatArray, camera: Camera) -> Float64Array:
        """When lines are taken after the image's time [s]; those beyond the image's edges as those at the edges.

        Args:
            lines: (N,) rows or columns [px], also between two.

        Source: "Time" in docs/CONVENTIONS.md: row r of H is taken at t + ((r + 0.5)/H - 0.5) · roll time.
        """
        shares = (np.asarray(lines, np.float64) + 0.5) / self.line_count(camera) - 0.5
        delays: Float64Array = np.clip(shares, -0.5, 0.5) * self.seconds
        return delays

    def knots_ns(self, timestamp_ns: int, count: int) -> Int64Array:
        """Times evenly spread over an image from its first edge to its last, (count,) int64 [ns]."""
        spread = np.linspace(-0.5, 0.5, count) * (self.seconds * 1e9)
        knots: Int64Array = timestamp_ns + np.rint(spread).astype(np.int64)
        return knots


GLOBAL = Shutter()
"""Takes all lines at once."""
