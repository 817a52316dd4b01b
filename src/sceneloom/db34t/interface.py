"""The data fusion interface of DB34/T 4101-2022, clause 5, in one process: properties, calibration, ego trajectory.

Received records, results.

Its configuration can be read from a TOML file.
"""

import math
import threading
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from sceneloom.db34t.boxes import Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.db34t.calibration import (
    MOST_PAIRS,
    CalibrationEntry,
    CalibrationTable,
    check_calibration,
    entry_of,
    format_calibrations,
    parse_calibrations,
)
from sceneloom.db34t.properties import Property, PropertyStore, parse_sensors
from sceneloom.db34t.queues import (
    QUEUE_PROPERTIES,
    Announcer,
    Flushed,
    Moved,
    Observer,
    QueueLimits,
    Refused,
    Result,
    Task,
)
from sceneloom.db34t.received_records import (
    CLOCK_JUMP_NS,
    Accepted,
    Collection,
    Counters,
    Ledger,
    ReceivedRecords,
    RefusedError,
    Setting,
    WholeRecord,
    check_headings,
)
from sceneloom.db34t.records import CalibrationData, SentRecord, kind_of
from sceneloom.db34t.types import DONE, Cause, Outcome, refused
from sceneloom.db34t.worker import ResultsQueue, Worker
from sceneloom.errors import CalibrationError, DataError, OptionError, PoseError, SceneloomError
from sceneloom.formats.base.files import read_settings
from sceneloom.fusion.algorithms import FusionType, algorithm
from sceneloom.scene.poses import Poses

_KEPT_NS = 60_000_000_000
"""So much of the trajectory is kept."""

_MOST_POSES = 100_000
"""Of one minute: a sender that reports more than 1600 poses a second is stopped."""


@dataclass(slots=True)
class RecentTrajectory:
    """Puts together poses that come piece by piece."""

    _path: Poses | None = None

    def extended(self, path: Poses) -> Poses:
        """Add newer poses, and give the trajectory of the last minute.

        Poses that are very much older begin another way: a clock was set back. Positions are counted from the newest
        one, so that points far from a map's origin keep their digits.

        Raises:
            PoseError: they are not newer than those that came before, or too many.
        """
        if path.static or len(path.timestamps_ns) == 0:
            raise PoseError("no poses with times; expected one or more")
        before = self._path
        if before is not None and path.start_ns < before.stop_ns - CLOCK_JUMP_NS:
            before = None
        if before is not None and path.start_ns <= before.stop_ns:
            raise PoseError(
                f"a pose at {path.start_ns} ns after one at {before.stop_ns} ns; expected newer ones"
            )
        parts = [path] if before is None else [before, path]
        times = np.concatenate([part.timestamps_ns for part in parts])
        kept = slice(int(np.searchsorted(times, times[-1] - _KEPT_NS)), None)
        if len(times[kept]) > _MOST_POSES:
            raise PoseError(f"{len(times[kept])} poses in a minute; expected at most {_MOST_POSES}")
        self._path = Poses(
            times[kept],
            np.concatenate([part.positions for part in parts])[kept],
            np.concatenate([part.quaternions_xyzw for part in parts])[kept],
        )
        return self._path.moved(self._path.positions[-1])


_MOST_MOVES = 100
"""Chunks of the vehicle's trajectory that may wait for the thread that fuses."""


