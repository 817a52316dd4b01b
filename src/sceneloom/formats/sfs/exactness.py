"""Attributes that the profile `scale` has to change, kept exactly under our metadata and put back on reading."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.formats.sfs.annotation_parts import attribute_values
from sceneloom.formats.sfs.poses import times_of
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import Identifier, key_of

Record = Mapping[str, Any]


def restore_exact_attributes(
    records: Any, annotations: tuple[Annotation, ...], attributes: tuple[AttributePath, ...]
) -> tuple[tuple[Annotation, ...], tuple[AttributePath, ...]]:
    """Put exact times and values back where the written ones still stand.

    Args:
        records: `exact_attributes` of our metadata.
        annotations: of the file.
        attributes: of the scene.
    """
    of_scene = [record for record in records if record.get("annotation_id") is None]
    by_annotation: dict[tuple[type, Identifier], list[Record]] = {}
    for record in records:
        identifier = record.get("annotation_id")
        if identifier is not None:
            by_annotation.setdefault((type(identifier), identifier), []).append(record)
    if by_annotation:
        annotations = tuple(
            _restored(annotation, by_annotation.get(key_of(annotation.id), [])) for annotation in annotations
        )
    return annotations, _restored_attributes(attributes, of_scene)


def _restored(annotation: Annotation, records: Sequence[Record]) -> Annotation:
    attributes = getattr(annotation, "attributes", ())
    if not records or not attributes:
        return annotation
    restored: Any = replace(cast("Any", annotation), attributes=_restored_attributes(attributes, records))
    return cast("Annotation", restored)


def _restored_attributes(
    attributes: Sequence[AttributePath], records: Sequence[Record]
) -> tuple[AttributePath, ...]:
    restored = list(attributes)
    for record in records:
        index = record["index"]
        if not 0 <= index < len(restored):
            continue
        values = attribute_values(record["values"])
        times_ns = read_only(times_of(record["timestamps"]))
        if _identical(attribute_values(record["written"]), restored[index].values):
            restored[index] = replace(restored[index], timestamps_ns=times_ns, values=values)
    return tuple(restored)


def simplified_attributes(
    attributes: Sequence[Record], annotation_id: Identifier | None
) -> tuple[list[Record], list[Record]]:
    """Give attributes as Scale's library takes them, and the records that keep what was changed.

    Numbers become integers: an attribute with fractions is counted in thousandths. Static attributes keep their first
    timestamp.
    """
    simplified: list[Record] = []
    records: list[Record] = []
    for index, attribute in enumerate(attributes):
        times, values = _listed(attribute.get("timestamps")), _listed(attribute.get("values"))
        written = _integers(values)
        kept = 1 if attribute.get("static") else len(values)
        written, written_times = written[:kept], times[:kept]
        if attribute.get("timestamps") is None:
            simplified.append(attribute)
            continue
        simplified.append({**attribute, "timestamps": written_times, "values": written})
        if written_times != times or not _identical(written, values):
            record = {"index": index, "timestamps": times, "values": values, "written": written}
            records.append(record if annotation_id is None else {"annotation_id": annotation_id, **record})
    return simplified, records


def thousandths(attribute: Record) -> Record:
    """Give one attribute with integers for numbers."""
    return {**attribute, "values": _integers(_listed(attribute.get("values")))}


def _listed(values: Any) -> list[Any]:
    return [] if values is None else values.tolist() if isinstance(values, np.ndarray) else list(values)


def _integers(values: Sequence[Any]) -> list[Any]:
    fractions = any(_is_number(value) and value != round(value) for value in values)
    scale = 1000 if fractions else 1
    return [round(value * scale) if _is_number(value) else value for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < float("inf")


def _identical(written: Sequence[Any], values: Sequence[Any]) -> bool:
    return [(type(value), value) for value in written] == [(type(value), value) for value in values]
