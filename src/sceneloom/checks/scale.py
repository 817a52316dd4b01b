"""Rules of the profile `scale`: whatever Scale's own library refuses to load or to validate."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.checks.rule import ERROR, HINT, WARNING, Hit, Rule, Subject
from sceneloom.formats.sfs.container import format_keys
from sceneloom.formats.sfs.profiles import ANNOTATIONS, PARTS, SENSORS, VALIDATED_SENSORS, record_faults, time_fault
from sceneloom.formats.sfs.records import Location

Located = tuple[Location, Any]
_VERSION = "1.0"


def _items(subject: Subject, name: str) -> Iterator[Located]:
    """The sensors or annotations of the file, as they stand in its header, with their locations."""
    found = (subject.header or {}).get(name)
    for index, item in enumerate(found if isinstance(found, list) else ()):
        yield (name, index), item


def _hit(location: Location, message: str) -> Hit:
    return Hit(format_keys(location), message)


def _scene_faults(subject: Subject) -> Iterator[Hit]:
    header = subject.header
    if header is None:
        return
    version = header.get("version")
    if not isinstance(version, str) or version != _VERSION:
        yield _hit(("version",), f"{version!r}; expected {_VERSION!r}")
    unit = header.get("time_unit", "microseconds")
    if not (isinstance(unit, str) and unit == "microseconds"):
        yield _hit(("time_unit",), f"{unit!r}; expected microseconds")
    offset = header.get("time_offset")
    if isinstance(offset, int) and offset < 0:
        yield _hit(("time_offset",), f"{offset}; expected none below 0")
    for name in ("sensors", "annotations"):
        if header.get(name) is not None and not isinstance(header[name], list):
            yield _hit((name,), "no list")
    for location, problem in record_faults(dict(header), PARTS["scene"]):
        yield _hit(location, problem)


def _type_of(record: Any) -> str:
    """The type of a sensor or annotation, "" where it has none."""
    kind = record.get("type") if isinstance(record, dict) else None
    return kind if isinstance(kind, str) else ""


def _unknown_sensors(subject: Subject) -> Iterator[Hit]:
    for location, sensor in _items(subject, "sensors"):
        kind = _type_of(sensor)
        if kind not in VALIDATED_SENSORS:
            yield _hit((*location, "type"), f"{kind!r}; the library validates {', '.join(VALIDATED_SENSORS)} only")


def _unknown_annotations(subject: Subject) -> Iterator[Hit]:
    for location, annotation in _items(subject, "annotations"):
        kind = _type_of(annotation)
        if kind not in ANNOTATIONS:
            yield _hit((*location, "type"), f"{kind!r}; the library loads {', '.join(ANNOTATIONS)} only")


class Parsed(NamedTuple):
    """A sensor or annotation of a type that the library knows, and what it has against its fields."""

    location: Location
    record: Mapping[str, Any]
    faults: tuple[tuple[Location, str], ...]


def _parsed(subject: Subject) -> list[Parsed]:
    def made(inner: Subject) -> list[Parsed]:
        return [
            Parsed(location, record, tuple(record_faults(record, records[_type_of(record)], location)))
            for name, records in (("sensors", SENSORS), ("annotations", ANNOTATIONS))
            for location, record in _items(inner, name)
            if _type_of(record) in records
        ]

    return subject.table("what Scale's library parses", made)


def _field_faults(subject: Subject) -> Iterator[Hit]:
    for parsed in _parsed(subject):
        for location, problem in parsed.faults:
            yield _hit(location, problem)


def _sound(subject: Subject, name: str) -> Iterator[tuple[Location, Mapping[str, Any]]]:
    """The sensors or annotations whose fields are as they have to be, so that their contents can be judged."""
    for location, record, faults in _parsed(subject):
        if location[0] == name and not faults:
            yield location, record


def _repeated_ids(subject: Subject) -> Iterator[Hit]:
    seen: dict[Any, Location] = {}
    for location, sensor in _items(subject, "sensors"):
        identifier = sensor.get("id") if isinstance(sensor, dict) else None
        if isinstance(identifier, str | int):
            first = seen.setdefault(identifier, location)
            if first != location:
                yield _hit((*location, "id"), f"{identifier!r} is the id of {format_keys(first)}, too")


def _time_faults(subject: Subject) -> Iterator[Hit]:
    for location, sensor in _sound(subject, "sensors"):
        for inside, timestamps in _series_of(sensor):
            fault = time_fault(timestamps, paced=inside[0] != "poses")
            if fault is not None:
                yield _hit((*location, *inside), fault)


def _series_of(sensor: Mapping[str, Any]) -> Iterator[tuple[Location, list[int]]]:
    if sensor["type"] != "camera":
        yield ("frames",), [frame["timestamp"] for frame in sensor["frames"]]
    elif sensor.get("video") is not None:
        yield ("video", "timestamps"), sensor["video"]["timestamps"]
    else:
        yield ("images",), [image["timestamp"] for image in sensor.get("images") or []]
    yield ("poses", "timestamps"), sensor["poses"]["timestamps"]


def _rows_that_do_not_convert(subject: Subject) -> Iterator[Hit]:
    for location, sensor in _sound(subject, "sensors"):
        yield from _path_faults(sensor["poses"], 7, (*location, "poses"), empty=False)
    for location, annotation in _sound(subject, "annotations"):
        if annotation["type"] == "cuboid":
            yield from _path_faults(annotation["path"], 9, (*location, "path"), empty=True)
        elif annotation["type"] == "localization_adjustment":
            yield from _path_faults(annotation["poses"], 7, (*location, "poses"), empty=False)


def _path_faults(path: Mapping[str, Any], columns: int, location: Location, *, empty: bool) -> Iterator[Hit]:
    timestamps, rows = path["timestamps"], path["values"]
    if not rows and not empty:
        yield _hit((*location, "values"), f"no rows; expected at least one of {columns} numbers")
    elif len(timestamps) != len(rows):
        yield _hit((*location, "values"), f"{len(rows)} rows for {len(timestamps)} timestamps; expected as many")
    for index, row in enumerate(rows):
        if len(row) != columns:
            yield _hit((*location, "values", index), f"{len(row)} numbers; expected {columns}")
            return


_DTYPES: Mapping[str, np.dtype[Any]] = {
    "positions": np.dtype(np.float32),
    "colors": np.dtype(np.uint8),
    "intensities": np.dtype(np.uint8),
    "directions": np.dtype(np.float32),
    "timestamps": np.dtype(np.uint32),
}

_COLUMNS = {"positions": 3, "colors": 3, "directions": 3}


def _point_faults(subject: Subject) -> Iterator[Hit]:
    for location, sensor in _sound(subject, "sensors"):
        for number, frame in enumerate(sensor.get("frames", ())):
            inside = (*location, "frames", number, "points")
            for name, problem in _faults_of_points(frame["points"]):
                yield _hit((*inside, name), problem)
            early = _earlier_than(frame["timestamp"], subject, frame["points"].get("timestamps"))
            if early is not None:
                yield _hit((*inside, "timestamps"), early)


def _faults_of_points(points: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    count = points["positions"].size // 3
    for name, dtype in _DTYPES.items():
        array = points.get(name)
        if array is None:
            continue
        columns = _COLUMNS.get(name, 1)
        if array.dtype != dtype:
            yield name, f"{array.dtype.name}; expected {dtype.name}"
        elif array.size != count * columns or (columns == 1 and array.ndim != 1):
            yield name, f"shape {array.shape}; expected {count} rows of {columns}"


def _earlier_than(timestamp: int, subject: Subject, timestamps: AnyArray | None) -> str | None:
    """What is wrong with the times of points, if any is before their frame's."""
    if timestamps is None or timestamps.dtype != _DTYPES["timestamps"]:
        return None
    first = int(subject.fetched(timestamps).min()) if timestamps.size else 0
    earliest = f"the earliest is {first}" if timestamps.size else "no times count as 0"
    return None if timestamp <= first else f"{earliest}; expected none before the frame's {timestamp}"


