"""What edits keep consistent: warnings, our metadata, ids and references to them, camera indices of points."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import OptionError
from sceneloom.scene.annotations import Annotation, LinkAnnotation, PlainAnnotation
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.motion import GnssSensor, ImuSensor, PlainSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Identifier, Key, key_of
from sceneloom.warnings import DataWarning

OURS = "sceneloom"
"""Name of our part of a scene's metadata."""


def ours_of(scene: Scene) -> Mapping[str, Any]:
    """Our part of a scene's metadata; empty where there is none."""
    ours = scene.metadata.get(OURS)
    return ours if isinstance(ours, Mapping) else {}


def with_ours(scene: Scene, **entries: Any) -> Scene:
    """The scene with some of our entries of the metadata set; None removes one."""
    ours = {name: value for name, value in {**ours_of(scene), **entries}.items() if value is not None}
    free = {name: value for name, value in scene.metadata.items() if name != OURS}
    return replace(scene, metadata=MappingProxyType({**free, **({OURS: ours} if ours else {})}))


def with_warnings(scene: Scene, warnings: Iterable[DataWarning]) -> Scene:
    """The scene with further warnings; those that count nothing are left out."""
    reported = tuple(warning for warning in warnings if warning.count > 0)
    return replace(scene, warnings=(*scene.warnings, *reported)) if reported else scene


DropField = Callable[[str, Any, str], bool]
"""Whether a field is removed: by its name ("" for an item of a list), its value and its location."""


def without(value: Any, location: str, drop: DropField) -> Any:
    """Give mappings and lists without some of their fields, at any depth; the very value where none is removed."""
    if isinstance(value, Mapping):
        stay = {k: one for k, one in value.items() if not drop(str(k), one, f"{location}.{k}")}
        fields = {k: without(one, f"{location}.{k}", drop) for k, one in stay.items()}
        same = len(fields) == len(value) and all(one is value[k] for k, one in fields.items())
        return value if same else fields
    if isinstance(value, list | tuple):
        kept = [(k, one) for k, one in enumerate(value) if not drop("", one, f"{location}[{k}]")]
        items = [without(one, f"{location}[{k}]", drop) for k, one in kept]
        same = len(items) == len(value) and all(a is b for a, b in zip(items, value, strict=True))
        return value if same else items
    return value


def without_fields(scene: Scene, drop: DropField) -> Scene:
    """Give the scene without some fields of its metadata, and of the extras of itself, its sensors and annotations."""

    def bare(part: Any, location: str) -> Any:
        extras = getattr(part, "extras", None)
        return replace(part, extras=without(extras, f"{location}.extras", drop)) if extras else part

    return replace(
        scene,
        sensors=tuple(bare(sensor, f"sensors[{sensor.id}]") for sensor in scene.sensors),
        annotations=tuple(bare(annotation, f"annotations[{annotation.id}]") for annotation in scene.annotations),
        metadata=without(scene.metadata, "metadata", drop),
        extras=without(scene.extras, "extras", drop),
    )


@dataclass(frozen=True, slots=True, eq=False)
class NewIds:
    """What becomes of ids.

    Attributes:
        changed: the new id of each that changes; None where its owner is gone.
    """

    changed: Mapping[Key, Identifier | None]

    def __call__(self, identifier: Identifier) -> Identifier | None:
        """The id now; None where its owner is gone."""
        return self.changed.get(key_of(identifier), identifier)

    def gone(self, identifier: Identifier | None) -> bool:
        """Whether the owner of an id is gone."""
        return identifier is not None and self(identifier) is None


_ENTRIES = ("attributes", "activations", "projections", "labeled_points")
"""Fields of annotations whose entries may be for one sensor."""


def with_sensor_ids(part: Any, sensors: NewIds) -> Any:
    """Give an annotation, or an entry of one, that names sensors by their new ids; None if it is for one that is gone.

    Labelled points of which none are left go, too.
    """
    if isinstance(part, PlainAnnotation):
        named = part.fields.get("sensor_id")
        if not isinstance(named, str | int):
            return part
        fields = {**part.fields, "sensor_id": sensors(named)}
        return None if sensors.gone(named) else replace(part, fields=fields)
    named = getattr(part, "sensor_id", None)
    if sensors.gone(named):
        return None
    changes: dict[str, Any] = {} if named is None else {"sensor_id": sensors(named)}
    for name in _ENTRIES:
        if entries := getattr(part, name, ()):
            changes[name] = entries_of(entries, sensors)
    if not changes.get("labeled_points", True):
        return None
    return replace(part, **changes) if changes else part


def entries_of(entries: Iterable[Any], sensors: NewIds) -> tuple[Any, ...]:
    """Of entries per sensor, such as attributes, or tuples of such those whose sensor stays, by the new ids."""
    new = (entries_of(e, sensors) if isinstance(e, tuple) else with_sensor_ids(e, sensors) for e in entries)
    return tuple(entry for entry in new if entry is not None)


