"""Objects followed through time, held against the true ones frame by frame, as figures of trackers need it.

Rows are sorted by frame, `starts` and flat pairs are those of `frame_overlaps`; the true objects are the rows of each
frame's pairs. Ids are numbers from 0 without gaps.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.assignment import best_columns
from sceneloom.kernels.cache import kernel

_EPSILON = float(np.finfo(np.float64).eps)
"""Similarities that are less below a threshold than this reach it, as in TrackEval."""


@njit(nogil=True, error_model="numpy", inline="always")
def _block(flat, starts, frame, rows, columns):  # type: ignore[no-untyped-def]
    """The pairs of one frame, (rows, columns)."""
    return flat[starts[frame] : starts[frame + 1]].reshape((rows, columns))


@kernel(
    "Tuple((int64[::1], int64[::1]))(float64[::1], int64[::1], int64[::1], int64[::1], float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def most_similar_pairs(
    similarities: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    least: float,
) -> tuple[Int64Array, Int64Array]:
    """Pair objects of each frame so that the sum of similarities is the largest.

    Args:
        similarities: (P,), of the pairs.
        true_starts, found_starts, starts: (F + 1,), of true objects, found ones and pairs.
        least: pairs that are less similar are none.

    Returns:
        (N,) int64, the true object of each found one, -1 for none; (M,) int64, the found one of each true one.
    """
    of_found = np.full(found_starts[-1], -1, np.int64)
    of_true = np.full(true_starts[-1], -1, np.int64)
    for f in range(len(starts) - 1):
        rows = true_starts[f + 1] - true_starts[f]
        columns = found_starts[f + 1] - found_starts[f]
        if rows == 0 or columns == 0:
            continue
        gains = _block(similarities, starts, f, rows, columns).copy()
        for i in range(rows):
            for j in range(columns):
                if gains[i, j] < least - _EPSILON:
                    gains[i, j] = 0.0
        paired = best_columns(gains)
        for i in range(rows):
            if paired[i] >= 0 and gains[i, paired[i]] > _EPSILON:
                of_true[true_starts[f] + i] = found_starts[f] + paired[i]
                of_found[found_starts[f] + paired[i]] = true_starts[f] + i
    return of_found, of_true


@kernel(
    "float64[::1](float64[::1], int64[::1], int64[::1], int64[::1], boolean[::1], boolean[::1])",
    nogil=True,
    cache=True,
)
def kept_pairs(
    values: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    true_kept: BoolArray,
    found_kept: BoolArray,
) -> Float64Array:
    """Give the values of those pairs both of whose objects are kept, in the order in which they stood."""
    kept = np.empty(len(values))
    count = 0
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(true_starts[f], true_starts[f + 1]):
            for j in range(found_starts[f], found_starts[f + 1]):
                if true_kept[i] and found_kept[j]:
                    kept[count] = values[k]
                    count += 1
                k += 1
    return kept[:count].copy()


@kernel(
    "float64[:,::1](float64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64, int64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def shared_frames(
    similarities: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    true_ids: Int64Array,
    found_ids: Int64Array,
    true_count: int,
    found_count: int,
) -> Float64Array:
    """Report in how many frames a true and a found object may be the same one.

    Returns:
        (G, E) float64: the sum over frames of similarity / (sums over row and column - similarity).

    Source: Luiten et al. 2021, "HOTA", section 6, as TrackEval computes it.
    """
    shared = np.zeros((true_count, found_count))
    for f in range(len(starts) - 1):
        rows = true_starts[f + 1] - true_starts[f]
        columns = found_starts[f + 1] - found_starts[f]
        block = _block(similarities, starts, f, rows, columns)
        of_rows, of_columns = np.zeros(rows), np.zeros(columns)
        for i in range(rows):
            for j in range(columns):
                of_rows[i] += block[i, j]
                of_columns[j] += block[i, j]
        for i in range(rows):
            for j in range(columns):
                whole = of_columns[j] + of_rows[i] - block[i, j]
                if whole > _EPSILON:
                    true_id, found_id = true_ids[true_starts[f] + i], found_ids[found_starts[f] + j]
                    shared[true_id, found_id] += block[i, j] / whole
    return shared


@kernel(
    "Tuple((int64[::1], int64[::1], float64[::1]))(float64[::1], int64[::1], int64[::1], int64[::1], int64[::1], "
    "int64[::1], float64[:,::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def aligned_pairs(
    similarities: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    true_ids: Int64Array,
    found_ids: Int64Array,
    alignments: Float64Array,
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Pair objects of each frame so that the sum of similarity times alignment of their ids is the largest.

    Args:
        alignments: (G, E), how well a true and a found object fit over the whole sequence.

    Returns:
        (K,) int64 ids of the true objects, those of the found ones, and (K,) float64 similarities, all above 0.
    """
    most = min(len(true_ids), len(found_ids))
    firsts, seconds, values = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    count = 0
    for f in range(len(starts) - 1):
        rows = true_starts[f + 1] - true_starts[f]
        columns = found_starts[f + 1] - found_starts[f]
        if rows == 0 or columns == 0:
            continue
        block = _block(similarities, starts, f, rows, columns)
        gains = np.empty((rows, columns))
        for i in range(rows):
            for j in range(columns):
                aligned = alignments[true_ids[true_starts[f] + i], found_ids[found_starts[f] + j]]
                gains[i, j] = aligned * block[i, j]
        paired = best_columns(gains)
        for i in range(rows):
            j = paired[i]
            if j >= 0 and block[i, j] > 0.0:
                firsts[count] = true_ids[true_starts[f] + i]
                seconds[count] = found_ids[found_starts[f] + j]
                values[count] = block[i, j]
                count += 1
    return firsts[:count].copy(), seconds[:count].copy(), values[:count].copy()


