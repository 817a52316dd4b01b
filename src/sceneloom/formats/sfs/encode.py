"""Sensors and trajectories as records of the file, and records as JSON by the table of fields, arrays as items."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import OptionError, without_folders
from sceneloom.formats.base.losses import Support
from sceneloom.formats.sfs.clock import FileClock, StaticTime
from sceneloom.formats.sfs.container import DTYPES, ITEMS, format_keys
from sceneloom.formats.sfs.images import camera_record
from sceneloom.formats.sfs.records import Location, mount_rows, with_extras
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS, RECORDS, Field, Kind
from sceneloom.formats.sfs.sensors import intrinsics_record
from sceneloom.formats.sfs.spool import Blob, Losses, SensorDraft
from sceneloom.scene.annotations import CameraCalibration
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Trajectory, same_direction
from sceneloom.scene.scene import Sensor
from sceneloom.warnings import DataWarning

_STAND_INS = ("brown_conrady", "fisheye", "fisheye_rad_tan_prism", "omnidirectional")
"""Models of the format that camera models of other models are fitted to: those whose formulas have a source."""


def _written_camera_model(camera: Camera, *, any_model: bool) -> tuple[Camera, str | None]:
    """Give the camera model that an `intrinsics` record can hold: the same.

    Or the nearest one of a model of the format.

    Args:
        camera: the exact camera model.
        any_model: whether a model that the format does not list may stand there by its own name.

    Returns:
        The camera model, and in words how far it is off; None where it is the same.
    """
    count = COEFFICIENT_COUNTS.get(camera.model)
    padded = (*camera.coefficients, *(0.0,) * (count or 0))[:count]
    if camera.model == "pinhole" or (any_model and count is None):
        return camera, None
    if count is not None and not any(camera.coefficients[count:]):
        return replace(camera, coefficients=padded), None
    if camera.model not in MODELS:
        pinhole = replace(camera, model="pinhole", coefficients=())
        return pinhole, f"{camera.model} camera model reported as pinhole, off by an unknown number of pixels"
    found = nearest(camera, _candidates())
    count = COEFFICIENT_COUNTS[found.camera.model]
    return replace(found.camera, coefficients=found.camera.coefficients[:count]), found.message(camera)


def with_written_camera_model(
    calibration: CameraCalibration, losses: Losses, *, any_model: bool
) -> CameraCalibration:
    """Give a calibration the camera model that its record can hold, with all numbers of its model.

    Args:
        calibration: with the exact camera model, or without one.
        losses: collects how far the camera model is off.
        any_model: as in `_written_camera_model`.
    """
    if calibration.intrinsics is None:
        return calibration
    written, how_far = _written_camera_model(calibration.intrinsics, any_model=any_model)
    if how_far is not None:
        location = f"annotations[{calibration.id}].intrinsics.distortion"
        losses.add(location, how_far, support=Support.APPROXIMATED)
    return replace(calibration, intrinsics=written)


def _candidates() -> dict[str, tuple[str, ...]]:
    """The models that may stand in for others, each with the coefficients of ours that the format does not have."""
    return {
        model: MODELS[model].coefficient_names[COEFFICIENT_COUNTS[model] :]
        for model in _STAND_INS
        if model in MODELS
    }


_GNSS_ARRAYS = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")

_TRAJECTORY_ARRAYS = ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds")


def _points_fields(sensor: PointsSensor) -> dict[str, Any]:
    """Make the fields of a points sensor."""
    further = sensor.extras.get("points")
    points = {"positions": sensor.positions, "colors": sensor.colors}
    return {"points": with_extras(points, further if isinstance(further, Mapping) else {})}


def _imu_fields(sensor: ImuSensor) -> dict[str, Any]:
    """Make the fields of an IMU; they stand under our metadata."""
    names = ("timestamps_ns", "values", "file_seconds")
    return {
        "streams": {
            name: {part: getattr(samples, part) for part in names} for name, samples in sensor.streams.items()
        }
    }


def _gnss_fields(sensor: GnssSensor) -> dict[str, Any]:
    """Make the fields of a satellite receiver; they stand under our metadata."""
    mount = {} if sensor.mount is None else {"mount": mount_rows(sensor.mount)}
    return {**{name: getattr(sensor, name) for name in _GNSS_ARRAYS}, **mount}


def trajectory_record(
    name: str, trajectory: Trajectory, odometry: Iterable[OdometrySensor]
) -> dict[str, Any]:
    """Make the record of a trajectory; where an odometry sensor reports the same way, only that sensor is named."""
    teller = next((sensor for sensor in odometry if _reports(sensor, trajectory)), None)
    record: dict[str, Any] = {"name": name}
    if teller is None:
        record |= {part: getattr(trajectory, part) for part in _TRAJECTORY_ARRAYS}
    else:
        record["sensor_id"] = teller.id
    if trajectory.covariances is not None:
        record["covariances"] = trajectory.covariances.reshape(-1, 36)
    return record


def _reports(sensor: OdometrySensor, trajectory: Trajectory) -> bool:
    """Whether an odometry sensor holds a trajectory whole."""
    return trajectory.file_seconds is None and same_direction(sensor.poses, trajectory)


def warning_record(warning: DataWarning, source: str) -> dict[str, Any]:
    """Make the record of a warning on a scene, without the folders above its source."""
    return {
        "kind": warning.kind.value,
        "code": warning.code,
        "location": without_folders(warning.location, source),
        "message": without_folders(warning.message, source),
        "count": warning.count,
    }


_MERGED = frozenset({"intrinsics", "video", "points", "poses"})
"""Further fields that go into parts of the sensor's record."""


