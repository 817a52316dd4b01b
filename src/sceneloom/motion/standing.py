"""When an ego stood, as its IMU feels it, and what the gyroscope told then."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array

WINDOW_NS = 1_000_000_000
"""Judged as one: long enough that the body of a car that drives has swung [ns]."""

LEAST_SAMPLES = 8
"""Samples of either kind that a window needs."""

QUIET_RATE = 0.005
"""Turn rates of a standing ego deviate by less on each axis: the noise of a consumer's gyroscope [rad/s]."""

QUIET_FORCE = 0.05
"""Its specific forces deviate by less on each axis [m/s²]; those of a car that rolls by more than that."""

LARGEST_BIAS = 0.06
"""A mean rate beyond it is a turn, however even [rad/s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """The times in which the ego stood.

    Attributes:
        rate: (3,) float64 [rad/s], mean of the gyroscope.
        seconds: how long.
    """

    rate: Float64Array
    seconds: float


def find_standing(
    rate_times_ns: Int64Array, rates: Float64Array, force_times_ns: Int64Array, forces: Float64Array
) -> Standing | None:
    """Find the windows of a second in which both sensors are quiet; None where there is none.

    Both have to be quiet, since an even turn is quiet to the gyroscope, and an even drive on a smooth road nearly so
    to the accelerometer.

    Args:
        rate_times_ns: (N,) int64 [ns], ascending.
        rates: (N, 3) float64 [rad/s].
        force_times_ns: (M,) int64 [ns], ascending.
        forces: (M, 3) float64 [m/s²].

    Source: the two moving variances are those that Skog, Händel, Nilsson and Rantakokko 2010, "Zero-Velocity
    Detection - An Algorithm Evaluation", compare; the thresholds are ours.
    """
    if len(rate_times_ns) == 0:
        return None
    start_ns, count = int(rate_times_ns[0]), int((rate_times_ns[-1] - rate_times_ns[0]) // WINDOW_NS) + 1
    rate_windows = (rate_times_ns - start_ns) // WINDOW_NS
    force_windows = (force_times_ns - start_ns) // WINDOW_NS
    mean, quiet = _statistics(rate_windows, rates, count, QUIET_RATE)
    inside = (force_windows >= 0) & (force_windows < count)
    _, quiet_forces = _statistics(force_windows[inside], forces[inside], count, QUIET_FORCE)
    stood = quiet & quiet_forces & (np.abs(mean) < LARGEST_BIAS).all(axis=1)
    if not stood.any():
        return None
    # a bias is the same each time, a turn so even that it looks like one is not
    stood &= (np.abs(mean - np.median(mean[stood], axis=0)) < QUIET_RATE).all(axis=1)
    if not stood.any():
        return None
    return Standing(rates[stood[rate_windows]].mean(axis=0), float(stood.sum()) * WINDOW_NS * 1e-9)


def _statistics(
    windows: Int64Array, values: Float64Array, count: int, quiet: float
) -> tuple[Float64Array, BoolArray]:
    """Mean of the values in each window, (count, 3), and whether they deviate by less than `quiet`, (count,)."""
    samples = np.maximum(np.bincount(windows, minlength=count), 1)[:, None]
    mean = _sums(windows, values, count) / samples
    deviation = np.sqrt(_sums(windows, (values - mean[windows]) ** 2, count) / samples)
    enough = samples[:, 0] >= LEAST_SAMPLES
    return mean, enough & (deviation < quiet).all(axis=1)


def _sums(windows: Int64Array, values: Float64Array, count: int) -> Float64Array:
    return np.stack([np.bincount(windows, column, minlength=count) for column in values.T], axis=1)
