"""What edits keep consistent: warnings, our metadata, ids and references to them, camera indices of points."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import OptionError
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    PlainAnnotation,
    PointsAnnotation,
    ShapeAnnotation,
)
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import PlainSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import DataWarning, WarningKind

OURS = "sceneloom"
"""Name of our part of a scene's metadata."""


def ours_of(scene: Scene) -> Mapping[str, Any]:
    """Our part of a scene's metadata; empty where there is none."""
    ours = scene.metadata.get(OURS)
    return ours if isinstance(ours, Mapping) else {}


def with_ours(scene: Scene, **entries: Any) -> Scene:
    """The scene with some of our entries of the metadata set; None takes one away."""
    reported = {name: value for name, value in {**ours_of(scene), **entries}.items() if value is not None}
    free = {name: value for name, value in scene.metadata.items() if name != OURS}
    return replace(scene, metadata=MappingProxyType({**free, **({OURS: reported} if reported else {})}))


def with_warnings(scene: Scene, warnings: Iterable[DataWarning]) -> Scene:
    """The scene with further warnings; those that count nothing are left out."""
    reported = tuple(warning for warning in warnings if warning.count > 0)
    return replace(scene, warnings=(*scene.warnings, *reported)) if reported else scene


def skipped(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something was left out."""
    return DataWarning(kind=WarningKind.SKIPPED, code=code, location=location, message=message, count=count)


def assumed(code: str, location: str, message: str, *, count: int = 1) -> DataWarning:
    """A warning that something is not stated and was taken to be so."""
    return DataWarning(kind=WarningKind.ASSUMED, code=code, location=location, message=message, count=count)


_BELONGING = (
    Box2DAnnotation,
    ShapeAnnotation,
    PointsAnnotation,
    EventAnnotation,
    LinkAnnotation,
    CameraCalibration,
)
"""Annotations that are for one sensor only, or may be: they go with it."""


@dataclass(frozen=True, slots=True, eq=False)
class NewIds:
    """What becomes of ids.

    Attributes:
        changed: the new id of each that changes; None where its bearer is gone.
    """

    changed: Mapping[Key, Identifier | None]

    def __call__(self, identifier: Identifier) -> Identifier | None:
        """The id now; None where its bearer is gone."""
        return self.changed.get(key_of(identifier), identifier)

    def gone(self, identifier: Identifier | None) -> bool:
        """Whether the bearer of an id is gone."""
        return identifier is not None and self(identifier) is None


def with_sensor_ids(annotation: Annotation, sensors: NewIds) -> Annotation | None:
    """Give an annotation that names sensors by their new ids; None where it belongs to one that is gone."""
    if isinstance(annotation, PlainAnnotation):
        return _plain_annotation(annotation, sensors)
    if isinstance(annotation, _BELONGING):
        if sensors.gone(annotation.sensor_id):
            return None
        if annotation.sensor_id is not None:
            annotation = replace(annotation, sensor_id=sensors(annotation.sensor_id))  # type: ignore[arg-type]
    if isinstance(annotation, CuboidAnnotation):
        annotation = replace(
            annotation,
            activations=_entries(annotation.activations, sensors),
            projections=_entries(annotation.projections, sensors),
        )
    elif isinstance(annotation, PointsAnnotation):
        projections = tuple(_entries(entries, sensors) for entries in annotation.projections)
        annotation = replace(annotation, projections=projections)
    elif isinstance(annotation, LabeledPointsAnnotation):
        entries = _entries(annotation.labeled_points, sensors)
        if annotation.labeled_points and not entries:
            return None
        annotation = replace(annotation, labeled_points=entries)
    return _with_attributes(annotation, sensors)  # type: ignore[no-any-return]


def _plain_annotation(annotation: PlainAnnotation, sensors: NewIds) -> PlainAnnotation | None:
    named = annotation.fields.get("sensor_id")
    if not isinstance(named, str | int):
        return annotation
    new = sensors(named)
    return None if new is None else replace(annotation, fields={**annotation.fields, "sensor_id": new})


def _entries(entries: Iterable[Any], sensors: NewIds) -> tuple[Any, ...]:
    """Of entries per sensor those that stay, by the new ids."""
    new = [(entry, sensors(entry.sensor_id)) for entry in entries]
    return tuple(
        entry if identifier == entry.sensor_id else replace(entry, sensor_id=identifier)
        for entry, identifier in new
        if identifier is not None
    )


def _with_attributes(annotation: Any, sensors: NewIds) -> Any:
    stated: tuple[AttributePath, ...] = getattr(annotation, "attributes", ())
    if all(attribute.sensor_id is None for attribute in stated):
        return annotation
    return replace(annotation, attributes=attributes_of(stated, sensors))


def attributes_of(attributes: Iterable[AttributePath], sensors: NewIds) -> tuple[AttributePath, ...]:
    """Give the attributes by the new ids of sensors, without those of sensors that are gone."""
    return tuple(
        attribute if attribute.sensor_id is None else replace(attribute, sensor_id=sensors(attribute.sensor_id))
        for attribute in attributes
        if not sensors.gone(attribute.sensor_id)
    )


def with_annotation_ids(annotation: Annotation, ids: NewIds) -> Annotation | None:
    """Give an annotation by its new id, with its parent and its ends; None for a link one of whose ends is gone."""
    identifier = ids(annotation.id)
    if identifier is None:
        return None
    if isinstance(annotation, LinkAnnotation):
        ends = ids(annotation.from_id), ids(annotation.to_id)
        if ends[0] is None or ends[1] is None:
            return None
        annotation = replace(annotation, from_id=ends[0], to_id=ends[1])
    parent_id = annotation.parent_id
    new_parent = None if parent_id is None else ids(parent_id)
    if isinstance(annotation, PlainAnnotation):
        fields = {**annotation.fields, **({} if parent_id is None else {"parent_id": new_parent})}
        return replace(annotation, id=identifier, fields=fields)
    return replace(annotation, id=identifier, parent_id=new_parent)


def with_sensor_parent(sensor: Sensor, ids: NewIds) -> Sensor:
    """Give a sensor by its new id and that of its parent; a parent that is gone is not named."""
    identifier, parent_id = ids(sensor.id), sensor.parent_id
    new_parent = None if parent_id is None else ids(parent_id)
    if identifier is None or (identifier == sensor.id and new_parent == parent_id):
        return sensor
    if isinstance(sensor, PlainSensor):
        fields = {**sensor.fields, **({} if parent_id is None else {"parent_id": new_parent})}
        return replace(sensor, id=identifier, fields=MappingProxyType(fields))
    return replace(sensor, id=identifier, parent_id=new_parent)


def metadata_of(ours: Mapping[str, Any], sensors: NewIds) -> dict[str, Any]:
    """Give our metadata with sensors named by their new ids, without what is stated for sensors that are gone."""
    return {name: _NAMING[name](value, sensors) if name in _NAMING else value for name, value in ours.items()}


def _entries_naming(value: Any, sensors: NewIds) -> Any:
    """Lists of entries with a `sensor_id`."""
    if not isinstance(value, list | tuple):
        return value
    return [
        {**entry, "sensor_id": sensors(entry["sensor_id"])} if _names(entry) else entry
        for entry in value
        if not (_names(entry) and sensors.gone(entry["sensor_id"]))
    ]


def _names(entry: Any) -> bool:
    return isinstance(entry, Mapping) and isinstance(entry.get("sensor_id"), str | int)


def _deskewed(value: Any, sensors: NewIds) -> Any:
    """Lists of entries with a list of `lidars`."""
    if not isinstance(value, list):
        return value
    return [
        {**entry, "lidars": _listed(entry["lidars"], sensors)}
        if isinstance(entry, Mapping) and isinstance(entry.get("lidars"), list)
        else entry
        for entry in value
    ]


def _fusion(value: Any, sensors: NewIds) -> Any:
    """What a fusion stated, in which the order of `cameras` is what `camera_index` counts."""
    if not (isinstance(value, Mapping) and isinstance(value.get("cameras"), list)):
        return value
    return {**value, "cameras": _listed(value["cameras"], sensors)}


def _listed(ids: list[Any], sensors: NewIds) -> list[Any]:
    new = [sensors(identifier) if isinstance(identifier, str | int) else identifier for identifier in ids]
    return [identifier for identifier in new if identifier is not None]


_NAMING: Mapping[str, Callable[[Any, NewIds], Any]] = MappingProxyType(
    {"unfused": _entries_naming, "extrapolated": _entries_naming, "deskew": _deskewed, "fusion": _fusion}
)
"""Our entries of the metadata that name sensors."""

_UNSEEN = 255
"""The `camera_index` of a point that no camera coloured."""


def recounted(lidar: LidarSensor, numbers: dict[int, int]) -> LidarSensor:
    """Give a lidar whose points name their cameras by new numbers, by the old ones; of others, no camera.

    Raises:
        OptionError: a number is beyond those that a point can bear.
    """
    if max(numbers.values(), default=0) >= _UNSEEN:
        raise OptionError(f"{max(numbers.values()) + 1} cameras; points can name {_UNSEEN} at most")
    table = np.full(256, _UNSEEN, np.uint8)
    for old, new in numbers.items():
        table[old] = new
    read = partial(_recounted_frame, lidar.frames, table)
    return replace(lidar, frames=LazyFrames(lidar.frames.timestamps_ns, read))


def _recounted_frame(frames: LazyFrames[LidarFrame], table: UInt8Array, k: int) -> LidarFrame:
    frame = frames[k]
    index = frame.points.camera_index
    return frame if index is None else replace(frame, points=replace(frame.points, camera_index=table[index]))


def without_cameras(scene: Scene, kept: Scene) -> Scene:
    """The scene `kept`, made of `scene` by leaving out sensors: its points name the cameras by their new locations."""
    locations = {key_of(camera.id): k for k, camera in enumerate(kept.cameras)}
    old = [key_of(camera.id) for camera in scene.cameras]
    numbers = {k: locations[key] for k, key in enumerate(old) if key in locations}
    if len(numbers) == len(old):
        return kept
    sensors = tuple(
        recounted(sensor, numbers) if isinstance(sensor, LidarSensor) else sensor for sensor in kept.sensors
    )
    return replace(kept, sensors=sensors)
