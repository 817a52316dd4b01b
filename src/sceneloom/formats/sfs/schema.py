"""The table of fields of a Sensor Fusion Scene: names, kinds, units.

And removal of parts of a header together with all that depends on them.
"""

import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.formats.sfs.container import format_keys


class Kind(StrEnum):
    """What a field holds, in words for messages."""

    ANYTHING = "anything"
    IDENTIFIER = "an id: text or an integer"
    TEXT = "text"
    FLAG = "true or false"
    INTEGER = "an integer"
    NUMBER = "a number"
    TIME = "a timestamp: an integer"
    TIMES = "a list of timestamps"
    DURATION = "a duration: a number"
    DURATIONS = "a list of durations"
    LIST = "a list"
    ARRAY = "an array"
    POINT_TIMES = "an array of timestamps"
    RECORD = "an object"
    RECORDS = "a list of objects"
    RECORD_OR_RECORDS = "an object or a list of objects"
    RECORD_LISTS = "a list of lists of objects"
    RECORD_MAP = "an object of objects"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a record.

    Attributes:
        name: as in the file.
        kind: what it holds.
        required: whether a file without it is at fault.
        expected: whether the description requires it, though a file without it can be read.
        unit: "m", "px", "file" for the scene's time unit, …; for people.
        record: the record of a RECORD, RECORDS and the like.
        dtype: the dtype of an ARRAY.
        columns: how many numbers a row of an ARRAY has; 0 for a plain list of numbers.
        ours: whether it is our extension; one of another dtype is then a stranger's and kept as unknown.
    """

    name: str
    kind: Kind
    required: bool = False
    unit: str = ""
    record: str = ""
    dtype: str = ""
    columns: int = 0
    ours: bool = False
    expected: bool = False


def _expects(field: Field) -> Field:
    return replace(field, expected=True)


def _needs(name: str, kind: Kind, unit: str = "", record: str = "") -> Field:
    return Field(name, kind, required=True, unit=unit, record=record)


def _array(name: str, dtype: str, columns: int = 0, unit: str = "", *, required: bool = False) -> Field:
    return Field(name, Kind.ARRAY, required=required, unit=unit, dtype=dtype, columns=columns)


def _ours(field: Field) -> Field:
    return replace(field, ours=True)


_ID = _needs("id", Kind.IDENTIFIER)

_TYPE = _needs("type", Kind.TEXT)

_PARENT = Field("parent_id", Kind.IDENTIFIER)

_SENSOR = Field("sensor_id", Kind.IDENTIFIER)

_OF_SENSOR = _needs("sensor_id", Kind.IDENTIFIER)

_LABEL = Field("label", Kind.TEXT)

_STATIONARY = Field("stationary", Kind.FLAG)

_TIMESTAMPS = _needs("timestamps", Kind.TIMES, "file")

_VALUES = _needs("values", Kind.LIST)

_ATTRIBUTES = Field("attributes", Kind.RECORDS, record="attribute")

_POSES = Field("poses", Kind.RECORD, unit="m, x y z w", record="poses")

_COORDINATES = Field("coordinates", Kind.TEXT)

_POINT_TIMES = Field("timestamps", Kind.POINT_TIMES, unit="file")

_CUBOIDS = Field("cuboids", Kind.LIST, unit="m, angles")

_POSITIONS = _array("positions", "float32", 3, "m", required=True)

_SENSOR_FIELDS = (_ID, _TYPE, _PARENT)

_MOVING_FIELDS = (*_SENSOR_FIELDS, _POSES, _COORDINATES)

_ANNOTATION_FIELDS = (_ID, _TYPE, _PARENT)

_LABELLED_FIELDS = (*_ANNOTATION_FIELDS, _LABEL, _ATTRIBUTES)

_OBJECT_FIELDS = (*_LABELLED_FIELDS, _STATIONARY)

_SHAPE_FIELDS = (*_OBJECT_FIELDS, _SENSOR, _needs("path", Kind.RECORD, record="path"))

_FLAT_SHAPE_FIELDS = (*_OBJECT_FIELDS, _OF_SENSOR, _needs("path", Kind.RECORD, record="path"))

_LABELED_POINTS_FIELDS = (
    *_ANNOTATION_FIELDS,
    _expects(_LABEL),
    _ATTRIBUTES,
    _expects(Field("is_instance", Kind.FLAG)),
    _needs("labeled_points", Kind.RECORDS, record="labeled_points_of_frame"),
)

SENSOR_RECORDS: Mapping[str, tuple[Field, ...]] = MappingProxyType(
    {
        "points": (*_SENSOR_FIELDS, _needs("points", Kind.RECORD, record="map_points")),
        "lidar": (*_MOVING_FIELDS, _needs("frames", Kind.RECORDS, record="lidar_frame")),
        "radar": (*_MOVING_FIELDS, _needs("frames", Kind.RECORDS, record="radar_frame")),
        "camera": (
            *_MOVING_FIELDS,
            _needs("intrinsics", Kind.RECORD, record="intrinsics"),
            Field("video", Kind.RECORD, record="video"),
            Field("images", Kind.RECORDS, record="image"),
        ),
        "odometry": (*_SENSOR_FIELDS, replace(_POSES, required=True)),
        "imu": (*_SENSOR_FIELDS, _needs("streams", Kind.RECORD_MAP, record="samples")),
        "gnss": (
            *_SENSOR_FIELDS,
            _array("timestamps_ns", "int64", unit="ns", required=True),
            _array("positions_lla", "float64", 3, "deg, deg, m", required=True),
            _array("accuracies", "float64", unit="m", required=True),
            _array("vertical_accuracies", "float64", unit="m", required=True),
            _array("file_seconds", "float64", unit="s"),
            Field("mount", Kind.LIST, unit="rows of R, t [m]"),
        ),
    }
)
"""The fields of each type of sensor; `imu` and `gnss` stand only under our metadata."""

ANNOTATION_RECORDS: Mapping[str, tuple[Field, ...]] = MappingProxyType(
    {
        "cuboid": (
            *_OBJECT_FIELDS,
            _needs("path", Kind.RECORD, record="path"),
            Field("activations", Kind.RECORDS, record="activation"),
            Field("projections", Kind.RECORDS, record="projection"),
        ),
        "box_2d": _FLAT_SHAPE_FIELDS,
        "polyline_2d": _FLAT_SHAPE_FIELDS,
        "polygon_2d": _FLAT_SHAPE_FIELDS,
        "point_2d": _FLAT_SHAPE_FIELDS,
        "polygon": _SHAPE_FIELDS,
        "polygon_topdown": _SHAPE_FIELDS,
        "polyline": (*_SHAPE_FIELDS, Field("is_closed", Kind.FLAG)),
        "point": _SHAPE_FIELDS,
        "point_topdown": _SHAPE_FIELDS,
        "points": (
            *_OBJECT_FIELDS,
            _SENSOR,
            Field("labels", Kind.LIST),
            _needs("paths", Kind.RECORD_OR_RECORDS, record="point_path"),
            Field("projections", Kind.RECORD_LISTS, record="point_projection"),
        ),
        "event": (
            *_LABELLED_FIELDS,
            _SENSOR,
            _needs("start", Kind.TIME, "file"),
            Field("duration", Kind.DURATION, unit="file"),
        ),
        "labeled_points": _LABELED_POINTS_FIELDS,
        "point_segmentation": _LABELED_POINTS_FIELDS,
        "localization_adjustment": (*_ANNOTATION_FIELDS, replace(_POSES, required=True)),
        "camera_calibration": (
            *_ANNOTATION_FIELDS,
            _OF_SENSOR,
            _POSES,
            Field("intrinsics", Kind.RECORD, record="intrinsics"),
            Field("time_offset", Kind.DURATION, unit="file"),
        ),
        "object": _LABELLED_FIELDS,
        "attributes": _LABELLED_FIELDS,
        "link": (
            *_ANNOTATION_FIELDS,
            _expects(_LABEL),
            _ATTRIBUTES,
            _SENSOR,
            _expects(Field("is_bidirectional", Kind.FLAG)),
            _needs("from_id", Kind.IDENTIFIER),
            _needs("to_id", Kind.IDENTIFIER),
        ),
        "group": _LABELLED_FIELDS,
    }
)
"""The fields of each type of annotation."""

_PART_RECORDS: Mapping[str, tuple[Field, ...]] = {
    "poses": (_TIMESTAMPS, _VALUES),
    "path": (_TIMESTAMPS, _VALUES),
    "point_path": (Field("id", Kind.IDENTIFIER), _TIMESTAMPS, _VALUES),
    "attribute": (
        _needs("name", Kind.TEXT),
        _SENSOR,
        Field("static", Kind.FLAG),
        Field("point_index", Kind.INTEGER),
        _expects(Field("timestamps", Kind.TIMES, unit="file")),
        _expects(Field("values", Kind.LIST)),
    ),
    "activation": (
        _OF_SENSOR,
        _TIMESTAMPS,
        _expects(Field("durations", Kind.DURATIONS, unit="file")),
        _CUBOIDS,
    ),
    "projection": (
        _OF_SENSOR,
        _TIMESTAMPS,
        _expects(Field("boxes", Kind.LIST, unit="px")),
        Field("confirmed", Kind.LIST),
        _CUBOIDS,
    ),
    "point_projection": (
        _OF_SENSOR,
        _TIMESTAMPS,
        _expects(Field("points", Kind.LIST, unit="px")),
        Field("confirmed", Kind.LIST),
        Field("positions", Kind.LIST, unit="m"),
    ),
    "labeled_points_of_frame": (
        _OF_SENSOR,
        Field("sensor_frame", Kind.INTEGER),
        _array("point_ids", "uint32", required=True),
    ),
    "map_points": (_POSITIONS, _array("colors", "uint8", 3)),
    "lidar_frame": (
        _needs("timestamp", Kind.TIME, "file"),
        _needs("points", Kind.RECORD, record="lidar_points"),
    ),
    "lidar_points": (
        _POSITIONS,
        _array("colors", "uint8", 3),
        _array("intensities", "uint8"),
        _POINT_TIMES,
        _ours(_array("ring", "uint16")),
        _ours(_array("camera_index", "uint8")),
    ),
    "radar_frame": (
        _needs("timestamp", Kind.TIME, "file"),
        _needs("points", Kind.RECORD, record="radar_points"),
    ),
    "radar_points": (
        _POSITIONS,
        _array("directions", "float32", 3),
        _array("lengths", "float32", unit="m/s"),
        _POINT_TIMES,
    ),
    "intrinsics": (
        _needs("fx", Kind.NUMBER, "px"),
        _needs("fy", Kind.NUMBER, "px"),
        _needs("cx", Kind.NUMBER, "px"),
        _needs("cy", Kind.NUMBER, "px"),
        _needs("width", Kind.INTEGER, "px"),
        _needs("height", Kind.INTEGER, "px"),
        Field("distortion", Kind.RECORD, record="distortion"),
    ),
    "distortion": (_expects(Field("model", Kind.TEXT)), _expects(Field("params", Kind.LIST))),
    "video": (
        _TIMESTAMPS,
        _array("content", "uint8", required=True),
        _expects(Field("fps", Kind.NUMBER, unit="1/s")),
    ),
    "image": (_needs("timestamp", Kind.TIME, "file"), _array("content", "uint8", required=True)),
    "unknown_frame": (Field("timestamp", Kind.TIME, unit="file"),),
    "unknown_sensor": (
        *_MOVING_FIELDS,
        Field("frames", Kind.RECORDS, record="unknown_frame"),
        Field("timestamps", Kind.TIMES, unit="file"),
    ),
    "samples": (
        _array("timestamps_ns", "int64", unit="ns", required=True),
        _array("values", "float64", columns=-1, required=True),
        _array("file_seconds", "float64", unit="s"),
    ),
    "trajectory": (
        _needs("name", Kind.TEXT),
        _SENSOR,
        _array("timestamps_ns", "int64", unit="ns"),
        _array("positions", "float64", 3, "m"),
        _array("quaternions_xyzw", "float64", 4),
        _array("file_seconds", "float64", unit="s"),
        _array("covariances", "float64", 36, "rad², rad m, m²"),
    ),
    "camera": (
        _needs("model", Kind.TEXT),
        _needs("width", Kind.INTEGER, "px"),
        _needs("height", Kind.INTEGER, "px"),
        _needs("fx", Kind.NUMBER, "px"),
        _needs("fy", Kind.NUMBER, "px"),
        _needs("cx", Kind.NUMBER, "px"),
        _needs("cy", Kind.NUMBER, "px"),
        _needs("coefficients", Kind.LIST),
    ),
    "images_note": (
        Field("cameras", Kind.RECORDS, record="camera"),
        Field("camera_of_image", Kind.LIST),
        Field("mounts", Kind.LIST, unit="rows of R, t [m]"),
        Field("extras", Kind.LIST),
    ),
    "sensor_note": (
        _ID,
        Field("points_frame", Kind.TEXT),
        Field("model", Kind.TEXT),
        Field("mount", Kind.LIST, unit="rows of R, t [m]"),
        Field("poses_from_mount", Kind.FLAG),
        Field("poses_static", Kind.FLAG),
        Field("coordinates", Kind.TEXT),
        Field("camera", Kind.RECORD, record="camera"),
        Field("written_camera", Kind.RECORD, record="camera"),
        Field("images", Kind.RECORD, record="images_note"),
        Field("lengths", Kind.LIST, unit="m/s"),
    ),
    "unfused": (
        _OF_SENSOR,
        _needs("timestamp_ns", Kind.INTEGER, "ns"),
        _needs("reason", Kind.TEXT),
        _needs("points", Kind.RECORD, record="unfused_points"),
    ),
    "unfused_points": (
        _POSITIONS,
        _array("colors", "uint8", 3),
        _array("intensities", "uint8"),
        _array("timestamps_ns", "int64", unit="ns"),
        _array("ring", "uint16"),
    ),
    "exact_attribute": (
        Field("annotation_id", Kind.IDENTIFIER),
        _needs("index", Kind.INTEGER),
        _TIMESTAMPS,
        _VALUES,
        _needs("written", Kind.LIST),
    ),
    "warning": (
        _needs("kind", Kind.TEXT),
        _needs("code", Kind.TEXT),
        _needs("location", Kind.TEXT),
        _needs("message", Kind.TEXT),
        _needs("count", Kind.INTEGER),
    ),
    "sceneloom": (
        Field("layout", Kind.INTEGER),
        Field("time_shift_ns", Kind.INTEGER, unit="ns"),
        Field("euler_unit", Kind.TEXT),
        Field("euler_order", Kind.TEXT),
        Field("tangential", Kind.TEXT),
        Field("tangential_before", Kind.TEXT),
        Field("assumed_models", Kind.LIST),
        Field("sensor_notes", Kind.RECORDS, record="sensor_note"),
        Field("sensors", Kind.LIST),
        Field("annotations", Kind.LIST),
        _ATTRIBUTES,
        Field("trajectories", Kind.RECORDS, record="trajectory"),
        Field("unfused", Kind.RECORDS, record="unfused"),
        Field("exact_attributes", Kind.RECORDS, record="exact_attribute"),
        Field("warnings", Kind.RECORDS, record="warning"),
    ),
    "scene": (
        _needs("version", Kind.TEXT),
        Field("time_unit", Kind.TEXT),
        Field("time_offset", Kind.NUMBER, unit="file"),
        Field("sensors", Kind.LIST),
        Field("annotations", Kind.LIST),
        _ATTRIBUTES,
        Field("metadata", Kind.ANYTHING),
    ),
}


def _unknown_annotation() -> tuple[Field, ...]:
    """All fields that annotations of any type have, none of them required."""
    fields = {field.name: field for record in ANNOTATION_RECORDS.values() for field in record}
    return tuple(replace(field, required=False) for field in fields.values())


def _by_name(fields: tuple[Field, ...]) -> Mapping[str, Field]:
    return MappingProxyType({field.name: field for field in fields})


RECORDS: Mapping[str, Mapping[str, Field]] = MappingProxyType(
    {
        **{name: _by_name(fields) for name, fields in _PART_RECORDS.items()},
        **{f"sensor {name}": _by_name(fields) for name, fields in SENSOR_RECORDS.items()},
        **{f"annotation {name}": _by_name(fields) for name, fields in ANNOTATION_RECORDS.items()},
        "unknown_annotation": _by_name(_unknown_annotation()),
    }
)
"""Every record by name, its fields by name."""

SENSOR_ALIASES: Mapping[str, str] = MappingProxyType({"gps": "odometry", "odometer": "odometry"})
"""Names of sensor types that stand for another."""


def sensor_record(type_name: str) -> str:
    """Name the record of a type of sensor; an unknown type has one that demands nothing."""
    name = SENSOR_ALIASES.get(type_name, type_name)
    return f"sensor {name}" if name in SENSOR_RECORDS else "unknown_sensor"


def annotation_record(type_name: str) -> str:
    """Name the record of a type of annotation; an unknown type has one that demands nothing."""
    return f"annotation {type_name}" if type_name in ANNOTATION_RECORDS else "unknown_annotation"


COEFFICIENT_COUNTS: Mapping[str, int] = MappingProxyType(
    {
        "brown_conrady": 10,
        "fisheye": 4,
        "mod_equi_fish": 4,
        "mod_kannala": 4,
        "cylindrical": 0,
        "equirectangular": 0,
        "omnidirectional": 9,
        "fisheye_rad_tan_prism": 12,
        "fisheye_radial_custom": 10,
        "ftheta": 5,
    }
)
"""How many numbers each model has. Source: the SFS description and scale-sensor-fusion-io 0.5.4."""

Keys = tuple[str | int, ...]
"""The path of a value in the header."""

_OURS = ("metadata", "sceneloom")

_RECORD_KINDS = {
    Kind.RECORD,
    Kind.RECORDS,
    Kind.RECORD_OR_RECORDS,
    Kind.RECORD_LISTS,
    Kind.RECORD_MAP,
}

_TYPED_LISTS = {"sensors": sensor_record, "annotations": annotation_record}

_OF_FRAMES = {"frames": ("lengths",), "images": ("camera_of_image", "mounts", "extras")}

_ANY, _MAP = "any of ", "map of "

_STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")

_TIMED_ROWS = frozenset({"poses", "path", "point_path"})

_NEEDED_ALL_THE_SAME = {
    "attribute": {"timestamps", "values", "static", "sensor_id", "point_index"},
    "activation": {"durations"},
    "labeled_points_of_frame": {"sensor_frame"},
    "intrinsics": {"distortion"},
    "distortion": {"model", "params"},
    **{f"sensor {name}": {"coordinates", "parent_id"} for name in ("lidar", "radar", "camera")},
    **{f"annotation {name}": {"sensor_id"} for name in ("polygon", "polygon_topdown", "polyline", "points")},
    "annotation camera_calibration": {"poses", "intrinsics", "time_offset"},
}
"""Fields that a record can be read without, but would mean something else then."""


def parse_path(path: str) -> Keys:
    """Take a path such as `sensors[3].frames[12].points` apart."""
    return tuple(int(index) if index else name for name, index in _STEP.findall(path))


def what_goes(header: Mapping[str, Any], keys: Keys) -> Keys | None:
    """Report what has to be taken out where the value at `keys` is lost: it, or the record that needs it.

    Returns:
        The path of a field that may be absent, of an entry of a list of records, or of a row of `values` that goes with
        its timestamp; None where there is no such location, or the scene cannot be without it.
    """
    removable: Keys | None = None
    node: Any = header
    record: str | None = "scene"
    for depth, key in enumerate(keys):
        if isinstance(node, dict):
            if key not in node:
                needed = _field_of(record, key)
                return removable if needed is not None and needed.required else None
            if record is not None and record.startswith(_MAP):
                record, removable, node = record.removeprefix(_MAP), keys[: depth + 1], node[key]
                continue
            field = _field_of(record, key)
            if field is None or not (field.required or key in _NEEDED_ALL_THE_SAME.get(record or "", ())):
                removable = keys[: depth + 1]
            if record in _TIMED_ROWS and _is_timed_row(node, keys[depth:]):
                return keys[: depth + 2]
            record = _record_below(record, str(key), field, keys[:depth])
        elif isinstance(node, list) and isinstance(key, int) and key < len(node):
            if record is not None:
                removable = keys[: depth + 1]
                record = _record_of_entry(record, node[key])
        elif isinstance(node, list):
            return None
        else:
            break
        node = node[key]
    return removable


def _field_of(record: str | None, key: str | int) -> Field | None:
    return RECORDS.get(record or "", {}).get(str(key))


def _record_below(record: str | None, name: str, field: Field | None, above: Keys) -> str | None:
    if record in {"scene", "sceneloom"} and name in _TYPED_LISTS:
        return f"{_ANY}{name}"
    if record == "scene" and name == "metadata":
        return None
    if (*above, name) == _OURS:
        return "sceneloom"
    if field is None or field.kind not in _RECORD_KINDS:
        return None
    return f"{_MAP}{field.record}" if field.kind == Kind.RECORD_MAP else str(field.record)


def _record_of_entry(record: str, entry: Any) -> str | None:
    """The record of an entry of a list, which for sensors and annotations depends on its type."""
    if not record.startswith(_ANY):
        return record
    type_name = entry.get("type") if isinstance(entry, dict) else None
    return _TYPED_LISTS[record.removeprefix(_ANY)](type_name if isinstance(type_name, str) else "")


def _is_timed_row(record: Mapping[str, Any], keys: Keys) -> bool:
    """Whether keys lead to one of several rows of `values`, each of which has its timestamp."""
    times, rows = record.get("timestamps"), record.get("values")
    return (
        len(keys) > 1
        and keys[0] == "values"
        and isinstance(times, list | np.ndarray)
        and isinstance(rows, list | np.ndarray)
        and len(times) == len(rows) > 1
        and isinstance(keys[1], int)
        and keys[1] < len(rows)
    )


def what_goes_with(header: Mapping[str, Any], locations: Iterable[Keys]) -> dict[Keys, Keys]:
    """Report of locations whose values are lost what has to be taken out; those that nothing can be taken out for lack.

    Where all rows of a path are lost, what needs the path goes in their location.
    """
    goes = {keys: victim for keys in locations if (victim := what_goes(header, keys)) is not None}
    rows: dict[Keys, set[Keys]] = defaultdict(set)
    for victim in goes.values():
        if _removal_is_timed_row(victim):
            rows[victim[:-1]].add(victim)
    for parent, lost in rows.items():
        if len(lost) == len(_at(header, parent)):
            instead = what_goes(header, parent)
            for keys, victim in list(goes.items()):
                if victim in lost and instead is not None:
                    goes[keys] = instead
    return goes


def _removal_is_timed_row(keys: Keys) -> bool:
    """Whether a victim is a row of a path, which goes with its timestamp."""
    return len(keys) > 2 and keys[-2] == "values" and isinstance(keys[-1], int)


def outermost(locations: Iterable[Keys]) -> list[Keys]:
    """Those that are not inside another, in their order."""
    wanted = dict.fromkeys(locations)
    return [keys for keys in wanted if not any(keys[:depth] in wanted for depth in range(1, len(keys)))]


def copied(node: Any) -> Any:
    """Copy the objects and lists of a header; arrays stay the same."""
    if isinstance(node, dict):
        return {name: copied(value) for name, value in node.items()}
    return [copied(value) for value in node] if isinstance(node, list) else node


def is_listed_thing(keys: Keys) -> bool:
    """Whether keys lead to a whole sensor or annotation."""
    return len(keys) > 1 and keys[:-2] in ((), _OURS) and keys[-2] in _TYPED_LISTS


_SINGULAR = {"frames": "frame", "images": "image"}


def in_words(header: Mapping[str, Any], keys: Keys) -> str:
    """Name a part of a header for people: "colors of frame 12 of lidar 'top'"."""
    depth = 4 if keys[:2] == _OURS else 2
    if not is_listed_thing(keys[:depth]):
        return format_keys(keys)
    thing = _at(header, keys[:depth])
    named = isinstance(thing, dict) and isinstance(thing.get("type"), str)
    owner = f"{thing['type']} {thing.get('id')!r}" if named else format_keys(keys[:depth])
    inner = keys[depth:]
    if len(inner) > 1 and inner[0] in _SINGULAR:
        owner, inner = f"{_SINGULAR[str(inner[0])]} {inner[1]} of {owner}", inner[2:]
    inner = inner[1:] if len(inner) > 1 and inner[0] == "points" else inner
    return f"{format_keys(inner)} of {owner}" if inner else owner


class Numbering:
    """Where the entries of a header's lists were before some were taken out."""

    def __init__(self) -> None:
        """Begin with a whole header."""
        self._before: dict[Keys, Sequence[int]] = {}

    def before(self, keys: Keys) -> Keys:
        """Where something was that is now at `keys`."""
        found: Keys = ()
        for key in keys:
            numbers = self._before.get(found)
            known = numbers is not None and isinstance(key, int) and key < len(numbers)
            found = (*found, numbers[int(key)] if numbers is not None and known else key)
        return found

    def frames(self) -> Mapping[Keys, Sequence[int]]:
        """The numbers that the frames and images that stay had, by the keys of their list."""
        return {keys: numbers for keys, numbers in self._before.items() if keys[-1] in _OF_FRAMES}

    def follow(self, kept: Mapping[Keys, Sequence[int]]) -> None:
        """Follow a removal: which entries stay, by the keys of their list as it was when they were taken out."""
        found = {self.before(keys): (keys, numbers) for keys, numbers in kept.items()}
        for before, (_, numbers) in found.items():
            known = self._before.get(before)
            self._before[before] = [known[k] for k in numbers] if known is not None else numbers


