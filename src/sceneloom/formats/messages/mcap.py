"""MCAP files with Foxglove's schemas: messages as records and back, a file as a log of topics, as a scene, and written.

Messages are protobuf, JSON or FlatBuffers; their large fields are not copied.
"""

import base64
import binascii
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from urllib.parse import quote

import msgspec
import numpy as np
from google.protobuf import descriptor_pb2, json_format
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.message import DecodeError, Message
from google.protobuf.timestamp_pb2 import Timestamp

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, MissingExtraError, OutputError, how_to_install
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.wire_formats import LENGTH_TYPE, FlatSchema, field_head, flat_schema, wire_fields
from sceneloom.formats.messages.file_bytes import Entries, FileBytes
from sceneloom.formats.messages.foxglove import LINE_LOOP, MATCHING_ID, POINT_TYPES, READERS
from sceneloom.formats.messages.mcap_files import McapIndex, McapWriter, read_index
from sceneloom.formats.messages.reader import scene_from_topics
from sceneloom.formats.messages.records import (
    AnyRecord,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    Dialect,
    FixRecord,
    ImageRecord,
    Kind,
    PoseRecord,
    SampleRecord,
    Topic,
    TransformRecord,
)
from sceneloom.formats.messages.writer import SceneStreams, check_images
from sceneloom.formats.rig_files.reader import Rig
from sceneloom.scene.scene import Scene, with_assumed_models
from sceneloom.version import __version__

try:
    import foxglove_schemas_protobuf
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing

_NOTES = "sceneloom"  # name of the metadata record that holds what no message has a field for
_NOTES_KEY = "scene"
_SAMPLE_SCHEMA = "sceneloom.Sample"  # name of the JSON schema of what an IMU measures, which Foxglove has none for

_SAMPLE_JSON = MappingProxyType({
    "title": _SAMPLE_SCHEMA,
    "description": "One measurement of an inertial unit; streams in m/s², rad/s, µT and K.",
    "type": "object",
    "properties": {
        "timestamp": {
            "type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
        },
        "frame_id": {"type": "string"},
        "values": {"type": "object", "additionalProperties": {"type": "array", "items": {"type": "number"}}},
    },
    "required": ["timestamp", "frame_id", "values"],
})  # fmt: skip
"""Source: MCAP format registry, schema encoding "jsonschema"."""

_TYPES = {name: number for number, name in POINT_TYPES.items()}
_DATA = "data"
_DIAGONAL = 2
_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_FACES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 0.35}
_EDGES = {"r": 0.1, "g": 0.6, "b": 1.0, "a": 1.0}
_SECOND_NS = 1_000_000_000

_Parts = list[bytes | memoryview]


def _topic_part(identifier: str | int) -> str:
    """An id as one part of a topic's name; `_id_of_part` is its inverse for texts."""
    return quote(str(identifier), safe="") or "%"


_DIALECT = Dialect(
    name="MCAP",
    world="world",
    ego="ego",
    part=_topic_part,
    fisheye="kannala_brandt",
    camera_model_topic="calibration",
    sample_topics=MappingProxyType({"": "imu"}),
    videos=True,
    covariances=False,
)


class _FoxgloveWriter:
    """Writes records to an MCAP file; schemas and channels are added when they are first needed."""

    def __init__(self, writer: McapWriter, shift_ns: int) -> None:
        """Begin; `shift_ns` is added to times to give log times, which cannot be negative."""
        self._writer, self._shift_ns = writer, shift_ns
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def add(self, time_ns: int, topic: str, record: AnyRecord) -> None:
        """Write a record as a message."""
        write = _WRITERS.get(type(record))
        if write is None:
            raise OutputError(f"a {type(record).__name__}; there is no schema for it")
        schema, parts = write(record)
        self._writer.add_message(self._channel(topic, schema), time_ns + self._shift_ns, parts)

    def _channel(self, topic: str, schema: str) -> int:
        known = self._channels.get((topic, schema))
        if known is not None:
            return known
        is_json = schema == _SAMPLE_SCHEMA
        if schema not in self._schemas:
            data = msgspec.json.encode(dict(_SAMPLE_JSON)) if is_json else schema_bytes(_foxglove_type(schema))
            encoding = "jsonschema" if is_json else "protobuf"
            self._schemas[schema] = self._writer.add_schema(schema, encoding, data)
        channel = self._writer.add_channel(topic, "json" if is_json else "protobuf", self._schemas[schema])
        self._channels[topic, schema] = channel
        return channel


