"""Messages of Foxglove's schemas: from protobuf or JSON to records and back, large fields without a copy."""

import base64
import binascii
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
from google.protobuf import descriptor_pb2, json_format
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import DecodeError, Message

from sceneloom.arrays import Float64Array
from sceneloom.errors import MissingExtraError, OutputError, how_to_install
from sceneloom.formats.base.protobuf import LENGTH_TYPE, field_head, wire_fields
from sceneloom.formats.messages.records import (
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
    PackedField,
    PoseRecord,
    SampleRecord,
    TransformRecord,
)
from sceneloom.geometry.rigid import RigidTransform

try:
    import foxglove_schemas_protobuf
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing


def schema_bytes(message_type: type[Any]) -> bytes:
    """Give the `FileDescriptorSet` of a class of messages, those that it refers to first.

    Source: MCAP format registry, schema encoding "protobuf".
    """
    files = dict.fromkeys(_with_imports(message_type.DESCRIPTOR.file))
    described = descriptor_pb2.FileDescriptorSet()
    for file in files:
        file.CopyToProto(described.file.add())
    return serialised(described)


def _with_imports(file: FileDescriptor) -> Iterator[FileDescriptor]:
    for imported in file.dependencies:
        yield from _with_imports(imported)
    yield file


def serialised(message: Message) -> bytes:
    """Give the bytes of a message; equal ones have equal bytes."""
    content: bytes = message.SerializeToString(deterministic=True)
    return content


@cache
def foxglove_type(schema: str) -> type[Any]:
    """Give the class of a Foxglove schema by its full name."""
    name = schema.removeprefix("foxglove.")
    found: type[Any] = getattr(import_module(f"{foxglove_schemas_protobuf.__name__}.{name}_pb2"), name)
    return found


NOTES = "sceneloom"
"""Name of the metadata record that holds what no message has a field for."""

NOTES_KEY = "scene"

SAMPLE_SCHEMA = "sceneloom.Sample"
"""Name of the JSON schema of what an IMU measures, which Foxglove has none for."""

SAMPLE_JSON = MappingProxyType(
    {
        "title": SAMPLE_SCHEMA,
        "description": "One measurement of an inertial unit; streams in m/s², rad/s, µT and K.",
        "type": "object",
        "properties": {
            "timestamp": {
                "type": "object",
                "title": "time",
                "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
            },
            "frame_id": {"type": "string"},
            "values": {
                "type": "object",
                "additionalProperties": {"type": "array", "items": {"type": "number"}},
            },
        },
        "required": ["timestamp", "frame_id", "values"],
    }
)
"""Source: MCAP format registry, schema encoding "jsonschema"."""

_LABEL_KEYS = ("label", "class", "class_name", "category", "type")
"""Metadata of plots that name the class of an object, the likeliest first."""

_ID_KEYS = ("id", "track_id", "instance_id", "object_id")
"""Metadata of plots that name an object, the likeliest first."""

_Parsed = tuple[Any, memoryview]
"""A message without its large field, and that field."""

_DTYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
_TYPES = {name: number for number, name in _DTYPES.items()}
_MATCHING_ID = 0
_LINE_LOOP, _LINE_STRIP, _LINE_LIST = 2, 3, 4


_Parts = list[bytes | memoryview]


_DIAGONAL = 2


_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_FACES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 0.35}
_EDGES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 1.0}


def _time_ns(timestamp: Any) -> int:
    """A time of a message [ns]."""
    return int(timestamp.seconds) * 1_000_000_000 + int(timestamp.nanos)


def _vector(vector: Any) -> Float64Array:
    return np.array([vector.x, vector.y, vector.z])


def _rotation(quaternion: Any) -> Float64Array:
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])


def _time(time_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return {"seconds": seconds, "nanos": nanos}


def _xyz(values: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _xyzw(values: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=True))


def _message(schema: str, data: memoryview | None = None, **fields: Any) -> tuple[str, _Parts]:
    message_type = foxglove_type(schema)
    rest = serialised(message_type(**fields))
    if data is None:
        return schema, [rest]
    number = message_type.DESCRIPTOR.fields_by_name["data"].number
    return schema, [rest, field_head(number, len(data)), data]


def _pairs(reported: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"key": key, "value": value} for key, value in reported.items()]


def _read_transforms(parsed: _Parsed) -> Iterable[TransformRecord]:
    message = parsed[0]
    for transform in getattr(message, "transforms", [message]):
        yield TransformRecord(
            _time_ns(transform.timestamp),
            transform.parent_frame_id,
            transform.child_frame_id,
            _vector(transform.translation),
            _rotation(transform.rotation),
        )


