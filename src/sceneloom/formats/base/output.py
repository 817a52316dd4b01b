"""Outputs: written beside the target and renamed, so that each is there whole or not at all.

File names made from ids.
"""

import ctypes
import errno
import gc
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote
from weakref import WeakSet
from zlib import crc32

from sceneloom.errors import OutputError
from sceneloom.scene.types import Identifier

try:
    import fcntl
except ImportError:  # no POSIX system
    fcntl = None  # type: ignore[assignment]

_WRITE_FAULTS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}


class Source:
    """A file or folder that is being read, as long as this object lives: it is never replaced by an output."""

    __slots__ = ("__weakref__", "path")

    def __init__(self, path: Path) -> None:
        """Take note of a path."""
        self.path = path.absolute()
        _SOURCES.add(self)

    def release(self) -> None:
        """Report that it is not being read any more."""
        _SOURCES.discard(self)

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process, which only reads, without taking note of it there."""
        return (_source_elsewhere, (self.path,))


def _source_elsewhere(path: Path) -> Source:
    source = Source(path)
    source.release()
    return source


_SOURCES: WeakSet[Source] = WeakSet()


@dataclass(frozen=True, slots=True)
class FolderKind:
    """What a writer of folders makes: a folder with anything else in it is somebody's own, and is not replaced.

    Attributes:
        what: what such a folder is called.
        files: the files that may be in it: paths of which each part between slashes is a regular expression. What the
            groups called `one` match is the same in all files of a folder: the name of the only drive in it.
        marker: one of `files` that is in each such folder; None where any file is enough.
    """

    what: str
    files: tuple[str, ...]
    marker: str | None = None

    def check(self, folder: Path) -> None:
        """Refuse a folder that is not of this kind; an empty one is.

        Raises:
            OutputError: naming what is in it, or is not.
        """
        rows = [[re.compile(part) for part in row.split("/")] for row in self.files]
        marker = None if self.marker is None else [re.compile(part) for part in self.marker.split("/")]
        has_files, has_marker = False, marker is None
        drives: set[str] = set()
        for entry, parts in _entries(folder):
            is_folder = entry.is_dir(follow_symlinks=False)
            fitting = [row for row in rows if _fits(parts, row, inner=is_folder)]
            if entry.is_symlink() or not fitting:
                raise OutputError(
                    f"{folder}: holds {'/'.join(parts)!r}, so it is no {self.what} that could be replaced; choose "
                    "another name, or move it away first"
                )
            has_files |= not is_folder
            drives |= set() if is_folder else _drive_names(parts, fitting[0])
            if len(drives) > 1:
                raise OutputError(
                    f"{folder}: holds {' and '.join(sorted(drives))}, and would hold one drive only; choose another "
                    "name, or move the others away first"
                )
            has_marker |= marker is not None and not is_folder and _fits(parts, marker, inner=False)
        if has_files and not has_marker:
            raise OutputError(
                f"{folder}: holds no {self.marker}, so it is no {self.what} that could be replaced; choose another "
                "name, or move it away first"
            )


def _entries(folder: Path, above: tuple[str, ...] = ()) -> Iterator[tuple[os.DirEntry[str], tuple[str, ...]]]:
    """All entries below a folder, a folder before what is in it."""
    with os.scandir(folder) as found:
        entries = sorted(found, key=lambda entry: entry.name)
    for entry in entries:
        parts = (*above, entry.name)
        yield entry, parts
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(Path(entry.path), parts)


def _fits(parts: tuple[str, ...], row: list[re.Pattern[str]], *, inner: bool) -> bool:
    """Whether a path is one of a row's files, or, where `inner`, a folder above one."""
    has_length = len(parts) < len(row) if inner else len(parts) == len(row)
    return has_length and all(pattern.fullmatch(part) for pattern, part in zip(row, parts, strict=False))


def _drive_names(parts: tuple[str, ...], row: list[re.Pattern[str]]) -> set[str]:
    found = [pattern.fullmatch(part) for pattern, part in zip(row, parts, strict=True) if pattern.groupindex]
    return {one["one"] for one in found if one is not None}


def check_output(target: Path, *, overwrite: bool) -> None:
    """Refuse a target that exists, is being read or whose folder is missing; put right what killed runs left of it.

    Raises:
        OutputError: naming what to do instead.
    """
    _recover(target)
    try:
        there = target.exists()
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror}") from error
    if there and not overwrite:
        raise OutputError(f"{target}: exists already; choose another name, or use `--overwrite`")
    if there and not (target.is_file() or target.is_dir()):
        raise OutputError(f"{target}: is neither a file nor a folder and is left alone; choose another name")
    if target.is_file():
        _check_not_read(target)
    if not target.parent.is_dir():
        if target.parent.exists():
            raise OutputError(f"{target}: {target.parent} is a file; expected a folder")
        raise OutputError(f"{target}: the folder {target.parent} does not exist; make it first")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"{target}: the folder {target.parent} is not writable")


