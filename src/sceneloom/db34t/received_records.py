"""Records that a session receives (clause 5.6): checked against the configuration in force.

Single boxes collected into frames, every record counted until it is fused or dropped.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.boxes import COLUMNS_2D, COLUMNS_3D, Box2d, Box3d, Boxes2d, Boxes3d, Column
from sceneloom.db34t.calibration import (
    CAMERA_MODELS,
    CalibratedPair,
    CalibrationTable,
    DeclaredFrames,
    SensorKind,
    axes_of,
    parse_camera_models,
    resolve_pair,
)
from sceneloom.db34t.properties import DeclaredSensor, Snapshot, parse_sensors
from sceneloom.db34t.records import ImageData, PointCloudData, RawData, kind_of, size_of
from sceneloom.db34t.scene_objects import (
    image_of,
    lidar_frame_of,
    lidar_frame_of_raw,
    pixels_of_raw,
    result_fields,
)
from sceneloom.db34t.tables import BOX_3D, POINT_CLOUD
from sceneloom.db34t.types import Cause, Outcome, refused
from sceneloom.errors import CalibrationError, SceneloomError
from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.fusion.configuration import FusionConfiguration
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame


@dataclass(slots=True)
class Counters:
    """Counts by name, from any thread.

    Names are words joined by dots, the first says what happened: `received.image`, `refused.bad-record`,
    `dropped.queue-full`, `unpaired.camera`, `results.sensor`, …
    """

    _counts: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, count: int = 1) -> None:
        """Count something that happened, if it did."""
        if count == 0:
            return
        with self._lock:
            self._counts[name] += count

    def counts(self) -> dict[str, int]:
        """All that was counted, by name in the order of the alphabet."""
        with self._lock:
            return dict(sorted(self._counts.items()))


Stream = tuple[str, int]
"""The kind of record and the sensor that sends it."""


@dataclass(slots=True, eq=False)
class Ticket:
    """One record on its way through the system.

    Attributes:
        stream: of the record.
        holders: how many locations keep it: an image goes to each lidar that its camera is calibrated with.
        fused: whether it took part in a result.
        support: what happened to it where it did not, as `dropped.queue-full`; "" for nothing but time.
        size: of its arrays [byte].
    """

    stream: Stream
    holders: int = 1
    fused: bool = False
    support: str = ""
    size: int = 0


@dataclass(slots=True)
class Ledger:
    """Counts every record once when nobody keeps it any more, from any thread.

    It was `fused` if it took part in a result, else `dropped`, or its part in the fusion `failed`, or it is `unpaired`:
    nothing came that it belongs to. So for each kind of record

        received + gathered = fused + unpaired + dropped + failed + waiting

    Attributes:
        counters: where.
        waiting_bytes: of the records that have come and are not done with.
    """

    counters: Counters
    waiting_bytes: int = 0
    _waiting: Counter[Stream] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def issue(self, ticket: Ticket) -> None:
        """Note a record that comes in."""
        with self._lock:
            self._waiting[ticket.stream] += 1
            self.waiting_bytes += ticket.size

    def share(self, ticket: Ticket, holders: int) -> None:
        """Note that so many locations keep a record; none of them: it is done."""
        with self._lock:
            ticket.holders = holders + 1
        self.settle(ticket)

    def settle(self, ticket: Ticket, support: str = "") -> None:
        """Note that one location does not keep a record any more, and why if not because it was used or is too old."""
        with self._lock:
            ticket.holders -= 1
            ticket.support = ticket.support or support
            if ticket.holders != 0:
                return
            self._waiting[ticket.stream] -= 1
            self.waiting_bytes -= ticket.size
            if not self._waiting[ticket.stream]:
                del self._waiting[ticket.stream]
        outcome = "fused" if ticket.fused else ticket.support or "unpaired"
        self.counters.add(f"{outcome}.{ticket.stream[0]}")

    def waiting(self, stream: Stream | None = None) -> int:
        """How many records of a stream, or of all, have come and are not done with."""
        with self._lock:
            return self._waiting.total() if stream is None else self._waiting[stream]


_MILLISECOND = 1_000_000

_SECOND = 1_000_000_000

_SHORTEST_WAIT_S = 0.01


@dataclass(frozen=True, eq=False)
class Setting:
    """What a record is received and fused by.

    Attributes:
        properties: as they were.
        table: the calibrations as they were.
        frames: the declared axes.
        camera_models: camera models that table 3 cannot state, by camera_id.
        sensors: what the property `sensors` declares, by sensor_id.
        pairs: camera model and mounting of each camera and lidar that are calibrated, by (camera_id, lidar_id).
        faults: why a calibration cannot be used with the declared axes, by the same.
    """

    properties: Snapshot
    table: CalibrationTable
    frames: DeclaredFrames
    camera_models: Mapping[int, Camera]
    sensors: Mapping[int, DeclaredSensor]
    pairs: Mapping[tuple[int, int], CalibratedPair]
    faults: Mapping[tuple[int, int], str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, properties: Snapshot, table: CalibrationTable, *, before: "Setting | None" = None
    ) -> "Setting":
        """Read properties and calibrations.

        Args:
            before: the setting until now: what did not change since is taken from there.

        Raises:
            DataError: the added property `camera_models` cannot be read.
            CalibrationError: a camera model in it cannot be.
        """
        if (
            before is not None
            and before.table is table
            and _geometry(before.properties) == _geometry(properties)
        ):
            parts = before.frames, before.camera_models, before.sensors, before.pairs, before.faults
            return cls(properties, table, *parts)
        frames, camera_models = _declared_frames(properties), _camera_models_of(properties)
        pairs: dict[tuple[int, int], CalibratedPair] = {}
        faults: dict[tuple[int, int], str] = {}
        for pair in table.entries:
            try:
                pairs[pair] = resolve_pair(table, *pair, frames, camera_models)
            except CalibrationError as error:
                faults[pair] = str(error)
        return cls(
            properties, table, frames, camera_models, parse_sensors(properties["sensors"]), pairs, faults
        )

    @cached_property
    def sweep_period_ns(self) -> int:
        """By `lidar_frequency` [ns]."""
        return int(_SECOND // self.properties["lidar_frequency"])

    @cached_property
    def image_period_ns(self) -> int:
        """By `camera_frequency` [ns]."""
        return int(_SECOND // self.properties["camera_frequency"])

    @cached_property
    def tolerance_ns(self) -> int:
        """How far an image may be from a sweep [ns], by `pairing_tolerance_ms`.

        Where the property is 0: as far as both lie apart at the worst where both sensors keep their frequencies, half
        of each period.
        """
        stated_ns = round(self.properties["pairing_tolerance_ms"] * _MILLISECOND)
        return stated_ns or (self.sweep_period_ns + self.image_period_ns) // 2

    @cached_property
    def timeout_ns(self) -> int:
        """By `pairing_timeout_ms` [ns]."""
        return int(self.properties["pairing_timeout_ms"]) * _MILLISECOND

    @cached_property
    def lateness_ns(self) -> int:
        """How much older than the newest of its sensor a record may be [ns]: the timeout, or a period of the sensor."""
        return max(self.timeout_ns, self.sweep_period_ns, self.image_period_ns)

    @cached_property
    def timeout_s(self) -> float:
        """By `pairing_timeout_ms` [s], but no shorter than what a thread can wait for others."""
        return max(self.timeout_ns / _SECOND, _SHORTEST_WAIT_S)

    @cached_property
    def idle_s(self) -> float:
        """After how much time without any record nothing is waited for any more [s]."""
        return max((self.timeout_ns + self.tolerance_ns) / _SECOND, _SHORTEST_WAIT_S)

    @cached_property
    def configuration(self) -> FusionConfiguration:
        """What the fusion system itself goes by."""
        sensor_data, detections = self.properties.algorithms
        return FusionConfiguration(
            fusion_algorithm=sensor_data,
            detection_algorithm=detections,
            detectors=self.properties["detectors"],
            pairing_tolerance_ns=self.tolerance_ns,
            lateness_ns=self.timeout_ns,
            most_waiting=self.properties["queue_length"],
            stand_beyond_trajectory=True,
            motion_compensation=self.properties["motion_compensation"] == 1,
            image_period_ns=self.image_period_ns,
            disorder_ns=self.lateness_ns,
        )

    @cached_property
    def pixels(self) -> int:
        """Of the images of all calibrated cameras together."""
        sizes = {camera_id: pair.camera for (camera_id, _), pair in self.pairs.items()}
        return sum(camera.width * camera.height for camera in sizes.values())

    @cached_property
    def standard_from_lidar(self) -> Float64Array:
        """Takes coordinates of the declared lidar frame into x forward, y left, z up, (3, 3) float64."""
        return self.frames.lidar.standard_from_declared(SensorKind.LIDAR)

    @cached_property
    def declared_from_standard(self) -> Float64Array:
        """The other way round, (3, 3) float64."""
        return read_only(self.standard_from_lidar.T)

    @cached_property
    def calibrated(self) -> Mapping[SensorKind, tuple[int, ...]]:
        """The numbers of the sensors that a usable calibration is known of, by kind."""
        cameras, lidars = ({pair[location] for pair in self.pairs} for location in (0, 1))
        return {SensorKind.CAMERA: tuple(sorted(cameras)), SensorKind.LIDAR: tuple(sorted(lidars))}

    def pairs_of(self, kind: SensorKind, sensor_id: int) -> tuple[tuple[int, int], ...]:
        """The pairs with a usable calibration that a sensor is in."""
        location = 1 if kind is SensorKind.LIDAR else 0
        return tuple(pair for pair in self.pairs if pair[location] == sensor_id)

    def fault_of(self, kind: SensorKind, sensor_id: int) -> str | None:
        """Why a calibration of a sensor cannot be used; None where there is no such."""
        location = 1 if kind is SensorKind.LIDAR else 0
        return next((fault for pair, fault in self.faults.items() if pair[location] == sensor_id), None)

    def camera(self, camera_id: int) -> Camera:
        """The camera model of a camera that is calibrated; a camera has one size with all lidars.

        Raises:
            CalibrationError: its calibrations are of images of several sizes.
        """
        camera_models = [pair.camera for (camera, _), pair in self.pairs.items() if camera == camera_id]
        sizes = {(camera_model.width, camera_model.height) for camera_model in camera_models}
        if len(sizes) > 1:
            raise CalibrationError(f"image_size of camera {camera_id}: {sorted(sizes)}; expected one size")
        return camera_models[0]


_GEOMETRY = (
    *("chirality", "camera_coordinate", "lidar_coordinate", "camera_axes", "lidar_axes", "sensors"),
    CAMERA_MODELS,
)
"""The properties that pairs and sensors depend on."""


def _geometry(properties: Snapshot) -> tuple[object, ...]:
    known = properties.properties
    return tuple(known[name].value if name in known else None for name in _GEOMETRY)


def _declared_frames(properties: Snapshot) -> DeclaredFrames:
    """Read the axes that the properties declare."""
    left_handed = properties["chirality"] == 1
    camera = axes_of(properties["camera_axes"], properties["camera_coordinate"], left_handed=left_handed)
    lidar = axes_of(properties["lidar_axes"], properties["lidar_coordinate"], left_handed=left_handed)
    return DeclaredFrames(camera, lidar)


def _camera_models_of(properties: Snapshot) -> Mapping[int, Camera]:
    """Read the added property `camera_models`; none where it is not there or not set.

    Raises:
        DataError: its text cannot be read.
        CalibrationError: a camera model cannot be.
    """
    found = properties.properties.get(CAMERA_MODELS)
    return parse_camera_models(found.value) if found is not None and isinstance(found.value, str) else {}


WholeRecord = RawData | ImageData | PointCloudData | Boxes3d | Boxes2d
"""What is sent of one frame."""

Received = LidarFrame | CameraImage | Boxes3d | Boxes2d
"""What is fused."""

CLOCK_JUMP_NS = 10_000_000_000
"""A record that is so much older than the newest one was not late: its sensor's clock was set back."""


