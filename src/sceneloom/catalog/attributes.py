"""Rows of attributes: what is stated about a scene, its sensors and its annotations, and when."""

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from sceneloom.catalog.values import Rows, text_of
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.scene import Scene

_Row = tuple[str, int, str | None, str, str, float, int | None, int | None]
_NAMES = ("owner", "track", "sensor", "name", "value", "number", "start_ns", "stop_ns")


def attribute_rows(scene: Scene) -> Rows:
    """Give the table `attributes`."""
    found: list[_Row] = []
    for attribute in scene.attributes:
        owner = "scene" if attribute.sensor_id is None else "sensor"
        found += _rows(attribute, owner, -1)
    for track, annotation in enumerate(scene.annotations):
        for attribute in getattr(annotation, "attributes", ()):
            found += _rows(attribute, "annotation", track)
    columns: Rows = {name: [row[k] for row in found] for k, name in enumerate(_NAMES)}
    return {**columns, "track": np.array([row[1] for row in found], np.int64)}


def _rows(attribute: AttributePath, owner: str, track: int) -> Iterator[_Row]:
    for value, start_ns, stop_ns in _spans(attribute):
        for part in value if isinstance(value, tuple | list) else (value,):
            if part is not None:
                sensor = text_of(attribute.sensor_id)
                yield owner, track, sensor, str(attribute.name), _text(part), _number(part), start_ns, stop_ns


def _spans(attribute: AttributePath) -> Iterator[tuple[Any, int | None, int | None]]:
    """Each value holds until the next; one without times always."""
    if not attribute.is_timed or attribute.timestamps_ns is None:
        yield from ((value, None, None) for value in attribute.values[:1])
        return
    times = attribute.timestamps_ns.tolist()
    yield from zip(attribute.values, times, [*times[1:], None][: len(times)], strict=True)


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value) if isinstance(value, int | float) else json.dumps(value, default=str, sort_keys=True)


def _number(value: Any) -> float:
    """NaN for what is no number, or too large for one."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.nan
