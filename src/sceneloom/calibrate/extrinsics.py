"""An estimated extrinsic with its covariance, and small steps of an extrinsic."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, check_array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)

_LOOSEST_ROTATION, _LOOSEST_SHIFT = np.radians(2.0), 0.25
"""Standard deviations [rad], [m] from which a direction counts as not observed by the data."""

_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class MountingEstimate:
    """`a_from_b`, and how far it may be off.

    Attributes:
        a_from_b: the transform.
        covariance: (6, 6) of a small rotation about the axes of a [rad], then a small shift along them [m]: the true
            rotation is exp(rotate) R, the true translation t + shift. Infinite where nothing is known.
        unobserved: what the data do not report, in words; () where they report everything.
    """

    a_from_b: RigidTransform
    covariance: Float64Array
    unobserved: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_array("covariance", self.covariance, (6, 6), np.float64)

    @property
    def sigmas(self) -> Float64Array:
        """(6,) standard deviations: rotations about x, y, z [rad], translations along x, y, z [m]."""
        return np.sqrt(np.diagonal(self.covariance))


def moved_by(a_from_b: RigidTransform, step: Float64Array) -> RigidTransform:
    """Rotate by step[:3] [rad] about the axes of a, then shift by step[3:] [m] along them.

    B's origin is not rotated.
    """
    rotation = matrix_from_quaternion(quaternion_from_rotation_vector(step[:3]))
    u, _, vt = np.linalg.svd(rotation @ a_from_b.rotation)
    return RigidTransform(u @ vt, a_from_b.translation + step[3:])


def step_between(start: RigidTransform, end: RigidTransform) -> Float64Array:
    """Give the (6,) step by which `moved_by` takes one mounting to the other."""
    rotation = multiply_quaternions(end.quaternion_xyzw, conjugate_quaternion(start.quaternion_xyzw))
    return np.concatenate([rotation_vector_from_quaternion(rotation), end.translation - start.translation])


def unobserved_directions(covariance: Float64Array, frame: str) -> tuple[str, ...]:
    """Name the directions of a (6, 6) covariance that are not known well enough to be used.

    Args:
        frame: whose axes the covariance's are, for the words.
    """
    found = []
    for name, part, loosest, unit, scale in (
        ("rotate about", slice(0, 3), _LOOSEST_ROTATION, "deg", np.degrees(1.0)),
        ("shift along", slice(3, 6), _LOOSEST_SHIFT, "m", 1.0),
    ):
        variances, directions = np.linalg.eigh(covariance[part, part])
        for variance, direction in zip(variances, directions.T, strict=True):
            sigma = float(np.sqrt(max(variance, 0.0)))
            if sigma > loosest:
                found.append(
                    f"{name} {_direction(direction)} of the {frame}: known within {sigma * scale:.2g} {unit} only"
                )
    return tuple(found)


def _direction(direction: Float64Array) -> str:
    """An axis by its letter where one stands out, else by its numbers."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > np.cos(np.radians(20.0)):
        return _AXES[axis]
    signed = direction * np.sign(direction[axis])
    return f"({', '.join(f'{value:.2f}' for value in signed)})"


_DRAWS = 400
_NEAR_PLANE = 0.12
_STEEPEST = np.cos(np.radians(50.0))
_REACH = 25.0


_SEED = 5


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
    below = (heights > 0.3) & (heights < 6.0)
    counts = (np.abs(thinned @ normals.T + heights) < _NEAR_PLANE).sum(axis=0) * below
    # walls hold many points, too, but the ground lies below whatever trajectory is up for the sensor
    counts = np.where(np.abs(normals[:, 2]) > _STEEPEST, counts, 0)
    best = int(np.argmax(counts))
    if counts[best] < 0.05 * len(thinned):
        return None
    inliers = thinned[np.abs(thinned @ normals[best] + heights[best]) < _NEAR_PLANE]
    middle = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - middle, full_matrices=False)[2][2]
    normal = normal * np.sign(-normal @ middle)
    return normal, float(-normal @ middle)
