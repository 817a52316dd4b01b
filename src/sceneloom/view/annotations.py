"""Annotations of every type, at the timestamps that they are about.

Cuboids with their trails, shapes, keypoints, labelled points, links and events; boxes, shapes and projections in camera
images; attributes; corrections. Annotations of one class and kind are a layer, logged for many moments at once.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray, BoolArray, Float32Array, Float64Array, Int64Array, UInt16Array, finite_rows
from sceneloom.geometry.rigid import rotate_vectors
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    locations_of,
)
from sceneloom.scene.annotations_at import (
    CuboidAngles,
    CuboidPoses,
    active_at,
    annotations_frame,
    attribute_at,
    box_2d_at,
    cuboid_poses,
    point_at,
    points_at,
    shape_at,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.view.images import image_path, show_calibration
from sceneloom.view.poses import Locations
from sceneloom.view.stream import EDGES, WORLD, Report, Stream, escaped, fits, one_packed, sdk
from sceneloom.visualization.figures import colour_of_name

_SHORT = 12
_SHOWN = 8


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """What is logged to one entity."""

    stream: Stream
    path: str
    annotations: tuple[Any, ...]
    colour: int
    links: Mapping[Identifier, str]

    def details(self, there: BoolArray, times_ns: Int64Array) -> Iterable[Any]:
        """What is stated for each object that is there at times (M,) [ns], as columns; a row for each and moment."""
        if not there.any():
            return ()
        rows = np.argwhere(there.T)
        stated = [_attributes_at(annotation, times_ns) for annotation in self.annotations]
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
            attributes=[_attributes_at(one, first)[0] for one in self.annotations],
            links=[self.links.get(one.id, "") for one in self.annotations],
        )


def _by_moment(values: AnyArray, there: BoolArray) -> AnyArray:
    """Take the rows of objects that are there, moment after moment: (A, M, …) to (R, …)."""
    rows: AnyArray = np.swapaxes(values, 0, 1)[there.T]
    return rows


def _chosen_by_moment(values: Sequence[Any], there: BoolArray) -> list[Any]:
    """Repeat what is stated for each of A objects for the moments in which it is there."""
    return [values[a] for _, a in np.argwhere(there.T).tolist()]


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    """What a layer logs for some moments."""

    columns: Any
    counts: Int64Array  # (M,), how many objects each moment has
    there: BoolArray | None = None

    @classmethod
    def of(cls, archetype: Any, there: BoolArray, group: _Group, **values: Any) -> "_Drawn":
        """One object for each annotation that is there, in the group's colour."""
        counts = there.sum(axis=0)
        colours = np.full(int(counts.sum()), group.colour, np.uint32)
        return cls(archetype.columns(colors=colours, **values), counts, there)


@dataclass(frozen=True, slots=True)
class _Layer:
    """Annotations of one class and kind."""

    group: _Group
    draw: Callable[[_Group, Int64Array, str], _Drawn]  # at times (M,) [ns], ascending
    kind: str
    counted: bool = True

    def log(self, times_ns: Int64Array) -> None:
        """Log them at times (M,) [ns], ascending."""
        group, drawn = self.group, self.draw(self.group, times_ns, self.kind)
        details = () if drawn.there is None else group.details(drawn.there, times_ns)
        columns = drawn.columns.partition(drawn.counts)
        kind = self.kind if self.counted else None
        group.stream.columns(times_ns, group.path, columns, details, kind=kind)


def _grouped(annotations: Iterable[Annotation], name: Callable[[Any], str]) -> dict[str, tuple[Any, ...]]:
    """Put annotations of one name together, in their order."""
    groups: dict[str, list[Annotation]] = {}
    for annotation in annotations:
        groups.setdefault(name(annotation), []).append(annotation)
    return {key: tuple(members) for key, members in groups.items()}


def _label_of(annotation: Any) -> str:
    """The class of an annotation, or its type."""
    return str(getattr(annotation, "label", None) or annotation.type)


def _name_of(annotation: Any) -> str:
    """The class and the id, whose beginning is enough where it is long; the id alone where it begins with the class."""
    label, identifier = _label_of(annotation), str(annotation.id)
    if len(label) < len(identifier) <= len(label) + _SHORT and identifier.startswith(label):
        return identifier
    return f"{label} {identifier if len(identifier) <= _SHORT else identifier[:_SHOWN]}"


