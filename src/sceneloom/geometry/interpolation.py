"""Poses between the poses of a path, and the fewest poses that still give the path."""

from math import radians

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from sceneloom.errors import ArrayError
from sceneloom.geometry.rotations import angle_between, normalise_quaternion, slerp

_EARLIEST_NS, _LATEST_NS = np.iinfo(np.int64).min, np.iinfo(np.int64).max
_ANY_REACH_NS = _LATEST_NS
_LEVELS_AT_WORST_POSE = 32
INSIDE, EXTRAPOLATED, OUT_OF_REACH = 0, 1, 2
"""Values of `coverage`."""


@np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
def interpolate_poses(
    timestamps_ns: Int64Array,
    positions: Float64Array,
    quaternions_xyzw: Float64Array,
    query_ns: Int64Array,
    *,
    reach_ns: int = 0,
) -> tuple[Float64Array, Float64Array, UInt8Array]:
    """Give the pose at each time: position linear, rotation slerp between the neighbouring poses.

    Beyond either end the velocity and the rotating of the end segment go on; a path of one pose is stationary.

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64, normalised here.
        query_ns: (M,) int64 [ns].
        reach_ns: how far beyond either end poses are given.

    Returns:
        positions: (M, 3) float64 [m]; NaN where out of reach.
        quaternions_xyzw: (M, 4) float64, unit; NaN where out of reach.
        coverage: (M,) uint8: 0 inside the path, 1 extrapolated, 2 out of reach.

    Raises:
        ArrayError: the path has no pose.
    """
    count = len(timestamps_ns)
    if count == 0:
        raise ArrayError("timestamps_ns: no pose to interpolate; expected at least one")
    times, coverage = _within_reach(timestamps_ns, np.asarray(query_ns, np.int64), reach_ns)
    before = np.clip(np.searchsorted(timestamps_ns, times, side="right") - 1, 0, max(count - 2, 0))
    after = np.minimum(before + 1, count - 1)
    # differences of int64 are taken as uint64, which holds each of them
    spans = np.maximum((timestamps_ns[after] - timestamps_ns[before]).view(np.uint64), 1)
    late = times >= timestamps_ns[before]
    since = np.where(late, times - timestamps_ns[before], timestamps_ns[before] - times).view(np.uint64)
    fraction = np.where(late, 1.0, -1.0) * since / spans
    fraction[before == after] = 0.0
    start, stop = positions[before], positions[after]
    locations = start + fraction[:, None] * (stop - start)
    rotations = slerp(quaternions_xyzw[before], quaternions_xyzw[after], fraction)
    locations[coverage == OUT_OF_REACH] = np.nan
    rotations[coverage == OUT_OF_REACH] = np.nan
    return locations, rotations, coverage


def _within_reach(timestamps_ns: Int64Array, query_ns: Int64Array, reach_ns: int) -> tuple[Int64Array, UInt8Array]:
    """Cut the times to the path and its reach, so that their differences stay within int64."""
    first, last = int(timestamps_ns[0]), int(timestamps_ns[-1])
    times = np.clip(query_ns, max(first - reach_ns, _EARLIEST_NS), min(last + reach_ns, _LATEST_NS))
    coverage = np.full(len(query_ns), INSIDE, np.uint8)
    coverage[(query_ns < first) | (query_ns > last)] = EXTRAPOLATED
    coverage[query_ns != times] = OUT_OF_REACH
    return times, coverage


@np.errstate(invalid="ignore", over="ignore")
def thin_poses(
    timestamps_ns: Int64Array,
    positions: Float64Array,
    quaternions_xyzw: Float64Array,
    required_ns: Int64Array,
    *,
    position_tolerance: float = 1e-3,
    rotation_tolerance: float = radians(0.01),
) -> Int64Array:
    """Find the poses of a dense path that a thinner path needs besides those at the required times.

    The thinner path has a pose, interpolated from the dense one, at every required time, and the poses
    returned here. Between the first and the last required time it stays within the tolerances of the dense
    path. Segments are split at their worst pose until they fit; all segments of one level at once, so long
    paths need no deep recursion.

    Args:
        timestamps_ns: (N,) int64 [ns], strictly increasing, N >= 1.
        positions: (N, 3) float64 [m].
        quaternions_xyzw: (N, 4) float64.
        required_ns: (K,) int64 [ns], in any order; where empty, the ends of the dense path are required.
        position_tolerance: largest distance between the two paths [m].
        rotation_tolerance: largest angle between them.

    Returns:
        (E,) int64, ascending indices into the dense path, none of them at a required time.

    Raises:
        ArrayError: the path has no pose.

    Source: Douglas and Peucker 1973, with the distance taken at equal times; it is largest at a pose of the
    dense path, since both paths move linearly between those.
    """
    unit = normalise_quaternion(quaternions_xyzw)
    required = np.unique(required_ns if len(required_ns) else timestamps_ns[[0, -1]])
    kept = np.zeros(len(timestamps_ns), np.bool_)
    open_poses = np.flatnonzero(
        (timestamps_ns > required[0]) & (timestamps_ns < required[-1]) & ~np.isin(timestamps_ns, required)
    )
    level = 0
    while len(open_poses):
        knots_ns = np.union1d(required, timestamps_ns[kept])
        locations, rotations, _ = interpolate_poses(timestamps_ns, positions, unit, knots_ns, reach_ns=_ANY_REACH_NS)
        times = timestamps_ns[open_poses]
        near, rotated, _ = interpolate_poses(knots_ns, locations, rotations, times)
        misfits = np.maximum(
            np.linalg.norm(near - positions[open_poses], axis=1) / position_tolerance,
            angle_between(rotated, unit[open_poses]) / rotation_tolerance,
        )
        misfits[np.isnan(misfits)] = np.inf  # poses that are no numbers are kept
        chosen, undecided = _split(np.searchsorted(knots_ns, times), misfits, at_worst=level < _LEVELS_AT_WORST_POSE)
        kept[open_poses[chosen]] = True
        open_poses = open_poses[undecided]
        level += 1
    return np.flatnonzero(kept)


def _split(segments: Int64Array, misfits: Float64Array, *, at_worst: bool) -> tuple[Int64Array, BoolArray]:
    """Choose one pose of every segment that does not fit, and report which poses have to be judged again.

    Splitting at the worst pose gives few poses, but may take as many levels as there are poses; splitting in
    the middle (not `at_worst`) bounds the levels.
    """
    starts = np.flatnonzero(np.diff(segments, prepend=segments[0] - 1))
    lengths = np.diff(starts, append=len(segments))
    worst = np.maximum.reduceat(misfits, starts)
    wrong = ~(worst <= 1.0)
    if at_worst:
        hits = np.flatnonzero(misfits == np.repeat(worst, lengths))
        middle = hits[np.searchsorted(hits, starts)]
    else:
        middle = starts + lengths // 2
    undecided = np.repeat(wrong, lengths)
    undecided[middle] = False
    return middle[wrong], undecided
