"""The messages of an MCAP file by their place in its index: whole ones, or only how they begin."""

import struct
import zlib
from collections import OrderedDict
from collections.abc import Iterator
from threading import Lock
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.mcap.compression import decompress
from sceneloom.formats.mcap.index import DIRECT, LARGEST_CHUNK, Entries, McapIndex
from sceneloom.formats.mcap.records import HEAD, MESSAGE, Op

_KEPT_CHUNKS = 2
"""Chunks that stay decompressed: messages that are read one after another mostly stand in one chunk."""

_BEFORE_DATA = HEAD.size + MESSAGE.size


class McapMessages:
    """Gives the messages of a file; of chunks that had to be decompressed the latest ones are kept.

    Attributes:
        index: where they stand.
    """

    def __init__(self, index: McapIndex) -> None:
        """Read nothing yet."""
        self.index = index
        self._begin()

    def _begin(self) -> None:
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {"index": self.index}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.index = state["index"]
        self._begin()

    def data(self, entries: Entries, k: int) -> memoryview:
        """Read the data of message `k` of a channel.

        Raises:
            DataError: the message is damaged.
        """
        chunk, offset = int(entries.chunks[k]), int(entries.offsets[k])
        if chunk == DIRECT:
            length = self._length(self.index.file.read(offset, HEAD.size), 0, offset)
            content = self.index.file.read(offset + HEAD.size, length)
            return memoryview(content)[MESSAGE.size :]
        content = self._chunk(chunk)
        start = offset + HEAD.size
        stop = start + self._length(content, offset, offset)
        if stop > len(content):
            raise self._fault(f"chunk {chunk}, byte {offset}", "a message that ends beyond its chunk")
        return memoryview(content)[start + MESSAGE.size : stop]

    def heads(self, entries: Entries, rows: Int64Array, size: int) -> Iterator[bytes]:
        """Give the first bytes of the data of some messages, in the order of the file.

        Args:
            entries: of a channel.
            rows: which, ascending.
            size: how many bytes at most.

        Raises:
            DataError: a message is damaged.
        """
        chunks = entries.chunks[rows]
        borders = np.flatnonzero(np.diff(chunks)) + 1
        for part in np.split(rows, borders):
            if len(part) == 0:
                continue
            chunk, offsets = int(entries.chunks[part[0]]), entries.offsets[part].tolist()
            if chunk == DIRECT:
                for offset in offsets:
                    content = self.index.file.read_up_to(offset, _BEFORE_DATA + size)
                    yield self._head(content, 0, size, offset)
            else:
                content = self._beginning(chunk, max(offsets) + _BEFORE_DATA + size)
                for offset in offsets:
                    yield self._head(content, offset, size, offset)

    def _head(self, content: bytes, offset: int, size: int, place: int) -> bytes:
        length = self._length(content, offset, place) - MESSAGE.size
        start = offset + _BEFORE_DATA
        return content[start : start + min(size, length)]

    def _length(self, content: bytes, offset: int, place: int) -> int:
        try:
            op, length = HEAD.unpack_from(content, offset)
        except struct.error:
            raise self._fault(f"byte {place}", "no message; the index is damaged") from None
        if op != Op.MESSAGE or not MESSAGE.size <= length <= LARGEST_CHUNK:
            problem = f"record {op} of {length} bytes where the index says that a message is"
            raise self._fault(f"byte {place}", problem)
        return int(length)

    def _chunk(self, number: int) -> bytes:
        with self._lock:
            known = self._chunks.get(number)
            if known is not None:
                self._chunks.move_to_end(number)
                return known
        place = self.index.chunks[number]
        content = self._beginning(number, place.full_size)
        if len(content) != place.full_size or (place.crc and zlib.crc32(content) != place.crc):
            raise self._fault(f"chunk {number}", "damaged: its checksum is another one, or it is cut off")
        with self._lock:
            self._chunks[number] = content
            while len(self._chunks) > _KEPT_CHUNKS:
                self._chunks.popitem(last=False)
        return content

    def _beginning(self, number: int, size: int) -> bytes:
        place = self.index.chunks[number]
        stored = self.index.file.read(place.start, place.size)
        try:
            return decompress(place.compression, stored, min(size, place.full_size))
        except ValueError as error:
            raise self._fault(f"chunk {number}", str(error)) from error

    def _fault(self, place: str, problem: str) -> DataError:
        return DataError(self.index.file.path, place, problem)
