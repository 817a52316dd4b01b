"""The data fusion interface of DB34/T 4101-2022, clause 5, in one process.

Properties, calibration and the ego trajectory are set, records are sent, results are fetched. What is sent is checked
against the configuration in force; boxes that come one by one are gathered to frames.
"""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from types import MappingProxyType, TracebackType
from typing import Any, NoReturn, Self, cast

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.results import FusedFrame
from sceneloom.db34t.events import (
    CLOCK_JUMP_NS,
    Accepted,
    Dropped,
    Event,
    Flushed,
    FrameRecord,
    Moved,
    Observer,
    Refused,
    Result,
    Stream,
    Task,
    Ticket,
)
from sceneloom.db34t.records import (
    Box2d,
    Box3d,
    Boxes2d,
    Boxes3d,
    CalibrationData,
    FusedDetections,
    ImageData,
    PointCloudData,
    RawData,
    ResultRecord,
    SensorFusionData,
    SentRecord,
    join_boxes,
    kind_of,
    size_of,
)
from sceneloom.db34t.scene_objects import (
    FoundObjects,
    boxes_2d_of,
    boxes_3d_of,
    declared_columns,
    measurement_of,
    sensor_fusion_record,
)
from sceneloom.db34t.setting import (
    MOST_PAIRS,
    CalibrationEntry,
    CalibrationTable,
    Property,
    PropertyStore,
    SensorKind,
    Setting,
    calibration_table,
)
from sceneloom.db34t.tables import BOX_3D
from sceneloom.db34t.types import DONE, Cause, Outcome, Timestamp, refused
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.errors import CalibrationError, OptionError, PoseError, SceneloomError
from sceneloom.formats.recording.contents import XYZIRT
from sceneloom.fusion.algorithms import BUILT_IN, FusionType, algorithm
from sceneloom.fusion.system import STILL, FusedDetectionFrame, FusionSystem, Leave, SeenBoxes
from sceneloom.geometry.rigid import RigidTransform, multiply_quaternions, rotate_vectors
from sceneloom.scene.cameras import GLOBAL, CameraImage
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.poses import Poses, PoseSource


@dataclass(slots=True)
class Counters:
    """Counts by name, and follows records until nobody keeps them any more; from any thread.

    Names are words joined by dots, the first says what happened: `received.image`, `refused.bad-record`,
    `dropped.queue-full`, `unpaired.camera`, `results.sensor`, … A record was `fused` if it took part in a result, else
    `dropped`, or its part in the fusion `failed`, or it is `unpaired`: nothing came that it belongs to. For each kind

        received + gathered = fused + unpaired + dropped + failed + waiting

    Attributes:
        waiting_bytes: of the records that have come and are not done with.
    """

    waiting_bytes: int = 0
    _counts: Counter[str] = field(default_factory=Counter)
    _waiting: Counter[Stream] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, count: int = 1) -> None:
        """Count something that happened, if it did."""
        if count:
            with self._lock:
                self._counts[name] += count

    def counts(self) -> dict[str, int]:
        """All that was counted, by name in the order of the alphabet."""
        with self._lock:
            return dict(sorted(self._counts.items()))

    def issue(self, ticket: Ticket) -> None:
        """Note a record that comes in."""
        with self._lock:
            self._waiting[ticket.stream] += 1
            self.waiting_bytes += ticket.size

    def share(self, ticket: Ticket, holders: int) -> None:
        """Note that so many fusion systems keep a record; none of them: it is done."""
        with self._lock:
            ticket.holders = holders + 1
        self.settle(ticket)

    def settle(self, ticket: Ticket, outcome: str = "") -> None:
        """Note that one of them does not keep a record any more, and why if not because it was used or is too old."""
        with self._lock:
            ticket.holders -= 1
            ticket.outcome = ticket.outcome or outcome
            if ticket.holders != 0:
                return
            self._waiting[ticket.stream] -= 1
            self.waiting_bytes -= ticket.size
            if not self._waiting[ticket.stream]:
                del self._waiting[ticket.stream]
        self.add(f"{'fused' if ticket.fused else ticket.outcome or 'unpaired'}.{ticket.stream[0]}")

    def waiting(self, stream: Stream | None = None) -> int:
        """How many records of a stream, or of all, have come and are not done with."""
        with self._lock:
            return self._waiting.total() if stream is None else self._waiting[stream]


class _Announcer:
    """Tells an observer what happens, one call at a time, from any thread; one that fails is counted."""

    def __init__(self, observer: Observer | None, counters: Counters) -> None:
        self.observed = observer is not None
        self._observer = observer
        self._counters = counters
        self._lock = threading.Lock()

    def notify(self, event: Event) -> None:
        """Tell what happened."""
        if self._observer is None:
            return
        with self._lock:
            try:
                self._observer(event)
            except Exception as error:  # noqa: BLE001 - who only looks on must not end the session
                self._counters.add(f"errors.observer.{type(error).__name__}")


_Found = tuple[ResultRecord, Setting, FoundObjects | None]
"""A result, the configuration in force when its sweep came, and of records of table 10 the objects that they report."""


def _rotated(vectors: Float32Array, matrix: Float64Array) -> Float32Array:
    """Take (N, 3) vectors into other axes by a signed permutation, exactly; the same array where nothing rotates."""
    if matrix[0, 0] == matrix[1, 1] == matrix[2, 2] == 1.0:
        return vectors
    columns = np.abs(matrix).argmax(axis=1)
    signs = matrix[range(3), columns].astype(np.float32)
    return read_only(np.ascontiguousarray(vectors[:, columns] * signs))


def _standard_boxes(boxes: Boxes3d, standard_from_declared: Float64Array) -> Boxes3d:
    """Take boxes out of their declared frame."""
    centers, vectors = _rotated(boxes.centers, standard_from_declared), boxes.velocity_vectors
    if centers is boxes.centers:
        return boxes
    return replace(
        boxes,
        centers=centers,
        directions=_rotated(boxes.directions, standard_from_declared),
        velocity_vectors=None if vectors is None else _rotated(vectors, standard_from_declared),
    )


_REACH_NS = 200_000_000
"""How far beyond the last pose the ego trajectory is continued: poses come later than what they are for."""


