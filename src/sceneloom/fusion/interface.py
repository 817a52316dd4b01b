"""The data fusion interface of the standard, clause 5, in one process: what the service offers to others."""

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any, Self

from sceneloom.errors import CalibrationError, OptionError, SceneloomError
from sceneloom.fusion.admitted import Admitted, WholeRecord
from sceneloom.fusion.algorithms import FusionType, algorithm
from sceneloom.fusion.bare_boxes import MOST_BOXES, BareBoxes, seq_of
from sceneloom.fusion.calibration.declared import check_calibration
from sceneloom.fusion.calibration.entries import CalibrationEntry, format_calibrations, parse_calibrations
from sceneloom.fusion.calibration.table import CalibrationTable
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.intake import Intake, RefusedError
from sceneloom.fusion.ledger import Ledger
from sceneloom.fusion.messages.boxes import Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.records import ResultRecord, SentRecord, kind_of, size_of
from sceneloom.fusion.motion import RecentWay
from sceneloom.fusion.outcome import DONE, Cause, Outcome, refused
from sceneloom.fusion.properties.store import Property, PropertyStore, Snapshot
from sceneloom.fusion.queues import QUEUE_PROPERTIES, Flushed, Moved, QueueLimits, Task, TaskQueue
from sceneloom.fusion.results import ResultQueue
from sceneloom.fusion.rig import Rig, RigResult
from sceneloom.fusion.setting import Setting
from sceneloom.scene.poses import PosePath


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One result, as clause 5.7 gives it.

    Attributes:
        number: among the results of its type, from 0 on; a gap where results were dropped.
        record: of table 9, or the records of table 10 of one pair.
        configuration: the properties in force when its sweep came; all calibrations among them.
    """

    number: int
    record: ResultRecord
    configuration: Snapshot


@dataclass(frozen=True, slots=True, eq=False)
class Refused:
    """A record that was not taken, and why.

    Attributes:
        record: as it was sent.
        outcome: the answer.
    """

    record: SentRecord
    outcome: Outcome


@dataclass(frozen=True, slots=True, eq=False)
class Dropped:
    """A record that had been taken and was dropped before it was fused, because too many waited.

    Attributes:
        admitted: the record.
    """

    admitted: Admitted


_MOST_MOVES = 100
"""Pieces of the vehicle's way that may wait for the thread that fuses."""

_LONGEST_IDLE_S = 3600.0

Event = Admitted | Refused | Dropped | Moved | Flushed | Result
"""What an observer is told, in the order in which it counts."""


