"""Records of DB34/T 4101-2022, tables 3 to 10, and the table of all kinds of records.

Detections stand alone (`Box3d`) or as lists (`Boxes3d`) whose fields are columns. A record is checked when it is made:
a field that is missing, of another type, shape or dtype, out of range, or in contradiction to others is a DataError.
Arrays become read-only; those of pixels, points and depths can be given in any shape and are kept flat.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, cast

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

_NO_DIRECTION = "(0.0, 0.0, 0.0); expected a vector other than 0"


@dataclass(frozen=True, slots=True)
class Column:
    """An array of a list of records.

    Attributes:
        attribute: of the list.
        names: the rows of the table that it holds: each in a column of its own, or one in all of them.
        dtype, shape: of the array, and of one row of it.
        optional: it may be None, for all records at once.
    """

    attribute: str
    names: tuple[str, ...]
    dtype: DTypeLike = np.float32
    shape: tuple[int, ...] = ()
    optional: bool = False


@dataclass(frozen=True, slots=True)
class ListLayout:
    """How a list of records of one table is kept as columns.

    Attributes:
        group: name of the list in messages.
        table: of one record of it.
        columns: the arrays; the first one states how many records there are.
        shared: fields of each record that are the list's own: name in the record to attribute of the list.
        ids: fields that some of the records have: name in the record to attribute of the list.
    """

    group: str
    table: Table
    columns: tuple[Column, ...]
    shared: Mapping[str, str]
    ids: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    _rows: tuple[tuple[np.dtype[Any], tuple[Row, ...], Row | None], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        rows = [tuple(map(self.table.row, column.names)) for column in self.columns]
        # where all rows of a column have the same bounds, the first one stands for all
        alike = [each[0] if len({row.bounds for row in each}) == 1 else None for each in rows]
        dtypes = [np.dtype(column.dtype) for column in self.columns]
        object.__setattr__(self, "_rows", tuple(zip(dtypes, rows, alike, strict=True)))

    def settle(self, record: Any) -> None:
        """Check columns, classes and ids of a list that is being made; columns become read-only, the others tuples."""
        count: int | None = None
        for column, (dtype, rows, alike) in zip(self.columns, self._rows, strict=True):
            values = getattr(record, column.attribute)
            if column.optional and (values is None or count == 0):
                object.__setattr__(record, column.attribute, None)
                continue
            self._check_shape(values, column, dtype, count)
            count = len(values)
            if alike is None or not alike.admits(values):
                self._check_values(values, column, rows)
            object.__setattr__(record, column.attribute, read_only(values))
        self.settle_classes(record)
        for name, attribute in self.ids.items():
            self._settle_ids(record, attribute, self.table.row(name))

    def settle_classes(self, record: Any) -> None:
        """Check that there is a class for each record of a list, and that each is a name."""
        names = record.class_names
        if not isinstance(names, tuple | list) or len(names) != len(record):
            raise self.table.fault("class", f"{shown(names)}; expected a tuple of {len(record)}")
        row = self.table.row("class")
        for name in set(names) if set(map(type, names)) == {str} else names:
            try:
                row.check_class(name, self.table.owner)
            except DataError as error:
                raise self.table.fault(f"{self.group}[{names.index(name)}].class", error.problem) from error
        object.__setattr__(record, "class_names", tuple(names))

    def fields_of(self, record: Any, k: int) -> dict[str, Any]:
        """The fields of record k of a list that are not the list's own."""
        found: dict[str, Any] = {"class_name": record.class_names[k]}
        for column in self.columns:
            values = getattr(record, column.attribute)
            if values is None:
                continue
            numbers = values[k].reshape(-1).tolist()
            attributes = [self.table.row(name).attribute for name in column.names]
            if len(attributes) == 1:
                numbers = [tuple(numbers) if column.shape else numbers[0]]
            found.update(zip(attributes, numbers, strict=True))
        return found | {name: getattr(record, attribute)[k] for name, attribute in self.ids.items()}

    def columns_of(self, box: Any) -> dict[str, Any]:
        """The columns of a list of one record, and its class."""
        found: dict[str, Any] = {"class_names": (box.class_name,)}
        for column in self.columns:
            values = [getattr(box, self.table.row(name).attribute) for name in column.names]
            absent = column.optional and values[0] is None
            found[column.attribute] = None if absent else np.array(values, column.dtype).reshape(1, *column.shape)
        return found

    def no_rows(self) -> dict[str, Any]:
        """The columns of a list without records."""
        present = (column for column in self.columns if not column.optional)
        return {"class_names": ()} | {c.attribute: np.zeros((0, *c.shape), c.dtype) for c in present}

    def _check_shape(self, values: Any, column: Column, expected: np.dtype[Any], count: int | None) -> None:
        if isinstance(values, np.ndarray) and values.dtype == expected:
            rows = len(values) if values.ndim else -1
            if values.shape == (rows if count is None else count, *column.shape):
                return
        shape = ("N" if count is None else count, *column.shape)
        words = f"({', '.join(str(n) for n in shape)}) {expected.name}"
        raise DataError(self.table.owner, column.attribute, f"{shown(values)}; expected an array {words}")

    def _check_values(self, values: AnyArray, column: Column, rows: tuple[Row, ...]) -> None:
        flat = values.reshape(len(values), math.prod(values.shape[1:]))
        for j in range(flat.shape[1]):
            row = rows[j if len(rows) > 1 else 0]
            if not row.admits(flat[:, j]):
                k = row.first_refused(flat[:, j])
                location = f"{self.group}[{k}].{row.name}" + (f"[{j}]" if len(rows) == 1 and column.shape else "")
                raise DataError(self.table.owner, location, f"{flat[k, j]}; {row.wanted}")

    def _settle_ids(self, record: Any, attribute: str, row: Row) -> None:
        ids, count = getattr(record, attribute), len(record)
        if ids is None:
            ids = (None,) * count
        if not isinstance(ids, tuple | list) or len(ids) != count:
            raise self.table.fault(row.name, f"{shown(ids)}; expected a tuple of {count}")
        low, high = INTEGER_RANGES[BasicType.INT32]
        known = [k for k in ids if k is not None]
        if known and not (set(map(type, known)) == {int} and low <= min(known) and max(known) <= high):
            ids = tuple(row.check(k, self.table.owner) for k in ids)
        object.__setattr__(record, attribute, tuple(ids))