def _attributes_at(annotation: Any, times_ns: Int64Array) -> list[str]:
    """What the attributes of an annotation state at times (M,) [ns], each time in a line."""
    attributes: tuple[AttributePath, ...] = getattr(annotation, "attributes", ())
    if not attributes:
        return [""] * len(times_ns)
    values = {_attribute_name(attribute): attribute_at(attribute, times_ns) for attribute in attributes}
    return [
        _attribute_text({name: column[m] for name, column in values.items() if column[m] is not None})
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


def _attribute_name(attribute: AttributePath) -> str:
    """The name of an attribute, with what it is limited to."""
    limits = [str(limit) for limit in (attribute.sensor_id, attribute.point_index) if limit is not None]
    return f"{attribute.name} ({', '.join(limits)})" if limits else attribute.name


def _attribute_text(values: Mapping[str, Any]) -> str:
    """Attributes in a line: `colour red, doors 4`."""
    return ", ".join(
        f"{name} {value if isinstance(value, str) else json.dumps(value, default=str)}"
        for name, value in values.items()
    )


_HISTORY_NS = 3_000_000_000  # so much of an object's trajectory trails behind it [ns]
_TRAIL_WIDTH, _LINK_WIDTH, _LINE_WIDTH = -1.5, -2.0, -1.0
"""Negative widths and radii are points of the screen, not metres."""
_KEYPOINT, _LABELLED, _MARK = -4.0, -2.4, -3.0
_MOVED = 0.5  # what moved less than that in all has no trail [m]
_POINTS_OF_TRAIL = 24


def _draw_cuboids(
    group: _Group, times_ns: Int64Array, kind: str, *, angles: CuboidAngles, origin: Float64Array
) -> _Drawn:
    """Cuboids that are there for a time; their trails are logged beside them."""
    poses = [cuboid_poses(one, times_ns, angles=angles) for one in group.annotations]
    held = np.array([_held(p, origin) for p in poses])
    there = np.array([p.there for p in poses])
    group.stream.leave_out(kind, np.count_nonzero(there & ~held))
    there &= held
    # boxes are drawn as their edges: what is in them stays in view
    group.stream.static(group.path, sdk().Boxes3D.from_fields(fill_mode=EDGES))
    _log_trails(group, times_ns, there, origin)
    return _Drawn.of(
        sdk().Boxes3D,
        there,
        group,
        centers=_by_moment(np.array([p.centers_world for p in poses]) - origin, there),
        half_sizes=_by_moment(np.array([p.sizes_lwh for p in poses]), there) / 2,
        quaternions=_by_moment(np.array([p.quaternions_xyzw for p in poses]), there),
        labels=_chosen_by_moment([_name_of(one) for one in group.annotations], there),
    )


def _log_trails(group: _Group, times_ns: Int64Array, there: BoolArray, origin: Float64Array) -> None:
    """The last part of the trajectory of each cuboid that moves, up to each time, thinned to what shows."""
    moving = []
    for a, one in enumerate(group.annotations):
        locations = one.path.values[:, 3:6]
        finite = locations[finite_rows(locations)]
        if len(finite) > 1 and np.ptp(finite, axis=0).max() > _MOVED:
            moving.append((a, one.path.timestamps_ns, locations))
    if not moving:
        return
    strips: list[Float64Array] = []
    counts = np.zeros(len(times_ns), np.int64)
    for m, time_ns in enumerate(times_ns.tolist()):
        for a, timestamps_ns, locations in moving:
            if there[a, m]:
                start, stop = np.searchsorted(timestamps_ns, [time_ns - _HISTORY_NS, time_ns + 1])
                count = max(min(_POINTS_OF_TRAIL, int(stop - start)), 0)
                line = locations[np.unique(np.linspace(start, stop - 1, count).astype(np.int64))]
                line = line[finite_rows(line)] - origin
                line = line[fits(line)]
                if len(line) > 1:
                    strips.append(line)
                    counts[m] += 1
    drawn = sdk().LineStrips3D.columns(
        strips=strips,
        colors=np.full(len(strips), group.colour, np.uint32),
        radii=np.full(len(strips), _TRAIL_WIDTH, np.float32),
    )
    group.stream.columns(times_ns, f"{group.path}/trails", drawn.partition(counts))


def _held(poses: CuboidPoses, origin: Float64Array) -> BoolArray:
    """Which moments the viewer can hold, (M,)."""
    rotated = fits(poses.quaternions_xyzw)
    return np.asarray(fits(poses.centers_world - origin) & fits(poses.sizes_lwh) & rotated, np.bool_)


def _stands(annotation: CuboidAnnotation) -> bool:
    """Whether a cuboid is there at all times in one location, with attributes that do not change."""
    fixed = all(not attribute.is_timed for attribute in annotation.attributes)
    return bool(annotation.stationary) and len(annotation.path.timestamps_ns) == 1 and fixed


def _show_stationary(group: _Group, angles: CuboidAngles, origin: Float64Array) -> None:
    """Show cuboids that stand."""
    timestamps = [one.path.timestamps_ns[:1] for one in group.annotations]
    poses = [cuboid_poses(one, t, angles=angles) for one, t in zip(group.annotations, timestamps, strict=True)]
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
        labels=[_name_of(one) for one in group.annotations],
        show_labels=False,
        fill_mode=EDGES,
    )
    group.stream.static(group.path, boxes, group.lasting_details())
    group.stream.count("stationary cuboids", len(poses))


