"""Boxes of messages as annotations: of one object all that carry its id."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.formats.topics.locations import Locations
from sceneloom.formats.topics.records import Box2D, Box3D, Boxes2DRecord, Boxes3DRecord
from sceneloom.formats.topics.survey import Survey
from sceneloom.geometry.rotations import multiply_quaternions, normalise_quaternion, rotate_vectors
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.warnings import WarningKind

Key = tuple[str, str]
"""Topic and id of an object."""


@dataclass(slots=True)
class Track:
    """The boxes of one object in the order of the messages."""

    times_ns: list[int] = field(default_factory=list)
    boxes: list[Any] = field(default_factory=list)

    def first_rows(self) -> Int64Array:
        """Rows in the order of time, the last one of several with one time, as a drawing replaces the one before."""
        times = np.array(self.times_ns, np.int64)
        _, rows = np.unique(times[::-1], return_index=True)
        return (len(times) - 1 - rows).astype(np.int64)

    @property
    def label(self) -> str | None:
        """The class that is stated first."""
        return next((box.label for box in self.boxes if box.label), None)


def gather(
    topic: str, records: Iterable[Boxes3DRecord | Boxes2DRecord], survey: Survey, *, by_frame: bool = False
) -> dict[Key, Track]:
    """Collect the boxes of each object; a box without an id is an object of its own."""
    tracks: dict[Key, Track] = {}
    nameless = others = 0
    for record in records:
        others += record.no_boxes
        for box in record.boxes:
            identifier = box.id
            if not identifier:
                nameless += 1
                identifier = f"{topic.strip('/')}/{nameless}"
            where = f"{topic}:{record.frame_id}" if by_frame and isinstance(record, Boxes2DRecord) else topic
            track = tracks.setdefault((where, identifier), Track())
            track.times_ns.append(record.timestamp_ns)
            track.boxes.append(box)
    location = f"{survey.log.name}: {topic}"
    if others:
        survey.ledger.note(
            WarningKind.SKIPPED, "plots-not-read", location, "plots that are no boxes", count=others
        )
    if nameless:
        message = "boxes without an id; each is an object of its own"
        survey.ledger.note(WarningKind.ASSUMED, "boxes-without-id", location, message, count=nameless)
    return tracks


def annotation_ids(keys: Sequence[Key]) -> list[str]:
    """Ids of annotations: those of the objects, with the topic where several topics or frames have the same."""
    seen: dict[str, int] = {}
    for _, identifier in keys:
        seen[identifier] = seen.get(identifier, 0) + 1
    return [name if seen[name] == 1 else f"{topic.strip('/')}/{name}" for topic, name in keys]


def cuboid(
    identifier: str | int, track: Track, locations: Locations, survey: Survey, location: str
) -> CuboidAnnotation | None:
    """Make the cuboid of an object; None where none of its boxes can be placed in the world."""
    rows = track.first_rows()
    times = np.array(track.times_ns, np.int64)[rows]
    boxes: list[Box3D] = [track.boxes[row] for row in rows.tolist()]
    centers = np.array([box.center for box in boxes]).reshape(-1, 3)
    rotations = np.array([box.quaternion_xyzw for box in boxes]).reshape(-1, 4)
    sizes = np.array([box.size_lwh for box in boxes]).reshape(-1, 3)
    sound = ~lengths_of(rotations)[1]
    sound &= np.isfinite(np.hstack([centers, rotations, sizes])).all(axis=1)
    _note(survey, sound, "boxes-at-fault", location, "boxes without a location, size or orientation")
    placed = np.zeros(len(boxes), np.bool_)
    for frame in dict.fromkeys(box.frame_id for box in boxes):
        same = np.array([box.frame_id == frame for box in boxes]) & sound
        if same.any():
            with np.errstate(over="ignore", invalid="ignore"):
                placed[same] = _to_world(centers, rotations, same, times, frame, locations)
    placed &= np.isfinite(centers).all(axis=1)
    _note(
        survey,
        placed | ~sound,
        "boxes-not-placed",
        location,
        "boxes in frames that are not placed in the world then",
    )
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


def box_2d(identifier: str | int, sensor_id: str | int, track: Track) -> Box2DAnnotation:
    """Make the box of an object in the images of a camera."""
    rows = track.first_rows()
    boxes: list[Box2D] = [track.boxes[row] for row in rows.tolist()]
    times = np.array(track.times_ns, np.int64)[rows]
    values = np.array([box.box_ltwh for box in boxes], np.float64).reshape(-1, 4)
    return Box2DAnnotation(
        identifier, sensor_id, BoxPath(times, values), track.label, attributes=_attributes(times, boxes)
    )


def _attributes(times: Int64Array, boxes: Sequence[Any]) -> tuple[AttributePath, ...]:
    """What is stated for an object beside its class, where it changes."""
    names = dict.fromkeys(name for box in boxes for name in box.reported)
    return tuple(_attribute(name, times, [box.reported.get(name) for box in boxes]) for name in names)


def _attribute(name: str, times: Int64Array, values: Sequence[str | None]) -> AttributePath:
    changes = [
        k for k, value in enumerate(values) if value is not None and (k == 0 or values[k - 1] != value)
    ]
    numbers = np.array(changes, np.int64)
    return AttributePath(name, tuple(_value(values[k]) for k in changes), times[numbers])


def _value(text: str | None) -> Any:
    """A number where the text is one."""
    try:
        number = float(text or "")
    except ValueError:
        return text
    return int(number) if number.is_integer() and abs(number) < 2**53 else number
