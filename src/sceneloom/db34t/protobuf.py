"""Records, properties, poses and configurations as protobuf messages.

Field k of a record's message is row k of its table, arrays are little-endian bytes. Lists of boxes are read from and
written to the bytes directly where nothing is unusual.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array, UInt32Array, read_only
from sceneloom.db34t.properties import Property, Snapshot
from sceneloom.db34t.records import RECORD_KINDS, Column, ListLayout, Record, RecordKind, SentRecord, kind_of
from sceneloom.db34t.tables import ARRAY_DTYPES, STREAM, TIME, Row
from sceneloom.db34t.types import NANOSECONDS, Timestamp, ValueForm, ValueType, array_of, bytes_of, shown
from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.base.protobuf import LENGTH_TYPE, WireField, enclosed, field_head, wire_fields
from sceneloom.kernels import packed
from sceneloom.scene.poses import Poses

try:
    from google.protobuf.message import DecodeError, Message

    from sceneloom.db34t.wire import fusion_pb2
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('serve')}") from missing


def timestamp_to_protobuf(timestamp: Timestamp) -> fusion_pb2.Timestamp:
    """Give the message of a timestamp."""
    return fusion_pb2.Timestamp(s=timestamp.s, ns=timestamp.ns)


def timestamp_from_protobuf(message: fusion_pb2.Timestamp, owner: str, location: str) -> Timestamp:
    """Give the timestamp of a message.

    Raises:
        DataError: its nanoseconds make a second or more.
    """
    try:
        return Timestamp(message.s, message.ns)
    except DataError as error:
        raise DataError(owner, f"{location}.{error.location}", error.problem) from error


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
    """Read the value of one row."""
    if row.type == TIME:
        if not message.HasField(row.name):
            return None
        return timestamp_from_protobuf(getattr(message, row.name), owner, row.name)
    value = getattr(message, row.name)
    if row.type in ARRAY_DTYPES:
        return array_of(value, ARRAY_DTYPES[row.type], owner, row.name)
    if row.value_type is not None and row.value_type.form is ValueForm.ARRAY and not isinstance(value, bytes):
        return tuple(value) if row.required or value else None
    if row.required:
        return value
    return _if_stated(message, row, value)


def _if_stated(message: Any, row: Row, value: Any) -> Any:
    """An optional field's value, None where it was left out."""
    if message.DESCRIPTOR.fields_by_name[row.name].has_presence:
        return value if message.HasField(row.name) else None
    return value or None


def _read_list(repeated: Any, layout: ListLayout, common: Mapping[str, Any]) -> dict[str, Any]:
    """Read the records of a repeated field.

    Args:
        common: what the list says of all of its records.

    Returns:
        By attribute, what a list of records is made of.

    Raises:
        DataError: a record says something else than the list, or a vector has another length.
    """
    messages = list(repeated)
    _check_shared(messages, layout, common)
    values: dict[str, Any] = {"class_names": tuple(map(attrgetter("class"), messages))}
    for column in layout.columns:
        name = column.names[0]
        if len(column.names) > 1:
            rows = list(map(attrgetter(*column.names), messages))
        elif column.shape:
            rows = [tuple(row) for row in map(attrgetter(name), messages)]
            if column.optional and not any(rows):
                continue
            _check_lengths(rows, math.prod(column.shape), layout, name)
        else:
            rows = list(map(attrgetter(name), messages))
        values[column.attribute] = np.array(rows, column.dtype).reshape(len(rows), *column.shape)
    for name, attribute in layout.ids.items():
        values[attribute] = tuple(getattr(message, name) if message.HasField(name) else None for message in messages)
    return values


def _check_shared(messages: Sequence[Any], layout: ListLayout, common: Mapping[str, Any]) -> None:
    """Check that each record of a list says of itself what the list says of all."""
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


def _check_lengths(rows: Sequence[tuple[Any, ...]], length: int, layout: ListLayout, name: str) -> None:
    k = next((k for k, row in enumerate(rows) if len(row) != length), None)
    if k is not None:
        kind = layout.table.row(name).type
        raise layout.table.fault(f"{layout.group}[{k}].{name}", f"{shown(rows[k])}; expected {kind}")


