"""Read an OpenLABEL file: objects, actions, events, contexts and relations as annotations."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import read_bytes
from sceneloom.formats.base.spec import as_positive
from sceneloom.formats.openlabel.document import (
    ABSOLUTE,
    CONFIRMED,
    ELEMENTS,
    GEOMETRY,
    INTERPOLATED,
    KEPT_WHOLE,
    OURS,
    PLAIN,
    RELATIVE,
    SCHEMA_VERSION,
    Ours,
    Part,
    SeenBoxes,
    restored_from,
)
from sceneloom.formats.openlabel.streams import ego_path, read_streams
from sceneloom.formats.openlabel.systems import (
    FrameTimes,
    Systems,
    frame_times,
    read_systems,
    rotation_from_euler,
    unit_quaternions,
)
from sceneloom.geometry.rotations import multiply_quaternions, quaternion_from_matrix, rotate_vectors
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    BoxPath,
    CuboidAnnotation,
    CuboidPath,
    EventAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
    ShapeAnnotation,
    ShapeType,
    VertexPath,
)
from sceneloom.scene.annotations_at import CuboidAngles
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier
from sceneloom.warnings import WarningKind


@dataclass(frozen=True, slots=True)
class _Stated:
    """One element of data at one time.

    Attributes:
        time_ns: of its frame [ns]; None where it holds for the whole object.
        part: the element.
    """

    time_ns: int | None
    part: Part


@dataclass(slots=True)
class _Element:
    """All that a file says of one object, action, event or context.

    Attributes:
        kind: "object", "action", "event" or "context".
        uid: its key.
        id: its key, with its kind where something else of the file has the same key.
        head: its entry in the root.
        data: what is stated for it, by the type and the name of the data.
        frames: numbers of the frames that name it.
    """

    kind: str
    uid: str
    id: str
    head: Part
    data: dict[tuple[str, str], list[_Stated]] = field(default_factory=dict)
    frames: list[int] = field(default_factory=list)

    @property
    def intervals(self) -> list[tuple[int, int]]:
        """First and last frame of each interval that its entry names."""
        found = []
        for interval in self.head.items("frame_intervals"):
            ends = [interval.need(name).value for name in ("frame_start", "frame_end")]
            if not all(isinstance(end, int) and 0 <= end < 1 << 53 for end in ends) or ends[0] > ends[1]:
                raise interval.fault("frame_start and frame_end, two numbers of frames in order")
            found.append((ends[0], ends[1]))
        return found


def _gather(document: Part, times: FrameTimes) -> list[_Element]:
    """Gather the data of all elements, in the order of the file.

    Raises:
        DataError: an element is wrong, or a frame names one that has no entry.
    """
    found: dict[tuple[str, str], _Element] = {}
    taken: set[str] = set()
    for listed, kind in ELEMENTS.items():
        for uid, head in document.each(listed):
            element = _Element(kind, uid, uid if uid not in taken else f"{kind}:{uid}", head)
            taken.add(uid)
            found[kind, uid] = element
            _take(element, head.get(f"{kind}_data"), None)
    for key, frame in document.each("frames"):
        if not key.isdigit():
            continue
        for listed, kind in ELEMENTS.items():
            for uid, entry in frame.each(listed):
                if (kind, uid) not in found:
                    raise entry.fault(f"an entry openlabel.{listed}.{uid} of the {kind} that it speaks of")
                found[kind, uid].frames.append(int(key))
                if isinstance(entry.value, dict):
                    _take(found[kind, uid], entry.get(f"{kind}_data"), times.at(int(key)))
    return list(found.values())


def _take(element: _Element, data: Part | None, time_ns: int | None) -> None:
    if data is None:
        return
    for kind, values in data.members().items():
        seen: dict[str, int] = {}
        for part in _parts(data, kind, values):
            name = part.members().get("name")
            name = name if isinstance(name, str) else kind
            seen[name] = seen.get(name, 0) + 1
            unique = name if seen[name] == 1 else f"{name}#{seen[name]}"
            element.data.setdefault((kind, unique), []).append(_Stated(time_ns, part))


def _parts(data: Part, kind: str, values: Any) -> Iterator[Part]:
    if kind not in (*GEOMETRY, *PLAIN, *KEPT_WHOLE):
        known = ", ".join((*GEOMETRY, *PLAIN, *KEPT_WHOLE))
        raise Part(data.file, f"{data.location}.{kind}", values).fault(f"a type of data out of {known}")
    return data.items(kind)


RBBOX = "rbbox"
"""Further field of a path: the rotated boxes that its polygons were made of, rows x y w h angle."""

_Geometry = CuboidAnnotation | Box2DAnnotation | ShapeAnnotation
_ANGLES = CuboidAngles()


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The rows of one element of data, in the order of their times.

    Attributes:
        stated: at least one; of a location that holds always, the only one.
        timestamps_ns: (N,) int64 [ns].
        system: the coordinate system that they name, or None.
        systems: all of them.
        camera: the sensor of what is drawn in images.
        fields: of the annotation.
    """

    stated: tuple[_Stated, ...]
    timestamps_ns: Int64Array
    system: str | None
    systems: Systems
    camera: Identifier
    fields: Mapping[str, Any]

    def in_root(self, points: Sequence[Float64Array]) -> tuple[Float64Array, ...]:
        """Bring (V, 3) locations of each row into the root of their coordinate system."""
        if self.system is None or len(self.systems.chain(self.system)) == 1:
            return tuple(points)
        positions, quaternions = self.systems.root_from(self.system, self.timestamps_ns)
        moved = zip(points, positions, quaternions, strict=True)
        return tuple(rotate_vectors(quaternion, one) + position for one, position, quaternion in moved)

    def rotated_to_root(self, quaternions_xyzw: Float64Array) -> Float64Array:
        """Bring (N, 4) rotations into the root."""
        if self.system is None or len(self.systems.chain(self.system)) == 1:
            return quaternions_xyzw
        return multiply_quaternions(self.systems.root_from(self.system, self.timestamps_ns)[1], quaternions_xyzw)


