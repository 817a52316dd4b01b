"""The JSON of an OpenLABEL file: parts with their locations, keywords, and the fields that it has no keywords for."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType, NoneType
from typing import Any

import msgspec
import numpy as np

from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    ObjectAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
)

SCHEMA_VERSION = "1.0.0"

WORLD, EGO = "world", "ego"
"""Names of the coordinate systems that we write."""

OURS = "sceneloom"
"""Name of the member of metadata and of stream properties that holds what the format has no keywords for."""

INTERPOLATED, CONFIRMED = "interpolated", "confirmed"
"""Flags inside cuboids between key frames, and inside boxes that are projections of cuboids."""

UID = re.compile(r"-?[0-9]+|[0-9a-fA-F]{8}-(?:[0-9a-fA-F]{4}-){3}[0-9a-fA-F]{12}")
"""What the schema accepts as the key of an object, action, event, context, relation or tag."""

KEPT = ("metadata", "ontologies", "resources", "tags")
"""Members of the root that are kept as they are."""

DOCUMENT, RATE = "document", "rate_hz"
"""Entries of our metadata `openlabel`: the file as it was read, as text, if it states more than the scene, and the rate
that its frames without timestamps were read at."""

OF_OTHERS = "of_others"
"""Member of `OURS` in metadata: whether other members of the file are as others wrote them."""

KEPT_WHOLE = ("mat", "image", "binary", "mesh", "line_reference", "area_reference")
"""Types of data that are kept as they are, as attributes."""

ABSOLUTE, RELATIVE = "MODE_POLY2D_ABSOLUTE", "MODE_POLY2D_RELATIVE"

RBBOX = "rbbox"
"""Extra field of a path: the rotated boxes that its polygons were made of, rows x y w h angle."""

TYPE = "openlabel_type"
"""Extra field of an attribute: the type of its data, where the value does not show it."""

KIND = "openlabel"
"""Extra field of an annotation: what the file calls it and states about it besides."""

OURS_CAMERA = ("model", "width", "height", "fx", "fy", "cx", "cy")
FISHEYE = {"center_x": "cx", "center_y": "cy", "focal_length_x": "fx", "focal_length_y": "fy"}
"""Fields of a fisheye's intrinsics, and ours."""

LENS_COEFFICIENTS = (
    "lens_coeffs_1xN", "lens_coeffs_1x4", "lens_coeffs", "camera_model_coeffs_1xN", "camera_model_coeffs_1x4",
)  # fmt: skip
"""Names of a fisheye's coefficients: of VCD now and before, of the schema, and ours before."""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


PLAIN: Mapping[str, Callable[[Any], bool]] = MappingProxyType(
    {
        "text": lambda value: isinstance(value, str),
        "num": _is_number,
        "boolean": lambda value: isinstance(value, bool),
        "vec": lambda value: (
            isinstance(value, list | tuple) and all(isinstance(one, str) or _is_number(one) for one in value)
        ),
    }
)
"""Types of data that are read as a plain value, and whether they hold a value."""


def is_json(value: Any) -> bool:
    """Whether JSON holds a value exactly."""
    try:
        return bool(msgspec.json.decode(msgspec.json.encode(value)) == value)
    except (TypeError, ValueError, OverflowError, msgspec.MsgspecError, RecursionError):
        return False


@dataclass(frozen=True, slots=True)
class _Field:
    """How a field of a record is written and read; a missing value is written as null unless it is `omitted`."""

    types: tuple[type, ...]
    read: Callable[[Any], Any] = lambda value: value
    write: Callable[[Any], Any] = lambda value: value
    omitted: bool = True

    @property
    def or_null(self) -> "_Field":
        return replace(self, omitted=False)


_Fields = Mapping[str, _Field]
_ID, _FLAG, _WHOLE, _TEXT = _Field((str, int)), _Field((bool,)), _Field((int,)), _Field((str,))
_TIMES = _Field((list,), lambda values: np.array(values, np.int64).reshape(-1), np.ndarray.tolist)
_POINT_IDS = _Field((list,), lambda values: np.array(values, np.int64).astype(np.uint32), np.ndarray.tolist)
_EXTRAS = _Field((dict,), MappingProxyType, lambda value: dict(value) if len(value) and is_json(dict(value)) else None)


