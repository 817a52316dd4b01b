"""Records, properties, poses and configurations as protobuf messages.

Field k of a record's message is row k of its table, arrays are little-endian bytes. Lists of boxes are read from and
written to the bytes directly where nothing is unusual. A faulty message or record is a DataError, what is no record an
OptionError.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, read_only
from sceneloom.db34t.records import RECORD_KINDS, Column, ListLayout, Record, RecordKind, SentRecord, kind_of
from sceneloom.db34t.setting import Property, Snapshot
from sceneloom.db34t.tables import ARRAY_DTYPES, STREAM, TIME, Row
from sceneloom.db34t.types import NANOSECONDS, Timestamp, ValueForm, ValueType, array_of, bytes_of, shown
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.base.wire_formats import LENGTH_TYPE, WireField, enclosed, field_head, wire_fields
from sceneloom.kernels import packed
from sceneloom.scene.poses import Poses

try:
    from google.protobuf.descriptor import FieldDescriptor
    from google.protobuf.message import DecodeError, Message

    from sceneloom.db34t.wire import fusion_pb2
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('serve')}") from missing

LARGEST_PLAIN = 1 << 24
"""Of a message, what is not the bytes of pixels, points and depths [byte]: parsed, it takes many times the memory.

100,000 boxes or poses have some 10 MB.
"""

MOST_PARTS = 100_100
"""Of one message: 100,000 boxes or poses, and what stands beside them. A part of two bytes takes hundreds in memory."""

_FEW_PARTS = 1 << 16  # messages of fewer bytes are not looked through for how many parts they have

_KIND_OF_MESSAGE: Mapping[str, RecordKind] = {kind.message_name: kind for kind in RECORD_KINDS.values()}

_SENT_KINDS: Mapping[int, RecordKind] = {
    field.number: RECORD_KINDS[field.name] for field in fusion_pb2.SendRequest.DESCRIPTOR.oneofs_by_name["data"].fields
}  # the kinds of records by their field of a request


def to_protobuf(record: Record) -> Message:
    """The message of a record."""
    message: Message = getattr(fusion_pb2, kind_of(record).message_name)()
    fill_message(message, record)
    return message


def fill_message(message: Message, record: Record) -> None:
    """Write a record into an empty message of its kind, such as a field of a request: large arrays are copied once."""
    kind = kind_of(record)
    message.SetInParent()
    if kind.layout is not None:
        message.MergeFromString(encode(record))
        return
    for row in kind.table.rows:
        _write_field(message, row, getattr(record, row.attribute))


def from_protobuf(message: Message) -> Any:
    """The record of a message; arrays are read-only views of its bytes."""
    kind = _KIND_OF_MESSAGE.get(message.DESCRIPTOR.name)
    if kind is None or not isinstance(message, getattr(fusion_pb2, kind.message_name)):
        kind = kind_of(type(message))
    values = {row.attribute: _read_field(message, row, kind.table.owner) for row in kind.table.rows}
    if kind.layout is not None:
        values |= _read_list(list(getattr(message, kind.layout.group)), kind.layout, values)
    return kind.record_type(**values)


def encode(record: Record) -> bytes:
    """The bytes of a record's message; equal records have equal bytes, and arrays are copied once."""
    return b"".join(_encoded_parts(record))


def _encoded_parts(record: Record) -> list[bytes | memoryview]:
    """The bytes of a record's message in parts: those of large arrays are the arrays themselves."""
    kind = kind_of(record)
    message_type = getattr(fusion_pb2, kind.message_name)
    parts: list[bytes | memoryview] = []
    message = message_type()
    if kind.layout is not None:
        group, after = message_type.DESCRIPTOR.fields_by_name[kind.layout.group].number, message_type()
        for row in kind.table.rows:
            _write_field(message if row.number < group else after, row, getattr(record, row.attribute))
        parts += [message.SerializeToString(deterministic=True), _list_bytes(record, kind)]
        return [*parts, after.SerializeToString(deterministic=True)]
    for row in kind.table.rows:
        value = getattr(record, row.attribute)
        if not _is_array(row):
            _write_field(message, row, value)
            continue
        view = memoryview(value) if isinstance(value, bytes) else _bytes_view(value)
        if len(view):
            parts += [message.SerializeToString(deterministic=True), field_head(row.number, len(view)), view]
            message = message_type()
    return [*parts, message.SerializeToString(deterministic=True)]