def _draw_keypoints(group: _Group, times_ns: Int64Array, kind: str, *, origin: Float64Array) -> _Drawn:
    """Named points in space."""
    positions: list[list[Float64Array]] = [[] for _ in times_ns]
    names: list[list[str]] = [[] for _ in times_ns]
    for annotation in group.annotations:
        for k, path in enumerate(annotation.paths):
            if len(path.timestamps_ns) == 0:
                continue
            values, there = point_at(path, times_ns, stationary=bool(annotation.stationary))
            rows = locations_of(values)
            held = fits(rows - origin).all(axis=1)
            group.stream.leave_out(kind, np.count_nonzero(there & ~held))
            for m in np.flatnonzero(there & held).tolist():
                positions[m].append(rows[m])
                names[m] += [_point_name(annotation, k)] * len(rows[m])
    counts = np.array([len(one) for one in names], np.int64)
    points = np.concatenate([np.zeros((0, 3)), *(rows for moment in positions for rows in moment)])
    columns = sdk().Points3D.columns(
        positions=points - origin,
        colors=np.full(len(points), group.colour, np.uint32),
        radii=np.full(len(points), _KEYPOINT, np.float32),
        labels=[name for moment in names for name in moment],
    )
    return _Drawn(columns, counts)


def _point_name(annotation: PointsAnnotation, k: int) -> str:
    """What point `k` of an annotation is called."""
    if annotation.labels is not None and k < len(annotation.labels):
        return annotation.labels[k]
    path = annotation.paths[k]
    return _name_of(annotation) if path.id is None else f"{_name_of(annotation)}: {path.id}"


def _draw_links(
    group: _Group,
    times_ns: Int64Array,
    kind: str,
    *,
    ends: Mapping[Key, Annotation],
    angles: CuboidAngles,
    origin: Float64Array,
) -> _Drawn:
    """Links as arrows between what they join, at times at which both ends, found by id in `ends`, are there."""
    starts, stops = (
        np.array([_middles(ends.get(key_of(identifier)), times_ns, angles) for identifier in identifiers])
        for identifiers in ([one.from_id for one in group.annotations], [one.to_id for one in group.annotations])
    )
    known = ~(np.isnan(starts) | np.isnan(stops)).any(axis=2)
    there = fits(starts - origin) & fits(stops - origin) & fits(stops - starts)
    group.stream.leave_out(kind, np.count_nonzero(known & ~there))
    origins = _by_moment(starts, there) - origin
    return _Drawn.of(
        sdk().Arrows3D,
        there,
        group,
        origins=origins,
        vectors=_by_moment(stops, there) - origin - origins,
        radii=np.full(len(origins), _LINK_WIDTH, np.float32),
        labels=_chosen_by_moment([_label_of(one) for one in group.annotations], there),
    )


def _middles(annotation: Annotation | None, times_ns: Int64Array, angles: CuboidAngles) -> Float64Array:
    """The middle of an annotation at each time, (M, 3) [m], NaN where it is not there."""
    if isinstance(annotation, CuboidAnnotation):
        return cuboid_poses(annotation, times_ns, angles=angles).centers_world
    nowhere = np.full((len(times_ns), 3), np.nan)
    if isinstance(annotation, ShapeAnnotation):
        shapes = shape_at(annotation, times_ns)
        return np.array([nowhere[0] if one is None else one.mean(axis=0) for one in shapes])
    if isinstance(annotation, PointsAnnotation) and annotation.paths:
        rows, _ = points_at(annotation, times_ns)[0]
        return rows[:, :3]
    return nowhere


