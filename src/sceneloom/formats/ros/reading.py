"""What messages of ROS state.

Source: packages sensor_msgs, nav_msgs, geometry_msgs, tf2_msgs and vision_msgs of ROS 2; REP 103, 105 and 118.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.formats.topics.records import (
    AnyRecord,
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    FixRecord,
    ImageRecord,
    Kind,
    NotesRecord,
    PackedField,
    PoseRecord,
    SampleRecord,
    TransformRecord,
)

DATATYPES: Mapping[int, str] = MappingProxyType(
    {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
)
"""The types of `sensor_msgs/msg/PointField`."""

MICROTESLA = 1e-6
ZERO_CELSIUS = 273.15
NO_FIX = -1
"""Status of fixes without reception."""


def timestamp_ns(stamp: Any) -> int:
    """A time of a message [ns]."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _head(message: Any) -> tuple[int, str]:
    """Time and frame; names of frames begin with a slash in old bags."""
    return timestamp_ns(message.header.stamp), _frame(message.header.frame_id)


def _frame(name: str) -> str:
    return name.lstrip("/")


def _vector(vector: Any) -> Float64Array:
    return np.array([vector.x, vector.y, vector.z])


def _rotation(quaternion: Any) -> Float64Array:
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def _bytes(data: Any) -> memoryview:
    return np.ascontiguousarray(data).data.cast("B")


def _transforms(message: Any) -> Iterable[TransformRecord]:
    for transform in getattr(message, "transforms", [message]):
        time_ns, parent = _head(transform)
        moved = transform.transform
        child = _frame(transform.child_frame_id)
        yield TransformRecord(time_ns, parent, child, _vector(moved.translation), _rotation(moved.rotation))


def _cloud(message: Any) -> Sequence[CloudRecord]:
    order: Literal["<", ">"] = ">" if message.is_bigendian else "<"
    fields = tuple(
        PackedField(
            field.name,
            int(field.offset),
            np.dtype(DATATYPES[field.datatype]).newbyteorder(order),
            max(1, int(field.count)),
        )
        for field in message.fields
        if field.datatype in DATATYPES
    )
    return [
        CloudRecord(
            *_head(message),
            fields,
            int(message.point_step),
            _bytes(message.data),
            int(message.width) * int(message.height),
            row_bytes=(int(message.row_step), int(message.width)) if message.height > 1 else None,
        )
    ]


def _image(message: Any) -> Sequence[ImageRecord]:
    return [
        ImageRecord(
            *_head(message),
            str(message.encoding),
            int(message.width),
            int(message.height),
            int(message.step),
            _bytes(message.data),
            bool(message.is_bigendian),
        )
    ]


def _compressed_image(message: Any) -> Sequence[CompressedImageRecord]:
    return [CompressedImageRecord(*_head(message), message.format.lower(), _bytes(message.data))]


def _video(message: Any) -> Sequence[CompressedImageRecord]:
    form = message.format.lower()
    return [
        CompressedImageRecord(
            timestamp_ns(message.timestamp), _frame(message.frame_id), form, _bytes(message.data)
        )
    ]


def _camera_model(message: Any) -> Sequence[CameraModelRecord]:
    numbers = {name: tuple(map(float, _either(message, name))) for name in "dkp"}
    return [
        CameraModelRecord(
            *_head(message),
            int(message.width),
            int(message.height),
            message.distortion_model,
            numbers["d"],
            numbers["k"],
            numbers["p"],
        )
    ]