def encode_in(container: Message, record: Record, *, more: bytes = b"") -> bytes:
    """The bytes of a request or reply with a record in the field of its kind, then its other fields, then `more`."""
    field = container.DESCRIPTOR.fields_by_name[kind_of(record).name]
    rest = container.SerializeToString(deterministic=True)
    return b"".join([*enclosed(field.number, _encoded_parts(record)), rest, more])


def decode(name: str, content: bytes) -> Any:
    """Read a record of the kind `name`, out of `RECORD_KINDS`, from the bytes of its message."""
    kind = RECORD_KINDS[name]
    message_type = getattr(fusion_pb2, kind.message_name)
    large = kind.layout is None and kind.arrays
    return from_protobuf((_parsed if large else parse_message)(message_type, content))


def parse_message(message_type: type[Any], content: bytes) -> Any:
    """Read a message of the `.proto` from bytes; a DataError also for very many bytes of one without arrays."""
    _check_parts(message_type.DESCRIPTOR.name, content, 0, len(content))
    return _parsed(message_type, content)


def to_send_request(record: SentRecord, *, session: str = "") -> fusion_pb2.SendRequest:
    """The message of clause 5.6 that carries a record."""
    request = fusion_pb2.SendRequest(session=session)
    fill_message(getattr(request, kind_of(record).name), record)
    return request


def from_send_request(request: fusion_pb2.SendRequest) -> SentRecord:
    """The record that a message of clause 5.6 carries."""
    name = request.WhichOneof("data")
    if name is None:
        raise DataError("request", "data", "missing; expected a record of one of tables 4 to 8")
    return cast("SentRecord", from_protobuf(getattr(request, name)))


def decode_send_request(content: bytes) -> SentRecord:
    """Read the record out of the bytes of a message of clause 5.6; pixels and points are views of these bytes."""
    field = _only_record(content)
    if field is not None:
        kind = _SENT_KINDS[field.number]
        if kind.layout is not None:
            _check_parts(kind.message_name, content, field.start, field.stop)
            record = read_usual_list(content, field.start, field.stop, kind)
        else:
            record = _large_record(content, field, kind)
        if record is not None:
            return cast("SentRecord", record)
    elif len(content) > _FEW_PARTS:
        raise DataError("request", "data", f"{len(content)} bytes; expected one record of one of tables 4 to 8")
    return from_send_request(parse_message(fusion_pb2.SendRequest, content))


def _only_record(content: bytes) -> WireField | None:
    """Where the only record of a request stands; None where there are several or none, or something is unusual."""
    outer = wire_fields(content, 0, len(content))
    records = [field for field in outer or () if field.number in _SENT_KINDS]
    if outer is None or len(records) != 1 or records[0].type != LENGTH_TYPE:
        return None
    if len(outer) > 1:
        # what stands beside the record is read, too, so that what the library refuses is refused here
        parse_message(fusion_pb2.SendRequest, content[: records[0].head] + content[records[0].stop :])
    return records[0]


def _large_record(content: bytes, field: WireField, kind: RecordKind) -> Any | None:
    """A record with arrays, of which only what stands beside them is parsed; None where something is unusual."""
    large = {row.number: row for row in kind.table.rows if _is_array(row)}
    inner = wire_fields(content, field.start, field.stop) if large else None
    if inner is None:
        return None
    found = {each.number: each for each in inner if each.number in large}
    if sum(each.number in large for each in inner) != len(found):
        return None
    if any(each.type != LENGTH_TYPE for each in found.values()):
        return None
    rest = b"".join(content[each.head : each.stop] for each in inner if each.number not in found)
    message = parse_message(getattr(fusion_pb2, kind.message_name), rest)
    values = {
        row.attribute: _array_within(content, found[row.number], row, kind.table.owner)
        if row.number in found
        else _read_field(message, row, kind.table.owner)
        for row in kind.table.rows
    }
    return kind.record_type(**values)


