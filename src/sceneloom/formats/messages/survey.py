"""A first pass over all topics: timestamps, small messages, and the notes of our own writer."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, TypeVar

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.messages.records import AnyRecord, Kind, Topic, TopicLog
from sceneloom.scene.types import NO_FIELDS
from sceneloom.warnings import WarningKind

VERSION = 1
ATTRIBUTE_PARTS = ("sensor_id", "static", "point_index")
"""What is noted of an attribute beside its name, values, timestamps and extras."""


@dataclass(frozen=True, slots=True)
class _Notes:
    """What our writer left beside the messages: a mapping for each of some things; empty for files of others."""

    sensors: tuple[Mapping[str, Any], ...] = ()
    trajectories: tuple[Mapping[str, Any], ...] = ()
    annotations: tuple[Mapping[str, Any], ...] = ()
    root: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def ours(self) -> bool:
        """Whether there are any."""
        return bool(self.root)


def in_order(timestamps_ns: Int64Array, location: str, ledger: Ledger) -> Int64Array:
    """Give the rows in the order of their times, the first of several with one time."""
    if (np.diff(timestamps_ns) < 0).any():
        count = int((np.diff(timestamps_ns) < 0).sum())
        message = "messages out of order; sorted by their times"
        ledger.note(WarningKind.REPAIRED, "messages-sorted", location, message, count=count)
    _, rows = np.unique(timestamps_ns, return_index=True)
    if len(rows) < len(timestamps_ns):
        message = "messages with the time of another one; the first counts"
        ledger.note(WarningKind.SKIPPED, "repeated-timestamps", location, message, count=len(timestamps_ns) - len(rows))
    return rows.astype(np.int64)


_R = TypeVar("_R")


@dataclass(slots=True)
class Survey:
    """What is in a log.

    Attributes:
        log: the messages.
        ledger: takes warnings and faults.
        notes: what our writer left.
        times_ns: of the messages of each topic of large ones, by its number.
        records: of each topic of small ones, by its number, with the times that count.
    """

    log: TopicLog
    ledger: Ledger
    notes: _Notes
    times_ns: dict[int, Int64Array] = field(default_factory=dict)
    records: dict[int, list[AnyRecord]] = field(default_factory=dict)

    @classmethod
    def begun(cls, log: TopicLog, ledger: Ledger) -> "Survey":
        """A survey that knows the notes only; DataError if they cannot be read."""
        if log.notes is None:
            return cls(log, ledger, _Notes())
        try:
            root = msgspec.json.decode(log.notes, type=dict[str, Any])
            lists = {
                key: msgspec.convert(root.get(key, ()), tuple[dict[str, Any], ...])
                for key in ("sensors", "trajectories", "annotations")
            }
        except (msgspec.MsgspecError, RecursionError) as error:
            raise DataError(log.name, "sceneloom.scene", f"notes that cannot be read: {error}") from error
        return cls(log, ledger, _Notes(**lists, root=MappingProxyType(root)))

    def topics(self, *kinds: Kind) -> list[Topic]:
        """The topics of some kinds that have messages."""
        return [topic for topic in self.log.topics if topic.kind in kinds and topic.count]

    def all_of(self, kind: Kind, record_type: type[_R]) -> Iterator[_R]:
        """The records of all topics of a kind."""
        for topic in self.topics(kind):
            yield from self.of(topic, record_type)

    def of(self, topic: Topic, record_type: type[_R]) -> list[_R]:
        """The records of a topic of small messages."""
        return [record for record in self.records.get(topic.number, ()) if isinstance(record, record_type)]
