"""Fixes held against states: what the IMU felt leads from the state before to each, so that not each needs its own."""

from dataclasses import dataclass, fields, replace

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.motion_chain import POSITION, ROTATION, SIZE, VELOCITY
from sceneloom.kernels.preintegration import ROTATION as BY_ROTATION
from sceneloom.kernels.preintegration import TRAJECTORY, preintegrate_until
from sceneloom.motion.gnss_imu.fixes import GnssFixes
from sceneloom.motion.gnss_imu.samples import InertialSamples


@dataclass(frozen=True, slots=True, eq=False)
class Fixes:
    """Positions of antennas, reported by F fixes.

    A fix expects the antenna at p + t v - fall up + R (lever + slope (b - bias)) for a state R, p, v, b, t before it.

    Attributes:
        timestamps_ns: (F,) int64 [ns], ascending.
        locations: (F,) int64, ascending: the state before each fix, or where no IMU measured the nearest.
        seconds: (F,) from the state to the fix.
        positions: (F, 3) [m], world.
        levers: (F, 3) [m], axes of the body at the state: the antenna at the time of the fix, with the trajectory that
            the IMU felt until then.
        falls: (F,) [m] through which gravity draws meanwhile; 0 where no IMU measured.
        slopes: (F, 3, 6) change of `levers` with the biases of gyroscope and accelerometer.
        biases: (F, 6) that `levers` has taken off.
        sigmas: (F, 3) [m], standard deviations along the world's axes.
        receivers: (F,) int64, which receiver each is from.
    """

    timestamps_ns: Int64Array
    locations: Int64Array
    seconds: Float64Array
    positions: Float64Array
    levers: Float64Array
    falls: Float64Array
    slopes: Float64Array
    biases: Float64Array
    sigmas: Float64Array
    receivers: Int64Array

    def __len__(self) -> int:
        return len(self.locations)

    def chosen(self, rows: Int64Array | BoolArray) -> "Fixes":
        """Some of the fixes."""
        return Fixes(*(getattr(self, field.name)[rows] for field in fields(self)))

    def within(self, first: int, last: int) -> "Fixes":
        """Those of states `first` to `last`, without the latter."""
        inside = self.chosen((self.locations >= first) & (self.locations < last))
        return replace(inside, locations=inside.locations - first)


def carried_fixes(
    fixes: GnssFixes,
    knots_ns: Int64Array,
    measured: BoolArray,
    samples: InertialSamples | None,
    *,
    biases: Float64Array,
    gravity: float,
    sigmas: Float64Array | None = None,
) -> Fixes:
    """Hold each fix against the state before it by what the IMU felt, and else against the nearest.

    Args:
        knots_ns: (K,) [ns], times of the states.
        measured: (K - 1,) between which of them the IMU measured.
        biases: (K - 1, 6) to take off what it measured.
        gravity: [m/s²].
        sigmas: (F, 3) [m]; None for those of the fixes.
    """
    times, count = fixes.timestamps_ns, len(fixes)
    before = np.clip(np.searchsorted(knots_ns, times, side="right") - 1, 0, len(knots_ns) - 1)
    led = np.append(measured, False)[before] & (times >= knots_ns[0])
    locations = np.where(led, before, nearest_states(knots_ns, times))
    seconds = np.asarray((times - knots_ns[locations]) * 1e-9, np.float64)
    levers, slopes, taken = fixes.levers.copy(), np.zeros((count, 3, 6)), np.zeros((count, 6))
    rows = np.flatnonzero(led & (seconds > 0))
    if samples is not None and len(rows):
        rotations, trajectories = np.empty((len(rows), 3, 3)), np.empty((len(rows), 3))
        by_biases = np.empty((len(rows), 9, 6))
        preintegrate_until(
            samples.timestamps_ns, samples.values, knots_ns, np.ascontiguousarray(biases), times[rows], locations[rows],
            rotations, np.empty((len(rows), 3)), trajectories, by_biases,
        )  # fmt: skip
        levers[rows] = np.einsum("nij,nj->ni", rotations, fixes.levers[rows]) + trajectories
        slopes[rows] = (
            by_biases[:, TRAJECTORY]
            + rotations @ crossed_with(fixes.levers[rows]) @ by_biases[:, BY_ROTATION]
        )
        taken[rows] = biases[locations[rows]]
    return Fixes(
        times, locations, seconds, fixes.positions, levers, np.where(led, 0.5 * gravity * seconds**2, 0.0), slopes,
        taken, fixes.sigmas if sigmas is None else sigmas, fixes.receivers,
    )  # fmt: skip


def nearest_states(knots_ns: Int64Array, times_ns: Int64Array) -> Int64Array:
    """The state nearest to each time."""
    after = np.clip(np.searchsorted(knots_ns, times_ns), 1, len(knots_ns) - 1)
    nearer_before = times_ns - knots_ns[after - 1] <= knots_ns[after] - times_ns
    nearest: Int64Array = after - nearer_before
    return nearest


def fix_variances(fixes: Fixes, rotations: Float64Array, own: Float64Array) -> Float64Array:
    """(F, 3) variances of where the antennas are, as states with orientations and covariances (K, 15, 15) report."""
    rotated = rotations[fixes.locations]
    slopes = np.zeros((len(fixes), 3, SIZE))
    slopes[:, :, ROTATION] = rotated @ crossed_with(fixes.levers)
    slopes[:, :, POSITION] = np.eye(3)
    slopes[:, :, VELOCITY] = fixes.seconds[:, None, None] * np.eye(3)
    slopes[:, :, VELOCITY.stop :] = rotated @ fixes.slopes
    variances: Float64Array = ((slopes @ own[fixes.locations]) * slopes).sum(axis=2)
    return variances


def crossed_with(vectors: Float64Array) -> Float64Array:
    """(F, 3, 3) matrices that take the cross product of what comes with (F, 3) vectors."""
    crossed: Float64Array = np.cross(np.eye(3)[None], vectors[:, None]).swapaxes(1, 2)
    return crossed
