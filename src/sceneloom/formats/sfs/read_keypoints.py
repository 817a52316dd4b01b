"""Points annotations of a file: named points with ways and projections of their own."""

from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, read_only
from sceneloom.formats.sfs.annotation_parts import (
    Record,
    check_counts,
    confirmations,
    fits_pairs_only,
    further,
    noting,
    nullable_rows,
    rows_at,
    with_height,
)
from sceneloom.formats.sfs.annotation_record import AnnotationRecord
from sceneloom.formats.sfs.poses import times_of
from sceneloom.formats.sfs.records import Faults, FieldError, Location
from sceneloom.scene.annotations.keypoints import PointPath, PointProjection, PointsAnnotation


def read_keypoints(found: AnnotationRecord) -> PointsAnnotation | None:
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
    with noting(faults, ("labels",)):
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


def _path(found: AnnotationRecord, record: Record, location: Location) -> PointPath | None:
    times = times_of(record["timestamps"])
    values = _values(found, record["values"], (*location, "values"))
    if values is None:
        return None
    with noting(found.faults, location):
        check_counts(times, values)
        return PointPath(
            read_only(times),
            read_only(values),
            id=record.get("id"),
            extras=further(record, "id", "timestamps", "values"),
        )
    return None


def _values(found: AnnotationRecord, raw: Any, location: Location) -> Float64Array | None:
    """Take rows of x, y, z, or of several such triples; of pairs, z is 0."""
    columns = len(raw[0]) if len(raw) and isinstance(raw[0], list | np.ndarray) else 3
    rows = rows_at(raw, columns, found.faults, location)
    if rows is None:
        return None
    if fits_pairs_only([columns]):
        found.note_flat(*location)
        return with_height(rows.reshape(-1, 2)).reshape(len(rows), -1)
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
        return _listed(_projection(raw, faults, location))
    return tuple(
        projection
        for index, record in enumerate(raw)
        for projection in _listed(_projection(record, faults, (*location, index)))
    )


def _listed(projection: PointProjection | None) -> tuple[PointProjection, ...]:
    return () if projection is None else (projection,)


def _projection(record: Record, faults: Faults, location: Location) -> PointProjection | None:
    before = len(faults)
    points = nullable_rows(record, "points", 2, faults, location)
    positions = nullable_rows(record, "positions", 3, faults, location)
    confirmed = confirmations(record, faults, location)
    if len(faults) > before:
        return None
    return PointProjection(
        record["sensor_id"],
        read_only(times_of(record["timestamps"])),
        points=points,
        confirmed=confirmed,
        positions=positions,
        extras=further(record, "sensor_id", "timestamps", "points", "confirmed", "positions"),
    )
