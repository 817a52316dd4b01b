"""Bags of ROS 1 and ROS 2: messages as records, a bag as a log of topics, as a scene, and written by rosbags."""

import json
import os
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from io import BytesIO
from pathlib import Path
from threading import RLock
from types import MappingProxyType
from typing import Any, ClassVar, Protocol
from urllib.parse import quote

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.rosbag1.reader import Header, ReaderError, RecordType, read_uint32
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from sceneloom.arrays import AnyArray, Float64Array, Int64Array
from sceneloom.errors import DataError, OptionError, OutputError, check_choice
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import check_regular, file_faults, most_unpacked
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.base.yaml_files import read_yaml
from sceneloom.formats.messages.file_bytes import Chunk, ChunkedMessages, FileBytes, decompress
from sceneloom.formats.messages.foxglove import READERS
from sceneloom.formats.messages.mcap_files import McapIndex, read_index
from sceneloom.formats.messages.packets import PacketReading
from sceneloom.formats.messages.points import scan_record
from sceneloom.formats.messages.reader import scene_from_topics
from sceneloom.formats.messages.records import (
    VELOCITIES,
    AnyRecord,
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    CameraModelRecord,
    CloudRecord,
    CompressedImageRecord,
    Dialect,
    FixRecord,
    GridRecord,
    ImageRecord,
    Kind,
    NotesRecord,
    PackedCloudRecord,
    PackedField,
    PacketsRecord,
    PoseRecord,
    SampleRecord,
    Topic,
    TransformRecord,
    grid_positions,
    rotation_of,
    vector_of,
)
from sceneloom.formats.messages.spec import METADATA, ROOT_KEY
from sceneloom.formats.messages.writer import FIXED_FRAMES_TOPIC, SceneStreams, check_images
from sceneloom.formats.packets.spec import CaptureReading
from sceneloom.formats.rig_files.reader import Rig
from sceneloom.scene.scene import Scene, with_assumed_models
from sceneloom.warnings import WarningKind

_NOTES_TOPIC = "/sceneloom/scene"  # the topic of what no message has a field for

_TIMESTAMPS = {"cdr": (4, "iI"), "ros1": (4, "II")}
"""Byte and form of the time in a header: behind the byte order in CDR, behind a counter of messages in ROS 1.

Messages of Foxglove's schemas begin with the time itself, without a header.
"""

_FOXGLOVE = "foxglove_msgs/msg/"

_FIXED = "tf_static"
_DESCRIPTION = "metadata"  # end of topics with what sensors say of themselves

_FAULTS = (
    *(SerdeError, AssertionError, ValueError, IndexError, KeyError),
    *(AttributeError, OverflowError, TypeError, struct.error, MemoryError),
)
"""What rosbags and the readers of messages raise for bytes that are no message of their type."""


