"""Stores behind URLs by fsspec: errors without secrets, retries up to a deadline, files read by ranges."""

import errno
import random
import time
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from threading import Lock
from typing import Any, Self, TypeVar, cast

from sceneloom.errors import DataError, MissingExtraError, SceneloomError, how_to_install, redacted

_EXTRA = f"files behind URLs need {how_to_install('cloud')}"

_PASSING_STATUS = {408, 425, 429, 500, 502, 503, 504}
"""Source: RFC 9110, clauses 15.5.9 and 15.6; RFC 6585, clause 4; RFC 8470, clause 5.2."""

_PASSING_ERRNO = {errno.EBUSY, errno.EAGAIN, errno.ECONNRESET, errno.ECONNREFUSED, errno.EPIPE, errno.ETIMEDOUT}

_PASSING_KINDS = (ConnectionError, TimeoutError, InterruptedError, BlockingIOError)

_PASSING_NAMES = frozenset(
    {
        *("ClientConnectionError", "ClientPayloadError"),  # aiohttp
        *("HTTPClientError", "IncompleteReadError", "ResponseStreamingError"),  # botocore
        *("ServiceRequestError", "ServiceResponseError", "IncompleteReadError"),  # azure
        *("TransportError", "ServerDisconnectedError"),  # google
    }
)
"""Classes of libraries that are not imported for their errors alone."""


class _CutShortError(ConnectionError):
    """A server gave fewer bytes than it was asked for."""


class _NoRangesError(ValueError):
    """A server gives all of a file for a part of it."""


def _may_pass(error: BaseException | None) -> bool:
    """Whether what a back end raised can be gone at the next try: a busy or slow server, a connection that was cut."""
    while error is not None:
        if isinstance(error, SceneloomError):
            return error.passing
        if _passes(error):
            return True
        error = error.__cause__
    return False


def _passes(error: BaseException) -> bool:
    status = _status(error)
    if status is not None:
        return status in _PASSING_STATUS
    if isinstance(error, _PASSING_KINDS) or _PASSING_NAMES & {kind.__name__ for kind in type(error).__mro__}:
        return True
    return isinstance(error, OSError) and error.errno in _PASSING_ERRNO


def _status(error: BaseException) -> int | None:
    """What a server answered, by the names that libraries have for it."""
    for name in ("status", "status_code", "code"):
        value = getattr(error, name, None)
        if isinstance(value, int | str) and str(value).isdigit() and 100 <= int(value) < 600:
            return int(value)
    answer = getattr(error, "response", None)
    reported = answer.get("ResponseMetadata", {}).get("HTTPStatusCode") if isinstance(answer, dict) else None
    return reported if isinstance(reported, int) else None


@contextmanager
def faults(url: str, location: str, *, doing: str = "read") -> Iterator[None]:
    """Turn whatever a back end raises into errors of ours, which quote it without secrets.

    Raises:
        DataError: it failed; `passing` says whether another try may do.
        MissingExtraError: what reads such addresses is not installed.
    """
    ours: SceneloomError | None = None
    try:
        yield
    except SceneloomError:
        raise
    except Exception as error:  # noqa: BLE001 - back ends raise what the libraries of their protocols raise
        ours = _ours(error, redacted(url), location, doing)
    if ours is None:
        return
    try:
        raise ours
    finally:
        # what the back end raised is left behind: it has addresses with all their secrets, and handlers of errors
        # that look around, and processes that an error is sent to, would find them
        ours.__cause__ = ours.__context__ = None


def _ours(error: Exception, url: str, location: str, doing: str) -> SceneloomError:
    if isinstance(error, ImportError):
        return MissingExtraError(f"{url}: {error}; {_EXTRA}")
    found = DataError(url, location, _problem(error, doing))
    if isinstance(error, _NoRangesError):
        found = DataError(url, "", "its server answers no ranges (`Range`); download the file first")
    found.passing = _may_pass(error)
    return found


