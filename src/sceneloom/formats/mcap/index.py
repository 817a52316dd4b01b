"""Where the messages of an MCAP file stand: from its summary, or, where it has none, from a walk over its chunks.

Source: the MCAP specification, mcap.dev/spec.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.mcap.compression import decompress
from sceneloom.formats.mcap.records import (
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE,
    Channel,
    Fields,
    Op,
    Schema,
    read_channel,
    read_schema,
)
from sceneloom.formats.topics.chunks import ChunkPlace
from sceneloom.formats.topics.file_bytes import FileBytes

DIRECT = -1
"""In place of a chunk's number: the offset is a place in the file."""

LARGEST_CHUNK = 1 << 31
"""Chunks that claim to be larger are refused: a damaged head can claim any number [bytes]."""

LARGEST_RECORD = 1 << 30
"""Records of the index that claim to be larger are refused [bytes]."""

_CHUNK_HEAD = struct.Struct("<QQQI")
_CHUNK_TOP = 256

_Rows = tuple[list[Int64Array], list[Int64Array], list[Int64Array]]


@dataclass(frozen=True, slots=True, eq=False)
class Entries:
    """The messages of one channel in the order of the file.

    Attributes:
        log_times_ns: (N,) int64 [ns].
        chunks: (N,) int64, number of the chunk, `DIRECT` for none that would have to be decompressed.
        offsets: (N,) int64, place of the message's record in the chunk or the file.
    """

    log_times_ns: Int64Array
    chunks: Int64Array
    offsets: Int64Array

    def __len__(self) -> int:
        return len(self.offsets)


@dataclass(slots=True)
class McapIndex:
    """What is where in a file.

    Attributes:
        file: the bytes.
        profile, library: as the file's head says.
        schemas, channels: by their numbers.
        chunks: in the order of the file.
        metadata: names and values of what is no message.
    """

    file: FileBytes
    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkPlace] = field(default_factory=list)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    _rows: dict[int, _Rows] = field(default_factory=dict)

    @property
    def names_all_channels(self) -> bool:
        """Whether all messages are of channels that are known."""
        return set(self._rows) <= set(self.channels)

    def entries(self, channel_id: int) -> Entries:
        """The messages of a channel."""
        times, chunks, offsets = self._rows.get(channel_id, ([], [], []))
        return Entries(_joined(times), _joined(chunks), _joined(offsets))

    def add_rows(self, channel_id: int, chunk: int, rows: Int64Array) -> None:
        """Note down messages of a channel: (N, 2) log times and offsets in the chunk."""
        rows = rows[np.argsort(rows[:, 1], kind="stable")]
        number, shift = chunk, 0
        if chunk != DIRECT and self.chunks[chunk].compression == "":
            number, shift = DIRECT, self.chunks[chunk].start
        times, chunks, offsets = self._rows.setdefault(channel_id, ([], [], []))
        times.append(rows[:, 0])
        chunks.append(np.full(len(rows), number, np.int64))
        offsets.append(rows[:, 1] + shift)


def _joined(parts: list[Int64Array]) -> Int64Array:
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def read_index(file: FileBytes, ledger: Ledger) -> McapIndex:
    """Find all messages of a file without reading them.

    Raises:
        DataError: it is no MCAP file, or one that was not finished, is cut off or damaged; a lenient reading takes
            what is whole.
    """
    if file.read_up_to(0, len(MAGIC)) != MAGIC:
        raise DataError(file.path, "byte 0", f"does not begin as an MCAP file does, with {MAGIC!r}")
    index = McapIndex(file)
    summary = _summary_place(file)
    if summary is None:
        problem = (
            "the file was not finished: its end and index are missing; say `--lenient` to read what is whole"
        )
        ledger.fault("mcap-unfinished", DataError(file.path, f"byte {file.size}", problem))
        _walk(index, ledger, until=file.size)
        return index
    try:
        _read_head(index)
        if summary and _read_summary(index, summary):
            return index
    except (ValueError, struct.error, UnicodeDecodeError, DataError) as error:
        problem = error.problem if isinstance(error, DataError) else str(error)
        fault = DataError(file.path, "summary", f"the index is damaged: {problem}")
        ledger.fault("mcap-index-damaged", fault)
    index = McapIndex(file)
    _walk(index, ledger, until=summary or file.size)
    return index


def _summary_place(file: FileBytes) -> int | None:
    """Where the summary begins, 0 where there is none; None where the file has no end."""
    tail_size = HEAD.size + FOOTER.size + len(MAGIC)
    if file.size < len(MAGIC) + tail_size:
        return None
    tail = file.read(file.size - tail_size, tail_size)
    if not tail.endswith(MAGIC) or HEAD.unpack_from(tail) != (Op.FOOTER, FOOTER.size):
        return None
    start: int = FOOTER.unpack_from(tail, HEAD.size)[0]
    return start


