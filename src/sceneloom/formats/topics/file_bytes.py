"""Bytes of a file by their place, for those who know from an index where something stands."""

import os
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO

from sceneloom.errors import DataError
from sceneloom.formats.identity import FileIdentity


class FileBytes:
    """A file that is read piece by piece; another process opens it again, if it is still the same file.

    Attributes:
        path: the file.
        size: its length [bytes].
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            DataError: it cannot be opened.
        """
        self.path = path
        try:
            self._identity = FileIdentity.of(path)
        except OSError as error:
            raise DataError(path, "", f"cannot be opened: {error.strerror or error}") from error
        self.size = self._identity.size
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        self._file: BinaryIO | None = None
        self._process = -1
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("path", "size", "_identity", "_closed")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def read(self, start: int, length: int) -> bytes:
        """Read bytes.

        Args:
            start: place of the first.
            length: how many; all of them have to be there.

        Raises:
            DataError: the file ends before, cannot be read, was changed, or is closed.
        """
        content = self.read_up_to(start, length)
        if len(content) != length:
            problem = f"the file ends after {len(content)} of {length} bytes; is it cut off?"
            raise DataError(self.path, f"byte {start}", problem)
        return content

    def read_up_to(self, start: int, length: int) -> bytes:
        """Read bytes, fewer where the file ends before."""
        if start < 0 or length < 0:
            raise DataError(
                self.path, f"byte {start}", f"{length} bytes wanted; expected a place in the file"
            )
        with self._lock:
            file = self._opened()
            try:
                file.seek(start)
                return _read(file, min(length, max(0, self.size - start)))
            except (OSError, OverflowError, ValueError) as error:
                raise DataError(self.path, f"byte {start}", f"cannot be read: {error}") from error

    def close(self) -> None:
        """Release the file; nothing can be read afterwards."""
        with self._lock:
            self._closed = True
            if self._file is not None and self._process == os.getpid():
                self._file.close()
            self._file = None

    def _opened(self) -> BinaryIO:
        if self._closed:
            raise DataError(self.path, "", "is closed")
        if self._file is None or self._process != os.getpid():
            # a forked process must not move the place at which the other one reads
            self._identity.check()
            self._file, self._process = self.path.open("rb", buffering=0), os.getpid()
        return self._file


def _read(file: BinaryIO, length: int) -> bytes:
    """Read so many bytes, in several steps where the system gives fewer at once."""
    content = file.read(length)
    if len(content) == length:
        return content
    parts = [content]
    while parts[-1] and length > sum(map(len, parts)):
        parts.append(file.read(length - sum(map(len, parts))))
    return b"".join(parts)
