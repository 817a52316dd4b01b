"""Records as protobuf messages: field k of a message is row k of its table, arrays are bytes, little-endian."""

from collections.abc import Mapping
from typing import Any, cast

from sceneloom.errors import DataError, MissingExtraError, how_to_install
from sceneloom.formats.wire_bytes import LENGTH_TYPE, WireField, enclosed, field_head, wire_fields
from sceneloom.fusion.messages.array_bytes import array_within, bytes_view
from sceneloom.fusion.messages.records import (
    RECORD_KINDS,
    Record,
    RecordKind,
    SentRecord,
    kind_of,
)
from sceneloom.fusion.messages.rows import ARRAY_DTYPES, STREAM, Row

try:
    from google.protobuf.message import DecodeError, Message

    from sceneloom.fusion.messages.protobuf_fields import read_field, write_field
    from sceneloom.fusion.messages.protobuf_lists import read_list
    from sceneloom.fusion.messages.wire import fusion_pb2
    from sceneloom.fusion.messages.wire_lists import list_bytes, read_usual_list
except ImportError as missing:
    raise MissingExtraError(f"{missing}; install the extra: {how_to_install('serve')}") from missing

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
    field.number: RECORD_KINDS[field.name]
    for field in fusion_pb2.SendRequest.DESCRIPTOR.oneofs_by_name["data"].fields
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
        write_field(message, row, getattr(record, row.attribute))


def from_protobuf(message: Message) -> Any:
    """Give the record of a message; arrays are read-only views of its bytes.

    Raises:
        DataError: a field is missing, has more or fewer values, or is out of range.
        OptionError: it is no message of a record.
    """
    kind = _KIND_OF_MESSAGE.get(message.DESCRIPTOR.name)
    if kind is None or not isinstance(message, getattr(fusion_pb2, kind.message_name)):
        kind = kind_of(type(message))
    values = {row.attribute: read_field(message, row, kind.table.owner) for row in kind.table.rows}
    if kind.layout is not None:
        values |= read_list(getattr(message, kind.layout.group), kind.layout, values)
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
            write_field(message, row, value)
            continue
        view = memoryview(value) if isinstance(value, bytes) else bytes_view(value)
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
        write_field(before if row.number < group else after, row, getattr(record, row.attribute))
    return [
        before.SerializeToString(deterministic=True),
        list_bytes(record, kind),
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
        raise DataError(
            "request", "data", f"{len(content)} bytes; expected one record of one of tables 4 to 8"
        )
    if found is None:
        return from_send_request(parse_message(fusion_pb2.SendRequest, content))
    kind, message, arrays = found
    values = {
        row.attribute: arrays[row.number]
        if row.number in arrays
        else read_field(message, row, kind.table.owner)
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
        else array_within(
            content,
            (field.start, field.stop),
            ARRAY_DTYPES[large[number].type],
            kind.table.owner,
            large[number].name,
        )
        for number, field in found.items()
    }
    return kind, message, arrays
