"""Write a scene as an OpenLABEL file."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.formats.base.loss_list import Losses
from sceneloom.formats.base.losses import LossReport, field_losses
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.openlabel.document import (
    ABSOLUTE,
    CONFIRMED,
    EGO,
    INTERPOLATED,
    OURS,
    SCHEMA_VERSION,
    UID,
    WORLD,
    annotation_fields,
    attribute_fields,
)
from sceneloom.formats.openlabel.reader import KEPT, KIND, RBBOX, TYPE
from sceneloom.formats.openlabel.spec import SUPPORTS
from sceneloom.formats.openlabel.streams import Streams
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
    PlainAnnotation,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    locations_of,
)
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, cuboid_poses
from sceneloom.scene.contents import KINDS
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import Coordinates, Identifier, Key, key_of

_Datum = tuple[int | None, str, dict[str, Any]]
"""Time [ns], or None for always; type of the data; the element."""

_CLOSED = (ShapeType.POLYGON, ShapeType.POLYGON_2D, ShapeType.POLYGON_TOPDOWN)
_POINTS = (ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN)


def _cuboid_data(
    cuboid: CuboidAnnotation, name: str, system: str, angles: CuboidAngles, frames_ns: Int64Array
) -> Iterator[_Datum]:
    """A cuboid in each row and, marked as such, in the frames between: centre, quaternion x y z w, sizes.

    Args:
        cuboid: over time.
        name: of the data.
        system: the coordinate system of the cuboid.
        angles: how its angles are meant.
        frames_ns: (M,) int64 [ns], the times of all frames; it is stated in those in which the cuboid is there.
    """
    values = cuboid.path.values
    quaternions = angles.quaternions(values[:, 6:9])
    rows = np.concatenate([values[:, 3:6], quaternions, values[:, :3]], axis=1).tolist()
    between_ns, between = _between(cuboid, angles, frames_ns)
    for time_ns, row in zip(cuboid.path.timestamps_ns.tolist(), rows, strict=True):
        reported = {"attributes": _flag(INTERPOLATED, value=False)} if between else {}
        yield time_ns, "cuboid", {"name": name, "val": row, "coordinate_system": system, **reported}
    for time_ns, row in zip(between_ns, between, strict=True):
        reported = {"attributes": _flag(INTERPOLATED, value=True)}
        yield time_ns, "cuboid", {"name": name, "val": row, "coordinate_system": system, **reported}


def _between(
    cuboid: CuboidAnnotation, angles: CuboidAngles, frames_ns: Int64Array
) -> tuple[list[int], list[list[float]]]:
    """Times and rows of a cuboid in the frames that have no row of its path, as far as it is there."""
    times = frames_ns[~np.isin(frames_ns, cuboid.path.timestamps_ns)]
    poses = cuboid_poses(cuboid, times, angles=angles)
    rows = np.concatenate([poses.centers_world, poses.quaternions_xyzw, poses.sizes_lwh], axis=1)
    there = poses.there & np.isfinite(rows).all(axis=1)
    return times[there].tolist(), rows[there].tolist()


def _flag(name: str, *, value: bool) -> dict[str, Any]:
    return {"boolean": [{"name": name, "val": value}]}


def _projection_data(projection: Projection, name: str, system: str) -> Iterator[_Datum]:
    """The box of a projection in each row that has one: centre and size, and whether a person confirmed it."""
    boxes = projection.boxes
    if boxes is None:
        return
    rows = np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)
    for k in np.flatnonzero(np.isfinite(rows).all(axis=1)).tolist():
        confirmed = None if projection.confirmed is None else projection.confirmed[k]
        reported = {} if confirmed is None else {"attributes": _flag(CONFIRMED, value=confirmed)}
        element = {"name": name, "val": rows[k].tolist(), "coordinate_system": system, **reported}
        yield int(projection.timestamps_ns[k]), "bbox", element


def _box_data(box: Box2DAnnotation, name: str, system: str) -> Iterator[_Datum]:
    """A box in each row: centre and size."""
    values = box.path.values
    rows = np.concatenate([values[:, :2] + values[:, 2:] / 2, values[:, 2:]], axis=1).tolist()
    for time_ns, row in zip(box.path.timestamps_ns.tolist(), rows, strict=True):
        yield time_ns, "bbox", {"name": name, "val": row, "coordinate_system": system}


def _shape_data(shape: ShapeAnnotation, name: str, system: str) -> Iterator[_Datum]:
    """A line, an area or a point in each row; areas that were rotated boxes as these."""
    times = shape.path.timestamps_ns.tolist()
    rotated = shape.path.extras.get(RBBOX)
    if rotated is not None and len(rotated) == len(times):
        for time_ns, row in zip(times, rotated, strict=True):
            yield time_ns, "rbbox", {"name": name, "val": list(row), "coordinate_system": system}
        return
    for time_ns, vertices in zip(times, shape.path.vertices, strict=True):
        kind = f"{'point' if shape.type in _POINTS and len(vertices) == 1 else 'poly'}{shape.dimensions}d"
        element: dict[str, Any] = {
            "name": name,
            "val": vertices.reshape(-1).tolist(),
            "coordinate_system": system,
        }
        if kind.startswith("poly"):
            element["closed"] = shape.type in _CLOSED or bool(shape.is_closed)
        if kind == "poly2d":
            element["mode"] = ABSOLUTE
        yield time_ns, kind, element


def _keypoint_data(points: PointsAnnotation, system: str) -> Iterator[_Datum]:
    """A point in each row of each path, by the names that the points have."""
    for k, path in enumerate(points.paths):
        name = points.labels[k] if points.labels is not None and k < len(points.labels) else f"point{k}"
        if path.values.shape[1] % 3:
            continue
        for time_ns, locations in zip(path.timestamps_ns.tolist(), locations_of(path.values).tolist(), strict=True):
            for location in locations:
                yield (
                    time_ns,
                    "point3d",
                    {"name": f"{name}:{k}", "val": location, "coordinate_system": system},
                )


_FURTHER = frozenset({"type", "attributes", TYPE})
"""Further fields of an attribute that its data state."""


def _attribute_data(attribute: AttributePath, systems: Mapping[Any, str]) -> list[_Datum] | None:
    """The values of an attribute; None where the format has no field for what it says.

    Args:
        attribute: of an object.
        systems: names of coordinate systems by the ids of sensors.
    """
    kinds = {_kind(value, attribute) for value in attribute.values}
    times = attribute.timestamps_ns
    sound = len(kinds) == 1 and None not in kinds and attribute.point_index is None
    if not sound or not (attribute.is_timed or (times is None and len(attribute.values) == 1)):
        return None
    if times is not None and len(np.unique(times)) < len(times):
        return None
    if attribute.sensor_id is not None and attribute.sensor_id not in systems:
        return None
    timestamps: list[int | None] = [None] if times is None else times.tolist()
    kind = str(next(iter(kinds)))
    further = {name: value for name, value in attribute.extras.items() if name in _FURTHER - {TYPE}}
    if attribute.sensor_id is not None:
        further["coordinate_system"] = systems[attribute.sensor_id]
    return [
        (timestamp, kind, {"name": attribute.name, **further, **_reported(kind, value)})
        for timestamp, value in zip(timestamps, attribute.values, strict=True)
    ]


def _reported(kind: str, value: Any) -> dict[str, Any]:
    if isinstance(value, Mapping):
        return dict(value)
    return {"val": list(value) if kind == "vec" else value}


def _kind(value: Any, attribute: AttributePath) -> str | None:
    """The type of data that holds a value; None where none does."""
    if isinstance(value, Mapping):
        kind = attribute.extras.get(TYPE)
        return kind if isinstance(kind, str) else None
    return next((kind for kind, holds in _HOLDS.items() if holds(value)), None)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


_HOLDS: Mapping[str, Callable[[Any], bool]] = MappingProxyType(
    {
        "text": lambda value: isinstance(value, str),
        "boolean": lambda value: isinstance(value, bool),
        "num": _is_number,
        "vec": lambda value: (
            isinstance(value, tuple | list) and all(isinstance(v, str) or _is_number(v) for v in value)
        ),
    }
)


@dataclass(slots=True)
class _Uids:
    """Keys of the elements of a file, which are whole numbers or UUIDs."""

    taken: set[str] = field(default_factory=set)
    by_id: dict[Key, str] = field(default_factory=dict)

    def give(self, identifier: Identifier) -> str:
        """A key for an id: the id itself where the schema takes it, else a UUID made of it."""
        text = str(identifier)
        uid = text
        attempt = 0
        while not UID.fullmatch(uid) or uid in self.taken:
            uid = str(uuid5(NAMESPACE_URL, f"sceneloom:{type(identifier).__name__}:{attempt}:{text}"))
            attempt += 1
        self.taken.add(uid)
        self.by_id[key_of(identifier)] = uid
        return uid


@dataclass(slots=True, eq=False)
class _Draft:
    """The members of a file.

    Attributes:
        times: (N,) int64 [ns] of the frames, ascending.
        heads: entries of the root, by "object" or "event" and key.
        frames: what is stated in each frame, by its number, then as `heads`: the data by type.
        ours: what only we understand of them.
        names: of the data of each object, by its key.
    """

    times: Int64Array
    heads: dict[str, dict[str, dict[str, Any]]] = field(default_factory=lambda: {"object": {}, "event": {}})
    frames: dict[int, dict[str, dict[str, dict[str, list[dict[str, Any]]]]]] = field(default_factory=dict)
    ours: dict[str, dict[str, Any]] = field(default_factory=dict)
    names: dict[str, set[str]] = field(default_factory=dict)

    def renamed(self, uid: str, data: Iterable[_Datum], identifier: Identifier) -> list[_Datum]:
        """Give elements of data names that nothing else of the object has, made of an id where they are taken."""
        taken, given, found = self.names.setdefault(uid, set()), dict[str, str](), list[_Datum]()
        for time_ns, kind, element in data:
            name = element["name"]
            if name not in given:
                attempt, free = 1, name
                while free in taken or free in given.values():
                    free = f"{name}:{identifier}" if attempt == 1 else f"{name}:{identifier}:{attempt}"
                    attempt += 1
                given[name] = free
            found.append((time_ns, kind, {**element, "name": given[name]}))
        taken.update(given.values())
        return found

    def number(self, time_ns: int) -> int:
        """The number of the frame of a time."""
        return int(np.searchsorted(self.times, time_ns))

    def state(self, kind: str, uid: str, data: Iterable[_Datum]) -> None:
        """Put elements of data where they belong: into the frames of their times, or the head."""
        for time_ns, name, element in data:
            if time_ns is None:
                location = self.heads[kind][uid].setdefault(f"{kind}_data", {})
            else:
                frame = self.frames.setdefault(self.number(time_ns), {}).setdefault(kind, {})
                location = frame.setdefault(uid, {})
            location.setdefault(name, []).append(element)

    def close(self) -> None:
        """Report in the heads which frames speak of them, and of which data."""
        for kind in ("object", "event"):
            pointers: dict[str, dict[str, tuple[str, list[int]]]] = {}
            numbers: dict[str, list[int]] = {}
            for number in sorted(self.frames):
                for uid, data in self.frames[number].get(kind, {}).items():
                    numbers.setdefault(uid, []).append(number)
                    for name, elements in data.items():
                        for element in elements:
                            found = pointers.setdefault(uid, {}).setdefault(element["name"], (name, []))
                            if not found[1] or found[1][-1] != number:
                                found[1].append(number)
            for uid, known in numbers.items():
                self.heads[kind][uid].setdefault("frame_intervals", _intervals(known))
            for uid, reported in pointers.items():
                self.heads[kind][uid][f"{kind}_data_pointers"] = {
                    name: {"type": type_, "frame_intervals": _intervals(known)}
                    for name, (type_, known) in reported.items()
                }


def _intervals(numbers: list[int]) -> list[dict[str, int]]:
    """Numbers in order as intervals, both ends included."""
    if not numbers:
        return []
    steps = np.flatnonzero(np.diff(numbers) > 1)
    starts = [numbers[0], *(numbers[k + 1] for k in steps.tolist())]
    stops = [*(numbers[k] for k in steps.tolist()), numbers[-1]]
    return [{"frame_start": start, "frame_end": stop} for start, stop in zip(starts, stops, strict=True)]


_PARTS = (CuboidAnnotation, Box2DAnnotation, ShapeAnnotation, PointsAnnotation, LabeledPointsAnnotation)


def _things(annotations: Sequence[Annotation]) -> Iterator[tuple[Annotation, list[Annotation]]]:
    """Give each annotation that stands for a thing, in their order, with those that report more of the same thing.

    What has an object or a cuboid as its parent, by `parent_id`, and is of no other class reports more of that. A
    cuboid below a cuboid is a thing of its own.
    """
    by_id: dict[Key, Annotation] = {key_of(one.id): one for one in annotations}
    parts: dict[Key, list[Annotation]] = {}
    labels: dict[Key, str | None] = {key_of(one.id): _label(one) for one in annotations}
    alone: list[Annotation] = []
    for one in annotations:
        host = _host(one, by_id)
        key, label = key_of(host.id), _label(one)
        if host is one or (label and labels[key] and label != labels[key]):
            alone.append(one)
            continue
        labels[key] = labels[key] or label
        parts.setdefault(key, []).append(one)
    for one in alone:
        yield one, parts.get(key_of(one.id), [])


def _label(annotation: Any) -> str | None:
    return getattr(annotation, "label", None) or None


def _host(annotation: Annotation, by_id: dict[Key, Annotation]) -> Annotation:
    """The annotation of the thing that another one reports: itself, or what it belongs to."""
    host, above = annotation, _above(annotation, by_id)
    if isinstance(above, CuboidAnnotation):
        host, above = above, _above(above, by_id)
        above = above if isinstance(above, ObjectAnnotation) else None
    return host if above is None else above


def _above(annotation: Any, by_id: dict[Key, Annotation]) -> Annotation | None:
    if annotation.parent_id is None or not isinstance(annotation, _PARTS) or not _is_whole(annotation):
        return None
    parent = by_id.get(key_of(annotation.parent_id))
    is_cuboid = isinstance(parent, CuboidAnnotation) and _is_whole(parent)
    if isinstance(parent, ObjectAnnotation) or (is_cuboid and not isinstance(annotation, CuboidAnnotation)):
        labels = {_label(annotation), _label(parent)} - {None}
        return parent if len(labels) < 2 else None
    return None


def _is_whole(annotation: Any) -> bool:
    """Whether the data of an object state the annotation in one piece: at some time, and by one type of data."""
    if isinstance(annotation, ShapeAnnotation):
        return len({len(vertices) == 1 for vertices in annotation.path.vertices}) == 1
    return not hasattr(annotation, "path") or len(annotation.path.timestamps_ns) > 0


_LEFT_OUT = (LocalizationAdjustment, CameraCalibration, PlainAnnotation)
_NO_POSITION = "left out: OpenLABEL has no field for it"
_SEEN = ("activations", "projections")


def write_openlabel(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write annotations, sensors without their frames, and the ego trajectory.

    Raises:
        OutputError: the file exists, or cannot be written.
        DataError: the metadata name an unknown frame of annotations.
    """
    writer = _Writer(scene)
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_bytes(msgspec.json.encode({"openlabel": writer.document()}))
    return LossReport.of(writer.losses)


