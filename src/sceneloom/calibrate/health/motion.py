"""Whether camera and lidar rotate about the same axes: the same rotation of the vehicle, seen by both.

From image to image the camera rotates by the vector c, and the lidar by l. With the true rotation X of
camera_from_lidar, C = X L X⁻¹, so c = X l. If X is the stated R after a small rotation w,

    c - R l = w × R l,

which reports w about the axes across the vehicle's own axis of rotating, and nothing along it. Steps of the same size
report by how much they rotate: a drive straight on states nothing.

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
_LEAST_STEPS, _LEAST_ROTATION_DEG = 20, 8.0
_BLOCKS = 10
_ROUNDS = 15


def judge_motion(
    camera_rotations: Float64Array, lidar_rotations: Float64Array, rotation: Float64Array
) -> Item:
    """Judge a rotation by how camera and lidar rotate.

    Args:
        camera_rotations: (N, 3) [rad], rotation vectors from image to image in the camera's axes; NaN where unknown.
        lidar_rotations: (N, 3) [rad], of the same times, in the lidar's axes; NaN where unknown.
        rotation: (3, 3), of `camera_from_lidar` as stated.

    Returns:
        What is to be stated of the two axes across the axis of rotating; the first is the nearest to the camera's x
        axis.
    """
    known = np.isfinite(camera_rotations).all(axis=1) & np.isfinite(lidar_rotations).all(axis=1)
    seen, stated = camera_rotations[known], lidar_rotations[known] @ rotation.T
    size = float(np.degrees(np.linalg.norm(stated, axis=1).sum()))
    if len(seen) < _LEAST_STEPS or size < _LEAST_ROTATION_DEG:
        return Item.unknown(
            MOTION,
            f"{len(seen)} steps in which both are known to rotate, by {size:.1f} deg; expected {_LEAST_STEPS} and "
            f"{_LEAST_ROTATION_DEG:g} deg",
        )
    delta_rotation, covariance, axis = _aligned(seen, stated)
    across = _across(axis)
    return judge(MOTION, across @ delta_rotation, across @ covariance @ across.T)


def _aligned(seen: Float64Array, stated: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """The rotation (3,) that takes what is stated to what is seen, its covariance (3, 3).

    And the axis of rotating (3,).
    """
    u, _, vt = np.linalg.svd(seen.T @ stated)
    axis = u[:, 0]
    along = np.outer(axis, axis)
    delta_rotation, weights = _first_rotation(axis, vt[0]), np.ones(len(seen))
    for _ in range(_ROUNDS):
        moved = stated @ matrix_from_quaternion(quaternion_from_rotation_vector(delta_rotation)).T
        slopes = -_cross(moved)
        left = seen - moved
        sizes = np.square(left).sum(axis=1)
        weights = 1.0 / (1.0 + sizes / max(4.0 * float(np.median(sizes)), 1e-16))
        normal = np.einsum("nki,n,nkj->ij", slopes, weights, slopes) + along * float(np.sum(stated**2))
        pulls = np.einsum("nki,n,nk->ni", slopes, weights, left)
        step = quaternion_from_rotation_vector(np.linalg.solve(normal, pulls.sum(axis=0)))
        delta_rotation = rotation_vector_from_quaternion(
            multiply_quaternions(step, quaternion_from_rotation_vector(delta_rotation))
        )
    blocks = np.zeros((_BLOCKS, 3))
    np.add.at(blocks, np.arange(len(seen)) * _BLOCKS // len(seen), pulls)
    inverse = np.linalg.inv(normal)
    return delta_rotation, inverse @ (blocks.T @ blocks) @ inverse * _BLOCKS / (_BLOCKS - 2), axis


def _first_rotation(seen_axis: Float64Array, stated_axis: Float64Array) -> Float64Array:
    """The smallest rotate, (3,), that takes one axis to the other."""
    normal = np.cross(stated_axis, seen_axis)
    sine, cosine = float(np.linalg.norm(normal)), float(stated_axis @ seen_axis)
    if sine < 1e-9:
        return np.zeros(3) if cosine > 0 else np.pi * _across(seen_axis)[0]
    delta_rotation: Float64Array = normal / sine * np.arctan2(sine, cosine)
    return delta_rotation


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
