"""Writing a scene as a whole or as a stream; the header is made at the end."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import DataError, OptionError, without_folders
from sceneloom.formats.base.losses import LossReport, Support
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.registry import FORMATS
from sceneloom.formats.sfs.annotations import attribute_record, encode_annotation
from sceneloom.formats.sfs.clock import (
    READABLE_TICKS_NS,
    TICKS_NS,
    UINT32_MAX,
    FileClock,
    StaticTime,
    chosen_offset_ns,
)
from sceneloom.formats.sfs.container import DTYPES, ITEMS, collector_paused, format_keys
from sceneloom.formats.sfs.metadata import OURS
from sceneloom.formats.sfs.profiles import (
    Profile,
    attribute_fits,
    profile_named,
    simplified_attributes,
    thousandths,
)
from sceneloom.formats.sfs.reader import DEFAULT_EULER
from sceneloom.formats.sfs.records import Location, mount_rows, with_extras
from sceneloom.formats.sfs.schema import (
    COEFFICIENT_COUNTS,
    RECORDS,
    Field,
    Kind,
    annotation_record,
    sensor_record,
)
from sceneloom.formats.sfs.sensors import ImageNotesWriter, camera_record, intrinsics_record
from sceneloom.formats.sfs.spool import (
    Blob,
    CameraDraft,
    ClockKeeper,
    CloudWriter,
    ImageWriter,
    Losses,
    SensorDraft,
    Spool,
    check_new,
    note_losses,
)
from sceneloom.scene.annotations import (
    Annotation,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    LocalizationAdjustment,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, key_of
from sceneloom.warnings import DataWarning, WarningKind

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


def _with_written_camera_model(calibration: CameraCalibration, losses: Losses, *, any_model: bool) -> CameraCalibration:
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
        model: MODELS[model].coefficient_names[COEFFICIENT_COUNTS[model] :] for model in _STAND_INS if model in MODELS
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
        "streams": {name: {part: getattr(samples, part) for part in names} for name, samples in sensor.streams.items()}
    }


def _gnss_fields(sensor: GnssSensor) -> dict[str, Any]:
    """Make the fields of a satellite receiver; they stand under our metadata."""
    mount = {} if sensor.mount is None else {"mount": mount_rows(sensor.mount)}
    return {**{name: getattr(sensor, name) for name in _GNSS_ARRAYS}, **mount}


def _trajectory_record(name: str, trajectory: Trajectory, odometry: Iterable[OdometrySensor]) -> dict[str, Any]:
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


def _warning_record(warning: DataWarning, source: str) -> dict[str, Any]:
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


def _draft_of(sensor: Sensor, losses: Losses, *, any_distortion: bool) -> SensorDraft:
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
        losses.add(f"{draft.location}.points_frame", what, kept="metadata.sceneloom.sensor_notes[].points_frame")
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


_Items = list[tuple[Location, Blob]]
"""The arrays below what is written first, each with its location there."""


class _ArraySink(Protocol):
    """Takes the arrays of records."""

    def add(self, array: AnyArray) -> Blob:
        """Take one, and state where it stands."""
        ...


@dataclass(slots=True)
class _RecordWriter:
    """Writes records of a file whose clock is known.

    Attributes:
        clock: turns nanoseconds into timestamps.
        spool: takes the arrays.
        lowest: the lowest timestamp so far, 0 at most.
        rounded: how many times were not a whole number of the file's unit.
        not_numbers: how many numbers of the header were infinite or no number, which JSON cannot state.
    """

    clock: FileClock
    spool: _ArraySink
    lowest: int = 0
    rounded: int = 0
    not_numbers: int = 0
    _location: list[str | int] = field(default_factory=list)

    def write(self, values: Mapping[str, Any], record: str, items: _Items) -> dict[str, Any]:
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

    def write_part(self, name: str, values: Mapping[str, Any], record: str, items: _Items) -> dict[str, Any]:
        """Write one of several records that an object holds by name."""
        self._location.append(name)
        written = self.write(values, record, items)
        self._location.pop()
        return written

    def write_list(self, values: Any, record: str, items: _Items) -> list[Any]:
        """Write a list of records, or, as in the projections of keypoints, a list of lists of them."""
        written = []
        for index, value in enumerate(values):
            self._location.append(index)
            is_record = type(value) is dict or isinstance(value, Mapping)
            written.append((self.write if is_record else self.write_list)(value, record, items))
            self._location.pop()
        return written

    def plain(self, value: Any, items: _Items) -> Any:
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

    def _array(self, value: Blob | AnyArray, items: _Items) -> str:
        """Leave the position of an array empty, as the container has it, and note its item."""
        if isinstance(value, np.ndarray) and value.dtype.name not in DTYPES:
            raise OptionError(f"{self.location}: an array of {value.dtype}; expected numbers")
        items.append((tuple(self._location), value if isinstance(value, Blob) else self.spool.add(value)))
        return ""

    @property
    def location(self) -> str:
        """Where the writer is, for messages."""
        return format_keys(self._location)

    def plain_object(self, value: Mapping[Any, Any], items: _Items) -> dict[Any, Any]:
        """Write an object of anything."""
        return self._plain_parts({str(key): part for key, part in value.items()}, items)

    def plain_list(self, values: list[Any] | tuple[Any, ...], items: _Items) -> list[Any]:
        """Write a list of anything; plain numbers and text need no look at each."""
        types = set(map(type, values))
        if types <= _JSON_TYPES or (types <= {int, float} and _all_finite(values)):
            return list(values)
        return list(self._plain_parts(dict(enumerate(values)), items).values())

    def _plain_parts(self, parts: dict[Any, Any], items: _Items) -> dict[Any, Any]:
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


_PLAIN_WRITERS: Mapping[Any, Callable[[_RecordWriter, Any, _Items], Any]] = {
    Mapping: _RecordWriter.plain_object,
    list | tuple: _RecordWriter.plain_list,
    float: lambda writer, value, _: writer.plain_number(float(value)),
    str: lambda _, value, __: str(value),
    int: lambda _, value, __: int(value),
}


def _encode_header(header: dict[str, Any], items: _Items) -> bytes:
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


def _write_plain(writer: _RecordWriter, value: Any, _: Field, items: _Items) -> Any:
    return writer.plain(value, items)


def _write_time(writer: _RecordWriter, value: Any, _: Field, items: _Items) -> Any:
    if type(value) is not int:
        return writer.plain(value, items)
    clock = writer.clock
    writer.rounded += (value - clock.offset_ns) % clock.tick_ns != 0
    timestamp = clock.timestamp(value)
    writer.lowest = min(writer.lowest, timestamp)
    return timestamp


def _write_times(writer: _RecordWriter, value: Any, field: Field, items: _Items) -> Any:
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


def _write_duration(writer: _RecordWriter, value: Any, _: Field, items: _Items) -> Any:
    return writer.plain(writer.clock.duration(value) if type(value) in (int, float) else value, items)


def _write_durations(writer: _RecordWriter, value: Any, field: Field, items: _Items) -> Any:
    if isinstance(value, list | tuple):
        return [_write_duration(writer, duration, field, items) for duration in value]
    return writer.plain(value, items)


def _write_list(writer: _RecordWriter, value: Any, _: Field, items: _Items) -> Any:
    """Write rows of numbers as JSON: the description calls none of them binary."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        values = value.tolist()
        return values if np.isfinite(value).all() else writer.plain(values, items)
    return writer.plain(value, items)


