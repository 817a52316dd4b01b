"""What messages of Foxglove's schemas state, whatever their encoding: of protobuf, JSON, FlatBuffers, ROS 1 or ROS 2.

Messages are objects with the fields of the schemas; times have `seconds` and `nanos`, or `sec` and `nanosec` or `nsec`.

Source: docs.foxglove.dev, "Message schemas"; package foxglove_msgs of ROS.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.formats.messages.points import scan_record
from sceneloom.formats.messages.records import (
    VELOCITIES,
    AnyRecord,
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    FixRecord,
    GridRecord,
    ImageRecord,
    Kind,
    PackedCloudRecord,
    PackedField,
    PoseRecord,
    SampleRecord,
    TransformRecord,
    grid_positions,
    rotation_of,
    vector_of,
)
from sceneloom.geometry.rigid import RigidTransform

_LABEL_KEYS = ("label", "class", "class_name", "category", "type")
"""Metadata of plots that name the class of an object, the likeliest first."""

_ID_KEYS = ("id", "track_id", "instance_id", "object_id")  # metadata of plots that name an object, the likeliest first
POINT_TYPES: Mapping[int, str] = MappingProxyType(
    {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
)
"""Numbers of a point's fields by `PackedElementField.type`."""

MATCHING_ID = 0
"""The type of deletions of one entity."""

LINE_LOOP = 2
"""The type of drawings whose last point is joined with the first."""

_LINE_STRIP, _LINE_LIST = 3, 4
_OTHER_PLOTS = ("arrows", "spheres", "cylinders", "lines", "triangles", "models")


def _time_ns(timestamp: Any) -> int:
    if hasattr(timestamp, "nanos"):
        return int(timestamp.seconds) * 1_000_000_000 + int(timestamp.nanos)
    rest = timestamp.nanosec if hasattr(timestamp, "nanosec") else timestamp.nsec
    return int(timestamp.sec) * 1_000_000_000 + int(rest)


def _head(message: Any) -> tuple[int, str]:
    return _time_ns(message.timestamp), str(message.frame_id)


def _states(message: Any, name: str) -> bool:
    """Whether a message has a field: of protobuf and FlatBuffers it may be left out."""
    return bool(message.HasField(name)) if hasattr(message, "HasField") else hasattr(message, name)


def _transforms(message: Any, _: memoryview) -> Iterable[TransformRecord]:
    for part in getattr(message, "transforms", [message]):
        names = str(part.parent_frame_id), str(part.child_frame_id)
        yield TransformRecord(_time_ns(part.timestamp), *names, vector_of(part.translation), rotation_of(part.rotation))


def _image(message: Any, data: memoryview) -> Iterable[ImageRecord]:
    size = int(message.width), int(message.height), int(message.step)
    yield ImageRecord(*_head(message), str(message.encoding), *size, data)


def _compressed_image(message: Any, data: memoryview) -> Iterable[CompressedImageRecord]:
    form = str(message.format).lower().removeprefix("image/").replace("jpg", "jpeg")
    yield CompressedImageRecord(*_head(message), form, data)


def _camera_model(message: Any, _: memoryview) -> Iterable[CameraModelRecord]:
    # ROS 2 writes their names in lower case
    rows = (getattr(message, name if hasattr(message, name) else name.lower()) for name in "DKP")
    numbers = (tuple(map(float, row)) for row in rows)
    size = int(message.width), int(message.height)
    yield CameraModelRecord(*_head(message), *size, str(message.distortion_model), *numbers)


def _cloud(message: Any, data: memoryview) -> Iterable[CloudRecord]:
    fields = tuple(
        PackedField(str(field.name), int(field.offset), np.dtype(POINT_TYPES[int(field.type)]).newbyteorder("<"))
        for field in message.fields
        if int(field.type) in POINT_TYPES
    )
    stride = int(message.point_stride)
    yield CloudRecord(*_head(message), fields, stride, data, frame_from_points=_placed(message))


def _packed_cloud(message: Any, data: memoryview) -> Iterable[PackedCloudRecord]:
    yield PackedCloudRecord(*_head(message), str(message.format), data, frame_from_points=_placed(message))