def _cuboid(rows: _Rows) -> _Geometry:
    parts = [row.part.need("val") for row in rows.stated]
    values = [part.numbers((9, 10)) for part in parts]
    quaternions = unit_quaternions(parts, [_quaternion(*one) for one in zip(parts, values, strict=True)])
    angles = _ANGLES.from_quaternions(rows.rotated_to_root(quaternions))
    locations = np.concatenate(rows.in_root([np.array([one[:3]]) for one in values]))
    values_9 = np.concatenate([np.array([one[-3:] for one in values]), locations, angles], axis=1)
    return CuboidAnnotation(path=CuboidPath(rows.timestamps_ns, values_9), **rows.fields)


def _quaternion(part: Part, values: list[float]) -> list[float]:
    """The quaternion of a row, x y z w, which has it, or the Euler angles of one."""
    if len(values) == 10:
        return values[3:7]
    return [*map(float, quaternion_from_matrix(rotation_from_euler(part, values[5:2:-1], "ZYX")))]


def _bbox(rows: _Rows) -> _Geometry:
    values = np.array([row.part.need("val").numbers((4,)) for row in rows.stated])
    boxes = np.concatenate([values[:, :2] - values[:, 2:] / 2, values[:, 2:]], axis=1)
    return Box2DAnnotation(sensor_id=rows.camera, path=BoxPath(rows.timestamps_ns, boxes), **rows.fields)


def _rbbox(rows: _Rows) -> _Geometry:
    values = [row.part.need("val").numbers((5,)) for row in rows.stated]
    corners = tuple(_rotated_corners(*one) for one in values)
    path = VertexPath(rows.timestamps_ns, corners, extras=MappingProxyType({RBBOX: values}))
    return ShapeAnnotation(type=ShapeType.POLYGON_2D, path=path, sensor_id=rows.camera, **rows.fields)


def _rotated_corners(x: float, y: float, width: float, height: float, angle: float) -> Float64Array:
    halves = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * (width / 2, height / 2)
    cosine, sine = np.cos(angle), np.sin(angle)
    corners: Float64Array = halves @ np.array([[cosine, sine], [-sine, cosine]]) + (x, y)
    return corners


def _poly2d(rows: _Rows) -> _Geometry:
    vertices = tuple(_vertices_2d(row.part) for row in rows.stated)
    kind = ShapeType.POLYGON_2D if _is_closed(rows) else ShapeType.POLYLINE_2D
    path = VertexPath(rows.timestamps_ns, vertices)
    return ShapeAnnotation(type=kind, path=path, sensor_id=rows.camera, **rows.fields)