@dataclass(frozen=True, slots=True, eq=False)
class Accepted:
    """A record that was taken.

    Attributes:
        sensor_id: who sent it.
        kind: camera or lidar.
        record: as it was sent.
        received: what is fused.
        setting: the configuration in force when it came.
        ticket: what becomes of it.
        timestamp_ns: of the record [ns].
    """

    sensor_id: int
    kind: SensorKind
    record: WholeRecord
    received: Received
    setting: Setting
    ticket: Ticket = field(init=False)
    timestamp_ns: int = field(init=False)

    def __post_init__(self) -> None:
        stream = kind_of(self.record).name, self.sensor_id
        object.__setattr__(self, "ticket", Ticket(stream, size=size_of(self.record)))
        object.__setattr__(self, "timestamp_ns", self.record.timestamp.nanoseconds)

    @property
    def left_out(self) -> int:
        """How many points of a cloud are not fused, because a number of theirs is not finite."""
        if not isinstance(self.received, LidarFrame):
            return 0
        record = self.record
        sent = record.length // XYZIRT.itemsize if isinstance(record, RawData) else 0
        return (record.number if isinstance(record, PointCloudData) else sent) - len(self.received.points)

    @property
    def stream(self) -> Stream:
        """Which queue it waits in: the kind of record and the sensor."""
        return self.ticket.stream


