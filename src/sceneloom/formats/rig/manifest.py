"""A `rig.toml` as records, the files that it names below one folder, and the timestamps of each sensor's files."""

import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from enum import StrEnum
from math import isfinite
from pathlib import Path, PurePosixPath, PureWindowsPath
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes, why_no_file
from sceneloom.formats.base.text_tables import (
    FARTHEST_NS,
    FILE_COLUMNS,
    PLACEHOLDERS,
    TIME_COLUMNS,
    UNITS_NS,
    Table,
    TimestampError,
    line_timestamps,
    parse_timestamp,
    read_table,
    shifted,
)
from sceneloom.geometry.euler import ORDERS
from sceneloom.warnings import WarningKind

_SHOWN = 20
"""Lines that an error lists."""


_FILL_IN = "still to be filled in"
"""How the problem begins where a template's `nan` still stands."""


class Faults:
    """The faults found so far, each with its location in the manifest.

    Attributes:
        file: the manifest, for messages.
        labels: what people call the parts, by location ("sensors[1]").
    """

    def __init__(self, file: object) -> None:
        """Begin without faults."""
        self.file = file
        self.labels: dict[str, str] = {}
        self._errors: list[DataError] = []

    def add(self, location: str, problem: str) -> None:
        """Note a fault of the manifest."""
        self._errors.append(DataError(self.file, location, problem))

    def __len__(self) -> int:
        return len(self._errors)

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
        if errors:
            stated = [self._reported(error) for error in errors if not error.problem.startswith(_FILL_IN)]
            lines = [*stated, *self._to_fill_in(errors)]
            if len(lines) > _SHOWN:
                lines[_SHOWN:] = [f"… and {len(lines) - _SHOWN} lines more"]
            raise DataError(self.file, "", "\n  ".join([f"{len(errors)} faults", *lines]))

    def _labelled(self, error: DataError) -> str:
        part, dot, rest = error.location.partition(".")
        known = part in self.labels and error.file == str(self.file)
        return f"{part} ({self.labels[part]}){dot}{rest}" if known else error.location

    def _reported(self, error: DataError) -> str:
        if error.file == str(self.file):
            return ": ".join(filter(None, (error.location, error.problem)))
        return str(error)

    @staticmethod
    def _to_fill_in(errors: list[DataError]) -> list[str]:
        """One line per sensor for all that a template left open."""
        open_fields: dict[str, list[str]] = {}
        for error in errors:
            if error.problem.startswith(_FILL_IN):
                part, _, name = error.location.partition(".")
                open_fields.setdefault(part, []).append(name)
        return [f"{part}: {_FILL_IN}: {', '.join(names)}" for part, names in open_fields.items()]


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
    """One field of a record.

    Attributes:
        name: as in the file.
        kind: what it holds.
        about: what it says, for people.
        required: whether a manifest without it is at fault.
        unit: "m", "px", "s", …
        record: the record of a RECORD or RECORDS.
        choices: the words of a CHOICE.
        shapes: the lengths of a VECTOR, as (3,), or the sizes of a MATRIX, as (4, 4).
        positive: whether a number has to be above zero.
    """

    name: str
    kind: Kind
    about: str
    required: bool = False
    unit: str = ""
    record: str = ""
    choices: tuple[str, ...] = ()
    shapes: tuple[tuple[int, ...], ...] = ()
    positive: bool = False


_SENSOR_TYPES = ("lidar", "camera", "imu", "gnss")


_TIMESTAMPS = ("start", "middle", "end")


_UNITS = tuple(UNITS_NS)


_ID = _Field("id", Kind.TEXT, "name of the sensor in the scene; no other has it", required=True)


_TYPE = _Field("type", Kind.CHOICE, "what it measures", required=True, choices=_SENSOR_TYPES)


_FRAME = _Field("frame", Kind.TEXT, "name of the sensor's own frame; left out: its id")


_EXTRINSIC = _Field("extrinsic", Kind.RECORD, "where the sensor is, instead of a `[[transforms]]`", record="extrinsic")


_ROOT = _Field("root", Kind.TEXT, "folder of the files, seen from the manifest; left out: the manifest's `root`")


_OFFSET = _Field("time_offset_s", Kind.SECONDS, "added to every timestamp of the sensor", unit="s")


_UNIT = _Field("unit", Kind.CHOICE, "unit of the numbers", choices=_UNITS)


_TIMES = _Field("times", Kind.RECORD, "where the timestamps come from", required=True, record="times")


_FILES = _Field(
    "files", Kind.TEXTS, "pattern of the files below `root`: `lidar/*.pcd`, `**/*.bin`, or a list of patterns"
)


_CSV_FILE = _Field("file", Kind.TEXT, "the CSV file below `root`", required=True)


_COLUMNS = _Field("columns", Kind.NAMES, "column of the file by what it is, where its name does not report")


_MOUNTED = (_ID, _TYPE, _FRAME, _EXTRINSIC, _ROOT, _OFFSET)


