"""How the angles of a scene's cuboids are meant: their unit, and the order of the rotations."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.euler import AngleUnit, cuboid_angles_from_rotation, rotation_from_cuboid_angles
from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix

if TYPE_CHECKING:
    from sceneloom.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class CuboidAngles:
    """The reading of roll, pitch and yaw.

    Attributes:
        unit: what they are counted in.
        order: in which order the three rotations are multiplied.

    Source: READING of "cuboid row" in docs/CONVENTIONS.md.
    """

    unit: str = AngleUnit.DEGREES
    order: str = "xyz"

    @classmethod
    def of(cls, scene: "Scene") -> "CuboidAngles":
        """The reading that a scene's metadata name, or the default one."""
        named: Any = scene.metadata.get("sceneloom")
        ours = named if isinstance(named, Mapping) else {}
        return cls(ours.get("euler_unit") or AngleUnit.DEGREES, ours.get("euler_order") or "xyz")

    def quaternions(self, angles_rpy: Float64Array) -> Float64Array:
        """Give `world_from_box` (..., 4), scalar last, of roll, pitch and yaw (..., 3).

        Raises:
            OptionError: unit or order is none of those known.
        """
        return quaternion_from_matrix(
            rotation_from_cuboid_angles(angles_rpy, unit=self.unit, order=self.order)
        )

    def from_quaternions(
        self, quaternions_xyzw: Float64Array, *, near: Float64Array | None = None
    ) -> Float64Array:
        """Give roll, pitch and yaw (..., 3) of rotations (..., 4).

        Args:
            quaternions_xyzw: the rotations, `world_from_box`.
            near: (..., 3) angles: of those that differ by whole rotates the nearest to these are given.

        Raises:
            OptionError: unit or order is none of those known.
        """
        angles = cuboid_angles_from_rotation(
            matrix_from_quaternion(quaternions_xyzw), unit=self.unit, order=self.order
        )
        if near is None:
            return angles
        rotation = 360.0 if self.unit == AngleUnit.DEGREES else 2.0 * np.pi
        nearest: Float64Array = angles + rotation * np.rint((near - angles) / rotation)
        return nearest
