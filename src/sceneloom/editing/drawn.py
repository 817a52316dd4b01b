"""What is drawn into images, when the images get another camera model: boxes, lines, areas and points follow."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded, unproject
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation, BoxPath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, Projection
from sceneloom.scene.annotations.keypoints import PointProjection, PointsAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation, VertexPath
from sceneloom.scene.types import Key, key_of

CORNER = 0.5
"""What is drawn counts from the image's corner, pixels from the centre of the first one."""

_SIDE = 9


class CameraModelChange:
    """From one camera model to another.

    Attributes:
        lost: how many drawn things were left out, since the new camera model does not see all of them, or the new image
            nothing.
    """

    def __init__(self, before: Camera, after: Camera) -> None:
        """Hold both camera models."""
        self._before, self._after = before, after
        self.lost = 0

    def pixels(self, locations: Float64Array) -> Float64Array:
        """Move (N, 2) locations in the corner convention; NaN where the new camera model has none."""
        rays: Float64Array = unproject(self._before, locations - CORNER)
        return project_unbounded(self._after, rays) + CORNER

    def shows(self, low: Float64Array, high: Float64Array) -> BoolArray:
        """Whether the new image shows anything from the least (N, 2) to the greatest (N, 2) locations."""
        size = (self._after.width, self._after.height)
        inside: BoolArray = np.all((high > 0.0) & (low < size), axis=1)
        return inside

    def boxes(self, boxes: Float64Array) -> Float64Array:
        """Move (N, 4) boxes `left top width height`: what bounds the moved outline.

        NaN where a part has no location, or the new image shows nothing of it.
        """
        along = np.linspace(0.0, 1.0, _SIDE)
        outline = np.concatenate(
            [np.stack(pair, axis=1) for pair in _sides(along, np.zeros(_SIDE), np.ones(_SIDE))]
        )
        locations = boxes[:, None, :2] + outline[None] * boxes[:, None, 2:]
        moved = self.pixels(locations.reshape(-1, 2)).reshape(locations.shape)
        low, high = moved.min(axis=1), moved.max(axis=1)
        low[~self.shows(low, high)] = np.nan
        self.lost += int((np.isnan(low).any(axis=1) & np.isfinite(boxes).all(axis=1)).sum())
        return np.concatenate([low, high - low], axis=1)


def _sides(
    along: Float64Array, zeros: Float64Array, ones: Float64Array
) -> tuple[tuple[Float64Array, Float64Array], ...]:
    return (along, zeros), (along, ones), (zeros, along), (ones, along)


def redrawn(
    annotations: tuple[Annotation, ...], changes: Mapping[Key, CameraModelChange]
) -> tuple[Annotation, ...]:
    """Move everything that is drawn into images of the cameras whose camera model changes.

    Rows of paths that the new camera model does not see whole, or the new image not at all, are left out, and an
    annotation of which nothing stays goes; locations of projections become null.
    """
    moved = (_moved(annotation, changes) for annotation in annotations)
    return tuple(annotation for annotation in moved if annotation is not None)


def _moved(annotation: Annotation, changes: Mapping[Key, CameraModelChange]) -> Annotation | None:
    if isinstance(annotation, Box2DAnnotation):
        change = changes.get(key_of(annotation.sensor_id))
        return annotation if change is None else _moved_box(annotation, change)
    if isinstance(annotation, ShapeAnnotation) and annotation.dimensions == 2:
        change = None if annotation.sensor_id is None else changes.get(key_of(annotation.sensor_id))
        return annotation if change is None else _moved_shape(annotation, change)
    if isinstance(annotation, CuboidAnnotation):
        projections = tuple(_moved_projection(one, changes) for one in annotation.projections)
        return replace(annotation, projections=projections)
    if isinstance(annotation, PointsAnnotation):
        lists = tuple(
            tuple(_moved_point(one, changes) for one in per_point) for per_point in annotation.projections
        )
        return replace(annotation, projections=lists)
    return annotation


def _moved_box(annotation: Box2DAnnotation, change: CameraModelChange) -> Box2DAnnotation | None:
    path = annotation.path
    values = change.boxes(path.values)
    kept: BoolArray = np.all(np.isfinite(values), axis=1)
    if not kept.any():
        return None
    return replace(annotation, path=BoxPath(path.timestamps_ns[kept], values[kept], path.extras))


def _moved_shape(annotation: ShapeAnnotation, change: CameraModelChange) -> ShapeAnnotation | None:
    path = annotation.path
    moved = [change.pixels(vertices) for vertices in path.vertices]
    kept = [_is_shown(vertices, change) for vertices in moved]
    change.lost += len(kept) - sum(kept)
    if not any(kept):
        return None
    vertices = tuple(one for one, keep in zip(moved, kept, strict=True) if keep)
    return replace(annotation, path=VertexPath(path.timestamps_ns[np.array(kept)], vertices, path.extras))


def _is_shown(vertices: Float64Array, change: CameraModelChange) -> bool:
    """Whether all vertices have a location, and the new image may show some of what they bound."""
    if not (len(vertices) and np.isfinite(vertices).all()):
        return not len(vertices)
    return bool(change.shows(vertices.min(axis=0)[None], vertices.max(axis=0)[None])[0])


def _moved_projection(projection: Projection, changes: Mapping[Key, CameraModelChange]) -> Projection:
    change = changes.get(key_of(projection.sensor_id))
    if change is None or projection.boxes is None:
        return projection
    return replace(projection, boxes=change.boxes(projection.boxes))


def _moved_point(projection: PointProjection, changes: Mapping[Key, CameraModelChange]) -> PointProjection:
    change = changes.get(key_of(projection.sensor_id))
    if change is None or projection.points is None:
        return projection
    moved = change.pixels(projection.points)
    moved[~change.shows(moved, moved)] = np.nan
    change.lost += int((np.isnan(moved).any(axis=1) & np.isfinite(projection.points).all(axis=1)).sum())
    return replace(projection, points=moved)
