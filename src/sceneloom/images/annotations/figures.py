"""What annotations look like at one time: lines, areas and marks, in the world or in the images of one camera."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any
from zlib import crc32

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.boxes import EDGES, box_corners
from sceneloom.images.canvas import Colour, leave_out
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation, ShapeType
from sceneloom.scene.at import active_at, attribute_at, box_2d_at, cuboid_poses, points_at, shape_at
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier

PALETTE: tuple[Colour, ...] = (
    (255, 122, 69), (82, 196, 255), (138, 226, 52), (255, 206, 84), (214, 137, 255), (64, 224, 190),
    (255, 110, 160), (168, 184, 255), (222, 222, 120), (255, 160, 122),
)  # fmt: skip
"""Colours that stand out from images and from each other."""

CORNER_FROM_CENTRE = 0.5
"""Boxes and vertices of files count from the image's corner, pixels that are drawn from the centre of the first."""


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """One annotation at one time.

    Attributes:
        name: what is written beside it.
        colour: what it is drawn in.
        lines: (K, D) vertices each, joined in order: locations [m] in the world (D = 3), or pixels [px] (D = 2).
        areas: (K, D) vertices each of areas to be tinted.
        marks: (M, D) single points.
        anchor: (D,) where its name goes, or None where there is nothing to see.
    """

    name: str
    colour: Colour
    lines: tuple[Float64Array, ...] = ()
    areas: tuple[Float64Array, ...] = ()
    marks: Float64Array | None = None
    anchor: Float64Array | None = None

    @property
    def is_finite(self) -> bool:
        """Whether all of it has a location."""
        parts = (*self.lines, *self.areas, *(() if self.marks is None else (self.marks,)))
        return all(bool(np.isfinite(part).all()) for part in parts)


def colour_of(annotation: Annotation) -> Colour:
    """Give annotations of one label one colour."""
    label = getattr(annotation, "label", None) or annotation.type
    return PALETTE[crc32(str(label).encode(errors="surrogatepass")) % len(PALETTE)]


def name_of(annotation: Annotation, timestamp_ns: int) -> str:
    """Write the label, or the id, and what attributes state at a time."""
    stated = [
        f"{attribute.name} {_value_text(value)}"
        for attribute in getattr(annotation, "attributes", ())
        for value in attribute_at(attribute, [timestamp_ns])
        if value is not None and attribute.sensor_id is None and attribute.point_index is None
    ]
    return " · ".join([str(getattr(annotation, "label", None) or annotation.id), *stated[:2]])


def figures_in_world(
    scene: Scene, timestamp_ns: int, *, sensor_id: Identifier | None = None
) -> Iterator[tuple[Annotation, Figure]]:
    """Give what has a location in the world at a time [ns]; cuboids as a sensor sees them, where one is named."""
    angles = CuboidAngles.of(scene)
    for annotation in scene.annotations:
        draw = _IN_WORLD.get(_key(annotation))
        if isinstance(annotation, CuboidAnnotation):
            figure = _cuboid(annotation, timestamp_ns, angles, sensor_id)
        else:
            figure = None if draw is None else draw(annotation, timestamp_ns, angles)
        if figure is not None:
            leave_out("annotations", not figure.is_finite)
            yield annotation, figure


def figures_in_image(
    scene: Scene, sensor_id: Identifier, timestamp_ns: int
) -> Iterator[tuple[Annotation, Figure]]:
    """Give what is drawn in the images of one camera at a time [ns], as pixels in the centre convention."""
    for annotation in scene.annotations:
        draw = _IN_IMAGE.get(_key(annotation))
        figure = None if draw is None else draw(annotation, sensor_id, timestamp_ns)
        if figure is not None:
            leave_out("annotations", not figure.is_finite)
            yield annotation, figure


def _key(annotation: Annotation) -> str:
    return str(annotation.type)


def _value_text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _cuboid(
    annotation: CuboidAnnotation,
    timestamp_ns: int,
    angles: CuboidAngles,
    sensor_id: Identifier | None = None,
) -> Figure | None:
    poses = cuboid_poses(annotation, [timestamp_ns], angles=angles, sensor_id=sensor_id)
    if not poses.there[0]:
        return None
    corners = box_corners(poses.centers_world[0], poses.sizes_lwh[0], poses.quaternions_xyzw[0])
    edges = tuple(corners[list(edge)] for edge in EDGES)
    nose = np.stack([corners[[0, 1, 2, 3]].mean(axis=0), corners[[0, 3]].mean(axis=0)])
    return _figure(annotation, timestamp_ns, lines=(*edges, nose), anchor=corners[4:].mean(axis=0))


def _figure(annotation: Annotation, timestamp_ns: int, **parts: Any) -> Figure:
    return Figure(name_of(annotation, timestamp_ns), colour_of(annotation), **parts)


_CLOSED = frozenset({ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYGON_2D})
_MARKS = frozenset({ShapeType.POINT, ShapeType.POINT_TOPDOWN, ShapeType.POINT_2D})


