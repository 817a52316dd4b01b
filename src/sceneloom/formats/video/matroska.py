"""Whether a Matroska file ends where its elements state: FFmpeg reads one that is cut off without a word.

Images that are shown earlier may be stored later, so what is left of a cut file is not its first images.

Source: RFC 8794 (EBML), sections 4 to 6; RFC 9559 (Matroska), section 5.1.
"""

import os
from typing import BinaryIO, NamedTuple

from sceneloom.errors import DataError
from sceneloom.formats.video.source import VideoSource, open_bytes

_SEGMENT = 0x18538067
_LONGEST_HEAD = 12


class _Element(NamedTuple):
    """The head of an element; `stop` is None where its size is not known, as while it is being recorded."""

    identifier: int
    start: int
    stop: int | None


def check_whole(source: VideoSource, name: str) -> None:
    """Check that no element reaches beyond the end of the file.

    Raises:
        DataError: one does.
    """
    with open_bytes(source) as file:
        size = file.seek(0, os.SEEK_END)
        stop = _declared_stop(file, size)
    if stop > size:
        raise DataError(name, f"byte {size}", f"is cut off: the container goes on to byte {stop} at least")


def _declared_stop(file: BinaryIO, size: int) -> int:
    """The end of the element that reaches farthest, as far as the file can be followed."""
    location = 0
    while location < size:
        element = _read_head(file, location)
        if element is None:
            return location
        if element.stop is not None and element.stop > size:
            return element.stop
        into = element.identifier == _SEGMENT or element.stop is None
        location = element.start if into else int(element.stop or 0)
    return location


def _read_head(file: BinaryIO, location: int) -> _Element | None:
    file.seek(location)
    head = file.read(_LONGEST_HEAD)
    identifier_length = _width(head[:1], longest=4)
    size_length = _width(head[identifier_length : identifier_length + 1], longest=8)
    start = identifier_length + size_length
    if not identifier_length or not size_length or len(head) < start:
        return None
    identifier = int.from_bytes(head[:identifier_length], "big")
    unknown = (1 << 7 * size_length) - 1
    size = int.from_bytes(head[identifier_length:start], "big") & unknown
    return _Element(identifier, location + start, None if size == unknown else location + start + size)


def _width(first: bytes, *, longest: int) -> int:
    """How many bytes a number has whose first byte this is; 0 where none begins like this."""
    width = 9 - first[0].bit_length() if first else 0
    return width if width <= longest else 0
