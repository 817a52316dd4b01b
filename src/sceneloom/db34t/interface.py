"""The data fusion interface of DB34/T 4101-2022, clause 5, in one process.

Properties, calibration and the ego trajectory are set, records are sent, results are fetched. What is sent is checked
against the configuration in force; boxes that come one by one are gathered to frames.
"""

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from types import MappingProxyType, TracebackType
from typing import Any, NoReturn, Self

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.db34t.calibration import (
    MOST_PAIRS,
    CalibrationEntry,
    CalibrationTable,
    SensorKind,
    calibration_table,
    parse_calibrations,
)
from sceneloom.db34t.events import (
    CLOCK_JUMP_NS,
    Accepted,
    Announcer,
    Counters,
    Flushed,
    FrameRecord,
    Moved,
    Observer,
    Refused,
    Result,
    Stream,
    Task,
)
from sceneloom.db34t.properties import MOST_PROPERTIES, PREDEFINED, Property, Snapshot
from sceneloom.db34t.records import (
    Box2d,
    Box3d,
    Boxes2d,
    Boxes3d,
    CalibrationData,
    ImageData,
    PointCloudData,
    RawData,
    SentRecord,
    join_boxes,
    kind_of,
)
from sceneloom.db34t.scene_objects import measurement_of
from sceneloom.db34t.setting import Setting
from sceneloom.db34t.tables import BOX_3D
from sceneloom.db34t.types import DONE, BasicType, Cause, Outcome, ValueForm, ValueType, refused, shown
from sceneloom.db34t.worker import ResultsQueue, Worker
from sceneloom.errors import CalibrationError, DataError, OptionError, PoseError, SceneloomError
from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.fusion.algorithms import FusionType, algorithm
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.poses import Poses

_LONGEST_NAME = 256
_LONGEST_DESCRIPTION = 65_536

_LARGEST_VALUES = 1 << 25
"""How large the values of all properties may be together: their characters, and 8 for each number."""


@dataclass(slots=True)
class PropertyStore:
    """Holds the properties; each call is whole before the next one is, whoever calls.

    Attributes:
        check_algorithm: called with a fusion type and a name before it is set; raises OptionError if there is no
            such algorithm.

    Source: DB34/T 4101-2022, clauses 5.2 to 5.5.
    """

    check_algorithm: Callable[[int, str], object] | None = None
    _properties: dict[str, Property] = field(
        default_factory=lambda: {
            row.name: Property(
                row.name, row.description, ValueType.parse(row.type), row.default, row.unit, predefined=True
            )
            for row in PREDEFINED.values()
        }
    )
    _algorithms: list[str] = field(default_factory=lambda: [PREDEFINED["fusion_algorithm"].default] * 2)
    _revision: int = 0
    _size: int = 0
    _snapshot: Snapshot | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, description: str, type: str) -> Outcome:
        """Add a property without a value.

        Args:
            name: up to 256 characters, none of them blank or a control character.
            description: for people; of an `enum` it lists its `name=number` pairs.
            type: of table 1, or a tuple or an array of such.

        Returns:
            0 where the name is taken or not usable, or the type is none.

        Source: DB34/T 4101-2022, clause 5.3.
        """
        try:
            _check_words(name, description)
            kind = ValueType.parse(type)
        except DataError as error:
            return refused(Cause.ILL_TYPED, error)
        added = Property(name, description, kind)
        if BasicType.ENUM in kind.elements and not added.enumeration:
            return refused(Cause.ILL_TYPED, "an enum without values; expected name=number pairs in its description")
        with self._lock:
            if name in self._properties:
                return refused(Cause.KNOWN_NAME, f"property {name!r} is there already")
            if len(self._properties) >= MOST_PROPERTIES:
                return refused(Cause.TOO_MANY, f"there are {MOST_PROPERTIES} properties, as many as there may be")
            self._keep(added)
        return DONE

    def set(self, name: str, value: Any) -> Outcome:
        """Set a property; what is refused leaves it as it was.

        Source: DB34/T 4101-2022, clause 5.4.
        """
        with self._lock:
            known = self._properties.get(name)
            if known is None:
                return refused(Cause.UNKNOWN_NAME, self._unknown(name))
            try:
                checked = _checked(known, value)
            except DataError as error:
                return refused(Cause.ILL_TYPED, error)
            try:
                self._check_further(name, checked)
            except OptionError as error:
                return refused(Cause.UNKNOWN_ALGORITHM, error)
            except (DataError, CalibrationError) as error:
                return refused(Cause.OUT_OF_RANGE, f"{name}: {error}")
            size = self._size - _size_of(known.value) + _size_of(checked)
            if size > _LARGEST_VALUES:
                problem = f"all values have {size} characters and numbers then; expected at most {_LARGEST_VALUES}"
                return refused(Cause.TOO_MANY, f"{name}: {problem}")
            self._size = size
            if name == "fusion_algorithm":
                self._algorithms[self._properties["fusion_type"].value] = checked
            self._keep(replace(known, value=checked))
            # fusion_algorithm states the algorithm of the fusion that fusion_type names
            algorithm = self._properties["fusion_algorithm"]
            current = self._algorithms[self._properties["fusion_type"].value]
            if algorithm.value != current:
                self._properties["fusion_algorithm"] = replace(algorithm, value=current)
        return DONE

    def get(self, name: str) -> Property:
        """Give a property.

        Raises:
            OptionError: there is none of that name.

        Source: DB34/T 4101-2022, clause 5.5.
        """
        with self._lock:
            if name not in self._properties:
                raise OptionError(self._unknown(name))
            return self._properties[name]

    def snapshot(self) -> Snapshot:
        """Give all properties as they are now."""
        with self._lock:
            if self._snapshot is None:
                kept = MappingProxyType(dict(self._properties))
                self._snapshot = Snapshot(self._revision, kept, (self._algorithms[0], self._algorithms[1]))
            return self._snapshot

    def _keep(self, changed: Property) -> None:
        self._properties[changed.name] = changed
        self._revision += 1
        self._snapshot = None

    def _check_further(self, name: str, value: Any) -> None:
        row = PREDEFINED.get(name)
        if row is not None and row.check is not None:
            row.check(value)
        if name == "fusion_algorithm" and self.check_algorithm is not None:
            self.check_algorithm(self._properties["fusion_type"].value, value)

    def _unknown(self, name: str) -> str:
        names = list(self._properties)
        listed = f"{', '.join(names[:40])}{'' if len(names) <= 40 else ', …'}"
        return f"property {shown(name)} is not there; there are {listed}"