_ROTATIONS = (
    _Field("translation", Kind.VECTOR, "origin of `from` seen in `to`", unit="m", shapes=((3,),)),
    _Field("quaternion_xyzw", Kind.VECTOR, "rotation, scalar last", shapes=((4,),)),
    _Field("quaternion_wxyz", Kind.VECTOR, "rotation, scalar first", shapes=((4,),)),
    _Field("rotation_matrix", Kind.MATRIX, "rotation, row by row", shapes=((3, 3),)),
    _Field("euler_deg", Kind.VECTOR, "angles about x, y and z, whatever the order", unit="°", shapes=((3,),)),
    _Field("euler_order", Kind.CHOICE, "order of the product: zyx is Rz·Ry·Rx", choices=ORDERS),
    _Field("matrix", Kind.MATRIX, "all in one: [R t; 0 0 0 1], row by row", unit="m", shapes=((4, 4), (3, 4))),
)


RECORDS: Mapping[str, tuple[_Field, ...]] = MappingProxyType(
    {
        "rig": (
            _Field("ego", Kind.TEXT, "the frame that the trajectory moves through the world; left out: base"),
            _Field(
                "root",
                Kind.TEXT,
                "folder of all files, absolute or seen from the manifest; left out: the manifest's",
            ),
            _Field("name", Kind.TEXT, "what the drive is called, for people"),
            _Field("transforms", Kind.RECORDS, "how the frames stand to each other", record="transform"),
            _Field("sensors", Kind.RECORDS, "the sensors", required=True, record="sensor"),
            _Field("trajectories", Kind.RECORDS, "ways through the world, the default first", record="trajectory"),
        ),
        "transform": (
            _Field("from", Kind.TEXT, "frame whose points go in", required=True),
            _Field("to", Kind.TEXT, "frame that they come out in: p_to = R·p_from + translation", required=True),
            *_ROTATIONS,
        ),
        "extrinsic": (
            _Field(
                "to",
                Kind.TEXT,
                "takes points of the sensor's frame into this frame: p_to = R·p + translation",
            ),
            _Field("from", Kind.TEXT, "instead of `to`: takes points of this frame into the sensor's frame"),
            *_ROTATIONS,
        ),
        "sensor lidar": (
            *_MOUNTED,
            _Field(_FILES.name, _FILES.kind, _FILES.about, required=True),
            _TIMES,
            _Field(
                "timestamp",
                Kind.CHOICE,
                "what of a sweep the timestamp means; left out: start",
                choices=_TIMESTAMPS,
            ),
            _Field(
                "sweep_s",
                Kind.SECONDS,
                "how long a sweep takes; left out: the median interval",
                unit="s",
                positive=True,
            ),
            _Field(
                "deskewed",
                Kind.FLAG,
                "true: all points are placed as at the timestamp, their times are not used",
            ),
            _Field("points_in", Kind.TEXT, "frame of the points, or `world`; left out: the sensor's own"),
            _Field("point_times", Kind.RECORD, "what the times of single points mean", record="point_times"),
            _Field("fields", Kind.TEXTS, "columns of `.bin`, or of rows in `.npz`: `x`, `ring:uint16`, `_:uint8`"),
            _Field("dtype", Kind.TEXT, "type of the `fields` that name none; left out: float32"),
            _Field(
                "use",
                Kind.NAMES,
                "column by what it is: x y z intensity ring red green blue, where names do not report",
            ),
            _Field(
                "intensity_max",
                Kind.NUMBER,
                "brightness that becomes 255; left out: seen in the first file",
                positive=True,
            ),
            _Field("model", Kind.TEXT, "name of the device"),
        ),
        "sensor camera": (
            *_MOUNTED,
            _FILES,
            _Field("video", Kind.TEXT, "a video below `root`, instead of `files`"),
            _TIMES,
            _Field("axes", Kind.AXES, "how the axes of the camera's frame lie; left out: optical"),
            _Field(
                "shutter_roll_s",
                Kind.SECONDS,
                "how long a rolling shutter takes from the first row to the last; left out: all at once",
                unit="s",
                positive=True,
            ),
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
            _Field(
                "pattern",
                Kind.TEXT,
                "timestamps in the file names: `{ns}`, `{s}_{ns}`, `*_{us}`, `{index}` with a rate",
            ),
            _Field("csv", Kind.TEXT, "timestamps in a CSV file below `root`"),
            _Field("column", Kind.TEXT, "column of the timestamps in the CSV; left out: timestamp, time, t, …"),
            _Field(
                "file_column",
                Kind.TEXT,
                "column of the file names in the CSV; left out: file, filename, … if any",
            ),
            _Field(
                "lines",
                Kind.TEXT,
                "timestamps in a text file below `root`, one line per file: numbers or dates",
            ),
            _Field("rate_hz", Kind.NUMBER, "files come evenly, so many a second", unit="1/s", positive=True),
            _Field(
                "start_s",
                Kind.SECONDS,
                "timestamp of index 0, or of a video's first image; left out: 0",
                unit="s",
            ),
            _Field("container", Kind.FLAG, "true: the times that the video itself has"),
            _UNIT,
        ),
        "point_times": (
            _Field("field", Kind.TEXT, "column of the times; left out: time, t, timestamp, …"),
            _Field("unit", Kind.CHOICE, "unit of the column", required=True, choices=_UNITS),
            _Field(
                "relative_to",
                Kind.CHOICE,
                "what they count from: the file's timestamp, the sweep's start, or the clock's zero; left out: "
                "timestamp",
                choices=("timestamp", "start", "clock"),
            ),
        ),
        "camera_model": (
            _Field("model", Kind.TEXT, "projection model; left out: pinhole, or brown_conrady with coefficients"),
            _Field(
                "width",
                Kind.INTEGER,
                "image size that the numbers hold for; left out: the images'",
                unit="px",
                positive=True,
            ),
            _Field("height", Kind.INTEGER, "the same", unit="px", positive=True),
            _Field("fx", Kind.NUMBER, "focal length", unit="px", positive=True),
            _Field("fy", Kind.NUMBER, "focal length; left out: fx", unit="px", positive=True),
            _Field("cx", Kind.NUMBER, "principal point; (0, 0) is the centre of the first pixel", unit="px"),
            _Field("cy", Kind.NUMBER, "the same", unit="px"),
            _Field("K", Kind.MATRIX, "instead of fx fy cx cy", unit="px", shapes=((3, 3),)),
            _Field(
                "P",
                Kind.MATRIX,
                "instead of them: K·[I t], as KITTI and ROS give it",
                unit="px",
                shapes=((3, 4),),
            ),
            _Field("coefficients", Kind.NUMBERS, "distortion: a list in OpenCV's order, or by name"),
            _Field("undistorted", Kind.FLAG, "true: the images are rectified, so the coefficients are not used"),
        ),
        "trajectory": (
            _Field("name", Kind.TEXT, "what it is called; left out: pose"),
            _Field("file", Kind.TEXT, "the file below `root`", required=True),
            _Field("form", Kind.CHOICE, "how it is written", required=True, choices=("tum", "kitti", "csv")),
            _Field("frame", Kind.TEXT, "the frame whose trajectory it is; left out: the ego's"),
            _Field("world_axes", Kind.CHOICE, "axes of its world; left out: z_up", choices=("z_up", "optical")),
            _Field("times", Kind.TEXT, "timestamps of a kitti file: a text file, one line per pose"),
            _COLUMNS,
            _UNIT,
            _ROOT,
            _OFFSET,
        ),
    }
)
"""Every record by name, its fields in the order in which they are explained."""


