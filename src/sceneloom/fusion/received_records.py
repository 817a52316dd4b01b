"""What comes from sensors and detectors: checked against the configuration, and made what is fused."""

from dataclasses import dataclass, field
from typing import NoReturn

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import CalibrationError, SceneloomError
from sceneloom.fusion.accepted import CLOCK_JUMP_NS, Accepted, Received, WholeRecord
from sceneloom.fusion.bare_boxes import seq_of
from sceneloom.fusion.calibration.axes import SensorKind
from sceneloom.fusion.ledger import Stream
from sceneloom.fusion.messages.boxes import Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.scene_form.clouds import lidar_frame_of, lidar_frame_of_raw, result_fields
from sceneloom.fusion.messages.scene_form.images import image_of, pixels_of_raw
from sceneloom.fusion.messages.sensor_data import ImageData, PointCloudData, RawData
from sceneloom.fusion.messages.tables import BOX_3D, POINT_CLOUD
from sceneloom.fusion.outcome import Cause, Outcome, refused
from sceneloom.fusion.setting import Setting

_REMEMBERED = 256
"""Numbers of each stream that are kept to report one that comes again."""

_MOST_FIELDS = 255
"""Of a point of table 9, whose fields_number is a uint8."""

_LEAST_LEVEL = 1e-3
"""A direction whose part along the ground is a smaller share of it than this is vertical."""

RESTART_NS = 2_000_000_000
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
        elif time_ns > arrivals.newest_ns + RESTART_NS:
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
        seq, time_ns = seq_of(box), box.timestamp.nanoseconds
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
        if seq in arrivals.times_ns and -late_ns <= RESTART_NS:
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