def _grid(message: Any, data: memoryview) -> Iterable[GridRecord]:
    """A grid, whose cells have the colours that they state."""
    stride, row_stride = int(message.cell_stride), int(message.row_stride)
    columns = int(message.column_count)
    if not 0 < stride * columns <= row_stride:
        raise ValueError(f"{columns} columns of {stride} bytes in rows of {row_stride}; expected longer rows")
    count = len(data) // row_stride
    table = np.frombuffer(data, np.uint8, count * row_stride).reshape(count, row_stride)[:, : columns * stride]
    cells = table.reshape(count * columns, stride)
    offsets = {str(one.name): int(one.offset) for one in message.fields if POINT_TYPES.get(int(one.type)) == "u1"}
    found = [offsets.get(name, stride) for name in ("red", "green", "blue")]
    colors = cells[:, found] if max(found) < stride else None
    rows, across = np.divmod(np.arange(len(cells)), columns)
    size = float(message.cell_size.x), float(message.cell_size.y)
    yield GridRecord(*_head(message), grid_positions(across, rows, size, message.pose), colors)


def _scan(message: Any, _: memoryview) -> Iterable[CloudRecord]:
    ranges = np.asarray(message.ranges, np.float64)
    start, stop = float(message.start_angle), float(message.end_angle)
    step = (stop - start) / (len(ranges) - 1) if len(ranges) > 1 else 0.0
    intensities = np.asarray(message.intensities, np.float64)
    yield scan_record(*_head(message), ranges, intensities, angles=(start, step), frame_from_points=_placed(message))


def _placed(message: Any) -> RigidTransform | None:
    """Where the origin of points is in their frame."""
    if not _states(message, "pose"):
        return None
    position, quaternion = vector_of(message.pose.position), rotation_of(message.pose.orientation)
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion)
    if not 0 < length < math.inf:
        return RigidTransform(np.eye(3), position)
    return RigidTransform.from_quaternion(position, quaternion)


def _poses(message: Any, _: memoryview) -> Iterable[PoseRecord | SampleRecord]:
    head, body = _head(message), str(getattr(message, "body_frame_id", ""))
    numbers = np.asarray(getattr(message, "pose_covariance", ()), np.float64)
    covariance = numbers.reshape(6, 6) if numbers.size == 36 and numbers.any() else None
    for pose in getattr(message, "poses", None) or [message.pose]:
        rotation = rotation_of(pose.orientation)
        known = _states(pose, "orientation") and (hasattr(pose, "HasField") or bool(rotation.any()))
        yield PoseRecord(*head, vector_of(pose.position), rotation if known else None, body, covariance)
    values = {
        stream: tuple(vector_of(getattr(message, name)).tolist())
        for stream, name in zip(VELOCITIES, ("linear_velocity", "angular_velocity"), strict=True)
        if hasattr(message, name) and _states(message, name)
    }
    if values:
        numbers = np.asarray(message.velocity_covariance, np.float64)
        spread = numbers.reshape(6, 6) if numbers.size == 36 else np.zeros((6, 6))
        parts = zip(VELOCITIES, (spread[:3, :3], spread[3:, 3:]), strict=True)
        stated = {name: tuple(part.reshape(-1).tolist()) for name, part in parts if part.any() and name in values}
        yield SampleRecord(head[0], body, values, stated)


def _point(message: Any, _: memoryview) -> Iterable[PoseRecord]:
    yield PoseRecord(*_head(message), vector_of(message.point), None)


def _fixes(message: Any, _: memoryview) -> Iterable[FixRecord]:
    for fix in getattr(message, "fixes", [message]):
        covariance = tuple(map(float, fix.position_covariance))
        known = fix.position_covariance_type != 0 and len(covariance) == 9
        lla = float(fix.latitude), float(fix.longitude), float(fix.altitude)
        variances = (covariance[0], covariance[4], covariance[8]) if known else None
        yield FixRecord(*_head(fix), lla, variances)


def _reported(pairs: Iterable[Any], *all_keys: Sequence[str]) -> tuple[dict[str, str], list[str | None]]:
    """Metadata of a plot, without what the first of each group of keys says, which stands beside it."""
    reported = {str(pair.key): str(pair.value) for pair in pairs}
    names = [next((key for key in keys if key in reported), None) for keys in all_keys]
    return reported, [None if name is None else reported.pop(name) for name in names]


