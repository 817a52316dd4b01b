"""Zipped recordings: unpacked within bounds into a temporary folder that is removed when the scene is closed."""

import atexit
import os
import shutil
import stat
import tempfile
import zlib
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from zipfile import BadZipFile, LargeZipFile, ZipFile, ZipInfo

from sceneloom.errors import DataError
from sceneloom.formats.base.files import open_file

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
_BESIDE = ("__MACOSX/", ".DS_Store")

_FAULTS = (BadZipFile, LargeZipFile, OSError, EOFError, RuntimeError, NotImplementedError, ValueError, zlib.error)
"""What reading of an archive that nobody checked may raise; `RuntimeError` is for one with a password."""


@dataclass(frozen=True, slots=True)
class UnpackedFolder:
    """A folder that goes with the scene that was unpacked into it; in other processes it only names the location.

    Attributes:
        folder: what holds the `data.jsonl`.
        top: what is removed.
        owner: id of the process that unpacked it.
    """

    folder: Path
    top: Path
    owner: int

    def remove(self) -> None:
        """Remove what was unpacked; of copies of this in other processes none does."""
        if os.getpid() == self.owner:
            atexit.unregister(self.remove)
            shutil.rmtree(self.top, ignore_errors=True)


def _is_zip(path: Path) -> bool:
    """Whether a file begins as zip archives do."""
    try:
        with open_file(path) as file:
            return file.read(4) == b"PK\x03\x04"
    except OSError:
        return False


def damage_of_zip(path: Path) -> str | None:
    """Why a zip archive cannot be read; None where it can."""
    try:
        with open_file(path) as file, ZipFile(file):
            return None
    except _FAULTS as error:
        return f"a zip archive that is damaged or cut off: {error or type(error).__name__}"


def holds_recording(path: Path, data_file: str) -> bool:
    """Whether a file is a zip archive of a recording.

    Args:
        path: any file.
        data_file: the file that a recording's folder has.
    """
    if not _is_zip(path):
        return False
    try:
        with open_file(path) as file, ZipFile(file) as archive:
            return root_of(archive.namelist(), data_file) is not None
    except _FAULTS:
        return False


def root_of(names: Sequence[str], data_file: str) -> str | None:
    """Find what stands before the names of a recording's files: "", or its single top folder with a slash.

    Returns:
        None where there is no such file at the root or in a single top folder.
    """
    ours = [name for name in names if not name.startswith(_BESIDE)]
    if data_file in ours:
        return ""
    tops = {name.partition("/")[0] for name in ours}
    top = next(iter(tops), "")
    return f"{top}/" if len(tops) == 1 and f"{top}/{data_file}" in ours else None


def unpack(path: Path, data_file: str) -> UnpackedFolder | None:
    """Unpack a zipped recording into a folder of its own among the system's temporary files.

    It is removed by `remove`, and when the interpreter ends; where something is wrong, nothing is left.

    Args:
        path: any file or folder.
        data_file: the file that a recording's folder has.

    Returns:
        None where it is no zip archive.

    Raises:
        DataError: it is damaged, holds no recording, or more than the bounds allow; or one of its
            names leads out of the folder.
    """
    if not _is_zip(path):
        return None
    try:
        with open_file(path) as file, ZipFile(file) as archive:
            return _unpack(archive, path, data_file)
    except _FAULTS as error:
        raise DataError(path, "", f"cannot be unpacked: {error or type(error).__name__}") from error


def _unpack(archive: ZipFile, path: Path, data_file: str) -> UnpackedFolder:
    root = root_of(archive.namelist(), data_file)
    if root is None:
        problem = f"holds no {data_file}, neither at its root nor in a single top folder"
        raise DataError(path, "", f"{problem}; expected a zipped recording")
    members = [member for member in archive.infolist() if not member.filename.startswith(_BESIDE)]
    _check_bounds(members, path)
    for member in members:
        _check_name(member, path)
    top = Path(tempfile.mkdtemp(prefix="sceneloom-"))
    # messages that name a file in it then name the archive, too
    unpacked = UnpackedFolder(top / path.name, top, os.getpid())
    atexit.register(unpacked.remove)
    with ExitStack() as stack:
        stack.callback(unpacked.remove)
        total, free = sum(member.file_size for member in members), shutil.disk_usage(top).free
        if total + _SPARE_BYTES > free:
            problem = f"holds {total} bytes, and {top.parent} has {free} free"
            raise DataError(path, "", f"{problem}; unpack it elsewhere and open the folder, or set TMPDIR")
        for member in members:
            if not member.is_dir():
                _write(archive, member, unpacked.folder / member.filename.removeprefix(root), path)
        stack.pop_all()
    return unpacked


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
    raise DataError(path, repr(name[:_LONGEST_NAME]), f"{problem}; expected plain files in the recording's folder")


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
