"""Poses as a file has them, before they are judged, sorted and brought to a body."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from sceneloom.arrays import Float64Array, Int64Array

GREATEST_NORM_ERROR = 0.01
"""The length of a quaternion may be off 1 by this much: files round them to a few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRows:
    """Poses of a body in a world, one per line of a file.

    Attributes:
        timestamps_ns: (N,) int64 [ns], in the order of the file.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, of any length, or None.
        lines: number of each pose's line.
    """

    timestamps_ns: Int64Array
    positions: Float64Array
    quaternions_xyzw: Float64Array | None
    lines: Sequence[int] = field(default_factory=tuple)
