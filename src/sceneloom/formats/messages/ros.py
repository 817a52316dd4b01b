"""Bags of ROS 1 and ROS 2: as a log of topics, as a scene, and written from one by rosbags."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rosbags.serde import SerdeError

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, OptionError, OutputError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import LossReport
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.messages.reader import scene_from_topics
from sceneloom.formats.messages.records import (
    AnyRecord,
    Dialect,
    Kind,
    NotesRecord,
    Topic,
    TransformRecord,
    merged,
)
from sceneloom.formats.messages.ros_bags import Bag, Connection, open_bags
from sceneloom.formats.messages.ros_messages import NOT_READ, READERS, Messages, distro_store, store_of
from sceneloom.formats.messages.writer import FIXED_FRAMES_TOPIC, SceneStreams, check_images
from sceneloom.scene.scene import Scene, with_assumed_models
from sceneloom.warnings import WarningKind

_NOTES_TOPIC = "/sceneloom/scene"
"""The topic of what no message has a field for."""

_TIMESTAMPS = {"cdr": (4, "iI"), "ros1": (4, "II")}
"""Where the time stands in messages that begin with a header, and in which form.

In CDR four bytes state the byte order, in ROS 1 four bytes are a number that counts messages.
"""

_FIXED = "tf_static"

_FAULTS = (
    SerdeError,
    AssertionError,
    ValueError,
    IndexError,
    KeyError,
    AttributeError,
    OverflowError,
    TypeError,
    struct.error,
    MemoryError,
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
) -> Scene:
    """Open a bag: its index and all small messages are read, images and points when they are asked for.

    Args:
        path: a `.bag`, a folder of ROS 2, or a file of it.
        form: name of the format.
        lenient: read what is whole of a bag that was not closed, is cut off or damaged; leave out topics and messages
            that are at fault; go by receive times where timestamps are of another clock.
        assume_model: allow computing with camera models whose formulas nothing confirms.
        timestamps: which time of a message counts: "header" or "receive"; None: that of its header.
        ego, world: names of the frames that are to be the ego and the world; None: chosen from the transforms.
        distro: of ROS, "humble", "noetic", …: whose types count where the bag does not define its own.

    Raises:
        DataError: the bag is damaged, or a message is wrong.
        OptionError: there is no such distribution or frame, or `timestamps` is none of the two.
    """
    ledger = Ledger(lenient=lenient)
    with ledger.telling():
        bags = open_bags(path, ledger)
        try:
            log = _log_of(str(path), bags, distro)
            _note_not_read(log, ledger)
        except BaseException:
            for bag in bags:
                bag.close()
            raise
        scene = scene_from_topics(log, ledger, form=form, metadata={}, timestamps=timestamps, ego=ego, world=world)
    return with_assumed_models(scene) if assume_model else scene


open_ros1, open_ros2 = partial(_open_bag, form="ros1"), partial(_open_bag, form="ros2")
"""As `_open_bag`."""


@dataclass(frozen=True, slots=True, eq=False)
class RosLog:
    """The topics of a bag, which may be in several files.

    Attributes:
        name: what messages call it.
        bags: its files, in their order.
        topics: all of them.
        parts: of each topic, by number: which connections of which files it is.
        distro: of ROS, whose types count where the bag has none.
        notes: what our writer left.
    """

    name: str
    bags: tuple[Bag, ...]
    topics: tuple[Topic, ...]
    parts: Mapping[int, tuple[tuple[int, int, int], ...]]
    distro: str | None
    notes: str | None = None

    def receive_times(self, topic: Topic) -> Int64Array:
        """When each message was recorded, (N,) int64 [ns]."""
        return _joined([self.bags[file].received(number) for file, number, _ in self.parts[topic.number]])

    def timestamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself; all of them are looked at."""
        found: list[int] = []
        for file, number, _ in self.parts[topic.number]:
            location, form = _TIMESTAMPS[self.bags[file].connections[number].encoding]
            cdr = self.bags[file].connections[number].encoding == "cdr"
            for k, head in enumerate(self.bags[file].heads(number, location + 8)):
                if len(head) < location + 8:
                    raise DataError(self.name, f"{topic.name}[{k}]", f"{len(head)} bytes; expected a message")
                order = "<" if not cdr or head[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(order + form, head, location)
                found.append(seconds * 1_000_000_000 + nanoseconds)
        return np.array(found, np.int64), True

    def read(self, topic: Topic, k: int) -> Sequence[AnyRecord]:
        """What message `k` says.

        Raises:
            DataError: it is no message of its type.
        """
        file, number, first = next(part for part in reversed(self.parts[topic.number]) if k >= part[2])
        connection = self.bags[file].connections[number]
        content = self.bags[file].data(number, k - first)
        try:
            message = self._parsed(connection, content)
            records = list(READERS[connection.type][1](message))
        except _FAULTS as error:
            raise DataError(self.name, f"{topic.name}[{k}]", f"no {connection.type}: {error}") from error
        if topic.name.endswith(_FIXED):
            return [_fixed(record) for record in records]
        return records

    def _parsed(self, connection: Connection, content: memoryview) -> Any:
        store = store_of(connection, self.distro)
        if connection.encoding == "cdr":
            return store.deserialize_cdr(content, connection.type)
        return store.deserialize_ros1(content, connection.type)

    def close(self) -> None:
        """Release the files."""
        for bag in self.bags:
            bag.close()


def _fixed(record: AnyRecord) -> AnyRecord:
    if not isinstance(record, TransformRecord):
        return record
    location = record.position, record.quaternion_xyzw
    return TransformRecord(record.timestamp_ns, record.parent, record.child, *location, fixed=True)


def _joined(parts: Sequence[Int64Array]) -> Int64Array:
    return np.concatenate(parts) if parts else np.zeros(0, np.int64)


def _log_of(name: str, bags: Sequence[Bag], distro: str | None) -> RosLog:
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
    log = RosLog(name, tuple(bags), tuple(topics), MappingProxyType(parts), distro)
    return RosLog(name, log.bags, log.topics, log.parts, distro, _notes(log))


def _topic(number: int, connection: Connection, count: int, distro: str | None) -> Topic:
    named = connection.topic, connection.type
    if connection.encoding not in _TIMESTAMPS:
        why = f"in the encoding {connection.encoding!r}; expected {' or '.join(_TIMESTAMPS)}"
        return Topic(number, *named, None, count, why)
    known = READERS.get(connection.type)
    if known is None or (known[0] is Kind.NOTES and connection.topic != _NOTES_TOPIC):
        return Topic(number, *named, None, count)
    try:
        store_of(connection, distro)
    except ValueError as error:
        return Topic(number, *named, None, count, f"{error}; state which distribution of ROS with distro=")
    return Topic(number, *named, known[0], count)


def _notes(log: RosLog) -> str | None:
    for topic in log.topics:
        if topic.kind is Kind.NOTES and topic.count:
            records = log.read(topic, 0)
            return getattr(records[0], "text", None)
    return None


def _note_not_read(log: RosLog, ledger: Ledger) -> None:
    """Report what is left out of messages that are read."""
    if log.notes is not None:
        return
    for topic in log.topics:
        if topic.kind is not None and topic.count and topic.schema in NOT_READ:
            message = f"{NOT_READ[topic.schema]} in messages {topic.schema} are not read"
            location = f"{log.name}: {topic.name}"
            ledger.note(WarningKind.SKIPPED, "fields-not-read", location, message, count=topic.count)


_STORAGES = ("sqlite3", "mcap")
"""What files of ROS 2 bags can be."""

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
            {
                "accelerometer": "data",
                "gyroscope": "data",
                "magnetometer": "mag",
                "imuTemperature": "temperature",
            }
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
        scene: the drive.
        path: of the file.
        overwrite: whether a file that is there may be replaced.
        images: see `write_ros2`.
        distro: of ROS 1, whose types are written.

    Raises:
        OptionError: there is no such distribution, or way of writing images.
        OutputError: the file exists, or cannot be written.
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
        scene: the drive.
        path: of the folder.
        overwrite: whether a folder that is there may be replaced.
        storage: "mcap" or "sqlite3".
        images: "jpeg" and "copy" write JPEG files, copied where the scene has them, "png" and "raw" lose nothing,
            "video" hands on videos packet by packet as messages of foxglove_msgs.
        distro: of ROS 2, whose types are written.

    Raises:
        OptionError: there is no such storage, distribution, or way of writing images.
        OutputError: the folder exists, or cannot be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    if storage not in _STORAGES:
        raise OptionError(f"storage {storage!r}; expected one of {', '.join(_STORAGES)}")
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
    store = distro_store(distro)
    if ("std_msgs/msg/Header" in store.types) and _has_number(store) is not ros1:
        raise OptionError(f"distro {distro!r}; expected one of ROS {1 if ros1 else 2}")
    if shift_ns:
        plan.notes["time_shift_ns"] = shift_ns
        what = f"times begin {shift_ns // _SECOND_NS} s later: ROS knows none before 0"
        plan.losses.converted("time_offset_ns", what)
    records = _Records(bag, store, Messages(store, ros1=ros1, shift_ns=shift_ns), shift_ns, ros1=ros1)
    records.add(plan.start_ns, _NOTES_TOPIC, NotesRecord(0, json.dumps(plan.notes)))
    for time_ns, topic, record in merged(plan.streams):
        records.add(time_ns, topic, record)
    return LossReport.of(plan.losses.all)


def _has_number(store: Any) -> bool:
    return any(name == "seq" for name, _ in store.fielddefs["std_msgs/msg/Header"][1])


class _Records:
    """Writes records to a bag; connections are added when they are first needed."""

    def __init__(self, bag: Any, store: Any, messages: Messages, shift_ns: int, *, ros1: bool) -> None:
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