_FORMS: Mapping[tuple[str, bool], int] = {
    ("float", False): packed.FLOAT,
    ("float", True): packed.FLOATS,
    ("uint32", False): packed.UNSIGNED,
    ("sint32", False): packed.SIGNED,
    ("string", False): packed.TEXT,
    ("message", False): packed.TIME,
}


@dataclass(frozen=True, slots=True)
class _Plan:
    """How the words of a list of records lie.

    Attributes:
        heads: numbers of the fields of the list: sensor, seq, timestamp, and its records.
        fields: (KNOWN, 4) int64 of `packed.read_list`.
        written: (K, 5) int64 of `packed.write_list`, in the order of the field numbers.
        width: words of a record.
        columns: each with where it begins among the words of a record, how many it has, and the number of the field
            without which it is not there: that of a vector, else None.
    """

    heads: tuple[int, int, int, int]
    fields: Int64Array
    written: Int64Array
    width: int
    columns: tuple[tuple[Column, int, int, int | None], ...]


@cache
def _plan_of(kind_name: str) -> _Plan:
    kind = RECORD_KINDS[kind_name]
    layout: Any = kind.layout
    descriptor = getattr(fusion_pb2, kind.message_name).DESCRIPTOR
    numbers = {field.name: field.number for field in descriptor.fields}
    message = descriptor.fields_by_name[layout.group].message_type
    fields = np.zeros((packed.KNOWN, 4), np.int64)
    for field in message.fields:
        fields[field.number, 0] = _form(field, layout)
    columns, first = [], 0
    for column in layout.columns:
        size = math.prod(column.shape)
        for k, name in enumerate(column.names):
            fields[message.fields_by_name[name].number, 1:] = first, size, k
        is_vector = len(column.names) == 1 and bool(column.shape)
        vector = message.fields_by_name[column.names[0]].number if is_vector else None
        columns.append((column, first, size, vector))
        first += size
    written = {number: (number, *fields[number].tolist()) for number in np.flatnonzero(fields[:, 0]).tolist()}
    for k, name in enumerate(layout.ids):
        number = message.fields_by_name[name].number
        written[number] = (number, packed.OPTIONAL, first + k, 1, k)
    heads = tuple(numbers.get(name, 0) for name in ("sensor_id", "seq", "timestamp", layout.group))
    rows = read_only([written[number] for number in sorted(written)], np.int64)
    return _Plan(heads, read_only(fields), rows, first, tuple(columns))


def _form(field: Any, layout: ListLayout) -> int:
    """What a field of a record holds."""
    if layout.shared.get(field.name) == "seq":
        return packed.SEQ
    kinds = {field.TYPE_FLOAT: "float", field.TYPE_UINT32: "uint32", field.TYPE_SINT32: "sint32"}
    kinds |= {field.TYPE_STRING: "string", field.TYPE_MESSAGE: "message"}
    return _FORMS[kinds[field.type], field.is_repeated]


def read_usual_list(content: bytes, start: int, stop: int, kind: RecordKind) -> Any | None:
    """Read a list of boxes.

    Args:
        content: bytes in which its message stands.
        start, stop: where it begins and ends.
        kind: of the list.

    Returns:
        The record; None where there is something unusual that others had better look at.

    Raises:
        DataError: a value is out of range.
    """
    layout = kind.layout
    if layout is None or layout.ids:
        return None
    plan = _plan_of(kind.name)
    head, words, texts, counts = packed.read_list(
        np.frombuffer(content, np.uint8), start, stop, plan.heads, plan.fields, plan.width
    )
    sensor_id, seq, s, ns, count = head
    if count < 0 or ns >= NANOSECONDS:
        return None
    try:
        names = tuple([content[begin:end].decode() for begin, end in texts.tolist()])
    except UnicodeDecodeError:
        return None
    values: dict[str, Any] = {"sensor_id": sensor_id, "seq": seq, "timestamp": Timestamp(s, ns)}
    values["class_names"] = names
    for column, first, size, vector in plan.columns:
        if vector is not None and counts[vector] != count:
            if not column.optional or counts[vector]:
                return None
            continue
        values[column.attribute] = _column(words, column, first * count, size * count, count)
    return kind.record_type(**values)