@dataclass(slots=True)
class Rig:
    """What a session's worker feeds: not for several threads at once.

    Each lidar has a fusion system of its own, whose ego frame is the lidar's: calibrations are of pairs, and those of
    two lidars need not agree on where a camera is. An image goes to all that its camera is calibrated with.

    Attributes:
        counters: told what became of each record, and what went wrong.
    """

    counters: Counters
    _setting: Setting | None = None
    _systems: dict[int, FusionSystem] = field(default_factory=dict)
    _cameras: set[tuple[int, int]] = field(default_factory=set)
    _path: Poses | None = None
    _origin: Float64Array = field(default_factory=lambda: np.zeros(3))
    _trajectories: dict[int, Poses] = field(default_factory=dict)
    _newest_ns: dict[Stream, int] = field(default_factory=dict)
    _left: list[tuple[Accepted, Leave]] = field(default_factory=list)

    def feed(self, accepted: Accepted) -> Iterator[_Found]:
        """Take what a sensor sent, and give what could be fused with it."""
        setting, of_lidar = accepted.setting, accepted.kind is SensorKind.LIDAR
        yield from self._adopt(setting)
        yield from self._follow_clock(accepted.stream, accepted.timestamp_ns)
        pairs = setting.pairs_of(accepted.kind, accepted.sensor_id)
        lidar_ids = (accepted.sensor_id,) if of_lidar and pairs else tuple(sorted(lidar for _, lidar in pairs))
        self.counters.share(accepted.ticket, len(lidar_ids))
        for lidar_id in lidar_ids:
            system = self._systems[lidar_id]
            try:
                self._send(system, lidar_id, accepted)
            except Exception as error:  # noqa: BLE001 - one record must not end the session
                self._failed({"sent": accepted}, error)
                self.counters.settle(accepted.ticket, "failed")
            yield from self._fetch(lidar_id, system)

    def flush(self) -> Iterator[_Found]:
        """Fuse all that waits with what has come."""
        for lidar_id, system in self._systems.items():
            system.flush()
            yield from self._fetch(lidar_id, system)

    def end(self) -> Iterator[_Found]:
        """Fuse all that waits, and keep nothing."""
        for lidar_id, system in self._systems.items():
            system.end()
            yield from self._fetch(lidar_id, system)

    @property
    def waits(self) -> bool:
        """Whether a sweep or its boxes wait for an image."""
        return any(system.waits for system in self._systems.values())

    def move(self, path: Poses, *, origin: Float64Array) -> None:
        """Let the vehicle move along a trajectory from now on, whose positions count from `origin`, (3,) [m]."""
        self._path, self._origin = path, origin
        for lidar_id in self._systems:
            self._move(lidar_id)

    def _move(self, lidar_id: int) -> None:
        """Derive the trajectory of a lidar from that of the vehicle, by the extrinsics in force."""
        if self._path is None or self._setting is None:
            return
        path, declared = self._path, self._setting.sensors.get(lidar_id)
        if declared is not None and declared.body_from_lidar is not None:
            path = Poses(
                path.timestamps_ns,
                path.positions + rotate_vectors(path.quaternions_xyzw, declared.body_from_lidar.translation),
                multiply_quaternions(path.quaternions_xyzw, declared.body_from_lidar.quaternion_xyzw),
                static=path.static,
            )
        self._trajectories[lidar_id] = path
        self._systems[lidar_id].move(path, reach_ns=_REACH_NS)

    def _follow_clock(self, stream: Stream, time_ns: int) -> Iterator[_Found]:
        """Where a sensor's clock was set back, fuse all that waits, and begin anew."""
        newest_ns = self._newest_ns.get(stream, time_ns)
        self._newest_ns[stream] = max(newest_ns, time_ns)
        if time_ns >= newest_ns - CLOCK_JUMP_NS:
            return
        self._newest_ns = {stream: time_ns}
        for lidar_id, system in self._systems.items():
            system.restart(time_ns)
            yield from self._fetch(lidar_id, system)

    def _send(self, system: FusionSystem, lidar_id: int, accepted: Accepted) -> None:
        axes, extras = accepted.setting.standard_from_lidar, MappingProxyType({"sent": accepted})
        name = f"{accepted.kind}{accepted.sensor_id}"
        match accepted.measurement:
            case LidarFrame() as frame:
                points, positions = frame.points, _rotated(frame.points.positions, axes)
                points = points if positions is points.positions else replace(points, positions=positions)
                system.send(name, replace(frame, points=points, extras=extras))
            case Boxes3d() as boxes:
                system.send(name, boxes_3d_of(_standard_boxes(boxes, axes), sensor_id=name), extras=extras)
            case CameraImage() as image:
                pair = accepted.setting.pairs[accepted.sensor_id, lidar_id]
                mount = pair.lidar_from_camera
                system.send(name, replace(image, camera=pair.camera, mount=mount, extras=extras))
            case Boxes2d() as boxes:
                pair = accepted.setting.pairs[accepted.sensor_id, lidar_id]
                seen = boxes_2d_of(boxes, sensor_id=name)
                system.send(name, SeenBoxes(seen, pair.camera, pair.lidar_from_camera, extras))

    def _fetch(self, lidar_id: int, system: FusionSystem) -> Iterator[_Found]:
        """Give what a system has fused, and settle what it does not keep any more."""
        for fused in iter(system.get, None):
            yield from self._sensor_data(lidar_id, fused)
        for found in iter(system.get_detections, None):
            yield from self._detections(lidar_id, found)
        left, self._left = self._left, []
        for accepted, leave in left:
            self.counters.settle(accepted.ticket, leave.value)

    def _sensor_data(self, lidar_id: int, fused: FusedFrame) -> Iterator[_Found]:
        sweep: Accepted = fused.extras["sent"]
        compensated = self._is_compensated(sweep.setting, stationary=fused.stationary)
        world_from_lidar = self._world_from_lidar(lidar_id, fused.reference_ns) if compensated else _HERE
        for view in fused.views:
            image: Accepted = fused.image_extras[view.camera_id]["sent"]
            try:
                record = sensor_fusion_record(
                    fused,
                    view,
                    world_from_lidar,
                    sweep.setting,
                    sent=cast("LidarFrame", sweep.measurement),
                    image=cast("ImageData", image.image),
                    numbers={
                        "camera_id": int(str(view.camera_id).removeprefix("camera")),
                        "lidar_id": lidar_id,
                        "image_seq": image.record.seq,
                        "points_seq": sweep.record.seq,
                    },
                    motion_compensated=compensated,
                )
            except Exception as error:  # noqa: BLE001 - an algorithm may be anyone's, and give anything
                self._failed(fused.extras, error)
                continue
            sweep.ticket.fused = image.ticket.fused = True
            yield record, sweep.setting, None

    def _detections(self, lidar_id: int, found: FusedDetectionFrame) -> Iterator[_Found]:
        sweep: Accepted = found.sweep_extras["sent"]
        image: Accepted = found.image_extras["sent"]
        boxes_3d, boxes_2d = cast("Boxes3d", sweep.measurement), cast("Boxes2d", image.measurement)
        camera_id = int(str(found.camera_id).removeprefix("camera"))
        compensated = self._is_compensated(sweep.setting, stationary=found.stationary)
        try:
            record = _fused_detections_record(
                found,
                boxes_3d,
                boxes_2d,
                sweep.setting,
                camera=image.setting.pairs[camera_id, lidar_id].camera,
                lidar_id=lidar_id,
                camera_id=camera_id,
                motion_compensated=compensated,
            )
        except Exception as error:  # noqa: BLE001 - an algorithm may be anyone's, and give anything
            self._failed(found.sweep_extras, error)
            return
        sweep.ticket.fused = image.ticket.fused = True
        used = (("boxes_3d", boxes_3d, record.box_3d_ids), ("boxes_2d", boxes_2d, record.box_2d_ids))
        for kind, boxes, ids in used:
            # several objects may be made of one box, and a box may have the id of another
            self.counters.add(f"left-out.{kind}", max(len(boxes) - len(ids) + ids.count(None), 0))
        world_from_lidar = self._world_from_lidar(lidar_id, found.timestamp_ns) if compensated else _HERE
        origin = self._origin if compensated else _HERE.translation
        yield record, sweep.setting, FoundObjects(found, world_from_lidar, origin, sweep.setting)

    def _is_compensated(self, setting: Setting, *, stationary: bool) -> bool:
        """Whether the ego trajectory counts for a result; counts where it should and is not known."""
        if self._path is not None and stationary and setting.configuration.motion_compensation:
            self.counters.add("motion.beyond-reach")
        return self._path is not None and not stationary

    def _adopt(self, setting: Setting) -> Iterator[_Found]:
        """Go by another configuration from this record on; gives what waited only for cameras that are gone."""
        if setting is self._setting:
            return
        self._setting = setting
        for camera_id, lidar_id in setting.pairs:
            if lidar_id not in self._systems:
                system = self._systems[lidar_id] = FusionSystem(
                    setting.configuration,
                    on_unreadable=lambda _: self.counters.add("errors.unreadable-image"),
                    on_failed=self._failed,
                    on_left=lambda extras, leave: self._left.append((extras["sent"], leave)),
                )
                period_ns = setting.sweep_period_ns
                system.add_lidar(f"lidar{lidar_id}", _AT_LIDAR, period_ns=period_ns, location=_AT_LIDAR)
            if (camera_id, lidar_id) not in self._cameras:
                self._systems[lidar_id].add_camera(f"camera{camera_id}", _AT_LIDAR, index=camera_id % 255)
                self._cameras.add((camera_id, lidar_id))
            declared = setting.sensors.get(camera_id)
            shutter = GLOBAL if declared is None else declared.shutter
            self._systems[lidar_id].roll(f"camera{camera_id}", shutter)
        for lidar_id, system in self._systems.items():
            system.configure(setting.configuration, period_ns=setting.sweep_period_ns)
            self._move(lidar_id)
            system.expect([f"camera{camera}" for camera, lidar in setting.pairs if lidar == lidar_id])
            yield from self._fetch(lidar_id, system)

    def _failed(self, extras: Mapping[str, Any], error: Exception) -> None:
        self.counters.add(f"errors.{type(error).__name__}")
        sent: Accepted = extras["sent"]
        sent.ticket.outcome = sent.ticket.outcome or "failed"

    def _world_from_lidar(self, lidar_id: int, time_ns: int) -> RigidTransform:
        if lidar_id not in self._trajectories:
            return _HERE
        pose = PoseSource(self._trajectories[lidar_id], _HERE, _REACH_NS).pose_at(time_ns)
        return _HERE if pose is None else pose  # out of reach is only a sweep without points, if it was compensated


