"""Bags of ROS 1 and ROS 2: connections, and messages by their number, in `.bag`, SQLite and MCAP files."""

import os
import re
import sqlite3
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from threading import RLock
from types import MappingProxyType
from typing import Any, Protocol
from urllib.parse import quote

import numpy as np
from rosbags.rosbag1.reader import Header, ReaderError, RecordType, read_uint32
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import check_regular, file_faults, most_unpacked, read_bytes
from sceneloom.formats.messages.file_bytes import Chunk, ChunkedMessages, FileBytes, decompress
from sceneloom.formats.messages.mcap_files import McapIndex, read_index
from sceneloom.formats.messages.spec import METADATA, ROOT_KEY
from sceneloom.warnings import WarningKind

_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_LONGEST_HEAD = 1 << 20

_HEAD_ROOM = 512  # heads of messages of ROS 1 are no longer [bytes]

_TOO_DEEP = re.compile(r"(?:[\[{]\s*|- ){65}")
"""Collections in one another without anything between them; rosbag2 writes six, thousands take the parser seconds."""


@dataclass(frozen=True, slots=True)
class Connection:
    """A stream of messages of one type.

    Attributes:
        topic: that they are on.
        type: of the messages, "package/msg/Name".
        definition: text that defines the type; "" where the bag has none.
        form: of the text: "ros1msg", "ros2msg" or "ros2idl".
        encoding: of the messages: "cdr" or "ros1".
    """

    topic: str
    type: str
    definition: str
    form: str
    encoding: str


class Bag(Protocol):
    """One file of a bag; it can be pickled."""

    @property
    def connections(self) -> Sequence[Connection]:
        """All streams."""
        ...

    def received(self, number: int) -> Int64Array:
        """When the messages of a connection were recorded, (N,) int64 [ns], in the order of the file."""
        ...

    def data(self, number: int, k: int) -> memoryview:
        """The bytes of message `k` of a connection."""
        ...

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...


def open_bags(path: Path, ledger: Ledger) -> list[Bag]:
    """Open all files of a bag.

    Raises:
        DataError: a file is missing, damaged, or packed as a whole.
    """
    reported = _metadata(path, ledger) if path.is_dir() else {}
    files = _files(path, reported, ledger) if path.is_dir() else [path]
    packed = str(reported.get("compression_mode") or "").lower() == "message"
    bags: list[Bag] = []
    try:
        for file in files:
            bag = _open(file, ledger)
            bags.append(_UnpackedBag(bag, str(reported.get("compression_format") or "")) if packed else bag)
    except BaseException:
        for bag in bags:
            bag.close()
        raise
    return bags


def _open(file: Path, ledger: Ledger) -> Bag:
    if file.suffix.lower() == ".zstd":
        problem = f"is packed as a whole; unpack it first: zstd -d {file.name}, and reindex the bag"
        raise DataError(file, "", problem)
    storage = _STORAGES.get(file.suffix.lower())
    if storage is None:
        raise DataError(file, "", f"suffix {file.suffix!r}; expected one of {', '.join(_STORAGES)}")
    return storage(file, ledger)


def _metadata(folder: Path, ledger: Ledger) -> Mapping[str, Any]:
    """What `metadata.yaml` says; nothing, with a warning, where it is missing."""
    path = folder / METADATA
    if not path.is_file():
        message = f"{METADATA} is missing; all files of messages were read (`ros2 bag reindex` makes it anew)"
        ledger.note(WarningKind.ASSUMED, "metadata-missing", str(folder), message)
        return {}
    try:
        text = read_bytes(path).decode()
        if _TOO_DEEP.search(text):
            raise ValueError("nested deeper than 64 levels")  # noqa: TRY301 - one handler for all faults
        root = YAML(typ="safe").load(text)[ROOT_KEY]
        if not isinstance(root, dict):
            raise TypeError(f"{ROOT_KEY} is no mapping")  # noqa: TRY301 - one handler for all faults
    except (YAMLError, OSError, ValueError, RecursionError, KeyError, TypeError) as error:
        ledger.fault("metadata-at-fault", DataError(path, "", f"cannot be read: {error}"))
        return {}
    return root


def _files(folder: Path, reported: Mapping[str, Any], ledger: Ledger) -> list[Path]:
    named = reported.get("relative_file_paths")
    if not named:
        found = sorted(file for file in folder.iterdir() if file.suffix.lower() in {".db3", ".mcap"})
        if not found:
            raise DataError(folder, "", "no .db3 or .mcap file; expected the messages of a bag")
        return found
    files = []
    for name in map(str, named):
        # old bags state the path from where they were recorded
        file = next((location for location in (folder / name, folder / Path(name).name) if location.is_file()), None)
        if file is None or not file.resolve().is_relative_to(folder.resolve()):
            error = DataError(folder / METADATA, "relative_file_paths", f"{name!r}; expected a file of the folder")
            ledger.fault("bag-file-missing", error)
        else:
            files.append(file)
    return files