def _column(words: UInt32Array, column: Column, first: int, length: int, count: int) -> Any:
    values = words[first : first + length].view(column.dtype)
    return values.reshape(count, *column.shape) if column.shape else values


def _list_bytes(record: Any, kind: RecordKind) -> bytes:
    """Give the records of a list as the bytes of the repeated field that they are in a message."""
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
    texts, letters = _texts(record.class_names)
    common = (getattr(record, "seq", 0), record.timestamp.s, record.timestamp.ns)
    written: Any = packed.write_list(
        plan.heads[3],
        count,
        _written_without(kind.name, tuple(absent)),
        np.concatenate(columns),
        texts,
        letters,
        given.reshape(len(ids), count),
        common,
    )
    return bytes(written)


@cache
def _written_without(kind_name: str, absent: tuple[int, ...]) -> Int64Array:
    """The fields of a record as `packed.write_list` takes them, without some that no record of a list has."""
    rows = _plan_of(kind_name).written
    return read_only(rows[~np.isin(rows[:, 0], absent)])


def _texts(names: tuple[str, ...]) -> tuple[Int64Array, UInt8Array]:
    """Where the letters of each name begin and end, (N, 2), and the letters of all."""
    locations: dict[str, tuple[int, int]] = {}
    letters = bytearray()
    for name in dict.fromkeys(names):
        first = len(letters)
        letters += name.encode()
        locations[name] = (first, len(letters))
    return (
        np.array([locations[name] for name in names], np.int64).reshape(len(names), 2),
        np.frombuffer(bytes(letters), np.uint8),
    )


_KIND_OF_MESSAGE: Mapping[str, RecordKind] = {kind.message_name: kind for kind in RECORD_KINDS.values()}

LARGEST_PLAIN = 1 << 24
"""Of a message, what is not the bytes of pixels, points and depths [byte]: parsed, it takes many times the memory.

100,000 boxes or poses have some 10 MB.
"""

MOST_PARTS = 100_100
"""Of one message: 100,000 boxes or poses, and what stands beside them. A part of two bytes takes hundreds in memory."""

_FEW_PARTS = 1 << 16
"""Messages of fewer bytes are not looked through for how many parts they have."""

_SENT_KINDS: Mapping[int, RecordKind] = {
    field.number: RECORD_KINDS[field.name] for field in fusion_pb2.SendRequest.DESCRIPTOR.oneofs_by_name["data"].fields
}
"""The kinds of records by their field of a request."""


def to_protobuf(record: Record) -> Message:
    """Give the message of a record.

    Raises:
        OptionError: it is no record.
    """
    message: Message = getattr(fusion_pb2, kind_of(record).message_name)()
    fill_message(message, record)
    return message


def fill_message(message: Message, record: Record) -> None:
    """Write a record into an empty message of its kind, such as a field of a request: large arrays are copied once.

    Raises:
        OptionError: it is no record.
    """
    kind = kind_of(record)
    message.SetInParent()
    if kind.layout is not None:
        message.MergeFromString(encode(record))
        return
    for row in kind.table.rows:
        _write_field(message, row, getattr(record, row.attribute))


def from_protobuf(message: Message) -> Any:
    """Give the record of a message; arrays are read-only views of its bytes.

    Raises:
        DataError: a field is missing, has more or fewer values, or is out of range.
        OptionError: it is no message of a record.
    """
    kind = _KIND_OF_MESSAGE.get(message.DESCRIPTOR.name)
    if kind is None or not isinstance(message, getattr(fusion_pb2, kind.message_name)):
        kind = kind_of(type(message))
    values = {row.attribute: _read_field(message, row, kind.table.owner) for row in kind.table.rows}
    if kind.layout is not None:
        values |= _read_list(getattr(message, kind.layout.group), kind.layout, values)
    return kind.record_type(**values)


def encode(record: Record) -> bytes:
    """Give the bytes of a record's message; equal records have equal bytes, and arrays are copied once."""
    return b"".join(encoded_parts(record))


