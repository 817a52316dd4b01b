"""The session log: all that sessions receive and give, in one MCAP file that can be replayed.

`SessionLog` writes it. `read_log` reads it, `replay` fuses it once more in this process: the same records under the
same configurations give the same results. `compare` holds these against the results in the log.
"""

import logging
import os
import struct
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO, NamedTuple, Self

from google.protobuf.message import Message

from sceneloom.db34t.events import Accepted, Dropped, Event, Flushed, Moved, Refused, Result
from sceneloom.db34t.interface import FusionInterface
from sceneloom.db34t.protobuf import (
    encode,
    encode_in,
    fill_message,
    from_protobuf,
    motion_request,
    parse_message,
    path_of,
    properties_message,
    snapshot_of,
    value_from_protobuf,
    value_to_protobuf,
)
from sceneloom.db34t.records import ResultRecord, SentRecord, kind_of, size_of
from sceneloom.db34t.setting import CalibrationEntry, CalibrationTable, Setting, calibration_table
from sceneloom.db34t.wire import fusion_pb2
from sceneloom.errors import DataError, OutputError, SceneloomError
from sceneloom.formats.base.files import open_file
from sceneloom.formats.base.output import check_output
from sceneloom.formats.messages.mcap import schema_bytes, serialised
from sceneloom.version import __version__

_LOG = logging.getLogger(__name__)

_CHUNK_BYTES = 4 << 20
"""Of messages that are compressed and written together; the most that is kept in memory, beside the largest message."""

_OVERHEAD = 2048  # what an event that waits keeps beside its arrays [byte], about

_PACKAGE = fusion_pb2.DESCRIPTOR.package
_SENSORS = {"raw": "sensor", "image": "camera", "boxes_2d": "camera", "points": "lidar", "boxes_3d": "lidar"}


class NotLoggedError(SceneloomError):
    """Something is not in the log: the disk was too slow or failed."""


def unfinished_path(path: Path) -> Path:
    """Where a log is until it is closed, and stays after a crash."""
    return path.with_name(f"{path.stem}.unfinished{path.suffix}")


