"""Scene files behind URLs, read by ranges: the header, then the arrays that are asked for, and nothing else."""

import io
import mmap
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock
from typing import Any, BinaryIO, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError, MissingExtraError
from sceneloom.formats.byte_stream import ByteStream
from sceneloom.formats.sfs.items import RawBytes
from sceneloom.formats.sfs.unfetched import Unfetched, arrays_in, replaced, unfetched

Range = tuple[int, int]
"""First byte, and the one after the last."""

GAP = 64 << 10
"""Ranges that are no farther apart are fetched as one: asking takes longer than the bytes between [bytes]."""

_FIRST_BLOCK, _LARGEST_BLOCK = 64 << 10, 16 << 20
_PIECE = 256 << 10
_REMEMBERED = 32 << 20
_NO_RESERVE = 0x4000
"""Source: MAP_NORESERVE of Linux; the placeholder takes addresses, not memory."""

_OF_FRAMES = {"lidar": "frames", "radar": "frames"}
_PLAYED = {"images", "video"}


@dataclass(frozen=True, slots=True)
class RemoteIdentity:
    """A file behind a URL as it was when it was opened.

    Attributes:
        path: its URL.
        size: its length [bytes].
        version: what the server says that changes with the content; None where it says nothing.
        storage_options: what the back end is made with.
    """

    path: str
    size: int
    version: str | None
    storage_options: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.path

    def check(self) -> None:
        """Refuse a file that is not the one that was opened.

        Raises:
            DataError: it was changed, replaced or removed.
        """
        now = RemoteFile.of(self.path, self.storage_options)
        now.close()
        if (now.identity.size, now.identity.version) != (self.size, self.version):
            raise DataError(self.path, "", "was changed after it was opened; open the scene anew")


