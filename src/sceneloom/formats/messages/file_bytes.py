"""Bytes of a log by their offset, locally or behind a URL, and its chunks, compressed or not."""

import bz2
import os
import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import DataError, MissingExtraError, how_to_install, redacted
from sceneloom.formats.base.files import FileIdentity, file_faults, most_unpacked, open_file, path_or_url
from sceneloom.formats.remote.stores import Range, RangedFile, RemoteIdentity

_READ_AHEAD = 64 << 10
"""How much of a file behind a URL is fetched at least: records are small, and stand side by side [bytes]."""


class FileBytes:
    """A file that is read piece by piece; another process opens it again, if it is still the same file.

    Attributes:
        path: the file; the URL of one, without secrets, as text.
        size: its length [bytes].
    """

    def __init__(self, path: Path | str) -> None:
        """Open the file, or the URL of one.

        Raises:
            DataError: it cannot be opened.
        """
        location = path_or_url(path)
        self.path = redacted(location) if isinstance(location, str) else location
        self._identity: FileIdentity | RemoteIdentity
        try:
            self._identity = RemoteIdentity.of(location) if isinstance(location, str) else FileIdentity.of(location)
        except OSError as error:
            raise DataError(path, "", f"cannot be opened: {error.strerror or error}") from error
        self.size = self._identity.size
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        self._file: BinaryIO | RangedFile | None = None
        self._process = -1
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("path", "size", "_identity", "_closed")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def read(self, start: int, length: int) -> bytes:
        """Read bytes.

        Args:
            start: location of the first.
            length: how many; all of them have to be there.

        Raises:
            DataError: the file ends before, cannot be read, was changed, or is closed.
        """
        content = self.read_up_to(start, length)
        if len(content) != length:
            problem = f"the file ends after {len(content)} of {length} bytes; is it cut off?"
            raise DataError(self.path, f"byte {start}", problem)
        return content

    def read_up_to(self, start: int, length: int) -> bytes:
        """Read bytes, fewer where the file ends before."""
        if start < 0 or length < 0:
            raise DataError(self.path, f"byte {start}", f"{length} bytes wanted; expected a position in the file")
        with self._lock:
            file = self._opened()
            try:
                stop = min(start + length, max(start, self.size))
                if isinstance(file, RangedFile):
                    return file.read_near(start, stop, _READ_AHEAD)
                file.seek(start)
                return file.read(stop - start)
            except (OSError, OverflowError, ValueError) as error:
                raise DataError(self.path, f"byte {start}", f"cannot be read: {error}") from error

    def expect(self, ranges: Iterable[Range]) -> None:
        """Report what will be read soon: behind a URL it is fetched side by side, on disk nothing happens.

        Raises:
            DataError: the file cannot be read.
        """
        with self._lock:
            file = self._opened()
            if isinstance(file, RangedFile):
                inside = ((max(0, start), min(stop, self.size)) for start, stop in ranges)
                file.ask_ahead((start, stop) for start, stop in inside if start < stop)

    def close(self) -> None:
        """Release the file; nothing can be read afterwards."""
        with self._lock:
            self._closed = True
            if self._file is not None and self._process == os.getpid():
                self._file.close()
            self._file = None

    def _opened(self) -> BinaryIO | RangedFile:
        if self._closed:
            raise DataError(self.path, "", "is closed")
        if self._file is None or self._process != os.getpid():
            # a forked process must not move the location at which the other one reads
            self._identity.check()
            if isinstance(self._identity, RemoteIdentity):
                self._file = self._identity.open()
            else:
                with file_faults(self._identity.path):
                    self._file = open_file(self._identity.path)
            self._process = os.getpid()
        return self._file


DIRECT = -1
"""Instead of a chunk's number: the offset is a position in the file."""