def _vertices_2d(part: Part) -> Float64Array:
    mode = part.get("mode")
    if mode is not None and mode.value not in {ABSOLUTE, RELATIVE}:
        raise mode.fault(f"{ABSOLUTE} or {RELATIVE}; chain codes are not read")
    values = np.array(part.need("val").numbers())
    if len(values) % 2:
        raise DataError(part.file, f"{part.location}.val", f"{len(values)} numbers; expected pairs")
    vertices = values.reshape(-1, 2)
    return np.cumsum(vertices, axis=0) if mode is not None and mode.value == RELATIVE else vertices


def _poly3d(rows: _Rows) -> _Geometry:
    vertices = []
    for row in rows.stated:
        values = row.part.need("val").numbers()
        if len(values) % 3:
            problem = f"{len(values)} numbers; expected triples"
            raise DataError(row.part.file, f"{row.part.location}.val", problem)
        vertices.append(np.array(values).reshape(-1, 3))
    kind = ShapeType.POLYGON if _is_closed(rows) else ShapeType.POLYLINE
    return ShapeAnnotation(type=kind, path=VertexPath(rows.timestamps_ns, rows.in_root(vertices)), **rows.fields)


def _is_closed(rows: _Rows) -> bool:
    return bool(rows.stated[0].part.members().get("closed"))


def _point2d(rows: _Rows) -> _Geometry:
    vertices = tuple(np.array([row.part.need("val").numbers((2,))]) for row in rows.stated)
    return ShapeAnnotation(
        type=ShapeType.POINT_2D,
        path=VertexPath(rows.timestamps_ns, vertices),
        sensor_id=rows.camera,
        **rows.fields,
    )


def _point3d(rows: _Rows) -> _Geometry:
    vertices = [np.array([row.part.need("val").numbers((3,))]) for row in rows.stated]
    return ShapeAnnotation(
        type=ShapeType.POINT, path=VertexPath(rows.timestamps_ns, rows.in_root(vertices)), **rows.fields
    )


_READERS: Mapping[str, Callable[[_Rows], _Geometry]] = MappingProxyType(
    {
        "cuboid": _cuboid,
        "bbox": _bbox,
        "rbbox": _rbbox,
        "poly2d": _poly2d,
        "poly3d": _poly3d,
        "point2d": _point2d,
        "point3d": _point3d,
    }
)
"""What makes an annotation of the rows of each type of data."""

_IN_IMAGES = ("bbox", "rbbox", "poly2d", "point2d")
"""Types of data that are drawn in the images of a camera."""

TYPE = "openlabel_type"
"""Further field of an attribute: the type of its data, where the value does not report it."""

_TAKEN = ("name", "val", "coordinate_system")


def _attribute(kind: str, name: str, rows: Sequence[_Stated]) -> AttributePath:
    """What was stated under one name, over time.

    Raises:
        DataError: a value is none of its kind.
    """
    ordered = sorted(rows, key=lambda row: (row.time_ns is not None, row.time_ns or 0))
    values = tuple(_value(kind, row.part) for row in ordered)
    times = [row.time_ns for row in ordered if row.time_ns is not None]
    first = ordered[0].part.members()
    further = {} if kind in KEPT_WHOLE else {key: first[key] for key in first if key not in _TAKEN}
    if kind in KEPT_WHOLE:
        further[TYPE] = kind
    seen_by = first.get("coordinate_system") if kind in PLAIN else None
    static = len(times) < len(values)
    return AttributePath(
        name,
        values,
        None if static else np.array(times, np.int64),
        sensor_id=seen_by if isinstance(seen_by, str) else None,
        static=True if static else None,
        extras=MappingProxyType(further),
    )


def _nested_flag(row: _Stated, name: str) -> bool | None:
    """A boolean that stands inside of an element of data, or None."""
    attributes = row.part.get("attributes")
    for part in () if attributes is None else attributes.items("boolean"):
        value = part.members().get("val")
        if part.members().get("name") == name and isinstance(value, bool):
            return value
    return None