@kernel(
    "Tuple((int64, int64, float64, int64[::1], int64[::1]))(float64[::1], int64[::1], int64[::1], int64[::1], "
    "int64[::1], int64[::1], int64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def followed_pairs(
    similarities: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    true_ids: Int64Array,
    found_ids: Int64Array,
    true_count: int,
    least: float,
) -> tuple[int, int, float, Int64Array, Int64Array]:
    """Pair objects of each frame, those of the frame before first, and count what becomes of each true one.

    Frames in which one side is empty end nothing: the pairs before them go on.

    Args:
        true_count: of ids.
        least: pairs that are less similar are none.

    Returns:
        How many were paired, how often a true object changed the found one it is paired with, the sum of the pairs'
        similarities, (G,) int64 in how many frames each true object was paired, and how often it began to be.

    Source: Bernardin and Stiefelhagen 2008, "CLEAR MOT", as TrackEval computes it.
    """
    paired_count, switches, total = 0, 0, 0.0
    frames, begun = np.zeros(true_count, np.int64), np.zeros(true_count, np.int64)
    last, before = np.full(true_count, -1, np.int64), np.full(true_count, -1, np.int64)
    now = np.empty(true_count, np.int64)
    for f in range(len(starts) - 1):
        rows = true_starts[f + 1] - true_starts[f]
        columns = found_starts[f + 1] - found_starts[f]
        if rows == 0 or columns == 0:
            continue
        block = _block(similarities, starts, f, rows, columns)
        gains = np.zeros((rows, columns))
        for i in range(rows):
            went_on = before[true_ids[true_starts[f] + i]]
            for j in range(columns):
                if block[i, j] >= least - _EPSILON:
                    same = found_ids[found_starts[f] + j] == went_on
                    gains[i, j] = block[i, j] + (1000.0 if same else 0.0)
        paired = best_columns(gains)
        now[:] = -1
        for i in range(rows):
            j = paired[i]
            if j < 0 or gains[i, j] <= _EPSILON:
                continue
            true_id, found_id = true_ids[true_starts[f] + i], found_ids[found_starts[f] + j]
            switches += last[true_id] >= 0 and last[true_id] != found_id
            last[true_id] = now[true_id] = found_id
            begun[true_id] += before[true_id] < 0
            frames[true_id] += 1
            paired_count += 1
            total += block[i, j]
        before[:] = now
    return paired_count, switches, total, frames, begun


@kernel(
    "float64[:,::1](float64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64, int64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def similar_frames(
    similarities: Float64Array,
    true_starts: Int64Array,
    found_starts: Int64Array,
    starts: Int64Array,
    true_ids: Int64Array,
    found_ids: Int64Array,
    true_count: int,
    found_count: int,
    least: float,
) -> Float64Array:
    """Count the frames in which a true and a found object are similar, (G, E) float64 of whole numbers."""
    counts = np.zeros((true_count, found_count))
    for f in range(len(starts) - 1):
        k = starts[f]
        for i in range(true_starts[f], true_starts[f + 1]):
            for j in range(found_starts[f], found_starts[f + 1]):
                if similarities[k] >= least:
                    counts[true_ids[i], found_ids[j]] += 1.0
                k += 1
    return counts


@kernel(
    "boolean[::1](float64[::1], int64[::1], int64[::1], int64[::1], float64)",
    nogil=True,
    cache=True,
)
def reached_columns(
    values: Float64Array,
    row_starts: Int64Array,
    column_starts: Int64Array,
    starts: Int64Array,
    least: float,
) -> BoolArray:
    """Report of which columns a pair has a value above `least`, (N,) bool."""
    reached = np.zeros(column_starts[-1], np.bool_)
    for f in range(len(starts) - 1):
        k = starts[f]
        for _ in range(row_starts[f], row_starts[f + 1]):
            for j in range(column_starts[f], column_starts[f + 1]):
                if values[k] > least:
                    reached[j] = True
                k += 1
    return reached