def _link_texts(annotations: Sequence[Annotation]) -> Mapping[Identifier, str]:
    """What is stated for the links of each annotation, in a line: `tows: trailer 7`."""
    names = {key_of(one.id): _name_of(one) for one in annotations}
    texts: dict[Identifier, list[str]] = {}
    for link in annotations:
        if isinstance(link, LinkAnnotation):
            other = names.get(key_of(link.to_id), str(link.to_id))
            back = names.get(key_of(link.from_id), str(link.from_id))
            texts.setdefault(link.from_id, []).append(f"{_label_of(link)}: {other}")
            texts.setdefault(link.to_id, []).append(f"{_label_of(link)} of {back}")
    return {identifier: "; ".join(stated) for identifier, stated in texts.items()}


def _draw_boxes(
    group: _Group, times_ns: Int64Array, kind: str, *, projections: Sequence[Projection] | None = None
) -> _Drawn:
    """Boxes in the images of a camera; with `projections`, one for each entry of the group, where it sees cuboids."""
    if projections is None:
        values = np.array([box_2d_at(one, times_ns)[0] for one in group.annotations])
    else:
        values = np.array([_rows_at(one.timestamps_ns, one.boxes, times_ns) for one in projections])
    half_sizes = values[..., 2:] / 2  # of (A, M, 4) `left top width height` [px], NaN where it is not there
    there = fits(values) & fits(values[..., :2] + half_sizes)
    group.stream.leave_out(kind, np.count_nonzero(~there & ~np.isnan(values).any(axis=2)))
    rows = _by_moment(values, there)
    return _Drawn.of(
        sdk().Boxes2D,
        there,
        group,
        centers=rows[:, :2] + rows[:, 2:] / 2,
        half_sizes=rows[:, 2:] / 2,
        labels=_chosen_by_moment([_name_of(one) for one in group.annotations], there),
    )


def _draw_point_projections(
    group: _Group, times_ns: Int64Array, kind: str, *, projections: Sequence[PointProjection], names: Sequence[str]
) -> _Drawn:
    """Where a camera sees named points: one entry of the group for each point."""
    values = np.array([_rows_at(one.timestamps_ns, one.points, times_ns) for one in projections])
    there = fits(values)
    group.stream.leave_out(kind, np.count_nonzero(~there & ~np.isnan(values).any(axis=2)))
    rows = _by_moment(values, there)
    radii = np.full(len(rows), _MARK, np.float32)
    labels = _chosen_by_moment(names, there)
    drawn = _Drawn.of(sdk().Points2D, there, group, positions=rows, radii=radii, labels=labels)
    return replace(drawn, there=None)


_SAME_NS = 1_000
"""A position in an image belongs to the image of that timestamp, which a file in microseconds may have rounded [ns]."""


def _rows_at(timestamps_ns: Int64Array, values: Float64Array | None, times_ns: Int64Array) -> Float64Array:
    """The rows of values (N, D) at times (M,), NaN where no timestamp is at that time; (M, D)."""
    width = 4 if values is None else values.shape[1]
    found = np.full((len(times_ns), width), np.nan)
    if values is None or len(timestamps_ns) == 0:
        return found
    order = np.argsort(timestamps_ns, kind="stable")
    ordered = timestamps_ns[order]
    at = np.clip(np.searchsorted(ordered, times_ns), 1, max(len(ordered) - 1, 1))
    before = np.abs(times_ns - ordered[at - 1]) <= np.abs(ordered[np.minimum(at, len(ordered) - 1)] - times_ns)
    rows = order[np.where(before, at - 1, np.minimum(at, len(ordered) - 1))]
    same = np.abs(timestamps_ns[rows] - times_ns) <= _SAME_NS
    found[same] = values[rows[same]]
    return found