_SPATIAL = (
    Column("id", ("id",), np.int32),
    Column("confidence", ("confidence",)),
    Column("centers", ("X", "Y", "Z"), shape=(3,)),
    Column("sizes_lwh", ("length", "width", "height"), shape=(3,)),
    Column("directions", ("direction",), shape=(3,)),
    Column("velocities", ("velocity",)),
    Column("velocity_vectors", ("velocity_vector",), shape=(3,), optional=True),
)
_CORNERS = Column("corners_xyxy", ("x1", "y1", "x2", "y2"), np.uint32, (4,))
_COVARIANCES = {"center_cov": "center_covs", "size_cov": "size_covs"}

_LAYOUT_3D = ListLayout("boxes", BOX_3D, _SPATIAL, {"points_seq": "seq", "timestamp": "timestamp"})  # of `Boxes3d`

_LAYOUT_2D = ListLayout("boxes", BOX_2D, (*_SPATIAL[:2], _CORNERS), {"image_seq": "seq", "timestamp": "timestamp"})
"""Of `Boxes2d`."""

_LAYOUT_FUSED = ListLayout(
    "detections",
    FUSED_DETECTION,
    (*_SPATIAL, *(Column(each, (name,), shape=(3, 3)) for name, each in _COVARIANCES.items()), _CORNERS),
    {"timestamp": "timestamp"},
    MappingProxyType({"box_3d_id": "box_3d_ids", "box_2d_id": "box_2d_ids"}),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Box3d:
    """One box in space, in the lidar frame.

    Attributes:
        id: number of the box, an int32.
        class_name: class of the object; `class` in the standard.
        points_seq: seq of its point cloud.
        confidence: probability that the object exists, 0 to 1.
        timestamp: time of the box.
        X, Y, Z: centre of the box [m].
        length, width, height: of the box [m], more than 0.
        direction: heading, a vector of any length but 0.
        velocity: speed along the direction [m/s], negative for reversing.
        velocity_vector: velocity [m/s] along x, y, z, or None.

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
            raise BOX_3D.fault("direction", _NO_DIRECTION)

    def alone(self, sensor_id: int) -> "Boxes3d":
        """The list of this one box."""
        columns = _LAYOUT_3D.columns_of(self)
        return Boxes3d(sensor_id=sensor_id, seq=self.points_seq, timestamp=self.timestamp, **columns)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Boxes3d:
    """The boxes of one point cloud, in the lidar frame; no boxes if nothing was found.

    Attributes:
        sensor_id: of the lidar, 0 to 255.
        seq, timestamp: of the point cloud.
        id: (N,) int32.
        class_names: N classes.
        confidence: (N,) float32, 0 to 1.
        centers: (N, 3) float32 [m].
        sizes_lwh: (N, 3) float32 [m], more than 0.
        directions: (N, 3) float32, none of them 0.
        velocities: (N,) float32 [m/s] along the directions, negative for reversing.
        velocity_vectors: (N, 3) float32 [m/s], or None.

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
        _LAYOUT_3D.settle(self)
        _refuse_first(_LAYOUT_3D, ~self.directions.any(axis=1), "direction", _NO_DIRECTION)

    @classmethod
    def empty(cls, sensor_id: int, seq: int, timestamp: Timestamp) -> "Boxes3d":
        """A cloud in which nothing was found."""
        return cls(sensor_id=sensor_id, seq=seq, timestamp=timestamp, **_LAYOUT_3D.no_rows())

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[Box3d]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, k: int) -> Box3d:
        return Box3d(points_seq=self.seq, timestamp=self.timestamp, **_LAYOUT_3D.fields_of(self, k))


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
        columns = _LAYOUT_2D.columns_of(self)
        return Boxes2d(sensor_id=sensor_id, seq=self.image_seq, timestamp=self.timestamp, **columns)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Boxes2d:
    """The boxes of one image; no boxes if nothing was found.

    Attributes:
        sensor_id: of the camera, 0 to 255.
        seq, timestamp: of the image.
        id: (N,) int32.
        class_names: N classes.
        confidence: (N,) float32, 0 to 1.
        corners_xyxy: (N, 4) uint32 [px], left, upper, right and lower edge; each box has an area.

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
        _LAYOUT_2D.settle(self)
        _check_area(self.corners_xyxy, group="boxes")

    @classmethod
    def empty(cls, sensor_id: int, seq: int, timestamp: Timestamp) -> "Boxes2d":
        """An image in which nothing was found."""
        return cls(sensor_id=sensor_id, seq=seq, timestamp=timestamp, **_LAYOUT_2D.no_rows())

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[Box2d]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, k: int) -> Box2d:
        return Box2d(image_seq=self.seq, timestamp=self.timestamp, **_LAYOUT_2D.fields_of(self, k))


@dataclass(frozen=True, slots=True)
class Encoding:
    """One encoding of pixels.

    Attributes:
        channels: how many values a pixel may have.
        is_file: the data are a whole file, of any length, not pixel after pixel.
        order: which values make red, green and blue; None where that is not known.
    """

    channels: frozenset[int]
    is_file: bool = False
    order: tuple[int, int, int] | None = None

    def rgb(self, pixels: UInt8Array) -> UInt8Array:
        """Red, green and blue of pixels (H, W, C), which are of no file.

        Those of `raw` are grey, red green blue, or red green blue and transparency by their number of values.

        Returns:
            (H, W, 3) uint8, read-only; a view where they are in this order already.
        """
        order = self.order or ((0, 0, 0) if pixels.shape[2] == 1 else (0, 1, 2))
        if order == (0, 1, 2) and pixels.shape[2] == 3:
            return cast("UInt8Array", read_only(pixels))
        rgb = np.empty((*pixels.shape[:2], 3), np.uint8)
        for k, channel in enumerate(order):  # a seventh of the time of numbers of channels as an index
            rgb[:, :, k] = pixels[:, :, channel]
        return cast("UInt8Array", read_only(rgb))


ENCODINGS: Mapping[str, Encoding] = MappingProxyType(
    {
        "rgb8": Encoding(frozenset({3}), order=(0, 1, 2)),
        "bgr8": Encoding(frozenset({3}), order=(2, 1, 0)),
        "mono8": Encoding(frozenset({1}), order=(0, 0, 0)),
        "rgba8": Encoding(frozenset({4}), order=(0, 1, 2)),
        "bgra8": Encoding(frozenset({4}), order=(2, 1, 0)),
        "raw": Encoding(frozenset(range(1, 256))),
        "jpeg": Encoding(frozenset({1, 3, 4}), is_file=True),
        "png": Encoding(frozenset({1, 2, 3, 4}), is_file=True),
    }
)
"""By the names of table 5; those with 8 are the names that ROS gave them."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RawData:
    """Bytes as a sensor made them.

    Attributes:
        sensor_id: 0 to 255.
        timestamp: when they were made.
        seq: number in the sequence, a uint32.
        length: how many bytes.
        data: the bytes.

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
        data: uint8, height * width * channel values row by row; a whole file where the encoding is jpeg or png.

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
        _check_pixels(IMAGE, self, "channel", "data")

    @property
    def pixels(self) -> UInt8Array | None:
        """The pixels, (height, width, channel) uint8, a view; None of a file, which has to be decoded."""
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
        data: float32, number * fields_number values point by point. Points with a non-finite number, which is how
            drivers mark missing returns, are left out of the fusion and counted.
        sensor_type: 0 for a mechanical lidar, 1 for a solid-state lidar.
        beam: how many beams a mechanical lidar has, or None.
        ring: the beam that all points are of, where the lidar is mechanical, or None.

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
        _check_points(POINT_CLOUD, self, "fields", "number", "data")
        for name in ("beam", "ring"):
            if self.sensor_type == 1 and getattr(self, name) is not None:
                raise POINT_CLOUD.fault(name, f"{getattr(self, name)} of a solid-state lidar; expected none")

    @property
    def points(self) -> Float32Array:
        """The points, (number, fields_number) float32, a view."""
        return self.data.reshape(self.number, self.fields_number)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationData:
    """Intrinsics of a camera, and extrinsics between it and a lidar.

    What the numbers mean as a camera model and as frames is judged where they are used.

    Attributes:
        image_size: width and height [px], each at least 1.
        intrinsic_matrix: 9 numbers, 3x3 row-major.
        reference_frame: the frame that `extrinsic_matrix` maps into: 0 camera, 1 lidar.
        extrinsic_matrix: 16 numbers, 4x4; by columns, as the standard's example, or by rows.
        distortion_coeffs: 5 numbers, k1 k2 p1 p2 k3; None for none.

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
        image_data: uint8, height * width * image_channel values.
        image_depth: float32 [m], height * width values, 0 where no point is seen.
        point_num: how many points.
        point_fields: what each point has; x, y and z among it.
        fields_number: how many fields.
        point_data: float32, point_num * fields_number values.
        class_name: empty; `class` in the standard.
        depth_kind: one of `DEPTH_KINDS`; None where it was not stated.
        point_frame: one of `POINT_FRAMES`; None where it was not stated.
        motion_compensated: 1 where the ego trajectory was taken into account.
        image_timestamp: of the image; None where it was not stated.

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
        _check_pixels(SENSOR_FUSION, self, "image_channel", "image_data")
        if self.image_depth.size != self.height * self.width:
            expected = f"{self.height * self.width} (width * height)"
            raise SENSOR_FUSION.fault("image_depth", f"{self.image_depth.size} values; expected {expected}")
        _check_points(SENSOR_FUSION, self, "point_fields", "point_num", "point_data")
        for name, known in (("depth_kind", DEPTH_KINDS), ("point_frame", POINT_FRAMES)):
            word = getattr(self, name)
            if word is not None and word not in known:
                raise SENSOR_FUSION.fault(name, f"{shown(word)}; expected one of {', '.join(known)}")

    @property
    def pixels(self) -> UInt8Array | None:
        """The image, (height, width, image_channel) uint8, a view; None of a file, which has to be decoded."""
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


