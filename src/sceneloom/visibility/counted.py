"""A scene whose cuboids report how many points they hold, or which."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from sceneloom.errors import OptionError
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPoints, LabeledPointsAnnotation
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.visibility.activations import activation_of
from sceneloom.visibility.points import FrameCounts, PointCounts

POINTS = "points"
"""Name of the attribute that holds the counts."""


def with_attributes(
    annotation: CuboidAnnotation,
    attributes: Iterable[AttributePath],
    *,
    names: Iterable[str],
    sensor_ids: Iterable[Identifier],
) -> CuboidAnnotation:
    """Give a cuboid new attributes instead of all of these names that it had of these sensors."""
    reported, sensors = set(names), {key_of(sensor_id) for sensor_id in sensor_ids}
    kept = [
        path
        for path in annotation.attributes
        if path.name not in reported or path.sensor_id is None or key_of(path.sensor_id) not in sensors
    ]
    return replace(annotation, attributes=(*kept, *attributes))


def with_counts(scene: Scene, counts: PointCounts) -> Scene:
    """Report in an attribute `points` of each cuboid, per lidar.

    How many points it holds at each frame while it is there.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: what `count_points` found.
    """
    rows = {key_of(identifier): row for row, identifier in enumerate(counts.annotation_ids)}
    return replace(scene, annotations=tuple(_counted(each, rows, counts) for each in scene.annotations))


def _counted(annotation: Annotation, rows: dict[Key, int], counts: PointCounts) -> Annotation:
    row = rows.get(key_of(annotation.id))
    if not isinstance(annotation, CuboidAnnotation) or row is None:
        return annotation
    reported = [path for lidar in counts.lidars if (path := _attribute(lidar, row)) is not None]
    sensor_ids = [lidar.lidar_id for lidar in counts.lidars]
    return with_attributes(annotation, reported, names=[POINTS], sensor_ids=sensor_ids)


def _attribute(lidar: FrameCounts, row: int) -> AttributePath | None:
    frames = np.flatnonzero(lidar.there[:, row])
    if len(frames) == 0:
        return None
    values = tuple(lidar.counts[frames, row].tolist())
    return AttributePath(POINTS, values, lidar.timestamps_ns[frames], sensor_id=lidar.lidar_id)


def with_activations(scene: Scene, counts: PointCounts, *, min_points: int = 1) -> Scene:
    """Report when each lidar sees each cuboid: while frame after frame has points of it.

    Replaces what was reported them.

    Args:
        scene: the scene, or one with the same cuboids.
        counts: what `count_points` found.
        min_points: fewer points in a frame are not seen.
    """
    rows = {key_of(identifier): row for row, identifier in enumerate(counts.annotation_ids)}
    keys = {key_of(lidar.lidar_id) for lidar in counts.lidars}
    annotations: list[Annotation] = []
    for each in scene.annotations:
        row = rows.get(key_of(each.id))
        if isinstance(each, CuboidAnnotation) and row is not None:
            kept = [reported for reported in each.activations if key_of(reported.sensor_id) not in keys]
            made = [
                activation_of(lidar.lidar_id, lidar.timestamps_ns, lidar.counts[:, row] >= min_points)
                for lidar in counts.lidars
            ]
            annotations.append(
                replace(each, activations=(*kept, *(reported for reported in made if reported is not None)))
            )
        else:
            annotations.append(each)
    return replace(scene, annotations=tuple(annotations))


def with_labeled_points(scene: Scene, counts: PointCounts) -> Scene:
    """Add an annotation of labelled points for each cuboid that holds any; the cuboid is its parent.

    Its id is that of the cuboid with ":points" behind it; an annotation of that id is replaced if it is one of these.

    Args:
        scene: the scene, or one with the same cuboids and frames.
        counts: what `count_points` found, the points listed.

    Raises:
        OptionError: the points were not listed, or another annotation has such an id.
    """
    if any(lidar.point_ids is None for lidar in counts.lidars):
        raise OptionError("the points in the cuboids were counted, not listed; count with `listed=True`")
    cuboids = {key_of(each.id): each for each in scene.annotations if isinstance(each, CuboidAnnotation)}
    made = [
        _labelled(cuboids[key_of(identifier)], entries)
        for row, identifier in enumerate(counts.annotation_ids)
        if (entries := _entries(counts.lidars, row))
    ]
    ids = {each.id for each in made}
    kept = [each for each in scene.annotations if each.id not in ids or not _is_ours(each)]
    return replace(scene, annotations=(*kept, *made))


def _is_ours(annotation: Annotation) -> bool:
    return isinstance(annotation, LabeledPointsAnnotation) and annotation.id == _points_id(
        annotation.parent_id
    )


def _points_id(identifier: Identifier | None) -> str:
    return f"{identifier}:{POINTS}"


def _labelled(cuboid: CuboidAnnotation, entries: tuple[LabeledPoints, ...]) -> LabeledPointsAnnotation:
    return LabeledPointsAnnotation(
        _points_id(cuboid.id), entries, label=cuboid.label, is_instance=True, parent_id=cuboid.id
    )


def _entries(lidars: Sequence[FrameCounts], row: int) -> tuple[LabeledPoints, ...]:
    return tuple(
        LabeledPoints(lidar.lidar_id, lists[row], sensor_frame=k)
        for lidar in lidars
        for k, lists in enumerate(lidar.point_ids or ())
        if row in lists
    )
