"""Records of DB34/T 4101-2022, tables 3 to 10, and the table of all kinds of records.

Detections stand alone (`Box3d`) or as lists (`Boxes3d`) whose fields are columns.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import DTypeLike

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, UInt8Array, UInt32Array, read_only
from sceneloom.db34t.tables import (
    ARRAY_DTYPES,
    BOX_2D,
    BOX_3D,
    BOXES_2D,
    BOXES_3D,
    CALIBRATION,
    FUSED_DETECTION,
    FUSED_DETECTIONS,
    IMAGE,
    POINT_CLOUD,
    RAW,
    SENSOR_FUSION,
    STREAM,
    Row,
    Table,
)
from sceneloom.db34t.types import INTEGER_RANGES, BasicType, Timestamp, shown
from sceneloom.errors import DataError, OptionError

_List = TypeVar("_List")
"""A class of lists of boxes or of detections."""


@dataclass(frozen=True, slots=True)
class Column:
    """An array of a list of records.

    Attributes:
        attribute: of the list.
        names: the rows of the table that it holds, one number of a row of the array each, or one that holds them all.
        dtype: of the array.
        shape: of one row of the array.
        optional: it may be None, for all boxes at once.
    """

    attribute: str
    names: tuple[str, ...]
    dtype: DTypeLike = np.float32
    shape: tuple[int, ...] = ()
    optional: bool = False


class _ColumnChecks:
    """The checks of the columns of one kind of lists."""

    def __init__(self, table: Table, columns: Sequence[Column], *, group: str) -> None:
        """Look up the rows of the columns.

        Args:
            table: of one record of the list.
            columns: of the list; the first reports how many records there are.
            group: how messages call the list.
        """
        self._table = table
        self._group = group
        self._columns = tuple(
            (column, np.dtype(column.dtype), tuple(map(table.row, column.names))) for column in columns
        )
        # of those whose rows have the same bounds the row that stands for all
        self._bounds = tuple(
            rows[0] if all(row.bounds == rows[0].bounds for row in rows) else None for _, _, rows in self._columns
        )

    def settle(self, record: Any) -> int:
        """Check all columns of a list that is being made, and make them read-only.

        Returns:
            How many records there are.

        Raises:
            DataError: a column has another shape or dtype, or a number in it is not finite or out of range.
        """
        count: int | None = None
        for (column, dtype, rows), bounds in zip(self._columns, self._bounds, strict=True):
            values = getattr(record, column.attribute)
            if column.optional and (values is None or count == 0):
                object.__setattr__(record, column.attribute, None)
                continue
            _check_shape(values, column, dtype, self._table, count)
            count = len(values)
            if bounds is None or not bounds.admits(values):
                _check_values(values, column, rows, self._table, self._group)
            object.__setattr__(record, column.attribute, read_only(values))
        return count or 0


def _settled(record_type: type[_List], columns: Sequence[Column], values: Mapping[str, Any]) -> _List:
    """Make a list of fields that are what its checks would make of them; its columns become read-only."""
    record = object.__new__(record_type)
    for name, value in values.items():
        object.__setattr__(record, name, value)
    for column in columns:
        value = values[column.attribute]
        if value is not None:
            value.flags.writeable = False
    return record


def _settle_classes(record: Any, table: Table, count: int, *, group: str) -> None:
    """Check the classes of a list that is being made.

    Raises:
        DataError: there are more or fewer than records, or one is no name.
    """
    names = record.class_names
    if not isinstance(names, tuple | list) or len(names) != count:
        raise table.fault("class", f"{shown(names)}; expected a tuple of {count}")
    row = table.row("class")
    for name in set(names) if set(map(type, names)) == {str} else names:
        try:
            row.check_class(name, table.owner)
        except DataError as error:
            raise table.fault(f"{group}[{names.index(name)}].class", error.problem) from error
    object.__setattr__(record, "class_names", tuple(names))


def _settle_ids(record: Any, attribute: str, row: Row, table: Table, count: int) -> None:
    """Check ids that some records of a list have and others have not.

    Raises:
        DataError: there are more or fewer than records, or one is neither None nor an int32.
    """
    ids = getattr(record, attribute)
    if ids is None:
        ids = (None,) * count
    if not isinstance(ids, tuple | list) or len(ids) != count:
        raise table.fault(row.name, f"{shown(ids)}; expected a tuple of {count}")
    low, high = INTEGER_RANGES[BasicType.INT32]
    known = [k for k in ids if k is not None]
    if known and not (set(map(type, known)) == {int} and low <= min(known) and max(known) <= high):
        ids = tuple(row.check(k, table.owner) for k in ids)
    object.__setattr__(record, attribute, tuple(ids))


def _check_shape(values: Any, column: Column, expected: np.dtype[Any], table: Table, count: int | None) -> None:
    if isinstance(values, np.ndarray) and values.dtype == expected:
        rows = len(values) if values.ndim else -1
        if values.shape == (rows if count is None else count, *column.shape):
            return
    shape = ("N" if count is None else count, *column.shape)
    words = f"({', '.join(str(n) for n in shape)}) {expected.name}"
    raise DataError(table.owner, column.attribute, f"{shown(values)}; expected an array {words}")


def _check_values(values: AnyArray, column: Column, rows: tuple[Row, ...], table: Table, group: str) -> None:
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    for j in range(flat.shape[1]):
        row = rows[j if len(rows) > 1 else 0]
        if not row.admits(flat[:, j]):
            k = row.first_refused(flat[:, j])
            location = f"{group}[{k}].{row.name}" + (f"[{j}]" if len(rows) == 1 and column.shape else "")
            raise DataError(table.owner, location, f"{flat[k, j]}; {row.wanted}")


COLUMNS_3D = (
    Column("id", ("id",), np.int32),
    Column("confidence", ("confidence",)),
    Column("centers", ("X", "Y", "Z"), shape=(3,)),
    Column("sizes_lwh", ("length", "width", "height"), shape=(3,)),
    Column("directions", ("direction",), shape=(3,)),
    Column("velocities", ("velocity",)),
    Column("velocity_vectors", ("velocity_vector",), shape=(3,), optional=True),
)
"""The columns of `Boxes3d`."""

COLUMNS_2D = (
    Column("id", ("id",), np.int32),
    Column("confidence", ("confidence",)),
    Column("corners_xyxy", ("x1", "y1", "x2", "y2"), np.uint32, (4,)),
)
"""The columns of `Boxes2d`."""

_CHECKS_3D = _ColumnChecks(BOX_3D, COLUMNS_3D, group="boxes")
_CHECKS_2D = _ColumnChecks(BOX_2D, COLUMNS_2D, group="boxes")


@dataclass(frozen=True, slots=True, kw_only=True)
class Box3d:
    """One box in space, in the lidar frame.

    Attributes:
        id: number of the box, an int32.
        class_name: class of the object; `class` in the standard.
        points_seq: seq of its point cloud.
        confidence: probability that the object exists, 0 to 1.
        timestamp: time of the box.
        X, Y, Z: middle of the box [m].
        length, width, height: of the box [m], more than 0.
        direction: where it heads, of any length but 0.
        velocity: speed along the direction [m/s], negative for reversing.
        velocity_vector: velocity [m/s] along x, y, z, or None.

    Raises:
        DataError: a field is missing, of another type or out of range.

    Source: DB34/T 4101-2022, table 7.
    """

    id: int
    class_name: str
    points_seq: int
    confidence: float
    timestamp: Timestamp
    X: float
    Y: float
    Z: float
    length: float
    width: float
    height: float
    direction: tuple[float, float, float]
    velocity: float
    velocity_vector: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        BOX_3D.settle(self)
        if not any(self.direction):
            raise BOX_3D.fault("direction", f"{self.direction}; expected a vector other than 0")

    def alone(self, sensor_id: int) -> "Boxes3d":
        """The list of this one box."""
        shared: dict[str, Any] = {"sensor_id": sensor_id, "seq": self.points_seq, "timestamp": self.timestamp}
        return Boxes3d(**shared, **_columns_of(self, BOX_3D, COLUMNS_3D))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Boxes3d:
    """The boxes of one point cloud, in the lidar frame; without boxes: a cloud in which nothing was found.

    Attributes:
        sensor_id: of the lidar, 0 to 255.
        seq: of the point cloud.
        timestamp: of the point cloud.
        id: (N,) int32.
        class_names: N classes.
        confidence: (N,) float32, 0 to 1.
        centers: (N, 3) float32 [m].
        sizes_lwh: (N, 3) float32 [m], more than 0.
        directions: (N, 3) float32, none of them 0.
        velocities: (N,) float32 [m/s] along the directions, negative for reversing.
        velocity_vectors: (N, 3) float32 [m/s], or None.

    Raises:
        DataError: a field is missing, of another type or out of range; arrays have another shape or dtype.

    Source: DB34/T 4101-2022, table 7 and clause 5.6.
    """

    sensor_id: int
    seq: int
    timestamp: Timestamp
    id: AnyArray
    class_names: tuple[str, ...]
    confidence: Float32Array
    centers: Float32Array
    sizes_lwh: Float32Array
    directions: Float32Array
    velocities: Float32Array
    velocity_vectors: Float32Array | None = None

    def __post_init__(self) -> None:
        BOXES_3D.settle(self)
        count = _CHECKS_3D.settle(self)
        _settle_classes(self, BOX_3D, count, group="boxes")
        heads = self.directions.any(axis=1)
        if not heads.all():
            location = f"boxes[{int(np.argmin(heads))}].direction"
            raise BOX_3D.fault(location, "(0.0, 0.0, 0.0); expected a vector other than 0")

    @classmethod
    def empty(cls, sensor_id: int, seq: int, timestamp: Timestamp) -> "Boxes3d":
        """A cloud in which nothing was found."""
        return cls(sensor_id=sensor_id, seq=seq, timestamp=timestamp, **_no_rows(COLUMNS_3D))

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[Box3d]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> Box3d:
        fields = _fields_of(self, k, BOX_3D, COLUMNS_3D)
        return Box3d(points_seq=self.seq, timestamp=self.timestamp, **fields)


@dataclass(frozen=True, slots=True, kw_only=True)
class Box2d:
    """One box in an image, whose own corner is (0, 0); the right and the lower edge are exclusive.

    Attributes:
        id: number of the box, an int32.
        class_name: class of the object; `class` in the standard.
        image_seq: seq of its image.
        confidence: probability that the object exists, 0 to 1.
        timestamp: time of the box.
        x1, y1, x2, y2: left, upper, right and lower edge [px], uint32; the box has an area.

    Raises:
        DataError: a field is missing, of another type or out of range.

    Source: DB34/T 4101-2022, table 8.
    """

    id: int
    class_name: str
    image_seq: int
    confidence: float
    timestamp: Timestamp
    x1: int
    y1: int
    x2: int
    y2: int

    def __post_init__(self) -> None:
        BOX_2D.settle(self)
        _check_area(np.array([[self.x1, self.y1, self.x2, self.y2]], np.uint32), group="")

    def alone(self, sensor_id: int) -> "Boxes2d":
        """The list of this one box."""
        shared: dict[str, Any] = {"sensor_id": sensor_id, "seq": self.image_seq, "timestamp": self.timestamp}
        return Boxes2d(**shared, **_columns_of(self, BOX_2D, COLUMNS_2D))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Boxes2d:
    """The boxes of one image; without boxes: an image in which nothing was found.

    Attributes:
        sensor_id: of the camera, 0 to 255.
        seq: of the image.
        timestamp: of the image.
        id: (N,) int32.
        class_names: N classes.
        confidence: (N,) float32, 0 to 1.
        corners_xyxy: (N, 4) uint32 [px], left, upper, right and lower edge; each box has an area.

    Raises:
        DataError: a field is missing, of another type or out of range; arrays have another shape or dtype.

    Source: DB34/T 4101-2022, table 8 and clause 5.6.
    """

    sensor_id: int
    seq: int
    timestamp: Timestamp
    id: AnyArray
    class_names: tuple[str, ...]
    confidence: Float32Array
    corners_xyxy: UInt32Array

    def __post_init__(self) -> None:
        BOXES_2D.settle(self)
        count = _CHECKS_2D.settle(self)
        _settle_classes(self, BOX_2D, count, group="boxes")
        _check_area(self.corners_xyxy, group="boxes")

    @classmethod
    def empty(cls, sensor_id: int, seq: int, timestamp: Timestamp) -> "Boxes2d":
        """An image in which nothing was found."""
        return cls(sensor_id=sensor_id, seq=seq, timestamp=timestamp, **_no_rows(COLUMNS_2D))

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[Box2d]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> Box2d:
        fields = _fields_of(self, k, BOX_2D, COLUMNS_2D)
        return Box2d(image_seq=self.seq, timestamp=self.timestamp, **fields)


def _columns_of(box: Any, table: Table, columns: Sequence[Column]) -> dict[str, Any]:
    """Give the columns of a list of one box, and its class."""
    found: dict[str, Any] = {"class_names": (box.class_name,)}
    for column in columns:
        values = [getattr(box, table.row(name).attribute) for name in column.names]
        absent = column.optional and values[0] is None
        found[column.attribute] = None if absent else np.array(values, column.dtype).reshape(1, *column.shape)
    return found


def _fields_of(boxes: Any, k: int, table: Table, columns: Sequence[Column]) -> dict[str, Any]:
    """Give the fields of one record of a list that stand in its columns, and its class."""
    found: dict[str, Any] = {"class_name": boxes.class_names[k]}
    for column in columns:
        values = getattr(boxes, column.attribute)
        if values is None:
            continue
        numbers = values[k].reshape(-1).tolist()
        attributes = [table.row(name).attribute for name in column.names]
        if len(attributes) == 1:
            numbers = [tuple(numbers) if column.shape else numbers[0]]
        found.update(zip(attributes, numbers, strict=True))
    return found


def _no_rows(columns: Sequence[Column]) -> dict[str, Any]:
    """Give the columns of a list without records."""
    present = (column for column in columns if not column.optional)
    arrays = {column.attribute: np.zeros((0, *column.shape), column.dtype) for column in present}
    return {"class_names": (), **arrays}


def _check_area(corners_xyxy: UInt32Array, *, group: str) -> None:
    """Check that boxes of table 8 have an area; right and lower edges are exclusive.

    Args:
        group: how messages call the list; "" for a single box.

    Raises:
        DataError: a right edge is not beyond the left one, or a lower edge not below the upper one.
    """
    areas = corners_xyxy[:, 2:] > corners_xyxy[:, :2]
    if areas.all():
        return
    k, axis = divmod(int(np.argmin(areas.reshape(-1))), 2)
    name, first = ("x2", "y2")[axis], int(corners_xyxy[k, axis])
    problem = f"{corners_xyxy[k, 2 + axis]}; expected more than {first}, which is {name[0]}1: edges are exclusive"
    raise BOX_2D.fault(_location(group, k, name), problem)


def _check_corners(corners_xyxy: UInt32Array, *, group: str) -> None:
    """Check that no box of table 10 is inside out: a right edge before the left one, a lower one above the upper."""
    for name, first, second in (("x2", 0, 2), ("y2", 1, 3)):
        wrong = corners_xyxy[:, second] < corners_xyxy[:, first]
        if wrong.any():
            k = int(np.argmax(wrong))
            problem = f"{corners_xyxy[k, second]}; expected {corners_xyxy[k, first]} or more, as {name[0]}1"
            raise FUSED_DETECTION.fault(_location(group, k, name), problem)


@dataclass(frozen=True, slots=True)
class Encoding:
    """One way of writing pixels.

    Attributes:
        channels: how many values a pixel may have.
        is_file: the data are a whole file, of any length, not pixel after pixel.
        order: which values make red, green and blue; None where that is not known.
    """

    channels: frozenset[int]
    is_file: bool = False
    order: tuple[int, int, int] | None = None


_ANY = frozenset(range(1, 256))

ENCODINGS: Mapping[str, Encoding] = MappingProxyType(
    {
        "rgb8": Encoding(frozenset({3}), order=(0, 1, 2)),
        "bgr8": Encoding(frozenset({3}), order=(2, 1, 0)),
        "mono8": Encoding(frozenset({1}), order=(0, 0, 0)),
        "rgba8": Encoding(frozenset({4}), order=(0, 1, 2)),
        "bgra8": Encoding(frozenset({4}), order=(2, 1, 0)),
        "raw": Encoding(_ANY),
        "jpeg": Encoding(frozenset({1, 3, 4}), is_file=True),
        "png": Encoding(frozenset({1, 2, 3, 4}), is_file=True),
    }
)
"""By the names of table 5; those with 8 are the names that ROS gave them."""


def _check_pixels(
    table: Table,
    encoding: str,
    *,
    size_hwc: tuple[int, int, int],
    length: int,
    channel_name: str,
    data_name: str,
) -> None:
    """Check that encoding, size and number of values of an image belong together.

    Args:
        table: of the record.
        size_hwc: height, width and channels.
        length: how many values there are.
        channel_name, data_name: how the table calls the two.

    Raises:
        DataError: they do not.
    """
    known = ENCODINGS.get(encoding)
    if known is None:
        raise table.fault("encoding", f"{shown(encoding)}; expected one of {', '.join(ENCODINGS)}")
    height, width, channels = size_hwc
    if channels not in known.channels:
        expected = " or ".join(str(count) for count in sorted(known.channels))
        raise table.fault(channel_name, f"{channels} of {encoding}; expected {expected}")
    if known.is_file:
        if length == 0:
            raise table.fault(data_name, f"empty; expected a file of {encoding}")
    elif length != height * width * channels:
        expected = f"{height * width * channels} (width * height * {channel_name})"
        raise table.fault(data_name, f"{length} values; expected {expected}")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RawData:
    """Bytes as a sensor made them.

    Attributes:
        sensor_id: 0 to 255.
        timestamp: when they were made.
        seq: number in the sequence, a uint32.
        length: how many bytes.
        data: the bytes.

    Raises:
        DataError: a field is missing, of another type or out of range, or `length` is not that of `data`.

    Source: DB34/T 4101-2022, table 4.
    """

    sensor_id: int
    timestamp: Timestamp
    seq: int
    length: int
    data: bytes

    def __post_init__(self) -> None:
        RAW.settle(self)
        if self.length != len(self.data):
            raise RAW.fault("length", f"{self.length}; expected {len(self.data)}, as there are bytes in data")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ImageData:
    """One image.

    Attributes:
        sensor_id: of the camera, 0 to 255.
        timestamp: when it was made.
        seq: number in the sequence, a uint32.
        height, width: of the image [px], at least 1.
        encoding: a name out of `ENCODINGS`.
        channel: values per pixel.
        data: uint8, height * width * channel values row by row; a whole file where the encoding is jpeg or png. Given
            in any shape, kept flat and read-only.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 5.
    """

    sensor_id: int
    timestamp: Timestamp
    seq: int
    height: int
    width: int
    encoding: str
    channel: int
    data: UInt8Array

    def __post_init__(self) -> None:
        IMAGE.settle(self)
        _check_pixels(
            IMAGE,
            self.encoding,
            size_hwc=(self.height, self.width, self.channel),
            length=self.data.size,
            channel_name="channel",
            data_name="data",
        )

    @property
    def pixels(self) -> UInt8Array | None:
        """The pixels, (height, width, channel) uint8, a view; None of a file, which wants decoding."""
        if ENCODINGS[self.encoding].is_file:
            return None
        return self.data.reshape(self.height, self.width, self.channel)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PointCloudData:
    """One point cloud.

    Attributes:
        sensor_id: of the lidar, 0 to 255.
        timestamp: when it was measured.
        seq: number in the sequence, a uint32.
        number: how many points.
        fields: what each point has; x, y and z among it.
        fields_number: how many fields.
        data: float32, number * fields_number values point by point; what fuses the cloud leaves out and counts points
            with a number that is not finite, which is how drivers mark missing returns. Given in any shape, kept flat
            and read-only.
        sensor_type: 0 for a mechanical lidar, 1 for a solid-state lidar.
        beam: how many beams a mechanical lidar has, or None.
        ring: the beam that all points are of, where the lidar is mechanical, or None.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 6.
    """

    sensor_id: int
    timestamp: Timestamp
    seq: int
    number: int
    fields: tuple[str, ...]
    fields_number: int
    data: Float32Array
    sensor_type: int = 0
    beam: int | None = None
    ring: int | None = None

    def __post_init__(self) -> None:
        POINT_CLOUD.settle(self)
        _check_fields(POINT_CLOUD, "fields", self.fields, self.fields_number)
        _check_point_count(
            POINT_CLOUD,
            names=("number", "data"),
            number=self.number,
            fields_number=self.fields_number,
            length=self.data.size,
        )
        for name in ("beam", "ring"):
            if self.sensor_type == 1 and getattr(self, name) is not None:
                raise POINT_CLOUD.fault(name, f"{getattr(self, name)} of a solid-state lidar; expected none")

    @property
    def points(self) -> Float32Array:
        """The points, (number, fields_number) float32, a view."""
        return self.data.reshape(self.number, self.fields_number)

    def columns(self, names: Sequence[str]) -> Float32Array:
        """Some fields of all points, (number, len(names)) float32.

        Raises:
            KeyError: the points have no field of such a name.
        """
        missing = [name for name in names if name not in self.fields]
        if missing:
            raise KeyError(missing[0])
        return np.ascontiguousarray(self.points[:, [self.fields.index(name) for name in names]])


def _check_fields(table: Table, name: str, fields: tuple[str, ...], fields_number: int) -> None:
    """Check the names of the fields that points have.

    Raises:
        DataError: x, y or z is missing, a name is empty or stands twice, or there are more or fewer than stated.
    """
    if not {"x", "y", "z"} <= set(fields):
        raise table.fault(name, f"{shown(fields)}; expected x, y and z among them")
    if "" in fields or len(set(fields)) != len(fields):
        raise table.fault(name, f"{shown(fields)}; expected different names")
    if fields_number != len(fields):
        raise table.fault("fields_number", f"{fields_number}; expected {len(fields)}, as there are names in {name}")


def _check_point_count(table: Table, *, names: tuple[str, str], number: int, fields_number: int, length: int) -> None:
    """Check that there are as many values as the points need.

    Args:
        names: how the table calls the number of points, and the values.

    Raises:
        DataError: there are more or fewer.
    """
    if length != number * fields_number:
        expected = f"{number * fields_number} ({names[0]} * fields_number)"
        raise table.fault(names[1], f"{length} values; expected {expected}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationData:
    """The camera model of a camera, and where it is seen from a lidar or a lidar from it.

    What the numbers mean as a camera model and as frames is judged by those who use them.

    Attributes:
        image_size: width and height [px], each at least 1.
        intrinsic_matrix: 9 numbers, 3x3 row-major.
        reference_frame: the frame that `extrinsic_matrix` maps into: 0 camera, 1 lidar.
        extrinsic_matrix: 16 numbers, 4x4; by columns, as the standard's example, or by rows.
        distortion_coeffs: 5 numbers, k1 k2 p1 p2 k3; None for none.

    Raises:
        DataError: a field is missing, of another type or out of range.

    Source: DB34/T 4101-2022, table 3.
    """

    image_size: tuple[int, int]
    intrinsic_matrix: tuple[float, ...]
    reference_frame: int
    extrinsic_matrix: tuple[float, ...]
    distortion_coeffs: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        CALIBRATION.settle(self)


DEPTH_KINDS = ("z", "range")
"""What a depth image can hold: the distance along the optical axis, or along the ray."""

POINT_FRAMES = ("lidar", "camera")
"""The frames that the points of a result can be in."""

_COLUMNS_FUSED = (
    *COLUMNS_3D,
    Column("center_covs", ("center_cov",), shape=(3, 3)),
    Column("size_covs", ("size_cov",), shape=(3, 3)),
    Column("corners_xyxy", ("x1", "y1", "x2", "y2"), np.uint32, (4,)),
)
"""The columns of `FusedDetections`."""

_CHECKS_FUSED = _ColumnChecks(FUSED_DETECTION, _COLUMNS_FUSED, group="detections")

_ASYMMETRY = 1e-3
"""How much a covariance of 32-bit numbers may differ from its transpose, of its largest number."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SensorFusionData:
    """A point cloud and an image after fusion.

    Attributes:
        timestamp: of the point cloud.
        image_seq, points_seq: numbers of the image and of the cloud.
        camera_id, lidar_id: 0 to 255.
        height, width: of the image [px].
        encoding: a name out of `ENCODINGS`.
        image_channel: values per pixel.
        image_data: uint8, height * width * image_channel values; kept flat and read-only.
        image_depth: float32 [m], height * width values, 0 where no point is seen; kept flat and read-only.
        point_num: how many points.
        point_fields: what each point has; x, y and z among it.
        fields_number: how many fields.
        point_data: float32, point_num * fields_number values; kept flat and read-only.
        class_name: empty; `class` in the standard.
        depth_kind: one of `DEPTH_KINDS`; None where it was not stated.
        point_frame: one of `POINT_FRAMES`; None where it was not stated.
        motion_compensated: 1 where the ego trajectory was taken into account.
        image_timestamp: of the image; None where it was not stated.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 9.
    """

    timestamp: Timestamp
    image_seq: int
    points_seq: int
    camera_id: int
    lidar_id: int
    height: int
    width: int
    encoding: str
    image_channel: int
    image_data: UInt8Array
    image_depth: Float32Array
    point_num: int
    point_fields: tuple[str, ...]
    fields_number: int
    point_data: Float32Array
    class_name: str = ""
    depth_kind: str | None = None
    point_frame: str | None = None
    motion_compensated: int = 0
    image_timestamp: Timestamp | None = None

    def __post_init__(self) -> None:
        SENSOR_FUSION.settle(self)
        _check_pixels(
            SENSOR_FUSION,
            self.encoding,
            size_hwc=(self.height, self.width, self.image_channel),
            length=self.image_data.size,
            channel_name="image_channel",
            data_name="image_data",
        )
        if self.image_depth.size != self.height * self.width:
            expected = f"{self.height * self.width} (width * height)"
            raise SENSOR_FUSION.fault("image_depth", f"{self.image_depth.size} values; expected {expected}")
        _check_fields(SENSOR_FUSION, "point_fields", self.point_fields, self.fields_number)
        _check_point_count(
            SENSOR_FUSION,
            names=("point_num", "point_data"),
            number=self.point_num,
            fields_number=self.fields_number,
            length=self.point_data.size,
        )
        for name, known in (("depth_kind", DEPTH_KINDS), ("point_frame", POINT_FRAMES)):
            word = getattr(self, name)
            if word is not None and word not in known:
                raise SENSOR_FUSION.fault(name, f"{shown(word)}; expected one of {', '.join(known)}")

    @property
    def pixels(self) -> UInt8Array | None:
        """The image, (height, width, image_channel) uint8, a view; None of a file, which wants decoding."""
        if ENCODINGS[self.encoding].is_file:
            return None
        return self.image_data.reshape(self.height, self.width, self.image_channel)

    @property
    def depths(self) -> Float32Array:
        """The depth image, (height, width) float32 [m], a view."""
        return self.image_depth.reshape(self.height, self.width)

    @property
    def points(self) -> Float32Array:
        """The points, (point_num, fields_number) float32, a view."""
        return self.point_data.reshape(self.point_num, self.fields_number)