def _open_bag(
    path: Path,
    *,
    form: str,
    lenient: bool = False,
    assume_model: bool = False,
    timestamps: str | None = None,
    ego: str | None = None,
    world: str | None = None,
    distro: str | None = None,
    rig: Rig | None = None,
    metadata: str | None = None,
    angles: str | None = None,
    model: str | None = None,
) -> Scene:
    """Open a bag: its index and all small messages are read, images and points when they are asked for.

    Of packets of lidars `metadata`, `angles` and `model` tell what they do not, as of captures.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        log = open_log(path, ledger, distro)
        _note_not_read(log, ledger)
        packets = CaptureReading(lenient=lenient, metadata=metadata, angles=angles, model=model)
        scene = scene_from_topics(
            log,
            ledger,
            form=form,
            metadata={},
            timestamps=timestamps,
            ego=ego,
            world=world,
            rig=rig,
            packets=PacketReading(path, packets),
        )
    return with_assumed_models(scene) if assume_model else scene


open_ros1, open_ros2 = partial(_open_bag, form="ros1"), partial(_open_bag, form="ros2")
"""As `_open_bag`."""


def open_log(path: Path, ledger: Ledger, distro: str | None = None) -> "_RosLog":
    """Open a bag as a log of topics, which closes its files.

    Raises:
        DataError: a file is missing, damaged, or packed as a whole.
    """
    bags = _open_bags(path, ledger)
    try:
        return _log_of(str(path), bags, distro)
    except BaseException:
        for bag in bags:
            bag.close()
        raise


_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_LONGEST_HEAD = 1 << 20
_HEAD_ROOM = 512  # heads of messages of ROS 1 are no longer [bytes]


@dataclass(frozen=True, slots=True)
class _Connection:
    """A stream of messages of one type."""

    topic: str
    type: str  # "package/msg/Name"
    definition: str  # text that defines the type; "" where the bag has none
    form: str  # of the text: "ros1msg", "ros2msg" or "ros2idl"
    encoding: str  # of the messages: "cdr" or "ros1"


class _Bag(Protocol):
    """One file of a bag; it can be pickled."""

    @property
    def connections(self) -> Sequence[_Connection]: ...

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


def _open_bags(path: Path, ledger: Ledger) -> list[_Bag]:
    """Open all files of a bag; DataError if one is missing, damaged, or packed as a whole."""
    reported = _metadata(path, ledger) if path.is_dir() else {}
    files = _files(path, reported, ledger) if path.is_dir() else [path]
    packed = str(reported.get("compression_mode") or "").lower() == "message"
    bags: list[_Bag] = []
    try:
        for file in files:
            bag = _open(file, ledger)
            bags.append(_UnpackedBag(bag, str(reported.get("compression_format") or "")) if packed else bag)
    except BaseException:
        for bag in bags:
            bag.close()
        raise
    return bags


def _open(file: Path, ledger: Ledger) -> _Bag:
    if file.suffix.lower() == ".zstd":
        problem = f"is packed as a whole; unpack it first: zstd -d {file.name}, and reindex the bag"
        raise DataError(file, "", problem)
    storage = _FILE_KINDS.get(file.suffix.lower())
    if storage is None:
        raise DataError(file, "", f"suffix {file.suffix!r}; expected one of {', '.join(_FILE_KINDS)}")
    return storage(file, ledger)


def _metadata(folder: Path, ledger: Ledger) -> Mapping[str, Any]:
    """What `metadata.yaml` says; nothing, with a warning, where it is missing."""
    path = folder / METADATA
    if not path.is_file():
        message = f"{METADATA} is missing; all files of messages were read (`ros2 bag reindex` makes it anew)"
        ledger.note(WarningKind.ASSUMED, "metadata-missing", str(folder), message)
        return {}
    try:
        content = read_yaml(path)
        root = content.get(ROOT_KEY) if isinstance(content, dict) else None
        if not isinstance(root, dict):
            raise DataError(path, "", f"cannot be read: {ROOT_KEY} is no mapping")  # noqa: TRY301 - one handler for both
    except DataError as error:
        ledger.fault("metadata-at-fault", error)
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


def _full_type(name: str) -> str:
    """The name of a type as ROS 2 has it: `sensor_msgs/Image` of ROS 1 is `sensor_msgs/msg/Image`."""
    package, _, rest = name.partition("/")
    return name if not rest or "/" in rest else f"{package}/msg/{rest}"


class _ChunkedBag:
    """A bag whose messages are in chunks of one file."""

    def __init__(self, messages: ChunkedMessages, connections: Mapping[int, _Connection]) -> None:
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


def _mcap_connection(index: McapIndex, number: int) -> _Connection:
    channel = index.channels[number]
    schema = index.schemas.get(channel.schema_id)
    if schema is None:
        return _Connection(channel.topic, "", "", "", channel.message_encoding)
    text = schema.data.decode("utf-8", "replace")
    return _Connection(channel.topic, _full_type(schema.name), text, schema.encoding, channel.message_encoding)


def _read_ros1(file: FileBytes, ledger: Ledger) -> _ChunkedBag:
    """A bag of ROS 1, by a scan over the heads of its records. Source: wiki.ros.org/Bags/Format/2.0."""
    scan = _Ros1Scan(file, ledger)
    return _ChunkedBag(scan.messages, dict(sorted(scan.connections.items())))


class _Ros1Scan:
    """Goes from record to record; a chunk without an index of its messages is looked into."""

    def __init__(self, file: FileBytes, ledger: Ledger) -> None:
        self.file, self.ledger = file, ledger
        self.messages = ChunkedMessages(file, _ros1_message_at, _HEAD_ROOM)
        self.connections: dict[int, _Connection] = {}
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
        kind, definition = _full_type(texts.get("type", "")), texts.get("message_definition", "")
        topic = header.get_string("topic")
        self.connections[header.get_uint32("conn")] = _Connection(topic, kind, definition, "ros1msg", "ros1")

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
        except (sqlite3.Error, UnicodeDecodeError) as error:
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

    def _read_topics(self) -> tuple[tuple[_Connection, ...], dict[int, int]]:
        database = self._opened()
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type='table'")}
        if not {"topics", "messages"} <= tables:
            raise DataError(self.path, "", f"tables {', '.join(sorted(tables)) or 'none'}; expected topics, messages")
        definitions = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (form, text) for name, form, text in database.execute(query)}
        found: list[_Connection] = []
        numbers: dict[int, int] = {}
        for identifier, name, kind, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            form, text = definitions.get(kind, ("ros2msg", ""))
            numbers[identifier] = len(found)
            found.append(_Connection(name, kind, text or "", form or "ros2msg", encoding or "cdr"))
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
        except (sqlite3.Error, UnicodeDecodeError) as error:
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
            except (sqlite3.Error, UnicodeDecodeError) as error:
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
                except (sqlite3.Error, UnicodeDecodeError, OverflowError) as error:
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

    bag: _Bag
    compression: str

    @property
    def connections(self) -> Sequence[_Connection]:
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


_FILE_KINDS: Mapping[str, Callable[[Path, Ledger], _Bag]] = MappingProxyType(
    {".bag": partial(_open_chunked, _read_ros1), ".db3": _SqliteBag, ".mcap": partial(_open_chunked, _read_mcap)}
)


@dataclass(frozen=True, slots=True, eq=False)
class _RosLog:
    """The topics of a bag, each with its connections by file; `distro` has the types that the bag does not define."""

    name: str
    bags: tuple[_Bag, ...]
    topics: tuple[Topic, ...]
    parts: Mapping[int, tuple[tuple[int, int, int], ...]]
    distro: str | None
    notes: str | None = None

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        parts = [self.bags[file].received(number) for file, number, _ in self.parts[topic.number]]
        return np.concatenate([np.zeros(0, np.int64), *parts])

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself, or when it was recorded; all of them are looked at."""
        if topic.schema in _WITHOUT_HEADER:
            return self.receive_times(topic), True
        found: list[int] = []
        for file, number, _ in self.parts[topic.number]:
            connection = self.bags[file].connections[number]
            location, form = _TIMESTAMPS[connection.encoding]
            cdr = connection.encoding == "cdr"
            if not cdr and connection.type.startswith(_FOXGLOVE):
                location = 0
            for k, head in enumerate(self.bags[file].heads(number, location + 8)):
                if len(head) < location + 8:
                    raise DataError(self.name, f"{topic.name}[{k}]", f"{len(head)} bytes; expected a message")
                order = "<" if not cdr or head[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(order + form, head, location)
                found.append(seconds * 1_000_000_000 + nanoseconds)
        return np.array(found, np.int64), True

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says."""
        file, number, first = next(part for part in reversed(self.parts[topic.number]) if k >= part[2])
        connection = self.bags[file].connections[number]
        content = self.bags[file].data(number, k - first)
        try:
            if connection.type in _LIVOX:
                return [_livox_cloud(_store_of(connection, self.distro), connection, content)]
            if connection.type in _PACKETS:
                pack = partial(_packed_packets, connection=connection, content=content)
                packed: PacketsRecord | None = _fitting(connection, self.distro, pack)
                if packed is not None:
                    return [packed]
            records = list(_READERS[connection.type][1](_parsed(connection, content, self.distro)))
        except _FAULTS as error:
            raise DataError(self.name, f"{topic.name}[{k}]", f"no {connection.type}: {error}") from error
        if topic.name.endswith(_FIXED):
            return [replace(one, fixed=True) if isinstance(one, TransformRecord) else one for one in records]
        return records

    def close(self) -> None:
        """Release the files."""
        for bag in self.bags:
            bag.close()


def _parsed(connection: _Connection, content: memoryview, distro: str | None) -> Any:
    """A message."""

    def parsed(store: Any) -> Any:
        parse = store.deserialize_cdr if connection.encoding == "cdr" else store.deserialize_ros1
        return parse(content, connection.type)

    return _fitting(connection, distro, parsed)


def _fitting(connection: _Connection, distro: str | None, parse: Callable[[Any], Any]) -> Any:
    """A message; of types whose definition changed, without one in the bag, by the first that its bytes fit."""
    stores = [_store_of(connection, distro)]
    if not connection.definition and connection.type in _EARLIER:
        stores += _earlier_stores(connection.type)
    for number, store in enumerate(stores, 1):
        try:
            return parse(store)
        except _FAULTS:
            if number == len(stores):
                raise
    return None


def _log_of(name: str, bags: Sequence[_Bag], distro: str | None) -> _RosLog:
    """Put the files of a bag together: connections of one topic and type are one topic."""
    groups: dict[tuple[str, str, str], list[tuple[int, int]]] = {}
    for file, bag in enumerate(bags):
        for number, connection in enumerate(bag.connections):
            key = connection.topic, connection.type, connection.encoding
            groups.setdefault(key, []).append((file, number))
    topics, parts = [], {}
    for identifier, locations in enumerate(groups.values()):
        rows, count = [], 0
        for file, number in locations:
            rows.append((file, number, count))
            count += len(bags[file].received(number))
        parts[identifier] = tuple(rows)
        connection = bags[locations[0][0]].connections[locations[0][1]]
        topics.append(_topic(identifier, connection, count, distro))
    log = _RosLog(name, tuple(bags), tuple(topics), MappingProxyType(parts), distro)
    noted = next((topic for topic in topics if topic.kind is Kind.NOTES and topic.count), None)
    return log if noted is None else replace(log, notes=getattr(log.read(noted, 0)[0], "text", None))


def _topic(number: int, connection: _Connection, count: int, distro: str | None) -> Topic:
    named = connection.topic, connection.type
    if connection.encoding not in _TIMESTAMPS:
        why = f"in the encoding {connection.encoding!r}; expected {' or '.join(_TIMESTAMPS)}"
        return Topic(number, *named, None, count, why)
    known = _READERS.get(connection.type)
    if known is None:
        return Topic(number, *named, None, count)
    kind = known[0]
    if kind is Kind.NOTES and connection.topic != _NOTES_TOPIC:
        if not connection.topic.endswith(_DESCRIPTION):
            return Topic(number, *named, None, count)
        kind = Kind.DESCRIPTION
    try:
        _store_of(connection, distro)
    except ValueError as error:
        return Topic(number, *named, None, count, f"{error}; name the ROS distribution with distro=")
    return Topic(number, *named, kind, count)


def _note_not_read(log: _RosLog, ledger: Ledger) -> None:
    """Report what is left out of messages that are read."""
    if log.notes is not None:
        return
    for topic in log.topics:
        if topic.kind is not None and topic.count and topic.schema in _NOT_READ:
            message = f"{_NOT_READ[topic.schema]} in messages {topic.schema} are not read"
            location = f"{log.name}: {topic.name}"
            ledger.note(WarningKind.SKIPPED, "fields-not-read", location, message, count=topic.count)


_STORAGES = ("sqlite3", "mcap")  # what files of ROS 2 bags can be
_SECOND_NS = 1_000_000_000


def _dialect(*, videos: bool) -> Dialect:
    return Dialect(
        name="ROS",
        world="map",
        ego="base_link",
        part=_ros_part,
        fisheye="equidistant",
        camera_model_topic="camera_info",
        sample_topics=MappingProxyType(
            {"accelerometer": "data", "gyroscope": "data", "magnetometer": "mag", "imuTemperature": "temperature"}
        ),
        videos=videos,
        covariances=True,
        each_camera_model=True,
        intensity="f4",
    )


_KIND = FolderKind("bag of ROS 2", (r"metadata\.yaml", r"(?P<one>.+)\.(mcap|db3)"), r"metadata\.yaml")


def write_ros1(
    scene: Scene, path: Path, *, overwrite: bool = False, images: str = "jpeg", distro: str = "noetic"
) -> LossReport:
    """Write a `.bag`; one message is in memory at a time.

    Args:
        images: see `write_ros2`.
        distro: of ROS 1, whose types are written.

    Raises:
        OptionError: there is no such distribution, or way of writing images.
    """
    from rosbags.rosbag1 import Writer

    with replacing(path, overwrite=overwrite) as draft, Writer(draft) as bag:
        return _write(scene, bag, distro, images, ros1=True)


def write_ros2(
    scene: Scene,
    path: Path,
    *,
    overwrite: bool = False,
    storage: str = "mcap",
    images: str = "jpeg",
    distro: str = "humble",
) -> LossReport:
    """Write a folder with `metadata.yaml`; one message is in memory at a time.

    Args:
        storage: "mcap" or "sqlite3".
        images: "jpeg" and "copy" write JPEG files, copied where the scene has them, "png" and "raw" lose nothing,
            "video" hands on videos packet by packet as messages of foxglove_msgs.
        distro: of ROS 2, whose types are written.

    Raises:
        OptionError: there is no such storage, distribution, or way of writing images.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    check_choice("storage", storage, _STORAGES)
    plugin = StoragePlugin[storage.upper()]
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        draft.rmdir()
        with Writer(draft, version=9, storage_plugin=plugin) as bag:
            return _write(scene, bag, distro, images, ros1=False)


def _write(scene: Scene, bag: Any, distro: str, images: str, *, ros1: bool) -> LossReport:
    videos = images == "video"
    form = "copy" if videos or images == "jpeg" else images
    check_images(form)
    plan = SceneStreams(scene, _dialect(videos=videos), images=form)
    shift_ns = -(plan.start_ns // _SECOND_NS) * _SECOND_NS if plan.start_ns < 0 else 0
    store = _distro_store(distro)
    header = store.fielddefs.get("std_msgs/msg/Header")
    if header is not None and any(name == "seq" for name, _ in header[1]) is not ros1:
        raise OptionError(f"distro {distro!r}; expected one of ROS {1 if ros1 else 2}")
    if shift_ns:
        plan.notes["time_shift_ns"] = shift_ns
        what = f"times begin {shift_ns // _SECOND_NS} s later: ROS knows none before 0"
        plan.losses.converted("time_offset_ns", what)
    records = _Records(bag, store, _Messages(store, ros1=ros1, shift_ns=shift_ns), shift_ns, ros1=ros1)
    records.add(plan.start_ns, _NOTES_TOPIC, NotesRecord(0, json.dumps(plan.notes)))
    for time_ns, topic, record in plan.records():
        records.add(time_ns, topic, record)
    return LossReport.of(plan.losses.all)


class _Records:
    """Writes records to a bag; connections are added when they are first needed."""

    def __init__(self, bag: Any, store: Any, messages: "_Messages", shift_ns: int, *, ros1: bool) -> None:
        self._bag, self._store, self._messages, self._shift_ns = bag, store, messages, shift_ns
        self._ros1 = ros1
        self._connections: dict[tuple[str, str], Any] = {}

    def add(self, time_ns: int, topic: str, record: AnyRecord) -> None:
        kind, message = self._messages.of(record)
        serialise = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        try:
            self._bag.write(self._connection(topic, kind), time_ns + self._shift_ns, serialise(message, kind))
        except (OverflowError, ValueError) as error:
            raise OutputError(f"{topic}: {kind} cannot be written: {error}") from error

    def _connection(self, topic: str, kind: str) -> Any:
        known = self._connections.get((topic, kind))
        if known is None:
            further: dict[str, Any] = {}
            if topic in {FIXED_FRAMES_TOPIC, _NOTES_TOPIC}:
                further = {"latching": 1} if self._ros1 else {"offered_qos_profiles": [_latched()]}
            known = self._bag.add_connection(topic, kind, typestore=self._store, **further)
            self._connections[topic, kind] = known
        return known


def _latched() -> Any:
    """The quality of service of topics whose last message late subscribers get, too."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        avoid_ros_namespace_conventions=False,
    )


def _ros_part(identifier: str | int) -> str:
    """An id as one part of a ROS topic's name, of letters, digits and underscores; several ids may become one."""
    part = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in str(identifier)) or "_"
    return f"_{part}" if part[0].isdigit() else part


_LIVOX_PACKAGES = ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")


def _livox_types(package: str) -> dict[str, str]:
    point = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
    head = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    whole = f"{head}{package}/CustomPoint[] points\n"
    return {f"{package}/msg/CustomPoint": point, f"{package}/msg/CustomMsg": whole}


_SIZED = "builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size\n"


def _packets_of(packet: str) -> str:
    return f"std_msgs/Header header\n{packet}[] packets\n"


_STAMPED = "builtin_interfaces/Time timestamp\nstring frame_id\n"
_FOXGLOVE_DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "CompressedVideo": "uint8[] data\nstring format\n",
        "CompressedImage": "uint8[] data\nstring format\n",
        "CompressedPointCloud": "geometry_msgs/Pose pose\nuint8[] data\nstring format\n",
        "LaserScan": (
            "geometry_msgs/Pose pose\nfloat64 start_angle\nfloat64 end_angle\nfloat64[] ranges\nfloat64[] intensities\n"
        ),
        "PoseInFrame": "geometry_msgs/Pose pose\n",
        "PosesInFrame": "geometry_msgs/Pose[] poses\n",
        "RawImage": "uint32 width\nuint32 height\nstring encoding\nuint32 step\nuint8[] data\n",
    }
)
"""Of Foxglove's schemas those that are small, behind time and frame."""

