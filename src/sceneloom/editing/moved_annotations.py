"""Annotations in another frame, each at its own times."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.editing.frame_change import FrameChange
from sceneloom.editing.keyframes import Keyframer
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.corrections import LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath
from sceneloom.scene.annotations.keypoints import PointPath, PointProjection, PointsAnnotation, locations_of
from sceneloom.scene.annotations.shapes import ShapeAnnotation, VertexPath
from sceneloom.scene.at import cuboid_at, point_at, shape_at


@dataclass(frozen=True, slots=True, eq=False)
class AnnotationMover:
    """Takes annotations into another frame.

    Attributes:
        keyframer: knows the change, and chooses the keyframes.
        angles: how the angles of cuboids are meant.
        adjustments: `new_from_corrected` and `old_from_new` around a localization adjustment; None leaves those.
    """

    keyframer: Keyframer
    angles: CuboidAngles
    adjustments: Callable[[LocalizationAdjustment], LocalizationAdjustment | None] | None = None

    @property
    def change(self) -> FrameChange:
        """`new_from_old`."""
        return self.keyframer.change

    def moved(self, annotations: Iterable[Annotation]) -> tuple[Annotation, ...]:
        """Give the annotations in the new frame; those that are nowhere known there are left out."""
        found = [self._moved(annotation) for annotation in annotations]
        return tuple(annotation for annotation in found if annotation is not None)

    def _moved(self, annotation: Annotation) -> Annotation | None:
        if isinstance(annotation, LocalizationAdjustment):
            return annotation if self.adjustments is None else self.adjustments(annotation)
        move = next((move for kind, move in _MOVES.items() if isinstance(annotation, kind)), None)
        return annotation if move is None else move(self, annotation)

    def cuboid_rows(self, times_ns: Int64Array, rows: Float64Array) -> Float64Array:
        """Take rows (M, 9) of cuboids, row k at time k, of whose angles those nearest to the old ones are given."""
        new = self.change.poses(times_ns, rows[:, 3:6], self.angles.quaternions(rows[:, 6:]))
        angles = self.angles.from_quaternions(new.quaternions_xyzw, near=rows[:, 6:])
        return np.concatenate([rows[:, :3], new.positions, angles], axis=1)

    def seen_rows(self, times_ns: Int64Array, rows: Float64Array | None) -> Float64Array | None:
        """The same of rows some of which are NaN, for null; None of None."""
        if rows is None:
            return None
        moved = np.full(rows.shape, np.nan)
        there = np.flatnonzero(np.isfinite(rows).all(axis=1))
        moved[there] = self.cuboid_rows(times_ns[there], rows[there])
        return moved


def _moved_cuboid(mover: AnnotationMover, annotation: CuboidAnnotation) -> CuboidAnnotation | None:
    key = (type(annotation.id), annotation.id, 0)
    path, keyframer, angles = annotation.path, mover.keyframer, mover.angles
    if len(path.timestamps_ns):
        own = keyframer.own_rows(key, path.timestamps_ns)
        timestamps_ns = path.timestamps_ns[own]
        old = replace(annotation, path=CuboidPath(timestamps_ns, path.values[own], path.extras))

        def sample(times_ns: Int64Array) -> tuple[Float64Array, Float64Array]:
            rows = cuboid_at(old, times_ns, angles=angles)[0]
            return rows[:, None, 3:6], angles.quaternions(rows[:, 6:])

        times_ns = keyframer.times(key, timestamps_ns, stationary=bool(annotation.stationary), sample=sample)
        if len(times_ns) == 0:
            return None
        rows = cuboid_at(old, times_ns, angles=angles)[0]
        path = CuboidPath(times_ns, mover.cuboid_rows(times_ns, rows), path.extras)
    return replace(
        annotation,
        path=path,
        stationary=keyframer.stationary(key, was=annotation.stationary),
        activations=tuple(_seen(mover, entry) for entry in annotation.activations),
        projections=tuple(_seen(mover, entry) for entry in annotation.projections),
    )


def _seen(mover: AnnotationMover, entry: Any) -> Any:
    """Of an activation or a projection the cuboids, as the sensor's own time has them."""
    return replace(entry, cuboids=mover.seen_rows(entry.timestamps_ns, entry.cuboids))


