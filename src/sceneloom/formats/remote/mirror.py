"""Files and folders behind URLs as a tree of local files that are fetched when they are opened."""

import atexit
import io
import os
import re
import shutil
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from tempfile import gettempdir, mkdtemp, mkstemp
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO, Self, cast
from urllib.parse import unquote, urlsplit

import msgspec

from sceneloom.errors import DataError, redacted
from sceneloom.formats.base.files import ByteStream
from sceneloom.formats.remote.stores import (
    SIDE_BY_SIDE,
    Facts,
    RangedFile,
    RemoteIdentity,
    Store,
    faults,
    open_store,
    patiently,
)
from sceneloom.formats.remote.uploads import MARKER

if TYPE_CHECKING:
    _AnyPath = Path
else:
    _AnyPath = type(Path())

_LEFT_FREE = 1 << 30  # what stays free on the disk [bytes]

_MARKS = "used"
_DRAFTS = "drafts"

_AHEAD = 8
"""How many files of a folder are fetched before they are asked for, where its files are read one after the other."""

_AHEAD_BYTES = 256 << 20  # how much of them at most: larger files come when they are asked for [bytes]

HEAD = 64 << 10
"""So much is fetched of a file of which only the first bytes are read [bytes]."""

PIECE = 256 << 10
"""Length of the chunks that a file comes in where it is not fetched whole [bytes]."""

_REMEMBERED = 32 << 20  # so much of chunks and beginnings is cached: all formats look at the same files [bytes]

_MUCH = 0.25
"""A file of which more than this share was read in chunks is fetched whole: further chunks would each be waited for."""

_STAY = 4 * SIDE_BY_SIDE
"""So many recently used files stay, however large they are: other processes may be about to open them."""


class _ListedFile(msgspec.Struct, frozen=True, array_like=True):
    """A file as it was when its folder was listed."""

    name: str  # below the folder, with `/`
    size: int  # [bytes]
    version: str | None  # what the store says that changes with the content

    @property
    def folder(self) -> str:
        """The name of the folder that it is in."""
        return self.name.rpartition("/")[0]


class _Listing(msgspec.Struct, frozen=True, kw_only=True):
    """A folder behind a URL as it was when it was opened, and where its files go."""

    url: str
    root: str  # its path in the store
    top: str  # its path on disk; the folder above it is ours, too
    largest: int  # how much of it is on disk at most [bytes]
    listed_ns: int  # stands for the time of change of all its files
    files: tuple[_ListedFile, ...]  # all, by folders, and in each in the order in which people number them


