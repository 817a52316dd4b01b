"""All annotations of a scene as layers, each logged at the moments that it is about."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.cuboids import CuboidAnnotation, CuboidPath, Projection
from sceneloom.scene.annotations.keypoints import PointPath, PointsAnnotation
from sceneloom.scene.annotations.relations import LinkAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation, VertexPath
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.at import active_at
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier, key_of
from sceneloom.view.annotations.cuboids import CuboidLayer, show_stationary, stands
from sceneloom.view.annotations.in_images import (
    BoxLayer,
    PointProjectionLayer,
    ProjectionLayer,
    ShapeLayer,
    by_camera,
)
from sceneloom.view.annotations.points import PointsLayer, point_name
from sceneloom.view.annotations.relations import LinkLayer, link_texts
from sceneloom.view.annotations.rows import Group, Layer, grouped, label_of
from sceneloom.view.clouds import WORLD
from sceneloom.view.colours import colour_of_name, one_packed
from sceneloom.view.images import image_path
from sceneloom.view.locations import Locations
from sceneloom.view.stream import Stream

EGO, ANNOTATIONS = "ego", "annotations"
_AT_ONCE = 128
"""Moments that are logged together."""


@dataclass(slots=True, eq=False)
class AnnotationLayers:
    """Annotations in space, and in the images of each camera.

    Attributes:
        in_space: logged at the moments of sweeps, and at the timestamps of their own paths.
        in_images: by camera, logged at the times of its images and at the timestamps of their own paths.
        timestamps_ns: of the paths of annotations in space, (N,) int64 [ns], ascending.
    """

    in_space: tuple[Layer, ...]
    in_images: dict[Identifier, tuple[Layer, ...]]
    timestamps_ns: Int64Array
    _waiting: list[int] = field(default_factory=list)
    _done_until: int = 0

    def note(self, time_ns: int) -> None:
        """Take a moment at which a sweep is shown [ns], in ascending order."""
        if self.in_space:
            self._waiting.append(time_ns)
            if len(self._waiting) >= _AT_ONCE:
                self._log_space(time_ns)

    def finish(self) -> None:
        """Log what is left."""
        if self.in_space:
            self._log_space(None)

    def _log_space(self, until_ns: int | None) -> None:
        """Log the moments that wait, and the timestamps up to the last of them; None: all that are left."""
        start = self._done_until
        stop = (
            len(self.timestamps_ns)
            if until_ns is None
            else int(np.searchsorted(self.timestamps_ns, until_ns, "right"))
        )
        moments = np.unique(
            np.concatenate([self.timestamps_ns[start:stop], np.array(self._waiting, np.int64)])
        )
        self._done_until, self._waiting = max(start, stop), []
        _log_in_parts(self.in_space, moments)

    def log_in_images(self, camera_id: Identifier, times_ns: Int64Array) -> None:
        """Log all that is drawn into the images of a camera, taken at times (N,) [ns]."""
        _log_in_parts(self.in_images.get(camera_id, ()), times_ns)


def _log_in_parts(layers: Sequence[Layer], times_ns: Int64Array) -> None:
    for start in range(0, len(times_ns), _AT_ONCE):
        for layer in layers:
            layer.log(times_ns[start : start + _AT_ONCE])


def annotation_layers(stream: Stream, locations: Locations, scene: Scene) -> AnnotationLayers:
    """Make the layers of a scene, and log what holds at all times."""
    maker = _Maker(stream, locations, scene)
    in_space = [*maker.cuboids(), *maker.shapes(), *maker.points(), *maker.links()]
    timestamps = [path.timestamps_ns for path in _paths_in_space(scene.annotations)]
    return AnnotationLayers(
        tuple(in_space),
        {camera.id: tuple(maker.drawn(camera.id)) for camera in scene.cameras},
        np.unique(np.concatenate([np.zeros(0, np.int64), *timestamps])),
    )


def _paths_in_space(annotations: Iterable[Annotation]) -> Iterable[CuboidPath | VertexPath | PointPath]:
    for annotation in annotations:
        if (isinstance(annotation, CuboidAnnotation) and not stands(annotation)) or (
            isinstance(annotation, ShapeAnnotation) and annotation.dimensions == 3
        ):
            yield annotation.path
        elif isinstance(annotation, PointsAnnotation):
            yield from annotation.paths


class _Maker:
    """Makes layers: one for each class of each kind."""

    def __init__(self, stream: Stream, locations: Locations, scene: Scene) -> None:
        self._stream, self._scene = stream, scene
        self._angles = CuboidAngles.of(scene)
        self._links = link_texts(scene.annotations)
        on_ego = annotations_frame(scene) is Coordinates.EGO
        self._base = stream.path(WORLD, EGO, ANNOTATIONS) if on_ego else stream.path(WORLD, ANNOTATIONS)
        self._origin: Float64Array = np.zeros(3) if on_ego else locations.origin_world

    def _group(self, base: str, label: str, members: Sequence[Annotation]) -> Group:
        colour = one_packed(colour_of_name(label))
        path = "/".join([base, _part(label)])
        return Group(self._stream, path, tuple(members), colour, self._links)

    def cuboids(self) -> Iterable[Layer]:
        """Those that come and go; those that stand are logged now."""
        found = [
            one
            for one in self._scene.annotations
            if isinstance(one, CuboidAnnotation) and len(one.path.timestamps_ns)
        ]
        for label, members in grouped(found, label_of).items():
            base = f"{self._base}/cuboids"
            stationary = [one for one in members if stands(one)]
            passing = [one for one in members if not stands(one)]
            if stationary:
                group = self._group(base, label, stationary)
                show_stationary(_within(group, "stationary"), self._angles, self._origin)
            if passing:
                yield CuboidLayer(self._group(base, label, passing), self._angles, self._origin)

    def shapes(self) -> Iterable[Layer]:
        """Shapes in space."""
        found = [one for one in self._scene.annotations if isinstance(one, ShapeAnnotation)]
        solid = [one for one in found if one.dimensions == 3]
        for kind, alike in grouped(solid, lambda one: one.type.value).items():
            for label, members in grouped(alike, label_of).items():
                yield ShapeLayer(self._group(f"{self._base}/{kind}", label, members), self._origin)

    def points(self) -> Iterable[Layer]:
        """Named points."""
        found = [one for one in self._scene.annotations if isinstance(one, PointsAnnotation)]
        for label, members in grouped(found, label_of).items():
            yield PointsLayer(self._group(f"{self._base}/points", label, members), self._origin)

    def links(self) -> Iterable[Layer]:
        """Links between what has locations."""
        found = [one for one in self._scene.annotations if isinstance(one, LinkAnnotation)]
        ends = {key_of(one.id): one for one in self._scene.annotations}
        for label, members in grouped(found, label_of).items():
            yield LinkLayer(
                self._group(f"{self._base}/links", label, members), ends, self._angles, self._origin
            )

    def drawn(self, camera_id: Identifier) -> Iterable[Layer]:
        """What is drawn into the images of one camera."""
        base, annotations = image_path(self._stream, camera_id), self._scene.annotations
        boxes = [
            one for one in annotations if isinstance(one, Box2DAnnotation) and one.sensor_id == camera_id
        ]
        for label, members in grouped(boxes, label_of).items():
            yield BoxLayer(self._group(f"{base}/boxes", label, members))
        shapes = [
            one for one in annotations if isinstance(one, ShapeAnnotation) and one.sensor_id == camera_id
        ]
        flat = [one for one in shapes if one.dimensions == 2]
        for kind, alike in grouped(flat, lambda one: one.type.value).items():
            for label, members in grouped(alike, label_of).items():
                yield ShapeLayer(self._group(f"{base}/{kind}", label, members), np.zeros(2))
        yield from self._projections(base, camera_id)

    def _projections(self, base: str, camera_id: Identifier) -> Iterable[Layer]:
        seen = [
            (one, entry)
            for one in self._scene.annotations
            if isinstance(one, CuboidAnnotation)
            for entry in one.projections
        ]
        pairs = by_camera(seen).get(camera_id, [])
        for label in dict.fromkeys(label_of(one) for one, _ in pairs):
            alike = [(one, entry) for one, entry in pairs if label_of(one) == label]
            group = self._group(f"{base}/projections", label, [one for one, _ in alike])
            yield ProjectionLayer(group, tuple(_active(one, entry) for one, entry in alike))
        named = [
            (one, k, entry)
            for one in self._scene.annotations
            if isinstance(one, PointsAnnotation)
            for k, entries in enumerate(one.projections)
            for entry in entries
            if entry.sensor_id == camera_id
        ]
        if named:
            group = self._group(base, "points", [one for one, _, _ in named])
            names = tuple(point_name(one, k) for one, k, _ in named)
            yield PointProjectionLayer(group, tuple(entry for _, _, entry in named), names)


def _within(group: Group, name: str) -> Group:
    return Group(group.stream, f"{group.path}/{name}", group.annotations, group.colour, group.links)


def _part(label: str) -> str:
    from sceneloom.view.stream import escaped

    return escaped(label)


def _active(annotation: CuboidAnnotation, entry: Projection) -> Projection:
    """Of a projection only what is active for its camera."""
    if entry.boxes is None:
        return entry
    there = active_at(annotation, entry.sensor_id, entry.timestamps_ns)
    return entry if there.all() else replace(entry, boxes=np.where(there[:, None], entry.boxes, np.nan))