def _check_words(name: str, description: str) -> None:
    """Check name and description of a property that is added."""
    usable = isinstance(name, str) and 0 < len(name) <= _LONGEST_NAME and name.isprintable() and " " not in name
    if not usable:
        raise DataError("property", "name", f"{shown(name)}; expected 1 to {_LONGEST_NAME} visible characters")
    if not isinstance(description, str):
        raise DataError(f"property {name}", "description", f"{shown(description)}; expected a text")
    if len(description) > _LONGEST_DESCRIPTION:
        problem = f"{len(description)} characters; expected at most {_LONGEST_DESCRIPTION}"
        raise DataError(f"property {name}", "description", problem)


def _size_of(value: Any) -> int:
    if isinstance(value, tuple):
        return sum(map(_size_of, value))
    return len(value) if isinstance(value, str) else 8


def _checked(known: Property, value: Any) -> Any:
    checked = known.type.check(value, owner=known.name)
    if BasicType.ENUM not in known.type.elements:
        return checked
    if known.type.form is ValueForm.SCALAR:
        return _enumerated(known, checked)
    return tuple(
        _enumerated(known, item) if kind is BasicType.ENUM else item
        for kind, item in zip(known.type.elements_of(len(checked)), checked, strict=True)
    )


def _enumerated(known: Property, value: str | int) -> int:
    pairs = known.enumeration
    if isinstance(value, str) and value in pairs:
        return pairs[value]
    if value in pairs.values():
        return int(value)
    expected = ", ".join(f"{name}={number}" for name, number in pairs.items())
    raise DataError(known.name, "", f"{shown(value)}; expected one of {expected}")


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


