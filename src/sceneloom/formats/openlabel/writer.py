"""Write a scene as an OpenLABEL file."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import msgspec
import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.cameras.camera import MODELS, Camera, to_opencv
from sceneloom.errors import SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Losses, LossReport, Support, field_losses
from sceneloom.formats.base.output import replacing
from sceneloom.formats.base.text_tables import seconds_text
from sceneloom.formats.openlabel.document import (
    ABSOLUTE,
    CONFIRMED,
    DOCUMENT,
    EGO,
    FISHEYE,
    INTERPOLATED,
    KEPT,
    KIND,
    LENS_COEFFICIENTS,
    OF_OTHERS,
    OURS,
    OURS_CAMERA,
    PLAIN,
    RATE,
    RBBOX,
    SCHEMA_VERSION,
    TYPE,
    UID,
    WORLD,
    is_json,
    own_fields,
)
from sceneloom.formats.openlabel.reader import DocumentReader
from sceneloom.formats.openlabel.spec import SUPPORTS
from sceneloom.geometry.rigid import RigidTransform, angle_between
from sceneloom.scene.annotations import (
    Annotation,
    AttributePath,
    Box2DAnnotation,
    CameraCalibration,
    CuboidAnnotation,
    EventAnnotation,
    LabeledPointsAnnotation,
    LinkAnnotation,
    LocalizationAdjustment,
    ObjectAnnotation,
    PlainAnnotation,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
    ShapeType,
    locations_of,
)
from sceneloom.scene.annotations_at import CuboidAngles, annotations_frame, cuboid_poses
from sceneloom.scene.cameras import CameraSensor, mounts_of_shots
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene, Sensor, frame_times
from sceneloom.scene.types import NO_FIELDS, Coordinates, Identifier, Key, key_of

_Datum = tuple[int | None, str, dict[str, Any]]  # time [ns], or None for always; type of the data; the element

_LASTING = ("action", "event", "context")
_KINDS = ("object", *_LASTING, "relation")
_CLOSED = (ShapeType.POLYGON, ShapeType.POLYGON_2D, ShapeType.POLYGON_TOPDOWN)
_POINTS = (ShapeType.POINT, ShapeType.POINT_2D, ShapeType.POINT_TOPDOWN)
_LEFT_OUT = (LocalizationAdjustment, CameraCalibration, PlainAnnotation)
_PARTS = (CuboidAnnotation, Box2DAnnotation, ShapeAnnotation, PointsAnnotation, LabeledPointsAnnotation)
_NOT_JSON = "left out: JSON cannot hold it"


def write_openlabel(scene: Scene, path: Path, *, overwrite: bool = False) -> LossReport:
    """Write annotations, sensors without their frames, and the ego trajectory.

    Raises:
        OutputError: the file exists, or cannot be written.
        DataError: the metadata name an unknown frame of annotations.
    """
    losses = Losses([])
    kept = _Kept.of(scene, losses)
    losses.extend(field_losses(scene if kept is None else kept.without_held(scene), SUPPORTS))
    document = kept.document if kept is not None and kept.is_whole else _Writer(scene, losses, kept).document()
    with replacing(path, overwrite=overwrite) as draft:
        draft.write_bytes(msgspec.json.encode({"openlabel": document}))
    return LossReport.of(losses)


# what others wrote


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """The document that a scene was read from, as far as the scene is still what it states."""

    document: dict[str, Any]
    numbers: Mapping[int, int]  # of its frames, by their times [ns]
    unchanged: frozenset[tuple[str, str]]  # kind and key of the elements that state what the scene does
    annotations: frozenset[Key]  # of these elements
    elements: Mapping[Key, tuple[str, str]]  # kind and key of each element, by the first of its annotations
    is_whole: bool  # whether nothing changed

    @classmethod
    def of(cls, scene: Scene, losses: Losses) -> "_Kept | None":
        """Compare a scene with the document of its metadata; None where there is none, or it holds no more."""
        stated = scene.metadata.get("openlabel")
        text = stated.get(DOCUMENT) if isinstance(stated, Mapping) else None
        if not isinstance(stated, Mapping) or not isinstance(text, str):
            return None
        rate = stated.get(RATE)
        try:
            document = msgspec.json.decode(text, type=dict[str, Any])
            reader = DocumentReader(
                Path(f"metadata.openlabel.{DOCUMENT}"),
                document,
                Ledger(lenient=False),
                rate if isinstance(rate, float) and rate > 0 else None,
            )
            read = reader.by_element()
        except (SceneloomError, msgspec.DecodeError, RecursionError) as error:
            losses.dropped(f"metadata.openlabel.{DOCUMENT}", f"left out: it is no document ({error})")
            return None
        sensors = tuple(sensor for sensor in scene.sensors if not _is_plain(sensor))
        if not _same(sensors, tuple(reader.sensors.values())) or not _same(scene.trajectories, reader.trajectories()):
            what = "what only the document states is left out: sensors or the trajectory changed"
            losses.dropped(f"metadata.openlabel.{DOCUMENT}", what)
            return None
        here = {key_of(one.id): one for one in scene.annotations}
        same = {
            element: all(_same(here.get(key_of(one.id)), one) for one in annotations)
            for element, annotations in read.items()
        }
        unchanged = {element for element, is_same in same.items() if is_same}
        held = {key_of(one.id) for element in unchanged for one in read[element]}
        left = [one for one in scene.annotations if key_of(one.id) not in held]
        if not set(_frame_times(left).tolist()) <= reader.numbers.keys():
            what = "what only the document states is left out: there are annotations at other times than its frames"
            losses.dropped(f"metadata.openlabel.{DOCUMENT}", what)
            return None
        for name in KEPT:
            if not _same(stated.get(name), _stated(document, name)):
                document = {key: value for key, value in document.items() if key != name}
                document |= {name: stated[name]} if name in stated else {}
        document["metadata"] = {**document.get("metadata", {}), "schema_version": SCHEMA_VERSION}
        own = {name for name in scene.metadata if name not in {"openlabel", OURS}}
        return cls(
            document,
            reader.numbers,
            frozenset(unchanged),
            frozenset(held),
            {key_of(annotations[0].id): element for element, annotations in read.items() if annotations},
            not left and len(unchanged) == len(read) and not own and OURS not in document["metadata"],
        )

    def without_held(self, scene: Scene) -> Scene:
        """A scene without what the document states of it."""
        return replace(
            scene,
            sensors=tuple(one for one in scene.sensors if _is_plain(one)),
            annotations=tuple(one for one in scene.annotations if key_of(one.id) not in self.annotations),
            trajectories=NO_FIELDS,
        )

    def elements_of(self, kind: str) -> dict[str, Any]:
        """The unchanged elements of a kind, by their keys."""
        stated: Mapping[str, Any] = self.document.get(f"{kind}s") or {}
        return {uid: element for uid, element in stated.items() if (kind, uid) in self.unchanged}

    def frame(self, number: int) -> dict[str, Any]:
        """What a frame states of unchanged elements, and its properties."""
        frame: Mapping[str, Any] = (self.document.get("frames") or {}).get(str(number)) or {}
        found = {}
        for name, value in frame.items():
            kind = name.removesuffix("s")
            if kind in _KINDS and isinstance(value, Mapping):
                found[name] = {uid: stated for uid, stated in value.items() if (kind, uid) in self.unchanged}
            else:
                found[name] = value
        return {name: value for name, value in found.items() if value or value == frame[name]}


def _stated(document: Mapping[str, Any], name: str) -> Any:
    """A member of a document as metadata hold it: without the schema's version and what is ours."""
    value = document.get(name)
    if name == "metadata" and isinstance(value, Mapping):
        value = {key: one for key, one in value.items() if key not in {OURS, "schema_version"}}
    return value or None