class FusionInterface:
    """Receives records, fuses them, and gives results: the standard's interface, for callers in several threads.

    A record is checked by the thread that sends it, and fused by a thread of the interface, but for short lists of
    boxes that nothing waits before; with `inline` the sender fuses always, so that equal records give equal results
    whatever the time. Use it in `with`, or call `close`.

    Attributes:
        properties: clauses 5.2 to 5.5.
        counters: what came in, what was left out and why.

    Source: DB34/T 4101-2022, clause 5.
    """

    def __init__(
        self,
        *,
        inline: bool = False,
        observer: Observer | None = None,
        on_result: Callable[[], None] | None = None,
        limits: QueueLimits | None = None,
    ) -> None:
        """Make a system with the predefined properties and no calibration.

        Args:
            inline: whether the threads that send also fuse.
            observer: reported all that is taken, refused and given, one call at a time.
            on_result: called as soon as a result can be fetched.
            limits: of what waits, whatever the properties state; None for none.
        """
        self.properties = PropertyStore(check_algorithm=lambda kind, name: algorithm(FusionType(kind), name))
        self.counters = Counters()
        self._lock = threading.RLock()
        self._table = CalibrationTable()
        self._setting: Setting | None = None
        self._trajectory = RecentTrajectory()
        self._limits = limits or QueueLimits()
        self._making_room: Flushed | None = None
        self._remarked: set[tuple[tuple[int, int], str]] = set()
        self._closed = False
        self._ledger = Ledger(self.counters)
        self._announcer = Announcer(observer, self.counters)
        self._received_records = ReceivedRecords()
        self._collection = Collection(self._received_records, self._hand_in)
        self._results_queue = ResultsQueue(
            self.counters, self._announcer, on_result=on_result, most_bytes=self._limits.most_bytes
        )
        self._worker = Worker(
            self.counters,
            self._ledger,
            self._announcer,
            self._results_queue.give,
            inline=inline,
            overdue=self._close_overdue,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add_property(self, name: str, description: str, type: str) -> Outcome:
        """Add a property, clause 5.3; see `PropertyStore.add`."""
        return self.properties.add(name, description, type)

    def set_property(self, name: str, value: Any) -> Outcome:
        """Set a property, clause 5.4; see `PropertyStore.set`. It counts for all records that come after.

        `calibration` replaces all calibrations.
        """
        most = self._limits.most_length
        if name in QUEUE_PROPERTIES and isinstance(value, int) and value > most:
            return refused(Cause.OUT_OF_RANGE, f"{name}: {value}; expected at most {most} here")
        with self._lock:
            outcome = self.properties.set(name, value)
            if outcome and name == "calibration":
                self._table = CalibrationTable().having(parse_calibrations(self.properties.get(name).value))
        return outcome

    def get_property(self, name: str) -> Any:
        """Give the value of a property, clause 5.5; None where it was added and not set yet.

        Raises:
            OptionError: there is none of that name.
        """
        return self.properties.get(name).value

    def list_properties(self) -> tuple[Property, ...]:
        """Give all properties, those of table 2 first."""
        return tuple(self.properties.snapshot().properties.values())

    def set_calibration(self, data: CalibrationData, *, camera_id: int = 0, lidar_id: int = 0) -> Outcome:
        """Set or replace the calibration of a camera and a lidar; it counts for all records that come after.

        The property `calibration` shows it with all others.
        """
        if not isinstance(data, CalibrationData):
            return refused(Cause.BAD_RECORD, f"a {type(data).__name__}; expected a record of table 3")
        if not all(isinstance(number, int) and 0 <= number <= 255 for number in (camera_id, lidar_id)):
            return refused(Cause.OUT_OF_RANGE, f"camera {camera_id}, lidar {lidar_id}; expected 0 to 255")
        try:
            check_calibration(data)
        except CalibrationError as error:
            return refused(Cause.BAD_CALIBRATION, error)
        width, height = data.image_size
        if width * height > self._limits.most_pixels:
            return refused(Cause.TOO_MANY, self._too_many_pixels(width * height))
        with self._lock:
            table = self._table.having([CalibrationEntry(camera_id, lidar_id, data)])
            if len(table.entries) > MOST_PAIRS:
                return refused(
                    Cause.TOO_MANY, f"{len(table.entries)} calibrations; expected at most {MOST_PAIRS}"
                )
            outcome = self.properties.set("calibration", format_calibrations(tuple(table.entries.values())))
            if outcome:
                self._table = table
        return outcome

    def send_motion(self, path: Poses) -> Outcome:
        """Report where the vehicle was: poses in a world that stands, x forward, y left, z up.

        They are of the body that the property `sensors` mounts lidars on (`body_from_lidar`), else of the lidar itself.
        """
        with self._lock:
            if self._closed:
                return refused(Cause.CLOSED, "the session has ended")
            if self._worker.waiting_moves >= _MOST_MOVES:
                return refused(Cause.QUEUE_FULL, f"{_MOST_MOVES} chunks of the trajectory wait already")
            try:
                recent = self._trajectory.extended(path)
            except SceneloomError as error:
                return refused(Cause.BAD_MOTION, error)
            self.counters.add("received.motion", len(path.timestamps_ns))
            self._worker.do(Moved(recent, path))
        return DONE

    def send(self, record: SentRecord) -> Outcome:
        """Hand in a record of tables 4 to 8, clause 5.6.

        Returns:
            1 with a reason where it is taken and its calibration looks wrong: stated once of each calibration.
        """
        with self._lock:
            if not isinstance(record, SentRecord):
                reason = f"a {type(record).__name__}; expected a record of tables 4 to 8"
                return self._refuse(record, refused(Cause.BAD_RECORD, reason))
            if self._closed:
                return self._refuse(record, refused(Cause.CLOSED, "the session has ended"))
            try:
                setting = self._current()
                outcome = (
                    self._gather(record, setting)
                    if isinstance(record, Box3d | Box2d)
                    else self._admit(record, setting, "received")
                )
            except RefusedError as error:
                return self._refuse(record, error.outcome)
        return outcome

    def get(self, fusion_type: int | None = None, timeout_s: float = 0.0) -> Result | None:
        """Fetch the oldest result that nobody has fetched, clause 5.7; None where there is none.

        Args:
            fusion_type: 0 sensor data, 1 detections; None for what the property fusion_type says.
            timeout_s: how long to wait for one; for ever where it is infinite.

        Raises:
            OptionError: there is no such type, or the time is no number.
        """
        chosen = self.properties.get("fusion_type").value if fusion_type is None else fusion_type
        if chosen not in _FUSION_TYPES:
            raise OptionError(f"fusion type {chosen!r}; expected 0 (sensor data) or 1 (detections)")
        if math.isnan(timeout_s):
            raise OptionError(f"timeout_s {timeout_s}; expected a time in seconds")
        return self._results_queue.get(FusionType(chosen), min(timeout_s, threading.TIMEOUT_MAX))

    def put_back(self, result: Result) -> None:
        """Take back a result that could not be delivered; it is the next one again."""
        self._results_queue.put_back(result)

    def results(self, fusion_type: int | None = None) -> Iterator[Result]:
        """Fetch all results that are there."""
        return iter(lambda: self.get(fusion_type), None)

    def flush(self) -> None:
        """Fuse what waits with what has come, and return when that is done."""
        with self._lock:
            if self._closed:
                return
            self._collection.close()
            flushed = Flushed()
            self._worker.do(flushed)
        flushed.done.wait()

    def repeat(self, task: Task) -> None:
        """Do what an observer was reported that a session did; what that one accepted is not judged again.

        Raises:
            OptionError: the interface has a thread of its own, which could drop it.
        """
        if not self._worker.inline:
            raise OptionError("a session with a thread of its own; expected one that was made with `inline`")
        with self._lock:
            if isinstance(task, Accepted):
                self._ledger.issue(task.ticket)
            self._worker.do(task)

    def close(self) -> None:
        """End: fuse what waits, let all who wait for results go."""
        with self._lock:
            if self._closed:
                return
            self._collection.close()
            self._closed = True
            self._worker.close()
        self._worker.join()
        self._results_queue.close()

    @property
    def waiting_results(self) -> int:
        """How many results wait to be fetched."""
        return len(self._results_queue)

    @property
    def waiting_records(self) -> int:
        """How many records were taken and are not done with, those that boxes alone are gathered in not counted."""
        return self._ledger.waiting()

    @property
    def waiting_boxes(self) -> int:
        """How many boxes that came alone wait for others of their frame."""
        with self._lock:
            return len(self._collection)

    def _refuse(self, record: SentRecord, outcome: Outcome) -> Outcome:
        self.counters.add(f"refused.{outcome.cause}")
        self._announcer.notify(Refused(record, outcome))
        return outcome

    def _current(self) -> Setting:
        """The configuration in force now, read once for all records until it changes."""
        snapshot = self.properties.snapshot()
        found = self._setting
        if found is None or found.properties is not snapshot or found.table is not self._table:
            try:
                found = self._setting = Setting.of(snapshot, self._table, before=found)
            except SceneloomError as error:
                raise RefusedError(refused(Cause.BAD_CALIBRATION, error)) from error
        if found.pixels > self._limits.most_pixels:
            raise RefusedError(refused(Cause.TOO_MANY, self._too_many_pixels(found.pixels)))
        return found

    def _too_many_pixels(self, count: int) -> str:
        return f"the cameras have {count} pixels together; expected at most {self._limits.most_pixels} here"

    def _admit(self, record: WholeRecord, setting: Setting, verb: str) -> Outcome:
        """Take a record of a whole frame, and count it as one that was received or gathered."""
        accepted = self._received_records.admit(record, setting)
        most, policy = setting.properties["queue_length"], setting.properties["queue_policy"]
        if policy == "refuse" and self._ledger.waiting(accepted.stream) >= most:
            reason = f"{most} records of {accepted.kind} {accepted.sensor_id} wait already (queue_length)"
            raise RefusedError(refused(Cause.QUEUE_FULL, reason))
        self._check_room(accepted.ticket.size)
        jump = self._received_records.note(accepted)
        if jump:
            self.counters.add(f"clock.{jump}")
        self.counters.add(f"{verb}.{accepted.stream[0]}")
        self.counters.add("left-out.points", accepted.left_out)
        self._ledger.issue(accepted.ticket)
        self._worker.do(accepted, most=most)
        return self._notes(accepted)

    def _check_room(self, size: int) -> None:
        """Refuse what there is no room for, and see to it that there will be: let go of what waits for partners."""
        waiting, most = self._ledger.waiting_bytes, self._limits.most_bytes
        if waiting + size <= most:
            return
        if self._making_room is None or self._making_room.done.is_set():
            self._making_room = Flushed(final=True)
            self._worker.do(self._making_room)
        reason = f"{waiting} bytes wait and {size} come; expected at most {most}"
        raise RefusedError(refused(Cause.TOO_MANY, reason))

    def _notes(self, accepted: Accepted) -> Outcome:
        """The answer 1, with what looks wrong with the calibrations of a sensor if nobody was reported yet."""
        setting = accepted.setting
        found = [
            (pair, note)
            for pair in setting.pairs_of(accepted.kind, accepted.sensor_id)
            for note in setting.pairs[pair].notes
            if (pair, note) not in self._remarked
        ]
        if not found:
            return DONE
        self._remarked.update(found)
        self.counters.add("notes.calibration", len(found))
        reported = "; ".join(f"camera {camera}, lidar {lidar}: {note}" for (camera, lidar), note in found)
        return Outcome(1, Cause.NONE, reported)

    def _gather(self, box: Box3d | Box2d, setting: Setting) -> Outcome:
        """Keep a box that came alone until its frame is whole."""
        if isinstance(box, Box3d):
            check_headings(np.array([box.direction]), "", setting)
        begins = self._collection.add(box, setting)
        self.counters.add(f"received.{kind_of(box).name}")
        if begins:
            self._worker.wake()
        return DONE

    def _hand_in(self, whole: Boxes3d | Boxes2d, setting: Setting) -> None:
        """Take the boxes that came alone for a whole frame; those who sent them were answered already."""
        try:
            self._admit(whole, setting, "gathered")
        except RefusedError as error:
            self.counters.add(f"gathered-refused.{error.outcome.cause}")
            self._announcer.notify(Refused(whole, error.outcome))

    def _close_overdue(self, now_s: float) -> float | None:
        """Take frames for whole that no box came for since a while, and state when the next one may be."""
        setting, oldest_s = self._setting, self._collection.oldest_s()
        if setting is None or oldest_s is None:
            return None
        if oldest_s + setting.timeout_s <= now_s:
            with self._lock:
                self._collection.close(older_than_s=now_s - setting.timeout_s)
            oldest_s = self._collection.oldest_s()
        return None if oldest_s is None else oldest_s + setting.timeout_s


_FUSION_TYPES = tuple(FusionType)

_TABLES = ("properties", "added", "sensors", "calibrations")

_ADDED = ("name", "description", "type", "value")

_IN_TABLES_OF_THEIR_OWN = ("sensors", "calibration")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConfigurationFile:
    """What a file says; read and tried by `read_configuration_file`.

    Attributes:
        path: of the file.
        properties: values of predefined properties, in the file's order.
        added: properties of clause 5.3: name, description, type and perhaps value.
        sensors: the text of the property `sensors`, "" for none.
        calibrations: the records of table 3.
        further: tables that are not of the fusion system.
    """

    path: Path
    properties: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    added: tuple[Mapping[str, Any], ...] = ()
    sensors: str = ""
    calibrations: tuple[CalibrationEntry, ...] = ()
    further: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))

    def apply(self, fusion: FusionInterface) -> None:
        """Set what the file says.

        Raises:
            DataError: something is refused.
        """
        for k, row in enumerate(self.added):
            location = f"added[{k}]"
            self._check(location, fusion.add_property(row["name"], row.get("description", ""), row["type"]))
            if "value" in row:
                self._check(f"{location}.value", fusion.set_property(row["name"], row["value"]))
        for name, value in self.properties.items():
            self._check(f"properties.{name}", fusion.set_property(name, value))
        if self.sensors:
            self._check("sensors", fusion.set_property("sensors", self.sensors))
        for k, entry in enumerate(self.calibrations):
            outcome = fusion.set_calibration(entry.data, camera_id=entry.camera_id, lidar_id=entry.lidar_id)
            self._check(f"calibrations[{k}]", outcome)

    def _check(self, location: str, outcome: Outcome) -> None:
        if not outcome:
            raise DataError(self.path, location, outcome.reason)