def _draw_shapes(group: _Group, times_ns: Int64Array, kind: str, *, origin: Float64Array) -> _Drawn:
    """Shapes of one kind, in images or in space: all have vertices of as many numbers as `origin`."""
    rr, flat = sdk(), len(origin) == 2
    found = [shape_at(one, times_ns) for one in group.annotations]
    stated = np.array([[vertices is not None and len(vertices) > 0 for vertices in one] for one in found])
    there = stated.copy()
    for a, m in np.argwhere(stated).tolist():
        there[a, m] = fits(found[a][m] - origin).all()  # type: ignore[operator]
    group.stream.leave_out(kind, np.count_nonzero(stated & ~there))
    chosen = [found[a][m] - origin for m, a in np.argwhere(there.T).tolist()]  # type: ignore[operator]
    owners = _chosen_by_moment(group.annotations, there)
    if group.annotations[0].type not in {ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN}:
        strips = [
            # the outline of an area, or a line
            np.concatenate([line, line[:1]]) if owner.is_closed or owner.type.value.startswith("polygon") else line
            for owner, line in zip(owners, chosen, strict=True)
        ]
        return _Drawn.of(
            rr.LineStrips2D if flat else rr.LineStrips3D,
            there,
            group,
            strips=strips,
            radii=np.full(len(chosen), _LINE_WIDTH, np.float32),
            labels=[_name_of(owner) for owner in owners],
        )
    positions = np.concatenate([*chosen, np.zeros((0, len(origin)))])
    columns = (rr.Points2D if flat else rr.Points3D).columns(
        positions=positions,
        radii=np.full(len(positions), _MARK, np.float32),
        colors=np.full(len(positions), group.colour, np.uint32),
    )
    # how many vertices each moment has, of all of its shapes
    sums = np.concatenate([[0], np.cumsum([len(vertices) for vertices in chosen])])
    counts = np.diff(sums[np.concatenate([[0], np.cumsum(there.sum(axis=0))])])
    return _Drawn(columns, np.asarray(counts, np.int64), there)


_CLASSES = 65_535  # so many labelled points annotations the viewer can tell apart


@dataclass(slots=True, eq=False)
class _LabelledPoints:
    """The labelled points of a scene, by the frames that they are of."""

    # `entries`: labels and rows of points by sensor and number of a frame (None: the sensor as a whole)

    stream: Stream
    entries: Mapping[tuple[Key, int | None], Sequence[tuple[int, Int64Array]]]
    _names: dict[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, stream: Stream, annotations: Sequence[Annotation]) -> "_LabelledPoints":
        """Collect them; each annotation is a class of its own for the viewer, with a colour and a name."""
        rr = sdk()
        labelled = [one for one in annotations if isinstance(one, LabeledPointsAnnotation)][:_CLASSES]
        entries: dict[tuple[Key, int | None], list[tuple[int, Int64Array]]] = {}
        for number, annotation in enumerate(labelled, start=1):
            for entry in annotation.labeled_points:
                rows = entry.point_ids.astype(np.int64)
                entries.setdefault((key_of(entry.sensor_id), entry.sensor_frame), []).append((number, rows))
        infos = []
        for number, one in enumerate(labelled, start=1):
            label, colour = (_name_of(one), one.id) if one.is_instance else (_label_of(one), _label_of(one))
            infos.append(rr.AnnotationInfo(id=number, label=label, color=colour_of_name(colour)))
        if infos:
            stream.static(stream.root, rr.AnnotationContext(infos))
        return cls(stream, entries)

    def log(
        self, sensor_id: Identifier, frame: int | None, path: str, time_ns: int | None, positions: Float32Array
    ) -> None:
        """Log those of a frame over its cloud, positions (N, 3) [m] of all its points; `time_ns` None: for always."""
        found = self.entries.get((key_of(sensor_id), frame))
        if not found:
            return
        rows = np.concatenate([rows for _, rows in found])
        classes: UInt16Array = np.repeat(
            np.array([number for number, _ in found], np.uint16), [len(rows) for _, rows in found]
        )
        there = rows < len(positions)
        there[there] = fits(positions[rows[there]])
        shown = sdk().Points3D(
            positions[rows[there]], class_ids=classes[there], radii=np.float32(_LABELLED), show_labels=False
        )
        if time_ns is None:
            self.stream.static(f"{path}/labelled", shown)
            self.stream.count("labelled clouds", 1)
        else:
            self.stream.log(time_ns, f"{path}/labelled", shown, kind="labelled clouds", size=14 * len(rows))


_MOST_NODES = 400
RELATIONS = "relations"


