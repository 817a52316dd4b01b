"""One open file that several read, each at a location of its own."""

import io
from threading import Lock
from typing import Any, BinaryIO

_LOCK = Lock()


class FileView(io.RawIOBase):
    """A file over another one, which stays open when this is closed."""

    def __init__(self, file: BinaryIO) -> None:
        """Begin at the first byte."""
        self._file, self._location = file, 0
        with _LOCK:
            self._size = file.seek(0, io.SEEK_END)

    def readable(self) -> bool:
        """Report yes."""
        return True

    def seekable(self) -> bool:
        """Report yes."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Copy the next bytes into the buffer."""
        with _LOCK:
            self._file.seek(self._location)
            content = self._file.read(len(buffer))
        buffer[: len(content)] = content
        self._location += len(content)
        return len(content)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to a byte."""
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._location, io.SEEK_END: self._size}[whence]
        self._location = max(0, base + offset)
        return self._location

    def tell(self) -> int:
        """The byte that is read next."""
        return self._location
