"""A folder with a `rig.toml` as a scene: its files and their timestamps, frames, trajectories and sensors."""

import os
import re
import tomllib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from enum import StrEnum
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path, PurePosixPath, PureWindowsPath
from threading import Lock
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, UInt8Array, read_only
from sceneloom.cameras.camera import MODEL_ALIASES, MODELS, OPENCV_LENGTHS, OPENCV_NAMES, Camera, from_opencv
from sceneloom.cameras.projection import check_camera
from sceneloom.errors import CalibrationError, DataError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import open_file, read_bytes, why_no_file
from sceneloom.formats.base.images import IMAGE_SUFFIXES, ImageReader, images_image_size
from sceneloom.formats.base.poses import GREATEST_NORM_ERROR, PoseRows, default_poses
from sceneloom.formats.base.text_tables import (
    FARTHEST_NS,
    FILE_COLUMNS,
    GNSS_COLUMNS,
    PLACEHOLDERS,
    POSE_COLUMNS,
    TIME_COLUMNS,
    UNITS_NS,
    Table,
    TimestampError,
    line_timestamps,
    parse_timestamp,
    pick_columns,
    read_table,
)
from sceneloom.formats.points.cloud import ALIASES, ROW_ALIASES, FieldLayout, find_roles
from sceneloom.formats.points.files import CLOUD_SUFFIXES, cloud_suffix, default_layout, read_cloud
from sceneloom.formats.points.mapping import (
    FARTHEST_WORLD,
    IntensityScale,
    PointMapping,
    PointTimes,
    SweepReader,
    detect_scale,
)
from sceneloom.formats.rig.spec import MANIFEST, natural_key
from sceneloom.formats.rig_files.matching import RigSensor, ego_frame, match_cameras, match_frames
from sceneloom.formats.rig_files.reader import Rig
from sceneloom.formats.video.reader import VideoReader, open_video, open_whole_or_left
from sceneloom.geometry.euler import ORDERS, rotation_from_cuboid_angles
from sceneloom.geometry.rigid import (
    GREATEST_ERROR,
    SILENT_ERROR,
    RigidTransform,
    matrix_from_quaternion,
    multiply_quaternions,
    nearest_rotation,
    normalise_quaternion,
    quaternion_from_matrix,
    rotate_vectors,
)
from sceneloom.scene.cameras import LONGEST_ROLL_S, CameraImage, CameraSensor, VideoContent
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, VectorSamples
from sceneloom.scene.poses import Poses, Trajectory, poses_along
from sceneloom.scene.scene import Scene, Sensor, frame_times, with_assumed_models
from sceneloom.scene.types import NO_FIELDS, PointsFrame
from sceneloom.warnings import WarningKind

_Record = dict[str, Any]
"""A record as read: values by name, absent ones left out."""


class Kind(StrEnum):
    """What a field holds, in words for messages."""

    TEXT = "text in quotes"
    TEXTS = "text in quotes, or a list of such texts"
    CHOICE = "one of a few words"
    FLAG = "true or false"
    INTEGER = "a whole number"
    NUMBER = "a number"
    SECONDS = "seconds as a number"
    VECTOR = "a list of numbers"
    MATRIX = "a list of rows of numbers"
    NUMBERS = "a list of numbers, or a table of numbers by name"
    NAMES = "a table of texts"
    AXES = "a word, three axes in one text, or a table of right, down, forward"
    RECORD = "a table"
    RECORDS = "a list of tables"


@dataclass(frozen=True, slots=True)
class _Field:
    """One field of a record."""

    name: str
    kind: Kind
    about: str  # what it means, for people
    required: bool = False  # a manifest without it is at fault
    unit: str = ""
    record: str = ""  # of a RECORD or RECORDS
    choices: tuple[str, ...] = ()  # the words of a CHOICE
    shapes: tuple[tuple[int, ...], ...] = ()  # lengths of a VECTOR, as (3,), or sizes of a MATRIX, as (4, 4)
    positive: bool = False  # the number has to be above zero


_SENSOR_TYPES = ("lidar", "camera", "imu", "gnss")
_TYPE = _Field("type", Kind.CHOICE, "kind of the sensor", required=True, choices=_SENSOR_TYPES)
_ROOT = _Field("root", Kind.TEXT, "folder of the files, relative to the manifest; left out: the manifest's `root`")
_OFFSET = _Field("time_offset_s", Kind.SECONDS, "added to every timestamp of the sensor", unit="s")
_UNIT = _Field("unit", Kind.CHOICE, "unit of the numbers", choices=tuple(UNITS_NS))
_TIMES = _Field("times", Kind.RECORD, "where the timestamps come from", required=True, record="times")
_FILES = _Field("files", Kind.TEXTS, "pattern of the files below `root`: `lidar/*.pcd`, or a list of patterns")
_CSV_FILE = _Field("file", Kind.TEXT, "the CSV file below `root`", required=True)
_COLUMNS = _Field("columns", Kind.NAMES, "column of the file by what it is, where it has another name")

_MOUNTED = (
    _Field("id", Kind.TEXT, "name of the sensor in the scene, which is unique", required=True),
    _TYPE,
    _Field("frame", Kind.TEXT, "name of the sensor's own frame; left out: its id"),
    _Field("extrinsic", Kind.RECORD, "pose of the sensor, in place of `[[transforms]]`", record="extrinsic"),
    _ROOT,
    _OFFSET,
)

_ROTATIONS = (
    _Field("translation", Kind.VECTOR, "origin of `from` seen in `to`", unit="m", shapes=((3,),)),
    _Field("quaternion_xyzw", Kind.VECTOR, "rotation, scalar last", shapes=((4,),)),
    _Field("quaternion_wxyz", Kind.VECTOR, "rotation, scalar first", shapes=((4,),)),
    _Field("rotation_matrix", Kind.MATRIX, "rotation, row by row", shapes=((3, 3),)),
    _Field("euler_deg", Kind.VECTOR, "angles about x, y and z, whatever the order", unit="°", shapes=((3,),)),
    _Field("euler_order", Kind.CHOICE, "order of the product: zyx is Rz·Ry·Rx", choices=ORDERS),
    _Field("matrix", Kind.MATRIX, "all in one: [R t; 0 0 0 1], row by row", unit="m", shapes=((4, 4), (3, 4))),
)

RECORDS: Mapping[str, tuple[_Field, ...]] = MappingProxyType({
    "rig": (
        _Field("ego", Kind.TEXT, "the frame that the trajectory moves through the world; left out: base"),
        _Field("root", Kind.TEXT, "folder of all files, absolute or relative to the manifest; left out: its own"),
        _Field("name", Kind.TEXT, "title of the drive"),
        _Field("transforms", Kind.RECORDS, "transforms between the frames", record="transform"),
        _Field("sensors", Kind.RECORDS, "the sensors", required=True, record="sensor"),
        _Field("trajectories", Kind.RECORDS, "trajectories, the default first", record="trajectory"),
    ),
    "transform": (
        _Field("from", Kind.TEXT, "frame whose points go in", required=True),
        _Field("to", Kind.TEXT, "frame that they come out in: p_to = R·p_from + translation", required=True),
        *_ROTATIONS,
    ),
    "extrinsic": (
        _Field("to", Kind.TEXT, "takes points of the sensor's frame into this frame: p_to = R·p + translation"),
        _Field("from", Kind.TEXT, "in place of `to`: takes points of this frame into the sensor's frame"),
        *_ROTATIONS,
    ),
    "sensor lidar": (
        *_MOUNTED,
        replace(_FILES, required=True),
        _TIMES,
        _Field("timestamp", Kind.CHOICE, "moment of the sweep that the timestamp means; left out: start",
            choices=("start", "middle", "end")),
        _Field("sweep_s", Kind.SECONDS, "duration of a sweep; left out: the median interval", unit="s", positive=True),
        _Field("deskewed", Kind.FLAG, "true: all points are as at the timestamp, their times are not used"),
        _Field("points_in", Kind.TEXT, "frame of the points, or `world`; left out: the sensor's own"),
        _Field("point_times", Kind.RECORD, "meaning of the times of single points", record="point_times"),
        _Field("fields", Kind.TEXTS, "columns of `.bin`, or of rows in `.npz`: `x`, `ring:uint16`, `_:uint8`"),
        _Field("dtype", Kind.TEXT, "type of the `fields` that name none; left out: float32"),
        _Field("use", Kind.NAMES, "column by what it is: x y z intensity ring red green blue"),
        _Field("intensity_max", Kind.NUMBER, "intensity that becomes 255; left out: taken from the first file",
            positive=True),
        _Field("model", Kind.TEXT, "name of the device"),
    ),
    "sensor camera": (
        *_MOUNTED,
        _FILES,
        _Field("video", Kind.TEXT, "a video below `root`, in place of `files`"),
        _TIMES,
        _Field("axes", Kind.AXES, "directions of the axes of the camera's frame; left out: optical"),
        _Field("shutter_roll_s", Kind.SECONDS, unit="s", positive=True,
            about="time of a rolling shutter from the first row to the last; left out: a global shutter"),
        _Field("shutter_left_to_right", Kind.FLAG, "true: it takes columns from the left, not rows"),
        _Field("camera_model", Kind.RECORD, "the intrinsics", required=True, record="camera_model"),
    ),
    "sensor imu": (
        *_MOUNTED,
        _CSV_FILE,
        _COLUMNS,
        _UNIT,
        _Field("gyroscope_unit", Kind.CHOICE, "left out: rad/s", choices=("rad/s", "deg/s")),
        _Field("accelerometer_unit", Kind.CHOICE, "left out: m/s2", choices=("m/s2", "g")),
    ),
    "sensor gnss": (*_MOUNTED, _CSV_FILE, _COLUMNS, _UNIT),
    "times": (
        _Field("pattern", Kind.TEXT, "timestamps in the file names: `{ns}`, `{s}_{ns}`, `{index}` with a rate"),
        _Field("csv", Kind.TEXT, "timestamps in a CSV file below `root`"),
        _Field("column", Kind.TEXT, "column of the timestamps in the CSV; left out: timestamp, time, t, …"),
        _Field("file_column", Kind.TEXT, "column of the file names in the CSV; left out: file, filename, … if any"),
        _Field("lines", Kind.TEXT, "text file below `root` with one timestamp per line: numbers or dates"),
        _Field("rate_hz", Kind.NUMBER, "files per second, at even intervals", unit="1/s", positive=True),
        _Field("start_s", Kind.SECONDS, "timestamp of index 0, or of a video's first image; left out: 0", unit="s"),
        _Field("container", Kind.FLAG, "true: the times that the video itself has"),
        _UNIT,
    ),
    "point_times": (
        _Field("field", Kind.TEXT, "column of the times; left out: time, t, timestamp, …"),
        replace(_UNIT, about="unit of the column", required=True),
        _Field("relative_to", Kind.CHOICE, choices=("timestamp", "start", "clock"),
            about="zero of the times: the file's timestamp (if left out), the sweep's start, or that of the clock"),
    ),
    "camera_model": (
        _Field("model", Kind.TEXT, "projection model; left out: pinhole, or brown_conrady with coefficients"),
        _Field("width", Kind.INTEGER, "image size of the calibration; left out: that of the images", unit="px",
            positive=True),
        _Field("height", Kind.INTEGER, "the same", unit="px", positive=True),
        _Field("fx", Kind.NUMBER, "focal length", unit="px", positive=True),
        _Field("fy", Kind.NUMBER, "focal length; left out: fx", unit="px", positive=True),
        _Field("cx", Kind.NUMBER, "principal point; (0, 0) is the centre of the first pixel", unit="px"),
        _Field("cy", Kind.NUMBER, "the same", unit="px"),
        _Field("K", Kind.MATRIX, "in place of fx fy cx cy", unit="px", shapes=((3, 3),)),
        _Field("P", Kind.MATRIX, "in place of them: K·[I t], as KITTI and ROS have it", unit="px", shapes=((3, 4),)),
        _Field("coefficients", Kind.NUMBERS, "distortion: a list in OpenCV's order, or by name"),
        _Field("undistorted", Kind.FLAG, "true: the images are rectified, so the coefficients are not used"),
    ),
    "trajectory": (
        _Field("name", Kind.TEXT, "name of the trajectory; left out: pose"),
        _Field("file", Kind.TEXT, "the file below `root`", required=True),
        _Field("form", Kind.CHOICE, "format of the file", required=True, choices=("tum", "kitti", "csv")),
        _Field("frame", Kind.TEXT, "the frame whose trajectory it is; left out: the ego's"),
        _Field("world_axes", Kind.CHOICE, "axes of its world; left out: z_up", choices=("z_up", "optical")),
        _Field("times", Kind.TEXT, "timestamps of a kitti file: a text file, one line per pose"),
        _COLUMNS,
        _UNIT,
        _ROOT,
        _OFFSET,
    ),
})  # fmt: skip
"""Every record by name, its fields in the order of the documentation."""

