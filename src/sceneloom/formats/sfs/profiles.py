"""The profiles of writing: what a reader of the file takes, and what has to stand under our metadata for its sake."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from sceneloom.errors import OptionError
from sceneloom.formats.sfs.fields import SENSOR_RECORDS
from sceneloom.formats.sfs.scale_library import (
    ANNOTATIONS,
    PARTS,
    VALIDATED_SENSORS,
    Need,
    attribute_value_fits,
    time_fault,
)
from sceneloom.formats.sfs.times import TICKS_NS, FileClock

Record = Mapping[str, Any]


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
    sensor_obstacle: Callable[[Record, FileClock], str | None]
    annotation_obstacle: Callable[[Record], str | None]
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
    if name not in PROFILES:
        raise OptionError(f"profile {name!r}; expected one of {', '.join(PROFILES)}")
    return PROFILES[name]


_OUR_TYPES = frozenset({"imu", "gnss"})
NO_POSITION = "the format has no such sensor"


def _sfs_sensor(record: Record, _: FileClock) -> str | None:
    return NO_POSITION if record["type"] in _OUR_TYPES else None


def _sfs_annotation(_: Record) -> None:
    return None


def _scale_sensor(record: Record, clock: FileClock) -> str | None:
    """Report what Scale's validator would refuse about a sensor.

    Source: scale-sensor-fusion-io 0.5.4, validation/parser/sfs.py and validation/validate.py.
    """
    type_name = record["type"]
    if type_name in _OUR_TYPES or type_name not in SENSOR_RECORDS:
        return NO_POSITION
    if type_name not in VALIDATED_SENSORS:
        return "Scale's validator knows no such sensor"
    if record.get("poses") is None:
        return "Scale's library needs poses"
    for name, times in _times_of(record).items():
        obstacle = _time_obstacle(name, times, clock)
        if obstacle is not None:
            return obstacle
    return None


def _times_of(record: Record) -> dict[str, list[int]]:
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


def _needed(record: Mapping[str, Need]) -> tuple[str, ...]:
    return tuple(name for name, need in record.items() if need.required and name != "id")


_SCALE_ANNOTATIONS = {name: _needed(record) for name, record in ANNOTATIONS.items()}
_SCALE_PARTS = {
    "activations": _needed(PARTS["activation"]),
    "projections": _needed(PARTS["projection"]),
    "attributes": _needed(PARTS["attribute"]),
}


def _scale_annotation(record: Record) -> str | None:
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
    return (
        None
        if attributes_fit(record.get("attributes") or [])
        else "Scale's loader takes text and integers only"
    )


def _whole_duration(record: Record) -> bool:
    """Whether the duration of an event [ns] is a whole number in a file for Scale's library."""
    duration_ns = record.get("duration") if record["type"] == "event" else None
    return duration_ns is None or (
        isinstance(duration_ns, int) and duration_ns % TICKS_NS["microseconds"] == 0
    )


def _has_null_cuboids(record: Record) -> bool:
    """Whether an activation or a projection has no cuboid at one of its times."""
    parts = [part for name in ("activations", "projections") for part in record.get(name) or []]
    return any(isinstance(part.get("cuboids"), list) and None in part["cuboids"] for part in parts)


def attributes_fit(attributes: Any) -> bool:
    """Whether Scale's loader takes the values of attributes."""
    return all(attribute_fits(attribute) for attribute in attributes)


def attribute_fits(attribute: Record) -> bool:
    """Whether Scale's loader takes one attribute."""
    named = isinstance(attribute.get("name"), str)
    return named and all(attribute_value_fits(value) for value in attribute.get("values") or [])


PROFILES: Mapping[str, Profile] = MappingProxyType(
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
