"""A file mapped into memory, whose arrays are references to it where they are pickled."""

import io
import mmap
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.byte_stream import ByteStream
from sceneloom.formats.files import open_file
from sceneloom.formats.identity import FileIdentity

_MAPPED_AT_MOST = 128 << 20
_DONT_NEED: int | None = getattr(mmap, "MADV_DONTNEED", None)
"""Not on every system."""


class MappedFile(mmap.mmap):
    """The bytes of a file, read only.

    Attributes:
        identity: how to report the file from one that takes its location.
        handed_out: bytes of arrays that were asked for since pages were last let go.
    """

    identity: FileIdentity
    handed_out: int = 0

    @classmethod
    def of(cls, path: Path) -> Self:
        """Map a file.

        Raises:
            OSError: it cannot be read.
            ValueError: it is empty.
        """
        with open_file(path) as file:
            mapped = cls(file.fileno(), 0, access=mmap.ACCESS_READ)
            mapped.identity = FileIdentity.of(path, descriptor=file.fileno())
        return mapped

    def hand_out(self, size: int) -> None:
        """Count bytes that are going to be read, and now and then let go of all pages that were.

        The system keeps them in its cache and maps them again if they are touched; but they count as this process's
        memory as long as they are mapped, and a long drive would be all in it in the end.
        """
        self.handed_out += size
        if self.handed_out > _MAPPED_AT_MOST and _DONT_NEED is not None:
            self.handed_out = 0
            self.madvise(_DONT_NEED)

    def reference(self, array: AnyArray) -> "StoredArray":
        """Give what stands for a contiguous array of these bytes in other processes."""
        start = _address(array) - _address(np.frombuffer(self, np.uint8))
        return StoredArray(self.identity, start, array.dtype, array.shape)


@dataclass(frozen=True, slots=True, eq=False)
class StoredArray:
    """Where an array is in a file."""

    identity: FileIdentity
    start: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    def __call__(self) -> AnyArray:
        """Map the file again, and give the array.

        Raises:
            DataError: the file was changed, replaced or removed.
        """
        self.identity.check()
        mapped = MappedFile.of(self.identity.path)
        return np.frombuffer(mapped, self.dtype, prod(self.shape), self.start).reshape(self.shape)


class MappedContent:
    """The bytes of an array of a mapped file, whose pages are let go as they are read."""

    def __init__(self, file: MappedFile, content: memoryview) -> None:
        """Nothing is read yet."""
        self._file, self._content = file, content

    def __len__(self) -> int:
        return len(self._content)

    def __getitem__(self, part: slice) -> memoryview:
        piece = self._content[part]
        self._file.hand_out(len(piece))
        return piece

    def __call__(self) -> BinaryIO:
        """Open them as a file."""
        return cast("BinaryIO", io.BufferedReader(ByteStream(self)))


@dataclass(frozen=True, slots=True, eq=False)
class LocalFile:
    """A file of this machine for a container.

    Attributes:
        content: its bytes.
        identity: how to report it from a file that takes its location.
    """

    content: MappedFile
    identity: FileIdentity

    @classmethod
    def of(cls, path: Path) -> Self:
        """Map a file.

        Raises:
            DataError: it cannot be read, or is empty.
        """
        try:
            if path.exists() and not path.is_file():
                raise DataError(path, "", "not a file; expected a Sensor Fusion Scene file")
            content = MappedFile.of(path)
        except ValueError:
            raise DataError(path, "", "is empty; expected a JSON header") from None
        except OSError as error:
            raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
        return cls(content, content.identity)

    def header(self, limit: int) -> memoryview:
        """Give the bytes before the first NUL.

        Raises:
            DataError: they are more than `limit`.
        """
        stop = self.content.find(b"\0", 0, limit)
        if stop < 0 and len(self.content) > limit:
            raise DataError(self.identity.name, "header", f"no NUL ends it within {limit} bytes")
        # A file without arrays needs no NUL; one that was cut inside its header is no whole JSON.
        return memoryview(self.content)[: stop if stop >= 0 else len(self.content)]

    def fill(self, header: dict[str, Any]) -> None:
        """Do nothing: all arrays have their values."""

    def fetch(self, value: Any) -> Any:
        """Give the value itself: the system reads its pages when they are touched."""
        self.content.hand_out(_bytes_in(value))
        return value

    def bytes_of(self, array: AnyArray) -> "MappedContent":
        """Give the bytes of an array without copying them."""
        return MappedContent(self.content, array.data.cast("B"))

    def close(self) -> None:
        """Do nothing: the map stays as long as an array of it is in use."""


def _bytes_in(value: Any) -> int:
    """How large the arrays of a record are in all."""
    if isinstance(value, dict):
        return sum(map(_bytes_in, value.values()))
    return value.nbytes if isinstance(value, np.ndarray) else 0


def _address(array: AnyArray) -> int:
    return int(array.__array_interface__["data"][0])