_LARGEST_CHUNK = 1 << 31  # chunks that claim to be larger are refused: a damaged head can claim any number [bytes]
_KEPT_CHUNKS = 2  # messages that are read one after another mostly are in one chunk


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where the records of a chunk are.

    Attributes:
        start: location of their first byte in the file.
        size: how many bytes they are there.
        full_size: how many they are once they are decompressed.
        compression: as the file calls it, "" for none.
        crc: checksum of the decompressed bytes, 0 for none.
    """

    start: int
    size: int
    full_size: int
    compression: str
    crc: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """The messages of one stream in the order of the file.

    Attributes:
        log_times_ns: (N,) int64 [ns], when they were recorded.
        chunks: (N,) int64, number of the chunk, or `DIRECT`.
        offsets: (N,) int64, location of the message's record in the chunk or the file.
    """

    log_times_ns: Int64Array
    chunks: Int64Array
    offsets: Int64Array

    def __len__(self) -> int:
        return len(self.offsets)


class ChunkedMessages:
    """The messages of a file; of chunks that are decompressed the latest ones are kept. It can be pickled.

    Attributes:
        file: the bytes.
        chunks: in the order of the file.
    """

    def __init__(self, file: FileBytes, message_at: Callable[[bytes, int], tuple[int, int]], head_size: int) -> None:
        """Begin without messages.

        Args:
            file: its bytes.
            message_at: finds in some bytes where the data of the message are whose record begins at an offset: the
                first byte and how many; ValueError or struct.error where there is no message. It can be pickled.
            head_size: at most so many bytes of a record come before the data.
        """
        self.file, self.chunks = file, list[Chunk]()
        self._message_at, self._head_size = message_at, head_size
        self._rows: dict[int, list[Int64Array]] = {}
        self._begin()

    def _begin(self) -> None:
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in {"_kept", "_lock"}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def add_chunk(self, chunk: Chunk) -> None:
        """Append a chunk.

        Raises:
            ValueError: it claims to be too large.
        """
        largest = max(chunk.size, chunk.full_size)
        if largest > _LARGEST_CHUNK:
            raise ValueError(f"a chunk of {largest} bytes; expected at most {_LARGEST_CHUNK}")
        self.chunks.append(chunk)

    def add(self, stream: int, chunk: int, times_and_offsets: Int64Array) -> None:
        """Append messages of a stream: (N, 2) recording times and offsets in a chunk, or the file for `DIRECT`."""
        ordered = times_and_offsets[np.argsort(times_and_offsets[:, 1], kind="stable")]
        numbers = np.full(len(ordered), chunk, np.int64)
        self._rows.setdefault(stream, []).append(np.stack((ordered[:, 0], numbers, ordered[:, 1])))

    @property
    def streams(self) -> set[int]:
        """The streams that have messages."""
        return set(self._rows)

    def entries(self, stream: int) -> Entries:
        """The messages of a stream."""
        parts = self._rows.get(stream, [])
        if len(parts) > 1:
            parts[:] = [np.concatenate(parts, axis=1)]
        return Entries(*(parts[0] if parts else np.zeros((3, 0), np.int64)))

    def compressed(self, entries: Entries) -> BoolArray:
        """Which messages are in chunks that have to be decompressed, (N,) bool."""
        flags = [bool(chunk.compression) for chunk in self.chunks]
        return np.array([*flags, False])[entries.chunks]

    def data(self, entries: Entries, k: int) -> memoryview:
        """Read the data of message `k` of a stream.

        Raises:
            DataError: the message, or its chunk, is damaged.
        """
        number, offset = int(entries.chunks[k]), int(entries.offsets[k])
        if number != DIRECT and self.chunks[number].compression:
            content = self._whole(number)
            start, size = self._located(content, offset, number, offset)
            if start + size > len(content):
                raise self._beyond(number, offset)
            return memoryview(content)[start : start + size]
        first, stop = 0, self.file.size
        if number != DIRECT:
            first, stop = self.chunks[number].start, self.chunks[number].start + self.chunks[number].size
        start, size = self._located(self.file.read_up_to(first + offset, self._head_size), 0, number, offset)
        if first + offset + start + size > stop:
            raise self._beyond(number, offset)
        return memoryview(self.file.read(first + offset + start, size))

    def heads(self, entries: Entries, rows: Int64Array, size: int) -> Iterator[bytes]:
        """Give the first bytes of the data of some messages, in the order of the file.

        Args:
            entries: of a stream.
            rows: which, ascending.
            size: how many bytes at most.

        Raises:
            DataError: a message is damaged.
        """
        starts = np.array([*(chunk.start for chunk in self.chunks), 0], np.int64)
        room = self._head_size + size
        compressed = self.compressed(entries)
        groups = np.where(compressed[rows], entries.chunks[rows], DIRECT)
        for part in np.split(rows, np.flatnonzero(np.diff(groups)) + 1):
            if len(part) == 0:
                continue
            numbers, offsets = entries.chunks[part], entries.offsets[part]
            if compressed[part[0]]:
                content = self._beginning(int(numbers[0]), int(offsets.max()) + room)
                for offset in offsets.tolist():
                    yield self._head(content, offset, size, int(numbers[0]), offset)
                continue
            locations = (starts[numbers] + offsets).tolist()
            self.file.expect((location, location + room) for location in locations)
            for location, number, offset in zip(locations, numbers.tolist(), offsets.tolist(), strict=True):
                yield self._head(self.file.read_up_to(location, room), 0, size, number, offset)

    def _head(self, content: bytes, at: int, size: int, number: int, offset: int) -> bytes:
        start, length = self._located(content, at, number, offset)
        return content[start : start + min(size, length)]

    def _located(self, content: bytes, at: int, number: int, offset: int) -> tuple[int, int]:
        try:
            if at < 0:
                raise ValueError("before its chunk")  # noqa: TRY301 - one handler for all faults
            return self._message_at(content, at)
        except (ValueError, struct.error) as error:
            location = _location(number, offset)
            problem = f"no message where the index has one: {error}"
            raise DataError(self.file.path, location, problem) from error

    def _beyond(self, number: int, offset: int) -> DataError:
        return DataError(self.file.path, _location(number, offset), "a message that ends beyond its chunk")

    def _whole(self, number: int) -> bytes:
        with self._lock:
            known = self._kept.get(number)
            if known is not None:
                self._kept.move_to_end(number)
                return known
        chunk = self.chunks[number]
        content = self._beginning(number, chunk.full_size)
        if len(content) != chunk.full_size or (chunk.crc and zlib.crc32(content) != chunk.crc):
            problem = "damaged: its checksum is another one, or it is cut off"
            raise DataError(self.file.path, f"chunk {number}", problem)
        with self._lock:
            self._kept[number] = content
            while len(self._kept) > _KEPT_CHUNKS:
                self._kept.popitem(last=False)
        return content

    def _beginning(self, number: int, size: int) -> bytes:
        try:
            return self.unpacked(number, size)
        except ValueError as error:
            raise DataError(self.file.path, f"chunk {number}", str(error)) from error

    def unpacked(self, number: int, size: int | None = None) -> bytes:
        """Give the first bytes of a chunk, or all of them.

        Raises:
            ValueError: they cannot be decompressed.
            DataError: they are not there.
        """
        chunk = self.chunks[number]
        stored = self.file.read(chunk.start, chunk.size)
        wanted = chunk.full_size if size is None else max(0, min(size, chunk.full_size))
        return decompress(chunk.compression, stored, wanted)


def _location(number: int, offset: int) -> str:
    return f"byte {offset}" if number == DIRECT else f"chunk {number}, byte {offset}"


def decompress(compression: str, content: bytes, size: int) -> bytes:
    """Give the first `size` bytes of what was compressed; never asks for memory for more.

    The readers of mcap and rosbags are not used for it: they decompress to whatever length the bytes state.

    Raises:
        ValueError: the bytes are damaged, of an unknown compression, or `size` is more than `most_unpacked` allows.
        MissingExtraError: the library of the compression is not installed.
    """
    if compression not in _DECOMPRESSORS:
        raise ValueError(f"compression {compression!r}; expected one of {', '.join(_DECOMPRESSORS)}")
    most = most_unpacked(len(content))
    if compression and size > most:
        raise ValueError(f"{len(content)} bytes that unpack to {size}; expected {most} at most")
    try:
        return _DECOMPRESSORS[compression](content, size)
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing
    except (RuntimeError, EOFError, MemoryError, OSError) as error:
        raise ValueError(f"cannot be decompressed as {compression}: {error}") from error


def _from_lz4(content: bytes, size: int) -> bytes:
    import lz4.frame

    found: bytes = lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size)
    return found


def _from_zstd(content: bytes, size: int) -> bytes:
    import zstandard

    try:
        with zstandard.ZstdDecompressor().stream_reader(content) as reader:
            return reader.read(size)
    except zstandard.ZstdError as error:
        raise ValueError(f"cannot be decompressed as zstd: {error}") from error


_DECOMPRESSORS: Mapping[str, Callable[[bytes, int], bytes]] = MappingProxyType(
    {
        "": lambda content, size: content[:size],
        "lz4": _from_lz4,
        "zstd": _from_zstd,
        "bz2": lambda content, size: bz2.BZ2Decompressor().decompress(content, size),
    }
)
