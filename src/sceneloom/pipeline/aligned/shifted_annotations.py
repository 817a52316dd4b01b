"""Annotations seen from another origin of the world; the axes stay."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

from sceneloom.arrays import Float64Array, read_only
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation, Projection
from sceneloom.scene.annotations.keypoints import PointPath, PointProjection, PointsAnnotation
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation

WithCuboids = TypeVar("WithCuboids", Activation, Projection)


def annotation_can_move(annotation: Annotation) -> bool:
    """Whether all that an annotation says about locations can be seen from another origin.

    An adjustment acts on the world or leads from the ego to it, which its file does not state; what an unknown type
    says is not known.
    """
    return not isinstance(annotation, LocalizationAdjustment | PlainAnnotation)


def moved_annotation(annotation: Annotation, origin_world: Float64Array) -> Annotation:
    """Give an annotation of a world whose origin is at (3,) float64 [m] of the old one."""
    move = _MOVES.get(type(annotation))
    return annotation if move is None else move(annotation, origin_world)


def _moved_cuboid(cuboid: CuboidAnnotation, origin_world: Float64Array) -> CuboidAnnotation:
    rows = _moved_rows(cuboid.path.values, origin_world)
    return replace(
        cuboid,
        path=replace(cuboid.path, values=rows),
        activations=tuple(_with_moved_cuboids(part, origin_world) for part in cuboid.activations),
        projections=tuple(_with_moved_cuboids(part, origin_world) for part in cuboid.projections),
    )


def _with_moved_cuboids(part: WithCuboids, origin_world: Float64Array) -> WithCuboids:
    if part.cuboids is None:
        return part
    return replace(part, cuboids=_moved_rows(part.cuboids, origin_world))


def _moved_rows(cuboids: Float64Array, origin_world: Float64Array) -> Float64Array:
    moved = cuboids.copy()
    moved[:, 3:6] -= origin_world
    return read_only(moved)


def _moved_shape(shape: ShapeAnnotation, origin_world: Float64Array) -> ShapeAnnotation:
    if shape.dimensions != 3:
        return shape
    vertices = tuple(read_only(locations - origin_world) for locations in shape.path.vertices)
    return replace(shape, path=replace(shape.path, vertices=vertices))


def _moved_points(points: PointsAnnotation, origin_world: Float64Array) -> PointsAnnotation:
    return replace(
        points,
        paths=tuple(_moved_path(path, origin_world) for path in points.paths),
        projections=tuple(
            tuple(_moved_projection(projection, origin_world) for projection in of_point)
            for of_point in points.projections
        ),
    )


def _moved_path(path: PointPath, origin_world: Float64Array) -> PointPath:
    shape = path.values.shape
    return replace(path, values=read_only((path.values.reshape(-1, 3) - origin_world).reshape(shape)))


def _moved_projection(projection: PointProjection, origin_world: Float64Array) -> PointProjection:
    if projection.positions is None:
        return projection
    return replace(projection, positions=read_only(projection.positions - origin_world))


_MOVES: Mapping[type, Callable[[Any, Float64Array], Annotation]] = MappingProxyType(
    {CuboidAnnotation: _moved_cuboid, ShapeAnnotation: _moved_shape, PointsAnnotation: _moved_points}
)
"""How the annotations that state locations in the world move; the others state none."""
