"""The properties of one fusion system: added, set and read by several callers at once."""

import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from sceneloom.errors import DataError, OptionError
from sceneloom.fusion.messages.basic_types import BasicType, shown
from sceneloom.fusion.messages.value_types import ValueForm, ValueType
from sceneloom.fusion.outcome import DONE, Cause, Outcome, refused
from sceneloom.fusion.properties.predefined import FAULTS, PREDEFINED

_ENUM_PAIR = re.compile(r"(\w+)\s*=\s*(-?\d+)")
_LONGEST_NAME = 256
_LONGEST_DESCRIPTION = 65_536
MOST_PROPERTIES = 1_000
"""Properties that one system may have: a caller that adds for ever is stopped."""

LARGEST_VALUES = 1 << 25
"""How large the values of all properties may be together: their characters, and 8 for each number."""


@dataclass(frozen=True, slots=True)
class Property:
    """One property with its value.

    Attributes:
        name: of the property.
        description: what it sets, for people; of an `enum` also its `name=number` pairs.
        type: what its values have to be.
        value: as `ValueType.check` gives it; None where it was added and not set yet.
        unit: of the value, or "".
        predefined: whether it is there from the start.
    """

    name: str
    description: str
    type: ValueType
    value: Any = None
    unit: str = ""
    predefined: bool = False

    @property
    def enumeration(self) -> Mapping[str, int]:
        """The names of an `enum` and their numbers, from the description."""
        return {name: int(number) for name, number in _ENUM_PAIR.findall(self.description)}


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The properties as they were at one moment; kept with every result.

    Attributes:
        revision: counts the changes; equal numbers mean equal properties.
        properties: by name, those of table 2 first, in their order.
        algorithms: `fusion_algorithm` of sensor data and of detections.
    """

    revision: int
    properties: Mapping[str, Property]
    algorithms: tuple[str, str]

    def __getitem__(self, name: str) -> Any:
        return self.properties[name].value


def _predefined() -> dict[str, Property]:
    return {
        row.name: Property(
            row.name, row.description, ValueType.parse(row.type), row.default, row.unit, predefined=True
        )
        for row in PREDEFINED.values()
    }


@dataclass(slots=True)
class PropertyStore:
    """Holds the properties; each call is whole before the next one is, whoever calls.

    Attributes:
        check_algorithm: reported a fusion type and a name before it is set; raises OptionError for one that is not
            there.

    Source: DB34/T 4101-2022, clauses 5.2 to 5.5.
    """

    check_algorithm: Callable[[int, str], object] | None = None
    _properties: dict[str, Property] = field(default_factory=_predefined)
    _algorithms: list[str] = field(default_factory=lambda: [PREDEFINED["fusion_algorithm"].default] * 2)
    _revision: int = 0
    _size: int = 0
    _snapshot: Snapshot | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, name: str, description: str, type: str) -> Outcome:
        """Add a property without a value.

        Args:
            name: up to 256 characters, none of them blank or a control character.
            description: for people; of an `enum` it lists its `name=number` pairs.
            type: of table 1, or a tuple or an array of such.

        Returns:
            0 where the name is taken or not usable, or the type is none.

        Source: DB34/T 4101-2022, clause 5.3.
        """
        try:
            _check_words(name, description)
            kind = ValueType.parse(type)
        except DataError as error:
            return refused(Cause.ILL_TYPED, error)
        added = Property(name, description, kind)
        if BasicType.ENUM in kind.elements and not added.enumeration:
            return refused(
                Cause.ILL_TYPED, "an enum without values; expected name=number pairs in its description"
            )
        with self._lock:
            if name in self._properties:
                return refused(Cause.KNOWN_NAME, f"property {name!r} is there already")
            if len(self._properties) >= MOST_PROPERTIES:
                return refused(
                    Cause.TOO_MANY, f"there are {MOST_PROPERTIES} properties, as many as there may be"
                )
            self._keep(added)
        return DONE

    def set(self, name: str, value: Any) -> Outcome:
        """Set a property; what is refused leaves it as it was.

        Source: DB34/T 4101-2022, clause 5.4.
        """
        with self._lock:
            known = self._properties.get(name)
            if known is None:
                return refused(Cause.UNKNOWN_NAME, f"property {shown(name)} is not there; {self._known()}")
            try:
                checked = _checked(known, value)
            except DataError as error:
                return refused(Cause.ILL_TYPED, error)
            try:
                self._check_further(name, checked)
            except OptionError as error:
                return refused(Cause.UNKNOWN_ALGORITHM, error)
            except FAULTS as error:
                return refused(Cause.OUT_OF_RANGE, f"{name}: {error}")
            size = self._size - _size_of(known.value) + _size_of(checked)
            if size > LARGEST_VALUES:
                problem = (
                    f"all values have {size} characters and numbers then; expected at most {LARGEST_VALUES}"
                )
                return refused(Cause.TOO_MANY, f"{name}: {problem}")
            self._size = size
            if name == "fusion_algorithm":
                self._algorithms[self._properties["fusion_type"].value] = checked
            self._keep(replace(known, value=checked))
            self._show_algorithm()
        return DONE

    def get(self, name: str) -> Property:
        """Give a property.

        Raises:
            OptionError: there is none of that name.

        Source: DB34/T 4101-2022, clause 5.5.
        """
        with self._lock:
            if name not in self._properties:
                raise OptionError(f"property {shown(name)} is not there; {self._known()}")
            return self._properties[name]

    def snapshot(self) -> Snapshot:
        """Give all properties as they are now."""
        with self._lock:
            if self._snapshot is None:
                kept = MappingProxyType(dict(self._properties))
                self._snapshot = Snapshot(self._revision, kept, (self._algorithms[0], self._algorithms[1]))
            return self._snapshot

    def _keep(self, changed: Property) -> None:
        self._properties[changed.name] = changed
        self._revision += 1
        self._snapshot = None

    def _show_algorithm(self) -> None:
        """Let `fusion_algorithm` state the algorithm of the fusion that `fusion_type` names."""
        shown_now = self._properties["fusion_algorithm"]
        current = self._algorithms[self._properties["fusion_type"].value]
        if shown_now.value != current:
            self._properties["fusion_algorithm"] = replace(shown_now, value=current)

    def _check_further(self, name: str, value: Any) -> None:
        row = PREDEFINED.get(name)
        if row is not None and row.check is not None:
            row.check(value)
        if name == "fusion_algorithm" and self.check_algorithm is not None:
            self.check_algorithm(self._properties["fusion_type"].value, value)

    def _known(self) -> str:
        names = list(self._properties)
        return f"there are {', '.join(names[:40])}{'' if len(names) <= 40 else ', …'}"


def _check_words(name: str, description: str) -> None:
    """Check name and description of a property that is added.

    Raises:
        DataError: one of them cannot be.
    """
    if not _is_name(name):
        problem = f"{shown(name)}; expected 1 to {_LONGEST_NAME} visible characters"
        raise DataError("property", "name", problem)
    if not isinstance(description, str):
        raise DataError(f"property {name}", "description", f"{shown(description)}; expected a text")
    if len(description) > _LONGEST_DESCRIPTION:
        problem = f"{len(description)} characters; expected at most {_LONGEST_DESCRIPTION}"
        raise DataError(f"property {name}", "description", problem)


def _size_of(value: Any) -> int:
    if isinstance(value, tuple):
        return sum(map(_size_of, value))
    return len(value) if isinstance(value, str) else 8


def _is_name(name: str) -> bool:
    return isinstance(name, str) and 0 < len(name) <= _LONGEST_NAME and name.isprintable() and " " not in name


def _checked(known: Property, value: Any) -> Any:
    checked = known.type.check(value, owner=known.name)
    if BasicType.ENUM not in known.type.elements:
        return checked
    if known.type.form is ValueForm.SCALAR:
        return _enumerated(known, checked)
    return tuple(
        _enumerated(known, item) if kind is BasicType.ENUM else item
        for kind, item in zip(_kinds(known.type, len(checked)), checked, strict=True)
    )


def _kinds(kind: ValueType, count: int) -> tuple[BasicType, ...]:
    return kind.elements if kind.form is ValueForm.TUPLE else kind.elements * count


def _enumerated(known: Property, value: str | int) -> int:
    pairs = known.enumeration
    if isinstance(value, str) and value in pairs:
        return pairs[value]
    if value in pairs.values():
        return int(value)
    expected = ", ".join(f"{name}={number}" for name, number in pairs.items())
    raise DataError(known.name, "", f"{shown(value)}; expected one of {expected}")
