"""The optimal assignment of rows to columns, for callers that are compiled themselves."""

import numpy as np

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
    """Find the column without an owner that is nearest to a row over reduced costs; `before` reports the way back."""
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
    rotated = np.empty((columns, rows))
    for i in range(rows):
        for j in range(columns):
            rotated[j, i] = -gains[i, j]
    paired = np.full(rows, -1, np.int64)
    owned = _cheapest(rotated)
    for j in range(columns):
        paired[owned[j]] = j
    return paired