DEFINITIONS: Mapping[str, str] = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
        "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
        "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
        "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
        "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
        "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
        "vision_msgs/msg/ObjectHypothesisWithPose": (
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
        ),
        "vision_msgs/msg/Detection2D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox2D bbox\nstring id\n"
        ),
        "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections\n",
        "vision_msgs/msg/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
            "vision_msgs/BoundingBox3D bbox\nstring id\n"
        ),
        "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
            "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
            "bool is_bigendian\nuint8[] data\n"
        ),
        "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data\n",
        "velodyne_msgs/msg/VelodyneScan": _packets_of("velodyne_msgs/VelodynePacket"),
        "pandar_msgs/msg/PandarPacket": _SIZED,
        "pandar_msgs/msg/PandarScan": _packets_of("pandar_msgs/PandarPacket"),
        "hesai_ros_driver/msg/UdpPacket": "uint8[] data\nuint32 size\n",
        "hesai_ros_driver/msg/UdpFrame": _packets_of("hesai_ros_driver/UdpPacket"),
        "robosense_msgs/msg/RobosensePacket": _SIZED,
        "robosense_msgs/msg/RobosenseScan": _packets_of("robosense_msgs/RobosensePacket"),
        "robosense_msgs/msg/RobosenseInfoPacket": "string lidar_model\nrobosense_msgs/RobosensePacket packet\n",
        "rslidar_msg/msg/RslidarPacket": (
            "std_msgs/Header header\nuint8 is_difop\nuint8 is_frame_begin\nuint8[] data\n"
        ),
        "ouster_msgs/msg/PacketMsg": "uint8[] buf\n",
        "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf\n",
        "ouster_ros/msg/PacketMsg": "uint8[] buf\n",
        "nebula_msgs/msg/NebulaPacket": "builtin_interfaces/Time stamp\nuint8[] data\n",
        "nebula_msgs/msg/NebulaPackets": _packets_of("nebula_msgs/NebulaPacket"),
        **{name: text for package in _LIVOX_PACKAGES for name, text in _livox_types(package).items()},
        "point_cloud_interfaces/msg/CompressedPointCloud2": (
            "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
            "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] compressed_data\nbool is_dense\n"
            "string format\n"
        ),
        **{f"{_FOXGLOVE}{name}": _STAMPED + text for name, text in _FOXGLOVE_DEFINITIONS.items()},
    }
)
"""Definitions of types that rosbags does not have, by name; those that others use come before them.

Source: packages vision_msgs (4.0), tf2_msgs, foxglove_msgs, ffmpeg_image_transport_msgs and point_cloud_interfaces, and
those of the drivers of lidars and radars: velodyne_msgs, pandar_msgs, robosense_msgs and nebula_msgs, hesai_ros_driver,
rslidar_msg, ouster_ros, livox_ros_driver.
"""

