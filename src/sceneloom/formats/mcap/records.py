"""The records of MCAP files: their numbers, their layouts, and how they are taken apart and put together.

Source: the MCAP specification, mcap.dev/spec.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

from sceneloom.scene.types import NO_FIELDS

MAGIC = b"\x89MCAP0\r\n"
"""What a file begins and ends with."""

HEAD = struct.Struct("<BQ")
"""Number and length of a record, which its content follows."""

MESSAGE = struct.Struct("<HIQQ")
"""What stands before the data of a message: channel, sequence, log time, publish time."""

FOOTER = struct.Struct("<QQI")
"""Content of the last record: starts of the summary and of its offsets, and the summary's checksum."""


class Op(IntEnum):
    """The kinds of records."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


@dataclass(frozen=True, slots=True)
class Schema:
    """What the messages of channels are."""

    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A stream of messages of one schema; schema 0 stands for none."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: Mapping[str, str] = field(default_factory=lambda: NO_FIELDS)


class Fields:
    """Reads the fields of a record one after another; what does not fit raises ValueError."""

    def __init__(self, content: bytes | memoryview) -> None:
        """Begin at the first byte."""
        self.content = memoryview(content)
        self.place = 0

    def number(self, size: int) -> int:
        """A number of so many bytes, the lowest first."""
        return int.from_bytes(self.blob_of(size), "little")

    def blob_of(self, size: int) -> memoryview:
        """So many bytes."""
        stop = self.place + size
        if stop > len(self.content):
            raise ValueError(f"{size} bytes wanted at byte {self.place} of a record of {len(self.content)}")
        part = self.content[self.place : stop]
        self.place = stop
        return part

    def blob(self, size: int = 4) -> memoryview:
        """Bytes that follow their length, which is a number of `size` bytes."""
        return self.blob_of(self.number(size))

    def text(self) -> str:
        """A text that follows its length."""
        return str(self.blob(), "utf-8")

    def texts(self) -> dict[str, str]:
        """Pairs of texts."""
        inner, found = Fields(self.blob()), {}
        while inner.place < len(inner.content):
            name = inner.text()
            found[name] = inner.text()
        return found

    def numbers(self) -> dict[int, int]:
        """Pairs of a number of two bytes and one of eight."""
        content = self.blob()
        if len(content) % 10:
            raise ValueError(f"{len(content)} bytes of pairs; expected a multiple of 10")
        return dict(struct.iter_unpack("<HQ", content))


def read_schema(content: bytes | memoryview) -> Schema:
    """Take a schema apart."""
    fields = Fields(content)
    return Schema(fields.number(2), fields.text(), fields.text(), bytes(fields.blob()))


def read_channel(content: bytes | memoryview) -> Channel:
    """Take a channel apart."""
    fields = Fields(content)
    return Channel(fields.number(2), fields.number(2), fields.text(), fields.text(), fields.texts())


def text_bytes(text: str) -> bytes:
    """A text behind its length."""
    content = text.encode()
    return struct.pack("<I", len(content)) + content


def pairs_bytes(pairs: Mapping[str, str]) -> bytes:
    """Pairs of texts behind their length."""
    content = b"".join(text_bytes(name) + text_bytes(value) for name, value in pairs.items())
    return struct.pack("<I", len(content)) + content


def numbers_bytes(pairs: Mapping[int, int]) -> bytes:
    """Pairs of numbers behind their length."""
    content = b"".join(struct.pack("<HQ", *pair) for pair in pairs.items())
    return struct.pack("<I", len(content)) + content


def record(op: Op, content: bytes) -> bytes:
    """A whole record."""
    return HEAD.pack(op, len(content)) + content


def schema_record(schema: Schema) -> bytes:
    """Put a schema together."""
    head = struct.pack("<H", schema.id) + text_bytes(schema.name) + text_bytes(schema.encoding)
    return record(Op.SCHEMA, head + struct.pack("<I", len(schema.data)) + schema.data)


def channel_record(channel: Channel) -> bytes:
    """Put a channel together."""
    head = struct.pack("<HH", channel.id, channel.schema_id)
    return record(
        Op.CHANNEL,
        head + text_bytes(channel.topic) + text_bytes(channel.encoding) + pairs_bytes(channel.metadata),
    )