def take_out(header: dict[str, Any], victims: Iterable[Keys]) -> Mapping[Keys, Sequence[int]]:
    """Remove fields and entries; what counts the frames or images of a sensor is brought into step.

    Returns:
        Which entries stay, by the keys of each list that some were taken out of.
    """
    parents: dict[Keys, list[str | int]] = defaultdict(list)
    stay: dict[Keys, Sequence[int]] = {}
    for keys in victims:
        parents[keys[:-1]].append(keys[-1])
    counted: list[tuple[Any, str, list[int], int]] = []
    for parent, names in sorted(parents.items(), key=lambda item: len(item[0]), reverse=True):
        node = _at(header, parent)
        if isinstance(node, dict):
            for name in names:
                gone_with = node.pop(str(name), None)
                if name == "video" and isinstance(gone_with, dict):
                    counted.append((node.get("id"), "images", [], _count_of(gone_with.get("timestamps"))))
            continue
        gone = set(names)
        kept = [k for k in range(len(node)) if k not in gone]
        stay[parent] = kept
        holder = _at(header, parent[:-1])
        if parent[-1] in _OF_FRAMES:
            counted.append((holder.get("id"), str(parent[-1]), kept, len(node)))
        elif parent[-1] == "values":
            times = holder["timestamps"]
            holder["timestamps"] = times[kept] if isinstance(times, np.ndarray) else [times[k] for k in kept]
        elif parent[-1] == "paths":
            _keep_points_in_step(holder, kept, len(node))
        holder_of_list: Any = holder
        holder_of_list[parent[-1]] = node[kept] if isinstance(node, np.ndarray) else [node[k] for k in kept]
    for sensor_id, name, kept, count in counted:
        keep_in_step(header, sensor_id, name, kept, count)
    return stay