def _write_transform(record: TransformRecord) -> tuple[str, _Parts]:
    return _message(
        "foxglove.FrameTransform",
        timestamp=_time(record.timestamp_ns),
        parent_frame_id=record.parent,
        child_frame_id=record.child,
        translation=_xyz(record.position),
        rotation=_xyzw(record.quaternion_xyzw),
    )


def _read_cloud(parsed: _Parsed) -> Sequence[CloudRecord]:
    message, data = parsed
    fields = tuple(
        PackedField(field.name, field.offset, np.dtype(_DTYPES.get(field.type, "u1")).newbyteorder("<"))
        for field in message.fields
        if field.type in _DTYPES
    )
    pose = message.pose if message.HasField("pose") else None
    return [
        CloudRecord(
            _time_ns(message.timestamp),
            message.frame_id,
            fields,
            message.point_stride,
            data,
            frame_from_points=None if pose is None else _rigid(pose),
        )
    ]


def _write_cloud(record: CloudRecord) -> tuple[str, _Parts]:
    return _message(
        "foxglove.PointCloud",
        record.data,
        timestamp=_time(record.timestamp_ns),
        frame_id=record.frame_id,
        pose={"position": _xyz((0, 0, 0)), "orientation": _xyzw((0, 0, 0, 1))},
        point_stride=record.stride,
        fields=[
            {"name": field.name, "offset": field.offset, "type": _TYPES[field.dtype.str[1:]]} for field in record.fields
        ],
    )


def _rigid(pose: Any) -> RigidTransform | None:
    quaternion = _rotation(pose.orientation)
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.linalg.norm(quaternion)
    if not 0 < length < math.inf:
        return RigidTransform(np.eye(3), _vector(pose.position))
    return RigidTransform.from_quaternion(_vector(pose.position), quaternion)


def _read_image(parsed: _Parsed) -> Sequence[ImageRecord]:
    message, data = parsed
    size = message.encoding, message.width, message.height, message.step
    return [ImageRecord(_time_ns(message.timestamp), message.frame_id, *size, data)]


def _write_image(record: ImageRecord) -> tuple[str, _Parts]:
    return _message(
        "foxglove.RawImage",
        record.data,
        timestamp=_time(record.timestamp_ns),
        frame_id=record.frame_id,
        width=record.width,
        height=record.height,
        encoding=record.encoding,
        step=record.step,
    )


def _read_compressed_image(parsed: _Parsed) -> Sequence[CompressedImageRecord]:
    message, data = parsed
    form = message.format.lower().removeprefix("image/").replace("jpg", "jpeg")
    return [CompressedImageRecord(_time_ns(message.timestamp), message.frame_id, form, data)]


def _write_compressed_image(record: CompressedImageRecord) -> tuple[str, _Parts]:
    schema = "foxglove.CompressedVideo" if record.form in _VIDEOS else "foxglove.CompressedImage"
    head = {"timestamp": _time(record.timestamp_ns), "frame_id": record.frame_id, "format": record.form}
    return _message(schema, record.data, **head)


def _read_camera_model(parsed: _Parsed) -> Sequence[CameraModelRecord]:
    message = parsed[0]
    return [
        CameraModelRecord(
            _time_ns(message.timestamp),
            message.frame_id,
            message.width,
            message.height,
            message.distortion_model,
            tuple(message.D),
            tuple(message.K),
            tuple(message.P),
        )
    ]


def _write_camera_model(record: CameraModelRecord) -> tuple[str, _Parts]:
    return _message(
        "foxglove.CameraCalibration",
        timestamp=_time(record.timestamp_ns),
        frame_id=record.frame_id,
        width=record.width,
        height=record.height,
        distortion_model=record.model,
        D=record.coefficients,
        K=record.k,
        R=np.eye(3).reshape(-1).tolist(),
        P=record.p,
    )


def _read_poses(parsed: _Parsed) -> Iterable[PoseRecord]:
    message = parsed[0]
    for pose in getattr(message, "poses", None) or [message.pose]:
        reported = pose.HasField("orientation")
        yield PoseRecord(
            _time_ns(message.timestamp),
            message.frame_id,
            _vector(pose.position),
            _rotation(pose.orientation) if reported else None,
            getattr(message, "body_frame_id", ""),
        )


def _write_pose(record: PoseRecord) -> tuple[str, _Parts]:
    pose: dict[str, Any] = {"position": _xyz(record.position)}
    if record.quaternion_xyzw is not None:
        pose["orientation"] = _xyzw(record.quaternion_xyzw)
    return _message("foxglove.PoseInFrame", timestamp=_time(record.timestamp_ns), frame_id=record.frame_id, pose=pose)


