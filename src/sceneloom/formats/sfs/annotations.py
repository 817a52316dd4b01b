"""Annotations of a file, read and written by one table: the fields of each type and the attributes of its model."""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import accumulate, chain
from types import MappingProxyType
from typing import Any, Literal

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, CalibrationError, OptionError
from sceneloom.formats.sfs.clock import FileClock, StaticTime, TimeRangeError
from sceneloom.formats.sfs.records import (
    Faults,
    FieldError,
    Location,
    Source,
    described,
    extras_of_intrinsics,
    extras_of_poses,
    read_camera_model,
    repaired_poses,
    rows_of,
    times_of,
    with_extras,
)
from sceneloom.formats.sfs.schema import ANNOTATION_RECORDS, annotation_record
from sceneloom.formats.sfs.sensors import intrinsics_record
from sceneloom.formats.sfs.spec import PAIRS
from sceneloom.scene.annotations import (
    DIMENSIONS,
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
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
    ShapeType,
    VertexPath,
)
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import NO_FIELDS, Identifier
from sceneloom.warnings import WarningKind

_Fields = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Record:
    """A record of the file that is being read: an annotation, or a part of one."""

    source: Source
    fields: _Fields  # checked by the table of fields, times in nanoseconds
    root: Location  # where the annotation is in the file
    location: Location  # where the record is in the annotation
    faults: Faults  # with locations in the annotation
    type: str = ""  # of the annotation

    def part(self, fields: _Fields, *below: str | int) -> "_Record":
        """A record inside this one."""
        return _Record(self.source, fields, self.root, (*self.location, *below), self.faults, self.type)

    def build(self, model: Callable[..., Any], columns: Mapping[str, "_Column"], **given: Any) -> Any:
        """Make an object of the model; None where something is at fault. Unknown fields become its `extras`."""
        before, extras = len(self.faults), {}
        for name, value in self.fields.items():
            column = columns.get(name)
            if column is None:
                extras[name] = value
            elif value is not None:
                read = column.read
                given[column.attribute or name] = value if read is None else read(self, name, value)
                if column.extras is not None and (unknown := column.extras(value)):
                    extras[name] = unknown
        if any(not fault.repaired for fault in self.faults[before:]):
            return None
        with _noting(self.faults, self.location):
            return model(**given, extras=extras)
        return None

    def warn_flat(self, *below: str | int) -> None:
        """Warn that a path in space has pairs for positions."""
        message = "pairs where locations in the world were expected; their z is taken as 0"
        where = (*self.root, *self.location, *below)
        self.source.warning(WarningKind.ASSUMED, "no-height", where, message)


@dataclass(frozen=True, slots=True)
class _Column:
    """A field of a record and the attribute of the model that holds it; it passes as it is where a function is None."""

    attribute: str = ""  # its name in the model, if it is another one
    read: Callable[[_Record, str, Any], Any] | None = None  # of record, name and value
    write: Callable[[str, Any, Any], Any] | None = None  # of location, attribute and its unknown fields
    extras: Callable[[Any], _Fields] | None = None  # unknown fields of a value that the model has no object for


class _NotFiniteError(ValueError):
    """Where a number is not finite, below the annotation, and which."""


def read_attributes(source: Source, records: Any, faults: Faults) -> tuple[AttributePath, ...]:
    """Read the attributes of the scene or of a sensor from their records."""
    return _read_attributes(_Record(source, {}, (), (), faults), "attributes", records or ())


def attribute_values(values: Any) -> tuple[Any, ...]:
    """Take the values of an attribute: lists of texts become tuples, all else stays what it is."""
    listed = values.tolist() if isinstance(values, np.ndarray) else values or ()
    return tuple(
        tuple(value) if isinstance(value, list) and all(isinstance(text, str) for text in value) else value
        for value in listed
    )


def attribute_record(attribute: AttributePath) -> dict[str, Any]:
    """Make the record of an attribute."""
    record = _written(attribute, _ATTRIBUTE)
    if attribute.timestamps_ns is None and not attribute.values:
        del record["values"]
    return record


def encode_annotation(annotation: Annotation) -> dict[str, Any]:
    """Make the record of an annotation.

    Raises:
        OptionError: a number of it is not finite; rows of NaN, where they mean "none", are written as null.
    """
    if isinstance(annotation, PlainAnnotation):
        return {"id": annotation.id, "type": annotation.type, **annotation.fields}
    head = {"id": annotation.id, "type": str(annotation.type)}
    try:
        return _written(annotation, _COLUMNS[type(annotation)], head=head)
    except _NotFiniteError as error:
        raise OptionError(f"annotations[{annotation.id}].{error}") from None


