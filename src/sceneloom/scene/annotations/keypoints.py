"""Points of an object that have names and ways of their own."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, check_count, hold_array
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class PointPath:
    """One point over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 3) float64 [m], in the scene's world; in files whose rows hold several points, (N, 3 V).
        id: unique within the annotation, or None (old files).
        extras: further fields of the file, by name.

    Source: "Points Annotation / Keypoints" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    id: Identifier | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "timestamps_ns", (None,), np.int64)
        hold_array(self, "values", (count, None), np.float64)


def locations_of(values: Float64Array) -> Float64Array:
    """Cut the rows of a point path, (M, 3 V), into the locations of its V points, (M, V, 3)."""
    return values.reshape(len(values), values.shape[1] // 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class PointProjection:
    """Where one camera sees one point.

    Attributes:
        sensor_id: the camera.
        timestamps_ns: (N,) int64 [ns], of its images.
        points: (N, 2) float64 [px] in the corner convention; a row of NaN where the point could not be projected or
            was deleted; None where the file says nothing.
        confirmed: N times whether a person confirmed it (None where one of them is not stated), or None.
        positions: (N, 3) float64 [m], rows of NaN for null, or None.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    points: Float64Array | None = None
    confirmed: tuple[bool | None, ...] | None = None
    positions: Float64Array | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "timestamps_ns", (None,), np.int64)
        hold_array(self, "points", (count, 2), np.float64, optional=True)
        hold_array(self, "positions", (count, 3), np.float64, optional=True)
        check_count("confirmed", self.confirmed, count)


@dataclass(frozen=True, slots=True, eq=False)
class PointsAnnotation:
    """Points of an object, or points on a map; other fields as in `CuboidAnnotation`.

    Attributes:
        paths: one per point.
        labels: one per point, or None.
        projections: one entry per point, in it one per camera.
        sensor_id: the only sensor that it is for, or None.
    """

    id: Identifier
    paths: tuple[PointPath, ...]
    labels: tuple[str, ...] | None = None
    projections: tuple[tuple[PointProjection, ...], ...] = ()
    sensor_id: Identifier | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> str:
        """`points`."""
        return "points"
