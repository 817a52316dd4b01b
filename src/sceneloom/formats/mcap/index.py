"""Where the messages of an MCAP file are: from its summary, or, where it has none, from a scan over its records.

The package `mcap` parses the records. Its readers are not used: they give messages in order of time and not by number,
read damaged files not at all, and decompress without a bound.

Source: the MCAP specification, mcap.dev/spec.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Metadata, MetadataIndex, Schema, Statistics

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.chunks import DIRECT, Chunk, ChunkedMessages
from sceneloom.formats.topics.file_bytes import FileBytes
from sceneloom.formats.topics.spec import MCAP_MAGIC

LARGEST_RECORD = 1 << 30
"""Records of the index that claim to be larger are refused [bytes]."""

_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record, which its content follows."""

_MESSAGE = struct.Struct("<HIQQ")
"""What comes before the data of a message: channel, sequence, log time, publish time."""

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
        problem = "the file was not finished: its end and index are missing; state `--lenient` to read what is whole"
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
    if op != Opcode.HEADER or length > LARGEST_RECORD:
        raise ValueError(f"record {op} of {length} bytes at the beginning; expected the header")
    start = len(MCAP_MAGIC) + _HEAD.size
    header = _parsed(Header.read, index.file.read(start, length))
    index.profile, index.library = header.profile, header.library
    return start + int(length)


def _read_summary(index: McapIndex, start: int) -> bool:
    """Read schemas, channels and locations of messages; whether that is all there is to know."""
    file, scan = index.file, _Scan(index)
    if not len(MCAP_MAGIC) <= start < file.size or file.size - start > LARGEST_RECORD:
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
    yield start + length, start + length + min(chunk.message_index_length, LARGEST_RECORD)


def _checked(length: int) -> int:
    if not 0 <= length <= LARGEST_RECORD:
        raise ValueError(f"a record of {length} bytes; expected at most {LARGEST_RECORD}")
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
    """Parse a record by the package `mcap`.

    Raises:
        ValueError: it is damaged.
    """
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
                problem = (
                    f"record {op} of {length} bytes, of which {until - start} are there: the file is cut off"
                )
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
        """Take the record at a location of the file, and read no more of it than is needed."""
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
