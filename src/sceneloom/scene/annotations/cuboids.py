"""Objects as boxes in space, and where sensors see them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, check_array, check_count, hold_array
from sceneloom.errors import ArrayError
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class CuboidPath:
    """A box over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 9) float64, rows `dx dy dz px py pz roll pitch yaw` exactly as stored: sizes and position [m] in
            the scene's world; the unit and order of the angles are the scene's `metadata["sceneloom"]` euler entries.
        extras: further fields of the file, by name.

    Source: "Cuboid Annotation" of the SFS description.
    """

    timestamps_ns: Int64Array
    values: Float64Array
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "cuboid.path.timestamps_ns", (None,), np.int64)
        hold_array(self, "cuboid.path.values", (count, 9), np.float64)


def cut_cuboid_paths(
    timestamps_ns: Int64Array, values: Float64Array, counts: Sequence[int]
) -> list[CuboidPath]:
    """Cut the paths of many cuboids out of the arrays of all of them, which are checked once.

    Args:
        timestamps_ns: (N,) int64 [ns].
        values: (N, 9) float64.
        counts: how many rows each path has, N in all.

    Raises:
        ArrayError: the arrays are not such.
    """
    count = check_array("timestamps_ns", timestamps_ns, (None,), np.int64)
    check_array("values", values, (count, 9), np.float64)
    if sum(counts) != count:
        raise ArrayError(f"counts: {sum(counts)} rows in all; expected {count}")
    stops = list(accumulate(counts))
    # What holds for the whole holds for its parts: their constructors need not look at them again.
    set_times, set_values, set_extras = (CuboidPath.__dict__[name].__set__ for name in CuboidPath.__slots__)
    paths = []
    for start, stop in zip([0, *stops], stops, strict=False):
        path = object.__new__(CuboidPath)
        set_times(path, timestamps_ns[start:stop])
        set_values(path, values[start:stop])
        set_extras(path, NO_FIELDS)
        paths.append(path)
    return paths


@dataclass(frozen=True, slots=True, eq=False)
class Activation:
    """When one sensor sees a cuboid, in scenes without frames.

    Attributes:
        sensor_id: the sensor.
        timestamps_ns: (N,) int64 [ns], when each begins.
        durations_ns: how long each lasts [ns], N integers (a float where a file says a part of a nanosecond), or
            None where the file says nothing.
        cuboids: (N, 9) float64 as in `CuboidPath`, or None.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    durations_ns: tuple[float, ...] | None = None
    cuboids: Float64Array | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "timestamps_ns", (None,), np.int64)
        hold_array(self, "cuboids", (count, 9), np.float64, optional=True)
        check_count("durations_ns", self.durations_ns, count)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """Where one camera sees a cuboid.

    Attributes:
        sensor_id: the camera.
        timestamps_ns: (N,) int64 [ns], of its images.
        boxes: (N, 4) float64 [px], rows `x y width height` in the corner convention; a row of NaN where the box could
            not be projected or was deleted; None where the file says nothing.
        confirmed: N times whether a person confirmed it (None where one of them is not stated), or None.
        cuboids: (N, 9) float64 as in `CuboidPath`, rows of NaN for null, or None.
        extras: further fields of the file, by name.
    """

    sensor_id: Identifier
    timestamps_ns: Int64Array
    boxes: Float64Array | None = None
    confirmed: tuple[bool | None, ...] | None = None
    cuboids: Float64Array | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    def __post_init__(self) -> None:
        count = hold_array(self, "timestamps_ns", (None,), np.int64)
        hold_array(self, "boxes", (count, 4), np.float64, optional=True)
        hold_array(self, "cuboids", (count, 9), np.float64, optional=True)
        check_count("confirmed", self.confirmed, count)


@dataclass(frozen=True, slots=True, eq=False)
class CuboidAnnotation:
    """An object as a box.

    Attributes:
        id: unique among the scene's annotations.
        path: the box over time.
        label: the object's class, or None.
        stationary: whether the object is stationary; None where not stated.
        parent_id: id of the parent annotation, or None.
        attributes: what is stated about it.
        activations: when sensors see it, one entry per sensor.
        projections: where cameras see it, one entry per camera.
        extras: every other field of the file, by name.
    """

    id: Identifier
    path: CuboidPath
    label: str | None = None
    stationary: bool | None = None
    parent_id: Identifier | None = None
    attributes: tuple[AttributePath, ...] = ()
    activations: tuple[Activation, ...] = ()
    projections: tuple[Projection, ...] = ()
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def type(self) -> str:
        """`cuboid`."""
        return "cuboid"
