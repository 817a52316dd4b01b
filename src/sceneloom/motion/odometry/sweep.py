"""What odometry uses of a sweep."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.kernels.scan_matching import thin_points
from sceneloom.motion.odometry.configuration import OdometryConfiguration


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """The usable points of a sweep.

    Attributes:
        timestamp_ns: the middle of its time, to which its pose refers [ns].
        first_ns, last_ns: of all its points [ns].
        points_ego: (N, 3) float64 [m], each as measured at its own time.
        seconds: (N,) float64, after `timestamp_ns`.
        chosen: (M,) int64, the points to register, evenly spread.
    """

    timestamp_ns: int
    first_ns: int
    last_ns: int
    points_ego: Float64Array
    seconds: Float64Array
    chosen: Int64Array


def usable_sweep(
    timestamp_ns: int,
    positions_ego: FloatArray,
    timestamps_ns: Int64Array | None,
    configuration: OdometryConfiguration,
) -> Sweep:
    """Leave out what is no number, too near or too far, and choose the points to register."""
    if timestamps_ns is None or len(timestamps_ns) == 0:
        first_ns = last_ns = timestamp_ns
    else:
        first_ns, last_ns = int(timestamps_ns.min()), int(timestamps_ns.max())
    middle_ns = (first_ns + last_ns) // 2
    with np.errstate(over="ignore", invalid="ignore"):
        squared = np.einsum("ij,ij->i", positions_ego, positions_ego)
    usable = np.flatnonzero((squared > configuration.nearest**2) & (squared < configuration.farthest**2))
    points = np.asarray(positions_ego[usable], np.float64)
    offsets_ns = (
        np.zeros(len(points), np.int64) if timestamps_ns is None else timestamps_ns[usable] - middle_ns
    )
    chosen = np.empty(len(points), np.int64)
    count = thin_points(points, configuration.spacing, chosen)
    return Sweep(middle_ns, first_ns, last_ns, points, np.asarray(offsets_ns * 1e-9), chosen[:count])