def _nested_attributes(rows: Iterable[_Stated], *, without: Sequence[str] = ()) -> tuple[AttributePath, ...]:
    """The attributes that stand inside of elements of data, but for some by their names."""
    found: dict[tuple[str, str], list[_Stated]] = {}
    for row in rows:
        attributes = row.part.get("attributes")
        if attributes is None:
            continue
        for kind in PLAIN:
            for part in attributes.items(kind):
                name = part.members().get("name")
                if name in without:
                    continue
                found.setdefault((kind, name if isinstance(name, str) else kind), []).append(_Stated(row.time_ns, part))
    return tuple(_attribute(kind, name, parts) for (kind, name), parts in found.items())


def _value(kind: str, part: Part) -> Any:
    if kind in KEPT_WHOLE:
        return {key: value for key, value in part.members().items() if key != "name"}
    value = part.need("val").value
    sound = _SOUND[kind](value)
    if not sound:
        raise part.need("val").fault(f"the value of a {kind}")
    return tuple(value) if kind == "vec" else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_SOUND: Mapping[str, Callable[[Any], bool]] = {
    "text": lambda value: isinstance(value, str),
    "boolean": lambda value: isinstance(value, bool),
    "num": _is_number,
    "vec": lambda value: isinstance(value, list) and all(isinstance(v, str) or _is_number(v) for v in value),
}

KIND = "openlabel"
"""Further field of an annotation: what the file calls it and says of it besides."""

_HEAD = ("type", "frame_intervals", "object_data", "object_data_pointers", "action_data", "action_data_pointers",
         "event_data", "event_data_pointers", "context_data", "context_data_pointers")  # fmt: skip

_OF_ROWS = ("name", "val", "coordinate_system", "attributes", "closed", "mode")