def _shape(annotation: ShapeAnnotation, timestamp_ns: int, vertices: Float64Array) -> Figure | None:
    if len(vertices) == 0:
        return None
    anchor = vertices.mean(axis=0)
    if annotation.type in _MARKS:
        return _figure(annotation, timestamp_ns, marks=vertices, anchor=anchor)
    round_ = annotation.type in _CLOSED
    line = np.concatenate([vertices, vertices[:1]]) if round_ or annotation.is_closed else vertices
    areas = (vertices,) if round_ and len(vertices) > 2 else ()
    return _figure(annotation, timestamp_ns, lines=(line,), areas=areas, anchor=anchor)


def _shape_in_world(annotation: ShapeAnnotation, timestamp_ns: int, _: CuboidAngles) -> Figure | None:
    vertices = shape_at(annotation, [timestamp_ns])[0]
    return None if vertices is None else _shape(annotation, timestamp_ns, vertices)


def _keypoints(annotation: PointsAnnotation, timestamp_ns: int, _: CuboidAngles) -> Figure | None:
    found = [rows[0].reshape(-1, 3) for rows, there in points_at(annotation, [timestamp_ns]) if there[0]]
    marks = np.concatenate(found) if found else np.zeros((0, 3))
    return (
        None if len(marks) == 0 else _figure(annotation, timestamp_ns, marks=marks, anchor=marks.mean(axis=0))
    )


def _shape_in_image(annotation: ShapeAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not same_id(annotation.sensor_id, sensor_id):
        return None
    vertices = shape_at(annotation, [timestamp_ns])[0]
    return None if vertices is None else _shape(annotation, timestamp_ns, vertices - CORNER_FROM_CENTRE)


def _box_in_image(annotation: Box2DAnnotation, sensor_id: Identifier, timestamp_ns: int) -> Figure | None:
    if not same_id(annotation.sensor_id, sensor_id):
        return None
    rows, there = box_2d_at(annotation, [timestamp_ns])
    return _rectangle(annotation, timestamp_ns, rows[0]) if there[0] else None


def _projected_cuboid(
    annotation: CuboidAnnotation, sensor_id: Identifier, timestamp_ns: int
) -> Figure | None:
    if not active_at(annotation, sensor_id, [timestamp_ns])[0]:
        return None
    for projection in annotation.projections:
        row = _nearest_row(projection.timestamps_ns, timestamp_ns)
        if same_id(projection.sensor_id, sensor_id) and row is not None and projection.boxes is not None:
            box = projection.boxes[row]
            return _rectangle(annotation, timestamp_ns, box) if np.isfinite(box).all() else None
    return None


def _projected_points(
    annotation: PointsAnnotation, sensor_id: Identifier, timestamp_ns: int
) -> Figure | None:
    seen = []
    for projections in annotation.projections:
        for projection in projections:
            row = _nearest_row(projection.timestamps_ns, timestamp_ns)
            if same_id(projection.sensor_id, sensor_id) and row is not None and projection.points is not None:
                seen.append(projection.points[row] - CORNER_FROM_CENTRE)
    marks = np.array([pixel for pixel in seen if np.isfinite(pixel).all()], np.float64).reshape(-1, 2)
    return None if len(marks) == 0 else _figure(annotation, timestamp_ns, marks=marks)


def _rectangle(annotation: Annotation, timestamp_ns: int, box: Float64Array) -> Figure:
    """A `left top width height` box as a closed line."""
    left, top = box[:2] - CORNER_FROM_CENTRE
    right, bottom = left + box[2], top + box[3]
    line = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
    return _figure(annotation, timestamp_ns, lines=(line,), anchor=line[0])


_NEARBY_NS = 60_000_000
"""How far from an image's time the timestamp of a projection may be to be drawn in it [ns]: half a frame at 8 Hz."""


def _nearest_row(timestamps_ns: Any, timestamp_ns: int) -> int | None:
    if len(timestamps_ns) == 0:
        return None
    row = int(np.argmin(np.abs(timestamps_ns - timestamp_ns)))
    return row if abs(int(timestamps_ns[row]) - timestamp_ns) <= _NEARBY_NS else None


def same_id(one: Identifier | None, other: Identifier | None) -> bool:
    """Whether two ids are the same; `1` is not `"1"`."""
    return one == other and type(one) is type(other)


def members_of(scene: Scene, parent_id: Identifier) -> Sequence[Annotation]:
    """The annotations that belong to another one."""
    return [a for a in scene.annotations if same_id(getattr(a, "parent_id", None), parent_id)]


_SHAPES_2D = (ShapeType.POLYLINE_2D, ShapeType.POLYGON_2D, ShapeType.POINT_2D)
_SHAPES_3D = (
    ShapeType.POLYGON, ShapeType.POLYGON_TOPDOWN, ShapeType.POLYLINE, ShapeType.POINT, ShapeType.POINT_TOPDOWN,
)  # fmt: skip

_IN_WORLD: Mapping[str, Callable[[Any, int, CuboidAngles], Figure | None]] = MappingProxyType(
    {"cuboid": _cuboid, "points": _keypoints, **{str(kind): _shape_in_world for kind in _SHAPES_3D}}
)
_IN_IMAGE: Mapping[str, Callable[[Any, Identifier, int], Figure | None]] = MappingProxyType(
    {
        "cuboid": _projected_cuboid,
        "points": _projected_points,
        "box_2d": _box_in_image,
        **{str(kind): _shape_in_image for kind in _SHAPES_2D},
    }
)
