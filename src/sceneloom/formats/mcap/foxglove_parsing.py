"""Messages of Foxglove's schemas from their bytes: protobuf or JSON; large fields are not copied."""

import base64
import binascii
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
from google.protobuf import json_format
from google.protobuf.message import DecodeError

from sceneloom.formats.mcap.foxglove_reading import READERS, Parsed, read_sample
from sceneloom.formats.mcap.schemas import foxglove_type
from sceneloom.formats.topics.records import AnyRecord
from sceneloom.formats.wire_bytes import LENGTH_TYPE, wire_fields

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
            return read_sample(fields)
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


def _split(schema: str, content: memoryview) -> Parsed:
    """Read a message but for its large field, which is a part of the bytes as they are."""
    message_type = foxglove_type(schema)
    large = message_type.DESCRIPTOR.fields_by_name.get(_DATA)
    message, data = message_type(), memoryview(b"")
    rest: bytes | memoryview = content
    if large is not None:
        fields = wire_fields(content, 0, len(content))
        if fields is None:
            raise ValueError(f"no {schema}: its fields cannot be told apart")
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


def head_stamp(head: bytes) -> int | None:
    """The time of a message of one of the large kinds, from how it begins [ns]; None where it is not said there.

    In all of them it is the first field.
    """
    place, stop = 0, len(head)
    while place < stop:
        number, kind, start, end = _next_field(head, place)
        if end > stop:
            return None
        if number == 1 and kind == LENGTH_TYPE:
            return _stamp(head[start:end])
        place = end
    return None


def _next_field(content: bytes, place: int) -> tuple[int, int, int, int]:
    tag, place = _varint(content, place)
    kind = tag & 7
    if kind == LENGTH_TYPE:
        length, start = _varint(content, place)
        return tag >> 3, kind, start, start + length
    if kind == 0:
        return tag >> 3, kind, place, _varint(content, place)[1]
    return tag >> 3, kind, place, place + {1: 8, 5: 4}.get(kind, len(content) + 1)


def _varint(content: bytes, place: int) -> tuple[int, int]:
    number = shift = 0
    while place < len(content) and shift < 70:
        byte = content[place]
        number |= (byte & 0x7F) << shift
        place, shift = place + 1, shift + 7
        if byte < 0x80:
            return number, place
    return 0, len(content) + 1


def _stamp(content: bytes) -> int | None:
    """A protobuf Timestamp: seconds are field 1, nanoseconds field 2; negative ones fill ten bytes."""
    place, parts = 0, {1: 0, 2: 0}
    while place < len(content):
        number, kind, start, end = _next_field(content, place)
        if kind != 0 or end > len(content):
            return None
        value = _varint(content, start)[0]
        parts[number] = value - (1 << 64) if value >= 1 << 63 else value
        place = end
    return parts[1] * _NANOSECONDS + parts[2]