_MOST_BOXES = 100_000
"""Boxes of one frame: a sender that never begins another is stopped."""

_COLUMNS: dict[type, tuple[Column, ...]] = {Boxes3d: COLUMNS_3D, Boxes2d: COLUMNS_2D}


def _seq_of(box: Box3d | Box2d) -> int:
    """The number of the frame that a box belongs to."""
    return box.points_seq if isinstance(box, Box3d) else box.image_seq


@dataclass(slots=True)
class _BareBoxes:
    """The boxes of one sensor that came one by one.

    A frame is whole as soon as a box of another frame comes, or none came for a while.

    Attributes:
        sensor_id: the sensor.
        setting: the configuration in force when the first box of the frame came.
        boxes: those of the frame that is not whole yet.
        latest_s: when the last one came, on the clock that the caller keeps [s].
    """

    sensor_id: int
    setting: Setting
    boxes: list[Box3d | Box2d] = field(default_factory=list)
    latest_s: float = 0.0

    def begins(self, box: Box3d | Box2d) -> bool:
        """Whether a box is the first of another frame than those before."""
        return not self.boxes or _seq_of(self.boxes[0]) != _seq_of(box)

    def add(self, box: Box3d | Box2d, now_s: float) -> None:
        """Keep a box of the frame that is not whole yet."""
        self.boxes.append(box)
        self.latest_s = now_s

    def close(self) -> Boxes3d | Boxes2d | None:
        """Give what was gathered as a whole frame; None where there is nothing."""
        if not self.boxes:
            return None
        lists = [box.alone(self.sensor_id) for box in self.boxes]
        self.boxes = []
        return joined(lists)


