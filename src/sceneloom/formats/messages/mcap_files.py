"""MCAP files: their records, the index of their messages, messages read by it, and writing by chunks."""

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import BinaryIO, TypeVar, cast

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from sceneloom.errors import DataError, MissingExtraError, OutputError, check_choice, how_to_install
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.messages.file_bytes import DIRECT, Chunk, ChunkedMessages, FileBytes
from sceneloom.formats.messages.spec import MCAP_MAGIC

_LARGEST_RECORD = 1 << 30  # records of the index that claim to be larger are refused [bytes]
_HEAD = struct.Struct("<BQ")  # opcode and length of a record, which its content follows
_MESSAGE = struct.Struct("<HIQQ")  # what comes before the data of a message: channel, sequence, log time, publish time

_FOOTER = struct.Struct("<QQI")
"""Content of the last record: starts of the summary and of its offsets, and the summary's checksum."""

_CHUNK = struct.Struct("<QQQII")
"""How a chunk begins: first and last time, size, checksum, length of the compression's name."""

_CHUNK_TOP = 256
_Record = TypeVar("_Record")


@dataclass(slots=True)
class McapIndex:
    """What is where in a file.

    Attributes:
        messages: of all channels, by the channel's id.
        profile, library: as the file's header says.
        schemas, channels: by their ids.
        metadata: names and values of the metadata records.
    """

    messages: ChunkedMessages
    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)

    @classmethod
    def of(cls, file: FileBytes) -> "McapIndex":
        """An index without anything in it."""
        return cls(ChunkedMessages(file, _message_at, _HEAD.size + _MESSAGE.size))

    @property
    def file(self) -> FileBytes:
        """The bytes of the file."""
        return self.messages.file


def _message_at(content: bytes, offset: int) -> tuple[int, int]:
    op, length = _HEAD.unpack_from(content, offset)
    if op != Opcode.MESSAGE or length < _MESSAGE.size:
        raise ValueError(f"record {op} of {length} bytes")
    return offset + _HEAD.size + _MESSAGE.size, length - _MESSAGE.size


def read_index(file: FileBytes, ledger: Ledger) -> McapIndex:
    """Find all messages of a file without reading them.

    Raises:
        DataError: it is no MCAP file, or one that was not finished, is cut off or damaged; a lenient reading takes
            what is whole.
    """
    if file.read_up_to(0, len(MCAP_MAGIC)) != MCAP_MAGIC:
        raise DataError(file.path, "byte 0", f"does not begin as an MCAP file does, with {MCAP_MAGIC!r}")
    summary = _summary_start(file)
    if summary is None:
        problem = "the file was not finished: its end and index are missing; use `--lenient` to read what is whole"
        ledger.fault("mcap-unfinished", DataError(file.path, f"byte {file.size}", problem))
        return _scanned(file, ledger, until=file.size)
    try:
        index = McapIndex.of(file)
        _read_header(index)
        if summary and _read_summary(index, summary):
            return index
    except (ValueError, struct.error, DataError) as error:
        problem = error.problem if isinstance(error, DataError) else str(error)
        fault = DataError(file.path, "summary", f"the index is damaged: {problem}")
        ledger.fault("mcap-index-damaged", fault)
    return _scanned(file, ledger, until=summary or file.size)


def _summary_start(file: FileBytes) -> int | None:
    """Where the summary begins, 0 where there is none; None where the file has no end."""
    tail_size = _HEAD.size + _FOOTER.size + len(MCAP_MAGIC)
    if file.size < len(MCAP_MAGIC) + tail_size:
        return None
    tail = file.read(file.size - tail_size, tail_size)
    if not tail.endswith(MCAP_MAGIC) or _HEAD.unpack_from(tail) != (Opcode.FOOTER, _FOOTER.size):
        return None
    start: int = _FOOTER.unpack_from(tail, _HEAD.size)[0]
    return start


def _read_header(index: McapIndex) -> int:
    """Read the first record, and give where it ends."""
    op, length = _HEAD.unpack(index.file.read(len(MCAP_MAGIC), _HEAD.size))
    if op != Opcode.HEADER or length > _LARGEST_RECORD:
        raise ValueError(f"record {op} of {length} bytes at the beginning; expected the header")
    start = len(MCAP_MAGIC) + _HEAD.size
    header = _parsed(Header.read, index.file.read(start, length))
    index.profile, index.library = header.profile, header.library
    return start + int(length)