@dataclass(frozen=True, slots=True, eq=False)
class _Reader:
    """What elements are read with.

    Attributes:
        times: of the frames.
        systems: the coordinate systems.
        sensors: by the names of streams.
        ours: what we wrote of them besides, if it was us.
        ledger: takes warnings, and faults in a lenient reading.
    """

    times: FrameTimes
    systems: Systems
    sensors: dict[str, Sensor]
    ours: Ours
    ledger: Ledger

    def annotations(self, elements: Sequence[_Element]) -> Iterator[Annotation]:
        """Make annotations of all elements; one that is wrong is left out of a lenient reading."""
        for element in elements:
            try:
                yield from self._of_object(element) if element.kind == "object" else [self._of_event(element)]
            except DataError as error:
                self.ledger.fault("elements", error)

    def _of_object(self, element: _Element) -> list[Annotation]:
        label = element.head.need("type").text() or None
        own, stated = self.ours.fields_of(element.kind, element.uid), dict(element.data)
        members = {} if own is None else own.members()
        parts = [] if own is None else [self._part(element, label, one, stated) for one in own.items("parts")]
        drawn = {} if own is None else _drawn(own, stated)
        plain = tuple(_attribute(*key, rows) for key, rows in stated.items() if key[0] not in GEOMETRY)
        shapes = {key: rows for key, rows in stated.items() if key[0] in GEOMETRY and self._is_read(key, rows)}
        if self.ours.class_of(element.kind, element.uid) == "points":
            shapes = {}
        extras = _further(element)
        alone = len(shapes) == 1 and members.get("is_whole") is not True
        made: list[Annotation] = []
        whole: Annotation = ObjectAnnotation(element.id, label, attributes=plain, extras=extras)
        if own is not None and not alone:
            whole = restored_from(own, whole)
        for (kind, name), rows in shapes.items():
            key_rows, without = _key_rows(rows, members)
            fields: dict[str, Any] = {
                "id": element.id if alone else f"{element.id}:{kind}:{name}",
                "label": label,
                "attributes": (*_nested_attributes(key_rows, without=without), *(plain if alone else ())),
                "extras": _shape_extras(extras if alone else {}, kind, name, rows),
                **({} if alone else {"parent_id": whole.id}),
            }
            made.append(_READERS[kind](self._rows(kind, key_rows, fields)))
        if alone:
            whole = made.pop() if own is None else restored_from(own, made.pop(), drawn)
        return [whole, *(one for one in parts if one is not None), *made]

    def _part(
        self, element: _Element, label: str | None, own: Part, stated: dict[tuple[str, str], list[_Stated]]
    ) -> Annotation | None:
        """An annotation that we wrote as data of the object of another; None where these were taken out.

        Args:
            element: the object.
            label: its class.
            own: what we wrote of the annotation besides.
            stated: what is stated for the object; what belongs to the annotation is taken out.
        """
        members, drawn = own.members(), _drawn(own, stated)
        names = [name.text() for name in own.items("data")]
        keys = [key for key in stated if key[0] in GEOMETRY and key[1] in names]
        shapes = {key: rows for key in keys if self._is_read(key, rows := stated.pop(key))}
        plain = []
        for listed in own.items("own"):
            kind, name, called = _texts(listed, 3)
            reported = stated.pop((kind, name), [])
            plain += [_attribute(kind, called, reported)] if reported else []
        if names and not shapes:
            return None
        whole = ObjectAnnotation(element.id, label, attributes=tuple(plain))
        if "class" in members or not shapes:
            return restored_from(own, whole)
        (kind, name), rows = next(iter(shapes.items()))
        key_rows, without = _key_rows(rows, members)
        fields: dict[str, Any] = {
            "id": f"{element.id}:{kind}:{name}",
            "label": label,
            "attributes": (*_nested_attributes(key_rows, without=without), *plain),
            "extras": _shape_extras({}, kind, name, rows),
        }
        return restored_from(own, _READERS[kind](self._rows(kind, key_rows, fields)), drawn)

    def _is_read(self, key: tuple[str, str], rows: list[_Stated]) -> bool:
        """Whether a shape is of a form that we know; cuboids without a value state that there is none."""
        rows[:] = [row for row in rows if row.part.members().get("val") is not None]
        if not rows:
            return False
        mode = rows[0].part.members().get("mode", ABSOLUTE)
        if key[0] != "poly2d" or mode in {ABSOLUTE, RELATIVE}:
            return True
        location = f"{rows[0].part.file}: {rows[0].part.location}"
        reported = f"polygons of the mode {mode} are chain codes, which are not read"
        self.ledger.note(WarningKind.SKIPPED, "poly2d-mode", location, reported, count=len(rows))
        return False

    def _rows(self, kind: str, rows: Sequence[_Stated], fields: dict[str, Any]) -> _Rows:
        if any(row.time_ns is None for row in rows):
            # what holds for the whole object is stationary
            rows = [row for row in rows if row.time_ns is None][:1]
            fields["stationary"] = True
        ordered = sorted(rows, key=lambda row: row.time_ns or 0)
        times = [self.times.first_ns if row.time_ns is None else row.time_ns for row in ordered]
        system = ordered[0].part.get("coordinate_system")
        name = None if system is None else system.text()
        if any(row.part.members().get("coordinate_system") != name for row in ordered):
            raise ordered[0].part.fault("the same coordinate_system in all frames")
        camera = self._camera(name, ordered[0].part) if kind in _IN_IMAGES else ""
        if kind not in _IN_IMAGES and name is not None and name not in self.systems.names:
            reported = f"the coordinate system {name!r} is not described; taken for the world"
            location = f"{ordered[0].part.file}: {ordered[0].part.location}"
            self.ledger.note(WarningKind.ASSUMED, "coordinate-system-unknown", location, reported)
        return _Rows(tuple(ordered), np.array(times, np.int64), name, self.systems, camera, MappingProxyType(fields))

    def _camera(self, system: str | None, part: Part) -> Identifier:
        """The camera of what is drawn in images: that of the coordinate system, else the only or first one."""
        if system in self.sensors:
            return self.sensors[str(system)].id
        cameras = [sensor for sensor in self.sensors.values() if isinstance(sensor, CameraSensor)]
        if system is not None and not cameras:
            return system
        found: Identifier = cameras[0].id if cameras else "camera"
        if len(cameras) != 1 or system is not None:
            reported = f"it is not stated in whose images it is drawn; taken for those of {found!r}"
            self.ledger.note(WarningKind.ASSUMED, "camera-assumed", f"{part.file}: {part.location}", reported)
        return found

    def _of_event(self, element: _Element) -> Annotation:
        """An action, event or context: something that lasts from one frame to another."""
        label = element.head.need("type").text() or None
        intervals = element.intervals or ([(min(element.frames), max(element.frames))] if element.frames else [])
        start_ns = self.times.at(intervals[0][0]) if intervals else self.times.first_ns
        stop_ns = self.times.at(intervals[-1][1]) if intervals else None
        extras = dict(_further(element))
        if element.kind != "event":
            extras[KIND] = {**extras.get(KIND, {}), "kind": element.kind}
        event = EventAnnotation(
            element.id,
            start_ns,
            None if stop_ns is None else stop_ns - start_ns,
            label,
            attributes=tuple(_attribute(*key, rows) for key, rows in element.data.items()),
            extras=MappingProxyType(extras),
        )
        return self.ours.restored(event, element.kind, element.uid)


