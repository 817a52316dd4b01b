"""Detections as records: 3D boxes (table 7) and 2D boxes (table 8), one by one and as lists.

Whose fields are columns.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

from sceneloom.arrays import AnyArray, Float32Array, UInt32Array, read_only
from sceneloom.db34t.tables import BOX_2D, BOX_3D, BOXES_2D, BOXES_3D, Row, Table
from sceneloom.db34t.types import INTEGER_RANGES, BasicType, Timestamp, shown
from sceneloom.errors import DataError

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


class ColumnChecks:
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
            rows[0] if all(row.bounds == rows[0].bounds for row in rows) else None
            for _, _, rows in self._columns
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


def settled(record_type: type[_List], columns: Sequence[Column], values: Mapping[str, Any]) -> _List:
    """Make a list of fields that are what its checks would make of them; its columns become read-only."""
    record = object.__new__(record_type)
    for name, value in values.items():
        object.__setattr__(record, name, value)
    for column in columns:
        value = values[column.attribute]
        if value is not None:
            value.flags.writeable = False
    return record


def settle_classes(record: Any, table: Table, count: int, *, group: str) -> None:
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


def settle_ids(record: Any, attribute: str, row: Row, table: Table, count: int) -> None:
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


def _check_shape(
    values: Any, column: Column, expected: np.dtype[Any], table: Table, count: int | None
) -> None:
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

_CHECKS_3D = ColumnChecks(BOX_3D, COLUMNS_3D, group="boxes")

_CHECKS_2D = ColumnChecks(BOX_2D, COLUMNS_2D, group="boxes")


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
        vector = self.velocity_vector
        return Boxes3d(
            sensor_id=sensor_id,
            seq=self.points_seq,
            timestamp=self.timestamp,
            id=np.array([self.id], np.int32),
            class_names=(self.class_name,),
            confidence=np.array([self.confidence], np.float32),
            centers=np.array([[self.X, self.Y, self.Z]], np.float32),
            sizes_lwh=np.array([[self.length, self.width, self.height]], np.float32),
            directions=np.array([self.direction], np.float32),
            velocities=np.array([self.velocity], np.float32),
            velocity_vectors=None if vector is None else np.array([vector], np.float32),
        )


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
        settle_classes(self, BOX_3D, count, group="boxes")
        heads = self.directions.any(axis=1)
        if not heads.all():
            location = f"boxes[{int(np.argmin(heads))}].direction"
            raise BOX_3D.fault(location, "(0.0, 0.0, 0.0); expected a vector other than 0")

    @classmethod
    def empty(cls, sensor_id: int, seq: int, timestamp: Timestamp) -> "Boxes3d":
        """A cloud in which nothing was found."""
        none = {
            column.attribute: np.zeros((0, *column.shape), column.dtype)
            for column in COLUMNS_3D
            if not column.optional
        }
        return cls(sensor_id=sensor_id, seq=seq, timestamp=timestamp, class_names=(), **none)

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[Box3d]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> Box3d:
        X, Y, Z = self.centers[k].tolist()
        length, width, height = self.sizes_lwh[k].tolist()
        vectors = self.velocity_vectors
        return Box3d(
            id=int(self.id[k]),
            class_name=self.class_names[k],
            points_seq=self.seq,
            confidence=float(self.confidence[k]),
            timestamp=self.timestamp,
            X=X,
            Y=Y,
            Z=Z,
            length=length,
            width=width,
            height=height,
            direction=tuple(self.directions[k].tolist()),
            velocity=float(self.velocities[k]),
            velocity_vector=None if vectors is None else tuple(vectors[k].tolist()),
        )


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
        return Boxes2d(
            sensor_id=sensor_id,
            seq=self.image_seq,
            timestamp=self.timestamp,
            id=np.array([self.id], np.int32),
            class_names=(self.class_name,),
            confidence=np.array([self.confidence], np.float32),
            corners_xyxy=np.array([[self.x1, self.y1, self.x2, self.y2]], np.uint32),
        )


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
        settle_classes(self, BOX_2D, count, group="boxes")
        _check_area(self.corners_xyxy, group="boxes")

    @classmethod
    def empty(cls, sensor_id: int, seq: int, timestamp: Timestamp) -> "Boxes2d":
        """An image in which nothing was found."""
        none = {column.attribute: np.zeros((0, *column.shape), column.dtype) for column in COLUMNS_2D}
        return cls(sensor_id=sensor_id, seq=seq, timestamp=timestamp, class_names=(), **none)

    def __len__(self) -> int:
        return len(self.id)

    def __iter__(self) -> Iterator[Box2d]:
        return (self[k] for k in range(len(self)))

    def __getitem__(self, k: int) -> Box2d:
        x1, y1, x2, y2 = self.corners_xyxy[k].tolist()
        return Box2d(
            id=int(self.id[k]),
            class_name=self.class_names[k],
            image_seq=self.seq,
            confidence=float(self.confidence[k]),
            timestamp=self.timestamp,
            x1=x1,
            y1=y1,
            x2=x2,
            y2=y2,
        )


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
    problem = (
        f"{corners_xyxy[k, 2 + axis]}; expected more than {first}, which is {name[0]}1: edges are exclusive"
    )
    raise BOX_2D.fault(f"{group}[{k}].{name}" if group else name, problem)


def check_corners(table: Table, corners_xyxy: UInt32Array, *, group: str) -> None:
    """Check that no box is rotated inside out.

    Args:
        group: how messages call the list; "" for a single box.

    Raises:
        DataError: a right edge is before the left one, or a lower edge above the upper one.
    """
    for name, first, second in (("x2", 0, 2), ("y2", 1, 3)):
        wrong = corners_xyxy[:, second] < corners_xyxy[:, first]
        if wrong.any():
            k = int(np.argmax(wrong))
            location = f"{group}[{k}].{name}" if group else name
            raise table.fault(
                location,
                f"{corners_xyxy[k, second]}; expected {corners_xyxy[k, first]} or more, as {name[0]}1",
            )
