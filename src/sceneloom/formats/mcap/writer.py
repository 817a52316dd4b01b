"""Writing MCAP files: messages in chunks, then an index of all of them; nothing is kept but the chunks at hand.

The package `mcap` writes all records but chunks and messages. Its writer copies each message four times, which makes
the writing of uncompressed sweeps and images ten times as slow, and it has one chunk at hand and no level of zstd.

Source: the MCAP specification, mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import BinaryIO, cast

from mcap.data_stream import RecordBuilder
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

from sceneloom.errors import MissingExtraError, OptionError, OutputError, how_to_install
from sceneloom.formats.topics.spec import MCAP_MAGIC

CHUNK_BYTES = 1 << 20
"""A chunk ends as soon as it is as long as this; a longer message is one of its own."""

COMPRESSIONS = ("none", "lz4", "zstd")
"""What chunks can be compressed with."""

MOST_IDS = 65535

Part = bytes | memoryview

_LARGE_MESSAGE = 16 << 10
"""Messages from here on are in chunks of their own where that is wanted [bytes]."""

_MESSAGE = struct.Struct("<BQHIQQ")
"""What comes before the data of a message: opcode, length, channel, sequence, log time, publish time."""


class _Chunk:
    """What will be written at once.

    Attributes:
        parts: its bytes, in chunks.
        size: of all of them.
        times_ns: first and last time of its messages [ns], None where it has none.
        index: log times of the messages of each channel and their offsets, packed one after another.
        described: channels that were described in this chunk, or one before that was written in its location.
    """

    def __init__(self) -> None:
        self.described: set[int] = set()
        self.begin()

    def begin(self) -> None:
        self.parts: list[Part] = []
        self.size = 0
        self.times_ns: tuple[int, int] | None = None
        self.index: dict[int, list[bytes]] = {}

    def take(self, parts: Sequence[Part]) -> None:
        self.parts += parts
        self.size += sum(len(part) for part in parts)

    def take_message(self, channel_id: int, log_time_ns: int, parts: Sequence[Part]) -> None:
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
        chunk_bytes: int = CHUNK_BYTES,
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

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Begin a stream of messages, and give its id."""
        channel = Channel(_next_id(self._channels), topic, encoding, dict(metadata or {}), schema_id)
        self._channels[channel.id] = channel
        self._counts[channel.id] = 0
        self._chunk.take([_packed(channel)])
        self._chunk.described.add(channel.id)
        return channel.id

    def add_message(
        self, channel_id: int, log_time_ns: int, parts: Sequence[Part], publish_time_ns: int | None = None
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
            raise OutputError(
                f"time {log_time_ns} ns; MCAP holds times from 0 to 2^64 ns: move the scene in time"
            )
        size, number = sum(len(part) for part in parts), self._counts[channel_id]
        head = _MESSAGE.pack(
            Opcode.MESSAGE, size + 22, channel_id, number & 0xFFFFFFFF, log_time_ns, published
        )
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

    def _write(self, *parts: Part) -> None:
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
    if name not in COMPRESSIONS:
        raise OptionError(f"compression {name!r}; expected one of {', '.join(COMPRESSIONS)}")
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
    if len(known) >= MOST_IDS:
        raise OutputError(f"{MOST_IDS} schemas or channels, as many as a file may have")
    return len(known) + 1
