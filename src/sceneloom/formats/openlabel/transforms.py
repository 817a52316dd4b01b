"""Transforms as OpenLABEL writes them.

Source: ASAM OpenLABEL 1.0.0, "transform_data"; the order of Euler angles where none is stated is that of its reference
program VCD: ZYX, the angle about z first in the list.
"""

from collections.abc import Sequence

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import DataError, SceneloomError
from sceneloom.formats.openlabel.document import Part
from sceneloom.formats.quaternion_lengths import lengths_of
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion, normalise_quaternion, quaternion_from_matrix

_GREATEST_MATRIX_ERROR = 0.01
_DEFAULT_SEQUENCE = "ZYX"


def read_transform(part: Part) -> RigidTransform:
    """Read a matrix of 4 times 4 by rows, or a quaternion x y z w or Euler angles with a translation.

    Raises:
        DataError: it is none of these, or its rotation is none.
    """
    matrix = part.get("matrix4x4")
    if matrix is not None:
        return _of_matrix(matrix, np.array(matrix.numbers((16,))).reshape(4, 4))
    translation = np.array(part.need("translation").numbers((3,)))
    quaternion = part.get("quaternion")
    if quaternion is not None:
        return RigidTransform.from_quaternion(
            translation, unit_quaternions([quaternion], [quaternion.numbers((4,))])[0]
        )
    angles = part.get("euler_angles")
    if angles is None:
        raise part.fault("matrix4x4, or quaternion or euler_angles with a translation")
    sequence = part.get("sequence")
    order = _DEFAULT_SEQUENCE if sequence is None else sequence.text()
    rotation = rotation_from_euler(part, angles.numbers((3,)), order)
    return RigidTransform.from_quaternion(translation, quaternion_from_matrix(rotation))


def _of_matrix(part: Part, matrix: Float64Array) -> RigidTransform:
    if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        raise part.fault("a matrix by rows, whose last row is 0 0 0 1")
    try:
        nearest, error = RigidTransform.nearest(matrix)
    except SceneloomError as fault:
        raise DataError(part.file, part.location, str(fault)) from fault
    if not error <= _GREATEST_MATRIX_ERROR:
        raise part.fault(f"a rotation; its rows are off by {error:.2g}")
    return nearest


def unit_quaternions(parts: Sequence[Part], values: list[list[float]]) -> Float64Array:
    """Quaternions x y z w, (N, 4), of length 1 within a hundredth; one part each, for messages.

    Raises:
        DataError: one has another length.
    """
    quaternions = np.array(values, np.float64)
    wrong = np.flatnonzero(lengths_of(quaternions)[1])
    if len(wrong):
        raise parts[int(wrong[0])].fault("a quaternion x y z w of length 1")
    return normalise_quaternion(quaternions)


def rotation_from_euler(part: Part, angles: list[float], sequence: str) -> Float64Array:
    """The product of three rotates about named axes, (3, 3): of "ZYX" and (a, b, c) it is Rz(a) Ry(b) Rx(c).

    Raises:
        DataError: the sequence is none.
    """
    if len(sequence) != 3 or not set(sequence.upper()) <= set("XYZ"):
        raise DataError(part.file, f"{part.location}.sequence", f"{sequence!r}; expected three of X, Y, Z")
    rotation = np.eye(3)
    for axis, angle in zip(sequence.upper(), angles, strict=True):
        half = np.zeros(4)
        half["XYZ".index(axis)], half[3] = np.sin(angle / 2), np.cos(angle / 2)
        rotation = rotation @ matrix_from_quaternion(half)
    return rotation
