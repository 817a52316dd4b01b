"""Annotations of every type, at the timestamps that they are about: keypoints, labelled points, links, events.

Attributes, corrections.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt16Array
from sceneloom.errors import CalibrationError
from sceneloom.geometry.rotations import rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    GroupAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PointPath,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    VertexPath,
    locations_of,
)
from sceneloom.scene.annotations_at import (
    Bracket,
    CuboidAngles,
    active_at,
    annotations_frame,
    cuboid_poses,
    points_at,
    shape_at,
)
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of
from sceneloom.view.images import camera_path, image_path, pinhole, straight_camera_model
from sceneloom.view.points import WORLD, colour_of_name, one_packed
from sceneloom.view.poses import Locations, transform_columns
from sceneloom.view.shapes import (
    BoxLayer,
    CuboidLayer,
    Group,
    Layer,
    PointProjectionLayer,
    ProjectionLayer,
    ShapeLayer,
    attribute_name,
    attribute_text,
    attributes_at,
    by_camera,
    grouped,
    label_of,
    name_of,
    show_stationary,
    stands,
)
from sceneloom.view.stream import Report, Stream, fits, sdk

_MARK = -4.0

_LABELLED = -2.4

_CLASSES = 65_535


@dataclass(frozen=True, slots=True, eq=False)
class _PointsLayer:
    """Shows named points of annotations of one class.

    Attributes:
        group: the annotations and their entity.
        origin: (3,) float64 [m], what is taken off locations.
    """

    group: Group
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log the points at times (M,) [ns]."""
        locations: list[list[Float64Array]] = [[] for _ in range(len(times_ns))]
        names: list[list[str]] = [[] for _ in range(len(times_ns))]
        for annotation in self.group.annotations:
            for k, path in enumerate(annotation.paths):
                found = Bracket.of(path.timestamps_ns, times_ns, stationary=bool(annotation.stationary))
                if len(path.timestamps_ns) == 0:
                    continue
                rows = found.blend(locations_of(path.values))
                held = fits(rows - self.origin).all(axis=1)
                self.group.stream.leave_out("named points", np.count_nonzero(found.there & ~held))
                for m in np.flatnonzero(found.there & held).tolist():
                    locations[m].append(rows[m])
                    names[m] += [_point_name(annotation, k)] * len(rows[m])
        counts = np.array([len(one) for one in names], np.int64)
        positions = np.concatenate([np.zeros((0, 3)), *(rows for moment in locations for rows in moment)])
        columns = sdk().Points3D.columns(
            positions=positions - self.origin,
            colors=np.full(len(positions), self.group.colour, np.uint32),
            radii=np.full(len(positions), _MARK, np.float32),
            labels=[name for moment in names for name in moment],
        )
        self.group.stream.columns(times_ns, self.group.path, columns.partition(counts), kind="named points")


def _point_name(annotation: PointsAnnotation, k: int) -> str:
    """What point `k` of an annotation is called."""
    if annotation.labels is not None and k < len(annotation.labels):
        return annotation.labels[k]
    path = annotation.paths[k]
    return name_of(annotation) if path.id is None else f"{name_of(annotation)}: {path.id}"


@dataclass(slots=True, eq=False)
class LabelledPoints:
    """The labelled points of a scene, by the frames that they are of.

    Attributes:
        stream: where to.
        entries: for each sensor and number of a frame (None: the sensor as a whole), labels and rows of points.
    """

    stream: Stream
    entries: Mapping[tuple[Key, int | None], Sequence[tuple[int, Int64Array]]]
    _names: dict[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, stream: Stream, annotations: Sequence[Annotation]) -> "LabelledPoints":
        """Collect them; each annotation is a class of its own for the viewer, with a colour and a name."""
        rr = sdk()
        labelled = [one for one in annotations if isinstance(one, LabeledPointsAnnotation)][:_CLASSES]
        entries: dict[tuple[Key, int | None], list[tuple[int, Int64Array]]] = {}
        for number, annotation in enumerate(labelled, start=1):
            for entry in annotation.labeled_points:
                rows = entry.point_ids.astype(np.int64)
                entries.setdefault((key_of(entry.sensor_id), entry.sensor_frame), []).append((number, rows))
        if labelled:
            infos = [
                rr.AnnotationInfo(id=number, label=_class_name(one), color=_class_colour(one))
                for number, one in enumerate(labelled, start=1)
            ]
            stream.static(stream.root, rr.AnnotationContext(infos))
        return cls(stream, entries)

    def log(
        self,
        sensor_id: Identifier,
        frame: int | None,
        path: str,
        time_ns: int | None,
        positions: Float32Array,
    ) -> None:
        """Log those of a frame over its cloud.

        Args:
            sensor_id: whose frame it is.
            frame: its number; None for a sensor without frames.
            path: of the cloud's entity, in whose frame the positions are.
            time_ns: when it is shown [ns]; None for always.
            positions: (N, 3) [m], of all points of the frame.
        """
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


