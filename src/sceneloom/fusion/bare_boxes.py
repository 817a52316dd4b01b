"""Records of tables 7 and 8 that come alone: gathered until their frame is whole."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.fusion.messages.boxes import COLUMNS_2D, COLUMNS_3D, Box2d, Box3d, Boxes2d, Boxes3d
from sceneloom.fusion.messages.columns import Column
from sceneloom.fusion.setting import Setting

MOST_BOXES = 100_000
"""Boxes of one frame: a sender that never begins another is stopped."""

_COLUMNS: dict[type, tuple[Column, ...]] = {Boxes3d: COLUMNS_3D, Boxes2d: COLUMNS_2D}


def seq_of(box: Box3d | Box2d) -> int:
    """The number of the frame that a box belongs to."""
    return box.points_seq if isinstance(box, Box3d) else box.image_seq


@dataclass(slots=True)
class BareBoxes:
    """The boxes of one sensor that came one by one.

    A frame is whole as soon as a box of another frame comes, or none came for a while.

    Attributes:
        sensor_id: the sensor.
        setting: the configuration in force when the first box of the frame came.
        boxes: those of the frame that is not whole yet.
        latest_s: when the last one came, on the clock that the caller keeps [s].
    """

    sensor_id: int
    setting: Setting
    boxes: list[Box3d | Box2d] = field(default_factory=list)
    latest_s: float = 0.0

    def begins(self, box: Box3d | Box2d) -> bool:
        """Whether a box is the first of another frame than those before."""
        return not self.boxes or seq_of(self.boxes[0]) != seq_of(box)

    def add(self, box: Box3d | Box2d, now_s: float) -> None:
        """Keep a box of the frame that is not whole yet."""
        self.boxes.append(box)
        self.latest_s = now_s

    def close(self) -> Boxes3d | Boxes2d | None:
        """Give what was gathered as a whole frame; None where there is nothing."""
        if not self.boxes:
            return None
        lists = [box.alone(self.sensor_id) for box in self.boxes]
        self.boxes = []
        return joined(lists)


def joined(lists: list[Boxes3d | Boxes2d]) -> Boxes3d | Boxes2d:
    """Put lists of one frame together; the first says the time."""
    first = lists[0]
    columns: dict[str, Any] = {}
    for column in _COLUMNS[type(first)]:
        parts = [getattr(boxes, column.attribute) for boxes in lists]
        if column.optional and any(part is None for part in parts):
            columns[column.attribute] = None
        else:
            columns[column.attribute] = np.concatenate(parts)
    names = tuple(name for boxes in lists for name in boxes.class_names)
    return replace(first, class_names=names, **columns)
