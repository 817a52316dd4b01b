"""How far off boxes of a sweep are: the formulas, each a function of plain numbers, and the loop over boxes.

What a detector is like stands in a table of numbers, a row for each kind of object and the columns named below; which
kind a box is of says its row. `detections.noise` fills the table. The loop is in one module with the formulas, since a
compiled loop that is kept on disk knows the age of its own module only.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import BoolArray, Float64Array, Int64Array
from sceneloom.kernels.cache import kernel

LOW, HIGH, BASE = 0, 1, 2
"""The first columns of the table: how low and how high scores count, as logarithms of odds, and the logarithms of the
deviations of x, y, z along the axes of the box, length, width, height [m] and heading [rad], at score 0 and `USUAL`."""
BY_SCORE, BY_RANGE = BASE + 7, BASE + 14
"""How much those grow with the score, and with the logarithm of the range, seven columns each."""
AGREED = BASE + 21
"""By how much the covariances of middle and size of a box with a partner in the picture are multiplied."""
PICTURE = AGREED + 2
"""Deviations of the partner in the picture: of its middle across, of its middle upright and of its height, in pixels
and beside that as a share of its own size there, six columns."""
COLUMNS = PICTURE + 6

USUAL = 20.0
"""The range at which `BASE` holds [m]."""
NEAREST = 5.0
"""What is nearer counts as so far away [m]."""

_TABLE, _TOLD = "Array(float64, 2, 'C', readonly=True)", "Array(float64, 3, 'C', readonly=True)"


@njit(nogil=True, error_model="numpy", inline="always")
def _sigma(number, score, distance, kind, table):  # type: ignore[no-untyped-def]
    """Deviation of one of the seven numbers of a box; one whose score is no number is as uncertain as the lowest."""
    low, high = table[kind, LOW], table[kind, HIGH]
    told = min(max(score, low), high) if score == score else low  # noqa: PLR0124 - no number
    far = np.log(max(distance, NEAREST) / USUAL)
    return np.exp(
        table[kind, BASE + number]
        + table[kind, BY_SCORE + number] * told
        + table[kind, BY_RANGE + number] * far
    )


@njit(nogil=True, error_model="numpy", inline="always")
def _range(boxes, n):  # type: ignore[no-untyped-def]
    return np.sqrt(boxes[n, 0] ** 2 + boxes[n, 1] ** 2 + boxes[n, 2] ** 2)


@njit(nogil=True, error_model="numpy")
def _assume(boxes, n, score, kind, table, found):  # type: ignore[no-untyped-def]
    """Fill in a covariance whose deviations lie along the axes of the box."""
    distance = _range(boxes, n)
    along = _sigma(0, score, distance, kind, table) ** 2
    across = _sigma(1, score, distance, kind, table) ** 2
    cosine, sine = np.cos(boxes[n, 6]), np.sin(boxes[n, 6])
    for i in range(6):
        for k in range(6):
            found[n, i, k] = 0.0
    found[n, 0, 0] = along * cosine * cosine + across * sine * sine
    found[n, 1, 1] = along * sine * sine + across * cosine * cosine
    found[n, 0, 1] = found[n, 1, 0] = (along - across) * cosine * sine
    for k in range(2, 6):
        found[n, k, k] = _sigma(k, score, distance, kind, table) ** 2


@njit(nogil=True, error_model="numpy")
def _take(told, row, n, found, lower):  # type: ignore[no-untyped-def]
    """Fill in what a detector tells, made symmetric; say whether that is a covariance, by Cholesky's factor of it."""
    for i in range(6):
        for k in range(6):
            found[n, i, k] = (told[row, i, k] + told[row, k, i]) / 2.0
            if not np.isfinite(found[n, i, k]):
                return False
    for i in range(6):
        for k in range(i + 1):
            rest = found[n, i, k]
            for m in range(k):
                rest -= lower[i, m] * lower[k, m]
            if i == k:
                if not rest > 0.0:
                    return False
                lower[i, i] = np.sqrt(rest)
            else:
                lower[i, k] = rest / lower[k, k]
    return True


@kernel(
    f"Tuple((float64[:,:,::1], float64[::1], boolean[::1]))(float64[:,::1], float64[::1], {_TOLD}, int64[::1], "
    f"int64[::1], {_TABLE})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def box_covariances(
    boxes: Float64Array,
    scores: Float64Array,
    told: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
    table: Float64Array,
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Give the covariances of middles and sizes, and the variances of headings.

    Args:
        boxes: (N, 7), middle, size [m] and heading [rad], in the frame of the sensor.
        scores: (N,), logarithms of odds as the detector tells them; NaN for no numbers.
        told: what the detector tells, (A, 7, 7) of all of its boxes, or (0, 7, 7).
        rows: (N,), which of them these are.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).

    Returns:
        (N, 6, 6) float64 [m²]: middle in the frame of the boxes, then length, width, height; (N,) float64 [rad²], and
        (N,) bool, whether they are the detector's own.
    """
    found, lower = np.empty((len(boxes), 6, 6)), np.empty((6, 6))
    of_yaws, own = np.empty(len(boxes)), np.zeros(len(boxes), np.bool_)
    for n in range(len(boxes)):
        own[n] = len(told) > 0 and _take(told, rows[n], n, found, lower)
        if own[n]:
            of_yaws[n] = told[rows[n], 6, 6]
        else:
            _assume(boxes, n, scores[n], kinds[n], table, found)
        if not (own[n] and of_yaws[n] > 0.0 and np.isfinite(of_yaws[n])):
            of_yaws[n] = _sigma(6, scores[n], _range(boxes, n), kinds[n], table) ** 2
    return found, of_yaws, own


@kernel(
    f"void(float64[:,:,::1], int64[::1], boolean[::1], int64[::1], {_TABLE})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def widen_agreed(
    covariances: Float64Array, partners: Int64Array, own: BoolArray, kinds: Int64Array, table: Float64Array
) -> None:
    """Multiply the covariances of boxes with a partner.

    The update makes them as small as if both sensors erred independently.

    Args:
        covariances: (N, 6, 6), of middles and sizes; changed.
        partners: (N,), -1 for none.
        own: (N,), those of a detector that knows them stay.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).
    """
    for n in range(len(partners)):
        if partners[n] < 0 or own[n]:
            continue
        for i in range(6):
            for k in range(6):
                covariances[n, i, k] *= np.sqrt(
                    table[kinds[n], AGREED + i // 3] * table[kinds[n], AGREED + k // 3]
                )
