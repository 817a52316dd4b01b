"""An estimated extrinsic with its covariance, small steps of an extrinsic, and the ground in a lidar's cloud."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, check_array
from sceneloom.geometry.rigid import (
    RigidTransform,
    conjugate_quaternion,
    matrix_from_rotation_vector,
    multiply_quaternions,
    nearest_rotation,
    rotation_vector_from_quaternion,
)

_LOOSEST_ROTATION, _LOOSEST_SHIFT = np.radians(2.0), 0.25
"""Standard deviations [rad], [m] from which a direction counts as not observed by the data."""

_DRAWS, _NEAR_PLANE, _STEEPEST, _REACH, _SEED = 400, 0.12, np.cos(np.radians(50.0)), 25.0, 5


@dataclass(frozen=True, slots=True, eq=False)
class MountingEstimate:
    """`a_from_b` with its uncertainty.

    Attributes:
        a_from_b: the transform.
        covariance: (6, 6) of a small rotation about the axes of a [rad], then a small translation along them [m], as
            `moved_by` applies them. Infinite where nothing is known.
        unobserved: what the data do not determine, in words; () where they determine everything.
    """

    a_from_b: RigidTransform
    covariance: Float64Array
    unobserved: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_array("covariance", self.covariance, (6, 6), np.float64)

    @classmethod
    def of(cls, a_from_b: RigidTransform, covariance: Float64Array, frame: str) -> "MountingEstimate":
        """Name the directions that are not known well enough to be used; `frame` is the name of a."""
        found = []
        for name, part, loosest, unit, scale in (
            ("rotation about", slice(0, 3), _LOOSEST_ROTATION, "deg", np.degrees(1.0)),
            ("translation along", slice(3, 6), _LOOSEST_SHIFT, "m", 1.0),
        ):
            variances, directions = np.linalg.eigh(covariance[part, part])
            for variance, direction in zip(variances, directions.T, strict=True):
                sigma = float(np.sqrt(max(variance, 0.0)))
                if sigma > loosest:
                    found.append(
                        f"{name} {_direction(direction)} of the {frame}: known within {sigma * scale:.2g} {unit} only"
                    )
        return cls(a_from_b, covariance, tuple(found))

    @property
    def sigmas(self) -> Float64Array:
        """(6,) standard deviations: rotations about x, y, z [rad], translations along x, y, z [m]."""
        return np.sqrt(np.diagonal(self.covariance))


def _direction(direction: Float64Array) -> str:
    """An axis by its letter where one stands out, else by its numbers."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > np.cos(np.radians(20.0)):
        return "xyz"[axis]
    signed = direction * np.sign(direction[axis])
    return f"({', '.join(f'{value:.2f}' for value in signed)})"


def moved_by(a_from_b: RigidTransform, step: Float64Array) -> RigidTransform:
    """Rotate by step[:3] [rad] about the axes of a, and translate by step[3:] [m] along them.

    The position of b in a is translated, not rotated.
    """
    rotation = matrix_from_rotation_vector(step[:3])
    return RigidTransform(nearest_rotation(rotation @ a_from_b.rotation)[0], a_from_b.translation + step[3:])


def step_between(start: RigidTransform, end: RigidTransform) -> Float64Array:
    """Give the (6,) step by which `moved_by` takes one transform to the other."""
    rotation = multiply_quaternions(end.quaternion_xyzw, conjugate_quaternion(start.quaternion_xyzw))
    return np.concatenate([rotation_vector_from_quaternion(rotation), end.translation - start.translation])


def ground_plane(points: Float64Array) -> tuple[Float64Array, float] | None:
    """Find the ground in a lidar's cloud, (N, 3) [m]: the plane below the sensor with the most points near it.

    Returns:
        (3,) unit normal that points up to the sensor, and the sensor's height above the plane [m]; None without one.

    Source: Fischler and Bolles 1981, "Random Sample Consensus".
    """
    near = points[np.linalg.norm(points, axis=1) < _REACH]
    if len(near) < 100:
        return None
    rng = np.random.default_rng(_SEED)
    thinned = near[rng.choice(len(near), min(len(near), 4000), replace=False)]
    drawn = thinned[rng.integers(0, len(thinned), (_DRAWS, 3))]
    normals = np.cross(drawn[:, 1] - drawn[:, 0], drawn[:, 2] - drawn[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-6] / lengths[lengths > 1e-6, None]
    heights = -(normals * drawn[lengths > 1e-6, 0]).sum(axis=1)
    normals, heights = normals * np.sign(heights)[:, None], np.abs(heights)
    counts = (np.abs(thinned @ normals.T + heights) < _NEAR_PLANE).sum(axis=0) * ((heights > 0.3) & (heights < 6.0))
    # walls contain many points, too, but the ground lies below in the sensor's own axes
    counts = np.where(np.abs(normals[:, 2]) > _STEEPEST, counts, 0)
    best = int(np.argmax(counts))
    if counts[best] < 0.05 * len(thinned):
        return None
    inliers = thinned[np.abs(thinned @ normals[best] + heights[best]) < _NEAR_PLANE]
    middle = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - middle, full_matrices=False)[2][2]
    normal = normal * np.sign(-normal @ middle)
    return normal, float(-normal @ middle)