def _class_name(annotation: LabeledPointsAnnotation) -> str:
    return name_of(annotation) if annotation.is_instance else label_of(annotation)


def _class_colour(annotation: LabeledPointsAnnotation) -> Any:
    reported = annotation.id if annotation.is_instance else label_of(annotation)
    return colour_of_name(reported)


_WIDTH = -2.0

_MOST_NODES = 400

RELATIONS = "relations"


@dataclass(frozen=True, slots=True, eq=False)
class _LinkLayer:
    """Shows links of one class as arrows between what they join.

    Attributes:
        group: the links and their entity.
        ends: the annotations that have locations, by id.
        angles: how angles of cuboids are meant.
        origin: (3,) float64 [m], what is taken off locations.
    """

    group: Group
    ends: Mapping[Key, Annotation]
    angles: CuboidAngles
    origin: Float64Array

    def log(self, times_ns: Int64Array) -> None:
        """Log the links at times (M,) [ns] at which both ends are there."""
        starts = np.array([self._locations(one.from_id, times_ns) for one in self.group.annotations])
        stops = np.array([self._locations(one.to_id, times_ns) for one in self.group.annotations])
        known = ~(np.isnan(starts) | np.isnan(stops)).any(axis=2)
        there = fits(starts - self.origin) & fits(stops - self.origin) & fits(stops - starts)
        self.group.stream.leave_out("links", np.count_nonzero(known & ~there))
        origins = np.swapaxes(starts, 0, 1)[there.T] - self.origin
        arrows = sdk().Arrows3D.columns(
            origins=origins,
            vectors=np.swapaxes(stops, 0, 1)[there.T] - self.origin - origins,
            colors=np.full(len(origins), self.group.colour, np.uint32),
            radii=np.full(len(origins), _WIDTH, np.float32),
            labels=[label_of(self.group.annotations[a]) for _, a in np.argwhere(there.T).tolist()],
        )
        cut = arrows.partition(there.sum(axis=0))
        self.group.stream.columns(
            times_ns, self.group.path, cut, self.group.details(there, times_ns), kind="links"
        )

    def _locations(self, identifier: Identifier, times_ns: Int64Array) -> Float64Array:
        """The middle of an annotation at each time, (M, 3) [m], NaN where it is not there."""
        annotation = self.ends.get(key_of(identifier))
        if isinstance(annotation, CuboidAnnotation):
            return cuboid_poses(annotation, times_ns, angles=self.angles).centers_world
        nowhere = np.full((len(times_ns), 3), np.nan)
        if isinstance(annotation, ShapeAnnotation):
            return np.array(
                [nowhere[0] if one is None else one.mean(axis=0) for one in shape_at(annotation, times_ns)]
            )
        if isinstance(annotation, PointsAnnotation) and annotation.paths:
            rows, _ = points_at(annotation, times_ns)[0]
            return rows[:, :3]
        return nowhere


def _link_texts(annotations: Sequence[Annotation]) -> Mapping[Identifier, str]:
    """What is stated for the links of each annotation, in a line: `tows: trailer 7`."""
    names = {key_of(one.id): name_of(one) for one in annotations}
    texts: dict[Identifier, list[str]] = {}
    for link in annotations:
        if isinstance(link, LinkAnnotation):
            other = names.get(key_of(link.to_id), str(link.to_id))
            back = names.get(key_of(link.from_id), str(link.from_id))
            texts.setdefault(link.from_id, []).append(f"{label_of(link)}: {other}")
            texts.setdefault(link.to_id, []).append(f"{label_of(link)} of {back}")
    return {identifier: "; ".join(stated) for identifier, stated in texts.items()}