class _Writer:
    """Rotates a scene into the document, and keeps what it cannot hold."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.streams = Streams.of(scene)
        self.losses = Losses(field_losses(scene, SUPPORTS))
        self.draft = _Draft(_frame_times(scene))
        self.uids = _Uids()
        self.relations: dict[str, Any] = {}
        self.parts: set[Key] = set()
        in_world = annotations_frame(scene) is Coordinates.WORLD
        self.system = WORLD if in_world else EGO
        self.angles = CuboidAngles.of(scene)

    def document(self) -> dict[str, Any]:
        """The member `openlabel`."""
        written = [one for one in self.scene.annotations if not isinstance(one, _LEFT_OUT)]
        for annotation, parts in _things([one for one in written if not isinstance(one, LinkAnnotation)]):
            self._element(annotation, parts)
        for annotation in written:
            if isinstance(annotation, LinkAnnotation):
                self._relation(annotation)
        self.draft.close()
        self._report_trajectory()
        self.losses.extend(self.streams.losses(self.draft.times))
        kept = self.scene.metadata.get("openlabel")
        kept = {name: kept[name] for name in KEPT if name in kept} if isinstance(kept, Mapping) else {}
        count = len(self.draft.times)
        members = {
            **kept,
            "metadata": {**kept.get("metadata", {}), "schema_version": SCHEMA_VERSION, OURS: self._ours()},
            "coordinate_systems": self.streams.systems(world=self.system == WORLD),
            "streams": self.streams.members(),
            "objects": self.draft.heads["object"],
            "events": self.draft.heads["event"],
            "relations": self.relations,
            "frames": {str(number): self._frame(number) for number in range(count)},
            "frame_intervals": [{"frame_start": 0, "frame_end": count - 1}] if count else [],
        }
        return {name: value for name, value in members.items() if value}

    def _frame(self, number: int) -> dict[str, Any]:
        time_ns = int(self.draft.times[number])
        properties: dict[str, Any] = {"timestamp": seconds_text(time_ns)}
        for name, value in (
            ("transforms", self.streams.transforms(time_ns)),
            ("streams", self.streams.syncs(time_ns)),
        ):
            properties.update({name: value} if value else {})
        frame: dict[str, Any] = {"frame_properties": properties}
        for kind, stated in self.draft.frames.get(number, {}).items():
            frame[f"{kind}s"] = {uid: {f"{kind}_data": data} for uid, data in stated.items()}
        return frame

    def _ours(self) -> dict[str, Any]:
        """What only we understand: fields of annotations, and metadata as far as JSON holds them."""
        found: dict[str, Any] = dict(self.draft.ours)
        names = list(self.scene.trajectories)
        found.update({"trajectory": names[0]} if names and self.streams.trajectory is not None else {})
        own = {name: value for name, value in self.scene.metadata.items() if name != "openlabel"}
        metadata = {name: value for name, value in own.items() if _is_json(value)}
        for name in own.keys() - metadata.keys():
            self.losses.dropped(f"metadata.{name}", "left out: JSON cannot state it")
        return {**found, **({"metadata": metadata} if metadata else {})}

    def _element(self, annotation: Any, parts: Sequence[Annotation]) -> None:
        """Write a thing: its annotation, and those that report more of it as further data of the same object."""
        kind = "event" if isinstance(annotation, EventAnnotation) else "object"
        uid = self.uids.give(annotation.id)
        further = annotation.extras.get(KIND)
        further = dict(further) if isinstance(further, Mapping) else {}
        head = {name: further[name] for name in ("ontology_uid", "resource_uid") if name in further}
        name = further.get("name")
        label = next((stated for one in (annotation, *parts) if (stated := getattr(one, "label", None))), None)
        self.draft.heads[kind][uid] = {
            "name": name if isinstance(name, str) else str(annotation.id),
            "type": label or "",
            **head,
        }
        if isinstance(annotation, EventAnnotation):
            stop_ns = annotation.start_ns + int(annotation.duration_ns or 0)
            self.draft.heads[kind][uid]["frame_intervals"] = [
                {
                    "frame_start": self.draft.number(annotation.start_ns),
                    "frame_end": self.draft.number(stop_ns),
                }
            ]
        fields = self._state(kind, uid, annotation, further, label)
        if parts:
            fields.update({} if fields["data"] else {"is_whole": True})
            fields["parts"] = [self._part(kind, uid, part, label) for part in parts]
        del fields["data"]
        self.draft.ours.setdefault(kind, {})[uid] = fields

    def _part(self, kind: str, uid: str, part: Any, label: str | None) -> dict[str, Any]:
        self.uids.by_id[key_of(part.id)] = uid
        self.parts.add(key_of(part.id))
        further = part.extras.get(KIND)
        return self._state(kind, uid, part, dict(further) if isinstance(further, Mapping) else {}, label, is_part=True)

    def _state(
        self,
        kind: str,
        uid: str,
        annotation: Any,
        further: Mapping[str, Any],
        label: str | None,
        *,
        is_part: bool = False,
    ) -> dict[str, Any]:
        """Report an annotation as data of an object, and give the fields that only we understand."""
        fields = annotation_fields(annotation)
        fields.update(_CLASS_FIELDS.get(type(annotation), lambda _: {})(annotation))
        if label is not None and getattr(annotation, "label", label) is None:
            fields["unlabelled"] = True
        data = self.draft.renamed(uid, self._data(annotation, further), annotation.id)
        fields["data"] = list(dict.fromkeys(element["name"] for _, _, element in data))
        if isinstance(annotation, CuboidAnnotation) and any("attributes" in one for _, _, one in data):
            fields["interpolated"] = True
        self.draft.state(kind, uid, data)
        self._report_fields(annotation)
        unsaid, renamed = self._attributes(kind, uid, annotation, is_part=is_part)
        fields.update({"attributes": unsaid} if unsaid else {})
        fields.update({"own": renamed} if renamed else {})
        fields.update(self._seen(kind, uid, annotation))
        fields.update(self._path_extras(annotation))
        if _is_json(dict(annotation.extras)):
            fields["extras"] = dict(annotation.extras)
        else:
            field = f"annotations[{annotation.id}].extras"
            self.losses.dropped(field, "left out: JSON cannot state it")
        return fields

    def _seen(self, kind: str, uid: str, annotation: Any) -> dict[str, Any]:
        """Report where and when sensors see a cuboid: the boxes as data, the rest among our fields."""
        found: dict[str, Any] = {}
        if isinstance(annotation, PointsAnnotation) and annotation.projections:
            points = annotation.projections
            seen = [[self._sound(annotation, _point_projection_fields(one)) for one in row] for row in points]
            return {"projections": seen}
        if not isinstance(annotation, CuboidAnnotation):
            return found
        if not len(annotation.path.timestamps_ns):
            for name in _SEEN:
                if count := len(getattr(annotation, name)):
                    field = f"annotations[{annotation.id}].{name}"
                    self.losses.dropped(field, _NO_POSITION, count=count)
            return found
        rows = [self._sound(annotation, _activation_fields(one)) for one in annotation.activations]
        found.update({"activations": rows} if rows else {})
        rows = []
        for projection in annotation.projections:
            fields = self._sound(annotation, _projection_fields(projection))
            system = self._camera(projection.sensor_id)
            data = list(_projection_data(projection, f"projection:{system}", system))
            if len({time_ns for time_ns, _, _ in data}) == len(data) and data:
                data = self.draft.renamed(uid, data, annotation.id)
                self.draft.state(kind, uid, data)
                fields.update({"data": data[0][2]["name"], "boxes": None})
            rows.append(fields)
        found.update({"projections": rows} if rows else {})
        return found

    def _sound(self, annotation: Annotation, fields: dict[str, Any]) -> dict[str, Any]:
        """Leave out further fields that JSON cannot state, and report it."""
        if _is_json(fields.get("extras")):
            return fields
        field, count = f"annotations[{annotation.id}].extras", len(fields["extras"])
        self.losses.dropped(field, "left out: JSON cannot state it", count=count)
        return {name: value for name, value in fields.items() if name != "extras"}

    def _path_extras(self, annotation: Any) -> dict[str, Any]:
        path = getattr(annotation, "path", None)
        further = {} if path is None else {name: path.extras[name] for name in path.extras if name != RBBOX}
        if not further:
            return {}
        if _is_json(further):
            return {"path_extras": further}
        field = f"annotations[{annotation.id}].path.extras"
        self.losses.dropped(field, "left out: JSON cannot state it", count=len(further))
        return {}

    def _data(self, annotation: Annotation, further: Mapping[str, Any]) -> list[_Datum]:
        """The locations of an annotation, if it has some."""
        reported = further.get("data")
        reported = dict(reported) if isinstance(reported, Mapping) else {}
        name = reported.pop("name", None)
        data: list[_Datum] = []
        if isinstance(annotation, CuboidAnnotation):
            data = list(_cuboid_data(annotation, name or "cuboid", self.system, self.angles, self.draft.times))
        elif isinstance(annotation, Box2DAnnotation):
            data = list(_box_data(annotation, name or "bbox", self._camera(annotation.sensor_id)))
        elif isinstance(annotation, ShapeAnnotation):
            flat = annotation.dimensions == 2
            system = self._camera(annotation.sensor_id) if flat else self.system
            data = list(_shape_data(annotation, name or annotation.type.value, system))
        elif isinstance(annotation, PointsAnnotation):
            return list(_keypoint_data(annotation, self.system))
        return [(time_ns, kind, {**reported, **element}) for time_ns, kind, element in data]

    def _camera(self, sensor_id: Any) -> str:
        return self.streams.names.get(sensor_id, str(sensor_id))

    def _attributes(
        self, kind: str, uid: str, annotation: Any, *, is_part: bool
    ) -> tuple[list[dict[str, Any]], list[list[str]]]:
        """Write the attributes; give those that the data cannot hold, and type, name and own name of a part's."""
        unsaid, renamed, seen = [], [], set()
        for attribute in annotation.attributes:
            data = _attribute_data(attribute, self.streams.names)
            key = None if not data else (data[0][1], attribute.name)
            if data and key not in seen and not self._collides(annotation, attribute.name):
                seen.add(key)
                if is_part:
                    data = self.draft.renamed(uid, data, annotation.id)
                    renamed.append([data[0][1], data[0][2]["name"], attribute.name])
                self.draft.names.setdefault(uid, set()).add(attribute.name)
                self.draft.state(kind, uid, data)
                self._report_further(annotation, attribute)
                if attribute.timestamps_ns is None and not attribute.static:
                    what = "an attribute without times is read back as one that holds always"
                    field = f"annotations[{annotation.id}].attributes"
                    self.losses.converted(field, what)
            elif _is_json([*attribute.values, dict(attribute.extras)]):
                unsaid.append(attribute_fields(attribute))
            else:
                field = f"annotations[{annotation.id}].attributes.{attribute.name}"
                self.losses.dropped(field, "left out: JSON cannot state it")
        return unsaid, renamed

    def _report_further(self, annotation: Any, attribute: AttributePath) -> None:
        unsaid = attribute.extras.keys() - _FURTHER
        if unsaid:
            field = f"annotations[{annotation.id}].attributes.{attribute.name}"
            what = f"further fields left out: {', '.join(sorted(unsaid))}"
            self.losses.dropped(field, what)

    def _collides(self, annotation: Any, name: str) -> bool:
        """Whether an attribute of points would be taken for another."""
        return isinstance(annotation, PointsAnnotation) and any(
            attribute.name == name and attribute.point_index is not None for attribute in annotation.attributes
        )

    def _report_fields(self, annotation: Any) -> None:
        """Report what an annotation says that is not written."""
        held = getattr(annotation, "path", None)
        if held is not None and not len(held.timestamps_ns):
            what = "it has no location at any time: read back as an object without one"
            self.losses.dropped(f"annotations[{annotation.id}]", what)

    def _keep(self, kind: str, uid: str, annotation: Any, fields: dict[str, Any]) -> None:
        """Keep the fields that only we understand, and the further ones that JSON can state."""
        if _is_json(dict(annotation.extras)):
            fields["extras"] = dict(annotation.extras)
        else:
            field = f"annotations[{annotation.id}].extras"
            self.losses.dropped(field, "left out: JSON cannot state it")
        self.draft.ours.setdefault(kind, {})[uid] = fields

    def _relation(self, link: LinkAnnotation) -> None:
        ends = [self.uids.by_id.get(key_of(one)) for one in (link.from_id, link.to_id)]
        if None in ends:
            what = "left out: one of its ends is not written"
            self.losses.dropped(f"annotations[{link.id}]", what)
            return
        uid = self.uids.give(link.id)
        subject, other = ({"uid": str(end), "type": self._kind_of(str(end))} for end in ends)
        further = link.extras.get(KIND)
        further = dict(further) if isinstance(further, Mapping) else {}
        self.relations[uid] = {
            "name": further.get("name", str(link.id)),
            "type": link.label or "",
            "rdf_subjects": [subject],
            "rdf_objects": [other],
            **{name: further[name] for name in ("ontology_uid", "resource_uid") if name in further},
        }
        fields = annotation_fields(link)
        for name, end in (("from_id", link.from_id), ("to_id", link.to_id)):
            fields.update({name: end} if key_of(end) in self.parts else {})
        self._keep("relation", uid, link, fields)

    def _kind_of(self, uid: str) -> str:
        return "event" if uid in self.draft.heads["event"] else "object"

    def _report_trajectory(self) -> None:
        """Report how the ego trajectory is sampled, and of which sensors the trajectories."""
        for name, trajectory in list(self.scene.trajectories.items())[:1]:
            if trajectory.quaternions_xyzw is None:
                self.losses.dropped(f"trajectories[{name}]", "left out: it has no orientations")
            elif not np.isin(trajectory.timestamps_ns, self.draft.times).all():
                what = "written at the times of the frames"
                field = f"trajectories[{name}].timestamps_ns"
                count = len(trajectory.timestamps_ns)
                self.losses.approximated(field, what, count=count)
        for name, trajectory in list(self.scene.trajectories.items())[1:]:
            what = "left out: the format has one ego trajectory"
            self.losses.dropped(f"trajectories[{name}]", what, count=len(trajectory.timestamps_ns))


