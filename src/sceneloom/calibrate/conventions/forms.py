"""The orders in which people write an extrinsic down: matrices by rows or columns, quaternions, angles."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.euler import AngleUnit, rotation_from_cuboid_angles
from sceneloom.geometry.rotations import matrix_from_quaternion, nearest_rotation

_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])
_LAST_ROW_TOLERANCE = 1e-6
_ROTATION_TOLERANCE = 1e-2
_NORM_TOLERANCE = 1e-2
_FULL_TURN_DEG = 360.0
_FULL_TURN = 2 * np.pi + 1e-6

Built = tuple[Float64Array, Float64Array]
"""Rotation (3, 3) and translation (3,)."""


@dataclass(frozen=True, slots=True)
class Form:
    """One order of numbers.

    Attributes:
        count: how many numbers it takes.
        choices: what it decides, name to value: "layout", "order of parts", "quaternion", "angles", "order of angles".
        build: rotation and translation out of the numbers, None where they are no such thing.
        apart: whether nine numbers of a rotation come first, and three of a translation that stood beside it.
    """

    count: int
    choices: Mapping[str, str]
    build: Callable[[Float64Array], Built | None] = field(compare=False)
    apart: bool = False


def _rotation(matrix: Float64Array) -> Float64Array | None:
    """Give the nearest rotation of a rounded one, None for a matrix that is none."""
    rotation, error = nearest_rotation(matrix)
    return rotation if error <= _ROTATION_TOLERANCE else None


def _from_matrix(shape: tuple[int, int], *, columns: bool) -> Callable[[Float64Array], Built | None]:
    """Build out of 4x4, 3x4 or 3x3 numbers, written row after row or column after column."""

    def build(numbers: Float64Array) -> Built | None:
        matrix = numbers.reshape(shape[::-1]).T if columns else numbers.reshape(shape)
        if shape[0] == 4 and np.abs(matrix[3] - _LAST_ROW).max() > _LAST_ROW_TOLERANCE:
            return None
        rotation = _rotation(matrix[:3, :3])
        translation = matrix[:3, 3] if shape[1] == 4 else np.zeros(3)
        return None if rotation is None else (rotation, translation.copy())

    return build


def _from_parts(*, columns: bool) -> Callable[[Float64Array], Built | None]:
    def build(numbers: Float64Array) -> Built | None:
        square = numbers[:9].reshape(3, 3)
        rotation = _rotation(square.T if columns else square)
        return None if rotation is None else (rotation, numbers[9:].copy())

    return build


def _from_quaternion(
    *, translation_first: bool, scalar_first: bool
) -> Callable[[Float64Array], Built | None]:
    def build(numbers: Float64Array) -> Built | None:
        translation, quaternion = (
            (numbers[:3], numbers[3:]) if translation_first else (numbers[4:], numbers[:4])
        )
        if abs(float(np.linalg.norm(quaternion)) - 1.0) > _NORM_TOLERANCE:
            return None
        xyzw = np.roll(quaternion, -1) if scalar_first else quaternion
        return matrix_from_quaternion(xyzw / np.linalg.norm(xyzw)), translation.copy()

    return build


def _from_angles(
    *, translation_first: bool, degrees: bool, yaw_last: bool
) -> Callable[[Float64Array], Built | None]:
    """Build out of roll, pitch, yaw about x, y, z: Rz·Ry·Rx where the yaw comes last, else Rx·Ry·Rz."""

    def build(numbers: Float64Array) -> Built | None:
        translation, angles = (numbers[:3], numbers[3:]) if translation_first else (numbers[3:], numbers[:3])
        if np.abs(angles).max() > (_FULL_TURN_DEG if degrees else _FULL_TURN):
            return None
        unit = AngleUnit.DEGREES if degrees else AngleUnit.RADIANS
        order = "zyx" if yaw_last else "xyz"
        return rotation_from_cuboid_angles(angles, unit=unit, order=order), translation.copy()

    return build


def _matrix_forms() -> Iterator[Form]:
    for columns in (False, True):
        choices = MappingProxyType({"layout": "columns" if columns else "rows"})
        for shape in ((4, 4), (3, 4), (3, 3)):
            yield Form(shape[0] * shape[1], choices, _from_matrix(shape, columns=columns))
        yield Form(12, choices, _from_parts(columns=columns), apart=True)


def _parts(*, translation_first: bool) -> dict[str, str]:
    return {"order of parts": "translation first" if translation_first else "rotation first"}


def _quaternion_forms() -> tuple[Form, ...]:
    return tuple(
        Form(
            7,
            MappingProxyType(
                {
                    **_parts(translation_first=translation_first),
                    "quaternion": "w x y z" if scalar_first else "x y z w",
                }
            ),
            _from_quaternion(translation_first=translation_first, scalar_first=scalar_first),
        )
        for translation_first in (True, False)
        for scalar_first in (False, True)
    )


def _angle_forms() -> tuple[Form, ...]:
    return tuple(
        Form(
            6,
            MappingProxyType(
                {
                    **_parts(translation_first=translation_first),
                    "angles": "degrees" if degrees else "radians",
                    "order of angles": "Rz Ry Rx" if yaw_last else "Rx Ry Rz",
                }
            ),
            _from_angles(translation_first=translation_first, degrees=degrees, yaw_last=yaw_last),
        )
        for translation_first in (True, False)
        for degrees in (False, True)
        for yaw_last in (True, False)
    )


FORMS: tuple[Form, ...] = (*_matrix_forms(), *_quaternion_forms(), *_angle_forms())
"""All orders of numbers that are tried."""

COUNTS = frozenset(form.count for form in FORMS)
"""How many numbers an extrinsic may have."""
