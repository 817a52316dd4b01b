"""Annotations of a file: from records to the model's classes."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from sceneloom.arrays import read_only
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError
from sceneloom.formats.sfs.annotation_parts import (
    check_counts,
    further,
    noting,
    read_poses,
    row_path,
    vertices_of,
)
from sceneloom.formats.sfs.annotation_record import AnnotationRecord
from sceneloom.formats.sfs.fields import ANNOTATION_RECORDS, annotation_record
from sceneloom.formats.sfs.poses import times_of
from sceneloom.formats.sfs.read_cameras import further_of_intrinsics, read_camera_model
from sceneloom.formats.sfs.read_cuboids import read_cuboid
from sceneloom.formats.sfs.read_keypoints import read_keypoints
from sceneloom.formats.sfs.records import Faults, FieldError, Location
from sceneloom.formats.sfs.source import Source
from sceneloom.formats.sfs.spec import PAIRS
from sceneloom.formats.sfs.usual_cuboids import read_usual_cuboids
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.relations import (
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations.shapes import DIMENSIONS, ShapeAnnotation, ShapeType, VertexPath
from sceneloom.scene.warnings import WarningKind


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
    usual = read_usual_cuboids(raw, source.clock)
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
    return build(AnnotationRecord(source, {**values, "type": type_name}, location, faults))


def _plain(found: AnnotationRecord) -> PlainAnnotation:
    return PlainAnnotation(found.id, found.values["type"], further(found.values, "id", "type"))


def _box_2d(found: AnnotationRecord) -> Box2DAnnotation | None:
    record = found.values["path"]
    fields = found.fields("label", "stationary", "parent_id", "attributes", taken=("sensor_id", "path"))
    path = row_path(record, 4, found.faults, ("path",))
    if path is None:
        return None
    box = BoxPath(*path, extras=further(record, "timestamps", "values"))
    return Box2DAnnotation(found.id, found.values["sensor_id"], box, **fields)


_OUTLINES = frozenset({ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYLINE})


def _shape(found: AnnotationRecord) -> ShapeAnnotation | None:
    kind, record, faults = ShapeType(found.values["type"]), found.values["path"], found.faults
    closing = ("is_closed",) if kind is ShapeType.POLYLINE else ()
    names = ("sensor_id", *closing, "label", "stationary", "parent_id", "attributes")
    fields = found.fields(*names, taken=("path",))
    asked = found.source.options.vertices
    vertices, flat = vertices_of(
        record["values"],
        DIMENSIONS[kind],
        faults,
        ("path", "values"),
        are_pairs=None if asked is None or kind not in _OUTLINES else asked == PAIRS,
    )
    if not faults.unmended:
        if flat:
            found.note_flat("path", "values")
        with noting(faults, ("path",)):
            path = _vertex_path(record, vertices)
            return ShapeAnnotation(found.id, kind, path, **fields)
    return None


def _vertex_path(record: Mapping[str, Any], vertices: tuple[Any, ...]) -> VertexPath:
    times = times_of(record["timestamps"])
    check_counts(times, vertices)
    return VertexPath(read_only(times), vertices, extras=further(record, "timestamps", "values"))


def _event(found: AnnotationRecord) -> EventAnnotation:
    fields = found.fields("label", "sensor_id", "parent_id", "attributes", taken=("start", "duration"))
    return EventAnnotation(
        found.id, found.values["start"], duration_ns=found.values.get("duration"), **fields
    )


def _labeled_points(found: AnnotationRecord) -> LabeledPointsAnnotation:
    names = ("label", "is_instance", "parent_id", "attributes")
    parts = [
        LabeledPoints(
            record["sensor_id"],
            record["point_ids"],
            sensor_frame=record.get("sensor_frame"),
            extras=further(record, "sensor_id", "point_ids", "sensor_frame"),
        )
        for record in found.values["labeled_points"]
    ]
    fields = found.fields(*names, taken=("labeled_points",))
    return LabeledPointsAnnotation(found.id, tuple(parts), type=found.values["type"], **fields)


def _object(found: AnnotationRecord) -> ObjectAnnotation:
    return ObjectAnnotation(
        found.id, type=found.values["type"], **found.fields("label", "parent_id", "attributes")
    )


def _group(found: AnnotationRecord) -> GroupAnnotation:
    return GroupAnnotation(found.id, **found.fields("label", "parent_id", "attributes"))


def _link(found: AnnotationRecord) -> LinkAnnotation:
    names = ("from_id", "to_id", "label", "is_bidirectional", "sensor_id", "parent_id", "attributes")
    return LinkAnnotation(found.id, **found.fields(*names))


def _adjustment(found: AnnotationRecord) -> LocalizationAdjustment | None:
    poses = read_poses(found.values, found.faults)
    if poses is None:
        return None
    fields = found.fields("parent_id", taken=("poses",))
    fields["extras"] |= _further_of_poses(found)
    return LocalizationAdjustment(found.id, poses, **fields)


def _calibration(found: AnnotationRecord) -> CameraCalibration | None:
    poses, camera_model = read_poses(found.values, found.faults), _camera_model(found)
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


def _further_of_poses(found: AnnotationRecord) -> dict[str, Any]:
    unknown = further(found.values.get("poses") or {}, "timestamps", "values")
    return {"poses": unknown} if unknown else {}


def _camera_model(found: AnnotationRecord) -> Camera | None:
    intrinsics = found.values.get("intrinsics")
    if intrinsics is None:
        return None
    try:
        return read_camera_model(found.source, intrinsics, {}, (*found.location, "intrinsics"))
    except (FieldError, CalibrationError) as error:
        found.faults.add(("intrinsics",), str(error))
        return None


_BUILDERS: Mapping[str, Callable[[AnnotationRecord], Annotation | None]] = MappingProxyType(
    {
        "cuboid": read_cuboid,
        "box_2d": _box_2d,
        **dict.fromkeys(ShapeType, _shape),
        "points": read_keypoints,
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
