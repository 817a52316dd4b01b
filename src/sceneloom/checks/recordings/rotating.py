"""How a trajectory rotated and accelerated, beside what the IMU measured at the same time."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    multiply_quaternions,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from sceneloom.scene.motion import VectorSamples
from sceneloom.scene.poses import Trajectory

INTERVAL = 0.2
"""Rates are compared over so long [s], or over the time from pose to pose where that is longer."""
LONGEST_INTERVAL = 1.0
"""Poses farther apart [s] do not notify how the device rotated between them."""
_MOST_INTERVALS = 2_000
_TORN_FACTOR, _TORN_LENGTH = 5.0, 20.0
"""Samples beyond so many times what 99 % keep to, and longer than this, are blows or broken lines."""
_ENOUGH_FOR_NOISE = 20_000
_FROM_MEDIAN = 1.4826
"""The deviation of a normal distribution is so many times the median of its absolute values."""
_GAP_FACTOR = 5.5
"""So many usual intervals without a sample are a gap: what the IMU felt then is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class CleanSamples:
    """Samples with finite values and strictly increasing times.

    Attributes:
        seconds: (N,) float64 [s], counted from `origin_ns`.
        values: (N, 3) float64.
        sums: (N, 3) float64, integral of the values since the first sample.
        gaps: (N,) int64, how many gaps lie before each sample.
    """

    seconds: Float64Array
    values: Float64Array
    sums: Float64Array
    gaps: Int64Array

    @classmethod
    def of(cls, samples: VectorSamples | None, origin_ns: int) -> "CleanSamples | None":
        """Take the usable samples of a stream of three axes; None for fewer than three."""
        if samples is None or samples.values.shape[1] != 3:
            return None
        usable = np.flatnonzero(_untorn(samples.values))
        times_ns = samples.timestamps_ns[usable]
        if not (np.diff(times_ns) > 0).all():
            usable = usable[np.unique(times_ns, return_index=True)[1]]
        if len(usable) < 3:
            return None
        seconds, values = (samples.timestamps_ns[usable] - origin_ns) / 1e9, samples.values[usable]
        steps = np.diff(seconds)
        areas = 0.5 * (values[1:] + values[:-1]) * steps[:, None]
        sums = np.vstack([np.zeros((1, 3)), np.cumsum(areas, axis=0)])
        gaps = np.concatenate([[0], np.cumsum(steps > _GAP_FACTOR * np.median(steps))])
        return cls(seconds, values, sums, gaps.astype(np.int64))

    def means(self, starts: Float64Array, stops: Float64Array) -> Float64Array:
        """The mean value over each interval, (M, 3); NaN where it reaches beyond the samples or over a gap."""
        before, after = self._location(starts), self._location(stops)
        integral = self._sums_at(stops, after) - self._sums_at(starts, before)
        known = (starts >= self.seconds[0]) & (stops <= self.seconds[-1])
        known &= self.gaps[np.minimum(after + 1, len(self.gaps) - 1)] == self.gaps[before]
        means: Float64Array = np.where(known[:, None], integral / (stops - starts)[:, None], np.nan)
        return means

    def noise(self, length: float) -> float:
        """Deviation of means over so long [s] that comes from noise, all axes together.

        Second differences of independent errors have six times their variance; what moves smoothly has none.
        """
        some = self.values[:_ENOUGH_FOR_NOISE]
        each = _FROM_MEDIAN * np.median(np.abs(np.diff(some, 2, axis=0)), axis=0) / np.sqrt(6.0)
        samples = max(1.0, length / float(np.median(np.diff(self.seconds[:_ENOUGH_FOR_NOISE]))))
        return float(np.linalg.norm(each)) / float(np.sqrt(samples))

    def _location(self, seconds: Float64Array) -> Int64Array:
        found = np.searchsorted(self.seconds, seconds, side="right") - 1
        return np.clip(found, 0, len(self.seconds) - 1).astype(np.int64)

    def _sums_at(self, seconds: Float64Array, location: Int64Array) -> Float64Array:
        """The sums at times that lie after these samples, (M, 3): once looked up for all axes."""
        first = np.minimum(location, len(self.seconds) - 2)
        share = (seconds - self.seconds[first]) / (self.seconds[first + 1] - self.seconds[first])
        before = self.sums[first]
        sums: Float64Array = before + share[:, None] * (self.sums[first + 1] - before)
        return sums