def _keep_points_in_step(annotation: dict[str, Any], kept: list[int], count: int) -> None:
    """Follow points that were taken out of a points annotation in its labels, projections and attributes."""
    _choose(annotation, ("labels", "projections"), kept, count)
    locations = {old: new for new, old in enumerate(kept)}
    attributes = annotation.get("attributes")
    if isinstance(attributes, list):
        annotation["attributes"] = [
            {**entry, "point_index": locations[entry["point_index"]]} if _is_of_point(entry) else entry
            for entry in attributes
            if not _is_of_point(entry) or entry["point_index"] in locations
        ]


def _is_of_point(attribute: Any) -> bool:
    return isinstance(attribute, dict) and type(attribute.get("point_index")) is int


def keep_in_step(header: dict[str, Any], sensor_id: Any, name: str, kept: list[int], count: int) -> None:
    """Follow frames or images that were taken out in our notes, and in labelled points.

    Args:
        header: the header, which is changed.
        sensor_id: the sensor that they belong to.
        name: "frames" or "images".
        kept: which of them stay.
        count: how many there were.
    """
    for note in _records(header, (*_OURS, "sensor_notes")):
        if note.get("id") == sensor_id:
            for holder in (note, note.get("images")):
                _choose(holder, _OF_FRAMES[name], kept, count)
    if name == "frames":
        locations = {old: new for new, old in enumerate(kept)}
        for root in ((), _OURS):
            for annotation in _records(header, (*root, "annotations")):
                _renumber(annotation, sensor_id, locations)


