"""Points of lidar frames that belong to one object or one class."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import UInt32Array, hold_array
from sceneloom.errors import ArrayError
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class LabeledPoints:
    """Which points of one sensor, or of one of its frames.

    Attributes:
        sensor_id: the sensor.
        point_ids: (N,) uint32, rows of its points.
        sensor_frame: number of the frame; None: the whole sensor, as for a map.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    point_ids: UInt32Array
    sensor_frame: int | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_array(self, "point_ids", (None,), np.uint32)


@dataclass(frozen=True, slots=True, eq=False)
class LabeledPointsAnnotation:
    """An object or a class as the points that belong to it; other fields as in `CuboidAnnotation`.

    Attributes:
        labeled_points: by sensor and frame.
        is_instance: whether it is one object and not a class; None where not stated.
        type: `labeled_points`, or `point_segmentation`, Scale's other word for it.

    Source: "Labeled Points Annotation" of the SFS description.
    """

    id: Identifier
    labeled_points: tuple[LabeledPoints, ...]
    label: str | None = None
    is_instance: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    type: str = "labeled_points"

    def __post_init__(self) -> None:
        if self.type not in LABELED_POINTS_TYPES:
            raise ArrayError(f"type {self.type!r}; expected one of {', '.join(LABELED_POINTS_TYPES)}")


LABELED_POINTS_TYPES = ("labeled_points", "point_segmentation")
"""The words that files have for such an annotation."""