def _written(
    value: Any, columns: Mapping[str, _Column], *, location: str = "", head: _Fields = MappingProxyType({})
) -> dict[str, Any]:
    """Make the record of an object of the model; fields that are not stated are left out."""
    record, extras = dict(head), value.extras
    for name, column in columns.items():
        held = getattr(value, column.attribute or name)
        if held is not None and column.write is not None:
            held = column.write(f"{location}{name}", held, extras.get(name))
        if held is not None:
            record[name] = held
    return with_extras(record, extras) if extras else record


def read_annotations(source: Source, raw: Any, location: Location) -> tuple[Annotation, ...]:
    """Read a list of annotations; those at fault are left out if the caller is lenient."""
    if raw is None:
        return ()
    if not isinstance(raw, list):
        faults = Faults()
        faults.add((), "expected a list of annotations")
        source.collect(faults, location)
        return ()
    usual = _read_usual_cuboids(raw, source.clock)
    annotations: list[Annotation] = []
    for index, item in enumerate(raw):
        if index in usual:
            annotations.append(usual[index])
            continue
        faults = Faults()
        annotation = _read_annotation(source, item, (*location, index), faults)
        if source.settle(faults, (*location, index)) and annotation is not None:
            annotations.append(annotation)
    return tuple(annotations)


