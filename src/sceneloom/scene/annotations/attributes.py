"""Attributes: what is stated about a scene, a sensor or an annotation, over time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array, hold_array
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class AttributePath:
    """The values of one attribute; each holds until the next.

    Attributes:
        name: what is stated.
        values: one per timestamp: text, a number, or a tuple of texts; whatever else a file has is kept as it is.
        timestamps_ns: (N,) int64 [ns], or None where the file gives none. Files may have more or fewer of them than
            values; both are kept, and `validate` reports it.
        sensor_id: of the only sensor that it holds for, or None.
        static: whether it holds at all times; None where not stated.
        point_index: of the only point of a points annotation that it holds for, or None.
        extras: further fields of the file, by name.

    Source: "Attribute Path" of the SFS description; `point_index` is that of "Points Annotation / Keypoints".
    """

    name: str
    values: tuple[Any, ...]
    timestamps_ns: Int64Array | None = None
    sensor_id: Identifier | None = None
    static: bool | None = None
    point_index: int | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        hold_array(self, "attribute.timestamps_ns", (None,), np.int64, optional=True)

    @property
    def is_timed(self) -> bool:
        """Whether each value has its own time."""
        timestamps = self.timestamps_ns
        return timestamps is not None and not self.static and len(timestamps) == len(self.values)
