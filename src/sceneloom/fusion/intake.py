"""What comes from sensors and detectors: checked against the configuration, and made what is fused."""

from collections import deque
from dataclasses import dataclass, field
from typing import NoReturn

from sceneloom.errors import SceneloomError
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.messages.boxes import Boxes2d, Boxes3d
from sceneloom.fusion.messages.records import kind_of
from sceneloom.fusion.messages.scene_form import (
    lidar_frame_of,
    lidar_frame_of_raw,
    picture_of,
    picture_of_raw,
)
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData, RawData
from sceneloom.fusion.outcome import Cause, Outcome, refused
from sceneloom.fusion.rig import Received
from sceneloom.fusion.setting import Setting

WholeRecord = RawData | ImageData | PointCloudData | Boxes3d | Boxes2d
"""What is sent of one frame."""

_REMEMBERED = 256
"""Numbers of each sensor that are kept to tell one that comes again."""

CLOCK_JUMP_NS = 10_000_000_000
"""A record that is so much older than the newest one was not late: its sensor's clock was set back."""


class RefusedError(SceneloomError):
    """A record is not taken; carries the answer."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.reason)
        self.outcome = outcome


@dataclass(frozen=True, slots=True, eq=False)
class Admitted:
    """A record that was taken.

    Attributes:
        sensor_id: who sent it.
        kind: camera or lidar.
        record: as it was sent.
        received: what is fused.
        setting: the configuration in force when it came.
    """

    sensor_id: int
    kind: SensorKind
    record: WholeRecord
    received: Received
    setting: Setting

    @property
    def timestamp_ns(self) -> int:
        """Of the record [ns]."""
        return self.record.timestamp.nanoseconds

    @property
    def stream(self) -> tuple[str, int]:
        """Which queue it waits in: the kind of record and the sensor."""
        return kind_of(self.record).name, self.sensor_id


@dataclass(slots=True)
class _Stream:
    """What came of one sensor as records of one kind."""

    numbers: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))
    newest_ns: int = -1


@dataclass(slots=True)
class Intake:
    """Checks records; remembers numbers and times of each stream. Not for several threads at once.

    Source: DB34/T 4101-2022, clause 5.6.
    """

    _streams: dict[tuple[str, int], _Stream] = field(default_factory=dict)
    _fused_ns: dict[tuple[str, int], int] = field(default_factory=dict)

    def admit(self, record: WholeRecord, setting: Setting) -> Admitted:
        """Take a record.

        Raises:
            RefusedError: it is not taken; the answer says why.
        """
        admitted = admitted_alone(record, setting)
        self._check_order(admitted)
        return admitted

    def restart(self) -> None:
        """Forget numbers and times: a clock was set back, and what comes now begins anew."""
        self._streams.clear()

    def jumped_back(self, admitted: Admitted) -> bool:
        """Whether a record is so old that its sensor's clock must have been set back."""
        stream = self._streams.get(admitted.stream)
        return stream is not None and admitted.timestamp_ns < stream.newest_ns - CLOCK_JUMP_NS

    def note(self, admitted: Admitted) -> None:
        """Remember a record that was taken."""
        stream = self._streams.setdefault(admitted.stream, _Stream())
        stream.numbers.append(admitted.record.seq)
        stream.newest_ns = max(stream.newest_ns, admitted.timestamp_ns)

    def _check_order(self, admitted: Admitted) -> None:
        stream = self._streams.get(admitted.stream)
        if stream is None or self.jumped_back(admitted):
            return
        seq = admitted.record.seq
        if seq in stream.numbers:
            _refuse(Cause.DUPLICATE, f"seq {seq} of {admitted.kind} {admitted.sensor_id} came already")
        late_ns = stream.newest_ns - admitted.timestamp_ns
        lateness_ns = max(admitted.setting.timeout_ns, admitted.setting.sweep_period_ns)
        if late_ns > lateness_ns:
            _refuse(
                Cause.TIME_BACKWARDS,
                f"{late_ns / 1e6:.3f} ms older than the newest of {admitted.kind} {admitted.sensor_id}; expected at "
                f"most {lateness_ns / 1e6:g} ms (pairing_timeout_ms, or a period of lidar_frequency)",
            )


def admitted_alone(record: WholeRecord, setting: Setting) -> Admitted:
    """Take a record by what it says itself, whatever came before it.

    Raises:
        RefusedError: it is not taken; the answer says why.
    """
    kind = _kind(record, setting)
    sensor_id = record.sensor_id
    known = {pair[kind is SensorKind.LIDAR] for pair in setting.pairs}
    if sensor_id not in known:
        listed = ", ".join(map(str, sorted(known))) or "none"
        _refuse(Cause.NO_CALIBRATION, f"no calibration of {kind} {sensor_id}; calibrated are {listed}")
    try:
        received = _received(record, sensor_id, setting)
    except SceneloomError as error:
        raise RefusedError(refused(Cause.BAD_RECORD, error)) from error
    return Admitted(sensor_id, kind, record, received, setting)


def _kind(record: WholeRecord, setting: Setting) -> SensorKind:
    declared = setting.sensors.get(record.sensor_id)
    wanted = _KINDS.get(type(record))
    if wanted is None:
        if declared is None or declared.raw is None:
            _refuse(
                Cause.UNKNOWN_SENSOR,
                f"raw data of sensor {record.sensor_id}, of which the property sensors says neither kind nor raw",
            )
        return declared.kind
    if setting.sensors and (declared is None or declared.kind is not wanted):
        listed = ", ".join(f"{sensor.sensor_id} ({sensor.kind})" for sensor in setting.sensors.values())
        _refuse(Cause.UNKNOWN_SENSOR, f"{wanted} {record.sensor_id}; the property sensors has {listed}")
    return wanted


_KINDS: dict[type, SensorKind] = {
    ImageData: SensorKind.CAMERA,
    Boxes2d: SensorKind.CAMERA,
    PointCloudData: SensorKind.LIDAR,
    Boxes3d: SensorKind.LIDAR,
}
"""Who sends a record; raw data can be of either."""


def _received(record: WholeRecord, sensor_id: int, setting: Setting) -> Received:
    if isinstance(record, PointCloudData):
        return lidar_frame_of(record)
    if isinstance(record, ImageData):
        return picture_of(record, setting.camera(sensor_id))
    if isinstance(record, RawData):
        declared = setting.sensors[sensor_id]
        if declared.kind is SensorKind.LIDAR:
            return lidar_frame_of_raw(record)
        return picture_of_raw(record, setting.camera(sensor_id), str(declared.raw))
    return record


def _refuse(cause: Cause, reason: object) -> NoReturn:
    raise RefusedError(refused(cause, reason))
