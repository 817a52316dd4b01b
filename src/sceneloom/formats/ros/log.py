"""Bags of ROS as logs of topics."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ros.bags import Bag, Connection
from sceneloom.formats.ros.reading import READERS
from sceneloom.formats.ros.typestores import store_of
from sceneloom.formats.topics.log import Topic
from sceneloom.formats.topics.records import AnyRecord, Kind, TransformRecord

NOTES_TOPIC = "/sceneloom/scene"
"""The topic of what no message has a place for."""

_STAMPS = {"cdr": (4, "iI"), "ros1": (4, "II")}
"""Where the time stands in messages that begin with a header, and in which form.

In CDR four bytes say the byte order, in ROS 1 four bytes are a number that counts messages.
"""

_FIXED = "tf_static"


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

    def stamps(self, topic: Topic) -> tuple[Int64Array, bool]:
        """The time that each message says itself; all of them are looked at."""
        found: list[int] = []
        for file, number, _ in self.parts[topic.number]:
            place, form = _STAMPS[self.bags[file].connections[number].encoding]
            cdr = self.bags[file].connections[number].encoding == "cdr"
            for k, head in enumerate(self.bags[file].heads(number, place + 8)):
                if len(head) < place + 8:
                    raise DataError(self.name, f"{topic.name}[{k}]", f"{len(head)} bytes; expected a message")
                order = "<" if not cdr or head[1] & 1 else ">"
                seconds, nanoseconds = struct.unpack_from(order + form, head, place)
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


def _faults() -> tuple[type[Exception], ...]:
    from rosbags.serde import SerdeError

    known = (
        ValueError,
        IndexError,
        KeyError,
        AttributeError,
        OverflowError,
        TypeError,
        struct.error,
        MemoryError,
    )
    return (SerdeError, AssertionError, *known)


_FAULTS = _faults()


def _fixed(record: AnyRecord) -> AnyRecord:
    if not isinstance(record, TransformRecord):
        return record
    place = record.position, record.quaternion_xyzw
    return TransformRecord(record.timestamp_ns, record.parent, record.child, *place, fixed=True)


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
    for identifier, places in enumerate(groups.values()):
        rows, count = [], 0
        for file, number in places:
            rows.append((file, number, count))
            count += len(bags[file].received(number))
        parts[identifier] = tuple(rows)
        connection = bags[places[0][0]].connections[places[0][1]]
        topics.append(_topic(identifier, connection, count, distro))
    log = RosLog(name, tuple(bags), tuple(topics), MappingProxyType(parts), distro)
    return RosLog(name, log.bags, log.topics, log.parts, distro, _notes(log))


def _topic(number: int, connection: Connection, count: int, distro: str | None) -> Topic:
    named = connection.topic, connection.type
    if connection.encoding not in _STAMPS:
        why = f"in the encoding {connection.encoding!r}; expected {' or '.join(_STAMPS)}"
        return Topic(number, *named, None, count, why)
    known = READERS.get(connection.type)
    if known is None or (known[0] is Kind.NOTES and connection.topic != NOTES_TOPIC):
        return Topic(number, *named, None, count)
    try:
        store_of(connection, distro)
    except ValueError as error:
        return Topic(number, *named, None, count, f"{error}; say which distribution of ROS with distro=")
    return Topic(number, *named, known[0], count)


def _notes(log: RosLog) -> str | None:
    for topic in log.topics:
        if topic.kind is Kind.NOTES and topic.count:
            records = log.read(topic, 0)
            return getattr(records[0], "text", None)
    return None
