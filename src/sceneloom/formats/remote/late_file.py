"""A file behind a URL that is fetched when more than its first bytes are read."""

import io
import os
from typing import Any

from sceneloom.formats.remote.mirror import HEAD, ListedFile, Mirror


class LateFile(io.RawIOBase):
    """An open file of a mirror that is not on disk yet."""

    def __init__(self, mirror: Mirror, file: ListedFile, path: str) -> None:
        """Begin at the first byte; nothing is fetched yet."""
        self._mirror, self._file, self._path = mirror, file, path
        self._place = 0
        self._on_disk: io.FileIO | None = None
        self.name = path

    def readable(self) -> bool:
        """Say yes."""
        return True

    def seekable(self) -> bool:
        """Say yes."""
        return True

    def fileno(self) -> int:
        """Have all of it on disk: who asks will map it, or hand it to the system."""
        return self._fetched().fileno()

    def readinto(self, buffer: Any) -> int:
        """Copy the next bytes into the buffer."""
        if self._on_disk is None and self._place + len(buffer) <= HEAD:
            piece = self._mirror.head(self._file)[self._place : self._place + len(buffer)]
            buffer[: len(piece)] = piece
            self._place += len(piece)
            return len(piece)
        return self._fetched().readinto(buffer)

    def readall(self) -> bytes:
        """Read what is left."""
        return self._fetched().readall()

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a byte."""
        if self._on_disk is not None:
            return self._on_disk.seek(offset, whence)
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._file.size}[whence]
        self._place = max(0, base + offset)
        return self._place

    def tell(self) -> int:
        """The byte that is read next."""
        return self._place if self._on_disk is None else self._on_disk.tell()

    def close(self) -> None:
        """Let go of the file."""
        if self._on_disk is not None:
            self._on_disk.close()
        super().close()

    def _fetched(self) -> io.FileIO:
        if self._on_disk is None:
            self._mirror.bring(self._file)
            self._on_disk = io.FileIO(self._path)
            self._on_disk.seek(self._place)
        return self._on_disk
