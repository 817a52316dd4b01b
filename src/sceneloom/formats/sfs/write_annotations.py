"""The model's annotations and attributes as records: the words of the file, times in nanoseconds."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.camera_models import intrinsics_record, merged_intrinsics
from sceneloom.formats.sfs.drafts import with_further
from sceneloom.formats.sfs.encoding import StationaryTime
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation, Projection
from sceneloom.scene.annotations.keypoints import PointPath, PointProjection, PointsAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.relations import (
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.poses import Poses

Record = dict[str, Any]


def annotation_record(annotation: Annotation) -> Record:
    """Make the record of an annotation.

    Raises:
        OptionError: a number of it is not finite; rows of NaN, where they mean "none", are written as null.
    """
    if isinstance(annotation, PlainAnnotation):
        return {"id": annotation.id, "type": annotation.type, **annotation.fields}
    record: Record = {
        "id": annotation.id,
        "type": str(annotation.type),
        "parent_id": annotation.parent_id,
        **_stated(annotation),
    }
    try:
        record |= _FIELDS[type(annotation)](annotation)
    except _NotFiniteError as error:
        raise OptionError(f"annotations[{annotation.id}].{error}") from None
    # a field that is not stated is left out here: not every type has each of them
    stated = {name: value for name, value in record.items() if value is not None}
    return with_further(stated, annotation.extras)


def attribute_record(attribute: AttributePath) -> Record:
    """Make the record of an attribute."""
    values: Any = attribute.values
    if attribute.timestamps_ns is None and not values:
        values = None
    record = {
        "name": attribute.name,
        "sensor_id": attribute.sensor_id,
        "static": attribute.static,
        "point_index": attribute.point_index,
        "timestamps": attribute.timestamps_ns,
        "values": values,
    }
    return with_further(record, attribute.extras)


class _NotFiniteError(ValueError):
    """Where a number is not finite, below the annotation, and which."""


def _stated(annotation: Any) -> Record:
    """Label, stillness and attributes, of the types that have them."""
    record: Record = {name: getattr(annotation, name, None) for name in ("label", "stationary")}
    attributes = getattr(annotation, "attributes", ())
    if attributes:
        record["attributes"] = [attribute_record(attribute) for attribute in attributes]
    return record


def _finite(name: str, values: Float64Array) -> Float64Array:
    if np.isfinite(values).all():
        return values
    row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
    raise _NotFiniteError(f"{name}[{row}]: {values[row].tolist()}; expected finite numbers")


def _nullable(name: str, values: Float64Array | None) -> Any:
    """Write rows of NaN as null."""
    if values is None or np.isfinite(values).all():
        return values
    rows: list[list[float] | None] = values.tolist()
    for row in np.flatnonzero(~np.isfinite(values).all(axis=1)).tolist():
        if not np.isnan(values[row]).all():
            raise _NotFiniteError(
                f"{name}[{row}]: {rows[row]}; expected finite numbers, or NaN for all of them"
            )
        rows[row] = None
    return rows


def _path(timestamps_ns: Any, values: Any, further: Mapping[str, Any]) -> Record:
    return with_further({"timestamps": timestamps_ns, "values": values}, further)


def _poses(poses: Poses | None, further: Any) -> Record | None:
    """Write poses; the time of one that holds at all times says nothing."""
    if poses is None:
        return None
    times: Any = StationaryTime(poses.start_ns) if poses.static else poses.timestamps_ns
    rows = np.hstack([poses.positions, poses.quaternions_xyzw])
    return _path(times, rows, further if isinstance(further, Mapping) else {})


def _cuboid(cuboid: CuboidAnnotation) -> Record:
    path = cuboid.path
    return {
        "path": _path(path.timestamps_ns, _finite("path.values", path.values), path.extras),
        "activations": _listed("activations", cuboid.activations, _activation),
        "projections": _listed("projections", cuboid.projections, _projection),
    }


def _listed(name: str, parts: Iterable[Any], record: Callable[[str, Any], Record]) -> list[Record] | None:
    return [record(f"{name}[{index}]", part) for index, part in enumerate(parts)] or None


def _activation(location: str, activation: Activation) -> Record:
    record = {
        "sensor_id": activation.sensor_id,
        "timestamps": activation.timestamps_ns,
        "durations": activation.durations_ns,
        "cuboids": _nullable(f"{location}.cuboids", activation.cuboids),
    }
    return with_further(record, activation.extras)


def _projection(location: str, projection: Projection) -> Record:
    record = {
        "sensor_id": projection.sensor_id,
        "timestamps": projection.timestamps_ns,
        "boxes": _nullable(f"{location}.boxes", projection.boxes),
        "confirmed": projection.confirmed,
        "cuboids": _nullable(f"{location}.cuboids", projection.cuboids),
    }
    return with_further(record, projection.extras)


def _box_2d(box: Box2DAnnotation) -> Record:
    path = box.path
    values = _finite("path.values", path.values)
    return {"sensor_id": box.sensor_id, "path": _path(path.timestamps_ns, values, path.extras)}


def _shape(shape: ShapeAnnotation) -> Record:
    path = shape.path
    rows = [
        _finite(f"path.values[{k}], vertices", vertices).reshape(-1).tolist()
        for k, vertices in enumerate(path.vertices)
    ]
    return {
        "sensor_id": shape.sensor_id,
        "is_closed": shape.is_closed,
        "path": _path(path.timestamps_ns, rows, path.extras),
    }


def _points(points: PointsAnnotation) -> Record:
    return {
        "sensor_id": points.sensor_id,
        "labels": points.labels,
        "paths": [_point_path(f"paths[{k}]", path) for k, path in enumerate(points.paths)],
        "projections": [
            _listed(f"projections[{k}]", of_point, _point_projection) or []
            for k, of_point in enumerate(points.projections)
        ]
        or None,
    }


def _point_path(location: str, path: PointPath) -> Record:
    values = _finite(f"{location}.values", path.values)
    return {"id": path.id, **_path(path.timestamps_ns, values, path.extras)}


def _point_projection(location: str, projection: PointProjection) -> Record:
    record = {
        "sensor_id": projection.sensor_id,
        "timestamps": projection.timestamps_ns,
        "points": _nullable(f"{location}.points", projection.points),
        "confirmed": projection.confirmed,
        "positions": _nullable(f"{location}.positions", projection.positions),
    }
    return with_further(record, projection.extras)


def _labeled_points(annotation: LabeledPointsAnnotation) -> Record:
    parts = [
        with_further(
            {"sensor_id": part.sensor_id, "sensor_frame": part.sensor_frame, "point_ids": part.point_ids},
            part.extras,
        )
        for part in annotation.labeled_points
    ]
    return {"is_instance": annotation.is_instance, "labeled_points": parts}


def _event(event: EventAnnotation) -> Record:
    return {"sensor_id": event.sensor_id, "start": event.start_ns, "duration": event.duration_ns}


def _link(link: LinkAnnotation) -> Record:
    names = ("sensor_id", "from_id", "to_id", "is_bidirectional")
    return {name: getattr(link, name) for name in names}


def _adjustment(adjustment: LocalizationAdjustment) -> Record:
    return {"poses": _poses(adjustment.poses, adjustment.extras.get("poses"))}


def _calibration(calibration: CameraCalibration) -> Record:
    camera_model, further = calibration.intrinsics, calibration.extras.get("intrinsics")
    return {
        "sensor_id": calibration.sensor_id,
        "poses": _poses(calibration.poses, calibration.extras.get("poses")),
        "intrinsics": None
        if camera_model is None
        else merged_intrinsics(intrinsics_record(camera_model), further),
        "time_offset": calibration.time_offset_ns,
    }


def _nothing_more(_: Any) -> Record:
    return {}


_FIELDS = cast(
    "Mapping[type, Callable[[Any], Record]]",
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _box_2d,
        ShapeAnnotation: _shape,
        PointsAnnotation: _points,
        LabeledPointsAnnotation: _labeled_points,
        EventAnnotation: _event,
        LinkAnnotation: _link,
        LocalizationAdjustment: _adjustment,
        CameraCalibration: _calibration,
        ObjectAnnotation: _nothing_more,
        GroupAnnotation: _nothing_more,
    },
)
"""What each type of annotation has besides what all have."""