def _fields_of(record: str) -> Mapping[str, _Field]:
    """The fields of a record by name."""
    return MappingProxyType({field.name: field for field in RECORDS[record]})


def _inner_records(record: str) -> Mapping[str, str]:
    """The record of each field of a record that holds one, by the field's name."""
    return MappingProxyType({field.name: field.record for field in RECORDS[record] if field.record in RECORDS})


Record = dict[str, Any]
"""A record as read: values by name, absent ones left out."""


_FARTHEST_S = Decimal("9.2e9")


_LARGEST = 1e15


class _FieldError(ValueError):
    """A value is not what its field holds."""


def read_record(raw: Mapping[str, Any], record: str, location: str, faults: Faults) -> Record:
    """Read one record; fields that are at fault are noted and left out.

    Args:
        raw: as `tomllib` gives it, numbers with a point as Decimal.
        record: its name in the table.
        location: where it stands, for messages.
        faults: takes all that is wrong.
    """
    fields = _fields_of(record)
    values: Record = {}
    for name, value in raw.items():
        where = f"{location}.{name}" if location else name
        if name not in fields:
            faults.add(where, f"unknown; {_nearest(name, record)}")
            continue
        try:
            values[name] = _READERS[fields[name].kind](value, fields[name], where, faults)
        except _FieldError as error:
            faults.add(where, str(error))
    for field in fields.values():
        if field.required and field.name not in raw:
            faults.add(
                f"{location}.{field.name}" if location else field.name,
                f"missing; expected {_expected(field)}",
            )
    return values


def _nearest(name: str, record: str) -> str:
    """Name the known field that is most like an unknown one, here or one table further in."""
    known = [*_fields_of(record)]
    close = get_close_matches(name, known, 1, 0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    for inner, inner_record in _inner_records(record).items():
        if name in _fields_of(inner_record):
            return f"did you mean {inner}.{name}?"
    return f"expected one of {', '.join(known)}"


def _expected(field: _Field) -> str:
    if field.choices:
        return f"one of {', '.join(field.choices)}"
    if field.shapes:
        return " or ".join(_shape(shape) for shape in field.shapes)
    unit = f" ({field.unit})" if field.unit else ""
    return f"{field.kind.value}{unit}{', above 0' if field.positive else ''}: {field.about}"


def _shape(shape: tuple[int, ...]) -> str:
    if len(shape) == 1:
        return f"a list of {shape[0]} numbers"
    return f"{shape[0]} rows of {shape[1]} numbers"


def _found(value: Any) -> str:
    if isinstance(value, list | dict):
        return f"a {'list' if isinstance(value, list) else 'table'} of {len(value)}"
    text = str(value) if isinstance(value, Decimal) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _wrong(value: Any, field: _Field) -> _FieldError:
    return _FieldError(f"{_found(value)}; expected {_expected(field)}")


def _read_text(value: Any, field: _Field, location: str, faults: Faults) -> str:
    del location, faults
    if isinstance(value, str) and value.strip() and "\0" not in value:
        return value
    raise _wrong(value, field)


def _read_texts(value: Any, field: _Field, location: str, faults: Faults) -> list[str]:
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list) or not texts:
        raise _wrong(value, field)
    return [_read_text(text, field, location, faults) for text in texts]