def _check_pixels(table: Table, record: Any, channel_name: str, data_name: str) -> None:
    """Check that encoding, size and number of values of an image belong together."""
    encoding, channels, length = record.encoding, getattr(record, channel_name), getattr(record, data_name).size
    known = ENCODINGS.get(encoding)
    if known is None:
        raise table.fault("encoding", f"{shown(encoding)}; expected one of {', '.join(ENCODINGS)}")
    if channels not in known.channels:
        expected = " or ".join(str(count) for count in sorted(known.channels))
        raise table.fault(channel_name, f"{channels} of {encoding}; expected {expected}")
    wanted = record.height * record.width * channels
    if known.is_file and length == 0:
        raise table.fault(data_name, f"empty; expected a file of {encoding}")
    if not known.is_file and length != wanted:
        raise table.fault(data_name, f"{length} values; expected {wanted} (width * height * {channel_name})")


def _check_points(table: Table, record: Any, fields_name: str, number_name: str, data_name: str) -> None:
    """Check the names of the fields of points, and that there are as many values as the points need."""
    fields, count, length = getattr(record, fields_name), record.fields_number, getattr(record, data_name).size
    if not {"x", "y", "z"} <= set(fields):
        raise table.fault(fields_name, f"{shown(fields)}; expected x, y and z among them")
    if "" in fields or len(set(fields)) != len(fields):
        raise table.fault(fields_name, f"{shown(fields)}; expected different names")
    if count != len(fields):
        raise table.fault("fields_number", f"{count}; expected {len(fields)}, as there are names in {fields_name}")
    wanted = getattr(record, number_name) * count
    if length != wanted:
        raise table.fault(data_name, f"{length} values; expected {wanted} ({number_name} * fields_number)")