def draft_of(sensor: Sensor, losses: Losses, *, any_distortion: bool) -> SensorDraft:
    """Make the draft of a sensor, still without frames.

    Args:
        sensor: the sensor.
        losses: collects what the format cannot hold.
        any_distortion: whether distortion models that the format does not list may be written by name.
    """
    if isinstance(sensor, PlainSensor):
        return SensorDraft(sensor.id, sensor.type, dict(sensor.fields), streamed=False)
    if isinstance(sensor, CameraSensor):
        return _with_poses(_camera(sensor, losses, any_distortion=any_distortion), sensor)
    for kind, make in _DRAFTS.items():
        if isinstance(sensor, kind):
            return _with_poses(make(sensor, losses), sensor)
    raise OptionError(f"a {type(sensor).__name__}; expected a sensor")


def _with_poses(draft: SensorDraft, sensor: Any) -> SensorDraft:
    further = sensor.extras.get("poses")
    draft.further_poses = further if isinstance(further, Mapping) else {}
    return draft


def _fields(sensor: Any) -> dict[str, Any]:
    """The fields that every sensor has, and those that it only carries along."""
    merged = {name for name in _MERGED if isinstance(sensor.extras.get(name), Mapping)}
    further = {name: value for name, value in sensor.extras.items() if name not in merged}
    return with_extras({"parent_id": sensor.parent_id}, further)


def _cloud(sensor: Any, losses: Losses) -> SensorDraft:
    draft = SensorDraft(sensor.id, sensor.type.value, _fields(sensor), frames=[])
    draft.poses, draft.mount, draft.coordinates = sensor.poses, sensor.mount, sensor.coordinates.value
    draft.points_frame = draft.note["points_frame"] = sensor.points_frame.value
    model = getattr(sensor, "model", None)
    if model is not None:
        draft.note["model"] = model
    if draft.points_frame != draft.coordinates:
        what = f"points are in the {draft.points_frame} frame, which the format cannot state"
        losses.add(
            f"{draft.location}.points_frame", what, kept="metadata.sceneloom.sensor_notes[].points_frame"
        )
    return draft


def _camera(sensor: CameraSensor, losses: Losses, *, any_distortion: bool) -> SensorDraft:
    draft = SensorDraft(sensor.id, "camera", _fields(sensor))
    draft.poses, draft.mount, draft.coordinates = sensor.poses, sensor.mount, sensor.coordinates.value
    written, how_far = _written_camera_model(sensor.camera, any_model=any_distortion)
    if how_far is not None:
        draft.note |= {"camera": camera_record(sensor.camera), "written_camera": camera_record(written)}
        kept = "metadata.sceneloom.sensor_notes[].camera"
        losses.add(f"{draft.location}.intrinsics.distortion", how_far, kept=kept)
    draft.fields["intrinsics"] = intrinsics_record(written, sensor.extras.get("intrinsics"))
    return draft


def _odometry(sensor: OdometrySensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "odometry", _fields(sensor), poses=sensor.poses, streamed=False)


def _points(sensor: PointsSensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "points", {**_fields(sensor), **_points_fields(sensor)}, streamed=False)


def _imu(sensor: ImuSensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "imu", {**_fields(sensor), **_imu_fields(sensor)}, streamed=False)


def _gnss(sensor: GnssSensor, _: Losses) -> SensorDraft:
    return SensorDraft(sensor.id, "gnss", {**_fields(sensor), **_gnss_fields(sensor)}, streamed=False)


_DRAFTS: Mapping[type, Callable[[Any, Losses], SensorDraft]] = {
    LidarSensor: _cloud,
    RadarSensor: _cloud,
    OdometrySensor: _odometry,
    PointsSensor: _points,
    ImuSensor: _imu,
    GnssSensor: _gnss,
}

