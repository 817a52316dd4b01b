"""Which images an mp4 video holds, by its tables alone: the images themselves are not read."""

import io
from collections.abc import Iterator
from typing import Any, BinaryIO, cast

from sceneloom.formats.byte_stream import Bytes, ByteStream
from sceneloom.formats.video.index import VideoIndex, read_index

BY_TABLES = {"fflags": "noparse+nofillin"}
"""Options for packets that are reported as the tables report them. Source.

AVFMT_FLAG_NOPARSE of libavformat/avformat.h.
"""

_LONG_SIZE, _TO_THE_END = 1, 0
_LOOKED_AT = 64 << 10
_MOST_BOXES = 10_000


def read_table_index(content: Bytes, name: str) -> VideoIndex:
    """Walk through all packets of an mp4 video; of the bytes of its images only the first few are fetched.

    Raises:
        DataError: the container breaks off.
    """
    return read_index(lambda: open_hollow(content), name, options=BY_TABLES)


def open_hollow(content: Bytes) -> BinaryIO:
    """Open an mp4 video as a file whose images read as NULs, but for the first bytes.

    By which decoders are reported.
    """
    payloads = [(start + _LOOKED_AT, stop) for start, stop in _media(content)]
    return cast("BinaryIO", io.BufferedReader(_Hollow(content, payloads), _LOOKED_AT))


class _Hollow(ByteStream):
    """A file whose payloads read as NULs."""

    def __init__(self, content: Bytes, payloads: list[tuple[int, int]]) -> None:
        super().__init__(content)
        self._payloads = payloads

    def readinto(self, buffer: Any) -> int:
        start, length = self.location, len(buffer)
        for first, stop in self._payloads:
            if first <= start < stop:
                length = min(length, stop - start)
                buffer[:length] = bytes(length)
                self.location += length
                return length
            if start < first:
                length = min(length, first - start)
        return super().readinto(memoryview(buffer)[:length])


def _media(content: Bytes) -> Iterator[tuple[int, int]]:
    """What is in the boxes that hold images: first byte, and the one after the last.

    Source: ISO/IEC 14496-12, 4.2 (boxes) and 8.1.1 (media data).
    """
    location = 0
    for _ in range(_MOST_BOXES):
        head = bytes(content[location : location + 16])
        if len(head) < 8:
            return
        size, name, header = int.from_bytes(head[:4], "big"), head[4:8], 8
        if size == _LONG_SIZE:
            size, header = int.from_bytes(head[8:16], "big"), 16
        stop = len(content) if size == _TO_THE_END else location + size
        if stop < location + header:
            return
        if name == b"mdat":
            yield location + header, min(stop, len(content))
        location = stop