def _write_array(writer: _RecordWriter, value: Any, field: Field, items: _Items) -> Any:
    if not isinstance(value, list | tuple):
        return writer.plain(value, items)
    try:
        return writer.plain(np.asarray(value, field.dtype), items)
    except (ValueError, TypeError, OverflowError):
        return writer.plain(value, items)


def _write_record(writer: _RecordWriter, value: Any, field: Field, items: _Items) -> Any:
    return writer.write(value, field.record, items) if isinstance(value, Mapping) else writer.plain(value, items)


def _write_records(writer: _RecordWriter, value: Any, field: Field, items: _Items) -> Any:
    if _are_records(value):
        return writer.write_list(value, field.record, items)
    return _write_record(writer, value, field, items)


def _are_records(value: Any) -> bool:
    """Whether a value is a list of records, or a list of such lists; fields of unknown types may be anything."""
    return isinstance(value, list | tuple) and all(
        type(item) is dict or isinstance(item, Mapping) or _are_records(item) for item in value
    )


def _write_record_map(writer: _RecordWriter, value: Any, field: Field, items: _Items) -> Any:
    written = {}
    for name, record in value.items():
        written[name] = writer.write_part(name, record, field.record, items)
    return written


_WRITERS: Mapping[Kind, Callable[[_RecordWriter, Any, Field, _Items], Any]] = {
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


_VERSION = "1.0"


_LAYOUT = 1
"""Number of the layout of our metadata."""


_UNIT_OF = {tick_ns: unit for unit, tick_ns in TICKS_NS.items()}


_EVERYWHERE = "sensors[], annotations[], attributes[]"


_ROUNDING = 0.5
"""How far a time is off at most where it is rounded [µs]."""


@dataclass(slots=True)
class _Contents:
    """Everything that a writer was given, arrays of frames spooled already.

    Attributes:
        drafts: the sensors, by id.
        annotations: their records.
        attributes: of the scene and its sensors.
        metadata: free fields.
        ours: fields of our entry of the metadata.
        extras: further root fields.
        time_unit: how the unit is spelt; None for the usual spelling.
    """

    drafts: dict[tuple[type, Identifier], SensorDraft] = field(default_factory=dict)
    annotations: list[dict[str, Any]] = field(default_factory=list)
    attributes: list[Mapping[str, Any]] = field(default_factory=list)
    metadata: dict[str, Any] = field(default_factory=dict)
    ours: dict[str, Any] = field(default_factory=dict)
    extras: dict[str, Any] = field(default_factory=dict)
    time_unit: str | None = None


class _Recorder:
    """Spools the arrays of a first pass over everything, and remembers where each stands."""

    def __init__(self, spool: Spool) -> None:
        self.spool = spool
        self.known: dict[int, tuple[AnyArray, Blob]] = {}

    def add(self, array: AnyArray) -> Blob:
        """Spool one array."""
        blob = self.spool.add(array)
        self.known[id(array)] = (array, blob)
        return blob


class _Replay:
    """Gives the blobs of a first pass again, each once; an array made anew is spooled anew."""

    def __init__(self, first: _Recorder) -> None:
        self._first = first

    def add(self, array: AnyArray) -> Blob:
        """Find or spool one array."""
        known = self._first.known.pop(id(array), None)
        return self._first.spool.add(array) if known is None else known[1]


def _assemble(contents: _Contents, profile: Profile, keeper: ClockKeeper, losses: Losses) -> bytes:
    """Make the header.

    Raises:
        OptionError: something cannot be held by the format.
    """
    firsts = [first for draft in contents.drafts.values() if (first := draft.first_ns()) is not None]
    if firsts:
        keeper.clock_for(min(firsts))
    recorder = _Recorder(keeper.spool)
    passed = _Pass(contents, profile, _RecordWriter(keeper.clock, recorder))
    header = passed.header()
    if passed.writer.lowest < 0:
        # a time that stands only in annotations or attributes is earlier than all frames and poses
        keeper.clock_for(passed.writer.lowest * keeper.tick_ns + keeper.clock.offset_ns)
        passed = _Pass(contents, profile, _RecordWriter(keeper.clock, _Replay(recorder)))
        header = passed.header()
    losses.add_all(passed.losses)
    return _encode_header(header, passed.items)


@dataclass(slots=True)
class _Pass:
    """One attempt at the header."""

    contents: _Contents
    profile: Profile
    writer: _RecordWriter
    losses: Losses = field(default_factory=Losses)
    items: _Items = field(default_factory=list)

    def header(self) -> dict[str, Any]:
        """Write everything; the locations of arrays are left empty."""
        clock = self.writer.clock
        header: dict[str, Any] = {
            "version": _VERSION,
            "time_unit": self.contents.time_unit or _UNIT_OF[clock.tick_ns],
            "time_offset": max(clock.offset_ns, 0) // clock.tick_ns,
        }
        header["sensors"], sensors_aside, notes = self._sensors()
        header["annotations"], annotations_aside, exact = self._annotations()
        header["attributes"], attributes_aside, exact_of_scene = self._attributes()
        header["metadata"] = self._metadata()
        ours = self._ours(
            {
                **self.contents.ours,
                "time_shift_ns": -clock.offset_ns if clock.offset_ns < 0 else None,
                "sensor_notes": notes or None,
                "attributes": attributes_aside or None,
                "exact_attributes": exact_of_scene + exact or None,
            },
            {
                "sensors": (sensors_aside, sensor_record),
                "annotations": (annotations_aside, annotation_record),
            },
        )
        if ours:
            header["metadata"][OURS] = {"layout": _LAYOUT, **ours}
        further = {name: value for name, value in self.contents.extras.items() if name not in header}
        self._count_rounding()
        return {**header, **self._written(further, "scene", ())}

    def _metadata(self) -> dict[str, Any]:
        inner: _Items = []
        written = self.writer.plain_object(self.contents.metadata, inner)
        self.items.extend((("metadata", *keys), blob) for keys, blob in inner)
        return written

    def _ours(self, fields: Mapping[str, Any], aside: Mapping[str, tuple[list[Any], Any]]) -> dict[str, Any]:
        """Write our entry of the metadata, and in it what the format or the profile has no field for."""
        location: Location = ("metadata", OURS)
        written = self._written(fields, OURS, location)
        for name, (records, record_of) in aside.items():
            if records:
                written[name] = self._list(records, (*location, name), record_of)
        return written

    def _written(self, record: Mapping[str, Any], name: str, location: Location) -> dict[str, Any]:
        inner: _Items = []
        written = self.writer.write(record, name, inner)
        self.items.extend(((*location, *keys), blob) for keys, blob in inner)
        return written

    def _list(self, records: list[dict[str, Any]], location: Location, record_of: Any) -> list[dict[str, Any]]:
        return [
            self._written(record, record_of(record["type"]), (*location, index)) for index, record in enumerate(records)
        ]

    def _sensors(self) -> tuple[list[Any], list[dict[str, Any]], list[dict[str, Any]]]:
        """Write the sensors; give those that must stand aside, and the notes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        notes: list[dict[str, Any]] = []
        for draft in self.contents.drafts.values():
            record = draft.record(self.writer.clock, self.losses)
            obstacle = self.profile.sensor_obstacle(record, self.writer.clock)
            (kept if obstacle is None else aside).append(record)
            if obstacle is not None:
                self.losses.add(draft.location, obstacle, kept="metadata.sceneloom.sensors")
            if draft.note:
                notes.append({"id": draft.id, **draft.note})
        return self._list(kept, ("sensors",), sensor_record), aside, notes

    def _annotations(self) -> tuple[list[Any], list[dict[str, Any]], list[Mapping[str, Any]]]:
        """Write the annotations; give those that must stand aside, and the exact attributes."""
        kept: list[dict[str, Any]] = []
        aside: list[dict[str, Any]] = []
        exact: list[Mapping[str, Any]] = []
        for record in self.contents.annotations:
            simple, exact_records = self._simplified(record)
            obstacle = self.profile.annotation_obstacle(simple)
            if obstacle is None:
                kept.append(simple)
                exact += exact_records
            else:
                aside.append(record)
                where = "metadata.sceneloom.annotations"
                self.losses.add(f"annotations[{record['type']}]", obstacle, kept=where)
        self._note_exact(exact, "annotations[].attributes[]")
        return self._list(kept, ("annotations",), annotation_record), aside, exact

    def _simplified(self, record: dict[str, Any]) -> tuple[dict[str, Any], list[Mapping[str, Any]]]:
        attributes = record.get("attributes")
        if self.profile.exact_attributes or not isinstance(attributes, list | tuple):
            return record, []
        simple, exact = simplified_attributes(attributes, record["id"])
        return {**record, "attributes": simple}, exact

    def _attributes(self) -> tuple[list[Any], list[Mapping[str, Any]], list[Mapping[str, Any]]]:
        """Write the scene's attributes; give those that must stand aside, and the exact ones."""
        if self.profile.exact_attributes:
            return self._written({"attributes": self.contents.attributes}, "scene", ())["attributes"], [], []
        fitting: list[Mapping[str, Any]] = []
        aside: list[Mapping[str, Any]] = []
        for attribute in self.contents.attributes:
            (fitting if attribute_fits(thousandths(attribute)) else aside).append(attribute)
        simple, exact = simplified_attributes(fitting, None)
        what = "Scale's loader takes text and integers only"
        self.losses.add("attributes[]", what, count=len(aside), kept="metadata.sceneloom.attributes")
        self._note_exact(exact, "attributes[]")
        return self._written({"attributes": simple}, "scene", ())["attributes"], aside, exact

    def _note_exact(self, exact: list[Mapping[str, Any]], where: str) -> None:
        what = "made integers (fractions in thousandths), static ones with one time stamp"
        self.losses.add(where, what, count=len(exact), kept="metadata.sceneloom.exact_attributes")

    def _count_rounding(self) -> None:
        what = "times rounded to whole microseconds, halves to even: at most 0.5 µs off"
        self.losses.add(
            _EVERYWHERE, what, count=self.writer.rounded, support=Support.CONVERTED, largest_error=_ROUNDING
        )
        what = "numbers that are infinite or none, written as null"
        self.losses.add(_EVERYWHERE, what, count=self.writer.not_numbers)


def _with_euler(contents: _Contents) -> None:
    """Record how the angles of cuboids are meant, where there are cuboids and nothing says it."""
    if any(record["type"] == "cuboid" for record in contents.annotations):
        contents.ours = {**DEFAULT_EULER, **contents.ours}


_Frame = LidarFrame | RadarFrame | CameraImage


_RESERVED = frozenset(
    {
        "layout",
        "time_shift_ns",
        "sensor_notes",
        "sensors",
        "annotations",
        "attributes",
        "trajectories",
        "exact_attributes",
        "warnings",
    }
)


_ROOT = frozenset({"version", "time_unit", "time_offset"})


_PER_FRAME, _PER_POSE, _PER_ANNOTATION = 2048, 180, 2048


_LEAST_HEADER, _UNKNOWN_HEADER = 1 << 17, 1 << 20


@dataclass(frozen=True, slots=True)
class _OpenFile:
    """What is there between opening and finishing a file."""

    spool: Spool
    keeper: ClockKeeper
    clouds: CloudWriter
    images: ImageWriter


class SceneWriter:
    """Writes a scene file sensor by sensor, frame by frame; memory holds the header and the frame at hand.

    ```python
    with SceneWriter("drive.sfs") as writer:
        writer.add_sensor(LidarSensor("top", LazyFrames.of([], []), points_frame=PointsFrame.WORLD))
        for timestamp_ns, positions in sweeps:
            writer.add_frame("top", LidarFrame(timestamp_ns, LidarPoints(positions)))
        writer.set_poses("top", Poses(timestamps_ns, positions_world, quaternions_xyzw))
    ```

    The file is there, whole, when the block ends without an error; else nothing is there.

    Attributes:
        losses: what the file cannot hold; empty before `finish`.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        profile: str = "sfs",
        time_unit: str = "microseconds",
        time_offset_ns: int | None = None,
        usual_offset_ns: int | None = None,
        first_ns: int | None = None,
        frame_count: int = 0,
        metadata: Mapping[str, Any] | None = None,
        verbatim: bool = False,
    ) -> None:
        """Check what is asked for; the file is opened on entering the context.

        Args:
            path: the file to be made.
            overwrite: whether a file there may be replaced.
            profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
            time_unit: "microseconds" or "nanoseconds".
            time_offset_ns: the absolute time of the file's zero [ns]; None to choose it by the earliest time.
            usual_offset_ns: an offset to begin with; unlike `time_offset_ns` it moves if something earlier comes.
            first_ns: the earliest time that will come, where it is known [ns]; saves moving the offset later.
            frame_count: how many frames will come, where it is known; saves copying arrays behind the header.
            metadata: free fields of the scene.
            verbatim: the contents come from a file of this format: frame timestamps and far positions pass
                unchanged.

        Raises:
            OptionError: a value is not one that can be followed.
        """
        self._path, self._overwrite, self._verbatim = Path(path), overwrite, verbatim
        self._profile = profile_named(profile)
        if time_unit not in self._profile.time_units:
            known = ", ".join(self._profile.time_units)
            raise OptionError(f"time_unit {time_unit!r}; expected {known} in profile {profile!r}")
        self._tick_ns = TICKS_NS[time_unit]
        self._fixed_offset_ns, self._frame_count = time_offset_ns, frame_count
        self._usual_offset_ns = usual_offset_ns
        if usual_offset_ns is None and first_ns is not None:
            self._usual_offset_ns = chosen_offset_ns(first_ns)
        self._contents = _Contents()
        self._cameras: dict[tuple[type, Identifier], CameraDraft] = {}
        self._unfused: list[Mapping[str, Any]] = []
        self._losses = Losses()
        self._stack = ExitStack()
        self._open: _OpenFile | None = None
        self.losses = LossReport()
        self.set_metadata(metadata or {})

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            draft = stack.enter_context(replacing(self._path, overwrite=self._overwrite))
            spool = stack.enter_context(Spool(draft, reserve=self._expected_header))
            fixed = self._fixed_offset_ns is not None
            offset_ns = self._fixed_offset_ns if fixed else self._usual_offset_ns
            keeper = ClockKeeper(self._tick_ns, offset_ns, fixed, spool, self._contents.drafts.values())
            self._open = _OpenFile(
                spool,
                keeper,
                CloudWriter(spool, self._profile, self._losses, self._verbatim, keeper),
                ImageWriter(spool, draft.parent, self._losses, self._verbatim),
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._open = None
            self._stack.__exit__(kind, error, trace)
        elif self._open is not None:
            self.finish()

    def finish(self) -> LossReport:
        """Complete the file and put it in its location; leaving the context does it, too.

        Raises:
            OptionError: something cannot be held by the format.
            OutputError: the file cannot be written.
        """
        opened = self._opened()
        with self._stack.pop_all():
            self._open = None
            for key, camera in self._cameras.items():
                note = note_losses(camera, self._losses)
                if note is not None:
                    self._contents.drafts[key].note["images"] = note
            _with_euler(self._contents)
            self._contents.ours["unfused"] = self._unfused or None
            with collector_paused():
                header = _assemble(self._contents, self._profile, opened.keeper, self._losses)
            opened.spool.finish(header)
        self.losses = LossReport.of(self._losses.all())
        return self.losses

    def add_sensor(self, sensor: Sensor) -> None:
        """Add a sensor, and write the frames or images that it holds; more may follow with `add_frame`.

        Raises:
            OptionError: its id stands in the file already, or something in it cannot be held by the format.
            DataError: a frame or image of it cannot be read.
        """
        opened, key = self._opened(), key_of(sensor.id)
        check_new(self._contents.drafts, sensor.id)
        any_distortion = self._profile.any_distortion and self._verbatim
        draft = _draft_of(sensor, self._losses, any_distortion=any_distortion)
        self._contents.drafts[key] = draft
        if isinstance(sensor, CameraSensor):
            self._cameras[key] = CameraDraft(draft, ImageNotesWriter.empty(sensor.camera))
            opened.images.add_sensor(self._cameras[key], sensor)
        elif isinstance(sensor, LidarSensor | RadarSensor):
            for frame in sensor.frames:
                self.add_frame(sensor.id, frame)

    def add_frame(self, sensor_id: Identifier, frame: _Frame) -> None:
        """Write one more frame of a lidar or radar, or one more image of a camera without a video.

        Raises:
            OptionError: the sensor takes no such frame, positions lie too far away, or times cannot be held.
        """
        opened, draft = self._opened(), self._draft(sensor_id)
        if isinstance(frame, LidarFrame) and draft.type == "lidar":
            opened.clouds.add_lidar_frame(draft, frame)
        elif isinstance(frame, RadarFrame) and draft.type == "radar":
            opened.clouds.add_radar_frame(draft, frame)
        elif isinstance(frame, CameraImage) and draft.type == "camera" and draft.streamed:
            opened.images.add_image(self._cameras[type(sensor_id), sensor_id], frame)
        else:
            held = "a video" if draft.type == "camera" else f"a {draft.type}"
            raise OptionError(f"{draft.location} is {held}; it takes no {type(frame).__name__}")

    def add_unfused(self, sensor_id: Identifier, frame: LidarFrame, reason: str) -> None:
        """Keep a sweep that could not be brought into the world, in its sensor's frame, under our metadata.

        Raises:
            OptionError: the sensor is not in the file.
        """
        draft = self._draft(sensor_id)
        points = self._opened().clouds.unfused_points(frame.points)
        record = {
            "sensor_id": draft.id,
            "timestamp_ns": frame.timestamp_ns,
            "reason": reason,
            "points": points,
        }
        self._unfused.append(record)
        kept = "metadata.sceneloom.unfused"
        # what stands behind a colon differs from sweep to sweep
        why = reason.partition(":")[0]
        self._losses.add(f"{draft.location}.frames[]", f"left out of the frames: {why}", kept=kept)

    def set_poses(self, sensor_id: Identifier, poses: Poses) -> None:
        """Report where a sensor was, in the frame that its `coordinates` name.

        Raises:
            OptionError: the sensor is not in the file.
        """
        self._draft(sensor_id).poses = poses

    def add_annotation(self, annotation: Annotation) -> None:
        """Add an annotation.

        Raises:
            OptionError: a number of it is not finite.
        """
        if isinstance(annotation, CameraCalibration):
            any_model = self._profile.any_distortion
            annotation = _with_written_camera_model(annotation, self._losses, any_model=any_model)
        self._contents.annotations.append(encode_annotation(annotation))

    def set_metadata(self, fields: Mapping[str, Any]) -> None:
        """Add free fields; those under "sceneloom" join ours.

        Raises:
            OptionError: a field under "sceneloom" is one that the writer fills itself.
        """
        ours = dict(fields.get(OURS) or {})
        taken = sorted(_RESERVED.intersection(ours))
        if taken:
            raise OptionError(f"metadata.{OURS}.{taken[0]} is filled by the writer; expected another name")
        self._unfused.extend(ours.pop("unfused", []))
        self._contents.metadata.update({name: value for name, value in fields.items() if name != OURS})
        self._contents.ours.update(ours)

    def spell_time_unit(self, spelling: str) -> None:
        """Write the unit of time by another of its names, as the file that a scene comes from has it."""
        self._contents.time_unit = spelling

    def add_scene(self, scene: Scene) -> None:
        """Add everything that a scene holds.

        Raises:
            OptionError: something in it cannot be held by the format.
            DataError: a frame or image cannot be read.
        """
        self.set_metadata(scene.metadata)
        self._contents.extras.update({name: v for name, v in scene.extras.items() if name not in _ROOT})
        self._contents.attributes.extend(map(attribute_record, scene.attributes))
        # what was repaired of the source is in order in the file; a correction that was applied stays one
        reported = [
            warning
            for warning in scene.warnings
            if self._verbatim or warning.kind != WarningKind.REPAIRED or warning.code == "correction-applied"
        ]
        if reported:
            self._contents.ours["warnings"] = [_warning_record(warning, scene.source) for warning in reported]
        for annotation in scene.annotations:
            self._add_read(annotation, scene)
        self._add_trajectories(scene)
        for sensor in scene.sensors:
            if isinstance(sensor, DepthCameraSensor):
                self._lose_depth(sensor)
            else:
                self.add_sensor(sensor)

    def _lose_depth(self, sensor: DepthCameraSensor) -> None:
        what = f"left out, with {len(sensor.frames)} depth images: the format has no cameras that measure depth"
        self._losses.add(f"sensors[{sensor.id}]", what)

    def _add_read(self, annotation: Annotation, scene: Scene) -> None:
        """Add an annotation; what cannot be held of one that was read from a file is a fault of that file."""
        try:
            self.add_annotation(annotation)
        except OptionError as error:
            if scene.format not in FORMATS:
                raise
            raise DataError(scene.source, "", str(error)) from None

    def _add_trajectories(self, scene: Scene) -> None:
        odometry = [sensor for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
        records = [_trajectory_record(name, trajectory, odometry) for name, trajectory in scene.trajectories.items()]
        alone = sum("sensor_id" not in record for record in records)
        what, kept = "the format knows odometry sensors only", "metadata.sceneloom.trajectories"
        self._losses.add("trajectories[]", what, count=alone, kept=kept)
        reported = [{"name": str(sensor.id), "sensor_id": sensor.id} for sensor in odometry]
        if records and records != reported:
            self._contents.ours["trajectories"] = records

    def _opened(self) -> _OpenFile:
        if self._open is None:
            raise OptionError(f"{self._path}: not open; use the writer in a `with` block, before `finish`")
        return self._open

    def _draft(self, sensor_id: Identifier) -> SensorDraft:
        draft = self._contents.drafts.get((type(sensor_id), sensor_id))
        if draft is None:
            known = ", ".join(repr(identifier) for _, identifier in self._contents.drafts)
            raise OptionError(f"no sensor {sensor_id!r} in the file; it has {known or 'none'}")
        return draft

    def _expected_header(self) -> int:
        """About how many bytes the header will take, by what is known of the scene now."""
        contents = self._contents
        poses = sum(0 if d.poses is None else len(d.poses.timestamps_ns) for d in contents.drafts.values())
        frames = max(self._frame_count, sum(len(d.frames or ()) for d in contents.drafts.values()))
        expected = frames * _PER_FRAME + poses * _PER_POSE + len(contents.annotations) * _PER_ANNOTATION
        return max(expected, _LEAST_HEADER if self._frame_count else _UNKNOWN_HEADER)


_LATEST_START_NS = {"sfs": None, "scale": 90_000_000_000}


def write_scene(
    scene: Scene,
    path: str | Path,
    *,
    overwrite: bool = False,
    profile: str = "sfs",
    time_unit: str | None = None,
    time_offset_ns: int | None = None,
) -> LossReport:
    """Write a scene to a file.

    Args:
        scene: any scene; one that was read from a file of this format keeps its unit, offset and timestamps.
        path: the file to be made.
        overwrite: whether a file there may be replaced.
        profile: "sfs", or "scale" for a file that Scale's own library loads and validates.
        time_unit: "microseconds" or "nanoseconds"; None for the scene's own, else microseconds.
        time_offset_ns: the absolute time of the file's zero [ns]; None to choose it.

    Returns:
        What the file cannot hold.

    Raises:
        OptionError: a value is not one that can be followed, or something cannot be held by the format.
        DataError: a frame or image cannot be read.
        OutputError: the file exists, or cannot be written.
    """
    times_ns = list(_known_times(scene))
    unit = time_unit or _own_unit(scene, profile)
    from_sfs = scene.format == "sfs"
    own_spelling = scene.extras.get("time_unit") if from_sfs and time_unit is None and profile == "sfs" else None
    keeps_offset = from_sfs and time_offset_ns is None and _offset_serves(scene, times_ns, unit, profile)
    with SceneWriter(
        path,
        overwrite=overwrite,
        profile=profile,
        time_unit=unit,
        time_offset_ns=time_offset_ns,
        usual_offset_ns=scene.time_offset_ns if keeps_offset else None,
        first_ns=min(times_ns, default=None),
        frame_count=sum(len(s.frames) for s in scene.sensors if isinstance(s, LidarSensor | RadarSensor)),
        verbatim=from_sfs,
    ) as writer:
        writer.add_scene(scene)
        if isinstance(own_spelling, str) and READABLE_TICKS_NS.get(own_spelling) == TICKS_NS[unit]:
            writer.spell_time_unit(own_spelling)
    return writer.losses


def _own_unit(scene: Scene, profile: str) -> str:
    own = scene.extras.get("time_unit")
    if profile == "scale" or not isinstance(own, str) or own not in READABLE_TICKS_NS:
        return "microseconds"
    return next(unit for unit, tick_ns in TICKS_NS.items() if tick_ns == READABLE_TICKS_NS[own])


def _offset_serves(scene: Scene, times_ns: list[int], unit: str, profile: str) -> bool:
    """Whether the offset of the file that the scene comes from can stay."""
    offset_ns, tick_ns = scene.time_offset_ns, TICKS_NS[unit]
    if offset_ns % tick_ns or not times_ns:
        return offset_ns % tick_ns == 0
    latest_start_ns = _LATEST_START_NS.get(profile)
    starts_late = latest_start_ns is not None and min(times_ns) - offset_ns > latest_start_ns
    wraps = tick_ns > 1 and (max(times_ns) - offset_ns) // tick_ns > UINT32_MAX
    return offset_ns <= min(times_ns) and not starts_late and not wraps


def _known_times(scene: Scene) -> Iterator[int]:
    """First and last of all times that are known without reading a frame [ns]."""
    for sensor in scene.sensors:
        if isinstance(sensor, LidarSensor | RadarSensor) and len(sensor.frames):
            times = sensor.frames.timestamps_ns
            yield from (int(times.min()), int(times.max()))
        if isinstance(sensor, CameraSensor) and len(sensor.images):
            times = sensor.images.timestamps_ns
            yield from (int(times.min()), int(times.max()))
        if isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | OdometrySensor):
            poses = sensor.poses
            if poses is not None and not poses.static:
                yield from (poses.start_ns, poses.stop_ns)
    for annotation in scene.annotations:
        for times in _times_of(annotation):
            if len(times):
                yield from (int(times.min()), int(times.max()))


def _times_of(annotation: Annotation) -> list[Int64Array]:
    """The times of an annotation's paths, or of its beginning."""
    if isinstance(annotation, CuboidAnnotation | Box2DAnnotation | ShapeAnnotation):
        return [annotation.path.timestamps_ns]
    if isinstance(annotation, PointsAnnotation):
        return [path.timestamps_ns for path in annotation.paths]
    if isinstance(annotation, EventAnnotation):
        return [np.array([annotation.start_ns], np.int64)]
    if isinstance(annotation, LocalizationAdjustment | CameraCalibration):
        poses = annotation.poses
        return [] if poses is None or poses.static else [poses.timestamps_ns]
    return []