_EARLIER: Mapping[str, tuple[str, tuple[str, ...]]] = MappingProxyType(
    {
        "robosense_msgs/msg/RobosenseScan": (
            "robosense_msgs/msg/RobosensePacket",
            (
                "builtin_interfaces/Time stamp\nuint8 is_difop\nuint8[1500] data\nuint32 size\n",
                "builtin_interfaces/Time stamp\nuint8[1248] data\nuint32 size\n",
            ),
        )
    }
)
"""Earlier definitions of a type that messages have, by their own. Source: history of robosense_msgs in nebula."""

_USUAL_DISTRO = {"ros1": "noetic", "cdr": "humble"}
"""The distribution whose types are taken where nothing is stated, by the encoding of messages."""


@cache
def _distro_store(distro: str) -> Any:
    """Give the types of a distribution, and those that it lacks."""
    known = {store.value.partition("_")[2]: store for store in Stores if "_" in store.value}
    check_choice("distro", distro, known)
    store = get_typestore(known[distro])
    for name, text in DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def _store_of(connection: _Connection, distro: str | None) -> Any:
    """Give the types that a connection's messages are read with: the bag's own definition counts."""
    if connection.definition:
        return _defined(connection.type, connection.definition, connection.form)
    store = _distro_store(distro or _USUAL_DISTRO[connection.encoding])
    if connection.type not in store.fielddefs:
        raise ValueError(f"the bag does not define {connection.type}, and neither does ROS {distro or 'by itself'}")
    return store


@cache
def _earlier_stores(name: str) -> list[Any]:
    """The types that messages of a type may have been written with before."""
    part, texts = _EARLIER[name]
    found = []
    for text in texts:
        store = get_typestore(Stores.ROS2_HUMBLE)
        for one in (part, name):
            store.register(get_types_from_msg(text if one == part else DEFINITIONS[one], one))
        found.append(store)
    return found


@cache
def _defined(name: str, definition: str, form: str) -> Any:
    """The types that a text defines."""
    store = get_typestore(Stores.EMPTY)
    try:
        if form == "ros2idl":
            store.register(get_types_from_idl(definition))
        else:
            store.register(get_types_from_msg(definition, name))
    except (TypesysError, KeyError, ValueError) as error:
        raise ValueError(f"a definition of {name} that cannot be read: {error}") from error
    if name not in store.fielddefs:
        raise ValueError(f"the bag's definition of {name} does not define it")
    return store


_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""The types of `sensor_msgs/msg/PointField`."""

_NUMBERS = {dtype: number for number, dtype in _DATATYPES.items()}
_MICROTESLA = 1e-6
_ZERO_CELSIUS = 273.15
_NO_FIX = -1  # status of fixes without reception


def _timestamp_ns(stamp: Any) -> int:
    """A time of a message [ns]."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _head(message: Any) -> tuple[int, str]:
    """Time and frame."""
    return _timestamp_ns(message.header.stamp), _frame(message.header.frame_id)


def _frame(name: str) -> str:
    """Names of frames begin with a slash in old bags."""
    return name.lstrip("/")


def _bytes(data: Any) -> memoryview:
    return np.ascontiguousarray(data).data.cast("B")


def _transforms(message: Any) -> Iterable[TransformRecord]:
    for transform in getattr(message, "transforms", [message]):
        time_ns, parent = _head(transform)
        moved = transform.transform
        child = _frame(transform.child_frame_id)
        yield TransformRecord(time_ns, parent, child, vector_of(moved.translation), rotation_of(moved.rotation))


def _cloud(message: Any) -> Sequence[CloudRecord]:
    order = ">" if message.is_bigendian else "<"
    fields = tuple(
        PackedField(
            field.name, int(field.offset), np.dtype(order + _DATATYPES[field.datatype]), max(1, int(field.count))
        )
        for field in message.fields
        if field.datatype in _DATATYPES
    )
    width, height = int(message.width), int(message.height)
    rows = (int(message.row_step), width) if height > 1 else None
    data, stride = _bytes(message.data), int(message.point_step)
    return [CloudRecord(*_head(message), fields, stride, data, width * height, row_bytes=rows)]


_LIVOX = frozenset(f"{name}/msg/CustomMsg" for name in _LIVOX_PACKAGES)
_LIVOX_HEAD = ("header", "timebase", "point_num", "lidar_id", "rsvd", "points")
_CDR_NUMBERS = {"uint32": "u4", "float32": "f4", "uint8": "u1", "float64": "f8", "uint64": "u8", "uint16": "u2"}


