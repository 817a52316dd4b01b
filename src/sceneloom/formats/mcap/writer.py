"""Writing MCAP files: messages in chunks, then an index of all of them; nothing is kept but the chunks at hand.

Source: the MCAP specification, mcap.dev/spec.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import BinaryIO

from sceneloom.errors import OutputError
from sceneloom.formats.mcap.compression import compressor
from sceneloom.formats.mcap.records import (
    FOOTER,
    HEAD,
    MAGIC,
    MESSAGE,
    Channel,
    Op,
    Schema,
    channel_record,
    numbers_bytes,
    pairs_bytes,
    record,
    schema_record,
    text_bytes,
)

CHUNK_BYTES = 1 << 20
"""A chunk ends as soon as it is as long as this; a longer message is one of its own."""

MOST_IDS = 65535

Part = bytes | memoryview

_LARGE_MESSAGE = 16 << 10
"""Messages from here on stand in chunks of their own where that is wanted [bytes]."""


class _Chunk:
    """What will be written at once.

    Attributes:
        parts: its bytes, in pieces.
        size: of all of them.
        span: of the times of its messages [ns], None where it has none.
        index: times of the messages of each channel, and where they stand.
        said: channels that were described in this chunk, or one before that was written in its place.
    """

    def __init__(self) -> None:
        self.said: set[int] = set()
        self.begin()

    def begin(self) -> None:
        """Hold nothing."""
        self.parts: list[Part] = []
        self.size = 0
        self.span: tuple[int, int] | None = None
        self.index: dict[int, list[tuple[int, int]]] = {}

    def take(self, parts: Sequence[Part]) -> None:
        """Take bytes."""
        self.parts += parts
        self.size += sum(len(part) for part in parts)

    def take_message(self, channel_id: int, log_time_ns: int, parts: Sequence[Part]) -> None:
        """Take a message."""
        self.index.setdefault(channel_id, []).append((log_time_ns, self.size))
        self.span = _wider(self.span, log_time_ns)
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
                need not decompress, and fetch, its clouds and pictures; messages are then in the order of their times
                by the index alone, not as they come in the file.

        Raises:
            OptionError: there is no such compression.
            MissingExtraError: its library is not installed.
        """
        self._stream = stream
        self._compress = compressor(compression)
        self._large_apart = large_apart and self._compress is not None
        self._compression = "" if compression == "none" else compression
        self._place, self._chunk_bytes = 0, chunk_bytes
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: dict[int, int] = {}
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._span: tuple[int, int] | None = None
        self._chunk, self._large_chunk = _Chunk(), _Chunk()
        self._write(MAGIC + record(Op.HEADER, text_bytes(profile) + text_bytes(library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Say what messages are, and give the number of that."""
        schema = Schema(_next_id(self._schemas), name, encoding, data)
        self._schemas[schema.id] = schema
        self._chunk.take([schema_record(schema)])
        return schema.id

    def add_channel(
        self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str] | None = None
    ) -> int:
        """Begin a stream of messages, and give its number."""
        channel = Channel(_next_id(self._channels), schema_id, topic, encoding, metadata or {})
        self._channels[channel.id] = channel
        self._counts[channel.id] = 0
        self._chunk.take([channel_record(channel)])
        self._chunk.said.add(channel.id)
        return channel.id

    def add_message(
        self, channel_id: int, log_time_ns: int, parts: Sequence[Part], publish_time_ns: int | None = None
    ) -> None:
        """Write a message.

        Args:
            channel_id: its stream.
            log_time_ns: when it was recorded [ns], not negative.
            parts: its bytes, in pieces that stay as they are until the chunk is written.
            publish_time_ns: when it was said [ns]; None for the same.

        Raises:
            OutputError: the time is negative or too large.
        """
        published = log_time_ns if publish_time_ns is None else publish_time_ns
        if not (0 <= log_time_ns < 1 << 64 and 0 <= published < 1 << 64):
            raise OutputError(
                f"time {log_time_ns} ns; MCAP holds times from 0 to 2^64 ns: move the scene in time"
            )
        size = MESSAGE.size + sum(len(part) for part in parts)
        head = HEAD.pack(Op.MESSAGE, size) + MESSAGE.pack(
            channel_id, self._counts[channel_id] & 0xFFFFFFFF, log_time_ns, published
        )
        self._counts[channel_id] += 1
        chunk = self._large_chunk if self._large_apart and size >= _LARGE_MESSAGE else self._chunk
        if channel_id not in chunk.said:
            self._say(chunk, channel_id)
        chunk.take_message(channel_id, log_time_ns, [head, *parts])
        if chunk.size >= self._chunk_bytes:
            self._end_chunk(chunk)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write values that are no message."""
        self._end_chunks()
        content = record(Op.METADATA, text_bytes(name) + pairs_bytes(values))
        index = struct.pack("<QQ", self._place, len(content)) + text_bytes(name)
        self._metadata_indexes.append(record(Op.METADATA_INDEX, index))
        self._write(content)

    def flush(self) -> None:
        """End the chunks at hand and hand all to the stream."""
        self._end_chunks()
        self._stream.flush()

    def finish(self) -> None:
        """Write the index; the stream stays open."""
        self._end_chunks()
        self._write(record(Op.DATA_END, bytes(4)))
        start = self._place
        groups = (
            (Op.SCHEMA, [schema_record(schema) for schema in self._schemas.values()]),
            (Op.CHANNEL, [channel_record(channel) for channel in self._channels.values()]),
            (Op.STATISTICS, [self._statistics()]),
            (Op.CHUNK_INDEX, self._chunk_indexes),
            (Op.METADATA_INDEX, self._metadata_indexes),
        )
        summary, offsets = b"", b""
        for op, records in groups:
            content = b"".join(records)
            if content:
                place = struct.pack("<BQQ", op, start + len(summary), len(content))
                offsets += record(Op.SUMMARY_OFFSET, place)
                summary += content
        offsets_start = start + len(summary)
        head = HEAD.pack(Op.FOOTER, FOOTER.size) + struct.pack("<QQ", start, offsets_start)
        crc = zlib.crc32(head, zlib.crc32(summary + offsets))
        self._write(summary + offsets + head + struct.pack("<I", crc) + MAGIC)

    def _say(self, chunk: "_Chunk", channel_id: int) -> None:
        """Say in a chunk of its own what the messages of a channel are: it may be written before the other one."""
        channel = self._channels[channel_id]
        schema = self._schemas.get(channel.schema_id)
        chunk.take([*([] if schema is None else [schema_record(schema)]), channel_record(channel)])
        chunk.said.add(channel_id)

    def _end_chunks(self) -> None:
        self._end_chunk(self._chunk)
        self._end_chunk(self._large_chunk)

    def _end_chunk(self, chunk: "_Chunk") -> None:
        if not chunk.parts:
            return
        start_ns, stop_ns = chunk.span or (0, 0)
        size, crc, parts = chunk.size, 0, chunk.parts
        if self._compress is not None:
            whole = b"".join(parts)
            crc, parts = zlib.crc32(whole), [self._compress(whole)]
        stored = sum(len(part) for part in parts)
        head = struct.pack("<QQQI", start_ns, stop_ns, size, crc) + text_bytes(self._compression)
        head += struct.pack("<Q", stored)
        place, length = self._place, HEAD.size + len(head) + stored
        self._write(HEAD.pack(Op.CHUNK, len(head) + stored) + head, *parts)
        self._end_index(chunk, struct.pack("<QQQQ", start_ns, stop_ns, place, length), stored)

    def _end_index(self, chunk: "_Chunk", head: bytes, stored: int) -> None:
        """Write where each channel's messages stand in the chunk, and note down where that is said."""
        begin, places = self._place, {}
        for channel_id, rows in chunk.index.items():
            places[channel_id] = self._place
            content = b"".join(struct.pack("<QQ", *row) for row in rows)
            self._write(record(Op.MESSAGE_INDEX, struct.pack("<HI", channel_id, len(content)) + content))
        tail = struct.pack("<Q", self._place - begin) + text_bytes(self._compression)
        tail += struct.pack("<QQ", stored, chunk.size)
        self._chunk_indexes.append(record(Op.CHUNK_INDEX, head + numbers_bytes(places) + tail))
        for time_ns in chunk.span or ():
            self._span = _wider(self._span, time_ns)
        chunk.begin()

    def _statistics(self) -> bytes:
        counts = {channel: count for channel, count in self._counts.items() if count}
        head = struct.pack(
            "<QHIIIIQQ",
            sum(counts.values()),
            len(self._schemas),
            len(self._channels),
            0,
            len(self._metadata_indexes),
            len(self._chunk_indexes),
            *(self._span or (0, 0)),
        )
        return record(Op.STATISTICS, head + numbers_bytes(counts))

    def _write(self, *parts: Part) -> None:
        for part in parts:
            self._stream.write(part)
            self._place += len(part)


def _next_id(known: Mapping[int, object]) -> int:
    if len(known) >= MOST_IDS:
        raise OutputError(f"{MOST_IDS} schemas or channels, as many as a file may have")
    return len(known) + 1


def _wider(span: tuple[int, int] | None, time_ns: int) -> tuple[int, int]:
    return (time_ns, time_ns) if span is None else (min(span[0], time_ns), max(span[1], time_ns))
