"""What messages state, whatever their format calls it.

The words that logs of messages are read into and written from.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.types import NO_FIELDS


class Kind(StrEnum):
    """What the messages of a topic state."""

    TRANSFORM = "transform"
    CLOUD = "cloud"
    IMAGE = "image"
    COMPRESSED_IMAGE = "image"
    VIDEO = "video"
    CAMERA_MODEL = "camera_model"
    POSE = "pose"
    FIX = "fix"
    SAMPLE = "sample"
    BOXES_3D = "boxes_3d"
    BOXES_2D = "boxes_2d"
    NOTES = "notes"


LARGE = frozenset({Kind.CLOUD, Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.VIDEO})
"""Kinds whose messages are read one by one, when they are asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class TransformRecord:
    """Where a frame was in its parent frame; `fixed` where it stays there."""

    timestamp_ns: int
    parent: str
    child: str
    position: Float64Array
    quaternion_xyzw: Float64Array
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class PackedField:
    """One value of each point: its name, its location among the bytes of a point, its dtype, how many."""

    name: str
    offset: int
    dtype: np.dtype[Any]
    count: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class CloudRecord:
    """Points, packed one after another.

    Attributes:
        timestamp_ns: of the message [ns].
        frame_id: of the points.
        fields: of each point.
        stride: bytes from point to point.
        count: number of points; None for as many as there are bytes for.
        data: the bytes.
        frame_from_points: where the points' origin is in the frame; None for its origin.
        row_bytes: bytes from row to row and points in a row, of clouds in rows; None where rows follow each other.
    """

    timestamp_ns: int
    frame_id: str
    fields: tuple[PackedField, ...]
    stride: int
    data: memoryview
    count: int | None = None
    frame_from_points: RigidTransform | None = None
    row_bytes: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """Pixels in rows of `step` bytes."""

    timestamp_ns: int
    frame_id: str
    encoding: str
    width: int
    height: int
    step: int
    data: memoryview
    big_endian: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CompressedImageRecord:
    """A whole image file, or the packets of one image of a video; `form` is "jpeg", "png", "h264", …."""

    timestamp_ns: int
    frame_id: str
    form: str
    data: memoryview


@dataclass(frozen=True, slots=True, eq=False)
class CameraModelRecord:
    """A camera model in the words of camera calibrations: `model` with `coefficients`, and (9,) K row by row."""

    timestamp_ns: int
    frame_id: str
    width: int
    height: int
    model: str
    coefficients: tuple[float, ...]
    k: tuple[float, ...]
    p: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """Where a body was in a frame.

    Attributes:
        timestamp_ns: when [ns].
        frame_id: in which frame.
        position: (3,) float64 [m].
        quaternion_xyzw: (4,) float64, or None where it is not stated.
        body: the frame of the body; "" where it is not stated.
        covariance: (6, 6) float64 of position [m], then rotate [rad]; None where it is not stated.
    """

    timestamp_ns: int
    frame_id: str
    position: Float64Array
    quaternion_xyzw: Float64Array | None
    body: str = ""
    covariance: Float64Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FixRecord:
    """Where a satellite receiver was: latitude, longitude [deg], altitude [m]; variances (east, north, up) [m²]."""

    timestamp_ns: int
    frame_id: str
    lla: tuple[float, float, float]
    variances: tuple[float, float, float] | None = None
    received: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class SampleRecord:
    """What an IMU measured at a time, by the names of its streams."""

    timestamp_ns: int
    frame_id: str
    values: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Box3D:
    """A box in space.

    Attributes:
        id: of the object; "" where it has none.
        frame_id: of centre and rotate.
        center: (3,) float64 [m].
        quaternion_xyzw: (4,) float64.
        size_lwh: (3,) float64 [m].
        label: class of the object, or None.
        reported: what else is stated, by name.
    """

    id: str
    frame_id: str
    center: Float64Array
    quaternion_xyzw: Float64Array
    size_lwh: Float64Array
    label: str | None = None
    reported: Mapping[str, str] = field(default_factory=lambda: NO_FIELDS)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes3DRecord:
    """Boxes in space at a time, the ids of those that are gone, and how many plots are no boxes."""

    timestamp_ns: int
    boxes: tuple[Box3D, ...]
    gone: tuple[str, ...] = ()
    no_boxes: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Box2D:
    """A box in an image: left, top, width, height [px] from the image's corner; the rest as in `Box3D`."""

    id: str
    box_ltwh: tuple[float, float, float, float]
    label: str | None = None
    reported: Mapping[str, str] = field(default_factory=lambda: NO_FIELDS)


@dataclass(frozen=True, slots=True, eq=False)
class Boxes2DRecord:
    """Boxes in the image of a time, and how many plots are no boxes."""

    timestamp_ns: int
    frame_id: str
    boxes: tuple[Box2D, ...]
    no_boxes: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class NotesRecord:
    """What a scene holds that no message has a location for, as JSON."""

    timestamp_ns: int
    text: str


AnyRecord = (
    TransformRecord
    | CloudRecord
    | ImageRecord
    | CompressedImageRecord
    | CameraModelRecord
    | PoseRecord
    | FixRecord
    | SampleRecord
    | Boxes3DRecord
    | Boxes2DRecord
    | NotesRecord
)