class RemoteFile:
    """A file behind a URL for a container.

    Attributes:
        content: as many bytes as the file has, without its values: arrays are views of it before they are fetched.
        identity: how to tell the file from one that takes its place.
    """

    def __init__(self, file: BinaryIO, identity: RemoteIdentity) -> None:
        """Take an open fsspec file."""
        self.identity = identity
        self.content = _placeholder(identity.size)
        self._address = _address(np.frombuffer(self.content, np.uint8))
        self._file = file
        self._lock = Lock()
        self._recent: OrderedDict[Range, bytes] = OrderedDict()

    @classmethod
    def of(cls, url: str, storage_options: Mapping[str, Any] | None = None) -> Self:
        """Open a URL.

        Raises:
            DataError: it cannot be read, or is empty.
            MissingExtraError: what reads such URLs is not installed.
        """
        try:
            from fsspec.core import url_to_fs
        except ImportError:
            raise MissingExtraError(f"{url}: {_EXTRA}") from None
        with _faults(url, ""):
            files, path = url_to_fs(url, **(storage_options or {}))
            facts = files.info(path)
            file = files.open(path, "rb", cache_type="none")
        if facts.get("type") == "directory":
            raise DataError(url, "", "is a folder; expected a Sensor Fusion Scene file")
        size = facts.get("size")
        if not isinstance(size, int):
            raise DataError(url, "", "its server does not say how long it is; fetch the file first")
        if size == 0:
            raise DataError(url, "", "is empty; expected a JSON header")
        version = next((str(facts[name]) for name in _VERSIONS if facts.get(name)), None)
        return cls(cast("BinaryIO", file), RemoteIdentity(url, size, version, dict(storage_options or {})))

    def header(self, limit: int) -> memoryview:
        """Fetch the bytes before the first NUL, in blocks that grow.

        Raises:
            DataError: they are more than `limit`, or cannot be read.
        """
        text, block = bytearray(), _FIRST_BLOCK
        while len(text) < self.identity.size:
            if len(text) > limit:
                raise DataError(self.identity.name, "header", f"no NUL ends it within {limit} bytes")
            piece = self._read(len(text), min(len(text) + block, self.identity.size))
            stop = piece.find(b"\0")
            text += piece if stop < 0 else piece[:stop]
            if stop >= 0:
                break
            block = min(2 * block, _LARGEST_BLOCK)
        return memoryview(bytes(text))

    def fill(self, header: dict[str, Any]) -> None:
        """Fetch all arrays of a header but those of frames and pictures, which are marked as unfetched."""
        looked_into: list[tuple[Any, Any]] = []
        for holder, key, deferred in _places(header, (), header):
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
        """Give the bytes of an array as what fetches the pieces that are read."""
        return RemoteContent(self, *self._range(array))

    def close(self) -> None:
        """Let go of the connection."""
        self._file.close()

    def read(self, start: int, stop: int) -> bytes:
        """Fetch a range; what was fetched a moment ago is remembered.

        Raises:
            DataError: the file cannot be read.
        """
        known = self._recent.get((start, stop))
        if known is None:
            known = self._recent[start, stop] = self._read(start, stop)
            while sum(map(len, self._recent.values())) > _REMEMBERED:
                self._recent.popitem(last=False)
        return known

    def _read(self, start: int, stop: int) -> bytes:
        place = f"bytes {start} to {stop}"
        with self._lock, _faults(self.identity.name, place):
            self._file.seek(start)
            content = self._file.read(stop - start)
        if len(content) != stop - start:
            raise DataError(self.identity.name, place, f"the server gave {len(content)} bytes")
        return content

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
        return b"".join(self._pieces(start, stop)) if start < stop else b""

    def __call__(self) -> BinaryIO:
        """Open them as a file."""
        return cast("BinaryIO", io.BufferedReader(ByteStream(self), _PIECE))

    def _pieces(self, start: int, stop: int) -> Iterator[bytes]:
        """Fetch whole pieces of one length, so that readings side by side find them remembered."""
        for number in range(start // _PIECE, -(-stop // _PIECE)):
            first = number * _PIECE
            piece = self._remote.read(self._start + first, min(self._start + first + _PIECE, self._stop))
            yield piece[max(0, start - first) : stop - first]


_EXTRA = "reading files behind URLs needs `pip install 'sceneloom[cloud]'`"
_VERSIONS = ("ETag", "etag", "mtime", "LastModified", "last_modified", "updated", "created")
"""What back ends call the mark of a content, best first."""


def coalesced(ranges: "Iterator[Range] | Sequence[Range]") -> list[Range]:
    """Join ranges that are no farther apart than `GAP`; ascending."""
    blocks: list[Range] = []
    for start, stop in sorted(ranges):
        if blocks and start - blocks[-1][1] <= GAP:
            blocks[-1] = (blocks[-1][0], max(stop, blocks[-1][1]))
        else:
            blocks.append((start, stop))
    return blocks


@contextmanager
def _faults(url: str, place: str) -> Iterator[None]:
    """Turn whatever a back end raises into errors of ours."""
    try:
        yield
    except ImportError as error:
        raise MissingExtraError(f"{url}: {error}; {_EXTRA}") from error
    except FileNotFoundError as error:
        # back ends say so, too, where no server answers
        cause = f": {error.__cause__}" if error.__cause__ else ""
        raise DataError(url, place, f"cannot be found{cause}") from error
    except ValueError as error:
        # fsspec says so where a server gives all of a file for a part of it
        if "range requests" not in str(error):
            raise DataError(url, place, f"cannot be read: {error}") from error
        raise DataError(url, "", "its server answers no ranges (`Range`); download the file first") from error
    except Exception as error:  # back ends raise what the libraries of their protocols raise
        problem = f"cannot be read: {str(error) or type(error).__name__}"
        raise DataError(url, place, problem) from error


def _places(node: Any, keys: tuple[Any, ...], header: dict[str, Any]) -> Iterator[tuple[Any, Any, bool]]:
    """All arrays of a header: what holds them, under which key, and whether readers leave them for later."""
    for key, value in list(node.items()) if isinstance(node, dict) else enumerate(node):
        if isinstance(value, np.ndarray):
            yield node, key, _is_deferred(header, (*keys, key))
        elif isinstance(value, dict | list):
            yield from _places(value, (*keys, key), header)


def _is_deferred(header: dict[str, Any], keys: tuple[Any, ...]) -> bool:
    """Whether an array belongs to a frame of a lidar or radar, or is a picture or a video of a camera."""
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
