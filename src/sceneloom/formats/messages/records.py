"""Messages whatever their format: records, topics that are read, streams that are written, supported fields."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt8Array
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
    PACKETS = "packets"
    DESCRIPTION = "description"
    GRID = "grid"


LARGE = frozenset({Kind.CLOUD, Kind.IMAGE, Kind.COMPRESSED_IMAGE, Kind.VIDEO, Kind.PACKETS, Kind.GRID})
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
        base_ns: what times of points count from in nanoseconds, of messages that state it.
        left_out: names of fields that could not be decompressed.
    """

    timestamp_ns: int
    frame_id: str
    fields: tuple[PackedField, ...]
    stride: int
    data: memoryview
    count: int | None = None
    frame_from_points: RigidTransform | None = None
    row_bytes: tuple[int, int] | None = None
    base_ns: int | None = None
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class PackedCloudRecord:
    """Compressed points; `layout` is what the message itself states of them, without bytes, or None."""

    timestamp_ns: int
    frame_id: str
    form: str
    data: memoryview
    layout: CloudRecord | None = None
    frame_from_points: RigidTransform | None = None


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
    """What an IMU measured at a time, by the names of its streams, and the (K, K) covariances of these, row by row."""

    timestamp_ns: int
    frame_id: str
    values: Mapping[str, tuple[float, ...]]
    covariances: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: NO_FIELDS)


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
class PacketsRecord:
    """Packets of a lidar or radar as they came over the network.

    Attributes:
        timestamp_ns: of the message [ns]; 0 where it has none.
        frame_id: of the sensor; "" where it is not stated.
        packets: the bytes of each; (N, L) uint8 of packets of one length.
        arrivals_ns: (N,) int64 [ns], when they came; None where it is not stated.
    """

    timestamp_ns: int
    frame_id: str
    packets: tuple[memoryview, ...] | UInt8Array
    arrivals_ns: Int64Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class GridRecord:
    """The cells of a grid whose values are known.

    Attributes:
        timestamp_ns: of the message [ns].
        frame_id: of the grid.
        positions: (N, 3) float64 [m], the middles of the cells.
        colors: (N, 3) uint8, or None where their values are none.
    """

    timestamp_ns: int
    frame_id: str
    positions: Float64Array
    colors: UInt8Array | None


@dataclass(frozen=True, slots=True, eq=False)
class NotesRecord:
    """What a scene holds that no message has a field for, or a sensor says of itself, as JSON."""

    timestamp_ns: int
    text: str


AnyRecord = (
    TransformRecord
    | CloudRecord
    | PackedCloudRecord
    | ImageRecord
    | CompressedImageRecord
    | CameraModelRecord
    | PoseRecord
    | FixRecord
    | SampleRecord
    | Boxes3DRecord
    | Boxes2DRecord
    | PacketsRecord
    | GridRecord
    | NotesRecord
)


@dataclass(frozen=True, slots=True)
class Topic:
    """A stream of messages.

    Attributes:
        number: of the stream in its log.
        name: of the topic.
        schema: name of the messages' type.
        kind: what they state; None where we do not know such messages.
        count: how many there are.
        why: what keeps us from reading them, where `kind` is None.
    """

    number: int
    name: str
    schema: str
    kind: Kind | None
    count: int
    why: str = "of a type that is not read"


VELOCITIES = ("linearVelocity", "angularVelocity")
"""Streams of what odometry, wheels or receivers say of the motion [m/s], [rad/s], in the axes of the body."""


class TopicLog(Protocol):
    """Messages that are read by their topic and number, in the order of the file; it can be pickled."""

    @property
    def name(self) -> str:
        """What messages call the log."""
        ...

    @property
    def topics(self) -> Sequence[Topic]:
        """All streams."""
        ...

    @property
    def notes(self) -> str | None:
        """What our own writer left as JSON, or None."""
        ...

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        ...

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself, (N,) int64 [ns], and whether all of them were looked at."""
        ...

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says."""
        ...

    def close(self) -> None:
        """Release the files."""
        ...


Stated = tuple[str, AnyRecord]
"""A topic, and what is stated on it."""


def vector_of(vector: Any) -> Float64Array:
    """(3,) float64 of the x, y and z of a message."""
    return np.array([vector.x, vector.y, vector.z])


def grid_positions(columns: Int64Array, rows: Int64Array, cell: tuple[float, float], pose: Any) -> Float64Array:
    """The middles of cells of a grid, (N, 3) float64 [m], by the pose of its corner.

    Args:
        columns, rows: (N,) int64, along x and y.
        cell: size of a cell along x and y [m].
        pose: `position` and `orientation` of a message.
    """
    flat = np.stack(((columns + 0.5) * cell[0], (rows + 0.5) * cell[1], np.zeros(len(rows))), axis=1)
    position, quaternion = vector_of(pose.position), rotation_of(pose.orientation)
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion)
    turned = 0 < length < np.inf
    corner = RigidTransform.from_quaternion(position, quaternion) if turned else RigidTransform(np.eye(3), position)
    return corner.apply(flat)


def rotation_of(quaternion: Any) -> Float64Array:
    """(4,) float64, x y z w of a message."""
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


@dataclass(frozen=True, slots=True)
class Dialect:
    """The habits of a format.

    Attributes:
        name: of the format, for losses.
        world, ego: names of these frames.
        part: makes a part of a topic's name of an id.
        fisheye: the name of OpenCV's fisheye camera model.
        camera_model_topic: last part of topics of camera models.
        sample_topics: last part of the topic of each stream of an IMU; "" for all that have none of their own.
        videos: whether there are messages for videos.
        covariances: whether poses have covariances.
        each_camera_model: whether each image comes with a message of its camera model, as synchronisers of pairs
            expect.
        intensity: dtype of intensities.
    """

    name: str
    world: str
    ego: str
    part: Callable[[str | int], str]
    fisheye: str
    camera_model_topic: str
    sample_topics: Mapping[str, str]
    videos: bool
    covariances: bool
    each_camera_model: bool = False
    intensity: str = "u1"
