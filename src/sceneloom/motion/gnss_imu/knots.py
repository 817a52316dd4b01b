"""The times at which the smoother has states: those of fixes, the ends of gaps, and some between."""

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import PoseError
from sceneloom.motion.gnss_imu.samples import InertialSamples

_CLOSEST_NS = 20_000_000
"""States lie no closer [ns]: what a fix tells is carried over so short a time without loss."""

_LONGEST_NS = 86_400 * 1_000_000_000
"""No drive lasts longer [ns]: a wrong time is not to be bridged by millions of states."""


def knot_times(
    fix_times_ns: Int64Array, samples: InertialSamples | None, further_ns: Int64Array, *, longest: float
) -> Int64Array:
    """Choose the times of the states.

    Args:
        fix_times_ns: (F,) [ns].
        samples: of the IMU, whose first and last time and gaps get states.
        further_ns: times that should have one, if there is none near them.
        longest: [s] between neighbours.

    Returns:
        (K,) int64 [ns], strictly increasing, K >= 2.

    Raises:
        PoseError: the times span more than a day.
    """
    marks = [fix_times_ns]
    if samples is not None:
        marks += [samples.timestamps_ns[[0, -1]], samples.gaps_ns.ravel()]
    times = np.unique(np.concatenate(marks))
    first_ns, last_ns = int(times[0]), int(times[-1])
    if last_ns - first_ns > _LONGEST_NS:
        raise PoseError(
            f"fixes and IMU span {(last_ns - first_ns) / 1e9:.6g} s, from {first_ns / 1e9:.9g} to {last_ns / 1e9:.9g}; "
            f"expected at most {_LONGEST_NS / 1e9:g}: is a time wrong?"
        )
    thin = _thinned(times)
    thin = _thinned(np.unique(np.concatenate([thin, further_ns])), first=thin)
    pieces = [thin[:1]]
    for start, stop in zip(thin[:-1].tolist(), thin[1:].tolist(), strict=True):
        count = max(1, int(np.ceil((stop - start) * 1e-9 / longest - 1e-6)))
        shares = np.arange(1, count + 1) * ((stop - start) / count)
        pieces.append(start + np.rint(shares).astype(np.int64))
    knots: Int64Array = np.concatenate(pieces)
    return knots if len(knots) > 1 else np.array([knots[0], knots[0] + _CLOSEST_NS])


def _thinned(times_ns: Int64Array, *, first: Int64Array | None = None) -> Int64Array:
    """Leave out times too close to the one kept before; those of `first` are kept before others."""
    if first is not None:
        near = np.searchsorted(first, times_ns)
        before = times_ns - first[np.clip(near - 1, 0, len(first) - 1)]
        after = first[np.clip(near, 0, len(first) - 1)] - times_ns
        far = (np.abs(before) >= _CLOSEST_NS) & (np.abs(after) >= _CLOSEST_NS)
        return np.unique(np.concatenate([first, _thinned(times_ns[far])]))
    kept: list[int] = []
    for time in times_ns.tolist():
        if not kept or time - kept[-1] >= _CLOSEST_NS:
            kept.append(time)
    return np.array(kept, np.int64)


def nearest_knots(knots_ns: Int64Array, times_ns: Int64Array) -> Int64Array:
    """The state nearest to each time."""
    after = np.clip(np.searchsorted(knots_ns, times_ns), 1, len(knots_ns) - 1)
    nearer_before = times_ns - knots_ns[after - 1] <= knots_ns[after] - times_ns
    nearest: Int64Array = after - nearer_before
    return nearest
