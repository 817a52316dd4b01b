"""The container of `.sfs` files, writing side: arrays go to disk as they come, the header goes before them at the end.

The first arrays are kept in memory; a file that stays small is then written at one go. When they become too many they
are spooled to the draft behind space that is left for the header. A header that does not fit there goes to a second
draft, and the arrays are copied behind it by the kernel.

Every array starts at a multiple of 64 bytes in the file and is followed by at least 4 NULs.
"""

import io
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np

from sceneloom.arrays import AnyArray

ALIGNMENT = 64
"""A cache line, and enough for every dtype and vector instruction."""

_NULS = bytes(2 * ALIGNMENT)
_GAP = 4
_IN_MEMORY = 8 << 20
_BUFFER = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """An array that stands in the spool, and in the header's tree until its item is written.

    Attributes:
        offset: of its first byte, from the end of the header.
        length: in bytes.
        dtype: NumPy's name.
        shape: as the array had it.
    """

    offset: int
    length: int
    dtype: str
    shape: tuple[int, ...]


class Spool:
    """Collects arrays for a file whose header comes last."""

    def __init__(self, draft: Path, *, reserve: Callable[[], int]) -> None:
        """Start empty.

        Args:
            draft: the file to be written.
            reserve: says how many bytes the header is expected to take; asked when the arrays go to disk.
        """
        self._draft = draft
        self._reserve = reserve
        self._file: BinaryIO = io.BytesIO()
        self._start = 0
        self._file.write(_NULS[:ALIGNMENT])
        self._end = ALIGNMENT

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, array: AnyArray) -> Blob:
        """Write an array, byte for byte, in little-endian order."""
        values = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        self._make_room(values.nbytes)
        self._file.write(values.reshape(-1).view(np.uint8).data)
        return self._added(values.nbytes, _name_of(values.dtype), tuple(array.shape))

    def add_file(self, path: Path) -> Blob:
        """Write the bytes of a file as an array of uint8."""
        length = path.stat().st_size
        self._make_room(length)
        with path.open("rb") as source:
            shutil.copyfileobj(source, self._file, _BUFFER)
        return self._added(length, "uint8", (length,))

    def change(self, blob: Blob, change: Callable[[AnyArray], AnyArray]) -> None:
        """Replace an array by one of the same shape and dtype."""
        self._file.seek(self._start + blob.offset)
        old = np.frombuffer(self._file.read(blob.length), blob.dtype).reshape(blob.shape)
        self._file.seek(self._start + blob.offset)
        self._file.write(change(old).astype(blob.dtype, copy=False).tobytes())
        self._file.seek(self._start + self._end)

    def finish(self, header: bytes) -> None:
        """Put the header, padded with blanks, before the arrays; the draft is then complete."""
        if self._start and len(header) <= self._start:
            self._file.seek(0)
            self._file.write(header.ljust(self._start))
            self._file.close()
            return
        front = header.ljust(_aligned(len(header)))
        target = self._draft if not self._start else self._draft.with_name(self._draft.name + ".whole")
        self._file.flush()
        with target.open("wb", buffering=0) as file:
            _write_all(file, front)
            if isinstance(self._file, io.BytesIO):
                _write_all(file, self._file.getbuffer())
            else:
                _copy(self._file, self._start, file)
        self._file.close()
        target.replace(self._draft)

    def _make_room(self, length: int) -> None:
        """Move from memory to the draft as soon as the arrays become too many."""
        if self._start or self._end + length <= _IN_MEMORY:
            return
        kept = self._file
        self._file = self._draft.open("w+b", buffering=_BUFFER)
        self._start = _aligned(self._reserve())
        self._file.seek(self._start)
        if isinstance(kept, io.BytesIO):
            self._file.write(kept.getbuffer())

    def _added(self, length: int, dtype: str, shape: tuple[int, ...]) -> Blob:
        blob = Blob(self._end, length, dtype, shape)
        end = _aligned(self._end + length + _GAP)
        self._file.write(_NULS[: end - self._end - length])
        self._end = end
        return blob


@lru_cache(maxsize=64)
def _name_of(dtype: np.dtype[Any]) -> str:
    """NumPy's name of a dtype, which it takes long to put together."""
    return dtype.name


def _aligned(length: int) -> int:
    return -(-length // ALIGNMENT) * ALIGNMENT


def _write_all(file: Any, content: bytes | memoryview) -> None:
    rest = memoryview(content)
    while rest:
        rest = rest[file.write(rest) :]


def _copy(source: BinaryIO, start: int, target: Any) -> None:
    """Append what lies behind `start` of one file to another, inside the kernel where that is possible."""
    source.seek(0, os.SEEK_END)
    stop = source.tell()
    try:
        while start < stop:
            start += os.copy_file_range(source.fileno(), target.fileno(), stop - start, start)
    except (AttributeError, OSError):
        source.seek(start)
        shutil.copyfileobj(source, target, _BUFFER)
