"""How a camera rotated between two images, from the directions in which it saw the same things."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)

LEAST_BEARINGS = 16
"""With fewer directions a rotation is not believed."""

_ROUNDS = 12
_FINEST = 1e-6
"""No direction is known better [rad]."""

_WIDEST = 0.02
"""Where directions agree no better than this, they are not of one rotation [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class BearingRotation:
    """A rotation that directions report.

    Attributes:
        rotation: `second_from_first`, (3, 3).
        agreeing: (N,), which directions agree with it.
        influences: (N,), what share each direction has in the rotation about its own axis; they sum up to 1.
    """

    rotation: Float64Array
    agreeing: BoolArray
    influences: Float64Array


def rotation_between(first: Float64Array, second: Float64Array) -> BearingRotation | None:
    """Find the rotation between two sets of directions to the same things, most of which are far away.

    What is near moves towards or away from the point to which the camera goes; along that direction differences count
    less, as much as they scatter there more. What fits neither has no weight.

    Args:
        first, second: (N, 3) unit vectors in the camera's frame.

    Returns:
        The rotation; None where too few directions agree with any.

    Source: weights (1 + r²/c²)⁻² are those of Geman and McClure 1985; the direction of the trajectory is the
        coplanarity
    condition of Longuet-Higgins 1981 for small rotations.
    """
    if len(first) < LEAST_BEARINGS:
        return None
    rotation, weights = _rotation_alone(first, second)
    rotated = first @ rotation.T
    ahead = _trajectory(rotated, second - rotated, weights)
    scales, amounts = np.zeros(2), np.zeros(4)
    for _ in range(_ROUNDS):
        view = _View.of(first @ rotation.T, second, ahead)
        parts = view.parts.copy()
        parts[:, 0] -= view.nearness @ amounts
        scales = np.maximum(1.4826 * np.median(np.abs(parts), axis=0), _FINEST)
        scales[0] = max(scales)
        weights = (1.0 + ((parts / (3.0 * scales)) ** 2).sum(axis=1)) ** -2
        root = np.sqrt(weights)[:, None] / scales
        rows = np.vstack([(view.slopes * root[:, :, None]).reshape(-1, 9), _HELD])
        solution = np.linalg.lstsq(rows, np.append(parts * root, np.zeros(2)), rcond=1e-6)[0]
        rotation = matrix_from_quaternion(quaternion_from_rotation_vector(solution[:3])) @ rotation
        ahead = view.rotated_trajectory(solution[3:5])
        amounts = amounts + solution[5:]
        if np.linalg.norm(solution[:3]) < 1e-7:
            break
    agreeing = np.asarray(weights > 0.25, np.bool_)
    if agreeing.sum() < LEAST_BEARINGS or scales[1] > _WIDEST:
        return None
    return BearingRotation(rotation, agreeing, _influences(rows, rotation))


def _influences(rows: Float64Array, rotation: Float64Array) -> Float64Array:
    """What share each direction has in a rotation about the axis of the rotation that was found.

    Were a direction alone to see a larger rotate, the solution's rotation would grow by its share of that.

    Args:
        rows: (2 N + 2, 9), of the least squares.
        rotation: (3, 3).
    """
    vector = rotation_vector_from_quaternion(quaternion_from_matrix(rotation))
    axis = vector / max(float(np.linalg.norm(vector)), 1e-12)
    normal = rows.T @ rows
    lengths = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(lengths, lengths), rcond=1e-10) / np.outer(lengths, lengths)
    shares = (rows @ inverse[:, :3] @ axis) * (rows[:, :3] @ axis)
    of_directions = shares[:-2].reshape(-1, 2).sum(axis=1)
    total = float(of_directions.sum())
    if not 0.5 < total < 2.0:
        return np.full(len(of_directions), 1.0 / len(of_directions))
    return np.asarray(of_directions / total, np.float64)


_HELD = np.zeros((2, 9))
_HELD[0, 3] = _HELD[1, 4] = 1.0 / 0.3
"""The direction of the trajectory is held, weakly: where nothing is near, nothing reports it [1/rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """How far directions differ, and what a small rotation and another way would change of it.

    Attributes:
        ahead: (3,), where the camera goes.
        sideways: (2, 3), two directions across it.
        parts: (N, 2): along the great circle through `ahead`, and across it.
        nearness: (N, 4), columns of a plane of nearness: what moves along is near.
        slopes: (N, 2, 9): by the rotation, the trajectory's direction, and the nearness.
    """

    ahead: Float64Array
    sideways: Float64Array
    parts: Float64Array
    nearness: Float64Array
    slopes: Float64Array

    @classmethod
    def of(cls, rotated: Float64Array, second: Float64Array, ahead: Float64Array) -> "_View":
        """Compare directions (N, 3) that were rotated with those that were seen."""
        apart = second - rotated
        along = ahead - (rotated @ ahead)[:, None] * rotated
        reach = np.maximum(np.linalg.norm(along, axis=1), 1e-3)[:, None]
        along /= reach
        across = np.cross(rotated, along)
        sideways = np.linalg.svd(ahead[None])[2][1:]
        nearness = reach * np.hstack([np.ones((len(rotated), 1)), rotated])
        # apart changes by -δ × rotated, across the circle by the way's direction, too
        slopes = np.zeros((len(rotated), 2, 9))
        slopes[:, 0, :3], slopes[:, 1, :3] = np.cross(rotated, along), np.cross(rotated, across)
        slopes[:, 1, 3:5] = np.cross(rotated, second) @ sideways.T / reach
        slopes[:, 0, 5:] = nearness
        parts = np.stack([(apart * along).sum(axis=1), (apart * across).sum(axis=1)], axis=1)
        return cls(ahead, sideways, parts, nearness, slopes)

    def rotated_trajectory(self, steps: Float64Array) -> Float64Array:
        """The trajectory's direction after small steps (2,) sideways."""
        trajectory = self.ahead + np.clip(steps, -0.3, 0.3) @ self.sideways
        return np.asarray(trajectory / np.linalg.norm(trajectory), np.float64)


def _rotation_alone(first: Float64Array, second: Float64Array) -> tuple[Float64Array, Float64Array]:
    """The rotation that takes most of the directions near to where they are, by weights that fall with the distance.

    Source: Wahba 1965, solved by the singular values as in Markley 1988.
    """
    weights = np.ones(len(first))
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(np.einsum("n,ni,nj->ij", weights, second, first))
        rotation = (u * np.array([1.0, 1.0, np.linalg.det(u @ vt)])) @ vt
        distances = np.linalg.norm(second - first @ rotation.T, axis=1)
        scale = max(1.4826 * float(np.median(distances)), _FINEST)
        weights = (1.0 + (distances / (2.0 * scale)) ** 2) ** -2
    return rotation, weights


def _trajectory(rotated: Float64Array, apart: Float64Array, weights: Float64Array) -> Float64Array:
    """The direction in which the camera went, up to its sign: all differences point to it or away from it."""
    normals = np.cross(rotated, apart) * weights[:, None]
    _, vectors = np.linalg.eigh(normals.T @ normals)
    return np.asarray(vectors[:, 0], np.float64)