class SessionLog:
    """Writes what happens in sessions; give `session(name)` as the observer of each, or the log itself for one.

    Arrays of records have to stay as they are after they were sent. Neither a file that cannot be written nor a disk
    that is too slow disturbs the sessions: `failure`, `lost` and `close` report it. Once there is no room, everything
    is left out until half of what waits is written, so that the log has long parts that are whole, and not images
    without their sweeps.

    Attributes:
        path: of the log once it is closed.
        failure: why nothing is written any more; None while all is well.
        lost: by session, how many events are not in the log: the disk was too slow, or failed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        most_bytes: int = 512 << 20,
        most_entries: int = 20_000,
        kept_back_s: float = 1.0,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        """Begin a log.

        Args:
            path: of the MCAP file; until it is closed it stands beside as `NAME.unfinished.mcap`.
            most_bytes: of records and results that wait to be written; the default is some two and a half seconds of
                10 Hz of 1080p and 250,000 points.
            kept_back_s: how long what was written may wait for the disk [s]; 0: observers return when it is there.

        Raises:
            OutputError: the log, or an unfinished one of its name, is there, or cannot be written.
        """
        self.path = Path(path)
        self._file = _LogFile(self.path, overwrite=overwrite)
        self.failure: Exception | None = None
        self.lost = Counter[str]()
        self._most_bytes, self._most_entries = most_bytes, most_entries
        self._kept_back_s, self._clock_ns = kept_back_s, clock_ns
        self._sessions: dict[str, _Messages] = {}
        self._own: Callable[[Event], None] | None = None
        self._waiting = deque[_Waiting]()
        self._bytes = 0
        self._missing = Counter[str]()
        self._full = self._writing = self._closed = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __call__(self, event: Event) -> None:
        """Observe the only session of a program."""
        if self._own is None:
            self._own = self.session("default")
        self._own(event)

    def session(self, name: str) -> Callable[[Event], None]:
        """Give the observer of a session; one of a name that ended and began again is another session.

        It raises `NotLoggedError` for an event that will not be written.
        """
        chosen, number = name, 1
        while chosen in self._sessions:
            number += 1
            chosen = f"{name}#{number}"
        self._sessions[chosen] = _Messages(chosen)
        with suppress(NotLoggedError):
            self._put(chosen, None)
        return partial(self._put, chosen)

    def close(self) -> None:
        """Write all that waits, complete the file and give it its name.

        Raises:
            OutputError: it could not be written; what is there is beside it.
        """
        with self._changed:
            is_first, self._closed = not self._closed, True
            self._changed.notify_all()
        self._thread.join()
        if self.lost:
            _LOG.warning("the log is not whole", extra={"fields": {"lost": dict(self.lost)}})
        if is_first:
            self._attempt(self._file.close)
        if self.failure is not None:
            draft = unfinished_path(self.path)
            raise OutputError(f"{self.path}: cannot be written: {self.failure}; see {draft}")

    def _put(self, session: str, event: Event | None) -> None:
        held = event.accepted.record if isinstance(event, Dropped) else getattr(event, "record", None)
        size = _OVERHEAD + (size_of(held) if isinstance(held, SentRecord | ResultRecord) else 0)
        with self._changed:
            ended = self._closed or self.failure is not None
            if ended or not self._has_room(size):
                if not self._missing and not ended:
                    waiting = {"waiting_bytes": self._bytes, "waiting_entries": len(self._waiting)}
                    _LOG.warning(
                        "the disk is slower than what is to be logged: the log has a gap",
                        extra={"fields": {"session": session, **waiting}},
                    )
                self.lost[session] += 1
                self._missing[session] += 1
                raise NotLoggedError("the log has ended" if ended else "the log has no room")
            self._waiting.extend(self._gaps())
            self._missing.clear()
            self._waiting.append(_Waiting(session, event, size, self._clock_ns()))
            self._bytes += size
            self._changed.notify_all()
            if self._kept_back_s <= 0:
                self._changed.wait_for(self._is_done)

    def _is_done(self) -> bool:
        return not self._waiting and not self._writing

    def _gaps(self) -> "list[_Waiting]":
        return [_Waiting(name, count, 0, self._clock_ns()) for name, count in self._missing.items()]

    def _has_room(self, size: int) -> bool:
        waiting = len(self._waiting) + self._writing
        share = 0.5 if self._full else 1.0
        fits = self._bytes + size <= share * self._most_bytes and waiting < share * self._most_entries
        self._full = waiting > 0 and not fits
        return not self._full

    def _work(self) -> None:
        due_s: float | None = None
        while True:
            with self._changed:
                patience_s = None if due_s is None else max(due_s - time.monotonic(), 0.0)
                self._changed.wait_for(lambda: self._waiting or self._closed, patience_s)
                if not self._waiting and self._closed:
                    break
                entry = self._waiting.popleft() if self._waiting else None
                self._writing = entry is not None
            if entry is not None:
                self._write(entry)
                due_s = time.monotonic() + self._kept_back_s if due_s is None else due_s
            if due_s is not None and time.monotonic() >= due_s:
                self._attempt(self._file.flush)
                due_s = None
            with self._changed:
                self._writing = False
                self._bytes -= 0 if entry is None else entry.size
                self._changed.notify_all()
        for gap in self._gaps():
            self._write(gap)

    def _write(self, entry: "_Waiting") -> None:
        try:
            for message in self._sessions[entry.session].of(entry.event):
                self._attempt(partial(self._file.add, entry.session, message, entry.time_ns))
        except Exception as error:  # noqa: BLE001 - one event that cannot be stated must not end the log
            _LOG.error("an entry cannot be logged", extra={"fields": {"error": repr(error)}})
            with self._changed:
                self._missing[entry.session] += 1
                self.lost[entry.session] += 1
            return
        if self.failure is not None:
            with self._changed:
                self.lost[entry.session] += 1

    def _attempt(self, step: Callable[[], None]) -> None:
        """Do a step with the file; one that cannot be written ends the log, and not what it is a log of."""
        if self.failure is not None:
            return
        try:
            step()
        except Exception as error:  # noqa: BLE001 - whatever a full disk or a foreign writer does
            _LOG.error("the log is cut: it cannot be written", extra={"fields": {"error": repr(error)}})
            with self._changed:
                self.failure = error
                self.lost.update(entry.session for entry in self._waiting)
                self._bytes -= sum(entry.size for entry in self._waiting)
                self._waiting.clear()
                self._changed.notify_all()


class _Waiting(NamedTuple):
    """What waits to be written: an event, None for the beginning of a session, or how many events are missing."""

    session: str
    event: Event | int | None
    size: int
    time_ns: int


class _Message(NamedTuple):
    """One message of a session."""

    name: str
    what: str
    type: type[Any] | None
    content: Any
    timestamp_ns: int | None = None


class _Messages:
    """States the events of one session as messages, each after the configuration in force where that is another."""

    def __init__(self, session: str) -> None:
        self._session = session
        self._setting: Setting | None = None

    def of(self, event: Event | int | None) -> Iterator[_Message]:
        """Give the messages of an event."""
        match event:
            case Accepted():
                yield from self._configuration(event.setting)
                kind = kind_of(event.record).name
                yield _record_message(f"{_SENSORS[kind]}/{event.sensor_id}/{kind}", "record", event.record)
            case Refused():
                outcome = event.outcome
                status = fusion_pb2.Status(status=outcome.status, cause=outcome.cause, reason=outcome.reason)
                yield _message("refused", status)
                if isinstance(event.record, SentRecord):
                    yield _record_message(f"refused/{kind_of(event.record).name}", "refused-record", event.record)
            case Dropped():
                record = event.accepted.record
                yield _record_message(f"dropped/{kind_of(record).name}", "dropped-record", record)
            case Moved():
                yield _message("motion", motion_request(event.sent, session=self._session))
            case Flushed():
                yield _message("flush", fusion_pb2.FlushRequest(session=self._session))
            case Result():
                # of its configuration the revision, for it stands in the file already
                reply = fusion_pb2.GetReply(number=event.number)
                reply.configuration.revision = event.configuration.revision
                content, time_ns = encode_in(reply, event.record), event.record.timestamp.nanoseconds
                yield _Message(f"results/{kind_of(event.record).name}", "result", type(reply), content, time_ns)
            case int():
                reason = f"{event} entries are missing here: the disk was slower than what came"
                yield _message("gap", fusion_pb2.Status(status=0, cause="log-gap", reason=reason))
            case None:
                yield _Message("session", "", None, {"session": self._session, "sceneloom": __version__})

    def _configuration(self, setting: Setting) -> Iterator[_Message]:
        before, self._setting = self._setting, setting
        if before is setting:
            return
        if before is None or before.properties is not setting.properties:
            yield _message("configuration", properties_message(setting.properties), "properties")
            yield _message("algorithms", value_to_protobuf(setting.properties.algorithms))
        known = {} if before is None else before.table
        for pair, entry in setting.table.items():
            if known.get(pair) is not entry:
                request = fusion_pb2.SetCalibrationRequest(camera_id=pair[0], lidar_id=pair[1], session=self._session)
                fill_message(request.calibration, entry.data)
                yield _message("calibration", request)
        if set(known) - set(setting.table):
            yield _message("pairs", value_to_protobuf(list(setting.table)))


def _message(name: str, message: Message, what: str = "") -> _Message:
    return _Message(name, what or name, type(message), serialised(message))


def _record_message(name: str, what: str, record: Any) -> _Message:
    message_type = getattr(fusion_pb2, kind_of(record).message_name)
    return _Message(name, what, message_type, encode(record), record.timestamp.nanoseconds)


class _LogFile:
    """The file of a log with any number of channels; until it is closed it has another name."""

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        from sceneloom.formats.messages.mcap_files import McapWriter

        self._path, self._draft, self._overwrite = path, unfinished_path(path), overwrite
        check_output(path, overwrite=overwrite)
        check_output(self._draft, overwrite=overwrite)
        try:
            self._stream: BinaryIO = self._draft.open("wb")
        except OSError as error:
            raise OutputError(f"{self._draft}: cannot be written: {error.strerror}") from error
        library = f"sceneloom {__version__}"
        self._writer = McapWriter(self._stream, library=library, compression="lz4", chunk_bytes=_CHUNK_BYTES)
        self._stream.flush()
        self._latest_ns = 0
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}

    def add(self, session: str, message: _Message, time_ns: int) -> None:
        """Write a message that happened at a time."""
        if message.type is None:
            self._writer.add_metadata(message.name, message.content)
            return
        # times never run backwards in the file, whatever the clock does: its order is what is replayed
        self._latest_ns = max(time_ns, self._latest_ns)
        published_ns = self._latest_ns if message.timestamp_ns is None else message.timestamp_ns
        channel = self._channel(session, message)
        self._writer.add_message(channel, self._latest_ns, [message.content], published_ns)

    def _channel(self, session: str, message: _Message) -> int:
        topic, name = f"/{session}/{message.name}", message.type.DESCRIPTOR.full_name  # type: ignore[union-attr]
        if (topic, name) not in self._channels:
            if len(self._channels) >= 60_000:  # the format counts 65535
                raise OutputError("60000 channels, as many as a log may have")
            if name not in self._schemas:
                self._schemas[name] = self._writer.add_schema(name, "protobuf", schema_bytes(message.type))  # type: ignore[arg-type]
            metadata = {"session": session, "what": message.what}
            self._channels[topic, name] = self._writer.add_channel(topic, "protobuf", self._schemas[name], metadata)
        return self._channels[topic, name]

    def flush(self) -> None:
        """Hand what was added to the disk."""
        self._writer.flush()

    def close(self) -> None:
        """Complete the log and give it its name."""
        self._writer.finish()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()
        check_output(self._path, overwrite=self._overwrite)
        self._draft.replace(self._path)


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
    """Whether a log was closed, rather than cut off by a crash: it ends with the 8 bytes that it begins with."""
    if not is_log(path) or path.stat().st_size < 16:
        return False
    with open_file(path) as file:
        start = file.read(8)
        file.seek(-8, os.SEEK_END)
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
            package, _, name = record.name.rpartition(".")
            schemas[record.id] = getattr(fusion_pb2, name, None) if package == _PACKAGE else None
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Record):
            channel = channels[record.channel_id]
            message_type = schemas.get(channel.schema_id)
            if message_type is None or "what" not in channel.metadata:
                continue
            found = True
            message = parse_message(message_type, record.data)
            session, what = channel.metadata.get("session", ""), channel.metadata["what"]
            yield LogEntry(session, what, channel.topic, record.log_time, message)
    if not found:
        raise DataError(path, "", f"no messages of {_PACKAGE}; expected a log of this service")


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


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Whether a log, replayed, gave what it says.

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
    """Replay a log, or one of its sessions, and give session and result in the order in which they were.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
    """
    replayed: dict[str, _Replayed] = defaultdict(lambda: _Replayed(Path(path)))
    for entry in read_log(Path(path)):
        if session in (None, entry.session):
            for result in replayed[entry.session].take(entry):
                yield entry.session, result


def compare(path: str | Path) -> ReplayReport:
    """Replay a log and compare each result with the log's own.

    Raises:
        DataError: the file is no log, or what stands in it is faulty.
    """
    replayed: dict[str, _Replayed] = defaultdict(lambda: _Replayed(Path(path)))
    ours: dict[str, dict[tuple[str, int], bytes]] = defaultdict(dict)
    equal, gaps = Counter[str](), Counter[str]()
    different: dict[str, list[str]] = defaultdict(list)
    for entry in read_log(Path(path)):
        gaps.update([entry.session] * (entry.what == "gap"))
        if entry.session in gaps:
            continue
        results = ours[entry.session]
        for result in replayed[entry.session].take(entry):
            results[kind_of(result.record).name, result.number] = encode(result.record)
        if entry.what == "result":
            name, number = entry.message.WhichOneof("result"), entry.message.number
            if results.pop((name, number), None) == encode(from_protobuf(getattr(entry.message, name))):
                equal[entry.session] += 1
            else:
                different[entry.session].append(f"{name} {number}")
    return ReplayReport(
        equal=dict(equal),
        different={name: tuple(found) for name, found in different.items()},
        beyond={
            name: tuple(f"{kind} {number}" for kind, number in left) for name, left in ours.items() if name not in gaps
        },
        complete=is_complete(Path(path)),
        gaps=dict(gaps),
    )


@dataclass(slots=True)
class _Replayed:
    """One session that is replayed."""

    path: Path
    _fusion: FusionInterface = field(init=False)
    _results: list[Result] = field(default_factory=list)
    _algorithms: tuple[str, str] | None = None
    _properties: Any = None
    _table: CalibrationTable = field(default_factory=dict)
    _setting: Setting | None = None

    def __post_init__(self) -> None:
        self._fusion = FusionInterface(inline=True, observer=self._note)

    def _note(self, event: Event) -> None:
        if isinstance(event, Result):
            self._results.append(event)

    def take(self, entry: LogEntry) -> list[Result]:
        """Do what an entry says, and give what it results in; entries that only report do nothing."""
        message = entry.message
        match entry.what:
            case "properties":
                self._properties, self._setting = message, None
            case "algorithms":
                sensor_data, detections = value_from_protobuf(message)
                self._algorithms, self._setting = (sensor_data, detections), None
            case "calibration":
                data = from_protobuf(message.calibration)
                added = CalibrationEntry(message.camera_id, message.lidar_id, data)
                self._table, self._setting = calibration_table([added], self._table), None
            case "pairs":
                kept = {tuple(pair) for pair in value_from_protobuf(message)}
                entries = {pair: known for pair, known in self._table.items() if pair in kept}
                self._table, self._setting = MappingProxyType(entries), None
            case "record":
                self._fusion.repeat(from_protobuf(message), self._current())
            case "motion":
                outcome = self._fusion.send_motion(path_of(message))
                if not outcome:
                    raise DataError(self.path, "motion", outcome.reason)
            case "flush":
                self._fusion.flush()
        results, self._results = self._results, []
        return results

    def _current(self) -> Setting:
        if self._setting is None:
            if self._properties is None:
                raise DataError(self.path, "", "a record before any configuration; expected it first")
            self._setting = Setting.of(snapshot_of(self._properties, self._algorithms), self._table)
        return self._setting