def _texts(part: Part, count: int) -> list[str]:
    values = part.value
    if not isinstance(values, list) or len(values) != count or not all(isinstance(v, str) for v in values):
        raise part.fault(f"a list of {count} texts")
    return list(values)


def _key_rows(rows: list[_Stated], members: Mapping[str, Any]) -> tuple[list[_Stated], tuple[str, ...]]:
    """Rows without those that we interpolated, and names of attributes that state which these are."""
    if members.get("interpolated") is not True:
        return rows, ()
    found = [row for row in rows if _nested_flag(row, INTERPOLATED) is not True]
    return found or rows, (INTERPOLATED,)


def _drawn(own: Part, stated: dict[tuple[str, str], list[_Stated]]) -> dict[str, SeenBoxes]:
    """Take the boxes that are projections of an annotation out of what is stated, by their names."""
    found: dict[str, SeenBoxes] = {}
    if own.members().get("class") is not None:
        return found
    for listed in own.items("projections"):
        name = listed.get("data")
        rows = [] if name is None else stated.pop(("bbox", name.text()), [])
        boxes = {}
        for row in rows:
            if row.time_ns is not None:
                x, y, width, height = row.part.need("val").numbers((4,))
                box = (x - width / 2, y - height / 2, width, height)
                boxes[row.time_ns] = (box, _nested_flag(row, CONFIRMED))
        if name is not None:
            found[name.text()] = boxes
    return found


def _further(element: _Element) -> Any:
    """What the entry says besides: its name where that is not its key, and ontology and resource."""
    members = element.head.members()
    further = {key: value for key, value in members.items() if key not in _HEAD}
    if further.get("name") == element.uid:
        del further["name"]
    intervals = element.intervals
    if len(intervals) > 1 and element.kind != "object":
        further["frame_intervals"] = [list(one) for one in intervals]
    return MappingProxyType({KIND: further} if further else {})


def _shape_extras(extras: Any, kind: str, name: str, rows: Sequence[_Stated]) -> Any:
    """What a shape says besides its location: its name where that says more than its type, and what its rows have."""
    further = {key: value for key, value in rows[0].part.members().items() if key not in _OF_ROWS}
    if name != kind:
        further["name"] = name
    if not further:
        return extras
    return MappingProxyType({**extras, KIND: {**extras.get(KIND, {}), "data": further}})


def _links(
    document: Part, known: dict[tuple[str, str], Identifier], ours: Ours, ledger: Ledger
) -> Iterator[Annotation]:
    """Make a link of each pair of subject and object of a relation."""
    taken = {uid for _, uid in known}
    for uid, relation in document.each("relations"):
        link_id = uid if uid not in taken else f"relation:{uid}"
        try:
            subjects = [_agent(part, known) for part in relation.items("rdf_subjects")]
            objects = [_agent(part, known) for part in relation.items("rdf_objects")]
            if not subjects or not objects:
                raise relation.fault("at least one each of rdf_subjects and rdf_objects")
            yield from (ours.restored(link, "relation", uid) for link in _pairs(link_id, relation, subjects, objects))
        except DataError as error:
            ledger.fault("relations", error)


def _pairs(
    relation_id: str, relation: Part, subjects: list[Identifier], objects: list[Identifier]
) -> Iterator[LinkAnnotation]:
    label = relation.need("type").text() or None
    taken = {"type", "rdf_subjects", "rdf_objects"}
    further = {key: value for key, value in relation.members().items() if key not in taken and value != relation_id}
    extras = MappingProxyType({KIND: further} if further else {})
    pairs = [(one, other) for one in subjects for other in objects]
    for k, (from_id, to_id) in enumerate(pairs):
        link_id = relation_id if len(pairs) == 1 else f"{relation_id}:{k}"
        yield LinkAnnotation(link_id, from_id, to_id, label, extras=extras)


def _agent(part: Part, known: dict[tuple[str, str], Identifier]) -> Identifier:
    kind, uid = part.need("type").text(), part.need("uid").text()
    if (kind, uid) not in known:
        raise part.fault(f"the uid of one of the file's {kind}s")
    return known[kind, uid]


