"""Boxes drawn into images."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, hold_array
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class BoxPath:
    """A box in an image over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 4) float64 [px], rows `left top width height` in the corner convention: the image's corner is
            (0, 0).
        extras: further fields of the file, by name.

    Source: "2D Box Annotation" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "path.timestamps_ns", (None,), np.int64)
        hold_array(self, "path.values", (count, 4), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Box2DAnnotation:
    """An object as a box in the images of one camera; fields as in `CuboidAnnotation`.

    Attributes:
        sensor_id: the camera.
        path: the box over time.
    """

    id: Identifier
    sensor_id: Identifier
    path: BoxPath
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> str:
        """`box_2d`."""
        return "box_2d"