def _is_plain(sensor: Sensor) -> bool:
    """Whether a sensor is of a type that streams do not have."""
    plain = isinstance(sensor, PlainSensor) and sensor.type.startswith("openlabel_")
    return type(sensor) not in _STREAM_TYPES and not plain


_RELATIVE, _ABSOLUTE, _MICROSECOND = 1e-12, 1e-9, 1000  # of what went through another format and back


def _same(a: Any, b: Any, tolerance: float = _ABSOLUTE) -> bool:  # noqa: PLR0911 - one for each kind of value
    """Whether two parts of scenes state the same; a sensor with frames is no stream, which has none."""
    if a is b:
        return True
    if isinstance(a, LazyFrames) and isinstance(b, LazyFrames):
        return len(a) == len(b) == 0
    if is_dataclass(a) or is_dataclass(b):
        return type(a) is type(b) and all(
            _same(getattr(a, name), getattr(b, name), _MICROSECOND if name.endswith("_ns") else _ABSOLUTE)
            for name in (one.name for one in fields(a))
        )
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        relative = _RELATIVE if a.dtype.kind == "f" else 0.0
        same = np.array_equal(a, b)
        return same or (a.shape == b.shape and np.allclose(a, b, rtol=relative, atol=tolerance, equal_nan=True))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_same(value, b[key]) for key, value in a.items())
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, int | float) and isinstance(b, int | float) and isinstance(a, bool) is isinstance(b, bool):
        relative = _RELATIVE if isinstance(a, float) or isinstance(b, float) else 0.0
        return (math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=relative, abs_tol=tolerance)
    return type(a) is type(b) and bool(a == b)


