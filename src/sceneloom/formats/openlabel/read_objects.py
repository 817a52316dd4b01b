"""Objects, actions, events, contexts and relations as annotations."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.openlabel.collection import Element, Stated
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.frame_times import FrameTimes
from sceneloom.formats.openlabel.ours import Ours, SeenBoxes, restored_from
from sceneloom.formats.openlabel.read_attributes import attribute, nested_attributes, nested_flag
from sceneloom.formats.openlabel.read_geometry import IN_IMAGES, READERS, Rows
from sceneloom.formats.openlabel.systems import Systems
from sceneloom.formats.openlabel.words import ABSOLUTE, CONFIRMED, GEOMETRY, INTERPOLATED, RELATIVE
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.relations import EventAnnotation, LinkAnnotation, ObjectAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.scene import Sensor
from sceneloom.scene.types import Identifier
from sceneloom.scene.warnings import WarningKind

KIND = "openlabel"
"""Further field of an annotation: what the file calls it and says of it besides."""

_HEAD = ("type", "frame_intervals", "object_data", "object_data_pointers", "action_data", "action_data_pointers",
         "event_data", "event_data_pointers", "context_data", "context_data_pointers")  # fmt: skip
_OF_ROWS = ("name", "val", "coordinate_system", "attributes", "closed", "mode")


@dataclass(frozen=True, slots=True, eq=False)
class Reader:
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

    def annotations(self, elements: Sequence[Element]) -> Iterator[Annotation]:
        """Make annotations of all elements; one that is wrong is left out of a lenient reading."""
        for element in elements:
            try:
                yield from self._of_object(element) if element.kind == "object" else [self._of_event(element)]
            except DataError as error:
                self.ledger.fault("elements", error)

    def _of_object(self, element: Element) -> list[Annotation]:
        label = element.head.need("type").text() or None
        own, stated = self.ours.fields_of(element.kind, element.uid), dict(element.data)
        members = {} if own is None else own.members()
        parts = [] if own is None else [self._part(element, label, one, stated) for one in own.items("parts")]
        drawn = {} if own is None else _drawn(own, stated)
        plain = tuple(attribute(*key, rows) for key, rows in stated.items() if key[0] not in GEOMETRY)
        shapes = {
            key: rows for key, rows in stated.items() if key[0] in GEOMETRY and self._is_read(key, rows)
        }
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
                "attributes": (*nested_attributes(key_rows, without=without), *(plain if alone else ())),
                "extras": _shape_extras(extras if alone else {}, kind, name, rows),
                **({} if alone else {"parent_id": whole.id}),
            }
            made.append(READERS[kind](self._rows(kind, key_rows, fields)))
        if alone:
            whole = made.pop() if own is None else restored_from(own, made.pop(), drawn)
        return [whole, *(one for one in parts if one is not None), *made]

    def _part(
        self, element: Element, label: str | None, own: Part, stated: dict[tuple[str, str], list[Stated]]
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
            plain += [attribute(kind, called, reported)] if reported else []
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
            "attributes": (*nested_attributes(key_rows, without=without), *plain),
            "extras": _shape_extras({}, kind, name, rows),
        }
        return restored_from(own, READERS[kind](self._rows(kind, key_rows, fields)), drawn)

    def _is_read(self, key: tuple[str, str], rows: list[Stated]) -> bool:
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

    def _rows(self, kind: str, rows: Sequence[Stated], fields: dict[str, Any]) -> Rows:
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
        camera = self._camera(name, ordered[0].part) if kind in IN_IMAGES else ""
        if kind not in IN_IMAGES and name is not None and name not in self.systems.names:
            reported = f"the coordinate system {name!r} is not described; taken for the world"
            location = f"{ordered[0].part.file}: {ordered[0].part.location}"
            self.ledger.note(WarningKind.ASSUMED, "coordinate-system-unknown", location, reported)
        return Rows(
            tuple(ordered), np.array(times, np.int64), name, self.systems, camera, MappingProxyType(fields)
        )

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

    def _of_event(self, element: Element) -> Annotation:
        """An action, event or context: something that lasts from one frame to another."""
        label = element.head.need("type").text() or None
        intervals = element.intervals or (
            [(min(element.frames), max(element.frames))] if element.frames else []
        )
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
            attributes=tuple(attribute(*key, rows) for key, rows in element.data.items()),
            extras=MappingProxyType(extras),
        )
        return self.ours.restored(event, element.kind, element.uid)


def _texts(part: Part, count: int) -> list[str]:
    values = part.value
    if not isinstance(values, list) or len(values) != count or not all(isinstance(v, str) for v in values):
        raise part.fault(f"a list of {count} texts")
    return list(values)


def _key_rows(rows: list[Stated], members: Mapping[str, Any]) -> tuple[list[Stated], tuple[str, ...]]:
    """Rows without those that we interpolated, and names of attributes that state which these are."""
    if members.get("interpolated") is not True:
        return rows, ()
    found = [row for row in rows if nested_flag(row, INTERPOLATED) is not True]
    return found or rows, (INTERPOLATED,)


def _drawn(own: Part, stated: dict[tuple[str, str], list[Stated]]) -> dict[str, SeenBoxes]:
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
                boxes[row.time_ns] = (box, nested_flag(row, CONFIRMED))
        if name is not None:
            found[name.text()] = boxes
    return found


def _further(element: Element) -> Any:
    """What the entry says besides: its name where that is not its key, and ontology and resource."""
    members = element.head.members()
    further = {key: value for key, value in members.items() if key not in _HEAD}
    if further.get("name") == element.uid:
        del further["name"]
    intervals = element.intervals
    if len(intervals) > 1 and element.kind != "object":
        further["frame_intervals"] = [list(one) for one in intervals]
    return MappingProxyType({KIND: further} if further else {})


def _shape_extras(extras: Any, kind: str, name: str, rows: Sequence[Stated]) -> Any:
    """What a shape says besides its location: its name where that says more than its type, and what its rows have."""
    further = {key: value for key, value in rows[0].part.members().items() if key not in _OF_ROWS}
    if name != kind:
        further["name"] = name
    if not further:
        return extras
    return MappingProxyType({**extras, KIND: {**extras.get(KIND, {}), "data": further}})


def links(
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
            yield from (
                ours.restored(link, "relation", uid) for link in _pairs(link_id, relation, subjects, objects)
            )
        except DataError as error:
            ledger.fault("relations", error)


def _pairs(
    relation_id: str, relation: Part, subjects: list[Identifier], objects: list[Identifier]
) -> Iterator[LinkAnnotation]:
    label = relation.need("type").text() or None
    taken = {"type", "rdf_subjects", "rdf_objects"}
    further = {
        key: value for key, value in relation.members().items() if key not in taken and value != relation_id
    }
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
