"""A folder behind a URL as a tree of files on disk that are fetched when they are asked for, ahead of who reads on."""

import os
import shutil
from collections import Counter, OrderedDict
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from tempfile import mkstemp
from threading import Lock

import msgspec

from sceneloom.errors import DataError
from sceneloom.formats.remote.faults import CutShortError, faults
from sceneloom.formats.remote.patience import patiently
from sceneloom.formats.remote.ranged import SIDE_BY_SIDE, RangedFile, RemoteIdentity
from sceneloom.formats.remote.stores import Store, open_store
from sceneloom.redaction import redacted

LEFT_FREE = 1 << 30
"""What stays free on the disk [bytes]."""

_MARKS = "used"
_DRAFTS = "drafts"

_AHEAD = 8
"""How many files of a folder are fetched before they are asked for, where its files are read one after the other."""

_AHEAD_BYTES = 256 << 20
"""How much of them at most: larger files come when they are asked for [bytes]."""

HEAD = 64 << 10
"""So much is fetched of a file of which only the first bytes are looked at [bytes]."""

PIECE = 256 << 10
"""Length of the chunks that a file comes in where it is not fetched whole [bytes]."""

_REMEMBERED = 32 << 20
"""So much of chunks and beginnings is remembered: all formats look at the same files [bytes]."""

_MUCH = 0.25
"""Of a file of which this share was read in chunks all is fetched: who goes on would wait for each of the others."""

_STAY = 4 * SIDE_BY_SIDE
"""So many files stay that were used last, however large they are: others may be about to open them."""


class ListedFile(msgspec.Struct, frozen=True, array_like=True):
    """A file as it was when its folder was listed.

    Attributes:
        name: below the folder, with `/`.
        size: its length [bytes].
        version: what the store says that changes with the content; None where it says nothing.
    """

    name: str
    size: int
    version: str | None

    @property
    def folder(self) -> str:
        """The name of the folder that it is in."""
        return self.name.rpartition("/")[0]


class Listing(msgspec.Struct, frozen=True, kw_only=True):
    """A folder behind a URL as it was when it was opened, and where its files go.

    Attributes:
        url: its address.
        root: its path in the store.
        top: its path on disk; the folder above it is ours, too.
        largest: how much of it is on disk at most [bytes].
        listed_ns: when it was listed, which stands for the time of change of all its files [ns].
        files: all of them, by folders, and in each in the order in which people number them.
    """

    url: str
    root: str
    top: str
    largest: int
    listed_ns: int
    files: tuple[ListedFile, ...]

    def plant(self) -> None:
        """Make the tree: all files are there, and empty.

        Who opens one without having it fetched finds too little in it, never other data.
        """
        for folder in (_MARKS, _DRAFTS):
            Path(self.top).with_name(folder).mkdir()
        for folder in {file.folder for file in self.files}:
            Path(self.top, folder).mkdir(parents=True, exist_ok=True)
        for file in self.files:
            _make_empty(f"{self.top}/{file.name}", self.listed_ns)


