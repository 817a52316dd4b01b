"""The profiles of writing: what Scale's own library accepts, and what has to stand under our metadata for its sake."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Self, cast

import numpy as np

from sceneloom.arrays import read_only
from sceneloom.errors import OptionError
from sceneloom.formats.sfs.annotations import attribute_values
from sceneloom.formats.sfs.clock import TICKS_NS, FileClock
from sceneloom.formats.sfs.container import RawBytes
from sceneloom.formats.sfs.records import Location, described, times_of
from sceneloom.formats.sfs.schema import COEFFICIENT_COUNTS, RECORDS, SENSOR_RECORDS, Kind
from sceneloom.scene.annotations import Annotation, AttributePath
from sceneloom.scene.types import Identifier, key_of

_LATEST_START = 100_000_000  # latest first timestamp of a series [µs]
_HIGHEST_RATE = 100.0  # most frames or images a second
_TICKS_PER_SECOND = 1e6

VALIDATED_SENSORS = ("lidar", "radar", "camera")
"""The sensors that its validator knows."""

_LOADED_ANNOTATIONS = (
    *("cuboid", "attributes", "box_2d", "polygon_2d", "polygon_topdown", "polyline", "event"),
    *("labeled_points", "point_segmentation", "localization_adjustment", "object"),
)
"""The annotations that its loader takes and converts."""


@dataclass(frozen=True, slots=True)
class _Need:
    """What one field has to be."""

    what: str  # out of `_CHECKS`, or a record's: `@poses` one, `[@attribute]` a list
    required: bool = False
    nullable: bool = True


_NEEDS_BY_KIND = {
    Kind.IDENTIFIER: "id", Kind.TEXT: "text", Kind.FLAG: "flag", Kind.INTEGER: "integer", Kind.TIME: "integer",
    Kind.DURATION: "integer", Kind.NUMBER: "number", Kind.TIMES: "integers", Kind.DURATIONS: "numbers",
    Kind.LIST: "rows", Kind.ARRAY: "array", Kind.POINT_TIMES: "array", Kind.RECORD: "@{}", Kind.RECORDS: "[@{}]",
}  # fmt: skip

_NEEDED_POSES = _Need("@poses", required=True, nullable=False)
_COORDINATES = _Need("ego or world", nullable=False)
_FLAG_BY_DEFAULT = _Need("flag", nullable=False)

_OTHER_NEEDS: Mapping[tuple[str, str], _Need | None] = {
    **{(f"sensor {kind}", "poses"): _NEEDED_POSES for kind in ("lidar", "radar", "camera")},
    ("sensor lidar", "coordinates"): _COORDINATES,
    ("sensor radar", "coordinates"): _COORDINATES,
    ("sensor camera", "coordinates"): None,
    ("annotation attributes", "label"): None,
    ("annotation labeled_points", "attributes"): None,
    ("annotation labeled_points", "is_instance"): _FLAG_BY_DEFAULT,
    ("annotation point_segmentation", "attributes"): None,
    ("annotation point_segmentation", "is_instance"): _FLAG_BY_DEFAULT,
    ("attribute", "values"): _Need("attribute values", required=True, nullable=False),
    ("attribute", "static"): _FLAG_BY_DEFAULT,
    ("attribute", "point_index"): None,
    ("projection", "boxes"): _Need("rows or nulls", required=True, nullable=False),
    ("projection", "confirmed"): None,
    ("lidar_points", "ring"): None,
    ("lidar_points", "camera_index"): None,
    ("distortion", "model"): _Need("distortion model", required=True, nullable=False),
    ("distortion", "params"): _Need("numbers", required=True, nullable=False),
}
"""Where the library differs from the description, or does not look (None)."""


def _needs_of(record: str) -> Mapping[str, _Need]:
    """What the library needs of the fields of a record: those that the description requires or expects."""
    # Source: scale-sensor-fusion-io 0.5.4, spec/sfs/types.py and validation/parser/sfs.py.
    needs: dict[str, _Need] = {}
    for name, field in RECORDS[record].items():
        needed = field.required or field.expected
        usual = _Need(_NEEDS_BY_KIND.get(field.kind, "").format(field.record), needed, not needed)
        need = _OTHER_NEEDS.get((record, name), usual)
        if need is not None and name != "type":
            needs[name] = need
    return MappingProxyType(needs)


ANNOTATIONS = MappingProxyType({name: _needs_of(f"annotation {name}") for name in _LOADED_ANNOTATIONS})
"""The annotations that its loader takes, with what it needs of their fields."""

SENSORS = MappingProxyType({name: _needs_of(f"sensor {name}") for name in VALIDATED_SENSORS})

_PART_NAMES = (
    *("poses", "path", "attribute", "activation", "projection", "labeled_points_of_frame", "lidar_frame"),
    *("radar_frame", "lidar_points", "radar_points", "intrinsics", "distortion", "video", "image"),
)

PARTS: Mapping[str, Mapping[str, _Need]] = MappingProxyType(
    {
        "scene": {"time_offset": _Need("integer"), "attributes": _Need("[@attribute]"), "metadata": _Need("map")},
        **{name: _needs_of(name) for name in _PART_NAMES},
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
        "distortion model": lambda value: isinstance(value, str) and value in COEFFICIENT_COUNTS,
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
        "distortion model": "one of " + ", ".join(COEFFICIENT_COUNTS),
    }
)


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
    return described(value)


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


@dataclass(frozen=True, slots=True)
class Profile:
    """Which programs a file is written for: all that know the format's text, or Scale's own library too.

    Attributes:
        name: "sfs" or "scale".
        scale: whether Scale's own library must load and validate the file. Attributes then have integers for numbers
            and static ones one timestamp, radar points no lengths, frames begin with their earliest point, frames
            without points have no point times, and distortion models are those that the format lists.
        time_units: the units that the readers know.
    """

    name: str
    scale: bool
    time_units: tuple[str, ...]

    @classmethod
    def named(cls, name: str) -> Self:
        """Find a profile.

        Raises:
            OptionError: there is none of that name.
        """
        if name not in {"sfs", "scale"}:
            raise OptionError(f"profile {name!r}; expected one of sfs, scale")
        return cls(name, name == "scale", ("microseconds",) if name == "scale" else tuple(TICKS_NS))

    def sensor_obstacle(self, record: _Record, clock: FileClock) -> str | None:
        """Why a sensor, as a record in nanoseconds, has to stand under our metadata; None: it need not.

        Source: scale-sensor-fusion-io 0.5.4, validation/parser/sfs.py and validation/validate.py.
        """
        type_name = record["type"]
        if type_name in _OUR_TYPES or (self.scale and type_name not in SENSOR_RECORDS):
            return "the format has no such sensor"
        if not self.scale:
            return None
        if type_name not in VALIDATED_SENSORS:
            return "Scale's validator knows no such sensor"
        if record.get("poses") is None:
            return "Scale's library needs poses"
        video = record.get("video") if type_name == "camera" else None
        name = "images" if type_name == "camera" else "frames"
        series = [frame["timestamp"] for frame in record.get(name) or []] if video is None else video["timestamps"]
        for what, times_ns in ((name, series), ("poses", record["poses"]["timestamps"])):
            fault = time_fault([clock.timestamp(int(time)) for time in times_ns], paced=what != "poses")
            if fault is not None:
                return f"Scale's validator refuses {what} with {fault}"
        return None

    def annotation_obstacle(self, record: _Record) -> str | None:
        """Why an annotation, as a record in nanoseconds, has to stand under our metadata; None: it need not.

        Source: scale-sensor-fusion-io 0.5.4, spec/sfs/types.py and model_converters/sfs.py.
        """
        if not self.scale:
            return None
        if record["type"] not in ANNOTATIONS:
            return f"Scale's loader knows no {record['type']} annotation"
        missing = _missing(record, ANNOTATIONS[record["type"]])
        for name, part in (("activations", "activation"), ("projections", "projection"), ("attributes", "attribute")):
            for item in record.get(name) or []:
                missing += [f"{name}[].{field}" for field in _missing(item, PARTS[part])]
        if missing:
            return f"Scale's loader needs {missing[0]}"
        duration_ns = record.get("duration") if record["type"] == "event" else None
        if duration_ns is not None and (type(duration_ns) is not int or duration_ns % TICKS_NS["microseconds"]):
            return "Scale's loader takes durations of whole microseconds only"
        parts = [part for name in ("activations", "projections") for part in record.get(name) or []]
        if any(isinstance(part.get("cuboids"), list) and None in part["cuboids"] for part in parts):
            return "Scale's loader takes no null among the cuboids of a sensor"
        fit = all(map(_attribute_fits, record.get("attributes") or []))
        return None if fit else "Scale's loader takes text and integers only"

    def fitting_attributes(self, attributes: Sequence[_Record]) -> tuple[list[_Record], list[_Record]]:
        """Part the attributes that can be written from those that have to stand under our metadata."""
        fitting: list[_Record] = []
        aside: list[_Record] = []
        for attribute in attributes:
            whole = {**attribute, "values": _integers(_listed(attribute.get("values")))}
            (fitting if not self.scale or _attribute_fits(whole) else aside).append(attribute)
        return fitting, aside

    def simplified_attributes(
        self, attributes: Sequence[_Record], annotation_id: Identifier | None
    ) -> tuple[Sequence[_Record], list[_Record]]:
        """Give attributes as the readers take them, and the records that keep what was changed.

        For Scale's library, numbers become integers: an attribute with fractions is counted in thousandths. Static
        attributes keep their first timestamp.
        """
        if not self.scale:
            return attributes, []
        simplified: list[_Record] = []
        records: list[_Record] = []
        for index, attribute in enumerate(attributes):
            if attribute.get("timestamps") is None:
                simplified.append(attribute)
                continue
            times, values = _listed(attribute["timestamps"]), _listed(attribute.get("values"))
            kept = 1 if attribute.get("static") else len(values)
            written, written_times = _integers(values)[:kept], times[:kept]
            simplified.append({**attribute, "timestamps": written_times, "values": written})
            if written_times != times or not _identical(written, values):
                record = {"index": index, "timestamps": times, "values": values, "written": written}
                records.append(record if annotation_id is None else {"annotation_id": annotation_id, **record})
        return simplified, records


_OUR_TYPES = frozenset({"imu", "gnss"})


def _missing(record: _Record, needs: Mapping[str, _Need]) -> list[str]:
    return [name for name, need in needs.items() if need.required and name != "id" and record.get(name) is None]


def _attribute_fits(attribute: _Record) -> bool:
    """Whether Scale's loader takes one attribute."""
    named = isinstance(attribute.get("name"), str)
    return named and all(map(_attribute_value_fits, attribute.get("values") or []))


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
