"""The model's sensors, trajectories and annotations as records: the field names of the file, times in its unit.

Arrays as items.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, cast

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import OptionError, without_folders
from sceneloom.formats.base.losses import Support
from sceneloom.formats.sfs.clock import FileClock
from sceneloom.formats.sfs.container import DTYPES, ITEMS, format_keys
from sceneloom.formats.sfs.images import camera_record
from sceneloom.formats.sfs.records import Location, mount_rows
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS, RECORDS, Field, Kind
from sceneloom.formats.sfs.spool import Blob, Losses, SensorDraft, with_further
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, Trajectory, same_direction
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


def _intrinsics_record(camera: Camera) -> dict[str, Any]:
    """Make the `intrinsics` record of a camera model that the format can hold."""
    record: dict[str, Any] = {
        name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
    }
    if camera.model != "pinhole":
        record["distortion"] = {"model": camera.model, "params": list(camera.coefficients)}
    return record


def _merged_intrinsics(record: dict[str, Any], further: Any) -> dict[str, Any]:
    """Add unknown fields of an `intrinsics` record and of its `distortion`; known ones win."""
    if not isinstance(further, Mapping):
        return record
    of_distortion = further.get("distortion")
    if isinstance(of_distortion, Mapping):
        record["distortion"] = with_further(record.get("distortion") or {}, of_distortion)
    return with_further(record, further)


_GNSS_ARRAYS = ("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds")

_TRAJECTORY_ARRAYS = ("timestamps_ns", "positions", "quaternions_xyzw", "file_seconds")


def _points_fields(sensor: PointsSensor) -> dict[str, Any]:
    """Make the fields of a points sensor."""
    further = sensor.extras.get("points")
    points = {"positions": sensor.positions, "colors": sensor.colors}
    return {"points": with_further(points, further if isinstance(further, Mapping) else {})}


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
    return with_further({"parent_id": sensor.parent_id}, further)


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
    draft.fields["intrinsics"] = _merged_intrinsics(
        _intrinsics_record(written), sensor.extras.get("intrinsics")
    )
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


class _StationaryTime(int):
    """The time of something that holds at all times [ns]; it is written as one that the file can hold."""


class ArraySink(Protocol):
    """Takes the arrays of records."""

    def add(self, array: AnyArray) -> Blob:
        """Take one, and state where it stands."""
        ...


@dataclass(slots=True)
class RecordWriter:
    """Writes records of a file whose clock is known.

    Attributes:
        clock: rotates nanoseconds into timestamps.
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
    if isinstance(value, _StationaryTime):
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

_Record = dict[str, Any]


def annotation_record(annotation: Annotation) -> _Record:
    """Make the record of an annotation.

    Raises:
        OptionError: a number of it is not finite; rows of NaN, where they mean "none", are written as null.
    """
    if isinstance(annotation, PlainAnnotation):
        return {"id": annotation.id, "type": annotation.type, **annotation.fields}
    record: _Record = {
        "id": annotation.id,
        "type": str(annotation.type),
        "parent_id": annotation.parent_id,
        **_stated(annotation),
    }
    try:
        record |= _FIELDS[type(annotation)](annotation)
    except _NotFiniteError as error:
        raise OptionError(f"annotations[{annotation.id}].{error}") from None
    # a field that is not stated is left out here: not every type has each of them
    stated = {name: value for name, value in record.items() if value is not None}
    return with_further(stated, annotation.extras)


def attribute_record(attribute: AttributePath) -> _Record:
    """Make the record of an attribute."""
    values: Any = attribute.values
    if attribute.timestamps_ns is None and not values:
        values = None
    record = {
        "name": attribute.name,
        "sensor_id": attribute.sensor_id,
        "static": attribute.static,
        "point_index": attribute.point_index,
        "timestamps": attribute.timestamps_ns,
        "values": values,
    }
    return with_further(record, attribute.extras)


class _NotFiniteError(ValueError):
    """Where a number is not finite, below the annotation, and which."""


def _stated(annotation: Any) -> _Record:
    """Label, stillness and attributes, of the types that have them."""
    record: _Record = {name: getattr(annotation, name, None) for name in ("label", "stationary")}
    attributes = getattr(annotation, "attributes", ())
    if attributes:
        record["attributes"] = [attribute_record(attribute) for attribute in attributes]
    return record


def _finite(name: str, values: Float64Array) -> Float64Array:
    if np.isfinite(values).all():
        return values
    row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
    raise _NotFiniteError(f"{name}[{row}]: {values[row].tolist()}; expected finite numbers")


def _nullable(name: str, values: Float64Array | None) -> Any:
    """Write rows of NaN as null."""
    if values is None or np.isfinite(values).all():
        return values
    rows: list[list[float] | None] = values.tolist()
    for row in np.flatnonzero(~np.isfinite(values).all(axis=1)).tolist():
        if not np.isnan(values[row]).all():
            raise _NotFiniteError(
                f"{name}[{row}]: {rows[row]}; expected finite numbers, or NaN for all of them"
            )
        rows[row] = None
    return rows


def _path(timestamps_ns: Any, values: Any, further: Mapping[str, Any]) -> _Record:
    return with_further({"timestamps": timestamps_ns, "values": values}, further)


