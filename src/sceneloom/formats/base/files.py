"""Input files: paths and URLs, bounded reads of regular files, streams of bytes.

Identity and fingerprints of files that are opened again.
"""

import errno
import io
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, Protocol, Self
from urllib.parse import unquote, urlsplit

from sceneloom.errors import DataError, MissingExtraError, redacted
from sceneloom.lazy import imported

_URL = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+(::[a-zA-Z][a-zA-Z0-9+.-]+)*://")
"""A scheme of two letters or more, which no drive has, or several, as fsspec chains them."""


def is_url(path: object) -> bool:
    """Whether text is an address such as `https://host/drive.sfs` or `s3://bucket/drive.sfs`."""
    return isinstance(path, str) and _URL.match(path) is not None


def path_or_url(text: str | Path) -> Path | str:
    """Give the path that text names, `file://` resolved, or the text itself where it is a URL."""
    if isinstance(text, Path):
        return text
    if not is_url(text):
        return Path(text)
    parts = urlsplit(str(text))
    return Path(unquote(parts.path)) if parts.scheme.lower() == "file" else str(text)


LARGEST_READ = 1 << 32
"""Longest file that is read whole: a sweep, an image, a table, a text [bytes]. Videos, bags, `.sfs` files and the
lines of recordings are read piece by piece, and may be of any length."""

LARGEST_RATIO = 100
"""How many times as long as they are compressed bytes may become; sweeps and tables become 2 to 20 times as long."""

LARGEST_SETTINGS = 1 << 26
"""Longest file of settings, lists, certificates or tokens: what people write by hand [bytes]."""

ALWAYS_UNPACKED = 1 << 26
"""Up to so many bytes anything compressed may become, however short it is: constant values compress very well."""

MOST_PIXELS = 1 << 27
"""Most pixels of an image, by its head, before it is decoded: 16384 x 8192."""

LARGEST_HOLES = 1000
"""How many times as long as its stored bytes a file of more than `LARGEST_READ` bytes may be: who reads on to the end
of a longer one finds nothing for hours. Files of which next to nothing is stated to be stored are elsewhere, on a tape
or in a store, and pass."""

_PAGE = 4096

_KINDS = {
    stat.S_IFIFO: "is a named pipe",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
    stat.S_IFSOCK: "is a socket",
}

_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


def check_regular(path: Path) -> None:
    """Refuse what is no regular file, for libraries that open files by their paths.

    Raises:
        OSError: it is a folder, a pipe, a device or a socket, is long and nearly all of it holes, or cannot be looked
            at.
    """
    status = path.stat()
    _check_mode(path, status.st_mode)
    stored = (getattr(status, "st_blocks", None) or 0) * 512  # remote files report none
    if status.st_size > LARGEST_READ and _PAGE <= stored < status.st_size / LARGEST_HOLES:
        problem = f"is {status.st_size} bytes long, of which {stored} are stored; expected a file without such holes"
        raise OSError(errno.EINVAL, problem, str(path))


def why_no_file(path: Path) -> str:
    """Why there is no file to be read at a path: "no such file", or what is there in its location."""
    try:
        check_regular(path)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return "no such file"
    except OSError as error:
        return error.strerror or str(error)
    return "no such file"


def open_file(path: Path, *, buffering: int = -1) -> BinaryIO:
    """Open a file of a drive for reading bytes.

    Raises:
        OSError: `check_regular` refuses it, or it cannot be opened.
    """
    check_regular(path)
    if type(path) is not type(Path()):
        # files of remote folders open in their own trajectory, and are regular ones
        return path.open("rb", buffering)

    def opened(name: str, _: int) -> int:
        descriptor = os.open(name, _FLAGS)
        try:
            # what has taken the file's location in between is not waited for
            _check_mode(path, os.fstat(descriptor).st_mode)
        except OSError:
            os.close(descriptor)
            raise
        if hasattr(os, "set_blocking") and os.name == "posix":
            os.set_blocking(descriptor, True)
        return descriptor

    return open(path, "rb", buffering, opener=opened)