def _count_of(values: Any) -> int:
    return len(values) if isinstance(values, list) else 0


def _at(header: Mapping[str, Any], keys: Keys) -> Any:
    node: Any = header
    for key in keys:
        node = node[key]
    return node


def _choose(holder: Any, names: tuple[str, ...], kept: list[int], count: int) -> None:
    for name in names:
        values = holder.get(name) if isinstance(holder, dict) else None
        if isinstance(values, list) and len(values) == count:
            holder[name] = [values[k] for k in kept]


def _renumber(annotation: dict[str, Any], sensor_id: Any, locations: Mapping[int, int]) -> None:
    entries = annotation.get("labeled_points")
    if not isinstance(entries, list):
        return
    annotation["labeled_points"] = [
        {**entry, "sensor_frame": locations[entry["sensor_frame"]]} if _counts(entry, sensor_id) else entry
        for entry in entries
        if not _counts(entry, sensor_id) or entry["sensor_frame"] in locations
    ]


def _counts(entry: Any, sensor_id: Any) -> bool:
    """Whether labelled points name a frame of this sensor by its number."""
    return (
        isinstance(entry, dict)
        and entry.get("sensor_id") == sensor_id
        and type(entry.get("sensor_frame")) is int
    )


def _records(header: Mapping[str, Any], keys: Keys) -> list[dict[str, Any]]:
    node: Any = header
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return [entry for entry in node if isinstance(entry, dict)] if isinstance(node, list) else []
