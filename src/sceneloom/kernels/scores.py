"""Scores of detections and tracks against the truth, frame by frame, and the optimal assignment that they need.

Rows are sorted by frame, `true_starts`, `found_starts`, `starts` (F + 1,) and flat pairs (P,) are as in
`kernels.overlaps`; the true objects are the rows of each frame's pairs. Ids are numbers from 0 without gaps.
"""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.signatures import inlined


@kernel(
    "int64(float64[:,::1], int64, float64[::1], float64[::1], int64[::1], int64[::1], float64[::1], boolean[::1], "
    "boolean[::1], int64[::1])"
)
def _shortest_path(
    costs: Float64Array, row: int, row_prices: Float64Array, column_prices: Float64Array, owners: Int64Array,
    before: Int64Array, lengths: Float64Array, seen_rows: BoolArray, seen_columns: BoolArray, open_columns: Int64Array,
) -> int:  # fmt: skip
    """Find the column without an owner that is nearest to a row over reduced costs; `before` gives the path back."""
    count = costs.shape[1]
    for j in range(count):
        # from the last to the first, so that equal costs end in the first columns
        open_columns[j] = count - 1 - j
        lengths[j] = np.inf
        seen_columns[j] = False
    seen_rows[:] = False
    left, reached = count, 0.0
    while True:
        seen_rows[row] = True
        nearest, least = -1, np.inf
        for k in range(left):
            j = open_columns[k]
            length = reached + costs[row, j] - row_prices[row] - column_prices[j]
            if length < lengths[j]:
                lengths[j] = length
                before[j] = row
            if lengths[j] < least or (lengths[j] == least and owners[j] < 0):
                nearest, least = k, lengths[j]
        column = int(open_columns[nearest])
        reached = least
        seen_columns[column] = True
        left -= 1
        open_columns[nearest] = open_columns[left]
        if owners[column] < 0:
            return column
        row = owners[column]


@kernel("int64[::1](float64[:,::1])")
def _cheapest(costs: Float64Array) -> Int64Array:
    """The column of each row; there are at least as many columns as rows."""
    rows, columns = costs.shape
    row_prices, column_prices = np.zeros(rows), np.zeros(columns)
    owners, owned = np.full(columns, -1, np.int64), np.full(rows, -1, np.int64)
    before, open_columns = np.empty(columns, np.int64), np.empty(columns, np.int64)
    lengths = np.empty(columns)
    seen_rows, seen_columns = np.empty(rows, np.bool_), np.empty(columns, np.bool_)
    for row in range(rows):
        column = _shortest_path(
            costs, row, row_prices, column_prices, owners, before, lengths, seen_rows, seen_columns, open_columns
        )
        reached = lengths[column]
        for i in range(rows):
            if seen_rows[i]:
                row_prices[i] += reached if i == row else reached - lengths[owned[i]]
        for j in range(columns):
            if seen_columns[j]:
                column_prices[j] -= reached - lengths[j]
        while True:
            i = before[column]
            owners[column] = i
            owned[i], column = column, owned[i]
            if i == row:
                break
    return owned


@kernel("int64[::1](float64[:,::1])")
def best_columns(gains: Float64Array) -> Int64Array:
    """Pair rows with columns so that the sum of their gains is the largest, as many pairs as can be.

    `gains` (N, M), finite. Returns (N,) int64, the column of each row, -1 for rows without one (where there are more
    rows than columns).

    Source: Crouse 2016, "On implementing 2D rectangular assignment algorithms", with ties broken as by
    `scipy.optimize.linear_sum_assignment`.
    """
    rows, columns = gains.shape
    if rows == 0 or columns == 0:
        return np.full(rows, -1, np.int64)
    if rows <= columns:
        return _cheapest(-gains)
    rotated = np.empty((columns, rows))
    for i in range(rows):
        for j in range(columns):
            rotated[j, i] = -gains[i, j]
    paired = np.full(rows, -1, np.int64)
    owned = _cheapest(rotated)
    for j in range(columns):
        paired[owned[j]] = j
    return paired


_NONE = -1


@inlined
def _most_overlapping(overlaps, i, chosen, taken, ignored, least):  # type: ignore[no-untyped-def]
    """The detection that overlaps a true object most; one that is ignored only if there is no other."""
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
    "boolean[::1])"
)
def _counted(
    overlaps: Float64Array, chosen: BoolArray, true_ignored: BoolArray, found_ignored: BoolArray, excused: BoolArray,
    least: float, taken: BoolArray,
) -> tuple[int, int, int]:  # fmt: skip
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


@kernel("boolean[::1](float64[:,::1], float64)")
def _near_something(overlaps: Float64Array, least: float) -> BoolArray:
    """Which detections of a frame overlap a true object by more than `least`."""
    near = np.zeros(overlaps.shape[1], np.bool_)
    for i in range(overlaps.shape[0]):
        for j in range(overlaps.shape[1]):
            if overlaps[i, j] > least:
                near[j] = True
    return near