def _read_choice(value: Any, field: _Field, location: str, faults: Faults) -> str:
    del location, faults
    if isinstance(value, str) and value in field.choices:
        return value
    close = get_close_matches(value, field.choices, 1, 0.5) if isinstance(value, str) else []
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise _FieldError(f"{_found(value)}; expected {_expected(field)}{hint}")


def _read_flag(value: Any, field: _Field, location: str, faults: Faults) -> bool:
    del location, faults
    if isinstance(value, bool):
        return value
    raise _wrong(value, field)


def _read_integer(value: Any, field: _Field, location: str, faults: Faults) -> int:
    del location, faults
    if type(value) is int and abs(value) < _LARGEST and (value > 0 or not field.positive):
        return value
    if _is_nan(value):
        raise _FieldError(f"{_FILL_IN}: {field.about}")
    raise _wrong(value, field)


def _is_nan(value: Any) -> bool:
    return isinstance(value, Decimal | float) and value != value  # noqa: PLR0124 - a Decimal has no cheaper test


def _number(value: Any, field: _Field) -> float:
    if _is_nan(value):
        raise _FieldError(f"{_FILL_IN}: {field.about}" + (f" [{field.unit}]" if field.unit else ""))
    if type(value) in {int, float, Decimal} and abs(value) < _LARGEST and isfinite(value):
        return float(value)
    raise _wrong(value, field)


def _read_number(value: Any, field: _Field, location: str, faults: Faults) -> float:
    del location, faults
    number = _number(value, field)
    if field.positive and not number > 0:
        raise _wrong(value, field)
    return number


def _read_seconds(value: Any, field: _Field, location: str, faults: Faults) -> int:
    """Read seconds as nanoseconds, exactly."""
    del location, faults
    if _is_nan(value):
        raise _FieldError(f"{_FILL_IN}: {field.about} [s]")
    try:
        number = Decimal(value) if type(value) in {int, Decimal} else Decimal("Infinity")
        if not abs(number) <= _FARTHEST_S or (field.positive and not number > 0):
            raise _wrong(value, field)
    except InvalidOperation:
        raise _wrong(value, field) from None
    return int((number * 10**9).to_integral_value())


def _read_vector(value: Any, field: _Field, location: str, faults: Faults) -> Any:
    del location, faults
    if not isinstance(value, list) or (len(value),) not in field.shapes:
        raise _wrong(value, field)
    return np.array([_number(item, field) for item in value])


def _read_matrix(value: Any, field: _Field, location: str, faults: Faults) -> Any:
    del location, faults
    rows = value if isinstance(value, list) else []
    widths = {len(row) if isinstance(row, list) else -1 for row in rows}
    if len(widths) != 1 or (len(rows), *widths) not in field.shapes:
        raise _wrong(value, field)
    return np.array([[_number(item, field) for item in row] for row in rows])


def _read_numbers(value: Any, field: _Field, location: str, faults: Faults) -> Any:
    del location, faults
    if isinstance(value, list):
        return [_number(item, field) for item in value]
    if isinstance(value, dict):
        return {name: _number(item, field) for name, item in value.items()}
    raise _wrong(value, field)


def _read_names(value: Any, field: _Field, location: str, faults: Faults) -> dict[str, str]:
    if not isinstance(value, dict):
        raise _wrong(value, field)
    return {name: _read_text(item, field, location, faults) for name, item in value.items()}


def _read_axes(value: Any, field: _Field, location: str, faults: Faults) -> tuple[str, ...]:
    """Read axes as the three of them that are right, down and forward, or as one word."""
    del location, faults
    if isinstance(value, dict) and set(value) == {"right", "down", "forward"}:
        value = ",".join(map(str, (value["right"], value["down"], value["forward"])))
    if not isinstance(value, str):
        raise _wrong(value, field)
    return tuple(word.strip().lower() for word in value.split(","))


def _read_inner(value: Any, field: _Field, location: str, faults: Faults) -> Record:
    if not isinstance(value, dict):
        raise _wrong(value, field)
    return read_record(value, field.record, location, faults)


def _read_list(value: Any, field: _Field, location: str, faults: Faults) -> list[Record]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise _FieldError(f"{_found(value)}; expected {field.kind.value}: one `[[{field.name}]]` each")
    read = _read_sensor if field.record == "sensor" else read_record
    for k, item in enumerate(value):
        label = item.get("id", item.get("name"))
        if isinstance(label, str):
            faults.labels[f"{location}[{k}]"] = label
    return [read(item, field.record, f"{location}[{k}]", faults) for k, item in enumerate(value)]