def _check_mode(path: Path, mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    kind = _KINDS.get(stat.S_IFMT(mode), "is no regular file")
    raise OSError(errno.EINVAL, f"{kind}; expected a regular file", str(path))


@contextmanager
def file_faults(path: Path) -> Iterator[None]:
    """Turn what the operating system says of a file into a DataError."""
    try:
        yield
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise DataError(path, "", "does not fit into the memory") from error


def read_bytes(path: Path) -> bytes:
    """Read a whole file.

    Raises:
        DataError: it cannot be read, is no regular file, or is longer than `LARGEST_READ`.
    """
    with file_faults(path), open_file(path) as file:
        check_length(path)
        return file.read()


def read_settings(path: Path) -> bytes:
    """Read a whole file that a person wrote: settings, a list of drives, a certificate, a token.

    Raises:
        DataError: it cannot be read, is no regular file, or is longer than `LARGEST_SETTINGS`.
    """
    with file_faults(path), open_file(path) as file:
        found = file.read(LARGEST_SETTINGS + 1)
    if len(found) > LARGEST_SETTINGS:
        raise DataError(path, "", f"{path.stat().st_size} bytes; expected {LARGEST_SETTINGS} at most")
    return found


def check_length(path: Path) -> int:
    """Give the length of a file that is to be read whole [bytes].

    Raises:
        DataError: it is longer than `LARGEST_READ`.
    """
    size = path.stat().st_size
    if size > LARGEST_READ:
        raise DataError(path, "", f"{size} bytes; expected {LARGEST_READ} at most in a file that is read whole")
    return size


def most_unpacked(packed: int) -> int:
    """How many bytes so many compressed ones may become [bytes]."""
    return max(ALWAYS_UNPACKED, LARGEST_RATIO * packed)


def check_unpacked(path: object, location: str, packed: int, unpacked: int) -> None:
    """Refuse compressed bytes that declare to become far more than data of sensors do.

    Args:
        path: the file, for the message.
        location: where in it, for the message.
        packed: how many bytes they are [bytes].
        unpacked: how many they declare to become [bytes].

    Raises:
        DataError: these are more than `most_unpacked` allows.
    """
    most = most_unpacked(packed)
    if unpacked > most:
        raise DataError(path, location, f"{packed} bytes that unpack to {unpacked}; expected {most} at most")


def check_pixels(path: object, location: str, width: int, height: int) -> None:
    """Refuse an image that is larger than those of cameras, before it is decoded.

    Raises:
        DataError: it has more than `MOST_PIXELS` pixels.
    """
    if width * height > MOST_PIXELS:
        raise DataError(path, location, f"{width}x{height} pixels; expected {MOST_PIXELS} pixels at most")


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


_LOCK = Lock()


class _SharedFile:
    """The bytes of an open file, which several readers share."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        with _LOCK:
            self._size = file.seek(0, io.SEEK_END)

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        with _LOCK:
            self._file.seek(part.start)
            return self._file.read(part.stop - part.start)


class FileView(ByteStream):
    """A file over another one, which stays open when this is closed."""

    def __init__(self, file: BinaryIO) -> None:
        """Begin at the first byte."""
        super().__init__(_SharedFile(file))


@dataclass(frozen=True, slots=True)
class FileIdentity:
    """A file as it was when it was opened.

    Attributes:
        name: what messages call it.
        path: where it is, from the root, so that processes in other folders find it.
        size: its length [bytes].
        modified_ns: when it was last written to [ns].
    """

    name: str
    path: Path
    size: int
    modified_ns: int

    @classmethod
    def of(cls, path: Path, *, descriptor: int | None = None) -> Self:
        """Look at a file, or at an open descriptor of it.

        Raises:
            OSError: it cannot be looked at.
        """
        status = path.stat() if descriptor is None else os.fstat(descriptor)
        return cls(str(path), path.absolute(), status.st_size, status.st_mtime_ns)

    def check(self) -> None:
        """Refuse a file that is not the one that was opened: what was read of it before would not fit.

        Raises:
            DataError: it was changed, replaced or removed.
        """
        try:
            now = self.path.stat()
        except OSError as error:
            problem = f"cannot be opened again: {error.strerror or error}"
            raise DataError(self.name, "", problem) from error
        if (now.st_size, now.st_mtime_ns) != (self.size, self.modified_ns):
            problem = (
                f"was changed after it was opened: it has {now.st_size} bytes and had {self.size}, "
                f"written {(now.st_mtime_ns - self.modified_ns) / 1e9:+.3f} s apart; open the scene anew"
            )
            raise DataError(self.name, "", problem)


def fingerprint(location: str) -> str:
    """Report a file or folder from what it was at another time.

    Behind a URL the mark that the server gives a content counts instead of the time.

    Args:
        location: its path or URL.

    Returns:
        "" where it is not there or refused, or where the server gives no marks: nobody knows then whether it changed.

    Raises:
        DataError: the server of a URL does not answer, which may pass.
    """
    reported = blake2b(digest_size=16)
    try:
        for name, size, mark in _remote_files(location) if is_url(location) else _files(Path(location)):
            reported.update(f"{name}\0{size}\0{mark}\n".encode("utf-8", "surrogateescape"))
    except OSError:
        return ""
    return reported.hexdigest()


_REMOTE_CONTENTS = "sceneloom.formats.remote.mirror:remote_contents"
"""What lists a folder behind a URL; imported where one is asked for."""


def _remote_files(url: str) -> list[tuple[str, int, str]]:
    try:
        found: list[tuple[str, int, str]] | None = imported(_REMOTE_CONTENTS)(url)
    except (DataError, MissingExtraError) as error:
        if error.passing:
            raise
        found = None
    if found is None:
        raise FileNotFoundError(redacted(url))
    return found


def _files(path: Path) -> Iterator[tuple[str, int, int]]:
    """The name, size and time of a file, or of all files below a folder."""
    found = [(path.name, path)]
    if path.is_dir():
        found = []
        for folder, inner, files in os.walk(path):
            inner.sort()
            found += [(os.path.relpath(Path(folder, name), path), Path(folder, name)) for name in sorted(files)]
    for name, entry in found:
        status = entry.stat()
        yield name, status.st_size, status.st_mtime_ns


def size_on_disk(path: Path | str) -> int | None:
    """Bytes of a file, or of all files below a folder; None for what is behind a URL."""
    if isinstance(path, str):
        return None
    if path.is_file():
        return path.stat().st_size
    return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())


def processors() -> int:
    """Those that the process may run on, where the system says so, else those of the machine; at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