def _labeled_points(annotation: LabeledPointsAnnotation) -> dict[str, Any]:
    return {
        "class": "labeled_points",
        "type": annotation.type,
        "labeled_points": [
            {
                "sensor_id": one.sensor_id,
                "point_ids": one.point_ids.tolist(),
                **({} if one.sensor_frame is None else {"sensor_frame": one.sensor_frame}),
                **({"extras": dict(one.extras)} if one.extras and _is_json(dict(one.extras)) else {}),
            }
            for one in annotation.labeled_points
        ],
    }


def _points(annotation: PointsAnnotation) -> dict[str, Any]:
    return {
        "class": "points",
        "labels": None if annotation.labels is None else list(annotation.labels),
        "paths": [
            {
                "timestamps_ns": one.timestamps_ns.tolist(),
                "values": one.values.tolist(),
                "id": one.id,
                **({"extras": dict(one.extras)} if one.extras and _is_json(dict(one.extras)) else {}),
            }
            for one in annotation.paths
        ],
    }


_CLASS_FIELDS: Mapping[type[Any], Any] = {
    LabeledPointsAnnotation: _labeled_points,
    PointsAnnotation: _points,
    GroupAnnotation: lambda _: {"class": "group"},
    ObjectAnnotation: lambda annotation: (
        {} if annotation.type == "object" else {"class": "object", "type": annotation.type}
    ),
    ShapeAnnotation: lambda annotation: {"shape": annotation.type.value},
}
"""Fields of classes that the format does not have."""


