"""Annotations whose times are moved, as those of what they were drawn in."""

from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array, read_only
from sceneloom.scene.poses import Poses
from sceneloom.scene.types import Key, key_of

Right = Callable[[Int64Array], Int64Array]
"""Gives the right times of timestamps (…,) int64 [ns]."""

Part = TypeVar("Part")

_MOMENTS = ("start_ns", "timestamp_ns")


def retimed_annotation(part: Part, sensors: Mapping[Key, Right], otherwise: Right | None) -> Part:
    """Move the times of an annotation or of a part of one.

    Args:
        part: any object of the annotations' model.
        sensors: by sensor; a part that names one of them goes with it, with all that is in it.
        otherwise: for what names no sensor; None: its times stay.
    """
    named = getattr(part, "sensor_id", None)
    right = otherwise if named is None else sensors.get(key_of(named))
    if right is None and not sensors:
        return part
    changes = {
        field.name: changed
        for field in fields(part)  # type: ignore[arg-type]
        if (changed := _changed(field.name, getattr(part, field.name), sensors, right)) is not None
    }
    if not changes:
        return part
    moved: Part = replace(part, **changes)  # type: ignore[type-var]
    return moved


def _changed(name: str, value: Any, sensors: Mapping[Key, Right], right: Right | None) -> Any:
    """A field's new value; None where it stays."""
    if name == "timestamps_ns" and isinstance(value, np.ndarray):
        return None if right is None or len(value) == 0 else read_only(right(value))
    if name in _MOMENTS and isinstance(value, int):
        return None if right is None else int(right(np.array(value, np.int64)))
    if isinstance(value, Poses) and value.static:
        return None
    if isinstance(value, tuple) and any(is_dataclass(item) or isinstance(item, tuple) for item in value):
        return tuple(_retimed_item(item, sensors, right) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return _retimed_item(value, sensors, right)
    return None


def _retimed_item(item: Any, sensors: Mapping[Key, Right], right: Right | None) -> Any:
    if isinstance(item, tuple):
        return tuple(_retimed_item(inner, sensors, right) for inner in item)
    return retimed_annotation(item, sensors, right) if is_dataclass(item) else item
