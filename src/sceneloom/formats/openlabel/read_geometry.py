"""Elements of data with a location as annotations.

Source: ASAM OpenLABEL 1.0.0: a cuboid is x y z, a quaternion x y z w or Euler angles rx ry rz [rad], and sizes; of the
angles the order is that of the reference program VCD, Rz Ry Rx. A bbox is its centre and its size, an rbbox has an
angle [rad] from x to y.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.openlabel.collection import Stated
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.systems import Systems
from sceneloom.formats.openlabel.transforms import rotation_from_euler, unit_quaternions
from sceneloom.formats.openlabel.words import ABSOLUTE, RELATIVE
from sceneloom.geometry.rotations import multiply_quaternions, quaternion_from_matrix, rotate_vectors
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations.shapes import ShapeAnnotation, ShapeType, VertexPath
from sceneloom.scene.types import Identifier

RBBOX = "rbbox"
"""Further field of a path: the rotated boxes that its polygons were made of, rows x y w h angle."""

Geometry = CuboidAnnotation | Box2DAnnotation | ShapeAnnotation
_ANGLES = CuboidAngles()


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """The rows of one element of data, in the order of their times.

    Attributes:
        stated: at least one; of a location that holds always, the only one.
        timestamps_ns: (N,) int64 [ns].
        system: the coordinate system that they name, or None.
        systems: all of them.
        camera: the sensor of what is drawn in images.
        fields: of the annotation.
    """

    stated: tuple[Stated, ...]
    timestamps_ns: Int64Array
    system: str | None
    systems: Systems
    camera: Identifier
    fields: Mapping[str, Any]

    def in_root(self, points: Sequence[Float64Array]) -> tuple[Float64Array, ...]:
        """Bring (V, 3) locations of each row into the root of their coordinate system."""
        if self.system is None or len(self.systems.chain(self.system)) == 1:
            return tuple(points)
        positions, quaternions = self.systems.root_from(self.system, self.timestamps_ns)
        moved = zip(points, positions, quaternions, strict=True)
        return tuple(rotate_vectors(quaternion, one) + position for one, position, quaternion in moved)

    def rotated_to_root(self, quaternions_xyzw: Float64Array) -> Float64Array:
        """Bring (N, 4) rotations into the root."""
        if self.system is None or len(self.systems.chain(self.system)) == 1:
            return quaternions_xyzw
        return multiply_quaternions(
            self.systems.root_from(self.system, self.timestamps_ns)[1], quaternions_xyzw
        )


def _cuboid(rows: Rows) -> Geometry:
    parts = [row.part.need("val") for row in rows.stated]
    values = [part.numbers((9, 10)) for part in parts]
    quaternions = unit_quaternions(parts, [_quaternion(*one) for one in zip(parts, values, strict=True)])
    angles = _ANGLES.from_quaternions(rows.rotated_to_root(quaternions))
    locations = np.concatenate(rows.in_root([np.array([one[:3]]) for one in values]))
    values_9 = np.concatenate([np.array([one[-3:] for one in values]), locations, angles], axis=1)
    return CuboidAnnotation(path=CuboidPath(rows.timestamps_ns, values_9), **rows.fields)


def _quaternion(part: Part, values: list[float]) -> list[float]:
    """The quaternion of a row, x y z w, which has it, or the Euler angles of one."""
    if len(values) == 10:
        return values[3:7]
    return [*map(float, quaternion_from_matrix(rotation_from_euler(part, values[5:2:-1], "ZYX")))]


def _bbox(rows: Rows) -> Geometry:
    values = np.array([row.part.need("val").numbers((4,)) for row in rows.stated])
    boxes = np.concatenate([values[:, :2] - values[:, 2:] / 2, values[:, 2:]], axis=1)
    return Box2DAnnotation(sensor_id=rows.camera, path=BoxPath(rows.timestamps_ns, boxes), **rows.fields)


def _rbbox(rows: Rows) -> Geometry:
    values = [row.part.need("val").numbers((5,)) for row in rows.stated]
    corners = tuple(_rotated_corners(*one) for one in values)
    path = VertexPath(rows.timestamps_ns, corners, extras=MappingProxyType({RBBOX: values}))
    return ShapeAnnotation(type=ShapeType.POLYGON_2D, path=path, sensor_id=rows.camera, **rows.fields)


def _rotated_corners(x: float, y: float, width: float, height: float, angle: float) -> Float64Array:
    halves = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (width / 2, height / 2)
    cosine, sine = np.cos(angle), np.sin(angle)
    corners: Float64Array = halves @ np.array([[cosine, sine], [-sine, cosine]]) + (x, y)
    return corners


def _poly2d(rows: Rows) -> Geometry:
    vertices = tuple(_vertices_2d(row.part) for row in rows.stated)
    kind = ShapeType.POLYGON_2D if _is_closed(rows) else ShapeType.POLYLINE_2D
    path = VertexPath(rows.timestamps_ns, vertices)
    return ShapeAnnotation(type=kind, path=path, sensor_id=rows.camera, **rows.fields)


def _vertices_2d(part: Part) -> Float64Array:
    mode = part.get("mode")
    if mode is not None and mode.value not in {ABSOLUTE, RELATIVE}:
        raise mode.fault(f"{ABSOLUTE} or {RELATIVE}; chain codes are not read")
    values = np.array(part.need("val").numbers())
    if len(values) % 2:
        raise DataError(part.file, f"{part.location}.val", f"{len(values)} numbers; expected pairs")
    vertices = values.reshape(-1, 2)
    return np.cumsum(vertices, axis=0) if mode is not None and mode.value == RELATIVE else vertices


def _poly3d(rows: Rows) -> Geometry:
    vertices = []
    for row in rows.stated:
        values = row.part.need("val").numbers()
        if len(values) % 3:
            problem = f"{len(values)} numbers; expected triples"
            raise DataError(row.part.file, f"{row.part.location}.val", problem)
        vertices.append(np.array(values).reshape(-1, 3))
    kind = ShapeType.POLYGON if _is_closed(rows) else ShapeType.POLYLINE
    return ShapeAnnotation(
        type=kind, path=VertexPath(rows.timestamps_ns, rows.in_root(vertices)), **rows.fields
    )


def _is_closed(rows: Rows) -> bool:
    return bool(rows.stated[0].part.members().get("closed"))


def _point2d(rows: Rows) -> Geometry:
    vertices = tuple(np.array([row.part.need("val").numbers((2,))]) for row in rows.stated)
    return ShapeAnnotation(
        type=ShapeType.POINT_2D,
        path=VertexPath(rows.timestamps_ns, vertices),
        sensor_id=rows.camera,
        **rows.fields,
    )


def _point3d(rows: Rows) -> Geometry:
    vertices = [np.array([row.part.need("val").numbers((3,))]) for row in rows.stated]
    return ShapeAnnotation(
        type=ShapeType.POINT, path=VertexPath(rows.timestamps_ns, rows.in_root(vertices)), **rows.fields
    )


READERS: Mapping[str, Callable[[Rows], Geometry]] = MappingProxyType(
    {
        "cuboid": _cuboid,
        "bbox": _bbox,
        "rbbox": _rbbox,
        "poly2d": _poly2d,
        "poly3d": _poly3d,
        "point2d": _point2d,
        "point3d": _point3d,
    }
)
"""What makes an annotation of the rows of each type of data."""

IN_IMAGES = ("bbox", "rbbox", "poly2d", "point2d")
"""Types of data that are drawn in the images of a camera."""
