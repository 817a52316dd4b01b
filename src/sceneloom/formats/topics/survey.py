"""A first look at all topics: what they state, when, and everything of them that is small."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, cast

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.topics.log import Topic, TopicLog
from sceneloom.formats.topics.notes import Notes, read_notes
from sceneloom.formats.topics.records import LARGE, AnyRecord, Kind, TransformRecord
from sceneloom.formats.topics.timestamps import TopicTimes, settle_times
from sceneloom.scene.warnings import WarningKind

R = TypeVar("R")


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
    notes: Notes
    times_ns: dict[int, Int64Array] = field(default_factory=dict)
    records: dict[int, list[AnyRecord]] = field(default_factory=dict)

    def topics(self, *kinds: Kind) -> list[Topic]:
        """The topics of some kinds that have messages."""
        return [topic for topic in self.log.topics if topic.kind in kinds and topic.count]

    def all_of(self, kind: Kind, record_type: type[R]) -> Iterator[R]:
        """The records of all topics of a kind."""
        for topic in self.topics(kind):
            yield from self.of(topic, record_type)

    def of(self, topic: Topic, record_type: type[R]) -> list[R]:
        """The records of a topic of small messages."""
        return [record for record in self.records.get(topic.number, ()) if isinstance(record, record_type)]


def survey(log: TopicLog, ledger: Ledger, *, timestamps: str | None) -> Survey:
    """Look at all topics.

    Args:
        log: the messages.
        ledger: takes warnings and faults.
        timestamps: which times count, "header" or "receive"; None: see `settle_times`.

    Raises:
        DataError: a small message is wrong, or topics are on different clocks.
    """
    found = Survey(log, ledger, read_notes(log.notes, log.name))
    _note_unknown(log, ledger)
    times: list[TopicTimes] = []
    rows: dict[int, list[tuple[int, list[AnyRecord]]]] = {}
    for topic in log.topics:
        if topic.kind is None or not topic.count or topic.kind is Kind.NOTES:
            continue
        received = log.receive_times(topic)
        if topic.kind in LARGE:
            reported, looked = log.timestamps(topic)
            if not looked and not found.notes.ours:
                message = "some messages state the time at which they were received, so the others are taken to do so"
                ledger.note(
                    WarningKind.ASSUMED, "timestamps-from-index", f"{log.name}: {topic.name}", message
                )
            times.append(TopicTimes(topic, reported, received))
        else:
            rows[topic.number] = _read(log, topic, ledger)
            first = np.array([records[0].timestamp_ns for _, records in rows[topic.number]], np.int64)
            kept = received[[k for k, _ in rows[topic.number]]] if len(first) else np.zeros(0, np.int64)
            fixed = topic.kind is Kind.CAMERA_MODEL or _are_fixed(
                [r for _, row in rows[topic.number] for r in row]
            )
            times.append(TopicTimes(topic, first, kept, fixed))
    settled = settle_times(
        [row for row in times if len(row.timestamps_ns)], log.name, ledger, wanted=timestamps
    )
    # our own writer moves scenes that begin before 0 where a format knows no such times
    moved_ns = int(found.notes.root.get("time_shift_ns", 0))
    for row in times:
        number = row.topic.number
        settled[number] = settled.get(number, row.timestamps_ns) - moved_ns
        if number in rows:
            counted = settled[number] - row.timestamps_ns
            found.records[number] = [
                _moved(record, int(shift))
                for (_, records), shift in zip(rows[number], counted.tolist(), strict=True)
                for record in records
            ]
        else:
            found.times_ns[number] = settled[number]
    return found


def _are_fixed(records: list[AnyRecord]) -> bool:
    return bool(records) and all(isinstance(record, TransformRecord) and record.fixed for record in records)


def _moved(record: AnyRecord, shift_ns: int) -> AnyRecord:
    if shift_ns == 0:
        return record
    return cast("AnyRecord", replace(cast("Any", record), timestamp_ns=record.timestamp_ns + shift_ns))


def _read(log: TopicLog, topic: Topic, ledger: Ledger) -> list[tuple[int, list[AnyRecord]]]:
    """Read all messages of a topic; those that state nothing are left out."""
    found = []
    for k in range(topic.count):
        try:
            records = list(log.read(topic, k))
        except DataError as error:
            ledger.fault("messages-at-fault", error)
            continue
        if records:
            found.append((k, records))
    return found


def _note_unknown(log: TopicLog, ledger: Ledger) -> None:
    """Report which messages are not read, by their type."""
    groups: dict[tuple[str, str], list[Topic]] = {}
    for topic in log.topics:
        if topic.kind is None and topic.count:
            groups.setdefault((topic.schema, topic.why), []).append(topic)
    for (schema, why), topics in groups.items():
        names = ", ".join(sorted({topic.name for topic in topics}))
        message = f"messages {schema or 'without a type'} on {names}: {why}"
        count = sum(topic.count for topic in topics)
        ledger.note(WarningKind.SKIPPED, "unknown-messages", log.name, message, count=count)