def _check_not_read(target: Path, *, whole: bool = False) -> None:
    """Refuse to replace what is being read; `whole`: with all that is in a folder."""
    if _read_by(target, whole=whole) is not None:
        gc.collect()  # scenes that nobody has any more read nothing
        path = _read_by(target, whole=whole)
        if path is not None:
            how = (
                "is read"
                if _same(path, target)
                else f"holds or lies in {path}, which is read"
                if whole
                else f"is a file in {path}, which is read"
            )
            raise OutputError(f"{target}: {how} by this very run, and is left alone; choose another name")


def _read_by(target: Path, *, whole: bool) -> Path | None:
    """What is being read and would be replaced: any file of a folder that is read counts as read."""
    location = Path(os.path.realpath(target))
    for source in list(_SOURCES):
        read = Path(os.path.realpath(source.path))
        if read == location or _same(read, location):
            return source.path
        if (whole and location in read.parents) or (read in location.parents and read.is_dir()):
            return source.path
    return None


def _same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:
        return False


@contextmanager
def replacing(target: Path, *, overwrite: bool, folder: FolderKind | None = None) -> Iterator[Path]:
    """Give a path beside the target to write to; on success it takes the target's location, on failure it goes.

    Args:
        target: where the output shall be in the end.
        overwrite: whether something there may be replaced.
        folder: give an empty folder instead of a file; only one of that kind is replaced.

    Raises:
        OutputError: the target exists, cannot be written, is being read, or holds something else.
    """
    _check_replaceable(target, folder, overwrite=overwrite)
    with _workplace(target) as workplace:
        draft = workplace / _FILES / target.name
        if folder is not None:
            draft.mkdir()
        yield draft
        _check_still_free(target, overwrite=overwrite)
        if not overwrite:
            _rename_to_free(draft, target)
        elif folder is None:
            draft.replace(target)
        else:
            _check_folder(target, folder)
            if not os.path.lexists(target):
                draft.rename(target)
            elif not exchange(draft, target):
                target.rename(workplace / _REPLACED)  # where a next run finds the old one
                draft.rename(target)


@contextmanager
def replacing_together(targets: Sequence[Path], *, overwrite: bool) -> Iterator[tuple[Path, ...]]:
    """Give paths to write files of one folder to that belong together: all of them take their locations, or none does.

    Raises:
        OutputError: a target exists, cannot be written or is being read.
    """
    for target in targets:
        _check_replaceable(target, None, overwrite=overwrite)
    with _workplace(targets[0]) as workplace:
        yield tuple(workplace / _FILES / target.name for target in targets)
        _move_all(workplace, targets[0].parent, overwrite=overwrite)


def _check_replaceable(target: Path, folder: FolderKind | None, *, overwrite: bool) -> None:
    check_output(target, overwrite=overwrite)
    if folder is None and target.is_dir():
        raise OutputError(f"{target}: is a folder; expected a file or a new name")
    if folder is not None and target.is_file():
        raise OutputError(f"{target}: is a file; expected a folder or a new name")
    if folder is not None:
        _check_folder(target, folder)