_HERE = RigidTransform.identity()
_AT_LIDAR = PoseSource(STILL, _HERE)


def _fused_detections_record(
    frame: FusedDetectionFrame,
    boxes_3d: Boxes3d,
    boxes_2d: Boxes2d,
    setting: Setting,
    *,
    camera: Camera,
    lidar_id: int,
    camera_id: int,
    motion_compensated: bool,
) -> FusedDetections:
    """The records of objects of a sweep and an image, to whose camera's size boxes are cut (table 10)."""
    fused = frame.fused
    columns, sound = declared_columns(fused, setting.declared_from_standard, camera)
    _tilt(columns, fused, boxes_3d, setting.standard_from_lidar)
    fields: dict[str, Any] = {
        "timestamp": boxes_3d.timestamp,
        "image_seq": boxes_2d.seq,
        "points_seq": boxes_3d.seq,
        "camera_id": camera_id,
        "lidar_id": lidar_id,
        "id": fused.ids.astype(np.int32),
        "class_names": fused.labels,
        "box_3d_ids": _box_ids(fused.rows_3d, boxes_3d),
        "box_2d_ids": _box_ids(fused.rows_2d, boxes_2d),
        "motion_compensated": int(motion_compensated),
        "image_timestamp": Timestamp.of(frame.image_timestamp_ns),
    }
    return FusedDetections.of_sound_numbers(**fields, **columns) if sound else FusedDetections(**fields, **columns)