def encoded_parts(record: Record) -> list[bytes | memoryview]:
    """Give the bytes of a record's message in parts: those of large arrays are the arrays themselves."""
    kind = kind_of(record)
    message_type = getattr(fusion_pb2, kind.message_name)
    if kind.layout is not None:
        return _list_parts(record, kind, message_type)
    parts: list[bytes | memoryview] = []
    message = message_type()
    for row in kind.table.rows:
        value = getattr(record, row.attribute)
        if not _is_array(row):
            _write_field(message, row, value)
            continue
        view = memoryview(value) if isinstance(value, bytes) else _bytes_view(value)
        if len(view):
            parts += [message.SerializeToString(deterministic=True), field_head(row.number, len(view)), view]
            message = message_type()
    parts.append(message.SerializeToString(deterministic=True))
    return parts


def _list_parts(record: Any, kind: RecordKind, message_type: Any) -> list[bytes | memoryview]:
    """The bytes of a list of records: what stands before them, the records, and what stands behind."""
    layout: Any = kind.layout
    group = message_type.DESCRIPTOR.fields_by_name[layout.group].number
    before, after = message_type(), message_type()
    for row in kind.table.rows:
        _write_field(before if row.number < group else after, row, getattr(record, row.attribute))
    return [
        before.SerializeToString(deterministic=True),
        _list_bytes(record, kind),
        after.SerializeToString(deterministic=True),
    ]


def encode_in(container: Message, record: Record) -> bytes:
    """Give the bytes of a request or reply with a record in the field of its kind.

    Args:
        container: the message without it, whose other fields come after it.
        record: to be put into it.

    Raises:
        OptionError: it is no record.
    """
    field = container.DESCRIPTOR.fields_by_name[kind_of(record).name]
    rest = container.SerializeToString(deterministic=True)
    return b"".join([*enclosed(field.number, encoded_parts(record)), rest])


def decode(name: str, content: bytes) -> Any:
    """Read a record from the bytes of its message.

    Args:
        name: the kind of record, out of `RECORD_KINDS`.

    Raises:
        DataError: the bytes are no such message, or the record is faulty.
    """
    kind = RECORD_KINDS[name]
    message_type = getattr(fusion_pb2, kind.message_name)
    large = kind.layout is None and any(_is_array(row) for row in kind.table.rows)
    return from_protobuf((_parsed if large else parse_message)(message_type, content))


def parse_message(message_type: type[Any], content: bytes) -> Any:
    """Read a message of the `.proto` from bytes.

    Raises:
        DataError: they are no such message, or very many for one without arrays.
    """
    _check_parts(message_type.DESCRIPTOR.name, content, 0, len(content))
    return _parsed(message_type, content)


def _check_parts(name: str, content: bytes, start: int, stop: int) -> None:
    """Refuse a message without arrays that is very large or has very many parts, before it is taken apart.

    Raises:
        DataError: it is.
    """
    size = stop - start
    if size > LARGEST_PLAIN:
        problem = f"{size} bytes; expected a message {name} of at most {LARGEST_PLAIN} beside its arrays"
        raise DataError("protobuf", "", problem)
    if size > _FEW_PARTS and wire_fields(content, start, stop, most=MOST_PARTS) is None:
        problem = f"{size} bytes; expected a message {name} of at most {MOST_PARTS} parts"
        raise DataError("protobuf", "", problem)


def _is_array(row: Row) -> bool:
    return row.type in ARRAY_DTYPES or row.type == STREAM


def _parsed(message_type: type[Any], content: bytes) -> Any:
    try:
        return message_type.FromString(content)
    except DecodeError as error:
        problem = f"{len(content)} bytes; expected a message {message_type.DESCRIPTOR.name}"
        raise DataError("protobuf", "", problem) from error


def to_send_request(record: SentRecord, *, session: str = "") -> fusion_pb2.SendRequest:
    """Give the message of clause 5.6 that carries a record."""
    request = fusion_pb2.SendRequest(session=session)
    fill_message(getattr(request, kind_of(record).name), record)
    return request


def from_send_request(request: fusion_pb2.SendRequest) -> SentRecord:
    """Give the record that a message of clause 5.6 carries.

    Raises:
        DataError: it carries none, or the record is faulty.
    """
    name = request.WhichOneof("data")
    if name is None:
        raise DataError("request", "data", "missing; expected a record of one of tables 4 to 8")
    return cast("SentRecord", from_protobuf(getattr(request, name)))