class _Writer:
    """Turns a scene into a document."""

    def __init__(self, scene: Scene, losses: Losses, kept: _Kept | None) -> None:
        self.scene, self.losses, self.kept = scene, losses, kept
        self.streams = _Streams.of(scene)
        times = _times_of(scene).tolist() if kept is None else sorted(kept.numbers)
        self.times = np.array(times, np.int64)  # of the frames, ascending
        self.numbers = dict(zip(times, range(len(times)), strict=True)) if kept is None else kept.numbers
        self.heads: dict[str, dict[str, dict[str, Any]]] = {kind: {} for kind in _KINDS[:-1]}  # by kind and key
        # by number, as `heads`: the data by type
        self.frames: dict[int, dict[str, dict[str, dict[str, list[dict[str, Any]]]]]] = {}
        self.names: dict[str, set[str]] = {}  # of the data of each object, by its key
        self.uids: dict[Key, tuple[str, str]] = {}  # kind and key of the elements, by annotation
        self.taken: set[str] = set()
        self.parts: set[Key] = set()  # annotations that are data of another's object
        self.relations: dict[str, Any] = {}
        self.ours: dict[str, dict[str, Any]] = {}  # fields without a keyword, by kind and key
        self.system = WORLD if annotations_frame(scene) is Coordinates.WORLD else EGO
        self.angles = CuboidAngles.of(scene)

    def document(self) -> dict[str, Any]:
        """The member `openlabel`."""
        kept = self.kept
        if kept is not None:
            self.uids |= kept.elements
            self.taken |= {uid for _, uid in kept.elements.values()}
        left = [one for one in self.scene.annotations if kept is None or key_of(one.id) not in kept.annotations]
        written = [one for one in left if not isinstance(one, _LEFT_OUT)]
        for annotation, parts in _things([one for one in written if not isinstance(one, LinkAnnotation)]):
            self._element(annotation, parts)
        for annotation in written:
            if isinstance(annotation, LinkAnnotation):
                self._relation(annotation)
        self._point_heads_to_frames()
        if kept is not None:
            return self._merged(kept)
        self._report_trajectories()
        self.losses.extend(self.streams.losses(self.times))
        stated = self.scene.metadata.get("openlabel")
        stated = {name: stated[name] for name in KEPT if name in stated} if isinstance(stated, Mapping) else {}
        count = len(self.times)
        members = {
            **stated,
            "metadata": {**stated.get("metadata", {}), "schema_version": SCHEMA_VERSION, OURS: self._ours()},
            "coordinate_systems": self.streams.systems(world=self.system == WORLD),
            "streams": self.streams.members(),
            **{f"{kind}s": heads for kind, heads in self.heads.items()},
            "relations": self.relations,
            "frames": {str(number): self._frame(number) for number in range(count)},
            "frame_intervals": [_interval(0, count - 1)] if count else [],
        }
        return {name: value for name, value in members.items() if value}

    def _merged(self, kept: _Kept) -> dict[str, Any]:
        """The document of others, with the elements that changed as we write them."""
        ours = {**self._ours(), OF_OTHERS: True}
        members = {**kept.document, "metadata": {**kept.document["metadata"], OURS: ours}}
        for kind in _KINDS:
            written = self.relations if kind == "relation" else self.heads[kind]
            members[f"{kind}s"] = {**kept.elements_of(kind), **written}
        if kept.document.get("frames"):
            members["frames"] = {}
        for number in map(int, kept.document.get("frames") or ()):
            members["frames"][str(number)] = frame = kept.frame(number)
            for name, stated in self._data_of(number).items():
                frame[name] = {**frame.get(name, {}), **stated}
        return {name: value for name, value in members.items() if value or value == kept.document.get(name)}

    def _frame(self, number: int) -> dict[str, Any]:
        time_ns = int(self.times[number])
        properties = {
            "timestamp": seconds_text(time_ns),
            "transforms": self.streams.transforms(time_ns),
            "streams": self.streams.syncs(time_ns),
        }
        frame: dict[str, Any] = {"frame_properties": {name: value for name, value in properties.items() if value}}
        return frame | self._data_of(number)

    def _data_of(self, number: int) -> dict[str, Any]:
        """The elements of a frame, by kind and key, with their data."""
        found = self.frames.get(number, {})
        return {f"{kind}s": {uid: {f"{kind}_data": one} for uid, one in data.items()} for kind, data in found.items()}

    def _ours(self) -> dict[str, Any]:
        """What the format has no keywords for: fields of annotations, and metadata as far as JSON holds them."""
        found: dict[str, Any] = dict(self.ours)
        names = list(self.scene.trajectories)
        if names and self.streams.trajectory is not None:
            found["trajectory"] = names[0]
        own = {name: value for name, value in self.scene.metadata.items() if name != "openlabel"}
        metadata = {name: value for name, value in own.items() if is_json(value)}
        for name in own.keys() - metadata.keys():
            self.losses.dropped(f"metadata.{name}", _NOT_JSON)
        return {**found, **({"metadata": metadata} if metadata else {})}

    def _number(self, time_ns: int) -> int:
        """The number of the frame of a time."""
        return self.numbers[time_ns]

    def _new_uid(self, kind: str, identifier: Identifier) -> str:
        """A key for an id: that of its element before, the id itself where the schema accepts it, else a UUID of it."""
        before = self.uids.get(key_of(identifier), ("", ""))
        if before[0] == kind:
            return before[1]
        uid = text = str(identifier)
        attempt = 0
        while not UID.fullmatch(uid) or uid in self.taken:
            uid = str(uuid5(NAMESPACE_URL, f"sceneloom:{type(identifier).__name__}:{attempt}:{text}"))
            attempt += 1
        self.taken.add(uid)
        self.uids[key_of(identifier)] = kind, uid
        return uid

    def _element(self, annotation: Any, parts: Sequence[Any]) -> None:
        """Write an annotation as an object or event, and its parts as further data of the same object."""
        further = _further(annotation)
        kind = "object"
        if isinstance(annotation, EventAnnotation):
            kind = next((one for one in _LASTING if one == further.get("kind")), "event")
        uid = self._new_uid(kind, annotation.id)
        name = further.get("name")
        label = next((stated for one in (annotation, *parts) if (stated := _label(one))), None)
        self.heads[kind][uid] = {
            "name": name if isinstance(name, str) else str(annotation.id),
            "type": label or "",
            **{name: further[name] for name in ("ontology_uid", "resource_uid") if name in further},
        }
        if isinstance(annotation, EventAnnotation):
            stop_ns = annotation.start_ns + int(annotation.duration_ns or 0)
            interval = _interval(self._number(annotation.start_ns), self._number(stop_ns))
            self.heads[kind][uid]["frame_intervals"] = [interval]
        fields = self._state(kind, uid, annotation, label)
        if parts:
            if not fields["data"]:
                fields["is_whole"] = True
            for part in parts:
                self.uids[key_of(part.id)] = kind, uid
                self.parts.add(key_of(part.id))
            fields["parts"] = [self._state(kind, uid, part, label) for part in parts]
        del fields["data"]
        self.ours.setdefault(kind, {})[uid] = fields

    def _state(self, kind: str, uid: str, annotation: Any, label: str | None) -> dict[str, Any]:
        """Write an annotation as data of an object; return the fields that the format has no keywords for."""
        fields = own_fields(annotation)
        self._report_extras(annotation)
        if label is not None and getattr(annotation, "label", label) is None:
            fields["unlabelled"] = True
        path = getattr(annotation, "path", None)
        if path is not None and not len(path.timestamps_ns):
            what = "it has no location at any time: read back as an object without one"
            self.losses.dropped(f"annotations[{annotation.id}]", what)
        data = self._renamed(uid, self._data(annotation), annotation.id)
        fields["data"] = list(dict.fromkeys(element["name"] for _, _, element in data))
        self._add(kind, uid, data)
        if isinstance(annotation, CuboidAnnotation):
            if any("attributes" in one for _, _, one in data):
                fields["interpolated"] = True
            if len(annotation.path.timestamps_ns):
                fields |= self._projections(kind, uid, annotation)
            else:
                fields.pop("activations", None)
                for name in ("activations", "projections"):
                    what, count = "left out: OpenLABEL has no field for it", len(getattr(annotation, name))
                    self.losses.dropped(f"annotations[{annotation.id}].{name}", what, count=count)
        fields |= self._attributes(kind, uid, annotation)
        extras = {name: value for name, value in getattr(path, "extras", {}).items() if name != RBBOX}
        if extras and self._holds(f"annotations[{annotation.id}].path.extras", extras, count=len(extras)):
            fields["path_extras"] = extras
        if self._holds(f"annotations[{annotation.id}].extras", dict(annotation.extras)):
            fields["extras"] = dict(annotation.extras)
        return fields

    def _holds(self, field: str, value: Any, *, count: int = 1) -> bool:
        """Whether JSON holds a value; if not, it is reported."""
        if is_json(value):
            return True
        self.losses.dropped(field, _NOT_JSON, count=count)
        return False

    def _report_extras(self, annotation: Any) -> None:
        """Report extra fields of the records of an annotation that JSON cannot hold."""
        records = [one for name in ("activations", "labeled_points", "paths") for one in getattr(annotation, name, ())]
        for one in getattr(annotation, "projections", ()):
            records += one if isinstance(one, tuple) else [one]
        for record in records:
            self._holds(f"annotations[{annotation.id}].extras", dict(record.extras), count=len(record.extras))

    def _projections(self, kind: str, uid: str, cuboid: CuboidAnnotation) -> dict[str, Any]:
        """Write the boxes of projections as data; return the rest as our own fields."""
        rows = []
        for projection in cuboid.projections:
            fields = own_fields(projection)
            system = self._camera(projection.sensor_id)
            data = list(_projection_data(projection, f"projection:{system}", system))
            if len({time_ns for time_ns, _, _ in data}) == len(data) and data:
                data = self._renamed(uid, data, cuboid.id)
                self._add(kind, uid, data)
                fields |= {"data": data[0][2]["name"], "boxes": None}
            rows.append(fields)
        return {"projections": rows} if rows else {}

    def _data(self, annotation: Annotation) -> list[_Datum]:
        """The locations of an annotation, if it has some."""
        stated = _further(annotation).get("data")
        stated = dict(stated) if isinstance(stated, Mapping) else {}
        name = stated.pop("name", None)
        if isinstance(annotation, CuboidAnnotation):
            data = _cuboid_data(annotation, name or "cuboid", self.system, self.angles, self.times)
        elif isinstance(annotation, Box2DAnnotation):
            data = _box_data(annotation, name or "bbox", self._camera(annotation.sensor_id))
        elif isinstance(annotation, ShapeAnnotation):
            system = self._camera(annotation.sensor_id) if annotation.dimensions == 2 else self.system
            data = _shape_data(annotation, name or annotation.type.value, system)
        elif isinstance(annotation, PointsAnnotation):
            return list(_keypoint_data(annotation, self.system))
        else:
            return []
        return [(time_ns, kind, {**stated, **element}) for time_ns, kind, element in data]

    def _camera(self, sensor_id: Any) -> str:
        return self.streams.names.get(sensor_id, str(sensor_id))

    def _attributes(self, kind: str, uid: str, annotation: Any) -> dict[str, Any]:
        """Write attributes as data; returns "attributes" that data cannot hold, and "own" names of a part's."""
        unsaid, renamed, seen = [], [], set()
        is_part = key_of(annotation.id) in self.parts
        if isinstance(annotation, LinkAnnotation):
            return {"attributes": [own_fields(one) for one in annotation.attributes]}
        # an attribute of all points must not be taken for one of a single point
        collide = isinstance(annotation, PointsAnnotation)
        of_points = {one.name for one in annotation.attributes if collide and one.point_index is not None}
        for attribute in annotation.attributes:
            data = _attribute_data(attribute, self.streams.names)
            key = None if not data else (data[0][1], attribute.name)
            field = f"annotations[{annotation.id}].attributes"
            if data and key not in seen and attribute.name not in of_points:
                seen.add(key)
                if is_part:
                    data = self._renamed(uid, data, annotation.id)
                    renamed.append([data[0][1], data[0][2]["name"], attribute.name])
                self.names.setdefault(uid, set()).add(attribute.name)
                self._add(kind, uid, data)
                if others := attribute.extras.keys() - {"type", "attributes", TYPE}:
                    what = f"extra fields left out: {', '.join(sorted(others))}"
                    self.losses.dropped(f"{field}.{attribute.name}", what)
                if attribute.timestamps_ns is None and not attribute.static:
                    self.losses.converted(field, "an attribute without times is read back as one that holds always")
            elif self._holds(f"{field}.{attribute.name}", [*attribute.values, dict(attribute.extras)]):
                unsaid.append(own_fields(attribute))
        return {**({"attributes": unsaid} if unsaid else {}), **({"own": renamed} if renamed else {})}

    def _renamed(self, uid: str, data: Iterable[_Datum], identifier: Identifier) -> list[_Datum]:
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

    def _add(self, kind: str, uid: str, data: Iterable[_Datum]) -> None:
        """Put elements of data into the frames of their times, or the head."""
        for time_ns, name, element in data:
            if time_ns is None:
                location = self.heads[kind][uid].setdefault(f"{kind}_data", {})
            else:
                frame = self.frames.setdefault(self._number(time_ns), {}).setdefault(kind, {})
                location = frame.setdefault(uid, {})
            location.setdefault(name, []).append(element)

    def _point_heads_to_frames(self) -> None:
        """State in the heads which frames name them, and which data of them."""
        for kind, heads in self.heads.items():
            numbers: dict[str, list[int]] = {}
            pointers: dict[str, dict[str, tuple[str, list[int]]]] = {}
            for number in sorted(self.frames):
                for uid, data in self.frames[number].get(kind, {}).items():
                    numbers.setdefault(uid, []).append(number)
                    for name, elements in data.items():
                        for element in elements:
                            _, known = pointers.setdefault(uid, {}).setdefault(element["name"], (name, []))
                            if known[-1:] != [number]:
                                known.append(number)
            for uid, known in numbers.items():
                heads[uid].setdefault("frame_intervals", _intervals(known))
            for uid, stated in pointers.items():
                heads[uid][f"{kind}_data_pointers"] = {
                    name: {"type": type_, "frame_intervals": _intervals(known)}
                    for name, (type_, known) in stated.items()
                }

    def _relation(self, link: LinkAnnotation) -> None:
        ends = [self.uids.get(key_of(one)) for one in (link.from_id, link.to_id)]
        if None in ends:
            self.losses.dropped(f"annotations[{link.id}]", "left out: one of its ends is not written")
            return
        uid = self._new_uid("relation", link.id)
        subject, other = ({"uid": end[1], "type": end[0]} for end in ends if end is not None)
        further = _further(link)
        self.relations[uid] = {
            "name": further.get("name", str(link.id)),
            "type": link.label or "",
            "rdf_subjects": [subject],
            "rdf_objects": [other],
            **{name: further[name] for name in ("ontology_uid", "resource_uid") if name in further},
        }
        fields = own_fields(link) | self._attributes("relation", uid, link)
        for name in ("from_id", "to_id"):
            if key_of(fields[name]) not in self.parts:
                del fields[name]
        if self._holds(f"annotations[{link.id}].extras", dict(link.extras)):
            fields["extras"] = dict(link.extras)
        self.ours.setdefault("relation", {})[uid] = fields

    def _report_trajectories(self) -> None:
        """Report how the ego trajectory is sampled, and the others, which are left out."""
        for k, (name, trajectory) in enumerate(self.scene.trajectories.items()):
            count = len(trajectory.timestamps_ns)
            if k:
                what = "left out: the format has one ego trajectory"
                self.losses.dropped(f"trajectories[{name}]", what, count=count)
            elif trajectory.quaternions_xyzw is None:
                self.losses.dropped(f"trajectories[{name}]", "left out: it has no orientations")
            elif not np.isin(trajectory.timestamps_ns, self.times).all():
                field = f"trajectories[{name}].timestamps_ns"
                self.losses.approximated(field, "written at the times of the frames", count=count)