def _poses(poses: Poses | None, further: Any) -> _Record | None:
    """Write poses; the time of one that holds at all times says nothing."""
    if poses is None:
        return None
    times: Any = _StationaryTime(poses.start_ns) if poses.static else poses.timestamps_ns
    rows = np.hstack([poses.positions, poses.quaternions_xyzw])
    return _path(times, rows, further if isinstance(further, Mapping) else {})


def _cuboid(cuboid: CuboidAnnotation) -> _Record:
    path = cuboid.path
    return {
        "path": _path(path.timestamps_ns, _finite("path.values", path.values), path.extras),
        "activations": _listed("activations", cuboid.activations, _activation),
        "projections": _listed("projections", cuboid.projections, _projection),
    }


def _listed(name: str, parts: Iterable[Any], record: Callable[[str, Any], _Record]) -> list[_Record] | None:
    return [record(f"{name}[{index}]", part) for index, part in enumerate(parts)] or None


def _activation(location: str, activation: Activation) -> _Record:
    record = {
        "sensor_id": activation.sensor_id,
        "timestamps": activation.timestamps_ns,
        "durations": activation.durations_ns,
        "cuboids": _nullable(f"{location}.cuboids", activation.cuboids),
    }
    return with_further(record, activation.extras)


def _projection(location: str, projection: Projection) -> _Record:
    record = {
        "sensor_id": projection.sensor_id,
        "timestamps": projection.timestamps_ns,
        "boxes": _nullable(f"{location}.boxes", projection.boxes),
        "confirmed": projection.confirmed,
        "cuboids": _nullable(f"{location}.cuboids", projection.cuboids),
    }
    return with_further(record, projection.extras)


def _box_2d(box: Box2DAnnotation) -> _Record:
    path = box.path
    values = _finite("path.values", path.values)
    return {"sensor_id": box.sensor_id, "path": _path(path.timestamps_ns, values, path.extras)}


def _shape(shape: ShapeAnnotation) -> _Record:
    path = shape.path
    rows = [
        _finite(f"path.values[{k}], vertices", vertices).reshape(-1).tolist()
        for k, vertices in enumerate(path.vertices)
    ]
    return {
        "sensor_id": shape.sensor_id,
        "is_closed": shape.is_closed,
        "path": _path(path.timestamps_ns, rows, path.extras),
    }


def _write_annotations_points(points: PointsAnnotation) -> _Record:
    return {
        "sensor_id": points.sensor_id,
        "labels": points.labels,
        "paths": [_point_path(f"paths[{k}]", path) for k, path in enumerate(points.paths)],
        "projections": [
            _listed(f"projections[{k}]", of_point, _point_projection) or []
            for k, of_point in enumerate(points.projections)
        ]
        or None,
    }


def _point_path(location: str, path: PointPath) -> _Record:
    values = _finite(f"{location}.values", path.values)
    return {"id": path.id, **_path(path.timestamps_ns, values, path.extras)}


def _point_projection(location: str, projection: PointProjection) -> _Record:
    record = {
        "sensor_id": projection.sensor_id,
        "timestamps": projection.timestamps_ns,
        "points": _nullable(f"{location}.points", projection.points),
        "confirmed": projection.confirmed,
        "positions": _nullable(f"{location}.positions", projection.positions),
    }
    return with_further(record, projection.extras)


def _labeled_points(annotation: LabeledPointsAnnotation) -> _Record:
    parts = [
        with_further(
            {"sensor_id": part.sensor_id, "sensor_frame": part.sensor_frame, "point_ids": part.point_ids},
            part.extras,
        )
        for part in annotation.labeled_points
    ]
    return {"is_instance": annotation.is_instance, "labeled_points": parts}


def _event(event: EventAnnotation) -> _Record:
    return {"sensor_id": event.sensor_id, "start": event.start_ns, "duration": event.duration_ns}


def _link(link: LinkAnnotation) -> _Record:
    names = ("sensor_id", "from_id", "to_id", "is_bidirectional")
    return {name: getattr(link, name) for name in names}


def _adjustment(adjustment: LocalizationAdjustment) -> _Record:
    return {"poses": _poses(adjustment.poses, adjustment.extras.get("poses"))}


def _calibration(calibration: CameraCalibration) -> _Record:
    camera_model, further = calibration.intrinsics, calibration.extras.get("intrinsics")
    return {
        "sensor_id": calibration.sensor_id,
        "poses": _poses(calibration.poses, calibration.extras.get("poses")),
        "intrinsics": None
        if camera_model is None
        else _merged_intrinsics(_intrinsics_record(camera_model), further),
        "time_offset": calibration.time_offset_ns,
    }


def _nothing_more(_: Any) -> _Record:
    return {}


_FIELDS = cast(
    "Mapping[type, Callable[[Any], _Record]]",
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _box_2d,
        ShapeAnnotation: _shape,
        PointsAnnotation: _write_annotations_points,
        LabeledPointsAnnotation: _labeled_points,
        EventAnnotation: _event,
        LinkAnnotation: _link,
        LocalizationAdjustment: _adjustment,
        CameraCalibration: _calibration,
        ObjectAnnotation: _nothing_more,
        GroupAnnotation: _nothing_more,
    },
)
"""What each type of annotation has besides what all have."""