_NAMED = (("sensors", "id"), ("trajectories", "name"))
"""The lists whose tables have names of their own, and the field of the name."""

_FILL_IN = "still to be filled in"  # how the problem begins where a template's `nan` still stands
_SHOWN_LINES = 20
_FARTHEST_S = Decimal("9.2e9")
_LARGEST = 1e15
_LARGEST_MANIFEST = 16_000_000
_LARGEST_EXPONENT = 40


class Faults:
    """The faults found so far, each with its location in the manifest.

    Attributes:
        file: the manifest, for messages.
        labels: ids and names of the parts, by location ("sensors[1]").
    """

    def __init__(self, file: object) -> None:
        """Begin without faults."""
        self.file = file
        self.labels: dict[str, str] = {}
        self._errors: list[DataError] = []

    def add(self, location: str, problem: str) -> None:
        """Note a fault of the manifest."""
        self._errors.append(DataError(self.file, location, problem))

    @contextmanager
    def catching(self, location: str) -> Iterator[None]:
        """Note what goes wrong in the block instead of raising it; errors of other files keep their location."""
        try:
            yield
        except DataError as error:
            self._errors.append(error)
        except SceneloomError as error:
            self.add(location, str(error))

    def raise_all(self) -> None:
        """Raise one error that reports all faults, if there is one.

        Raises:
            DataError: the only fault, or the first with all others below it.
        """
        errors = [DataError(e.file, self._labelled(e), e.problem) for e in self._errors]
        if len(errors) == 1:
            raise errors[0]
        lines, open_fields = [], dict[str, list[str]]()
        for error in errors:
            if error.problem.startswith(_FILL_IN):
                part, _, name = error.location.partition(".")
                open_fields.setdefault(part, []).append(name)
            elif error.file == str(self.file):
                lines.append(": ".join(filter(None, (error.location, error.problem))))
            else:
                lines.append(str(error))
        lines += [f"{part}: {_FILL_IN}: {', '.join(names)}" for part, names in open_fields.items()]
        if len(lines) > _SHOWN_LINES:
            lines[_SHOWN_LINES:] = [f"… and {len(lines) - _SHOWN_LINES} more lines"]
        if errors:
            raise DataError(self.file, "", "\n  ".join([f"{len(errors)} faults", *lines]))

    def _labelled(self, error: DataError) -> str:
        part, dot, rest = error.location.partition(".")
        known = part in self.labels and error.file == str(self.file)
        return f"{part} ({self.labels[part]}){dot}{rest}" if known else error.location


@dataclass(frozen=True, slots=True)
class _Manifest:
    """A manifest without faults in its fields: the file, and its record."""

    path: Path
    record: _Record

    @property
    def ego(self) -> str:
        """The frame that moves through the world."""
        return str(self.record.get("ego", "base"))

    def faults(self) -> Faults:
        """A collection of faults that knows the names of the parts."""
        faults = Faults(self.path)
        for name, key in _NAMED:
            faults.labels.update({location: record[key] for location, record in self.records(name) if key in record})
        return faults

    def records(self, name: str) -> list[tuple[str, _Record]]:
        """The tables of a list, each with its location."""
        return [(f"{name}[{k}]", record) for k, record in enumerate(self.record.get(name, []))]


def _read_manifest(path: Path, rig: Rig | None = None) -> _Manifest:
    """Read a manifest, and what a rig adds to it."""
    raw = _parse(path)
    if rig is not None:
        _add_rig(raw, rig)
    faults = Faults(path)
    manifest = _Manifest(path, read_record(raw, "rig", "", faults))
    for name, key in _NAMED:
        seen: dict[str, str] = {}
        for location, record in manifest.records(name):
            if record.get(key) in seen:
                faults.add(f"{location}.{key}", f"{record[key]!r} is also that of {seen[record[key]]}")
            elif key in record:
                seen[record[key]] = location
    if manifest.record.get("sensors") == []:
        faults.add("sensors", "an empty list; expected at least one `[[sensors]]`")
    faults.raise_all()
    return manifest


def _add_rig(raw: _Record, rig: Rig) -> None:
    """Put the transforms and camera models of a rig into a manifest, as if they stood there."""
    tables = [one for one in raw.get("sensors") or [] if isinstance(one, dict) and isinstance(one.get("id"), str)]
    known = [RigSensor(one["id"], one.get("type") == "camera", str(one.get("frame", ""))) for one in tables]
    cameras, ego = match_cameras(rig, known), str(raw.get("ego", "base"))
    if rig.transforms or not cameras:
        transforms = match_frames(rig, known, cameras, [ego])
        top = ego_frame(rig, transforms)
        edges = [(one.child, one.parent, one.parent_from_child) for one in transforms]
        if top is not None and ego not in rig.frames:
            edges.append((top, ego, RigidTransform.identity()))
            message = f"frame {top!r} is taken as the manifest's ego {ego!r}; state another with `--rig-name ego=FRAME`"
            rig.ledger.note(WarningKind.ASSUMED, "rig-ego-taken", rig.files[0], message)
        stated = [{"from": child, "to": parent, "matrix": pose.matrix.tolist()} for child, parent, pose in edges]
        raw["transforms"] = [*raw.get("transforms", []), *stated]
    for one in tables:
        if one["id"] in cameras:
            camera = cameras[one["id"]].camera
            names = MODELS[camera.model].coefficient_names
            numbers = {name: getattr(camera, name) for name in ("model", "width", "height", "fx", "fy", "cx", "cy")}
            coefficients = dict(zip(names, camera.coefficients, strict=False))
            one["camera_model"] = numbers | ({"coefficients": coefficients} if coefficients else {})


def read_frames_and_cameras(
    path: Path,
) -> tuple[list[tuple[str, str, RigidTransform, str]], list[tuple[str, str, Camera, str]]]:
    """Read what a manifest states of frames and cameras; its files are not looked at, and need not be named.

    Returns:
        transforms: source frame, target frame, `target_from_source`, and where it stands; frames of cameras have
            optical axes here, whatever their own are.
        cameras: id, frame, camera model, and where it stands; of those whose image size is stated.

    Raises:
        DataError: the manifest is no TOML, or something of this is at fault.
    """
    raw, faults, ledger = _parse(path), Faults(path), Ledger(lenient=False)
    sensors = raw.get("sensors", [])
    if not isinstance(sensors, list) or not all(isinstance(_of(one, "id"), str) for one in sensors):
        raise DataError(path, "sensors", "expected `[[sensors]]`, each with an `id`")
    kept: _Record = {name: raw[name] for name in ("ego", "transforms") if name in raw}
    listed = read_record({**kept, "sensors": []}, "rig", "", faults).get("transforms", [])
    tables = [(f"transforms[{k}]", one, one.get("from", ""), one.get("to", "")) for k, one in enumerate(listed)]
    cameras, optical = [], {}
    for k, one in enumerate(sensors):
        frame, location = str(one.get("frame", one["id"])), f"sensors[{k}]"
        parts = {name: one[name] for name in ("extrinsic", "camera_model") if name in one}
        for name, part in parts.items():
            parts[name] = read_record(part, name, f"{location}.{name}", faults) if isinstance(part, dict) else None
            if parts[name] is None:
                faults.add(f"{location}.{name}", f"{_found(part)}; expected a table")
        table, model = parts.get("extrinsic"), parts.get("camera_model")
        if table is not None:
            tables.append((f"{location}.extrinsic", table, table.get("from", frame), table.get("to", frame)))
        with faults.catching(f"{location}.axes"):
            if "axes" in one:
                optical[frame] = frame_from_optical(_stated_axes(one["axes"], f"{location}.axes", faults))
        with faults.catching(f"{location}.camera_model"):
            if model is not None and "width" not in model:
                raise CalibrationError("no width and height; expected those of the calibrated images")
            if model is not None:
                optical[frame] = optical.get(frame, RigidTransform.identity()) @ frame_from_camera(model)
                size = int(model["width"]), int(model.get("height", 0))
                cameras.append((one["id"], frame, read_camera_model(model, size), f"{location}.camera_model"))
    found = []
    for location, table, source, target in tables:
        with faults.catching(location):
            if source == target:
                raise CalibrationError(f"from {source!r} to itself; expected two frames")
            pose = read_transform(table, location, ledger)
            if source in optical:
                pose = pose @ optical[source]
            if target in optical:
                pose = optical[target].inverse() @ pose
            found.append((source, target, pose, location))
    faults.raise_all()
    return found, cameras


def _stated_axes(value: Any, location: str, faults: Faults) -> tuple[str, ...]:
    field = next(field for field in RECORDS["sensor camera"] if field.name == "axes")
    try:
        axes: tuple[str, ...] = _read(value, field, location, faults)
    except _FieldError as error:
        raise CalibrationError(str(error)) from None
    return axes


def _of(table: Any, name: str) -> Any:
    return table.get(name) if isinstance(table, dict) else None


def _parse(path: Path) -> _Record:
    try:
        size = path.stat().st_size
        if size > _LARGEST_MANIFEST:
            raise DataError(path, "", f"{size} bytes; expected a manifest of at most {_LARGEST_MANIFEST}")
        text = read_bytes(path).decode("utf-8-sig")
        return tomllib.loads(text.replace("\r\n", "\n"), parse_float=_decimal)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise DataError(path, f"byte {error.start}", "is no UTF-8 text; expected TOML") from error
    except (ValueError, RecursionError) as error:
        broken = "key part" in str(error) or "inline table" in str(error)
        hint = "; a table in { } has to stand in one line" if broken else ""
        raise DataError(path, "", f"is no TOML: {error}{hint}") from error


def _decimal(text: str) -> Decimal:
    """Keep all digits of a number, so that no time is rounded; extreme numbers become infinite or zero."""
    try:
        number = Decimal(text)
    except InvalidOperation:
        return Decimal("Infinity")
    if not number.is_finite() or number == 0 or abs(number.adjusted()) <= _LARGEST_EXPONENT:
        return number
    return Decimal("Infinity") if number.adjusted() > 0 else Decimal(0)


class _FieldError(ValueError):
    """A value is not what its field holds."""


def read_record(raw: Mapping[str, Any], record: str, location: str, faults: Faults) -> _Record:
    """Read one record; fields that are at fault are noted and left out.

    Args:
        raw: as `tomllib` reads it, numbers with a point as Decimal.
        record: its name in the table.
        location: where it stands, for messages.
        faults: takes all that is wrong.
    """
    if record == "sensor":
        kind = raw.get("type")
        if kind not in _SENSOR_TYPES:
            _report_type(raw, location, faults)
            return {}
        record = f"sensor {kind}"
    fields = {field.name: field for field in RECORDS[record]}
    before = f"{location}." if location else ""
    values: _Record = {}
    for name, value in raw.items():
        if name not in fields:
            faults.add(before + name, f"unknown; {_nearest(name, fields)}")
            continue
        try:
            values[name] = _read(value, fields[name], before + name, faults)
        except _FieldError as error:
            faults.add(before + name, str(error))
    for field in fields.values():
        if field.required and field.name not in raw:
            faults.add(before + field.name, f"missing; expected {_expected(field)}")
    return values


