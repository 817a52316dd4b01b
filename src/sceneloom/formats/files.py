"""Files of a drive: opened only where they are regular files, and never taken for larger than their bytes state.

Every reader opens its files with `open_file` or `read_bytes`, or asks `check_regular` before a library opens one by its
path: a named pipe would be waited for without end, a device gives bytes without end. What a file declares is checked
against the bytes that are there before memory is asked for; what is compressed may declare more, within
`most_unpacked`. The constants of this module are looked up at each call, so a program that has larger files may raise
them: `sceneloom.formats.files.LARGEST_RATIO = 1000`.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from sceneloom.errors import DataError

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
    """Rotate what the operating system says of a file into a DataError."""
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
        raise DataError(
            path, "", f"{size} bytes; expected {LARGEST_READ} at most in a file that is read whole"
        )
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