def joined(lists: list[Boxes3d | Boxes2d]) -> Boxes3d | Boxes2d:
    """Put lists of one frame together; the first says the time."""
    first = lists[0]
    columns: dict[str, Any] = {}
    for column in _COLUMNS[type(first)]:
        parts = [getattr(boxes, column.attribute) for boxes in lists]
        if column.optional and any(part is None for part in parts):
            columns[column.attribute] = None
        else:
            columns[column.attribute] = np.concatenate(parts)
    names = tuple(name for boxes in lists for name in boxes.class_names)
    return replace(first, class_names=names, **columns)


_REMEMBERED = 256
"""Numbers of each stream that are kept to report one that comes again."""

_MOST_FIELDS = 255
"""Of a point of table 9, whose fields_number is a uint8."""

_LEAST_LEVEL = 1e-3
"""A direction whose part along the ground is a smaller share of it than this is vertical."""

_RESTART_NS = 2_000_000_000
"""A sensor that was silent for so long may have been started again, and count from 0."""


class RefusedError(SceneloomError):
    """A record is not taken; carries the answer."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.reason)
        self.outcome = outcome


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


@dataclass(slots=True)
class ReceivedRecords:
    """Checks records; remembers numbers and times of each stream. Not for several threads at once.

    Source: DB34/T 4101-2022, clause 5.6.
    """

    _arrivals: dict[Stream, _Arrivals] = field(default_factory=dict)

    def admit(self, record: WholeRecord, setting: Setting) -> Accepted:
        """Take a record.

        Raises:
            RefusedError: it is not taken; the answer says why.
        """
        accepted = accepted_alone(record, setting)
        self._check_order(accepted)
        return accepted

    def note(self, accepted: Accepted) -> str:
        """Remember a record that was taken.

        Returns:
            "set-back" or "set-forward" where its sensor's clock must have been, or it was silent for long; else "".
        """
        arrivals, time_ns = self._arrivals.get(accepted.stream), accepted.timestamp_ns
        jump = ""
        if arrivals is not None and _is_set_back(arrivals, time_ns):
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

    def sender_of(self, box: Box3d | Box2d, setting: Setting) -> int:
        """Report whose a box is that names no sensor: of the frame with its number, else of the only sensor there is.

        Raises:
            RefusedError: there is none, or more than one.

        Source: READING of missing ids in docs/CONVENTIONS.md.
        """
        kind = SensorKind.LIDAR if isinstance(box, Box3d) else SensorKind.CAMERA
        seq, time_ns = _seq_of(box), box.timestamp.nanoseconds
        calibrated = setting.calibrated[kind]
        if len(calibrated) == 1:
            return calibrated[0]
        timestamps = {
            sensor_id: arrivals.times_ns[seq]
            for (name, sensor_id), arrivals in self._arrivals.items()
            if name in _FRAME_STREAMS[kind] and seq in arrivals.times_ns and sensor_id in calibrated
        }
        found = [
            sensor_id for sensor_id, timestamp_ns in timestamps.items() if timestamp_ns == time_ns
        ] or list(timestamps)
        if len(found) != 1:
            _refuse(
                Cause.UNKNOWN_SENSOR if calibrated else Cause.NO_CALIBRATION,
                f"a box of frame {seq} that names no sensor: {len(found)} of {len(calibrated)} calibrated {kind}s sent "
                "a frame of that number; expected one, or lists of boxes, which state theirs",
            )
        return found[0]

    def has_come(self, stream: Stream, seq: int) -> bool:
        """Whether a number of a stream has come lately."""
        arrivals = self._arrivals.get(stream)
        return arrivals is not None and seq in arrivals.times_ns

    def _check_order(self, accepted: Accepted) -> None:
        arrivals = self._arrivals.get(accepted.stream)
        if arrivals is None or _is_set_back(arrivals, accepted.timestamp_ns):
            return
        seq, late_ns = accepted.record.seq, arrivals.newest_ns - accepted.timestamp_ns
        if seq in arrivals.times_ns and -late_ns <= _RESTART_NS:
            _refuse(Cause.DUPLICATE, f"seq {seq} of {accepted.kind} {accepted.sensor_id} came already")
        lateness_ns = accepted.setting.lateness_ns
        if late_ns > lateness_ns:
            _refuse(
                Cause.TIME_BACKWARDS,
                f"{late_ns / 1e6:.3f} ms older than the newest of {accepted.kind} {accepted.sensor_id}; expected at "
                f"most {lateness_ns / 1e6:g} ms (pairing_timeout_ms, or one period of the sensors' frequencies)",
            )


def _is_set_back(arrivals: _Arrivals, time_ns: int) -> bool:
    """Whether a record is so old that its sensor's clock must have been set back."""
    return time_ns < arrivals.newest_ns - CLOCK_JUMP_NS


