"""How far off boxes of a sweep are: the formulas, each a function of plain numbers, and the loop over boxes.

What a detector is like stands in a table of numbers, a row for each kind of object and the columns named below; which
kind a box is of says its row. `detections.noise` fills the table. The loop is in one module with the formulas, since a
compiled loop that is kept on disk knows the age of its own module only.
"""

import numpy as np
from numba import njit

from sceneloom.arrays import Float64Array, Int64Array

CENTER_SHARE, CENTER_LEAST, SIZE_SHARE, SIZE_LEAST, RANGE_SCALE = range(5)
"""The columns of the table: deviation per metre of size and beside it [m], and the range at which both doubled [m]."""
COLUMNS = 5

_TABLE, _TOLD = "Array(float64, 2, 'C', readonly=True)", "Array(float64, 3, 'C', readonly=True)"


@njit(nogil=True, error_model="numpy", inline="always")
def _center_sigma(side, distance, kind, table):  # type: ignore[no-untyped-def]
    """Deviation of a middle along an axis along which the box is so long [m]."""
    return (table[kind, CENTER_SHARE] * side + table[kind, CENTER_LEAST]) * (
        1.0 + distance / table[kind, RANGE_SCALE]
    )


@njit(nogil=True, error_model="numpy", inline="always")
def _size_sigma(side, distance, kind, table):  # type: ignore[no-untyped-def]
    """Deviation of a size [m]."""
    return (table[kind, SIZE_SHARE] * side + table[kind, SIZE_LEAST]) * (
        1.0 + distance / table[kind, RANGE_SCALE]
    )


@njit(nogil=True, error_model="numpy")
def _assume(boxes, n, kind, table, found):  # type: ignore[no-untyped-def]
    """Fill in a covariance whose deviations lie along the axes of the box."""
    distance = np.sqrt(boxes[n, 0] ** 2 + boxes[n, 1] ** 2 + boxes[n, 2] ** 2)
    along = _center_sigma(boxes[n, 3], distance, kind, table) ** 2
    across = _center_sigma(boxes[n, 4], distance, kind, table) ** 2
    cosine, sine = np.cos(boxes[n, 6]), np.sin(boxes[n, 6])
    for i in range(6):
        for k in range(6):
            found[n, i, k] = 0.0
    found[n, 0, 0] = along * cosine * cosine + across * sine * sine
    found[n, 1, 1] = along * sine * sine + across * cosine * cosine
    found[n, 0, 1] = found[n, 1, 0] = (along - across) * cosine * sine
    found[n, 2, 2] = _center_sigma(boxes[n, 5], distance, kind, table) ** 2
    for k in range(3, 6):
        found[n, k, k] = _size_sigma(boxes[n, k], distance, kind, table) ** 2


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


@njit(
    f"float64[:,:,::1](float64[:,::1], {_TOLD}, int64[::1], int64[::1], {_TABLE})",
    nogil=True,
    cache=True,
    error_model="numpy",
)
def center_and_size_covariances(
    boxes: Float64Array,
    told: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
    table: Float64Array,
) -> Float64Array:
    """Give the covariances of middles and sizes.

    Args:
        boxes: (N, 7), middle, size [m] and heading [rad], in the frame of the sensor.
        told: what the detector tells, (A, 7, 7) of all of its boxes, or (0, 7, 7).
        rows: (N,), which of them these are.
        kinds: (N,), rows of the table.
        table: (K, COLUMNS).

    Returns:
        (N, 6, 6) float64 [m²]: middle in the frame of the boxes, then length, width, height.
    """
    found, lower = np.empty((len(boxes), 6, 6)), np.empty((6, 6))
    for n in range(len(boxes)):
        if len(told) == 0 or not _take(told, rows[n], n, found, lower):
            _assume(boxes, n, kinds[n], table, found)
    return found