def _read_sensor(raw: Mapping[str, Any], record: str, location: str, faults: Faults) -> Record:
    """Read a sensor by the record of its type; of one without a known type only the type is judged."""
    del record
    kind = raw.get("type")
    if kind in _SENSOR_TYPES:
        return read_record(raw, f"sensor {kind}", location, faults)
    field = _fields_of(f"sensor {_SENSOR_TYPES[0]}")["type"]
    if kind is None:
        close = get_close_matches("type", raw, 1, 0.6)
        hint = f"; {close[0]!r} is unknown: is it meant?" if close else ""
        faults.add(f"{location}.type", f"missing; expected {_expected(field)}{hint}")
    else:
        try:
            _read_choice(kind, field, location, faults)
        except _FieldError as error:
            faults.add(f"{location}.type", str(error))
    return {}


_READERS: Mapping[Kind, Callable[[Any, _Field, str, Faults], Any]] = {
    Kind.TEXT: _read_text,
    Kind.TEXTS: _read_texts,
    Kind.CHOICE: _read_choice,
    Kind.FLAG: _read_flag,
    Kind.INTEGER: _read_integer,
    Kind.NUMBER: _read_number,
    Kind.SECONDS: _read_seconds,
    Kind.VECTOR: _read_vector,
    Kind.MATRIX: _read_matrix,
    Kind.NUMBERS: _read_numbers,
    Kind.NAMES: _read_names,
    Kind.AXES: _read_axes,
    Kind.RECORD: _read_inner,
    Kind.RECORDS: _read_list,
}


if not {field.kind for record in RECORDS.values() for field in record} <= set(_READERS):
    raise TypeError("a kind of the table of fields has no reader")


_NAMED = (("sensors", "id"), ("trajectories", "name"))


_LARGEST_MANIFEST = 16_000_000


_LARGEST_EXPONENT = 40


@dataclass(frozen=True, slots=True)
class Manifest:
    """A manifest that the table of fields finds nothing wrong with.

    Attributes:
        path: the file.
        record: its fields.
    """

    path: Path
    record: Record

    @property
    def ego(self) -> str:
        """The frame that moves through the world."""
        return str(self.record.get("ego", "base"))

    def faults(self) -> Faults:
        """A collection of faults that knows what the parts are called."""
        faults = Faults(self.path)
        for name, key in _NAMED:
            faults.labels.update({location: record[key] for location, record in self.records(name) if key in record})
        return faults

    def records(self, name: str) -> list[tuple[str, Record]]:
        """The tables of a list, each with its location."""
        return [(f"{name}[{k}]", record) for k, record in enumerate(self.record.get(name, []))]


