"""Extrinsic matrices of a recording as rigid transforms."""

from collections.abc import Mapping

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import CalibrationError
from sceneloom.formats.ledger import Ledger
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import GREATEST_ERROR, SILENT_ERROR, nearest_rotation
from sceneloom.scene.warnings import WarningKind

MatrixNumbers = list[float | list[float]]
"""A matrix as JSON has it: rows of four (or three) numbers, or sixteen (or nine) numbers column by column."""

_SIZES: Mapping[int, int] = {16: 4, 9: 3}
"""By how many numbers a flat matrix has, its rows. Nine are a rotation alone.

Source: `imuToCameraMatrix` in `codegen/parameter_definitions.c` of HybVIO, which takes both column by column.
"""

_LAST_ROW_ERROR = 1e-6
_LARGEST_ELEMENT = 2.0
_FARTHEST = 1e6


def rigid_transform(numbers: MatrixNumbers, location: str, ledger: Ledger) -> RigidTransform:
    """Read a 4x4 matrix, rows of four or sixteen numbers column by column, or a 3x3 one, which moves nothing.

    Args:
        location: file and path of the matrix, for messages.
        ledger: takes the warning of a rotation that had to be normalised.

    Raises:
        CalibrationError: it is no such matrix, or not rigid.
    """
    matrix = _square(numbers, location)
    if not (np.abs(matrix[3] - [0, 0, 0, 1]) <= _LAST_ROW_ERROR).all():
        hint = "; is it transposed?" if (matrix[:3, 3] == 0).all() else ""
        raise CalibrationError(f"{location}: last row {matrix[3].tolist()}; expected 0, 0, 0, 1{hint}")
    _check_sizes(matrix, location)
    rotation, error = nearest_rotation(matrix[:3, :3])
    if not error <= GREATEST_ERROR:
        problem = "mirrored or singular" if error == float("inf") else f"off by {error:.2g}"
        raise CalibrationError(
            f"{location}: rotation {problem}; expected an orthonormal right-handed one within {GREATEST_ERROR:g}"
        )
    if error > SILENT_ERROR:
        message = f"rotation off by {error:.2g} (max abs of R Rᵀ - I); the nearest rotation was taken"
        ledger.note(WarningKind.REPAIRED, "rotation-normalised", location, message)
    return RigidTransform(rotation, matrix[:3, 3].copy())


def _check_sizes(matrix: Float64Array, location: str) -> None:
    """Refuse numbers so large that the arithmetic of the checks to come would overflow."""
    largest, farthest = np.abs(matrix[:3, :3]).max(), np.abs(matrix[:3, 3]).max()
    if largest > _LARGEST_ELEMENT:
        raise CalibrationError(f"{location}: rotation holds {largest:g}; expected numbers from -1 to 1")
    if farthest > _FARTHEST:
        raise CalibrationError(
            f"{location}: translation holds {farthest:g}; expected metres within {_FARTHEST:g}"
        )


def _square(numbers: MatrixNumbers, location: str) -> Float64Array:
    rows = [row for row in numbers if isinstance(row, list)]
    size = len(rows) or _SIZES.get(len(numbers), 0)
    if size not in _SIZES.values() or (rows and [len(row) for row in rows] != [size] * len(numbers)):
        shape = f"{len(numbers)} rows" if rows else f"{len(numbers)} numbers"
        raise CalibrationError(
            f"{location}: {shape}; expected 4 rows of 4 numbers, or 16 numbers column by column"
        )
    given = np.array(rows, np.float64) if rows else np.array(numbers, np.float64).reshape(size, size).T
    if not np.isfinite(given).all():
        raise CalibrationError(f"{location}: a number is not finite; expected 4x4 finite numbers")
    matrix = np.eye(4)
    matrix[:size, :size] = given
    return matrix
