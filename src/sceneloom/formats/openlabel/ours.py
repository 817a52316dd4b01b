"""What OpenLABEL has no words for: fields of annotations by their own names, beside the metadata of the file."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.errors import SceneloomError
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.words import OURS
from sceneloom.scene import (
    Annotation,
    AttributePath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPoints,
    LabeledPointsAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    PointPath,
    PointsAnnotation,
    ShapeAnnotation,
    ShapeType,
)
from sceneloom.scene.types import NO_FIELDS

Kind = TypeVar("Kind", bound=Annotation)

_ID, _NUMBER = (str, int), (int, float)
REPLACED: Mapping[str, tuple[type, ...]] = MappingProxyType(
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
        """The class of an annotation that the data do not tell, in our words."""
        by_uid = None if self.part is None else self.part.value.get(kind)
        fields = by_uid.get(uid) if isinstance(by_uid, dict) else None
        return fields.get("class") if isinstance(fields, dict) else None

    def restored(self, annotation: Annotation, kind: str, uid: str) -> Annotation:
        """The annotation with the fields put back that we wrote of it.

        Raises:
            DataError: they do not fit.
        """
        by_uid = None if self.part is None else self.part.get(kind)
        part = by_uid.get(uid) if by_uid is not None and isinstance(by_uid.value, dict) else None
        if part is None or not isinstance(part.value, dict):
            return annotation
        try:
            return _restored(annotation, part.value)
        except _FAULTS as error:
            raise part.fault(f"the fields of an annotation: {error}") from error


def _restored(annotation: Annotation, fields: Mapping[str, Any]) -> Annotation:
    made = _made(annotation, fields)
    known = type(made).__dataclass_fields__
    values = {name: fields[name] for name in REPLACED if name in fields and name in known}
    for name, value in values.items():
        if not isinstance(value, REPLACED[name]):
            raise TypeError(f"{name}: {value!r}")
    if "extras" in fields:
        values["extras"] = MappingProxyType(dict(fields["extras"]))
    if isinstance(made, ShapeAnnotation) and "shape" in fields:
        values["type"] = ShapeType(fields["shape"])
    if "attributes" in fields and "attributes" in known:
        own = tuple(attribute_of(one) for one in fields["attributes"])
        values["attributes"] = (*getattr(made, "attributes", ()), *own)
    whole: Annotation = replace(made, **values)
    return whole


def _made(annotation: Annotation, fields: Mapping[str, Any]) -> Any:
    """An annotation of the class that the fields name, where the data do not tell it."""
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
        return PointsAnnotation(paths=paths, labels=labels, **common)
    common["label"] = annotation.label
    if kind == "group":
        return GroupAnnotation(**common)
    if kind == "labeled_points":
        points = tuple(_labeled(one) for one in fields["labeled_points"])
        return LabeledPointsAnnotation(labeled_points=points, type=fields["type"], **common)
    return ObjectAnnotation(type=fields["type"], **common)


def _labeled(said: Mapping[str, Any]) -> LabeledPoints:
    ids = np.array(said["point_ids"], np.int64).astype(np.uint32)
    return LabeledPoints(said["sensor_id"], ids, said.get("sensor_frame"))


def _path(said: Mapping[str, Any]) -> PointPath:
    times, values = np.array(said["timestamps_ns"], np.int64), np.array(said["values"], np.float64)
    return PointPath(times, values.reshape(len(times), -1), said.get("id"))


def attribute_of(said: Mapping[str, Any]) -> AttributePath:
    """Read an attribute that the data of the format do not hold."""
    times = said.get("timestamps_ns")
    return AttributePath(
        said["name"],
        tuple(tuple(value) if isinstance(value, list) else value for value in said["values"]),
        None if times is None else np.array(times, np.int64),
        said.get("sensor_id"),
        said.get("static"),
        said.get("point_index"),
        said.get("extras") or NO_FIELDS,
    )


def attribute_fields(attribute: AttributePath) -> dict[str, Any]:
    """Say an attribute in full."""
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
    """Say what the data of the format do not hold of an annotation, as far as it is said."""
    known = type(annotation).__dataclass_fields__
    names = [name for name in REPLACED if name in known]
    fields = {name: value for name in names if (value := getattr(annotation, name)) is not None}
    if isinstance(annotation, EventAnnotation) and annotation.duration_ns is None:
        fields["duration_ns"] = None
    if isinstance(annotation, LinkAnnotation):
        fields["attributes"] = [attribute_fields(one) for one in annotation.attributes]
    return fields