def _show_graph(stream: Stream, annotations: Sequence[Annotation], notify: Report) -> None:
    """Show parents, groups and links as a graph."""
    edges = [(str(one.parent_id), str(one.id)) for one in annotations if one.parent_id is not None]
    edges += [(str(one.from_id), str(one.to_id)) for one in annotations if isinstance(one, LinkAnnotation)]
    joined = {name for edge in edges for name in edge}
    alone = [one for one in annotations if isinstance(one, GroupAnnotation | ObjectAnnotation)]
    shown = [one for one in annotations if str(one.id) in joined and not isinstance(one, LinkAnnotation)]
    nodes = {str(one.id): one for one in (*shown, *alone)}
    if not nodes:
        return
    if len(nodes) > _MOST_NODES:
        notify("graph-cut", "annotations", f"the graph of relations shows {_MOST_NODES} of {len(nodes)} annotations")
        nodes = dict(list(nodes.items())[:_MOST_NODES])
    rr = sdk()
    drawn = rr.GraphNodes(
        list(nodes),
        labels=[_name_of(one) for one in nodes.values()],
        colors=np.array([one_packed(colour_of_name(_label_of(one))) for one in nodes.values()], np.uint32),
    )
    kept = [edge for edge in edges if edge[0] in nodes and edge[1] in nodes]
    lines = (rr.GraphEdges(kept, graph_type="directed"),) if kept else ()
    stream.static(stream.path(RELATIONS), drawn, *lines)


EVENTS, ATTRIBUTES, LIST = "events", "attributes", "annotations"
_MOST_ROWS = 1_000


def _show_events(stream: Stream, annotations: Sequence[Annotation]) -> None:
    """Show events as lines of a log and as states that last."""
    for event in annotations:
        if not isinstance(event, EventAnnotation):
            continue
        start_ns = event.start_ns
        stated = _attributes_at(event, np.array([start_ns], np.int64))[0]
        where = "" if event.sensor_id is None else f" (sensor {event.sensor_id})"
        text = f"{_name_of(event)}{where}{': ' if stated else ''}{stated}"
        line = sdk().TextLog(text, level="INFO", color=colour_of_name(_label_of(event)))
        path = stream.path(EVENTS, event.id)
        state = sdk().StateChange(state=_label_of(event))
        stream.log(start_ns, path, line, state, kind="events")
        if event.duration_ns:
            stream.log(start_ns + round(event.duration_ns), path, sdk().StateChange(state=""))


def _show_attributes(stream: Stream, scene: Scene) -> None:
    """Show attributes of the scene and its sensors: numbers as curves, words as states."""
    for attribute in scene.attributes:
        if not (attribute.is_timed and attribute.values):
            continue
        columns: Iterable[Any]
        if all(isinstance(value, int | float) and not isinstance(value, bool) for value in attribute.values):
            columns = sdk().Scalars.columns(scalars=np.array(attribute.values, np.float64))
        else:
            columns = sdk().StateChange.columns(state=[_word(value) for value in attribute.values])
        timestamps = np.asarray(attribute.timestamps_ns, np.int64)
        stream.columns(timestamps, stream.path(ATTRIBUTES, _attribute_name(attribute)), columns, kind="attributes")