def _frame_times(scene: Scene) -> Int64Array:
    """The times that the file has frames of: those of annotations, and of the first lidar's or camera's frames."""
    found: list[Int64Array] = []
    for annotation in scene.annotations:
        if KINDS[type(annotation)] in {
            "annotations.localization_adjustment",
            "annotations.camera_calibration",
        }:
            continue
        paths = [getattr(annotation, "path", None), *getattr(annotation, "paths", ())]
        found += [path.timestamps_ns for path in paths if path is not None]
        found += [one.timestamps_ns for one in getattr(annotation, "attributes", ()) if one.timestamps_ns is not None]
        if isinstance(annotation, CuboidAnnotation):
            found += [one.timestamps_ns for one in annotation.projections if one.boxes is not None]
        if isinstance(annotation, EventAnnotation):
            stop_ns = annotation.start_ns + int(annotation.duration_ns or 0)
            found.append(np.array([annotation.start_ns, stop_ns], np.int64))
    sensors: list[Sensor] = [*scene.lidars, *scene.cameras]
    references = [times for one in sensors if len(times := frame_times(one))]
    found += references[:1]
    if not any(len(times) for times in found):
        found = [trajectory.timestamps_ns for trajectory in list(scene.trajectories.values())[:1]]
    return np.unique(np.concatenate(found)) if found else np.zeros(0, np.int64)