@dataclass(frozen=True, slots=True, kw_only=True)
class FusedDetection:
    """One object, found in space, in an image, or in both.

    Attributes:
        id: number of the detection, an int32.
        confidence: probability that the object exists, 0 to 1.
        timestamp: time of the detection.
        class_name: class of the object; `class` in the standard.
        X, Y, Z: middle of the box [m], lidar frame.
        center_cov: 9 numbers [m²], 3x3 row-major.
        length, width, height: of the box [m]; more than 0 where there is a 3D box.
        size_cov: 9 numbers [m²], 3x3 row-major: length, width, height.
        direction: where it heads, lidar frame; not 0 where there is a 3D box.
        velocity: speed along the direction [m/s], negative for reversing.
        x1, y1, x2, y2: left, upper, right and lower edge in the image [px], uint32; all 0 of a detection that the
            image does not show: one behind the camera or beside its view.
        velocity_vector: velocity [m/s] along x, y, z, or None.
        box_3d_id, box_2d_id: the boxes it was made of; None for a sensor that did not see it.

    Raises:
        DataError: a field is missing, of another type or out of range, or they do not belong together.

    Source: DB34/T 4101-2022, table 10.
    """

    id: int
    confidence: float
    timestamp: Timestamp
    class_name: str
    X: float
    Y: float
    Z: float
    center_cov: tuple[float, ...]
    length: float
    width: float
    height: float
    size_cov: tuple[float, ...]
    direction: tuple[float, float, float]
    velocity: float
    x1: int
    y1: int
    x2: int
    y2: int
    velocity_vector: tuple[float, float, float] | None = None
    box_3d_id: int | None = None
    box_2d_id: int | None = None

    def __post_init__(self) -> None:
        FUSED_DETECTION.settle(self)
        _check_corners(np.array([[self.x1, self.y1, self.x2, self.y2]], np.uint32), group="")
        for name in ("center_cov", "size_cov"):
            _check_covariances(name, np.array(getattr(self, name), np.float32).reshape(1, 3, 3), group="")
        if self.box_3d_id is not None:
            sizes_lwh = np.array([[self.length, self.width, self.height]], np.float32)
            _check_seen_in_space(sizes_lwh, np.array([self.direction], np.float32), (0,), group="")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FusedDetections:
    """The fused detections of one point cloud and one image.

    Attributes:
        timestamp: of the point cloud.
        image_seq, points_seq: numbers of the image and of the cloud.
        camera_id, lidar_id: 0 to 255.
        id: (N,) int32.
        class_names: N classes.
        confidence: (N,) float32, 0 to 1.
        centers: (N, 3) float32 [m], lidar frame.
        center_covs: (N, 3, 3) float32 [m²], lidar frame.
        sizes_lwh: (N, 3) float32 [m]; more than 0 where there is a 3D box.
        size_covs: (N, 3, 3) float32 [m²]: length, width, height.
        directions: (N, 3) float32, lidar frame; not 0 where there is a 3D box.
        velocities: (N,) float32 [m/s] along the directions.
        corners_xyxy: (N, 4) uint32 [px]; zeros of a detection that the image does not show, see `in_image`.
        velocity_vectors: (N, 3) float32 [m/s], or None.
        box_3d_ids, box_2d_ids: the boxes that each was made of, None in them for a sensor that did not see it; None
            for N of None.
        motion_compensated: 1 where the ego trajectory was taken into account.
        image_timestamp: of the image; None where it was not stated.

    Raises:
        DataError: a field is missing, of another type or out of range; arrays have another shape or dtype.

    Source: DB34/T 4101-2022, table 10 and clause 5.7.
    """

    timestamp: Timestamp
    image_seq: int
    points_seq: int
    camera_id: int
    lidar_id: int
    id: AnyArray
    class_names: tuple[str, ...]
    confidence: Float32Array
    centers: Float32Array
    center_covs: Float32Array
    sizes_lwh: Float32Array
    size_covs: Float32Array
    directions: Float32Array
    velocities: Float32Array
    corners_xyxy: UInt32Array
    velocity_vectors: Float32Array | None = None
    box_3d_ids: tuple[int | None, ...] = None  # type: ignore[assignment]
    box_2d_ids: tuple[int | None, ...] = None  # type: ignore[assignment]
    motion_compensated: int = 0
    image_timestamp: Timestamp | None = None

    def __post_init__(self) -> None:
        FUSED_DETECTIONS.settle(self)
        count = _CHECKS_FUSED.settle(self)
        _settle_classes(self, FUSED_DETECTION, count, group="detections")
        for name in ("box_3d_id", "box_2d_id"):
            _settle_ids(self, f"{name}s", FUSED_DETECTION.row(name), FUSED_DETECTION, count)
        _check_corners(self.corners_xyxy, group="detections")
        _check_covariances("center_cov", self.center_covs, group="detections")
        _check_covariances("size_cov", self.size_covs, group="detections")
        _check_seen_in_space(self.sizes_lwh, self.directions, self.box_3d_ids, group="detections")

    @classmethod
    def of_sound_numbers(cls, **fields: Any) -> "FusedDetections":
        """Make it of all its fields, whose numbers and shapes were checked already; they become read-only.

        Raises:
            DataError: a class is no name.
        """
        detections = _settled(cls, _COLUMNS_FUSED, fields)
        _settle_classes(detections, FUSED_DETECTION, len(detections), group="detections")
        return detections

    @classmethod
    def empty(cls, timestamp: Timestamp, **pair: Any) -> "FusedDetections":
        """A pair in which nothing was found; `pair` are the fields that are not of one detection."""
        return cls(timestamp=timestamp, **_no_rows(_COLUMNS_FUSED), **pair)

    @property
    def in_image(self) -> BoolArray:
        """Which detections the image shows, (N,) bool: those whose outline has an area."""
        sides = self.corners_xyxy[:, 2:] > self.corners_xyxy[:, :2]
        shown: BoolArray = np.logical_and(sides[:, 0], sides[:, 1])
        return shown

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[FusedDetection]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> FusedDetection:
        return FusedDetection(
            timestamp=self.timestamp,
            box_3d_id=self.box_3d_ids[k],
            box_2d_id=self.box_2d_ids[k],
            **_fields_of(self, k, FUSED_DETECTION, _COLUMNS_FUSED),
        )