@kernel(
    "void(int64[:,::1], int64[::1], float64[:,::1], boolean[::1], boolean[::1], boolean[::1], float64[::1], float64)"
)
def _step_through(
    steps: Int64Array, rows: Int64Array, overlaps: Float64Array, true_ignored: BoolArray, found_ignored: BoolArray,
    excused: BoolArray, scores: Float64Array, least: float,
) -> None:  # fmt: skip
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
    "float64[::1], float64)"
)
def score_steps(
    overlaps: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array,
    true_ignored: BoolArray, found_ignored: BoolArray, excused: BoolArray, scores: Float64Array, least: float,
) -> Int64Array:  # fmt: skip
    """Changes of the counts when the threshold of the score falls to that of each detection.

    With each threshold the objects are paired anew: each true one, in their order, with the detection that overlaps it
    most.

    Args:
        overlaps: (P,), of the pairs.
        true_ignored: (T,), true objects that need not be found.
        found_ignored: (N,), detections that are neither right nor wrong.
        excused: (N,), detections that are not wrong where they are no true object.
        scores: (N,).
        least: pairs must overlap more.

    Returns:
        (N, 3) int64: changes of right and of wrong detections, and of true objects found by ignored ones. Where several
        of a frame have one score, the last of them has the change of all.

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


@kernel("int64[::1](float64[::1], int64[::1], int64[::1], int64[::1], float64[::1], float64)")
def surest_matches(
    overlaps: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array, scores: Float64Array,
    least: float,
) -> Int64Array:  # fmt: skip
    """Pair each true object, in their order, with the most confident detection that overlaps it by more than `least`.

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


_EPSILON = float(np.finfo(np.float64).eps)
"""Similarities that are less below a threshold than this reach it, as in TrackEval."""


@inlined
def _block(flat, starts, frame, rows, columns):  # type: ignore[no-untyped-def]
    """The pairs of one frame, (rows, columns)."""
    return flat[starts[frame] : starts[frame + 1]].reshape((rows, columns))


@kernel("Tuple((int64[::1], int64[::1]))(float64[::1], int64[::1], int64[::1], int64[::1], float64)")
def most_similar_pairs(
    similarities: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array, least: float
) -> tuple[Int64Array, Int64Array]:
    """Pair objects of each frame so that the sum of similarities is the largest.

    `similarities` (P,), of the pairs; `true_starts`, `found_starts`, `starts` (F + 1,), of true objects, found ones and
    pairs; `least`: pairs that are less similar are none. Returns (N,) int64, the true object of each found one, -1 for
    none; (M,) int64, the found one of each true one.
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


@kernel("float64[::1](float64[::1], int64[::1], int64[::1], int64[::1], boolean[::1], boolean[::1])")
def kept_pairs(
    values: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array, true_kept: BoolArray,
    found_kept: BoolArray,
) -> Float64Array:  # fmt: skip
    """The values of those pairs both of whose objects are kept, in their order."""
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


@kernel("float64[:,::1](float64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64, int64)")
def shared_frames(
    similarities: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array,
    true_ids: Int64Array, found_ids: Int64Array, true_count: int, found_count: int,
) -> Float64Array:  # fmt: skip
    """The number of frames in which a true and a found object may be the same one.

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
    "int64[::1], float64[:,::1])"
)
def aligned_pairs(
    similarities: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array,
    true_ids: Int64Array, found_ids: Int64Array, alignments: Float64Array,
) -> tuple[Int64Array, Int64Array, Float64Array]:  # fmt: skip
    """Pair objects of each frame so that the sum of similarity times alignment of their ids is the largest.

    `alignments` (G, E), how well a true and a found object fit over the whole sequence. Returns (K,) int64 ids of the
    true objects, those of the found ones, and (K,) float64 similarities, all above 0.
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
    "int64[::1], int64[::1], int64, float64)"
)
def followed_pairs(
    similarities: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array,
    true_ids: Int64Array, found_ids: Int64Array, true_count: int, least: float,
) -> tuple[int, int, float, Int64Array, Int64Array]:  # fmt: skip
    """Pair objects of each frame, continuing the pairs of the frame before, and count what becomes of each true one.

    Frames in which one side is empty end nothing: the pairs before them go on.

    `true_count`: of ids; `least`: pairs that are less similar are none. Returns how many were paired, how often a true
    object changed the found one it is paired with, the sum of the pairs' similarities, (G,) int64 in how many frames
    each true object was paired, and how often it began to be.

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
    "float64[:,::1](float64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], int64, int64, float64)"
)
def similar_frames(
    similarities: Float64Array, true_starts: Int64Array, found_starts: Int64Array, starts: Int64Array,
    true_ids: Int64Array, found_ids: Int64Array, true_count: int, found_count: int, least: float,
) -> Float64Array:  # fmt: skip
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


@kernel("boolean[::1](float64[::1], int64[::1], int64[::1], int64[::1], float64)")
def reached_columns(
    values: Float64Array, row_starts: Int64Array, column_starts: Int64Array, starts: Int64Array, least: float
) -> BoolArray:
    """Which columns have a pair with a value above `least`, (N,) bool."""
    reached = np.zeros(column_starts[-1], np.bool_)
    for f in range(len(starts) - 1):
        k = starts[f]
        for _ in range(row_starts[f], row_starts[f + 1]):
            for j in range(column_starts[f], column_starts[f + 1]):
                if values[k] > least:
                    reached[j] = True
                k += 1
    return reached
