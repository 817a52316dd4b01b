"""Cuboid annotations of a file, with their activations and projections."""

from collections.abc import Callable
from typing import Any

from sceneloom.arrays import read_only
from sceneloom.formats.sfs.annotation_parts import (
    Record,
    check_counts,
    confirmations,
    further,
    noting,
    nullable_rows,
    row_path,
)
from sceneloom.formats.sfs.annotation_record import AnnotationRecord
from sceneloom.formats.sfs.poses import times_of
from sceneloom.formats.sfs.records import Faults, Location
from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation, CuboidPath, Projection


def read_cuboid(found: AnnotationRecord) -> CuboidAnnotation | None:
    """Make a cuboid."""
    record, faults = found.values["path"], found.faults
    fields = found.fields(
        "label", "stationary", "parent_id", "attributes", taken=("path", "activations", "projections")
    )
    activations = _parts(found, "activations", _activation)
    projections = _parts(found, "projections", _projection)
    path = row_path(record, 9, faults, ("path",))
    if path is None or faults.unmended:
        return None
    return CuboidAnnotation(
        found.id,
        CuboidPath(*path, extras=further(record, "timestamps", "values")),
        activations=activations,
        projections=projections,
        **fields,
    )


def _parts(
    found: AnnotationRecord, name: str, read: Callable[[Record, Faults, Location], Any]
) -> tuple[Any, ...]:
    records = found.values.get(name) or ()
    return tuple(read(record, found.faults, (name, index)) for index, record in enumerate(records))


def _activation(record: Record, faults: Faults, location: Location) -> Activation | None:
    before = len(faults)
    cuboids = nullable_rows(record, "cuboids", 9, faults, location)
    durations = record.get("durations")
    if durations is not None:
        with noting(faults, (*location, "durations")):
            check_counts(record["timestamps"], durations, name="durations")
    if len(faults) > before:
        return None
    return Activation(
        record["sensor_id"],
        read_only(times_of(record["timestamps"])),
        durations_ns=None if durations is None else tuple(durations),
        cuboids=cuboids,
        extras=further(record, "sensor_id", "timestamps", "durations", "cuboids"),
    )


def _projection(record: Record, faults: Faults, location: Location) -> Projection | None:
    before = len(faults)
    boxes = nullable_rows(record, "boxes", 4, faults, location)
    cuboids = nullable_rows(record, "cuboids", 9, faults, location)
    confirmed = confirmations(record, faults, location)
    if len(faults) > before:
        return None
    return Projection(
        record["sensor_id"],
        read_only(times_of(record["timestamps"])),
        boxes=boxes,
        confirmed=confirmed,
        cuboids=cuboids,
        extras=further(record, "sensor_id", "timestamps", "boxes", "confirmed", "cuboids"),
    )
