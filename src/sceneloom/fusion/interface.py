"""The data fusion interface of the standard, clause 5, in one process: what the service offers to others."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from sceneloom.errors import CalibrationError, OptionError, SceneloomError
from sceneloom.fusion.algorithms import FusionType, algorithm
from sceneloom.fusion.bare_boxes import BareBoxes, seq_of
from sceneloom.fusion.calibration.declared import check_calibration
from sceneloom.fusion.calibration.entries import CalibrationEntry, parse_calibrations
from sceneloom.fusion.calibration.table import CalibrationTable
from sceneloom.fusion.counters import Counters
from sceneloom.fusion.intake import Admitted, Intake, RefusedError
from sceneloom.fusion.messages.boxes import Box2d, Box3d
from sceneloom.fusion.messages.calibration_data import CalibrationData
from sceneloom.fusion.messages.fused import FusedDetections
from sceneloom.fusion.messages.records import ResultRecord, SentRecord, kind_of
from sceneloom.fusion.motion import RecentWay
from sceneloom.fusion.outcome import DONE, Cause, Outcome, refused
from sceneloom.fusion.properties.store import Property, PropertyStore, Snapshot
from sceneloom.fusion.queues import Flushed, Moved, Task, TaskQueue
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
        configuration: the properties in force when its sweep came.
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
    ) -> None:
        """Make a system with the predefined properties and no calibration.

        Args:
            inline: whether the threads that send also fuse.
            observer: told all that is taken, refused and given, one call at a time.
            on_result: called as soon as a result can be fetched.
        """
        self.properties = PropertyStore(check_algorithm=lambda kind, name: algorithm(FusionType(kind), name))
        self.counters = Counters()
        self._table = CalibrationTable()
        self._setting: Setting | None = None
        self._intake = Intake()
        self._bare: dict[tuple[type, int], BareBoxes] = {}
        self._way = RecentWay()
        self._lock = threading.RLock()
        self._rig = Rig(self.counters)
        self._observer = observer
        self._on_result = on_result
        self._observing = threading.Lock()
        self._results: dict[FusionType, ResultQueue[Result]] = {kind: ResultQueue() for kind in FusionType}
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
        """Set a property, clause 5.4; see `PropertyStore.set`. It counts for all records that come after."""
        with self._lock:
            outcome = self.properties.set(name, value)
            if outcome and name == "calibration":
                self._table = self._table.having(parse_calibrations(self.properties.get(name).value))
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
        """Set or replace the calibration of a camera and a lidar; it counts for all records that come after."""
        if not all(isinstance(number, int) and 0 <= number <= 255 for number in (camera_id, lidar_id)):
            return refused(Cause.OUT_OF_RANGE, f"camera {camera_id}, lidar {lidar_id}; expected 0 to 255")
        try:
            check_calibration(data)
        except CalibrationError as error:
            return refused(Cause.BAD_CALIBRATION, error)
        with self._lock:
            self._table = self._table.having([CalibrationEntry(camera_id, lidar_id, data)])
        return DONE

    def send_motion(self, path: PosePath) -> Outcome:
        """Tell where the vehicle was: poses of the lidar's frame (x forward, y left, z up) in a world that stands."""
        with self._lock:
            if self._closed:
                return refused(Cause.CLOSED, "the session has ended")
            try:
                recent = self._way.extended(path)
            except SceneloomError as error:
                return refused(Cause.BAD_MOTION, error)
            self.counters.add("received.motion", len(path.timestamps_ns))
            self._do(Moved(recent, path))
        return DONE

    def send(self, record: SentRecord) -> Outcome:
        """Hand in a record of tables 4 to 8, clause 5.6."""
        with self._lock:
            if not isinstance(record, SentRecord):
                reason = f"a {type(record).__name__}; expected a record of tables 4 to 8"
                return self._refuse(record, refused(Cause.BAD_RECORD, reason))
            if self._closed:
                return self._refuse(record, refused(Cause.CLOSED, "the session has ended"))
            try:
                self._gather(record) if isinstance(record, Box3d | Box2d) else self._admit(record)
            except RefusedError as error:
                return self._refuse(record, error.outcome)
            self.counters.add(f"received.{kind_of(record).name}")
        return DONE

    def get(self, fusion_type: int | None = None, timeout_s: float = 0.0) -> Result | None:
        """Fetch the oldest result that nobody has fetched, clause 5.7; None where there is none.

        Args:
            fusion_type: 0 sensor data, 1 detections; None for what the property fusion_type says.
            timeout_s: how long to wait for one.

        Raises:
            OptionError: there is no such type.
        """
        chosen = self.properties.get("fusion_type").value if fusion_type is None else fusion_type
        if isinstance(chosen, bool) or chosen not in list(FusionType):
            raise OptionError(f"fusion type {chosen!r}; expected 0 (sensor data) or 1 (detections)")
        return self._results[FusionType(chosen)].get(timeout_s)

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
            self.flush() if self._worker is None else self._close_bare(older_than_s=None)
            self._closed = True
            self._tasks.close()
        if self._worker is not None and self._worker is not threading.current_thread():
            self._worker.join()
        for queue in self._results.values():
            queue.close()

    @property
    def waiting_results(self) -> int:
        """How many results wait to be fetched."""
        return sum(len(queue) for queue in self._results.values())

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
                found = self._setting = Setting.of(snapshot, self._table)
            except SceneloomError as error:
                raise RefusedError(refused(Cause.BAD_CALIBRATION, error)) from error
        return found

    def _admit(self, record: Any) -> None:
        admitted = self._intake.admit(record, self._current())
        if self._intake.jumped_back(admitted):
            self.counters.add("clock.jumps")
            self._intake.restart()
            self._do(Flushed())
        self._intake.note(admitted)
        self._do(admitted)

    def _gather(self, box: Box3d | Box2d) -> None:
        """Keep a box that came alone until its frame is whole."""
        setting = self._current()
        sensors = sorted({pair[isinstance(box, Box3d)] for pair in setting.pairs})
        if len(sensors) != 1:
            raise RefusedError(
                refused(
                    Cause.UNKNOWN_SENSOR if sensors else Cause.NO_CALIBRATION,
                    f"a box of frame {seq_of(box)} that names no sensor, with {len(sensors)} calibrated ones; expected "
                    "one, or lists of boxes, which say theirs",
                )
            )
        bare = self._bare.setdefault((type(box), sensors[0]), BareBoxes(sensors[0]))
        whole = bare.add(box, time.monotonic())
        if whole is not None:
            self._admit(whole)

    def _close_bare(self, *, older_than_s: float | None) -> None:
        """Take frames whose boxes came alone for whole, all of them or those that nothing came for since a time."""
        for bare in self._bare.values():
            if older_than_s is not None and bare.latest_s > older_than_s:
                continue
            whole = bare.close()
            if whole is None:
                continue
            try:
                self._admit(whole)
            except RefusedError as error:
                self._refuse(whole, error.outcome)

    def _do(self, task: Task) -> None:
        """Let the worker do something, or do it here."""
        if self._worker is None:
            self._perform(task)
            return
        properties = self.properties.snapshot()
        most, refuses = properties["queue_length"], properties["queue_policy"] == "refuse"
        dropped = self._tasks.put(task, most=most, refuses=refuses)
        self.counters.add("dropped.queue-full", len(dropped))
        for admitted in dropped:
            self._tell(Dropped(admitted))

    def _work(self) -> None:
        while True:
            timeout_s = self.properties.get("pairing_timeout_ms").value / 1e3
            task = self._tasks.get(timeout_s)
            if task is not None:
                self._perform(task)
            elif self._tasks.closed:
                self._perform(Flushed())
                return
            else:
                self._be_idle(timeout_s)

    def _be_idle(self, timeout_s: float) -> None:
        """Nothing came for a while: do not keep what came before waiting for it."""
        with self._lock:
            self._close_bare(older_than_s=time.monotonic() - timeout_s)
        if len(self._tasks) == 0 and self._rig.waits:
            self._perform(Flushed())

    def _perform(self, task: Task) -> None:
        self._tell(task)
        try:
            for result in self._done(task):
                self._give(result)
        except Exception as error:  # noqa: BLE001 - one record must not end the session
            self.counters.add(f"failed.{type(error).__name__}")
        finally:
            if isinstance(task, Flushed):
                task.done.set()

    def _done(self, task: Task) -> Iterator[RigResult]:
        if isinstance(task, Admitted):
            return self._rig.feed(task.sensor_id, task.received, task.record.seq, task.setting)
        if isinstance(task, Moved):
            self._rig.move(task.path)
            return iter(())
        return self._rig.flush()

    def _give(self, found: RigResult) -> None:
        kind = _type_of(found.record)
        result = Result(self._given[kind], found.record, found.setting.properties)
        self._given[kind] += 1
        self.counters.add(f"results.{kind.name.lower()}")
        self._tell(result)
        most = found.setting.properties["result_queue_length"]
        self.counters.add("dropped.results", self._results[kind].put(result, most=most))
        if self._on_result is not None:
            self._on_result()

    def _tell(self, event: Event) -> None:
        if self._observer is not None:
            with self._observing:
                self._observer(event)


def _type_of(record: ResultRecord) -> FusionType:
    return FusionType.DETECTIONS if isinstance(record, FusedDetections) else FusionType.SENSOR_DATA