def _untorn(values: Float64Array) -> BoolArray:
    """Which samples are finite, and not far beyond what nearly all others are, (N,) bool."""
    lengths = np.sqrt((values * values).sum(axis=1))
    finite: BoolArray = np.asarray(np.isfinite(lengths))
    if not finite.any():
        return finite
    farthest = max(_TORN_FACTOR * float(np.percentile(lengths[finite], 99.0)), _TORN_LENGTH)
    return np.asarray(finite & (lengths <= farthest))


@dataclass(frozen=True, slots=True, eq=False)
class PoseIntervals:
    """A trajectory as intervals between some of its poses.

    Attributes:
        starts, stops: (M,) float64 [s], counted from the trajectory's first pose.
        first, last: (M,) int64, the poses that bound each interval.
    """

    starts: Float64Array
    stops: Float64Array
    first: Int64Array
    last: Int64Array

    @classmethod
    def of(cls, trajectory: Trajectory) -> "PoseIntervals":
        """Choose intervals of about `INTERVAL`, evenly spread where there are very many."""
        seconds = (trajectory.timestamps_ns - trajectory.timestamps_ns[0]) / 1e9
        if len(seconds) < 2:
            none = np.zeros(0)
            return cls(none, none, none.astype(np.int64), none.astype(np.int64))
        step = max(INTERVAL, float(np.median(np.diff(seconds))))
        knots = np.flatnonzero(np.diff(np.floor((seconds + 1e-6) / step), prepend=-1.0))
        lengths = np.diff(seconds[knots])
        usable = np.flatnonzero((lengths > 0.5 * step) & (lengths < min(2.0 * step, LONGEST_INTERVAL + 1e-6)))
        usable = usable[:: len(usable) // _MOST_INTERVALS + 1]
        first, last = knots[usable].astype(np.int64), knots[usable + 1].astype(np.int64)
        return cls(seconds[first], seconds[last], first, last)

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def lengths(self) -> Float64Array:
        """(M,) float64 [s]."""
        return self.stops - self.starts

    def rates(self, quaternions_xyzw: Float64Array) -> Float64Array:
        """Mean yaw rate over each interval in the axes of the device, (M, 3) [rad/s]."""
        rotated = multiply_quaternions(
            conjugate_quaternion(quaternions_xyzw[self.first]), quaternions_xyzw[self.last]
        )
        return rotation_vector_from_quaternion(rotated) / self.lengths[:, None]

    def velocities(self, positions: Float64Array) -> Float64Array:
        """Mean velocity over each interval in the world, (M, 3) [m/s]."""
        velocities: Float64Array = (positions[self.last] - positions[self.first]) / self.lengths[:, None]
        return velocities

    def to_world(self, quaternions_xyzw: Float64Array, vectors: Float64Array) -> Float64Array:
        """Rotate vectors (M, 3), one per interval, from the axes of the device into the world's in its middle."""
        middle = (self.first + self.last) // 2
        return rotate_vectors(quaternions_xyzw[middle], vectors)


def orientation_noise(quaternions_xyzw: Float64Array) -> float:
    """Deviation of each orientation (N, 4) from those beside it, all axes together [rad]; see `CleanSamples.noise`."""
    some = quaternions_xyzw[:_ENOUGH_FOR_NOISE]
    steps = rotation_vector_from_quaternion(multiply_quaternions(conjugate_quaternion(some[:-1]), some[1:]))
    if len(steps) < 2:
        return 0.0
    each = _FROM_MEDIAN * np.median(np.abs(np.diff(steps, axis=0)), axis=0) / np.sqrt(6.0)
    return float(np.linalg.norm(each))


def finite_rows(*arrays: Float64Array) -> BoolArray:
    """Which rows are finite in all of the arrays, (M,) bool."""
    return np.asarray(np.logical_and.reduce([np.isfinite(array).all(axis=1) for array in arrays]))