def full_type(name: str) -> str:
    """The name of a type as ROS 2 has it: `sensor_msgs/Image` of ROS 1 is `sensor_msgs/msg/Image`."""
    package, _, rest = name.partition("/")
    return name if not rest or "/" in rest else f"{package}/msg/{rest}"


class _ChunkedBag:
    """A bag whose messages are in chunks of one file."""

    def __init__(self, messages: ChunkedMessages, connections: Mapping[int, Connection]) -> None:
        self._messages = messages
        self.connections = tuple(connections.values())
        self._entries = [messages.entries(number) for number in connections]

    def received(self, number: int) -> Int64Array:
        return self._entries[number].log_times_ns

    def data(self, number: int, k: int) -> memoryview:
        return self._messages.data(self._entries[number], k)

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        entries = self._entries[number]
        return self._messages.heads(entries, np.arange(len(entries)), size)

    def close(self) -> None:
        self._messages.file.close()


def _open_chunked(read: Callable[[FileBytes, Ledger], _ChunkedBag], path: Path, ledger: Ledger) -> _ChunkedBag:
    file = FileBytes(path)
    try:
        return read(file, ledger)
    except BaseException:
        file.close()
        raise


def _read_mcap(file: FileBytes, ledger: Ledger) -> _ChunkedBag:
    """A file of ROS 2. Source: rosbag2_storage_mcap of ROS 2; MCAP format registry, profile "ros2"."""
    index = read_index(file, ledger)
    return _ChunkedBag(index.messages, {number: _mcap_connection(index, number) for number in index.channels})


def _mcap_connection(index: McapIndex, number: int) -> Connection:
    channel = index.channels[number]
    schema = index.schemas.get(channel.schema_id)
    if schema is None:
        return Connection(channel.topic, "", "", "", channel.message_encoding)
    text = schema.data.decode("utf-8", "replace")
    return Connection(channel.topic, full_type(schema.name), text, schema.encoding, channel.message_encoding)


def _read_ros1(file: FileBytes, ledger: Ledger) -> _ChunkedBag:
    """A bag of ROS 1, by a scan over the heads of its records. Source: wiki.ros.org/Bags/Format/2.0."""
    scan = _Ros1Scan(file, ledger)
    return _ChunkedBag(scan.messages, dict(sorted(scan.connections.items())))