def _tilt(columns: dict[str, Any], fused: FusedBoxes, boxes_3d: Boxes3d, standard_from_declared: Float64Array) -> None:
    """Let directions rise and fall as those that were sent do: objects of the fusion system are upright."""
    rows = np.flatnonzero(fused.rows_3d != NO_BOX)
    up = standard_from_declared[2]
    sent = boxes_3d.directions[fused.rows_3d[rows]].astype(np.float64)
    lifts = sent @ up
    tilted = np.flatnonzero(lifts)
    if not len(tilted):
        return
    rows, sent, lifts = rows[tilted], sent[tilted], lifts[tilted]
    level = np.sqrt((sent * sent).sum(axis=1) - lifts * lifts)
    headings = columns["directions"][rows].astype(np.float64)
    # an object may have been found to head the other way, and then goes down where the box went up
    along = np.sign((headings * sent).sum(axis=1))
    tilts = np.where(along == 0, 0.0, along) * np.arctan2(lifts, level)
    directions = headings * np.cos(tilts)[:, None] + np.sin(tilts)[:, None] * up
    columns["directions"][rows] = directions
    if columns["velocity_vectors"] is not None:
        columns["velocities"][rows] = (columns["velocity_vectors"][rows] * directions).sum(axis=1)


def _box_ids(rows: Int64Array, boxes: Boxes3d | Boxes2d) -> tuple[int | None, ...]:
    ids = boxes.id.tolist()
    return tuple(None if row == NO_BOX else ids[row] for row in rows.tolist())


_FUSION_TYPES = {SensorFusionData: FusionType.SENSOR_DATA, FusedDetections: FusionType.DETECTIONS}


