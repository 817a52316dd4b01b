"""The container of `.sfs` files, reading side: a JSON header, then arrays.

Mapped into memory or read by ranges behind a URL.
"""

import gc
import io
import json
import mmap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Protocol, Self, cast

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError, redacted
from sceneloom.formats.base.files import ByteStream, Identity, is_url
from sceneloom.formats.remote.stores import Range, RangedFile, RemoteIdentity, coalesced
from sceneloom.formats.sfs.arrays import (
    DTYPES,
    ITEMS,
    ItemFault,
    LocalFile,
    MappedContent,
    RawBytes,
    Unfetched,
    arrays_in,
    format_keys,
    item_locations,
    put_items,
    replaced,
    unfetched,
)

_FIRST_BLOCK, _LARGEST_BLOCK = 64 << 10, 16 << 20

_PIECE = 256 << 10

_NO_RESERVE = 0x4000
"""Source: MAP_NORESERVE of Linux; the placeholder takes addresses, not memory."""

_OF_FRAMES = {"lidar": "frames", "radar": "frames"}

_PLAYED = {"images", "video"}


class RemoteFile:
    """A file behind a URL for a container.

    Attributes:
        content: as many bytes as the file has, without its values: arrays are views of it before they are fetched.
        identity: how to report the file from one that takes its location.
    """

    def __init__(self, file: RangedFile) -> None:
        """Take an open file."""
        self.identity = file.identity
        self.content = _placeholder(file.identity.size)
        self._address = _address(np.frombuffer(self.content, np.uint8))
        self._file = file

    @classmethod
    def of(cls, url: str, storage_options: Mapping[str, Any] | None = None) -> Self:
        """Open a URL.

        Raises:
            DataError: it cannot be read, or is empty.
            MissingExtraError: what reads such URLs is not installed.
        """
        return cls(RemoteIdentity.of(url, storage_options).open())

    def header(self, limit: int) -> memoryview:
        """Fetch the bytes before the first NUL, in blocks that grow.

        Raises:
            DataError: they are more than `limit`, or cannot be read.
        """
        text, block = bytearray(), _FIRST_BLOCK
        while len(text) < self.identity.size:
            if len(text) > limit:
                raise DataError(self.identity.name, "header", f"no NUL ends it within {limit} bytes")
            piece = self._file.ask(len(text), min(len(text) + block, self.identity.size))
            stop = piece.find(b"\0")
            text += piece if stop < 0 else piece[:stop]
            if stop >= 0:
                break
            block = min(2 * block, _LARGEST_BLOCK)
        return memoryview(bytes(text))

    def fill(self, header: dict[str, Any]) -> None:
        """Fetch all arrays of a header but those of frames and images, which are marked as unfetched."""
        looked_into: list[tuple[Any, Any]] = []
        for holder, key, deferred in _locations(header, (), header):
            array = holder[key]
            holder[key] = unfetched(array)
            if not (deferred and array.dtype.isnative):
                looked_into.append((holder, key))
        filled = self._filled([holder[key] for holder, key in looked_into])
        for holder, key in looked_into:
            holder[key] = filled[id(holder[key])]

    def fetch(self, value: Any) -> Any:
        """Give a value with all arrays in it filled; neighbouring ones are fetched at one go.

        Raises:
            DataError: the file cannot be read.
        """
        return replaced(value, self._filled(list(arrays_in(value))))

    def bytes_of(self, array: AnyArray) -> "RemoteContent":
        """Give the bytes of an array as what fetches the chunks that are read."""
        return RemoteContent(self, *self._range(array))

    def close(self) -> None:
        """Let go of the connection."""
        self._file.close()

    def read(self, start: int, stop: int) -> bytes:
        """Fetch a range; what was fetched a moment ago is remembered.

        Raises:
            DataError: the file cannot be read.
        """
        return self._file.fetch(start, stop)

    def _range(self, array: AnyArray) -> Range:
        start = _address(array) - self._address if array.nbytes else 0
        return start, start + array.nbytes

    def _filled(self, arrays: Sequence[Unfetched]) -> dict[int, AnyArray]:
        """Fetch arrays; by `id` of those without values."""
        ranges = {id(array): self._range(array) for array in arrays}
        blocks = coalesced(range_ for range_ in ranges.values() if range_[0] < range_[1])
        starts = np.array([start for start, _ in blocks], np.int64)
        contents = [self.read(*block) for block in blocks]
        filled = {}
        for array in arrays:
            start, _ = ranges[id(array)]
            block = int(np.searchsorted(starts, start, side="right")) - 1
            content, skipped = (contents[block], start - blocks[block][0]) if array.nbytes else (b"", 0)
            plain = np.frombuffer(content, array.dtype, array.size, skipped).reshape(array.shape)
            filled[id(array)] = plain.view(RawBytes) if isinstance(array, RawBytes) else plain
        return filled