def _problem(error: Exception, doing: str) -> str:
    if isinstance(error, FileNotFoundError):
        # back ends report it, too, where no server answers
        return f"cannot be found{f': {redacted(error.__cause__)}' if error.__cause__ else ''}"
    if isinstance(error, _CutShortError):
        return redacted(error)
    return f"cannot be {'read' if doing == 'read' else doing}: {redacted(error) or type(error).__name__}"


_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class Patience:
    """How long something is tried.

    Attributes:
        tries: how often at most.
        wait: before the second try [s]; each later wait is twice as long.
        longest_wait: of one wait [s].
        deadline: after which nothing is tried again [s].
        answer: how long one answer may take [s].
    """

    tries: int = 5
    wait: float = 0.25
    longest_wait: float = 8.0
    deadline: float = 120.0
    answer: float = 30.0

    def pause(self, number: int) -> float:
        """The wait after try `number`, from 0 [s]; uneven, so that many workers do not come back all at once."""
        whole = min(self.wait * 2.0**number, self.longest_wait)
        return whole * random.uniform(0.5, 1.0)  # noqa: S311 - nothing secret hangs on it


_PATIENCE = Patience()  # how long back ends are tried


def patiently(action: Callable[[], _Result], patience: Patience | None = None) -> _Result:
    """Do something, again where it fails with what may pass; the last error is raised as it is."""
    rule = patience or _PATIENCE
    begun = time.monotonic()
    for number in range(rule.tries):
        try:
            return action()
        except Exception as error:
            pause = rule.pause(number)
            late = time.monotonic() - begun + pause > rule.deadline
            if number + 1 == rule.tries or late or not _may_pass(error):
                raise
        time.sleep(pause)
    raise AssertionError("unreachable: the last try returns or raises")


_PART = 16 << 20  # length of the parts that a file is sent in; stores take 10,000 of them, which makes 160 GB [bytes]

_VERSIONS = (
    *("ETag", "etag", "Content-MD5", "Digest"),
    *("mtime", "LastModified", "Last-Modified", "last_modified", "updated", "created"),
)
"""What back ends call the mark of a content, best first."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What a store says of a file or folder.

    Attributes:
        path: its name in the store.
        size: its length [bytes]; None where the store does not state.
        version: what changes with the content; None where the store says nothing.
        is_folder: whether it is one.
    """

    path: str
    size: int | None
    version: str | None
    is_folder: bool