def _word(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def _list_annotations(stream: Stream, scene: Scene) -> None:
    """Show a table of all annotations with their attributes, and of those that hold for the scene."""
    fixed = [one for one in scene.attributes if not one.is_timed]
    rows = [f"| {kind} | {text} |" for kind, text in ((_attribute_name(a), _word(a.values)) for a in fixed)]
    parts = ["# Attributes of the scene\n| attribute | value |\n| --- | --- |\n" + "\n".join(rows)] if rows else []
    if scene.annotations:
        listed = ["# Annotations", "| type | label | id | parent | attributes |", "| --- | --- | --- | --- | --- |"]
        for one in scene.annotations[:_MOST_ROWS]:
            attributes: tuple[AttributePath, ...] = getattr(one, "attributes", ())
            stated = _attribute_text({_attribute_name(each): _word(each.values) for each in attributes[:8]})
            parent = "" if one.parent_id is None else str(one.parent_id)
            cells = (one.type, getattr(one, "label", None) or "", one.id, parent, stated)
            texts = (str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells)
            listed.append("| " + " | ".join(texts) + " |")
        more = len(scene.annotations) - _MOST_ROWS
        parts.append("\n".join(listed) + (f"\n\n… and {more} more" if more > 0 else ""))
    if parts:
        stream.static(stream.path(LIST), sdk().TextDocument("\n\n".join(parts), media_type="text/markdown"))


def _show_adjustment(stream: Stream, locations: Locations, annotation: LocalizationAdjustment) -> None:
    """The trajectory p' = A(t) p of the ego; A itself, which leads from ego to world then, where that is not known."""
    trajectory, poses = locations.path, annotation.poses
    positions = poses.positions
    if trajectory is not None:
        held = poses.held(trajectory.timestamps_ns)
        positions = rotate_vectors(held.quaternions_xyzw, trajectory.positions) + held.positions
    shifted = positions - locations.origin_world
    shown = fits(shifted)
    stream.leave_out("poses of corrected trajectories", np.count_nonzero(~shown))
    line = sdk().LineStrips3D(
        [shifted[shown]],
        colors=np.array([one_packed(colour_of_name(annotation.id))], np.uint32),
        radii=np.array([_LINK_WIDTH], np.float32),
        labels=["corrected trajectory"],
    )
    stream.static(stream.path(WORLD, "corrected trajectories", annotation.id), line)
    stream.count("localization adjustments", 1)


_EGO, _ANNOTATIONS = "ego", "annotations"
_AT_ONCE = 128  # moments that are logged together


@dataclass(slots=True, eq=False)
class AnnotationView:
    """The annotations of a drive: what holds at all times is logged by `of`, the rest while frames are played.

    Attributes:
        in_space: logged at the moments of sweeps, and at the timestamps of their own paths.
        in_images: by camera, logged at the times of its images and at the timestamps of their own paths.
        timestamps_ns: of the paths of annotations in space, (N,) int64 [ns], ascending.
        labelled: labelled points, which follow their clouds.
    """

    in_space: tuple[_Layer, ...]
    in_images: dict[Identifier, tuple[_Layer, ...]]
    timestamps_ns: Int64Array
    labelled: _LabelledPoints
    _waiting: list[int] = field(default_factory=list)
    _done_until: int = 0

    @classmethod
    def of(cls, stream: Stream, locations: Locations, scene: Scene, notify: Report) -> "AnnotationView":
        """Make the layers of a scene, and log what holds at all times."""
        for one in scene.annotations:  # each correction as what it leads to
            if isinstance(one, LocalizationAdjustment):
                _show_adjustment(stream, locations, one)
            elif isinstance(one, CameraCalibration):
                show_calibration(stream, one, notify)
        _show_events(stream, scene.annotations)
        _show_attributes(stream, scene)
        _show_graph(stream, scene.annotations, notify)
        _list_annotations(stream, scene)
        maker = _Maker(stream, locations, scene)
        timestamps = [np.zeros(0, np.int64)]
        for one in scene.annotations:
            if (isinstance(one, CuboidAnnotation) and not _stands(one)) or (
                isinstance(one, ShapeAnnotation) and one.dimensions == 3
            ):
                timestamps.append(one.path.timestamps_ns)
            elif isinstance(one, PointsAnnotation):
                timestamps += [path.timestamps_ns for path in one.paths]
        return cls(
            (*maker.cuboids(), *maker.shapes(), *maker.points(), *maker.links()),
            {camera.id: tuple(maker.drawn(camera.id)) for camera in scene.cameras},
            np.unique(np.concatenate(timestamps)),
            _LabelledPoints.of(stream, scene.annotations),
        )

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
            len(self.timestamps_ns) if until_ns is None else int(np.searchsorted(self.timestamps_ns, until_ns, "right"))
        )
        moments = np.unique(np.concatenate([self.timestamps_ns[start:stop], np.array(self._waiting, np.int64)]))
        self._done_until, self._waiting = max(start, stop), []
        _log_in_parts(self.in_space, moments)

    def log_in_images(self, camera_id: Identifier, times_ns: Int64Array) -> None:
        """Log all that is drawn into the images of a camera, taken at times (N,) [ns]."""
        _log_in_parts(self.in_images.get(camera_id, ()), times_ns)


def _log_in_parts(layers: Sequence[_Layer], times_ns: Int64Array) -> None:
    for start in range(0, len(times_ns), _AT_ONCE):
        for layer in layers:
            layer.log(times_ns[start : start + _AT_ONCE])


