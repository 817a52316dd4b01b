"""The JSON of an OpenLABEL file: parts with their paths, keywords, and our fields that it has no keywords for."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError, SceneloomError
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
)
from sceneloom.scene.types import NO_FIELDS

SCHEMA_VERSION = "1.0.0"

WORLD, EGO = "world", "ego"
"""Names of the coordinate systems that we write."""

OURS = "sceneloom"
"""Name of what only we understand: a member of metadata and stream properties, and a text of objects."""

INTERPOLATED, CONFIRMED = "interpolated", "confirmed"
"""Flags inside of cuboids between key frames, and of boxes that are projections of cuboids."""

UID = re.compile(r"-?[0-9]+|[0-9a-fA-F]{8}-(?:[0-9a-fA-F]{4}-){3}[0-9a-fA-F]{12}")
"""What the schema takes as the key of an object, action, event, context, relation or tag."""

GEOMETRY = ("cuboid", "bbox", "rbbox", "poly2d", "poly3d", "point2d", "point3d")
"""Types of object data that have a location."""

PLAIN = ("text", "num", "boolean", "vec")
"""Types of data that are read as a plain value."""

KEPT_WHOLE = ("mat", "image", "binary", "mesh", "line_reference", "area_reference")
"""Types of data that are kept as they are."""

ELEMENTS: Mapping[str, str] = MappingProxyType(
    {"objects": "object", "actions": "action", "events": "event", "contexts": "context"}
)
"""What a file has lists of, and what one of each is called."""

ABSOLUTE, RELATIVE = "MODE_POLY2D_ABSOLUTE", "MODE_POLY2D_RELATIVE"
SENSOR_TYPES = ("camera", "lidar", "radar", "gps_imu", "other")
_SHOWN = 60
_LARGEST = 1e150


@dataclass(frozen=True, slots=True)
class Part:
    """A part of a document.

    Attributes:
        file: the document's.
        location: where the part stands in it ("openlabel.frames.3").
        value: as in the file.
    """

    file: Path
    location: str
    value: Any

    def fault(self, expected: str) -> DataError:
        """What is wrong with the part."""
        text = repr(self.value)
        shown = text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
        return DataError(self.file, self.location, f"{shown}; expected {expected}")

    def members(self) -> dict[str, Any]:
        """The members of an object of JSON.

        Raises:
            DataError: it is none.
        """
        if not isinstance(self.value, dict):
            raise self.fault("an object of JSON")
        return self.value

    def get(self, name: str) -> "Part | None":
        """A member that need not be there; null counts as not there."""
        value = self.members().get(name)
        return None if value is None else Part(self.file, f"{self.location}.{name}", value)

    def need(self, name: str) -> "Part":
        """A member.

        Raises:
            DataError: it is missing.
        """
        found = self.get(name)
        if found is None:
            raise DataError(self.file, f"{self.location}.{name}", "missing")
        return found

    def each(self, name: str) -> Iterator[tuple[str, "Part"]]:
        """The members of a member, by name; none where it is not there."""
        found = self.get(name)
        if found is not None:
            for key, value in found.members().items():
                yield key, Part(self.file, f"{found.location}.{key}", value)

    def items(self, name: str) -> Iterator["Part"]:
        """The elements of a list that is a member; none where it is not there."""
        found = self.get(name)
        if found is not None:
            if not isinstance(found.value, list):
                raise found.fault("a list")
            for k, value in enumerate(found.value):
                yield Part(self.file, f"{found.location}[{k}]", value)

    def text(self) -> str:
        """A text.

        Raises:
            DataError: it is none.
        """
        if not isinstance(self.value, str):
            raise self.fault("a text")
        return self.value

    def numbers(self, counts: Sequence[int] | None = None) -> list[float]:
        """A list of finite numbers.

        Args:
            counts: how many there may be; None: any number.

        Raises:
            DataError: it is none, or of another length.
        """
        values = self.value
        sound = (
            isinstance(values, list)
            and {*map(type, values)} <= {int, float}
            and all(-_LARGEST < end < _LARGEST for end in (min(values, default=0), max(values, default=0)))
        )
        if not sound or (counts is not None and len(values) not in counts):
            listed = " or ".join(map(str, counts or ()))
            raise self.fault(f"a list of {listed + ' ' if listed else ''}numbers")
        return [*map(float, values)]


_ID, _NUMBER = (str, int), (int, float)

_REPLACED: Mapping[str, tuple[type, ...]] = MappingProxyType(
    {
        "id": _ID,
        "parent_id": _ID,
        "sensor_id": _ID,
        "stationary": (bool,),
        "is_closed": (bool,),
        "is_instance": (bool,),
        "is_bidirectional": (bool,),
        "start_ns": (int,),
        "duration_ns": (*_NUMBER, type(None)),
    }
)
"""Fields that are put back as they were, and the types that they have."""

SeenBoxes = Mapping[int, tuple[tuple[float, ...], bool | None]]
"""Boxes `x y width height` [px], and whether a person confirmed them, by their times [ns]."""

_FAULTS = (SceneloomError, TypeError, ValueError, KeyError, OverflowError, AttributeError)


@dataclass(frozen=True, slots=True)
class Ours:
    """What we wrote besides, if it was us.

    Attributes:
        part: the member of the metadata that holds it, or None.
    """

    part: Part | None = None

    @classmethod
    def of(cls, document: Part) -> "Ours":
        """Find it in a file."""
        metadata = document.get("metadata")
        part = None if metadata is None else metadata.get(OURS)
        return cls(part if part is not None and isinstance(part.value, dict) else None)

    def class_of(self, kind: str, uid: str) -> str | None:
        """The class of an annotation that the data do not report, in our words."""
        by_uid = None if self.part is None else self.part.value.get(kind)
        fields = by_uid.get(uid) if isinstance(by_uid, dict) else None
        return fields.get("class") if isinstance(fields, dict) else None

    def restored(self, annotation: Annotation, kind: str, uid: str) -> Annotation:
        """The annotation with the fields put back that we wrote of it.

        Raises:
            DataError: they do not fit.
        """
        part = self.fields_of(kind, uid)
        if part is None:
            return annotation
        return restored_from(part, annotation)

    def fields_of(self, kind: str, uid: str) -> Part | None:
        """What we wrote of an element besides, or None."""
        by_uid = None if self.part is None else self.part.get(kind)
        part = by_uid.get(uid) if by_uid is not None and isinstance(by_uid.value, dict) else None
        return part if part is not None and isinstance(part.value, dict) else None


def restored_from(part: Part, annotation: Annotation, boxes: Mapping[str, SeenBoxes] = NO_FIELDS) -> Annotation:
    """The annotation with the fields put back that a part of our own says.

    Args:
        part: the fields.
        annotation: as the data report it.
        boxes: in images, by the names of the data that are projections of it.

    Raises:
        DataError: they do not fit.
    """
    try:
        return _restored(annotation, part.members(), boxes)
    except _FAULTS as error:
        raise part.fault(f"the fields of an annotation: {error}") from error


def _restored(annotation: Annotation, fields: Mapping[str, Any], boxes: Mapping[str, SeenBoxes]) -> Annotation:
    made = _made(annotation, fields)
    known = type(made).__dataclass_fields__
    values = {name: fields[name] for name in _REPLACED if name in fields and name in known}
    for name, value in values.items():
        if not isinstance(value, _REPLACED[name]):
            raise TypeError(f"{name}: {value!r}")
    for name in ("from_id", "to_id"):
        if name in fields and name in known and isinstance(fields[name], _ID):
            values[name] = fields[name]
    if fields.get("unlabelled") is True and "label" in known:
        values["label"] = None
    if isinstance(made, CuboidAnnotation):
        values["activations"] = tuple(_activation(one) for one in fields.get("activations") or ())
        values["projections"] = tuple(_projection(one, boxes) for one in fields.get("projections") or ())
    if "path_extras" in fields and isinstance(made, CuboidAnnotation | Box2DAnnotation | ShapeAnnotation):
        further = MappingProxyType({**made.path.extras, **fields["path_extras"]})
        values["path"] = replace(made.path, extras=further)
    if "extras" in fields:
        values["extras"] = MappingProxyType(dict(fields["extras"]))
    if isinstance(made, ShapeAnnotation) and "shape" in fields:
        values["type"] = ShapeType(fields["shape"])
    if "attributes" in fields and "attributes" in known:
        own = tuple(_attribute_of(one) for one in fields["attributes"])
        values["attributes"] = (*getattr(made, "attributes", ()), *own)
    whole: Annotation = replace(made, **values)
    return whole


def _made(annotation: Annotation, fields: Mapping[str, Any]) -> Any:
    """An annotation of the class that the fields name, where the data do not report it."""
    kind = fields.get("class")
    if not isinstance(annotation, ObjectAnnotation) or kind is None:
        return annotation
    common: dict[str, Any] = {
        "id": annotation.id,
        "attributes": annotation.attributes,
        "extras": annotation.extras,
    }
    if kind == "points":
        paths = tuple(_path(one) for one in fields["paths"])
        labels = None if fields.get("labels") is None else tuple(fields["labels"])
        seen = tuple(tuple(_point_projection(one) for one in point) for point in fields.get("projections") or ())
        return PointsAnnotation(paths=paths, labels=labels, projections=seen, **common)
    common["label"] = annotation.label
    if kind == "group":
        return GroupAnnotation(**common)
    if kind == "labeled_points":
        points = tuple(_labeled(one) for one in fields["labeled_points"])
        return LabeledPointsAnnotation(labeled_points=points, type=fields["type"], **common)
    return ObjectAnnotation(type=fields["type"], **common)


def _labeled(stated: Mapping[str, Any]) -> LabeledPoints:
    ids = np.array(stated["point_ids"], np.int64).astype(np.uint32)
    return LabeledPoints(
        stated["sensor_id"],
        ids,
        stated.get("sensor_frame"),
        MappingProxyType(dict(stated.get("extras") or {})),
    )


def _path(stated: Mapping[str, Any]) -> PointPath:
    times, values = np.array(stated["timestamps_ns"], np.int64), np.array(stated["values"], np.float64)
    further = MappingProxyType(dict(stated.get("extras") or {}))
    return PointPath(times, values.reshape(len(times), -1), stated.get("id"), further)


def _seen(stated: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that all have that report when a sensor sees something."""
    if not isinstance(stated["sensor_id"], _ID):
        raise TypeError(f"sensor_id: {stated['sensor_id']!r}")
    return {
        "sensor_id": stated["sensor_id"],
        "timestamps_ns": np.array(stated["timestamps_ns"], np.int64).reshape(-1),
        "extras": MappingProxyType(dict(stated.get("extras") or {})),
    }


