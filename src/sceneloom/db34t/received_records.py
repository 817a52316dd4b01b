"""Records that a session receives (clause 5.6): checked against the configuration in force, single boxes as frames."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from types import MappingProxyType
from typing import NoReturn

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.db34t.calibration import SensorKind
from sceneloom.db34t.events import CLOCK_JUMP_NS, Accepted, FrameRecord, Stream
from sceneloom.db34t.records import (
    ENCODINGS,
    Box2d,
    Box3d,
    Boxes2d,
    Boxes3d,
    ImageData,
    PointCloudData,
    RawData,
    join_boxes,
    kind_of,
)
from sceneloom.db34t.scene_objects import image_of, lidar_frame_of, result_fields
from sceneloom.db34t.setting import Setting
from sceneloom.db34t.tables import BOX_3D, POINT_CLOUD, RAW
from sceneloom.db34t.types import NANOSECONDS, Cause, Outcome, refused
from sceneloom.errors import CalibrationError, OptionError, SceneloomError
from sceneloom.formats.recording.lidars import XYZIRT
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame, LidarPoints

_MOST_FIELDS = 255  # of a point of table 9, whose fields_number is a uint8


def _measurement_of(
    record: RawData | ImageData | PointCloudData | Boxes3d | Boxes2d, setting: Setting
) -> tuple[LidarFrame | CameraImage | Boxes3d | Boxes2d, ImageData | None]:
    """What is fused of a record of one frame, and the record of an image where it is or makes one.

    Raises:
        DataError: the record does not fit its calibration, or cannot be read.
        CalibrationError: the calibrations of its camera are of images of several sizes.
    """
    match record:
        case PointCloudData():
            frame = lidar_frame_of(record)
            if len(result_fields(frame)) > _MOST_FIELDS:
                expected = f"expected so many that {_MOST_FIELDS} are left with r, g, b"
                raise POINT_CLOUD.fault("fields", f"{len(record.fields)} names; {expected}")
            return frame, None
        case ImageData():
            return image_of(record, setting.camera(record.sensor_id)), record
        case RawData():
            declared = setting.sensors[record.sensor_id]
            if declared.kind is SensorKind.LIDAR:
                return lidar_frame_of_raw(record), None
            camera = setting.camera(record.sensor_id)
            image = image_record_of_raw(record, camera, str(declared.raw))
            return image_of(image, camera), image
    return record, None


_MOST_BOXES = 100_000  # boxes of one frame: a sender that never begins another is stopped
_REMEMBERED = 256  # numbers of each stream that are kept to report one that comes again
_LEAST_LEVEL = 1e-3  # a direction whose part along the ground is a smaller share of it than this is vertical
_RESTART_NS = 2_000_000_000  # a sensor that was silent for so long may have been started again, and count from 0

_KINDS: dict[type, SensorKind] = {
    ImageData: SensorKind.CAMERA,
    Boxes2d: SensorKind.CAMERA,
    PointCloudData: SensorKind.LIDAR,
    Boxes3d: SensorKind.LIDAR,
}
"""Who sends a record; raw data can be of either."""


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
    """The boxes of one sensor that came one by one, of the frame that is not whole yet.

    Attributes:
        latest_s: when the last one came, on the monotonic clock [s].
    """

    sensor_id: int
    setting: Setting
    boxes: list[Box3d | Box2d] = field(default_factory=list)
    latest_s: float = 0.0


class ReceivedRecords:
    """Checks records; remembers numbers and times of each stream, and boxes until their frames are whole.

    A frame is whole as soon as a box of another frame comes, or none came for a while. Not for several threads at once.

    Source: DB34/T 4101-2022, clause 5.6.
    """

    def __init__(self, hand_in: Callable[[Boxes3d | Boxes2d, Setting], None]) -> None:
        """Know nothing yet.

        Args:
            hand_in: takes a frame of boxes that is whole, by the configuration in force when its first box came.
        """
        self._hand_in = hand_in
        self._arrivals: dict[Stream, _Arrivals] = {}
        self._frames: dict[tuple[type, int], _Frame] = {}

    def accept(self, record: FrameRecord, setting: Setting) -> Accepted:
        """Take a record, unless it came already or is too old.

        Raises:
            RefusedError: it is not taken; the answer says why.
        """
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
        """Remember a record that was taken.

        Returns:
            "set-back" or "set-forward" where its sensor's clock must have been, or it was silent for long; else "".
        """
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
        """Keep a box; where it begins a frame, the one before is whole.

        Returns:
            Whether it begins a frame.

        Raises:
            RefusedError: it is not taken; the answer says why.
        """
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
        """When the last box of the frame came that waits longest for another, by the monotonic clock [s].

        For any thread. None where no boxes wait.
        """
        return min((frame.latest_s for frame in tuple(self._frames.values()) if frame.boxes), default=None)

    def _close(self, frame: _Frame) -> None:
        boxes, frame.boxes = frame.boxes, []
        if boxes:
            self._hand_in(join_boxes([box.alone(frame.sensor_id) for box in boxes]), frame.setting)

    def _sender_of(self, box: Box3d | Box2d, setting: Setting) -> int:
        """Find the sensor of a box that names none: that of the frame with its number, or the only one there is.

        Source: READING of missing ids in docs/CONVENTIONS.md.
        """
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
        measurement, image = _measurement_of(record, setting)
    except RefusedError:
        raise
    except SceneloomError as error:
        cause = Cause.BAD_CALIBRATION if isinstance(error, CalibrationError) else Cause.BAD_RECORD
        raise RefusedError(refused(cause, error)) from error
    return Accepted(sensor_id, kind, record, measurement, setting, image)


def _check_headings(directions: Float64Array, group: str, setting: Setting) -> None:
    """Refuse boxes that head straight up or down: boxes are upright, so nothing would be known of how they lie.

    Args:
        directions: (N, 3), of any length but 0, in the declared lidar frame.

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
        direction = tuple(directions[k].tolist())
        problem = f"{direction} is vertical; expected where the box heads along the ground"
        _refuse(Cause.BAD_RECORD, BOX_3D.fault(location, problem))