@dataclass(frozen=True, slots=True)
class Store:
    """A location in a store.

    Attributes:
        url: its address.
        files: the fsspec file system.
        path: the location's name there.
    """

    url: str
    files: Any
    path: str

    def facts(self) -> Facts:
        """Look at the location; what was known of it before does not count."""
        if hasattr(self.files, "invalidate_cache"):
            self.files.invalidate_cache()
        return _facts(self.files.info(self.path))

    def fitting(self) -> list[str]:
        """Addresses of what fits the location as a pattern, by their names."""
        scheme = self.url.partition("://")[0]
        return [f"{scheme}://{path.lstrip('/')}" for path in sorted(self.files.glob(self.path))]

    def handle(self, size: int) -> "Handle":
        """Open the file for reading by ranges."""
        protocol = self.files.protocol
        known = {"size": size} if "http" in ((protocol,) if isinstance(protocol, str) else protocol) else {}
        return Handle(self, self.files.open(self.path, "rb", cache_type="none", **known))

    def contents(self) -> list[Facts]:
        """What is reported of the file, or of all files of the folder; nothing where it is not there."""
        try:
            top = self.facts()
        except FileNotFoundError as error:
            if _may_pass(error):
                raise
            return []
        return list(self.walk()) if top.is_folder else [top]

    def walk(self) -> Iterator[Facts]:
        """All files below the location, by their names."""
        found = self.files.find(self.path, detail=True)
        yield from (_facts(found[name]) for name in sorted(found))

    def names(self) -> list[str]:
        """Names of the files and folders just below the location; none where it is not there."""
        self.files.invalidate_cache()
        try:
            found = self.files.ls(self.path, detail=False)
        except FileNotFoundError:
            return []
        return [path.rstrip("/").rpartition("/")[2] for path in found]

    def put_first(self, content: bytes) -> bytes:
        """Put a small file there unless there is one; give what is there then."""
        self.files.invalidate_cache()
        if self.files.exists(self.path):  # not all stores refuse to put one twice
            return cast("bytes", self.files.cat_file(self.path))
        try:
            self.files.pipe_file(self.path, content, mode="create")
        except Exception:
            # back ends have many names for the refusal
            self.files.invalidate_cache()
            if not self.files.exists(self.path):
                raise
        self.files.invalidate_cache()
        return cast("bytes", self.files.cat_file(self.path))

    def get(self, target: Path) -> None:
        """Fetch the whole file."""
        self.files.get_file(self.path, str(target))

    def fetch(self, target: Path, size: int | None) -> None:
        """Fetch the whole file, of so many bytes where that is known, once."""
        self.get(target)
        found = target.stat().st_size
        if size is not None and found != size:
            raise _CutShortError(f"the server gave {found} of {size} bytes")

    def put(self, source: Path | None) -> None:
        """Put a file there, piece by piece; it appears whole once the last piece is there.

        Args:
            source: the file; None puts an empty one.
        """
        file = self.files.open(self.path, "wb", block_size=_PART, autocommit=False)
        try:
            if source is not None:
                with source.open("rb") as content:
                    while piece := content.read(_PART):
                        file.write(piece)
            file.close()
            file.commit()
        except BaseException:
            _abandon(file)
            raise
        self.files.invalidate_cache()

    def remove(self) -> None:
        """Take a file away; one that is not there is none."""
        with suppress(FileNotFoundError):
            self.files.rm_file(self.path)
        self.files.invalidate_cache()

    def at(self, path: str) -> "Store":
        """Another location of the same store."""
        return Store(self.url, self.files, path)


class Handle:
    """A connection to one file, which one thread at a time reads from.

    Not by `cat_ranges`: where a server gives all of a file for a part of it, that loads all. For two ranges of 1,000
    bytes of 300 MB it held 1.2 GB; this refuses after 3 MB.
    """

    def __init__(self, store: Store, file: Any) -> None:
        self._store, self._file = store, file

    def read(self, start: int, stop: int, *, seconds: float) -> bytes:
        """Ask for a range once.

        Raises:
            _CutShortError: fewer bytes came.
            NoRangesError: the server gives the whole file only.
            Exception: whatever the back end raises.
        """
        content = self._content(start, stop, seconds)
        if len(content) != stop - start:
            raise _CutShortError(f"the server gave {len(content)} of {stop - start} bytes")
        return content

    def _content(self, start: int, stop: int, seconds: float) -> bytes:
        ask = getattr(self._file, "async_fetch_range", None)
        if ask is None:
            if not self._file.seekable():
                raise _NoRangesError
            self._file.seek(start)
            return cast("bytes", self._file.read(stop - start))
        from fsspec.asyn import sync

        try:
            return cast("bytes", sync(self._file.loop, ask, start, stop, timeout=seconds))
        except ValueError as error:
            # fsspec says so where a server gives all of a file for a part of it
            if "range requests" in str(error):
                raise _NoRangesError from error
            raise

    def close(self) -> None:
        """Let go of the connection."""
        self._file.close()