def _report_type(raw: Mapping[str, Any], location: str, faults: Faults) -> None:
    """Report the type of a sensor that is missing or unknown; its other fields are not checked."""
    if "type" in raw:
        problem = str(_wrong(raw["type"], _TYPE))
    else:
        close = get_close_matches("type", raw, 1, 0.6)
        problem = f"missing; expected {_expected(_TYPE)}" + (
            f"; {close[0]!r} is unknown: is it meant?" if close else ""
        )
    faults.add(f"{location}.type", problem)


def _nearest(name: str, fields: Mapping[str, _Field]) -> str:
    """Name the known field that is most like an unknown one, here or one table further in."""
    close = get_close_matches(name, fields, 1, 0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    for field in fields.values():
        if name in (inner.name for inner in RECORDS.get(field.record, ())):
            return f"did you mean {field.name}.{name}?"
    return f"expected one of {', '.join(fields)}"


def _expected(field: _Field) -> str:
    if field.choices:
        return f"one of {', '.join(field.choices)}"
    if field.shapes:
        shapes = (
            f"{shape[0]} rows of {shape[1]}" if len(shape) == 2 else f"a list of {shape[0]}" for shape in field.shapes
        )
        return " or ".join(f"{shape} numbers" for shape in shapes)
    unit = f" ({field.unit})" if field.unit else ""
    return f"{field.kind.value}{unit}{', above 0' if field.positive else ''}: {field.about}"


def _found(value: Any) -> str:
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'table'} of {len(value)}"
    text = str(value) if isinstance(value, Decimal) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _wrong(value: Any, field: _Field) -> _FieldError:
    close = get_close_matches(value, field.choices, 1, 0.5) if isinstance(value, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else ""
    return _FieldError(f"{_found(value)}; expected {_expected(field)}{hint}")


def _read(value: Any, field: _Field, location: str, faults: Faults) -> Any:  # noqa: PLR0911, PLR0912 - one a kind
    """Read the value of a field; raise `_FieldError` unless it is as its kind, but note the faults of inner records."""
    match field.kind:
        case Kind.TEXT:
            return _text(value, field)
        case Kind.TEXTS if value and isinstance(value, str | list):
            return [_text(text, field) for text in ([value] if isinstance(value, str) else value)]
        case Kind.CHOICE if isinstance(value, str) and value in field.choices:
            return value
        case Kind.FLAG if isinstance(value, bool):
            return value
        case Kind.INTEGER if not isinstance(value, Decimal) or value.is_nan():
            return int(_number(value, field))
        case Kind.NUMBER:
            return float(_number(value, field))
        case Kind.SECONDS:  # as nanoseconds, exactly
            return int((Decimal(_number(value, field)) * 10**9).to_integral_value())
        case Kind.VECTOR if isinstance(value, list) and (len(value),) in field.shapes:
            return _array(value, field)
        case Kind.MATRIX if isinstance(value, list) and all(isinstance(row, list) for row in value):
            widths = {len(row) for row in value}
            if len(widths) == 1 and (len(value), *widths) in field.shapes:
                return np.array([_array(row, field) for row in value])
        case Kind.NUMBERS if isinstance(value, list):
            return [float(_number(item, field)) for item in value]
        case Kind.NUMBERS if isinstance(value, dict):
            return {name: float(_number(item, field)) for name, item in value.items()}
        case Kind.NAMES if isinstance(value, dict):
            return {name: _text(item, field) for name, item in value.items()}
        case Kind.AXES if isinstance(value, str):
            return tuple(word.strip().lower() for word in value.split(","))
        case Kind.AXES if isinstance(value, dict) and set(value) == {"right", "down", "forward"}:
            return tuple(str(value[direction]).strip().lower() for direction in ("right", "down", "forward"))
        case Kind.RECORD if isinstance(value, dict):
            return read_record(value, field.record, location, faults)
        case Kind.RECORDS if isinstance(value, list) and all(isinstance(item, dict) for item in value):
            return _read_list(value, field, location, faults)
        case Kind.RECORDS:
            raise _FieldError(f"{_found(value)}; expected {field.kind.value}: one `[[{field.name}]]` each")
    raise _wrong(value, field)


def _text(value: Any, field: _Field) -> str:
    if isinstance(value, str) and value.strip() and "\0" not in value:
        return value
    raise _wrong(value, field)


def _number(value: Any, field: _Field) -> int | float | Decimal:
    if isinstance(value, Decimal | float) and value != value:  # noqa: PLR0124 - a Decimal has no cheaper test
        raise _FieldError(f"{_FILL_IN}: {field.about}" + (f" [{field.unit}]" if field.unit else ""))
    limit = _FARTHEST_S if field.kind is Kind.SECONDS else _LARGEST
    if type(value) not in {int, float, Decimal} or not abs(value) <= limit or (field.positive and not value > 0):
        raise _wrong(value, field)
    return value  # type: ignore[no-any-return]


def _array(values: list[Any], field: _Field) -> Any:
    return np.array([float(_number(item, field)) for item in values])


def _read_list(items: list[_Record], field: _Field, location: str, faults: Faults) -> list[_Record]:
    for k, item in enumerate(items):
        label = item.get("id", item.get("name"))
        if isinstance(label, str):
            faults.labels[f"{location}[{k}]"] = label
    return [read_record(item, field.record, f"{location}[{k}]", faults) for k, item in enumerate(items)]


_WORLD = "world"
_RESERVED_NAMES = {"gnss", "lidar", "identity"}  # names of trajectories that stand for computed ones


def open_rig(path: Path, *, lenient: bool = False, assume_model: bool = False, rig: Rig | None = None) -> Scene:
    """Open a folder with a `rig.toml`, or a manifest itself; images and points are read on demand.

    Args:
        path: the folder, or the manifest.
        lenient: leave out sensors and trajectories that are at fault, files without time and times without file.
        assume_model: allow computing with camera models whose formulas nothing confirms.
        rig: transforms and camera models that the manifest does not state.

    Raises:
        DataError: the manifest, or what it names, is at fault; all faults are reported at once.
        OptionError: nothing of the rig is the manifest's.
    """
    manifest = _read_manifest(path / MANIFEST if path.is_dir() else path, rig)
    ledger = Ledger(lenient=lenient)
    try:
        with ledger.telling():
            scene = _open(manifest, ledger)
    except OSError as error:
        raise DataError(path, "", f"cannot be read: {error}") from error
    if rig is not None:
        scene = replace(scene, warnings=(*rig.ledger.warnings, *scene.warnings))
    return with_assumed_models(scene) if assume_model else scene


def _open(manifest: _Manifest, ledger: Ledger) -> Scene:
    faults = manifest.faults()
    tree = _frame_tree(manifest, faults, ledger)
    drive = _Drive(manifest, tree, ledger)
    trajectories = _trajectories(drive, faults)
    drive.ego_path = default_poses(trajectories, str(manifest.path), ledger)
    closing = _CloseVideos(drive.videos)
    sensors: list[Sensor] = []
    try:
        for location, record in manifest.records("sensors"):
            with _noting(location, faults, ledger):
                sensors.append(_BUILDERS[record["type"]](_Part(drive, record, location)))
        faults.raise_all()
    except BaseException:
        closing()
        raise
    _note_frames_and_roots(drive)
    _note_doubts(drive, sensors, trajectories)
    ego_from_frame = {name: tree.ego_from(name) for name in tree.frames if name not in tree.loose}
    about: dict[str, Any] = {
        "ego": manifest.ego,
        "ego_from_frame": {
            name: [*pose.translation.tolist(), *pose.quaternion_xyzw.tolist()] for name, pose in ego_from_frame.items()
        },
    }
    if "name" in manifest.record:
        about["name"] = manifest.record["name"]
    return Scene(
        sensors=tuple(sensors),
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType({"rig": about}),
        source=str(manifest.path.parent if manifest.path.name == MANIFEST else manifest.path),
        format="rig",
        warnings=ledger.warnings,
        on_close=closing,
    )


class _VideoFile:
    """A video by its path. In another process it opens again, if it is still the file that was opened here."""

    def __init__(self, path: Path) -> None:
        """Open nothing yet."""
        self.path = path
        self.cut_off = False  # whether only what is left of a damaged video is read
        self._closed = False
        self._reader: VideoReader | None = None
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "cut_off": self.cut_off, "_closed": self._closed, "_reader": self._reader}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._lock = Lock()

    def reader(self) -> VideoReader:
        """The open video.

        Raises:
            DataError: it cannot be read as one, or was closed.
        """
        with self._lock:
            if self._closed:
                raise DataError(self.path, "", "is closed")
            if self._reader is None:
                self._reader = open_video(self.path, cut_off=self.cut_off)
            return self._reader

    def whole_or_left(self, ledger: Ledger) -> VideoReader:
        """The open video with its list of images; a lenient reading takes what is left of one that breaks off.

        Raises:
            DataError: it cannot be read, or no image of it is left.
        """
        with self._lock:
            if self._reader is None and not self._closed:
                self._reader = open_whole_or_left(self.path, ledger)
                self.cut_off = self._reader.is_remainder
        return self.reader()

    def rgb(self, index: int) -> UInt8Array:
        """Decode one image."""
        return self.reader().rgb(index)

    def container_ns(self) -> Int64Array:
        """The times that the video has itself, (N,) int64 [ns], rounded from its ticks once each.

        Raises:
            DataError: it has none.
        """
        index = self.reader().index
        if not index.timed:
            raise DataError(self.path, "", "has no times of its own; give them with csv, lines or rate_hz")
        ticks, base = index.pts.tolist(), index.time_base * 10**9
        return np.array([round(tick * base) for tick in ticks], np.int64)

    def open_binary(self) -> BinaryIO:
        """Open the video's bytes."""
        return open_file(self.path)

    def content(self, chosen: Int64Array) -> VideoContent | None:
        """The video for those who copy it, with the images that are used of it; None for what is left of one."""
        if self.cut_off:
            return None
        reader = self.reader()
        whole = np.array_equal(chosen, np.arange(reader.count))
        return VideoContent(self.open_binary, reader.codec, None if whole else tuple(chosen.tolist()))

    def close(self) -> None:
        """Release the file; no image can be read afterwards."""
        with self._lock:
            self._closed = True
            if self._reader is not None:
                self._reader.close()
            self._reader = None


@dataclass(frozen=True, slots=True, eq=False)
class _VideoImages:
    """Makes the images of one camera from a video."""

    video: _VideoFile
    chosen: Int64Array  # (N,) number of each image in the video
    timestamps_ns: Int64Array
    camera: Camera

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        return CameraImage(int(self.timestamps_ns[k]), self.camera, partial(self.video.rgb, int(self.chosen[k])))


@dataclass(frozen=True, slots=True)
class _CloseVideos:
    """Closes the videos of a scene."""

    videos: list[_VideoFile]

    def __call__(self) -> None:
        for video in self.videos:
            video.close()


@contextmanager
def _noting(location: str, faults: Faults, ledger: Ledger) -> Iterator[None]:
    """Note what goes wrong with one part; a lenient reading leaves the part out."""
    if not ledger.lenient:
        with faults.catching(location):
            yield
        return
    try:
        yield
    except SceneloomError as error:
        where, problem = location, str(error)
        if isinstance(error, DataError) and error.file == str(faults.file) and error.location:
            where, problem = error.location, error.problem
        ledger.note(WarningKind.SKIPPED, "parts-at-fault", f"{faults.file}: {where}", f"left out: {problem}")


