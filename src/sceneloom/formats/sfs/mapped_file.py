"""A file mapped into memory, whose arrays are references to it where they are pickled."""

import mmap
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Self

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.formats.identity import FileIdentity


class MappedFile(mmap.mmap):
    """The bytes of a file, read only.

    Attributes:
        identity: how to tell the file from one that takes its place.
    """

    identity: FileIdentity

    @classmethod
    def of(cls, path: Path) -> Self:
        """Map a file.

        Raises:
            OSError: it cannot be read.
            ValueError: it is empty.
        """
        with path.open("rb") as file:
            mapped = cls(file.fileno(), 0, access=mmap.ACCESS_READ)
            mapped.identity = FileIdentity.of(path, descriptor=file.fileno())
        return mapped

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


def _address(array: AnyArray) -> int:
    return int(array.__array_interface__["data"][0])
