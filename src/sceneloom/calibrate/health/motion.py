"""Whether camera and lidar turn about the same axes: the same turn of the vehicle, seen by both.

From picture to picture the camera turns by the vector c, and the lidar by l. With the true rotation X of
camera_from_lidar, C = X L X⁻¹, so c = X l. If X is the stated R after a small turn w,

    c - R l = w × R l,

which tells w about the axes across the vehicle's own axis of turning, and nothing along it. Steps of the same size tell
by how much they turn: a drive straight on tells nothing.

Source: Shiu and Ahmad 1989, "Calibration of Wrist-Mounted Robotic Sensors by Solving Homogeneous Transform Equations of
the Form AX = XB"; rotation vectors: Park and Martin 1994; sandwich by clusters: Liang and Zeger 1986.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.calibrate.health.verdicts import Item, judge
from sceneloom.geometry.rotations import (
    matrix_from_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)

MOTION = "motion"
_LEAST_STEPS, _LEAST_TURN_DEG = 20, 8.0
_BLOCKS = 10
_ROUNDS = 15


def judge_motion(camera_turns: Float64Array, lidar_turns: Float64Array, rotation: Float64Array) -> Item:
    """Judge a rotation by how camera and lidar turn.

    Args:
        camera_turns: (N, 3) [rad], rotation vectors from picture to picture in the camera's axes; NaN where unknown.
        lidar_turns: (N, 3) [rad], of the same times, in the lidar's axes; NaN where unknown.
        rotation: (3, 3), of `camera_from_lidar` as stated.

    Returns:
        What is to be said of the two axes across the axis of turning; the first is the nearest to the camera's x axis.
    """
    known = np.isfinite(camera_turns).all(axis=1) & np.isfinite(lidar_turns).all(axis=1)
    seen, said = camera_turns[known], lidar_turns[known] @ rotation.T
    size = float(np.degrees(np.linalg.norm(said, axis=1).sum()))
    if len(seen) < _LEAST_STEPS or size < _LEAST_TURN_DEG:
        return Item.unknown(
            MOTION,
            f"{len(seen)} steps in which both are known to turn, by {size:.1f} deg; expected {_LEAST_STEPS} and "
            f"{_LEAST_TURN_DEG:g} deg",
        )
    turn, covariance, axis = _aligned(seen, said)
    across = _across(axis)
    return judge(MOTION, across @ turn, across @ covariance @ across.T)


def _aligned(seen: Float64Array, said: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """The turn (3,) that takes what is said to what is seen, its covariance (3, 3), and the axis of turning (3,)."""
    u, _, vt = np.linalg.svd(seen.T @ said)
    axis = u[:, 0]
    along = np.outer(axis, axis)
    turn, weights = _first_turn(axis, vt[0]), np.ones(len(seen))
    for _ in range(_ROUNDS):
        moved = said @ matrix_from_quaternion(quaternion_from_rotation_vector(turn)).T
        slopes = -_cross(moved)
        left = seen - moved
        sizes = np.square(left).sum(axis=1)
        weights = 1.0 / (1.0 + sizes / max(4.0 * float(np.median(sizes)), 1e-16))
        normal = np.einsum("nki,n,nkj->ij", slopes, weights, slopes) + along * float(np.sum(said**2))
        pulls = np.einsum("nki,n,nk->ni", slopes, weights, left)
        step = quaternion_from_rotation_vector(np.linalg.solve(normal, pulls.sum(axis=0)))
        turn = rotation_vector_from_quaternion(
            multiply_quaternions(step, quaternion_from_rotation_vector(turn))
        )
    blocks = np.zeros((_BLOCKS, 3))
    np.add.at(blocks, np.arange(len(seen)) * _BLOCKS // len(seen), pulls)
    inverse = np.linalg.inv(normal)
    return turn, inverse @ (blocks.T @ blocks) @ inverse * _BLOCKS / (_BLOCKS - 2), axis


def _first_turn(seen_axis: Float64Array, said_axis: Float64Array) -> Float64Array:
    """The smallest turn, (3,), that takes one axis to the other."""
    normal = np.cross(said_axis, seen_axis)
    sine, cosine = float(np.linalg.norm(normal)), float(said_axis @ seen_axis)
    if sine < 1e-9:
        return np.zeros(3) if cosine > 0 else np.pi * _across(seen_axis)[0]
    turn: Float64Array = normal / sine * np.arctan2(sine, cosine)
    return turn


def _across(axis: Float64Array) -> Float64Array:
    """Two directions, (2, 3), across an axis; the first is the nearest to x, or to z where the axis is near x."""
    near = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    first = near - axis * (near @ axis)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(first, axis)])


def _cross(vectors: Float64Array) -> Float64Array:
    """Matrices, (N, 3, 3), that take a vector w to v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