class _Ros1Scan:
    """Goes from record to record; a chunk without an index of its messages is looked into."""

    def __init__(self, file: FileBytes, ledger: Ledger) -> None:
        self.file, self.ledger = file, ledger
        self.messages = ChunkedMessages(file, _ros1_message_at, _HEAD_ROOM)
        self.connections: dict[int, Connection] = {}
        self.indexed = True  # whether an index follows the latest chunk
        if file.read_up_to(0, len(_ROS1_MAGIC)) != _ROS1_MAGIC:
            problem = f"does not begin as a bag of ROS 1 does, with {_ROS1_MAGIC!r}"
            raise DataError(file.path, "byte 0", problem)
        location = len(_ROS1_MAGIC)
        while location < file.size:
            try:
                header, start, size = self._record_at(location)
            except (ValueError, struct.error, DataError) as error:
                problem = error.problem if isinstance(error, DataError) else str(error)
                self._fault("bag-cut-off", location, f"the bag is cut off or damaged: {problem}")
                break
            try:
                self._take(header, start, size)
            except (ValueError, struct.error, ReaderError) as error:
                self._fault("bag-damaged", start, f"the record is damaged: {error}")
            location = start + size
        self._finish_chunk()

    def _fault(self, code: str, location: int, problem: str) -> None:
        self.ledger.fault(code, DataError(self.file.path, f"byte {location}", problem))

    def _record_at(self, location: int) -> tuple[Header, int, int]:
        (length,) = struct.unpack("<I", self.file.read(location, 4))
        if length > _LONGEST_HEAD:
            raise ValueError(f"a record's head of {length} bytes")
        header, start, size = _ros1_record(self.file.read(location, length + 8), 0)
        if "op" not in header:
            raise ValueError(f"a record's head of {length} bytes without `op`")
        start += location
        if start + size > self.file.size:
            raise ValueError(f"a record of {size} bytes, of which {self.file.size - start} are there")
        return header, start, size

    def _take(self, header: Header, start: int, size: int) -> None:
        op = header.get_uint8("op")
        if op == RecordType.BAGHEADER and header.get_uint64("index_pos") == 0:
            problem = "the bag was not closed, its index is missing; use `--lenient` to read what is whole"
            self._fault("bag-unfinished", start, problem)
        elif op == RecordType.CONNECTION:
            self._take_connection(header, self.file.read(start, size))
        elif op == RecordType.IDXDATA:
            self.indexed = True
            self._take_index(header.get_uint32("conn"), self.file.read(start, size))
        elif op == RecordType.CHUNK:
            self._finish_chunk()
            compression = header.get_string("compression")
            compression = "" if compression == "none" else compression
            self.messages.add_chunk(Chunk(start, size, header.get_uint32("size"), compression))
            self.indexed = False

    def _take_connection(self, header: Header, content: bytes) -> None:
        fields = Header.read(BytesIO(struct.pack("<I", len(content)) + content))
        texts = {name: value.decode("utf-8", "replace") for name, value in fields.items()}
        kind, definition = full_type(texts.get("type", "")), texts.get("message_definition", "")
        topic = header.get_string("topic")
        self.connections[header.get_uint32("conn")] = Connection(topic, kind, definition, "ros1msg", "ros1")

    def _take_index(self, connection: int, content: bytes) -> None:
        if not self.messages.chunks:
            raise ValueError("an index before any chunk")
        rows = np.frombuffer(content, np.dtype("<u4")).reshape(-1, 3).astype(np.int64)
        times_ns = rows[:, 0] * 1_000_000_000 + rows[:, 1]
        self.messages.add(connection, len(self.messages.chunks) - 1, np.stack((times_ns, rows[:, 2]), axis=1))

    def _finish_chunk(self) -> None:
        """Look into the latest chunk where no index follows it, or where connections are not known otherwise."""
        number = len(self.messages.chunks) - 1
        if number >= 0 and (not self.indexed or not self.messages.streams <= set(self.connections)):
            try:
                self._look_into(number, with_messages=not self.indexed)
            except (ValueError, struct.error, ReaderError) as error:
                fault = DataError(self.file.path, f"chunk {number}", f"damaged: {error}")
                self.ledger.fault("bag-damaged", fault)
        self.indexed = True

    def _look_into(self, number: int, *, with_messages: bool) -> None:
        content, offset = self.messages.unpacked(number), 0
        rows: dict[int, list[tuple[int, int]]] = {}
        while offset + 8 <= len(content):
            header, start, size = _ros1_record(content, offset)
            op = header.get_uint8("op")
            if op == RecordType.CONNECTION:
                self._take_connection(header, content[start : start + size])
            elif op == RecordType.MSGDATA and with_messages and start + size <= len(content):
                found = rows.setdefault(header.get_uint32("conn"), [])
                found.append((header.get_time("time"), offset))
            offset = start + size
        for connection, found in rows.items():
            self.messages.add(connection, number, np.array(found, np.int64))


def _ros1_record(content: bytes, offset: int) -> tuple[Header, int, int]:
    """Header of the record at an offset, where its data begin, and how many bytes they are."""
    source = BytesIO(content)
    source.seek(offset)
    try:
        header, size = Header.read(source), read_uint32(source)
    except ReaderError as error:
        raise ValueError(str(error)) from error
    return header, source.tell(), size


def _ros1_message_at(content: bytes, offset: int) -> tuple[int, int]:
    header, start, size = _ros1_record(content, offset)
    if header.get("op") != bytes([RecordType.MSGDATA]):
        raise ValueError("another record")
    return start, size