def _read_annotation(source: Source, raw: Any, location: Location, faults: Faults) -> Annotation | None:
    type_name = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(type_name, str):
        faults.add(("type",), f"{type_name!r}; expected one of {', '.join(ANNOTATION_RECORDS)}")
        return None
    if type_name == "event" and raw.get("start") is None:
        source.warning(WarningKind.ASSUMED, "event-is-object", location, "an event without a start; read as an object")
        type_name = "object"
    known = type_name in ANNOTATION_RECORDS
    values = source.reader(forgiving=not known).read(raw, annotation_record(type_name), faults)
    if not known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults.unrepaired:
        return None
    del values["type"]
    model = _MODELS.get(type_name)
    if model is None:
        return PlainAnnotation(values.pop("id"), type_name, values)
    record, columns = _Record(source, values, location, (), faults, type_name), _COLUMNS[model]
    if model is ShapeAnnotation and type_name != ShapeType.POLYLINE:
        columns = {name: column for name, column in columns.items() if name != "is_closed"}
    given = {"type": ShapeType(type_name) if model is ShapeAnnotation else type_name}
    annotation: Annotation | None = record.build(model, columns, **given if model in _TYPED else {})
    if isinstance(annotation, PointsAnnotation) and annotation.labels is not None:
        labels, paths = len(annotation.labels), annotation.paths
        points = sum(path.values.shape[1] // 3 for path in paths)
        if labels not in {len(paths), points}:
            faults.add(("labels",), f"{labels} labels for {points} points; expected as many of both")
    return annotation


@contextmanager
def _noting(faults: Faults, location: Location) -> Iterator[None]:
    """Turn what a part refuses into a fault at its location."""
    try:
        yield
    except FieldError as error:
        faults.add(location, str(error), code=error.code)
    except ArrayError as error:
        faults.add(location, str(error))


def _check_counts(record: _Record, values: Sized, name: str = "values") -> None:
    """Refuse more or fewer values than timestamps."""
    times = record.fields["timestamps"]
    if len(times) != len(values):
        raise FieldError(f"{len(times)} timestamps and {len(values)} {name}; expected as many of both")


def _read_durations(record: _Record, name: str, raw: Any) -> tuple[Any, ...]:
    with _noting(record.faults, (*record.location, name)):
        _check_counts(record, raw, name)
    return tuple(raw)


def _read_confirmed(record: _Record, name: str, raw: Any) -> tuple[bool | None, ...]:
    """Read `confirmed`: true, false or null for each timestamp."""
    listed = raw.tolist() if isinstance(raw, np.ndarray) else raw
    for index, value in enumerate(listed):
        if value is not None and not isinstance(value, bool):
            problem = f"{described(value)}; expected true, false or null"
            record.faults.add((*record.location, name, index), problem)
    with _noting(record.faults, (*record.location, name)):
        _check_counts(record, listed)
    return tuple(listed)


def _read_labels(record: _Record, name: str, raw: Any) -> tuple[str, ...]:
    for index, label in enumerate(raw):
        if not isinstance(label, str):
            record.faults.add((name, index), f"{label!r}; expected text")
    return tuple(raw)


def _read_rows(record: _Record, name: str, raw: Any, *, columns: int) -> Float64Array | None:
    """Read rows of numbers, (N, columns) float64; each row that is none becomes a fault with its number."""
    location, faults = (*record.location, name), record.faults
    try:
        rows = rows_of(raw, columns)
    except FieldError as error:
        before = len(faults)
        for index, row in enumerate(raw if isinstance(raw, list) else ()):
            _note_bad_row(row, columns, faults, (*location, index))
        if len(faults) == before:
            faults.add(location, str(error))
        return None
    with _noting(faults, record.location):
        _check_counts(record, rows)
    return read_only(rows)


def _read_nullable_rows(record: _Record, name: str, raw: Any, *, columns: int) -> Float64Array | None:
    """Read rows in which null stands for none, (N, columns) float64 with rows of NaN for null."""
    location, faults = (*record.location, name), record.faults
    listed: Sequence[Any] = raw.tolist() if isinstance(raw, np.ndarray) else raw
    kept = [index for index, row in enumerate(listed) if row is not None]
    before = len(faults)
    with _noting(faults, location):
        _check_counts(record, listed, name)
    try:
        rows = rows_of([listed[index] for index in kept], columns)
    except FieldError as error:
        for index in kept:
            _note_bad_row(listed[index], columns, faults, (*location, index))
        if len(faults) == before:
            faults.add(location, str(error))
        return None
    array = np.full((len(listed), columns), np.nan)
    array[kept] = rows
    return read_only(array)


def _note_bad_row(row: Any, columns: int, faults: Faults, location: Location) -> None:
    """Note a row that is not that many numbers."""
    numbers = isinstance(row, list | np.ndarray) and all(
        isinstance(value, int | float | np.number) and not isinstance(value, bool) for value in row
    )
    if not numbers or len(row) != columns:
        found = f"{len(row)} numbers" if numbers else described(row)
        faults.add(location, f"{found}; expected {columns} numbers")


def _write_rows(location: str, values: Float64Array, _: Any) -> Float64Array:
    if np.isfinite(values).all():
        return values
    row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
    raise _NotFiniteError(f"{location}[{row}]: {values[row].tolist()}; expected finite numbers")


def _write_nullable_rows(location: str, values: Float64Array, _: Any) -> Any:
    """Write rows of NaN as null."""
    if np.isfinite(values).all():
        return values
    rows: list[list[float] | None] = values.tolist()
    for row in np.flatnonzero(~np.isfinite(values).all(axis=1)).tolist():
        if not np.isnan(values[row]).all():
            problem = f"{rows[row]}; expected finite numbers, or NaN for all of them"
            raise _NotFiniteError(f"{location}[{row}]: {problem}")
        rows[row] = None
    return rows


def _read_points(record: _Record, name: str, raw: Any) -> Float64Array | None:
    """Read rows of x, y, z, or of several such triples; of pairs, z is 0."""
    columns = len(raw[0]) if len(raw) and isinstance(raw[0], list | np.ndarray) else 3
    rows = _read_rows(record, name, raw, columns=columns)
    if rows is None:
        return None
    if _fits_pairs_only([columns]):
        record.warn_flat(name)
        return read_only(_with_height(rows.reshape(-1, 2)).reshape(len(rows), -1))
    if columns % 3 or columns == 0:
        problem = f"rows of {columns} numbers; expected x, y, z"
        record.faults.add((*record.location, name), problem)
    return rows


def _read_vertices(record: _Record, name: str, raw: Any) -> tuple[Float64Array, ...]:
    """Cut the rows of a shape into vertices, (V, D) float64 each; where rows fit pairs only, z is 0."""
    kind, asked, faults = ShapeType(record.type), record.source.options.vertices, record.faults
    location, dimensions = (*record.location, name), DIMENSIONS[kind]
    listed: Sequence[Any] = list(raw)
    arrays = [_read_numbers(row, faults, (*location, index)) for index, row in enumerate(listed)]
    found = [array for array in arrays if array is not None]
    if len(found) != len(listed):
        return ()
    if asked is None or kind not in _OUTLINES:
        are_pairs = _fits_pairs_only([array.size for array in found])
    else:
        are_pairs = asked == PAIRS
    flat = dimensions == 3 and are_pairs
    size = 2 if flat else dimensions
    for index, array in enumerate(found):
        if array.size % size:
            problem = f"{array.size} numbers; expected a multiple of {size}, {size} per vertex"
            faults.add((*location, index), problem)
    if faults.unrepaired:
        return ()
    with _noting(faults, record.location):
        _check_counts(record, found)
    if flat:
        record.warn_flat(name)
    cut = [array.reshape(-1, size) for array in found]
    return tuple(read_only(_with_height(array) if flat else array) for array in cut)


_OUTLINES = frozenset({ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYLINE})


def _fits_pairs_only(sizes: Sequence[int]) -> bool:
    """Whether rows are pairs and cannot be triples: all of even length, one of them no multiple of three."""
    return all(size % 2 == 0 for size in sizes) and any(size % 3 for size in sizes)


def _with_height(pairs: Float64Array) -> Float64Array:
    """Add z = 0 to (V, 2) positions."""
    return np.column_stack([pairs, np.zeros(len(pairs))])


def _read_numbers(row: Any, faults: Faults, location: Location) -> Float64Array | None:
    array: AnyArray | None = None
    if isinstance(row, list | np.ndarray):
        try:
            array = np.asarray(row)
        except (ValueError, OverflowError):
            array = None
    if array is None or array.ndim != 1 or (array.size and array.dtype.kind not in "iuf"):
        faults.add(location, f"{described(row)}; expected a list of numbers")
        return None
    return array.astype(np.float64)


def _write_vertices(location: str, vertices: tuple[Float64Array, ...], _: Any) -> list[list[float]]:
    return [
        _write_rows(f"{location}[{k}], vertices", rows, None).reshape(-1).tolist() for k, rows in enumerate(vertices)
    ]


def _read_poses(record: _Record, name: str, raw: Any) -> Poses | None:
    before = len(record.faults)
    path = repaired_poses(raw, record.faults)
    if path is None and len(record.faults) == before:
        record.faults.add((name,), "empty; expected at least one pose")
    return path


def _write_poses(_: str, poses: Poses, extras: Any) -> dict[str, Any]:
    """Write poses; the time of one that holds at all times means nothing."""
    times: Any = StaticTime(poses.start_ns) if poses.static else poses.timestamps_ns
    rows = np.hstack([poses.positions, poses.quaternions_xyzw])
    return with_extras({"timestamps": times, "values": rows}, extras if isinstance(extras, Mapping) else {})


def _read_intrinsics(record: _Record, name: str, raw: Any) -> Camera | None:
    try:
        return read_camera_model(record.source, raw, {}, (*record.root, name))
    except (FieldError, CalibrationError) as error:
        record.faults.add((name,), str(error))
        return None


def _read_attributes(record: _Record, name: str, raw: Any) -> tuple[AttributePath, ...]:
    built = (
        record.part(fields, name, index).build(AttributePath, _ATTRIBUTE, values=()) for index, fields in enumerate(raw)
    )
    return tuple(attribute for attribute in built if attribute is not None)


def _record(model: Callable[..., Any], columns: Mapping[str, _Column]) -> _Column:
    """A field that holds one record."""

    def read(record: _Record, name: str, raw: Any) -> Any:
        return record.part(raw, name).build(model, columns)

    def write(location: str, value: Any, _: Any) -> dict[str, Any]:
        return _written(value, columns, location=f"{location}.")

    return _Column(read=read, write=write)


def _records(
    model: Callable[..., Any], columns: Mapping[str, _Column], *, depth: int = 1, required: bool = False
) -> _Column:
    """A list of records, or of lists of them (one in place of a list is taken); empty is left out if not required."""

    def read_level(record: _Record, location: Location, raw: Any, level: int) -> Any:
        if level and not isinstance(raw, dict):
            parts = (read_level(record, (*location, k), item, level - 1) for k, item in enumerate(raw))
            return tuple(part for part in parts if part is not None)
        part = record.part(raw, *location).build(model, columns)
        return part if not level else () if part is None else (part,)

    def read(record: _Record, name: str, raw: Any) -> Any:
        return read_level(record, (name,), raw, depth)

    def write_list(location: str, values: Any, below: int) -> Any:
        if not below:
            return _written(values, columns, location=f"{location}.")
        return [write_list(f"{location}[{k}]", value, below - 1) for k, value in enumerate(values)]

    def write(location: str, values: Any, _: Any) -> Any:
        return write_list(location, values, depth) if values or required else None

    return _Column(read=read, write=write)


_AS_IS = _Column()
_TIMESTAMPS = _Column("timestamps_ns", lambda _, __, raw: read_only(times_of(raw)))


def _nullable_rows(columns: int) -> _Column:
    return _Column(read=partial(_read_nullable_rows, columns=columns), write=_write_nullable_rows)


def _path(read: Callable[..., Any], write: Callable[..., Any] = _write_rows) -> Mapping[str, _Column]:
    return {"timestamps": _TIMESTAMPS, "values": _Column(read=read, write=write)}


_ATTRIBUTE: Mapping[str, _Column] = {
    "name": _AS_IS,
    "sensor_id": _AS_IS,
    "static": _AS_IS,
    "point_index": _AS_IS,
    "timestamps": _TIMESTAMPS,
    "values": _Column(read=lambda _, __, raw: attribute_values(raw)),
}

_SEEN = {"sensor_id": _AS_IS, "timestamps": _TIMESTAMPS}  # what activations and projections begin with
_CONFIRMED = _Column(read=_read_confirmed)
_CUBOIDS = _nullable_rows(9)
_POSES = _Column(read=_read_poses, write=_write_poses, extras=extras_of_poses)
_ANY = {"id": _AS_IS, "parent_id": _AS_IS}
_ATTRIBUTES = _Column(
    read=_read_attributes, write=lambda _, attributes, __: list(map(attribute_record, attributes)) or None
)
_LABELLED = {**_ANY, "label": _AS_IS, "attributes": _ATTRIBUTES}
_OBJECT = {**_ANY, "label": _AS_IS, "stationary": _AS_IS, "attributes": _ATTRIBUTES}

_COLUMNS: Mapping[type, Mapping[str, _Column]] = {
    CuboidAnnotation: {
        **_OBJECT,
        "path": _record(CuboidPath, _path(partial(_read_rows, columns=9))),
        "activations": _records(
            Activation, {**_SEEN, "durations": _Column("durations_ns", _read_durations), "cuboids": _CUBOIDS}
        ),
        "projections": _records(
            Projection, {**_SEEN, "boxes": _nullable_rows(4), "confirmed": _CONFIRMED, "cuboids": _CUBOIDS}
        ),
    },
    Box2DAnnotation: {**_OBJECT, "sensor_id": _AS_IS, "path": _record(BoxPath, _path(partial(_read_rows, columns=4)))},
    ShapeAnnotation: {
        **_OBJECT,
        "sensor_id": _AS_IS,
        "is_closed": _AS_IS,
        "path": _record(
            VertexPath, {"timestamps": _TIMESTAMPS, "values": _Column("vertices", _read_vertices, _write_vertices)}
        ),
    },
    PointsAnnotation: {
        **_ANY,
        "stationary": _AS_IS,
        "attributes": _ATTRIBUTES,
        "sensor_id": _AS_IS,
        "labels": _Column(read=_read_labels),
        "paths": _records(PointPath, {"id": _AS_IS, **_path(_read_points)}, required=True),
        "projections": _records(
            PointProjection,
            {**_SEEN, "points": _nullable_rows(2), "confirmed": _CONFIRMED, "positions": _nullable_rows(3)},
            depth=2,
        ),
    },
    LabeledPointsAnnotation: {
        **_LABELLED,
        "is_instance": _AS_IS,
        "labeled_points": _records(
            LabeledPoints, {"sensor_id": _AS_IS, "sensor_frame": _AS_IS, "point_ids": _AS_IS}, required=True
        ),
    },
    EventAnnotation: {
        **_LABELLED,
        "sensor_id": _AS_IS,
        "start": _Column("start_ns"),
        "duration": _Column("duration_ns"),
    },
    LinkAnnotation: {**_LABELLED, "sensor_id": _AS_IS, "from_id": _AS_IS, "to_id": _AS_IS, "is_bidirectional": _AS_IS},
    LocalizationAdjustment: {**_ANY, "poses": _POSES},
    CameraCalibration: {
        **_ANY,
        "sensor_id": _AS_IS,
        "poses": _POSES,
        "intrinsics": _Column(
            read=_read_intrinsics,
            write=lambda _, camera, extras: intrinsics_record(camera, extras),
            extras=extras_of_intrinsics,
        ),
        "time_offset": _Column("time_offset_ns"),
    },
    ObjectAnnotation: _LABELLED,
    GroupAnnotation: _LABELLED,
}
"""The fields of each type besides `type`, in the order in which they are written."""

_MODELS: Mapping[str, type] = {
    "cuboid": CuboidAnnotation, "box_2d": Box2DAnnotation, **dict.fromkeys(ShapeType, ShapeAnnotation),
    "points": PointsAnnotation, "event": EventAnnotation, "labeled_points": LabeledPointsAnnotation,
    "point_segmentation": LabeledPointsAnnotation, "localization_adjustment": LocalizationAdjustment,
    "camera_calibration": CameraCalibration, "object": ObjectAnnotation, "attributes": ObjectAnnotation,
    "link": LinkAnnotation, "group": GroupAnnotation,
}  # fmt: skip
"""The model of each type of the file; annotations of other types stay plain."""

_TYPED = frozenset({ShapeAnnotation, LabeledPointsAnnotation, ObjectAnnotation})
"""Models of several types, which hold theirs."""

_CUBOID_COLUMNS = 9


class _Path(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    timestamps: list[int]
    values: list[Any]


class _Attribute(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    name: str
    timestamps: list[int]
    values: list[Any]
    static: bool | None = None
    sensor_id: Identifier | None = None


class _Cuboid(msgspec.Struct, forbid_unknown_fields=True, gc=False):
    id: Identifier
    type: Literal["cuboid"]
    path: _Path
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: list[_Attribute] | None = None


_UNUSUAL = (msgspec.ValidationError, struct.error, TypeError, OverflowError)


def _cut_cuboid_paths(timestamps_ns: Int64Array, values: Float64Array, counts: Sequence[int]) -> list[CuboidPath]:
    """Cut the paths of many cuboids, of as many rows each, out of the arrays (N,) and (N, 9) of all of them."""
    # What holds for the whole holds for its parts: their constructors need not look at them again.
    set_times, set_values, set_extras = (CuboidPath.__dict__[name].__set__ for name in CuboidPath.__slots__)
    paths, stops = [], list(accumulate(counts))
    for start, stop in zip([0, *stops], stops, strict=False):
        path = object.__new__(CuboidPath)
        set_times(path, timestamps_ns[start:stop])
        set_values(path, values[start:stop])
        set_extras(path, NO_FIELDS)
        paths.append(path)
    return paths


def _read_usual_cuboids(annotations: list[Any], clock: FileClock) -> dict[int, CuboidAnnotation]:
    """Make the cuboids that have nothing unusual, many at once; by their number in the file's list."""
    found: dict[int, _Cuboid] = {}
    timestamps, rows, stated = list[bytes](), list[bytes](), list[bytes]()
    for index, annotation in enumerate(annotations):
        try:
            cuboid = msgspec.convert(annotation, _Cuboid)
            count, values = len(cuboid.path.timestamps), cuboid.path.values
            if len(values) != count or set(map(len, values)) != {_CUBOID_COLUMNS}:
                continue
            packed = _packer("q", count)(*cuboid.path.timestamps)
            packed_rows = _packer("d", count * _CUBOID_COLUMNS)(*chain.from_iterable(values))
            attributes = cuboid.attributes or ()
            stated_at = [_packer("q", len(one.timestamps))(*one.timestamps) for one in attributes]
        except _UNUSUAL:
            continue
        found[index] = cuboid
        timestamps.append(packed)
        rows.append(packed_rows)
        stated += stated_at
    try:
        times_ns, stated_ns = (
            read_only(clock.absolute_array(np.frombuffer(b"".join(packed), np.int64)))
            for packed in (timestamps, stated)
        )
    except TimeRangeError:
        return {}
    all_rows = np.frombuffer(b"".join(rows), np.float64).reshape(-1, _CUBOID_COLUMNS)
    paths = _cut_cuboid_paths(times_ns, all_rows, [len(cuboid.path.timestamps) for cuboid in found.values()])
    position, cuboids = 0, dict[int, CuboidAnnotation]()
    for (index, cuboid), path in zip(found.items(), paths, strict=True):
        made = []
        for one in cuboid.attributes or ():
            stop, listed = position + len(one.timestamps), one.values
            attribute = attribute_values(listed) if list in map(type, listed) else tuple(listed)
            made.append(AttributePath(one.name, attribute, stated_ns[position:stop], one.sensor_id, one.static))
            position = stop
        cuboids[index] = CuboidAnnotation(
            cuboid.id, path, cuboid.label, cuboid.stationary, cuboid.parent_id, tuple(made)
        )
    return cuboids


@lru_cache(maxsize=256)
def _packer(code: str, count: int) -> Callable[..., bytes]:
    return struct.Struct(f"{count}{code}").pack