def lidar_frame_of_raw(record: RawData) -> LidarFrame:
    """The sweep of raw data that are the 23-byte records of the recording format.

    Points with a number that is not finite are left out, as those of table 6 are.

    Raises:
        DataError: the bytes are no whole number of records, or times are none.
    """
    count, remainder = divmod(record.length, XYZIRT.itemsize)
    if remainder:
        expected = f"expected records of {XYZIRT.itemsize} bytes"
        raise RAW.fault("data", f"{count} records and a remainder of {remainder} bytes; {expected}")
    rows = np.frombuffer(record.data, XYZIRT)
    finite = np.ones(count, np.bool_)
    for name in ("x", "y", "z", "timestamp"):
        finite &= np.isfinite(rows[name])
    if not finite.all():
        rows = rows[finite]
    times = rows["timestamp"]
    if len(times) and (times.max() >= 2**32 or times.min() < 0):
        raise RAW.fault("data", f"times up to {float(times.max())} s; expected 0 to {2**32} s")
    seconds = np.floor(times)
    points = LidarPoints(
        np.column_stack([rows[name] for name in "xyz"]).astype(np.float32, copy=False).reshape(len(rows), 3),
        rows["intensity"].copy(),
        timestamps_ns=seconds.astype(np.int64) * NANOSECONDS
        + np.rint((times - seconds) * NANOSECONDS).astype(np.int64),
        rings=rows["ring"].astype(np.uint16),
    )
    extras = {"sensor_id": record.sensor_id, "seq": record.seq}
    return LidarFrame(record.timestamp.nanoseconds, points, extras=MappingProxyType(extras))


def image_record_of_raw(record: RawData, camera: Camera, encoding: str) -> ImageData:
    """The image record of raw data: jpeg, png, or pixels of the camera's size in another one of `ENCODINGS`.

    Raises:
        DataError: there are more or fewer bytes than pixels need.
        OptionError: the encoding is not known, or does not state how many values a pixel has.
    """
    known = ENCODINGS.get(encoding)
    if known is None or encoding == "raw":
        names = ", ".join(name for name in ENCODINGS if name != "raw")
        raise OptionError(f"encoding {encoding!r}; expected one of {names}")
    channel = 3 if known.is_file else min(known.channels)
    length = camera.height * camera.width * channel
    if not known.is_file and record.length != length:
        expected = f"{length}, as {camera.width}x{camera.height} pixels of {encoding} have"
        raise RAW.fault("length", f"{record.length}; expected {expected}")
    if record.length == 0:
        raise RAW.fault("length", f"0; expected a file of {encoding}")
    return ImageData(
        sensor_id=record.sensor_id,
        timestamp=record.timestamp,
        seq=record.seq,
        height=camera.height,
        width=camera.width,
        encoding=encoding,
        channel=channel,
        data=np.frombuffer(record.data, np.uint8),
    )