def _livox_cloud(store: Any, connection: _Connection, content: memoryview) -> CloudRecord:
    """The points of a message of Livox's drivers as they lie in its bytes: one by one they would take 50 times as long.

    Source: livox_ros_driver/CustomMsg and CustomPoint; OMG CDR (alignment of numbers by their size).
    """
    fields = store.fielddefs[connection.type][1]
    if tuple(name for name, _ in fields) != _LIVOX_HEAD:
        raise ValueError(f"fields {', '.join(name for name, _ in fields)}; expected {', '.join(_LIVOX_HEAD)}")
    cdr, order, content, at, head = _packed_head(connection, content)
    at += -at % 8 if cdr else 0
    base_ns, _, _, count = struct.unpack_from(f"{order}QIB3xI", content, at)
    kinds = {
        name: np.dtype(order + _CDR_NUMBERS[kind[0]]) for name, (_, kind) in store.fielddefs[fields[-1][1][1][0][1]][1]
    }
    rows = _packed_rows(kinds, content[at + 20 :], count, aligned=cdr)
    members = tuple(PackedField(name, entry[1], entry[0]) for name, entry in (rows.dtype.fields or {}).items())
    data = memoryview(rows).cast("B")  # type: ignore[arg-type]  # arrays are buffers
    return CloudRecord(*head, members, rows.itemsize, data, count, base_ns=base_ns)


def _packed_head(connection: _Connection, content: memoryview) -> tuple[bool, str, memoryview, int, tuple[int, str]]:
    """Whether a message with a header is CDR, its byte order, its bytes, where the header ends, and what it states."""
    cdr = connection.encoding == "cdr"
    order = ">" if cdr and not content[1] & 1 else "<"
    content = content[4:] if cdr else content
    at = 0 if cdr else 4  # headers of ROS 1 begin with a number
    seconds, nanoseconds, length = struct.unpack_from(f"{order}III", content, at)
    at += 12 + length
    frame_id = bytes(content[at - length : at]).rstrip(b"\0").decode()
    return cdr, order, content, at, (seconds * 1_000_000_000 + nanoseconds, _frame(frame_id))


def _packed_rows(kinds: Mapping[str, np.dtype[Any]], data: memoryview, count: int, *, aligned: bool) -> AnyArray:
    """Elements of a sequence as they lie in the bytes of a message, (count,) of the members `kinds`.

    Source: OMG CDR (alignment of numbers by their size); messages of ROS 1 have no padding.
    """
    sizes = [kind.base.itemsize if aligned else 1 for kind in kinds.values()]
    offsets, end = [], 0
    for kind, size in zip(kinds.values(), sizes, strict=True):
        offsets.append(end + -end % size)
        end = offsets[-1] + kind.itemsize
    stride = end + -end % max(sizes)
    if len(data) < count * stride - (stride - end):
        raise ValueError(f"{len(data)} bytes for {count} elements of {stride}; expected all of them")
    if count and len(data) < count * stride:  # there is no padding behind the last one
        data = memoryview(bytes(data) + bytes(stride - end))
    layout: Any = {"names": list(kinds), "formats": list(kinds.values()), "offsets": offsets, "itemsize": stride}
    return np.frombuffer(data, np.dtype(layout), count)


_TIME = "builtin_interfaces/msg/Time"


def _packed_packets(store: Any, connection: _Connection, content: memoryview) -> PacketsRecord | None:
    """The packets of a message as they lie in its bytes: one by one they would take five times as long.

    None of types that are no header and packets of one length and layout.
    """
    fields = store.fielddefs[connection.type][1]
    if [name for name, _ in fields] != ["header", "packets"] or fields[1][1][0] != Nodetype.SEQUENCE:
        return None
    cdr, order, content, at, head = _packed_head(connection, content)
    kinds: dict[str, np.dtype[Any]] = {}
    for name, (node, kind) in store.fielddefs[fields[1][1][1][0][1]][1]:
        if (node, kind) == (Nodetype.NAME, _TIME):
            kinds[name] = np.dtype((f"{order}u4", 2))
        elif node == Nodetype.BASE and kind[0] in _CDR_NUMBERS:
            kinds[name] = np.dtype(order + _CDR_NUMBERS[kind[0]])
        elif node == Nodetype.ARRAY and kind[0] == (Nodetype.BASE, ("uint8", 0)):
            kinds[name] = np.dtype(("u1", kind[1]))
        else:
            return None
    if "data" not in kinds or not kinds["data"].shape:
        return None
    at += -at % 4 if cdr else 0
    (count,) = struct.unpack_from(f"{order}I", content, at)
    rows = _packed_rows(kinds, content[at + 4 :], count, aligned=cdr)
    behind = len(content) - at - 4 - rows.nbytes
    if behind > 3:
        raise ValueError(f"{behind} bytes behind {count} packets of {rows.itemsize}")
    data, stamps = rows["data"], None
    if "stamp" in kinds:
        seconds, nanoseconds = rows["stamp"].astype(np.int64).T
        stamps = seconds * 1_000_000_000 + nanoseconds
    if "size" in kinds:
        size = int(rows["size"].max(initial=0))
        if size > data.shape[1]:
            raise ValueError(f"a packet of {size} bytes, of which {data.shape[1]} are there")
        if (rows["size"] != size).any():
            return None
        data = data[:, :size]
    return PacketsRecord(*head, data, stamps)


def _packets(message: Any) -> Sequence[PacketsRecord]:
    """The packets of a message: in an array, or one that is the message itself or its field."""
    parts = getattr(message, "packets", None)
    head = _head(message) if hasattr(message, "header") else (0, "")
    if parts is None:
        parts = [getattr(message, "packet", message)]
    if not parts:
        return [PacketsRecord(*head, ())]
    # all of one type: looking at each for its fields would take longer than reading them
    name, sized, stamped = "data" if hasattr(parts[0], "data") else "buf", hasattr(parts[0], "size"), None
    found = [memoryview(getattr(part, name)).cast("B") for part in parts]
    if sized:
        sizes = [int(part.size) for part in parts]
        for size, data in zip(sizes, found, strict=True):
            if size > len(data):
                raise ValueError(f"a packet of {size} bytes, of which {len(data)} are there")
        found = [data[:size] for size, data in zip(sizes, found, strict=True)]
    if hasattr(parts[0], "stamp"):
        stamped = np.array([part.stamp.sec * 1_000_000_000 + part.stamp.nanosec for part in parts], np.int64)
    return [PacketsRecord(*head, tuple(found), stamped)]


def _grid(message: Any) -> Sequence[GridRecord]:
    """A map of what is occupied, by 0 to 100; cells that are unknown are left out."""
    info, values = message.info, np.asarray(message.data, np.int8)
    width, height = int(info.width), int(info.height)
    if len(values) != width * height:
        raise ValueError(f"{len(values)} cells; expected {width} x {height}")
    known = np.flatnonzero((values >= 0) & (values <= _OCCUPIED))
    rows, columns = np.divmod(known, max(width, 1))
    grey = np.rint(255.0 - 255.0 / _OCCUPIED * values[known]).astype(np.uint8)
    size = float(info.resolution), float(info.resolution)
    return [
        GridRecord(*_head(message), grid_positions(columns, rows, size, info.origin), np.stack((grey,) * 3, axis=1))
    ]


_OCCUPIED = 100


def _packed_cloud(message: Any) -> Sequence[PackedCloudRecord]:
    """Compressed points, whose layout is that of the points before; `format` was a truth value in old definitions."""
    data, message.data = message.compressed_data, message.compressed_data[:0]
    (layout,) = _cloud(message)
    return [PackedCloudRecord(*_head(message), str(message.format).lower(), _bytes(data), layout)]


