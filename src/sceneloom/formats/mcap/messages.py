"""The messages of an MCAP file by their place in its index: whole ones, or only how they begin."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.mcap.compression import decompress
from sceneloom.formats.mcap.index import DIRECT, LARGEST_CHUNK, Entries, McapIndex
from sceneloom.formats.mcap.records import HEAD, MESSAGE, Op
from sceneloom.formats.topics.chunks import Chunks

_BEFORE_DATA = HEAD.size + MESSAGE.size


@dataclass(frozen=True, slots=True, eq=False)
class McapMessages:
    """Gives the messages of a file; of chunks that had to be decompressed the latest ones are kept.

    Attributes:
        index: where they stand.
        chunks: of the file.
    """

    index: McapIndex
    chunks: Chunks

    @classmethod
    def of(cls, index: McapIndex) -> Self:
        """Read nothing yet."""
        return cls(index, Chunks(index.file, index.chunks, decompress))

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
        content = self.chunks.whole(chunk)
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
                self.index.file.expect((offset, offset + _BEFORE_DATA + size) for offset in offsets)
                for offset in offsets:
                    content = self.index.file.read_up_to(offset, _BEFORE_DATA + size)
                    yield self._head(content, 0, size, offset)
            else:
                content = self.chunks.beginning(chunk, max(offsets) + _BEFORE_DATA + size)
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

    def _fault(self, place: str, problem: str) -> DataError:
        return DataError(self.index.file.path, place, problem)
