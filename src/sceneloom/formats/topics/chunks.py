"""Chunks of files that hold many messages each: the latest ones stay as they are once they are not compressed."""

import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

from sceneloom.errors import DataError
from sceneloom.formats.topics.file_bytes import FileBytes

_KEPT_CHUNKS = 2
"""Messages that are read one after another mostly stand in one chunk."""


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Where the records of a chunk stand.

    Attributes:
        start: place of their first byte in the file.
        size: how many bytes they are there.
        full_size: how many they are once they are not compressed.
        compression: as the file calls it, "" for none.
        crc: checksum of the bytes that are not compressed, 0 for none.
    """

    start: int
    size: int
    full_size: int
    compression: str
    crc: int = 0


Decompress = Callable[[str, bytes, int], bytes]
"""Gives the first bytes of what was compressed: by the name of the compression, the bytes, and how many."""


class Chunks:
    """Gives the bytes of chunks."""

    def __init__(self, file: FileBytes, places: Sequence[ChunkPlace], decompress: Decompress) -> None:
        """Read nothing yet.

        Args:
            file: that the chunks are in.
            places: where each of them is.
            decompress: a function that can be pickled; raises ValueError for bytes that are damaged.
        """
        self._file, self._places, self._decompress = file, places, decompress
        self._begin()

    def _begin(self) -> None:
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("_file", "_places", "_decompress")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def whole(self, number: int) -> bytes:
        """Give a chunk.

        Raises:
            DataError: it is damaged.
        """
        with self._lock:
            known = self._kept.get(number)
            if known is not None:
                self._kept.move_to_end(number)
                return known
        place = self._places[number]
        content = self.beginning(number, place.full_size)
        if len(content) != place.full_size or (place.crc and zlib.crc32(content) != place.crc):
            problem = "damaged: its checksum is another one, or it is cut off"
            raise DataError(self._file.path, f"chunk {number}", problem)
        with self._lock:
            self._kept[number] = content
            while len(self._kept) > _KEPT_CHUNKS:
                self._kept.popitem(last=False)
        return content

    def beginning(self, number: int, size: int) -> bytes:
        """Give the first bytes of a chunk, all of them where it has no more."""
        place = self._places[number]
        stored = self._file.read(place.start, place.size)
        try:
            return self._decompress(place.compression, stored, min(size, place.full_size))
        except ValueError as error:
            raise DataError(self._file.path, f"chunk {number}", str(error)) from error
