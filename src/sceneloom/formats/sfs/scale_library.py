"""What Scale's own library takes: the fields of its records, the series of times that it accepts, and what it drops.

Its loader builds typed records and converts them, its validator parses sensors once more and judges them. What either
refuses is listed here once, for files to be written and for files to be checked.

Source: scale-sensor-fusion-io 0.5.4: spec/sfs/types.py, model_converters/sfs.py, loaders/sfs_loader.py,
validation/parser/sfs.py and validation/validate.py, each line tried by the tests with the library itself.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.formats.sfs.container import RawBytes

LATEST_START = 100_000_000
"""Latest first timestamp of a series [µs]."""

HIGHEST_RATE = 100.0
"""Most frames or images a second."""

TICKS_PER_SECOND = 1e6

VALIDATED_SENSORS = ("lidar", "radar", "camera")
"""The sensors that its validator knows."""

DISTORTION_MODELS = (
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
class Need:
    """What one field has to be.

    Attributes:
        what: a name out of `CHECKS`, or of a record: `@poses` one, `[@attribute]` a list of them.
        required: whether it must be there.
        nullable: whether it may be null.
    """

    what: str
    required: bool = False
    nullable: bool = True


def _needs(what: str) -> Need:
    return Need(what, required=True, nullable=False)


def _by_default(what: str) -> Need:
    return Need(what, nullable=False)


_ID = {"id": _needs("id"), "parent_id": Need("id")}
_ATTRIBUTES = {"attributes": Need("[@attribute]")}
_LABELLED = {**_ID, "label": Need("text"), **_ATTRIBUTES}
_SHAPE = {**_LABELLED, "stationary": Need("flag"), "sensor_id": Need("id"), "path": _needs("@path")}
_FLAT_SHAPE = {**_SHAPE, "sensor_id": _needs("id")}
_LABELED_POINTS = {
    **_ID,
    "label": _needs("text"),
    "labeled_points": _needs("[@labeled_points_of_frame]"),
    "is_instance": _by_default("flag"),
}

ANNOTATIONS: Mapping[str, Mapping[str, Need]] = MappingProxyType(
    {
        "cuboid": {
            **_LABELLED,
            "stationary": Need("flag"),
            "path": _needs("@cuboid_path"),
            "activations": Need("[@activation]"),
            "projections": Need("[@projection]"),
        },
        "attributes": {**_ID, **_ATTRIBUTES},
        "box_2d": _FLAT_SHAPE,
        "polygon_2d": _FLAT_SHAPE,
        "polygon_topdown": _SHAPE,
        "polyline": {**_SHAPE, "is_closed": Need("flag")},
        "event": {
            **_LABELLED,
            "start": _needs("integer"),
            "duration": Need("integer"),
            "sensor_id": Need("id"),
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

SENSORS: Mapping[str, Mapping[str, Need]] = MappingProxyType(
    {
        "lidar": {**_CLOUD, "frames": _needs("[@lidar_frame]")},
        "radar": {**_CLOUD, "frames": _needs("[@radar_frame]")},
        "camera": {
            **_MOVING,
            "intrinsics": _needs("@intrinsics"),
            "video": Need("@video"),
            "images": Need("[@image]"),
        },
    }
)

PARTS: Mapping[str, Mapping[str, Need]] = MappingProxyType(
    {
        "scene": {
            "time_offset": Need("integer"),
            "attributes": Need("[@attribute]"),
            "metadata": Need("map"),
        },
        "poses": {"timestamps": _needs("integers"), "values": _needs("rows")},
        "path": {"timestamps": _needs("integers"), "values": _needs("rows")},
        "cuboid_path": {"timestamps": _needs("integers"), "values": _needs("rows")},
        "attribute": {
            "name": _needs("text"),
            "timestamps": _needs("integers"),
            "values": _needs("attribute values"),
            "sensor_id": Need("id"),
            "static": _by_default("flag"),
        },
        "activation": {
            "sensor_id": _needs("id"),
            "timestamps": _needs("integers"),
            "durations": _needs("numbers"),
            "cuboids": Need("rows"),
        },
        "projection": {
            "sensor_id": _needs("id"),
            "timestamps": _needs("integers"),
            "boxes": _needs("rows or nulls"),
            "cuboids": Need("rows"),
        },
        "labeled_points_of_frame": {
            "sensor_id": _needs("id"),
            "point_ids": _needs("array"),
            "sensor_frame": Need("integer"),
        },
        "lidar_frame": {"timestamp": _needs("integer"), "points": _needs("@lidar_points")},
        "radar_frame": {"timestamp": _needs("integer"), "points": _needs("@radar_points")},
        "lidar_points": {
            "positions": _needs("array"),
            "colors": Need("array"),
            "intensities": Need("array"),
            "timestamps": Need("array"),
        },
        "radar_points": {
            "positions": _needs("array"),
            "directions": Need("array"),
            "lengths": Need("array"),
            "timestamps": Need("array"),
        },
        "intrinsics": {
            **{name: _needs("number") for name in ("fx", "fy", "cx", "cy")},
            "width": _needs("integer"),
            "height": _needs("integer"),
            "distortion": Need("@distortion"),
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


def attribute_value_fits(value: Any) -> bool:
    """Whether its loader takes a value of an attribute: text, an integer, or a list of texts."""
    return isinstance(value, str | int) or (
        isinstance(value, list | tuple) and all(isinstance(text, str) for text in value)
    )


CHECKS: Mapping[str, Callable[[Any], bool]] = MappingProxyType(
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
        "attribute values": lambda value: isinstance(value, list) and all(map(attribute_value_fits, value)),
        "ego or world": lambda value: isinstance(value, str) and value in ("ego", "world"),
        "distortion model": lambda value: isinstance(value, str) and value in DISTORTION_MODELS,
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
        "distortion model": "one of " + ", ".join(DISTORTION_MODELS),
    }
)

Location = tuple[str | int, ...]


def record_faults(
    record: Any, needs: Mapping[str, Need], location: Location = ()
) -> Iterator[tuple[Location, str]]:
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
    elif not CHECKS[what](value):
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
    if timestamps[0] > LATEST_START:
        return (
            f"a first timestamp of {timestamps[0]} µs; expected it within 100 s, and the rest in time_offset"
        )
    if paced and len(timestamps) > 1:
        rate = TICKS_PER_SECOND * (len(timestamps) - 1) / (timestamps[-1] - timestamps[0])
        if rate > HIGHEST_RATE:
            return f"a rate of {rate:.1f} a second; expected at most {HIGHEST_RATE:g}"
    return None
