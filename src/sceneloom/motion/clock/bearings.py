"""How a camera turned between two pictures, from the directions in which it saw the same things."""

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.geometry.rotations import matrix_from_quaternion, quaternion_from_rotation_vector

LEAST_BEARINGS = 16
"""With fewer directions a turn is not believed."""

_ROUNDS = 12
_FINEST = 1e-6
"""No direction is known better [rad]."""

_WIDEST = 0.02
"""Where directions agree no better than this, they are not of one turn [rad]."""


def turn_between(first: Float64Array, second: Float64Array) -> tuple[Float64Array, BoolArray] | None:
    """Find the rotation between two sets of directions to the same things, most of which are far away.

    What is near moves towards or away from the point to which the camera goes; along that direction differences count
    less, as much as they scatter there more. What fits neither has no weight.

    Args:
        first, second: (N, 3) unit vectors in the camera's frame.

    Returns:
        `second_from_first` (3, 3), and which directions agree with it (N,); None where too few do.

    Source: weights (1 + r²/c²)⁻² are those of Geman and McClure 1985; the direction of the way is the coplanarity
    condition of Longuet-Higgins 1981 for small turns.
    """
    if len(first) < LEAST_BEARINGS:
        return None
    rotation, weights = _turn_alone(first, second)
    ahead = np.zeros(3)
    scales, amounts = np.zeros(2), np.zeros(4)
    for _ in range(_ROUNDS):
        turned = first @ rotation.T
        apart = second - turned
        ahead = _way(turned, apart, weights)
        along = ahead - (turned @ ahead)[:, None] * turned
        reach = np.linalg.norm(along, axis=1)
        along /= np.maximum(reach, 1e-9)[:, None]
        across = np.cross(turned, along)
        parts = np.stack([(apart * along).sum(axis=1), (apart * across).sum(axis=1)], axis=1)
        nearness = reach[:, None] * np.hstack([np.ones((len(turned), 1)), turned])
        parts[:, 0] -= nearness @ amounts
        scales = np.maximum(1.4826 * np.median(np.abs(parts), axis=0), _FINEST)
        scales[0] = max(scales)
        weights = (1.0 + ((parts / (3.0 * scales)) ** 2).sum(axis=1)) ** -2
        # apart changes by -δ × turned, which is turned × δ
        slopes = np.zeros((len(turned), 2, 7))
        slopes[:, 0, :3], slopes[:, 1, :3] = np.cross(turned, along), np.cross(turned, across)
        slopes[:, 0, 3:] = nearness
        root = np.sqrt(weights)[:, None] / scales
        rows = (slopes * root[:, :, None]).reshape(-1, 7)
        solution = np.linalg.lstsq(rows, (parts * root).reshape(-1), rcond=1e-6)[0]
        step, amounts = solution[:3], amounts + solution[3:]
        rotation = matrix_from_quaternion(quaternion_from_rotation_vector(step)) @ rotation
        if np.linalg.norm(step) < 1e-8:
            break
    agreeing = np.asarray(weights > 0.25, np.bool_)
    if agreeing.sum() < LEAST_BEARINGS or scales[1] > _WIDEST:
        return None
    return rotation, agreeing


def _turn_alone(first: Float64Array, second: Float64Array) -> tuple[Float64Array, Float64Array]:
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


def _way(turned: Float64Array, apart: Float64Array, weights: Float64Array) -> Float64Array:
    """The direction in which the camera went, up to its sign: all differences point to it or away from it."""
    normals = np.cross(turned, apart) * weights[:, None]
    _, vectors = np.linalg.eigh(normals.T @ normals)
    return np.asarray(vectors[:, 0], np.float64)
