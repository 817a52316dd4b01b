"""The table of fields of a `rig.toml`, and reading by it: kinds are checked, seconds become nanoseconds.

All faults are collected.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from difflib import get_close_matches
from enum import StrEnum
from math import isfinite
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.points.mapping import UNITS_NS
from sceneloom.geometry.euler import ORDERS

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

_EXTRINSIC = _Field(
    "extrinsic", Kind.RECORD, "where the sensor is, instead of a `[[transforms]]`", record="extrinsic"
)

_ROOT = _Field(
    "root", Kind.TEXT, "folder of the files, seen from the manifest; left out: the manifest's `root`"
)

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
    _Field(
        "matrix", Kind.MATRIX, "all in one: [R t; 0 0 0 1], row by row", unit="m", shapes=((4, 4), (3, 4))
    ),
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
            _Field(
                "trajectories", Kind.RECORDS, "ways through the world, the default first", record="trajectory"
            ),
        ),
        "transform": (
            _Field("from", Kind.TEXT, "frame whose points go in", required=True),
            _Field(
                "to", Kind.TEXT, "frame that they come out in: p_to = R·p_from + translation", required=True
            ),
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
            _Field(
                "fields", Kind.TEXTS, "columns of `.bin`, or of rows in `.npz`: `x`, `ring:uint16`, `_:uint8`"
            ),
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
            _Field(
                "column", Kind.TEXT, "column of the timestamps in the CSV; left out: timestamp, time, t, …"
            ),
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
            _Field(
                "model", Kind.TEXT, "projection model; left out: pinhole, or brown_conrady with coefficients"
            ),
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
            _Field(
                "undistorted", Kind.FLAG, "true: the images are rectified, so the coefficients are not used"
            ),
        ),
        "trajectory": (
            _Field("name", Kind.TEXT, "what it is called; left out: pose"),
            _Field("file", Kind.TEXT, "the file below `root`", required=True),
            _Field("form", Kind.CHOICE, "how it is written", required=True, choices=("tum", "kitti", "csv")),
            _Field("frame", Kind.TEXT, "the frame whose trajectory it is; left out: the ego's"),
            _Field(
                "world_axes", Kind.CHOICE, "axes of its world; left out: z_up", choices=("z_up", "optical")
            ),
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
    return MappingProxyType(
        {field.name: field.record for field in RECORDS[record] if field.record in RECORDS}
    )


Record = dict[str, Any]
"""A record as read: values by name, absent ones left out."""

_FARTHEST_S = Decimal("9.2e9")

_LARGEST = 1e15


class FieldError(ValueError):
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
        except FieldError as error:
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


def _wrong(value: Any, field: _Field) -> FieldError:
    return FieldError(f"{_found(value)}; expected {_expected(field)}")


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
    raise FieldError(f"{_found(value)}; expected {_expected(field)}{hint}")


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
        raise FieldError(f"{_FILL_IN}: {field.about}")
    raise _wrong(value, field)


def _is_nan(value: Any) -> bool:
    return isinstance(value, Decimal | float) and value != value  # noqa: PLR0124 - a Decimal has no cheaper test


def _number(value: Any, field: _Field) -> float:
    if _is_nan(value):
        raise FieldError(f"{_FILL_IN}: {field.about}" + (f" [{field.unit}]" if field.unit else ""))
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
        raise FieldError(f"{_FILL_IN}: {field.about} [s]")
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
        raise FieldError(f"{_found(value)}; expected {field.kind.value}: one `[[{field.name}]]` each")
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
        except FieldError as error:
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