Items = list[tuple[Location, Blob]]
"""The arrays below what is written first, each with its location there."""


class ArraySink(Protocol):
    """Takes the arrays of records."""

    def add(self, array: AnyArray) -> Blob:
        """Take one, and state where it stands."""
        ...


@dataclass(slots=True)
class RecordWriter:
    """Writes records of a file whose clock is known.

    Attributes:
        clock: turns nanoseconds into timestamps.
        spool: takes the arrays.
        lowest: the lowest timestamp so far, 0 at most.
        rounded: how many times were not a whole number of the file's unit.
        not_numbers: how many numbers of the header were infinite or no number, which JSON cannot state.
    """

    clock: FileClock
    spool: ArraySink
    lowest: int = 0
    rounded: int = 0
    not_numbers: int = 0
    _location: list[str | int] = field(default_factory=list)

    def write(self, values: Mapping[str, Any], record: str, items: Items) -> dict[str, Any]:
        """Write one record; fields that are None where the table knows them are left out."""
        fields = RECORDS[record]
        written: dict[str, Any] = {}
        for name, value in values.items():
            if type(value) is Blob:
                written[name] = ""
                items.append(((*self._location, name), value))
                continue
            field = fields.get(name)
            if value is None:
                if field is None:
                    written[name] = None
                continue
            self._location.append(name)
            kind = Kind.ANYTHING if field is None else field.kind
            written[name] = _WRITERS[kind](self, value, field or _UNKNOWN, items)
            self._location.pop()
        return written

    def write_part(self, name: str, values: Mapping[str, Any], record: str, items: Items) -> dict[str, Any]:
        """Write one of several records that an object holds by name."""
        self._location.append(name)
        written = self.write(values, record, items)
        self._location.pop()
        return written

    def write_list(self, values: Any, record: str, items: Items) -> list[Any]:
        """Write a list of records, or, as in the projections of keypoints, a list of lists of them."""
        written = []
        for index, value in enumerate(values):
            self._location.append(index)
            is_record = type(value) is dict or isinstance(value, Mapping)
            written.append((self.write if is_record else self.write_list)(value, record, items))
            self._location.pop()
        return written

    def plain(self, value: Any, items: Items) -> Any:
        """Write any value that JSON and the container can hold.

        Raises:
            OptionError: it is something else.
        """
        if value is None or type(value) in _JSON_TYPES:
            return value
        if isinstance(value, Blob | np.ndarray):
            return self._array(value, items)
        if isinstance(value, np.generic):
            return self.plain(value.item(), items)
        for kind, write in _PLAIN_WRITERS.items():
            if isinstance(value, kind):
                return write(self, value, items)
        raise OptionError(f"{self.location}: a {type(value).__name__}; JSON and arrays cannot hold it")

    def _array(self, value: Blob | AnyArray, items: Items) -> str:
        """Leave the position of an array empty, as the container has it, and note its item."""
        if isinstance(value, np.ndarray) and value.dtype.name not in DTYPES:
            raise OptionError(f"{self.location}: an array of {value.dtype}; expected numbers")
        items.append((tuple(self._location), value if isinstance(value, Blob) else self.spool.add(value)))
        return ""

    @property
    def location(self) -> str:
        """Where the writer is, for messages."""
        return format_keys(self._location)

    def plain_object(self, value: Mapping[Any, Any], items: Items) -> dict[Any, Any]:
        """Write an object of anything."""
        return self._plain_parts({str(key): part for key, part in value.items()}, items)

    def plain_list(self, values: list[Any] | tuple[Any, ...], items: Items) -> list[Any]:
        """Write a list of anything; plain numbers and text need no look at each."""
        types = set(map(type, values))
        if types <= _JSON_TYPES or (types <= {int, float} and _all_finite(values)):
            return list(values)
        return list(self._plain_parts(dict(enumerate(values)), items).values())

    def _plain_parts(self, parts: dict[Any, Any], items: Items) -> dict[Any, Any]:
        written = {}
        for key, part in parts.items():
            self._location.append(key)
            written[key] = self.plain(part, items)
            self._location.pop()
        return written

    def plain_number(self, value: float) -> float | None:
        """Write a number that JSON can state; others become null and are counted."""
        if abs(value) < float("inf"):
            return value
        self.not_numbers += 1
        return None


def _all_finite(values: Iterable[float]) -> bool:
    """Whether all numbers are finite; their sum says so at once, unless it is beyond float64 itself."""
    try:
        return math.isfinite(math.fsum(values))
    except OverflowError:
        return all(value - value == 0 for value in values)
    except ValueError:  # infinity less infinity
        return False