def _check_folder(target: Path, kind: FolderKind) -> None:
    if not target.is_dir():
        return
    _check_not_read(target, whole=True)
    try:
        kind.check(target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be looked through, and is left alone: {error.strerror}") from error


def _check_still_free(location: Path, *, overwrite: bool) -> None:
    """Look again before the output takes its location: another program may have been quicker."""
    if not overwrite and location.exists():
        raise _taken(location)


def _taken(location: Path) -> OutputError:
    return OutputError(f"{location}: was made by another program meanwhile; choose another name, or use `--overwrite`")


def _rename_to_free(draft: Path, target: Path) -> None:
    """Rename, and replace nothing, not even what appears at this very instant where the system can see to that."""
    fault = _renameat2(draft, target, _FREE_ONLY)
    if fault == errno.EEXIST:
        raise _taken(target)
    if fault:
        draft.rename(target)


def exchange(one: Path, other: Path) -> bool:
    """Exchange two names at once; false, and do nothing, where the system cannot."""
    return not _renameat2(one, other, _EXCHANGE)


_FREE_ONLY, _EXCHANGE, _HERE = 1, 2, -100


def _renameat2(old: Path, new: Path, flags: int) -> int:
    """Rename as Linux can: give 0 where it was done, else the number of the error."""
    rename = _system_call()
    if rename is None:
        return errno.ENOSYS
    done = rename(_HERE, os.fsencode(old), _HERE, os.fsencode(new), flags) == 0
    return 0 if done else ctypes.get_errno()


@cache
def _system_call() -> Callable[..., int] | None:
    if not sys.platform.startswith("linux"):
        return None
    call: Any = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is not None:
        call.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    return cast("Callable[..., int] | None", call)


@contextmanager
def filling(folder: Path, *, overwrite: bool) -> Iterator[Path]:
    """Give an empty folder beside `folder` to write files to; on success they move into it, on failure they go.

    Files that were in the folder before stay, but for those of the same name.

    Raises:
        OutputError: the folder has something in it and `overwrite` is not stated, or it cannot be written.
    """
    _recover(folder)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; expected a folder or a new name")
    check_output(folder, overwrite=overwrite or (folder.is_dir() and not any(folder.iterdir())))
    with _workplace(folder) as workplace:
        yield workplace / _FILES
        _move_all(workplace, folder, overwrite=overwrite)


@contextmanager
def on_trial(target: Path, *, overwrite: bool) -> Iterator[tuple[Path, Callable[[], bool]]]:
    """Give a path to write an output to that may still be refused, and what puts it in the target's location.

    The path has the target's name in a folder beside it; what else is written into that folder goes with it. The
    function says false, and does nothing, where the target is a folder: only its format knows whether that may be
    replaced, and has to write to it.

    Raises:
        OutputError: the target exists, or cannot be written.
    """
    check_output(target, overwrite=overwrite)
    with _workplace(target) as workplace:

        def accept() -> bool:
            drafts = sorted((workplace / _FILES).iterdir())
            if any((target.parent / draft.name).is_dir() for draft in drafts):
                return False
            _move_all(workplace, target.parent, overwrite=overwrite)
            return True

        yield workplace / _FILES / target.name, accept


def _move_all(workplace: Path, folder: Path, *, overwrite: bool) -> None:
    """Move all that was written into a folder: first all of it is known to be whole, so that a next run can go on."""
    drafts = workplace / _FILES
    if not any(drafts.iterdir()):
        return
    if not os.path.lexists(folder):
        _rename_to_free(drafts, folder)
        return
    for draft, location in _moves(drafts, folder):
        if location.exists():
            _check_still_free(location, overwrite=overwrite)
            if draft.is_dir() or location.is_dir():
                raise OutputError(f"{location}: is in the way; expected a {'folder' if draft.is_dir() else 'file'}")
            _check_not_read(location)
    (workplace / _LISTING).write_text(os.path.relpath(folder, workplace), "utf-8", "surrogateescape")
    (workplace / _LISTING).rename(workplace / _READY)
    for draft, location in _moves(drafts, folder):
        draft.replace(location)
    (workplace / _READY).unlink()


def _moves(drafts: Path, folder: Path) -> Iterator[tuple[Path, Path]]:
    """What is moved, and to where: files, and folders that are not there yet."""
    for draft in sorted(drafts.iterdir()):
        location = folder / draft.name
        if draft.is_dir() and location.is_dir():
            yield from _moves(draft, location)
        else:
            yield draft, location


def _go_on(workplace: Path) -> None:
    """Move what is still to be moved of a process that was stopped; what was written since then stays."""
    ready = workplace / _READY
    since = ready.stat().st_mtime
    folder = Path(os.path.normpath(workplace / ready.read_text("utf-8", "surrogateescape")))
    for draft, location in _moves(workplace / _FILES, folder):
        if not location.exists() or location.stat().st_mtime <= since:
            draft.replace(location)
    ready.unlink()


_FILES, _REPLACED, _READY, _LISTING, _LOCK = "files", "replaced", "ready", "listing", "lock"

_MOST = 8  # how many processes write to one target at once at the most

_ALL_OF_IT = {_FILES, _REPLACED, _READY, _LISTING, _LOCK}

_IDLE_S = 3600.0
"""For how long a process of another machine, whose lock may not be seen here, has written nothing if it is dead."""


def _workplaces(target: Path) -> list[Path]:
    return [target.with_name(f".{target.name}.sceneloom" + (f"-{number}" if number else "")) for number in range(_MOST)]


@contextmanager
def _workplace(target: Path) -> Iterator[Path]:
    """Give a hidden folder beside the target, and take it away again whatever happens."""
    try:
        workplace, lock = _own_workplace(target)
    except OSError as error:
        raise OutputError(f"{target}: cannot be written: {error.strerror}") from error
    try:
        yield workplace
    except OSError as error:
        if error.errno in _WRITE_FAULTS or str(error.filename or "").startswith(str(workplace)):
            raise OutputError(f"{target}: cannot be written: {error.strerror or error}") from error
        raise
    finally:
        try:
            _clear(workplace, target)
        finally:
            os.close(lock)


def _own_workplace(target: Path) -> tuple[Path, int]:
    """Make a workplace that no other process has, and lock it."""
    if not target.name:
        raise OutputError(f"{target}: is no name of an output; choose another one")
    for workplace in _workplaces(target):
        with suppress(FileExistsError, FileNotFoundError):  # somebody has it, or has just taken it for a dead one's
            workplace.mkdir()
            lock = os.open(workplace / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                if _locks(lock) is not False and _is_at(lock, workplace / _LOCK):
                    os.write(lock, _machine())
                    (workplace / _FILES).mkdir()
                    return workplace, lock
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)
    names = f".{target.name}.sceneloom*"
    raise OutputError(
        f"{target}: {_MOST} other programs are writing it; if none is, delete the folders {names} beside it"
    )


def _locks(lock: int) -> bool | None:
    """Lock a file until it is closed or the process ends, however that is; None where that cannot be done."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _is_at(lock: int, path: Path) -> bool:
    """Whether an open file is still the one of its name."""
    try:
        return os.path.samestat(os.fstat(lock), path.lstat())
    except FileNotFoundError:
        return False


@cache
def _machine() -> bytes:
    """What reports a running system from all others; containers on one share it, and see each other's locks."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_bytes().strip()
    except OSError:
        import platform

        return platform.node().encode()


def _recover(target: Path) -> None:
    """Put right, and take away, what dead processes left of an output."""
    for workplace in _workplaces(target) if target.name else ():
        if not os.path.lexists(workplace):
            continue
        try:
            if not {path.name for path in workplace.iterdir()} <= _ALL_OF_IT:
                continue  # somebody else's folder
            lock = os.open(workplace / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            continue  # not ours to look into, or gone
        try:
            if _locks(lock) and _is_at(lock, workplace / _LOCK) and _is_dead(workplace, os.read(lock, 100)):
                _clear(workplace, target)
        finally:
            os.close(lock)


def _is_dead(workplace: Path, machine: bytes) -> bool:
    """Whether a lock that could be had was given up by its process: on shared folders, others may not be seen."""
    try:
        if machine in (b"", _machine()):
            return True
        latest = max(path.lstat().st_mtime for path in (workplace, *workplace.rglob("*")))
    except OSError:
        return False
    return time.time() - latest > _IDLE_S


def _clear(workplace: Path, target: Path) -> None:
    """Complete what was begun in a workplace, and take it away."""
    try:
        if os.path.lexists(workplace / _REPLACED) and not os.path.lexists(target):
            (workplace / _REPLACED).rename(target)
        if (workplace / _READY).exists():
            _go_on(workplace)
    except OSError as error:
        raise OutputError(
            f"{target}: what an interrupted run wrote is in {workplace} and cannot be put in its location: "
            f"{error.strerror or error}; move it by hand, or delete that folder"
        ) from error
    shutil.rmtree(workplace, ignore_errors=True)


_LONGEST = 120  # longer ids are cut: most file systems allow 255 bytes for a name

_EMPTY = "%"  # what stands for an empty id: no other id is written so


def file_stem(identifier: Identifier) -> str:
    """Rotate an id into a part of a file name; what a file name cannot hold is written as %XX."""
    stem = quote(str(identifier), safe=" ()+,=@").replace("~", "%7E")
    stem = f"%2E{stem[1:]}" if stem.startswith(".") else stem or _EMPTY
    return stem if len(stem) <= _LONGEST else f"{stem[:_LONGEST]}~{crc32(stem.encode()):08x}"


def file_stems(identifiers: Iterable[Identifier]) -> list[str]:
    """Rotate ids into parts of file names that differ from each other, in upper or lower case, too."""
    stems: list[str] = []
    taken: dict[str, int] = {}
    for stem in map(file_stem, identifiers):
        number = taken[stem.casefold()] = taken.get(stem.casefold(), 0) + 1
        stems.append(stem if number == 1 else f"{stem}~{number}")
    return stems
