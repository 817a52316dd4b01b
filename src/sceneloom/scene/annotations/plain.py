"""Annotations of types that the model has no class for."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class PlainAnnotation:
    """An annotation of an unknown type, its fields as the file has them, times in nanoseconds.

    Attributes:
        id: unique among the scene's annotations.
        type: the file's own word.
        fields: all fields but `id` and `type`.
    """

    id: Identifier
    type: str
    fields: Mapping[str, Any]

    @property
    def parent_id(self) -> Identifier | None:
        """Id of the parent annotation, or None."""
        return self.fields.get("parent_id")