def _array_within(content: bytes, field: WireField, row: Row, owner: str) -> Any:
    """The flat array in a part of bytes: a read-only view of it, a copy where numbers are not aligned; or the bytes."""
    if row.type == STREAM:
        return content[field.start : field.stop]
    dtype, length = ARRAY_DTYPES[row.type], field.stop - field.start
    if length and length % dtype.itemsize == 0:
        flat = np.frombuffer(content, dtype.newbyteorder("<"), length // dtype.itemsize, field.start)
        if flat.flags.aligned:
            return flat.astype(dtype, copy=False)
    return array_of(content[field.start : field.stop], dtype, owner, row.name)


def _bytes_view(array: AnyArray) -> memoryview:
    """The bytes of an array in C order, without a copy where it has this order and is little-endian."""
    plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return plain.reshape(-1).view(np.uint8).data


def _is_array(row: Row) -> bool:
    return row.type in ARRAY_DTYPES or row.type == STREAM


def _check_parts(name: str, content: bytes, start: int, stop: int) -> None:
    """Refuse a message without arrays that is very large or has very many parts, before it is taken apart."""
    size = stop - start
    if size > LARGEST_PLAIN:
        problem = f"{size} bytes; expected a message {name} of at most {LARGEST_PLAIN} beside its arrays"
        raise DataError("protobuf", "", problem)
    if size > _FEW_PARTS and wire_fields(content, start, stop, most=MOST_PARTS) is None:
        problem = f"{size} bytes; expected a message {name} of at most {MOST_PARTS} parts"
        raise DataError("protobuf", "", problem)


def _parsed(message_type: type[Any], content: bytes) -> Any:
    try:
        return message_type.FromString(content)
    except DecodeError as error:
        problem = f"{len(content)} bytes; expected a message {message_type.DESCRIPTOR.name}"
        raise DataError("protobuf", "", problem) from error


def _write_field(message: Any, row: Row, value: Any) -> None:
    """Write the value of one row; None is left out."""
    if value is None:
        return
    if row.type == TIME:
        timestamp = getattr(message, row.name)
        timestamp.s, timestamp.ns = value.s, value.ns
        timestamp.SetInParent()
    elif row.type in ARRAY_DTYPES:
        setattr(message, row.name, bytes_of(value))
    elif isinstance(value, tuple):
        getattr(message, row.name).extend(value)
    else:
        setattr(message, row.name, value)


def _read_field(message: Any, row: Row, owner: str) -> Any:
    """Read the value of one row; None for an optional one that was left out."""
    if row.type == TIME:
        return _timestamp(getattr(message, row.name), owner, row.name) if message.HasField(row.name) else None
    value = getattr(message, row.name)
    if row.type in ARRAY_DTYPES:
        return array_of(value, ARRAY_DTYPES[row.type], owner, row.name)
    if row.value_type is not None and row.value_type.form is ValueForm.ARRAY and not isinstance(value, bytes):
        return tuple(value) if row.required or value else None
    if row.required:
        return value
    if message.DESCRIPTOR.fields_by_name[row.name].has_presence:
        return value if message.HasField(row.name) else None
    return value or None


def _timestamp(message: fusion_pb2.Timestamp, owner: str, location: str) -> Timestamp:
    try:
        return Timestamp(message.s, message.ns)
    except DataError as error:
        raise DataError(owner, f"{location}.{error.location}", error.problem) from error


def _read_list(messages: list[Any], layout: ListLayout, common: Mapping[str, Any]) -> dict[str, Any]:
    """The columns, classes and ids of the records of a repeated field; `common` is what the list states of all."""
    _check_shared(messages, layout, common)
    values: dict[str, Any] = {"class_names": tuple(map(attrgetter("class"), messages))}
    for column in layout.columns:
        rows: list[Any] = list(map(attrgetter(*column.names), messages))
        if column.shape and len(column.names) == 1:
            rows = list(map(tuple, rows))
            if column.optional and not any(rows):
                continue
            size = math.prod(column.shape)
            wrong = next((k for k, row in enumerate(rows) if len(row) != size), None)
            if wrong is not None:
                row = layout.table.row(column.names[0])
                problem = f"{shown(rows[wrong])}; expected {row.type}"
                raise layout.table.fault(f"{layout.group}[{wrong}].{row.name}", problem)
        values[column.attribute] = np.array(rows, column.dtype).reshape(len(rows), *column.shape)
    for name, attribute in layout.ids.items():
        values[attribute] = tuple(getattr(message, name) if message.HasField(name) else None for message in messages)
    return values


def _check_shared(messages: list[Any], layout: ListLayout, common: Mapping[str, Any]) -> None:
    """Check that each record of a list states of itself what the list states of all."""
    timestamp = common["timestamp"]
    if timestamp is None:
        return
    seqs = [(name, common[shared]) for name, shared in layout.shared.items() if name != "timestamp"]
    expected = (timestamp.s, timestamp.ns, *(seq for _, seq in seqs))
    reported = attrgetter("timestamp.s", "timestamp.ns", *(name for name, _ in seqs))
    if not set(map(reported, messages)) - {expected}:
        return
    k, found = next((k, found) for k, found in enumerate(map(reported, messages)) if found != expected)
    wrong = found[:2] != expected[:2]
    name = "timestamp" if wrong else seqs[0][0]
    value = f"{found[0]}.{found[1]:09d}" if wrong else found[2]
    problem = f"{value}; expected {timestamp if wrong else expected[2]} as all of them"
    raise layout.table.fault(f"{layout.group}[{k}].{name}", problem)


_FORMS: Mapping[tuple[int, bool], int] = {
    (FieldDescriptor.TYPE_FLOAT, False): packed.FLOAT,
    (FieldDescriptor.TYPE_FLOAT, True): packed.FLOATS,
    (FieldDescriptor.TYPE_UINT32, False): packed.UNSIGNED,
    (FieldDescriptor.TYPE_SINT32, False): packed.SIGNED,
    (FieldDescriptor.TYPE_STRING, False): packed.TEXT,
    (FieldDescriptor.TYPE_MESSAGE, False): packed.TIME,
}


@dataclass(frozen=True, slots=True)
class _Plan:
    """How the words of a list of records lie."""

    heads: tuple[int, int, int, int]  # fields of the list: sensor, seq, timestamp, records
    fields: Int64Array  # (KNOWN, 4) of `packed.read_list`
    written: Int64Array  # (K, 5) of `packed.write_list`, in the order of the field numbers
    width: int  # words of a record
    columns: tuple[tuple[Column, int, int, int | None], ...]  # its first word, words, number of its vector


@cache
def _plan_of(kind_name: str) -> _Plan:
    kind = RECORD_KINDS[kind_name]
    layout: Any = kind.layout
    descriptor = getattr(fusion_pb2, kind.message_name).DESCRIPTOR
    numbers = {field.name: field.number for field in descriptor.fields}
    message = descriptor.fields_by_name[layout.group].message_type
    fields = np.zeros((packed.KNOWN, 4), np.int64)
    for field in message.fields:
        is_seq = layout.shared.get(field.name) == "seq"
        fields[field.number, 0] = packed.SEQ if is_seq else _FORMS[field.type, field.is_repeated]
    columns, first = [], 0
    for column in layout.columns:
        size = math.prod(column.shape)
        for k, name in enumerate(column.names):
            fields[message.fields_by_name[name].number, 1:] = first, size, k
        is_vector = len(column.names) == 1 and bool(column.shape)
        columns.append((column, first, size, message.fields_by_name[column.names[0]].number if is_vector else None))
        first += size
    written = {number: (number, *fields[number].tolist()) for number in np.flatnonzero(fields[:, 0]).tolist()}
    for k, name in enumerate(layout.ids):
        number = message.fields_by_name[name].number
        written[number] = (number, packed.OPTIONAL, first + k, 1, k)
    heads = tuple(numbers.get(name, 0) for name in ("sensor_id", "seq", "timestamp", layout.group))
    rows = read_only([written[number] for number in sorted(written)], np.int64)
    return _Plan(heads, read_only(fields), rows, first, tuple(columns))


def read_usual_list(content: bytes, start: int, stop: int, kind: RecordKind) -> Any | None:
    """Read a list of boxes from its message within bytes; None where something is unusual, for the library to read.

    Raises:
        DataError: a value is out of range.
    """
    layout = kind.layout
    if layout is None or layout.ids:
        return None
    plan = _plan_of(kind.name)
    buffer = np.frombuffer(content, np.uint8)
    head, words, texts, counts = packed.read_list(buffer, start, stop, plan.heads, plan.fields, plan.width)
    sensor_id, seq, s, ns, count = head
    if count < 0 or ns >= NANOSECONDS:
        return None
    try:
        names = tuple([content[begin:end].decode() for begin, end in texts.tolist()])
    except UnicodeDecodeError:
        return None
    values: dict[str, Any] = {"sensor_id": sensor_id, "seq": seq, "timestamp": Timestamp(s, ns), "class_names": names}
    for column, first, size, vector in plan.columns:
        if vector is not None and counts[vector] != count:
            if not column.optional or counts[vector]:
                return None
            continue
        column_words = words[first * count : (first + size) * count].view(column.dtype)
        values[column.attribute] = column_words.reshape(count, *column.shape) if column.shape else column_words
    return kind.record_type(**values)


def _list_bytes(record: Any, kind: RecordKind) -> bytes:
    """The records of a list as the bytes of the repeated field that they are in a message."""
    layout: Any = kind.layout
    plan, count = _plan_of(kind.name), len(record)
    columns: list[Any] = []
    absent: list[Any] = []
    for column, _, size, vector in plan.columns:
        values = getattr(record, column.attribute)
        if values is None:
            absent.append(vector)
            values = np.zeros(size * count, np.uint32)
        columns.append(values.reshape(-1).view(np.uint32))
    ids = [getattr(record, attribute) for attribute in layout.ids.values()]
    given = np.array([[number is not None for number in numbers] for numbers in ids], np.bool_)
    columns += [np.array([number or 0 for number in numbers], np.int32).view(np.uint32) for numbers in ids]
    locations: dict[str, tuple[int, int]] = {}
    letters = bytearray()
    for name in dict.fromkeys(record.class_names):
        first = len(letters)
        letters += name.encode()
        locations[name] = (first, len(letters))
    written: Any = packed.write_list(
        plan.heads[3],
        count,
        _written_without(kind.name, tuple(absent)),
        np.concatenate(columns),
        np.array([locations[name] for name in record.class_names], np.int64).reshape(count, 2),
        np.frombuffer(bytes(letters), np.uint8),
        given.reshape(len(ids), count),
        (getattr(record, "seq", 0), record.timestamp.s, record.timestamp.ns),
    )
    return bytes(written)


@cache
def _written_without(kind_name: str, absent: tuple[int, ...]) -> Int64Array:
    """The fields of a record as `packed.write_list` takes them, without some that no record of a list has."""
    rows = _plan_of(kind_name).written
    return read_only(rows[~np.isin(rows[:, 0], absent)])


def value_to_protobuf(value: Any) -> fusion_pb2.Value:
    """The message of a value of table 1, or of a list of such."""
    message = fusion_pb2.Value()
    if isinstance(value, bool | np.bool_):
        message.bool_value = bool(value)
    elif isinstance(value, int | np.integer) and -(2**63) <= value < 2**63:
        message.integer_value = int(value)
    elif isinstance(value, float | np.floating):
        message.number_value = float(value)
    elif isinstance(value, str):
        message.string_value = value
    elif isinstance(value, list | tuple | np.ndarray):
        message.list_value.SetInParent()
        message.list_value.values.extend(value_to_protobuf(item) for item in value)
    else:
        raise DataError("value", "", f"{shown(value)}; expected a value of table 1 or a list of such")
    return message


def value_from_protobuf(message: fusion_pb2.Value) -> Any:
    """The value of a message."""
    kind = message.WhichOneof("kind")
    if kind is None:
        raise DataError("value", "", "missing; expected a value of table 1 or a list of such")
    if kind == "list_value":
        return [value_from_protobuf(item) for item in message.list_value.values]
    return getattr(message, kind)


def property_to_protobuf(found: Property) -> fusion_pb2.Property:
    """The message of a property; without a value where it was added and not set yet."""
    return fusion_pb2.Property(
        name=found.name,
        description=found.description,
        type=str(found.type),
        unit=found.unit,
        value=None if found.value is None else value_to_protobuf(found.value),
        predefined=found.predefined,
    )


def property_of(message: fusion_pb2.Property) -> Property:
    """The property of a message."""
    kind = ValueType.parse(message.type)
    value = None
    if message.HasField("value"):
        value = kind.check(value_from_protobuf(message.value), owner=message.name)
    return Property(message.name, message.description, kind, value, message.unit, message.predefined)


def properties_message(snapshot: Snapshot) -> fusion_pb2.Properties:
    """The message of a configuration."""
    properties = map(property_to_protobuf, snapshot.properties.values())
    return fusion_pb2.Properties(properties=properties, revision=snapshot.revision)


def snapshot_of(message: fusion_pb2.Properties, algorithms: tuple[str, str] | None = None) -> Snapshot:
    """The configuration of a message.

    `algorithms` are those of both fusion types; None for what the message states: that of its fusion_type, "" for the
    other one.
    """
    properties = {found.name: found for found in map(property_of, message.properties)}
    if algorithms is None:
        stated, kind = properties.get("fusion_algorithm"), properties.get("fusion_type")
        name = "" if stated is None else str(stated.value)
        algorithms = ("", name) if kind is not None and kind.value == 1 else (name, "")
    return Snapshot(message.revision, MappingProxyType(properties), algorithms)


def motion_request(path: Poses, *, session: str = "") -> fusion_pb2.SendMotionRequest:
    """The message of a trajectory."""
    if path.static:
        raise DataError("motion", "poses", "a location without times; expected poses with times")
    numbers = path.timestamps_ns.tolist(), path.positions.tolist(), path.quaternions_xyzw.tolist()
    request = fusion_pb2.SendMotionRequest(session=session)
    for timestamp_ns, position, quaternion in zip(*numbers, strict=True):
        time = Timestamp.of(timestamp_ns)
        request.poses.add(
            timestamp=fusion_pb2.Timestamp(s=time.s, ns=time.ns), position=position, quaternion_xyzw=quaternion
        )
    return request


def path_of(request: fusion_pb2.SendMotionRequest) -> Poses:
    """The trajectory of a message.

    Raises:
        DataError: a pose has more or fewer numbers.
        ArrayError: the poses are no trajectory.
    """
    times = []
    for k, pose in enumerate(request.poses):
        found = len(pose.position), len(pose.quaternion_xyzw)
        if found != (3, 4):
            problem = f"{found[0]} and {found[1]} numbers; expected a position of 3 and a quaternion of 4"
            raise DataError("motion", f"poses[{k}]", problem)
        times.append(_timestamp(pose.timestamp, "motion", f"poses[{k}].timestamp").nanoseconds)
    return Poses(
        np.array(times, np.int64),
        np.array([list(pose.position) for pose in request.poses], np.float64).reshape(-1, 3),
        np.array([list(pose.quaternion_xyzw) for pose in request.poses], np.float64).reshape(-1, 4),
    )