def _trajectories(drive: "_Drive", faults: Faults) -> dict[str, Trajectory]:
    trajectories = {}
    for location, record in drive.manifest.records("trajectories"):
        name = record.get("name", "pose")
        if name in _RESERVED_NAMES:
            faults.add(f"{location}.name", f"{name!r} stands for a computed trajectory; expected another name")
        elif name in trajectories:
            faults.add(f"{location}.name", f"a second trajectory {name!r}; expected different names")
        else:
            with _noting(location, faults, drive.ledger):
                trajectories[name] = _build_trajectory(_Part(drive, record, location))
    return trajectories


@dataclass(slots=True, eq=False)
class _Drive:
    """A manifest while its scene is made."""

    manifest: _Manifest
    tree: "FrameTree"
    ledger: Ledger
    ego_path: Poses | None = None  # `world_from_ego` of the default trajectory, once that is read
    videos: list[_VideoFile] = field(default_factory=list)  # that were opened; the scene closes them


@dataclass(frozen=True, eq=False)
class _Part:
    """A sensor or trajectory of the manifest while it is built: its record, and where that stands."""

    drive: _Drive
    record: _Record
    location: str

    @property
    def ledger(self) -> Ledger:
        return self.drive.ledger

    def where(self, field: str) -> str:
        """The location of a field in the manifest."""
        return f"{self.location}.{field}" if field else self.location

    def fault(self, field: str, problem: str) -> DataError:
        return DataError(self.drive.manifest.path, self.where(field), problem)

    def note(self, kind: WarningKind, code: str, message: str, *, field: str = "", count: int = 1) -> None:
        self.ledger.note(kind, code, f"{self.drive.manifest.path}: {self.where(field)}", message, count=count)

    @cached_property
    def root(self) -> "_Root":
        """The folder of the files, by the part's `root` or the manifest's."""
        manifest = self.drive.manifest
        return _open_root(manifest.path, self.record.get("root", manifest.record.get("root")), self.where("root"))

    def file(self, field: str) -> Path:
        """The file that a field names."""
        return self.root.file(self.record[field], self.where(field))

    def files(self, suffixes: Sequence[str]) -> list[Path]:
        """The files of the patterns in `files`, each with one of some suffixes."""
        files = self.root.files(self.record["files"], self.where("files"))
        for path in files:
            if path.suffix.lower() not in suffixes:
                raise self.fault("files", f"{path.name!r}; expected files that end with {' '.join(suffixes)}")
        return files

    @property
    def offset_ns(self) -> int:
        return int(self.record.get("time_offset_s", 0))

    @property
    def own_frame(self) -> str:
        return _own_frame(self.record)

    @property
    def mount(self) -> RigidTransform:
        """`ego_from_frame` of the sensor's own frame."""
        return self.drive.tree.ego_from(self.own_frame)

    def poses(self, mount: RigidTransform, timestamps_ns: Int64Array) -> Poses | None:
        """`world_from_sensor` at those of the times that the default trajectory covers."""
        return poses_along(self.drive.ego_path, {0: mount}, np.zeros(len(timestamps_ns), np.int64), timestamps_ns)


def _own_frame(record: _Record) -> str:
    return str(record.get("frame", record["id"]))


def _open_root(manifest: Path, name: str | None, location: str) -> "_Root":
    """The folder of some files, relative to that of the manifest."""
    folder = manifest.parent if name is None else manifest.parent / Path(name).expanduser()
    try:
        resolved = folder.resolve()
    except (OSError, RuntimeError) as error:
        raise DataError(manifest, location, f"{name!r} cannot be read: {error}") from error
    if not resolved.is_dir():
        raise DataError(manifest, location, f"{name!r}: no such folder; expected the folder of the files")
    return _Root(resolved, manifest)


@dataclass(frozen=True, slots=True)
class _Root:
    """A folder, resolved, whose files a manifest may name."""

    folder: Path
    manifest: Path

    def file(self, name: str, location: str) -> Path:
        """Find one file."""
        path = self.folder / self._checked(name, location)
        if not path.is_file():
            raise DataError(self.manifest, location, f"{name!r}: {why_no_file(path)} in {self.folder}")
        self._check_inside([path], location)
        return path

    def files(self, patterns: Sequence[str], location: str) -> list[Path]:
        """Find the regular files of some patterns, in natural order: 2 before 10."""
        found: set[Path] = set()
        for pattern in patterns:
            try:
                matches = [path for path in self.folder.glob(self._checked(pattern, location)) if not path.is_dir()]
            except (ValueError, NotImplementedError, IndexError, re.error) as error:
                raise DataError(self.manifest, location, f"{pattern!r} is no pattern: {error}") from error
            if not matches:
                problem = f"{pattern!r}: no such files in {self.folder}{self._hint(pattern)}"
                raise DataError(self.manifest, location, problem)
            found.update(matches)
        files = sorted(found, key=natural_key)
        odd = next((path for path in files if not path.is_file()), None)
        if odd is not None:
            raise DataError(self.manifest, location, f"{self.relative(odd)!r}: {why_no_file(odd)}")
        self._check_inside(files, location)
        return files

    def relative(self, path: Path) -> str:
        """The name of a file relative to the folder."""
        # called for many thousands of files: cutting the text is ten times as fast as `relative_to`
        return str(path)[len(str(self.folder)) :].lstrip(os.sep).replace(os.sep, "/")

    def _checked(self, name: str, location: str) -> str:
        windows = PureWindowsPath(name)
        if PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
            problem = f"{name!r}; expected a path below {self.folder}; name another folder with `root`"
            raise DataError(self.manifest, location, problem)
        return name

    def _check_inside(self, files: Sequence[Path], location: str) -> None:
        """Refuse links that lead out; folders are resolved once each."""
        resolved: dict[Path, bool] = {}
        for path in files:
            if path.parent not in resolved:
                resolved[path.parent] = path.parent.resolve().is_relative_to(self.folder)
            inside = resolved[path.parent]
            if not inside or (path.is_symlink() and not path.resolve().is_relative_to(self.folder)):
                problem = (
                    f"{self.relative(path)!r} leads out of {self.folder} by a link, to {path.resolve()}; "
                    "name the folder that the files are in as `root`"
                )
                raise DataError(self.manifest, location, problem)

    def _hint(self, pattern: str) -> str:
        """What there is in place of the files of a pattern without matches."""
        folder, spelling = self.folder, ""
        if "\\" in pattern:
            spelling = "; folders are separated by /, also on Windows"
        elif "[" in pattern:
            spelling = "; [ ] stand for a choice of characters: write [[] for the character ["
        for part in PurePosixPath(pattern).parts[:-1]:
            if any(sign in part for sign in "*?["):
                break
            if not (folder / part).is_dir():
                return f"; {folder.name or folder} has {_folders_in(folder)}{spelling}"
            folder /= part
        suffixes = sorted({entry.suffix for entry in folder.iterdir() if entry.is_file() and entry.suffix})
        held = ", ".join("*" + suffix for suffix in suffixes[:10]) or "no files"
        also = f" and {_folders_in(folder)}" if folder == self.folder else ""
        return f"; {folder.name or folder} has {held}{also}{spelling}"


def _folders_in(folder: Path) -> str:
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    return f"the folders {', '.join(names[:10])}" if names else "no folders"


_TIME_SOURCES = ("pattern", "csv", "lines", "rate_hz", "container")
"""The fields of `times` that each state where timestamps come from; a pattern of indices needs a rate beside it."""

_Chosen = tuple[Int64Array, Int64Array]
"""Indices among the files or images, (N,) int64, and their timestamps, (N,) int64 [ns]."""


def _timed_files(
    part: _Part, files: Sequence[Path], read: Callable[[Path], object]
) -> tuple[tuple[Path, ...], tuple[str, ...], Int64Array]:
    """Timed files of a sensor, their names and timestamps [ns]; leniently, from the first that `read` can read."""
    names = [part.root.relative(path) for path in files]
    source = _time_source(part, _FILE_TIMES)
    chosen, timestamps_ns = _in_time_order(part, *_FILE_TIMES[source](part, names), names)
    if not len(chosen):
        raise part.fault("files", "none of the files has a time")
    first = 0
    while part.ledger.lenient:
        try:
            read(files[chosen[first]])
            break
        except DataError as error:
            if first == len(chosen) - 1:
                raise
            part.ledger.fault("unreadable-files", error)
            first += 1
    used = chosen[first:].tolist()
    return tuple(files[k] for k in used), tuple(names[k] for k in used), timestamps_ns[first:]


def _timed_images(part: _Part, count: int, container_ns: Callable[[], Int64Array], name: str) -> _Chosen:
    """The images of a video that have a time, in the order of time; `container_ns` gives those of the video itself."""
    source = _time_source(part, ("csv", "lines", "rate_hz", "container"))
    names = [f"{name} image {k}" for k in range(count)]
    if source == "container":
        offset_ns = int(part.record["times"].get("start_s", 0))
        timestamps = _shifted(container_ns(), offset_ns, part.drive.manifest.path, part.where("times.start_s"))
        return _in_time_order(part, np.arange(count), timestamps, names)
    if source == "csv":
        table, timestamps = _timestamp_table(part)
        return _in_time_order(part, *_in_parallel(part, table.path, timestamps, count), names)
    return _in_time_order(part, *_FILE_TIMES[source](part, names), names)


def _time_source(part: _Part, possible: Iterable[str]) -> str:
    stated = [source for source in _TIME_SOURCES if part.record["times"].get(source) not in (None, False)]
    if len(stated) != 1 and stated != ["pattern", "rate_hz"]:
        found = ", ".join(stated) or "none of them"
        raise part.fault("times", f"{found}; expected exactly one of {', '.join(possible)}")
    if stated[0] not in possible:
        raise part.fault("times", f"{stated[0]}; expected one of {', '.join(possible)} here")
    return stated[0]


def _by_pattern(part: _Part, names: Sequence[str]) -> _Chosen:
    """Times in the file names."""
    times = part.record["times"]
    try:
        pattern = NamePattern(times["pattern"])
    except TimestampError as error:
        raise part.fault("times.pattern", str(error)) from None
    if pattern.indexed != ("rate_hz" in times):
        expected = "`rate_hz` beside {index}" if pattern.indexed else "{index} in the pattern beside `rate_hz`"
        raise part.fault("times", f"{times['pattern']!r}; expected {expected}")
    chosen, values = [], []
    for k, name in enumerate(names):
        try:
            values.append(pattern.read(name.rpartition("/")[2]))
            chosen.append(k)
        except TimestampError as error:
            part.ledger.fault("names-without-time", part.fault("times.pattern", str(error)))
    timestamps = _evenly(part, values) if pattern.indexed else np.array(values, np.int64)
    return np.array(chosen, np.int64), timestamps


def _evenly(part: _Part, indices: Sequence[int]) -> Int64Array:
    """Times of numbered files, rounded once each, so that no error adds up."""
    period = Decimal(10**9) / Decimal(str(part.record["times"]["rate_hz"]))
    start_ns = int(part.record["times"].get("start_s", 0))
    timestamps = [int((index * period).to_integral_value()) + start_ns for index in indices]
    if timestamps and max(map(abs, timestamps)) > FARTHEST_NS:
        raise part.fault("times", f"index {max(indices)}: its time is beyond the year 2261")
    return np.array(timestamps, np.int64)


def _by_lines(part: _Part, names: Sequence[str]) -> _Chosen:
    """One line of a text file per file."""
    path = part.root.file(part.record["times"]["lines"], part.where("times.lines"))
    return _in_parallel(part, path, line_timestamps(path, part.record["times"].get("unit")), len(names))