def decode_send_request(content: bytes) -> SentRecord:
    """Read the record out of the bytes of a message of clause 5.6; pixels and points are views of these bytes.

    Raises:
        DataError: they are no such message, carry no record, or the record is faulty.
    """
    field = _only_record(content)
    if field is not None and _SENT_KINDS[field.number].layout is not None:
        _check_parts(_SENT_KINDS[field.number].message_name, content, field.start, field.stop)
        record = read_usual_list(content, field.start, field.stop, _SENT_KINDS[field.number])
        if record is not None:
            return cast("SentRecord", record)
    found = None if field is None else _large_record(content, field)
    if field is None and len(content) > _FEW_PARTS:
        raise DataError("request", "data", f"{len(content)} bytes; expected one record of one of tables 4 to 8")
    if found is None:
        return from_send_request(parse_message(fusion_pb2.SendRequest, content))
    kind, message, arrays = found
    values = {
        row.attribute: arrays[row.number] if row.number in arrays else _read_field(message, row, kind.table.owner)
        for row in kind.table.rows
    }
    return cast("SentRecord", kind.record_type(**values))


def _only_record(content: bytes) -> WireField | None:
    """Where the only record of a request stands; None where there are several or none, or something is unusual.

    Raises:
        DataError: what stands beside the record is no such request.
    """
    outer = wire_fields(content, 0, len(content))
    records = [field for field in outer or () if field.number in _SENT_KINDS]
    if outer is None or len(records) != 1 or records[0].type != LENGTH_TYPE:
        return None
    if len(outer) > 1:
        # what stands beside the record is read, too, so that what the library refuses is refused here
        parse_message(fusion_pb2.SendRequest, content[: records[0].head] + content[records[0].stop :])
    return records[0]


def _large_record(content: bytes, field: WireField) -> tuple[RecordKind, Any, dict[int, Any]] | None:
    """The kind of the only record of a request, its message without arrays, and the arrays by their row numbers.

    None where the library had better read it: it has no arrays, or something is unusual about it.
    """
    kind = _SENT_KINDS[field.number]
    large = {row.number: row for row in kind.table.rows if _is_array(row)}
    if kind.layout is not None or not large:
        return None
    inner = wire_fields(content, field.start, field.stop)
    if inner is None:
        return None
    found = {field.number: field for field in inner if field.number in large}
    if sum(field.number in large for field in inner) != len(found):
        return None
    if any(field.type != LENGTH_TYPE for field in found.values()):
        return None
    rest = b"".join(content[field.head : field.stop] for field in inner if field.number not in found)
    message = parse_message(getattr(fusion_pb2, kind.message_name), rest)
    arrays = {
        number: content[field.start : field.stop]
        if large[number].type == STREAM
        else _array_within(
            content,
            (field.start, field.stop),
            ARRAY_DTYPES[large[number].type],
            kind.table.owner,
            large[number].name,
        )
        for number, field in found.items()
    }
    return kind, message, arrays


_INT64 = range(-(2**63), 2**63)


def value_to_protobuf(value: Any) -> fusion_pb2.Value:
    """Give the message of a value.

    Raises:
        DataError: it is none of table 1, nor a list of such.
    """
    message = fusion_pb2.Value()
    if isinstance(value, bool | np.bool_):
        message.bool_value = bool(value)
    elif isinstance(value, int | np.integer) and int(value) in _INT64:
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
    """Give the value of a message.

    Raises:
        DataError: it holds none.
    """
    kind = message.WhichOneof("kind")
    if kind is None:
        raise DataError("value", "", "missing; expected a value of table 1 or a list of such")
    if kind == "list_value":
        return [value_from_protobuf(item) for item in message.list_value.values]
    return getattr(message, kind)


def property_to_protobuf(found: Property) -> fusion_pb2.Property:
    """Give the message of a property; without a value where it was added and not set yet."""
    return fusion_pb2.Property(
        name=found.name,
        description=found.description,
        type=str(found.type),
        unit=found.unit,
        value=None if found.value is None else value_to_protobuf(found.value),
        predefined=found.predefined,
    )


