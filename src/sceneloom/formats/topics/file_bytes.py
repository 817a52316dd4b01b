"""Bytes of a file by their location, for those who know from an index where something stands."""

import os
from collections.abc import Iterable
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, Protocol

from sceneloom.errors import DataError
from sceneloom.formats.files import file_faults, open_file
from sceneloom.formats.identity import FileIdentity
from sceneloom.formats.remote.ranged import Range, RangedFile, RemoteIdentity
from sceneloom.formats.urls import path_or_url
from sceneloom.redaction import redacted

_READ_AHEAD = 64 << 10
"""How much of a file behind a URL is fetched at least: records are small, and stand side by side [bytes]."""


class _OpenFile(Protocol):
    """An open file, on disk or behind a URL."""

    def read_at(self, start: int, length: int) -> bytes:
        """Read so many bytes, or as many as there are."""
        ...

    def expect(self, ranges: Iterable[Range]) -> None:
        """Hear what will be read soon."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class FileBytes:
    """A file that is read piece by piece; another process opens it again, if it is still the same file.

    Attributes:
        path: the file; the URL of one, without secrets, as text.
        size: its length [bytes].
    """

    def __init__(self, path: Path | str) -> None:
        """Open the file, or the URL of one.

        Raises:
            DataError: it cannot be opened.
        """
        location = path_or_url(path)
        self.path = redacted(location) if isinstance(location, str) else location
        self._identity: FileIdentity | RemoteIdentity
        try:
            self._identity = (
                RemoteIdentity.of(location) if isinstance(location, str) else FileIdentity.of(location)
            )
        except OSError as error:
            raise DataError(path, "", f"cannot be opened: {error.strerror or error}") from error
        self.size = self._identity.size
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        self._file: _OpenFile | None = None
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
            start: location of the first.
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
                self.path, f"byte {start}", f"{length} bytes wanted; expected a location in the file"
            )
        with self._lock:
            file = self._opened()
            try:
                return file.read_at(start, min(length, max(0, self.size - start)))
            except (OSError, OverflowError, ValueError) as error:
                raise DataError(self.path, f"byte {start}", f"cannot be read: {error}") from error

    def expect(self, ranges: Iterable[Range]) -> None:
        """Report what will be read soon: behind a URL it is fetched side by side, on disk nothing happens.

        Raises:
            DataError: the file cannot be read.
        """
        with self._lock:
            self._opened().expect((max(0, start), min(stop, self.size)) for start, stop in ranges)

    def close(self) -> None:
        """Release the file; nothing can be read afterwards."""
        with self._lock:
            self._closed = True
            if self._file is not None and self._process == os.getpid():
                self._file.close()
            self._file = None

    def _opened(self) -> _OpenFile:
        if self._closed:
            raise DataError(self.path, "", "is closed")
        if self._file is None or self._process != os.getpid():
            # a forked process must not move the location at which the other one reads
            self._identity.check()
            self._file, self._process = _opened(self._identity), os.getpid()
        return self._file


def _opened(identity: FileIdentity | RemoteIdentity) -> _OpenFile:
    if isinstance(identity, RemoteIdentity):
        return _Remote(identity.open())
    with file_faults(identity.path):
        return _Local(open_file(identity.path, buffering=0))


class _Local:
    """A file on disk."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file

    def read_at(self, start: int, length: int) -> bytes:
        self._file.seek(start)
        return _read(self._file, length)

    def expect(self, ranges: Iterable[Range]) -> None:
        """Leave that to the system."""

    def close(self) -> None:
        self._file.close()


class _Remote:
    """A file behind a URL."""

    def __init__(self, file: RangedFile) -> None:
        self._file = file

    def read_at(self, start: int, length: int) -> bytes:
        return self._file.read_near(start, start + length, _READ_AHEAD)

    def expect(self, ranges: Iterable[Range]) -> None:
        self._file.ask_ahead(range_ for range_ in ranges if range_[0] < range_[1])

    def close(self) -> None:
        self._file.close()


def _read(file: BinaryIO, length: int) -> bytes:
    """Read so many bytes, in several steps where the system gives fewer at once."""
    content = file.read(length)
    if len(content) == length:
        return content
    parts = [content]
    while parts[-1] and length > sum(map(len, parts)):
        parts.append(file.read(length - sum(map(len, parts))))
    return b"".join(parts)