def _by_csv(part: _Part, names: Sequence[str]) -> _Chosen:
    """The rows of a CSV file, matched by the file names in them if there are any, else in parallel."""
    table, timestamps = _timestamp_table(part)
    column_name = part.record["times"].get("file_column")
    column = table.find(FILE_COLUMNS) if column_name is None else table.column(column_name)
    if column is None:
        return _in_parallel(part, table.path, timestamps, len(names))
    known: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        base = name.rpartition("/")[2]
        for key in {name, base, base.rpartition(".")[0] or base}:
            known.setdefault(key, []).append(k)
    chosen, rows = [], []
    for row, cells in enumerate(table.rows):
        wanted = cells[column].replace("\\", "/").removeprefix("./")
        match = known.get(wanted) or known.get(wanted.rpartition("/")[2]) or []
        if len(match) == 1:
            chosen.append(match[0])
            rows.append(row)
        else:
            problem = f"{cells[column]!r} is {len(match) or 'none'} of the sensor's files; expected exactly one"
            part.ledger.fault("rows-without-file", DataError(table.path, f"line {table.lines[row]}", problem))
    without = len(names) - len(set(chosen))
    if without:
        message = "has no time for some files; they were left out"
        part.ledger.note(WarningKind.SKIPPED, "files-without-time", str(table.path), message, count=without)
    return np.array(chosen, np.int64), timestamps[rows]


def _timestamp_table(part: _Part) -> tuple[Table, Int64Array]:
    """The CSV file of the times, and the timestamps of its rows."""
    times = part.record["times"]
    table = read_table(part.root.file(times["csv"], part.where("times.csv")))
    column = table.column(times["column"]) if "column" in times else table.find(TIME_COLUMNS)
    if column is None:
        problem = f"no column of times among {', '.join(table.names)}; name it with `column`"
        raise DataError(table.path, "line 1", problem)
    return table, table.timestamps(column, times.get("unit"))


def _in_parallel(part: _Part, path: Path, timestamps: Int64Array, count: int) -> _Chosen:
    if len(timestamps) != count:
        problem = f"{len(timestamps)} times for {count} files or images; expected as many"
        part.ledger.fault("counts-disagree", DataError(path, "", problem), count=abs(count - len(timestamps)))
    used = min(len(timestamps), count)
    return np.arange(used), timestamps[:used]


def _in_time_order(part: _Part, chosen: Int64Array, times: Int64Array, names: Sequence[str]) -> _Chosen:
    """Add the sensor's offset, sort by time, and take one file per time."""
    timestamps = _shifted(times, part.offset_ns, part.drive.manifest.path, part.where("times"))
    back = int((timestamps[1:] < timestamps[:-1]).sum())
    if back:
        message = "times run backwards in the order of the names; sorted by time"
        part.note(WarningKind.REPAIRED, "files-sorted", message, field="times", count=back)
    order = np.argsort(timestamps, kind="stable")
    chosen, timestamps = chosen[order], timestamps[order]
    repeated = np.flatnonzero(np.diff(timestamps) == 0) + 1
    if len(repeated):
        k = int(repeated[0])
        problem = (
            f"{names[chosen[k - 1]]!r} and {names[chosen[k]]!r} have the same time, {timestamps[k] / 1e9:.9f} s; "
            "expected one file per time"
        )
        part.ledger.fault("repeated-times", part.fault("times", problem), count=len(repeated))
    return np.delete(chosen, repeated), np.delete(timestamps, repeated)


_FILE_TIMES: Mapping[str, Callable[[_Part, Sequence[str]], _Chosen]] = {
    "pattern": _by_pattern,
    "csv": _by_csv,
    "lines": _by_lines,
    "rate_hz": lambda part, names: (np.arange(len(names)), _evenly(part, range(len(names)))),
}


class NamePattern:
    """A pattern of file names with numbers in it: `{s}_{ns}`, `*__{us}`, `frame_{index}`.

    `*` stands for any text. The values of several units add up. The pattern has to fit the whole name, or the whole
    name without its endings.

    Attributes:
        indexed: whether the names hold an index instead of a time.
    """

    def __init__(self, pattern: str) -> None:
        """Compile the pattern.

        Raises:
            TimestampError: it has no placeholder, an unknown one, or one twice.
        """
        self._text = pattern
        known = (*PLACEHOLDERS, "index")
        expression, names = "", []
        for part in re.split(r"(\{[^{}]*\}|\*)", pattern):
            if part == "*":
                expression += ".*?"
            elif part.startswith("{") and part.endswith("}"):
                names.append(part[1:-1])
                digits = r"\d+\.\d+|\d+" if part == "{s}" else r"\d+"
                expression += f"(?P<{names[-1]}>{digits})" if names[-1] in known else ""
            else:
                expression += re.escape(part)
        repeated = len(set(names)) != len(names) or ("index" in names and len(names) > 1)
        if not names or not set(names) <= set(known) or repeated:
            listed = ", ".join(f"{{{name}}}" for name in known)
            raise TimestampError(f"{pattern!r}; expected some of {listed}, each once, {{index}} alone")
        self.indexed = names == ["index"]
        self._expression = re.compile(expression, re.ASCII)

    def read(self, name: str) -> int:
        """Read the time [ns], or the index, out of a file name.

        Raises:
            TimestampError: the name does not fit.
        """
        rest, match = name, self._expression.fullmatch(name)
        while match is None and "." in rest:
            rest = rest.rpartition(".")[0]
            match = self._expression.fullmatch(rest) if rest else None
        if match is None:
            raise TimestampError(f"{name!r} does not fit the pattern {self._text!r}")
        if self.indexed:
            return int(match["index"][:18])
        timestamp_ns = sum(
            parse_timestamp(text, PLACEHOLDERS[unit], hint="`{{{sign}}}`") for unit, text in match.groupdict().items()
        )
        if timestamp_ns > FARTHEST_NS:
            raise TimestampError(f"{name!r} gives a time beyond the year 2261 by the pattern {self._text!r}")
        return timestamp_ns


_WAYS_TO_ROTATE = ("quaternion_xyzw", "quaternion_wxyz", "rotation_matrix", "euler_deg")
_NORM_ERROR = 0.01
_FARTHEST = 1e6
_QUARTER_ERROR = 0.003
"""Angles rounded to 1.57 and 3.14 are quarter rotations in radians within this share; 1.5 and 3 degrees are not."""

_AGREEMENT_ROTATION, _AGREEMENT_TRANSLATION = 2e-3, 0.01
"""Two chains between the same frames may differ by this much [rad, m], which rounding in files comes to."""

_AXES: Mapping[str, tuple[str, str, str]] = {
    "optical": ("+x", "+y", "+z"),
    "flu": ("-y", "-z", "+x"),
    "frd": ("+y", "+z", "+x"),
}
"""Axes that point right, down and forward: of an optical frame, and of bodies that are x forward, y left or right."""

_DIRECTIONS = {sign + axis: value for axis in "xyz" for sign, value in (("+", 1.0), ("-", -1.0), ("", 1.0))}


def read_transform(record: _Record, location: str, ledger: Ledger) -> RigidTransform:
    """Build a transform from `matrix`, or from `translation` and one form of rotation.

    Raises:
        CalibrationError: too many or too few fields, or the rotation is invalid.
    """
    forms = [form for form in _WAYS_TO_ROTATE if form in record]
    if "matrix" in record:
        if forms or "translation" in record:
            raise CalibrationError(f"matrix beside {(forms or ['translation'])[0]}; expected one of them")
        return _checked_transform(record["matrix"], location, ledger)
    if len(forms) > 1:
        raise CalibrationError(f"{' and '.join(forms)}; expected one of them")
    if not forms and "translation" not in record:
        raise CalibrationError(f"no transform; expected matrix, or translation and one of {', '.join(_WAYS_TO_ROTATE)}")
    matrix = np.eye(4)
    matrix[:3, 3] = record.get("translation", (0.0, 0.0, 0.0))
    if forms:
        matrix[:3, :3] = _rotation(record, forms[0])
    if forms == ["euler_deg"]:
        angles = record["euler_deg"]
        quarters = np.abs(angles) / (np.pi / 2)
        whole = (np.abs(quarters - np.round(quarters)) < _QUARTER_ERROR) & (np.round(quarters) > 0)
        if np.abs(angles).max() < 2 * np.pi and whole.any():
            message = f"euler_deg {angles.tolist()} look like radians; degrees are expected, as 90 or -180"
            ledger.note(WarningKind.ASSUMED, "angles-in-radians", location, message)
    return _checked_transform(matrix, location, ledger)


def _rotation(record: _Record, form: str) -> Float64Array:
    value: Float64Array = record[form]
    if (form == "euler_deg") != ("euler_order" in record):
        raise CalibrationError("euler_deg and euler_order; expected both or neither")
    if form == "rotation_matrix":
        return value
    if form == "euler_deg":
        return rotation_from_cuboid_angles(value, order=record["euler_order"])
    norm = float(np.linalg.norm(value))
    if abs(norm - 1.0) > _NORM_ERROR:
        raise CalibrationError(f"{form} {value.tolist()} of length {norm:.4f}; expected 1 within {_NORM_ERROR}")
    return matrix_from_quaternion(value if form == "quaternion_xyzw" else value[[1, 2, 3, 0]])


def _checked_transform(matrix: Float64Array, location: str, ledger: Ledger) -> RigidTransform:
    if np.abs(matrix[:3, 3]).max() > _FARTHEST or np.abs(matrix[:3, :3]).max() > 2:
        problem = f"{matrix.tolist()}; expected a rotation and a translation in metres within {_FARTHEST:g}"
        raise CalibrationError(problem)
    transform, error = RigidTransform.nearest(matrix)
    if not error <= GREATEST_ERROR:
        problem = "mirrored or singular" if error == float("inf") else f"off by {error:.2g} (max abs of R Rᵀ - I)"
        expected = f"expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        raise CalibrationError(f"rotation {problem}; {expected}")
    if error > SILENT_ERROR:
        message = f"rotation off by {error:.2g} (max abs of R Rᵀ - I); the nearest rotation was taken"
        ledger.note(WarningKind.REPAIRED, "rotation-normalised", location, message)
    return transform


def frame_from_optical(axes: tuple[str, ...]) -> RigidTransform:
    """Rotate from the optical axes (x right, y down, z forward) to those of a frame.

    Args:
        axes: "optical", "flu" or "frd", or the axes of the frame that point right, down and forward.

    Raises:
        CalibrationError: the axes are not three different ones, or a mirror.
    """
    if len(axes) == 1 and axes[0] not in _AXES:
        expected = f"one of {', '.join(_AXES)}, or right, down and forward as '-y,-z,+x'"
        raise CalibrationError(f"axes {axes[0]!r}; expected {expected}")
    if len(axes) == 1:
        axes = _AXES[axes[0]]
    if len(axes) != 3 or not set(axes) <= set(_DIRECTIONS):
        raise CalibrationError(f"axes {','.join(axes)!r}; expected right, down and forward as '-y,-z,+x'")
    rotation = np.zeros((3, 3))
    for column, axis in enumerate(axes):
        rotation["xyz".index(axis[-1]), column] = _DIRECTIONS[axis]
    if round(np.linalg.det(rotation)) != 1:
        raise CalibrationError(
            f"axes {','.join(axes)!r} (right, down, forward) are a mirror or no three axes; expected a right-handed set"
        )
    return RigidTransform(rotation, np.zeros(3))


def _frame_tree(manifest: _Manifest, faults: Faults, ledger: Ledger) -> "FrameTree":
    """Read all transforms; nothing else can be checked without a sound tree."""
    tables = [(location, record, record["from"], record["to"]) for location, record in manifest.records("transforms")]
    for location, sensor in manifest.records("sensors"):
        if "extrinsic" not in sensor:
            continue
        where, record, frame = f"{location}.extrinsic", sensor["extrinsic"], _own_frame(sensor)
        if ("to" in record) == ("from" in record):
            found = "to and from" if "to" in record else "neither to nor from"
            faults.add(where, f"{found}; expected `to`: the frame that points of {frame!r} are taken into")
        else:
            tables.append((where, record, record.get("from", frame), record.get("to", frame)))
    edges = []
    for location, record, source, target in tables:
        with faults.catching(location):
            transform = read_transform(record, f"{manifest.path}: {location}", ledger)
            edges.append(Edge(source, target, transform, location))
    faults.raise_all()
    try:
        return FrameTree(manifest.ego, edges)
    except CalibrationError as error:
        raise DataError(manifest.path, "", str(error)) from None