def read_configuration_file(path: Path | str, *, further: tuple[str, ...] = ()) -> ConfigurationFile:
    """Read a file and try whether a fusion system takes what it says.

    Args:
        path: of the TOML file.
        further: names of tables that others read.

    Raises:
        DataError: it is no TOML, has something unknown in it, or a value is refused.
        OSError: it cannot be read.

    Source: DB34/T 4101-2022, clause 5.2, tables 2 and 3.
    """
    path = Path(path)
    content = _tables(path)
    for name, table in content.items():
        if name not in (*_TABLES, *further):
            raise DataError(path, name, f"unknown; expected one of {', '.join((*_TABLES, *further))}")
        if not isinstance(table, list if name in ("added", "calibrations") else dict):
            wanted = f"[[{name}]]" if name in ("added", "calibrations") else f"[{name}]"
            raise DataError(path, name, f"{table!r}; expected a table {wanted}")
    found = ConfigurationFile(
        path=path,
        properties=MappingProxyType(_properties(path, content.get("properties", {}))),
        added=tuple(_added(path, k, row) for k, row in enumerate(content.get("added", ()))),
        sensors=_sensors(path, content.get("sensors", {})),
        calibrations=_calibrations(path, content.get("calibrations", ())),
        further=MappingProxyType({name: content[name] for name in further if name in content}),
    )
    with FusionInterface(inline=True) as tried:
        found.apply(tried)
    return found


