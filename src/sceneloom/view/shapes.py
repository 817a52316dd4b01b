"""Cuboids with their trails, and what is drawn into camera images: boxes, shapes, projected cuboids and points."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, Protocol

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float64Array, Int64Array
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    CuboidAnnotation,
    PointProjection,
    Projection,
    ShapeAnnotation,
    ShapeType,
)
from sceneloom.scene.annotations_at import (
    CuboidAngles,
    CuboidPoses,
    attribute_at,
    box_2d_at,
    cuboid_poses,
    shape_at,
)
from sceneloom.scene.types import Identifier
from sceneloom.view.stream import Stream, fits, sdk

_SHORT = 12

_SHOWN = 8


class Layer(Protocol):
    """Annotations of one kind."""

    def log(self, times_ns: Int64Array) -> None:
        """Log them at times (M,) [ns], ascending."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """What is logged to one entity.

    Attributes:
        stream: where to.
        path: of the entity.
        annotations: all that are drawn there.
        colour: 0xRRGGBBAA.
        links: texts on the links of annotations, by id.
    """

    stream: Stream
    path: str
    annotations: tuple[Any, ...]
    colour: int
    links: Mapping[Identifier, str]

    def details(self, there: BoolArray, times_ns: Int64Array) -> Iterable[Any]:
        """What is stated for each object that is there, as columns; one row for each in each moment.

        Args:
            there: (A, M) bool, which annotation is there when.
            times_ns: (M,) int64 [ns].
        """
        if not there.any():
            return ()
        rows = np.argwhere(there.T)
        stated = [attributes_at(annotation, times_ns) for annotation in self.annotations]
        seen = [_seen_by(annotation, times_ns) for annotation in self.annotations]
        values = {
            "id": [str(self.annotations[a].id) for _, a in rows.tolist()],
            "attributes": [stated[a][m] for m, a in rows.tolist()],
            "parent": [str(self.annotations[a].parent_id or "") for _, a in rows.tolist()],
            "links": [self.links.get(self.annotations[a].id, "") for _, a in rows.tolist()],
            "seen_by": [seen[a][m] for m, a in rows.tolist()],
        }
        kept = {name: column for name, column in values.items() if name == "id" or any(column)}
        columns: Iterable[Any] = sdk().AnyValues.columns(**kept).partition(there.sum(axis=0))
        return columns

    def lasting_details(self) -> Any:
        """What is stated for annotations that hold at all times."""
        first = np.zeros(1, np.int64)
        return sdk().AnyValues(
            id=[str(one.id) for one in self.annotations],
            attributes=[attributes_at(one, first)[0] for one in self.annotations],
            links=[self.links.get(one.id, "") for one in self.annotations],
        )


def _by_moment(values: AnyArray, there: BoolArray) -> AnyArray:
    """Take the rows of objects that are there, moment after moment: (A, M, …) to (R, …)."""
    rows: AnyArray = np.swapaxes(values, 0, 1)[there.T]
    return rows


def _chosen_by_moment(values: Sequence[Any], there: BoolArray) -> list[Any]:
    """Repeat what is stated for each of A objects for the moments in which it is there."""
    return [values[a] for _, a in np.argwhere(there.T).tolist()]


def grouped(annotations: Iterable[Annotation], name: Callable[[Any], str]) -> dict[str, tuple[Any, ...]]:
    """Put annotations of one name together, in their order."""
    groups: dict[str, list[Annotation]] = {}
    for annotation in annotations:
        groups.setdefault(name(annotation), []).append(annotation)
    return {key: tuple(members) for key, members in groups.items()}


def label_of(annotation: Any) -> str:
    """The class of an annotation, or its type."""
    return str(getattr(annotation, "label", None) or annotation.type)


def name_of(annotation: Any) -> str:
    """The class and the id, whose beginning is enough where it is long; the id alone where it begins with the class."""
    label, identifier = label_of(annotation), str(annotation.id)
    if len(label) < len(identifier) <= len(label) + _SHORT and identifier.startswith(label):
        return identifier
    return f"{label} {identifier if len(identifier) <= _SHORT else identifier[:_SHOWN]}"


def attributes_at(annotation: Any, times_ns: Int64Array) -> list[str]:
    """What the attributes of an annotation state at times (M,) [ns], each time in a line."""
    attributes: tuple[AttributePath, ...] = getattr(annotation, "attributes", ())
    if not attributes:
        return [""] * len(times_ns)
    values = {attribute_name(attribute): attribute_at(attribute, times_ns) for attribute in attributes}
    return [
        attribute_text({name: column[m] for name, column in values.items() if column[m] is not None})
        for m in range(len(times_ns))
    ]


def _seen_by(annotation: Any, times_ns: Int64Array) -> list[str]:
    """The sensors whose activations state that they see an annotation at times (M,) [ns]."""
    activations: tuple[Activation, ...] = getattr(annotation, "activations", ())
    sensors: list[list[str]] = [[] for _ in times_ns]
    for activation in activations:
        starts = activation.timestamps_ns
        lasts = (0,) * len(starts) if activation.durations_ns is None else activation.durations_ns
        stops = starts.astype(np.float64) + np.array(lasts, np.float64)  # may lie beyond int64
        active = (starts[:, None] <= times_ns) & (times_ns <= stops[:, None])
        for m in np.flatnonzero(active.any(axis=0)).tolist():
            sensors[m].append(str(activation.sensor_id))
    return [", ".join(found) for found in sensors]


def attribute_name(attribute: AttributePath) -> str:
    """The name of an attribute, with what it is limited to."""
    limits = [str(limit) for limit in (attribute.sensor_id, attribute.point_index) if limit is not None]
    return f"{attribute.name} ({', '.join(limits)})" if limits else attribute.name


def attribute_text(values: Mapping[str, Any]) -> str:
    """Attributes in a line: `colour red, access 4`."""
    return ", ".join(
        f"{name} {value if isinstance(value, str) else json.dumps(value, default=str)}"
        for name, value in values.items()
    )


_HISTORY_NS = 3_000_000_000
"""So much of an object's trajectory trails behind it [ns]."""