@dataclass(frozen=True, slots=True)
class Edge:
    """One transform of a manifest: `target_from_source` takes points of frame `source` into frame `target`."""

    source: str
    target: str
    target_from_source: RigidTransform
    location: str


class FrameTree:
    """Frames and the transforms between them.

    Attributes:
        ego: the root of the tree.
        frames: all frames that a transform names, and the ego's.
        loose: those that are not connected with the ego's.
    """

    def __init__(self, ego: str, edges: Iterable[Edge]) -> None:
        """Follow the transforms from the ego to every frame that they reach.

        Raises:
            CalibrationError: a transform goes from a frame to itself, or two chains between frames contradict each
                other.
        """
        self.ego = ego
        self._edges = tuple(edges)
        for edge in self._edges:
            if edge.source == edge.target:
                raise CalibrationError(f"{edge.location}: from {edge.source!r} to itself; expected two frames")
        self.frames = tuple(dict.fromkeys([ego, *(n for edge in self._edges for n in (edge.source, edge.target))]))
        self._ego_from: dict[str, RigidTransform] = {ego: RigidTransform.identity()}
        self._parents: dict[str, str] = {}
        waiting = deque([ego])
        while waiting:
            near = waiting.popleft()
            for edge in self._edges:
                if edge.target == near:
                    far, near_from_far = edge.source, edge.target_from_source
                else:
                    far, near_from_far = edge.target, edge.target_from_source.inverse()
                if near in {edge.source, edge.target} and far not in self._ego_from:
                    self._ego_from[far] = self._ego_from[near] @ near_from_far
                    self._parents[far] = near
                    waiting.append(far)
        self.loose = tuple(frame for frame in self.frames if frame not in self._ego_from)
        for edge in self._edges:
            if edge.source in self._ego_from:
                self._check(edge)

    def ego_from(self, frame: str) -> RigidTransform:
        """Give `ego_from_frame`.

        Raises:
            CalibrationError: no chain of transforms leads there.
        """
        if frame in self._ego_from:
            return self._ego_from[frame]
        near = [frame]
        for name in near:
            pairs = [(edge.source, edge.target) for edge in self._edges if name in (edge.source, edge.target)]
            near += dict.fromkeys(other for pair in pairs for other in pair if other not in near)
        if len(near) > 1:
            with_frame, with_ego = (", ".join(map(repr, names)) for names in (near[1:], self._ego_from))
            hint = f"it is connected with {with_frame}, the ego's with {with_ego}: one is missing between"
        else:
            known = ", ".join(map(repr, self.frames))
            hint = f'no transform names it (known frames: {known}); give it an `extrinsic`, or set `ego = "{frame}"`'
        raise CalibrationError(f"no transforms lead from frame {frame!r} to the ego's frame {self.ego!r}; {hint}")

    def _check(self, edge: Edge) -> None:
        """Compare a transform with the chain of the others between its two frames."""
        target_from_source = self._ego_from[edge.target].inverse() @ self._ego_from[edge.source]
        rotation = float(np.abs(target_from_source.rotation - edge.target_from_source.rotation).max())
        distance = float(np.abs(target_from_source.translation - edge.target_from_source.translation).max())
        if rotation > _AGREEMENT_ROTATION or distance > _AGREEMENT_TRANSLATION:
            source, target = self._to_ego(edge.source), self._to_ego(edge.target)
            meeting = next(frame for frame in source if frame in target)
            chain = [*source[: source.index(meeting) + 1], *reversed(target[: target.index(meeting)])]
            raise CalibrationError(
                f"{edge.location}: from {edge.source!r} to {edge.target!r} contradicts the chain "
                f"{' - '.join(map(repr, chain))} by {distance:.3g} m and {np.degrees(rotation):.3g}°; "
                "is one of these transforms the other way round?"
            )

    def _to_ego(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] != self.ego:
            chain.append(self._parents[chain[-1]])
        return chain


def _build_trajectory(part: _Part) -> Trajectory:
    """Read a trajectory and bring it to the ego."""
    ledger, record = part.ledger, part.record
    frame = record.get("frame", part.drive.manifest.ego)
    frame_from_ego = part.drive.tree.ego_from(frame).inverse()
    path = part.file("file")
    rows = _POSE_READERS[record["form"]](part, path)
    times_ns, positions, quaternions = rows.timestamps_ns, rows.positions, rows.quaternions_xyzw
    if not len(times_ns):
        raise DataError(path, "", "holds no poses")
    if quaternions is not None:
        norms = np.linalg.norm(quaternions, axis=1)
        wrong = np.flatnonzero(~(np.abs(norms - 1.0) <= GREATEST_NORM_ERROR))
        if len(wrong):
            k = int(wrong[0])
            problem = f"orientation {quaternions[k].tolist()} of length {norms[k]:.4f}; expected 1 within 0.01"
            raise DataError(path, f"line {rows.lines[k]}", problem)
        quaternions = normalise_quaternion(quaternions)
    back = np.flatnonzero(times_ns[1:] < times_ns[:-1])
    if len(back):
        location = f"{path}: line {rows.lines[int(back[0]) + 1]}"
        ledger.note(WarningKind.REPAIRED, "poses-sorted", location, "poses out of order; sorted by time")
    unique_ns, chosen = np.unique(times_ns, return_index=True)
    if len(unique_ns) < len(times_ns):
        message, count = "several poses at one time; the first was kept", len(times_ns) - len(unique_ns)
        ledger.note(WarningKind.SKIPPED, "repeated-poses", str(path), message, count=count)
    times_ns, positions = unique_ns, positions[chosen]
    quaternions = None if quaternions is None else quaternions[chosen]
    if record.get("world_axes") == "optical":  # the scene's world is z up: x forward, y left
        world_from_file = frame_from_optical(("flu",))
        positions = world_from_file.apply(positions)
        if quaternions is not None:
            quaternions = multiply_quaternions(world_from_file.quaternion_xyzw, quaternions)
    distance = float(np.linalg.norm(frame_from_ego.translation))
    if quaternions is not None:
        positions = rotate_vectors(quaternions, frame_from_ego.translation) + positions
        quaternions = multiply_quaternions(quaternions, frame_from_ego.quaternion_xyzw)
    elif distance > 0:
        message = f"positions of frame {frame!r}, without orientations, are taken for the ego, {distance:.3g} m off"
        ledger.note(WarningKind.ASSUMED, "lever-arm-ignored", str(path), message)
    return Trajectory(
        record.get("name", "pose"),
        read_only(_shifted(times_ns, part.offset_ns, part.drive.manifest.path, part.where("time_offset_s"))),
        read_only(positions),
        None if quaternions is None else read_only(quaternions),
    )


def _read_numbers(path: Path, count: int, expected: str) -> Table:
    table = read_table(path, named=False)
    if table.rows and len(table.rows[0]) != count:
        problem = f"{len(table.rows[0])} values; expected {count}: {expected}"
        raise DataError(path, f"line {table.lines[0]}", problem)
    return table


def _read_tum(part: _Part, path: Path) -> PoseRows:
    """Lines `timestamp tx ty tz qx qy qz qw`. Source: "File Formats" of the TUM RGB-D benchmark."""
    table = _read_numbers(path, 8, "timestamp tx ty tz qx qy qz qw")
    values = table.numbers(range(1, 8))
    return PoseRows(table.timestamps(0, part.record.get("unit")), values[:, :3], values[:, 3:], table.lines)


def _read_kitti(part: _Part, path: Path) -> PoseRows:
    """Lines of the 12 numbers of [R t], row by row. Source: the development kit of KITTI's odometry benchmark."""
    if "times" not in part.record:
        raise part.fault("times", "missing; a kitti file has no times: expected a text file with one time per pose")
    table = _read_numbers(path, 12, "three rows of [R t]")
    times_path = part.file("times")
    timestamps = line_timestamps(times_path, part.record.get("unit"))
    if len(timestamps) != len(table.rows):
        raise DataError(times_path, "", f"{len(timestamps)} times for {len(table.rows)} poses; expected as many")
    matrices = table.numbers(range(12)).reshape(-1, 3, 4)
    quaternions = np.empty((len(matrices), 4))
    for k, matrix in enumerate(matrices):
        if np.abs(matrix[:, :3]).max() > 2:
            raise DataError(path, f"line {table.lines[k]}", f"{matrix.tolist()}; expected a rotation and a translation")
        rotation, error = nearest_rotation(matrix[:, :3])
        if not error <= GREATEST_ERROR:
            problem = f"rotation off by {error:.2g}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
            raise DataError(path, f"line {table.lines[k]}", problem)
        quaternions[k] = quaternion_from_matrix(rotation)
    return PoseRows(timestamps, matrices[:, :, 3].copy(), quaternions, table.lines)


def _read_csv(part: _Part, path: Path) -> PoseRows:
    table = read_table(path)
    columns = _pick_columns(part, table, POSE_COLUMNS)
    rotation = [role for role in ("qx", "qy", "qz", "qw") if role in columns]
    needed = ("time", "x", "y", "z", "qx", "qy", "qz", "qw") if rotation else ("time", "x", "y", "z")
    _check_columns(table, columns, needed)
    values = table.numbers([columns[role] for role in ("x", "y", "z", *rotation)])
    timestamps = table.timestamps(columns["time"], part.record.get("unit"))
    return PoseRows(timestamps, values[:, :3].copy(), values[:, 3:].copy() if rotation else None, table.lines)


_POSE_READERS: Mapping[str, Callable[[_Part, Path], PoseRows]] = {
    "tum": _read_tum,
    "kitti": _read_kitti,
    "csv": _read_csv,
}


def _pick_columns(part: _Part, table: Table, wanted: Mapping[str, Sequence[str]]) -> dict[str, int]:
    named = part.record.get("columns", {})
    return pick_columns(table, wanted, named, part.where("columns"), part.drive.manifest.path)


def _check_columns(table: Table, columns: Mapping[str, int], needed: Sequence[str]) -> None:
    missing = [role for role in needed if role not in columns]
    if missing:
        problem = f"no column for {', '.join(missing)} among {', '.join(table.names)}; name them with `columns`"
        raise DataError(table.path, "line 1", problem)


_SKEW = 1e-3
_RATIO_ERROR = 0.01


def _build_camera(part: _Part) -> CameraSensor:
    """Build a camera; the head of its first image is read."""
    record, fps = part.record, None
    if ("files" in record) == ("video" in record):
        found = "files and video" if "files" in record else "neither files nor video"
        raise part.fault("", f"{found}; expected one of them")
    images: ImageReader | _VideoImages
    if "files" in record:
        files, names, timestamps_ns = _timed_files(part, part.files(IMAGE_SUFFIXES), images_image_size)
        camera = _fitted_camera(part, images_image_size(files[0]))
        images, content = ImageReader(files, names, timestamps_ns, camera), None
    else:
        video = _VideoFile(part.file("video"))
        part.drive.videos.append(video)
        reader = video.whole_or_left(part.ledger)
        camera = _fitted_camera(part, (reader.width, reader.height))
        chosen, timestamps_ns = _timed_images(part, reader.count, video.container_ns, Path(record["video"]).name)
        images, content = _VideoImages(video, chosen, timestamps_ns, camera), video.content(chosen)
        fps = 1e9 / float(np.median(np.diff(timestamps_ns))) if len(timestamps_ns) > 1 else reader.fps
        fps = record["times"].get("rate_hz", fps)
    mount = (
        part.mount @ frame_from_optical(record.get("axes", ("optical",))) @ frame_from_camera(record["camera_model"])
    )
    return CameraSensor(
        id=record["id"],
        camera=camera,
        images=LazyFrames(timestamps_ns, images),
        poses=part.poses(mount, timestamps_ns),
        mount=mount,
        video=content,
        fps=fps,
        extras=_shutter(part),
    )


