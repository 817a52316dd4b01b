"""Arrays on their way into a file whose header comes last: spooled to disk as they come."""

import ctypes
import io
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from sceneloom.arrays import AnyArray

ALIGNMENT = 64
"""A cache line, and enough for every dtype and vector instruction."""

_NULS = bytes(2 * ALIGNMENT)
_GAP = 4
_IN_MEMORY = 8 << 20
_GATHERED = 1 << 20
_SMALL = 1 << 16
_ALLOCATED = 64 << 20

_BLOCK = 4096
"""Space can be put into a file in multiples of the block of its file system, which is nearly always this [bytes]."""

_EXTEND, _INSERT_RANGE = 0x00, 0x20
"""Modes of fallocate(2) of Linux: reserve space, which is then cheaper to fill; put space before the first byte of a
file without copying what follows (FALLOC_FL_INSERT_RANGE, which ext4 and XFS know)."""


@dataclass(frozen=True, slots=True, eq=False)
class Blob:
    """An array that stands in the spool, and in the header's tree until its item is written.

    Attributes:
        offset: of its first byte, from the end of the header.
        length: in bytes.
        dtype: NumPy's name.
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
            reserve: gives the bytes that the header is expected to take; called when the arrays go to disk.
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
            self._gathered[location] = _changed(bytes(self._gathered[location]), blob, change)
            return
        file = self._file_for(0)
        file.seek(self._start + blob.offset)
        content = bytearray()
        while len(content) < blob.length and (chunk := file.read(blob.length - len(content))):
            content += chunk
        file.seek(self._start + blob.offset)
        _write_all(file, _changed(bytes(content), blob, change))
        file.seek(self._start + self._end)

    def finish(self, header: bytes) -> None:
        """Put the header, padded with blanks, before the arrays; the draft is then complete."""
        if self._file is None:
            with self._draft.open("wb", buffering=0) as file:
                _write_all(file, header.ljust(_aligned(len(header))), self._gathered)
            return
        spooled = self._file_for(0)
        spooled.truncate(self._start + self._end)
        missing = -(-max(0, len(header) - self._start) // _BLOCK) * _BLOCK
        front = header.ljust(self._start + missing)
        if not missing or _fallocate(spooled.fileno(), _INSERT_RANGE, 0, missing):
            spooled.seek(0)
            _write_all(spooled, front)
            spooled.close()
            return
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
            _fallocate(file.fileno(), _EXTEND, 0, self._allocated)
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
    """The little-endian dtype, and NumPy's name of it, which takes long to compute."""
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


def _copy(source: io.FileIO, start: int, target: io.FileIO) -> None:
    """Append what lies behind `start` of one file to another, inside the kernel where that is possible."""
    stop = os.fstat(source.fileno()).st_size
    try:
        while start < stop:
            start += os.copy_file_range(source.fileno(), target.fileno(), stop - start, start)
    except (AttributeError, OSError):
        source.seek(start)
        shutil.copyfileobj(source, target, _GATHERED)


def _fallocate(descriptor: int, mode: int, start: int, length: int) -> bool:
    call = _system_call()
    return call is not None and call(descriptor, mode, start, length) == 0


@lru_cache(maxsize=1)
def _system_call() -> Any:
    """Find the function in the C library; unlike `os.posix_fallocate` it does not write zeros where it cannot."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        call = ctypes.CDLL(None, use_errno=True).fallocate64
    except (OSError, AttributeError):
        return None
    call.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]
    call.restype = ctypes.c_int
    return call