_TRAIL_WIDTH = -1.5
"""Negative widths are points of the screen, not metres."""

_MOVED = 0.5
"""What moved less than that in all has no trail [m]."""

_POINTS_OF_TRAIL = 24

EDGES = "majorwireframe"
"""Boxes are drawn as their edges: what is in them stays in view."""


def _edges_only() -> Any:
    """What makes boxes be drawn as edges, for an entity that is given boxes over time."""
    return sdk().Boxes3D.from_fields(fill_mode=EDGES)


@dataclass(frozen=True, slots=True, eq=False)
class CuboidLayer:
    """Shows cuboids of one class that are there for a time.

    Attributes:
        group: the cuboids and their entity.
        angles: how their angles are meant.
        origin: (3,) float64 [m], what is taken off locations.
    """

    group: Group
    angles: CuboidAngles
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log boxes and trails at times (M,) [ns]."""
        group = self.group
        poses = [cuboid_poses(one, times_ns, angles=self.angles) for one in group.annotations]
        held = np.array([_held(p, self.origin) for p in poses])
        there = np.array([p.there for p in poses])
        group.stream.leave_out("cuboid moments", np.count_nonzero(there & ~held))
        there &= held
        centers = _by_moment(np.array([p.centers_world for p in poses]) - self.origin, there)
        boxes = sdk().Boxes3D.columns(
            centers=centers,
            half_sizes=_by_moment(np.array([p.sizes_lwh for p in poses]), there) / 2,
            quaternions=_by_moment(np.array([p.quaternions_xyzw for p in poses]), there),
            colors=np.full(len(centers), group.colour, np.uint32),
            labels=_chosen_by_moment([name_of(one) for one in group.annotations], there),
        )
        cut = boxes.partition(there.sum(axis=0))
        group.stream.static(group.path, _edges_only())
        group.stream.columns(times_ns, group.path, cut, group.details(there, times_ns), kind="cuboid moments")
        self._trails(times_ns, there)

    def _trails(self, times_ns: Int64Array, there: BoolArray) -> None:
        moving = [a for a, one in enumerate(self.group.annotations) if _moves(one)]
        strips: list[Float64Array] = []
        counts = np.zeros(len(times_ns), np.int64)
        for m, time_ns in enumerate(times_ns.tolist()):
            trails = [self._trail(a, time_ns) for a in moving if there[a, m]]
            lines = [strip - self.origin for strip in trails]
            long = [line for line in (line[fits(line)] for line in lines) if len(line) > 1]
            strips += long
            counts[m] = len(long)
        if moving:
            drawn = sdk().LineStrips3D.columns(
                strips=strips,
                colors=np.full(len(strips), self.group.colour, np.uint32),
                radii=np.full(len(strips), _TRAIL_WIDTH, np.float32),
            )
            self.group.stream.columns(times_ns, f"{self.group.path}/trails", drawn.partition(counts))

    def _trail(self, a: int, time_ns: int) -> Float64Array:
        path = self.group.annotations[a].path
        return _trail(path.timestamps_ns, path.values[:, 3:6], time_ns)


def _held(poses: CuboidPoses, origin: Float64Array) -> BoolArray:
    """Which moments the viewer can hold, (M,)."""
    rotated = fits(poses.quaternions_xyzw)
    return np.asarray(fits(poses.centers_world - origin) & fits(poses.sizes_lwh) & rotated, np.bool_)


def _moves(annotation: CuboidAnnotation) -> bool:
    locations = annotation.path.values[:, 3:6]
    finite = locations[np.isfinite(locations).all(axis=1)]
    return len(finite) > 1 and bool(np.ptp(finite, axis=0).max() > _MOVED)


def _trail(timestamps_ns: Int64Array, locations: Float64Array, time_ns: int) -> Float64Array:
    """The last part (K, 3) [m] of a trajectory up to a time [ns], thinned to what shows.

    Args:
        timestamps_ns: (N,) int64 [ns], ascending.
        locations: (N, 3) [m].
        time_ns: the end.
    """
    start, stop = np.searchsorted(timestamps_ns, [time_ns - _HISTORY_NS, time_ns + 1])
    count = min(_POINTS_OF_TRAIL, int(stop - start))
    rows = np.unique(np.linspace(start, stop - 1, max(count, 0)).astype(np.int64))
    part = locations[rows]
    return part[np.isfinite(part).all(axis=1)]


def stands(annotation: CuboidAnnotation) -> bool:
    """Whether a cuboid is there at all times in one location, with attributes that do not change."""
    fixed = all(not attribute.is_timed for attribute in annotation.attributes)
    return bool(annotation.stationary) and len(annotation.path.timestamps_ns) == 1 and fixed


def show_stationary(group: Group, angles: CuboidAngles, origin: Float64Array) -> None:
    """Show cuboids that stand."""
    timestamps = [one.path.timestamps_ns[:1] for one in group.annotations]
    poses = [
        cuboid_poses(one, t, angles=angles) for one, t in zip(group.annotations, timestamps, strict=True)
    ]
    held = [bool(_held(p, origin).all()) for p in poses]
    group.stream.leave_out("stationary cuboids", held.count(False))
    group = replace(group, annotations=tuple(compress(group.annotations, held)))
    poses = list(compress(poses, held))
    if not poses:
        return
    boxes = sdk().Boxes3D(
        centers=np.concatenate([p.centers_world for p in poses]) - origin,
        half_sizes=np.concatenate([p.sizes_lwh for p in poses]) / 2,
        quaternions=np.concatenate([p.quaternions_xyzw for p in poses]),
        colors=np.full(len(poses), group.colour, np.uint32),
        labels=[name_of(one) for one in group.annotations],
        show_labels=False,
        fill_mode=EDGES,
    )
    group.stream.static(group.path, boxes, group.lasting_details())
    group.stream.count("stationary cuboids", len(poses))


_SAME_NS = 1_000
"""A location in a image belongs to the image of that timestamp, which a file in microseconds may have rounded [ns]."""

_MARK = -3.0

_WIDTH = -1.0


@dataclass(frozen=True, slots=True, eq=False)
class BoxLayer:
    """Shows boxes of one class in the images of a camera."""

    group: Group

    def log(self, times_ns: Int64Array) -> None:
        """Log the boxes at times (M,) [ns]."""
        found = [box_2d_at(one, times_ns) for one in self.group.annotations]
        _log_boxes(self.group, times_ns, [boxes for boxes, _ in found], "boxes in images")


@dataclass(frozen=True, slots=True, eq=False)
class ProjectionLayer:
    """Shows where a camera sees cuboids of one class."""

    group: Group
    projections: tuple[Projection, ...]

    def log(self, times_ns: Int64Array) -> None:
        """Log the boxes at times (M,) [ns]."""
        found = [_rows_at(one.timestamps_ns, one.boxes, times_ns) for one in self.projections]
        _log_boxes(self.group, times_ns, found, "projections")


def _log_boxes(group: Group, times_ns: Int64Array, boxes: Sequence[Float64Array], kind: str) -> None:
    """Log boxes: for each annotation (M, 4) `left top width height` [px], NaN where it is not there."""
    values = np.array(boxes)
    half_sizes = values[..., 2:] / 2
    held = fits(values) & fits(values[..., :2] + half_sizes)
    group.stream.leave_out(kind, np.count_nonzero(~held & ~np.isnan(values).any(axis=2)))
    rows = _by_moment(values, there := held)
    columns = sdk().Boxes2D.columns(
        centers=rows[:, :2] + rows[:, 2:] / 2,
        half_sizes=rows[:, 2:] / 2,
        colors=np.full(len(rows), group.colour, np.uint32),
        labels=_chosen_by_moment([name_of(one) for one in group.annotations], there),
    )
    cut = columns.partition(there.sum(axis=0))
    group.stream.columns(times_ns, group.path, cut, group.details(there, times_ns), kind=kind)


@dataclass(frozen=True, slots=True, eq=False)
class PointProjectionLayer:
    """Shows where a camera sees named points: one entry of the group for each point."""

    group: Group
    projections: tuple[PointProjection, ...]
    names: tuple[str, ...]

    def log(self, times_ns: Int64Array) -> None:
        """Log the points at times (M,) [ns]."""
        values = np.array([_rows_at(one.timestamps_ns, one.points, times_ns) for one in self.projections])
        there = fits(values)
        lost = np.count_nonzero(~there & ~np.isnan(values).any(axis=2))
        self.group.stream.leave_out("points in images", lost)
        rows = _by_moment(values, there)
        columns = sdk().Points2D.columns(
            positions=rows,
            colors=np.full(len(rows), self.group.colour, np.uint32),
            radii=np.full(len(rows), _MARK, np.float32),
            labels=_chosen_by_moment(self.names, there),
        )
        self.group.stream.columns(times_ns, self.group.path, columns.partition(there.sum(axis=0)))


def _rows_at(timestamps_ns: Int64Array, values: Float64Array | None, times_ns: Int64Array) -> Float64Array:
    """The rows of values (N, D) at times (M,), NaN where no timestamp is at that time; (M, D)."""
    width = 4 if values is None else values.shape[1]
    found = np.full((len(times_ns), width), np.nan)
    if values is None or len(timestamps_ns) == 0:
        return found
    order = np.argsort(timestamps_ns, kind="stable")
    ordered = timestamps_ns[order]
    at = np.clip(np.searchsorted(ordered, times_ns), 1, max(len(ordered) - 1, 1))
    before = np.abs(times_ns - ordered[at - 1]) <= np.abs(
        ordered[np.minimum(at, len(ordered) - 1)] - times_ns
    )
    rows = order[np.where(before, at - 1, np.minimum(at, len(ordered) - 1))]
    same = np.abs(timestamps_ns[rows] - times_ns) <= _SAME_NS
    found[same] = values[rows[same]]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class ShapeLayer:
    """Shows shapes of one class and kind, in images or in space.

    Attributes:
        group: the shapes and their entity; all have vertices of as many numbers.
        origin: (D,) float64, what is taken off vertices.
    """

    group: Group
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log the shapes at times (M,) [ns]."""
        rr, group = sdk(), self.group
        found = [shape_at(one, times_ns) for one in group.annotations]
        reported = np.array(
            [[vertices is not None and len(vertices) > 0 for vertices in one] for one in found]
        )
        there = np.array([[_is_whole(vertices, self.origin) for vertices in one] for one in found])
        group.stream.leave_out("shapes", np.count_nonzero(reported & ~there))
        chosen = [found[a][m] - self.origin for m, a in np.argwhere(there.T).tolist()]  # type: ignore[operator]
        owners = _chosen_by_moment(group.annotations, there)
        marks, flat = _is_mark(group.annotations[0].type), len(self.origin) == 2
        details = group.details(there, times_ns)
        if marks:
            archetype = rr.Points2D if flat else rr.Points3D
            counts = _sums([len(vertices) for vertices in chosen], there.sum(axis=0))
            positions = np.concatenate([*chosen, np.zeros((0, len(self.origin)))])
            radii = np.full(len(positions), _MARK, np.float32)
            columns = archetype.columns(
                positions=positions, radii=radii, colors=np.full(len(positions), group.colour, np.uint32)
            )
        else:
            archetype = rr.LineStrips2D if flat else rr.LineStrips3D
            counts = there.sum(axis=0)
            columns = archetype.columns(
                strips=[_closed(owner, line) for owner, line in zip(owners, chosen, strict=True)],
                radii=np.full(len(chosen), _WIDTH, np.float32),
                colors=np.full(len(chosen), group.colour, np.uint32),
                labels=[name_of(owner) for owner in owners],
            )
        group.stream.columns(times_ns, group.path, columns.partition(counts), details, kind="shapes")