def _further(annotation: Any) -> dict[str, Any]:
    """What the file that an annotation was read from called it and stated about it besides."""
    further = annotation.extras.get(KIND)
    return dict(further) if isinstance(further, Mapping) else {}


def _label(annotation: Any) -> str | None:
    return getattr(annotation, "label", None) or None


def _interval(start: int, end: int) -> dict[str, int]:
    return {"frame_start": start, "frame_end": end}


def _intervals(numbers: list[int]) -> list[dict[str, int]]:
    """Ascending numbers as intervals, both ends included."""
    runs = np.split(np.array(numbers), np.flatnonzero(np.diff(numbers) > 1) + 1)
    return [_interval(int(run[0]), int(run[-1])) for run in runs]


def _times_of(scene: Scene) -> Int64Array:
    """The times that the file has frames of: those of annotations, and of the first lidar's or camera's frames."""
    found = [_frame_times(scene.annotations)]
    sensors: list[Sensor] = [*scene.lidars, *scene.cameras]
    found += [times for one in sensors if len(times := frame_times(one))][:1]
    if not any(len(times) for times in found):
        found = [trajectory.timestamps_ns for trajectory in list(scene.trajectories.values())[:1]]
    return np.unique(np.concatenate(found)) if found else np.zeros(0, np.int64)


