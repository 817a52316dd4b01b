"""Wire formats: of protobuf, for messages whose arrays would be copied once more by the library; and of FlatBuffers.

Source: protobuf.dev, "Encoding"; flatbuffers.dev, "Internals", and its schema of schemas, reflection.fbs.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

# Protobuf

LENGTH_TYPE = 2
"""The type of fields that begin with their length: messages, bytes and texts."""

_VARINT_TYPE = 0
_FIXED_SIZES = {1: 8, 5: 4}
_LONGEST_VARINT = 10

_MOST_FIELDS = 1000  # of one message: more are very many


@dataclass(frozen=True, slots=True)
class WireField:
    """Where a field stands in the bytes of a message.

    Attributes:
        number: of the field.
        type: how its end is known.
        head: where its number begins.
        start, stop: where its content begins and ends.
    """

    number: int
    type: int
    head: int
    start: int
    stop: int


def varint(number: int) -> bytes:
    """A number that is not negative, seven bits a byte, lowest first."""
    parts = bytearray()
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    parts.append(number)
    return bytes(parts)


def read_varint(content: bytes | memoryview, position: int, stop: int) -> tuple[int, int]:
    """A number as `varint` writes it, also of Thrift, Draco and AV1, and where it ends.

    Args:
        content: bytes in which it stands.
        position: where it begins.
        stop: where it has ended at the latest.

    Raises:
        ValueError: it does not end before `stop`, or within ten bytes.
    """
    number = 0
    for k in range(min(_LONGEST_VARINT, stop - position)):
        byte = content[position + k]
        number |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return number, position + k + 1
    raise ValueError(f"the number at byte {position} does not end before byte {stop}, or is longer than 64 bits")


def field_head(number: int, length: int) -> bytes:
    """What stands before the content of a field of messages, bytes or texts.

    Args:
        number: of the field.
        length: of the content [byte].
    """
    return varint(number << 3 | LENGTH_TYPE) + varint(length)


def enclosed(number: int, parts: Iterable[bytes | memoryview]) -> list[bytes | memoryview]:
    """The parts of a message as the content of a field of another message."""
    content = list(parts)
    return [field_head(number, sum(len(part) for part in content)), *content]


def wire_fields(
    content: bytes | memoryview, start: int, stop: int, *, most: int = _MOST_FIELDS
) -> list[WireField] | None:
    """Find the fields of a message without reading them.

    Args:
        content: bytes in which the message stands.
        start, stop: where it begins and ends.
        most: how many fields are not very many.

    Returns:
        The fields in order; None where there is something unusual: another type of field, very many, or no message.
    """
    fields: list[WireField] = []
    position = start
    try:
        while position < stop:
            head = position
            tag, position = read_varint(content, position, stop)
            kind, begin = tag & 7, position
            if kind == LENGTH_TYPE:
                length, begin = read_varint(content, position, stop)
                position = begin + length
            elif kind == _VARINT_TYPE:
                position = read_varint(content, position, stop)[1]
            elif kind in _FIXED_SIZES:
                position += _FIXED_SIZES[kind]
            else:
                return None
            if position > stop or len(fields) == most:
                return None
            fields.append(WireField(tag >> 3, kind, head, begin, position))
    except ValueError:
        return None
    return fields


# FlatBuffers

_SCALARS = {1: "B", 2: "?", 3: "b", 4: "B", 5: "h", 6: "H", 7: "i", 8: "I", 9: "q", 10: "Q", 11: "f", 12: "d"}
_STRING, _VECTOR, _OBJECT, _ARRAY = 13, 14, 15, 17
_REALS = (11, 12)


class _FlatBytes:
    """The bytes of a FlatBuffer: numbers, and where the offsets between its parts lead; ValueError beyond them."""

    def __init__(self, content: bytes | memoryview) -> None:
        """Begin. No more tables are made of it than it has space for: one may be in many positions."""
        self.content, self.tables_left = memoryview(content), len(content) // 4

    def number(self, form: str, at: int) -> Any:
        """A scalar."""
        try:
            (value,) = struct.unpack_from(f"<{form}", self.content, at) if at >= 0 else ("",)
        except struct.error:
            value = ""
        if value == "":
            raise ValueError(f"offset {at} of a FlatBuffer of {len(self.content)} bytes")
        return value

    def there(self, at: int) -> int:
        """Where the offset at a position leads."""
        return at + int(self.number("I", at))

    def slot(self, table: int, offset: int) -> int:
        """Where a field of a table is, by its offset in the table of fields; 0 where it is left out."""
        fields = table - int(self.number("i", table))
        found = self.number("H", fields + offset) if offset + 2 <= self.number("H", fields) else 0
        return table + int(found) if found else 0

    def text(self, at: int) -> str:
        """A string, by the position of its offset."""
        start = self.there(at)
        stop = start + 4 + self.number("I", start)
        if stop > len(self.content):
            raise ValueError(f"a text of {stop - start - 4} bytes; the FlatBuffer ends before")
        return bytes(self.content[start + 4 : stop]).decode()

    def array(self, form: str, start: int, count: int) -> Any:
        """Numbers as they lie there, (count,)."""
        if not 0 <= start <= len(self.content):
            raise ValueError(f"offset {start} of a FlatBuffer of {len(self.content)} bytes")
        return np.frombuffer(self.content, f"<{form}", count, start)

    def vector(self, at: int, size: int) -> tuple[int, int]:
        """Where the elements of a vector begin, by the position of its offset, and how many there are."""
        start = self.there(at)
        count = int(self.number("I", start))
        if start + 4 + count * size > len(self.content):
            raise ValueError(f"a vector of {count} elements; the FlatBuffer ends before")
        return start + 4, count


@dataclass(frozen=True, slots=True)
class _FlatField:
    """A field of a table, or of a struct: its type, where it is, and its number where it is left out."""

    kind: int
    element: int
    index: int
    length: int
    offset: int
    default: Any


@dataclass(frozen=True, slots=True)
class _FlatObject:
    """A table, or a struct of so many bytes."""

    is_struct: bool
    size: int
    fields: dict[str, _FlatField]


class FlatSchema:
    """A schema of FlatBuffers in its binary form (.bfbs), by which messages are read field by field."""

    def __init__(self, content: bytes) -> None:
        """Read the schema.

        Raises:
            ValueError: it is none.
        """
        data = _FlatBytes(content)
        root = data.there(0)
        start, count = data.vector(_stated(data, root, 0), 4)
        tables = [data.there(start + 4 * k) for k in range(count)]
        self._objects = [_flat_object(data, table) for table in tables]
        names = [data.text(_stated(data, table, 0)) for table in tables]
        self._root = names.index(data.text(_stated(data, data.there(_stated(data, root, 4)), 0)))

    def message(self, content: bytes | memoryview) -> "FlatMessage":
        """Give a message, whose fields are read when they are asked for.

        Raises:
            ValueError: it is too short; as of all that reads its fields.
        """
        data = _FlatBytes(content)
        return FlatMessage(self, self._objects[self._root], data, data.there(0))

    def value(self, field: _FlatField, data: _FlatBytes, at: int) -> Any:
        """What a field holds that is at a position; what is left out, at 0, is empty, or the field's default."""
        if field.kind in _SCALARS:
            return data.number(_SCALARS[field.kind], at) if at else field.default
        if field.kind == _STRING:
            return data.text(at) if at else ""
        if field.kind == _OBJECT:
            return self._part(self._object(field), data, at)
        if field.kind == _VECTOR:
            return self._vector(field, data, at)
        if field.kind == _ARRAY and field.element in _SCALARS:
            return data.array(_SCALARS[field.element], at, field.length)
        raise ValueError(f"a field of type {field.kind} of FlatBuffers, which is not read")

    def _object(self, field: _FlatField) -> _FlatObject:
        if not 0 <= field.index < len(self._objects):
            raise ValueError(f"object {field.index} of a schema of {len(self._objects)}")
        return self._objects[field.index]

    def _part(self, kind: _FlatObject, data: _FlatBytes, at: int) -> "FlatMessage":
        data.tables_left -= bool(at)
        if data.tables_left < 0:
            raise ValueError("more tables than there is space for in the FlatBuffer")
        return FlatMessage(self, kind, data, at if kind.is_struct or not at else data.there(at))

    def _vector(self, field: _FlatField, data: _FlatBytes, at: int) -> Any:
        form = _SCALARS.get(field.element)
        kind = self._object(field) if field.element == _OBJECT else None
        size = struct.calcsize(form) if form else kind.size if kind and kind.is_struct else 4
        start, count = data.vector(at, size) if at else (0, 0)
        if form:
            return data.array(form, start, count)
        positions = (start + k * size for k in range(count))
        if kind is None:
            return [data.text(one) for one in positions] if field.element == _STRING else []
        return [self._part(kind, data, one) for one in positions]