def _rows(width: int) -> _Field:
    """Rows of numbers; null stands for NaN."""
    return _Field(
        (list,),
        lambda rows: np.array(rows, np.float64).reshape(len(rows), -1) if rows else np.zeros((0, width)),
        np.ndarray.tolist,
        omitted=False,
    )


def _tuple_of(*types: type) -> _Field:
    def read(values: list[Any]) -> tuple[Any, ...]:
        if not all(isinstance(one, types) for one in values):
            raise TypeError(f"{values!r}")
        return tuple(tuple(one) if isinstance(one, list) else one for one in values)

    return _Field((list,), read, list, omitted=False)


def _list_of(read: Callable[[Any], Any], write: Callable[[Any], Any]) -> _Field:
    return _Field((list,), lambda values: tuple(map(read, values)), lambda records: [*map(write, records)] or None)


def _records(kind: type) -> _Field:
    return _list_of(lambda stated: _record(kind, stated), lambda one: own_fields(one))  # noqa: PLW0108 - defined below


_SEEN: _Fields = {"sensor_id": _ID, "timestamps_ns": _TIMES, "extras": _EXTRAS}
_CONFIRMED = _tuple_of(bool, NoneType)
_RECORDS: Mapping[type[Any], _Fields] = MappingProxyType({
    Activation: {**_SEEN, "durations_ns": _tuple_of(int, float), "cuboids": _rows(9)},
    Projection: {**_SEEN, "boxes": _rows(4), "confirmed": _CONFIRMED, "cuboids": _rows(9)},
    PointProjection: {**_SEEN, "points": _rows(2), "confirmed": _CONFIRMED, "positions": _rows(3)},
    PointPath: {"timestamps_ns": _TIMES, "values": _rows(3), "id": _ID.or_null, "extras": _EXTRAS},
    LabeledPoints: {"sensor_id": _ID, "point_ids": _POINT_IDS, "sensor_frame": _WHOLE, "extras": _EXTRAS},
    AttributePath: {"name": _TEXT, "values": _tuple_of(object), "timestamps_ns": _TIMES, "sensor_id": _ID,
        "static": _FLAG, "point_index": _WHOLE, "extras": _EXTRAS},
})  # fmt: skip
"""Records of annotations that are written in full."""

_CLASSES: Mapping[str, type[Any]] = MappingProxyType({
    "labeled_points": LabeledPointsAnnotation, "points": PointsAnnotation, "group": GroupAnnotation,
    "object": ObjectAnnotation,
})  # fmt: skip
"""Classes that the data of the format do not show."""

_COMMON: _Fields = {
    "id": _ID, "parent_id": _ID, "sensor_id": _ID, "stationary": _FLAG, "is_closed": _FLAG, "is_instance": _FLAG,
    "is_bidirectional": _FLAG, "start_ns": _WHOLE, "duration_ns": _Field((int, float, NoneType)), "from_id": _ID,
    "to_id": _ID,
}  # fmt: skip
_OF_CLASS: Mapping[type[Any], _Fields] = MappingProxyType(
    {
        CuboidAnnotation: {"activations": _records(Activation)},
        LabeledPointsAnnotation: {"type": _TEXT, "labeled_points": _records(LabeledPoints).or_null},
        PointsAnnotation: {
            "labels": _tuple_of(str),
            "paths": _records(PointPath).or_null,
            "projections": _list_of(_records(PointProjection).read, lambda row: [*map(own_fields, row)]),
        },
        ObjectAnnotation: {"type": _TEXT},
    }
)
"""Fields of annotations that the data of the format do not hold: of every class that has them, and of one only."""