def _read_head(index: McapIndex) -> int:
    """Read the first record, and give where it ends."""
    op, length = HEAD.unpack(index.file.read(len(MAGIC), HEAD.size))
    if op != Op.HEADER or length > LARGEST_RECORD:
        raise ValueError(f"record {op} of {length} bytes at the beginning; expected the header")
    start = len(MAGIC) + HEAD.size
    fields = Fields(index.file.read(start, length))
    index.profile, index.library = fields.text(), fields.text()
    return start + int(length)


def _read_summary(index: McapIndex, start: int) -> bool:
    """Read schemas, channels and places of chunks; whether that is all there is to know."""
    file = index.file
    if not len(MAGIC) <= start < file.size or file.size - start > LARGEST_RECORD:
        raise ValueError(f"a summary at byte {start} of {file.size}")
    content = memoryview(file.read(start, file.size - start))
    message_count, chunk_indexes = None, []
    for op, part in _records(content):
        if op == Op.SCHEMA:
            schema = read_schema(part)
            index.schemas[schema.id] = schema
        elif op == Op.CHANNEL:
            channel = read_channel(part)
            index.channels[channel.id] = channel
        elif op == Op.CHUNK_INDEX:
            chunk_indexes.append(part)
        elif op == Op.STATISTICS:
            message_count = Fields(part).number(8)
        elif op == Op.METADATA_INDEX:
            _add_metadata(index, part)
        elif op == Op.FOOTER:
            break
    file.expect(place for part in chunk_indexes for place in _chunk_places(Fields(part)))
    for part in chunk_indexes:
        if not _add_chunk(index, Fields(part)):
            return False
    # a summary may leave out channels, or all chunks where messages stand outside of them
    return index.names_all_channels and (bool(chunk_indexes) or message_count == 0)


def _add_metadata(index: McapIndex, content: memoryview) -> None:
    fields = Fields(content)
    start, length = fields.number(8), fields.number(8)
    if not HEAD.size <= length <= LARGEST_RECORD:
        raise ValueError(f"metadata of {length} bytes")
    found = Fields(index.file.read(start, length)[HEAD.size :])
    index.metadata.append((found.text(), found.texts()))


def _chunk_places(fields: Fields) -> Iterator[tuple[int, int]]:
    """Where the head of a chunk stands, and the index of its messages."""
    fields.blob_of(16)
    start, length = fields.number(8), fields.number(8)
    fields.numbers()
    yield start, start + min(length, _CHUNK_TOP)
    yield start + length, start + length + min(fields.number(8), LARGEST_RECORD)


def _add_chunk(index: McapIndex, fields: Fields) -> bool:
    """Note down a chunk and its messages; whether the file has an index of these."""
    fields.blob_of(16)
    start, length = fields.number(8), fields.number(8)
    places, index_length = fields.numbers(), fields.number(8)
    compression, size, full_size = fields.text(), fields.number(8), fields.number(8)
    head = index.file.read(start, min(length, _CHUNK_TOP))
    if not head or head[0] != Op.CHUNK:
        raise ValueError(f"no chunk at byte {start}")
    crc = _CHUNK_HEAD.unpack_from(head, HEAD.size)[3]
    index.chunks.append(_checked(ChunkPlace(start + length - size, size, full_size, compression, crc)))
    if not places:
        return full_size == 0
    if index_length > LARGEST_RECORD:
        raise ValueError(f"an index of {index_length} bytes")
    for op, part in _records(memoryview(index.file.read(start + length, index_length))):
        if op == Op.MESSAGE_INDEX:
            _add_message_index(index, len(index.chunks) - 1, part)
    return True


def _checked(chunk: ChunkPlace) -> ChunkPlace:
    if chunk.full_size > LARGEST_CHUNK or chunk.size > LARGEST_CHUNK:
        raise ValueError(f"a chunk of {chunk.full_size} bytes; expected at most {LARGEST_CHUNK}")
    return chunk


def _add_message_index(index: McapIndex, chunk: int, content: memoryview) -> int:
    fields = Fields(content)
    channel_id, rows = fields.number(2), fields.blob()
    if len(rows) % 16:
        raise ValueError(f"an index of messages of {len(rows)} bytes; expected a multiple of 16")
    index.add_rows(channel_id, chunk, np.frombuffer(rows, "<i8").reshape(-1, 2).astype(np.int64))
    return channel_id


def _records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """The records in some bytes, which have to be whole."""
    place = 0
    while place + HEAD.size <= len(content):
        op, length = HEAD.unpack_from(content, place)
        stop = place + HEAD.size + length
        if stop > len(content):
            raise ValueError(
                f"record {op} of {length} bytes, of which {len(content) - place - HEAD.size} are there"
            )
        yield op, content[place + HEAD.size : stop]
        place = stop


