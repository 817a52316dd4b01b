"""Preintegrated IMU measurements: what lies between two states, independent of where the first one is."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.kernels.preintegration import preintegrate


@dataclass(frozen=True, slots=True, eq=False)
class Preintegrated:
    """What an IMU measured in F intervals, summed up in the axes that the body had at the beginning of each.

    Attributes:
        rotations: (F, 3, 3) float64, `first_from_second`.
        gains: (F, 3) gain of velocity [m/s] without gravity.
        trajectories: (F, 3) trajectory [m] without gravity and without the velocity at the beginning.
        slopes: (F, 9, 6) change of rotation (on the right side [rad]), gain and trajectory with the biases of gyroscope
            and accelerometer.
        covariances: (F, 9, 9) of rotation, gain and trajectory.
        biases: (F, 6) that were taken off.

    Source: Forster, Carlone, Dellaert and Scaramuzza 2017, "On-Manifold Preintegration for Real-Time Visual-Inertial
    Odometry".
    """

    rotations: Float64Array
    gains: Float64Array
    trajectories: Float64Array
    slopes: Float64Array
    covariances: Float64Array
    biases: Float64Array

    def part(self, rows: slice) -> "Preintegrated":
        """Some of the intervals."""
        return Preintegrated(
            self.rotations[rows],
            self.gains[rows],
            self.trajectories[rows],
            self.slopes[rows],
            self.covariances[rows],
            self.biases[rows],
        )


def preintegrated(
    timestamps_ns: Int64Array,
    values: Float64Array,
    knots_ns: Int64Array,
    *,
    biases: Float64Array,
    densities: Float64Array,
) -> Preintegrated:
    """Sum up what an IMU measured from each knot to the next.

    Between samples rate and force change evenly; the rotation is exact to the fourth order in the time between samples
    for such a rate, velocity and trajectory are integrated by Simpson's rule over it.

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 2.
        values: (N, 6) yaw rate [rad/s] and specific force [m/s²], body frame.
        knots_ns: (K,) int64 [ns], strictly increasing; they need not lie on samples.
        biases: (K - 1, 6) to take off.
        densities: (K - 1, 2) of the white noise, (rad/s)²/Hz and (m/s²)²/Hz.
    """
    count = len(knots_ns) - 1
    found = Preintegrated(
        np.empty((count, 3, 3)),
        np.empty((count, 3)),
        np.empty((count, 3)),
        np.empty((count, 9, 6)),
        np.empty((count, 9, 9)),
        np.ascontiguousarray(biases),
    )
    preintegrate(
        timestamps_ns, values, knots_ns, found.biases, np.ascontiguousarray(densities), found.rotations, found.gains,
        found.trajectories, found.slopes, found.covariances,
    )  # fmt: skip
    return found
