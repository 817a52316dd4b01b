"""Bytes that can be cut, in memory or fetched as they are looked at, as a file that can be read and sought in."""

import io
import os
from typing import Any, Protocol


class Bytes(Protocol):
    """Bytes in memory, or fetched as they are looked at."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice, /) -> bytes | memoryview: ...


class ByteStream(io.RawIOBase):
    """A file of bytes, which are not copied before they are read."""

    def __init__(self, content: Bytes) -> None:
        """Begin at the first byte."""
        self.content, self.location = content, 0

    def readable(self) -> bool:
        """Report yes."""
        return True

    def seekable(self) -> bool:
        """Report yes."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Copy the next bytes into the buffer."""
        piece = self.content[self.location : self.location + len(buffer)]
        buffer[: len(piece)] = piece
        self.location += len(piece)
        return len(piece)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a byte."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self.location, os.SEEK_END: len(self.content)}[whence]
        self.location = max(0, base + offset)
        return self.location

    def tell(self) -> int:
        """The byte that is read next."""
        return self.location