def _frame_times(annotations: Iterable[Annotation]) -> Int64Array:
    """The times that annotations need frames of."""
    found: list[Int64Array] = [np.zeros(0, np.int64)]
    for annotation in annotations:
        if isinstance(annotation, LocalizationAdjustment | CameraCalibration):
            continue
        paths = [getattr(annotation, "path", None), *getattr(annotation, "paths", ())]
        found += [path.timestamps_ns for path in paths if path is not None]
        found += [one.timestamps_ns for one in getattr(annotation, "attributes", ()) if one.timestamps_ns is not None]
        if isinstance(annotation, CuboidAnnotation):
            found += [one.timestamps_ns for one in annotation.projections if one.boxes is not None]
        if isinstance(annotation, EventAnnotation):
            stop_ns = annotation.start_ns + int(annotation.duration_ns or 0)
            found.append(np.array([annotation.start_ns, stop_ns], np.int64))
    return np.unique(np.concatenate(found))


# which annotations are one object


def _things(annotations: Sequence[Annotation]) -> Iterator[tuple[Annotation, list[Annotation]]]:
    """Each annotation that stands for a thing, with those of its `parent_id` and class that describe the same thing."""
    # A cuboid below a cuboid is a thing of its own.
    by_id: dict[Key, Annotation] = {key_of(one.id): one for one in annotations}
    parts: dict[Key, list[Annotation]] = {}
    labels: dict[Key, str | None] = {key_of(one.id): _label(one) for one in annotations}
    alone: list[Annotation] = []
    for one in annotations:
        host = _host(one, by_id)
        key, label = key_of(host.id), _label(one)
        if host is one or (label and labels[key] and label != labels[key]):
            alone.append(one)
        else:
            labels[key] = labels[key] or label
            parts.setdefault(key, []).append(one)
    for one in alone:
        yield one, parts.get(key_of(one.id), [])