def _read_summary(index: McapIndex, start: int) -> bool:
    """Read schemas, channels and offsets of messages; whether that is all there is to know."""
    file, scan = index.file, _Scan(index)
    if not len(MCAP_MAGIC) <= start < file.size or file.size - start > _LARGEST_RECORD:
        raise ValueError(f"a summary at byte {start} of {file.size}")
    message_count = None
    chunks: list[ChunkIndex] = []
    for op, content in _records(memoryview(file.read(start, file.size - start))):
        if op in {Opcode.SCHEMA, Opcode.CHANNEL}:
            scan.take_content(op, content)
        elif op == Opcode.CHUNK_INDEX:
            chunks.append(_parsed(ChunkIndex.read, content))
        elif op == Opcode.STATISTICS:
            message_count = _parsed(Statistics.read, content).message_count
        elif op == Opcode.METADATA_INDEX:
            metadata = _parsed(MetadataIndex.read, content)
            scan.take(Opcode.METADATA, metadata.offset, metadata.length - _HEAD.size)
        elif op == Opcode.FOOTER:
            break
    file.expect(location for chunk in chunks for location in _locations(chunk))
    for chunk in chunks:
        scan.take(Opcode.CHUNK, chunk.chunk_start_offset, chunk.chunk_length - _HEAD.size)
        stop, length = chunk.chunk_start_offset + chunk.chunk_length, chunk.message_index_length
        for op, content in _records(memoryview(file.read(stop, _checked(length)))):
            if op == Opcode.MESSAGE_INDEX:
                scan.take_content(op, content)
        scan.finish_chunk()
    # a summary may leave out channels, or all chunks where messages are outside of them
    known = index.messages.streams <= set(index.channels)
    return known and (bool(chunks) or message_count == 0)


def _locations(chunk: ChunkIndex) -> Iterator[tuple[int, int]]:
    """Where the head of a chunk is, and the index of its messages."""
    start, length = chunk.chunk_start_offset, chunk.chunk_length
    yield start, start + min(length, _CHUNK_TOP)
    yield start + length, start + length + min(chunk.message_index_length, _LARGEST_RECORD)


def _checked(length: int) -> int:
    if not 0 <= length <= _LARGEST_RECORD:
        raise ValueError(f"a record of {length} bytes; expected at most {_LARGEST_RECORD}")
    return length


def _records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """The records in some bytes, which have to be whole."""
    offset = 0
    while offset + _HEAD.size <= len(content):
        op, length = _HEAD.unpack_from(content, offset)
        stop = offset + _HEAD.size + length
        if stop > len(content):
            there = len(content) - offset - _HEAD.size
            raise ValueError(f"record {op} of {length} bytes, of which {there} are there")
        yield op, content[offset + _HEAD.size : stop]
        offset = stop


class _Bytes(ReadDataStream):
    """The content of a record; the package takes fewer bytes than a field has for the whole field."""

    def read(self, length: int) -> bytes:
        content = super().read(length)
        if len(content) != length:
            raise ValueError(f"{length} bytes expected in a record, of which {len(content)} are there")
        return content


def _parsed(read: Callable[[ReadDataStream], _Record], content: bytes | memoryview) -> _Record:
    """Parse a record by the package `mcap`."""
    try:
        return read(_Bytes(BytesIO(content)))
    except (McapError, struct.error) as error:
        raise ValueError(f"a record of {len(content)} bytes that ends too early") from error


def _scanned(file: FileBytes, ledger: Ledger, *, until: int) -> McapIndex:
    """Go from record to record through a file; chunks are passed over unless they are needed."""
    index, location = McapIndex.of(file), len(MCAP_MAGIC)
    scan = _Scan(index)
    try:
        location = _read_header(index)
        while location + _HEAD.size <= until:
            op, length = _HEAD.unpack(file.read(location, _HEAD.size))
            start = location + _HEAD.size
            if start + length > until:
                problem = f"record {op} of {length} bytes, of which {until - start} are there: the file is cut off"
                ledger.fault("mcap-cut-off", DataError(file.path, f"byte {location}", problem))
                break
            if op == Opcode.DATA_END:
                break
            scan.take(op, location, length)
            location = start + length
        scan.finish_chunk()
    except (ValueError, struct.error) as error:
        problem = f"the file is damaged: {error}"
        ledger.fault("mcap-damaged", DataError(file.path, f"byte {location}", problem))
    return index


