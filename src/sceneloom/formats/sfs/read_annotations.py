"""Annotations of a file."""

from typing import Any

from sceneloom.arrays import read_only
from sceneloom.errors import ArrayError
from sceneloom.formats.sfs.fields import ANNOTATION_RECORDS, annotation_record
from sceneloom.formats.sfs.poses import rows_of, times_of
from sceneloom.formats.sfs.records import Faults, FieldError, Place
from sceneloom.formats.sfs.source import Source
from sceneloom.scene import Annotation, CuboidAnnotation, CuboidPath, NoticeKind, PlainAnnotation

_TAKEN = frozenset({"id", "type", "path", "label", "stationary", "parent_id"})


def read_annotations(source: Source, raw: Any, place: Place) -> tuple[Annotation, ...]:
    """Read a list of annotations; those at fault are left out where the caller is lenient.

    Raises:
        DataError: one is at fault.
    """
    if raw is None:
        return ()
    if not isinstance(raw, list):
        faults = Faults()
        faults.add((), "expected a list of annotations")
        source.raise_faults(faults, place)
        return ()
    annotations = []
    for index, item in enumerate(raw):
        faults = Faults()
        annotation = _read_annotation(source, item, (*place, index), faults)
        if source.settle(faults, (*place, index)) and annotation is not None:
            annotations.append(annotation)
    return tuple(annotations)


def _read_annotation(source: Source, raw: Any, place: Place, faults: Faults) -> Annotation | None:
    type_name = raw.get("type") if isinstance(raw, dict) else None
    if not isinstance(type_name, str):
        faults.add(("type",), f"{type_name!r}; expected one of {', '.join(ANNOTATION_RECORDS)}")
        return None
    if type_name == "event" and raw.get("start") is None:
        source.notice(
            NoticeKind.ASSUMED, "event-is-object", place, "an event without a start; read as an object"
        )
        type_name = "object"
    known = type_name in ANNOTATION_RECORDS
    values = source.reader(forgiving=not known).read(raw, annotation_record(type_name), faults)
    if not known and not isinstance(values.get("id"), str | int):
        faults.add(("id",), f"{values.get('id')!r}; expected text or an integer")
    if faults:
        return None
    if type_name == "cuboid":
        return _cuboid(values, faults)
    fields = {name: value for name, value in values.items() if name not in {"id", "type"}}
    return PlainAnnotation(values["id"], type_name, fields)


def _cuboid(values: dict[str, Any], faults: Faults) -> CuboidAnnotation | None:
    path = values["path"]
    try:
        timestamps_ns, rows = times_of(path["timestamps"]), rows_of(path["values"], 9)
        cuboids = CuboidPath(read_only(timestamps_ns), read_only(rows))
    except FieldError as error:
        faults.add(("path", "values"), str(error))
        return None
    except ArrayError as error:
        faults.add(("path",), str(error).removeprefix("cuboid.path."))
        return None
    extras = {name: value for name, value in values.items() if name not in _TAKEN}
    further = {name: value for name, value in path.items() if name not in {"timestamps", "values"}}
    if further:
        extras["path"] = further
    return CuboidAnnotation(
        values["id"],
        cuboids,
        label=values.get("label"),
        stationary=values.get("stationary"),
        parent_id=values.get("parent_id"),
        extras=extras,
    )
