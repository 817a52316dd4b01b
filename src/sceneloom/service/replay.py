"""Reads a session log and replays it in this process, or sends it to a service again.

The same records under the same configurations give the same results.
"""

import os
import struct
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from sceneloom.db34t.calibration import CalibrationEntry, CalibrationTable
from sceneloom.db34t.interface import FusionInterface, RecentTrajectory
from sceneloom.db34t.properties import Property, Snapshot
from sceneloom.db34t.protobuf import encode, from_protobuf, parse_message
from sceneloom.db34t.queues import Event, Flushed, Moved, Result
from sceneloom.db34t.received_records import Setting, accepted_alone
from sceneloom.db34t.records import kind_of
from sceneloom.db34t.types import Cause
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError
from sceneloom.formats.base.files import open_file
from sceneloom.service.messages import path_of, property_of, snapshot_of, value_from_protobuf
from sceneloom.service.sending import Pace, Receiver, SendReport, Statistics, must

_MAGIC_BYTES = 8

_OURS = fusion_pb2.DESCRIPTOR.package


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One message of a log.

    Attributes:
        session: that it is of.
        what: what it says.
        topic: of its channel.
        log_time_ns: when it was written.
        message: of our `.proto`.
    """

    session: str
    what: str
    topic: str
    log_time_ns: int
    message: Any


def is_log(path: Path) -> bool:
    """Whether a file begins as an MCAP file does."""
    if not path.is_file():
        return False
    with open_file(path) as file:
        return file.read(6) == b"\x89MCAP0"


def is_complete(path: Path) -> bool:
    """Whether a log was closed, rather than cut off by a crash."""
    if not is_log(path) or path.stat().st_size < 2 * _MAGIC_BYTES:
        return False
    with open_file(path) as file:
        start = file.read(_MAGIC_BYTES)
        file.seek(-_MAGIC_BYTES, os.SEEK_END)
        return file.read() == start


def read_log(path: Path) -> Iterator[LogEntry]:
    """Give the messages of our schemas in the order in which they were written; what a crash cut off ends it.

    Raises:
        DataError: the file is no MCAP file, or holds none of our messages.
    """
    from mcap.records import Channel, Schema
    from mcap.records import Message as Record

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    found = False
    for record in _records(path):
        if isinstance(record, Schema):
            schemas[record.id] = _message_type(record.name)
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Record):
            channel = channels[record.channel_id]
            message_type = schemas.get(channel.schema_id)
            if message_type is None or "what" not in channel.metadata:
                continue
            found = True
            reported = channel.metadata
            yield LogEntry(
                reported.get("session", ""),
                reported["what"],
                channel.topic,
                record.log_time,
                parse_message(message_type, record.data),
            )
    if not found:
        raise DataError(path, "", f"no messages of {_OURS}; expected a log of this service")


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Whether a log, played again, gave what it says.

    Attributes:
        equal: by session, how many results were the same, byte for byte.
        different: by session, those that were not: kind and number.
        beyond: by session, those that the log does not have. The last ones are none of a log that a crash cut off.
        complete: whether the log was closed.
        gaps: by session, how often the log left something out; what came after the first gap of a session is not
            compared, for it depends on what is missing.
    """

    equal: Mapping[str, int]
    different: Mapping[str, tuple[str, ...]]
    beyond: Mapping[str, tuple[str, ...]]
    complete: bool
    gaps: Mapping[str, int] = field(default_factory=dict)

    def __bool__(self) -> bool:
        if self.gaps or any(self.different.values()):
            return False
        return not (self.complete and any(self.beyond.values()))


def replay(path: str | Path, *, session: str | None = None) -> Iterator[tuple[str, Result]]:
    """Play a log again and give session and result, in the order in which they were.

    Args:
        session: only that one; None for all.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
    """
    playing: dict[str, _Session] = {}
    for entry in read_log(Path(path)):
        if session is not None and entry.session != session:
            continue
        played = playing.setdefault(entry.session, _Session(Path(path)))
        for result in played.take(entry):
            yield entry.session, result