class _Scan:
    """Takes the records of a file one after another; a chunk without an index of its messages is looked into."""

    def __init__(self, index: McapIndex) -> None:
        self.index, self.messages = index, index.messages
        self.indexed: set[int] | None = None  # channels that the index of the latest chunk names

    def take(self, op: int, location: int, length: int) -> None:
        """Take the record at a position of the file, and read no more of it than is needed."""
        if op != Opcode.MESSAGE_INDEX:
            self.finish_chunk()
        start = location + _HEAD.size
        if op == Opcode.CHUNK:
            self._take_chunk(location, length)
        elif op == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise ValueError(f"a message of {length} bytes")
            channel_id, _, log_time, _ = _MESSAGE.unpack(self.index.file.read(start, _MESSAGE.size))
            self.messages.add(channel_id, DIRECT, np.array([[_signed(log_time), location]], np.int64))
        elif op in {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.MESSAGE_INDEX}:
            self.take_content(op, self.index.file.read(start, _checked(length)))

    def take_content(self, op: int, content: bytes | memoryview) -> None:
        """Take the content of a schema, channel, metadata or message index."""
        if op == Opcode.SCHEMA:
            schema = _parsed(Schema.read, content)
            self.index.schemas[schema.id] = schema
        elif op == Opcode.CHANNEL:
            channel = _parsed(Channel.read, content)
            self.index.channels[channel.id] = channel
        elif op == Opcode.METADATA:
            metadata = _parsed(Metadata.read, content)
            self.index.metadata.append((metadata.name, metadata.metadata))
        elif op == Opcode.MESSAGE_INDEX and self.indexed is not None:
            channel_id, size = struct.unpack_from("<HI", content)
            # the package makes a tuple of each message, which takes ten times as long
            rows = np.frombuffer(content, "<i8", offset=6, count=size // 8).astype(np.int64).reshape(-1, 2)
            self.messages.add(channel_id, len(self.messages.chunks) - 1, rows)
            self.indexed.add(channel_id)

    def _take_chunk(self, location: int, length: int) -> None:
        head = self.index.file.read(location, min(_HEAD.size + length, _CHUNK_TOP))
        if not head or head[0] != Opcode.CHUNK:
            raise ValueError(f"no chunk at byte {location}")
        _, _, full_size, crc, name_size = _CHUNK.unpack_from(head, _HEAD.size)
        name_start = _HEAD.size + _CHUNK.size
        compression = head[name_start : name_start + name_size].decode()
        (size,) = struct.unpack_from("<Q", head, name_start + name_size)
        before = name_start + name_size + 8
        if before + size > _HEAD.size + length:
            raise ValueError(f"a chunk of {size} bytes in a record of {length}")
        self.messages.add_chunk(Chunk(location + before, size, full_size, compression, crc))
        self.indexed = set()

    def finish_chunk(self) -> None:
        """Look into the latest chunk where its index is missing or names channels that are not known."""
        if self.indexed is not None and (not self.indexed or not self.indexed <= set(self.index.channels)):
            self._look_into_latest(with_messages=not self.indexed)
        self.indexed = None

    def _look_into_latest(self, *, with_messages: bool) -> None:
        number, offset = len(self.messages.chunks) - 1, 0
        rows: dict[int, list[tuple[int, int]]] = {}
        for op, content in _records(memoryview(self.messages.unpacked(number))):
            if op in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self.take_content(op, content)
            elif op == Opcode.MESSAGE and with_messages:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(content)
                rows.setdefault(channel_id, []).append((_signed(log_time), offset))
            offset += _HEAD.size + len(content)
        for channel_id, found in rows.items():
            self.messages.add(channel_id, number, np.array(found, np.int64))


def _signed(time_ns: int) -> int:
    """A log time as int64; times beyond that are none of this world, and recognised by being negative."""
    return time_ns if time_ns < 1 << 63 else time_ns - (1 << 64)


_CHUNK_BYTES = 1 << 20  # a chunk ends as soon as it is as long as this; a longer message is one of its own
_COMPRESSIONS = ("none", "lz4", "zstd")  # what chunks can be compressed with
_MOST_IDS = 65535
_Part = bytes | memoryview

_LARGE_MESSAGE = 16 << 10  # messages from here on are in chunks of their own where that is wanted [bytes]

_WRITER_MESSAGE = struct.Struct("<BQHIQQ")
"""What comes before the data of a message: opcode, length, channel, sequence, log time, publish time."""


class _Chunk:
    """What will be written at once: its bytes, and the first and last time of its messages [ns], None without any."""

    def __init__(self) -> None:
        self.described: set[int] = set()
        self.begin()

    def begin(self) -> None:
        self.parts: list[_Part] = []
        self.size = 0
        self.times_ns: tuple[int, int] | None = None
        self.index: dict[int, list[bytes]] = {}

    def take(self, parts: Sequence[_Part]) -> None:
        self.parts += parts
        self.size += sum(len(part) for part in parts)

    def take_message(self, channel_id: int, log_time_ns: int, parts: Sequence[_Part]) -> None:
        self.index.setdefault(channel_id, []).append(struct.pack("<QQ", log_time_ns, self.size))
        earliest, latest = self.times_ns or (log_time_ns, log_time_ns)
        self.times_ns = min(earliest, log_time_ns), max(latest, log_time_ns)
        self.take(parts)


class McapWriter:
    """Writes messages to a file from its first byte on.

    Chunks that are not compressed have no checksum, as the format allows: it would take longer than writing them.
    """

    def __init__(
        self,
        stream: BinaryIO,
        *,
        profile: str = "",
        library: str,
        compression: str = "none",
        chunk_bytes: int = _CHUNK_BYTES,
        large_apart: bool = False,
    ) -> None:
        """Begin the file.

        Args:
            stream: a seekable binary file, not written to yet; it stays open.
            profile: "ros2", or "" for none.
            library: who writes.
            compression: "none", "lz4" or "zstd".
            chunk_bytes: how long chunks are before they are compressed.
            large_apart: put large messages into compressed chunks of their own, so that who wants the poses of a drive
                need not decompress, and fetch, its clouds and images; messages are then in the order of their times
                by the index alone, not as they come in the file.

        Raises:
            OptionError: there is no such compression.
            MissingExtraError: its library is not installed.
        """
        self._stream = stream
        self._compress = _compressor(compression)
        self._large_apart = large_apart and self._compress is not None
        self._compression = "" if compression == "none" else compression
        self._offset, self._chunk_bytes = 0, chunk_bytes
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: dict[int, int] = {}
        self._chunk_indexes: list[ChunkIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._chunk, self._large_chunk = _Chunk(), _Chunk()
        self._write(MCAP_MAGIC, _packed(Header(profile, library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema of messages, and give its id."""
        schema = Schema(_next_id(self._schemas), data, encoding, name)
        self._schemas[schema.id] = schema
        self._chunk.take([_packed(schema)])
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str] | None = None) -> int:
        """Begin a stream of messages, and give its id."""
        channel = Channel(_next_id(self._channels), topic, encoding, dict(metadata or {}), schema_id)
        self._channels[channel.id] = channel
        self._counts[channel.id] = 0
        self._chunk.take([_packed(channel)])
        self._chunk.described.add(channel.id)
        return channel.id

    def add_message(
        self, channel_id: int, log_time_ns: int, parts: Sequence[_Part], publish_time_ns: int | None = None
    ) -> None:
        """Write a message.

        Args:
            channel_id: its stream.
            log_time_ns: when it was recorded [ns], not negative.
            parts: its bytes, in chunks that stay as they are until the chunk is written.
            publish_time_ns: when it was published [ns]; None for the same.

        Raises:
            OutputError: the time is negative or too large.
        """
        published = log_time_ns if publish_time_ns is None else publish_time_ns
        if not (0 <= log_time_ns < 1 << 64 and 0 <= published < 1 << 64):
            raise OutputError(f"time {log_time_ns} ns; MCAP holds times from 0 to 2^64 ns: move the scene in time")
        size, number = sum(len(part) for part in parts), self._counts[channel_id]
        head = _WRITER_MESSAGE.pack(Opcode.MESSAGE, size + 22, channel_id, number & 0xFFFFFFFF, log_time_ns, published)
        self._counts[channel_id] += 1
        chunk = self._large_chunk if self._large_apart and size >= _LARGE_MESSAGE else self._chunk
        if channel_id not in chunk.described:
            # described in a chunk of its own, too, which may be written before the other one
            channel = self._channels[channel_id]
            schema = self._schemas.get(channel.schema_id)
            chunk.take([_packed(*([] if schema is None else [schema]), channel)])
            chunk.described.add(channel_id)
        chunk.take_message(channel_id, log_time_ns, [head, *parts])
        if chunk.size >= self._chunk_bytes:
            self._end_chunk(chunk)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write values that are no message."""
        self._end_chunks()
        content = _packed(Metadata(name, dict(values)))
        self._metadata_indexes.append(MetadataIndex(self._offset, len(content), name))
        self._write(content)

    def flush(self) -> None:
        """End the chunks at hand and hand all to the stream."""
        self._end_chunks()
        self._stream.flush()

    def finish(self) -> None:
        """Write the index; the stream stays open."""
        self._end_chunks()
        self._write(_packed(DataEnd(0)))
        start = self._offset
        summary, offsets = b"", list[SummaryOffset]()
        groups: tuple[tuple[Opcode, Iterable[McapRecord]], ...] = (
            (Opcode.SCHEMA, self._schemas.values()),
            (Opcode.CHANNEL, self._channels.values()),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        )
        for op, records in groups:
            content = _packed(*records)
            if content:
                offsets.append(SummaryOffset(op, start + len(summary), len(content)))
                summary += content
        offsets_start = start + len(summary)
        summary += _packed(*offsets)
        crc = zlib.crc32(_packed(Footer(start, offsets_start, 0))[:-4], zlib.crc32(summary))
        self._write(summary, _packed(Footer(start, offsets_start, crc)), MCAP_MAGIC)

    def _end_chunks(self) -> None:
        self._end_chunk(self._chunk)
        self._end_chunk(self._large_chunk)

    def _end_chunk(self, chunk: _Chunk) -> None:
        if not chunk.parts:
            return
        start_ns, stop_ns = chunk.times_ns or (0, 0)
        crc, parts = 0, chunk.parts
        if self._compress is not None:
            whole = b"".join(parts)
            crc, parts = zlib.crc32(whole), [self._compress(whole)]
        stored, name = sum(len(part) for part in parts), self._compression.encode()
        head = struct.pack("<QQQII", start_ns, stop_ns, chunk.size, crc, len(name)) + name
        head += struct.pack("<Q", stored)
        offset = self._offset
        self._write(struct.pack("<BQ", Opcode.CHUNK, len(head) + stored), head, *parts)
        index_offset, offsets = self._offset, {}
        for channel_id, rows in chunk.index.items():
            offsets[channel_id] = self._offset
            content = struct.pack("<HI", channel_id, 16 * len(rows)) + b"".join(rows)
            self._write(struct.pack("<BQ", Opcode.MESSAGE_INDEX, len(content)), content)
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_start_offset=offset,
                chunk_length=index_offset - offset,
                message_start_time=start_ns,
                message_end_time=stop_ns,
                message_index_offsets=offsets,
                message_index_length=self._offset - index_offset,
                compression=self._compression,
                compressed_size=stored,
                uncompressed_size=chunk.size,
            )
        )
        chunk.begin()

    def _statistics(self) -> Statistics:
        with_messages = [chunk for chunk in self._chunk_indexes if chunk.message_index_offsets]
        counts = {channel: count for channel, count in self._counts.items() if count}
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=counts,
            chunk_count=len(self._chunk_indexes),
            message_count=sum(counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in with_messages), default=0),
            message_start_time=min((chunk.message_start_time for chunk in with_messages), default=0),
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self._schemas),
        )

    def _write(self, *parts: _Part) -> None:
        for part in parts:
            self._stream.write(part)
            self._offset += len(part)


def _packed(*records: McapRecord) -> bytes:
    """The bytes of whole records."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    content: bytes = builder.end()  # type: ignore[no-untyped-call]  # it has no annotation
    return content


def _compressor(name: str) -> Callable[[bytes], bytes] | None:
    """What compresses a chunk; None for "none"."""
    check_choice("compression", name, _COMPRESSIONS)
    try:
        if name == "lz4":
            import lz4.frame

            return cast("Callable[[bytes], bytes]", lz4.frame.compress)
        if name == "zstd":
            import zstandard

            return zstandard.ZstdCompressor(level=1).compress
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install('mcap')}") from missing
    return None


def _next_id(known: Mapping[int, object]) -> int:
    if len(known) >= _MOST_IDS:
        raise OutputError(f"{_MOST_IDS} schemas or channels, as many as a file may have")
    return len(known) + 1