def write_mcap(
    scene: Scene, path: Path, *, overwrite: bool = False, compression: str = "none", images: str = "copy"
) -> LossReport:
    """Write a scene; one message is in memory at a time.

    Args:
        compression: of chunks: "none", "lz4" or "zstd".
        images: "copy" hands on videos packet by packet and JPEG files as they are, and encodes the rest as JPEG;
            "jpeg", "png" and "raw" write all images in one form.

    Raises:
        OptionError: there is no such compression, or way of writing images.
    """
    check_images(images)
    with replacing(path, overwrite=overwrite) as draft, draft.open("wb") as stream:
        writer = McapWriter(stream, library=f"sceneloom {__version__}", compression=compression, large_apart=True)
        plan = SceneStreams(scene, _DIALECT, images=images)
        records = _FoxgloveWriter(writer, max(0, -plan.start_ns))
        for time_ns, topic, record in plan.records():
            records.add(time_ns, topic, record)
        writer.add_metadata(_NOTES, {_NOTES_KEY: json.dumps(plan.notes)})
        writer.finish()
        return LossReport.of(plan.losses.all)


_HEAD_BYTES = 512
_LOOKED_AT = 8  # messages of a topic in compressed chunks whose own times are compared with those of the index
_FLAT = "flatbuffer"
_ENCODINGS = ("protobuf", "json", _FLAT)  # encodings of messages that are read