def _scan(message: Any) -> Sequence[CloudRecord]:
    """A line of ranges, or of several ranges for each beam."""
    ranges, intensities, beams, echoes = message.ranges, message.intensities, None, None
    if not isinstance(ranges, np.ndarray):
        counts = [len(one.echoes) for one in ranges]
        beams = np.repeat(np.arange(len(counts)), counts)
        echoes = np.concatenate([np.arange(0), *(np.arange(count) for count in counts)])
        none = np.zeros(0)
        ranges = np.concatenate([none, *(one.echoes for one in ranges)])
        intensities = np.concatenate([none, *(one.echoes for one in intensities)])
    return [
        scan_record(
            *_head(message),
            np.asarray(ranges, np.float64),
            np.asarray(intensities, np.float64),
            angles=(float(message.angle_min), float(message.angle_increment)),
            limits=(float(message.range_min), float(message.range_max)),
            step_s=float(message.time_increment),
            beams=beams,
            echoes=echoes,
        )
    ]


def _image(message: Any) -> Sequence[ImageRecord]:
    size = int(message.width), int(message.height), int(message.step)
    return [
        ImageRecord(*_head(message), str(message.encoding), *size, _bytes(message.data), bool(message.is_bigendian))
    ]


def _compressed_image(message: Any) -> Sequence[CompressedImageRecord]:
    return [CompressedImageRecord(*_head(message), message.format.lower(), _bytes(message.data))]


_FFMPEG_CODECS = (("264", "h264"), ("265", "h265"), ("hevc", "h265"), ("vp9", "vp9"), ("av1", "av1"))
"""Parts of names of FFmpeg's codecs and encoders, and what the codec is called here."""


def _video(message: Any) -> Sequence[CompressedImageRecord]:
    """A packet of FFmpeg, whose encoding begins with the name of a codec, or of an encoder in old messages."""
    named = str(message.encoding).partition(";")[0].strip().lower()
    codec = next((codec for part, codec in _FFMPEG_CODECS if part in named), named)
    return [CompressedImageRecord(*_head(message), codec, _bytes(message.data))]


def _foxglove(read: Callable[[Any, memoryview], Iterable[AnyRecord]], message: Any) -> Iterable[AnyRecord]:
    """A message of Foxglove's schemas in ROS."""
    return read(message, _bytes(message.data) if hasattr(message, "data") else memoryview(b""))


def _camera_model(message: Any) -> Sequence[CameraModelRecord]:
    # ROS 1 writes their names in upper case
    rows = (getattr(message, name if hasattr(message, name) else name.upper()) for name in "dkp")
    numbers = (tuple(map(float, row)) for row in rows)
    size = int(message.width), int(message.height)
    return [CameraModelRecord(*_head(message), *size, message.distortion_model, *numbers)]


def _pose(message: Any) -> Sequence[PoseRecord]:
    pose, covariance = message.pose, None
    if hasattr(pose, "pose"):
        spread = np.array(pose.covariance, np.float64).reshape(6, 6)
        pose, covariance = pose.pose, spread if spread.any() else None
    rotation, body = rotation_of(pose.orientation), _frame(getattr(message, "child_frame_id", ""))
    reported = rotation if rotation.any() else None
    return [PoseRecord(*_head(message), vector_of(pose.position), reported, body, covariance)]


def _point(message: Any) -> Sequence[PoseRecord]:
    return [PoseRecord(*_head(message), vector_of(message.point), None)]


def _fix(message: Any) -> Sequence[FixRecord]:
    east, north, up = np.array(message.position_covariance, np.float64)[[0, 4, 8]].tolist()
    lla = float(message.latitude), float(message.longitude), float(message.altitude)
    variances = (east, north, up) if message.position_covariance_type else None
    return [FixRecord(*_head(message), lla, variances, received=message.status.status != _NO_FIX)]


def _imu(message: Any) -> Sequence[SampleRecord]:
    """Measurements; a first element -1 of their covariances says that there are none."""
    values: dict[str, tuple[float, ...]] = {}
    covariances: dict[str, tuple[float, ...]] = {}
    for stream, name in (("accelerometer", "linear_acceleration"), ("gyroscope", "angular_velocity")):
        spread = np.asarray(getattr(message, f"{name}_covariance"), np.float64)
        if spread[0] != -1:
            values[stream] = tuple(vector_of(getattr(message, name)).tolist())
            covariances |= _spread(stream, spread)
    rotation = rotation_of(message.orientation)
    if message.orientation_covariance[0] != -1 and not lengths_of(rotation[None])[1][0]:
        values["orientation"] = tuple(rotation.tolist())
        covariances |= _spread("orientation", np.asarray(message.orientation_covariance, np.float64))
    return [SampleRecord(*_head(message), values, covariances)]


def _spread(stream: str, covariance: Float64Array) -> dict[str, tuple[float, ...]]:
    """A covariance that is stated; zeros say that it is not known."""
    return {stream: tuple(covariance.reshape(-1).tolist())} if covariance.any() else {}


def _magnetic(message: Any) -> Sequence[SampleRecord]:
    field = vector_of(message.magnetic_field) / _MICROTESLA
    spread = np.asarray(message.magnetic_field_covariance, np.float64) / _MICROTESLA**2
    known = _spread("magnetometer", spread) if spread[0] >= 0 else {}
    return [SampleRecord(*_head(message), {"magnetometer": tuple(field.tolist())}, known)]


def _temperature(message: Any) -> Sequence[SampleRecord]:
    spread = _spread("imuTemperature", np.array([message.variance], np.float64))
    return [SampleRecord(*_head(message), {"imuTemperature": (float(message.temperature) + _ZERO_CELSIUS,)}, spread)]


def _twist(message: Any) -> Sequence[SampleRecord]:
    return [_velocities(*_head(message), message.twist)]


def _velocities(time_ns: int, frame_id: str, twist: Any) -> SampleRecord:
    """A motion, with its covariance or without."""
    covariances: dict[str, tuple[float, ...]] = {}
    if hasattr(twist, "twist"):
        spread = np.asarray(twist.covariance, np.float64).reshape(6, 6)
        covariances = _spread(VELOCITIES[0], spread[:3, :3]) | _spread(VELOCITIES[1], spread[3:, 3:])
        twist = twist.twist
    vectors = vector_of(twist.linear), vector_of(twist.angular)
    values = {stream: tuple(vector.tolist()) for stream, vector in zip(VELOCITIES, vectors, strict=True)}
    return SampleRecord(time_ns, frame_id, values, covariances)


def _odometry(message: Any) -> Sequence[PoseRecord | SampleRecord]:
    return [*_pose(message), _velocities(_head(message)[0], _frame(message.child_frame_id), message.twist)]


def _label(detection: Any) -> tuple[str | None, dict[str, str]]:
    """Class and score of the likeliest hypothesis; packages before vision_msgs 4 have both in the result itself."""
    best, label = None, None
    for result in detection.results:
        hypothesis = getattr(result, "hypothesis", result)
        if best is None or hypothesis.score > best:
            best = float(hypothesis.score)
            label = str(getattr(hypothesis, "class_id", getattr(hypothesis, "id", "")))
    return label or None, {} if best is None else {"score": repr(best)}