def _table(rows: Any, width: int) -> Float64Array | None:
    """Rows of numbers, null for NaN, as JSON says them."""
    return None if rows is None else np.array(rows, np.float64).reshape(-1, width)


def _flags(stated: Any) -> tuple[bool | None, ...] | None:
    if stated is None:
        return None
    if not all(one is None or isinstance(one, bool) for one in stated):
        raise TypeError(f"confirmed: {stated!r}")
    return tuple(stated)


def _activation(stated: Mapping[str, Any]) -> Activation:
    durations = stated.get("durations_ns")
    if durations is not None and not all(type(one) in _NUMBER for one in durations):
        raise TypeError(f"durations_ns: {durations!r}")
    held = None if durations is None else tuple(durations)
    return Activation(**_seen(stated), durations_ns=held, cuboids=_table(stated.get("cuboids"), 9))


def _projection(stated: Mapping[str, Any], drawn: Mapping[str, SeenBoxes]) -> Projection:
    fields, boxes, confirmed = _seen(stated), _table(stated.get("boxes"), 4), _flags(stated.get("confirmed"))
    if stated.get("data") is not None:
        found = drawn.get(stated["data"], {})
        times = fields["timestamps_ns"].tolist()
        nothing = ((np.nan,) * 4, None)
        boxes = np.array([found.get(time_ns, nothing)[0] for time_ns in times], np.float64).reshape(-1, 4)
        if confirmed is not None:
            reported = [found.get(time_ns, nothing)[1] for time_ns in times]
            confirmed = tuple(old if new is None else new for old, new in zip(confirmed, reported, strict=True))
    return Projection(**fields, boxes=boxes, confirmed=confirmed, cuboids=_table(stated.get("cuboids"), 9))


