"""Texts, numbers and the like as attributes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.formats.openlabel.collection import Stated
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.openlabel.words import KEPT_WHOLE, PLAIN
from sceneloom.scene.annotations.attributes import AttributePath

TYPE = "openlabel_type"
"""Further field of an attribute: the type of its data, where the value does not report it."""

_TAKEN = ("name", "val", "coordinate_system")


def attribute(kind: str, name: str, rows: Sequence[Stated]) -> AttributePath:
    """What was stated under one name, over time.

    Raises:
        DataError: a value is none of its kind.
    """
    ordered = sorted(rows, key=lambda row: (row.time_ns is not None, row.time_ns or 0))
    values = tuple(_value(kind, row.part) for row in ordered)
    times = [row.time_ns for row in ordered if row.time_ns is not None]
    first = ordered[0].part.members()
    further = {} if kind in KEPT_WHOLE else {key: first[key] for key in first if key not in _TAKEN}
    if kind in KEPT_WHOLE:
        further[TYPE] = kind
    seen_by = first.get("coordinate_system") if kind in PLAIN else None
    static = len(times) < len(values)
    return AttributePath(
        name,
        values,
        None if static else np.array(times, np.int64),
        sensor_id=seen_by if isinstance(seen_by, str) else None,
        static=True if static else None,
        extras=MappingProxyType(further),
    )


def nested_flag(row: Stated, name: str) -> bool | None:
    """A boolean that stands inside of an element of data, or None."""
    attributes = row.part.get("attributes")
    for part in () if attributes is None else attributes.items("boolean"):
        value = part.members().get("val")
        if part.members().get("name") == name and isinstance(value, bool):
            return value
    return None


def nested_attributes(rows: Iterable[Stated], *, without: Sequence[str] = ()) -> tuple[AttributePath, ...]:
    """The attributes that stand inside of elements of data, but for some by their names."""
    found: dict[tuple[str, str], list[Stated]] = {}
    for row in rows:
        attributes = row.part.get("attributes")
        if attributes is None:
            continue
        for kind in PLAIN:
            for part in attributes.items(kind):
                name = part.members().get("name")
                if name in without:
                    continue
                found.setdefault((kind, name if isinstance(name, str) else kind), []).append(
                    Stated(row.time_ns, part)
                )
    return tuple(attribute(kind, name, parts) for (kind, name), parts in found.items())


def _value(kind: str, part: Part) -> Any:
    if kind in KEPT_WHOLE:
        return {key: value for key, value in part.members().items() if key != "name"}
    value = part.need("val").value
    sound = _SOUND[kind](value)
    if not sound:
        raise part.need("val").fault(f"the value of a {kind}")
    return tuple(value) if kind == "vec" else value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_SOUND: Mapping[str, Callable[[Any], bool]] = {
    "text": lambda value: isinstance(value, str),
    "boolean": lambda value: isinstance(value, bool),
    "num": _is_number,
    "vec": lambda value: isinstance(value, list) and all(isinstance(v, str) or _is_number(v) for v in value),
}
