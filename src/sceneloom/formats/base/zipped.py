"""Zipped drives: unpacked within bounds into a temporary folder that is removed when the scene is closed."""

import atexit
import os
import shutil
import stat
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath
from threading import Lock
from zipfile import BadZipFile, LargeZipFile, ZipFile, ZipInfo

from sceneloom.errors import DataError
from sceneloom.formats.base.files import FileIdentity, open_file

MOST_FILES = 1_000_000
"""More files than this are not unpacked: 28 hours of lidar at 10 Hz have as many."""

LARGEST_TOTAL = 1 << 40
"""Nor more bytes than this in all."""

LARGEST_RATIO = 300
"""Nor archives whose files are this many times as large as they are: the lines of a log shrink to a tenth."""

_ALWAYS_FINE = 64 << 20  # bytes that may come out of an archive of any size
_SPARE_BYTES = 64 << 20
_BLOCK = 1 << 20
_LONGEST_NAME = 1000
_DEEPEST = 4

_FAULTS = (BadZipFile, LargeZipFile, OSError, EOFError, RuntimeError, NotImplementedError, ValueError, zlib.error)
"""What reading of an archive that nobody checked may raise; `RuntimeError` is for one with a password."""


@dataclass(frozen=True, slots=True)
class UnpackedFolder:
    """A folder that goes with the scene that was unpacked into it; in other processes it only names the location.

    Attributes:
        folder: what was unpacked.
        top: what is removed.
        owner: id of the process that unpacked it.
        archive: what it was unpacked from.
    """

    folder: Path
    top: Path
    owner: int
    archive: FileIdentity

    def locations(self) -> Iterator[Path]:
        """Where a drive may be: the folder, the only entry of it, and the only one of that, and so on."""
        location = self.folder
        for _ in range(_DEEPEST):
            yield location
            inside = list(islice(location.iterdir(), 2)) if location.is_dir() else []
            if len(inside) != 1:
                return
            location = inside[0]

    def location_of(self, is_one: Callable[[Path], bool], expected: str) -> Path:
        """Find the drive of a format.

        Raises:
            DataError: there is none.
        """
        for location in self.locations():
            if is_one(location):
                return location
        problem = f"a zip archive that holds no such drive; expected {expected}"
        raise DataError(self.archive.name, "", problem)

    def remove(self) -> None:
        """Remove what was unpacked; of copies of this in other processes none does."""
        if os.getpid() == self.owner:
            atexit.unregister(self.remove)
            shutil.rmtree(self.top, ignore_errors=True)


_LOCK = Lock()
_looked_at: list[UnpackedFolder] = []  # at most one, which whoever opens the archive next takes


def look_into(path: Path) -> UnpackedFolder:
    """Unpack an archive to see what it holds, and keep it until another is looked into, or this one is unpacked.

    Raises:
        DataError: as of `unpack`.
    """
    unpacked = unpack(path)
    with _LOCK:
        others, _looked_at[:] = _looked_at[:], [unpacked]
    for other in others:
        other.remove()
    return unpacked


def unpack(path: Path) -> UnpackedFolder:
    """Unpack a zip archive into a folder of its own among the system's temporary files.

    It is removed by `remove`, and when the interpreter ends; where something is wrong, nothing is left.

    Raises:
        DataError: it is damaged, or holds more than the bounds allow; or one of its names leads out of the folder.
    """
    try:
        identity = FileIdentity.of(path)
        with _LOCK:
            found = [one for one in _looked_at if (one.archive, one.owner) == (identity, os.getpid())]
            _looked_at[:] = [one for one in _looked_at if one not in found]
        if found:
            return found[0]
        with open_file(path) as file, ZipFile(file) as archive:
            return _unpack(archive, path, identity)
    except _FAULTS as error:
        problem = "a zip archive that cannot be unpacked, is damaged or cut off"
        raise DataError(path, "", f"{problem}: {error or type(error).__name__}") from error


def _unpack(archive: ZipFile, path: Path, identity: FileIdentity) -> UnpackedFolder:
    members = [member for member in archive.infolist() if not _is_beside(member.filename)]
    _check_bounds(members, path)
    for member in members:
        _check_name(member, path)
    top = Path(tempfile.mkdtemp(prefix="sceneloom-"))
    # messages that name a file in it then name the archive, too
    unpacked = UnpackedFolder(top / path.name, top, os.getpid(), identity)
    atexit.register(unpacked.remove)
    with ExitStack() as stack:
        stack.callback(unpacked.remove)
        total, free = sum(member.file_size for member in members), shutil.disk_usage(top).free
        if total + _SPARE_BYTES > free:
            problem = f"holds {total} bytes, and {top.parent} has {free} free"
            raise DataError(path, "", f"{problem}; unpack it elsewhere and open the folder, or set TMPDIR")
        unpacked.folder.mkdir()
        for member in members:
            if not member.is_dir():
                _write(archive, member, unpacked.folder / member.filename, path)
        stack.pop_all()
    return unpacked


def _is_beside(name: str) -> bool:
    """Whether macOS or Windows put a file beside those of a person."""
    return name.startswith("__MACOSX/") or name.rpartition("/")[2] in {".DS_Store", "Thumbs.db"}


def _check_bounds(members: Sequence[ZipInfo], path: Path) -> None:
    if len(members) > MOST_FILES:
        raise DataError(path, "", f"holds {len(members)} files; expected {MOST_FILES} at most")
    total, packed = sum(member.file_size for member in members), path.stat().st_size
    if total > LARGEST_TOTAL:
        raise DataError(path, "", f"says that it holds {total} bytes; expected {LARGEST_TOTAL} at most")
    if total > max(LARGEST_RATIO * packed, _ALWAYS_FINE):
        problem = f"says that its {packed} bytes hold {total}, {total // max(packed, 1)} times as many"
        raise DataError(path, "", f"{problem}; expected {LARGEST_RATIO} times at most")


def _check_name(member: ZipInfo, path: Path) -> None:
    """Refuse what would be written outside the folder, or is no plain file."""
    name, kind = member.filename, stat.S_IFMT(member.external_attr >> 16)
    windows = PureWindowsPath(name)
    if PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
        problem = "leads out of the folder"
    elif "\0" in member.orig_filename or "\\" in name or len(name) > _LONGEST_NAME:
        problem = f"is no name of a file with at most {_LONGEST_NAME} letters and slashes between folders"
    elif kind not in {0, stat.S_IFREG, stat.S_IFDIR}:
        problem = "is a link or a device"
    elif member.flag_bits & 1:
        problem = "is encrypted"
    else:
        return
    raise DataError(path, repr(name[:_LONGEST_NAME]), f"{problem}; expected plain files in a folder")


def _write(archive: ZipFile, member: ZipInfo, target: Path, path: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        raise DataError(path, repr(member.filename), "stands there twice; expected each file once")
    left = member.file_size
    with archive.open(member) as packed, target.open("xb") as file:
        while block := packed.read(_BLOCK):
            left -= len(block)
            if left < 0:
                problem = f"holds more than the {member.file_size} bytes that it says"
                raise DataError(path, repr(member.filename), problem)
            file.write(block)
    if left:
        raise DataError(path, repr(member.filename), f"holds {left} bytes less than it says")