class _ResultsQueue:
    """The results of both fusion types: given by one thread at a time, fetched by several."""

    def __init__(
        self, counters: Counters, announcer: _Announcer, *, on_result: Callable[[], None] | None, most_bytes: int
    ) -> None:
        """Hold nothing yet; `most_bytes` is how large the results of one type that wait may be together."""
        self._counters, self._announcer, self._on_result = counters, announcer, on_result
        self._most_bytes = most_bytes
        self._given, self._bytes = dict.fromkeys(FusionType, 0), dict.fromkeys(FusionType, 0)
        self._waiting: dict[FusionType, deque[Result]] = {kind: deque() for kind in FusionType}
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        """How many results wait to be fetched."""
        return sum(len(waiting) for waiting in self._waiting.values())

    def give(self, found: _Found) -> None:
        """Let a result be fetched; the oldest ones beyond the limits are dropped and counted."""
        record, setting, objects = found
        kind, properties = _FUSION_TYPES[type(record)], setting.properties
        result = Result(self._given[kind], record, properties, objects)
        self._given[kind] += 1
        self._counters.add(f"results.{kind.name.lower()}")
        self._announcer.notify(result)
        waiting, most, dropped = self._waiting[kind], properties["result_queue_length"], 0
        with self._changed:
            self._keep(kind, len(waiting), result)
            while len(waiting) > 1 and (len(waiting) > most or self._bytes[kind] > self._most_bytes):
                self._take(kind)
                dropped += 1
        self._counters.add("dropped.results", dropped)
        if self._on_result is not None:
            self._on_result()

    def get(self, kind: FusionType, timeout_s: float) -> Result | None:
        """Fetch the oldest result, waiting for one up to `timeout_s`; None where none came or the queue is closed."""
        waiting = self._waiting[kind]
        with self._changed:
            if not waiting and timeout_s > 0.0:
                self._changed.wait_for(lambda: waiting or self._closed, timeout_s)
            return self._take(kind) if waiting else None

    def put_back(self, result: Result) -> None:
        """Take back a result that could not be delivered, in front of all that came after it."""
        kind = _FUSION_TYPES[type(result.record)]
        waiting = self._waiting[kind]
        with self._changed:
            later = (k for k, other in enumerate(waiting) if result.number < other.number)
            self._keep(kind, next(later, len(waiting)), result)
        if self._on_result is not None:
            self._on_result()

    def close(self) -> None:
        """Let all who wait go; what is there can still be fetched."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _keep(self, kind: FusionType, k: int, result: Result) -> None:
        self._waiting[kind].insert(k, result)
        self._bytes[kind] += size_of(result.record)
        self._changed.notify_all()

    def _take(self, kind: FusionType) -> Result:
        result = self._waiting[kind].popleft()
        self._bytes[kind] -= size_of(result.record)
        return result


@dataclass(slots=True)
class _TaskQueue:
    """Tasks in the order in which they came; of each sensor's records only so many wait."""

    _tasks: deque[Task] = field(default_factory=deque)
    _waiting: Counter[Stream] = field(default_factory=Counter)
    _changed: threading.Condition = field(default_factory=threading.Condition)
    closed: bool = False
    busy: bool = False
    moves: int = 0
    _woken: bool = False

    def __len__(self) -> int:
        return len(self._tasks)

    @property
    def idle(self) -> bool:
        """Whether nothing is being done or to be done."""
        return not self._tasks and not self.busy

    def put(self, task: Task, *, most: int) -> list[Accepted]:
        """Append a task; gives the older records of the same stream that were dropped to make room."""
        dropped: list[Accepted] = []
        with self._changed:
            if isinstance(task, Accepted):
                while self._waiting[task.stream] >= most:
                    dropped.append(self._drop_oldest(task.stream))
                self._waiting[task.stream] += 1
            self.moves += isinstance(task, Moved)
            self._tasks.append(task)
            self._changed.notify()
        return dropped

    def get(self, timeout_s: float) -> Task | None:
        """Take the oldest task, waiting for one; None where none came, it was woken, or it is closed and empty."""
        with self._changed:
            if not self._tasks:
                self._changed.wait_for(lambda: self._tasks or self.closed or self._woken, timeout_s)
            self._woken = False
            if not self._tasks:
                return None
            self.busy = True  # before the queue is empty: whoever looks at both never finds it idle
            task = self._tasks.popleft()
            if isinstance(task, Accepted):
                self._waiting[task.stream] -= 1
            self.moves -= isinstance(task, Moved)
            return task

    def wake(self) -> None:
        """Let the worker look at the time: something other than a task waits now."""
        with self._changed:
            self._woken = True
            self._changed.notify()

    def close(self) -> None:
        """Let the worker end once it has done what is there."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def _drop_oldest(self, stream: Stream) -> Accepted:
        k, oldest = next(
            (k, task) for k, task in enumerate(self._tasks) if isinstance(task, Accepted) and task.stream == stream
        )
        del self._tasks[k]
        self._waiting[stream] -= 1
        return oldest


_LONGEST_IDLE_S = 3600.0
_MANY_LATER = 1000
"""After a longer list, a sweep or an image so many lists go to the thread, for they may be fused together."""


_Overdue = Callable[[float], float | None]
"""Does by the monotonic clock [s] what is due now, and states when the next is; None for never."""


class _Worker:
    """Does tasks one at a time, and gives the results.

    They are done by a thread of its own, or with `inline` by those that hand them in. Small lists of boxes are always
    fused by who hands them in, if the thread has nothing to do.
    """

    def __init__(
        self,
        counters: Counters,
        announcer: _Announcer,
        give: Callable[[_Found], None],
        *,
        inline: bool,
        overdue: _Overdue,
    ) -> None:
        """Begin; the announcer is notified of each task before it is done, and of what was dropped."""
        self._counters, self._announcer = counters, announcer
        self._give, self._overdue = give, overdue
        self._rig = Rig(counters)
        self._tasks = _TaskQueue()
        self._fusing = threading.Lock()
        self._latest_s = time.monotonic()
        self._idle_s = _LONGEST_IDLE_S
        self._wakes_s = 0.0
        self._later = 0
        self._thread = None if inline else threading.Thread(target=self._work, name="fusion", daemon=True)
        if self._thread is not None:
            self._thread.start()

    @property
    def waiting_moves(self) -> int:
        """How many chunks of the vehicle's trajectory wait."""
        return self._tasks.moves

    def wake(self) -> None:
        """Let the thread look at what is overdue."""
        self._tasks.wake()

    def do(self, task: Task, *, most: int = 0) -> None:
        """Do a task, or let the thread do it; for one caller at a time.

        Args:
            most: how many records of one stream may wait; the oldest ones make room.
        """
        if self._thread is None:
            self._perform(task)
        elif not self._done_at_once(task):
            for accepted in self._tasks.put(task, most=most):
                self._announcer.notify(Dropped(accepted))
                self._counters.settle(accepted.ticket, "dropped.queue-full")

    def close(self) -> None:
        """Do what is there, fuse what waits, and take nothing more; the thread goes on until that is done."""
        self._tasks.close()
        if self._thread is None:
            self._perform(Flushed(final=True))

    def join(self) -> None:
        """Wait until the thread has ended."""
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _done_at_once(self, task: Task) -> bool:
        """Fuse a small list of boxes here, if nothing is before it."""
        if not isinstance(task, Accepted):
            return False
        record, algorithms = task.record, task.setting.properties.algorithms
        # lists of so few boxes are fused in less time than it takes to hand them to another thread and back
        few = isinstance(record, Boxes3d | Boxes2d) and len(record) <= 100
        if not few or algorithms[FusionType.DETECTIONS] not in BUILT_IN[FusionType.DETECTIONS]:
            self._later = _MANY_LATER
            return False
        if self._later > 0:
            self._later -= 1
            return False
        if self._announcer.observed or not self._fusing.acquire(blocking=False):
            return False
        try:
            if not self._tasks.idle:
                return False
            self._perform(task)
            if self._rig.waits and self._wakes_s > self._latest_s + self._idle_s:
                self._tasks.wake()
        finally:
            self._fusing.release()
        return True

    def _work(self) -> None:
        while True:
            task = self._tasks.get(self._patience_s())
            ended = task is None and self._tasks.closed and len(self._tasks) == 0
            if task is not None or ended:
                with self._fusing:
                    self._perform(task or Flushed(final=True))
                    self._tasks.busy = False
            if ended:
                return

    def _patience_s(self) -> float:
        """Do what is overdue, and give for how long nothing will be [s]."""
        again_s = self._overdue(time.monotonic())
        with self._fusing:
            now_s = time.monotonic()
            if self._rig.waits and self._tasks.idle:
                flush_s = self._latest_s + self._idle_s
                if now_s >= flush_s:
                    self._perform(Flushed())
                elif again_s is None or flush_s < again_s:
                    again_s = flush_s
            self._wakes_s = now_s + _LONGEST_IDLE_S if again_s is None else again_s
            return max(self._wakes_s - now_s, 0.0)

    def _perform(self, task: Task) -> None:
        self._announcer.notify(task)
        try:
            if isinstance(task, Accepted):
                self._idle_s = task.setting.idle_s
                results = self._rig.feed(task)
            elif isinstance(task, Moved):
                self._rig.move(task.path, origin=task.sent.positions[-1])
                results = iter(())
            else:
                results = self._rig.end() if task.final else self._rig.flush()
            for result in results:
                self._give(result)
        except Exception as error:  # noqa: BLE001 - one record must not end the session
            self._counters.add(f"errors.{type(error).__name__}")
        finally:
            if isinstance(task, Flushed):
                task.done.set()
        self._latest_s = time.monotonic()


_MOST_BOXES = 100_000  # boxes of one frame: a sender that never begins another is stopped
_REMEMBERED = 256  # numbers of each stream that are kept to report one that comes again
_LEAST_LEVEL = 1e-3  # a direction whose part along the ground is a smaller share of it than this is vertical
_RESTART_NS = 2_000_000_000  # a sensor that was silent for so long may have been started again, and count from 0

_KINDS: dict[type, SensorKind] = {
    ImageData: SensorKind.CAMERA,
    Boxes2d: SensorKind.CAMERA,
    PointCloudData: SensorKind.LIDAR,
    Boxes3d: SensorKind.LIDAR,
}  # who sends a record; raw data can be of either


