"""The protobuf wire format, for messages whose arrays would be copied once more by the library."""

from collections.abc import Iterable
from dataclasses import dataclass

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
    while position < stop:
        head = position
        tag, position = _read_varint(content, position, stop)
        kind, begin = tag & 7, position
        if kind == LENGTH_TYPE:
            length, begin = _read_varint(content, position, stop)
            position = begin + length
        elif kind == _VARINT_TYPE:
            position = _read_varint(content, position, stop)[1]
        elif kind in _FIXED_SIZES:
            position += _FIXED_SIZES[kind]
        else:
            return None
        if position > stop or len(fields) == most:
            return None
        fields.append(WireField(tag >> 3, kind, head, begin, position))
    return fields


def _read_varint(content: bytes | memoryview, position: int, stop: int) -> tuple[int, int]:
    """A number, and where it ends: beyond `stop` where it does not end before."""
    number = 0
    for k in range(min(_LONGEST_VARINT, stop - position)):
        byte = content[position + k]
        number |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return number, position + k + 1
    return 0, stop + 1
