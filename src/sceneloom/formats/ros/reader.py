"""Reads a bag of ROS as a scene: its connections as a log of topics, and the scene of these."""

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
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.ros.bags import Bag, Connection, open_bags
from sceneloom.formats.ros.reading import NOT_READ, READERS
from sceneloom.formats.ros.typestores import store_of
from sceneloom.formats.topics.log import Topic
from sceneloom.formats.topics.records import AnyRecord, Kind, TransformRecord
from sceneloom.formats.topics.scene_from_topics import scene_from_topics
from sceneloom.scene.assumed_camera_models import with_assumed_models
from sceneloom.scene.scene import Scene
from sceneloom.scene.warnings import WarningKind

NOTES_TOPIC = "/sceneloom/scene"
"""The topic of what no message has a location for."""

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


def open_bag(
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
            log = log_of(str(path), bags, distro)
            _note_not_read(log, ledger)
        except BaseException:
            for bag in bags:
                bag.close()
            raise
        scene = scene_from_topics(
            log, ledger, form=form, metadata={}, timestamps=timestamps, ego=ego, world=world
        )
    return with_assumed_models(scene) if assume_model else scene


open_ros1, open_ros2 = partial(open_bag, form="ros1"), partial(open_bag, form="ros2")
"""As `open_bag`."""


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


def log_of(name: str, bags: Sequence[Bag], distro: str | None) -> RosLog:
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
    if known is None or (known[0] is Kind.NOTES and connection.topic != NOTES_TOPIC):
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