class _RefusedError(SceneloomError):
    """A record is not taken; carries the answer."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.reason)
        self.outcome = outcome


def _refuse(cause: Cause, reason: object) -> NoReturn:
    raise _RefusedError(refused(cause, reason))


@dataclass(slots=True)
class _Arrivals:
    """What came in one stream: the times of the last numbers, and the newest time [ns]."""

    times_ns: dict[int, int] = field(default_factory=dict)
    newest_ns: int = -1

    def note(self, seq: int, time_ns: int) -> None:
        self.times_ns[seq] = time_ns
        if len(self.times_ns) > _REMEMBERED:
            del self.times_ns[next(iter(self.times_ns))]
        self.newest_ns = max(self.newest_ns, time_ns)

    def is_set_back(self, time_ns: int) -> bool:
        """Whether a record is so old that its sensor's clock must have been set back."""
        return time_ns < self.newest_ns - CLOCK_JUMP_NS


@dataclass(slots=True)
class _Frame:
    """The boxes of one sensor that came one by one, of the frame that is not whole yet."""

    sensor_id: int
    setting: Setting
    boxes: list[Box3d | Box2d] = field(default_factory=list)
    latest_s: float = 0.0  # when the last one came, on the monotonic clock


class _ReceivedRecords:
    """Checks records; remembers numbers and times of each stream, and boxes until frames are whole (clause 5.6)."""

    # a frame is whole as soon as a box of another one comes, or none came for a while; not for several threads at once

    def __init__(self, hand_in: Callable[[Boxes3d | Boxes2d, Setting], None]) -> None:
        """Know nothing; `hand_in` takes whole frames of boxes, with the configuration when their first box came."""
        self._hand_in = hand_in
        self._arrivals: dict[Stream, _Arrivals] = {}
        self._frames: dict[tuple[type, int], _Frame] = {}

    def accept(self, record: FrameRecord, setting: Setting) -> Accepted:
        """Take a record, unless it came already or is too old."""
        accepted = _accepted_alone(record, setting)
        arrivals = self._arrivals.get(accepted.stream)
        if arrivals is None or arrivals.is_set_back(accepted.timestamp_ns):
            return accepted
        sensor = f"{accepted.kind} {accepted.sensor_id}"
        late_ns = arrivals.newest_ns - accepted.timestamp_ns
        if record.seq in arrivals.times_ns and -late_ns <= _RESTART_NS:
            _refuse(Cause.DUPLICATE, f"seq {record.seq} of {sensor} came already")
        if late_ns > setting.lateness_ns:
            _refuse(
                Cause.TIME_BACKWARDS,
                f"{late_ns / 1e6:.3f} ms older than the newest of {sensor}; expected at most "
                f"{setting.lateness_ns / 1e6:g} ms (pairing_timeout_ms, or one period of the sensors' frequencies)",
            )
        return accepted

    def note(self, accepted: Accepted) -> str:
        """Remember a record; "set-back" or "set-forward" where its clock was set, or it was silent for long."""
        arrivals, time_ns = self._arrivals.get(accepted.stream), accepted.timestamp_ns
        jump = ""
        if arrivals is not None and arrivals.is_set_back(time_ns):
            self._arrivals.clear()
            arrivals, jump = None, "set-back"
        elif arrivals is not None and time_ns > arrivals.newest_ns + CLOCK_JUMP_NS:
            jump = "set-forward"
        if arrivals is None:
            arrivals = self._arrivals[accepted.stream] = _Arrivals()
        elif time_ns > arrivals.newest_ns + _RESTART_NS:
            arrivals.times_ns.clear()
        arrivals.note(accepted.record.seq, time_ns)
        return jump

    @property
    def waiting_boxes(self) -> int:
        """How many boxes wait for others of their frame."""
        return sum(len(frame.boxes) for frame in self._frames.values())

    def add_box(self, box: Box3d | Box2d, setting: Setting) -> bool:
        """Keep a box, and give whether it begins a frame, which makes the one before whole."""
        if isinstance(box, Box3d):
            _check_headings(np.array([box.direction]), "", setting)
        sensor_id, seq = self._sender_of(box, setting), _SEQ_OF[type(box)](box)
        frame = self._frames.setdefault((type(box), sensor_id), _Frame(sensor_id, setting))
        begins = not frame.boxes or _SEQ_OF[type(box)](frame.boxes[0]) != seq
        if begins:
            stream = kind_of(Boxes3d if isinstance(box, Box3d) else Boxes2d).name, sensor_id
            if stream in self._arrivals and seq in self._arrivals[stream].times_ns:
                reason = f"a box of frame {seq}, of which all have come; expected it before the next frame's"
                _refuse(Cause.DUPLICATE, reason)
            self._close(frame)
            frame.setting = setting
        elif len(frame.boxes) >= _MOST_BOXES:
            _refuse(Cause.TOO_MANY, f"more than {_MOST_BOXES} boxes of frame {seq}")
        frame.boxes.append(box)
        frame.latest_s = time.monotonic()
        return begins

    def close_frames(self, *, older_than_s: float | None = None) -> None:
        """Hand in frames: all of them, or those that nothing came for since a time of the monotonic clock [s]."""
        for frame in self._frames.values():
            if older_than_s is None or frame.latest_s <= older_than_s:
                self._close(frame)

    def oldest_frame_s(self) -> float | None:
        """For any thread: when the last box of the longest waiting frame came, monotonic [s]; None: no boxes wait."""
        return min((frame.latest_s for frame in tuple(self._frames.values()) if frame.boxes), default=None)

    def _close(self, frame: _Frame) -> None:
        boxes, frame.boxes = frame.boxes, []
        if boxes:
            self._hand_in(join_boxes([box.alone(frame.sensor_id) for box in boxes]), frame.setting)

    def _sender_of(self, box: Box3d | Box2d, setting: Setting) -> int:
        """Find the sensor of a box that names none: that of the frame with its number, or the only one there is."""
        # Source: READING of missing ids in docs/db34t-4101.md
        kind = SensorKind.LIDAR if isinstance(box, Box3d) else SensorKind.CAMERA
        streams = ("points", "raw", "boxes_3d") if kind is SensorKind.LIDAR else ("image", "raw", "boxes_2d")
        seq, time_ns = _SEQ_OF[type(box)](box), box.timestamp.nanoseconds
        calibrated = setting.calibrated[kind]
        if len(calibrated) == 1:
            return calibrated[0]
        times_ns = {
            sensor_id: arrivals.times_ns[seq]
            for (name, sensor_id), arrivals in self._arrivals.items()
            if name in streams and seq in arrivals.times_ns and sensor_id in calibrated
        }
        found = [sensor_id for sensor_id in times_ns if times_ns[sensor_id] == time_ns] or list(times_ns)
        if len(found) != 1:
            _refuse(
                Cause.UNKNOWN_SENSOR if calibrated else Cause.NO_CALIBRATION,
                f"a box of frame {seq} that names no sensor: {len(found)} of {len(calibrated)} calibrated {kind}s sent "
                "a frame of that number; expected one, or lists of boxes, which state theirs",
            )
        return found[0]


