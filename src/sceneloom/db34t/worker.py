"""The worker of a session: one fusion system per lidar, fed in the order in which records arrived.

Results are numbered and queued.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Protocol, cast

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.blending import NO_CAMERA, colour_points
from sceneloom.colouring.results import FusedFrame, FusedView
from sceneloom.db34t.calibration import SensorKind
from sceneloom.db34t.events import (
    CLOCK_JUMP_NS,
    Accepted,
    Announcer,
    Counters,
    Dropped,
    Flushed,
    Moved,
    Result,
    Stream,
    Task,
)
from sceneloom.db34t.records import (
    Boxes2d,
    Boxes3d,
    FusedDetections,
    ImageData,
    ResultRecord,
    SensorFusionData,
    size_of,
)
from sceneloom.db34t.results import FoundObjects, declared_columns
from sceneloom.db34t.scene_objects import COLOR_NAMES, boxes_2d_of, boxes_3d_of, point_table, result_fields
from sceneloom.db34t.setting import Setting
from sceneloom.db34t.types import Timestamp
from sceneloom.detections.results import NO_BOX, FusedBoxes
from sceneloom.fusion.algorithms import BUILT_IN, FusionType
from sceneloom.fusion.system import STILL, FusedDetectionFrame, FusionSystem, Leave, SeenBoxes
from sceneloom.geometry.rigid import OUT_OF_REACH, RigidTransform, multiply_quaternions, rotate_vectors
from sceneloom.kernels.projection import draw_depths
from sceneloom.scene.cameras import GLOBAL, CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.scene.poses import Poses, PoseSource

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
        pose = PoseSource(self._trajectories[lidar_id], _HERE, _REACH_NS).at(np.array([time_ns], np.int64))
        if pose.coverage[0] == OUT_OF_REACH:  # which only a sweep without points can be, if it was compensated
            return _HERE
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])


_HERE = RigidTransform.identity()
_AT_LIDAR = PoseSource(STILL, _HERE)


_FUSION_TYPES = {SensorFusionData: FusionType.SENSOR_DATA, FusedDetections: FusionType.DETECTIONS}


class ResultsQueue:
    """The results of both fusion types: given by one thread at a time, fetched by several."""

    def __init__(
        self, counters: Counters, announcer: Announcer, *, on_result: Callable[[], None] | None, most_bytes: int
    ) -> None:
        """Hold nothing yet.

        Args:
            announcer: notified of each result.
            on_result: called as soon as a result can be fetched.
            most_bytes: how large the results of one type that wait may be together.
        """
        self._counters = counters
        self._announcer = announcer
        self._on_result = on_result
        self._most_bytes = most_bytes
        self._given = dict.fromkeys(FusionType, 0)
        self._bytes = dict.fromkeys(FusionType, 0)
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


class Overdue(Protocol):
    """What else there is to do by the clock."""

    def __call__(self, now_s: float) -> float | None:
        """Do what is due now, and state when the next is, both by the monotonic clock [s]; None for never."""
        ...


class Worker:
    """Does tasks one at a time, and gives the results.

    They are done by a thread of its own, or with `inline` by those that hand them in. Small lists of boxes are always
    fused by who hands them in, if the thread has nothing to do.
    """

    def __init__(
        self,
        counters: Counters,
        announcer: Announcer,
        give: Callable[[_Found], None],
        *,
        inline: bool,
        overdue: Overdue,
    ) -> None:
        """Begin.

        Args:
            announcer: notified of each task before it is done, and of what was dropped.
            give: takes each result.
            inline: whether there is no thread.
        """
        self._counters = counters
        self._announcer = announcer
        self._give = give
        self._overdue = overdue
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
    def inline(self) -> bool:
        """Whether there is no thread."""
        return self._thread is None

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


def sensor_fusion_record(
    frame: FusedFrame,
    view: FusedView,
    world_from_lidar: RigidTransform,
    setting: Setting,
    *,
    sent: LidarFrame,
    image: ImageData,
    numbers: Mapping[str, Any],
    motion_compensated: bool,
) -> SensorFusionData:
    """The record of a sweep and one of its images.

    The points have x, y, z, then what else was sent of them in its order, then r, g, b, whatever the values are.

    Args:
        world_from_lidar: the lidar at the sweep's reference time; where the ego stood, the identity.
        numbers: camera_id, lidar_id, image_seq and points_seq.

    Source: DB34/T 4101-2022, table 9; READINGS of table 9 in docs/CONVENTIONS.md.
    """
    of_lidar = setting.properties["reference_frame"] == 1
    world_from_frame = world_from_lidar if of_lidar else view.world_from_camera
    kind = SensorKind.LIDAR if of_lidar else SensorKind.CAMERA
    points = replace(
        sent.points,
        positions=_moved(frame.points, world_from_frame, setting.axes[kind].standard_from_declared(kind).T),
        colors=_colors_of(frame, view, setting),
        camera_index=None,
        extras={name: values for name, values in sent.points.extras.items() if name not in COLOR_NAMES},
    )
    fields, depth_kind = result_fields(sent), setting.properties["depth_kind"]
    data = point_table(points, fields, frame.timestamp_ns)
    return SensorFusionData(
        **numbers,
        timestamp=Timestamp.of(frame.timestamp_ns),
        height=view.camera.height,
        width=view.camera.width,
        encoding=image.encoding,
        image_channel=image.channel,
        image_data=image.data,
        image_depth=view.depth_image if depth_kind == "z" else _range_image(frame, view),
        point_num=len(data),
        point_fields=fields,
        fields_number=len(fields),
        point_data=data,
        depth_kind=depth_kind,
        point_frame=kind.value,
        motion_compensated=motion_compensated,
        image_timestamp=Timestamp.of(view.timestamp_ns),
    )


def _range_image(frame: FusedFrame, view: FusedView) -> Float32Array:
    """Distances [m] of the nearest visible points from the camera's centre, (H, W) float32, 0 for none."""
    positions_world = frame.points.positions[view.point_ids].astype(np.float64)
    ranges = np.linalg.norm(positions_world - view.world_from_camera.translation, axis=1)
    image = np.zeros((view.camera.height, view.camera.width), np.float32)
    draw_depths(view.pixel_numbers, ranges.astype(np.float32), view.visible, image)
    return image