def _shutter(part: _Part) -> Mapping[str, Any]:
    """A rolling shutter, in the words in which recordings keep it."""
    if "shutter_roll_s" not in part.record:
        return NO_FIELDS
    seconds = part.record["shutter_roll_s"] / 1e9
    if seconds > LONGEST_ROLL_S:
        raise part.fault("shutter_roll_s", f"{seconds:g} s; expected at most {LONGEST_ROLL_S:g} s")
    left_to_right = {"rollingShutterLeftToRight": True} if part.record.get("shutter_left_to_right") else {}
    return {"calibration": {"shutterRollTimeSeconds": seconds, **left_to_right}}


def _fitted_camera(part: _Part, size: tuple[int, int]) -> Camera:
    """The camera model for the images as they are, with a warning where its calibration is for another size."""
    calibrated = read_camera_model(part.record["camera_model"], size)
    if (calibrated.width, calibrated.height) == size:
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, the images are {size[0]}x{size[1]}"
    ratio = (size[0] / calibrated.width) / (size[1] / calibrated.height)
    if abs(ratio - 1.0) > _RATIO_ERROR:
        swapped = (calibrated.height, calibrated.width) == size
        meant = "are width and height exchanged?" if swapped else "if they were cropped, cx and cy move with the crop"
        problem = f"for {sizes}, another shape; expected the calibration of the images as they are; {meant}"
        raise part.fault("camera_model", problem)
    message = f"the calibration is for {sizes}; the camera model was scaled"
    part.note(WarningKind.REPAIRED, "camera-model-scaled", message, field="camera_model")
    return calibrated.resized(*size)


def read_camera_model(record: _Record, image_size: tuple[int, int]) -> Camera:
    """Build the camera model, for the image size of its calibration.

    Args:
        record: the `camera_model` of a camera.
        image_size: width and height of the images [px], taken where the record has none.

    Raises:
        CalibrationError: too many or too few fields, or a number is impossible.
    """
    fx, fy, cx, cy = _intrinsics(record)
    if ("width" in record) != ("height" in record):
        raise CalibrationError("width without height; expected both or neither")
    given = record.get("coefficients", [])
    model = _model(record.get("model"), given)
    if record.get("undistorted", False):
        model, given = "pinhole", []
    size = (record["width"], record["height"]) if "width" in record else image_size
    camera = Camera(model, size[0], size[1], fx, fy, cx, cy, _coefficients(model, given))
    check_camera(camera)
    return camera


def frame_from_camera(record: _Record) -> RigidTransform:
    """The translation that a projection matrix P = K·[I t] has in it: p_camera = p_frame + t."""
    if "P" not in record:
        return RigidTransform.identity()
    return RigidTransform(np.eye(3), -np.linalg.solve(record["P"][:, :3], record["P"][:, 3]))


def _intrinsics(record: _Record) -> tuple[float, float, float, float]:
    """The values of fx, fy, cx, cy, from them or from one of the matrices."""
    forms = [form for form in ("fx", "K", "P") if form in record]
    if len(forms) != 1:
        raise CalibrationError(f"{' and '.join(forms) or 'no focal length'}; expected one of fx fy cx cy, K, P")
    if forms == ["fx"]:
        missing = [name for name in ("cx", "cy") if name not in record]
        if missing:
            raise CalibrationError(f"{' and '.join(missing)} missing; expected fx fy cx cy [px]")
        fx: float = record["fx"]
        return fx, record.get("fy", fx), record["cx"], record["cy"]
    beside = [name for name in ("fy", "cx", "cy") if name in record]
    if beside:
        raise CalibrationError(f"{forms[0]} beside {', '.join(beside)}; expected one of them")
    matrix: Float64Array = record[forms[0]][:, :3]
    rest = np.array([matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1.0])
    if np.abs(rest).max() > _SKEW:
        raise CalibrationError(f"{forms[0]} {matrix.tolist()}; expected [fx 0 cx; 0 fy cy; 0 0 1], row by row")
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])


def _model(name: str | None, given: Any) -> str:
    if name is None:
        return "brown_conrady" if given else "pinhole"
    plain = name.lower().replace("-", "_").replace(" ", "_")
    model = MODEL_ALIASES.get(plain, plain)
    if model not in MODELS:
        known = [*MODELS, *MODEL_ALIASES]
        close = get_close_matches(plain, known, 1, 0.6)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise CalibrationError(f"model {name!r}; expected one of {', '.join(known)}{hint}")
    return "brown_conrady" if model == "pinhole" and given else model


def _coefficients(model: str, given: list[float] | dict[str, float]) -> tuple[float, ...]:
    names = MODELS[model].coefficient_names
    if isinstance(given, dict):
        unknown = [name for name in given if name not in names]
        if unknown:
            raise CalibrationError(f"coefficients {', '.join(unknown)}; {model} has {' '.join(names) or 'none'}")
        return tuple(given.get(name, 0.0) for name in names) if given else ()
    if model != "brown_conrady":
        return tuple(given)
    if len(given) not in OPENCV_LENGTHS:
        lengths = ", ".join(map(str, OPENCV_LENGTHS))
        order = " ".join(OPENCV_NAMES)
        raise CalibrationError(f"{len(given)} coefficients; expected {lengths} in OpenCV's order: {order}")
    return from_opencv(given)


_LONGEST_SWEEP_NS = 60_000_000_000  # a sweep that takes longer than this [ns] is none
_LOOKED_AT = 10  # files that are looked through for one that is bright enough to show the scale of intensity
_ROLES = (*(role for role in ALIASES if role != "time"), *ROW_ALIASES)

_KNOWN_TIMES: dict[tuple[str, str], PointTimes] = {
    ("t", "u"): PointTimes("nanoseconds"),
    ("offset_time", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "u"): PointTimes("nanoseconds"),
    ("offset_ns", "i"): PointTimes("nanoseconds"),
    ("time", "f"): PointTimes("seconds"),
    ("timestamp", "f"): PointTimes("seconds", "clock"),
}
"""Meaning of the columns of point times that well-known drivers write, by name and kind of number.

Source: Ouster's and Livox' drivers for ROS (t, offset_time: uint32 nanoseconds from the timestamp), Velodyne's (time:
float32 seconds from the timestamp), Hesai's and RoboSense's (timestamp: float64 seconds of the clock); Argoverse 2
(offset_ns).
"""


def _build_lidar(part: _Part) -> LidarSensor:
    """Build a lidar; its first file is read, to see its columns."""
    record, mount = part.record, part.mount
    files = part.files(CLOUD_SUFFIXES)
    layout = _choose_layout(part, files[0])
    used, names, timestamps_ns = _timed_files(part, files, lambda path: read_cloud(path, layout=layout))
    named = record.get("use", {})
    for role in named:
        if role not in _ROLES:
            expected = f"some of {', '.join(_ROLES)}; times of points go into point_times.field"
            raise part.fault(f"use.{role}", f"unknown; expected {expected}")
    reader = SweepReader(
        files=used,
        names=names,
        clocks_ns=np.stack([timestamps_ns, timestamps_ns], axis=1),
        timestamps_ns=timestamps_ns,
        zero_ns=part.offset_ns,
        layout=layout,
        mapping=PointMapping(named=MappingProxyType(named)),
    )
    reader = _with_clocks(part, _with_columns(part, reader))
    points_frame, rotation = _points_frame(part, mount)
    reader = replace(reader, rotation=rotation)
    _note_first_sweep(part, reader, points_frame)
    scale = reader.mapping.scale
    return LidarSensor(
        id=record["id"],
        frames=LazyFrames(reader.timestamps_ns, reader),
        poses=part.poses(mount, reader.timestamps_ns),
        mount=mount,
        points_frame=points_frame,
        model=record.get("model"),
        extras=MappingProxyType({} if scale is None else {"intensity_max": scale.maximum}),
    )


def _choose_layout(part: _Part, first: Path) -> FieldLayout | None:
    """The columns that the manifest states, or the usual ones of files without a header."""
    if "fields" in part.record:
        try:
            return FieldLayout.parse(part.record["fields"], default=part.record.get("dtype", "float32"))
        except OptionError as error:
            raise part.fault("fields", str(error)) from None
    if "dtype" in part.record:
        raise part.fault("dtype", "has no effect without `fields`")
    if cloud_suffix(first) != ".bin":
        return None
    layout = default_layout(first)
    part.note(WarningKind.ASSUMED, "fields-assumed", f"`fields` not stated; the points are taken to be {layout}")
    return layout


def _with_columns(part: _Part, reader: SweepReader) -> SweepReader:
    """Settle the meaning of intensity and times, from the first files where the manifest does not state it."""
    columns = reader.cloud(0).columns
    roles = find_roles(columns, reader.mapping.named)
    scale = None
    if "intensity_max" in part.record:
        scale = IntensityScale(part.record["intensity_max"])
    elif roles.get("intensity") in columns:
        scale = _detect_scale(part, reader, roles["intensity"])
    stated = part.record.get("point_times")
    times = None
    if not part.record.get("deskewed", False):
        if stated is None:
            times = _guess_times(part, columns, roles.get("time"))
        else:
            times = PointTimes(stated["unit"], stated.get("relative_to", "timestamp"), stated.get("field"))
    settled = replace(reader, mapping=replace(reader.mapping, scale=scale, times=times))
    if times is None or stated is not None:
        return settled
    # a guess is kept only if the first sweep agrees with it
    try:
        settled.read(0)
    except DataError as error:
        if not error.location.startswith(f"{times.field}["):
            raise
        hint = f"but {error.problem}; set `point_times` to use it"
        part.note(WarningKind.SKIPPED, "point-times-not-used", f"column {times.field!r} looks like point times, {hint}")
        return replace(settled, mapping=replace(settled.mapping, times=None))
    message = f"column {times.field!r} is taken for point times: {times.unit} relative to the {times.relative_to}"
    part.note(WarningKind.ASSUMED, "point-times-assumed", message)
    return settled


def _detect_scale(part: _Part, reader: SweepReader, name: str) -> IntensityScale:
    """The scale of the first of the first files that has any intensity, else of the first of all."""
    cloud = reader.cloud(0)
    for k in range(min(len(reader.files), _LOOKED_AT)):
        bright = reader.cloud(k)
        if name in bright.columns and (bright.columns[name] > 0).any():
            cloud = bright
            break
    values = cloud.columns[name]
    scale = detect_scale(values)
    if scale is None:
        problem = f"up to {values.max()}; set what becomes 255 by {part.location}.intensity_max"
        raise DataError(cloud.file, name, problem)
    if values.dtype != np.uint8:
        message = f"`intensity_max` not stated; {name} goes up to {values.max():g}"
        message += f", so {scale.maximum:g} becomes 255" if len(values) else ""
        part.note(WarningKind.ASSUMED, "intensity-scale", message)
    return scale


def _guess_times(part: _Part, columns: Mapping[str, AnyArray], name: str | None) -> PointTimes | None:
    known = None if name is None else _KNOWN_TIMES.get((name.lower(), columns[name].dtype.kind))
    if known is not None:
        return replace(known, field=name)
    if name is not None:
        message = f"column {name!r} looks like point times; set `point_times` to use it"
        part.note(WarningKind.SKIPPED, "point-times-not-used", message)
    return None