def show_graph(stream: Stream, annotations: Sequence[Annotation], notify: Report) -> bool:
    """Show parents, groups and links as a graph; report whether there is one."""
    edges = [(str(one.parent_id), str(one.id)) for one in annotations if one.parent_id is not None]
    edges += [(str(one.from_id), str(one.to_id)) for one in annotations if isinstance(one, LinkAnnotation)]
    joined = {name for edge in edges for name in edge}
    alone = [one for one in annotations if isinstance(one, GroupAnnotation | ObjectAnnotation)]
    shown = [one for one in annotations if str(one.id) in joined and not isinstance(one, LinkAnnotation)]
    nodes = {str(one.id): one for one in (*shown, *alone)}
    if not nodes:
        return False
    if len(nodes) > _MOST_NODES:
        notify(
            "graph-cut",
            "annotations",
            f"the graph of relations shows {_MOST_NODES} of {len(nodes)} annotations",
        )
        nodes = dict(list(nodes.items())[:_MOST_NODES])
    rr = sdk()
    drawn = rr.GraphNodes(
        list(nodes),
        labels=[name_of(one) for one in nodes.values()],
        colors=np.array([one_packed(colour_of_name(label_of(one))) for one in nodes.values()], np.uint32),
    )
    kept = [edge for edge in edges if edge[0] in nodes and edge[1] in nodes]
    lines = (rr.GraphEdges(kept, graph_type="directed"),) if kept else ()
    stream.static(stream.path(RELATIONS), drawn, *lines)
    return True


EVENTS, ATTRIBUTES, LIST = "events", "attributes", "annotations"

_MOST_ROWS = 1_000


def show_events(stream: Stream, annotations: Sequence[Annotation]) -> int:
    """Show events as lines of a log and as states that last; give their number."""
    events = [one for one in annotations if isinstance(one, EventAnnotation)]
    for event in events:
        start_ns = event.start_ns
        stated = attributes_at(event, np.array([start_ns], np.int64))[0]
        where = "" if event.sensor_id is None else f" (sensor {event.sensor_id})"
        text = f"{name_of(event)}{where}{': ' if stated else ''}{stated}"
        line = sdk().TextLog(text, level="INFO", color=colour_of_name(label_of(event)))
        path = stream.path(EVENTS, event.id)
        state = sdk().StateChange(state=label_of(event))
        stream.log(start_ns, path, line, state, kind="events")
        if event.duration_ns:
            stream.log(start_ns + round(event.duration_ns), path, sdk().StateChange(state=""))
    return len(events)


def show_attributes(stream: Stream, scene: Scene) -> int:
    """Show attributes of the scene and its sensors: numbers as curves, words as states; give how many have times."""
    timed = [attribute for attribute in scene.attributes if attribute.is_timed and attribute.values]
    for attribute in timed:
        path = stream.path(ATTRIBUTES, attribute_name(attribute))
        timestamps = np.asarray(attribute.timestamps_ns, np.int64)
        numbers = _numbers(attribute)
        columns: Iterable[Any]
        if numbers is None:
            columns = sdk().StateChange.columns(state=[_word(value) for value in attribute.values])
        else:
            columns = sdk().Scalars.columns(scalars=numbers)
        stream.columns(timestamps, path, columns, kind="attributes")
    return len(timed)


def _numbers(attribute: AttributePath) -> np.ndarray | None:
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in attribute.values):
        return np.array(attribute.values, np.float64)
    return None