def _radar_lengths(subject: Subject) -> Iterator[Hit]:
    for location, sensor in _items(subject, "sensors"):
        frames = sensor.get("frames") if _type_of(sensor) == "radar" else None
        for number, frame in enumerate(frames if isinstance(frames, list) else ()):
            points = frame.get("points") if isinstance(frame, dict) else None
            lengths = points.get("lengths") if isinstance(points, dict) else None
            if isinstance(lengths, np.ndarray):
                what = "cannot be cut into rows of 3" if lengths.size % 3 else "are dropped in silence"
                inside = (*location, "frames", number, "points", "lengths")
                yield _hit(inside, f"{lengths.size} lengths {what}")


def _static_attributes(subject: Subject) -> Iterator[Hit]:
    header = subject.header or {}
    owners = [((), header), *_items(subject, "annotations")]
    for location, owner in owners:
        attributes = owner.get("attributes") if isinstance(owner, Mapping) else None
        for index, attribute in enumerate(attributes if isinstance(attributes, list) else ()):
            timestamps = attribute.get("timestamps") if isinstance(attribute, dict) else None
            if isinstance(timestamps, list) and attribute.get("static") is True and len(timestamps) > 1:
                yield _hit((*location, "attributes", index), f"static, with {len(timestamps)} timestamps; expected one")