def _host(annotation: Annotation, by_id: dict[Key, Annotation]) -> Annotation:
    """The annotation of the thing that another one describes: itself, or what it belongs to."""
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


# annotations as data


def _cuboid_data(
    cuboid: CuboidAnnotation, name: str, system: str, angles: CuboidAngles, frames_ns: Int64Array
) -> Iterator[_Datum]:
    """A cuboid in each row and, marked as such, in the frames between: centre, quaternion x y z w, sizes."""
    values = cuboid.path.values
    rows = np.concatenate([values[:, 3:6], angles.quaternions(values[:, 6:9]), values[:, :3]], axis=1)
    times = frames_ns[~np.isin(frames_ns, cuboid.path.timestamps_ns)]
    poses = cuboid_poses(cuboid, times, angles=angles)
    between = np.concatenate([poses.centers_world, poses.quaternions_xyzw, poses.sizes_lwh], axis=1)
    there = poses.there & np.isfinite(between).all(axis=1)
    for times_ns, stated, flag in ((cuboid.path.timestamps_ns, rows, False), (times[there], between[there], True)):
        for time_ns, row in zip(times_ns.tolist(), stated.tolist(), strict=True):
            marked = {"attributes": _flag(INTERPOLATED, value=flag)} if there.any() else {}
            yield time_ns, "cuboid", {"name": name, "val": row, "coordinate_system": system, **marked}


def _flag(name: str, *, value: bool) -> dict[str, Any]:
    return {"boolean": [{"name": name, "val": value}]}


def _centred(boxes: Float64Array) -> Float64Array:
    return np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2, boxes[:, 2:]], axis=1)


def _projection_data(projection: Projection, name: str, system: str) -> Iterator[_Datum]:
    """The box of a projection in each row that has one: centre and size, and whether a person confirmed it."""
    rows = _centred(np.zeros((0, 4)) if projection.boxes is None else projection.boxes)
    for k in np.flatnonzero(np.isfinite(rows).all(axis=1)).tolist():
        confirmed = None if projection.confirmed is None else projection.confirmed[k]
        marked = {} if confirmed is None else {"attributes": _flag(CONFIRMED, value=confirmed)}
        element = {"name": name, "val": rows[k].tolist(), "coordinate_system": system, **marked}
        yield int(projection.timestamps_ns[k]), "bbox", element


def _box_data(box: Box2DAnnotation, name: str, system: str) -> Iterator[_Datum]:
    """A box in each row: centre and size."""
    for time_ns, row in zip(box.path.timestamps_ns.tolist(), _centred(box.path.values).tolist(), strict=True):
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
        element: dict[str, Any] = {"name": name, "val": vertices.reshape(-1).tolist(), "coordinate_system": system}
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
                yield time_ns, "point3d", {"name": f"{name}:{k}", "val": location, "coordinate_system": system}


def _attribute_data(attribute: AttributePath, systems: Mapping[Any, str]) -> list[_Datum] | None:
    """The values of an attribute; None where the format has no field for what it states."""
    kinds = {_kind(value, attribute) for value in attribute.values}
    times = attribute.timestamps_ns
    sound = len(kinds) == 1 and None not in kinds and attribute.point_index is None
    if not sound or not (attribute.is_timed or (times is None and len(attribute.values) == 1)):
        return None
    if times is not None and len(np.unique(times)) < len(times):
        return None
    further = {name: value for name, value in attribute.extras.items() if name in {"type", "attributes"}}
    if attribute.sensor_id is not None:
        if attribute.sensor_id not in systems:
            return None
        further["coordinate_system"] = systems[attribute.sensor_id]
    data: list[_Datum] = []
    for time_ns, value in zip([None] if times is None else times.tolist(), attribute.values, strict=True):
        kind = str(_kind(value, attribute))
        stated = dict(value) if isinstance(value, Mapping) else {"val": list(value) if kind == "vec" else value}
        data.append((time_ns, kind, {"name": attribute.name, **further, **stated}))
    return data


