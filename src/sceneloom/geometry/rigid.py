"""Rigid transforms: a rotation and a translation that take points of one frame into another."""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, Self

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, hold_arrays
from sceneloom.errors import CalibrationError
from sceneloom.geometry.rotations import matrix_from_quaternion, nearest_rotation, quaternion_from_matrix

_LAST_ROW_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class RigidTransform:
    """`a_from_b`: takes points of frame b into frame a, p_a = R p_b + t.

    Attributes:
        rotation: (3, 3) float64, orthonormal, determinant +1.
        translation: (3,) float64 [m].

    Raises:
        CalibrationError: the rotation is off by more than 1e-6.
    """

    rotation: Float64Array
    translation: Float64Array

    def __post_init__(self) -> None:
        hold_arrays(self, "", {"rotation": (np.float64, 3, 3), "translation": (np.float64, 3)}, frozen=True)
        error, determinant = _measure(self.rotation)
        if not (error < 1e-6 and determinant > 0 and all(map(isfinite, self.translation.tolist()))):
            raise CalibrationError(
                f"rotation off by {error:.2g}, translation {self.translation.tolist()}; "
                "expected an orthonormal right-handed matrix and finite numbers"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        return RigidTransform, (self.rotation, self.translation)

    @classmethod
    def identity(cls) -> Self:
        """The transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, position: FloatArray, quaternion_xyzw: FloatArray) -> Self:
        """Build from a (3,) position [m] and a (4,) scalar-last quaternion, normalised here."""
        return cls(matrix_from_quaternion(quaternion_xyzw), np.asarray(position, np.float64))

    @classmethod
    def nearest(cls, matrix: FloatArray) -> tuple[Self, float]:
        """Build from a (4, 4) or (3, 4) matrix of a file, whose rotation may be rounded.

        Returns:
            The transform with the closest proper rotation, and how far the given one is from it: max abs of
            R Rᵀ - I, infinite for a mirrored one. The caller judges that number.

        Raises:
            CalibrationError: shape, a value that is not finite, or a last row that is not 0 0 0 1.
        """
        m = np.asarray(matrix, np.float64)
        if m.shape not in {(4, 4), (3, 4)} or not np.isfinite(m).all():
            raise CalibrationError(f"matrix {m.tolist()}; expected 4x4 or 3x4 finite numbers")
        if m.shape == (4, 4) and np.abs(m[3] - (0.0, 0.0, 0.0, 1.0)).max() > _LAST_ROW_TOLERANCE:
            raise CalibrationError(f"matrix with the last row {m[3].tolist()}; expected 0 0 0 1")
        rotation, error = nearest_rotation(m[:3, :3])
        return cls(rotation, m[:3, 3].copy()), error

    @property
    def quaternion_xyzw(self) -> Float64Array:
        """The rotation as a unit quaternion, scalar last, w >= 0."""
        return quaternion_from_matrix(self.rotation)

    @property
    def matrix(self) -> Float64Array:
        """The (4, 4) homogeneous matrix."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix

    @property
    def inverse_matrix(self) -> Float64Array:
        """The (4, 4) homogeneous matrix of the inverse, which need not be checked anew."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation.T, -self.rotation.T @ self.translation
        return matrix

    def __matmul__(self, other: "RigidTransform") -> "RigidTransform":
        """`a_from_b @ b_from_c` is `a_from_c`."""
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def inverse(self) -> "RigidTransform":
        """`b_from_a`."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    @np.errstate(invalid="ignore", over="ignore")  # files hold numbers that are none
    def apply(self, points: FloatArray) -> Float64Array:
        """Take (..., 3) points [m] of frame b into frame a."""
        moved: Float64Array = np.asarray(points, np.float64) @ self.rotation.T
        # In location: of many points another array would cost twice as long as the sum.
        moved += self.translation
        return moved

    @np.errstate(invalid="ignore", over="ignore")
    def rotate(self, vectors: FloatArray) -> Float64Array:
        """Take (..., 3) directions or velocities of frame b into frame a, which moves nothing."""
        rotated: Float64Array = np.asarray(vectors, np.float64) @ self.rotation.T
        return rotated


def _measure(rotation: Float64Array) -> tuple[float, float]:
    """Max abs of R Rᵀ - I, infinite if something is not finite, and the determinant.

    By plain numbers: transforms are made for each image and sweep, and NumPy takes several times as long for nine.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    off = (
        *(a * a + b * b + c * c - 1.0, d * d + e * e + f * f - 1.0, g * g + h * h + i * i - 1.0),
        *(a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i),
    )
    error = max(map(abs, off)) if all(map(isfinite, off)) else inf
    return error, a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
