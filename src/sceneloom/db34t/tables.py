"""Tables 3 to 10 of DB34/T 4101-2022, row by row: name, type, unit and check of each field.

Records, encodings, documentation and the conformance kit are derived from them.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import AnyArray, read_only
from sceneloom.db34t.types import (
    INTEGER_RANGES,
    BasicType,
    Timestamp,
    ValueForm,
    ValueType,
    check_basic,
    shown,
)
from sceneloom.errors import DataError

TIME = "uint32. uint32"
"""How the standard writes the type of a timestamp."""

_CLASS = "enum"
"""The type of classes, which are names here."""

STREAM = "int8[]"
"""How it writes the type of raw bytes."""

ARRAY_DTYPES: Mapping[str, np.dtype[Any]] = {"uint8[]": np.dtype(np.uint8), "float[]": np.dtype(np.float32)}
"""The types of fields that are arrays of any length, and what they are in memory."""

_FEW = 1000
"""Of fewer numbers it is quicker to look at each than for the smallest and the largest."""


@dataclass(frozen=True, slots=True)
class Row:
    """One field of a record.

    Attributes:
        number: of the row in its table, from 1; from 100 on a field that the standard does not have.
        name: the standard's name.
        type: as the standard writes it.
        meaning: what it says.
        unit: "" for none.
        low, high: the smallest and largest value that makes sense, each included; None for those of the type.
        above: `low` itself makes no sense.
        finite: whether every number has to be finite; points without a position are dropped when they are used.
        required: whether it has to be there.
        default: what it is where it is not there.
        size: how many values an array has, in words of other fields.
        example: the standard's.
        attribute: of the record in Python; "" for `name`.
        aliases: names that are read, too: those of the same field in other tables.
        value_type: what `type` means; None for a timestamp.
        whole: smallest and largest value of a whole number, else None.
        bounds: `low`, `high` and `above`.
    """

    number: int
    name: str
    type: str
    meaning: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    above: bool = False
    finite: bool = True
    required: bool = True
    default: Any = None
    size: str = ""
    example: Any = None
    attribute: str = ""
    aliases: tuple[str, ...] = ()
    value_type: ValueType | None = field(init=False)
    whole: tuple[int, int] | None = field(init=False)
    bounds: tuple[float | None, float | None, bool] = field(init=False)

    def __post_init__(self) -> None:
        value_type = None if self.type == TIME else ValueType.parse(self.type)
        object.__setattr__(self, "value_type", value_type)
        object.__setattr__(self, "attribute", self.attribute or self.name)
        object.__setattr__(self, "whole", self._whole(value_type))
        object.__setattr__(self, "bounds", (self.low, self.high, self.above))

    def _whole(self, value_type: ValueType | None) -> tuple[int, int] | None:
        """Smallest and largest value where it is one whole number."""
        if value_type is None or value_type.form is not ValueForm.SCALAR or self.type == _CLASS:
            return None
        bounds = INTEGER_RANGES.get(value_type.elements[0])
        if bounds is None:
            return None
        low, high = self.low, self.high
        return bounds[0] if low is None else int(low), bounds[1] if high is None else int(high)

    @property
    def is_extension(self) -> bool:
        """Whether the standard does not have it."""
        return self.number >= 100

    @property
    def range(self) -> str:
        """The values that make sense, in words."""
        low, high = (self.low, self.high) if self.whole is None else self.whole
        if low is None:
            return ""
        if self.above:
            return f"more than {low:g}"
        return f"{_plain(low)} or more" if high is None else f"{_plain(low)} to {_plain(high)}"

    @property
    def wanted(self) -> str:
        """What was expected of a number, for messages."""
        return f"expected {self.range or 'a finite number'}"

    def check(self, value: Any, owner: str) -> Any:
        """Check a value exactly.

        Args:
            value: what stands in the record; None where nothing does.
            owner: the record, for the message.

        Returns:
            The value as a record keeps it: arrays flat and read-only, numbers of Python, vectors as tuples.

        Raises:
            DataError: it is missing, of another type or out of range.
        """
        if type(value) is int and self.whole is not None and self.whole[0] <= value <= self.whole[1]:
            return value
        if value is None:
            if self.required:
                raise DataError(owner, self.name, f"missing; expected {self._expected()}")
            return self.default
        check = _CHECKS.get(self.type)
        return self._plain_value(value, owner) if check is None else check(self, value, owner)

    def check_class(self, value: Any, owner: str, location: str = "") -> str:
        """Check the name of a class.

        Raises:
            DataError: it is no text, or empty where a class is required.
        """
        if type(value) is str and value.isascii() and value:
            return value
        name = check_basic(BasicType.STRING, value, owner=owner, location=location or self.name)
        if self.required and not name:
            raise DataError(owner, location or self.name, "''; expected the name of a class")
        return str(name)

    def refuse_any(self, flat: AnyArray, owner: str) -> None:
        """Refuse an array in which a number is not finite or out of range.

        Raises:
            DataError: one is; the message names the first.
        """
        if not self.admits(flat):
            k = self.first_refused(flat)
            raise DataError(owner, f"{self.name}[{k}]", f"{flat[k]}; {self.wanted}")

    def admits(self, values: AnyArray) -> bool:
        """Whether all numbers of an array are finite and in the range of this field."""
        if values.size == 0:
            return True
        broken = values.dtype.kind == "f"
        if self.low is None and self.high is None and (not broken or values.size < _FEW):
            return not broken or bool(np.isfinite(values).all())
        smallest, largest = values.min().item(), values.max().item()
        finite = not broken or (math.isfinite(smallest) and math.isfinite(largest))
        return finite and self._is_in_range(smallest) and self._is_in_range(largest)

    def first_refused(self, values: AnyArray) -> int:
        """The number of the first value that is not finite or out of range; there has to be one."""
        good = np.isfinite(values)
        if self.low is not None:
            good &= values > self.low if self.above else values >= self.low
        if self.high is not None:
            good &= values <= self.high
        return int(np.argmin(good))

    def _plain_value(self, value: Any, owner: str) -> Any:
        value_type = cast("ValueType", self.value_type)
        try:
            checked = value_type.check(value, owner=owner, location=self.name)
        except DataError as error:
            if self.range and value_type.form is ValueForm.SCALAR:
                raise DataError(owner, self.name, f"{shown(value)}; {self.wanted}") from error
            raise
        numbers = checked if isinstance(checked, tuple) else (checked,)
        if not all(self._is_in_range(number) for number in numbers):
            raise DataError(owner, self.name, f"{shown(value)}; {self.wanted}")
        return checked

    def _is_in_range(self, number: Any) -> bool:
        if self.high is not None and number > self.high:
            return False
        if self.low is None:
            return True
        return bool(number > self.low if self.above else number >= self.low)

    def _expected(self) -> str:
        words = (self.type, self.range, f"[{self.unit}]" if self.unit else "")
        return ", ".join(word for word in words if word)


def _time(row: Row, value: Any, owner: str) -> Timestamp:
    if not isinstance(value, Timestamp):
        raise DataError(owner, row.name, f"{shown(value)}; expected a Timestamp")
    return value


def _stream(row: Row, value: Any, owner: str) -> bytes:
    if isinstance(value, bytes):
        return value
    if isinstance(value, np.ndarray) and value.dtype in (np.int8, np.uint8):
        return value.tobytes()
    if isinstance(value, bytearray | memoryview):
        return bytes(value)
    raise DataError(owner, row.name, f"{shown(value)}; expected bytes")


def _array(row: Row, values: Any, owner: str) -> AnyArray:
    dtype = ARRAY_DTYPES[row.type]
    if not isinstance(values, np.ndarray) or values.dtype != dtype:
        raise DataError(owner, row.name, f"{shown(values)}; expected an array of {dtype.name}")
    flat = read_only(values.reshape(-1))
    if row.finite:
        row.refuse_any(flat, owner)
    return flat


def _plain(number: float) -> str:
    return str(int(number)) if number == int(number) else str(number)


_CHECKS: Mapping[str, Callable[[Row, Any, str], Any]] = {
    TIME: _time,
    STREAM: _stream,
    _CLASS: Row.check_class,
    **dict.fromkeys(ARRAY_DTYPES, _array),
}
"""How fields of these types are checked; others hold a value or a few of table 1."""


@dataclass(frozen=True, slots=True)
class Table:
    """One of the standard's tables.

    Attributes:
        number: of the table.
        clause: in which it stands.
        title: what it describes.
        rows: its fields in order, extensions last.
    """

    number: int
    clause: str
    title: str
    rows: tuple[Row, ...]
    _by_name: dict[str, Row] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_by_name", {row.name: row for row in self.rows})

    @property
    def owner(self) -> str:
        """How messages call a record of it."""
        return f"{self.title} (table {self.number})"

    def row(self, name: str) -> Row:
        """The row with that name.

        Raises:
            KeyError: there is none.
        """
        return self._by_name[name]

    def settle(self, record: Any) -> None:
        """Check all fields of a record that is being made, and put what they come to in their locations.

        Raises:
            DataError: a field is missing, of another type or out of range.
        """
        owner = self.owner
        for row in self.rows:
            checked = row.check(getattr(record, row.attribute), owner)
            object.__setattr__(record, row.attribute, checked)

    def fault(self, name: str, problem: str) -> DataError:
        """What is wrong with a field of a record of it."""
        return DataError(self.owner, name, problem)


_TIMESTAMP = Timestamp(1595682678, 715705367)

_UINT8, _UINT32, _INT32 = "uint8", "uint32", "int32"

_VELOCITY_VECTOR = Row(
    100, "velocity_vector", "float[3]", "velocity along x, y, z of the lidar frame", "m/s", required=False
)

_SENSOR = ("camera_id", "lidar_id")

_SEQ = ("image_seq", "points_seq")

CALIBRATION = Table(
    3,
    "6.1",
    "calibration data",
    (
        Row(1, "image_size", "uint32[2]", "width and height of the image", "px", low=1, example=(640, 480)),
        Row(
            2,
            "distortion_coeffs",
            "double[5]",
            "k1 k2 p1 p2 k3 of the pinhole model; all 0 where they are missing",
            required=False,
            default=(0.0, 0.0, 0.0, 0.0, 0.0),
            example=(-0.3995, 0.1803, 0, 0, 0.0429),
        ),
        Row(
            3,
            "intrinsic_matrix",
            "double[9]",
            "3x3, row-major: takes the camera frame to the image",
            "px",
            example=(468.3708, 0.0, 339.7596, 0.0, 470.2517, 235.6143, 0.0, 0.0, 1.0),
        ),
        Row(4, "reference_frame", "bool", "the frame mapped into: 0 camera, 1 lidar", example=0),
        Row(
            5,
            "extrinsic_matrix",
            "double[16]",
            "4x4, column-major: takes points of one declared frame into the other",
            "m",
            example=(
                *(0.0070, 1e-06, 0.9999, 0, -0.9999, -0.0016, 0.0070, 0),
                *(0.0016, -0.9999, -1e-06, 0, -0.0062, 0.0756, 0.0337, 1),
            ),
        ),
    ),
)

RAW = Table(
    4,
    "6.2",
    "raw data",
    (
        Row(1, "sensor_id", _UINT8, "the sensor that measured", example=1, aliases=_SENSOR),
        Row(2, "timestamp", TIME, "when the data were made", "s. ns", example=_TIMESTAMP),
        Row(3, "seq", _UINT32, "number in the sequence", example=1, aliases=_SEQ),
        Row(4, "length", _UINT32, "how many bytes", "byte", example=1),
        Row(5, "data", STREAM, "the bytes", size="length"),
    ),
)

IMAGE = Table(
    5,
    "6.3",
    "image data",
    (
        Row(1, "sensor_id", _UINT8, "the camera", example=1, aliases=("camera_id",)),
        Row(2, "timestamp", TIME, "when the image was made", "s. ns", example=_TIMESTAMP),
        Row(3, "seq", _UINT32, "number in the sequence", example=1, aliases=("image_seq",)),
        Row(4, "height", _UINT32, "rows of pixels", "px", low=1, example=480),
        Row(5, "width", _UINT32, "columns of pixels", "px", low=1, example=360),
        Row(6, "encoding", "string", "how the pixels are written", example="rgb8"),
        Row(7, "channel", _UINT8, "values per pixel", low=1, example=3, aliases=("image_channel",)),
        Row(8, "data", "uint8[]", "the pixels", size="width * height * channel", aliases=("image_data",)),
    ),
)

POINT_CLOUD = Table(
    6,
    "6.4",
    "point cloud data",
    (
        Row(1, "sensor_id", _UINT8, "the lidar", example=0, aliases=("lidar_id",)),
        Row(2, "timestamp", TIME, "when the cloud was measured", "s. ns", example=_TIMESTAMP),
        Row(3, "seq", _UINT32, "number in the sequence, growing by one", example=1, aliases=("points_seq",)),
        Row(4, "number", _UINT32, "how many points", example=1000, aliases=("point_num",)),
        Row(
            5,
            "fields",
            "string[]",
            "what each point has: x, y, z and others such as reflectivity",
            example=("x", "y", "z", "reflectivity"),
            aliases=("point_fields",),
        ),
        Row(6, "fields_number", _UINT8, "how many fields", low=3, example=3),
        Row(
            7,
            "data",
            "float[]",
            "the points one after the other; one with a number that is not finite is left out",
            size="number * fields_number",
            finite=False,
            aliases=("point_data",),
        ),
        Row(8, "sensor_type", "bool", "0 mechanical lidar, 1 solid-state lidar", example=0),
        Row(9, "beam", _UINT32, "beams of a mechanical lidar", required=False, example=32),
        Row(10, "ring", _UINT32, "the beam of all points, of a mechanical lidar", required=False, example=0),
    ),
)

BOX_3D = Table(
    7,
    "6.5",
    "3D box",
    (
        Row(1, "id", _INT32, "number of the box", example=1),
        Row(2, "class", "enum", "class of the object", example="Car", attribute="class_name"),
        Row(3, "points_seq", _UINT32, "seq of its point cloud", example=2, aliases=("seq",)),
        Row(4, "confidence", "float", "probability that the object exists", low=0, high=1, example=0.8),
        Row(5, "timestamp", TIME, "time of the box", "s. ns", example=_TIMESTAMP),
        Row(6, "X", "float", "middle of the box, lidar frame", "m", example=1.0, aliases=("x",)),
        Row(7, "Y", "float", "middle of the box, lidar frame", "m", example=1.0, aliases=("y",)),
        Row(8, "Z", "float", "middle of the box, lidar frame", "m", example=1.0, aliases=("z",)),
        Row(9, "length", "float", "length of the box", "m", low=0, above=True, example=1.0),
        Row(10, "width", "float", "width of the box", "m", low=0, above=True, example=1.0),
        Row(11, "height", "float", "height of the box", "m", low=0, above=True, example=1.0),
        Row(
            12,
            "direction",
            "float[3]",
            "where it heads, lidar frame; of any length but 0",
            example=(2.0, 3.0, 0.0),
        ),
        Row(13, "velocity", "float", "speed along the direction, negative for reversing", "m/s", example=1),
        _VELOCITY_VECTOR,
    ),
)

BOX_2D = Table(
    8,
    "6.6",
    "2D box",
    (
        Row(1, "id", _INT32, "number of the box", example=1),
        Row(2, "class", "enum", "class of the object", example="Car", attribute="class_name"),
        Row(3, "image_seq", _UINT32, "seq of its image", example=1, aliases=("seq",)),
        Row(4, "confidence", "float", "probability that the object exists", low=0, high=1, example=0.8),
        Row(5, "timestamp", TIME, "time of the box", "s. ns", example=_TIMESTAMP),
        Row(6, "x1", _UINT32, "left edge", "px", example=103),
        Row(7, "y1", _UINT32, "upper edge", "px", example=103),
        Row(8, "x2", _UINT32, "right edge, beyond the left one", "px", example=204),
        Row(9, "y2", _UINT32, "lower edge, below the upper one", "px", example=204),
    ),
)

SENSOR_FUSION = Table(
    9,
    "6.7",
    "fused sensor data",
    (
        Row(1, "timestamp", TIME, "time of the point cloud", "s. ns", example=_TIMESTAMP),
        Row(
            2,
            "class",
            "enum",
            "empty: sensor data have no class",
            required=False,
            default="",
            example="Car",
            attribute="class_name",
        ),
        Row(3, "image_seq", _UINT32, "seq of the image", example=1),
        Row(4, "points_seq", _UINT32, "seq of the point cloud", example=1),
        Row(5, "camera_id", _UINT8, "the camera", example=1),
        Row(6, "lidar_id", _UINT8, "the lidar", example=1),
        Row(7, "height", _UINT32, "rows of pixels", "px", low=1, example=480),
        Row(8, "width", _UINT32, "columns of pixels", "px", low=1, example=360),
        Row(9, "encoding", "string", "how the pixels are written", example="rgb8"),
        Row(10, "image_channel", _UINT8, "values per pixel", low=1, example=3, aliases=("channel",)),
        Row(11, "image_data", "uint8[]", "the pixels", size="width * height * image_channel"),
        Row(
            12,
            "image_depth",
            "float[]",
            "how far what each pixel shows is from the camera; 0 where no point is seen",
            "m",
            low=0,
            size="width * height",
        ),
        Row(13, "point_num", _UINT32, "how many points", example=10000, aliases=("number",)),
        Row(
            14,
            "point_fields",
            "string[]",
            "what each point has",
            example=("x", "y", "z"),
            aliases=("fields",),
        ),
        Row(15, "fields_number", _UINT8, "how many fields", low=3, example=3),
        Row(16, "point_data", "float[]", "the points one after the other", size="point_num * fields_number"),
        Row(
            100,
            "depth_kind",
            "string",
            'what image_depth holds: "z" along the optical axis, "range" along the ray',
            required=False,
        ),
        Row(101, "point_frame", "string", 'frame of point_data: "lidar" or "camera"', required=False),
        Row(
            102,
            "motion_compensated",
            "bool",
            "whether the ego trajectory was taken into account",
            required=False,
            default=0,
        ),
        Row(103, "image_timestamp", TIME, "when the image was made", "s. ns", required=False),
    ),
)

FUSED_DETECTION = Table(
    10,
    "6.8",
    "fused detection",
    (
        Row(1, "id", _INT32, "number of the detection", example=1),
        Row(2, "confidence", "float", "probability that the object exists", low=0, high=1, example=0.8),
        Row(3, "timestamp", TIME, "time of the detection", "s. ns", example=_TIMESTAMP),
        Row(4, "class", "enum", "class of the object", example="Car", attribute="class_name"),
        Row(5, "X", "float", "middle of the box, lidar frame", "m", example=1.0, aliases=("x",)),
        Row(6, "Y", "float", "middle of the box, lidar frame", "m", example=1.0, aliases=("y",)),
        Row(7, "Z", "float", "middle of the box, lidar frame", "m", example=1.0, aliases=("z",)),
        Row(
            8,
            "center_cov",
            "float[9]",
            "3x3, row-major: covariance of the middle, lidar frame",
            "m²",
            example=(0.2, 0.01, 0.01, 0.01, 0.2, 0.01, 0.01, 0.01, 0.2),
        ),
        Row(9, "length", "float", "length of the box", "m", low=0, example=1.0),
        Row(10, "width", "float", "width of the box", "m", low=0, example=1.0),
        Row(11, "height", "float", "height of the box", "m", low=0, example=1.0),
        Row(
            12,
            "size_cov",
            "float[9]",
            "3x3, row-major: covariance of length, width and height",
            "m²",
            example=(0.2, 0.01, 0.01, 0.01, 0.2, 0.01, 0.01, 0.01, 0.2),
        ),
        Row(13, "direction", "float[3]", "where it heads, lidar frame", example=(2.0, 3.0, 0.0)),
        Row(14, "velocity", "float", "speed along the direction, negative for reversing", "m/s", example=1),
        Row(15, "x1", _UINT32, "left edge; all four 0 where the image does not show it", "px", example=103),
        Row(16, "y1", _UINT32, "upper edge", "px", example=103),
        Row(17, "x2", _UINT32, "right edge, beyond the left one", "px", example=204),
        Row(18, "y2", _UINT32, "lower edge, below the upper one", "px", example=204),
        _VELOCITY_VECTOR,
        Row(101, "box_3d_id", _INT32, "id of the 3D box, where there was one", required=False),
        Row(102, "box_2d_id", _INT32, "id of the 2D box, where there was one", required=False),
    ),
)

BOXES_3D = Table(
    7,
    "6.5",
    "3D boxes",
    (
        Row(1, "sensor_id", _UINT8, "the lidar", aliases=("lidar_id",)),
        Row(2, "seq", _UINT32, "seq of the point cloud", aliases=("points_seq",)),
        Row(3, "timestamp", TIME, "time of the point cloud", "s. ns"),
    ),
)
"""What the boxes of one point cloud have in common."""

BOXES_2D = Table(
    8,
    "6.6",
    "2D boxes",
    (
        Row(1, "sensor_id", _UINT8, "the camera", aliases=("camera_id",)),
        Row(2, "seq", _UINT32, "seq of the image", aliases=("image_seq",)),
        Row(3, "timestamp", TIME, "time of the image", "s. ns"),
    ),
)
"""What the boxes of one image have in common."""

FUSED_DETECTIONS = Table(
    10,
    "6.8",
    "fused detections",
    (
        Row(2, "image_seq", _UINT32, "seq of the image"),
        Row(3, "points_seq", _UINT32, "seq of the point cloud"),
        Row(4, "camera_id", _UINT8, "the camera"),
        Row(5, "lidar_id", _UINT8, "the lidar"),
        Row(6, "timestamp", TIME, "time of the point cloud", "s. ns"),
        SENSOR_FUSION.row("motion_compensated"),
        SENSOR_FUSION.row("image_timestamp"),
    ),
)
"""What the detections of one pair have in common."""

TABLES: Mapping[int, Table] = MappingProxyType(
    {
        table.number: table
        for table in (
            *(CALIBRATION, RAW, IMAGE, POINT_CLOUD),
            *(BOX_3D, BOX_2D, SENSOR_FUSION, FUSED_DETECTION),
        )
    }
)
"""By number."""
