"""Bags of ROS 1: where their messages stand, found by a walk over the heads of their chunks.

Source: wiki.ros.org/Bags/Format/2.0.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.ros.bags import Connection, full_type
from sceneloom.formats.topics.chunks import Chunk, ChunkedMessages
from sceneloom.formats.topics.file_bytes import FileBytes

MAGIC = b"#ROSBAG V2.0\n"
"""What a bag begins with."""

_MESSAGE, _BAG, _INDEX, _CHUNK, _CONNECTION = 0x02, 0x03, 0x04, 0x05, 0x07
_LONGEST_HEAD = 1 << 20
_HEAD_ROOM = 512

Fields = dict[str, bytes]


@dataclass(frozen=True, slots=True)
class _Record:
    """A record: its fields, and where its data stand."""

    fields: Fields
    start: int
    size: int

    @property
    def op(self) -> int:
        return int.from_bytes(self.fields.get("op", b"")[:1])

    def number(self, name: str) -> int:
        return int.from_bytes(self.fields.get(name, b""), "little")


class Ros1Bag:
    """The messages of a bag.

    Attributes:
        connections: all streams.
    """

    def __init__(self, path: Path, ledger: Ledger) -> None:
        """Read which messages there are.

        Raises:
            DataError: the bag was not closed, is cut off or damaged; a lenient reading takes what is whole.
        """
        self._file = FileBytes(path)
        self._messages = ChunkedMessages(self._file, _message_at, _HEAD_ROOM)
        self._found: dict[int, Connection] = {}
        self._indexed = True
        try:
            self._check_beginning()
            self._walk(ledger)
        except BaseException:
            self._file.close()
            raise
        numbers = sorted(self._found)
        self.connections = tuple(self._found[number] for number in numbers)
        self._entries = [self._messages.entries(number) for number in numbers]

    def _check_beginning(self) -> None:
        if self._file.read_up_to(0, len(MAGIC)) != MAGIC:
            problem = f"does not begin as a bag of ROS 1 does, with {MAGIC!r}"
            raise DataError(self._file.path, "byte 0", problem)

    def _walk(self, ledger: Ledger) -> None:
        file, place = self._file, len(MAGIC)
        while place < file.size:
            try:
                record = self._record_at(place)
            except (ValueError, struct.error, DataError) as error:
                problem = error.problem if isinstance(error, DataError) else str(error)
                fault = DataError(file.path, f"byte {place}", f"the bag is cut off or damaged: {problem}")
                ledger.fault("bag-cut-off", fault)
                break
            if record.op == _BAG and record.number("index_pos") == 0:
                problem = (
                    "the bag was not closed, its index is missing; say `--lenient` to read what is whole"
                )
                ledger.fault("bag-unfinished", DataError(file.path, f"byte {place}", problem))
            try:
                self._take(record, ledger)
            except (ValueError, struct.error) as error:
                fault = DataError(file.path, f"byte {record.start}", f"the record is damaged: {error}")
                ledger.fault("bag-damaged", fault)
            place = record.start + record.size
        self._look_into_last(ledger)

    def _record_at(self, place: int) -> _Record:
        (length,) = struct.unpack("<I", self._file.read(place, 4))
        if length > _LONGEST_HEAD:
            raise ValueError(f"a record's head of {length} bytes")
        fields = _fields(self._file.read(place + 4, length))
        if "op" not in fields:
            raise ValueError(f"a record's head of {length} bytes without `op`")
        (size,) = struct.unpack("<I", self._file.read(place + 4 + length, 4))
        start = place + 8 + length
        if start + size > self._file.size:
            raise ValueError(f"a record of {size} bytes, of which {self._file.size - start} are there")
        return _Record(fields, start, size)

    def _take(self, record: _Record, ledger: Ledger) -> None:
        if record.op == _CONNECTION:
            self._add_connection(
                record.number("conn"), record.fields, self._file.read(record.start, record.size)
            )
        elif record.op == _INDEX:
            self._indexed = True
            self._add_index(record)
        elif record.op == _CHUNK:
            self._look_into_last(ledger)
            compression = record.fields.get("compression", b"none").decode("ascii", "replace")
            name = "" if compression == "none" else compression
            self._messages.add_chunk(Chunk(record.start, record.size, record.number("size"), name))
            self._indexed = False

    def _add_connection(self, number: int, fields: Fields, content: bytes) -> None:
        told = _fields(content)
        texts = {name: value.decode("utf-8", "replace") for name, value in told.items()}
        topic = fields.get("topic", b"").decode("utf-8", "replace")
        kind = full_type(texts.get("type", ""))
        self._found[number] = Connection(topic, kind, texts.get("message_definition", ""), "ros1msg", "ros1")

    def _add_index(self, record: _Record) -> None:
        if not self._messages.chunks:
            raise ValueError("an index before any chunk")
        rows = np.frombuffer(self._file.read(record.start, record.size), np.dtype("<u4")).reshape(-1, 3)
        times_ns = rows[:, 0].astype(np.int64) * 1_000_000_000 + rows[:, 1]
        found = np.stack((times_ns, rows[:, 2].astype(np.int64)), axis=1)
        self._messages.add(record.number("conn"), len(self._messages.chunks) - 1, found)

    def _look_into_last(self, ledger: Ledger) -> None:
        """Look into the last chunk where no index follows it, or where connections are not known otherwise."""
        number = len(self._messages.chunks) - 1
        if number >= 0 and (not self._indexed or not self._messages.streams <= set(self._found)):
            try:
                self._look_into(number, with_messages=not self._indexed)
            except (ValueError, struct.error) as error:
                fault = DataError(self._file.path, f"chunk {number}", f"damaged: {error}")
                ledger.fault("bag-damaged", fault)
        self._indexed = True

    def _look_into(self, number: int, *, with_messages: bool) -> None:
        content = self._messages.unpacked(number)
        rows: dict[int, list[tuple[int, int]]] = {}
        offset = 0
        while offset + 8 <= len(content):
            fields, start, size = _record_in(content, offset)
            op, connection = (
                int.from_bytes(fields.get("op", b"")[:1]),
                int.from_bytes(fields.get("conn", b""), "little"),
            )
            if op == _CONNECTION:
                self._add_connection(connection, fields, content[start : start + size])
            elif op == _MESSAGE and with_messages and start + size <= len(content):
                seconds, nanoseconds = struct.unpack("<II", fields.get("time", bytes(8)))
                rows.setdefault(connection, []).append((seconds * 1_000_000_000 + nanoseconds, offset))
            offset = start + size
        for connection, found in rows.items():
            self._messages.add(connection, number, np.array(found, np.int64))

    def received(self, number: int) -> Int64Array:
        """When the messages of a connection were recorded."""
        return self._entries[number].log_times_ns

    def data(self, number: int, k: int) -> memoryview:
        """The bytes of message `k` of a connection.

        Raises:
            DataError: the bag is damaged there.
        """
        return self._messages.data(self._entries[number], k)

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins."""
        entries = self._entries[number]
        return self._messages.heads(entries, np.arange(len(entries)), size)

    def close(self) -> None:
        """Release the file."""
        self._file.close()


def _message_at(content: bytes, offset: int) -> tuple[int, int]:
    fields, start, size = _record_in(content, offset)
    if int.from_bytes(fields.get("op", b"")[:1]) != _MESSAGE:
        raise ValueError("another record")
    return start, size


def _fields(content: bytes) -> Fields:
    """The fields of a record's head: `name=value` behind their length."""
    found, place = {}, 0
    while place < len(content):
        (length,) = struct.unpack_from("<I", content, place)
        name, equals, value = content[place + 4 : place + 4 + length].partition(b"=")
        if not equals or place + 4 + length > len(content):
            raise ValueError(f"a field of {length} bytes in a head of {len(content)}; expected name=value")
        found[name.decode("ascii", "replace")] = value
        place += 4 + length
    return found


def _record_in(content: bytes, offset: int) -> tuple[Fields, int, int]:
    """Fields of a record in some bytes, and where its data stand."""
    (length,) = struct.unpack_from("<I", content, offset)
    if offset + 8 + length > len(content):
        raise ValueError(f"a record's head of {length} bytes in {len(content) - offset}")
    (size,) = struct.unpack_from("<I", content, offset + 4 + length)
    return _fields(content[offset + 4 : offset + 4 + length]), offset + 8 + length, size