def _read_fixes(parsed: _Parsed) -> Iterable[FixRecord]:
    message = parsed[0]
    for fix in getattr(message, "fixes", [message]):
        known = fix.position_covariance_type != 0 and len(fix.position_covariance) == 9
        covariance = tuple(fix.position_covariance)
        yield FixRecord(
            _time_ns(fix.timestamp),
            fix.frame_id,
            (fix.latitude, fix.longitude, fix.altitude),
            (covariance[0], covariance[4], covariance[8]) if known else None,
        )


def _write_fix(record: FixRecord) -> tuple[str, _Parts]:
    latitude, longitude, altitude = record.lla
    fields: dict[str, Any] = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
    if record.variances is not None:
        fields["position_covariance"] = np.diag(record.variances).reshape(-1).tolist()
        fields["position_covariance_type"] = _DIAGONAL
    return _message("foxglove.LocationFix", timestamp=_time(record.timestamp_ns), frame_id=record.frame_id, **fields)


def _read_sample(content: Mapping[str, Any]) -> Sequence[SampleRecord]:
    """Read a measurement of ours."""
    timestamp = content["timestamp"]
    values = {name: tuple(map(float, row)) for name, row in content["values"].items()}
    timestamp_ns = int(timestamp["sec"]) * 1_000_000_000 + int(timestamp["nsec"])
    return [SampleRecord(timestamp_ns, str(content["frame_id"]), values)]


def _write_sample(record: SampleRecord) -> tuple[str, _Parts]:
    seconds, nanos = divmod(record.timestamp_ns, 1_000_000_000)
    content = {
        "timestamp": {"sec": seconds, "nsec": nanos},
        "frame_id": record.frame_id,
        "values": record.values,
    }
    return SAMPLE_SCHEMA, [msgspec.json.encode(content)]


def _reported(pairs: Iterable[Any]) -> dict[str, str]:
    return {pair.key: pair.value for pair in pairs}


def _pick(reported: dict[str, str], keys: Iterable[str]) -> str | None:
    """Take out what the first of the keys says."""
    name = next((key for key in keys if key in reported), None)
    return None if name is None else reported.pop(name)


def _read_boxes_3d(parsed: _Parsed) -> Sequence[Boxes3DRecord]:
    message = parsed[0]
    boxes: list[Box3D] = []
    others = 0
    for entity in message.entities:
        drawn = sum(len(getattr(entity, name)) for name in _OTHER_PLOTS)
        others += drawn + (not entity.cubes)
        for k, cube in enumerate(entity.cubes):
            reported = _reported(entity.metadata)
            label = _pick(reported, _LABEL_KEYS)
            boxes.append(
                Box3D(
                    entity.id if len(entity.cubes) == 1 else f"{entity.id}/{k}",
                    entity.frame_id,
                    _vector(cube.pose.position),
                    _rotation(cube.pose.orientation),
                    _vector(cube.size),
                    label if label is not None else next((text.text for text in entity.texts if text.text), None),
                    MappingProxyType(reported),
                )
            )
    timestamps = [*message.entities, *message.deletions]
    gone = tuple(deletion.id for deletion in message.deletions if deletion.type == _MATCHING_ID)
    return [Boxes3DRecord(_time_ns(timestamps[0].timestamp), tuple(boxes), gone, others)] if timestamps else []


def _write_boxes_3d(record: Boxes3DRecord) -> tuple[str, _Parts]:
    time = _time(record.timestamp_ns)
    entities = [
        {
            "timestamp": time,
            "frame_id": box.frame_id,
            "id": box.id,
            "frame_locked": True,
            "metadata": _pairs({**({} if box.label is None else {"label": box.label}), **box.reported}),
            "cubes": [
                {
                    "pose": {"position": _xyz(box.center), "orientation": _xyzw(box.quaternion_xyzw)},
                    "size": _xyz(box.size_lwh),
                    "color": _FACES,
                }
            ],
        }
        for box in record.boxes
    ]
    gone = [{"timestamp": time, "type": _MATCHING_ID, "id": identifier} for identifier in record.gone]
    return _message("foxglove.SceneUpdate", deletions=gone, entities=entities)


_OTHER_PLOTS = ("arrows", "spheres", "cylinders", "lines", "triangles", "models")


