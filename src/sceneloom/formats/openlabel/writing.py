"""A scene as an OpenLABEL file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.formats.field_losses import field_losses
from sceneloom.formats.loss import Loss, LossReport, Support
from sceneloom.formats.openlabel.draft import Draft, Uids
from sceneloom.formats.openlabel.ours import (
    activation_fields,
    annotation_fields,
    attribute_fields,
    is_json,
    point_projection_fields,
    projection_fields,
)
from sceneloom.formats.openlabel.read_geometry import RBBOX
from sceneloom.formats.openlabel.read_objects import KIND
from sceneloom.formats.openlabel.reading import KEPT
from sceneloom.formats.openlabel.spec import SUPPORTS
from sceneloom.formats.openlabel.things import things
from sceneloom.formats.openlabel.words import EGO, OURS, SCHEMA_VERSION, WORLD
from sceneloom.formats.openlabel.written_data import (
    FURTHER,
    Datum,
    attribute_data,
    box_data,
    cuboid_data,
    keypoint_data,
    projection_data,
    shape_data,
)
from sceneloom.formats.openlabel.written_streams import Streams
from sceneloom.formats.output import replacing
from sceneloom.formats.recording.written_times import seconds_text
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.annotation import Annotation
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.annotations.boxes_2d import Box2DAnnotation
from sceneloom.scene.annotations.corrections import CameraCalibration, LocalizationAdjustment
from sceneloom.scene.annotations.cuboids import CuboidAnnotation
from sceneloom.scene.annotations.keypoints import PointsAnnotation
from sceneloom.scene.annotations.labelled_points import LabeledPointsAnnotation
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations.relations import (
    EventAnnotation,
    GroupAnnotation,
    LinkAnnotation,
    ObjectAnnotation,
)
from sceneloom.scene.annotations.shapes import ShapeAnnotation
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.contents import KINDS
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, Key, key_of

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
        self.losses = list(field_losses(scene, SUPPORTS))
        self.draft = Draft(_frame_times(scene))
        self.uids = Uids()
        self.relations: dict[str, Any] = {}
        self.parts: set[Key] = set()
        in_world = annotations_frame(scene) is Coordinates.WORLD
        self.system = WORLD if in_world else EGO
        self.angles = CuboidAngles.of(scene)

    def document(self) -> dict[str, Any]:
        """The member `openlabel`."""
        written = [one for one in self.scene.annotations if not isinstance(one, _LEFT_OUT)]
        for annotation, parts in things([one for one in written if not isinstance(one, LinkAnnotation)]):
            self._element(annotation, parts)
        for annotation in written:
            if isinstance(annotation, LinkAnnotation):
                self._relation(annotation)
        self.draft.close()
        self._report_trajectory()
        self.losses += self.streams.losses(self.draft.times)
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
        metadata = {name: value for name, value in own.items() if is_json(value)}
        for name in own.keys() - metadata.keys():
            self.losses.append(Loss(field=f"metadata.{name}", what="left out: JSON cannot state it"))
        return {**found, **({"metadata": metadata} if metadata else {})}

    def _element(self, annotation: Any, parts: Sequence[Annotation]) -> None:
        """Write a thing: its annotation, and those that report more of it as further data of the same object."""
        kind = "event" if isinstance(annotation, EventAnnotation) else "object"
        uid = self.uids.give(annotation.id)
        further = annotation.extras.get(KIND)
        further = dict(further) if isinstance(further, Mapping) else {}
        head = {name: further[name] for name in ("ontology_uid", "resource_uid") if name in further}
        name = further.get("name")
        label = next(
            (stated for one in (annotation, *parts) if (stated := getattr(one, "label", None))), None
        )
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
        return self._state(
            kind, uid, part, dict(further) if isinstance(further, Mapping) else {}, label, is_part=True
        )

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
        if is_json(dict(annotation.extras)):
            fields["extras"] = dict(annotation.extras)
        else:
            field = f"annotations[{annotation.id}].extras"
            self.losses.append(Loss(field=field, what="left out: JSON cannot state it"))
        return fields

    def _seen(self, kind: str, uid: str, annotation: Any) -> dict[str, Any]:
        """Report where and when sensors see a cuboid: the boxes as data, the rest among our fields."""
        found: dict[str, Any] = {}
        if isinstance(annotation, PointsAnnotation) and annotation.projections:
            points = annotation.projections
            seen = [[self._sound(annotation, point_projection_fields(one)) for one in row] for row in points]
            return {"projections": seen}
        if not isinstance(annotation, CuboidAnnotation):
            return found
        if not len(annotation.path.timestamps_ns):
            for name in _SEEN:
                if count := len(getattr(annotation, name)):
                    field = f"annotations[{annotation.id}].{name}"
                    self.losses.append(Loss(field=field, what=_NO_POSITION, count=count))
            return found
        rows = [self._sound(annotation, activation_fields(one)) for one in annotation.activations]
        found.update({"activations": rows} if rows else {})
        rows = []
        for projection in annotation.projections:
            fields = self._sound(annotation, projection_fields(projection))
            system = self._camera(projection.sensor_id)
            data = list(projection_data(projection, f"projection:{system}", system))
            if len({time_ns for time_ns, _, _ in data}) == len(data) and data:
                data = self.draft.renamed(uid, data, annotation.id)
                self.draft.state(kind, uid, data)
                fields.update({"data": data[0][2]["name"], "boxes": None})
            rows.append(fields)
        found.update({"projections": rows} if rows else {})
        return found

    def _sound(self, annotation: Annotation, fields: dict[str, Any]) -> dict[str, Any]:
        """Leave out further fields that JSON cannot state, and report it."""
        if is_json(fields.get("extras")):
            return fields
        field, count = f"annotations[{annotation.id}].extras", len(fields["extras"])
        self.losses.append(Loss(field=field, what="left out: JSON cannot state it", count=count))
        return {name: value for name, value in fields.items() if name != "extras"}

    def _path_extras(self, annotation: Any) -> dict[str, Any]:
        path = getattr(annotation, "path", None)
        further = {} if path is None else {name: path.extras[name] for name in path.extras if name != RBBOX}
        if not further:
            return {}
        if is_json(further):
            return {"path_extras": further}
        field = f"annotations[{annotation.id}].path.extras"
        self.losses.append(Loss(field=field, what="left out: JSON cannot state it", count=len(further)))
        return {}

    def _data(self, annotation: Annotation, further: Mapping[str, Any]) -> list[Datum]:
        """The locations of an annotation, if it has some."""
        reported = further.get("data")
        reported = dict(reported) if isinstance(reported, Mapping) else {}
        name = reported.pop("name", None)
        data: list[Datum] = []
        if isinstance(annotation, CuboidAnnotation):
            data = list(cuboid_data(annotation, name or "cuboid", self.system, self.angles, self.draft.times))
        elif isinstance(annotation, Box2DAnnotation):
            data = list(box_data(annotation, name or "bbox", self._camera(annotation.sensor_id)))
        elif isinstance(annotation, ShapeAnnotation):
            flat = annotation.dimensions == 2
            system = self._camera(annotation.sensor_id) if flat else self.system
            data = list(shape_data(annotation, name or annotation.type.value, system))
        elif isinstance(annotation, PointsAnnotation):
            return list(keypoint_data(annotation, self.system))
        return [(time_ns, kind, {**reported, **element}) for time_ns, kind, element in data]

    def _camera(self, sensor_id: Any) -> str:
        return self.streams.names.get(sensor_id, str(sensor_id))

    def _attributes(
        self, kind: str, uid: str, annotation: Any, *, is_part: bool
    ) -> tuple[list[dict[str, Any]], list[list[str]]]:
        """Write the attributes; give those that the data cannot hold, and type, name and own name of a part's."""
        unsaid, renamed, seen = [], [], set()
        for attribute in annotation.attributes:
            data = attribute_data(attribute, self.streams.names)
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
                    self.losses.append(Loss(field=field, what=what, support=Support.CONVERTED))
            elif is_json([*attribute.values, dict(attribute.extras)]):
                unsaid.append(attribute_fields(attribute))
            else:
                field = f"annotations[{annotation.id}].attributes.{attribute.name}"
                self.losses.append(Loss(field=field, what="left out: JSON cannot state it"))
        return unsaid, renamed

    def _report_further(self, annotation: Any, attribute: AttributePath) -> None:
        unsaid = attribute.extras.keys() - FURTHER
        if unsaid:
            field = f"annotations[{annotation.id}].attributes.{attribute.name}"
            what = f"further fields left out: {', '.join(sorted(unsaid))}"
            self.losses.append(Loss(field=field, what=what))

    def _collides(self, annotation: Any, name: str) -> bool:
        """Whether an attribute of points would be taken for another."""
        return isinstance(annotation, PointsAnnotation) and any(
            attribute.name == name and attribute.point_index is not None
            for attribute in annotation.attributes
        )

    def _report_fields(self, annotation: Any) -> None:
        """Report what an annotation says that is not written."""
        held = getattr(annotation, "path", None)
        if held is not None and not len(held.timestamps_ns):
            what = "it has no location at any time: read back as an object without one"
            self.losses.append(Loss(field=f"annotations[{annotation.id}]", what=what))

    def _keep(self, kind: str, uid: str, annotation: Any, fields: dict[str, Any]) -> None:
        """Keep the fields that only we understand, and the further ones that JSON can state."""
        if is_json(dict(annotation.extras)):
            fields["extras"] = dict(annotation.extras)
        else:
            field = f"annotations[{annotation.id}].extras"
            self.losses.append(Loss(field=field, what="left out: JSON cannot state it"))
        self.draft.ours.setdefault(kind, {})[uid] = fields

    def _relation(self, link: LinkAnnotation) -> None:
        ends = [self.uids.by_id.get(key_of(one)) for one in (link.from_id, link.to_id)]
        if None in ends:
            what = "left out: one of its ends is not written"
            self.losses.append(Loss(field=f"annotations[{link.id}]", what=what))
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
                self.losses.append(
                    Loss(field=f"trajectories[{name}]", what="left out: it has no orientations")
                )
            elif not np.isin(trajectory.timestamps_ns, self.draft.times).all():
                what = "written at the times of the frames"
                field = f"trajectories[{name}].timestamps_ns"
                count = len(trajectory.timestamps_ns)
                self.losses.append(Loss(field=field, what=what, count=count, support=Support.APPROXIMATED))
        for name, trajectory in list(self.scene.trajectories.items())[1:]:
            what = "left out: the format has one ego trajectory"
            self.losses.append(
                Loss(field=f"trajectories[{name}]", what=what, count=len(trajectory.timestamps_ns))
            )


def _labeled_points(annotation: LabeledPointsAnnotation) -> dict[str, Any]:
    return {
        "class": "labeled_points",
        "type": annotation.type,
        "labeled_points": [
            {
                "sensor_id": one.sensor_id,
                "point_ids": one.point_ids.tolist(),
                **({} if one.sensor_frame is None else {"sensor_frame": one.sensor_frame}),
                **({"extras": dict(one.extras)} if one.extras and is_json(dict(one.extras)) else {}),
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
                **({"extras": dict(one.extras)} if one.extras and is_json(dict(one.extras)) else {}),
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
        found += [
            one.timestamps_ns
            for one in getattr(annotation, "attributes", ())
            if one.timestamps_ns is not None
        ]
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
