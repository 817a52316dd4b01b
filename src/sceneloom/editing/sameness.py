"""Whether records of two scenes state the same, and in which fields they do not."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import key_of

SAME_TOLERANCE = 1e-6
"""Numbers of two scenes that differ by no more are the same, brought into one world by computing [m], …"""


def is_same(a: Any, b: Any) -> bool:
    """Whether two values, records or arrays state the same, numbers within `SAME_TOLERANCE`."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return _same_arrays(np.asarray(a), np.asarray(b))
    if hasattr(a, "__dataclass_fields__"):
        names = a.__dataclass_fields__
        return type(a) is type(b) and all(is_same(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(is_same(a[name], b[name]) for name in a)
    if isinstance(a, Sequence) and isinstance(b, Sequence) and not isinstance(a, str):
        return len(a) == len(b) and all(is_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def _same_arrays(a: Any, b: Any) -> bool:
    if a.shape != b.shape or a.dtype.kind != b.dtype.kind:
        return False
    if a.dtype.kind != "f":
        return bool(np.array_equal(a, b))
    return bool(np.allclose(a, b, rtol=0.0, atol=SAME_TOLERANCE, equal_nan=True))


_JOINED = frozenset(
    (
        *("frames", "images", "video", "poses", "mount", "streams"),
        *("timestamps_ns", "positions_lla", "accuracies", "vertical_accuracies", "file_seconds"),
        *("path", "paths", "activations", "projections", "labeled_points", "start_ns", "duration_ns"),
        "attributes",
    )
)
"""Fields of sensors and annotations that are joined from those of both parts, or that must be the same in both."""


def differing_fields(first: Any, second: Any) -> tuple[str, ...]:
    """Name the fields in which two parts of one sensor or annotation differ, and of which only one can stand."""
    names = [name for name in first.__dataclass_fields__ if name not in _JOINED]
    differing = [name for name in names if not is_same(getattr(first, name), getattr(second, name))]
    attributes = (getattr(part, "attributes", ()) for part in (first, second))
    return (*differing, *contradicting(*attributes))


def contradicting(first: Iterable[AttributePath], second: Iterable[AttributePath]) -> tuple[str, ...]:
    """Name the attributes that two parts have both, without times by which they could go on, and that differ."""
    known = {stated_of(attribute): attribute for attribute in first}
    return tuple(
        f"attributes[{attribute.name}]"
        for attribute in second
        if stated_of(attribute) in known
        and not (attribute.is_timed and known[stated_of(attribute)].is_timed)
        and not is_same(known[stated_of(attribute)], attribute)
    )


def stated_of(attribute: AttributePath) -> tuple[Any, ...]:
    """What an attribute reports: two of the same are one."""
    sensor = None if attribute.sensor_id is None else key_of(attribute.sensor_id)
    return attribute.name, sensor, attribute.static, attribute.point_index
