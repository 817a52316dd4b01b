"""Files behind URLs, read by ranges: side by side where several are known, tried again where that may help."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, Self

from sceneloom.errors import DataError
from sceneloom.formats.remote.faults import faults
from sceneloom.formats.remote.patience import PATIENCE, patiently
from sceneloom.formats.remote.stores import Handle, Store, open_store
from sceneloom.redaction import redacted

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
        blocks = [part for block in coalesced(ranges) for part in _cut(block)]
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
            content = handle.read(start, stop, seconds=PATIENCE.answer)
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


def _cut(block: Range) -> list[Range]:
    start, stop = block
    return [(first, min(first + _LARGEST, stop)) for first in range(start, stop, _LARGEST)]


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