def open_mcap(
    path: Path | str,
    *,
    lenient: bool = False,
    assume_model: bool = False,
    timestamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
    rig: Rig | None = None,
) -> Scene:
    """Open a file: its index and all small messages are read, images and points when they are asked for.

    Args:
        path: of the file; or its URL.
        lenient: read what is whole of a file that was not finished, is cut off or damaged; leave out topics and
            messages that are at fault; go by receive times where timestamps are of another clock.
        assume_model: allow computing with camera models whose formulas nothing confirms.
        timestamps: which time of a message counts: "header", what it says itself, or "receive", when it was recorded;
            None: what it says itself.
        ego, world: names of the frames that are to be the ego and the world; None: chosen from the transforms.
        rig: mountings and camera models that the file does not state.

    Raises:
        DataError: the file is damaged, or a message is wrong.
        OptionError: a frame is not there, or `timestamps` is none of the two.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        log = open_log(path, ledger)
        reported = {"profile": log.index.profile, "library": log.index.library}
        scene = scene_from_topics(
            log, ledger, form="mcap", metadata=reported, timestamps=timestamps, ego=ego, world=world, rig=rig
        )
    return with_assumed_models(scene) if assume_model else scene


@dataclass(frozen=True, slots=True, eq=False)
class _McapLog:
    """The topics of a file, and where their messages are, by the number of the topic."""

    index: McapIndex
    topics: tuple[Topic, ...]
    entries: Mapping[int, Entries]

    @property
    def name(self) -> str:
        """The file's path."""
        return str(self.index.file.path)

    @property
    def notes(self) -> str | None:
        """What our writer left."""
        return next((values.get(_NOTES_KEY) for name, values in self.index.metadata if name == _NOTES), None)

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        return self.entries[topic.number].log_times_ns

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """Times that messages state; in compressed chunks, the index's where some messages all state the same."""
        entries = self.entries[topic.number]
        if len(entries) > _LOOKED_AT and self.index.messages.compressed(entries).any():
            rows = np.unique(np.linspace(0, len(entries) - 1, _LOOKED_AT).astype(np.int64))
            if np.array_equal(self._timestamps_of(topic, rows), entries.log_times_ns[rows]):
                return entries.log_times_ns, False
        return self._timestamps_of(topic, np.arange(len(entries))), True

    def _timestamps_of(self, topic: Topic, rows: Int64Array) -> Int64Array:
        messages, entries, found = self.index.messages, self.entries[topic.number], []
        head_timestamp = self._head_timestamp(topic)
        heads = None if head_timestamp is None else messages.heads(entries, rows, _HEAD_BYTES)
        for row in rows.tolist():
            stated = None if heads is None or head_timestamp is None else head_timestamp(next(heads))
            found.append(self.read(topic, row)[0].timestamp_ns if stated is None else stated)
        return np.array(found, np.int64)

    def _head_timestamp(self, topic: Topic) -> Callable[[bytes], int | None] | None:
        """What finds the timestamp at the head of a large message; None of encodings that are read whole."""
        match self._encoding(topic):
            case "protobuf":
                return _head_timestamp
            case "flatbuffer":
                return partial(_flat_timestamp, self._flat_schema(topic))
        return None

    def _encoding(self, topic: Topic) -> str:
        return self.index.channels[topic.number].message_encoding

    def _flat_schema(self, topic: Topic) -> FlatSchema:
        schema = self.index.schemas[self.index.channels[topic.number].schema_id]
        try:
            return flat_schema(schema.data)
        except (ValueError, RecursionError) as error:
            raise DataError(self.name, f"schema {schema.name!r}", f"no schema of FlatBuffers: {error}") from error

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says."""
        content = self.index.messages.data(self.entries[topic.number], k)
        try:
            if self._encoding(topic) == _FLAT:
                return _parse_flatbuffer(self._flat_schema(topic), topic.schema, content)
            parse = _parse_protobuf if self._encoding(topic) == "protobuf" else _parse_json
            return parse(topic.schema, content)
        except (ValueError, OverflowError) as error:
            raise DataError(self.name, f"{topic.name}[{k}]", str(error)) from error

    def close(self) -> None:
        """Release the file."""
        self.index.file.close()


def open_log(path: Path | str, ledger: Ledger) -> _McapLog:
    """Open a file as a log of topics by its index.

    Raises:
        DataError: the file is damaged.
    """
    file = FileBytes(path)
    try:
        index = read_index(file, ledger)
        entries = {number: index.messages.entries(number) for number in index.channels}
        topics = tuple(_topic(index, number, len(entries[number])) for number in index.channels)
    except BaseException:
        file.close()
        raise
    return _McapLog(index, topics, MappingProxyType(entries))


def _topic(index: McapIndex, number: int, count: int) -> Topic:
    channel = index.channels[number]
    schema = index.schemas.get(channel.schema_id)
    name = "" if schema is None else schema.name
    kind = Kind.SAMPLE if name == _SAMPLE_SCHEMA and channel.message_encoding == "json" else None
    kind = _READERS[name][0] if name in _READERS else kind
    if kind is not None and channel.message_encoding not in _ENCODINGS:
        why = f"in the encoding {channel.message_encoding!r}; expected one of {', '.join(_ENCODINGS)}"
        return Topic(number, channel.topic, name, None, count, why)
    if schema is None:
        return Topic(number, channel.topic, f"{channel.message_encoding or 'bytes'} without a schema", None, count)
    return Topic(number, channel.topic, name, kind, count)


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
def _foxglove_type(schema: str) -> type[Any]:
    """Give the class of a Foxglove schema by its full name."""
    name = schema.removeprefix("foxglove.")
    try:
        found: type[Any] = getattr(import_module(f"{foxglove_schemas_protobuf.__name__}.{name}_pb2"), name)
    except ImportError as missing:
        problem = f"{missing}; install the extra, with a newer foxglove-schemas-protobuf: {how_to_install('mcap')}"
        raise MissingExtraError(problem) from missing
    return found


def _parse_protobuf(schema: str, content: memoryview) -> Sequence[AnyRecord]:
    """Read a message; its large field is a part of the bytes as they are."""
    message_type = _foxglove_type(schema)
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
    return list(_READERS[schema][1](message, data))


def _parse_json(schema: str, content: memoryview) -> Sequence[AnyRecord]:
    """Read JSON: bytes in base64, times in `sec` and `nsec`. Source: docs.foxglove.dev, "JSON" of the schemas."""
    try:
        fields = msgspec.json.decode(content, type=dict[str, Any])
        if schema not in _READERS:
            return [_read_sample(fields)]
        data = memoryview(base64.b64decode(fields.pop(_DATA, "")))
        message = _foxglove_type(schema)()
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
    return list(_READERS[schema][1](message, data))


def _parse_flatbuffer(flat: FlatSchema, schema: str, content: memoryview) -> Sequence[AnyRecord]:
    """Read a FlatBuffer by the schema of its channel."""
    message = flat.message(content)
    data = memoryview(message.data) if message.HasField(_DATA) else memoryview(b"")
    try:
        return list(_READERS[schema][1](message, data))
    except (AttributeError, TypeError) as error:
        raise ValueError(f"no {schema}: its schema states other fields: {error}") from error


def _flat_timestamp(flat: FlatSchema, head: bytes) -> int | None:
    """Timestamp [ns] at the head of a large FlatBuffer; None where it is farther on."""
    try:
        message = flat.message(memoryview(head))
        timestamp = message.timestamp
        return int(timestamp.sec) * _SECOND_NS + int(timestamp.nsec)
    except (ValueError, AttributeError):
        return None


def _as_protobuf_writes(value: Any, name: str = "") -> Any:
    """Times and durations as protobuf writes them in JSON."""
    if isinstance(value, list):
        return [_as_protobuf_writes(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    if name == "lifetime":
        return f"{int(value.get('sec', 0))}.{int(value.get('nsec', 0)):09d}s"
    if set(value) in ({"sec", "nsec"}, {"sec", "nanosec"}):
        nanos = int(value.get("nsec", value.get("nanosec", 0)))
        return Timestamp(seconds=int(value["sec"]), nanos=nanos).ToJsonString()
    return {key: _as_protobuf_writes(item, key) for key, item in value.items()}


def _head_timestamp(head: bytes) -> int | None:
    """Timestamp [ns] at the head of a large message: field 1, which writers put first; None where another one is."""
    length = head[1] if len(head) > 1 and head[0] == 1 << 3 | LENGTH_TYPE else len(head)
    if length > len(head) - 2:
        return None
    try:
        return _time_ns(Timestamp.FromString(head[2 : 2 + length]))
    except DecodeError:
        return None


def _message(schema: str, data: memoryview | None = None, **fields: Any) -> tuple[str, _Parts]:
    message_type = _foxglove_type(schema)
    rest = serialised(message_type(**fields))
    if data is None:
        return schema, [rest]
    number = message_type.DESCRIPTOR.fields_by_name[_DATA].number
    return schema, [rest, field_head(number, len(data)), data]


def _time_ns(timestamp: Any) -> int:
    return int(timestamp.seconds) * _SECOND_NS + int(timestamp.nanos)


def _time(time_ns: int) -> dict[str, int]:
    seconds, nanos = divmod(time_ns, _SECOND_NS)
    return {"seconds": seconds, "nanos": nanos}


def _xyz(values: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def _xyzw(values: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, values), strict=True))


class _Field(NamedTuple):
    """A field of a message and of its record, and how its values are written."""

    message: str
    record: str
    write: Callable[[Any], Any] = lambda value: value


_HEAD = (_Field("timestamp", "timestamp_ns", _time), _Field("frame_id", "frame_id"))
_SIZE = (_Field("width", "width"), _Field("height", "height"))

_FIELDS: Mapping[type[Any], tuple[_Field, ...]] = {
    TransformRecord: (
        _HEAD[0], _Field("parent_frame_id", "parent"), _Field("child_frame_id", "child"),
        _Field("translation", "position", _xyz), _Field("rotation", "quaternion_xyzw", _xyzw),
    ),
    ImageRecord: (*_HEAD, *_SIZE, _Field("encoding", "encoding"), _Field("step", "step")),
    CompressedImageRecord: (*_HEAD, _Field("format", "form")),
    CameraModelRecord: (
        *_HEAD, *_SIZE, _Field("distortion_model", "model"), _Field("D", "coefficients"), _Field("K", "k"),
        _Field("P", "p"),
    ),
}  # fmt: skip
"""Records whose messages have the same fields, but for large ones."""


def _write_fields(record: Any, schema: str, **further: Any) -> tuple[str, _Parts]:
    fields = {field.message: field.write(getattr(record, field.record)) for field in _FIELDS[type(record)]}
    return _message(schema, getattr(record, _DATA, None), **fields, **further)


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


def _write_pose(record: PoseRecord) -> tuple[str, _Parts]:
    pose: dict[str, Any] = {"position": _xyz(record.position)}
    if record.quaternion_xyzw is not None:
        pose["orientation"] = _xyzw(record.quaternion_xyzw)
    return _message("foxglove.PoseInFrame", timestamp=_time(record.timestamp_ns), frame_id=record.frame_id, pose=pose)


def _write_fix(record: FixRecord) -> tuple[str, _Parts]:
    fields: dict[str, Any] = dict(zip(("latitude", "longitude", "altitude"), record.lla, strict=True))
    if record.variances is not None:
        fields["position_covariance"] = np.diag(record.variances).reshape(-1).tolist()
        fields["position_covariance_type"] = _DIAGONAL
    return _message("foxglove.LocationFix", timestamp=_time(record.timestamp_ns), frame_id=record.frame_id, **fields)


def _read_sample(content: Mapping[str, Any]) -> SampleRecord:
    """Read a measurement of ours."""
    timestamp = content["timestamp"]
    values = {name: tuple(map(float, row)) for name, row in content["values"].items()}
    timestamp_ns = int(timestamp["sec"]) * _SECOND_NS + int(timestamp["nsec"])
    return SampleRecord(timestamp_ns, str(content["frame_id"]), values)


def _write_sample(record: SampleRecord) -> tuple[str, _Parts]:
    seconds, nanos = divmod(record.timestamp_ns, _SECOND_NS)
    timestamp = {"sec": seconds, "nsec": nanos}
    content = {"timestamp": timestamp, "frame_id": record.frame_id, "values": record.values}
    return _SAMPLE_SCHEMA, [msgspec.json.encode(content)]


def _metadata(reported: Mapping[str, str], **named: str | None) -> list[dict[str, str]]:
    known = {key: value for key, value in named.items() if value is not None}
    return [{"key": key, "value": value} for key, value in {**known, **reported}.items()]


def _write_boxes_3d(record: Boxes3DRecord) -> tuple[str, _Parts]:
    time = _time(record.timestamp_ns)
    entities = []
    for box in record.boxes:
        pose = {"position": _xyz(box.center), "orientation": _xyzw(box.quaternion_xyzw)}
        entities.append(
            {
                "timestamp": time,
                "frame_id": box.frame_id,
                "id": box.id,
                "frame_locked": True,
                "metadata": _metadata(box.reported, label=box.label),
                "cubes": [{"pose": pose, "size": _xyz(box.size_lwh), "color": _FACES}],
            }
        )
    gone = [{"timestamp": time, "type": MATCHING_ID, "id": identifier} for identifier in record.gone]
    return _message("foxglove.SceneUpdate", deletions=gone, entities=entities)


def _write_boxes_2d(record: Boxes2DRecord) -> tuple[str, _Parts]:
    time, points = _time(record.timestamp_ns), []
    for box in record.boxes:
        left, top, width, height = box.box_ltwh
        corners = ((left, top), (left + width, top), (left + width, top + height), (left, top + height))
        points.append(
            {
                "timestamp": time,
                "type": LINE_LOOP,
                "points": [{"x": x, "y": y} for x, y in corners],
                "outline_color": _EDGES,
                "thickness": 2.0,
                "metadata": _metadata(box.reported, id=box.id, label=box.label),
            }
        )
    return _message("foxglove.ImageAnnotations", points=points)


_READERS = {f"foxglove.{name}": reader for name, reader in READERS.items()}

_WRITERS: Mapping[type[Any], Callable[[Any], tuple[str, _Parts]]] = MappingProxyType(
    {
        TransformRecord: partial(_write_fields, schema="foxglove.FrameTransform"),
        CloudRecord: _write_cloud,
        ImageRecord: partial(_write_fields, schema="foxglove.RawImage"),
        CompressedImageRecord: lambda record: _write_fields(
            record, f"foxglove.Compressed{'Video' if record.form in _VIDEOS else 'Image'}"
        ),
        CameraModelRecord: partial(
            _write_fields, schema="foxglove.CameraCalibration", R=np.eye(3).reshape(-1).tolist()
        ),
        PoseRecord: _write_pose,
        FixRecord: _write_fix,
        SampleRecord: _write_sample,
        Boxes3DRecord: _write_boxes_3d,
        Boxes2DRecord: _write_boxes_2d,
    }
)
