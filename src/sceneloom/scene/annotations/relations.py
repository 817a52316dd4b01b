"""Objects, groups, links and events: annotations without a shape of their own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sceneloom.arrays import hold_timestamp
from sceneloom.errors import ArrayError
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS, Identifier

OBJECT_TYPES = ("object", "attributes")
"""The words that files have for an annotation that is nothing but its attributes; the second is Scale's library's."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectAnnotation:
    """An object to which other annotations belong; fields as in `CuboidAnnotation`.

    Attributes:
        type: `object`, or `attributes`.
    """

    id: Identifier
    label: str | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    type: str = "object"

    def __post_init__(self) -> None:
        if self.type not in OBJECT_TYPES:
            raise ArrayError(f"type {self.type!r}; expected one of {', '.join(OBJECT_TYPES)}")


@dataclass(frozen=True, slots=True, eq=False)
class GroupAnnotation:
    """A group to which other annotations belong by their `parent_id`; fields as in `CuboidAnnotation`."""

    id: Identifier
    label: str | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> str:
        """`group`."""
        return "group"


@dataclass(frozen=True, slots=True, eq=False)
class LinkAnnotation:
    """A relation between two annotations; other fields as in `CuboidAnnotation`.

    Attributes:
        from_id: the annotation that it leads from.
        to_id: the one that it leads to.
        is_bidirectional: whether it holds both ways; None where not stated.
        sensor_id: the only sensor that it is for, or None.
    """

    id: Identifier
    from_id: Identifier
    to_id: Identifier
    label: str | None = None
    is_bidirectional: bool | None = None
    sensor_id: Identifier | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> str:
        """`link`."""
        return "link"


@dataclass(frozen=True, slots=True, eq=False)
class EventAnnotation:
    """Something that happens; other fields as in `CuboidAnnotation`.

    Attributes:
        start_ns: when it begins [ns].
        duration_ns: how long it lasts [ns], or None.
        sensor_id: the only sensor that it is for, or None.
    """

    id: Identifier
    start_ns: int
    duration_ns: int | float | None = None
    label: str | None = None
    sensor_id: Identifier | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_timestamp(self, "start_ns")

    @property
    def type(self) -> str:
        """`event`."""
        return "event"