def _boxes_3d(message: Any, _: memoryview) -> Iterable[Boxes3DRecord]:
    boxes: list[Box3D] = []
    others = 0
    for entity in message.entities:
        others += sum(len(getattr(entity, name)) for name in _OTHER_PLOTS) + (not entity.cubes)
        for k, cube in enumerate(entity.cubes):
            reported, (label,) = _reported(entity.metadata, _LABEL_KEYS)
            boxes.append(
                Box3D(
                    entity.id if len(entity.cubes) == 1 else f"{entity.id}/{k}",
                    entity.frame_id,
                    vector_of(cube.pose.position),
                    rotation_of(cube.pose.orientation),
                    vector_of(cube.size),
                    label if label is not None else next((text.text for text in entity.texts if text.text), None),
                    MappingProxyType(reported),
                )
            )
    gone = tuple(deletion.id for deletion in message.deletions if deletion.type == MATCHING_ID)
    for timed in [*message.entities, *message.deletions][:1]:
        yield Boxes3DRecord(_time_ns(timed.timestamp), tuple(boxes), gone, others)


def _boxes_2d(message: Any, _: memoryview) -> Iterable[Boxes2DRecord]:
    by_time: dict[int, list[Box2D]] = {}
    others, plots = len(message.circles), [*message.circles, *message.points, *message.texts]
    for drawing in message.points:
        points = np.array([(point.x, point.y) for point in drawing.points]).reshape(-1, 2)
        box = _upright(points) if drawing.type in {LINE_LOOP, _LINE_STRIP, _LINE_LIST} else None
        if box is None:
            others += 1
            continue
        reported, (identifier, label) = _reported(getattr(drawing, "metadata", ()), _ID_KEYS, _LABEL_KEYS)
        found = Box2D(identifier or "", box, label, MappingProxyType(reported))
        by_time.setdefault(_time_ns(drawing.timestamp), []).append(found)
    if not by_time and others:
        # messages of older schemas have no time of their own
        by_time[_time_ns((message if hasattr(message, "timestamp") else plots[0]).timestamp)] = []
    for number, (timestamp_ns, boxes) in enumerate(by_time.items()):
        yield Boxes2DRecord(timestamp_ns, "", tuple(boxes), 0 if number else others)


def _upright(points: Float64Array) -> tuple[float, float, float, float] | None:
    """Left, top, width and height of a drawing whose points are the corners of an upright box; None of others."""
    if len(points) < 4 or not np.isfinite(points).all():
        return None
    (left, top), (right, bottom) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    if {(x, y) for x, y in points.tolist()} != {(x, y) for x in (left, right) for y in (top, bottom)}:
        return None
    return left, top, right - left, bottom - top


_Reader = Callable[[Any, memoryview], Iterable[AnyRecord]]

READERS: Mapping[str, tuple[Kind, _Reader]] = MappingProxyType(
    {
        "FrameTransform": (Kind.TRANSFORM, _transforms),
        "FrameTransforms": (Kind.TRANSFORM, _transforms),
        "PointCloud": (Kind.CLOUD, _cloud),
        "CompressedPointCloud": (Kind.CLOUD, _packed_cloud),
        "LaserScan": (Kind.CLOUD, _scan),
        "Grid": (Kind.GRID, _grid),
        "RawImage": (Kind.IMAGE, _image),
        "CompressedImage": (Kind.COMPRESSED_IMAGE, _compressed_image),
        "CompressedVideo": (Kind.VIDEO, _compressed_image),
        "CameraCalibration": (Kind.CAMERA_MODEL, _camera_model),
        "PoseInFrame": (Kind.POSE, _poses),
        "PosesInFrame": (Kind.POSE, _poses),
        "Odometry": (Kind.POSE, _poses),
        "Point3InFrame": (Kind.POSE, _point),
        "LocationFix": (Kind.FIX, _fixes),
        "LocationFixes": (Kind.FIX, _fixes),
        "SceneUpdate": (Kind.BOXES_3D, _boxes_3d),
        "ImageAnnotations": (Kind.BOXES_2D, _boxes_2d),
    }
)
"""The schemas that are read, by name: what they state, and what reads a message and the bytes of its field `data`."""