def motion_request(path: Poses, *, session: str = "") -> fusion_pb2.SendMotionRequest:
    """Give the message of a trajectory.

    Raises:
        DataError: it has no times, or one that a timestamp cannot state.
    """
    if path.static:
        raise DataError("motion", "poses", "a location without times; expected poses with times")
    poses = [
        fusion_pb2.Pose(
            timestamp=timestamp_to_protobuf(Timestamp.of(timestamp_ns)),
            position=position,
            quaternion_xyzw=quaternion,
        )
        for timestamp_ns, position, quaternion in zip(
            path.timestamps_ns.tolist(), path.positions.tolist(), path.quaternions_xyzw.tolist(), strict=True
        )
    ]
    return fusion_pb2.SendMotionRequest(poses=poses, session=session)


def path_of(request: fusion_pb2.SendMotionRequest) -> Poses:
    """Give the trajectory of a message.

    Raises:
        DataError: a pose has more or fewer numbers.
        ArrayError: the poses are no path.
    """
    poses = request.poses
    for k, pose in enumerate(poses):
        found = len(pose.position), len(pose.quaternion_xyzw)
        if found != (3, 4):
            problem = f"{found[0]} and {found[1]} numbers; expected a position of 3 and a quaternion of 4"
            raise DataError("motion", f"poses[{k}]", problem)
    times = [
        timestamp_from_protobuf(pose.timestamp, "motion", f"poses[{k}].timestamp").nanoseconds
        for k, pose in enumerate(poses)
    ]
    return Poses(
        np.array(times, np.int64),
        np.array([list(pose.position) for pose in poses], np.float64).reshape(-1, 3),
        np.array([list(pose.quaternion_xyzw) for pose in poses], np.float64).reshape(-1, 4),
    )


def properties_message(snapshot: Snapshot) -> fusion_pb2.Properties:
    """Give the message of a configuration."""
    return fusion_pb2.Properties(
        properties=map(property_to_protobuf, snapshot.properties.values()), revision=snapshot.revision
    )


def property_of(message: fusion_pb2.Property) -> Property:
    """Give the property of a message.

    Raises:
        DataError: its type is none, or its value is not of it.
    """
    kind = ValueType.parse(message.type)
    value = None
    if message.HasField("value"):
        value = kind.check(value_from_protobuf(message.value), owner=message.name)
    return Property(message.name, message.description, kind, value, message.unit, message.predefined)


def snapshot_of(message: fusion_pb2.Properties, algorithms: tuple[str, str] | None = None) -> Snapshot:
    """Give the configuration of a message.

    Args:
        algorithms: of both types; None for what the message says: that of its fusion_type, "" for the other one.

    Raises:
        DataError: a property is faulty.
    """
    properties = {found.name: found for found in map(property_of, message.properties)}
    if algorithms is None:
        algorithms = _shown_algorithms(properties)
    return Snapshot(message.revision, MappingProxyType(properties), algorithms)


def _shown_algorithms(properties: dict[str, Property]) -> tuple[str, str]:
    shown, kind = properties.get("fusion_algorithm"), properties.get("fusion_type")
    name = "" if shown is None else str(shown.value)
    detections = kind is not None and kind.value == 1
    return ("", name) if detections else (name, "")


def _array_within(content: bytes, span: tuple[int, int], dtype: np.dtype[Any], owner: str, location: str) -> AnyArray:
    """Give the flat array that a part of bytes holds: a read-only view of it, a copy where numbers are not aligned.

    Args:
        span: where the part begins and ends.
        owner: what it belongs to, for the message.
        location: the field, for the message.

    Raises:
        DataError: it is no whole number of values.
    """
    start, stop = span
    length = stop - start
    if length % dtype.itemsize or not length:
        return array_of(content[start:stop], dtype, owner, location)
    flat = np.frombuffer(content, dtype.newbyteorder("<"), length // dtype.itemsize, start)
    if not flat.flags.aligned:
        return array_of(content[start:stop], dtype, owner, location)
    return flat.astype(dtype, copy=False)


def _bytes_view(array: AnyArray) -> memoryview:
    """Give the bytes of an array in C order, without a copy where it has this order and is little-endian."""
    plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return plain.reshape(-1).view(np.uint8).data