def _word(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def list_annotations(stream: Stream, scene: Scene) -> bool:
    """Show a table of all annotations with their attributes, and of those that hold for the scene; whether any."""
    fixed = [one for one in scene.attributes if not one.is_timed]
    rows = [f"| {kind} | {text} |" for kind, text in ((attribute_name(a), _word(a.values)) for a in fixed)]
    parts = (
        ["# Attributes of the scene\n| attribute | value |\n| --- | --- |\n" + "\n".join(rows)]
        if rows
        else []
    )
    if scene.annotations:
        head = "| type | label | id | parent | attributes |\n| --- | --- | --- | --- | --- |\n"
        listed = [_row(one) for one in scene.annotations[:_MOST_ROWS]]
        more = len(scene.annotations) - len(listed)
        rest = f"\n\n… and {more} more" if more else ""
        parts.append(f"# Annotations\n{head}" + "\n".join(listed) + rest)
    if parts:
        stream.static(stream.path(LIST), sdk().TextDocument("\n\n".join(parts), media_type="text/markdown"))
    return bool(parts)


def _row(annotation: Any) -> str:
    attributes: tuple[AttributePath, ...] = getattr(annotation, "attributes", ())
    stated = attribute_text({attribute_name(one): _word(one.values) for one in attributes[:8]})
    parent = "" if annotation.parent_id is None else str(annotation.parent_id)
    cells = (annotation.type, getattr(annotation, "label", None) or "", annotation.id, parent, stated)
    return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def show_corrections(
    stream: Stream, locations: Locations, annotations: tuple[Annotation, ...], notify: Report
) -> None:
    """Show each correction as what it leads to: the corrected ego trajectory, the corrected frustum of a camera."""
    for annotation in annotations:
        if isinstance(annotation, LocalizationAdjustment):
            _show_adjustment(stream, locations, annotation)
        elif isinstance(annotation, CameraCalibration):
            _show_calibration(stream, annotation, notify)


def _show_adjustment(stream: Stream, locations: Locations, annotation: LocalizationAdjustment) -> None:
    """The trajectory p' = A(t) p of the ego; A itself where the ego trajectory is not known.

    As it leads from ego to world then.
    """
    trajectory, poses = locations.path, annotation.poses
    positions = poses.positions
    if trajectory is not None:
        held = poses.held(trajectory.timestamps_ns)
        positions = rotate_vectors(held.quaternions_xyzw, trajectory.positions) + held.positions
    colour = one_packed(colour_of_name(annotation.id))
    shifted = positions - locations.origin_world
    shown = fits(shifted)
    stream.leave_out("poses of corrected ways", np.count_nonzero(~shown))
    line = sdk().LineStrips3D(
        [shifted[shown]],
        colors=np.array([colour], np.uint32),
        radii=np.array([_WIDTH], np.float32),
        labels=["corrected trajectory"],
    )
    stream.static(stream.path(WORLD, "corrected ways", annotation.id), line)
    stream.count("localization adjustments", 1)


def _show_calibration(stream: Stream, annotation: CameraCalibration, notify: Report) -> None:
    """The camera' = camera D(t), with the other camera model if it is reported one."""
    entity = f"{camera_path(stream, annotation.sensor_id)}/calibrated"
    if annotation.poses is not None:
        poses = annotation.poses.held(annotation.poses.timestamps_ns)
        if annotation.poses.static:
            rotation = sdk().Quaternion(xyzw=poses.quaternions_xyzw[0])
            stream.static(entity, sdk().Transform3D(translation=poses.positions[0], quaternion=rotation))
        else:
            held = fits(poses.positions)
            stream.leave_out("poses of calibrations", np.count_nonzero(~held))
            rows = np.flatnonzero(held)
            stream.columns(annotation.poses.timestamps_ns[rows], entity, transform_columns(poses, rows))
    if annotation.intrinsics is not None:
        try:
            stream.static(f"{entity}/camera model", pinhole(straight_camera_model(annotation.intrinsics)))
        except CalibrationError as error:
            notify(
                "camera-model-left",
                f"annotations[{annotation.id!r}]",
                f"its camera model is not drawn: {error}",
            )
    stream.static(entity, sdk().TransformAxes3D(0.5))
    stream.count("camera calibrations", 1)


_EGO, _ANNOTATIONS = "ego", "annotations"

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
        self._links = _link_texts(scene.annotations)
        on_ego = annotations_frame(scene) is Coordinates.EGO
        self._base = stream.path(WORLD, _EGO, _ANNOTATIONS) if on_ego else stream.path(WORLD, _ANNOTATIONS)
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
            yield _PointsLayer(self._group(f"{self._base}/points", label, members), self._origin)

    def links(self) -> Iterable[Layer]:
        """Links between what has locations."""
        found = [one for one in self._scene.annotations if isinstance(one, LinkAnnotation)]
        ends = {key_of(one.id): one for one in self._scene.annotations}
        for label, members in grouped(found, label_of).items():
            yield _LinkLayer(
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
            names = tuple(_point_name(one, k) for one, k, _ in named)
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
