"""Two values of any kind that the model holds, compared part by part."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import AnyArray
from sceneloom.editing.differences.arrays import apart
from sceneloom.editing.differences.report import Change, Findings
from sceneloom.editing.differences.tolerances import (
    DEGREES,
    METRES,
    PIXELS,
    Tolerances,
    limit_of,
    unit_of,
)
from sceneloom.editing.differences.trajectories import TRAJECTORIES, is_trajectory, trajectories_apart
from sceneloom.scene.angles import CuboidAngles

SHOWN = 60
"""Characters of a value that are reported."""

CUBOIDS = {("CuboidPath", "values"), ("Projection", "cuboids"), ("Activation", "cuboids")}
"""Class and field of cuboid rows, whose angles are compared as rotates."""

KEYS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "AttributePath": ("name", "sensor_id", "point_index"),
        "Activation": ("sensor_id",),
        "Projection": ("sensor_id",),
        "PointProjection": ("sensor_id",),
        "LabeledPoints": ("sensor_id", "sensor_frame"),
    }
)
"""By which fields the members of a list are distinguished, instead of their numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Compares values and reports what it finds.

    Attributes:
        findings: where differences are reported.
        tolerances: how much may differ.
        angles: how the angles of cuboids are meant in the two scenes.
        frame: number of the frame that is compared, or None.
    """

    findings: Findings
    tolerances: Tolerances
    angles: tuple[CuboidAngles, CuboidAngles] = (CuboidAngles(), CuboidAngles())
    frame: int | None = None

    def add(
        self, path: str, change: Change, message: str, amount: float | None = None, unit: str = ""
    ) -> None:
        """Report a difference."""
        self.findings.add(path, change, message, amount=amount, unit=unit, frame=self.frame)

    def values(self, path: str, a: Any, b: Any, *, owner: str = "", name: str = "") -> None:
        """Compare two values of the field `name` of a class."""
        if a is b:
            return
        if a is None or b is None:
            change = Change.ADDED if a is None else Change.REMOVED
            self.add(path, change, shown(b if a is None else a))
            return
        compare = next((compare for fits, compare in _KINDS if fits(a) and fits(b)), None)
        if compare is None:
            self.add(path, Change.CHANGED, f"{shown(a)}; then {shown(b)}")
            return
        compare(self, path, a, b, owner, name)

    def records(self, path: str, a: Any, b: Any, *, skipped: Iterable[str] = ()) -> None:
        """Compare two records field by field."""
        if type(a) is not type(b):
            self.add(path, Change.CHANGED, f"{type(a).__name__}; then {type(b).__name__}")
            return
        owner = type(a).__name__
        passed = {*skipped, *self._trajectories(path, a, b)}
        for each in fields(a):
            if each.name not in passed:
                inner = f"{path}.{each.name}" if path else each.name
                self.values(inner, getattr(a, each.name), getattr(b, each.name), owner=owner, name=each.name)

    def _trajectories(self, path: str, a: Any, b: Any) -> tuple[str, ...]:
        """Compare two paths reported at other timestamps as ways; gives the fields that this settles."""
        if not (is_trajectory(a) and is_trajectory(b)):
            return ()
        count, other = len(a.timestamps_ns), len(b.timestamps_ns)
        if count == other:
            away = np.abs(a.timestamps_ns - b.timestamps_ns)
            if away.max() <= self.tolerances.nanoseconds:
                return ()
        found = trajectories_apart(a, b, self.angles)
        if found is None:
            return ()
        metres, degrees = found
        within = metres <= self.tolerances.metres and degrees <= self.tolerances.degrees
        if not (self.tolerances.other_timestamps and within):
            message = (
                f"{count} timestamps; then {other}; as ways up to {metres:.3g} m and {degrees:.3g} deg apart"
            )
            self.add(path, Change.CHANGED, message, metres, METRES)
        return TRAJECTORIES[type(a).__name__][1]

    def record(self, path: str, a: Any, b: Any, _owner: str, _name: str) -> None:
        """Compare two records field by field."""
        self.records(path, a, b)

    def mapping(self, path: str, a: Mapping[Any, Any], b: Mapping[Any, Any], _owner: str, _name: str) -> None:
        """Compare two mappings key by key."""
        self._members(
            path,
            {repr(key): value for key, value in a.items()},
            {repr(key): value for key, value in b.items()},
        )

    def _members(self, path: str, a: Mapping[str, Any], b: Mapping[str, Any]) -> None:
        for key, value in a.items():
            if key not in b:
                self.add(f"{path}[{key}]", Change.REMOVED, shown(value))
        for key, value in b.items():
            if key in a:
                self.values(f"{path}[{key}]", a[key], value)
            else:
                self.add(f"{path}[{key}]", Change.ADDED, shown(value))

    def sequence(self, path: str, a: Sequence[Any], b: Sequence[Any], owner: str, name: str) -> None:
        """Compare two lists, member by member or by what reports their members apart."""
        keyed = _keyed(a), _keyed(b)
        if keyed[0] is not None and keyed[1] is not None:
            self._members(path, keyed[0], keyed[1])
            return
        if len(a) != len(b):
            self.add(path, Change.CHANGED, f"{len(a)} values; then {len(b)}", abs(len(a) - len(b)))
        for k, (first, second) in enumerate(zip(a, b, strict=False)):
            self.values(f"{path}[{k}]", first, second, owner=owner, name=name)

    def arrays(self, path: str, a: AnyArray, b: AnyArray, owner: str, name: str) -> None:
        """Compare two arrays: kind and shape, then row by row."""
        if a.dtype != b.dtype or a.shape != b.shape:
            self.add(
                path,
                Change.CHANGED,
                f"{_form(a)}; then {_form(b)}",
                abs(len(a) - len(b)) if a.ndim and b.ndim else None,
            )
            return
        if (owner, name) in CUBOIDS:
            self._cuboids(path, a, b)
            return
        unit = unit_of(owner, name)
        if owner == "VertexPath" and a.ndim == 2:
            unit = METRES if a.shape[1] == 3 else PIXELS
        self._rows(path, a, b, unit)

    def _rows(self, path: str, a: AnyArray, b: AnyArray, unit: str) -> None:
        away = apart(a, b, unit)
        if away is None:
            if not np.array_equal(a, b):
                self.add(path, Change.CHANGED, f"{_form(a)} of other values")
            return
        wrong = np.flatnonzero(away > limit_of(self.tolerances, unit))
        if len(wrong):
            worst = int(np.argmax(away))
            rows = f"{len(wrong)} of {len(away)} rows" if len(away) > 1 else "the values"
            self.add(path, Change.CHANGED, f"{rows} differ, row {worst} most", float(away[worst]), unit)

    def _cuboids(self, path: str, a: AnyArray, b: AnyArray) -> None:
        """Sizes and locations in metres, angles as rotates, each by the reading of its own scene."""
        self._rows(f"{path}.size", a[:, :3], b[:, :3], METRES)
        self._rows(f"{path}.position", a[:, 3:6], b[:, 3:6], METRES)
        if self.angles[0] == self.angles[1] and np.array_equal(a[:, 6:], b[:, 6:], equal_nan=True):
            return
        first, second = self.angles[0].quaternions(a[:, 6:]), self.angles[1].quaternions(b[:, 6:])
        self._rows(f"{path}.rotation", first, second, DEGREES)

    def number(self, path: str, a: float, b: float, owner: str, name: str) -> None:
        """Compare two numbers."""
        unit = unit_of(owner, name)
        away = abs(a - b)
        if a == b or (math.isnan(a) and math.isnan(b)) or away <= limit_of(self.tolerances, unit):
            return
        self.add(path, Change.CHANGED, f"{a!r}; then {b!r}", float(away), unit)

    def plain(self, path: str, a: Any, b: Any, _owner: str, _name: str) -> None:
        """Compare two values that are equal or not."""
        if a != b:
            self.add(path, Change.CHANGED, f"{shown(a)}; then {shown(b)}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str | bytes | bool)


def _is_record(value: Any) -> bool:
    return is_dataclass(value) and not isinstance(value, type)


_KINDS: tuple[tuple[Callable[[Any], bool], Callable[..., None]], ...] = (
    (lambda value: isinstance(value, np.ndarray), Comparison.arrays),
    (_is_text, Comparison.plain),
    (_is_number, Comparison.number),
    (lambda value: isinstance(value, Mapping), Comparison.mapping),
    (lambda value: isinstance(value, list | tuple), Comparison.sequence),
    (_is_record, Comparison.record),
    (callable, lambda *_: None),
)
"""How two values of one kind are compared; functions, which open and decode, are not."""


def _keyed(members: Sequence[Any]) -> dict[str, Any] | None:
    """The members by what reports them apart; None where nothing does, or not all of them."""
    names = {type(member).__name__ for member in members}
    if not members:
        return {}
    if len(names) != 1 or not names <= KEYS.keys():
        return None
    keys = KEYS[names.pop()]
    found = {
        ", ".join(repr(value) for key in keys if (value := getattr(member, key)) is not None): member
        for member in members
    }
    return found if len(found) == len(members) else None


def _form(array: AnyArray) -> str:
    return f"{array.dtype.name} {'x'.join(map(str, array.shape)) or 'number'}"


def shown(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, np.ndarray):
        return f"an array of {_form(value)}"
    if _is_record(value):
        return type(value).__name__
    if isinstance(value, Mapping):
        return f"a mapping of {len(value)}"
    text = repr(value.value if isinstance(value, Enum) else value)
    return text if len(text) <= SHOWN else text[: SHOWN - 1] + "…"