class FlatMessage:
    """A table or struct of a FlatBuffer; its fields are attributes."""

    def __init__(self, schema: FlatSchema, kind: _FlatObject, data: _FlatBytes, at: int) -> None:
        """Begin; at position 0 all fields are left out."""
        self._schema, self._kind, self._data, self._at = schema, kind, data, at

    def _position(self, field: _FlatField) -> int:
        if not self._at:
            return 0
        return self._at + field.offset if self._kind.is_struct else self._data.slot(self._at, field.offset)

    def HasField(self, name: str) -> bool:  # noqa: N802 - as messages of protobuf have it
        """Whether a field is stated."""
        return name in self._kind.fields and self._position(self._kind.fields[name]) != 0

    def __getattr__(self, name: str) -> Any:
        """What a field holds."""
        field = None if name.startswith("_") else self._kind.fields.get(name)
        if field is None:
            raise AttributeError(name)
        return self._schema.value(field, self._data, self._position(field))


def _stated(data: _FlatBytes, table: int, number: int) -> int:
    """Where a field of the schema of schemas is, by its number."""
    found = data.slot(table, 4 + 2 * number)
    if not found:
        raise ValueError(f"no schema of FlatBuffers: field {number} is missing")
    return found


def _flat_object(data: _FlatBytes, table: int) -> _FlatObject:
    def number(table: int, field: int, form: str, default: Any) -> Any:
        at = data.slot(table, 4 + 2 * field)
        return data.number(form, at) if at else default

    start, count = data.vector(_stated(data, table, 1), 4)
    fields = {}
    for one in (data.there(start + 4 * k) for k in range(count)):
        kind = data.there(_stated(data, one, 1))
        base = number(kind, 0, "b", 0)
        default = number(one, 5, "d", 0.0) if base in _REALS else number(one, 4, "q", 0)
        fields[data.text(_stated(data, one, 0))] = _FlatField(
            base, number(kind, 1, "b", 0), number(kind, 2, "i", -1), number(kind, 3, "H", 0),
            number(one, 3, "H", 0), default,
        )  # fmt: skip
    return _FlatObject(bool(number(table, 2, "B", 0)), number(table, 4, "i", 0), fields)


@lru_cache(maxsize=64)
def flat_schema(content: bytes) -> FlatSchema:
    """Read a schema of FlatBuffers, each once.

    Raises:
        ValueError: it is none.
    """
    return FlatSchema(content)
