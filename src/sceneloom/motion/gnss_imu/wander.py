"""Slow errors of fixes: what satellites and air do to all fixes of some seconds alike."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.motion.gnss_imu.chain import equations
from sceneloom.motion.gnss_imu.robust import Fit

_LEAST_FIXES = 8
_ALIKE, _LEAST_ALIKE = 1.3, 0.3
"""Residuals of neighbours are alike where their correlation is above so many standard deviations of that of white
noise, 1/√n, and above the second number; those of a smoother with white noise are rather unlike."""
_MOST_ALIKE = 0.98
_FARTHEST = 3.0
"""Fixes further apart in time [s] are no neighbours."""
_AXES = (slice(0, 2), slice(2, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Wander:
    """The slow error of the fixes along some axes.

    Attributes:
        sigma: its standard deviation [m].
        seconds: the time after which it has forgotten itself but for 1/e.
        alike: correlation of neighbouring residuals.
        times_ns: (F,) int64 [ns] of the fixes that went in.
        values: (F, axes) [m], the slow error at each.
    """

    sigma: float
    seconds: float
    alike: float
    times_ns: Int64Array
    values: Float64Array

    def at(self, times_ns: Int64Array) -> Float64Array:
        """Give it at some times, (N, axes) [m]: the mean between and beyond the fixes.

        Source: Rasmussen and Williams 2006, "Gaussian Processes for Machine Learning", 4.2.1, the exponential
        covariance, whose process is that of Ornstein and Uhlenbeck 1930 and needs the two neighbours only.
        """
        after = np.searchsorted(self.times_ns, times_ns)
        before, after = np.clip(after - 1, 0, None), np.clip(after, None, len(self.times_ns) - 1)
        one = np.exp(-np.abs(times_ns - self.times_ns[before]) * 1e-9 / self.seconds)
        other = np.exp(-np.abs(self.times_ns[after] - times_ns) * 1e-9 / self.seconds)
        both = np.where(before == after, 0.0, one * other)
        left = np.maximum(1.0 - both**2, 1e-12)
        inside = times_ns <= self.times_ns[-1]
        weights = np.stack([one - both * other, other - both * one]) / left
        weights[:, before == after] = np.stack([one, 0.0 * one])[:, before == after]
        weights[:, ~inside] = np.stack(
            [0.0 * one, np.exp(-np.abs(times_ns - self.times_ns[-1]) * 1e-9 / self.seconds)]
        )[:, ~inside]
        found: Float64Array = (
            weights[0][:, None] * self.values[before] + weights[1][:, None] * self.values[after]
        )
        return found


def wandering(fit: Fit) -> tuple[Wander | None, Wander | None]:
    """Find the slow error across and in height, where residuals of neighbouring fixes are alike."""
    fixes = fit.chain.fixes
    rows = np.flatnonzero(fit.weights > 0)
    if len(rows) < _LEAST_FIXES or len(np.unique(fixes.receivers)) > 1:
        return None, None
    residuals = -equations(fit.chain, fit.states, fit.weights).fix_residuals[rows]
    times = fixes.timestamps_ns[rows]
    across, height = (_wander(times, residuals[:, axes]) for axes in _AXES)
    return across, height


def _wander(times_ns: Int64Array, residuals: Float64Array) -> Wander | None:
    steps = np.diff(times_ns) * 1e-9
    near = (steps > 0) & (steps <= max(_FARTHEST, 1.5 * float(np.median(steps))))
    variance = float((residuals**2).mean())
    if near.sum() < _LEAST_FIXES or variance == 0.0:
        return None
    alike = float((residuals[1:] * residuals[:-1])[near].mean()) / variance
    if alike < max(_LEAST_ALIKE, _ALIKE / np.sqrt(near.sum() * residuals.shape[1])):
        return None
    alike = min(alike, _MOST_ALIKE)
    seconds = -float(np.median(steps[near])) / np.log(alike)
    return Wander(np.sqrt(variance), seconds, alike, times_ns, residuals)
