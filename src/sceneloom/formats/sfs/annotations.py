"""Annotations of a file, from records to the model: cuboids, keypoints, boxes, shapes, with attributes.

Activations and projections.
"""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from types import MappingProxyType
from typing import Any, Literal

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, CalibrationError
from sceneloom.formats.sfs.clock import FileClock, TimeRangeError
from sceneloom.formats.sfs.metadata import Source
from sceneloom.formats.sfs.records import Faults, FieldError, Location, repaired_path_of, rows_of, times_of
from sceneloom.formats.sfs.schema import ANNOTATION_RECORDS, annotation_record
from sceneloom.formats.sfs.sensors import further_of_intrinsics, read_camera_model
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
    cut_cuboid_paths,
)
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Identifier
from sceneloom.warnings import WarningKind

_Record = Mapping[str, Any]

_ATTRIBUTE = frozenset({"name", "sensor_id", "static", "point_index", "timestamps", "values"})


@contextmanager
def _noting(faults: Faults, location: Location) -> Iterator[None]:
    """Rotate what a part refuses into a fault at its location."""
    try:
        yield
    except FieldError as error:
        faults.add(location, str(error), code=error.code)
    except ArrayError as error:
        faults.add(location, str(error))


def _further(record: _Record, *taken: str) -> dict[str, Any]:
    """The fields of a record that are not taken."""
    return {name: value for name, value in record.items() if name not in taken}


def read_attributes(records: Any, faults: Faults) -> tuple[AttributePath, ...]:
    """Make the attributes of their records."""
    attributes = []
    for index, record in enumerate(records or ()):
        with _noting(faults, ("attributes", index)):
            attributes.append(_attribute(record))
    return tuple(attributes)


def _attribute(record: _Record) -> AttributePath:
    times, values = record.get("timestamps"), attribute_values(record.get("values"))
    return AttributePath(
        record["name"],
        values,
        timestamps_ns=None if times is None else read_only(times_of(times)),
        sensor_id=record.get("sensor_id"),
        static=record.get("static"),
        point_index=record.get("point_index"),
        extras=_further(record, *_ATTRIBUTE),
    )


def attribute_values(values: Any) -> tuple[Any, ...]:
    """Take the values of an attribute: lists of texts become tuples, all else stays what it is."""
    listed = values.tolist() if isinstance(values, np.ndarray) else values or ()
    return tuple(
        tuple(value) if isinstance(value, list) and all(isinstance(text, str) for text in value) else value
        for value in listed
    )


def _check_counts(times: Sized, values: Sized, *, name: str = "values") -> None:
    """Refuse a path with more or fewer values than timestamps.

    Raises:
        FieldError: there are.
    """
    if len(times) != len(values):
        raise FieldError(f"{len(times)} timestamps and {len(values)} {name}; expected as many of both")


def _row_path(
    record: _Record, columns: int, faults: Faults, location: Location
) -> tuple[Int64Array, Float64Array] | None:
    """Take the timestamps [ns] and rows of numbers of a path; None where it is at fault."""
    rows = _rows_at(record["values"], columns, faults, (*location, "values"))
    if rows is None:
        return None
    times = times_of(record["timestamps"])
    with _noting(faults, location):
        _check_counts(times, rows)
        return read_only(times), read_only(rows)
    return None


def _rows_at(values: Any, columns: int, faults: Faults, location: Location) -> Float64Array | None:
    """Take rows of numbers, (N, columns) float64; each row that is none becomes a fault with its number."""
    try:
        return rows_of(values, columns)
    except FieldError as error:
        before = len(faults)
        for index, row in enumerate(values if isinstance(values, list) else ()):
            _note_bad_row(row, columns, faults, (*location, index))
        if len(faults) == before:
            faults.add(location, str(error))
    return None


def _note_bad_row(row: Any, columns: int, faults: Faults, location: Location) -> bool:
    """Note a row that is not that many numbers; report whether it is sound."""
    numbers = isinstance(row, list | np.ndarray) and all(
        isinstance(value, int | float | np.number) and not isinstance(value, bool) for value in row
    )
    if numbers and len(row) == columns:
        return True
    found = f"{len(row)} numbers" if numbers else _described(row)
    faults.add(location, f"{found}; expected {columns} numbers")
    return False