def compare(path: str | Path) -> ReplayReport:
    """Play a log again and hold each result against the log's own.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
    """
    playing: dict[str, _Session] = {}
    equal: dict[str, int] = {}
    different: dict[str, list[str]] = {}
    gaps: dict[str, int] = {}
    waiting: dict[str, dict[tuple[str, int], bytes]] = {}
    for entry in read_log(Path(path)):
        if entry.what == "gap":
            gaps[entry.session] = gaps.get(entry.session, 0) + 1
        if entry.session in gaps:
            continue
        ours = waiting.setdefault(entry.session, {})
        played = playing.setdefault(entry.session, _Session(Path(path)))
        for result in played.take(entry):
            ours[kind_of(result.record).name, result.number] = encode(result.record)
        if entry.what == "result":
            name = entry.message.WhichOneof("result")
            key = name, entry.message.number
            logged = encode(from_protobuf(getattr(entry.message, name)))
            if ours.pop(key, None) == logged:
                equal[entry.session] = equal.get(entry.session, 0) + 1
            else:
                different.setdefault(entry.session, []).append(f"{name} {entry.message.number}")
    beyond = {
        name: tuple(f"{kind} {number}" for kind, number in left)
        for name, left in waiting.items()
        if name not in gaps
    }
    reported = {name: tuple(found) for name, found in different.items()}
    return ReplayReport(equal, reported, beyond, is_complete(Path(path)), gaps)


@dataclass(slots=True)
class _Session:
    """One session that is played again."""

    path: Path
    _fusion: FusionInterface = field(init=False)
    _results: list[Result] = field(default_factory=list)
    _snapshot: Snapshot | None = None
    _algorithms: tuple[str, str] | None = None
    _properties: Any = None
    _table: CalibrationTable = field(default_factory=CalibrationTable)
    _setting: Setting | None = None
    _trajectory: RecentTrajectory = field(default_factory=RecentTrajectory)

    def __post_init__(self) -> None:
        self._fusion = FusionInterface(inline=True, observer=self._note)

    def take(self, entry: LogEntry) -> list[Result]:
        """Do what an entry says, and give what it results in."""
        do = _STEPS.get(entry.what)
        if do is not None:
            do(self, entry.message)
        results, self._results = self._results, []
        return results

    def _note(self, event: Event) -> None:
        if isinstance(event, Result):
            self._results.append(event)

    def properties(self, message: Any) -> None:
        """Go by other properties."""
        self._properties, self._setting = message, None

    def algorithms(self, message: Any) -> None:
        """Go by other algorithms."""
        sensor_data, detections = value_from_protobuf(message)
        self._algorithms, self._setting = (sensor_data, detections), None

    def calibration(self, message: Any) -> None:
        """Go by another calibration of a pair."""
        entry = CalibrationEntry(message.camera_id, message.lidar_id, from_protobuf(message.calibration))
        self._table, self._setting = self._table.having([entry]), None

    def pairs(self, message: Any) -> None:
        """Forget the calibrations of all other pairs."""
        kept = {tuple(pair) for pair in value_from_protobuf(message)}
        entries = {pair: entry for pair, entry in self._table.entries.items() if pair in kept}
        self._table, self._setting = CalibrationTable(MappingProxyType(entries)), None

    def record(self, message: Any) -> None:
        """Fuse a record."""
        if self._setting is None:
            if self._properties is None:
                raise DataError(self.path, "", "a record before any configuration; expected it first")
            self._setting = Setting.of(snapshot_of(self._properties, self._algorithms), self._table)
        self._fusion.repeat(accepted_alone(from_protobuf(message), self._setting))

    def motion(self, message: Any) -> None:
        """Move the vehicle on."""
        path = path_of(message)
        self._fusion.repeat(Moved(self._trajectory.extended(path), path))

    def flush(self, _: Any) -> None:
        """Fuse what waits."""
        self._fusion.repeat(Flushed())


_STEPS = {
    "properties": _Session.properties,
    "algorithms": _Session.algorithms,
    "calibration": _Session.calibration,
    "pairs": _Session.pairs,
    "record": _Session.record,
    "motion": _Session.motion,
    "flush": _Session.flush,
}
"""What each entry of a log does; the others are only reported."""


def _message_type(schema: str) -> type[Any] | None:
    package, _, name = schema.rpartition(".")
    return getattr(fusion_pb2, name, None) if package == _OURS else None


def _records(path: Path) -> Iterator[Any]:
    """The records of a file up to its end, or to where it was cut off."""
    from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
    from mcap.stream_reader import StreamReader

    if not is_log(path):
        raise DataError(path, "", "no MCAP file")
    with open_file(path) as file:
        try:
            yield from StreamReader(file, record_size_limit=path.stat().st_size).records
        except (EndOfFile, RecordLengthLimitExceeded, struct.error):
            return  # it ends in the middle of a record
        except (McapError, RuntimeError, ValueError) as error:
            raise DataError(path, f"byte {file.tell()}", f"cannot be read: {error}") from error