def _colors_of(frame: FusedFrame, view: FusedView, setting: Setting) -> UInt8Array:
    """One image's colours of the points: the cloud's, if it alone gave them; grey where it does not show them."""
    # algorithms of other packages may colour a cloud as they like
    own = setting.properties.algorithms[FusionType.SENSOR_DATA] in BUILT_IN[FusionType.SENSOR_DATA]
    colors, shown_by = frame.points.colors, frame.points.camera_index
    if not own or len(frame.views) != 1 or colors is None or shown_by is None:
        colors, shown_by = colour_points(len(frame.points), [view], [0])
    unseen = shown_by == NO_CAMERA
    if unseen.any():
        colors = colors.copy()
        colors[unseen] = 128  # red, green and blue alike: grey
    return colors


def _moved(points: LidarPoints, world_from_frame: RigidTransform, declared_from_standard: Float64Array) -> Float32Array:
    """Give points of the world in a frame of declared axes, (N, 3) float32 [m]."""
    frame_from_world = world_from_frame.inverse()
    rotation = declared_from_standard @ frame_from_world.rotation
    translation = declared_from_standard @ frame_from_world.translation
    if np.array_equal(rotation, np.eye(3)) and not translation.any():
        return points.positions
    return (points.positions @ rotation.T + translation).astype(np.float32)


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
        "box_3d_ids": _numbers(fused.rows_3d, boxes_3d),
        "box_2d_ids": _numbers(fused.rows_2d, boxes_2d),
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


def _numbers(rows: Int64Array, boxes: Boxes3d | Boxes2d) -> tuple[int | None, ...]:
    ids = boxes.id.tolist()
    return tuple(None if row == NO_BOX else ids[row] for row in rows.tolist())
