"""Boxes of messages as annotations, one for each object id, and annotations as messages."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.base.poses import lengths_of
from sceneloom.formats.messages.frames import Locations
from sceneloom.formats.messages.records import (
    Box2D,
    Box3D,
    Boxes2DRecord,
    Boxes3DRecord,
    Kind,
    Stated,
    Stream,
)
from sceneloom.formats.messages.survey import Survey, attributes_from, nearest
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.warnings import WarningKind

_Key = tuple[str, str]
"""Topic and id of an object."""


@dataclass(slots=True)
class _Track:
    """The boxes of one object in the order of the messages."""

    times_ns: list[int] = field(default_factory=list)
    boxes: list[Any] = field(default_factory=list)

    def drawn(self) -> tuple[Int64Array, list[Any]]:
        """Times and boxes in order, the last one of several with one time: a drawing replaces the one before."""
        latest = dict(zip(self.times_ns, self.boxes, strict=True))
        times = sorted(latest)
        return np.array(times, np.int64), [latest[time] for time in times]

    @property
    def label(self) -> str | None:
        """The class that is stated first."""
        return next((box.label for box in self.boxes if box.label), None)


def _gather(topic: str, records: Iterable[Boxes3DRecord | Boxes2DRecord], survey: Survey) -> dict[_Key, _Track]:
    """Collect the boxes of each object; a box without an id is an object of its own."""
    tracks: dict[_Key, _Track] = {}
    nameless = others = 0
    for record in records:
        others += record.no_boxes
        for box in record.boxes:
            identifier = box.id
            if not identifier:
                nameless += 1
                identifier = f"{topic.strip('/')}/{nameless}"
            track = tracks.setdefault((topic, identifier), _Track())
            track.times_ns.append(record.timestamp_ns)
            track.boxes.append(box)
    location = f"{survey.log.name}: {topic}"
    if others:
        survey.ledger.note(WarningKind.SKIPPED, "plots-not-read", location, "plots that are no boxes", count=others)
    if nameless:
        message = "boxes without an id; each is an object of its own"
        survey.ledger.note(WarningKind.ASSUMED, "boxes-without-id", location, message, count=nameless)
    return tracks


def _annotation_ids(keys: Sequence[_Key]) -> list[str]:
    """Ids of annotations: those of the objects, with the topic where several topics or frames have the same."""
    seen = Counter(identifier for _, identifier in keys)
    return [name if seen[name] == 1 else f"{topic.strip('/')}/{name}" for topic, name in keys]


def _cuboid_of_boxes(
    identifier: str | int, track: _Track, locations: Locations, survey: Survey, location: str
) -> CuboidAnnotation | None:
    """Make the cuboid of an object; None where none of its boxes can be placed in the world."""
    times, boxes = track.drawn()
    centers = np.array([box.center for box in boxes]).reshape(-1, 3)
    rotations = np.array([box.quaternion_xyzw for box in boxes]).reshape(-1, 4)
    sizes = np.array([box.size_lwh for box in boxes]).reshape(-1, 3)
    sound = ~lengths_of(rotations)[1]
    sound &= np.isfinite(np.hstack([centers, rotations, sizes])).all(axis=1)
    _note(survey, sound, "boxes-at-fault", location, "boxes without position, size or orientation")
    placed = np.zeros(len(boxes), np.bool_)
    for frame in dict.fromkeys(box.frame_id for box in boxes):
        same = np.array([box.frame_id == frame for box in boxes]) & sound
        if same.any():
            with np.errstate(over="ignore", invalid="ignore"):
                placed[same] = _to_world(centers, rotations, same, times, frame, locations)
    placed &= np.isfinite(centers).all(axis=1)
    message = "boxes in frames that are not placed in the world then"
    _note(survey, placed | ~sound, "boxes-not-placed", location, message)
    if not placed.any():
        return None
    angles = CuboidAngles().from_quaternions(normalise_quaternion(rotations[placed]))
    path = CuboidPath(times[placed], np.hstack([sizes[placed], centers[placed], angles]))
    kept = [box for box, good in zip(boxes, placed.tolist(), strict=True) if good]
    return CuboidAnnotation(identifier, path, track.label, attributes=_attributes(times[placed], kept))


def _note(survey: Survey, good: Any, code: str, location: str, message: str) -> None:
    lost = int((~good).sum())
    if lost:
        survey.ledger.note(WarningKind.SKIPPED, code, location, message, count=lost)


def _to_world(
    centers: Float64Array,
    rotations: Float64Array,
    same: Any,
    times: Int64Array,
    frame: str,
    locations: Locations,
) -> Any:
    """Move the chosen boxes of one frame into the world, in place; state which of them could be."""
    path, fixed = locations.world_from(frame, times[same])
    if fixed is not None:
        if not np.array_equal(fixed.matrix, np.eye(4)):
            centers[same] = fixed.apply(centers[same])
            rotations[same] = multiply_quaternions(fixed.quaternion_xyzw, rotations[same])
        return True
    if path is None:
        return False
    poses = path.interpolate(times[same], reach_ns=_REACH_NS)
    known = poses.coverage < 2
    centers[same] = rotate_vectors(poses.quaternions_xyzw, centers[same]) + poses.positions
    rotations[same] = multiply_quaternions(poses.quaternions_xyzw, rotations[same])
    return known


_REACH_NS = 100_000_000
"""Boxes may be this much before or after all that is known of the ego trajectory."""


def _box_2d(identifier: str | int, sensor_id: str | int, track: _Track) -> Box2DAnnotation:
    """Make the box of an object in the images of a camera."""
    times, boxes = track.drawn()
    values = np.array([box.box_ltwh for box in boxes], np.float64).reshape(-1, 4)
    return Box2DAnnotation(
        identifier, sensor_id, BoxPath(times, values), track.label, attributes=_attributes(times, boxes)
    )


def _attributes(times: Int64Array, boxes: Sequence[Any]) -> tuple[AttributePath, ...]:
    """What is stated for an object beside its class, where it changes."""
    found = []
    for name in dict.fromkeys(name for box in boxes for name in box.reported):
        values = [box.reported.get(name) for box in boxes]
        changes = [k for k, value in enumerate(values) if value is not None and (k == 0 or values[k - 1] != value)]
        found.append(AttributePath(name, tuple(_value(values[k]) for k in changes), times[changes]))
    return tuple(found)


def _value(text: str) -> Any:
    """A number where the text is one."""
    try:
        number = float(text)
    except ValueError:
        return text
    return int(number) if number.is_integer() and abs(number) < 2**53 else number


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
    found.sort(key=lambda pair: order.get(pair[0], len(order)))
    annotations = [_with_note(annotation, notes.get(key)) for key, annotation in found]
    # an object may be a cuboid and a box in images
    taken = Counter[Any]()
    for k, annotation in enumerate(annotations):
        key = type(annotation.id), annotation.id
        taken[key] += 1
        if taken[key] > 1:
            annotations[k] = replace(annotation, id=f"{annotation.id}~{taken[key]}")
    return annotations


def _cuboids(survey: Survey, locations: Locations) -> list[tuple[_Key, Annotation]]:
    tracks: dict[_Key, _Track] = {}
    for topic in survey.topics(Kind.BOXES_3D):
        tracks |= _gather(topic.name, survey.of(topic, Boxes3DRecord), survey)
    location = f"{survey.log.name}: boxes"
    made = [
        (key, _cuboid_of_boxes(identifier, track, locations, survey, location))
        for (key, track), identifier in zip(tracks.items(), _annotation_ids([*tracks]), strict=True)
    ]
    return [(key, annotation) for key, annotation in made if annotation is not None]


def _boxes_2d(survey: Survey, cameras: Mapping[str, Any]) -> list[tuple[_Key, Annotation]]:
    found: list[tuple[_Key, Box2DAnnotation]] = []
    noted = {note["boxes_topic"]: note["id"] for note in survey.notes.sensors if {"boxes_topic", "id"} <= note.keys()}
    for topic in survey.topics(Kind.BOXES_2D):
        records = survey.of(topic, Boxes2DRecord)
        # the camera whose topic stands beside that of boxes; the only one where there is only one
        name = nearest(topic.name, cameras) or (next(iter(cameras)) if len(cameras) == 1 else None)
        camera = noted.get(topic.name, None if name is None else cameras[name])
        if camera is None:
            message = "boxes in images of a camera that is not reported"
            location = f"{survey.log.name}: {topic.name}"
            count = sum(len(record.boxes) for record in records)
            survey.ledger.note(WarningKind.SKIPPED, "boxes-without-camera", location, message, count=count)
            continue
        tracks = _gather(topic.name, records, survey)
        named = zip(tracks.items(), _annotation_ids([*tracks]), strict=True)
        found += [(key, _box_2d(identifier, camera, track)) for (key, track), identifier in named]
    # objects that several cameras see become an annotation for each
    counts = Counter(annotation.id for _, annotation in found)
    return [
        (key, replace(one, id=f"{key[0].strip('/')}/{one.id}") if counts[one.id] > 1 else one) for key, one in found
    ]


def _with_note(annotation: Annotation, note: Mapping[str, Any] | None) -> Annotation:
    if note is None:
        return annotation
    fields: dict[str, Any] = {name: note.get(name) for name in ("id", "parent_id", "label", "stationary")}
    fields["attributes"] = attributes_from(note.get("attributes", ()))
    if note.get("extras"):
        fields["extras"] = MappingProxyType(note["extras"])
    return replace(annotation, **fields)


_Drawn = CuboidAnnotation | Box2DAnnotation


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """All rows of some annotations in the order of time: whose each is, and which of its own."""

    times_ns: Int64Array
    owners: Int64Array
    rows: Int64Array
    starts: Int64Array

    @classmethod
    def of(cls, annotations: Sequence[_Drawn]) -> "_Rows":
        lengths = [len(annotation.path.timestamps_ns) for annotation in annotations]
        times = np.concatenate([annotation.path.timestamps_ns for annotation in annotations])
        owners = np.repeat(np.arange(len(annotations)), lengths)
        rows = np.concatenate([np.arange(length) for length in lengths])
        order = np.lexsort((owners, times))
        moments, starts = np.unique(times[order], return_index=True)
        return cls(moments, owners[order], rows[order], np.append(starts, len(times)))

    def at(self, k: int) -> Iterator[tuple[int, int]]:
        part = slice(self.starts[k], self.starts[k + 1])
        return zip(self.owners[part].tolist(), self.rows[part].tolist(), strict=True)


def cuboid_stream(
    annotations: Sequence[CuboidAnnotation],
    keys: Sequence[str],
    topic: str,
    frame_id: str,
    angles: CuboidAngles,
) -> Stream:
    """Draw cuboids at each of their times, and take them away at the first one after their last."""
    rows = _Rows.of(annotations)
    last = {int(owner): int(annotations[owner].path.timestamps_ns[-1]) for owner in range(len(annotations))}
    ends = sorted(last.items(), key=lambda row: row[1])
    location = 0

    def make(k: int) -> Iterator[Stated]:
        nonlocal location
        time_ns, gone = int(rows.times_ns[k]), []
        while location < len(ends) and ends[location][1] < time_ns:
            gone.append(keys[ends[location][0]])
            location += 1
        boxes = tuple(_cuboid(annotations[owner], keys[owner], row, frame_id, angles) for owner, row in rows.at(k))
        yield topic, Boxes3DRecord(time_ns, boxes, tuple(gone))

    return Stream(rows.times_ns, make)


def _cuboid(annotation: CuboidAnnotation, key: str, row: int, frame_id: str, angles: CuboidAngles) -> Box3D:
    values = annotation.path.values[row]
    rotation = angles.quaternions(values[6:])
    return Box3D(key, frame_id, values[3:6], rotation, values[:3], annotation.label)


def box_2d_stream(annotations: Sequence[Box2DAnnotation], keys: Sequence[str], topic: str, frame_id: str) -> Stream:
    """Draw boxes into the images of a camera at each of their times."""
    rows = _Rows.of(annotations)

    def make(k: int) -> Iterator[Stated]:
        boxes = []
        for owner, row in rows.at(k):
            left, top, width, height = annotations[owner].path.values[row].tolist()
            boxes.append(Box2D(keys[owner], (left, top, width, height), annotations[owner].label))
        yield topic, Boxes2DRecord(int(rows.times_ns[k]), frame_id, tuple(boxes))

    return Stream(rows.times_ns, make)