def open_store(url: str, storage_options: Mapping[str, Any] | None = None) -> Store:
    """Find what reads and writes an address; its library is imported here.

    Args:
        url: the address.
        storage_options: what the back end is made with; what it needs of credentials it finds in the environment.

    Raises:
        MissingExtraError: fsspec, or what it needs for this scheme, is not installed.
        Exception: whatever the back end raises.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise MissingExtraError(f"{redacted(url)}: {_EXTRA}") from None
    files, path = url_to_fs(url, **(storage_options or {}))
    return Store(url, files, path)


def _abandon(file: Any) -> None:
    """Give up what was begun: parts that were sent are not put together, and do not stay."""
    with suppress(Exception):
        file.discard()
    file.buffer = None
    file.closed = True  # else the file would be finished once nothing holds it


def _facts(reported: Mapping[str, Any]) -> Facts:
    size = reported.get("size")
    version = next((_mark(reported[name]) for name in _VERSIONS if reported.get(name)), None)
    return Facts(
        str(reported["name"]), size if isinstance(size, int) else None, version, reported.get("type") == "directory"
    )


def _mark(reported: object) -> str:
    """What a back end says that changes with the content, as text; lists and single files word it differently."""
    when = reported.timestamp() if isinstance(reported, datetime) else reported
    return f"{when:.6f}" if isinstance(when, float) else str(when).strip('"')


Range = tuple[int, int]
"""First byte, and the one after the last."""

GAP = 64 << 10
"""Ranges that are no farther apart are fetched as one: asking takes longer than the bytes between [bytes]."""

SIDE_BY_SIDE = 8
"""How many ranges or files are fetched at one time."""

_REMEMBERED = 32 << 20
_AHEAD = 128 << 20

_LARGEST = 8 << 20
"""Longest range of what is fetched ahead: longer ones are cut, so that their parts come side by side [bytes]."""


@dataclass(frozen=True, slots=True)
class RemoteIdentity:
    """A file behind a URL as it was when it was opened.

    Attributes:
        path: its URL.
        size: its length [bytes].
        version: what the server says that changes with the content; None where it says nothing.
        storage_options: what the back end is made with.
    """

    path: str = field(repr=False)
    size: int
    version: str | None
    storage_options: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, url: str, storage_options: Mapping[str, Any] | None = None) -> Self:
        """Look at a file.

        Raises:
            DataError: it is not there, empty, a folder, or its server does not state how long it is.
            MissingExtraError: what reads such addresses is not installed.
        """
        with faults(url, ""):
            facts = patiently(lambda: open_store(url, storage_options).facts())
        shown = redacted(url)
        if facts.is_folder:
            raise DataError(shown, "", "is a folder; expected a file")
        if facts.size is None:
            raise DataError(shown, "", "its server does not state how long it is; fetch the file first")
        if facts.size == 0:
            raise DataError(shown, "", "is empty; expected a header")
        return cls(url, facts.size, facts.version, dict(storage_options or {}))

    @property
    def name(self) -> str:
        """What messages call it."""
        return redacted(self.path)

    def check(self) -> None:
        """Refuse a file that is not the one that was opened.

        Raises:
            DataError: it was changed, replaced or removed.
        """
        now = RemoteIdentity.of(self.path, self.storage_options)
        if (now.size, now.version) != (self.size, self.version):
            raise DataError(self.name, "", "was changed after it was opened; open the scene anew")

    def open(self) -> "RangedFile":
        """Open it for reading."""
        return RangedFile(self)


class RangedFile:
    """An open file behind a URL; several threads may read it."""

    def __init__(self, identity: RemoteIdentity, store: Store | None = None) -> None:
        """Nothing is fetched yet; `store` is where the file is, if that is known."""
        self.identity = identity
        self._store = store
        self._closed = False
        self._free: list[Handle] = []
        self._lock = Lock()
        self._recent: OrderedDict[Range, bytes] = OrderedDict()
        self._ahead: tuple[list[int], list[bytes]] = ([], [])

    def fetch(self, start: int, stop: int) -> bytes:
        """Fetch a range; what was fetched a moment ago, or ahead, is remembered.

        Raises:
            DataError: the file cannot be read; `passing` says whether that may pass.
        """
        ahead = self._fetched_ahead(start, stop)
        if ahead is not None:
            return ahead
        with self._lock:
            known = self._recent.get((start, stop))
        if known is None:
            known = self.ask(start, stop)
            with self._lock:
                self._recent[start, stop] = known
                while sum(map(len, self._recent.values())) > _REMEMBERED:
                    self._recent.popitem(last=False)
        return known

    def read_near(self, start: int, stop: int, length: int) -> bytes:
        """Fetch a range with what follows, `length` bytes at least, so that the next ones may be there already.

        Raises:
            DataError: the file cannot be read.
        """
        if start >= stop:
            return b""
        ahead = self._fetched_ahead(start, stop)
        if ahead is not None:
            return ahead
        with self._lock:
            for first, last in reversed(self._recent):
                if first <= start and stop <= last:
                    return self._recent[first, last][start - first : stop - first]
        return self.fetch(start, min(max(stop, start + length), self.identity.size))[: stop - start]

    def ask(self, start: int, stop: int) -> bytes:
        """Fetch a range from the server, and remember nothing.

        Raises:
            DataError: the file cannot be read.
        """
        if start >= stop:
            return b""
        with faults(self.identity.path, f"bytes {start} to {stop}"):
            return patiently(lambda: self._try(start, stop))

    def ask_ahead(self, ranges: Iterable[Range]) -> None:
        """Fetch ranges that will be read soon, neighbouring ones as one, side by side; too many are left for later."""
        blocks = [
            (first, min(first + _LARGEST, stop))
            for start, stop in coalesced(ranges)
            for first in range(start, stop, _LARGEST)
        ]
        if sum(stop - start for start, stop in blocks) > _AHEAD or len(blocks) < 2:
            return
        with ThreadPoolExecutor(min(SIDE_BY_SIDE, len(blocks))) as thread_pool:
            contents = list(thread_pool.map(lambda block: self.ask(*block), blocks))
        self._ahead = _joined(blocks, contents)

    def forget(self) -> None:
        """Let go of what was fetched ahead."""
        self._ahead = ([], [])

    def close(self) -> None:
        """Let go of the connections."""
        with self._lock:
            self._closed = True
            free, self._free = self._free, []
        for handle in free:
            handle.close()

    def _fetched_ahead(self, start: int, stop: int) -> bytes | None:
        starts, contents = self._ahead
        block = bisect_right(starts, start) - 1
        if block < 0 or stop - starts[block] > len(contents[block]):
            return None
        return contents[block][start - starts[block] : stop - starts[block]]

    def _try(self, start: int, stop: int) -> bytes:
        handle = self._handle()
        try:
            content = handle.read(start, stop, seconds=_PATIENCE.answer)
        except BaseException:
            handle.close()
            raise
        with self._lock:
            closed = self._closed
            if not closed:
                self._free.append(handle)
        if closed:
            handle.close()
        return content

    def _handle(self) -> Handle:
        with self._lock:
            if self._free:
                return self._free.pop()
            if self._store is None:
                self._store = open_store(self.identity.path, self.identity.storage_options)
            store = self._store
        return store.handle(self.identity.size)


def coalesced(ranges: Iterable[Range] | Sequence[Range]) -> list[Range]:
    """Join ranges that are no farther apart than `GAP`; ascending."""
    blocks: list[Range] = []
    for start, stop in sorted(ranges):
        if blocks and start - blocks[-1][1] <= GAP:
            blocks[-1] = (blocks[-1][0], max(stop, blocks[-1][1]))
        else:
            blocks.append((start, stop))
    return blocks


def _joined(blocks: list[Range], contents: list[bytes]) -> tuple[list[int], list[bytes]]:
    """Put parts that were cut together again."""
    starts: list[int] = []
    parts: list[list[bytes]] = []
    stop = -1
    for (start, end), content in zip(blocks, contents, strict=True):
        if start == stop:
            parts[-1].append(content)
        else:
            starts.append(start)
            parts.append([content])
        stop = end
    return starts, [b"".join(part) for part in parts]
