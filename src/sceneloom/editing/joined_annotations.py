"""An annotation that goes on from one part of a drive to the next, joined."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.joined_sensors import joined_path, new_rows
from sceneloom.editing.sameness import is_same, stated_of
from sceneloom.errors import OptionError
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.annotations.relations import (
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.types import key_of

_ROWS = ("values", "vertices", "boxes", "cuboids", "points", "positions", "durations_ns", "confirmed")
"""Fields of paths, activations and projections that have one entry per timestamp."""


def joined_annotation(first: Annotation, second: Annotation, name: str) -> Annotation:
    """Join two parts of one annotation; of two keyframes at one time that of the first counts.

    Raises:
        OptionError: they are of different types, or cannot be parts of one.
    """
    join = _JOINS.get(type(first))
    if type(first) is not type(second) or first.type != second.type or join is None:
        if is_same(first, second):
            return first
        raise OptionError(f"{name}: a {first.type} in one scene and a {second.type} in another; expected one")
    joined: Any = join(first, second, name)
    if isinstance(first, LocalizationAdjustment | CameraCalibration):
        return joined  # type: ignore[no-any-return]
    stated: Any = second
    return replace(joined, attributes=joined_attributes(joined.attributes, stated.attributes))  # type: ignore[no-any-return]


def joined_rows(first: Any, second: Any) -> Any:
    """Join what has timestamps and an entry of some fields for each; a field that one lacks is left out."""
    rows = new_rows(first.timestamps_ns, second.timestamps_ns)
    chosen: dict[str, Any] = {
        "timestamps_ns": np.concatenate([first.timestamps_ns, second.timestamps_ns])[rows]
    }
    for name in _ROWS:
        if hasattr(first, name):
            chosen[name] = _rows(getattr(first, name), getattr(second, name), rows)
    return replace(first, **chosen)


def _rows(a: Any, b: Any, rows: Int64Array) -> Any:
    if a is None or b is None:
        return None
    if isinstance(a, tuple):
        both = (*a, *b)
        return tuple(both[row] for row in rows.tolist())
    return np.concatenate([a, b])[rows]


def joined_attributes(
    first: tuple[AttributePath, ...], second: tuple[AttributePath, ...]
) -> tuple[AttributePath, ...]:
    """Join attributes of one name, sensor and point; one whose values have no times each is that of the first."""
    joined = {stated_of(attribute): attribute for attribute in first}
    alone = []
    for attribute in second:
        known = joined.get(stated_of(attribute))
        if known is None:
            alone.append(attribute)
        elif known.is_timed and attribute.is_timed:
            joined[stated_of(attribute)] = joined_rows(known, attribute)
    return (*joined.values(), *alone)


def _entries(first: tuple[Any, ...], second: tuple[Any, ...]) -> tuple[Any, ...]:
    """Join entries per sensor."""
    joined = {key_of(entry.sensor_id): entry for entry in first}
    for entry in second:
        key = key_of(entry.sensor_id)
        joined[key] = joined_rows(joined[key], entry) if key in joined else entry
    return tuple(joined.values())


def _joined_paths(first: Any, second: Any) -> Any:
    """The path of both; of what is stationary at one location in both parts that of the first."""
    still = all(getattr(part, "stationary", None) for part in (first, second))
    a, b = first.path, second.path
    there = all(is_same(getattr(a, name), getattr(b, name)) for name in _ROWS if hasattr(a, name))
    return a if still and there else joined_rows(a, b)


def _cuboid(first: CuboidAnnotation, second: CuboidAnnotation, name: str) -> CuboidAnnotation:
    del name
    return replace(
        first,
        path=_joined_paths(first, second),
        activations=_entries(first.activations, second.activations),
        projections=_entries(first.projections, second.projections),
    )


def _path(first: Any, second: Any, name: str) -> Any:
    if not is_same(first.sensor_id, second.sensor_id):
        raise OptionError(
            f"{name}: of sensor {first.sensor_id!r} and of {second.sensor_id!r}; expected one sensor"
        )
    return replace(first, path=_joined_paths(first, second))


def _points(first: PointsAnnotation, second: PointsAnnotation, name: str) -> PointsAnnotation:
    if len(first.paths) != len(second.paths):
        raise OptionError(
            f"{name}: {len(first.paths)} points and {len(second.paths)} points; expected as many"
        )
    paths = (joined_rows(a, b) for a, b in zip(first.paths, second.paths, strict=True))
    count = max(len(first.projections), len(second.projections))
    a, b = (((*given, *((),) * count)[:count]) for given in (first.projections, second.projections))
    projections = (_entries(x, y) for x, y in zip(a, b, strict=True))
    return replace(first, paths=tuple(paths), projections=tuple(projections))


def _labelled(
    first: LabeledPointsAnnotation, second: LabeledPointsAnnotation, name: str
) -> LabeledPointsAnnotation:
    del name
    joined = {(key_of(entry.sensor_id), entry.sensor_frame): entry for entry in first.labeled_points}
    for entry in second.labeled_points:
        location = (key_of(entry.sensor_id), entry.sensor_frame)
        known = joined.get(location)
        ids = entry.point_ids if known is None else np.union1d(known.point_ids, entry.point_ids)
        joined[location] = replace(entry, point_ids=ids.astype(np.uint32))
    return replace(first, labeled_points=tuple(joined.values()))


def _event(first: EventAnnotation, second: EventAnnotation, name: str) -> EventAnnotation:
    """From the beginning of the earlier part to the end of the later one."""
    del name
    start_ns = min(first.start_ns, second.start_ns)
    duration_ns = max(event.start_ns + (event.duration_ns or 0) for event in (first, second)) - start_ns
    untold = first.duration_ns is None and second.duration_ns is None and duration_ns == 0
    return replace(first, start_ns=start_ns, duration_ns=None if untold else duration_ns)


def _adjustment(
    first: LocalizationAdjustment, second: LocalizationAdjustment, name: str
) -> LocalizationAdjustment:
    return replace(first, poses=joined_path(first.poses, second.poses, name))


def _calibration(first: CameraCalibration, second: CameraCalibration, name: str) -> CameraCalibration:
    poses = first.poses if second.poses is None else second.poses
    if first.poses is not None and second.poses is not None:
        poses = joined_path(first.poses, second.poses, name)
    stated = ((a.sensor_id, a.intrinsics, a.time_offset_ns) for a in (first, second))
    if not is_same(*stated):
        raise OptionError(
            f"{name}: another camera, camera model or time offset in one scene than in another; expected one"
        )
    return replace(first, poses=poses)


def _first(first: Any, second: Any, name: str) -> Any:
    del second, name
    return first


def _link(first: LinkAnnotation, second: LinkAnnotation, name: str) -> LinkAnnotation:
    if not is_same((first.from_id, first.to_id), (second.from_id, second.to_id)):
        raise OptionError(f"{name}: joins other annotations in one scene than in another; expected one link")
    return first


_JOINS: Mapping[type, Callable[[Any, Any, str], Any]] = MappingProxyType(
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _path,
        ShapeAnnotation: _path,
        PointsAnnotation: _points,
        LabeledPointsAnnotation: _labelled,
        EventAnnotation: _event,
        LocalizationAdjustment: _adjustment,
        CameraCalibration: _calibration,
        ObjectAnnotation: _first,
        GroupAnnotation: _first,
        LinkAnnotation: _link,
    }
)
"""How the parts of each kind of annotation are joined."""
