"""Roll, pitch and yaw of cuboids: rotations about x, y and z, in either unit and any order of the product."""

from enum import StrEnum
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import Float64Array
from sceneloom.errors import check_choice

ORDERS = tuple("".join(order) for order in permutations("xyz"))
"""Orders of the product: "xyz" is Rx(roll) Ry(pitch) Rz(yaw), "zyx" is Rz(yaw) Ry(pitch) Rx(roll), …"""


class AngleUnit(StrEnum):
    """What the angles of a file are counted in."""

    DEGREES = "degrees"
    RADIANS = "radians"


def rotation_from_cuboid_angles(
    angles_rpy: ArrayLike, *, unit: AngleUnit | str = AngleUnit.DEGREES, order: str = "xyz"
) -> Float64Array:
    """Give the orientation of cuboids.

    Args:
        angles_rpy: (..., 3) roll about x, pitch about y and yaw about z, whatever the order.
        unit: what they are counted in.
        order: one of `ORDERS`; the matrices are multiplied in this order.

    Returns:
        (..., 3, 3) float64 rotation matrices.

    Raises:
        OptionError: the unit or the order is none of those known.

    Source: "Cuboid Annotation" of the SFS description leaves unit and order open; the defaults are those of
        the only public writer.
    """
    i, j, k, _ = _axes(order)
    angles = np.asarray(angles_rpy, np.float64) * _radians_per(unit)
    return _rotation(i, angles[..., i]) @ _rotation(j, angles[..., j]) @ _rotation(k, angles[..., k])


def cuboid_angles_from_rotation(
    rotation: ArrayLike, *, unit: AngleUnit | str = AngleUnit.DEGREES, order: str = "xyz"
) -> Float64Array:
    """Give (..., 3) roll, pitch and yaw of (..., 3, 3) rotation matrices.

    The angle about the middle axis lies within a quarter rotation, the others within half a rotation, of zero.
    Where the middle one is a quarter rotation, only the sum or difference of the others is determined.

    Raises:
        OptionError: the unit or the order is none of those known.

    Source: Shuster 1993, "A Survey of Attitude Representations", section on Euler angles. The last angle is
        read off after the first rotation is undone, which loses no digits near a quarter rotation.
    """
    i, j, k, sign = _axes(order)
    m = np.asarray(rotation, np.float64)
    angles = np.empty(m.shape[:-1])
    first = np.arctan2(-sign * m[..., j, k], m[..., k, k])
    undone = np.cos(first)[..., None] * m[..., j, :] + sign * np.sin(first)[..., None] * m[..., k, :]
    angles[..., i] = first
    angles[..., j] = np.arctan2(sign * m[..., i, k], np.hypot(m[..., i, i], m[..., i, j]))
    angles[..., k] = np.arctan2(sign * undone[..., i], undone[..., j])
    return angles / _radians_per(unit)


def _axes(order: str) -> tuple[int, int, int, float]:
    """The axes of an order, and whether they follow each other as x, y, z do (1) or the other way (-1)."""
    check_choice("order of angles", order, ORDERS)
    i, j, k = ("xyz".index(axis) for axis in order)
    return i, j, k, 1.0 if (j - i) % 3 == 1 else -1.0


def _radians_per(unit: AngleUnit | str) -> float:
    check_choice("unit of angles", unit, AngleUnit)
    return float(np.pi / 180.0) if unit == AngleUnit.DEGREES else 1.0


def _rotation(axis: int, angle: Float64Array) -> Float64Array:
    """Rotation matrices about one axis."""
    after, last = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.zeros((*np.shape(angle), 3, 3))
    rotation[..., axis, axis] = 1.0
    rotation[..., after, after] = rotation[..., last, last] = np.cos(angle)
    rotation[..., last, after] = np.sin(angle)
    rotation[..., after, last] = -np.sin(angle)
    return rotation