def _kind(value: Any, attribute: AttributePath) -> str | None:
    """The type of data that holds a value; None where none does."""
    if isinstance(value, Mapping):
        kind = attribute.extras.get(TYPE)
        return kind if isinstance(kind, str) else None
    return next((kind for kind, holds in PLAIN.items() if holds(value)), None)


# sensors as streams

_STREAM_TYPES: Mapping[type[Any], str] = {
    CameraSensor: "camera",
    LidarSensor: "lidar",
    RadarSensor: "radar",
    ImuSensor: "gps_imu",
    GnssSensor: "gps_imu",
}

_FISHEYE_COEFFICIENTS = ("k1", "k2", "k3", "k4")
_EXACT_M, _EXACT_DEG = 1e-6, 1e-4  # poses this near to the exact ones count as exact

_WITHIN = 0.5
"""A frame of a sensor belongs to the file's nearest frame within this share of the sensor's median interval."""


def _camera_properties(camera: Camera) -> dict[str, Any]:
    """A camera model in the words of the format where it has some, and in ours, which state it exactly."""
    ours = {name: getattr(camera, name) for name in OURS_CAMERA}
    named = dict(zip(MODELS[camera.model].coefficient_names, camera.coefficients, strict=False))
    size = {"width_px": camera.width, "height_px": camera.height}
    if camera.model == "fisheye":
        kind, found = (
            "fisheye",
            {
                **{name: getattr(camera, field) for name, field in FISHEYE.items()},
                LENS_COEFFICIENTS[0]: [named.get(name, 0.0) for name in _FISHEYE_COEFFICIENTS],
                "model": "opencv_fisheye",
            },
        )
    elif (coefficients := to_opencv(camera)) is not None:
        matrix = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        kind, found = "pinhole", {"camera_matrix_3x4": matrix, "distortion_coeffs_1xN": coefficients}
    else:
        kind, found = "custom", {**ours, **named}
    return {
        OURS: {"camera_model": {**ours, "coefficients": list(camera.coefficients)}},
        f"intrinsics_{kind}": {**size, **found},
    }


@dataclass(frozen=True, slots=True, eq=False)
class _Streams:
    """The sensors of a scene that a file names."""

    names: Mapping[Identifier, str]  # of the streams, by the ids of sensors
    sensors: Mapping[str, Sensor]  # by the names
    trajectory: Poses | None
    placed: Mapping[str, tuple[str, RigidTransform | None]]  # by the names: system and pose there, None if it moves

    @classmethod
    def of(cls, scene: Scene) -> "_Streams":
        """Name the sensors of a scene; those of types that streams do not have are left out."""
        # the first one with orientations, else that of an odometry sensor
        known = [one.poses for one in scene.trajectories.values() if one.quaternions_xyzw is not None]
        known += [sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor)]
        trajectory = next((poses for poses in known if not poses.static), None)
        check_one_ego(scene, trajectory)
        names: dict[Identifier, str] = {}
        sensors: dict[str, Sensor] = {}
        placed = {}
        for sensor in scene.sensors:
            if _is_plain(sensor):
                continue
            name = str(sensor.id)
            while name in sensors or name in {WORLD, EGO}:
                name += "_"
            names[sensor.id], sensors[name] = name, sensor
            if (where := _system_and_pose(sensor)) is not None:
                placed[name] = where
        return cls(names, sensors, trajectory, placed)

    def members(self) -> dict[str, Any]:
        """The member `streams`."""
        return {name: _stream(sensor) for name, sensor in self.sensors.items()}

    def systems(self, *, world: bool) -> dict[str, Any]:
        """The member `coordinate_systems`; the ego is the root where nothing is placed in the world."""
        parents = {parent for parent, _ in self.placed.values()}
        systems: dict[str, Any] = {}
        if world or self.trajectory is not None or WORLD in parents:
            systems[WORLD] = {"type": "scene_cs", "parent": ""}
        if EGO in parents or self.trajectory is not None or not systems:
            systems[EGO] = {"type": "local_cs", "parent": WORLD if self.trajectory is not None else ""}
        for name, (parent, pose) in self.placed.items():
            stated = {} if pose is None else {"pose_wrt_parent": _matrix(pose)}
            systems[name] = {"type": "sensor_cs", "parent": parent, **stated}
        for name, system in systems.items():
            system["children"] = [other for other, one in systems.items() if one["parent"] == name]
        return systems

    def transforms(self, time_ns: int) -> dict[str, Any]:
        """The transforms of the frame of a time: of the ego, and of sensors with poses of their own."""
        ego = {} if self.trajectory is None else {EGO: self.trajectory}
        found = {}
        for name, path in (ego | self._moving_sensors()).items():
            at = path.interpolate(np.array([time_ns], np.int64))
            if np.isfinite(at.positions[0]).all():
                pose = _matrix(RigidTransform.from_quaternion(at.positions[0], at.quaternions_xyzw[0]))
                found[f"{name}_to_{WORLD}"] = {"src": name, "dst": WORLD, "transform_src_to_dst": pose}
        return found

    def _moving_sensors(self) -> dict[str, Poses]:
        """`world_from_sensor` of the sensors that have transforms of their own, by the names of their streams."""
        moving = [name for name, (_, pose) in self.placed.items() if pose is None]
        return {name: poses for name in moving if (poses := getattr(self.sensors[name], "poses", None)) is not None}

    def losses(self, times_ns: Int64Array) -> Iterator[Loss]:
        """How far poses by transforms at the file's frames are off at the sensors' own, and which are left out."""
        ego = self.trajectory
        if ego is not None:
            yield from _sampled(ego, ego.timestamps_ns, times_ns, "trajectories.positions", "its poses")
        for name, path in self._moving_sensors().items():
            sensor = self.sensors[name]
            field, times = f"sensors[{sensor.id}].poses", _times(sensor)
            if len(times):
                yield from _sampled(path, times, times_ns, field, "its frames")
            else:
                yield from _sampled(path, path.timestamps_ns, times_ns, field, "its poses")

    def syncs(self, time_ns: int) -> dict[str, Any]:
        """Which frame of each sensor is the nearest to a time, and its own time."""
        found = {}
        for name, sensor in self.sensors.items():
            times = _times(sensor)
            if not len(times):
                continue
            k = int(np.argmin(np.abs(times - time_ns)))
            limit = float(np.median(np.diff(times))) * _WITHIN if len(times) > 1 else 0.0
            if abs(int(times[k]) - time_ns) <= limit:
                properties: dict[str, Any] = {"sync": {"frame_stream": k, "timestamp": seconds_text(int(times[k]))}}
                if isinstance(sensor, CameraSensor) and (camera := sensor.images[k].camera) != sensor.camera:
                    properties |= _camera_properties(camera)
                    del properties[OURS]
                found[name] = {"stream_properties": properties}
        return found


