"""The container of `.sfs` files, writing side: arrays go to disk as they come, the header goes before them at the end.

The first arrays are kept in memory; a file that stays small is then written at one go. When they become too many they
are spooled to the draft behind space that is left for the header. For a header that does not fit there the file system
is asked to put space in front of the arrays; where it cannot, they are copied behind the header in a second draft.

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
from typing import Any, Self

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.formats.sfs.allocation import BLOCK, allocate, insert

ALIGNMENT = 64
"""A cache line, and enough for every dtype and vector instruction."""

_NULS = bytes(2 * ALIGNMENT)
_GAP = 4
_IN_MEMORY = 8 << 20
_GATHERED = 1 << 20
_SMALL = 1 << 16
_ALLOCATED = 64 << 20


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
        self._file: io.FileIO | None = None
        self._start = 0
        self._gathered = bytearray(ALIGNMENT)
        self._end = ALIGNMENT
        self._allocated = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, array: AnyArray) -> Blob:
        """Write an array, byte for byte, in little-endian order."""
        dtype, name = _form_of(array.dtype)
        if array.nbytes < _SMALL:
            content: Any = array.astype(dtype, copy=False).tobytes()
        else:
            content = np.ascontiguousarray(array, dtype).reshape(-1).view(np.uint8).data
        self._write(content, array.nbytes)
        return self._added(array.nbytes, name, array.shape)

    def add_file(self, path: Path) -> Blob:
        """Write the bytes of a file as an array of uint8."""
        length = path.stat().st_size
        with path.open("rb", buffering=0) as source:
            if length < _SMALL:
                self._write(source.read(), length)
            else:
                _copy(source, 0, self._file_for(length))
        return self._added(length, "uint8", (length,))

    def change(self, blob: Blob, change: Callable[[AnyArray], AnyArray]) -> None:
        """Replace an array by one of the same shape and dtype."""
        if self._file is None:
            location = slice(blob.offset, blob.offset + blob.length)
            old = bytes(self._gathered[location])
            self._gathered[location] = _changed(old, blob, change)
            return
        file = self._file_for(0)
        file.seek(self._start + blob.offset)
        content = _changed(_read_all(file, blob.length), blob, change)
        file.seek(self._start + blob.offset)
        _write_all(file, content)
        file.seek(self._start + self._end)

    def finish(self, header: bytes) -> None:
        """Put the header, padded with blanks, before the arrays; the draft is then complete."""
        if self._file is None:
            with self._draft.open("wb", buffering=0) as file:
                _write_all(file, header.ljust(_aligned(len(header))), self._gathered)
            return
        file = self._file_for(0)
        file.truncate(self._start + self._end)
        missing = -(-max(0, len(header) - self._start) // BLOCK) * BLOCK
        front = header.ljust(self._start + missing)
        if missing and not insert(file.fileno(), missing):
            self._copy_behind(front, file)
        else:
            file.seek(0)
            _write_all(file, front)
        file.close()

    def _copy_behind(self, front: bytes, spooled: io.FileIO) -> None:
        whole = self._draft.with_name(self._draft.name + ".whole")
        with whole.open("wb", buffering=0) as file:
            _write_all(file, front)
            _copy(spooled, self._start, file)
        spooled.close()
        whole.replace(self._draft)

    def _write(self, content: Any, length: int) -> None:
        """Gather small arrays, write large ones; a caller may change its array as soon as this returns."""
        in_memory = self._file is None and self._end + length <= _IN_MEMORY
        if in_memory or (length < _SMALL and len(self._gathered) < _GATHERED):
            self._gathered += content
        else:
            _write_all(self._file_for(length), content)

    def _file_for(self, length: int) -> io.FileIO:
        """Give the draft, opened at its first use, all gathered arrays written, with room for `length` bytes more."""
        if self._file is None:
            self._start = _aligned(self._reserve())
            self._file = self._draft.open("w+b", buffering=0)
            self._file.seek(self._start)
        file, wanted = self._file, self._start + self._end + length
        if length and wanted > self._allocated:
            self._allocated = max(self._allocated, self._start) + max(_ALLOCATED, wanted - self._allocated)
            allocate(file.fileno(), 0, self._allocated)
        if self._gathered:
            _write_all(file, self._gathered)
            self._gathered = bytearray()
        return file

    def _added(self, length: int, dtype: str, shape: tuple[int, ...]) -> Blob:
        start, stop = self._end, self._end + length
        self._end = -(-(stop + _GAP) // ALIGNMENT) * ALIGNMENT
        self._gathered += _NULS[: self._end - stop]
        return Blob(start, length, dtype, shape)


@lru_cache(maxsize=64)
def _form_of(dtype: np.dtype[Any]) -> tuple[np.dtype[Any], str]:
    """The little-endian dtype, and NumPy's name of it, which it takes long to put together."""
    return dtype.newbyteorder("<"), dtype.name


def _changed(content: bytes, blob: Blob, change: Callable[[AnyArray], AnyArray]) -> bytes:
    old = np.frombuffer(content, blob.dtype).reshape(blob.shape)
    return change(old).astype(blob.dtype, copy=False).tobytes()


def _aligned(length: int) -> int:
    return -(-length // ALIGNMENT) * ALIGNMENT


def _write_all(file: io.FileIO, *contents: Any) -> None:
    for content in contents:
        rest = memoryview(content)
        while rest:
            rest = rest[file.write(rest) :]


def _read_all(file: io.FileIO, length: int) -> bytes:
    content = bytearray()
    while len(content) < length and (piece := file.read(length - len(content))):
        content += piece
    return bytes(content)


def _copy(source: io.FileIO, start: int, target: io.FileIO) -> None:
    """Append what lies behind `start` of one file to another, inside the kernel where that is possible."""
    stop = os.fstat(source.fileno()).st_size
    try:
        while start < stop:
            start += os.copy_file_range(source.fileno(), target.fileno(), stop - start, start)
    except (AttributeError, OSError):
        source.seek(start)
        shutil.copyfileobj(source, target, _GATHERED)
