"""What labels state of an object besides where it is: how sure it is, what it rests on, how fast it goes, whence."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.scene.annotations.attributes import AttributePath
from sceneloom.scene.tracks import Support, Track

EXISTENCE, SUPPORT, SPEED, POSITION_SIGMA = "existence", "support", "speed", "position_sigma"
"""Names of the attributes that hold over time: probability, a word of `Support`, [m/s], [m]."""
TRACK, SOURCE, REVIEW = "track", "source", "review"
"""Names of those that hold at all times: number of the track, where it comes from, what to look at first."""

_STEPS = {EXISTENCE: 0.05, SPEED: 0.5, POSITION_SIGMA: 0.1}
"""A value holds until the true one is so far from it."""
_DECIMALS = 3


def attributes_of(track: Track, source: str, flags: Sequence[str]) -> tuple[AttributePath, ...]:
    """Report of an object what its track knows; what holds over time is reported only where it changes."""
    times, covariances = track.timestamps_ns, track.covariances
    level = np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2.0
    numbers = {
        EXISTENCE: track.scores,
        SPEED: np.linalg.norm(track.velocities[:, :2], axis=1),
        POSITION_SIGMA: np.sqrt(np.maximum(level, 0.0)),
    }
    timed = [_stepped(name, times, values, _STEPS[name]) for name, values in numbers.items()]
    words = [Support(k).name.lower() for k in track.supports.tolist()]
    changes = [k for k, word in enumerate(words) if k == 0 or words[k - 1] != word]
    timed.append(AttributePath(SUPPORT, tuple(words[k] for k in changes), times[changes]))
    still: dict[str, Any] = {TRACK: track.id, SOURCE: source}
    if flags:
        still[REVIEW] = tuple(flags)
    return (*timed, *(static(name, value, int(times[0])) for name, value in still.items()))


def static(name: str, value: Any, time_ns: int) -> AttributePath:
    """An attribute that holds at all times; its only timestamp is for readers that want one."""
    return AttributePath(name, (value,), np.array([time_ns], np.int64), static=True)


def _stepped(name: str, times_ns: Int64Array, values: Float64Array, step: float) -> AttributePath:
    kept: list[int] = []
    for k, value in enumerate(values.tolist()):
        if not kept or abs(value - values[kept[-1]]) >= step:
            kept.append(k)
    return AttributePath(name, tuple(round(float(values[k]), _DECIMALS) for k in kept), times_ns[kept])
