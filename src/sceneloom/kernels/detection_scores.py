"""Detections held against true objects frame by frame, from any score on, as precision and recall need it.

Rows are sorted by frame, `starts` and flat pairs are those of `frame_overlaps`; the true objects are the rows of each
frame's pairs.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

_NONE = -1


@njit(nogil=True, error_model="numpy", inline="always")
def _most_overlapping(overlaps, i, chosen, taken, ignored, least):  # type: ignore[no-untyped-def]
    """Give the detection that overlaps a true object most; one that is ignored only if there is no other."""
    best, most, spare = -1, least, -1
    for j in range(overlaps.shape[1]):
        if not chosen[j] or taken[j] or overlaps[i, j] <= least:
            continue
        if not ignored[j]:
            if overlaps[i, j] > most:
                best, most = j, overlaps[i, j]
        elif spare < 0:
            spare = j
    return best if best >= 0 else spare


@kernel(
    "Tuple((int64, int64, int64))(float64[:,::1], boolean[::1], boolean[::1], boolean[::1], boolean[::1], float64, "
    "boolean[::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def _counted(
    overlaps: Float64Array,
    chosen: BoolArray,
    true_ignored: BoolArray,
    found_ignored: BoolArray,
    excused: BoolArray,
    least: float,
    taken: BoolArray,
) -> tuple[int, int, int]:
    """Count in one frame, of the chosen detections: true ones, false ones, and true objects found by ignored ones."""
    taken[:] = False
    right, wrong, passed = 0, 0, 0
    for i in range(overlaps.shape[0]):
        j = _most_overlapping(overlaps, i, chosen, taken, found_ignored, least)
        if j < 0:
            continue
        taken[j] = True
        if not true_ignored[i]:
            right += not found_ignored[j]
            passed += found_ignored[j]
    for j in range(overlaps.shape[1]):
        wrong += chosen[j] and not (taken[j] or found_ignored[j] or excused[j])
    return right, wrong, passed


@kernel("boolean[::1](float64[:,::1], float64)", nogil=True, cache=True)
def _near_something(overlaps: Float64Array, least: float) -> BoolArray:
    """Report which detections of a frame overlap a true object by more than `least`."""
    near = np.zeros(overlaps.shape[1], np.bool_)
    for i in range(overlaps.shape[0]):
        for j in range(overlaps.shape[1]):
            if overlaps[i, j] > least:
                near[j] = True
    return near


@kernel(
    "void(int64[:,::1], int64[::1], float64[:,::1], boolean[::1], boolean[::1], boolean[::1], float64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def _step_through(
    steps: Int64Array,
    rows: Int64Array,
    overlaps: Float64Array,
    true_ignored: BoolArray,
    found_ignored: BoolArray,
    excused: BoolArray,
    scores: Float64Array,
    least: float,
) -> None:
    """Let the detections `rows` of a frame come in by their scores, and write how the counts change."""
    own_scores, ignored, forgiven = scores[rows], found_ignored[rows], excused[rows]
    order = np.argsort(-own_scores, kind="mergesort")
    chosen, taken = np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.bool_)
    before = (0, 0, 0)
    for k in range(len(order)):
        j = order[k]
        chosen[j] = True
        if k + 1 < len(order) and own_scores[order[k + 1]] == own_scores[j]:
            continue
        now = _counted(overlaps, chosen, true_ignored, ignored, forgiven, least, taken)
        steps[rows[j], 0] = now[0] - before[0]
        steps[rows[j], 1] = now[1] - before[1]
        steps[rows[j], 2] = now[2] - before[2]
        before = now


@kernel(
    "int64[:,::1](float64[::1], int64[::1], int64[::1], int64[::1], boolean[::1], boolean[::1], boolean[::1], "
    "float64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def score_steps(
    overlaps: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    true_ignored: BoolArray,
    found_ignored: BoolArray,
    excused: BoolArray,
    scores: Float64Array,
    least: float,
) -> Int64Array:
    """Report by how much counts change when the least score of detections that count falls to that of each.

    With each least score the objects are paired anew: each true one, in their order, with the detection that overlaps
    it most.

    Args:
        overlaps: (P,), of the pairs.
        true_starts, found_starts, starts: (F + 1,), of true objects, detections and pairs.
        true_ignored: (T,), true objects that need not be found.
        found_ignored: (N,), detections that are neither right nor wrong.
        excused: (N,), detections that are not wrong where they are no true object.
        scores: (N,).
        least: pairs must overlap more.

    Returns:
        (N, 3) int64: steps of right and of wrong detections, and of true objects found by ignored ones. Where several
        of a frame have one score, the last of them has the step of all.

    Source: Geiger et al. 2012, the development kit of KITTI's object benchmark, `computeStatistics`.
    """
    steps = np.zeros((len(scores), 3), np.int64)
    for f in range(len(starts) - 1):
        t0, t1, d0, d1 = true_starts[f], true_starts[f + 1], found_starts[f], found_starts[f + 1]
        block = overlaps[starts[f] : starts[f + 1]].reshape((t1 - t0, d1 - d0))
        near = _near_something(block, least)
        for j in range(d1 - d0):
            # what is near no object changes no pair
            if not near[j] and not (found_ignored[d0 + j] or excused[d0 + j]):
                steps[d0 + j, 1] = 1
        rows = d0 + np.flatnonzero(near)
        _step_through(steps, rows, block[:, near], true_ignored[t0:t1], found_ignored, excused, scores, least)
    return steps


@kernel(
    "int64[::1](float64[::1], int64[::1], int64[::1], int64[::1], float64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def surest_matches(
    overlaps: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    scores: Float64Array,
    least: float,
) -> Int64Array:
    """Pair each true object, in their order, with the surest detection that overlaps it by more than `least`.

    Returns:
        (N,) int64, the true object of each detection, -1 for none.

    Source: as above.
    """
    matches = np.full(len(scores), _NONE, np.int64)
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(true_starts[f], true_starts[f + 1]):
            best = _NONE
            for j in range(found_starts[f], found_starts[f + 1]):
                if overlaps[k] > least and matches[j] < 0 and (best < 0 or scores[j] > scores[best]):
                    best = j
                k += 1
            if best >= 0:
                matches[best] = i
    return matches