def has_sensors(path: Path) -> bool:
    """Whether a file is TOML with sensors in it."""
    try:
        return "sensors" in _parse(path)
    except DataError:
        return False


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        DataError: the file cannot be read, is no TOML, or has faults; all of them are reported at once.
    """
    raw = _parse(path)
    faults = Faults(path)
    record = read_record(raw, "rig", "", faults)
    _check_ids(record, faults)
    faults.raise_all()
    return Manifest(path, record)


def _check_ids(record: Record, faults: Faults) -> None:
    for name, key in _NAMED:
        seen: dict[str, int] = {}
        for k, inner in enumerate(record.get(name, [])):
            identifier = inner.get(key)
            if identifier in seen:
                faults.add(f"{name}[{k}].{key}", f"{identifier!r} is also that of {name}[{seen[identifier]}]")
            elif identifier is not None:
                seen[identifier] = k
    if record.get("sensors") == []:
        faults.add("sensors", "an empty list; expected at least one `[[sensors]]`")


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
    """Keep all digits of a number, so that no time is rounded; numbers beyond all reason are infinite or zero."""
    try:
        number = Decimal(text)
    except InvalidOperation:
        return Decimal("Infinity")
    if not number.is_finite() or number == 0:
        return number
    if abs(number.adjusted()) <= _LARGEST_EXPONENT:
        return number
    return Decimal("Infinity") if number.adjusted() > 0 else Decimal(0)


_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True, slots=True)
class Root:
    """A folder whose files a manifest may name.

    Attributes:
        folder: resolved.
        manifest: for messages.
    """

    folder: Path
    manifest: Path

    def file(self, name: str, location: str) -> Path:
        """Find one file.

        Raises:
            DataError: there is no such file, or it lies outside the folder.
        """
        path = self.folder / self._checked(name, location)
        if not path.is_file():
            raise DataError(self.manifest, location, f"{name!r}: {why_no_file(path)} in {self.folder}")
        self._check_inside([path], location)
        return path

    def files(self, patterns: Sequence[str], location: str) -> list[Path]:
        """Find the files of some patterns, in the order in which people number them: 2 before 10.

        Raises:
            DataError: there is none, one is no regular file, or one lies outside the folder.
        """
        found: set[Path] = set()
        for pattern in patterns:
            try:
                matches = [path for path in self.folder.glob(self._checked(pattern, location)) if not path.is_dir()]
            except (ValueError, NotImplementedError, IndexError, re.error) as error:
                raise DataError(self.manifest, location, f"{pattern!r} is no pattern: {error}") from error
            if not matches:
                raise DataError(
                    self.manifest,
                    location,
                    f"{pattern!r}: no such files in {self.folder}{self._hint(pattern)}",
                )
            found.update(matches)
        files = sorted(found, key=natural_key)
        odd = next((path for path in files if not path.is_file()), None)
        if odd is not None:
            raise DataError(self.manifest, location, f"{self.relative(odd)!r}: {why_no_file(odd)}")
        self._check_inside(files, location)
        return files

    def relative(self, path: Path) -> str:
        """What a file is called seen from the folder."""
        # of many thousands of files, each asked for: cutting the text is ten times as fast as `relative_to`
        return str(path)[len(str(self.folder)) :].lstrip(os.sep).replace(os.sep, "/")

    def _checked(self, name: str, location: str) -> str:
        windows = PureWindowsPath(name)
        outside = PurePosixPath(name).is_absolute() or windows.drive or windows.root or ".." in windows.parts
        if outside:
            problem = f"{name!r}; expected a path below {self.folder}; name another folder with `root`"
            raise DataError(self.manifest, location, problem)
        return name

    def _check_inside(self, files: Sequence[Path], location: str) -> None:
        """Refuse links that lead out; folders are looked up once each."""
        resolved: dict[Path, bool] = {}
        for path in files:
            if path.parent not in resolved:
                resolved[path.parent] = path.parent.resolve().is_relative_to(self.folder)
            inside = resolved[path.parent]
            if inside and path.is_symlink():
                inside = path.resolve().is_relative_to(self.folder)
            if not inside:
                problem = (
                    f"{self.relative(path)!r} leads out of {self.folder} by a link, to {path.resolve()}; "
                    "name the folder that the files are in as `root`"
                )
                raise DataError(self.manifest, location, problem)

    def _hint(self, pattern: str) -> str:
        """Report what there is instead of a pattern without matches."""
        folder = self.folder
        for part in PurePosixPath(pattern).parts[:-1]:
            if any(sign in part for sign in "*?["):
                break
            if not (folder / part).is_dir():
                return f"; {folder.name or folder} has {_folders_in(folder)}{_spelling_hint(pattern)}"
            folder /= part
        suffixes = sorted({entry.suffix for entry in folder.iterdir() if entry.is_file() and entry.suffix})
        held = ", ".join("*" + suffix for suffix in suffixes[:10]) or "no files"
        also = f" and {_folders_in(folder)}" if folder == self.folder else ""
        return f"; {folder.name or folder} has {held}{also}{_spelling_hint(pattern)}"


def _folders_in(folder: Path) -> str:
    names = sorted(entry.name for entry in folder.iterdir() if entry.is_dir())
    return f"the folders {', '.join(names[:10])}" if names else "no folders"


def _spelling_hint(pattern: str) -> str:
    """Explain signs that mean something else in a pattern than in a name."""
    if "\\" in pattern:
        return "; folders are parted by /, also on Windows"
    return "; [ ] stand for a choice of signs: write [[] for the sign [" if "[" in pattern else ""


def natural_key(path: Path) -> tuple[tuple[int, int, str], ...]:
    """Order numbers inside names by their value."""
    parts = _DIGITS.split(path.as_posix())
    return tuple((1, int(part), part) if part.isdecimal() and part.isascii() else (0, 0, part) for part in parts)


def open_root(manifest: Path, names: Sequence[str | None], location: str) -> Root:
    """Find the folder of some files.

    Args:
        manifest: the manifest, from whose folder a relative root is seen.
        names: `root` of the sensor and of the manifest, None where not stated; the first that is stated counts.

    Raises:
        DataError: there is no such folder.
    """
    name = next((name for name in names if name is not None), None)
    folder = manifest.parent if name is None else manifest.parent / Path(name).expanduser()
    try:
        resolved = folder.resolve()
    except (OSError, RuntimeError) as error:
        raise DataError(manifest, location, f"{name!r} cannot be read: {error}") from error
    if not resolved.is_dir():
        raise DataError(manifest, location, f"{name!r}: no such folder; expected the folder of the files")
    return Root(resolved, manifest)


_TIMES_TRAJECTORIES = ("pattern", "csv", "lines", "rate_hz", "container")
"""The fields of `times` that each state where timestamps come from; a pattern of indices needs a rate beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Timestamps:
    """Which items of a sensor are used, and when they are of.

    Attributes:
        chosen: (N,) int64, index among the files or images, in the order of time.
        timestamps_ns: (N,) int64 [ns], strictly increasing.
    """

    chosen: Int64Array
    timestamps_ns: Int64Array


def drop_unreadable(timestamps: Timestamps, read: Callable[[int], object], ledger: Ledger) -> Timestamps:
    """Leave out the first files as long as they cannot be read: what a sensor is like is seen in its first one.

    Args:
        timestamps: of at least one file.
        read: looks into one file, by its index among all files.
        ledger: of a lenient reading; in another one the first file is as good as any, and nothing is tried.

    Raises:
        DataError: no file can be read; the last one's fault.
    """
    if not ledger.lenient:
        return timestamps
    for row, k in enumerate(timestamps.chosen.tolist()):
        try:
            read(k)
        except DataError as error:
            if row == len(timestamps.chosen) - 1:
                raise
            ledger.fault("unreadable-files", error)
        else:
            return Timestamps(timestamps.chosen[row:], timestamps.timestamps_ns[row:])
    return timestamps