KEPT = ("metadata", "ontologies", "resources", "tags")
"""Members of the root that are kept as they are."""


def read_openlabel(path: Path, *, lenient: bool = False, rate_hz: float | str | None = None) -> Scene:
    """Read a file.

    Args:
        path: of the file.
        lenient: leave out what is wrong, and count it.
        rate_hz: frames per second of a file whose frames have no times.

    Raises:
        DataError: the file is wrong.
        OptionError: the rate is no number above 0.
    """
    rate = None if rate_hz is None else as_positive("rate_hz", rate_hz)
    document, ledger = _read_document(path), Ledger(lenient=lenient)
    with ledger.telling():
        return _scene(document, ledger, rate)


def _scene(document: Part, ledger: Ledger, rate_hz: float | None) -> Scene:
    _check_version(document, ledger)
    times = frame_times(document, ledger, rate_hz)
    systems = read_systems(document, times, ledger)
    sensors = read_streams(document, systems, ledger)
    names = [name for name, _ in document.each("streams")]
    elements, ours = _gather(document, times), Ours.of(document)
    reader = _Reader(times, systems, dict(zip(names, sensors, strict=True)), ours, ledger)
    annotations = list(reader.annotations(elements))
    annotations += _links(document, _ids(elements, annotations, ours), ours, ledger)
    trajectory = ego_path(systems)
    trajectories = {}
    if trajectory is not None:
        name, path = trajectory
        stated = None if ours.part is None else ours.part.members().get("trajectory")
        name = stated if isinstance(stated, str) else name
        trajectories[name] = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
    return Scene(
        sensors,
        annotations=tuple(annotations),
        trajectories=MappingProxyType(trajectories),
        metadata=MappingProxyType(_metadata(document)),
        source=str(document.file),
        format="openlabel",
        warnings=ledger.warnings,
    )


def _check_version(document: Part, ledger: Ledger) -> None:
    metadata = document.get("metadata")
    version = None if metadata is None else metadata.get("schema_version")
    if version is None or version.value != SCHEMA_VERSION:
        reported = f"version {None if version is None else version.value!r} of the schema; read as {SCHEMA_VERSION}"
        ledger.note(WarningKind.ASSUMED, "schema-version", f"{document.file}: openlabel.metadata", reported)


def _ids(elements: list[_Element], annotations: list[Annotation], ours: Ours) -> dict[tuple[str, str], Identifier]:
    """Ids of annotations by what relations call them."""
    found: dict[tuple[str, str], Identifier] = {}
    known = {annotation.id for annotation in annotations}
    for element in elements:
        fields: Any = {} if ours.part is None else ours.part.members().get(element.kind, {})
        stated = fields.get(element.uid, {}) if isinstance(fields, dict) else {}
        own = stated.get("id", element.id) if isinstance(stated, dict) else element.id
        if isinstance(own, str | int) and own in known:
            found[element.kind, element.uid] = own
    return found


def _metadata(document: Part) -> dict[str, Any]:
    """The members that the model has no field for, and how the angles of boxes are meant."""
    kept = {name: value for name in KEPT if (value := document.members().get(name))}
    if isinstance(kept.get("metadata"), dict):
        own = {name: value for name, value in kept["metadata"].items() if name not in {OURS, "schema_version"}}
        kept.pop("metadata")
        kept.update({"metadata": own} if own else {})
    angles = CuboidAngles()
    metadata: dict[str, Any] = {OURS: {"euler_unit": str(angles.unit), "euler_order": angles.order}}
    ours = Ours.of(document).part
    further = None if ours is None else ours.members().get("metadata")
    if isinstance(further, dict):
        metadata = {**further, OURS: {**further.get(OURS, {}), **metadata[OURS]}}
    return {**metadata, **({"openlabel": kept} if kept else {})}


def _read_document(path: Path) -> Part:
    """Read a file.

    Raises:
        DataError: it is no JSON, or has no member `openlabel`.
    """
    try:
        value = msgspec.json.decode(read_bytes(path))
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise DataError(path, "", f"is no JSON: {error}") from error
    if not isinstance(value, Mapping) or not isinstance(value.get("openlabel"), dict):
        raise DataError(path, "", "has no object `openlabel`; expected a file of ASAM OpenLABEL")
    return Part(path, "openlabel", value["openlabel"])
