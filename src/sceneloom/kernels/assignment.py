"""The optimal assignment of rows to columns, for callers that are compiled themselves."""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel


@kernel(
    "int64(float64[:,::1], int64, float64[::1], float64[::1], int64[::1], int64[::1], float64[::1], boolean[::1], "
    "boolean[::1], int64[::1])",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def _shortest_path(
    costs: Float64Array,
    row: int,
    row_prices: Float64Array,
    column_prices: Float64Array,
    owners: Int64Array,
    before: Int64Array,
    lengths: Float64Array,
    seen_rows: BoolArray,
    seen_columns: BoolArray,
    open_columns: Int64Array,
) -> int:
    """Find the column without an owner that is nearest to a row over reduced costs; `before` tells the way back."""
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


@kernel("int64[::1](float64[:,::1])", nogil=True, cache=True, error_model="numpy")
def _cheapest(costs: Float64Array) -> Int64Array:
    """Give each row its column; there are at least as many columns as rows."""
    rows, columns = costs.shape
    row_prices, column_prices = np.zeros(rows), np.zeros(columns)
    owners, owned = np.full(columns, -1, np.int64), np.full(rows, -1, np.int64)
    before, open_columns = np.empty(columns, np.int64), np.empty(columns, np.int64)
    lengths = np.empty(columns)
    seen_rows, seen_columns = np.empty(rows, np.bool_), np.empty(columns, np.bool_)
    for row in range(rows):
        column = _shortest_path(
            costs,
            row,
            row_prices,
            column_prices,
            owners,
            before,
            lengths,
            seen_rows,
            seen_columns,
            open_columns,
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


@kernel("int64[::1](float64[:,::1])", nogil=True, cache=True, error_model="numpy")
def best_columns(gains: Float64Array) -> Int64Array:
    """Pair rows with columns so that the sum of their gains is the largest, as many pairs as can be.

    Args:
        gains: (N, M), finite.

    Returns:
        (N,) int64, the column of each row, -1 for rows without one (where there are more rows than columns).

    Source: Crouse 2016, "On implementing 2D rectangular assignment algorithms", with ties broken as by
    `scipy.optimize.linear_sum_assignment`.
    """
    rows, columns = gains.shape
    if rows == 0 or columns == 0:
        return np.full(rows, -1, np.int64)
    if rows <= columns:
        return _cheapest(-gains)
    turned = np.empty((columns, rows))
    for i in range(rows):
        for j in range(columns):
            turned[j, i] = -gains[i, j]
    paired = np.full(rows, -1, np.int64)
    owned = _cheapest(turned)
    for j in range(columns):
        paired[owned[j]] = j
    return paired


@njit(nogil=True, error_model="numpy", inline="always")
def _root(parents, place):  # type: ignore[no-untyped-def]
    """The first of the group of a place, and a shorter way there."""
    while parents[place] != place:
        parents[place] = parents[parents[place]]
        place = parents[place]
    return place


@njit(nogil=True, error_model="numpy")
def _groups(rows, columns, row_count, column_count):  # type: ignore[no-untyped-def]
    """The order of pairs by what hangs together, and where each group of them begins."""
    parents = np.arange(row_count + column_count)
    for k in range(len(rows)):
        first, second = _root(parents, rows[k]), _root(parents, row_count + columns[k])
        parents[max(first, second)] = min(first, second)
    names = np.full(row_count + column_count, -1, np.int64)
    groups, count = np.empty(len(rows), np.int64), 0
    for k in range(len(rows)):
        root = _root(parents, rows[k])
        if names[root] < 0:
            names[root] = count
            count += 1
        groups[k] = names[root]
    starts = np.zeros(count + 1, np.int64)
    for k in range(len(rows)):
        starts[groups[k] + 1] += 1
    starts[:] = np.cumsum(starts)
    order, filled = np.empty(len(rows), np.int64), starts[:count].copy()
    for k in range(len(rows)):
        order[filled[groups[k]]] = k
        filled[groups[k]] += 1
    return order, starts


@kernel(
    "int64[::1](int64[::1], int64[::1], float64[::1], int64, int64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def best_pairs(
    rows: Int64Array, columns: Int64Array, gains: Float64Array, row_count: int, column_count: int
) -> Int64Array:
    """Pair rows with columns so that the sum of their gains is the largest; what gains nothing is no pair.

    What does not hang together by pairs is solved apart.

    Args:
        rows, columns: (K,), the pairs that there may be, each once.
        gains: (K,), of each.
        row_count, column_count: how many rows and columns there are.

    Returns:
        (row_count,) int64, the column of each row, -1 for none.
    """
    worth = np.flatnonzero(gains > 0.0)
    rows, columns, gains = rows[worth], columns[worth], gains[worth]
    order, starts = _groups(rows, columns, row_count, column_count)
    paired, places = np.full(row_count, -1, np.int64), np.full(row_count + column_count, -1, np.int64)
    own_rows, own_columns = np.empty(row_count, np.int64), np.empty(column_count, np.int64)
    for group in range(len(starts) - 1):
        high, wide, first, last = 0, 0, starts[group], starts[group + 1]
        if last - first == 1:
            paired[rows[order[first]]] = columns[order[first]]
            continue
        for n in range(first, last):
            row, column = rows[order[n]], columns[order[n]]
            if places[row] < 0:
                places[row], own_rows[high] = high, row
                high += 1
            if places[row_count + column] < 0:
                places[row_count + column], own_columns[wide] = wide, column
                wide += 1
        table = np.zeros((high, wide))
        for n in range(first, last):
            k = order[n]
            table[places[rows[k]], places[row_count + columns[k]]] = gains[k]
        found = best_columns(table)
        for i in range(high):
            if found[i] >= 0 and table[i, found[i]] > 0.0:
                paired[own_rows[i]] = own_columns[found[i]]
    return paired


@kernel("Tuple((int64[::1], int64[::1]))(float64[:,::1])", nogil=True, cache=True, error_model="numpy")
def best_partners(gains: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Pair the rows of a table with its columns as `best_pairs` does.

    Args:
        gains: (N, M), not NaN.

    Returns:
        (N,) int64, the column of each row, and (M,) int64, the row of each column, -1 for none.
    """
    high, wide = gains.shape
    count = 0
    for i in range(high):
        for j in range(wide):
            count += gains[i, j] > 0.0
    rows, columns, worth = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    k = 0
    for i in range(high):
        for j in range(wide):
            if gains[i, j] > 0.0:
                rows[k], columns[k], worth[k] = i, j, gains[i, j]
                k += 1
    of_rows, of_columns = best_pairs(rows, columns, worth, high, wide), np.full(wide, -1, np.int64)
    for i in range(high):
        if of_rows[i] >= 0:
            of_columns[of_rows[i]] = i
    return of_rows, of_columns