def _location(group: str, k: int, name: str) -> str:
    return f"{group}[{k}].{name}" if group else name


def _check_covariances(name: str, covariances: Float32Array, *, group: str) -> None:
    """Check that variances are not negative and covariances the same both ways."""
    mirrored = covariances.transpose(0, 2, 1)
    if (covariances == mirrored).all() and (covariances.reshape(-1, 9)[:, ::4] >= 0).all():
        return
    wide = covariances.astype(np.float64)
    asymmetry = np.abs(wide - wide.transpose(0, 2, 1)).max(axis=(1, 2))
    wrong = (asymmetry > _ASYMMETRY * np.abs(wide).max(axis=(1, 2))) | (wide.diagonal(axis1=1, axis2=2) < 0).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        numbers = covariances[k].reshape(-1).tolist()
        expected = "expected a symmetric 3x3 matrix without negative variances"
        raise FUSED_DETECTION.fault(_location(group, k, name), f"{numbers}; {expected}")


def _check_seen_in_space(
    sizes_lwh: Float32Array, directions: Float32Array, box_3d_ids: tuple[int | None, ...], *, group: str
) -> None:
    """Check that what a lidar saw has a size and heads somewhere."""
    seen = np.array([number is not None for number in box_3d_ids], np.bool_)
    for j, name in enumerate(("length", "width", "height")):
        flat = seen & (sizes_lwh[:, j] <= 0)
        if flat.any():
            raise FUSED_DETECTION.fault(_location(group, int(np.argmax(flat)), name), "0.0; expected more than 0")
    headless = seen & ~directions.any(axis=1)
    if headless.any():
        location = _location(group, int(np.argmax(headless)), "direction")
        raise FUSED_DETECTION.fault(location, "(0.0, 0.0, 0.0); expected a vector other than 0")