def _is_mark(kind: ShapeType) -> bool:
    """Whether a shape is points alone."""
    return kind in {ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN}


def _closed(annotation: ShapeAnnotation, vertices: Float64Array) -> Float64Array:
    """The outline of an area, or a line, from its vertices (V, D)."""
    if annotation.is_closed or annotation.type.value.startswith("polygon"):
        return np.concatenate([vertices, vertices[:1]])
    return vertices


def _is_whole(vertices: Float64Array | None, origin: Float64Array) -> bool:
    return vertices is not None and len(vertices) > 0 and bool(fits(vertices - origin).all())


def _sums(sizes: Sequence[int], counts: Int64Array) -> Int64Array:
    """How many vertices each moment has, of as many shapes as `counts` says."""
    stops = np.concatenate([[0], np.cumsum(sizes)])[np.concatenate([[0], np.cumsum(counts)])]
    return np.asarray(np.diff(stops), np.int64)


def by_camera(entries: Sequence[tuple[Any, Any]]) -> Mapping[Any, list[tuple[Any, Any]]]:
    """Pairs of an annotation and one of its entries that name a sensor, by that sensor."""
    found: dict[Any, list[tuple[Any, Any]]] = {}
    for annotation, entry in entries:
        found.setdefault(entry.sensor_id, []).append((annotation, entry))
    return found
