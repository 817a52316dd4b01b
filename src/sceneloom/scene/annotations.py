"""What people and programs say about a scene: annotations and attributes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, check_array
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class CuboidPath:
    """A box over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 9) float64, rows `dx dy dz px py pz roll pitch yaw` exactly as stored: sizes and world position
            [m]; the unit and order of the angles are the scene's `metadata["sceneloom"]` euler entries.

    Source: "Cuboid Annotation" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array

    def __post_init__(self) -> None:
        count = check_array("cuboid.path.timestamps_ns", self.timestamps_ns, (None,), np.int64)
        check_array("cuboid.path.values", self.values, (count, 9), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class CuboidAnnotation:
    """An object as a box.

    Attributes:
        id: unique among the scene's annotations.
        path: the box over time.
        label: the object's class, or None.
        stationary: whether the object stands still; None where not said.
        parent_id: id of the parent annotation, or None.
        extras: every other field of the file, by name, times in nanoseconds.
    """

    id: Identifier
    path: CuboidPath
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> str:
        """`cuboid`."""
        return "cuboid"


@dataclass(frozen=True, slots=True, eq=False)
class PlainAnnotation:
    """An annotation of any other type, its fields as the file has them, times in nanoseconds.

    Attributes:
        id: unique among the scene's annotations.
        type: the file's own word.
        fields: all fields but `id` and `type`.
    """

    id: Identifier
    type: str
    fields: Mapping[str, Any]


Annotation = CuboidAnnotation | PlainAnnotation
