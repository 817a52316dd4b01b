"""Labelled points of a scene as SemanticKITTI's numbers: one for each point of each sweep."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import UInt32Array
from sceneloom.formats.kitti.odometry.semantic_labels import CLASS_BITS, CLASS_NAMES, UNLABELED
from sceneloom.formats.loss import Loss, Support
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import key_of

_NUMBERS: Mapping[str, int] = {name: number for number, name in CLASS_NAMES.items()}
_KEPT = "semantic_kitti"
_LARGEST = (1 << CLASS_BITS) - 1


@dataclass(slots=True)
class PointLabels:
    """The labels of a lidar's sweeps.

    Attributes:
        parts: by number of the sweep, the numbers and the points that have them.
        losses: of annotations that have no number.
        lost_later: of points that have several labels, found while sweeps are written.
    """

    parts: dict[int, list[tuple[int, UInt32Array]]] = field(default_factory=lambda: defaultdict(list))
    losses: list[Loss] = field(default_factory=list)
    lost_later: list[Loss] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.parts)

    @classmethod
    def of(cls, scene: Scene, lidar: LidarSensor | None) -> "PointLabels":
        """Collect what a scene says of a lidar's points."""
        found = cls()
        instances: dict[int, int] = defaultdict(int)
        for annotation in scene.annotations:
            if isinstance(annotation, LabeledPointsAnnotation):
                value = found._value(annotation, instances)
                if value is not None:
                    found._add(annotation, value, lidar)
        return found

    def values(self, sweep: int, count: int) -> UInt32Array:
        """The labels of a sweep's points, (count,) uint32; of several of one point the last counts."""
        values = np.full(count, UNLABELED, np.uint32)
        repeated = beyond = 0
        for value, rows in self.parts.get(sweep, ()):
            inside = rows[rows < count]
            beyond += len(rows) - len(inside)
            repeated += int((values[inside] != UNLABELED).sum())
            values[inside] = value
        for lost, what in ((repeated, "a point has one label there: the last one"), (beyond, "of no point")):
            if lost:
                name = "annotations.labeled_points.labeled_points.point_ids"
                self.lost_later.append(Loss(field=name, what=what, count=lost))
        return values

    def _value(self, annotation: LabeledPointsAnnotation, instances: dict[int, int]) -> int | None:
        """The number of an annotation: as it was read, else that of its class, and a free one for an object."""
        kept = annotation.extras.get(_KEPT)
        if isinstance(kept, int) and 0 < kept < 1 << (2 * CLASS_BITS):
            return kept
        number = _class_number(annotation.label)
        if number is None:
            what = f"{annotation.label!r} left out: SemanticKITTI has no number for it"
            count = sum(len(part.point_ids) for part in annotation.labeled_points)
            self.losses.append(Loss(field="annotations.labeled_points", what=what, count=count))
            return None
        if not annotation.is_instance:
            return number
        instances[number] += 1
        if instances[number] > _LARGEST:
            return number
        what = "objects are called by numbers there"
        self.losses.append(Loss(field="annotations.labeled_points.id", what=what, support=Support.CONVERTED))
        return number | instances[number] << CLASS_BITS

    def _add(self, annotation: LabeledPointsAnnotation, value: int, lidar: LidarSensor | None) -> None:
        for part in annotation.labeled_points:
            is_here = lidar is not None and key_of(part.sensor_id) == key_of(lidar.id)
            if is_here and part.sensor_frame is not None:
                self.parts[part.sensor_frame].append((value, part.point_ids))
                continue
            what = "left out: points of another sensor, or of no sweep"
            name = "annotations.labeled_points.labeled_points"
            self.losses.append(Loss(field=name, what=what, count=len(part.point_ids)))
        for name, count in (
            ("attributes", len(annotation.attributes)),
            ("parent_id", int(annotation.parent_id is not None)),
            ("extras", len([key for key in annotation.extras if key != _KEPT])),
        ):
            if count:
                what = "left out: a label is a number"
                self.losses.append(Loss(field=f"annotations.labeled_points.{name}", what=what, count=count))


def _class_number(label: str | None) -> int | None:
    """The number of a class by its name in any case, or the number that it is called by."""
    if label is None:
        return None
    name = label.strip().lower().replace("_", "-").replace(" ", "-")
    if name.isascii() and name.isdigit() and 0 < int(name) <= _LARGEST:
        return int(name)
    number = _NUMBERS.get(name)
    return number or None