def _moved_shape(mover: AnnotationMover, annotation: ShapeAnnotation) -> ShapeAnnotation | None:
    if annotation.dimensions == 2 or len(annotation.path.timestamps_ns) == 0:
        return annotation
    key = (type(annotation.id), annotation.id, 0)
    path, keyframer = annotation.path, mover.keyframer
    own = keyframer.own_rows(key, path.timestamps_ns)
    timestamps_ns = path.timestamps_ns[own]
    old = replace(
        annotation, path=VertexPath(timestamps_ns, tuple(path.vertices[k] for k in own.tolist()), path.extras)
    )
    counts = {len(vertices) for vertices in old.path.vertices}

    def sample(times_ns: Int64Array) -> tuple[Float64Array, None]:
        # vertices that come and go are at no location between keyframes
        if len(counts) > 1:
            return np.zeros((len(times_ns), 0, 3)), None
        found = shape_at(old, times_ns)
        nowhere = np.full((next(iter(counts)), 3), np.nan)
        return np.stack([nowhere if vertices is None else vertices for vertices in found]), None

    times_ns = keyframer.times(key, timestamps_ns, stationary=bool(annotation.stationary), sample=sample)
    if len(times_ns) == 0:
        return None
    found = [vertices for vertices in shape_at(old, times_ns) if vertices is not None]
    vertices = tuple(
        mover.change.locations(times_ns[k : k + 1], shape[None])[0] for k, shape in enumerate(found)
    )
    return replace(
        annotation,
        path=VertexPath(times_ns, vertices, path.extras),
        stationary=keyframer.stationary(key, was=annotation.stationary),
    )


def _moved_points(mover: AnnotationMover, annotation: PointsAnnotation) -> PointsAnnotation | None:
    stationary = bool(annotation.stationary)
    paths = tuple(
        _moved_point(mover, annotation, number, path, stationary=stationary)
        for number, path in enumerate(annotation.paths)
    )
    if annotation.paths and not any(len(path.timestamps_ns) for path in paths):
        return None
    first = (type(annotation.id), annotation.id, 0)
    return replace(
        annotation,
        paths=paths,
        stationary=mover.keyframer.stationary(first, was=annotation.stationary),
        projections=tuple(
            tuple(_seen_point(mover, entry) for entry in entries) for entries in annotation.projections
        ),
    )


def _moved_point(
    mover: AnnotationMover, annotation: PointsAnnotation, number: int, path: PointPath, *, stationary: bool
) -> PointPath:
    key = (type(annotation.id), annotation.id, number)
    if len(path.timestamps_ns) == 0 or path.values.shape[1] % 3:
        return path
    own = mover.keyframer.own_rows(key, path.timestamps_ns)
    old = replace(path, timestamps_ns=path.timestamps_ns[own], values=path.values[own])

    def locations(times_ns: Int64Array) -> Float64Array:
        return locations_of(point_at(old, times_ns, stationary=stationary)[0])

    times_ns = mover.keyframer.times(
        key, old.timestamps_ns, stationary=stationary, sample=lambda times: (locations(times), None)
    )
    moved = mover.change.locations(times_ns, locations(times_ns))
    return replace(path, timestamps_ns=times_ns, values=moved.reshape(len(times_ns), path.values.shape[1]))


def _seen_point(mover: AnnotationMover, entry: PointProjection) -> PointProjection:
    if entry.positions is None:
        return entry
    return replace(entry, positions=mover.change.locations(entry.timestamps_ns, entry.positions))


_MOVES: Mapping[type, Callable[[AnnotationMover, Any], Annotation | None]] = MappingProxyType(
    {CuboidAnnotation: _moved_cuboid, ShapeAnnotation: _moved_shape, PointsAnnotation: _moved_points}
)
"""How the annotations that have a location in space are moved; the others have none."""
