"""What a scene holds that no message has a location for, as JSON, and back."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from sceneloom.errors import DataError
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS

VERSION = 1

_ATTRIBUTE_PARTS = ("sensor_id", "static", "point_index")


@dataclass(frozen=True, slots=True)
class Notes:
    """What our writer left beside the messages; empty for files of others.

    Attributes:
        sensors, trajectories, annotations: one mapping for each.
        root: everything else by name.
    """

    sensors: tuple[Mapping[str, Any], ...] = ()
    trajectories: tuple[Mapping[str, Any], ...] = ()
    annotations: tuple[Mapping[str, Any], ...] = ()
    root: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def ours(self) -> bool:
        """Whether there are any."""
        return bool(self.root)


def read_notes(text: str | None, name: str) -> Notes:
    """Read what our writer left.

    Raises:
        DataError: it is no such JSON.
    """
    if text is None:
        return Notes()
    try:
        root = msgspec.json.decode(text, type=dict[str, Any])
        lists = {
            key: msgspec.convert(root.get(key, ()), tuple[dict[str, Any], ...])
            for key in ("sensors", "trajectories", "annotations")
        }
    except (msgspec.MsgspecError, RecursionError) as error:
        raise DataError(name, "sceneloom.scene", f"notes that cannot be read: {error}") from error
    return Notes(**lists, root=MappingProxyType(root))


def as_json(value: Any) -> Any:
    """Give a value as JSON says it.

    Raises:
        ValueError: JSON cannot state it.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return float(value)
    if isinstance(value, np.integer | np.floating | np.bool_):
        return as_json(value.item())
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {str(name): as_json(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    raise ValueError(f"a {type(value).__name__}")


def sayable(values: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The values that JSON can state, and the names of the others."""
    kept, lost = {}, []
    for name, value in values.items():
        try:
            kept[name] = as_json(value)
        except ValueError:
            lost.append(name)
    return kept, lost


def attribute_notes(attributes: Iterable[AttributePath]) -> tuple[list[dict[str, Any]], int]:
    """Attributes as JSON, and how many cannot be."""
    kept, lost = [], 0
    for attribute in attributes:
        reported: dict[str, Any] = {"name": attribute.name}
        try:
            reported["values"] = as_json(list(attribute.values))
            if attribute.extras:
                reported["extras"] = as_json(attribute.extras)
        except ValueError:
            lost += 1
            continue
        if attribute.timestamps_ns is not None:
            reported["timestamps_ns"] = attribute.timestamps_ns.tolist()
        reported |= {
            name: value for name in _ATTRIBUTE_PARTS if (value := getattr(attribute, name)) is not None
        }
        kept.append(reported)
    return kept, lost


def attributes_from(notes: Iterable[Mapping[str, Any]], shift_ns: int = 0) -> tuple[AttributePath, ...]:
    """The attributes of notes."""
    return tuple(_attribute(note, shift_ns) for note in notes)


def _attribute(note: Mapping[str, Any], shift_ns: int) -> AttributePath:
    timestamps = note.get("timestamps_ns")
    return AttributePath(
        note["name"],
        tuple(tuple(value) if isinstance(value, list) else value for value in note["values"]),
        None if timestamps is None else np.asarray(timestamps, np.int64) + shift_ns,
        extras=MappingProxyType(note["extras"]) if "extras" in note else NO_FIELDS,
        **{name: note[name] for name in _ATTRIBUTE_PARTS if name in note},
    )
