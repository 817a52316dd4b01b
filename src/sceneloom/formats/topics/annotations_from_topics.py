"""The annotations that the topics of boxes report."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from sceneloom.formats.topics.boxes import Key, Track, annotation_ids, box_2d, cuboid, gather
from sceneloom.formats.topics.locations import Locations
from sceneloom.formats.topics.log import Topic
from sceneloom.formats.topics.names import nearest
from sceneloom.formats.topics.notes import attributes_from
from sceneloom.formats.topics.records import Boxes2DRecord, Boxes3DRecord, Kind
from sceneloom.formats.topics.survey import Survey
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.warnings import WarningKind


def read_annotations(survey: Survey, locations: Locations, cameras: Mapping[str, Any]) -> list[Annotation]:
    """Make the annotations of all topics of boxes, those that notes speak of as these state.

    Args:
        survey: of all topics.
        locations: of all frames.
        cameras: ids by the topics of their images.
    """
    found = [*_cuboids(survey, locations), *_boxes_2d(survey, cameras)]
    notes = {(str(note.get("topic")), str(note.get("key"))): note for note in survey.notes.annotations}
    order = {key: row for row, key in enumerate(notes)}
    noted = [
        (order.get(key, len(order)), _with_note(annotation, notes.get(key))) for key, annotation in found
    ]
    return _with_unique_ids([annotation for _, annotation in sorted(noted, key=lambda row: row[0])])


def _with_unique_ids(annotations: Sequence[Annotation]) -> list[Annotation]:
    """Number ids that are there once more: an object may be a cuboid and a box in images."""
    taken: dict[Any, int] = {}
    found = []
    for annotation in annotations:
        key = type(annotation.id), annotation.id
        taken[key] = taken.get(key, 0) + 1
        again = taken[key] > 1
        found.append(replace(annotation, id=f"{annotation.id}~{taken[key]}") if again else annotation)
    return found


def _cuboids(survey: Survey, locations: Locations) -> list[tuple[Key, Annotation]]:
    tracks: dict[Key, Track] = {}
    for topic in survey.topics(Kind.BOXES_3D):
        tracks |= gather(topic.name, survey.of(topic, Boxes3DRecord), survey)
    location = f"{survey.log.name}: boxes"
    made = [
        (key, cuboid(identifier, track, locations, survey, location))
        for (key, track), identifier in zip(tracks.items(), annotation_ids([*tracks]), strict=True)
    ]
    return [(key, annotation) for key, annotation in made if annotation is not None]


def _boxes_2d(survey: Survey, cameras: Mapping[str, Any]) -> list[tuple[Key, Annotation]]:
    found: list[tuple[Key, Annotation]] = []
    noted = {
        note["boxes_topic"]: note["id"]
        for note in survey.notes.sensors
        if {"boxes_topic", "id"} <= note.keys()
    }
    for topic in survey.topics(Kind.BOXES_2D):
        records = survey.of(topic, Boxes2DRecord)
        camera = noted.get(topic.name)
        if camera is None:
            camera = _camera_of(topic, cameras)
        if camera is None:
            message = "boxes in images of a camera that is not reported"
            location = f"{survey.log.name}: {topic.name}"
            count = sum(len(record.boxes) for record in records)
            survey.ledger.note(WarningKind.SKIPPED, "boxes-without-camera", location, message, count=count)
            continue
        tracks = gather(topic.name, records, survey)
        ids = annotation_ids([*tracks])
        found += [
            (key, box_2d(identifier, camera, track))
            for (key, track), identifier in zip(tracks.items(), ids, strict=True)
        ]
    return _with_own_ids(found)


def _camera_of(topic: Topic, cameras: Mapping[str, Any]) -> Any:
    """The camera whose topic stands beside that of boxes; the only one where there is only one."""
    name = nearest(topic.name, cameras) or (next(iter(cameras)) if len(cameras) == 1 else None)
    return None if name is None else cameras[name]


def _with_own_ids(found: Sequence[tuple[Key, Annotation]]) -> list[tuple[Key, Annotation]]:
    """Objects that several cameras see become an annotation for each."""
    counts: dict[Any, int] = {}
    for _, annotation in found:
        counts[annotation.id] = counts.get(annotation.id, 0) + 1
    return [
        (key, annotation)
        if counts[annotation.id] == 1
        else (key, replace(annotation, id=f"{key[0].strip('/')}/{annotation.id}"))
        for key, annotation in found
    ]


def _with_note(annotation: Annotation, note: Mapping[str, Any] | None) -> Annotation:
    if note is None:
        return annotation
    fields: dict[str, Any] = {name: note.get(name) for name in ("id", "parent_id", "label", "stationary")}
    fields["attributes"] = attributes_from(note.get("attributes", ()))
    if note.get("extras"):
        fields["extras"] = MappingProxyType(note["extras"])
    return replace(annotation, **fields)