def join_boxes(lists: list[Boxes3d | Boxes2d]) -> Boxes3d | Boxes2d:
    """Put lists of one frame together; the first says the time."""
    first = lists[0]
    columns: dict[str, Any] = {}
    for column in COLUMNS_3D if isinstance(first, Boxes3d) else COLUMNS_2D:
        parts = [getattr(boxes, column.attribute) for boxes in lists]
        if column.optional and any(part is None for part in parts):
            columns[column.attribute] = None
        else:
            columns[column.attribute] = np.concatenate(parts)
    names = tuple(name for boxes in lists for name in boxes.class_names)
    return replace(first, class_names=names, **columns)


SensorRecord = RawData | ImageData | PointCloudData
"""What sensors send."""

DetectionRecord = Boxes3d | Boxes2d | Box3d | Box2d
"""What detectors send."""

SentRecord = SensorRecord | DetectionRecord
"""What the fusion system receives, clause 5.6."""

ResultRecord = SensorFusionData | FusedDetections
"""What the fusion system gives, clause 5.7."""

Record = CalibrationData | SentRecord | ResultRecord | FusedDetection
"""Any record of tables 3 to 10."""


@dataclass(frozen=True, slots=True)
class ListLayout:
    """How a list of records of one table is kept as columns.

    Attributes:
        group: what the list is called.
        table: of one record of it.
        columns: the arrays.
        shared: fields of each record that are the list's own: name in the record to attribute of the list.
        ids: fields that some of the records have: name in the record to attribute of the list.
    """

    group: str
    table: Table
    columns: tuple[Column, ...]
    shared: Mapping[str, str]
    ids: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class RecordKind:
    """One kind of record.

    Attributes:
        name: as the messages of the service call it.
        record_type: its class.
        message_name: its message in the `.proto`.
        table: of its fields; of a list those that its records have in common.
        layout: of a list, else None.
    """

    name: str
    record_type: type[Any]
    message_name: str
    table: Table
    layout: ListLayout | None = None


