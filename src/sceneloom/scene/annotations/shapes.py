"""Lines, areas and points, in images and in space."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, as_array, check_array, check_count, hold_array
from sceneloom.errors import ArrayError
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS, Identifier


class ShapeType(StrEnum):
    """The shapes of the format, in its words; `point` and `point_topdown` are those of Scale's library."""

    POLYLINE_2D = "polyline_2d"
    POLYGON_2D = "polygon_2d"
    POINT_2D = "point_2d"
    POLYGON = "polygon"
    POLYGON_TOPDOWN = "polygon_topdown"
    POLYLINE = "polyline"
    POINT = "point"
    POINT_TOPDOWN = "point_topdown"


DIMENSIONS: Mapping[ShapeType, int] = MappingProxyType(
    {kind: 2 if kind.value.endswith("_2d") else 3 for kind in ShapeType}
)
"""How many numbers a vertex has: pixels in an image, or a location in the world."""


@dataclass(frozen=True, slots=True, eq=False)
class VertexPath:
    """The vertices of a shape over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        vertices: N arrays (V, D) float64, V of each its own: pixels in the corner convention [px] (D = 2), or locations
            in the scene's world [m] (D = 3).
        extras: further fields of the file, by name.

    Source: "AnnotationPath" of the SFS description, whose rows are these vertices one after another.
    """

    timestamps_ns: Int64Array
    vertices: tuple[Float64Array, ...]
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "path.timestamps_ns", (None,), np.int64)
        check_count("path.vertices", self.vertices, count)
        if not all(isinstance(vertices, np.ndarray) for vertices in self.vertices):
            held = tuple(as_array("path.vertices", v, (None, None), np.float64) for v in self.vertices)
            object.__setattr__(self, "vertices", held)


@dataclass(frozen=True, slots=True, eq=False)
class ShapeAnnotation:
    """A line, an area or a point; other fields as in `CuboidAnnotation`.

    Attributes:
        type: which shape.
        path: its vertices over time.
        sensor_id: the camera of a shape in images (then required), or the only sensor that one in space is for.
        is_closed: whether the last vertex of a `polyline` is joined to the first; None where not stated.
    """

    id: Identifier
    type: ShapeType
    path: VertexPath
    sensor_id: Identifier | None = None
    is_closed: bool | None = None
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        columns = DIMENSIONS[self.type]
        for k, vertices in enumerate(self.path.vertices):
            check_array(f"path.vertices[{k}]", vertices, (None, columns), np.float64)
        if columns == 2 and self.sensor_id is None:
            raise ArrayError(f"sensor_id: missing; a {self.type} is drawn in the images of a camera")

    @property
    def dimensions(self) -> int:
        """2 in images, 3 in the world."""
        return DIMENSIONS[self.type]
