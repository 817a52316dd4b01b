"""Paths of files that are fetched when someone opens them: readers of folders take them as they take others."""

import io
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self, cast

import msgspec

from sceneloom.formats.byte_stream import ByteStream
from sceneloom.formats.remote.mirror import HEAD, PIECE, ListedFile, Listing, Mirror

WORKPLACE = "sceneloom-"
"""What the names of the folders begin with that trees are injected in."""

_LISTING = "listing.json"

_WORTHWHILE = 4 << 20
"""Smaller files are fetched whole by those who could do with chunks [bytes]."""

_open: dict[tuple[int, str], Mirror] = {}
"""What processes fetch from: by their number, since a forked one must begin anew, and the tops of trees."""

if TYPE_CHECKING:
    from pathlib import Path as _Path
else:
    # which class paths are of depends on the system
    _Path = type(Path())


class MirroredPath(_Path):
    """A path below a folder that stands for one behind a URL.

    Whatever asks for the position of a file on disk, as `open` does, has it fetched first. Its size and time are known
    without. In other processes it does the same.
    """

    def __fspath__(self) -> str:
        """Have the file fetched, and give its location on disk.

        Raises:
            DataError: it cannot be fetched, or was changed after the folder was opened.
        """
        text = str(self)
        mirror, file = _find(text)
        if mirror is not None and file is not None:
            mirror.bring(file)
        return text

    def open(self, mode: str = "r", buffering: int = -1, *more: Any, **named: Any) -> Any:
        """Open it as any path; who reads a few bytes at its beginning fetches no more than some around them.

        Raises:
            DataError: it cannot be fetched, or was changed after the folder was opened.
        """
        mirror, file = _find(str(self))
        if mode != "rb" or mirror is None or file is None or file.size <= HEAD or mirror.is_near(file):
            return super().open(mode, buffering, *more, **named)
        late = _LateFile(self)
        return late if buffering == 0 else io.BufferedReader(late)

    def in_chunks(self) -> "Chunks | None":
        """Its bytes for those who read here and there; None where it had better be fetched, or is on disk."""
        mirror, file = _find(str(self))
        if mirror is None or file is None or file.size < _WORTHWHILE or mirror.is_near(file):
            return None
        return Chunks(self)

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Look at it; a file that was not fetched yet is as long as it is in the store."""
        found = self._plain().stat(follow_symlinks=follow_symlinks)
        _, file = _find(str(self))
        if file is None or found.st_size == file.size:
            return found
        times = {name: getattr(found, name) for name in ("st_atime_ns", "st_mtime_ns", "st_ctime_ns")}
        return os.stat_result((*found[:6], file.size, *found[7:]), times)

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is there; there are no links."""
        del follow_symlinks
        return self._plain().exists()

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is a file; there are no links."""
        del follow_symlinks
        return self._plain().is_file()

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:
        """Whether it is a folder; there are no links."""
        del follow_symlinks
        return self._plain().is_dir()

    def resolve(self, strict: bool = False) -> Self:  # noqa: FBT001, FBT002 - as all paths have it
        """Follow links above the folder."""
        return type(self)(self._plain().resolve(strict))

    def _plain(self) -> Path:
        return Path(str(self))


class Chunks:
    """The bytes of a file of a mirror, fetched as they are looked at: whole once much of it was."""

    def __init__(self, path: MirroredPath) -> None:
        """Nothing is fetched yet."""
        self.path = path

    def __len__(self) -> int:
        return self._found()[1].size

    def __getitem__(self, part: slice) -> bytes:
        mirror, file = self._found()
        start, stop, _ = part.indices(file.size)
        if mirror.is_near(file) or mirror.read_much(file):
            with open(self.path, "rb") as whole:  # noqa: PTH123 - which has it fetched
                whole.seek(start)
                return whole.read(max(stop - start, 0))
        if stop <= HEAD:
            return mirror.head(file)[start:stop]
        first = start // PIECE
        chunks = [mirror.piece(file, number) for number in range(first, -(-stop // PIECE))]
        return b"".join(chunks)[start - first * PIECE : stop - first * PIECE] if start < stop else b""

    def __call__(self) -> BinaryIO:
        """Open them as a file."""
        return cast("BinaryIO", io.BufferedReader(ByteStream(self), PIECE))

    def _found(self) -> tuple[Mirror, ListedFile]:
        mirror, file = _find(str(self.path))
        if mirror is None or file is None:
            raise FileNotFoundError(f"{self.path}: the drive is closed")
        return mirror, file


class _LateFile(ByteStream):
    """An open file that is not on disk yet: it is fetched when more than its first bytes are read."""

    def __init__(self, path: MirroredPath) -> None:
        super().__init__(Chunks(path))
        self.name = str(path)
        self._path = path
        self._on_disk: io.FileIO | None = None

    def fileno(self) -> int:
        """Have all of it on disk: who asks will map it, or hand it to the system."""
        return self._fetched().fileno()

    def readinto(self, buffer: Any) -> int:
        if self._on_disk is None and self.location + len(buffer) <= HEAD:
            return super().readinto(buffer)
        count = self._fetched().readinto(buffer)
        self.location += count
        return count

    def readall(self) -> bytes:
        content = self._fetched().readall()
        self.location += len(content)
        return content

    def close(self) -> None:
        if self._on_disk is not None:
            self._on_disk.close()
        super().close()

    def _fetched(self) -> io.FileIO:
        if self._on_disk is None:
            self._on_disk = io.FileIO(self._path)
        self._on_disk.seek(self.location)
        return self._on_disk


def plant(listing: Listing) -> MirroredPath:
    """Make the tree of a folder behind a URL, and give its top."""
    listing.plant()
    Path(listing.top).with_name(_LISTING).write_bytes(msgspec.json.encode(listing))
    _open[os.getpid(), listing.top] = Mirror(listing)
    return MirroredPath(listing.top)


def mirror_of(path: Path) -> Mirror | None:
    """What a path is fetched by, in this process."""
    return _find(str(path))[0]


def uproot(workplace: Path) -> None:
    """Fetch nothing more to what is below a folder."""
    for process, top in list(_open):
        if process == os.getpid() and Path(top).parent == workplace:
            _open.pop((process, top)).close()


def _find(text: str) -> tuple[Mirror | None, ListedFile | None]:
    """What fetches a path, and the file that it means, if any."""
    mirror = _opened(text) or _injected(Path(text).parents)
    if mirror is None:
        return None, None
    name = text[len(mirror.listing.top) + 1 :]
    return mirror, mirror.file(name.replace(os.sep, "/"))


def _opened(text: str) -> Mirror | None:
    process = os.getpid()
    for (owner, top), mirror in list(_open.items()):
        if owner == process and (text == top or text.startswith(top + os.sep)):
            return mirror
    return None


def _injected(above: Iterable[Path]) -> Mirror | None:
    """Begin to fetch to a tree that another process has injected."""
    workplace = next((folder for folder in above if folder.name.startswith(WORKPLACE)), None)
    if workplace is None:
        return None
    try:
        listing = msgspec.json.decode((workplace / _LISTING).read_bytes(), type=Listing)
    except OSError:
        return None
    return _open.setdefault((os.getpid(), listing.top), Mirror(listing))
