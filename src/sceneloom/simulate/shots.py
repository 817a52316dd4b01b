"""The shots of a lidar's frame: where each goes, and when."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, UInt16Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.simulate.casting import Rays


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """All shots of one frame, in the order of their time.

    Attributes:
        rays: their directions in the lidar's frame; shot k answers in slot k; the pose of a ray is its moment.
        offsets_ns: (M,) int64 [ns], the moments at which the lidar shoots, after the start of the frame.
        moments: (S,) int64, which of `offsets_ns` each shot is fired at.
        rings: (S,) uint16, the row of each shot from the lowest, or None where the pattern has no rows.
    """

    rays: Rays
    offsets_ns: Int64Array
    moments: Int64Array
    rings: UInt16Array | None


def repeating(shots: Shots) -> Callable[[int], Shots]:
    """Give the function that makes the same shots for each frame."""
    return partial(_same, shots)


def _same(shots: Shots, _: int) -> Shots:
    return shots


class ScanSpec(Protocol):
    """What every lidar says about itself; the fields are those of `LidarSpec`."""

    @property
    def period_ns(self) -> int:
        """Time of a frame [ns]."""

    @property
    def offset_ns(self) -> int:
        """How much later than the drive the first frame starts [ns]."""

    @property
    def range_sigma(self) -> float:
        """Standard deviation of the measured range [m]."""

    @property
    def drop_rate(self) -> float:
        """Share of returns that are lost at random."""

    @property
    def min_range(self) -> float:
        """No returns nearer [m]."""

    @property
    def max_range(self) -> float:
        """No returns farther [m]."""

    @property
    def mount(self) -> RigidTransform:
        """`ego_from_lidar`."""

    def plan_shots(self) -> Callable[[int], Shots]:
        """Give the function that makes the shots of a frame that starts so many ns after the first."""


def scan_bounds(spec: ScanSpec) -> Iterator[tuple[str, float, float, float]]:
    """The bounds that hold for every lidar, for `check_bounds`."""
    yield "period_ns", spec.period_ns, 1, 10**12
    yield "offset_ns", spec.offset_ns, 0, spec.period_ns - 1
    yield "range_sigma", spec.range_sigma, 0.0, 10.0
    yield "drop_rate", spec.drop_rate, 0.0, 1.0
    yield "min_range", spec.min_range, 0.0, spec.max_range
    yield "max_range", spec.max_range, spec.min_range, 1e4


def directions_at(azimuths: Float64Array, elevations: Float64Array) -> Float64Array:
    """Unit vectors (N, 3) at angles [rad], counter-clockwise from x and upwards."""
    flat = np.cos(elevations)
    return np.column_stack([flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(elevations)])