def accepted_alone(record: WholeRecord, setting: Setting) -> Accepted:
    """Take a record by what it says itself, whatever came before it.

    Raises:
        RefusedError: it is not taken; the answer says why.
    """
    kind = _kind_of_sensor(record, setting)
    sensor_id = record.sensor_id
    if sensor_id not in setting.calibrated[kind]:
        _refuse_uncalibrated(kind, sensor_id, setting)
    try:
        received = _received(record, sensor_id, setting)
    except CalibrationError as error:
        raise RefusedError(refused(Cause.BAD_CALIBRATION, error)) from error
    except SceneloomError as error:
        raise RefusedError(refused(Cause.BAD_RECORD, error)) from error
    return Accepted(sensor_id, kind, record, received, setting)


_KINDS: dict[type, SensorKind] = {
    ImageData: SensorKind.CAMERA,
    Boxes2d: SensorKind.CAMERA,
    PointCloudData: SensorKind.LIDAR,
    Boxes3d: SensorKind.LIDAR,
}
"""Who sends a record; raw data can be of either."""

_FRAME_STREAMS = {
    SensorKind.CAMERA: ("image", "raw", "boxes_2d"),
    SensorKind.LIDAR: ("points", "raw", "boxes_3d"),
}
"""The kinds of records whose numbers are those of a sensor's frames."""