def _read_boxes_2d(parsed: _Parsed) -> Iterable[Boxes2DRecord]:
    message = parsed[0]
    by_time: dict[int, list[Box2D]] = {}
    others = len(message.circles)
    for drawing in message.points:
        points = np.array([(point.x, point.y) for point in drawing.points]).reshape(-1, 2)
        box = _upright(points) if drawing.type in {_LINE_LOOP, _LINE_STRIP, _LINE_LIST} else None
        if box is None:
            others += 1
            continue
        reported = _reported(drawing.metadata)
        identifier, label = _pick(reported, _ID_KEYS), _pick(reported, _LABEL_KEYS)
        by_time.setdefault(_time_ns(drawing.timestamp), []).append(
            Box2D(identifier or "", box, label, MappingProxyType(reported))
        )
    if not by_time and others:
        by_time[_time_ns(message.timestamp)] = []
    for number, (timestamp_ns, boxes) in enumerate(by_time.items()):
        yield Boxes2DRecord(timestamp_ns, "", tuple(boxes), 0 if number else others)


def _write_boxes_2d(record: Boxes2DRecord) -> tuple[str, _Parts]:
    time, points = _time(record.timestamp_ns), []
    for box in record.boxes:
        left, top, width, height = box.box_ltwh
        corners = ((left, top), (left + width, top), (left + width, top + height), (left, top + height))
        reported = {"id": box.id, **({} if box.label is None else {"label": box.label}), **box.reported}
        points.append(
            {
                "timestamp": time,
                "type": _LINE_LOOP,
                "points": [{"x": x, "y": y} for x, y in corners],
                "outline_color": _EDGES,
                "thickness": 2.0,
                "metadata": _pairs(reported),
            }
        )
    return _message("foxglove.ImageAnnotations", points=points)


def _upright(points: Float64Array) -> tuple[float, float, float, float] | None:
    """Left, top, width and height of a drawing whose points are the corners of an upright box; None of others."""
    if len(points) < 4 or not np.isfinite(points).all():
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    corners = {(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])}
    if {(float(x), float(y)) for x, y in points} != {(float(x), float(y)) for x, y in corners}:
        return None
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


_Reader = Callable[[_Parsed], Iterable[AnyRecord]]

READERS: Mapping[str, tuple[Kind, _Reader]] = MappingProxyType(
    {
        "foxglove.FrameTransform": (Kind.TRANSFORM, _read_transforms),
        "foxglove.FrameTransforms": (Kind.TRANSFORM, _read_transforms),
        "foxglove.PointCloud": (Kind.CLOUD, _read_cloud),
        "foxglove.RawImage": (Kind.IMAGE, _read_image),
        "foxglove.CompressedImage": (Kind.COMPRESSED_IMAGE, _read_compressed_image),
        "foxglove.CompressedVideo": (Kind.VIDEO, _read_compressed_image),
        "foxglove.CameraCalibration": (Kind.CAMERA_MODEL, _read_camera_model),
        "foxglove.PoseInFrame": (Kind.POSE, _read_poses),
        "foxglove.PosesInFrame": (Kind.POSE, _read_poses),
        "foxglove.Odometry": (Kind.POSE, _read_poses),
        "foxglove.LocationFix": (Kind.FIX, _read_fixes),
        "foxglove.LocationFixes": (Kind.FIX, _read_fixes),
        "foxglove.SceneUpdate": (Kind.BOXES_3D, _read_boxes_3d),
        "foxglove.ImageAnnotations": (Kind.BOXES_2D, _read_boxes_2d),
    }
)
"""The schemas that are read, by name: what they state, and what reads them."""

_DATA = "data"
_NANOSECONDS = 1_000_000_000


def parse_protobuf(schema: str, content: memoryview) -> Sequence[AnyRecord]:
    """Read a message.

    Raises:
        ValueError: the bytes are no such message.
    """
    return list(READERS[schema][1](_split(schema, content)))


def parse_json(schema: str, content: memoryview) -> Sequence[AnyRecord]:
    """Read a message that is JSON; its bytes are in base64, its times in `sec` and `nsec`.

    Raises:
        ValueError: it is no such message.

    Source: docs.foxglove.dev, "JSON" of the schemas.
    """
    try:
        fields = msgspec.json.decode(content, type=dict[str, Any])
        if schema not in READERS:
            return _read_sample(fields)
        data = memoryview(b"")
        if _DATA in fields:
            data = memoryview(base64.b64decode(fields.pop(_DATA)))
        message = foxglove_type(schema)()
        json_format.ParseDict(_as_protobuf_writes(fields), message, ignore_unknown_fields=True)
    except (
        msgspec.DecodeError,
        json_format.ParseError,
        binascii.Error,
        RecursionError,
        KeyError,
        TypeError,
        AttributeError,
    ) as error:
        raise ValueError(f"no {schema} in JSON: {error}") from error
    return list(READERS[schema][1]((message, data)))