def _walk(index: McapIndex, ledger: Ledger, *, until: int) -> None:
    """Go from record to record through a file without a summary; chunks are passed over unless they are needed."""
    file, place, waiting = index.file, len(MAGIC), _Waiting(index)
    try:
        place = _read_head(index)
        while place + HEAD.size <= until:
            op, length = HEAD.unpack(file.read(place, HEAD.size))
            start = place + HEAD.size
            if start + length > until:
                problem = (
                    f"record {op} of {length} bytes, of which {until - start} are there: the file is cut off"
                )
                ledger.fault("mcap-cut-off", DataError(file.path, f"byte {place}", problem))
                break
            if op == Op.DATA_END:
                break
            waiting.take(op, place, length)
            place = start + length
        waiting.finish()
    except (ValueError, struct.error, UnicodeDecodeError) as error:
        ledger.fault("mcap-damaged", DataError(file.path, f"byte {place}", f"the file is damaged: {error}"))


class _Waiting:
    """Takes the records of a file one after another; a chunk without an index is looked into."""

    def __init__(self, index: McapIndex) -> None:
        self.index = index
        self.indexed: set[int] | None = None
        self.takers: dict[int, Callable[[int, int], None]] = {
            Op.SCHEMA: self._schema,
            Op.CHANNEL: self._channel,
            Op.MESSAGE: self._message,
            Op.CHUNK: self._chunk,
            Op.MESSAGE_INDEX: self._message_index,
            Op.METADATA: self._metadata,
        }

    def take(self, op: int, place: int, length: int) -> None:
        if op != Op.MESSAGE_INDEX:
            self.finish()
        if op in self.takers:
            self.takers[op](place, length)

    def finish(self) -> None:
        """Look into the last chunk where its index is missing or names channels that are not known."""
        if self.indexed is not None and (not self.indexed or not self.indexed <= set(self.index.channels)):
            self._look_into(len(self.index.chunks) - 1, with_messages=not self.indexed)
        self.indexed = None

    def _content(self, place: int, length: int) -> bytes:
        if length > LARGEST_RECORD:
            raise ValueError(f"a record of {length} bytes")
        return self.index.file.read(place + HEAD.size, length)

    def _schema(self, place: int, length: int) -> None:
        schema = read_schema(self._content(place, length))
        self.index.schemas[schema.id] = schema

    def _channel(self, place: int, length: int) -> None:
        channel = read_channel(self._content(place, length))
        self.index.channels[channel.id] = channel

    def _metadata(self, place: int, length: int) -> None:
        fields = Fields(self._content(place, length))
        self.index.metadata.append((fields.text(), fields.texts()))

    def _message(self, place: int, length: int) -> None:
        if length < MESSAGE.size:
            raise ValueError(f"a message of {length} bytes")
        channel_id, _, log_time, _ = MESSAGE.unpack(self.index.file.read(place + HEAD.size, MESSAGE.size))
        self.index.add_rows(channel_id, DIRECT, np.array([[_signed(log_time), place]], np.int64))

    def _chunk(self, place: int, length: int) -> None:
        fields = Fields(self.index.file.read(place + HEAD.size, min(length, _CHUNK_TOP)))
        fields.blob_of(16)
        full_size, crc = fields.number(8), fields.number(4)
        compression, size = fields.text(), fields.number(8)
        start = place + HEAD.size + fields.place
        if start + size > place + HEAD.size + length:
            raise ValueError(f"a chunk of {size} bytes in a record of {length}")
        self.index.chunks.append(_checked(ChunkPlace(start, size, full_size, compression, crc)))
        self.indexed = set()

    def _message_index(self, place: int, length: int) -> None:
        if self.indexed is not None:
            content = memoryview(self._content(place, length))
            self.indexed.add(_add_message_index(self.index, len(self.index.chunks) - 1, content))

    def _look_into(self, number: int, *, with_messages: bool) -> None:
        chunk = self.index.chunks[number]
        content = self.index.file.read(chunk.start, chunk.size)
        rows: dict[int, list[tuple[int, int]]] = {}
        place = 0
        for op, part in _records(memoryview(decompress(chunk.compression, content, chunk.full_size))):
            if op == Op.SCHEMA:
                schema = read_schema(part)
                self.index.schemas[schema.id] = schema
            elif op == Op.CHANNEL:
                channel = read_channel(part)
                self.index.channels[channel.id] = channel
            elif op == Op.MESSAGE and with_messages:
                channel_id, _, log_time, _ = MESSAGE.unpack_from(part)
                rows.setdefault(channel_id, []).append((_signed(log_time), place))
            place += HEAD.size + len(part)
        for channel_id, found in rows.items():
            self.index.add_rows(channel_id, number, np.array(found, np.int64))


def _signed(time_ns: int) -> int:
    """A log time as int64; times beyond that are none of this world, and told by their being negative."""
    return time_ns if time_ns < 1 << 63 else time_ns - (1 << 64)