def _boxes_3d(message: Any) -> Sequence[Boxes3DRecord]:
    time_ns, frame = _head(message)
    boxes = []
    for detection in message.detections:
        label, reported = _label(detection)
        center = detection.bbox.center
        boxes.append(
            Box3D(
                str(getattr(detection, "id", "")),
                _frame(detection.header.frame_id) or frame,
                vector_of(center.position),
                rotation_of(center.orientation),
                vector_of(detection.bbox.size),
                label,
                MappingProxyType(reported),
            )
        )
    return [Boxes3DRecord(time_ns, tuple(boxes))]


def _boxes_2d(message: Any) -> Sequence[Boxes2DRecord]:
    time_ns, frame = _head(message)
    boxes, rotated = [], 0
    for detection in message.detections:
        label, reported = _label(detection)
        box = detection.bbox
        center = getattr(box.center, "position", box.center)
        if box.center.theta != 0:
            rotated += 1
            continue
        width, height = float(box.size_x), float(box.size_y)
        corner = float(center.x) - width / 2, float(center.y) - height / 2
        named = str(getattr(detection, "id", ""))
        boxes.append(Box2D(named, (*corner, width, height), label, MappingProxyType(reported)))
    return [Boxes2DRecord(time_ns, frame, tuple(boxes), rotated)]


_Reader = Callable[[Any], Iterable[AnyRecord]]

_WITHOUT_HEADER = frozenset(
    {
        *("ouster_ros/msg/PacketMsg", "ouster_msgs/msg/PacketMsg", "ouster_sensor_msgs/msg/PacketMsg"),
        "robosense_msgs/msg/RobosenseInfoPacket",
    }
)
"""Types of packets that do not say when they were sent."""

_PACKETS = _WITHOUT_HEADER | {
    *("velodyne_msgs/msg/VelodyneScan", "pandar_msgs/msg/PandarScan", "hesai_lidar/msg/PandarScan"),
    *("hesai_ros_driver/msg/UdpFrame", "robosense_msgs/msg/RobosenseScan", "rslidar_msg/msg/RslidarPacket"),
    *("rslidar_msg/msg/RslidarScan", "rslidar_msgs/msg/rslidarScan", "nebula_msgs/msg/NebulaPackets"),
}
"""Types of packets. Source: as of `DEFINITIONS`."""

_READERS: Mapping[str, tuple[Kind, _Reader]] = MappingProxyType(
    {
        "tf2_msgs/msg/TFMessage": (Kind.TRANSFORM, _transforms),
        "tf/msg/tfMessage": (Kind.TRANSFORM, _transforms),
        "geometry_msgs/msg/TransformStamped": (Kind.TRANSFORM, _transforms),
        "sensor_msgs/msg/PointCloud2": (Kind.CLOUD, _cloud),
        "sensor_msgs/msg/Image": (Kind.IMAGE, _image),
        "sensor_msgs/msg/CompressedImage": (Kind.COMPRESSED_IMAGE, _compressed_image),
        "sensor_msgs/msg/LaserScan": (Kind.CLOUD, _scan),
        "sensor_msgs/msg/MultiEchoLaserScan": (Kind.CLOUD, _scan),
        "point_cloud_interfaces/msg/CompressedPointCloud2": (Kind.CLOUD, _packed_cloud),
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (Kind.VIDEO, _video),
        **{f"{_FOXGLOVE}{name}": (kind, partial(_foxglove, read)) for name, (kind, read) in READERS.items()},
        "sensor_msgs/msg/CameraInfo": (Kind.CAMERA_MODEL, _camera_model),
        "nav_msgs/msg/Odometry": (Kind.POSE, _odometry),
        "nav_msgs/msg/OccupancyGrid": (Kind.GRID, _grid),
        "geometry_msgs/msg/TwistStamped": (Kind.SAMPLE, _twist),
        "geometry_msgs/msg/TwistWithCovarianceStamped": (Kind.SAMPLE, _twist),
        "geometry_msgs/msg/PoseStamped": (Kind.POSE, _pose),
        "geometry_msgs/msg/PoseWithCovarianceStamped": (Kind.POSE, _pose),
        "geometry_msgs/msg/PointStamped": (Kind.POSE, _point),
        "sensor_msgs/msg/NavSatFix": (Kind.FIX, _fix),
        "sensor_msgs/msg/Imu": (Kind.SAMPLE, _imu),
        "sensor_msgs/msg/MagneticField": (Kind.SAMPLE, _magnetic),
        "sensor_msgs/msg/Temperature": (Kind.SAMPLE, _temperature),
        "vision_msgs/msg/Detection3DArray": (Kind.BOXES_3D, _boxes_3d),
        "vision_msgs/msg/Detection2DArray": (Kind.BOXES_2D, _boxes_2d),
        **dict.fromkeys(_LIVOX, (Kind.CLOUD, _cloud)),
        **dict.fromkeys(_PACKETS, (Kind.PACKETS, _packets)),
        "std_msgs/msg/String": (Kind.NOTES, lambda message: [NotesRecord(0, message.data)]),
    }
)
"""The types that are read, by name: what they state, and what reads them."""

_NOT_READ: Mapping[str, str] = MappingProxyType(
    {
        "vision_msgs/msg/Detection3DArray": "hypotheses but the likeliest, and their poses,",
        "vision_msgs/msg/Detection2DArray": "hypotheses but the likeliest, and their poses,",
    }
)
"""What is left out of messages that are read."""

_DIAGONAL, _GPS = 2, 1
_VIDEOS = frozenset({"h264", "h265", "vp9", "av1"})
_LATEST_SECOND = 2**31 - 1
_Message = tuple[str, Mapping[str, Any] | tuple[Any, ...]]  # the type of a message, and its fields by name or in order


