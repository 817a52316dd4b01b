"""Looks at fields of a message's bytes without parsing it: to know whose a large request is costs nothing."""

from collections.abc import Iterator

from sceneloom.errors import DataError

_VARINT, _FIXED_64, _BYTES, _FIXED_32 = 0, 1, 2, 5


def text_field(content: bytes, number: int) -> str:
    """Give a text of a message, the last where it stands twice, "" where it is left out.

    Raises:
        DataError: the bytes are no message.
    """
    found = ""
    for field, kind, start, stop in _fields(content):
        if field == number and kind == _BYTES:
            try:
                found = content[start:stop].decode()
            except UnicodeDecodeError as error:
                raise DataError("protobuf", "", f"no UTF-8 in field {number}") from error
    return found


def _fields(content: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Number, kind, and begin and end of the value of each field.

    Source: protobuf.dev, "Encoding", "Message Structure".
    """
    position = 0
    while position < len(content):
        tag, position = _varint(content, position)
        kind = tag & 7
        start = position
        if kind == _VARINT:
            _, position = _varint(content, position)
        elif kind == _BYTES:
            length, start = _varint(content, position)
            position = start + length
        elif kind in (_FIXED_32, _FIXED_64):
            position += 8 if kind == _FIXED_64 else 4
        else:
            raise _no_message(content)
        if position > len(content):
            raise _no_message(content)
        yield tag >> 3, kind, start, position


def _varint(content: bytes, position: int) -> tuple[int, int]:
    """A number of seven bits a byte, lowest first, and where the next field begins."""
    number = 0
    for k, byte in enumerate(content[position : position + 10]):
        number |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return number, position + k + 1
    raise _no_message(content)


def _no_message(content: bytes) -> DataError:
    return DataError("protobuf", "", f"{len(content)} bytes; expected a message")