def _kind_of_sensor(record: WholeRecord, setting: Setting) -> SensorKind:
    declared = setting.sensors.get(record.sensor_id)
    wanted = _KINDS.get(type(record))
    if wanted is None:
        if declared is None or declared.raw is None:
            _refuse(
                Cause.UNKNOWN_SENSOR,
                f"raw data of sensor {record.sensor_id}; expected one whose kind and raw the property sensors says",
            )
        return declared.kind
    if setting.sensors and (declared is None or declared.kind is not wanted):
        listed = ", ".join(f"{sensor.sensor_id} ({sensor.kind})" for sensor in setting.sensors.values())
        _refuse(Cause.UNKNOWN_SENSOR, f"{wanted} {record.sensor_id}; the property sensors has {listed}")
    return wanted


def _refuse_uncalibrated(kind: SensorKind, sensor_id: int, setting: Setting) -> NoReturn:
    fault = setting.fault_of(kind, sensor_id)
    if fault is not None:
        _refuse(Cause.BAD_CALIBRATION, fault)
    listed = ", ".join(map(str, setting.calibrated[kind])) or "none"
    _refuse(Cause.NO_CALIBRATION, f"no calibration of {kind} {sensor_id}; calibrated are {listed}")


def _received(record: WholeRecord, sensor_id: int, setting: Setting) -> Received:
    if isinstance(record, PointCloudData):
        frame = lidar_frame_of(record)
        count = len(result_fields(frame))
        if count > _MOST_FIELDS:
            problem = (
                f"{len(record.fields)} names; expected so many that {_MOST_FIELDS} are left with r, g, b"
            )
            raise POINT_CLOUD.fault("fields", problem)
        return frame
    if isinstance(record, ImageData):
        return image_of(record, setting.camera(sensor_id))
    if isinstance(record, Boxes3d):
        check_headings(record.directions.astype(np.float64), "boxes", setting)
    if isinstance(record, RawData):
        declared = setting.sensors[sensor_id]
        if declared.kind is SensorKind.LIDAR:
            return lidar_frame_of_raw(record)
        return pixels_of_raw(record, setting.camera(sensor_id), str(declared.raw))
    return record


