"""Sensors of types that the model has no class for."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class PlainSensor:
    """A sensor of any other type, its fields as the file has them, times in nanoseconds.

    Attributes:
        id: unique among the scene's sensors.
        type: the file's own word.
        fields: all fields but `id` and `type`.
    """

    id: Identifier
    type: str
    fields: Mapping[str, Any]

    @property
    def parent_id(self) -> Identifier | None:
        """Id of the parent sensor, or None."""
        return self.fields.get("parent_id")
