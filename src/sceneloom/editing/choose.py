"""Scenes with some of their sensors, or with the annotations of some labels."""

from collections.abc import Iterable
from dataclasses import replace
from types import MappingProxyType

from sceneloom.editing.camera_index import without_cameras
from sceneloom.editing.record import OURS, assumed, ours_of, skipped, with_warnings
from sceneloom.editing.references import (
    NewIds,
    attributes_of,
    metadata_of,
    with_annotation_ids,
    with_sensor_ids,
    with_sensor_parent,
)
from sceneloom.errors import OptionError
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.relations import LinkAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of


def with_sensors_chosen(
    scene: Scene, *, sensors: Iterable[Identifier] | None = None, without: Iterable[Identifier] = ()
) -> Scene:
    """Give a scene with some of its sensors, and without what is stated for the others.

    Args:
        scene: as it is.
        sensors: ids of those that stay; None for all.
        without: ids of those that go all the same.

    Raises:
        OptionError: there is no such sensor, none is left, or one that is left refers to an ego that is gone.
    """
    wanted = {key_of(s.id) for s in scene.sensors}
    if sensors is not None:
        wanted = {key_of(scene.sensor(identifier).id) for identifier in sensors}
    wanted -= {key_of(scene.sensor(identifier).id) for identifier in without}
    if not wanted:
        raise OptionError(f"{scene.source}: no sensor is left")
    ids = NewIds({key_of(s.id): None for s in scene.sensors if key_of(s.id) not in wanted})
    if not ids.changed:
        return scene
    kept = tuple(with_sensor_parent(s, ids) for s in scene.sensors if key_of(s.id) in wanted)
    _check_ego(scene, kept, ids)
    attributes = attributes_of(scene.attributes, ids)
    cut = replace(scene, sensors=kept, attributes=attributes)
    cut = with_annotations(cut, [with_sensor_ids(annotation, ids) for annotation in scene.annotations])
    ours = metadata_of(ours_of(scene), ids)
    if ours:
        cut = replace(cut, metadata=MappingProxyType({**scene.metadata, OURS: ours}))
    reported = skipped("sensors-left-out", "sensors", "sensors that were not chosen", count=len(ids.changed))
    colours = assumed(
        "colours-kept",
        "sensors[].frames[].points.camera_index",
        "points keep the colours that a camera that was left out gave them, without saying which it was",
        count=sum(isinstance(s, CameraSensor) and ids.gone(s.id) for s in scene.sensors),
    )
    clouds = any(isinstance(sensor, LidarSensor) for sensor in kept)
    return with_warnings(without_cameras(scene, cut), (reported, *((colours,) if clouds else ())))


def _check_ego(scene: Scene, kept: tuple[object, ...], ids: NewIds) -> None:
    gone = [s for s in scene.sensors if isinstance(s, OdometrySensor) and ids.gone(s.id)]
    left = any(isinstance(sensor, OdometrySensor) for sensor in kept)
    for sensor in kept if gone else ():
        on_ego = isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor) and (
            sensor.coordinates is Coordinates.EGO
        )
        if on_ego and not left:
            raise OptionError(
                f"{scene.source}: sensor {getattr(sensor, 'id', None)!r} is in ego coordinates and needs the odometry "
                f"sensor {gone[0].id!r}; bring the scene into the world first: `sceneloom edit to-world`"
            )


def with_annotations(scene: Scene, found: list[Annotation | None]) -> Scene:
    """Give a scene whose annotations became these, None for one that is gone; links to it and its role as parent go.

    Args:
        scene: with all annotations.
        found: one for each of them.
    """
    gone: dict[Key, Identifier | None] = {}
    for annotation, new in zip(scene.annotations, found, strict=True):
        if new is None:
            gone[key_of(annotation.id)] = None
    kept = tuple(annotation for annotation in found if annotation is not None)
    if not gone:
        return replace(scene, annotations=kept)
    ids = NewIds(gone)
    orphans = sum(ids.gone(annotation.parent_id) for annotation in kept)
    freed = [with_annotation_ids(annotation, ids) for annotation in kept]
    left = tuple(annotation for annotation in freed if annotation is not None)
    reported = (
        ("annotations", "annotations that are not in it any more", len(gone)),
        ("links", "links to annotations that are not in it any more", len(kept) - len(left)),
        ("parents", "names of parents that are not in it any more", orphans),
    )
    warnings = [skipped(f"{what}-left-out", "annotations", message, count=n) for what, message, n in reported]
    return with_warnings(replace(scene, annotations=left), warnings)


def with_labels_chosen(scene: Scene, labels: Iterable[str]) -> Scene:
    """Give a scene with the annotations of these labels, their parents, links between them, and all corrections.

    Raises:
        OptionError: no annotation has such a label.
    """
    wanted = frozenset(labels)
    stated = {_label(annotation) for annotation in scene.annotations}
    unknown = sorted(wanted - stated)
    if unknown:
        known = ", ".join(sorted(repr(label) for label in stated if label is not None))
        raise OptionError(
            f"{scene.source}: no annotation has the label {unknown[0]!r}; there are {known or 'none'}"
        )
    kept = {key_of(a.id) for a in scene.annotations if _label(a) in wanted}
    parents = {key_of(a.id): a.parent_id for a in scene.annotations}
    for key in list(kept):
        parent = parents[key]
        while parent is not None and key_of(parent) not in kept and key_of(parent) in parents:
            kept.add(key_of(parent))
            parent = parents[key_of(parent)]
    links = {
        key_of(a.id)
        for a in scene.annotations
        if isinstance(a, LinkAnnotation) and key_of(a.from_id) in kept and key_of(a.to_id) in kept
    }
    corrections = (LocalizationAdjustment, CameraCalibration)
    return with_annotations(
        scene,
        [
            a if key_of(a.id) in kept or key_of(a.id) in links or isinstance(a, corrections) else None
            for a in scene.annotations
        ],
    )


def _label(annotation: Annotation) -> str | None:
    if isinstance(annotation, PlainAnnotation):
        label = annotation.fields.get("label")
        return label if isinstance(label, str) else None
    return getattr(annotation, "label", None)
