"""Annotations and attributes of a part of a scene in time."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import Activation, CuboidAnnotation, Projection
from sceneloom.scene.annotations.keypoints import PointPath, PointProjection, PointsAnnotation
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.relations import EventAnnotation, LinkAnnotation
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Key, key_of

Interval = tuple[int, int]
"""`[first_ns, last_ns)`."""

Path = TypeVar("Path", bound=Any)
Seen = TypeVar("Seen", Projection, PointProjection)


@dataclass(frozen=True, slots=True)
class _Times:
    """When a part is, and the same until its last sweep ends, for what is drawn into images."""

    part: Interval
    with_images: Interval


def cut_annotation(
    annotation: Annotation, part: Interval, *, with_images: Interval | None = None
) -> Annotation | None:
    """Keep what an annotation says about a part; None for one that is not there in it.

    What holds at all times stays, and so do labelled points: it is for the caller to count their frames anew.

    Args:
        part: when the part is.
        with_images: the same until its last sweep ends; None: as `part`.
    """
    cut = _CUTS.get(type(annotation))
    found: Any = annotation if cut is None else cut(annotation, _Times(part, with_images or part))
    stated: tuple[AttributePath, ...] = getattr(found, "attributes", ())
    kept = cut_attributes(stated, part)
    changed: Annotation | None = found if kept == stated else replace(found, attributes=kept)
    return changed


def cut_attributes(attributes: tuple[AttributePath, ...], part: Interval) -> tuple[AttributePath, ...]:
    """Keep what attributes state about a part: a value holds until the next one.

    So the last one before it begins it.
    """
    cut = (_cut_attribute(attribute, part) for attribute in attributes)
    return tuple(attribute for attribute in cut if attribute is not None)


def without_loose_ends(
    before: Iterable[Annotation], after: Iterable[Annotation]
) -> tuple[tuple[Annotation, ...], int]:
    """Take away links to annotations that were left out, and parents that were.

    Returns:
        annotations: those after, each without what is gone.
        freed: how many lost their parent.
    """
    kept = tuple(after)
    gone = {key_of(a.id) for a in before} - {key_of(a.id) for a in kept}
    if not gone:
        return kept, 0
    firm = [a for a in kept if not (isinstance(a, LinkAnnotation) and _ends(a) & gone)]
    freed = [_freed(a, gone) for a in firm]
    return tuple(freed), sum(now is not then for now, then in zip(freed, firm, strict=True))


def _ends(link: LinkAnnotation) -> set[Key]:
    return {key_of(link.from_id), key_of(link.to_id)}


def _freed(annotation: Annotation, gone: set[Key]) -> Annotation:
    parent = annotation.parent_id
    if isinstance(annotation, PlainAnnotation) or parent is None or key_of(parent) not in gone:
        return annotation
    return replace(annotation, parent_id=None)


def rows_between(times_ns: Int64Array, part: Interval) -> slice:
    """The rows in a part."""
    first, last = np.searchsorted(times_ns, part)
    return slice(int(first), int(last))


def rows_around(times_ns: Int64Array, part: Interval, margin_ns: int) -> slice:
    """The rows of a part and its surroundings, with at least one at or before it and one after it, where there are."""
    inner = rows_between(times_ns, part)
    outer = rows_between(times_ns, (part[0] - margin_ns, part[1] + margin_ns))
    return slice(max(min(outer.start, inner.start - 1), 0), max(outer.stop, inner.stop + 1))


def overlaps(times_ns: Int64Array, part: Interval) -> bool:
    """Whether what lasts from the first time to the last one is there in a part."""
    return len(times_ns) > 0 and bool(times_ns[0] < part[1] and times_ns[-1] >= part[0])


def cut_poses(path: Poses, part: Interval, margin_ns: int) -> Poses:
    """Keep the poses in and around a part, so that between its times nothing changes."""
    if path.static:
        return path
    rows = rows_around(path.timestamps_ns, part, margin_ns)
    return Poses(path.timestamps_ns[rows], path.positions[rows], path.quaternions_xyzw[rows])


def _cut_attribute(attribute: AttributePath, part: Interval) -> AttributePath | None:
    times = attribute.timestamps_ns
    if times is None or not len(times) or not attribute.is_timed or not _increase(times):
        return attribute  # without times it holds at all of them, or is at fault: a part keeps it
    inner = rows_between(times, part)
    rows = slice(max(int(np.searchsorted(times, part[0], "right")) - 1, 0), inner.stop)
    if rows.start >= rows.stop:
        return None
    if rows == slice(0, len(times)) and times[0] >= part[0]:
        return attribute
    return replace(attribute, timestamps_ns=np.maximum(times[rows], part[0]), values=attribute.values[rows])


def _increase(times_ns: Int64Array) -> bool:
    """Whether times can be searched; paths that run backwards stay whole."""
    return bool((np.diff(times_ns) >= 0).all())


def _cut_path(path: Path, part: Interval, name: str, *, stationary: bool | None) -> Path | None:
    """Cut a path with values under a name; None where it is not there in the part."""
    times, values = path.timestamps_ns, getattr(path, name)
    if len(times) == 0 or not _increase(times):
        return path
    if stationary:
        # what is stationary holds at all times, so one of its rows serves the part, at a time in it
        rows = rows_between(times, part)
        rows = rows if rows.start < rows.stop else slice(0, 1)
        times_ns = np.clip(times[rows], part[0], part[1] - 1)
        return replace(path, timestamps_ns=times_ns, **{name: values[rows]})
    if not overlaps(times, part):
        return None
    rows = rows_around(times, part, 0)
    return replace(path, timestamps_ns=times[rows], **{name: values[rows]})


def _cuboid(cuboid: CuboidAnnotation, times: _Times) -> CuboidAnnotation | None:
    path = _cut_path(cuboid.path, times.part, "values", stationary=cuboid.stationary)
    if path is None:
        return None
    activations = (_activation(activation, times.part) for activation in cuboid.activations)
    projections = (_projection(projection, times.with_images) for projection in cuboid.projections)
    return replace(
        cuboid,
        path=path,
        activations=tuple(a for a in activations if len(a.timestamps_ns)),
        projections=tuple(p for p in projections if len(p.timestamps_ns)),
    )


def _activation(activation: Activation, part: Interval) -> Activation:
    """Keep what lasts into the part."""
    starts = activation.timestamps_ns
    durations = activation.durations_ns
    lasting = 0 if durations is None else np.array(durations, np.float64)
    rows = np.flatnonzero((starts < part[1]) & ((starts + lasting > part[0]) | (starts >= part[0])))
    return replace(
        activation,
        timestamps_ns=starts[rows],
        durations_ns=None if durations is None else tuple(durations[row] for row in rows.tolist()),
        cuboids=_chosen(activation.cuboids, rows),
    )


def _projection(projection: Seen, part: Interval) -> Seen:
    times_ns = projection.timestamps_ns
    rows = np.flatnonzero((times_ns >= part[0]) & (times_ns < part[1]))
    names = ("boxes", "cuboids") if isinstance(projection, Projection) else ("points", "positions")
    arrays: dict[str, Any] = {name: _chosen(getattr(projection, name), rows) for name in names}
    confirmed = projection.confirmed
    return replace(
        projection,
        timestamps_ns=times_ns[rows],
        confirmed=None if confirmed is None else tuple(confirmed[row] for row in rows.tolist()),
        **arrays,
    )


def _chosen(array: AnyArray | None, rows: AnyArray) -> AnyArray | None:
    return None if array is None else array[rows]


def _box_2d(box: Box2DAnnotation, times: _Times) -> Box2DAnnotation | None:
    path = _cut_path(box.path, times.with_images, "values", stationary=box.stationary)
    return None if path is None else replace(box, path=path)


def _shape(shape: ShapeAnnotation, times: _Times) -> ShapeAnnotation | None:
    part = times.with_images if shape.dimensions == 2 else times.part
    path = _cut_path(shape.path, part, "vertices", stationary=shape.stationary)
    return None if path is None else replace(shape, path=path)


def _points(points: PointsAnnotation, times: _Times) -> PointsAnnotation | None:
    """Cut the trajectories of all points; one that is not there keeps its number, and nothing else."""
    paths = [_cut_path(path, times.part, "values", stationary=points.stationary) for path in points.paths]
    if paths and all(path is None for path in paths):
        return None
    return replace(
        points,
        paths=tuple(
            _emptied(path) if kept is None else kept for path, kept in zip(points.paths, paths, strict=True)
        ),
        projections=tuple(
            tuple(_projection(projection, times.with_images) for projection in of_point)
            for of_point in points.projections
        ),
    )


def _emptied(path: PointPath) -> PointPath:
    return replace(path, timestamps_ns=path.timestamps_ns[:0], values=path.values[:0])


def _event(event: EventAnnotation, times: _Times) -> EventAnnotation | None:
    """Keep an event that lasts into the part; one that began before begins with it and ends when it did."""
    duration_ns = event.duration_ns or 0
    if event.start_ns >= times.part[1]:
        return None
    if event.start_ns >= times.part[0]:
        return event
    if event.start_ns + duration_ns <= times.part[0]:
        return None
    before_ns = times.part[0] - event.start_ns
    return replace(event, start_ns=times.part[0], duration_ns=duration_ns - before_ns)


def _adjustment(adjustment: LocalizationAdjustment, times: _Times) -> LocalizationAdjustment | None:
    poses = _correcting(adjustment.poses, times.part)
    return None if poses is None else replace(adjustment, poses=poses)


def _calibration(calibration: CameraCalibration, times: _Times) -> CameraCalibration:
    """Cut the poses; camera model and time hold in any part."""
    if calibration.poses is None:
        return calibration
    return replace(calibration, poses=_correcting(calibration.poses, times.with_images))


def _correcting(path: Poses, part: Interval) -> Poses | None:
    if path.static or overlaps(path.timestamps_ns, part):
        return cut_poses(path, part, 0)
    return None


_CUTS: Mapping[type, Callable[[Any, _Times], Annotation | None]] = MappingProxyType(
    {
        CuboidAnnotation: _cuboid,
        Box2DAnnotation: _box_2d,
        ShapeAnnotation: _shape,
        PointsAnnotation: _points,
        EventAnnotation: _event,
        LocalizationAdjustment: _adjustment,
        CameraCalibration: _calibration,
    }
)
"""How the annotations that state when are cut; the others stay."""