class RefusedError(SceneloomError):
    """A record is not taken; carries the answer."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.reason)
        self.outcome = outcome


def _refuse(cause: Cause, reason: object) -> NoReturn:
    raise RefusedError(refused(cause, reason))


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
        accepted = accepted_alone(record, setting)
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


def accepted_alone(record: FrameRecord, setting: Setting) -> Accepted:
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
    except RefusedError:
        raise
    except SceneloomError as error:
        cause = Cause.BAD_CALIBRATION if isinstance(error, CalibrationError) else Cause.BAD_RECORD
        raise RefusedError(refused(cause, error)) from error
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


@dataclass(slots=True)
class RecentTrajectory:
    """Joins poses that arrive in chunks."""

    _path: Poses | None = None

    def extended(self, path: Poses) -> Poses:
        """Add newer poses, and give the trajectory of the last minute.

        Poses that are very much older begin another trajectory: a clock was set back. Positions are relative to the
        newest one, so that points far from a map's origin keep their digits.

        Raises:
            PoseError: they are not newer than those that came before, or too many.
        """
        if path.static or len(path.timestamps_ns) == 0:
            raise PoseError("no poses with times; expected one or more")
        before = self._path
        if before is not None and path.start_ns < before.stop_ns - CLOCK_JUMP_NS:
            before = None
        if before is not None and path.start_ns <= before.stop_ns:
            raise PoseError(f"a pose at {path.start_ns} ns after one at {before.stop_ns} ns; expected newer ones")
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


_MOST_MOVES = 100  # chunks of the vehicle's trajectory that may wait for the thread that fuses
_PIXEL_BYTES = 7  # what a pixel takes while its image is fused: red, green, blue, and a depth of 32 bits


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueLimits:
    """What waits in one system at most, whatever its properties state.

    Attributes:
        most_length: what the properties queue_length and result_queue_length can be set to.
        most_bytes: of records that are not fused yet; and of results of each type that wait to be fetched.
    """

    most_length: int = 2**32 - 1
    most_bytes: int = 2**63

    @property
    def most_pixels(self) -> int:
        """How many pixels all cameras may have together: a sweep is fused with an image of each at once."""
        return self.most_bytes // _PIXEL_BYTES

    def too_many_pixels(self, count: int) -> str:
        """Why cameras with so many pixels are refused."""
        return f"the cameras have {count} pixels together; expected at most {self.most_pixels} here"


_QUEUE_PROPERTIES = ("queue_length", "result_queue_length")  # those that `QueueLimits.most_length` bounds


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
            observer: called with all that is accepted, refused and given, one call at a time.
            on_result: called as soon as a result can be fetched.
            limits: of what waits, whatever the properties state; None for none.
        """
        self.properties = PropertyStore(check_algorithm=lambda kind, name: algorithm(FusionType(kind), name))
        self.counters = Counters()
        self._lock = threading.RLock()
        self._table: CalibrationTable = {}
        self._setting: Setting | None = None
        self._trajectory = RecentTrajectory()
        self._limits = limits or QueueLimits()
        self._making_room: Flushed | None = None
        self._remarked: set[tuple[tuple[int, int], str]] = set()
        self._closed = False
        self._announcer = Announcer(observer, self.counters)
        self._received = _ReceivedRecords(self._hand_in)
        self._results_queue = ResultsQueue(
            self.counters, self._announcer, on_result=on_result, most_bytes=self._limits.most_bytes
        )
        self._worker = Worker(
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
        most = self._limits.most_length
        if name in _QUEUE_PROPERTIES and isinstance(value, int) and value > most:
            return refused(Cause.OUT_OF_RANGE, f"{name}: {value}; expected at most {most} here")
        with self._lock:
            outcome = self.properties.set(name, value)
            if outcome and name == "calibration":
                self._table = calibration_table(parse_calibrations(self.properties.get(name).value))
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
        if width * height > self._limits.most_pixels:
            return refused(Cause.TOO_MANY, self._limits.too_many_pixels(width * height))
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
            self._received.close_frames()
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
                self.counters.issue(task.ticket)
            self._worker.do(task)

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
                raise RefusedError(refused(Cause.BAD_CALIBRATION, error)) from error
        if found.pixels > self._limits.most_pixels:
            _refuse(Cause.TOO_MANY, self._limits.too_many_pixels(found.pixels))
        return found

    def _admit(self, record: FrameRecord, setting: Setting, verb: str) -> Outcome:
        """Take a record of a whole frame, and count it as one that was received or gathered."""
        accepted = self._received.accept(record, setting)
        most, policy = setting.properties["queue_length"], setting.properties["queue_policy"]
        if policy == "refuse" and self.counters.waiting(accepted.stream) >= most:
            reason = f"{most} records of {accepted.kind} {accepted.sensor_id} wait already (queue_length)"
            _refuse(Cause.QUEUE_FULL, reason)
        size, waiting, limit = accepted.ticket.size, self.counters.waiting_bytes, self._limits.most_bytes
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
        except RefusedError as error:
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


_FUSION_TYPES = tuple(FusionType)


def format_calibrations(entries: Iterable[CalibrationEntry]) -> str:
    """Write the property's text, which `parse_calibrations` reads back."""
    items = [{"camera_id": e.camera_id, "lidar_id": e.lidar_id, **asdict(e.data)} for e in entries]
    return msgspec.json.encode(items).decode()
