"""The bytes of protobuf messages by hand, where their arrays would be copied once more by the library.

Source: protobuf.dev, "Encoding".
"""

from collections.abc import Iterable

_BYTES = 2
"""The type of fields that begin with their length: messages, bytes and texts."""


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
    return varint(number << 3 | _BYTES) + varint(length)


def enclosed(number: int, parts: Iterable[bytes | memoryview]) -> list[bytes | memoryview]:
    """The parts of a message as the content of a field of another message."""
    content = list(parts)
    return [field_head(number, sum(len(part) for part in content)), *content]