def own_fields(annotation: Any) -> dict[str, Any]:
    """Write what the data of the format do not hold of an annotation; a record of it in full.

    Extra fields that JSON cannot hold are left out. Attributes, extra fields and projections of cuboids depend on what
    is written as data, and are left to the writer.
    """
    if type(annotation) in _RECORDS:
        return _written(annotation, _RECORDS[type(annotation)])
    fields = _written(annotation, _COMMON)
    if isinstance(annotation, EventAnnotation):
        fields["duration_ns"] = annotation.duration_ns
    if isinstance(annotation, ShapeAnnotation):
        fields["shape"] = annotation.type.value
    name = next((name for name, kind in _CLASSES.items() if type(annotation) is kind), None)
    if name is not None and getattr(annotation, "type", None) != "object":
        fields["class"] = name
        fields |= _written(annotation, _OF_CLASS.get(type(annotation), {}))
    elif isinstance(annotation, CuboidAnnotation):
        fields |= _written(annotation, _OF_CLASS[CuboidAnnotation])
    return fields


def _names(kind: type[Any]) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def _written(record: Any, table: _Fields) -> dict[str, Any]:
    found = {}
    for name, field in table.items():
        if name in _names(type(record)):
            value = getattr(record, name)
            value = None if value is None else field.write(value)
            if value is not None or not field.omitted:
                found[name] = value
    return found


def _read(stated: Mapping[str, Any], table: _Fields, known: tuple[str, ...]) -> dict[str, Any]:
    """The fields of a table that are stated; null counts as missing, where it is no value of the field."""
    values = {}
    for name in (name for name in table if name in stated and name in known):
        field, value = table[name], stated[name]
        if value is not None or NoneType in field.types:
            if not isinstance(value, field.types):
                raise TypeError(f"{name}: {value!r}")
            values[name] = field.read(value)
    return values


def _record(kind: type[Any], stated: Mapping[str, Any]) -> Any:
    return kind(**_read(stated, _RECORDS[kind], _names(kind)))


SeenBoxes = Mapping[int, tuple[tuple[float, ...], bool | None]]
"""Boxes `x y width height` [px], and whether a person confirmed them, by their times [ns]."""


def restored(annotation: Any, fields: Mapping[str, Any], boxes: Mapping[str, SeenBoxes]) -> Annotation:
    """The annotation as the data of the format state it, with the fields that we wrote of it.

    Args:
        boxes: in images, by the names of the data that are projections of it.
    """
    kind: Any = type(annotation)
    if kind is ObjectAnnotation:
        kind = _CLASSES.get(fields.get("class"), kind)  # type: ignore[arg-type]
    known = _names(kind)
    values = {name: getattr(annotation, name) for name in _names(type(annotation)) if name in known}
    values |= _read(fields, {**_COMMON, **_OF_CLASS.get(kind, {})}, known)
    if fields.get("unlabelled") is True and "label" in known:
        values["label"] = None
    if kind is CuboidAnnotation:
        values["projections"] = tuple(_projection(one, boxes) for one in fields.get("projections") or ())
    if "path_extras" in fields and "path" in known:
        extras = MappingProxyType({**annotation.path.extras, **fields["path_extras"]})
        values["path"] = replace(annotation.path, extras=extras)
    if "extras" in fields:
        values["extras"] = MappingProxyType(dict(fields["extras"]))
    if kind is ShapeAnnotation and "shape" in fields:
        values["type"] = ShapeType(fields["shape"])
    if "attributes" in fields and "attributes" in known:
        own = (_record(AttributePath, one) for one in fields["attributes"])
        values["attributes"] = (*annotation.attributes, *own)
    whole: Annotation = kind(**values)
    return whole


def _projection(stated: Mapping[str, Any], drawn: Mapping[str, SeenBoxes]) -> Projection:
    """A projection of a cuboid; what the data of its name state, boxes and flags, has precedence."""
    read: Projection = _record(Projection, stated)
    if stated.get("data") is None:
        return read
    found = drawn.get(stated["data"], {})
    rows = [found.get(time_ns, ((np.nan,) * 4, None)) for time_ns in read.timestamps_ns.tolist()]
    confirmed = read.confirmed
    if confirmed is not None:
        confirmed = tuple(old if new is None else new for old, (_, new) in zip(confirmed, rows, strict=True))
    return replace(read, boxes=np.array([box for box, _ in rows]).reshape(-1, 4), confirmed=confirmed)
