"""Cuboids and boxes in images as plots of messages."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.topics.records import Box2D, Box3D, Boxes2DRecord, Boxes3DRecord
from sceneloom.formats.topics.streams import Stated, Stream
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation

Drawn = CuboidAnnotation | Box2DAnnotation


def keys_of(annotations: Sequence[Annotation]) -> list[str]:
    """Ids of annotations as texts that differ from each other."""
    taken: dict[str, int] = {}
    keys = []
    for annotation in annotations:
        key = str(annotation.id) or "annotation"
        taken[key] = taken.get(key, 0) + 1
        keys.append(key if taken[key] == 1 else f"{key}~{taken[key]}")
    return keys


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """All rows of some annotations in the order of time: whose each is, and which of its own."""

    times_ns: Int64Array
    owners: Int64Array
    rows: Int64Array
    starts: Int64Array

    @classmethod
    def of(cls, annotations: Sequence[Drawn]) -> "_Rows":
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
        boxes = tuple(
            _cuboid(annotations[owner], keys[owner], row, frame_id, angles) for owner, row in rows.at(k)
        )
        yield topic, Boxes3DRecord(time_ns, boxes, tuple(gone))

    return Stream(rows.times_ns, make)


def _cuboid(annotation: CuboidAnnotation, key: str, row: int, frame_id: str, angles: CuboidAngles) -> Box3D:
    values = annotation.path.values[row]
    rotation = angles.quaternions(values[6:])
    return Box3D(key, frame_id, values[3:6], rotation, values[:3], annotation.label)


def box_2d_stream(
    annotations: Sequence[Box2DAnnotation], keys: Sequence[str], topic: str, frame_id: str
) -> Stream:
    """Draw boxes into the images of a camera at each of their times."""
    rows = _Rows.of(annotations)

    def make(k: int) -> Iterator[Stated]:
        boxes = tuple(
            Box2D(keys[owner], _ltwh(annotations[owner], row), annotations[owner].label)
            for owner, row in rows.at(k)
        )
        yield topic, Boxes2DRecord(int(rows.times_ns[k]), frame_id, boxes)

    return Stream(rows.times_ns, make)


def _ltwh(annotation: Box2DAnnotation, row: int) -> tuple[float, float, float, float]:
    left, top, width, height = annotation.path.values[row].tolist()
    return left, top, width, height
