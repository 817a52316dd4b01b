"""The profiles of writing: what Scale's own library accepts, and what has to stand under our metadata for its sake."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any, cast

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.annotations import attribute_values
from sceneloom.formats.sfs.clock import TICKS_NS, FileClock
from sceneloom.formats.sfs.container import RawBytes
from sceneloom.formats.sfs.records import times_of
from sceneloom.formats.sfs.schema import SENSOR_RECORDS
from sceneloom.scene.annotations import Annotation, AttributePath
from sceneloom.scene.types import Identifier, key_of

_LATEST_START = 100_000_000
"""Latest first timestamp of a series [µs]."""

_HIGHEST_RATE = 100.0
"""Most frames or images a second."""

_TICKS_PER_SECOND = 1e6

VALIDATED_SENSORS = ("lidar", "radar", "camera")
"""The sensors that its validator knows."""

_DISTORTION_MODELS = (
    "brown_conrady",
    "mod_equi_fish",
    "mod_kannala",
    "fisheye",
    "fisheye_rad_tan_prism",
    "cylindrical",
    "equirectangular",
    "omnidirectional",
    "fisheye_radial_custom",
    "ftheta",
)


@dataclass(frozen=True, slots=True)
class _Need:
    """What one field has to be.

    Attributes:
        what: a name out of `_CHECKS`, or of a record: `@poses` one, `[@attribute]` a list of them.
        required: whether it must be there.
        nullable: whether it may be null.
    """

    what: str
    required: bool = False
    nullable: bool = True


def _needs(what: str) -> _Need:
    return _Need(what, required=True, nullable=False)


def _by_default(what: str) -> _Need:
    return _Need(what, nullable=False)


_ID = {"id": _needs("id"), "parent_id": _Need("id")}
_ATTRIBUTES = {"attributes": _Need("[@attribute]")}
_LABELLED = {**_ID, "label": _Need("text"), **_ATTRIBUTES}
_SHAPE = {**_LABELLED, "stationary": _Need("flag"), "sensor_id": _Need("id"), "path": _needs("@path")}
_FLAT_SHAPE = {**_SHAPE, "sensor_id": _needs("id")}

_LABELED_POINTS = {
    **_ID,
    "label": _needs("text"),
    "labeled_points": _needs("[@labeled_points_of_frame]"),
    "is_instance": _by_default("flag"),
}

ANNOTATIONS: Mapping[str, Mapping[str, _Need]] = MappingProxyType(
    {
        "cuboid": {
            **_LABELLED,
            "stationary": _Need("flag"),
            "path": _needs("@cuboid_path"),
            "activations": _Need("[@activation]"),
            "projections": _Need("[@projection]"),
        },
        "attributes": {**_ID, **_ATTRIBUTES},
        "box_2d": _FLAT_SHAPE,
        "polygon_2d": _FLAT_SHAPE,
        "polygon_topdown": _SHAPE,
        "polyline": {**_SHAPE, "is_closed": _Need("flag")},
        "event": {
            **_LABELLED,
            "start": _needs("integer"),
            "duration": _Need("integer"),
            "sensor_id": _Need("id"),
        },
        "labeled_points": _LABELED_POINTS,
        "point_segmentation": _LABELED_POINTS,
        "localization_adjustment": {**_ID, "poses": _needs("@poses")},
        "object": _LABELLED,
    }
)
"""The annotations that its loader takes and converts, with their fields."""

_MOVING = {**_ID, "poses": _needs("@poses")}
_CLOUD = {**_MOVING, "coordinates": _by_default("ego or world")}

SENSORS: Mapping[str, Mapping[str, _Need]] = MappingProxyType(
    {
        "lidar": {**_CLOUD, "frames": _needs("[@lidar_frame]")},
        "radar": {**_CLOUD, "frames": _needs("[@radar_frame]")},
        "camera": {
            **_MOVING,
            "intrinsics": _needs("@intrinsics"),
            "video": _Need("@video"),
            "images": _Need("[@image]"),
        },
    }
)

PARTS: Mapping[str, Mapping[str, _Need]] = MappingProxyType(
    {
        "scene": {
            "time_offset": _Need("integer"),
            "attributes": _Need("[@attribute]"),
            "metadata": _Need("map"),
        },
        "poses": {"timestamps": _needs("integers"), "values": _needs("rows")},
        "path": {"timestamps": _needs("integers"), "values": _needs("rows")},
        "cuboid_path": {"timestamps": _needs("integers"), "values": _needs("rows")},
        "attribute": {
            "name": _needs("text"),
            "timestamps": _needs("integers"),
            "values": _needs("attribute values"),
            "sensor_id": _Need("id"),
            "static": _by_default("flag"),
        },
        "activation": {
            "sensor_id": _needs("id"),
            "timestamps": _needs("integers"),
            "durations": _needs("numbers"),
            "cuboids": _Need("rows"),
        },
        "projection": {
            "sensor_id": _needs("id"),
            "timestamps": _needs("integers"),
            "boxes": _needs("rows or nulls"),
            "cuboids": _Need("rows"),
        },
        "labeled_points_of_frame": {
            "sensor_id": _needs("id"),
            "point_ids": _needs("array"),
            "sensor_frame": _Need("integer"),
        },
        "lidar_frame": {"timestamp": _needs("integer"), "points": _needs("@lidar_points")},
        "radar_frame": {"timestamp": _needs("integer"), "points": _needs("@radar_points")},
        "lidar_points": {
            "positions": _needs("array"),
            "colors": _Need("array"),
            "intensities": _Need("array"),
            "timestamps": _Need("array"),
        },
        "radar_points": {
            "positions": _needs("array"),
            "directions": _Need("array"),
            "lengths": _Need("array"),
            "timestamps": _Need("array"),
        },
        "intrinsics": {
            **{name: _needs("number") for name in ("fx", "fy", "cx", "cy")},
            "width": _needs("integer"),
            "height": _needs("integer"),
            "distortion": _Need("@distortion"),
        },
        "distortion": {"model": _needs("distortion model"), "params": _needs("numbers")},
        "video": {"timestamps": _needs("integers"), "content": _needs("array"), "fps": _needs("number")},
        "image": {"timestamp": _needs("integer"), "content": _needs("array")},
    }
)
"""The records inside sensors and annotations."""

_NUMBERS = frozenset({int, float, bool})
_INTEGERS = frozenset({int, bool})


def _is_list_of(kinds: frozenset[type]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and kinds.issuperset(map(type, value))


_is_numbers = _is_list_of(_NUMBERS)


def _attribute_value_fits(value: Any) -> bool:
    """Whether its loader takes a value of an attribute: text, an integer, or a list of texts."""
    return isinstance(value, str | int) or (
        isinstance(value, list | tuple) and all(isinstance(text, str) for text in value)
    )


_CHECKS: Mapping[str, Callable[[Any], bool]] = MappingProxyType(
    {
        "id": lambda value: isinstance(value, str | int),
        "text": lambda value: isinstance(value, str),
        "flag": lambda value: isinstance(value, bool),
        "integer": lambda value: isinstance(value, int),
        "number": lambda value: isinstance(value, int | float),
        "map": lambda value: isinstance(value, dict),
        "array": lambda value: isinstance(value, np.ndarray) and not isinstance(value, RawBytes),
        "integers": _is_list_of(_INTEGERS),
        "numbers": _is_numbers,
        "rows": lambda value: isinstance(value, list) and all(map(_is_numbers, value)),
        "rows or nulls": lambda value: (
            isinstance(value, list) and all(row is None or _is_numbers(row) for row in value)
        ),
        "attribute values": lambda value: isinstance(value, list) and all(map(_attribute_value_fits, value)),
        "ego or world": lambda value: isinstance(value, str) and value in ("ego", "world"),
        "distortion model": lambda value: isinstance(value, str) and value in _DISTORTION_MODELS,
    }
)
"""What a field can be, and how that is reported."""

_WORDS = MappingProxyType(
    {
        "id": "text or an integer",
        "flag": "true or false",
        "integer": "an integer",
        "number": "a number",
        "map": "an object",
        "array": "an array with a dtype",
        "integers": "a list of integers",
        "numbers": "a list of numbers",
        "rows": "a list of lists of numbers",
        "rows or nulls": "a list of lists of numbers, or null instead of a list",
        "attribute values": "a list of texts, integers, or lists of texts",
        "ego or world": "'ego' or 'world'",
        "distortion model": "one of " + ", ".join(_DISTORTION_MODELS),
    }
)

Location = tuple[str | int, ...]


def record_faults(record: Any, needs: Mapping[str, _Need], location: Location = ()) -> Iterator[tuple[Location, str]]:
    """Compare a record with what the library needs; give the position of each fault and what is wrong there."""
    if not isinstance(record, dict):
        yield location, f"{_reported(record)}; expected an object"
        return
    for name, need in needs.items():
        if name not in record:
            if need.required:
                yield (*location, name), "missing"
        elif record[name] is None:
            if not need.nullable:
                yield (*location, name), f"null; expected {_expected(need.what)}"
        else:
            yield from _value_faults(record[name], need.what, (*location, name))


def _value_faults(value: Any, what: str, location: Location) -> Iterator[tuple[Location, str]]:
    if what.startswith("@"):
        yield from record_faults(value, PARTS[what[1:]], location)
    elif what.startswith("["):
        if not isinstance(value, list):
            yield location, f"{_reported(value)}; expected a list of objects"
            return
        inner = PARTS[what[2:-1]]
        for index, item in enumerate(value):
            yield from record_faults(item, inner, (*location, index))
    elif not _CHECKS[what](value):
        yield location, f"{_reported(value)}; expected {_expected(what)}"


def _expected(what: str) -> str:
    return "an object" if what.startswith("@") else _WORDS.get(what, what)


def _reported(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype.name} {value.shape}"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def time_fault(timestamps: Sequence[int], *, paced: bool) -> str | None:
    """Report what the validator has against a series of timestamps [µs].

    Args:
        timestamps: in the file's order.
        paced: whether their rate is judged, too: of frames and images, not of poses.
    """
    if len(timestamps) == 0:
        return "no timestamps; expected at least one"
    if min(timestamps) < 0:
        return f"a timestamp of {min(timestamps)}; expected none below 0"
    for before, after in pairwise(timestamps):
        if after <= before:
            return f"a timestamp of {after} after {before}; expected increasing times"
    if timestamps[0] > _LATEST_START:
        return f"a first timestamp of {timestamps[0]} µs; expected it within 100 s, and the rest in time_offset"
    if paced and len(timestamps) > 1:
        rate = _TICKS_PER_SECOND * (len(timestamps) - 1) / (timestamps[-1] - timestamps[0])
        if rate > _HIGHEST_RATE:
            return f"a rate of {rate:.1f} a second; expected at most {_HIGHEST_RATE:g}"
    return None


_Record = Mapping[str, Any]


def restore_exact_attributes(
    records: Any, annotations: tuple[Annotation, ...], attributes: tuple[AttributePath, ...]
) -> tuple[tuple[Annotation, ...], tuple[AttributePath, ...]]:
    """Put exact times and values back where the written ones still stand.

    Args:
        records: `exact_attributes` of our metadata.
        annotations: of the file.
        attributes: of the scene.
    """
    of_scene = [record for record in records if record.get("annotation_id") is None]
    by_annotation: dict[tuple[type, Identifier], list[_Record]] = {}
    for record in records:
        identifier = record.get("annotation_id")
        if identifier is not None:
            by_annotation.setdefault((type(identifier), identifier), []).append(record)
    if by_annotation:
        annotations = tuple(
            _restored(annotation, by_annotation.get(key_of(annotation.id), [])) for annotation in annotations
        )
    return annotations, _restored_attributes(attributes, of_scene)


def _restored(annotation: Annotation, records: Sequence[_Record]) -> Annotation:
    attributes = getattr(annotation, "attributes", ())
    if not records or not attributes:
        return annotation
    restored: Any = replace(cast("Any", annotation), attributes=_restored_attributes(attributes, records))
    return cast("Annotation", restored)


def _restored_attributes(attributes: Sequence[AttributePath], records: Sequence[_Record]) -> tuple[AttributePath, ...]:
    restored = list(attributes)
    for record in records:
        index = record["index"]
        if not 0 <= index < len(restored):
            continue
        values = attribute_values(record["values"])
        times_ns = read_only(times_of(record["timestamps"]))
        if _identical(attribute_values(record["written"]), restored[index].values):
            restored[index] = replace(restored[index], timestamps_ns=times_ns, values=values)
    return tuple(restored)


def simplified_attributes(
    attributes: Sequence[_Record], annotation_id: Identifier | None
) -> tuple[list[_Record], list[_Record]]:
    """Give attributes as Scale's library takes them, and the records that keep what was changed.

    Numbers become integers: an attribute with fractions is counted in thousandths. Static attributes keep their first
    timestamp.
    """
    simplified: list[_Record] = []
    records: list[_Record] = []
    for index, attribute in enumerate(attributes):
        times, values = _listed(attribute.get("timestamps")), _listed(attribute.get("values"))
        written = _integers(values)
        kept = 1 if attribute.get("static") else len(values)
        written, written_times = written[:kept], times[:kept]
        if attribute.get("timestamps") is None:
            simplified.append(attribute)
            continue
        simplified.append({**attribute, "timestamps": written_times, "values": written})
        if written_times != times or not _identical(written, values):
            record = {"index": index, "timestamps": times, "values": values, "written": written}
            records.append(record if annotation_id is None else {"annotation_id": annotation_id, **record})
    return simplified, records


def thousandths(attribute: _Record) -> _Record:
    """Give one attribute with integers for numbers."""
    return {**attribute, "values": _integers(_listed(attribute.get("values")))}


def _listed(values: Any) -> list[Any]:
    return [] if values is None else values.tolist() if isinstance(values, np.ndarray) else list(values)


def _integers(values: Sequence[Any]) -> list[Any]:
    fractions = any(_is_number(value) and value != round(value) for value in values)
    scale = 1000 if fractions else 1
    return [round(value * scale) if _is_number(value) else value for value in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < float("inf")


def _identical(written: Sequence[Any], values: Sequence[Any]) -> bool:
    return [(type(value), value) for value in written] == [(type(value), value) for value in values]


@dataclass(frozen=True, slots=True)
class Profile:
    """One profile.

    Attributes:
        name: as the caller says it.
        time_units: the units that its readers know.
        sensor_obstacle: why a sensor, as a record in nanoseconds, has to stand under our metadata; None: it need not.
        annotation_obstacle: the same for an annotation.
        exact_attributes: whether attributes may have fractions, and static ones several timestamps.
        radar_lengths: whether radar points may have lengths.
        late_frames: whether a frame that was read may start later than its points.
        empty_point_times: whether a frame without points may have an array of point times.
        any_distortion: whether distortion models may have names that the format does not list.
    """

    name: str
    time_units: tuple[str, ...]
    sensor_obstacle: Callable[[_Record, FileClock], str | None]
    annotation_obstacle: Callable[[_Record], str | None]
    exact_attributes: bool
    radar_lengths: bool
    late_frames: bool
    empty_point_times: bool
    any_distortion: bool


def profile_named(name: str) -> Profile:
    """Find a profile.

    Raises:
        OptionError: there is none of that name.
    """
    if name not in _PROFILES:
        raise OptionError(f"profile {name!r}; expected one of {', '.join(_PROFILES)}")
    return _PROFILES[name]


_OUR_TYPES = frozenset({"imu", "gnss"})
_NO_POSITION = "the format has no such sensor"


def _sfs_sensor(record: _Record, _: FileClock) -> str | None:
    return _NO_POSITION if record["type"] in _OUR_TYPES else None


def _sfs_annotation(_: _Record) -> None:
    return None


def _scale_sensor(record: _Record, clock: FileClock) -> str | None:
    """Report what Scale's validator would refuse about a sensor.

    Source: scale-sensor-fusion-io 0.5.4, validation/parser/sfs.py and validation/validate.py.
    """
    type_name = record["type"]
    if type_name in _OUR_TYPES or type_name not in SENSOR_RECORDS:
        return _NO_POSITION
    if type_name not in VALIDATED_SENSORS:
        return "Scale's validator knows no such sensor"
    if record.get("poses") is None:
        return "Scale's library needs poses"
    for name, times in _times_of(record).items():
        obstacle = _time_obstacle(name, times, clock)
        if obstacle is not None:
            return obstacle
    return None


def _times_of(record: _Record) -> dict[str, list[int]]:
    """All series of times of a sensor [ns], by name."""
    if record["type"] == "camera":
        video = record.get("video")
        content = [image["timestamp"] for image in record.get("images") or []]
        times = {"images": content if video is None else list(video["timestamps"])}
    else:
        times = {"frames": [frame["timestamp"] for frame in record["frames"]]}
    return {**times, "poses": list(record["poses"]["timestamps"])}


def _time_obstacle(name: str, times_ns: list[int], clock: FileClock) -> str | None:
    fault = time_fault([clock.timestamp(int(time)) for time in times_ns], paced=name != "poses")
    return None if fault is None else f"Scale's validator refuses {name} with {fault}"


def _needed(record: Mapping[str, _Need]) -> tuple[str, ...]:
    return tuple(name for name, need in record.items() if need.required and name != "id")


_SCALE_ANNOTATIONS = {name: _needed(record) for name, record in ANNOTATIONS.items()}

_SCALE_PARTS = {
    "activations": _needed(PARTS["activation"]),
    "projections": _needed(PARTS["projection"]),
    "attributes": _needed(PARTS["attribute"]),
}


def _scale_annotation(record: _Record) -> str | None:
    """Report what Scale's loader would refuse about an annotation.

    Source: scale-sensor-fusion-io 0.5.4, spec/sfs/types.py and model_converters/sfs.py.
    """
    needed = _SCALE_ANNOTATIONS.get(record["type"])
    if needed is None:
        return f"Scale's loader knows no {record['type']} annotation"
    missing = [name for name in needed if record.get(name) is None]
    for part, names in _SCALE_PARTS.items():
        for item in record.get(part) or []:
            missing += [f"{part}[].{name}" for name in names if item.get(name) is None]
    if missing:
        return f"Scale's loader needs {missing[0]}"
    if not _whole_duration(record):
        return "Scale's loader takes durations of whole microseconds only"
    if _has_null_cuboids(record):
        return "Scale's loader takes no null among the cuboids of a sensor"
    return None if _attributes_fit(record.get("attributes") or []) else "Scale's loader takes text and integers only"


def _whole_duration(record: _Record) -> bool:
    """Whether the duration of an event [ns] is a whole number in a file for Scale's library."""
    duration_ns = record.get("duration") if record["type"] == "event" else None
    return duration_ns is None or (isinstance(duration_ns, int) and duration_ns % TICKS_NS["microseconds"] == 0)


