"""Scene files behind URLs, read by ranges: the header, then the arrays that are asked for, and nothing else."""

import io
import mmap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, BinaryIO, Self, cast

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.errors import DataError
from sceneloom.formats.byte_stream import ByteStream
from sceneloom.formats.remote.ranged import Range, RangedFile, RemoteIdentity, coalesced
from sceneloom.formats.sfs.items import RawBytes
from sceneloom.formats.sfs.unfetched import Unfetched, arrays_in, replaced, unfetched

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