def _described(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _nullable_rows(
    record: _Record, name: str, columns: int, faults: Faults, location: Location
) -> Float64Array | None:
    """Take the rows of a field in which null stands for none, (N, columns) float64 with rows of NaN for null.

    None where there is no such field, or it is at fault.
    """
    values = record.get(name)
    if values is None:
        return None
    listed: Sequence[Any] = values.tolist() if isinstance(values, np.ndarray) else values
    kept = [index for index, row in enumerate(listed) if row is not None]
    before = len(faults)
    with _noting(faults, (*location, name)):
        _check_counts(record["timestamps"], listed, name=name)
    try:
        rows = rows_of([listed[index] for index in kept], columns)
    except FieldError as error:
        for index in kept:
            _note_bad_row(listed[index], columns, faults, (*location, name, index))
        if len(faults) == before:
            faults.add((*location, name), str(error))
    if len(faults) > before:
        return None
    array = np.full((len(listed), columns), np.nan)
    array[kept] = rows
    return read_only(array)


def _confirmations(record: _Record, faults: Faults, location: Location) -> tuple[bool | None, ...] | None:
    """Take `confirmed`: true, false or null for each timestamp."""
    values = record.get("confirmed")
    if values is None:
        return None
    listed = values.tolist() if isinstance(values, np.ndarray) else values
    for index, value in enumerate(listed):
        if value is not None and not isinstance(value, bool):
            faults.add((*location, "confirmed", index), f"{_described(value)}; expected true, false or null")
    with _noting(faults, (*location, "confirmed")):
        _check_counts(record["timestamps"], listed, name="values")
    return tuple(listed)


def _read_poses(values: _Record, faults: Faults) -> Poses | None:
    """Make the poses of a correction."""
    record = values.get("poses")
    if record is None:
        return None
    before = len(faults)
    path = repaired_path_of(record, faults)
    if path is None and len(faults) == before:
        faults.add(("poses",), "empty; expected at least one pose")
    return path


def _vertices_of(
    rows: Any, dimensions: int, faults: Faults, location: Location, *, are_pairs: bool | None = None
) -> tuple[tuple[Float64Array, ...], bool]:
    """Cut rows of numbers into vertices, (V, D) float64 each.

    Args:
        rows: the numbers of each keyframe.
        dimensions: 2 or 3.
        faults: takes what is wrong.
        location: where the rows are.
        are_pairs: whether rows that should hold triples hold pairs; None: where they fit pairs only.

    Returns:
        vertices: one array per row; nothing where one is at fault.
        flat: whether rows that should hold triples fit pairs only; their z is 0.
    """
    listed: Sequence[Any] = list(rows)
    arrays = [_numbers(row, faults, (*location, index)) for index, row in enumerate(listed)]
    found = [array for array in arrays if array is not None]
    if len(found) != len(listed):
        return (), False
    fits = _fits_pairs_only([array.size for array in found])
    flat = dimensions == 3 and (fits if are_pairs is None else are_pairs)
    size = 2 if flat else dimensions
    for index, array in enumerate(found):
        if array.size % size:
            faults.add(
                (*location, index), f"{array.size} numbers; expected a multiple of {size}, {size} per vertex"
            )
    if faults.unmended:
        return (), False
    cut = [array.reshape(-1, size) for array in found]
    return tuple(read_only(_with_height(array) if flat else array) for array in cut), flat


def _fits_pairs_only(sizes: Sequence[int]) -> bool:
    """Whether rows are pairs and cannot be triples: all of even length, one of them no multiple of three."""
    return all(size % 2 == 0 for size in sizes) and any(size % 3 for size in sizes)


def _with_height(pairs: Float64Array) -> Float64Array:
    """Add z = 0 to (V, 2) locations."""
    return np.column_stack([pairs, np.zeros(len(pairs))])


def _numbers(row: Any, faults: Faults, location: Location) -> Float64Array | None:
    array: AnyArray | None = None
    if isinstance(row, list | np.ndarray):
        with _noting(faults, location):
            array = _flat_array(row)
    if array is None or array.ndim != 1 or (array.size and array.dtype.kind not in "iuf"):
        faults.add(location, f"{_described(row)}; expected a list of numbers")
        return None
    return array.astype(np.float64)


def _flat_array(row: Any) -> AnyArray:
    try:
        return np.asarray(row)
    except (ValueError, OverflowError):
        raise FieldError(f"{_described(row)}; expected a list of numbers") from None


@dataclass(frozen=True, slots=True)
class _AnnotationRecord:
    """One annotation of the file.

    Attributes:
        source: the file.
        values: its fields, checked by the table of fields, times in nanoseconds.
        location: where it stands.
        faults: takes what is wrong, with locations below it.
    """

    source: Source
    values: _Record
    location: Location
    faults: Faults

    @property
    def id(self) -> Identifier:
        """Its id."""
        identifier: Identifier = self.values["id"]
        return identifier

    def fields(self, *names: str, taken: tuple[str, ...] = ()) -> dict[str, Any]:
        """Give fields that pass as they are, `attributes`, and all others but those taken as `extras`."""
        fields = {name: self.values.get(name) for name in names}
        fields["extras"] = _further(self.values, "id", "type", *names, *taken)
        if "attributes" in fields:
            fields["attributes"] = read_attributes(fields["attributes"], self.faults)
        return fields

    def note_flat(self, *below: str | int) -> None:
        """Report that a path in space has pairs for locations."""
        message = "pairs where locations in the world were expected; their z is taken as 0"
        self.source.warning(WarningKind.ASSUMED, "no-height", (*self.location, *below), message)


def _read_cuboid(found: _AnnotationRecord) -> CuboidAnnotation | None:
    """Make a cuboid."""
    record, faults = found.values["path"], found.faults
    fields = found.fields(
        "label", "stationary", "parent_id", "attributes", taken=("path", "activations", "projections")
    )
    activations = _parts(found, "activations", _activation)
    projections = _parts(found, "projections", _projection)
    path = _row_path(record, 9, faults, ("path",))
    if path is None or faults.unmended:
        return None
    return CuboidAnnotation(
        found.id,
        CuboidPath(*path, extras=_further(record, "timestamps", "values")),
        activations=activations,
        projections=projections,
        **fields,
    )


def _parts(
    found: _AnnotationRecord, name: str, read: Callable[[_Record, Faults, Location], Any]
) -> tuple[Any, ...]:
    records = found.values.get(name) or ()
    return tuple(read(record, found.faults, (name, index)) for index, record in enumerate(records))


def _activation(record: _Record, faults: Faults, location: Location) -> Activation | None:
    before = len(faults)
    cuboids = _nullable_rows(record, "cuboids", 9, faults, location)
    durations = record.get("durations")
    if durations is not None:
        with _noting(faults, (*location, "durations")):
            _check_counts(record["timestamps"], durations, name="durations")
    if len(faults) > before:
        return None
    return Activation(
        record["sensor_id"],
        read_only(times_of(record["timestamps"])),
        durations_ns=None if durations is None else tuple(durations),
        cuboids=cuboids,
        extras=_further(record, "sensor_id", "timestamps", "durations", "cuboids"),
    )


def _projection(record: _Record, faults: Faults, location: Location) -> Projection | None:
    before = len(faults)
    boxes = _nullable_rows(record, "boxes", 4, faults, location)
    cuboids = _nullable_rows(record, "cuboids", 9, faults, location)
    confirmed = _confirmations(record, faults, location)
    if len(faults) > before:
        return None
    return Projection(
        record["sensor_id"],
        read_only(times_of(record["timestamps"])),
        boxes=boxes,
        confirmed=confirmed,
        cuboids=cuboids,
        extras=_further(record, "sensor_id", "timestamps", "boxes", "confirmed", "cuboids"),
    )


def _read_keypoints(found: _AnnotationRecord) -> PointsAnnotation | None:
    """Make a points annotation; one path instead of a list of them is taken, too."""
    values, faults = found.values, found.faults
    raw = values["paths"]
    single = isinstance(raw, dict)
    paths = [
        _path(found, record, ("paths",) if single else ("paths", index))
        for index, record in enumerate([raw] if single else raw)
    ]
    projections = [
        _projections(of_point, faults, ("projections", index))
        for index, of_point in enumerate(values.get("projections") or ())
    ]
    fields = found.fields(
        "sensor_id", "stationary", "parent_id", "attributes", taken=("paths", "labels", "projections")
    )
    with _noting(faults, ("labels",)):
        labels = _labels(values.get("labels"), [path for path in paths if path is not None], faults)
    if faults.unmended:
        return None
    return PointsAnnotation(
        found.id,
        tuple(path for path in paths if path is not None),
        labels=labels,
        projections=tuple(projections),
        **fields,
    )


def _path(found: _AnnotationRecord, record: _Record, location: Location) -> PointPath | None:
    times = times_of(record["timestamps"])
    values = _values(found, record["values"], (*location, "values"))
    if values is None:
        return None
    with _noting(found.faults, location):
        _check_counts(times, values)
        return PointPath(
            read_only(times),
            read_only(values),
            id=record.get("id"),
            extras=_further(record, "id", "timestamps", "values"),
        )
    return None


def _values(found: _AnnotationRecord, raw: Any, location: Location) -> Float64Array | None:
    """Take rows of x, y, z, or of several such triples; of pairs, z is 0."""
    columns = len(raw[0]) if len(raw) and isinstance(raw[0], list | np.ndarray) else 3
    rows = _rows_at(raw, columns, found.faults, location)
    if rows is None:
        return None
    if _fits_pairs_only([columns]):
        found.note_flat(*location)
        return _with_height(rows.reshape(-1, 2)).reshape(len(rows), -1)
    if columns % 3 or columns == 0:
        found.faults.add(location, f"rows of {columns} numbers; expected x, y, z")
        return None
    return rows


def _labels(raw: Any, paths: list[PointPath], faults: Faults) -> tuple[str, ...] | None:
    if raw is None:
        return None
    for index, label in enumerate(raw):
        if not isinstance(label, str):
            faults.add(("labels", index), f"{label!r}; expected text")
    points = sum(path.values.shape[1] // 3 for path in paths)
    if not faults.unmended and len(raw) not in {len(paths), points}:
        raise FieldError(f"{len(raw)} labels for {points} points; expected as many of both")
    return tuple(raw)


def _projections(raw: Any, faults: Faults, location: Location) -> tuple[PointProjection, ...]:
    """Take the projections of one point; one instead of a list of them is taken, too."""
    if isinstance(raw, dict):
        return _listed(_read_keypoints_projection(raw, faults, location))
    return tuple(
        projection
        for index, record in enumerate(raw)
        for projection in _listed(_read_keypoints_projection(record, faults, (*location, index)))
    )


def _listed(projection: PointProjection | None) -> tuple[PointProjection, ...]:
    return () if projection is None else (projection,)


def _read_keypoints_projection(record: _Record, faults: Faults, location: Location) -> PointProjection | None:
    before = len(faults)
    points = _nullable_rows(record, "points", 2, faults, location)
    positions = _nullable_rows(record, "positions", 3, faults, location)
    confirmed = _confirmations(record, faults, location)
    if len(faults) > before:
        return None
    return PointProjection(
        record["sensor_id"],
        read_only(times_of(record["timestamps"])),
        points=points,
        confirmed=confirmed,
        positions=positions,
        extras=_further(record, "sensor_id", "timestamps", "points", "confirmed", "positions"),
    )


_COLUMNS = 9


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


class _UnusualError(ValueError):
    """Something is not as usual."""


_UNUSUAL = (_UnusualError, msgspec.ValidationError, struct.error, TypeError, OverflowError)


def _read_usual_cuboids(annotations: list[Any], clock: FileClock) -> dict[int, CuboidAnnotation]:
    """Make the cuboids that have nothing unusual.

    Args:
        annotations: the file's list of annotations.
        clock: rotates timestamps into nanoseconds.

    Returns:
        The cuboids by their number in the list.
    """
    found: dict[int, _Cuboid] = {}
    timestamps: list[bytes] = []
    rows: list[bytes] = []
    stated: list[bytes] = []
    for index, annotation in enumerate(annotations):
        try:
            cuboid = msgspec.convert(annotation, _Cuboid)
            packed = _packed_timestamps(cuboid.path.timestamps), _packed_rows(cuboid.path)
            stated_at = [_packed_timestamps(attribute.timestamps) for attribute in cuboid.attributes or ()]
        except _UNUSUAL:
            continue
        found[index] = cuboid
        timestamps.append(packed[0])
        rows.append(packed[1])
        stated += stated_at
    try:
        times_ns, stated_ns = _times(timestamps, clock), _times(stated, clock)
    except TimeRangeError:
        return {}
    values = np.frombuffer(b"".join(rows), np.float64).reshape(-1, _COLUMNS)
    counts = [len(cuboid.path.timestamps) for cuboid in found.values()]
    paths = cut_cuboid_paths(times_ns, values, counts)
    saying = _Saying(stated_ns)
    return {
        index: _cuboid(cuboid, path, saying)
        for (index, cuboid), path in zip(found.items(), paths, strict=True)
    }


def _packed_timestamps(timestamps: list[int]) -> bytes:
    return _packer("q", len(timestamps))(*timestamps)


def _packed_rows(path: _Path) -> bytes:
    count = len(path.timestamps)
    if len(path.values) != count or set(map(len, path.values)) != {_COLUMNS}:
        raise _UnusualError
    return _packer("d", count * _COLUMNS)(*chain.from_iterable(path.values))


@lru_cache(maxsize=256)
def _packer(code: str, count: int) -> Callable[..., bytes]:
    return struct.Struct(f"{count}{code}").pack


def _times(packed: list[bytes], clock: FileClock) -> Int64Array:
    times_ns = clock.absolute_array(np.frombuffer(b"".join(packed), np.int64))
    times_ns.flags.writeable = False
    return times_ns


def _cuboid(cuboid: _Cuboid, path: CuboidPath, saying: "_Saying") -> CuboidAnnotation:
    return CuboidAnnotation(
        cuboid.id,
        path,
        cuboid.label,
        cuboid.stationary,
        cuboid.parent_id,
        tuple(map(saying.attribute, cuboid.attributes)) if cuboid.attributes else (),
    )


class _Saying:
    """Deals the times of all attributes out to them, in order."""

    def __init__(self, times_ns: Int64Array) -> None:
        self._times_ns = times_ns
        self._next = 0

    def attribute(self, attribute: _Attribute) -> AttributePath:
        """Make the next one."""
        values, first = attribute.values, self._next
        self._next += len(attribute.timestamps)
        return AttributePath(
            attribute.name,
            attribute_values(values) if list in map(type, values) else tuple(values),
            self._times_ns[first : self._next],
            attribute.sensor_id,
            attribute.static,
        )


def read_annotations(source: Source, raw: Any, location: Location) -> tuple[Annotation, ...]:
    """Read a list of annotations; those at fault are left out where the caller is lenient.

    Raises:
        DataError: one is at fault.
    """
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
        source.warning(
            WarningKind.ASSUMED, "event-is-object", location, "an event without a start; read as an object"
        )
        type_name = "object"
    known = type_name in ANNOTATION_RECORDS
    values = source.reader(forgiving=not known).read(raw, annotation_record(type_name), faults)
    if not known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults.unmended:
        return None
    build = _BUILDERS.get(type_name, _plain)
    return build(_AnnotationRecord(source, {**values, "type": type_name}, location, faults))


def _plain(found: _AnnotationRecord) -> PlainAnnotation:
    return PlainAnnotation(found.id, found.values["type"], _further(found.values, "id", "type"))


def _box_2d(found: _AnnotationRecord) -> Box2DAnnotation | None:
    record = found.values["path"]
    fields = found.fields("label", "stationary", "parent_id", "attributes", taken=("sensor_id", "path"))
    path = _row_path(record, 4, found.faults, ("path",))
    if path is None:
        return None
    box = BoxPath(*path, extras=_further(record, "timestamps", "values"))
    return Box2DAnnotation(found.id, found.values["sensor_id"], box, **fields)


_OUTLINES = frozenset({ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYLINE})


def _shape(found: _AnnotationRecord) -> ShapeAnnotation | None:
    kind, record, faults = ShapeType(found.values["type"]), found.values["path"], found.faults
    closing = ("is_closed",) if kind is ShapeType.POLYLINE else ()
    names = ("sensor_id", *closing, "label", "stationary", "parent_id", "attributes")
    fields = found.fields(*names, taken=("path",))
    asked = found.source.options.vertices
    vertices, flat = _vertices_of(
        record["values"],
        DIMENSIONS[kind],
        faults,
        ("path", "values"),
        are_pairs=None if asked is None or kind not in _OUTLINES else asked == PAIRS,
    )
    if not faults.unmended:
        if flat:
            found.note_flat("path", "values")
        with _noting(faults, ("path",)):
            path = _vertex_path(record, vertices)
            return ShapeAnnotation(found.id, kind, path, **fields)
    return None


def _vertex_path(record: Mapping[str, Any], vertices: tuple[Any, ...]) -> VertexPath:
    times = times_of(record["timestamps"])
    _check_counts(times, vertices)
    return VertexPath(read_only(times), vertices, extras=_further(record, "timestamps", "values"))


def _event(found: _AnnotationRecord) -> EventAnnotation:
    fields = found.fields("label", "sensor_id", "parent_id", "attributes", taken=("start", "duration"))
    return EventAnnotation(
        found.id, found.values["start"], duration_ns=found.values.get("duration"), **fields
    )


def _labeled_points(found: _AnnotationRecord) -> LabeledPointsAnnotation:
    names = ("label", "is_instance", "parent_id", "attributes")
    parts = [
        LabeledPoints(
            record["sensor_id"],
            record["point_ids"],
            sensor_frame=record.get("sensor_frame"),
            extras=_further(record, "sensor_id", "point_ids", "sensor_frame"),
        )
        for record in found.values["labeled_points"]
    ]
    fields = found.fields(*names, taken=("labeled_points",))
    return LabeledPointsAnnotation(found.id, tuple(parts), type=found.values["type"], **fields)


def _object(found: _AnnotationRecord) -> ObjectAnnotation:
    return ObjectAnnotation(
        found.id, type=found.values["type"], **found.fields("label", "parent_id", "attributes")
    )


def _group(found: _AnnotationRecord) -> GroupAnnotation:
    return GroupAnnotation(found.id, **found.fields("label", "parent_id", "attributes"))


def _link(found: _AnnotationRecord) -> LinkAnnotation:
    names = ("from_id", "to_id", "label", "is_bidirectional", "sensor_id", "parent_id", "attributes")
    return LinkAnnotation(found.id, **found.fields(*names))


def _adjustment(found: _AnnotationRecord) -> LocalizationAdjustment | None:
    poses = _read_poses(found.values, found.faults)
    if poses is None:
        return None
    fields = found.fields("parent_id", taken=("poses",))
    fields["extras"] |= _further_of_poses(found)
    return LocalizationAdjustment(found.id, poses, **fields)


def _calibration(found: _AnnotationRecord) -> CameraCalibration | None:
    poses, camera_model = _read_poses(found.values, found.faults), _camera_model(found)
    if found.faults.unmended:
        return None
    fields = found.fields("sensor_id", "parent_id", taken=("poses", "intrinsics", "time_offset"))
    fields["extras"] |= _further_of_poses(found)
    if camera_model is not None:
        fields["extras"] |= further_of_intrinsics(found.values["intrinsics"])
    time_offset_ns = found.values.get("time_offset")
    return CameraCalibration(
        found.id, poses=poses, intrinsics=camera_model, time_offset_ns=time_offset_ns, **fields
    )


def _further_of_poses(found: _AnnotationRecord) -> dict[str, Any]:
    unknown = _further(found.values.get("poses") or {}, "timestamps", "values")
    return {"poses": unknown} if unknown else {}


def _camera_model(found: _AnnotationRecord) -> Camera | None:
    intrinsics = found.values.get("intrinsics")
    if intrinsics is None:
        return None
    try:
        return read_camera_model(found.source, intrinsics, {}, (*found.location, "intrinsics"))
    except (FieldError, CalibrationError) as error:
        found.faults.add(("intrinsics",), str(error))
        return None


_BUILDERS: Mapping[str, Callable[[_AnnotationRecord], Annotation | None]] = MappingProxyType(
    {
        "cuboid": _read_cuboid,
        "box_2d": _box_2d,
        **dict.fromkeys(ShapeType, _shape),
        "points": _read_keypoints,
        "event": _event,
        "labeled_points": _labeled_points,
        "point_segmentation": _labeled_points,
        "localization_adjustment": _adjustment,
        "camera_calibration": _calibration,
        "object": _object,
        "attributes": _object,
        "link": _link,
        "group": _group,
    }
)
"""What makes each type of annotation; other types stay plain."""
