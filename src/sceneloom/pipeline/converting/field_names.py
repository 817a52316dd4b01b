"""Which fields of the model a line of a loss report is about."""

import re
from collections.abc import Mapping

from sceneloom.scene.contents import IMU_STREAMS, KINDS, MODEL_FIELDS
from sceneloom.scene.scene import Scene

_TIMESTAMPS = (
    "timestamp_ns",
    "timestamps_ns",
    "start_ns",
    "duration_ns",
    "durations_ns",
    "poses",
    "attributes",
)
_TOGETHER: Mapping[str, tuple[str, ...]] = {
    "timestamps": _TIMESTAMPS,
    "sensors[], annotations[], attributes[]": _TIMESTAMPS,
    "file_seconds": ("file_seconds",),
}
"""Words for the fields of one meaning in all sensors, trajectories and annotations, and their last parts."""

_WORDS = (
    (re.compile(r"\.images(\[\])?\.content$"), ".images.rgb"),
    (re.compile(r"\.timestamp(s?)$"), r".timestamp\1_ns"),
    (re.compile(r"^(sensors\[.*\])\.intrinsics"), r"\1.camera"),
)
"""Words of the Sensor Fusion Scene format for fields that have other names in the model."""

_SEVERAL = re.compile(r"^(sensors|annotations)\[(.*?)\](?=\.|$)")
_STREAM = re.compile(r"^(sensors\.imu\.streams)\.([^.]+)")
_TRAJECTORY = re.compile(r"^trajectories(?:\[.*?\](?=\.|$)|\.([^.]+))")
_INDEX = re.compile(r"\[[^\]]*\]")


def kinds_by_id(scene: Scene) -> dict[str, str]:
    """The kind of each sensor and annotation, by `sensors[ID]` or `annotations[ID]`, else with its type for an ID."""
    several = {"sensors": scene.sensors, "annotations": scene.annotations}
    items = [(name, item) for name, found in several.items() for item in found]
    by_type = {f"{name}[{item.type}]": KINDS[type(item)] for name, item in items}
    return {**by_type, **{f"{name}[{item.id}]": KINDS[type(item)] for name, item in items}}


def fields_meant(location: str, kinds: Mapping[str, str]) -> tuple[str, ...]:
    """Give the fields of the model that a location in the scene is or holds; none if it is no such location.

    Args:
        location: the field of a loss, as a name of `MODEL_FIELDS`, the beginning of one, or with ids and indices in it.
        kinds: of the scene, as `kinds_by_id` gives them.
    """
    if location == "sensors":
        return ("sensors.order",)
    if location in _TOGETHER:
        return tuple(field for field in MODEL_FIELDS if field.rpartition(".")[2] in _TOGETHER[location])
    for pattern, ours in _WORDS:
        location = pattern.sub(ours, location)
    names = _by_kind(location, kinds)
    # of all kinds, those that have such a field; the others have no further field of that name
    found = [field for name in names for field in _at_or_below(name)]
    return tuple(dict.fromkeys(found or [field for name in names for field in _above(name)]))


def _by_kind(location: str, kinds: Mapping[str, str]) -> list[str]:
    """The location with a kind instead of the id; several where all of them are meant."""
    owner = max(
        (key for key in kinds if location == key or location.startswith(f"{key}.")), key=len, default=None
    )
    if owner is not None:
        return [_plain(kinds[owner] + location[len(owner) :])]
    several = _SEVERAL.match(location)
    if several is None:
        return [_plain(location)]
    return [
        _plain(kind + location[several.end() :])
        for kind in KINDS.values()
        if kind.startswith(several.group(1))
    ]


def _plain(location: str) -> str:
    """The location without indices, names of trajectories and of streams that have no rows of their own."""
    trajectory = _TRAJECTORY.match(location)
    if trajectory is not None and f"trajectories.{trajectory.group(1)}" not in MODEL_FIELDS:
        location = "trajectories" + location[trajectory.end() :]
    location = _INDEX.sub("", location)
    stream = _STREAM.match(location)
    if stream is not None and stream.group(2) not in (*IMU_STREAMS, "other"):
        location = f"{stream.group(1)}.other{location[stream.end() :]}"
    return location


def _at_or_below(name: str) -> list[str]:
    """The field of that name, or those below it."""
    return [field for field in MODEL_FIELDS if field == name or field.startswith(f"{name}.")]


def _above(name: str) -> list[str]:
    """The field that one of that name is a part of; further fields are `extras`."""
    above = name.rpartition(".")[0]
    while above:
        for field in (above, f"{above}.extras"):
            if field in MODEL_FIELDS:
                return [field]
        above = above.rpartition(".")[0]
    return []
