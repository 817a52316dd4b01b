"""The 16 numbers of `extrinsic_matrix`: row after row, or column after column."""

from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import CalibrationError

_TOLERANCE = 1e-6
_END = np.array([0.0, 0.0, 0.0, 1.0])


class MatrixLayout(StrEnum):
    """In which order the numbers of a matrix stand."""

    ROW_MAJOR = "row-major"
    COLUMN_MAJOR = "column-major"


def possible_layouts(numbers: Sequence[float]) -> tuple[MatrixLayout, ...]:
    """Report in which layouts 16 numbers are a transform; both where its translation is zero.

    A transform ends with the row 0 0 0 1, which stands last in row-major order and is every fourth number in
    column-major order.

    Raises:
        CalibrationError: they are not 16 finite numbers, or a transform in neither layout.

    Source: table 3 of DB34/T 4101-2022, whose example has its translation in the last row.
    """
    given = np.asarray(numbers, np.float64).reshape(-1)
    if given.shape != (16,) or not np.isfinite(given).all():
        raise CalibrationError(f"extrinsic_matrix of {given.size} numbers; expected 16 finite ones")
    square = given.reshape(4, 4)
    ends = {MatrixLayout.ROW_MAJOR: square[3], MatrixLayout.COLUMN_MAJOR: square[:, 3]}
    found = tuple(layout for layout, end in ends.items() if np.abs(end - _END).max() <= _TOLERANCE)
    if not found:
        raise CalibrationError(
            f"extrinsic_matrix with the last row {square[3].tolist()} and the last column {square[:, 3].tolist()}; "
            "expected one of them to be 0 0 0 1"
        )
    return found


def matrix_of(numbers: Sequence[float], layout: MatrixLayout) -> Float64Array:
    """Arrange 16 numbers of a layout as a (4, 4) float64 matrix with the translation in its last column."""
    square = np.asarray(numbers, np.float64).reshape(4, 4)
    return square.copy() if layout is MatrixLayout.ROW_MAJOR else square.T.copy()


def numbers_of(matrix: Float64Array, layout: MatrixLayout = MatrixLayout.COLUMN_MAJOR) -> tuple[float, ...]:
    """Give the 16 numbers of a (4, 4) transform, in the standard's own layout unless stated otherwise."""
    ordered = matrix if layout is MatrixLayout.ROW_MAJOR else matrix.T
    return tuple(ordered.reshape(-1).tolist())