def _with_clocks(part: _Part, reader: SweepReader) -> SweepReader:
    """Bring timestamps of a sweep's middle or end to its start; points without times are at the middle, if known."""
    meant = part.record.get("timestamp", "start")
    sweep_ns: int = part.record.get("sweep_s", 0)
    timestamps_ns = reader.timestamps_ns
    if part.record.get("deskewed", False):
        return replace(reader, deskewed=True)
    if not sweep_ns and meant != "start":
        if len(timestamps_ns) < 2:
            raise part.fault(
                "sweep_s", "missing, and a single sweep has no interval; expected the duration of a sweep [s]"
            )
        sweep_ns = int(np.median(np.diff(timestamps_ns)))
        message = f"`sweep_s` not stated; the duration of a sweep is the median interval, {sweep_ns / 1e9:g} s"
        part.note(WarningKind.ASSUMED, "sweep-length", message)
    if sweep_ns > _LONGEST_SWEEP_NS:
        expected = f"the duration of a sweep, at most {_LONGEST_SWEEP_NS // 10**9} s"
        raise part.fault("sweep_s", f"{sweep_ns / 1e9:g}; expected {expected}")
    starts_ns = timestamps_ns - round(sweep_ns * {"start": 0.0, "middle": 0.5, "end": 1.0}[meant])
    times_ns = starts_ns if reader.mapping.times is not None else starts_ns + round(sweep_ns / 2)
    return replace(reader, clocks_ns=np.stack([timestamps_ns, starts_ns], axis=1), timestamps_ns=times_ns)


def _points_frame(part: _Part, mount: RigidTransform) -> tuple[PointsFrame, RigidTransform | None]:
    """The frame that the points will be in, and the transform into it if the file has them in another."""
    tree = part.drive.tree
    name: str = part.record.get("points_in", part.own_frame)
    if name == part.own_frame:
        return PointsFrame.SENSOR, None
    if name == tree.ego:
        return PointsFrame.EGO, None
    if name == _WORLD and _WORLD not in tree.frames:
        return PointsFrame.WORLD, None
    return PointsFrame.SENSOR, mount.inverse() @ tree.ego_from(name)


_FARTHEST_POINT = 10_000.0  # no lidar measures as far [m]: numbers of another type give such points
_NEAREST_POINT = 1e-6
_ODD_SHARE = 0.01


def _note_first_sweep(part: _Part, reader: SweepReader, points_frame: PointsFrame) -> None:
    """Check the points of the first sweep, and note what was left out of it."""
    read, path = reader.read(0), reader.files[0]
    positions, columns = read.points.positions, reader.cloud(0).columns
    if read.dropped:
        message = "points that are not finite, or exactly at the origin, are no returns and are left out"
        part.ledger.note(WarningKind.SKIPPED, "points-dropped", str(path), message, count=read.dropped)
    distances = np.linalg.norm(positions.astype(np.float64), axis=1)
    intensities = columns.get(find_roles(columns, {}).get("intensity", ""), positions[:0, 0])
    odd = (
        (distances > _FARTHEST_POINT, f"points farther than {_FARTHEST_POINT:g} m"),
        (distances < _NEAREST_POINT, f"points nearer than {_NEAREST_POINT:g} m"),
        (intensities < 0, "intensity below zero"),
    )
    for rows, what in odd:
        if rows.sum() > _ODD_SHARE * max(len(distances), 1):
            message = f"{what}; does the file have the columns and types that it is taken to have?"
            part.ledger.note(WarningKind.ASSUMED, "odd-points", str(path), message, count=int(rows.sum()))
    if points_frame is PointsFrame.WORLD and len(positions) and np.abs(positions).max() > FARTHEST_WORLD:
        problem = f"points up to {np.abs(positions).max():.0f} m from the world's origin; expected {FARTHEST_WORLD:g} m"
        raise DataError(path, "", f"{problem} at most: give points and trajectory a nearer origin")


_IMU_COLUMNS: Mapping[str, Sequence[str]] = {
    "time": TIME_COLUMNS,
    "ax": ("ax", "acc_x", "accel_x", "a_x", "accx", "linear_acceleration_x"),
    "ay": ("ay", "acc_y", "accel_y", "a_y", "accy", "linear_acceleration_y"),
    "az": ("az", "acc_z", "accel_z", "a_z", "accz", "linear_acceleration_z"),
    "gx": ("gx", "wx", "gyro_x", "gyr_x", "w_x", "angular_velocity_x", "omega_x"),
    "gy": ("gy", "wy", "gyro_y", "gyr_y", "w_y", "angular_velocity_y", "omega_y"),
    "gz": ("gz", "wz", "gyro_z", "gyr_z", "w_z", "angular_velocity_z", "omega_z"),
}

_STREAMS = (
    ("accelerometer", ("ax", "ay", "az"), "accelerometer_unit", "m/s2"),
    ("gyroscope", ("gx", "gy", "gz"), "gyroscope_unit", "rad/s"),
)
"""Streams of an IMU: columns, field of the unit, unit where it is left out."""

_FACTORS = {"m/s2": 1.0, "g": 9.80665, "rad/s": 1.0, "deg/s": float(np.pi / 180.0)}
"""Source: the standard acceleration of the 3rd General Conference on Weights and Measures, 1901."""


def _build_imu(part: _Part) -> ImuSensor:
    """Read an IMU; its values are converted to the axes of the ego."""
    mount = part.mount
    table, columns, order, timestamps = _read_samples(part, _IMU_COLUMNS)
    streams = {}
    for stream, roles, field, default in _STREAMS:
        found = [columns[role] for role in roles if role in columns]
        if len(found) == 3:
            values = table.numbers(found)[order] * _FACTORS[part.record.get(field, default)]
            streams[stream] = VectorSamples(timestamps, read_only(mount.rotate(values)))
    if not streams:
        problem = f"no columns ax ay az or gx gy gz among {', '.join(table.names)}; name them with `columns`"
        raise DataError(table.path, "line 1", problem)
    distance = float(np.linalg.norm(mount.translation))
    if distance > 0 and "accelerometer" in streams:
        message = f"accelerations are converted to the ego's axes, but not over the {distance:.3g} m to its origin"
        part.ledger.note(WarningKind.ASSUMED, "imu-lever-arm", str(table.path), message)
    return ImuSensor(part.record["id"], MappingProxyType(streams))


def _build_gnss(part: _Part) -> GnssSensor:
    """Read a GNSS receiver."""
    table, columns, order, timestamps = _read_samples(part, GNSS_COLUMNS)
    _check_columns(table, columns, ("latitude", "longitude", "altitude"))
    positions = table.numbers([columns[role] for role in ("latitude", "longitude", "altitude")])[order]
    outside = np.flatnonzero((np.abs(positions[:, 0]) > 90) | (np.abs(positions[:, 1]) > 180))
    if len(outside):
        k = int(outside[0])
        problem = f"latitude {positions[k, 0]}, longitude {positions[k, 1]}; expected degrees within ±90 and ±180"
        raise DataError(table.path, f"line {table.lines[int(order[k])]}", problem)
    accuracies, vertical_accuracies = (
        read_only(table.numbers([columns[role]])[order, 0] if role in columns else np.full(len(order), np.nan))
        for role in ("accuracy", "vertical_accuracy")
    )
    return GnssSensor(part.record["id"], timestamps, read_only(positions), accuracies, vertical_accuracies)


def _read_samples(
    part: _Part, wanted: Mapping[str, Sequence[str]]
) -> tuple[Table, dict[str, int], Int64Array, Int64Array]:
    """The CSV file of a sensor, its columns by role, its rows in the order of time, and their timestamps [ns]."""
    table = read_table(part.file("file"))
    columns = _pick_columns(part, table, wanted)
    if "time" not in columns:
        problem = f"no column of times among {', '.join(table.names)}; name it with `columns`"
        raise DataError(table.path, "line 1", problem)
    times = table.timestamps(columns["time"], part.record.get("unit"))
    timestamps = _shifted(times, part.offset_ns, table.path, "")
    back = np.flatnonzero(timestamps[1:] < timestamps[:-1])
    if len(back):
        location, message = f"{table.path}: line {table.lines[int(back[0]) + 1]}", "times run backwards; sorted by time"
        part.ledger.note(WarningKind.REPAIRED, "samples-sorted", location, message, count=len(back))
    order = np.argsort(timestamps, kind="stable")
    return table, columns, order, read_only(timestamps[order])


_BUILDERS: Mapping[str, Callable[[_Part], Sensor]] = {
    "lidar": _build_lidar,
    "camera": _build_camera,
    "imu": _build_imu,
    "gnss": _build_gnss,
}

_FARTHEST_MOUNT = 30.0  # a sensor that is mounted farther than this from the ego [m] is reported: no vehicle is as long
_WITHIN_NS = 1_000_000_000  # streams that miss each other by less may well belong together
_LEANING = 0.5  # cosine of 60 degrees: an ego whose z axis leans more than that is on its side or upside down


def _note_frames_and_roots(drive: _Drive) -> None:
    path, tree = drive.manifest.path, drive.tree
    if tree.loose:
        message = f"frames {', '.join(map(repr, tree.loose))} are not connected with {tree.ego!r}; not used"
        drive.ledger.note(WarningKind.SKIPPED, "loose-frames", str(path), message)
    records = [drive.manifest.record, *(record for _, record in drive.manifest.records("sensors"))]
    for name in dict.fromkeys(record["root"] for record in records if "root" in record):
        root = _open_root(path, name, "root").folder
        if not root.is_relative_to(path.parent.resolve()):
            message = f"files are read from {root}, outside the manifest's folder"
            drive.ledger.note(WarningKind.ASSUMED, "root-elsewhere", str(path), message)


def _note_doubts(drive: _Drive, sensors: Sequence[Sensor], trajectories: Mapping[str, Trajectory]) -> None:
    """Note what is hardly meant: far mountings, an ego on its side, clocks that never meet."""

    def doubt(code: str, message: str) -> None:
        drive.ledger.note(WarningKind.ASSUMED, code, str(drive.manifest.path), message)

    for sensor in sensors:
        if isinstance(sensor, LidarSensor | CameraSensor) and sensor.mount is not None:
            distance = float(np.linalg.norm(sensor.mount.translation))
            if distance > _FARTHEST_MOUNT:
                doubt("far-mount", f"sensor {sensor.id!r} is {distance:.5g} m from the ego; are these millimetres?")
    for name, trajectory in trajectories.items():
        if trajectory.quaternions_xyzw is None:
            continue
        x, y = trajectory.quaternions_xyzw[:, 0], trajectory.quaternions_xyzw[:, 1]
        leaning, count = int((1.0 - 2.0 * (x * x + y * y) < _LEANING).sum()), len(trajectory.timestamps_ns)
        if leaning > count / 2:
            found = f"trajectory {name!r} has the ego on its side or upside down in {leaning} of {count} poses"
            doubt("ego-leaning", f"{found}; are the quaternions x y z w, and is the world's z axis up?")
    spans = [(f"sensor {sensor.id!r}", frame_times(sensor)) for sensor in sensors]
    spans += [(f"trajectory {name!r}", trajectory.timestamps_ns) for name, trajectory in trajectories.items()]
    ordered = sorted((int(times.min()), int(times.max()), name) for name, times in spans if len(times))
    latest = ordered[0][1] if ordered else 0
    for before, after in pairwise(ordered):
        latest = max(latest, before[1])
        if after[0] > latest + _WITHIN_NS:
            found = f"{after[2]} begins {(after[0] - latest) / 1e9:.3f} s after {before[2]} and all before it end"
            doubt("clocks-apart", f"{found}; are their clocks or units the same?")


def _shifted(timestamps_ns: Int64Array, offset_ns: int, file: object, location: str) -> Int64Array:
    """Add an offset to timestamps; a sum beyond the year 2261 is a DataError."""
    ends = (int(timestamps_ns.min()), int(timestamps_ns.max())) if len(timestamps_ns) else (0,)
    if max(abs(end + offset_ns) for end in ends) > FARTHEST_NS:
        raise DataError(file, location, f"times with {offset_ns / 1e9:g} s added are beyond the year 2261")
    return timestamps_ns + offset_ns
