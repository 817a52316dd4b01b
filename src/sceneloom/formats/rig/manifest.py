"""A `rig.toml` as records: the table of its fields, and the faults that are found when it is read."""

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.text_tables import UNITS_NS
from sceneloom.geometry.euler import ORDERS

Record = dict[str, Any]
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
class Manifest:
    """A manifest without faults in its fields: the file, and its record."""

    path: Path
    record: Record

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

    def records(self, name: str) -> list[tuple[str, Record]]:
        """The tables of a list, each with its location."""
        return [(f"{name}[{k}]", record) for k, record in enumerate(self.record.get(name, []))]


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        DataError: the file cannot be read, is not TOML, or has faults; all of them are reported at once.
    """
    raw = _parse(path)
    faults = Faults(path)
    manifest = Manifest(path, read_record(raw, "rig", "", faults))
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


def has_sensors(path: Path) -> bool:
    """Whether a file is TOML with sensors in it."""
    try:
        return "sensors" in _parse(path)
    except DataError:
        return False


def _parse(path: Path) -> Record:
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


def read_record(raw: Mapping[str, Any], record: str, location: str, faults: Faults) -> Record:
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
    values: Record = {}
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


def _read_list(items: list[Record], field: _Field, location: str, faults: Faults) -> list[Record]:
    for k, item in enumerate(items):
        label = item.get("id", item.get("name"))
        if isinstance(label, str):
            faults.labels[f"{location}[{k}]"] = label
    return [read_record(item, field.record, f"{location}[{k}]", faults) for k, item in enumerate(items)]
