"""Attributes that the profile `scale` has to change, kept exactly under our metadata and put back on reading."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sceneloom.scene import Annotation, CuboidAnnotation, Identifier

Attribute = Mapping[str, Any]


def restore_exact_attributes(
    records: Any, annotations: tuple[Annotation, ...], attributes: tuple[Attribute, ...]
) -> tuple[tuple[Annotation, ...], tuple[Attribute, ...]]:
    """Put exact times and values back where the written ones still stand.

    Args:
        records: `exact_attributes` of our metadata.
        annotations: of the file.
        attributes: of the scene.
    """
    of_scene = [record for record in records if record.get("annotation_id") is None]
    by_annotation: dict[tuple[type, Identifier], list[Attribute]] = {}
    for record in records:
        identifier = record.get("annotation_id")
        if identifier is not None:
            by_annotation.setdefault((type(identifier), identifier), []).append(record)
    if by_annotation:
        annotations = tuple(
            _restored(annotation, by_annotation.get((type(annotation.id), annotation.id), []))
            for annotation in annotations
        )
    return annotations, tuple(_restored_list(attributes, of_scene))


def _restored(annotation: Annotation, records: Sequence[Attribute]) -> Annotation:
    fields = annotation.extras if isinstance(annotation, CuboidAnnotation) else annotation.fields
    attributes = fields.get("attributes")
    if not records or not isinstance(attributes, list):
        return annotation
    changed = {**fields, "attributes": _restored_list(attributes, records)}
    if isinstance(annotation, CuboidAnnotation):
        return replace(annotation, extras=changed)
    return replace(annotation, fields=changed)


def _restored_list(attributes: Sequence[Attribute], records: Sequence[Attribute]) -> list[Attribute]:
    restored = list(attributes)
    for record in records:
        index = record["index"]
        if 0 <= index < len(restored) and _equal(restored[index].get("values"), record["written"]):
            restored[index] = {
                **restored[index],
                "timestamps": record["timestamps"],
                "values": record["values"],
            }
    return restored


def simplified_attributes(
    attributes: Sequence[Attribute], annotation_id: Identifier | None
) -> tuple[list[Attribute], list[Attribute]]:
    """Give attributes as Scale's library takes them, and the records that keep what was changed.

    Numbers become integers: an attribute with fractions is counted in thousandths. Static attributes keep their first
    time stamp.
    """
    simplified: list[Attribute] = []
    records: list[Attribute] = []
    for index, attribute in enumerate(attributes):
        times, values = _listed(attribute.get("timestamps")), _listed(attribute.get("values"))
        written = _integers(values)
        kept = 1 if attribute.get("static") else len(values)
        written, written_times = written[:kept], times[:kept]
        simplified.append({**attribute, "timestamps": written_times, "values": written})
        if written_times != times or not _identical(written, values):
            record = {"index": index, "timestamps": times, "values": values, "written": written}
            records.append(record if annotation_id is None else {"annotation_id": annotation_id, **record})
    return simplified, records


def thousandths(attribute: Attribute) -> Attribute:
    """Give one attribute with integers for numbers."""
    return {**attribute, "values": _integers(_listed(attribute.get("values")))}


def _listed(values: Any) -> list[Any]:
    return [] if values is None else values.tolist() if isinstance(values, np.ndarray) else list(values)


def _equal(a: Any, b: Any) -> bool:
    try:
        return bool(_listed(a) == _listed(b))
    except ValueError:  # arrays among the values, which no attribute of ours has
        return False


def _integers(values: Sequence[Any]) -> list[Any]:
    fractions = any(_is_number(value) and value != round(value) for value in values)
    scale = 1000 if fractions else 1
    return [round(value * scale) if _is_number(value) else value for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < float("inf")


def _identical(written: Sequence[Any], values: Sequence[Any]) -> bool:
    return [(type(value), value) for value in written] == [(type(value), value) for value in values]