def send_log(
    path: str | Path,
    open_session: Callable[[str], Receiver],
    *,
    rate: float = 1.0,
    pace: Pace | None = None,
) -> SendReport:
    """Send what was taken in the sessions of a log, in its order.

    What was refused or dropped is not sent again. Results are the same byte for byte as long as the receiving sessions
    drop nothing and no pause lets them fuse what waits earlier than it was; `replay` excludes both.

    Args:
        open_session: gives what is sent to, by the name of the session in the log.
        rate: 1 for as fast as it came, 2 for twice as fast, 0 for as fast as the sessions take it.
        pace: holds records back; None for one of that rate.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
        OptionError: a session refuses the configuration.
    """
    begun = time.perf_counter()
    kept = pace or Pace(rate)
    sessions: dict[str, _Sending] = {}
    for entry in read_log(Path(path)):
        step = _SENDING_LOGS_STEPS.get(entry.what)
        if step is None:
            continue
        if entry.session not in sessions:
            sessions[entry.session] = _Sending(Statistics(open_session(entry.session), kept))
        kept.until(entry.log_time_ns)
        step(sessions[entry.session], entry)
    for sending in sessions.values():
        sending.end()
    sent: Counter[str] = sum((sending.statistics.sent for sending in sessions.values()), Counter())
    refused: Counter[str] = sum((sending.statistics.refused for sending in sessions.values()), Counter())
    return SendReport(
        source=str(path),
        sensors={},
        sent=dict(sorted(sent.items())),
        refused=dict(sorted(refused.items())),
        seconds=time.perf_counter() - begun,
    )


@dataclass(slots=True)
class _Sending:
    """One session of a log that is sent again."""

    statistics: Statistics
    _known: dict[str, Property] = field(default_factory=dict)
    _policy: str | None = None

    @property
    def receiver(self) -> Receiver:
        """What is sent to."""
        return self.statistics.receiver

    def properties(self, entry: LogEntry) -> None:
        """Add and set what is not so yet; the algorithms follow by themselves."""
        for found in map(property_of, entry.message.properties):
            known = self._known.get(found.name)
            if not found.predefined and known is None:
                outcome = self.receiver.add_property(found.name, found.description, str(found.type))
                if outcome.cause is not Cause.KNOWN_NAME:
                    must(outcome, f"property {found.name}")
            if found.name == _POLICY and self.statistics.pace.rate <= 0:
                # as fast as possible, what there is no room for is sent again; in the end it is as it was
                self._policy = found.value
                must(self.receiver.set_property(_POLICY, "refuse"), f"property {_POLICY}")
            elif found.value is not None and found.name != _ALGORITHM and self._differs(found):
                must(self.receiver.set_property(found.name, found.value), f"property {found.name}")
            self._known[found.name] = found

    def algorithms(self, entry: LogEntry) -> None:
        """Set the algorithms of both types; the type that the log says is set last."""
        chosen = self.receiver.get_property(_TYPE)
        for number, name in enumerate(value_from_protobuf(entry.message)):
            must(self.receiver.set_property(_TYPE, number), f"property {_TYPE}")
            must(self.receiver.set_property(_ALGORITHM, name), f"property {_ALGORITHM}")
        must(self.receiver.set_property(_TYPE, chosen), f"property {_TYPE}")

    def calibration(self, entry: LogEntry) -> None:
        """Set or replace a calibration."""
        message = entry.message
        outcome = self.receiver.set_calibration(
            from_protobuf(message.calibration), camera_id=message.camera_id, lidar_id=message.lidar_id
        )
        must(outcome, f"calibration of camera {message.camera_id} and lidar {message.lidar_id}")

    def record(self, entry: LogEntry) -> None:
        """Send a record."""
        self.statistics.send(from_protobuf(entry.message))

    def motion(self, entry: LogEntry) -> None:
        """Send poses."""
        path = path_of(entry.message)
        self.statistics.count("motion", self.receiver.send_motion(path), len(path.timestamps_ns))

    def flush(self, _: LogEntry) -> None:
        """Fuse what waits."""
        self.receiver.flush()

    def end(self) -> None:
        """Leave the session as the log left it."""
        if self._policy is not None:
            self.receiver.set_property(_POLICY, self._policy)

    def _differs(self, found: Property) -> bool:
        known = self._known.get(found.name)
        before: Any = self.receiver.get_property(found.name) if known is None else known.value
        return bool(before != found.value)


_POLICY, _TYPE, _ALGORITHM = "queue_policy", "fusion_type", "fusion_algorithm"

_SENDING_LOGS_STEPS: dict[str, Callable[[_Sending, LogEntry], None]] = {
    "properties": _Sending.properties,
    "algorithms": _Sending.algorithms,
    "calibration": _Sending.calibration,
    "record": _Sending.record,
    "motion": _Sending.motion,
    "flush": _Sending.flush,
}
"""What is sent of each entry of a log; the others only report."""