@dataclass(frozen=True, slots=True, kw_only=True)
class FusedDetection:
    """One object, found in space, in an image, or in both.

    Attributes:
        id: number of the detection, an int32.
        confidence: probability that the object exists, 0 to 1.
        timestamp: time of the detection.
        class_name: class of the object; `class` in the standard.
        X, Y, Z: centre of the box [m], lidar frame.
        center_cov: 9 numbers [m²], 3x3 row-major.
        length, width, height: of the box [m]; more than 0 where there is a 3D box.
        size_cov: 9 numbers [m²], 3x3 row-major: length, width, height.
        direction: heading, lidar frame; not 0 where there is a 3D box.
        velocity: speed along the direction [m/s], negative for reversing.
        x1, y1, x2, y2: left, upper, right and lower edge in the image [px], uint32; all 0 of a detection that the
            image does not show: one behind the camera or beside its view.
        velocity_vector: velocity [m/s] along x, y, z, or None.
        box_3d_id, box_2d_id: the boxes it was made of; None for a sensor that did not see it.

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
        columns = _LAYOUT_FUSED.columns_of(self)
        _check_fused(columns, (self.box_3d_id,), group="")


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
        _LAYOUT_FUSED.settle(self)
        columns = {column.attribute: getattr(self, column.attribute) for column in _LAYOUT_FUSED.columns}
        _check_fused(columns, self.box_3d_ids, group="detections")

    @classmethod
    def of_sound_numbers(cls, **fields: Any) -> "FusedDetections":
        """Make it of all its fields, whose numbers and shapes were checked already; they become read-only.

        Raises:
            DataError: a class is no name.
        """
        detections = object.__new__(cls)
        for name, value in fields.items():
            object.__setattr__(detections, name, value)
        for column in _LAYOUT_FUSED.columns:
            if fields[column.attribute] is not None:
                fields[column.attribute].flags.writeable = False
        _LAYOUT_FUSED.settle_classes(detections)
        return detections

    @classmethod
    def empty(cls, timestamp: Timestamp, **pair: Any) -> "FusedDetections":
        """A pair in which nothing was found; `pair` are the fields that are not of one detection."""
        return cls(timestamp=timestamp, **_LAYOUT_FUSED.no_rows(), **pair)

    @property
    def in_image(self) -> BoolArray:
        """Which detections the image shows, (N,) bool: those whose outline has an area."""
        sides = self.corners_xyxy[:, 2:] > self.corners_xyxy[:, :2]
        shown: BoolArray = np.logical_and(sides[:, 0], sides[:, 1])
        return shown

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[FusedDetection]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, k: int) -> FusedDetection:
        return FusedDetection(timestamp=self.timestamp, **_LAYOUT_FUSED.fields_of(self, k))


def _location(group: str, k: int, name: str) -> str:
    return f"{group}[{k}].{name}" if group else name


def _refuse_first(layout: ListLayout, wrong: Any, name: str, problem: str, *, group: str | None = None) -> None:
    """Refuse a list in which a record is wrong, (N,) bool; the message names the first."""
    if wrong.any():
        where = _location(layout.group if group is None else group, int(np.argmax(wrong)), name)
        raise layout.table.fault(where, problem)


def _check_area(corners_xyxy: UInt32Array, *, group: str) -> None:
    """Check that boxes of table 8 have an area; right and lower edges are exclusive."""
    areas = corners_xyxy[:, 2:] > corners_xyxy[:, :2]
    if not areas.all():
        k, axis = divmod(int(np.argmin(areas.reshape(-1))), 2)
        name, first = ("x2", "y2")[axis], int(corners_xyxy[k, axis])
        problem = f"{corners_xyxy[k, 2 + axis]}; expected more than {first}, which is {name[0]}1: edges are exclusive"
        raise BOX_2D.fault(_location(group, k, name), problem)


_ASYMMETRY = 1e-3  # how much a covariance of 32-bit numbers may differ from its transpose, of its largest number


def _check_fused(columns: Mapping[str, Any], box_3d_ids: Sequence[int | None], *, group: str) -> None:
    """Check what the columns of fused detections have to fulfil beyond the ranges of their fields."""
    corners = columns["corners_xyxy"]
    for name, first, second in (("x2", 0, 2), ("y2", 1, 3)):
        wrong = corners[:, second] < corners[:, first]
        if wrong.any():
            k = int(np.argmax(wrong))
            problem = f"{corners[k, second]}; expected {corners[k, first]} or more, as {name[0]}1"
            raise FUSED_DETECTION.fault(_location(group, k, name), problem)
    for name, attribute in _COVARIANCES.items():
        _check_covariances(name, columns[attribute], group=group)
    seen = np.array([number is not None for number in box_3d_ids], np.bool_)
    for j, name in enumerate(("length", "width", "height")):
        flat = seen & (columns["sizes_lwh"][:, j] <= 0)
        _refuse_first(_LAYOUT_FUSED, flat, name, "0.0; expected more than 0", group=group)
    headless = seen & ~columns["directions"].any(axis=1)
    _refuse_first(_LAYOUT_FUSED, headless, "direction", _NO_DIRECTION, group=group)


def _check_covariances(name: str, covariances: Float32Array, *, group: str) -> None:
    """Check that variances are not negative and covariances symmetric."""
    mirrored = covariances.transpose(0, 2, 1)
    if (covariances == mirrored).all() and (covariances.reshape(-1, 9)[:, ::4] >= 0).all():
        return
    wide = covariances.astype(np.float64)
    asymmetry = np.abs(wide - wide.transpose(0, 2, 1)).max(axis=(1, 2))
    wrong = (asymmetry > _ASYMMETRY * np.abs(wide).max(axis=(1, 2))) | (wide.diagonal(axis1=1, axis2=2) < 0).any(axis=1)
    numbers = covariances[int(np.argmax(wrong))].reshape(-1).tolist()
    problem = f"{numbers}; expected a symmetric 3x3 matrix without negative variances"
    _refuse_first(_LAYOUT_FUSED, wrong, name, problem, group=group)


def join_boxes(lists: list[Boxes3d | Boxes2d]) -> Boxes3d | Boxes2d:
    """Join lists of one frame; the time is that of the first."""
    first = lists[0]
    columns: dict[str, Any] = {}
    for column in (_LAYOUT_3D if isinstance(first, Boxes3d) else _LAYOUT_2D).columns:
        parts = [getattr(boxes, column.attribute) for boxes in lists]
        absent = column.optional and any(part is None for part in parts)
        columns[column.attribute] = None if absent else np.concatenate(parts)
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
class RecordKind:
    """One kind of record.

    Attributes:
        name: in the messages of the service.
        record_type: its class.
        message_name: its message in the `.proto`.
        table: of its fields; of a list those that its records have in common.
        layout: of a list, else None.
        arrays: the attributes that hold arrays or bytes.
    """

    name: str
    record_type: type[Any]
    message_name: str
    table: Table
    layout: ListLayout | None = None
    arrays: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        rows = (row for row in self.table.rows if row.type in ARRAY_DTYPES or row.type == STREAM)
        columns = () if self.layout is None else self.layout.columns
        arrays = tuple(column.attribute for column in columns) or tuple(row.attribute for row in rows)
        object.__setattr__(self, "arrays", arrays)


RECORD_KINDS: Mapping[str, RecordKind] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            RecordKind("raw", RawData, "RawData", RAW),
            RecordKind("image", ImageData, "ImageData", IMAGE),
            RecordKind("points", PointCloudData, "PointCloudData", POINT_CLOUD),
            RecordKind("boxes_3d", Boxes3d, "Boxes3d", BOXES_3D, _LAYOUT_3D),
            RecordKind("boxes_2d", Boxes2d, "Boxes2d", BOXES_2D, _LAYOUT_2D),
            RecordKind("box_3d", Box3d, "Box3d", BOX_3D),
            RecordKind("box_2d", Box2d, "Box2d", BOX_2D),
            RecordKind("calibration", CalibrationData, "Calibration", CALIBRATION),
            RecordKind("sensor_data", SensorFusionData, "SensorFusionData", SENSOR_FUSION),
            RecordKind("detections", FusedDetections, "FusedDetections", FUSED_DETECTIONS, _LAYOUT_FUSED),
            RecordKind("detection", FusedDetection, "FusedDetection", FUSED_DETECTION),
        )
    }
)
"""By name; those that can be sent and results have the names of the fields of SendRequest and GetReply."""

_KIND_OF = {kind.record_type: kind for kind in RECORD_KINDS.values()}


def size_of(record: Record) -> int:
    """How many bytes the arrays of a record have."""
    size = 0
    for name in kind_of(record).arrays:
        value = getattr(record, name)
        if value is not None:
            size += len(value) if isinstance(value, bytes) else value.nbytes
    return size


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