def _either(message: Any, name: str) -> Any:
    """A field that ROS 1 writes in upper case."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def _pose(message: Any) -> Sequence[PoseRecord]:
    pose, covariance = message.pose, None
    if hasattr(pose, "pose"):
        spread = np.array(pose.covariance, np.float64).reshape(6, 6)
        pose, covariance = pose.pose, spread if spread.any() else None
    rotation, body = _rotation(pose.orientation), _frame(getattr(message, "child_frame_id", ""))
    reported = rotation if rotation.any() else None
    return [PoseRecord(*_head(message), _vector(pose.position), reported, body, covariance)]


def _point(message: Any) -> Sequence[PoseRecord]:
    return [PoseRecord(*_head(message), _vector(message.point), None)]


def _fix(message: Any) -> Sequence[FixRecord]:
    covariance = np.array(message.position_covariance, np.float64)
    variances = (float(covariance[0]), float(covariance[4]), float(covariance[8]))
    return [
        FixRecord(
            *_head(message),
            (float(message.latitude), float(message.longitude), float(message.altitude)),
            variances if message.position_covariance_type else None,
            received=message.status.status != NO_FIX,
        )
    ]


def _imu(message: Any) -> Sequence[SampleRecord]:
    """Measurements; a first element -1 of their covariances says that there are none."""
    values: dict[str, tuple[float, ...]] = {}
    if message.linear_acceleration_covariance[0] != -1:
        values["accelerometer"] = tuple(_vector(message.linear_acceleration).tolist())
    if message.angular_velocity_covariance[0] != -1:
        values["gyroscope"] = tuple(_vector(message.angular_velocity).tolist())
    rotation = _rotation(message.orientation)
    if message.orientation_covariance[0] != -1 and not lengths_of(rotation[None])[1][0]:
        values["orientation"] = tuple(rotation.tolist())
    return [SampleRecord(*_head(message), values)]


def _magnetic(message: Any) -> Sequence[SampleRecord]:
    field = _vector(message.magnetic_field) / MICROTESLA
    return [SampleRecord(*_head(message), {"magnetometer": tuple(field.tolist())})]


def _temperature(message: Any) -> Sequence[SampleRecord]:
    return [SampleRecord(*_head(message), {"imuTemperature": (float(message.temperature) + ZERO_CELSIUS,)})]


def _label(detection: Any) -> tuple[str | None, dict[str, str]]:
    """Class and score of the likeliest hypothesis; packages before vision_msgs 4 have both in the result itself."""
    best, label = None, None
    for result in detection.results:
        hypothesis = getattr(result, "hypothesis", result)
        if best is None or hypothesis.score > best:
            best = float(hypothesis.score)
            label = str(getattr(hypothesis, "class_id", getattr(hypothesis, "id", "")))
    return label or None, {} if best is None else {"score": repr(best)}


def _boxes_3d(message: Any) -> Sequence[Boxes3DRecord]:
    time_ns, frame = _head(message)
    boxes = []
    for detection in message.detections:
        label, reported = _label(detection)
        center = detection.bbox.center
        boxes.append(
            Box3D(
                str(getattr(detection, "id", "")),
                _frame(detection.header.frame_id) or frame,
                _vector(center.position),
                _rotation(center.orientation),
                _vector(detection.bbox.size),
                label,
                MappingProxyType(reported),
            )
        )
    return [Boxes3DRecord(time_ns, tuple(boxes))]


def _boxes_2d(message: Any) -> Sequence[Boxes2DRecord]:
    time_ns, frame = _head(message)
    boxes, rotated = [], 0
    for detection in message.detections:
        label, reported = _label(detection)
        box = detection.bbox
        center = getattr(box.center, "position", box.center)
        if box.center.theta != 0:
            rotated += 1
            continue
        width, height = float(box.size_x), float(box.size_y)
        corner = float(center.x) - width / 2, float(center.y) - height / 2
        named = str(getattr(detection, "id", ""))
        boxes.append(Box2D(named, (*corner, width, height), label, MappingProxyType(reported)))
    return [Boxes2DRecord(time_ns, frame, tuple(boxes), rotated)]


def _notes(message: Any) -> Sequence[NotesRecord]:
    return [NotesRecord(0, message.data)]


Reader = Callable[[Any], Iterable[AnyRecord]]

READERS: Mapping[str, tuple[Kind, Reader]] = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": (Kind.TRANSFORM, _transforms),
        "tf/msg/tfMessage": (Kind.TRANSFORM, _transforms),
        "geometry_msgs/msg/TransformTimestamped": (Kind.TRANSFORM, _transforms),
        "sensor_msgs/msg/PointCloud2": (Kind.CLOUD, _cloud),
        "sensor_msgs/msg/Image": (Kind.IMAGE, _image),
        "sensor_msgs/msg/CompressedImage": (Kind.COMPRESSED_IMAGE, _compressed_image),
        "foxglove_msgs/msg/CompressedVideo": (Kind.VIDEO, _video),
        "sensor_msgs/msg/CameraInfo": (Kind.CAMERA_MODEL, _camera_model),
        "nav_msgs/msg/Odometry": (Kind.POSE, _pose),
        "geometry_msgs/msg/PoseTimestamped": (Kind.POSE, _pose),
        "geometry_msgs/msg/PoseWithCovarianceTimestamped": (Kind.POSE, _pose),
        "geometry_msgs/msg/PointTimestamped": (Kind.POSE, _point),
        "sensor_msgs/msg/NavSatFix": (Kind.FIX, _fix),
        "sensor_msgs/msg/Imu": (Kind.SAMPLE, _imu),
        "sensor_msgs/msg/MagneticField": (Kind.SAMPLE, _magnetic),
        "sensor_msgs/msg/Temperature": (Kind.SAMPLE, _temperature),
        "vision_msgs/msg/Detection3DArray": (Kind.BOXES_3D, _boxes_3d),
        "vision_msgs/msg/Detection2DArray": (Kind.BOXES_2D, _boxes_2d),
        "std_msgs/msg/String": (Kind.NOTES, _notes),
    }
)
"""The types that are read, by name: what they state, and what reads them."""

NOT_READ: Mapping[str, str] = MappingProxyType(
    {
        "nav_msgs/msg/Odometry": "velocities",
        "sensor_msgs/msg/Imu": "covariances",
        "sensor_msgs/msg/MagneticField": "covariances",
        "sensor_msgs/msg/Temperature": "variances",
        "vision_msgs/msg/Detection3DArray": "hypotheses but the likeliest, and their poses,",
        "vision_msgs/msg/Detection2DArray": "hypotheses but the likeliest, and their poses,",
    }
)
"""What is left out of messages that are read."""