_DROPPED: Mapping[str, tuple[str, ...]] = {
    "lidar": ("parent_id", "coordinates"),
    "radar": ("parent_id", "coordinates"),
    "camera": ("parent_id", "coordinates"),
}


def _dropped(subject: Subject) -> Iterator[Hit]:
    for location, sensor in _items(subject, "sensors"):
        for name in _DROPPED.get(_type_of(sensor), ()):
            if isinstance(sensor.get(name), str | int) and sensor[name] != "world":
                yield _hit((*location, name), f"{sensor[name]!r} is dropped by the loader")


# fmt: off
_RULES: tuple[Rule, ...] = (
    Rule("scale-scene", ERROR, "Version, unit and offset of the scene are those that Scale's library takes.",
         "Write the scene again with `--profile scale`.", find=_scene_faults),
    Rule("scale-sensor-type", ERROR, "All sensors are of types that Scale's validator knows.",
         "Write the scene again with `--profile scale`: it keeps other sensors under the metadata.",
         find=_unknown_sensors),
    Rule("scale-sensor-ids", ERROR, "Sensors have ids of their own.", "Rename all but one.", find=_repeated_ids),
    Rule("scale-annotation-type", ERROR, "All annotations are of types that Scale's loader reads and converts.",
         "Write the scene again with `--profile scale`: it keeps other annotations under the metadata.",
         find=_unknown_annotations),
    Rule("scale-field", ERROR, "Every field that Scale's library reads is there and of its type.",
         "Write the scene again with `--profile scale`.", find=_field_faults),
    Rule("scale-times", ERROR,
         "The times of frames, images and poses are not negative, increase, begin within 100 s and come at most "
         "100 a second.", "Put the start into `time_offset`; leave frames out, or give them their own times.",
         find=_time_faults),
    Rule("scale-rows", ERROR, "Paths of poses and cuboids have a row of 7 or 9 numbers for each timestamp.",
         "Give each timestamp its row.", find=_rows_that_do_not_convert),
    Rule("scale-points", ERROR,
         "The arrays of points have the types and lengths that Scale's validator wants, and no point is measured "
         "before its frame.", "Write the scene again with `--profile scale`.", find=_point_faults),
    Rule("scale-radar-lengths", ERROR,
         "Radar points have no lengths: Scale's loader cuts them into rows of three, or drops them.",
         "Write the scene again with `--profile scale`: it keeps the lengths under the metadata.", find=_radar_lengths),
    Rule("scale-static-attribute", WARNING, "Static attributes have one timestamp.", "Keep the first value.",
         find=_static_attributes),
    Rule("scale-dropped", HINT, "Sensors state nothing that Scale's library drops.",
         "Keep a copy of the file: what that library writes no longer has it.", find=_dropped),
)
# fmt: on

SCALE_RULES = tuple(replace(rule, profiles=("scale",)) for rule in _RULES)