_SEQ_OF = {Box3d: attrgetter("points_seq"), Box2d: attrgetter("image_seq")}
"""The number of the frame that a box belongs to."""


def _accepted_alone(record: FrameRecord, setting: Setting) -> Accepted:
    """Take a record by what it says itself, whatever came before it.

    Raises:
        RefusedError: it is not taken; the answer says why.
    """
    sensor_id, declared, kind = record.sensor_id, setting.sensors.get(record.sensor_id), _KINDS.get(type(record))
    if kind is None:
        if declared is None or declared.raw is None:
            reason = f"raw data of sensor {sensor_id}; expected one whose kind and raw the property sensors says"
            _refuse(Cause.UNKNOWN_SENSOR, reason)
        kind = declared.kind
    elif setting.sensors and (declared is None or declared.kind is not kind):
        listed = ", ".join(f"{sensor.sensor_id} ({sensor.kind})" for sensor in setting.sensors.values())
        _refuse(Cause.UNKNOWN_SENSOR, f"{kind} {sensor_id}; the property sensors has {listed}")
    if sensor_id not in setting.calibrated[kind]:
        fault = setting.fault_of(kind, sensor_id)
        if fault is not None:
            _refuse(Cause.BAD_CALIBRATION, fault)
        listed = ", ".join(map(str, setting.calibrated[kind])) or "none"
        _refuse(Cause.NO_CALIBRATION, f"no calibration of {kind} {sensor_id}; calibrated are {listed}")
    try:
        if isinstance(record, Boxes3d):
            _check_headings(record.directions.astype(np.float64), "boxes", setting)
        measurement, image = measurement_of(record, setting)
    except _RefusedError:
        raise
    except SceneloomError as error:
        cause = Cause.BAD_CALIBRATION if isinstance(error, CalibrationError) else Cause.BAD_RECORD
        raise _RefusedError(refused(cause, error)) from error
    return Accepted(sensor_id, kind, record, measurement, setting, image)


def _check_headings(directions: Float64Array, group: str, setting: Setting) -> None:
    """Refuse directions (N, 3), lidar frame, straight up or down: how those boxes lie would not be known."""
    # Source: READING of direction in docs/db34t-4101.md
    lifts = directions @ setting.standard_from_lidar[2]
    if not lifts.any():
        return
    squares = (directions * directions).sum(axis=1)
    upright = squares - lifts * lifts <= _LEAST_LEVEL**2 * squares
    if upright.any():
        k = int(np.argmax(upright))
        location = f"{group}[{k}].direction" if group else "direction"
        direction = tuple(directions[k].tolist())
        problem = f"{direction} is vertical; expected where the box heads along the ground"
        _refuse(Cause.BAD_RECORD, BOX_3D.fault(location, problem))


_KEPT_NS = 60_000_000_000  # so much of the trajectory is kept
_MOST_POSES = 100_000  # of one minute: a sender that reports more than 1600 poses a second is stopped