_UNKNOWN = Field("", Kind.ANYTHING)

_JSON_TYPES = frozenset({bool, int, str})

_PLAIN_WRITERS: Mapping[Any, Callable[[RecordWriter, Any, Items], Any]] = {
    Mapping: RecordWriter.plain_object,
    list | tuple: RecordWriter.plain_list,
    float: lambda writer, value, _: writer.plain_number(float(value)),
    str: lambda _, value, __: str(value),
    int: lambda _, value, __: int(value),
}


def encode_header(header: dict[str, Any], items: Items) -> bytes:
    """Make the header's bytes; `$items` comes last.

    Raises:
        OptionError: the header nests too deeply, or text in it is no Unicode.
    """
    header[ITEMS] = [
        {"keys": list(keys), "length": b.length, "offset": b.offset, "dtype": b.dtype, "shape": list(b.shape)}
        for keys, b in items
    ]
    try:
        return msgspec.json.encode(header)
    except RecursionError:
        raise OptionError("the scene's fields nest too deeply for JSON") from None
    except UnicodeEncodeError as error:
        raise OptionError(f"the scene holds text that is no Unicode: {error}") from None


def _write_plain(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    return writer.plain(value, items)


def _write_time(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    if type(value) is not int:
        return writer.plain(value, items)
    clock = writer.clock
    writer.rounded += (value - clock.offset_ns) % clock.tick_ns != 0
    timestamp = clock.timestamp(value)
    writer.lowest = min(writer.lowest, timestamp)
    return timestamp


def _write_times(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if isinstance(value, StaticTime):
        return [max(writer.clock.timestamp(value), 0)]
    if isinstance(value, np.ndarray) and value.dtype.kind in "iu" and value.ndim == 1:
        timestamps, inexact = writer.clock.timestamp_array(value.astype(np.int64))
        writer.rounded += inexact
        written: list[int] = timestamps.tolist()
        writer.lowest = min(writer.lowest, *written) if written else writer.lowest
        return written
    if isinstance(value, list | tuple) and set(map(type, value)) <= {int}:
        tick_ns, offset_ns = writer.clock.tick_ns, writer.clock.offset_ns
        if not any((time - offset_ns) % tick_ns for time in value):
            writer.lowest = min(writer.lowest, (min(value, default=offset_ns) - offset_ns) // tick_ns)
            return [(time - offset_ns) // tick_ns for time in value]
        return [_write_time(writer, time, field, items) for time in value]
    return writer.plain(value, items)


def _write_duration(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    return writer.plain(writer.clock.duration(value) if type(value) in (int, float) else value, items)


def _write_durations(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if isinstance(value, list | tuple):
        return [_write_duration(writer, duration, field, items) for duration in value]
    return writer.plain(value, items)


def _write_list(writer: RecordWriter, value: Any, _: Field, items: Items) -> Any:
    """Write rows of numbers as JSON: the description calls none of them binary."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        values = value.tolist()
        return values if np.isfinite(value).all() else writer.plain(values, items)
    return writer.plain(value, items)


def _write_array(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if not isinstance(value, list | tuple):
        return writer.plain(value, items)
    try:
        return writer.plain(np.asarray(value, field.dtype), items)
    except (ValueError, TypeError, OverflowError):
        return writer.plain(value, items)


def _write_record(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    return (
        writer.write(value, field.record, items) if isinstance(value, Mapping) else writer.plain(value, items)
    )


def _write_records(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    if _are_records(value):
        return writer.write_list(value, field.record, items)
    return _write_record(writer, value, field, items)


def _are_records(value: Any) -> bool:
    """Whether a value is a list of records, or a list of such lists; fields of unknown types may be anything."""
    return isinstance(value, list | tuple) and all(
        type(item) is dict or isinstance(item, Mapping) or _are_records(item) for item in value
    )


def _write_record_map(writer: RecordWriter, value: Any, field: Field, items: Items) -> Any:
    written = {}
    for name, record in value.items():
        written[name] = writer.write_part(name, record, field.record, items)
    return written


_WRITERS: Mapping[Kind, Callable[[RecordWriter, Any, Field, Items], Any]] = {
    **dict.fromkeys(Kind, _write_plain),
    Kind.TIME: _write_time,
    Kind.TIMES: _write_times,
    Kind.DURATION: _write_duration,
    Kind.DURATIONS: _write_durations,
    Kind.LIST: _write_list,
    Kind.ARRAY: _write_array,
    Kind.RECORD: _write_record,
    Kind.RECORDS: _write_records,
    Kind.RECORD_OR_RECORDS: _write_records,
    Kind.RECORD_LISTS: _write_records,
    Kind.RECORD_MAP: _write_record_map,
}