class FusionInterface:
    """Receives records, fuses them, and gives results: the standard's interface, for callers in several threads.

    A record is checked by the thread that sends it, and fused by a thread of the interface; with `inline` the sender
    fuses, too, so that equal records give equal results whatever the time. Use it in `with`, or call `close`.

    Attributes:
        properties: clauses 5.2 to 5.5.
        counters: what came in, what was left out and why.

    Source: DB34/T 4101-2022, clause 5.
    """

    def __init__(
        self,
        *,
        inline: bool = False,
        observer: Callable[[Event], None] | None = None,
        on_result: Callable[[], None] | None = None,
        limits: QueueLimits | None = None,
    ) -> None:
        """Make a system with the predefined properties and no calibration.

        Args:
            inline: whether the threads that send also fuse.
            observer: told all that is taken, refused and given, one call at a time.
            on_result: called as soon as a result can be fetched.
            limits: of what waits, whatever the properties say; None for none.
        """
        self.properties = PropertyStore(check_algorithm=lambda kind, name: algorithm(FusionType(kind), name))
        self.counters = Counters()
        self._table = CalibrationTable()
        self._setting: Setting | None = None
        self._intake = Intake()
        self._bare: dict[tuple[type, int], BareBoxes] = {}
        self._way = RecentWay()
        self._lock = threading.RLock()
        self._ledger = Ledger(self.counters)
        self._rig = Rig(self.counters, self._ledger)
        self._remarked: set[tuple[tuple[int, int], str]] = set()
        self._observer = observer
        self._on_result = on_result
        self._observing = threading.Lock()
        self._results: dict[FusionType, ResultQueue[Result]] = {
            kind: ResultQueue(size=lambda result: size_of(result.record)) for kind in FusionType
        }
        self._limits = limits or QueueLimits()
        self._making_room: Flushed | None = None
        self._given = dict.fromkeys(FusionType, 0)
        self._tasks = TaskQueue()
        self._closed = False
        self._worker = None if inline else threading.Thread(target=self._work, name="fusion", daemon=True)
        if self._worker is not None:
            self._worker.start()

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
        with self._lock:
            table = self._table.having([CalibrationEntry(camera_id, lidar_id, data)])
            outcome = self.properties.set("calibration", format_calibrations(tuple(table.entries.values())))
            if outcome:
                self._table = table
        return outcome

    def send_motion(self, path: PosePath) -> Outcome:
        """Tell where the vehicle was: poses of the lidar's frame (x forward, y left, z up) in a world that stands."""
        with self._lock:
            if self._closed:
                return refused(Cause.CLOSED, "the session has ended")
            if self._tasks.moves >= _MOST_MOVES:
                return refused(Cause.QUEUE_FULL, f"{_MOST_MOVES} pieces of the way wait already")
            try:
                recent = self._way.extended(path)
            except SceneloomError as error:
                return refused(Cause.BAD_MOTION, error)
            self.counters.add("received.motion", len(path.timestamps_ns))
            self._do(Moved(recent, path))
        return DONE

    def send(self, record: SentRecord) -> Outcome:
        """Hand in a record of tables 4 to 8, clause 5.6.

        Returns:
            1 with a reason where it is taken and its calibration looks wrong: said once of each calibration.
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
        if chosen not in list(FusionType):
            raise OptionError(f"fusion type {chosen!r}; expected 0 (sensor data) or 1 (detections)")
        if math.isnan(timeout_s):
            raise OptionError(f"timeout_s {timeout_s}; expected a time in seconds")
        return self._results[FusionType(chosen)].get(min(timeout_s, threading.TIMEOUT_MAX))

    def put_back(self, result: Result) -> None:
        """Take back a result that could not be delivered; it is the next one again."""
        self._results[_type_of(result.record)].put_back(
            result, before=lambda other: result.number < other.number
        )
        if self._on_result is not None:
            self._on_result()

    def results(self, fusion_type: int | None = None) -> Iterator[Result]:
        """Fetch all results that are there."""
        return iter(lambda: self.get(fusion_type), None)

    def flush(self) -> None:
        """Fuse what waits with what has come, and return when that is done."""
        with self._lock:
            if self._closed:
                return
            self._close_bare(older_than_s=None)
            flushed = Flushed()
            self._do(flushed)
        flushed.done.wait()

    def repeat(self, task: Task) -> None:
        """Do what an observer was told that a session did; what that one admitted is not judged again.

        Raises:
            OptionError: the interface has a thread of its own, which could drop it.
        """
        if self._worker is not None:
            raise OptionError("a session with a thread of its own; expected one that was made with `inline`")
        with self._lock:
            self._perform(task)

    def close(self) -> None:
        """End: fuse what waits, let all who wait for results go."""
        with self._lock:
            if self._closed:
                return
            self._close_bare(older_than_s=None)
            self._closed = True
            self._tasks.close()
            if self._worker is None:
                self._perform(Flushed(final=True))
        if self._worker is not None and self._worker is not threading.current_thread():
            self._worker.join()
        for queue in self._results.values():
            queue.close()

    @property
    def waiting_results(self) -> int:
        """How many results wait to be fetched."""
        return sum(len(queue) for queue in self._results.values())

    @property
    def waiting_records(self) -> int:
        """How many records were taken and are not done with, those that boxes alone are gathered in not counted."""
        return self._ledger.waiting()

    @property
    def waiting_boxes(self) -> int:
        """How many boxes that came alone wait for others of their frame."""
        with self._lock:
            return sum(len(bare.boxes) for bare in self._bare.values())

    def _refuse(self, record: SentRecord, outcome: Outcome) -> Outcome:
        self.counters.add(f"refused.{outcome.cause}")
        self._tell(Refused(record, outcome))
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
        return found

    def _admit(self, record: WholeRecord, setting: Setting, verb: str) -> Outcome:
        """Take a record of a whole frame, and count it as one that was received or gathered."""
        admitted = self._intake.admit(record, setting)
        most, policy = setting.properties["queue_length"], setting.properties["queue_policy"]
        if policy == "refuse" and self._ledger.waiting(admitted.stream) >= most:
            reason = f"{most} records of {admitted.kind} {admitted.sensor_id} wait already (queue_length)"
            raise RefusedError(refused(Cause.QUEUE_FULL, reason))
        size = size_of(record)
        self._check_room(size)
        self.counters.add("clock.set-back", self._intake.jumped_back(admitted))
        self.counters.add("clock.set-forward", self._intake.jumped_forward(admitted))
        self._intake.note(admitted)
        self.counters.add(f"{verb}.{kind_of(record).name}")
        self._do(replace(admitted, ticket=self._ledger.issue(admitted.stream, size)))
        return self._remarks(admitted)

    def _check_room(self, size: int) -> None:
        """Refuse what there is no room for, and see to it that there will be: let go of what waits for partners."""
        waiting, most = self._ledger.waiting_bytes, self._limits.most_bytes
        if waiting + size <= most:
            return
        if self._making_room is None or self._making_room.done.is_set():
            self._making_room = Flushed(final=True)
            self._do(self._making_room)
        reason = f"{waiting} bytes wait and {size} come; expected at most {most}"
        raise RefusedError(refused(Cause.TOO_MANY, reason))

    def _remarks(self, admitted: Admitted) -> Outcome:
        """The answer 1, with what looks wrong with the calibrations of a sensor if nobody was told yet."""
        setting = admitted.setting
        found = [
            (pair, remark)
            for pair in setting.pairs_of(admitted.kind, admitted.sensor_id)
            for remark in setting.pairs[pair].remarks
            if (pair, remark) not in self._remarked
        ]
        if not found:
            return DONE
        self._remarked.update(found)
        self.counters.add("remarks.calibration", len(found))
        told = "; ".join(f"camera {camera}, lidar {lidar}: {remark}" for (camera, lidar), remark in found)
        return Outcome(1, Cause.NONE, told)

    def _gather(self, box: Box3d | Box2d, setting: Setting) -> Outcome:
        """Keep a box that came alone until its frame is whole."""
        sensor_id = self._intake.sender_of(box, setting)
        bare = self._bare.setdefault((type(box), sensor_id), BareBoxes(sensor_id, setting))
        stream = kind_of(Boxes3d if isinstance(box, Box3d) else Boxes2d).name, sensor_id
        if bare.begins(box):
            if self._intake.has_come(stream, seq_of(box)):
                reason = f"a box of frame {seq_of(box)}, of which all have come; expected it before the next frame's"
                raise RefusedError(refused(Cause.DUPLICATE, reason))
            self._hand_in(bare)
            bare.setting = setting
        elif len(bare.boxes) >= MOST_BOXES:
            reason = f"more than {MOST_BOXES} boxes of frame {seq_of(box)}"
            raise RefusedError(refused(Cause.TOO_MANY, reason))
        self.counters.add(f"received.{kind_of(box).name}")
        bare.add(box, time.monotonic())
        if len(bare.boxes) == 1:
            self._tasks.wake()
        return DONE

    def _hand_in(self, bare: BareBoxes) -> None:
        """Take the boxes that came alone for a whole frame; those who sent them were answered already."""
        whole = bare.close()
        if whole is None:
            return
        try:
            self._admit(whole, bare.setting, "gathered")
        except RefusedError as error:
            self.counters.add(f"gathered-refused.{error.outcome.cause}")
            self._tell(Refused(whole, error.outcome))

    def _close_bare(self, *, older_than_s: float | None) -> None:
        """Take frames whose boxes came alone for whole, all of them or those that nothing came for since a time."""
        for bare in self._bare.values():
            if older_than_s is None or bare.latest_s <= older_than_s:
                self._hand_in(bare)

    def _do(self, task: Task) -> None:
        """Let the worker do something, or do it here."""
        if self._worker is None:
            self._perform(task)
            return
        for admitted in self._tasks.put(task, most=self.properties.snapshot()["queue_length"]):
            self._tell(Dropped(admitted))
            if admitted.ticket is not None:
                self._ledger.settle(admitted.ticket, "dropped.queue-full")

    def _work(self) -> None:
        latest_s = time.monotonic()
        while True:
            task = self._tasks.get(self._patience_s(latest_s))
            if task is not None:
                self._perform(task)
                latest_s = time.monotonic()
            elif self._tasks.closed:
                self._perform(Flushed(final=True))
                return
            else:
                self._be_idle(latest_s)

    def _patience_s(self, latest_s: float) -> float:
        """How long to wait for the next record before something is done without it [s].

        Args:
            latest_s: when the last one was dealt with.
        """
        setting, now_s = self._setting, time.monotonic()
        if setting is None:
            return _LONGEST_IDLE_S
        deadlines = [bare.latest_s + setting.timeout_s for bare in tuple(self._bare.values()) if bare.boxes]
        if self._rig.waits:
            deadlines.append(latest_s + setting.idle_s)
        return max(min(deadlines, default=now_s + _LONGEST_IDLE_S) - now_s, 0.0)

    def _be_idle(self, latest_s: float) -> None:
        """Nothing came for a while: do not keep what came before waiting for it."""
        setting, now_s = self._setting, time.monotonic()
        if setting is None:
            return
        with self._lock:
            self._close_bare(older_than_s=now_s - setting.timeout_s)
        if len(self._tasks) == 0 and self._rig.waits and now_s >= latest_s + setting.idle_s:
            self._perform(Flushed())

    def _perform(self, task: Task) -> None:
        self._tell(task)
        try:
            for result in self._done(task):
                self._give(result)
        except Exception as error:  # noqa: BLE001 - one record must not end the session
            self.counters.add(f"errors.{type(error).__name__}")
        finally:
            if isinstance(task, Flushed):
                task.done.set()

    def _done(self, task: Task) -> Iterator[RigResult]:
        if isinstance(task, Admitted):
            return self._rig.feed(task, task.ticket or self._ledger.issue(task.stream))
        if isinstance(task, Moved):
            self._rig.move(task.path)
            return iter(())
        return self._rig.end() if task.final else self._rig.flush()

    def _give(self, found: RigResult) -> None:
        kind = _type_of(found.record)
        result = Result(self._given[kind], found.record, found.setting.properties)
        self._given[kind] += 1
        self.counters.add(f"results.{kind.name.lower()}")
        self._tell(result)
        most = found.setting.properties["result_queue_length"]
        self.counters.add(
            "dropped.results", self._results[kind].put(result, most=most, most_bytes=self._limits.most_bytes)
        )
        if self._on_result is not None:
            self._on_result()

    def _tell(self, event: Event) -> None:
        if self._observer is None:
            return
        with self._observing:
            try:
                self._observer(event)
            except Exception as error:  # noqa: BLE001 - who only looks on must not end the session
                self.counters.add(f"errors.observer.{type(error).__name__}")


def _type_of(record: ResultRecord) -> FusionType:
    return FusionType.DETECTIONS if isinstance(record, FusedDetections) else FusionType.SENSOR_DATA