def _tables(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_settings(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise DataError(path, "", f"no TOML: {error}") from error


def _properties(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    for name in _IN_TABLES_OF_THEIR_OWN:
        if name in table:
            own = "[sensors.ID]" if name == "sensors" else "[[calibrations]]"
            raise DataError(path, f"properties.{name}", f"a property with tables of its own; expected {own}")
    return table


def _added(path: Path, k: int, row: Any) -> Mapping[str, Any]:
    location = f"added[{k}]"
    if not isinstance(row, dict):
        raise DataError(path, location, f"{row!r}; expected a table")
    for name in row:
        if name not in _ADDED:
            raise DataError(path, f"{location}.{name}", f"unknown; expected one of {', '.join(_ADDED)}")
    for name in ("name", "type"):
        if name not in row:
            raise DataError(path, f"{location}.{name}", "missing; expected as clause 5.3 has it")
    for name in ("name", "description", "type"):
        if not isinstance(row.get(name, ""), str):
            raise DataError(path, f"{location}.{name}", f"{row[name]!r}; expected a string")
    return MappingProxyType(row)


def _sensors(path: Path, table: dict[str, Any]) -> str:
    text = msgspec.json.encode(table, enc_hook=str).decode() if table else ""
    try:
        parse_sensors(text)
    except DataError as error:
        raise DataError(path, ".".join(filter(None, ("sensors", error.location))), error.problem) from error
    return text


def _calibrations(path: Path, rows: Any) -> tuple[CalibrationEntry, ...]:
    entries: list[CalibrationEntry] = []
    for k, row in enumerate(rows):
        try:
            entry = entry_of(row, f"[{k}]")
        except DataError as error:
            raise DataError(path, f"calibrations{error.location}", error.problem) from error
        except CalibrationError as error:
            raise DataError(path, f"calibrations[{k}]", str(error)) from error
        if any((entry.camera_id, entry.lidar_id) == (known.camera_id, known.lidar_id) for known in entries):
            pair = f"camera {entry.camera_id} and lidar {entry.lidar_id}"
            raise DataError(path, f"calibrations[{k}]", f"{pair} again; expected each pair once")
        entries.append(entry)
    return tuple(entries)
