"""When an ego stood, as its IMU feels it, and what the gyroscope reported then."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array

WINDOW_NS = 1_000_000_000
"""Judged as one: long enough that the body of a car that drives has swung [ns]."""

LEAST_SAMPLES = 20
"""Samples of either kind that a window needs."""

QUIET_RATE = 0.005
"""Rotate rates of a stationary ego deviate by less on each axis: the noise of a consumer's gyroscope [rad/s]."""

QUIET_FORCE = 0.2
"""Its specific forces deviate by less on each axis, with the engine running [m/s²]."""

WHITE = 1.5
"""A stationary ego's samples differ from one to the next as from their mean: the ratio of the two variances is 1, with
200 samples within 0.1. A car that rolls, however smoothly, sways slowly: neighbouring samples are alike."""

_ROUNDING = 1e-20
"""Variance of samples that are all the same, as computed."""

LARGEST_BIAS = 0.06
"""A mean rate beyond it is a rotation, however even [rad/s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Stationary:
    """The times in which the ego stood.

    Attributes:
        rate: (3,) float64 [rad/s], mean of the gyroscope.
        seconds: how long.
    """

    rate: Float64Array
    seconds: float


def find_stationary(
    rate_times_ns: Int64Array, rates: Float64Array, force_times_ns: Int64Array, forces: Float64Array
) -> Stationary | None:
    """Find the windows of a second in which both sensors are quiet; None where there is none.

    Quiet is what deviates little, and by noise alone: an even drive on a smooth road deviates little, too.

    Args:
        rate_times_ns: (N,) int64 [ns], ascending.
        rates: (N, 3) float64 [rad/s].
        force_times_ns: (M,) int64 [ns], ascending.
        forces: (M, 3) float64 [m/s²].

    Source: the two moving variances are those that Skog, Händel, Nilsson and Rantakokko 2010, "Zero-Velocity
    Detection - An Algorithm Evaluation", compare; the ratio is that of von Neumann 1941, "Distribution of the Ratio of
    the Mean Square Successive Difference to the Variance"; the thresholds are ours.
    """
    if len(rate_times_ns) == 0:
        return None
    # numbered as they come: a wrong time would else make windows by the million
    seconds, rate_windows = np.unique((rate_times_ns - rate_times_ns[0]) // WINDOW_NS, return_inverse=True)
    count = len(seconds)
    of_forces = (force_times_ns - rate_times_ns[0]) // WINDOW_NS
    force_windows = np.minimum(np.searchsorted(seconds, of_forces), count - 1)
    mean, quiet = _statistics(rate_windows, rates, count, QUIET_RATE)
    inside = seconds[force_windows] == of_forces
    _, quiet_forces = _statistics(force_windows[inside], forces[inside], count, QUIET_FORCE)
    stood = quiet & quiet_forces & (np.abs(mean) < LARGEST_BIAS).all(axis=1)
    if not stood.any():
        return None
    # a bias is the same each time, a rotation so even that it looks like one is not
    stood &= (np.abs(mean - np.median(mean[stood], axis=0)) < QUIET_RATE).all(axis=1)
    if not stood.any():
        return None
    return Stationary(rates[stood[rate_windows]].mean(axis=0), float(stood.sum()) * WINDOW_NS * 1e-9)


def _statistics(
    windows: Int64Array, values: Float64Array, count: int, quiet: float
) -> tuple[Float64Array, BoolArray]:
    """Mean of the values in each window, (count, 3), and whether they deviate by less than `quiet`, (count,)."""
    samples = np.maximum(np.bincount(windows, minlength=count), 1)[:, None]
    mean = _sums(windows, values, count) / samples
    variance = _sums(windows, (values - mean[windows]) ** 2, count) / samples
    pairs = windows[1:] == windows[:-1]
    steps = _sums(windows[1:][pairs], np.diff(values, axis=0)[pairs] ** 2, count) / samples
    calm = (variance < quiet**2) & (variance <= WHITE * steps / 2 + _ROUNDING)
    return mean, (samples[:, 0] >= LEAST_SAMPLES) & calm.all(axis=1)


def _sums(windows: Int64Array, values: Float64Array, count: int) -> Float64Array:
    return np.stack([np.bincount(windows, column, minlength=count) for column in values.T], axis=1)