def _sampled(path: Poses, own_ns: Int64Array, times_ns: Int64Array, field: str, own: str) -> Iterator[Loss]:
    """How far a path is off between the times that it is written at, and how many of its own lie beyond them."""
    written = path.interpolate(times_ns)
    known = np.isfinite(written.positions).all(axis=1)
    right = path.interpolate(own_ns)
    wanted = np.isfinite(right.positions).all(axis=1)
    reached: BoolArray = np.zeros(len(own_ns), bool)
    if known.any():
        read = Poses(times_ns[known], written.positions[known], written.quaternions_xyzw[known])
        found = read.interpolate(own_ns)
        reached = np.asarray(wanted & np.isfinite(found.positions).all(axis=1), np.bool_)
        moved = np.linalg.norm(found.positions[reached] - right.positions[reached], axis=1)
        rotated = np.degrees(angle_between(found.quaternions_xyzw[reached], right.quaternions_xyzw[reached]))
        off, rotation = float(moved.max(initial=0.0)), float(rotated.max(initial=0.0))
        if off > _EXACT_M or rotation > _EXACT_DEG:
            what = (
                f"written at the times of the frames; at the times of {own} they are up to {round(off, 4):g} m and "
                f"{round(rotation, 3):g} degrees off"
            )
            count = int(reached.sum())
            yield Loss(field=field, what=what, count=count, support=Support.APPROXIMATED, largest_error=off)
    beyond = int((wanted & ~reached).sum())
    if beyond:
        yield Loss(field=field, what=f"left out at times of {own} that lie beyond the file's frames", count=beyond)


def _times(sensor: Sensor) -> Int64Array:
    has_frames = isinstance(sensor, LidarSensor | RadarSensor | CameraSensor)
    return frame_times(sensor) if has_frames else np.zeros(0, np.int64)


def _system_and_pose(sensor: Any) -> tuple[str, RigidTransform | None] | None:
    """The system that a sensor is placed in, and its pose there, None where it moves; None where nothing is known."""
    mount, poses = getattr(sensor, "mount", None), getattr(sensor, "poses", None)
    if isinstance(sensor, CameraSensor) and sensor.coordinates is Coordinates.WORLD and mounts_of_shots(sensor):
        # its images have mountings of their own: only its poses state where they were taken
        return None if poses is None else (WORLD, None)
    if mount is not None:
        return EGO, mount
    if poses is None:
        return None
    if len(poses.timestamps_ns) == 1:
        parent = EGO if sensor.coordinates is Coordinates.EGO else WORLD
        return parent, RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])
    return None if sensor.coordinates is Coordinates.EGO else (WORLD, None)


def _matrix(pose: RigidTransform) -> dict[str, Any]:
    return {"matrix4x4": pose.matrix.reshape(-1).tolist()}


def _stream(sensor: Any) -> dict[str, Any]:
    if isinstance(sensor, PlainSensor):
        return {"type": sensor.type.removeprefix("openlabel_"), **sensor.fields}
    camera = _camera_properties(sensor.camera) if isinstance(sensor, CameraSensor) else {}
    kept = sensor.extras.get("stream_properties")
    own = {"id": sensor.id, "type": str(sensor.type), **camera.get(OURS, {})}
    stream = {
        "type": _STREAM_TYPES[type(sensor)],
        "stream_properties": {**(kept if isinstance(kept, dict) else {}), **camera, OURS: own},
    }
    texts = {name: sensor.extras.get(name) for name in ("uri", "description")}
    return stream | {name: text for name, text in texts.items() if isinstance(text, str)}
