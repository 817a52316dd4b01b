"""How much likelier it is that boxes are of objects that are followed than that they are of other things."""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel


@njit(nogil=True, error_model="numpy", inline="always")
def _heavy(square, count, freedom):  # type: ignore[no-untyped-def]
    """Squares of deviations as heavy tails take them: near 0 as they are, far away as their logarithm."""
    return (freedom + count) * np.log1p(square / freedom)


@njit(nogil=True, error_model="numpy", inline="always")
def _may_be_one(a, i, b, j):  # type: ignore[no-untyped-def]
    """Whether classes are equal, of one family, or one of them says nothing."""
    if a[i, 0] == b[j, 0] or a[i, 0] < 0 or b[j, 0] < 0:
        return True
    return a[i, 1] == b[j, 1] and a[i, 1] >= 0


@njit(nogil=True, error_model="numpy", inline="always")
def _trace(matrices, i):  # type: ignore[no-untyped-def]
    return matrices[i, 0, 0] + matrices[i, 1, 1] + matrices[i, 2, 2]


@njit(nogil=True, error_model="numpy")
def _with_room(column, room):  # type: ignore[no-untyped-def]
    """The same numbers, and room for more behind them."""
    wider = np.empty(room, column.dtype)
    wider[: len(column)] = column
    return wider


@kernel(
    "Tuple((int64[::1], int64[::1], float64[::1]))(float64[:,::1], float64[:,:,::1], int64[:,::1], float64[::1], "
    "float64[:,::1], float64[:,:,::1], int64[:,::1], float64[::1], float64, float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def gains_in_space(
    locations: Float64Array,
    spreads: Float64Array,
    codes: Int64Array,
    expected: Float64Array,
    seen_positions: Float64Array,
    seen_spreads: Float64Array,
    seen_codes: Int64Array,
    seen_doubts: Float64Array,
    least_variance: float,
    freedom: float,
    most: float,
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Compare where objects are expected with where boxes are.

    Args:
        locations, spreads: (N, 3) and (N, 3, 3) [m, m²], of objects.
        codes: (N, 2), class and family, -1 for none.
        expected: (N,), logarithm of how many boxes of other things lie around each [1/m²].
        seen_positions, seen_spreads, seen_codes: the same of M boxes.
        seen_doubts: (M,), what is added for each box.
        least_variance: is added along each axis [m²].
        freedom: degrees of freedom of Student's distribution.
        most: how much images can add later; pairs that will stay below 0 are left out.

    Returns:
        The pairs that may be one: (K,) int64 objects, rising, (K,) int64 boxes, and (K,) float64 logarithms of ratios
        of likelihoods on the ground.
    """
    count = len(seen_positions)
    xs, ys, zs = seen_positions[:, 0].copy(), seen_positions[:, 1].copy(), seen_positions[:, 2].copy()
    reach = np.empty(count)
    for j in range(count):
        reach[j] = _trace(seen_spreads, j) + 3.0 * least_variance
    room, found = 4 * (len(locations) + count), 0
    rows, columns, gains = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room)
    near = np.empty(count, np.int64)
    for i in range(len(locations)):
        # no pair is worth more than one whose locations are known as well as can be; farther ones are hopeless
        best = most - expected[i] - np.log(2.0 * np.pi * least_variance)
        farthest = freedom * np.expm1(max(2.0 * best, 0.0) / (freedom + 3.0))
        own, nearby = _trace(spreads, i), 0
        for j in range(count):
            x, y, z = xs[j] - locations[i, 0], ys[j] - locations[i, 1], zs[j] - locations[i, 2]
            near[nearby] = j
            nearby += x * x + y * y + z * z <= farthest * (own + reach[j])
        if found + nearby > room:
            room = 2 * (found + nearby)
            rows, columns, gains = _with_room(rows, room), _with_room(columns, room), _with_room(gains, room)
        for k in range(nearby):
            j = near[k]
            if not _may_be_one(codes, i, seen_codes, j):
                continue
            x = seen_positions[j, 0] - locations[i, 0]
            y = seen_positions[j, 1] - locations[i, 1]
            z = seen_positions[j, 2] - locations[i, 2]
            a = spreads[i, 0, 0] + seen_spreads[j, 0, 0] + least_variance
            b = spreads[i, 0, 1] + seen_spreads[j, 0, 1]
            c = spreads[i, 0, 2] + seen_spreads[j, 0, 2]
            d = spreads[i, 1, 1] + seen_spreads[j, 1, 1] + least_variance
            e = spreads[i, 1, 2] + seen_spreads[j, 1, 2]
            f = spreads[i, 2, 2] + seen_spreads[j, 2, 2] + least_variance
            area = a * d - b * b
            # the adjugate of the symmetric matrix, row by row
            r, s, t = d * f - e * e, c * e - b * f, b * e - c * d
            whole = a * r + b * s + c * t
            square = x * x * r + y * y * (a * f - c * c) + z * z * area
            square += 2.0 * (x * y * s + x * z * t + y * z * (b * c - a * e))
            far = _heavy(square / whole, 3.0, freedom)
            gain = seen_doubts[j] - expected[i] - np.log(2.0 * np.pi) - 0.5 * (np.log(area) + far)
            if gain > -most:
                rows[found], columns[found], gains[found] = i, j, gain
                found += 1
    return rows[:found].copy(), columns[:found].copy(), gains[:found].copy()


@kernel(
    "void(int64[::1], int64[::1], float64[::1], float64[:,::1], float64[:,::1], boolean[::1], float64, float64, "
    "float64, float64)",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def add_gains_in_image(
    rows: Int64Array,
    columns: Int64Array,
    gains: Float64Array,
    foreseen: Float64Array,
    corners: Float64Array,
    measured: BoolArray,
    sigma: float,
    usual: float,
    least: float,
    freedom: float,
) -> None:
    """Add to gains what boxes in an image state.

    Args:
        rows, columns: (K,), pairs of objects and boxes.
        gains: (K,), are changed in place; -inf for what cannot be one.
        foreseen, corners: (N, 4) and (M, 4) [px], where objects are expected and where boxes are, NaN for none.
        measured: (M,), whether there is a box in space behind the one in the image.
        sigma: deviation of the share by which boxes of one object fail to overlap.
        usual: the share of overlap that says nothing.
        least: a box in the image alone that overlaps less is not of the object.
        freedom: degrees of freedom of Student's distribution.
    """
    neutral = _heavy(((1.0 - usual) / sigma) ** 2, 1.0, freedom)
    for k in range(len(gains)):
        i, j = rows[k], columns[k]
        area = (corners[j, 2] - corners[j, 0]) * (corners[j, 3] - corners[j, 1])
        if not area > 0.0:
            continue
        own = (foreseen[i, 2] - foreseen[i, 0]) * (foreseen[i, 3] - foreseen[i, 1])
        share = usual
        if own > 0.0:
            wide = min(foreseen[i, 2], corners[j, 2]) - max(foreseen[i, 0], corners[j, 0])
            high = min(foreseen[i, 3], corners[j, 3]) - max(foreseen[i, 1], corners[j, 1])
            common = max(wide, 0.0) * max(high, 0.0)
            share = common / (own + area - common)
            gains[k] += 0.5 * (neutral - _heavy(((1.0 - share) / sigma) ** 2, 1.0, freedom))
        if not measured[j] and (share < least or not own > 0.0):
            gains[k] = -np.inf