_BOXES_3D = ListLayout(
    "boxes", BOX_3D, COLUMNS_3D, {"points_seq": "seq", "timestamp": "timestamp"}, MappingProxyType({})
)

_BOXES_2D = ListLayout(
    "boxes", BOX_2D, COLUMNS_2D, {"image_seq": "seq", "timestamp": "timestamp"}, MappingProxyType({})
)

_DETECTIONS = ListLayout(
    "detections",
    FUSED_DETECTION,
    _COLUMNS_FUSED,
    {"timestamp": "timestamp"},
    MappingProxyType({"box_3d_id": "box_3d_ids", "box_2d_id": "box_2d_ids"}),
)

RECORD_KINDS: Mapping[str, RecordKind] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            RecordKind("raw", RawData, "RawData", RAW),
            RecordKind("image", ImageData, "ImageData", IMAGE),
            RecordKind("points", PointCloudData, "PointCloudData", POINT_CLOUD),
            RecordKind("boxes_3d", Boxes3d, "Boxes3d", BOXES_3D, _BOXES_3D),
            RecordKind("boxes_2d", Boxes2d, "Boxes2d", BOXES_2D, _BOXES_2D),
            RecordKind("box_3d", Box3d, "Box3d", BOX_3D),
            RecordKind("box_2d", Box2d, "Box2d", BOX_2D),
            RecordKind("calibration", CalibrationData, "Calibration", CALIBRATION),
            RecordKind("sensor_data", SensorFusionData, "SensorFusionData", SENSOR_FUSION),
            RecordKind("detections", FusedDetections, "FusedDetections", FUSED_DETECTIONS, _DETECTIONS),
            RecordKind("detection", FusedDetection, "FusedDetection", FUSED_DETECTION),
        )
    }
)
"""By name; those that can be sent and results have the names of the fields of SendRequest and GetReply."""


def size_of(record: Record) -> int:
    """How many bytes the arrays of a record have."""
    size = 0
    for name in _contents(cast("Any", type(record))):
        value = getattr(record, name)
        if value is not None:
            size += len(value) if isinstance(value, bytes) else value.nbytes
    return size


@cache
def _contents(record_type: type[Any]) -> tuple[str, ...]:
    """The attributes of a class of records that hold arrays or bytes."""
    kind = kind_of(record_type)
    if kind.layout is not None:
        return tuple(column.attribute for column in kind.layout.columns)
    return tuple(row.attribute for row in kind.table.rows if row.type in ARRAY_DTYPES or row.type == STREAM)


_KIND_OF = {kind.record_type: kind for kind in RECORD_KINDS.values()}


def kind_of(record: Record | type[Any]) -> RecordKind:
    """The kind of a record or of a class of records.

    Raises:
        OptionError: it is no record.
    """
    record_type = record if isinstance(record, type) else type(record)
    kind = _KIND_OF.get(record_type)
    if kind is None:
        known = ", ".join(known.__name__ for known in _KIND_OF)
        raise OptionError(f"a {record_type.__name__}; expected one of {known}")
    return kind