def _as_protobuf_writes(value: Any) -> Any:
    """Times as protobuf writes them in JSON."""
    if isinstance(value, list):
        return [_as_protobuf_writes(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    if set(value) in ({"sec", "nsec"}, {"sec", "nanosec"}):
        return _Time.text(int(value["sec"]), int(value.get("nsec", value.get("nanosec", 0))))
    return {name: _as_time(name, item) for name, item in value.items()}


def _as_time(name: str, value: Any) -> Any:
    found = _as_protobuf_writes(value)
    # a duration is written as seconds
    return _Time.duration(value) if name == "lifetime" and isinstance(value, Mapping) else found


class _Time:
    @staticmethod
    def text(seconds: int, nanoseconds: int) -> str:
        from google.protobuf.timestamp_pb2 import Timestamp

        return Timestamp(seconds=seconds, nanos=nanoseconds).ToJsonString()

    @staticmethod
    def duration(value: Mapping[str, Any]) -> str:
        return f"{int(value.get('sec', 0))}.{int(value.get('nsec', 0)):09d}s"


def _split(schema: str, content: memoryview) -> _Parsed:
    """Read a message but for its large field, which is a part of the bytes as they are."""
    message_type = foxglove_type(schema)
    large = message_type.DESCRIPTOR.fields_by_name.get(_DATA)
    message, data = message_type(), memoryview(b"")
    rest: bytes | memoryview = content
    if large is not None:
        fields = wire_fields(content, 0, len(content))
        if fields is None:
            raise ValueError(f"no {schema}: its fields cannot be distinguished")
        kept = []
        for field in fields:
            if field.number == large.number and field.type == LENGTH_TYPE:
                data = content[field.start : field.stop]
            else:
                kept.append(content[field.head : field.stop])
        rest = b"".join(kept)
    try:
        message.ParseFromString(bytes(rest))
    except (DecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"no {schema}: {error}") from error
    return message, data


def head_timestamp(head: bytes) -> int | None:
    """The time of a message of one of the large kinds, from how it begins [ns]; None where it is not stated there.

    In all of them it is the first field.
    """
    location, stop = 0, len(head)
    while location < stop:
        number, kind, start, end = _next_field(head, location)
        if end > stop:
            return None
        if number == 1 and kind == LENGTH_TYPE:
            return _timestamp(head[start:end])
        location = end
    return None


def _next_field(content: bytes, location: int) -> tuple[int, int, int, int]:
    tag, location = _varint(content, location)
    kind = tag & 7
    if kind == LENGTH_TYPE:
        length, start = _varint(content, location)
        return tag >> 3, kind, start, start + length
    if kind == 0:
        return tag >> 3, kind, location, _varint(content, location)[1]
    return tag >> 3, kind, location, location + {1: 8, 5: 4}.get(kind, len(content) + 1)


def _varint(content: bytes, location: int) -> tuple[int, int]:
    number = shift = 0
    while location < len(content) and shift < 70:
        byte = content[location]
        number |= (byte & 0x7F) << shift
        location, shift = location + 1, shift + 7
        if byte < 0x80:
            return number, location
    return 0, len(content) + 1


def _timestamp(content: bytes) -> int | None:
    """A protobuf Timestamp: seconds are field 1, nanoseconds field 2; negative ones fill ten bytes."""
    location, parts = 0, {1: 0, 2: 0}
    while location < len(content):
        number, kind, start, end = _next_field(content, location)
        if kind != 0 or end > len(content):
            return None
        value = _varint(content, start)[0]
        parts[number] = value - (1 << 64) if value >= 1 << 63 else value
        location = end
    return parts[1] * _NANOSECONDS + parts[2]


def encode(record: AnyRecord) -> tuple[str, _Parts]:
    """Give the schema of a record's message, and the message.

    Raises:
        OutputError: there is no schema for such records.
    """
    write = _WRITERS.get(type(record))
    if write is None:
        raise OutputError(f"a {type(record).__name__}; there is no schema for it")
    return write(record)


_WRITERS: Mapping[type[Any], Callable[[Any], tuple[str, _Parts]]] = MappingProxyType(
    {
        TransformRecord: _write_transform,
        CloudRecord: _write_cloud,
        ImageRecord: _write_image,
        CompressedImageRecord: _write_compressed_image,
        CameraModelRecord: _write_camera_model,
        PoseRecord: _write_pose,
        FixRecord: _write_fix,
        SampleRecord: _write_sample,
        Boxes3DRecord: _write_boxes_3d,
        Boxes2DRecord: _write_boxes_2d,
    }
)