def _seen_fields(seen: Activation | Projection | PointProjection) -> dict[str, Any]:
    return {
        "sensor_id": seen.sensor_id,
        "timestamps_ns": seen.timestamps_ns.tolist(),
        **({"extras": dict(seen.extras)} if seen.extras else {}),
    }


def _rows(values: Float64Array | None) -> list[list[float]] | None:
    return None if values is None else values.tolist()


def _activation_fields(seen: Activation) -> dict[str, Any]:
    """Report when a sensor sees a cuboid."""
    durations = None if seen.durations_ns is None else list(seen.durations_ns)
    return {**_seen_fields(seen), "durations_ns": durations, "cuboids": _rows(seen.cuboids)}


def _projection_fields(seen: Projection) -> dict[str, Any]:
    """Report where a camera sees a cuboid, and what was confirmed of that."""
    confirmed = None if seen.confirmed is None else list(seen.confirmed)
    stated = {"boxes": _rows(seen.boxes), "confirmed": confirmed, "cuboids": _rows(seen.cuboids)}
    return {**_seen_fields(seen), **stated}


def _point_projection_fields(seen: PointProjection) -> dict[str, Any]:
    """Report where a camera sees a named point, and what was confirmed of that."""
    confirmed = None if seen.confirmed is None else list(seen.confirmed)
    stated = {"points": _rows(seen.points), "confirmed": confirmed, "positions": _rows(seen.positions)}
    return {**_seen_fields(seen), **stated}


def _is_json(value: Any) -> bool:
    """Whether JSON says a value as it is."""
    try:
        return bool(msgspec.json.decode(msgspec.json.encode(value)) == value)
    except (TypeError, ValueError, OverflowError, msgspec.MsgspecError, RecursionError):
        return False