class _Maker:
    """Makes layers: one for each class of each kind."""

    def __init__(self, stream: Stream, locations: Locations, scene: Scene) -> None:
        self._stream, self._scene = stream, scene
        self._angles = CuboidAngles.of(scene)
        self._links = _link_texts(scene.annotations)
        on_ego = annotations_frame(scene) is Coordinates.EGO
        self._base = stream.path(WORLD, _EGO, _ANNOTATIONS) if on_ego else stream.path(WORLD, _ANNOTATIONS)
        self._origin: Float64Array = np.zeros(3) if on_ego else locations.origin_world

    def _group(self, base: str, label: str, members: Sequence[Annotation]) -> _Group:
        colour = one_packed(colour_of_name(label))
        return _Group(self._stream, f"{base}/{escaped(label)}", tuple(members), colour, self._links)

    def _groups(self, base: str, annotations: Iterable[Annotation]) -> Iterator[_Group]:
        """One for each class."""
        for label, members in _grouped(annotations, _label_of).items():
            yield self._group(base, label, members)

    def _of(self, kind: type[Any]) -> list[Any]:
        return [one for one in self._scene.annotations if isinstance(one, kind)]

    def cuboids(self) -> Iterator[_Layer]:
        """Those that come and go; stationary ones are logged now."""
        draw = partial(_draw_cuboids, angles=self._angles, origin=self._origin)
        found = [one for one in self._of(CuboidAnnotation) if len(one.path.timestamps_ns)]
        for group in self._groups(f"{self._base}/cuboids", found):
            stationary = tuple(one for one in group.annotations if _stands(one))
            passing = tuple(one for one in group.annotations if not _stands(one))
            if stationary:
                below = replace(group, path=f"{group.path}/stationary", annotations=stationary)
                _show_stationary(below, self._angles, self._origin)
            if passing:
                yield _Layer(replace(group, annotations=passing), draw, "cuboid moments")

    def _shapes(self, base: str, shapes: Iterable[ShapeAnnotation], origin: Float64Array) -> Iterator[_Layer]:
        draw = partial(_draw_shapes, origin=origin)
        for kind, alike in _grouped(shapes, lambda one: one.type.value).items():
            for group in self._groups(f"{base}/{kind}", alike):
                yield _Layer(group, draw, "shapes")

    def shapes(self) -> Iterator[_Layer]:
        """Shapes in space."""
        solid = [one for one in self._of(ShapeAnnotation) if one.dimensions == 3]
        yield from self._shapes(self._base, solid, self._origin)

    def points(self) -> Iterator[_Layer]:
        """Named points."""
        draw = partial(_draw_keypoints, origin=self._origin)
        for group in self._groups(f"{self._base}/points", self._of(PointsAnnotation)):
            yield _Layer(group, draw, "named points")

    def links(self) -> Iterator[_Layer]:
        """Links between what has locations."""
        ends = {key_of(one.id): one for one in self._scene.annotations}
        draw = partial(_draw_links, ends=ends, angles=self._angles, origin=self._origin)
        for group in self._groups(f"{self._base}/links", self._of(LinkAnnotation)):
            yield _Layer(group, draw, "links")

    def drawn(self, camera_id: Identifier) -> Iterator[_Layer]:
        """What is drawn into the images of one camera."""
        base = image_path(self._stream, camera_id)
        boxes = [one for one in self._of(Box2DAnnotation) if one.sensor_id == camera_id]
        for group in self._groups(f"{base}/boxes", boxes):
            yield _Layer(group, _draw_boxes, "boxes in images")
        shapes = [one for one in self._of(ShapeAnnotation) if one.sensor_id == camera_id]
        yield from self._shapes(base, [one for one in shapes if one.dimensions == 2], np.zeros(2))
        seen: dict[str, list[tuple[CuboidAnnotation, Projection]]] = {}
        for one in self._of(CuboidAnnotation):
            for entry in one.projections:
                if entry.sensor_id != camera_id:
                    continue
                if entry.boxes is not None:  # only what is active for the camera
                    there = active_at(one, camera_id, entry.timestamps_ns)
                    entry = replace(entry, boxes=np.where(there[:, None], entry.boxes, np.nan))  # noqa: PLW2901
                seen.setdefault(_label_of(one), []).append((one, entry))
        for label, pairs in seen.items():
            draw = partial(_draw_boxes, projections=[entry for _, entry in pairs])
            yield _Layer(self._group(f"{base}/projections", label, [one for one, _ in pairs]), draw, "projections")
        named = [
            (one, _point_name(one, k), entry)
            for one in self._of(PointsAnnotation)
            for k, entries in enumerate(one.projections)
            for entry in entries
            if entry.sensor_id == camera_id
        ]
        if named:
            owners, names, entries = zip(*named, strict=True)
            draw_points = partial(_draw_point_projections, projections=entries, names=names)
            yield _Layer(self._group(base, "points", owners), draw_points, "points in images", counted=False)