class RemoteContent:
    """The bytes of an array of a file behind a URL, fetched piece by piece as they are read."""

    def __init__(self, file: RemoteFile, start: int, stop: int) -> None:
        """Nothing is fetched yet."""
        self._remote, self._start, self._stop = file, start, stop

    def __len__(self) -> int:
        return self._stop - self._start

    def __getitem__(self, part: slice) -> bytes:
        start, stop, _ = part.indices(len(self))
        return b"".join(self._chunks(start, stop)) if start < stop else b""

    def __call__(self) -> BinaryIO:
        """Open them as a file."""
        return cast("BinaryIO", io.BufferedReader(ByteStream(self), _PIECE))

    def _chunks(self, start: int, stop: int) -> Iterator[bytes]:
        """Fetch whole chunks of one length, so that readings side by side find them remembered."""
        for number in range(start // _PIECE, -(-stop // _PIECE)):
            first = number * _PIECE
            piece = self._remote.read(self._start + first, min(self._start + first + _PIECE, self._stop))
            yield piece[max(0, start - first) : stop - first]


def _locations(node: Any, keys: tuple[Any, ...], header: dict[str, Any]) -> Iterator[tuple[Any, Any, bool]]:
    """All arrays of a header: what holds them, under which key, and whether readers leave them for later."""
    for key, value in list(node.items()) if isinstance(node, dict) else enumerate(node):
        if isinstance(value, np.ndarray):
            yield node, key, _is_deferred(header, (*keys, key))
        elif isinstance(value, dict | list):
            yield from _locations(value, (*keys, key), header)


def _is_deferred(header: dict[str, Any], keys: tuple[Any, ...]) -> bool:
    """Whether an array belongs to a frame of a lidar or radar, or is an image or a video of a camera."""
    ours = keys[:2] == ("metadata", "sceneloom")
    keys, root = (keys[2:], header["metadata"]["sceneloom"]) if ours else (keys, header)
    if len(keys) < 4 or keys[0] != "sensors" or not isinstance(root["sensors"], list):
        return False
    sensor = root["sensors"][keys[1]]
    kind = sensor.get("type") if isinstance(sensor, dict) else None
    if kind == "camera":
        return keys[2] in _PLAYED and keys[-1] == "content"
    return bool(keys[2] == _OF_FRAMES.get(str(kind)))


def _placeholder(size: int) -> mmap.mmap:
    if hasattr(mmap, "MAP_PRIVATE"):
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _NO_RESERVE
        return mmap.mmap(-1, size, flags=flags, prot=mmap.PROT_READ)
    return mmap.mmap(-1, size, access=mmap.ACCESS_READ)


def _address(array: AnyArray) -> int:
    return int(array.__array_interface__["data"][0])


__all__ = ["DTYPES", "ITEMS", "Container", "ItemFault", "RawBytes", "format_keys"]

HEADER_LIMIT = 1 << 30
"""Longest header that is read [bytes]: beyond it the text alone would fill the memory of a large machine."""


class StoredFile(Protocol):
    """A file on disk or behind a URL."""

    @property
    def content(self) -> mmap.mmap:
        """Its bytes, or what has as many."""
        ...

    @property
    def identity(self) -> Identity:
        """How to report it from a file that takes its location."""
        ...

    def header(self, limit: int) -> memoryview:
        """Give the bytes before the first NUL."""
        ...

    def fill(self, header: dict[str, Any]) -> None:
        """Give values to the arrays of a header that readers look into."""
        ...

    def fetch(self, value: Any) -> Any:
        """Give a value with all arrays in it filled."""
        ...

    def bytes_of(self, array: AnyArray) -> MappedContent | RemoteContent:
        """Give the bytes of an array, which may be read piece by piece."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Container:
    """An open `.sfs` file, on disk or behind a URL.

    Attributes:
        file: its name, for messages.
        identity: how to report it from a file that takes its location.
        size: its length [bytes].
        header: the decoded header without `$items`; arrays stand in their locations as read-only views. In that of a
            file behind a URL, arrays of frames and images have no values: `fetch` gives them.

    Raises:
        DataError: the file cannot be read, or its header or an item is wrong.
        MissingExtraError: it is behind a URL, and what reads those is not installed.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        faults: list[ItemFault] | None = None,
        storage_options: Mapping[str, Any] | None = None,
        decode: Callable[[memoryview, str], Any] | None = None,
    ) -> None:
        """Open the file and decode its header.

        Args:
            path: the file, or its URL.
            faults: where items at fault are noted, in the order of `$items`; None stands in the position of each in the
                header, if it has one. Without a list the first fault is raised.
            storage_options: what the fsspec back end of a URL is made with.
            decode: makes a value of the header's text and the file's name, instead of the strict decoder.
        """
        self.file = redacted(path) if is_url(path) else str(path)
        self._stored: StoredFile = (
            RemoteFile.of(str(path), storage_options) if is_url(path) else LocalFile.of(Path(path))
        )
        self.identity = self._stored.identity
        self.size = len(self._stored.content)
        self.closed = False
        self._on_close: list[Callable[[], None]] = [self._stored.close]
        try:
            self._read(decode or _decode, faults)
        except BaseException:
            self.close()
            raise

    def _read(self, decode: Callable[[memoryview, str], Any], faults: list[ItemFault] | None) -> None:
        with self._stored.header(HEADER_LIMIT) as text:
            self.start = len(text)
            header = decode(text, self.file)
        if not isinstance(header, dict):
            raise DataError(self.file, "header", f"a JSON {type(header).__name__}; expected an object")
        self._items = header.pop(ITEMS, [])
        if not isinstance(self._items, list):
            raise DataError(self.file, ITEMS, f"a {type(self._items).__name__}; expected a list")
        found = put_items(header, self._items, self._stored.content, self.start)
        if found and faults is None:
            raise DataError(self.file, found[0].location, found[0].problem)
        if faults is not None:
            faults.extend(found)
        self._stored.fill(header)
        self.header: dict[str, Any] = header
        self._numbers: dict[str, int] | None = None

    def close(self) -> None:
        """Let go of the file; arrays that are still in use keep their part of it."""
        self.closed = True
        while self._on_close:
            self._on_close.pop()()

    def on_close(self, close: Callable[[], None]) -> None:
        """Have something closed together with the file."""
        self._on_close.append(close)

    def check_open(self, location: str) -> None:
        """Refuse to read from a closed file.

        Raises:
            DataError: the file is closed.
        """
        if self.closed:
            raise DataError(self.file, location, "the scene is closed; read its frames before that")

    def fetch(self, value: Any) -> Any:
        """Give an array, or whatever holds arrays, with their values; of a file on disk it is the value itself.

        Raises:
            DataError: the file is behind a URL and cannot be read, or has changed.
        """
        return self._stored.fetch(value)

    def bytes_of(self, array: AnyArray) -> MappedContent | RemoteContent:
        """Give the bytes of an array, to be read piece by piece where the file is behind a URL."""
        return self._stored.bytes_of(array)

    def bytes_between(self, start: int, stop: int) -> memoryview:
        """Give bytes of a file on disk by their offsets from the end of the header, as many as there are."""
        return memoryview(self._stored.content)[self.start + start : self.start + stop]

    @property
    def item_count(self) -> int:
        """How many entries `$items` has."""
        return len(self._items)

    def item(self, number: int) -> Any:
        """Give an entry of `$items` as the file has it."""
        return self._items[number]

    def item_number(self, location: str, header: dict[str, Any] | None = None) -> int | None:
        """Find the item that fills a location such as `sensors[0].frames[3].points.positions`.

        Args:
            location: where.
            header: as it was when the file was opened, where parts have been taken out of `self.header` since.
        """
        if self._numbers is None:
            self._numbers = item_locations(self.header if header is None else header, self._items)
        return self._numbers.get(location)


def _decode(text: memoryview, file: str) -> Any:
    try:
        return msgspec.json.decode(text)
    except RecursionError:
        raise DataError(file, "header", "nested too deeply") from None
    except (ValueError, msgspec.DecodeError) as error:
        problem = str(error)
    return _decode_again(bytes(text), problem, file)


def _decode_again(text: bytes, problem: str, file: str) -> Any:
    """Decode what strict JSON refuses but Python's writers produce: NaN and Infinity."""
    if b"NaN" in text or b"Infinity" in text:
        try:
            return json.loads(text)
        except RecursionError:
            problem = "nested too deeply"
        except ValueError as error:
            problem = str(error)
    raise DataError(file, "header", f"no valid JSON: {problem}")


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause the search for reference cycles.

    A header makes very many small objects that all stay and form no cycles: the collector would walk over them again
    and again and take more time than the parsing.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