def _has_null_cuboids(record: _Record) -> bool:
    """Whether an activation or a projection has no cuboid at one of its times."""
    parts = [part for name in ("activations", "projections") for part in record.get(name) or []]
    return any(isinstance(part.get("cuboids"), list) and None in part["cuboids"] for part in parts)


def _attributes_fit(attributes: Any) -> bool:
    """Whether Scale's loader takes the values of attributes."""
    return all(attribute_fits(attribute) for attribute in attributes)


def attribute_fits(attribute: _Record) -> bool:
    """Whether Scale's loader takes one attribute."""
    named = isinstance(attribute.get("name"), str)
    return named and all(_attribute_value_fits(value) for value in attribute.get("values") or [])


_PROFILES: Mapping[str, Profile] = MappingProxyType(
    {
        "sfs": Profile(
            name="sfs",
            time_units=tuple(TICKS_NS),
            sensor_obstacle=_sfs_sensor,
            annotation_obstacle=_sfs_annotation,
            exact_attributes=True,
            radar_lengths=True,
            late_frames=True,
            empty_point_times=True,
            any_distortion=True,
        ),
        "scale": Profile(
            name="scale",
            time_units=("microseconds",),
            sensor_obstacle=_scale_sensor,
            annotation_obstacle=_scale_annotation,
            exact_attributes=False,
            radar_lengths=False,
            late_frames=False,
            empty_point_times=False,
            any_distortion=False,
        ),
    }
)
"""The profiles by name: the format's text, and what Scale's own library loads and validates."""