def check_headings(directions: Float64Array, group: str, setting: Setting) -> None:
    """Refuse boxes that head straight up or down: boxes are upright, so nothing would be known of how they lie.

    Args:
        directions: (N, 3), of any length but 0, in the declared lidar frame.
        group: how messages call the list; "" for a single box.

    Raises:
        RefusedError: one does.

    Source: READING of direction in docs/CONVENTIONS.md.
    """
    lifts = directions @ setting.standard_from_lidar[2]
    if not lifts.any():
        return
    squares = (directions * directions).sum(axis=1)
    upright = squares - lifts * lifts <= _LEAST_LEVEL**2 * squares
    if upright.any():
        k = int(np.argmax(upright))
        location = f"{group}[{k}].direction" if group else "direction"
        problem = (
            f"{tuple(directions[k].tolist())} is vertical; expected where the box heads along the ground"
        )
        _refuse(Cause.BAD_RECORD, BOX_3D.fault(location, problem))


def _refuse(cause: Cause, reason: object) -> NoReturn:
    raise RefusedError(refused(cause, reason))


_HandIn = Callable[[Boxes3d | Boxes2d, Setting], None]
"""Takes a frame that is whole, by the configuration in force when its first box came."""


class Collection:
    """Keeps boxes that came alone until their frames are whole. Changed by one thread at a time."""

    def __init__(self, received_records: ReceivedRecords, hand_in: _HandIn) -> None:
        """Keep nothing yet.

        Args:
            received_records: knows whose boxes are that name no sensor, and which frames have come.
            hand_in: reported each whole frame.
        """
        self._received_records = received_records
        self._hand_in = hand_in
        self._bare: dict[tuple[type, int], _BareBoxes] = {}

    def __len__(self) -> int:
        """How many boxes wait for others of their frame."""
        return sum(len(bare.boxes) for bare in self._bare.values())

    def add(self, box: Box3d | Box2d, setting: Setting) -> bool:
        """Keep a box; where it begins a frame, the one before is whole.

        Returns:
            Whether it begins a frame.

        Raises:
            RefusedError: it is not taken; the answer says why.
        """
        sensor_id = self._received_records.sender_of(box, setting)
        bare = self._bare.setdefault((type(box), sensor_id), _BareBoxes(sensor_id, setting))
        begins = bare.begins(box)
        if begins:
            stream = kind_of(Boxes3d if isinstance(box, Box3d) else Boxes2d).name, sensor_id
            if self._received_records.has_come(stream, _seq_of(box)):
                reason = f"a box of frame {_seq_of(box)}, of which all have come; expected it before the next frame's"
                raise RefusedError(refused(Cause.DUPLICATE, reason))
            self._close(bare)
            bare.setting = setting
        elif len(bare.boxes) >= _MOST_BOXES:
            reason = f"more than {_MOST_BOXES} boxes of frame {_seq_of(box)}"
            raise RefusedError(refused(Cause.TOO_MANY, reason))
        bare.add(box, time.monotonic())
        return begins

    def close(self, *, older_than_s: float | None = None) -> None:
        """Hand in frames: all of them, or those that nothing came for since a time of the monotonic clock [s]."""
        for bare in self._bare.values():
            if older_than_s is None or bare.latest_s <= older_than_s:
                self._close(bare)

    def oldest_s(self) -> float | None:
        """When the last box of the frame came that waits longest for another, by the monotonic clock [s].

        For any thread. None where no boxes wait.
        """
        return min((bare.latest_s for bare in tuple(self._bare.values()) if bare.boxes), default=None)

    def _close(self, bare: _BareBoxes) -> None:
        whole = bare.close()
        if whole is not None:
            self._hand_in(whole, bare.setting)