_MOST_MOVES = 100  # chunks of the vehicle's trajectory that may wait for the thread that fuses
_PIXEL_BYTES = 7  # what a pixel takes while its image is fused: red, green, blue, and a depth of 32 bits
_QUEUE_PROPERTIES = ("queue_length", "result_queue_length")  # those that `most_length` bounds


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
        most_length: int = 2**32 - 1,
        most_bytes: int = 2**63,
    ) -> None:
        """Make a system with the predefined properties and no calibration.

        Args:
            inline: whether the threads that send also fuse.
            observer: called with all that is accepted, refused and given, one call at a time.
            on_result: called as soon as a result can be fetched.
            most_length: what the properties queue_length and result_queue_length can be set to.
            most_bytes: of records that are not fused yet; and of results of each type that wait to be fetched.
        """
        self.properties = PropertyStore(check_algorithm=lambda kind, name: algorithm(FusionType(kind), name))
        self.counters = Counters()
        self._lock = threading.RLock()
        self._table: CalibrationTable = {}
        self._setting: Setting | None = None
        self._trajectory: Poses | None = None
        self._most_length, self._most_bytes = most_length, most_bytes
        self._making_room: Flushed | None = None
        self._remarked: set[tuple[tuple[int, int], str]] = set()
        self._closed, self._inline = False, inline
        self._announcer = _Announcer(observer, self.counters)
        self._received = _ReceivedRecords(self._hand_in)
        self._results_queue = _ResultsQueue(self.counters, self._announcer, on_result=on_result, most_bytes=most_bytes)
        self._worker = _Worker(
            self.counters, self._announcer, self._results_queue.give, inline=inline, overdue=self._close_overdue
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
        if name in _QUEUE_PROPERTIES and isinstance(value, int) and value > self._most_length:
            return refused(Cause.OUT_OF_RANGE, f"{name}: {value}; expected at most {self._most_length} here")
        with self._lock:
            outcome = self.properties.set(name, value)
            if outcome and name == "calibration":
                self._table = self.properties.snapshot().calibrations
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
            entry = CalibrationEntry(camera_id, lidar_id, data)
        except CalibrationError as error:
            return refused(Cause.BAD_CALIBRATION, error)
        width, height = data.image_size
        if too_many := self._too_many_pixels(width * height):
            return refused(Cause.TOO_MANY, too_many)
        with self._lock:
            table = calibration_table([entry], self._table)
            if len(table) > MOST_PAIRS:
                return refused(Cause.TOO_MANY, f"{len(table)} calibrations; expected at most {MOST_PAIRS}")
            outcome = self.properties.set("calibration", format_calibrations(table.values()))
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
                recent = self._extended(path)
            except SceneloomError as error:
                return refused(Cause.BAD_MOTION, error)
            self.counters.add("received.motion", len(path.timestamps_ns))
            self._worker.do(Moved(recent, path))
        return DONE

    def _extended(self, path: Poses) -> Poses:
        """Add newer poses, and give the trajectory of the last minute, whose positions count from the newest one."""
        # poses that are very much older begin another trajectory: a clock was set back
        if path.static or len(path.timestamps_ns) == 0:
            raise PoseError("no poses with times; expected one or more")
        before = self._trajectory
        if before is not None and path.start_ns < before.stop_ns - CLOCK_JUMP_NS:
            before = None
        if before is not None and path.start_ns <= before.stop_ns:
            raise PoseError(f"a pose at {path.start_ns} ns after one at {before.stop_ns} ns; expected newer ones")
        parts = [path] if before is None else [before, path]
        times = np.concatenate([part.timestamps_ns for part in parts])
        kept = slice(int(np.searchsorted(times, times[-1] - _KEPT_NS)), None)
        if len(times[kept]) > _MOST_POSES:
            raise PoseError(f"{len(times[kept])} poses in a minute; expected at most {_MOST_POSES}")
        self._trajectory = Poses(
            times[kept],
            np.concatenate([part.positions for part in parts])[kept],
            np.concatenate([part.quaternions_xyzw for part in parts])[kept],
        )
        return self._trajectory.moved(self._trajectory.positions[-1])

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
            except _RefusedError as error:
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
        if chosen not in _FUSION_TYPES.values():
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
            self._received.close_frames()
            flushed = Flushed()
            self._worker.do(flushed)
        flushed.done.wait()

    def repeat(self, record: FrameRecord, setting: Setting) -> None:
        """Fuse a record that another session accepted, as it was configured, whatever came here before.

        Raises:
            OptionError: the interface has a thread of its own, which could drop it.
        """
        if not self._inline:
            raise OptionError("a session with a thread of its own; expected one that was made with `inline`")
        with self._lock:
            accepted = _accepted_alone(record, setting)
            self.counters.issue(accepted.ticket)
            self._worker.do(accepted)

    def close(self) -> None:
        """End: fuse what waits, let all who wait for results go."""
        with self._lock:
            if self._closed:
                return
            self._received.close_frames()
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
        return self.counters.waiting()

    @property
    def waiting_boxes(self) -> int:
        """How many boxes that came alone wait for others of their frame."""
        with self._lock:
            return self._received.waiting_boxes

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
                raise _RefusedError(refused(Cause.BAD_CALIBRATION, error)) from error
        if too_many := self._too_many_pixels(found.pixels):
            _refuse(Cause.TOO_MANY, too_many)
        return found

    def _too_many_pixels(self, count: int) -> str:
        """Why cameras with so many pixels together are refused: a sweep is fused with an image of each at once."""
        most = self._most_bytes // _PIXEL_BYTES
        return "" if count <= most else f"the cameras have {count} pixels together; expected at most {most} here"

    def _admit(self, record: FrameRecord, setting: Setting, verb: str) -> Outcome:
        """Take a record of a whole frame, and count it as one that was received or gathered."""
        accepted = self._received.accept(record, setting)
        most, policy = setting.properties["queue_length"], setting.properties["queue_policy"]
        if policy == "refuse" and self.counters.waiting(accepted.stream) >= most:
            reason = f"{most} records of {accepted.kind} {accepted.sensor_id} wait already (queue_length)"
            _refuse(Cause.QUEUE_FULL, reason)
        size, waiting, limit = accepted.ticket.size, self.counters.waiting_bytes, self._most_bytes
        if waiting + size > limit:
            # let go of what waits for partners, so that there will be room
            if self._making_room is None or self._making_room.done.is_set():
                self._making_room = Flushed(final=True)
                self._worker.do(self._making_room)
            _refuse(Cause.TOO_MANY, f"{waiting} bytes wait and {size} come; expected at most {limit}")
        jump = self._received.note(accepted)
        if jump:
            self.counters.add(f"clock.{jump}")
        self.counters.add(f"{verb}.{accepted.stream[0]}")
        frame = accepted.measurement
        if isinstance(frame, LidarFrame):  # points with a number that is not finite are not fused
            sent = record.length // XYZIRT.itemsize if isinstance(record, RawData) else 0
            sent = record.number if isinstance(record, PointCloudData) else sent
            self.counters.add("left-out.points", sent - len(frame.points))
        self.counters.issue(accepted.ticket)
        self._worker.do(accepted, most=most)
        return self._notes(accepted)

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
        begins = self._received.add_box(box, setting)
        self.counters.add(f"received.{kind_of(box).name}")
        if begins:
            self._worker.wake()
        return DONE

    def _hand_in(self, whole: Boxes3d | Boxes2d, setting: Setting) -> None:
        """Take the boxes that came alone for a whole frame; those who sent them were answered already."""
        try:
            self._admit(whole, setting, "gathered")
        except _RefusedError as error:
            self.counters.add(f"gathered-refused.{error.outcome.cause}")
            self._announcer.notify(Refused(whole, error.outcome))

    def _close_overdue(self, now_s: float) -> float | None:
        """Take frames for whole that no box came for since a while, and state when the next one may be."""
        setting, oldest_s = self._setting, self._received.oldest_frame_s()
        if setting is None or oldest_s is None:
            return None
        if oldest_s + setting.timeout_s <= now_s:
            with self._lock:
                self._received.close_frames(older_than_s=now_s - setting.timeout_s)
            oldest_s = self._received.oldest_frame_s()
        return None if oldest_s is None else oldest_s + setting.timeout_s


def format_calibrations(entries: Iterable[CalibrationEntry]) -> str:
    """Write the property's text, which `parse_calibrations` reads back."""
    items = [{"camera_id": e.camera_id, "lidar_id": e.lidar_id, **asdict(e.data)} for e in entries]
    return msgspec.json.encode(items).decode()