class _Messages:
    """Makes messages with the types of a store; of ROS 1, headers have a number, and matrices upper-case names."""

    def __init__(self, store: Any, *, ros1: bool, shift_ns: int) -> None:
        """Begin; `shift_ns` is added to all times."""
        self._types, self._ros1, self._shift_ns = store.types, ros1, shift_ns

    def of(self, record: AnyRecord) -> tuple[str, Any]:
        """Give the type of a record's message, and the message."""
        make = self._makers.get(type(record))
        if make is None:
            raise OutputError(f"a {type(record).__name__}; there is no message for it")
        name, fields = make(self, record)
        return name, self._types[name](**fields) if isinstance(fields, Mapping) else self._types[name](*fields)

    def _make(self, name: str, *arguments: Any, **fields: Any) -> Any:
        return self._types[name](*arguments, **fields)

    def _time(self, time_ns: int) -> Any:
        seconds, nanoseconds = divmod(time_ns + self._shift_ns, 1_000_000_000)
        if not 0 <= seconds <= _LATEST_SECOND:
            raise OutputError(f"time {time_ns} ns; ROS holds times from 0 to 2^31 seconds: move the scene in time")
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)

    def _header(self, time_ns: int, frame_id: str) -> Any:
        number = {"seq": 0} if self._ros1 else {}
        return self._make("std_msgs/msg/Header", **number, stamp=self._time(time_ns), frame_id=frame_id)

    def _of_geometry(self, name: str, numbers: Iterable[Any]) -> Any:
        """A point, vector or quaternion."""
        return self._make(f"geometry_msgs/msg/{name}", *map(float, numbers))

    def _pose(self, position: Any, quaternion_xyzw: Any) -> Any:
        parts = self._of_geometry("Point", position), self._of_geometry("Quaternion", quaternion_xyzw)
        return self._make("geometry_msgs/msg/Pose", *parts)

    def _spread_pose(self, position: Any, quaternion_xyzw: Any, covariance: Any = None) -> Any:
        """A pose with its covariance, zeros for none."""
        numbers = np.zeros(36) if covariance is None else np.ascontiguousarray(covariance, np.float64).reshape(-1)
        return self._make("geometry_msgs/msg/PoseWithCovariance", self._pose(position, quaternion_xyzw), numbers)

    def _transform(self, record: TransformRecord) -> _Message:
        place = self._of_geometry("Vector3", record.position), self._of_geometry("Quaternion", record.quaternion_xyzw)
        moved = self._make("geometry_msgs/msg/Transform", *place)
        head = self._header(record.timestamp_ns, record.parent)
        timestamped = self._make("geometry_msgs/msg/TransformStamped", head, record.child, moved)
        return "tf2_msgs/msg/TFMessage", ([timestamped],)

    def _cloud(self, record: CloudRecord) -> _Message:
        count = record.count or 0
        return "sensor_msgs/msg/PointCloud2", {
            "header": self._header(record.timestamp_ns, record.frame_id),
            "height": 1,
            "width": count,
            "fields": [
                self._make("sensor_msgs/msg/PointField", field.name, field.offset, _NUMBERS[field.dtype.str[1:]], 1)
                for field in record.fields
            ],
            "is_bigendian": False,
            "point_step": record.stride,
            "row_step": record.stride * count,
            "data": np.frombuffer(record.data, np.uint8),
            "is_dense": True,
        }

    def _image(self, record: ImageRecord) -> _Message:
        return "sensor_msgs/msg/Image", {
            "header": self._header(record.timestamp_ns, record.frame_id),
            "height": record.height,
            "width": record.width,
            "encoding": record.encoding,
            "is_bigendian": 0,
            "step": record.step,
            "data": np.frombuffer(record.data, np.uint8),
        }

    def _file(self, record: CompressedImageRecord) -> _Message:
        """An image's file, or a packet of a video."""
        data = np.frombuffer(record.data, np.uint8)
        if record.form in _VIDEOS:
            fields = self._time(record.timestamp_ns), record.frame_id, data, record.form
            return "foxglove_msgs/msg/CompressedVideo", fields
        head = self._header(record.timestamp_ns, record.frame_id)
        return "sensor_msgs/msg/CompressedImage", (head, record.form, data)

    def _camera_model(self, record: CameraModelRecord) -> _Message:
        numbers = {"d": record.coefficients, "k": record.k, "r": np.eye(3).reshape(-1), "p": record.p}
        return "sensor_msgs/msg/CameraInfo", {
            "header": self._header(record.timestamp_ns, record.frame_id),
            "height": record.height,
            "width": record.width,
            "distortion_model": record.model,
            "binning_x": 0,
            "binning_y": 0,
            "roi": self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, do_rectify=False),
            **{key.upper() if self._ros1 else key: np.array(row, np.float64) for key, row in numbers.items()},
        }

    def _posed(self, record: PoseRecord) -> _Message:
        """Where a body was; a point, where its orientation is not known."""
        head = self._header(record.timestamp_ns, record.frame_id)
        if record.quaternion_xyzw is None:
            return "geometry_msgs/msg/PointStamped", (head, self._of_geometry("Point", record.position))
        pose = self._spread_pose(record.position, record.quaternion_xyzw, record.covariance)
        still = self._make("geometry_msgs/msg/Twist", *(self._of_geometry("Vector3", (0, 0, 0)) for _ in range(2)))
        twist = self._make("geometry_msgs/msg/TwistWithCovariance", still, np.zeros(36))
        return "nav_msgs/msg/Odometry", (head, record.body, pose, twist)

    def _fix(self, record: FixRecord) -> _Message:
        spread = np.diag(record.variances or (0.0, 0.0, 0.0)).reshape(-1).astype(np.float64)
        status = self._make("sensor_msgs/msg/NavSatStatus", 0, _GPS)
        head, known = self._header(record.timestamp_ns, record.frame_id), record.variances is not None
        return "sensor_msgs/msg/NavSatFix", (head, status, *record.lla, spread, _DIAGONAL if known else 0)

    def _sample(self, record: SampleRecord) -> _Message:
        """What an IMU measured; what it did not is marked by -1 in the covariance."""
        head, values = self._header(record.timestamp_ns, record.frame_id), record.values
        if "magnetometer" in values:
            field = self._of_geometry("Vector3", np.array(values["magnetometer"]) * _MICROTESLA)
            return "sensor_msgs/msg/MagneticField", (head, field, np.zeros(9))
        if "imuTemperature" in values:
            return "sensor_msgs/msg/Temperature", (head, values["imuTemperature"][0] - _ZERO_CELSIUS, 0.0)
        missing = np.array([-1.0, *np.zeros(8)])
        parts: list[Any] = [self._of_geometry("Quaternion", (0, 0, 0, 1)), missing]
        for stream in ("gyroscope", "accelerometer"):
            vector = self._of_geometry("Vector3", values.get(stream, (0, 0, 0)))
            parts += [vector, np.zeros(9) if stream in values else missing]
        return "sensor_msgs/msg/Imu", (head, *parts)

    def _boxes_3d(self, record: Boxes3DRecord) -> _Message:
        detections = []
        for box in record.boxes:
            place = self._pose(box.center, box.quaternion_xyzw), self._of_geometry("Vector3", box.size_lwh)
            bounds = self._make("vision_msgs/msg/BoundingBox3D", *place)
            head = self._header(record.timestamp_ns, box.frame_id)
            parts = head, self._hypotheses(box.label), bounds, box.id
            detections.append(self._make("vision_msgs/msg/Detection3D", *parts))
        frame = record.boxes[0].frame_id if record.boxes else ""
        return "vision_msgs/msg/Detection3DArray", (self._header(record.timestamp_ns, frame), detections)

    def _boxes_2d(self, record: Boxes2DRecord) -> _Message:
        detections, head = [], self._header(record.timestamp_ns, record.frame_id)
        for box in record.boxes:
            left, top, width, height = box.box_ltwh
            point = self._make("vision_msgs/msg/Point2D", left + width / 2, top + height / 2)
            center = self._make("vision_msgs/msg/Pose2D", point, 0.0)
            bounds = self._make("vision_msgs/msg/BoundingBox2D", center, width, height)
            parts = head, self._hypotheses(box.label), bounds, box.id
            detections.append(self._make("vision_msgs/msg/Detection2D", *parts))
        return "vision_msgs/msg/Detection2DArray", (head, detections)

    def _hypotheses(self, label: str | None) -> list[Any]:
        if label is None:
            return []
        reported = self._make("vision_msgs/msg/ObjectHypothesis", label, 1.0)
        pose = self._spread_pose((0, 0, 0), (0, 0, 0, 1))
        return [self._make("vision_msgs/msg/ObjectHypothesisWithPose", reported, pose)]

    def _notes(self, record: NotesRecord) -> _Message:
        return "std_msgs/msg/String", (record.text,)

    _makers: ClassVar[Mapping[type[Any], Callable[["_Messages", Any], _Message]]] = MappingProxyType({
        TransformRecord: _transform, CloudRecord: _cloud, ImageRecord: _image, CompressedImageRecord: _file,
        CameraModelRecord: _camera_model, PoseRecord: _posed, FixRecord: _fix, SampleRecord: _sample,
        Boxes3DRecord: _boxes_3d, Boxes2DRecord: _boxes_2d, NotesRecord: _notes,
    })  # fmt: skip