class Mirror:
    """What one process fetches of a folder behind a URL; other processes may fetch to the same tree.

    Attributes:
        listing: the folder.
    """

    def __init__(self, listing: Listing) -> None:
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

    def file(self, name: str) -> ListedFile | None:
        """The file of that name; None where there is none."""
        number = self._numbers.get(name)
        return None if number is None else self.listing.files[number]

    def bring(self, file: ListedFile) -> None:
        """Have a file on disk; those after it are fetched, too, where one after the other is asked for.

        Raises:
            DataError: it cannot be read, or was changed after the folder was opened.
        """
        coming = self._fetching(file)
        for later in self._later(file):
            self._fetching(later)
        if coming is not None:
            coming.result()
        self._mark(file)

    def is_near(self, file: ListedFile) -> bool:
        """Whether a file is on disk, or on its way."""
        return file.name in self._coming or self._is_here(file)

    def head(self, file: ListedFile) -> bytes:
        """Fetch the first bytes of a file, `HEAD` of them unless it is shorter.

        Raises:
            DataError: they cannot be read.
        """
        with closing(self._ranges_of(file)) as ranged:
            return self._part(file, ranged, 0, HEAD, checked=False)

    def read_much(self, file: ListedFile) -> bool:
        """Whether so many chunks of a file were fetched that all of it had better be."""
        return self._read[file.name] > _MUCH * file.size

    def piece(self, file: ListedFile, number: int) -> bytes:
        """Fetch a piece of a file, `PIECE` bytes but for the last one; those of a moment ago are remembered.

        Raises:
            DataError: it cannot be read, or the file was changed after the folder was opened.
        """
        with self._lock:
            ranged = self._ranged.setdefault(file.name, self._ranges_of(file))
        content = self._part(file, ranged, number * PIECE, (number + 1) * PIECE, checked=True)
        if self._closed:
            ranged.close()
        return content

    def _ranges_of(self, file: ListedFile) -> RangedFile:
        """The file by ranges; its store is that of the folder, and the address stands in messages alone."""
        url = f"{self.listing.url.partition('?')[0].rstrip('/')}/{file.name}"
        with faults(url, ""):
            return RangedFile(RemoteIdentity(url, file.size, file.version), self._there(file))

    def _part(self, file: ListedFile, ranged: RangedFile, start: int, stop: int, *, checked: bool) -> bytes:
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

    def gather(self, files: Iterable[ListedFile]) -> None:
        """Have files on disk, side by side, right after they were listed.

        Raises:
            DataError: one cannot be read.
        """
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

    def _fetching(self, file: ListedFile, *, fresh: bool = False) -> "Future[None] | None":
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

    def _is_here(self, file: ListedFile) -> bool:
        with suppress(FileNotFoundError):
            return self._path_of(file).stat().st_size == file.size
        return True  # the tree is gone; who opens the file will be reported

    def _later(self, file: ListedFile) -> list[ListedFile]:
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

    def _fetch(self, file: ListedFile, *, fresh: bool) -> None:
        with faults(self.listing.url, redacted(file.name)):
            there = self._there(file)
            self._make_room(file.size)
            descriptor, name = mkstemp(dir=self._beside(_DRAFTS))
            os.close(descriptor)
            draft = Path(name)
            try:
                patiently(lambda: fetch_whole(there, file.size, draft))
                if not fresh:
                    self._check(file, there)
                os.utime(draft, ns=(self.listing.listed_ns, self.listing.listed_ns))
                draft.replace(self._path_of(file))
            finally:
                draft.unlink(missing_ok=True)
        self._mark(file)

    def _there(self, file: ListedFile) -> Store:
        """Where a file is in the store."""
        if self._store is None:
            self._store = open_store(self.listing.url)
        return self._store.at(f"{self.listing.root}/{file.name}")

    def _check(self, file: ListedFile, there: Store) -> None:
        """Refuse a file that is not the one that was listed; asked afterwards, this holds for the bytes that came."""
        now = patiently(there.facts)
        if (now.size, now.version) != (file.size, file.version):
            problem = "was changed after it was opened; open the scene anew"
            raise DataError(redacted(self.listing.url), file.name, problem)

    def _make_room(self, size: int) -> None:
        """Let go of the files that were used longest ago, where there is too much on disk."""
        with self._lock:
            free = shutil.disk_usage(self._beside(_DRAFTS)).free - LEFT_FREE
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

    def _let_go(self, file: ListedFile) -> None:
        """Make a file empty again; who has it open or mapped keeps what is in it."""
        draft = self._beside(_DRAFTS) / f"empty-{os.getpid()}"
        _make_empty(str(draft), self.listing.listed_ns)
        draft.replace(self._path_of(file))
        self._mark_of(file).unlink(missing_ok=True)

    def _mark(self, file: ListedFile) -> None:
        """Note down for all processes that a file is on disk, and was used now."""
        with suppress(FileNotFoundError):  # closed meanwhile
            self._mark_of(file).touch()

    def _marked(self) -> list[ListedFile]:
        """The files on disk; those first that were used longest ago."""
        with os.scandir(self._beside(_MARKS)) as marks:
            found = sorted((mark.stat().st_mtime_ns, int(mark.name)) for mark in marks)
        return [self.listing.files[number] for _, number in found]

    def _path_of(self, file: ListedFile) -> Path:
        return Path(self.listing.top, file.name)

    def _mark_of(self, file: ListedFile) -> Path:
        return self._beside(_MARKS) / str(self._numbers[file.name])

    def _beside(self, name: str) -> Path:
        return Path(self.listing.top).with_name(name)


def fetch_whole(location: Store, size: int | None, target: Path) -> None:
    """Fetch a file once.

    Raises:
        CutShortError: another number of bytes came.
        Exception: whatever the back end raises.
    """
    location.get(target)
    found = target.stat().st_size
    if size is not None and found != size:
        raise CutShortError(f"the server gave {found} of {size} bytes")


def _make_empty(path: str, time_ns: int) -> None:
    with open(path, "wb"):  # noqa: PTH123 - of many thousands
        pass
    os.utime(path, ns=(time_ns, time_ns))