def _point_projection(stated: Mapping[str, Any]) -> PointProjection:
    confirmed = _flags(stated.get("confirmed"))
    points, positions = _table(stated.get("points"), 2), _table(stated.get("positions"), 3)
    return PointProjection(**_seen(stated), points=points, confirmed=confirmed, positions=positions)


def _attribute_of(stated: Mapping[str, Any]) -> AttributePath:
    """Read an attribute that the data of the format do not hold."""
    times = stated.get("timestamps_ns")
    return AttributePath(
        stated["name"],
        tuple(tuple(value) if isinstance(value, list) else value for value in stated["values"]),
        None if times is None else np.array(times, np.int64),
        stated.get("sensor_id"),
        stated.get("static"),
        stated.get("point_index"),
        stated.get("extras") or NO_FIELDS,
    )


def attribute_fields(attribute: AttributePath) -> dict[str, Any]:
    """Report an attribute in full."""
    times = attribute.timestamps_ns
    fields = {
        "name": attribute.name,
        "values": list(attribute.values),
        "timestamps_ns": None if times is None else times.tolist(),
        "sensor_id": attribute.sensor_id,
        "static": attribute.static,
        "point_index": attribute.point_index,
        "extras": dict(attribute.extras) or None,
    }
    return {name: value for name, value in fields.items() if value is not None}


def annotation_fields(annotation: Any) -> dict[str, Any]:
    """Report what the data of the format do not hold of an annotation, as far as it is stated."""
    known = type(annotation).__dataclass_fields__
    names = [name for name in _REPLACED if name in known]
    fields = {name: value for name in names if (value := getattr(annotation, name)) is not None}
    if isinstance(annotation, EventAnnotation) and annotation.duration_ns is None:
        fields["duration_ns"] = None
    if isinstance(annotation, LinkAnnotation):
        fields["attributes"] = [attribute_fields(one) for one in annotation.attributes]
    return fields