@dataclass(frozen=True, slots=True)
class TimeSource:
    """What the timestamps of one sensor are read with.

    Attributes:
        record: the `times` of the sensor.
        location: where it stands in the manifest.
        manifest: the file, for messages.
        root: folder of the sensor's files.
        offset_ns: added to every timestamp [ns].
        ledger: takes warnings, and faults in a lenient reading.
    """

    record: Record
    location: str
    manifest: Path
    root: Root
    offset_ns: int
    ledger: Ledger

    def timestamp_files(self, files: Sequence[Path]) -> Timestamps:
        """Give the times of files, which stand in the order of their names.

        Raises:
            DataError: a time is missing, no time, or that of two files.
        """
        trajectory = self._trajectory(("pattern", "csv", "lines", "rate_hz"))
        names = [self.root.relative(path) for path in files]
        chosen, times = _TRAJECTORIES[trajectory](self, names)
        return self._in_order(chosen, times, names)

    def timestamp_images(self, count: int, container_ns: Callable[[], Int64Array], name: str) -> Timestamps:
        """Give the times of the images of a video, which have numbers instead of names.

        Args:
            count: how many images it has.
            container_ns: gives the times that the video has itself.
            name: of the video, for messages.
        """
        trajectory = self._trajectory(("csv", "lines", "rate_hz", "container"))
        names = [f"{name} image {k}" for k in range(count)]
        if trajectory == "container":
            timestamps = shifted(container_ns(), self._start_ns(), self.manifest, f"{self.location}.start_s")
            return self._in_order(np.arange(count), timestamps, names)
        if trajectory == "csv":
            chosen, times = self._in_parallel(*self._csv_times(), count)
        else:
            chosen, times = _TRAJECTORIES[trajectory](self, names)
        return self._in_order(chosen, times, names)

    def _trajectory(self, possible: Sequence[str]) -> str:
        stated = [trajectory for trajectory in _TIMES_TRAJECTORIES if self.record.get(trajectory) not in (None, False)]
        indexed = stated == ["pattern", "rate_hz"]
        if len(stated) != 1 and not indexed:
            found = ", ".join(stated) or "none of them"
            raise DataError(self.manifest, self.location, f"{found}; expected exactly one of {', '.join(possible)}")
        if stated[0] not in possible:
            raise DataError(self.manifest, self.location, f"{stated[0]}; expected one of {', '.join(possible)} here")
        return stated[0]

    def _start_ns(self) -> int:
        return int(self.record.get("start_s", 0))

    def _evenly(self, indices: Sequence[int]) -> Int64Array:
        """Times of numbered files, rounded once each, so that no error adds up."""
        period = Decimal(10**9) / Decimal(str(self.record["rate_hz"]))
        timestamps = [int((index * period).to_integral_value()) + self._start_ns() for index in indices]
        if timestamps and max(map(abs, timestamps)) > FARTHEST_NS:
            raise DataError(self.manifest, self.location, f"index {max(indices)}: its time is beyond the year 2261")
        return np.array(timestamps, np.int64)

    def by_pattern(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Read the times out of the names."""
        where = f"{self.location}.pattern"
        try:
            pattern = NamePattern(self.record["pattern"])
        except TimestampError as error:
            raise DataError(self.manifest, where, str(error)) from None
        if pattern.indexed != ("rate_hz" in self.record):
            expected = "`rate_hz` beside {index}" if pattern.indexed else "{index} in the pattern beside `rate_hz`"
            raise DataError(self.manifest, self.location, f"{self.record['pattern']!r}; expected {expected}")
        chosen, values = [], []
        for k, name in enumerate(names):
            try:
                values.append(pattern.read(name.rpartition("/")[2]))
                chosen.append(k)
            except TimestampError as error:
                self.ledger.fault("names-without-time", DataError(self.manifest, where, str(error)))
        times = self._evenly(values) if pattern.indexed else np.array(values, np.int64)
        return np.array(chosen, np.int64), times

    def by_rate(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Count the files."""
        return np.arange(len(names)), self._evenly(range(len(names)))

    def by_lines(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Take one line of a text file per file."""
        path = self.root.file(self.record["lines"], f"{self.location}.lines")
        return self._in_parallel(path, line_timestamps(path, self.record.get("unit")), len(names))

    def by_csv(self, names: Sequence[str]) -> tuple[Int64Array, Int64Array]:
        """Take the rows of a CSV file, by the names of files in them where there are, else in parallel."""
        table, path = self._table()
        timestamps = table.timestamps(self._time_column(table), self.record.get("unit"))
        column = self._file_column(table)
        if column is None:
            return self._in_parallel(path, timestamps, len(names))
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
                continue
            problem = f"{cells[column]!r} is {len(match) or 'none'} of the sensor's files"
            fault = DataError(path, f"line {table.lines[row]}", f"{problem}; expected exactly one")
            self.ledger.fault("rows-without-file", fault)
        self._note_unused(path, len(names) - len(set(chosen)))
        return np.array(chosen, np.int64), timestamps[rows]

    def _note_unused(self, path: Path, count: int) -> None:
        if count:
            message = "has no time for some files; they were left out"
            self.ledger.note(WarningKind.SKIPPED, "files-without-time", str(path), message, count=count)

    def _table(self) -> tuple[Table, Path]:
        path = self.root.file(self.record["csv"], f"{self.location}.csv")
        return read_table(path), path

    def _csv_times(self) -> tuple[Path, Int64Array]:
        table, path = self._table()
        return path, table.timestamps(self._time_column(table), self.record.get("unit"))

    def _time_column(self, table: Table) -> int:
        name = self.record.get("column")
        found = table.find(TIME_COLUMNS) if name is None else table.column(name)
        if found is None:
            problem = f"no column of times among {', '.join(table.names)}; name it with `column`"
            raise DataError(table.path, "line 1", problem)
        return found

    def _file_column(self, table: Table) -> int | None:
        name = self.record.get("file_column")
        return table.find(FILE_COLUMNS) if name is None else table.column(name)

    def _in_parallel(self, path: Path, timestamps: Int64Array, count: int) -> tuple[Int64Array, Int64Array]:
        if len(timestamps) != count:
            problem = f"{len(timestamps)} times for {count} files or images; expected as many"
            self.ledger.fault("counts-disagree", DataError(path, "", problem), count=abs(count - len(timestamps)))
        used = min(len(timestamps), count)
        return np.arange(used), timestamps[:used]

    def _in_order(self, chosen: Int64Array, times: Int64Array, names: Sequence[str]) -> Timestamps:
        timestamps = shifted(times, self.offset_ns, self.manifest, self.location)
        if len(timestamps) > 1 and (timestamps[1:] < timestamps[:-1]).any():
            message = "times run backwards in the order of the names; sorted by time"
            location = f"{self.manifest}: {self.location}"
            back = int((timestamps[1:] < timestamps[:-1]).sum())
            self.ledger.note(WarningKind.REPAIRED, "files-sorted", location, message, count=back)
        order = np.argsort(timestamps, kind="stable")
        chosen, timestamps = chosen[order], timestamps[order]
        repeated = np.flatnonzero(np.diff(timestamps) == 0) + 1
        if len(repeated):
            k = int(repeated[0])
            problem = (
                f"{names[chosen[k - 1]]!r} and {names[chosen[k]]!r} have the same time, {timestamps[k] / 1e9:.9f} s; "
                "expected one file per time"
            )
            self.ledger.fault("repeated-times", DataError(self.manifest, self.location, problem), count=len(repeated))
            kept = np.ones(len(timestamps), np.bool_)
            kept[repeated] = False
            chosen, timestamps = chosen[kept], timestamps[kept]
        return Timestamps(chosen, timestamps)


_TRAJECTORIES: Mapping[str, Callable[[TimeSource, Sequence[str]], tuple[Int64Array, Int64Array]]] = {
    "pattern": TimeSource.by_pattern,
    "csv": TimeSource.by_csv,
    "lines": TimeSource.by_lines,
    "rate_hz": TimeSource.by_rate,
}


class NamePattern:
    """A pattern of file names with numbers in it: `{s}_{ns}`, `*__{us}`, `frame_{index}`.

    `*` stands for any text. Units that are named add up. The pattern has to fit the whole name, or the whole name
    without its endings.

    Attributes:
        indexed: whether the names hold an index instead of a time.
    """

    def __init__(self, pattern: str) -> None:
        """Compile the pattern.

        Raises:
            TimestampError: it names nothing, something unknown, or something twice.
        """
        self._text = pattern
        expression, names = "", []
        for part in re.split(r"(\{[^{}]*\}|\*)", pattern):
            if part == "*":
                expression += ".*?"
            elif part.startswith("{") and part.endswith("}"):
                names.append(part[1:-1])
                digits = r"\d+\.\d+|\d+" if part == "{s}" else r"\d+"
                expression += f"(?P<{part[1:-1]}>{digits})" if names[-1] in (*PLACEHOLDERS, "index") else ""
            else:
                expression += re.escape(part)
        known = ", ".join(f"{{{name}}}" for name in (*PLACEHOLDERS, "index"))
        unknown = [name for name in names if name not in (*PLACEHOLDERS, "index")]
        if unknown or not names or len(set(names)) != len(names) or ("index" in names and len(names) > 1):
            raise TimestampError(f"{pattern!r}; expected some of {known}, each once, {{index}} alone")
        self.indexed = names == ["index"]
        self._expression = re.compile(expression, re.ASCII)

    def read(self, name: str) -> int:
        """Read the time [ns], or the index, out of a file name.

        Raises:
            TimestampError: the name does not fit.
        """
        match = self._match(name)
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

    def _match(self, name: str) -> "re.Match[str] | None":
        while name:
            match = self._expression.fullmatch(name)
            if match is not None or "." not in name:
                return match
            name = name.rpartition(".")[0]
        return None