class _SqliteBag:
    """A file of ROS 2 in SQLite, by its rows. Source: rosbag2_storage_sqlite3 of ROS 2."""

    def __init__(self, path: Path, ledger: Ledger) -> None:
        self.path = path
        self._begin()
        try:
            self.connections, self._numbers = self._read_topics()
            self._rows = self._read_rows(ledger)
        except sqlite3.Error as error:
            self.close()
            raise DataError(path, "", f"cannot be read as a bag: {error}") from error
        except DataError:
            self.close()
            raise

    def _begin(self) -> None:
        self._database: sqlite3.Connection | None = None
        self._process = -1
        self._lock = RLock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("path", "connections", "_numbers", "_rows")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    def _opened(self) -> sqlite3.Connection:
        if self._database is None or self._process != os.getpid():
            with file_faults(self.path):
                check_regular(self.path)
            address = f"file:{quote(os.fspath(self.path.absolute()))}?mode=ro"
            self._database = sqlite3.connect(address, uri=True, check_same_thread=False)
            self._process = os.getpid()
        return self._database

    def _read_topics(self) -> tuple[tuple[Connection, ...], dict[int, int]]:
        database = self._opened()
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type='table'")}
        if not {"topics", "messages"} <= tables:
            raise DataError(self.path, "", f"tables {', '.join(sorted(tables)) or 'none'}; expected topics, messages")
        definitions = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (form, text) for name, form, text in database.execute(query)}
        found: list[Connection] = []
        numbers: dict[int, int] = {}
        for identifier, name, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            form, text = definitions.get(kind, ("ros2msg", ""))
            numbers[identifier] = len(found)
            found.append(Connection(name, kind, text or "", form or "ros2msg", encoding or "cdr"))
        return tuple(found), numbers

    def _read_rows(self, ledger: Ledger) -> list[tuple[Int64Array, Int64Array]]:
        """Ids and times of the messages of each connection."""
        rows: list[list[tuple[int, int]]] = [[] for _ in self.connections]
        lost = 0
        try:
            for identifier, topic, time_ns in self._opened().execute(
                "SELECT id, topic_id, timestamp FROM messages ORDER BY id"
            ):
                if topic in self._numbers:
                    rows[self._numbers[topic]].append((identifier, time_ns))
                else:
                    lost += 1
        except sqlite3.Error as error:
            count = sum(map(len, rows))
            problem = f"damaged after {count} messages, is it cut off?: {error}"
            ledger.fault("bag-cut-off", DataError(self.path, "messages", problem))
        if lost:
            problem = f"{lost} messages of topics that are not listed"
            ledger.fault("bag-damaged", DataError(self.path, "messages", problem), count=lost)
        arrays = [np.array(found, np.int64).reshape(-1, 2) for found in rows]
        return [(array[:, 0], array[:, 1]) for array in arrays]

    def received(self, number: int) -> Int64Array:
        return self._rows[number][1]

    def data(self, number: int, k: int) -> memoryview:
        identifier = int(self._rows[number][0][k])
        with self._lock:
            try:
                row = self._opened().execute("SELECT data FROM messages WHERE id=?", (identifier,)).fetchone()
            except sqlite3.Error as error:
                raise self._fault(identifier, error) from error
        if row is None or not isinstance(row[0], bytes):
            raise self._fault(identifier, "no bytes")
        return memoryview(row[0])

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        for identifier in self._rows[number][0].tolist():
            with self._lock:
                try:
                    with self._opened().blobopen("messages", "data", identifier, readonly=True) as blob:
                        content = blob.read(size)
                except (sqlite3.Error, OverflowError) as error:
                    raise self._fault(identifier, error) from error
            yield content

    def _fault(self, identifier: int, problem: object) -> DataError:
        return DataError(self.path, f"messages: id {identifier}", f"cannot be read: {problem}")

    def close(self) -> None:
        with self._lock:
            if self._database is not None and self._process == os.getpid():
                self._database.close()
            self._database = None


@dataclass(frozen=True, slots=True, eq=False)
class _UnpackedBag:
    """Unpacks the messages of a bag as they are read."""

    bag: Bag
    compression: str

    @property
    def connections(self) -> Sequence[Connection]:
        return self.bag.connections

    def received(self, number: int) -> Int64Array:
        return self.bag.received(number)

    def data(self, number: int, k: int) -> memoryview:
        location = f"{self.connections[number].topic}[{k}]"
        if self.compression != "zstd":
            raise DataError(location, "", f"compression {self.compression!r}; expected zstd")
        packed = bytes(self.bag.data(number, k))
        most = most_unpacked(len(packed))
        try:
            content = memoryview(decompress(self.compression, packed, most))
        except ValueError as error:
            raise DataError(location, "", str(error)) from error
        if len(content) == most:
            problem = f"{len(packed)} bytes that unpack to {most} or more; expected less"
            raise DataError(location, "", problem)
        return content

    def heads(self, number: int, size: int) -> Iterator[bytes]:
        """How each message of a connection begins; they are unpacked whole."""
        return (bytes(self.data(number, k)[:size]) for k in range(len(self.received(number))))

    def close(self) -> None:
        self.bag.close()


_STORAGES: Mapping[str, Callable[[Path, Ledger], Bag]] = MappingProxyType(
    {".bag": partial(_open_chunked, _read_ros1), ".db3": _SqliteBag, ".mcap": partial(_open_chunked, _read_mcap)}
)
