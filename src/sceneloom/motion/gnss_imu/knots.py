"""The times at which the smoother has states: ends of gaps, fixes to which the IMU does not lead well, and others."""

import numpy as np

from sceneloom.arrays import BoolArray, Int64Array
from sceneloom.errors import PoseError
from sceneloom.motion.gnss_imu.samples import InertialSamples, noise_densities
from sceneloom.motion.gnss_imu.settings import SmootherSettings

CLOSEST_NS = 20_000_000
"""States lie no closer [ns]: what a fix reports is carried over so short a time without loss."""

_LONGEST_NS = 86_400 * 1_000_000_000
"""No drive lasts longer [ns]: a wrong time is not to be bridged by millions of states."""

_CARRIED = 0.3
"""What the noise of the IMU adds to a fix on the way from the state before it, as a share of the best fix's own."""
_LONGEST_CARRIED = 0.5
"""So long at most [s], since not all that is wrong with an IMU shows in its noise: scales, axes, biases at first."""
_WEIGHT = 9.81
"""Acceleration [m/s²] that a wrong orientation rotates aside."""


def knot_times(
    fix_times_ns: Int64Array,
    samples: InertialSamples | None,
    further_ns: Int64Array,
    settings: SmootherSettings,
) -> Int64Array:
    """Choose the times of the states.

    Args:
        fix_times_ns: (F,) [ns], ascending.
        samples: of the IMU, whose first and last time and gaps get states.
        further_ns: times that should have one, if there is none near them.
        settings: how far states may lie apart.

    Returns:
        (K,) int64 [ns], strictly increasing, K >= 2.

    Raises:
        PoseError: the times span more than a day.
    """
    marks = np.empty(0, np.int64)
    if samples is not None:
        marks = np.unique(np.concatenate([samples.timestamps_ns[[0, -1]], samples.gaps_ns.ravel()]))
    times = np.concatenate([marks, fix_times_ns])
    first_ns, last_ns = int(times.min()), int(times.max())
    if last_ns - first_ns > _LONGEST_NS:
        raise PoseError(
            f"fixes and IMU span {(last_ns - first_ns) / 1e9:.6g} s, from {first_ns / 1e9:.9g} to {last_ns / 1e9:.9g}; "
            f"expected at most {_LONGEST_NS / 1e9:g}: is a time wrong?"
        )
    thin = _spaced(marks, np.empty(0, np.int64), np.full(len(marks), CLOSEST_NS))
    thin = _spaced(np.unique(fix_times_ns), thin, _apart_ns(np.unique(fix_times_ns), samples, settings))
    thin = _spaced(further_ns, thin, np.full(len(further_ns), CLOSEST_NS))
    chunks = [thin[:1]]
    for start, stop in zip(thin[:-1].tolist(), thin[1:].tolist(), strict=True):
        count = max(1, int(np.ceil((stop - start) * 1e-9 / settings.longest_interval - 1e-6)))
        shares = np.arange(1, count + 1) * ((stop - start) / count)
        chunks.append(start + np.rint(shares).astype(np.int64))
    knots: Int64Array = np.concatenate(chunks)
    return knots if len(knots) > 1 else np.array([knots[0], knots[0] + CLOSEST_NS])


def _apart_ns(
    times_ns: Int64Array, samples: InertialSamples | None, settings: SmootherSettings
) -> Int64Array:
    """How far a fix at each time may be from the state before it, (F,) [ns]: the IMU's noise has to stay small.

    Source: position by white noise of the acceleration, n² t³ / 3, and by that of the yaw rate under gravity,
    (g n)² t⁵ / 20 (Farrell 2008, "Aided Navigation", 11.4).
    """
    if samples is None:
        return np.full(len(times_ns), CLOSEST_NS)
    rate, force = noise_densities(samples, times_ns, settings).T
    allowed = _CARRIED * settings.least_fix_noise / np.sqrt(2.0)
    seconds = np.minimum(
        (3.0 * allowed**2 / force) ** (1.0 / 3.0), (20.0 * allowed**2 / (_WEIGHT**2 * rate)) ** 0.2
    )
    apart = np.rint(np.minimum(seconds, _LONGEST_CARRIED) * 1e9).astype(np.int64)
    return np.where(_felt(times_ns, samples), np.maximum(apart, CLOSEST_NS), CLOSEST_NS)


def _felt(times_ns: Int64Array, samples: InertialSamples) -> BoolArray:
    """Which times lie within the samples and in no gap of theirs."""
    felt: BoolArray = (times_ns >= samples.timestamps_ns[0]) & (times_ns <= samples.timestamps_ns[-1])
    for start_ns, stop_ns in samples.gaps_ns:
        felt &= (times_ns <= start_ns) | (times_ns >= stop_ns)
    return felt


def _spaced(times_ns: Int64Array, known_ns: Int64Array, apart_ns: Int64Array) -> Int64Array:
    """Known times and those of others that lie far enough after the one before and not close before the next known."""
    ends = np.append(known_ns, np.iinfo(np.int64).max)
    kept: list[int] = []
    for time, apart, location in zip(
        times_ns.tolist(), apart_ns.tolist(), np.searchsorted(known_ns, times_ns).tolist(), strict=True
    ):
        before = [kept[-1]] if kept else []
        before += [int(known_ns[location - 1])] if location else []
        if int(ends[location]) - time >= CLOSEST_NS and (not before or time - max(before) >= apart):
            kept.append(time)
    return np.union1d(known_ns, np.array(kept, np.int64))
