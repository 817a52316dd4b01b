"""What an IMU tells of the poses of a trajectory: how they turned, and where up was."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.checks.recordings.turning import CleanSamples, PoseIntervals, finite_rows
from sceneloom.scene import Trajectory

LEAST_TURNING = 0.03
"""The gyroscope's means over intervals have to vary so much (rms) before anything is said of turning [rad/s]."""
TURNING_PER_NOISE = 2.0
"""And so many times what the noise of the gyroscope leaves in the means."""
FEWEST_INTERVALS = 10
"""Fewer tell nothing."""
GREATEST_SHIFT = 1.0
"""Shifts between the clocks of poses and IMU are looked for up to this [s]."""
_SHIFT_STEP = 0.02
"""Shifts are tried in steps of so long [s]."""
_SHIFTS_SHARE = 0.2
"""Shifts are tried up to this share of the time that both streams cover."""
"""And no farther than this part of the time that both have."""


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """What the gyroscope measured over the intervals of a trajectory.

    Attributes:
        intervals: of the trajectory.
        shifts: (S,) float64 [s], by which the gyroscope's times were taken to be later; the middle one is 0.
        measured: (S, M, 3) mean rates for each shift [rad/s].
        known: (M,) int64, the intervals that they are of.
        sample_interval: usual time between two samples [s].
    """

    intervals: PoseIntervals
    shifts: Float64Array
    measured: Float64Array
    known: Int64Array
    sample_interval: float

    @classmethod
    def of(cls, intervals: PoseIntervals, rates: CleanSamples | None) -> "Turning | None":
        """Measure; None where there are too few samples, or the device hardly turned."""
        if rates is None or not _may_turn(rates.means(intervals.starts, intervals.stops)):
            return None
        overlap = min(rates.seconds[-1], intervals.stops[-1]) - max(rates.seconds[0], intervals.starts[0])
        count = int(min(GREATEST_SHIFT, max(0.0, _SHIFTS_SHARE * overlap)) / _SHIFT_STEP)
        shifts = np.asarray(np.arange(-count, count + 1) * _SHIFT_STEP, np.float64)
        measured = np.stack([rates.means(intervals.starts + s, intervals.stops + s) for s in shifts])
        known = np.flatnonzero(np.isfinite(measured).all(axis=(0, 2)))
        if len(known) < FEWEST_INTERVALS:
            return None
        interval = float(np.median(np.diff(rates.seconds)))
        turning = cls(intervals, shifts, measured[:, known], known, interval)
        now = centred(turning.measured[count])
        noise = rates.noise(float(np.median(intervals.lengths)))
        turned = float(np.sqrt((now * now).sum(axis=1).mean()))
        return turning if turned >= max(LEAST_TURNING, TURNING_PER_NOISE * noise) else None

    def is_above(self, orientation_noise: float) -> bool:
        """Whether the device turned clearly more than orientations with so much noise [rad] seem to."""
        now = centred(self.measured[len(self.shifts) // 2])
        noise = np.sqrt(2.0) * orientation_noise / float(np.median(self.intervals.lengths))
        return bool(np.sqrt((now * now).sum(axis=1).mean()) >= TURNING_PER_NOISE * noise)

    def tolerance(self, way: Trajectory) -> float:
        """How far apart samples and poses are [s]: they do not tell shorter shifts."""
        return max(self.sample_interval, float(np.median(np.diff(way.timestamps_ns))) / 1e9)

    def both(self, quaternions_xyzw: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Measured and told rates at no shift, without their means, (M, 3) each."""
        told = self.intervals.rates(quaternions_xyzw)[self.known]
        kept = _without_jumps(told)
        return centred(self.measured[len(self.shifts) // 2][kept]), centred(told[kept])

    def correlations(self, quaternions_xyzw: Float64Array) -> Float64Array:
        """Correlation of all axes together for each shift, (S,)."""
        told = self.intervals.rates(quaternions_xyzw)[self.known]
        kept = _without_jumps(told)
        told, measured = centred(told[kept]), self.measured[:, kept]
        measured = measured - measured.mean(axis=1, keepdims=True)
        products = np.einsum("smk,mk->s", measured, told)
        lengths = np.sqrt((measured * measured).sum(axis=(1, 2)) * (told * told).sum())
        return np.asarray(np.divide(products, lengths, out=np.zeros(len(products)), where=lengths > 0))


def _may_turn(measured: Float64Array) -> bool:
    """Whether a device may have turned enough: a first look, before rates are measured for every shift."""
    known = centred(measured[finite_rows(measured)])
    return len(known) > 0 and float(np.sqrt((known * known).sum(axis=1).mean())) >= 0.5 * LEAST_TURNING


@dataclass(frozen=True, slots=True, eq=False)
class Gravity:
    """What the accelerometer measured over the intervals of a trajectory, (M, 3) in the axes of the device."""

    intervals: PoseIntervals
    measured: Float64Array

    @classmethod
    def of(cls, intervals: PoseIntervals, forces: CleanSamples | None) -> "Gravity | None":
        """Measure; None where there are too few samples."""
        if forces is None:
            return None
        measured = forces.means(intervals.starts, intervals.stops)
        known = measured[finite_rows(measured)]
        return cls(intervals, measured) if len(known) >= FEWEST_INTERVALS and known.any() else None

    def up(self, quaternions_xyzw: Float64Array) -> Float64Array:
        """The mean in the world, as part of the mean length, (3,)."""
        known = finite_rows(self.measured)
        world = self.intervals.to_world(quaternions_xyzw, self.measured)[known]
        up: Float64Array = world.mean(axis=0) / np.linalg.norm(self.measured[known], axis=1).mean()
        return up

    def felt_and_moved(self, quaternions_xyzw: Float64Array, positions: Float64Array) -> float:
        """Correlation of what was felt along the ground with how the positions sped up and turned.

        Args:
            quaternions_xyzw: (N, 4) `world_from_device` of each pose.
            positions: (N, 3) [m], world.
        """
        intervals = self.intervals
        felt = intervals.to_world(quaternions_xyzw, self.measured)
        joined = np.flatnonzero(intervals.first[1:] == intervals.last[:-1])
        lengths = 0.5 * (intervals.lengths[1:] + intervals.lengths[:-1])[joined, None]
        moved = np.diff(intervals.velocities(positions), axis=0)[joined, :2] / lengths
        felt = 0.5 * (felt[1:] + felt[:-1])[joined, :2]
        known = finite_rows(felt, moved)
        felt, moved = centred(felt[known]), centred(moved[known])
        length = float(np.sqrt((felt * felt).sum() * (moved * moved).sum()))
        return float((felt * moved).sum()) / length if length > 0 else 0.0


def centred(rates: Float64Array) -> Float64Array:
    """Rates (M, K) without their mean, which a bias may be."""
    without: Float64Array = rates - rates.mean(axis=0) if len(rates) else rates
    return without


def _without_jumps(rates: Float64Array) -> BoolArray:
    """Which rates are not far beyond the usual, (M,) bool: a single wrong pose tells nothing of the others."""
    lengths = np.linalg.norm(rates, axis=1)
    return np.asarray(lengths <= 3.0 * np.percentile(lengths, 95.0) + 0.1)