class _Mirror:
    """What one process fetches of a folder behind a URL; other processes may fetch to the same tree."""

    def __init__(self, listing: _Listing) -> None:
        """Nothing is fetched yet."""
        self.listing = listing
        self._numbers = {file.name: number for number, file in enumerate(listing.files)}
        self._lock = Lock()
        self._store: Store | None = None
        self._thread_pool: ThreadPoolExecutor | None = None
        self._coming: dict[str, Future[None]] = {}
        self._last: dict[str, int] = {}
        self._parts: OrderedDict[tuple[str, int, int], bytes] = OrderedDict()
        self._read: Counter[str] = Counter()
        self._ranged: dict[str, RangedFile] = {}
        self._since_counted = listing.largest
        self._closed = False

    def file(self, name: str) -> _ListedFile | None:
        """The file of that name; None where there is none."""
        number = self._numbers.get(name)
        return None if number is None else self.listing.files[number]

    def bring(self, file: _ListedFile) -> None:
        """Have a file on disk; those after it are fetched, too, where one after the other is asked for."""
        coming = self._fetching(file)
        for later in self._later(file):
            self._fetching(later)
        if coming is not None:
            coming.result()
        self._mark(file)

    def is_near(self, file: _ListedFile) -> bool:
        """Whether a file is on disk, or on its way."""
        return file.name in self._coming or self._is_here(file)

    def head(self, file: _ListedFile) -> bytes:
        """Fetch the first bytes of a file, `HEAD` of them unless it is shorter."""
        with closing(self._ranges_of(file)) as ranged:
            return self._part(file, ranged, 0, HEAD, checked=False)

    def read_much(self, file: _ListedFile) -> bool:
        """Whether so many chunks of a file were fetched that all of it had better be."""
        return self._read[file.name] > _MUCH * file.size

    def piece(self, file: _ListedFile, number: int) -> bytes:
        """Fetch a piece of a file, `PIECE` bytes but for the last one; those of a moment ago are remembered."""
        with self._lock:
            ranged = self._ranged.setdefault(file.name, self._ranges_of(file))
        content = self._part(file, ranged, number * PIECE, (number + 1) * PIECE, checked=True)
        if self._closed:
            ranged.close()
        return content

    def _ranges_of(self, file: _ListedFile) -> RangedFile:
        """The file by ranges; its store is that of the folder, and the address stands in messages alone."""
        url = f"{self.listing.url.partition('?')[0].rstrip('/')}/{file.name}"
        with faults(url, ""):
            return RangedFile(RemoteIdentity(url, file.size, file.version), self._there(file))

    def _part(self, file: _ListedFile, ranged: RangedFile, start: int, stop: int, *, checked: bool) -> bytes:
        """Fetch some bytes of a file; those of a moment ago are remembered."""
        key = file.name, start, stop
        with self._lock:
            known = self._parts.get(key)
        if known is not None:
            return known
        content = ranged.ask(start, min(stop, file.size))
        if checked:
            with faults(self.listing.url, redacted(file.name)):
                self._check(file, self._there(file))
        with self._lock:
            self._read[file.name] += len(content) if checked else 0
            self._parts[key] = content
            while sum(map(len, self._parts.values())) > _REMEMBERED:
                self._parts.popitem(last=False)
        return content

    def gather(self, files: Iterable[_ListedFile]) -> None:
        """Have files on disk, side by side, right after they were listed."""
        for coming in [self._fetching(file, fresh=True) for file in files]:
            if coming is not None:
                coming.result()

    def on_disk(self) -> int:
        """How much of the folder is on disk now [bytes]."""
        return sum(file.size for file in self._marked())

    def close(self) -> None:
        """Fetch nothing more."""
        with self._lock:
            self._closed = True
            thread_pool, self._thread_pool = self._thread_pool, None
            opened, self._ranged = self._ranged, {}
        for ranged in opened.values():
            ranged.close()
        if thread_pool is not None:
            thread_pool.shutdown(cancel_futures=True)

    def _fetching(self, file: _ListedFile, *, fresh: bool = False) -> "Future[None] | None":
        """What fetches a file, begun now if nothing does; None where the file is on disk."""
        with self._lock:
            coming = self._coming.get(file.name)
            if coming is not None or self._is_here(file):
                return coming
            if self._thread_pool is None:
                self._thread_pool = ThreadPoolExecutor(SIDE_BY_SIDE, thread_name_prefix="sceneloom-fetch")
            coming = self._coming[file.name] = self._thread_pool.submit(self._fetch, file, fresh=fresh)
        coming.add_done_callback(lambda _: self._coming.pop(file.name, None))
        return coming

    def _is_here(self, file: _ListedFile) -> bool:
        with suppress(FileNotFoundError):
            return self._path_of(file).stat().st_size == file.size
        return True  # the tree is gone; who opens the file will be reported

    def _later(self, file: _ListedFile) -> list[_ListedFile]:
        """The files that are asked for next, if this one came soon after another one of its folder."""
        number = self._numbers[file.name]
        with self._lock:
            last, self._last[file.folder] = self._last.get(file.folder), number
        if last is None or number - last != 1:
            return []
        found, size = [], 0
        for later in self.listing.files[number + 1 : number + 1 + _AHEAD]:
            size += later.size
            if later.folder != file.folder or size > min(_AHEAD_BYTES, self.listing.largest // 2):
                break
            found.append(later)
        return found

    def _fetch(self, file: _ListedFile, *, fresh: bool) -> None:
        with faults(self.listing.url, redacted(file.name)):
            there = self._there(file)
            self._make_room(file.size)
            descriptor, name = mkstemp(dir=self._beside(_DRAFTS))
            os.close(descriptor)
            draft = Path(name)
            try:
                patiently(lambda: there.fetch(draft, file.size))
                if not fresh:
                    self._check(file, there)
                os.utime(draft, ns=(self.listing.listed_ns, self.listing.listed_ns))
                draft.replace(self._path_of(file))
            finally:
                draft.unlink(missing_ok=True)
        self._mark(file)

    def _there(self, file: _ListedFile) -> Store:
        """Where a file is in the store."""
        if self._store is None:
            self._store = open_store(self.listing.url)
        return self._store.at(f"{self.listing.root}/{file.name}")

    def _check(self, file: _ListedFile, there: Store) -> None:
        """Refuse a file that is not the one that was listed; asked afterwards, this holds for the bytes that came."""
        now = patiently(there.facts)
        if (now.size, now.version) != (file.size, file.version):
            problem = "was changed after it was opened; open the scene anew"
            raise DataError(redacted(self.listing.url), file.name, problem)

    def _make_room(self, size: int) -> None:
        """Let go of the files that were used longest ago, where there is too much on disk."""
        with self._lock:
            free = shutil.disk_usage(self._beside(_DRAFTS)).free - _LEFT_FREE
            self._since_counted += size
            if self._since_counted < self.listing.largest // 16 and free > size:
                return
            marked = self._marked()
            held = sum(file.size for file in marked) + size
            too_much = max(held - self.listing.largest * 15 // 16, size - free)
            for file in marked[:-_STAY]:
                if too_much <= 0:
                    break
                too_much -= file.size
                self._let_go(file)
            self._since_counted = 0

    def _let_go(self, file: _ListedFile) -> None:
        """Make a file empty again; who has it open or mapped keeps what is in it."""
        draft = self._beside(_DRAFTS) / f"empty-{os.getpid()}"
        _make_empty(str(draft), self.listing.listed_ns)
        draft.replace(self._path_of(file))
        self._mark_of(file).unlink(missing_ok=True)

    def _mark(self, file: _ListedFile) -> None:
        """Note down for all processes that a file is on disk, and was used now."""
        with suppress(FileNotFoundError):  # closed meanwhile
            self._mark_of(file).touch()

    def _marked(self) -> list[_ListedFile]:
        """The files on disk; those first that were used longest ago."""
        with os.scandir(self._beside(_MARKS)) as marks:
            found = sorted((mark.stat().st_mtime_ns, int(mark.name)) for mark in marks)
        return [self.listing.files[number] for _, number in found]

    def _path_of(self, file: _ListedFile) -> Path:
        return Path(self.listing.top, file.name)

    def _mark_of(self, file: _ListedFile) -> Path:
        return self._beside(_MARKS) / str(self._numbers[file.name])

    def _beside(self, name: str) -> Path:
        return Path(self.listing.top).with_name(name)


def _make_empty(path: str, time_ns: int) -> None:
    with open(path, "wb"):  # noqa: PTH123 - of many thousands
        pass
    os.utime(path, ns=(time_ns, time_ns))


_WORKPLACE = "sceneloom-"  # what the names of the folders begin with that trees are made in

_LISTING = "listing.json"

_WORTHWHILE = 4 << 20  # smaller files are fetched whole by those who could do with chunks [bytes]

_open: dict[tuple[int, str], _Mirror] = {}
"""Mirrors by process, since a forked one must begin anew, and by the top of the tree."""


class MirroredPath(_AnyPath):
    """A path below a folder that stands for one behind a URL.

    Whatever asks for the position of a file on disk, as `open` does, has it fetched first. Its size and time are known
    without. In other processes it does the same.
    """

    def __fspath__(self) -> str:
        """Have the file fetched, and give its location on disk."""
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
    """The bytes of a file of a mirror, fetched as they are read; the whole file once much of it was."""

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

    def _found(self) -> tuple[_Mirror, _ListedFile]:
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


def _make_tree(listing: _Listing) -> _Mirror:
    """Make the tree of a folder behind a URL: all files are empty, so one that is not fetched is never other data."""
    top = Path(listing.top)
    for name in (_MARKS, _DRAFTS):
        top.with_name(name).mkdir()
    for folder in {file.folder for file in listing.files}:
        Path(top, folder).mkdir(parents=True, exist_ok=True)
    for file in listing.files:
        _make_empty(f"{top}/{file.name}", listing.listed_ns)
    top.with_name(_LISTING).write_bytes(msgspec.json.encode(listing))
    mirror = _open[os.getpid(), listing.top] = _Mirror(listing)
    return mirror


def mirror_of(path: Path) -> _Mirror | None:
    """What a path is fetched by, in this process."""
    return _find(str(path))[0]


def _find(text: str) -> tuple[_Mirror | None, _ListedFile | None]:
    """What fetches a path, and the file that it means, if any."""
    process = os.getpid()
    opened = (
        mirror
        for (owner, top), mirror in list(_open.items())
        if owner == process and (text == top or text.startswith(top + os.sep))
    )
    mirror = next(opened, None) or _of_other_process(Path(text))
    if mirror is None:
        return None, None
    name = text[len(mirror.listing.top) + 1 :]
    return mirror, mirror.file(name.replace(os.sep, "/"))


def _of_other_process(path: Path) -> _Mirror | None:
    """Begin to fetch to a tree that another process has made."""
    workplace = next((folder for folder in path.parents if folder.name.startswith(_WORKPLACE)), None)
    if workplace is None:
        return None
    try:
        listing = msgspec.json.decode((workplace / _LISTING).read_bytes(), type=_Listing)
    except OSError:
        return None
    return _open.setdefault((os.getpid(), listing.top), _Mirror(listing))


_LARGEST = 64 << 30  # more of a drive is not on disk at one time [bytes]

_TABLES = (".json", ".jsonl", ".txt", ".csv", ".toml", ".yaml", ".yml", ".xml", ".md")

_SMALL = 4 << 20  # tables of this size are fetched at once, side by side: readers open them one after the other [bytes]

_NUMBERS = re.compile(r"(\D*)(\d*)", re.ASCII)


@dataclass(frozen=True, slots=True)
class Fetched:
    """What was fetched, or will be when it is opened.

    Attributes:
        path: where it is on disk.
        files: how many files.
        size: of all of them [bytes].
        remove: takes it away again; does nothing in other processes.
    """

    path: Path
    files: int
    size: int
    remove: Callable[[], None]

    def reported(self) -> str:
        """Report what is where, for people."""
        mirror = mirror_of(self.path)
        if mirror is None:
            return f"{self.size / 1e6:.1f} MB were fetched to {self.path}; they go when the scene is closed"
        return (
            f"{mirror.on_disk() / 1e6:.1f} of {self.size / 1e6:.1f} MB in {self.files} files were fetched to "
            f"{self.path}; others come when they are read, and all go when the scene is closed"
        )


def find_urls(pattern: str) -> list[str]:
    """Find what fits a pattern such as `s3://bucket/2025-*/drive.sfs` in a store, by their names.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(pattern, ""):
        return patiently(lambda: open_store(pattern).fitting())


def names_below(url: str) -> list[str]:
    """Names of the files and folders just below a location in a store; none where it is not there.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(url, ""):
        return patiently(lambda: open_store(url).names())


def remote_contents(url: str) -> list[tuple[str, int, str]] | None:
    """What a store says of a file, or of all files of a folder: name below it, size [bytes], mark of the content.

    Names bear no secrets, so that they are the same when an address is signed anew.

    Returns:
        None where nothing is there, or where of a file that is not known.

    Raises:
        DataError: the store cannot be read.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(url, ""):
        found = patiently(lambda: open_store(url).contents())
    known = [
        (redacted(facts.path), facts.size, facts.version)
        for facts in found
        if facts.size is not None and facts.version is not None
    ]
    return known if known and len(known) == len(found) else None


def fetch(url: str, *, largest: int = _LARGEST) -> Fetched:
    """Fetch a file into the system's temporary folder (`TMPDIR`), or prepare to fetch what is opened of a folder.

    Of a folder all files are listed, and small tables fetched. Others are fetched when they are opened by the path that
    is given here, or one that is made of it.

    Args:
        url: the address.
        largest: how much of it is on disk at most [bytes]; of a folder the files go that were used longest ago.

    Raises:
        DataError: it is not there, cannot be read, or a file is larger than what may be fetched or fits on the disk.
        MissingExtraError: what reads such addresses is not installed.
    """
    with faults(url, ""):
        store = open_store(url)
        top = patiently(store.facts)
        found = patiently(lambda: list(store.walk())) if top.is_folder else [top]
    files = _listed(url, store, found) if top.is_folder else ()
    most = min(largest, shutil.disk_usage(gettempdir()).free - _LEFT_FREE)
    size = max((facts.size or 0 for facts in found), default=0)
    if size > most:
        problem = (
            f"a file of {size / 1e9:.1f} GB is more than the {max(most, 0) / 1e9:.1f} GB that may be fetched; "
            "set TMPDIR to a folder of a larger disk"
        )
        raise DataError(url, "", problem)
    workplace = Path(mkdtemp(prefix=_WORKPLACE))
    remove = partial(_remove, workplace, os.getpid())
    atexit.register(remove)
    try:
        root = workplace / (Path(unquote(urlsplit(url).path)).name or "drive")
        if not top.is_folder:
            with faults(url, ""):
                patiently(lambda: store.at(top.path).fetch(root, top.size))
            return Fetched(root, 1, top.size or 0, remove)
        listing = _Listing(
            url=url,
            root=store.path.rstrip("/"),
            top=str(root),
            largest=most,
            listed_ns=time.time_ns() // 10**9 * 10**9,
            files=files,
        )
        mirror = _make_tree(listing)
        tables = [file for file in files if file.size <= _SMALL and file.name.lower().endswith(_TABLES)]
        if sum(file.size for file in tables) < most // 2:
            mirror.gather(tables)
    except BaseException:
        remove()
        raise
    return Fetched(MirroredPath(root), len(files), sum(file.size for file in files), remove)


def _listed(url: str, store: Store, found: list[Facts]) -> tuple[_ListedFile, ...]:
    """The files by their names below the location."""
    root = store.path.rstrip("/") + "/"
    files = []
    for facts in found:
        name = facts.path.removeprefix(root)
        parts = PurePosixPath(name)
        if parts.is_absolute() or ".." in parts.parts or "\\" in name:
            raise DataError(url, name, "leads out of its folder; expected names of files below it")
        if facts.is_folder or name == MARKER:
            continue
        if facts.size is None:
            raise DataError(url, name, "the store does not state how long it is; fetch the folder first")
        files.append(_ListedFile(name, facts.size, facts.version))
    if not files:
        raise DataError(url, "", "is a folder without files")
    # by folders, and 2 before 10
    return tuple(
        sorted(files, key=lambda file: (file.folder, [(int(n or -1), text) for text, n in _NUMBERS.findall(file.name)]))
    )


def _remove(workplace: Path, process: int) -> None:
    """Fetch nothing more to a tree, and take it away; does nothing in other processes."""
    if os.getpid() == process:
        for owner, top in list(_open):
            if owner == process and Path(top).parent == workplace:
                _open.pop((owner, top)).close()
        shutil.rmtree(workplace, ignore_errors=True)