def with_annotation_ids(annotation: Annotation, ids: NewIds) -> Annotation | None:
    """Give an annotation by its new id, with its parent and its ends; None for a link one of whose ends is gone."""
    identifier, parent_id = ids(annotation.id), annotation.parent_id
    if identifier is None:
        return None
    if isinstance(annotation, LinkAnnotation):
        ends = ids(annotation.from_id), ids(annotation.to_id)
        if ends[0] is None or ends[1] is None:
            return None
        annotation = replace(annotation, from_id=ends[0], to_id=ends[1])
    changed: Annotation = _with_parent(annotation, identifier, None if parent_id is None else ids(parent_id))
    return changed


def with_sensor_parent(sensor: Sensor, ids: NewIds) -> Sensor:
    """Give a sensor by its new id and that of its parent; a parent that is gone is not named."""
    identifier, parent_id = ids(sensor.id), sensor.parent_id
    new_parent = None if parent_id is None else ids(parent_id)
    if identifier is None or (identifier == sensor.id and new_parent == parent_id):
        return sensor
    changed: Sensor = _with_parent(sensor, identifier, new_parent)
    return changed


def _with_parent(part: Any, identifier: Identifier, parent_id: Identifier | None) -> Any:
    if not isinstance(part, PlainAnnotation | PlainSensor):
        return replace(part, id=identifier, parent_id=parent_id)
    parent = {} if part.parent_id is None else {"parent_id": parent_id}
    return replace(part, id=identifier, fields=MappingProxyType({**part.fields, **parent}))


_NAMING = ("unfused", "extrapolated", "deskew", "fusion")
"""Our entries of the metadata that name sensors: by `sensor_id`, and in lists `lidars` and `cameras`.

The order of a fusion's `cameras` is what `camera_index` counts.
"""


def metadata_of(ours: Mapping[str, Any], sensors: NewIds) -> dict[str, Any]:
    """Give our metadata with sensors named by their new ids, without what is stated for sensors that are gone."""
    return {name: _by_new_ids(value, sensors) if name in _NAMING else value for name, value in ours.items()}


def _by_new_ids(value: Any, sensors: NewIds) -> Any:
    if isinstance(value, list | tuple):
        new = [_by_new_ids(entry, sensors) for entry in value]
        return [entry for entry in new if not (isinstance(entry, Mapping) and entry.get("sensor_id", 0) is None)]
    if not isinstance(value, Mapping):
        return value
    changed = dict(value)
    if isinstance(value.get("sensor_id"), str | int):
        changed["sensor_id"] = sensors(value["sensor_id"])
    for name in ("lidars", "cameras"):
        if isinstance(value.get(name), list):
            ids = [sensors(one) if isinstance(one, str | int) else one for one in value[name]]
            changed[name] = [identifier for identifier in ids if identifier is not None]
    return changed


_UNSEEN = 255  # the `camera_index` of a point that no camera coloured


def recounted(lidar: LidarSensor, numbers: Mapping[int, int]) -> LidarSensor:
    """Give a lidar whose points name their cameras by new numbers, by the old ones; of others, no camera.

    Raises:
        OptionError: a number is beyond those that a point can hold.
    """
    if max(numbers.values(), default=0) >= _UNSEEN:
        raise OptionError(f"{max(numbers.values()) + 1} cameras; points can name {_UNSEEN} at most")
    table = np.full(256, _UNSEEN, np.uint8)
    for old, new in numbers.items():
        table[old] = new
    return replace(lidar, frames=lidar.frames.mapped(partial(_recounted_frame, table)))


def _recounted_frame(table: UInt8Array, frame: LidarFrame) -> LidarFrame:
    index = frame.points.camera_index
    return frame if index is None else replace(frame, points=replace(frame.points, camera_index=table[index]))


LINES, TEXTS = "recording", "further_keys"
"""Our entry of the metadata with lines of recordings that say more than their samples.

In it, such lines by stream and by time [ns] as text.
"""


WHOLE_LABELS = ("openlabel", "document")
"""Our entry of the metadata with the text of the OpenLABEL file that a scene was read from."""


def streams_of(sensor: Sensor) -> list[str]:
    """The names under which a recording keeps lines of a sensor."""
    if isinstance(sensor, ImuSensor):
        return [f"imu.{name}" for name in sensor.streams]
    if isinstance(sensor, GnssSensor):
        return ["gnss" if sensor.id == "gnss" else f"gnss.{sensor.id}"]
    if isinstance(sensor, LidarSensor):
        return [f"lidars.{str(sensor.id).removeprefix('lidar') or 0}"]
    return []
