"""Boxes in space: length along x (forward), width along y (left), height along z (up) of their own frame."""

import numpy as np
from numpy.typing import ArrayLike

from sceneloom.arrays import BoolArray, Float64Array, read_only
from sceneloom.geometry.rigid import conjugate_quaternion, rotate_vectors

CORNER_SIGNS: Float64Array = read_only(
    [[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]], np.float64
)
"""Side of the centre on which each corner lies: the bottom from the front left counter-clockwise as seen from
above (front left, back left, back right, front right), then the top in the same order."""

EDGES = (*((0, 1), (1, 2), (2, 3), (3, 0)), *((4, 5), (5, 6), (6, 7), (7, 4)), *((0, 4), (1, 5), (2, 6), (3, 7)))
"""The corners that each of the twelve edges joins: bottom, top, then the upright ones."""


def box_corners(center: ArrayLike, size_lwh: ArrayLike, quaternion_xyzw: ArrayLike) -> Float64Array:
    """Give the corners of boxes in the order of `CORNER_SIGNS`.

    Args:
        center: (..., 3) [m].
        size_lwh: (..., 3) full length, width and height [m].
        quaternion_xyzw: (..., 4) orientation, normalised here.

    Returns:
        (..., 8, 3) float64 [m], in the frame of `center`.
    """
    halves = np.asarray(size_lwh, np.float64)[..., None, :] / 2.0
    rotated = rotate_vectors(np.asarray(quaternion_xyzw, np.float64)[..., None, :], halves * CORNER_SIGNS)
    corners: Float64Array = np.asarray(center, np.float64)[..., None, :] + rotated
    return corners


def points_in_box(
    points: ArrayLike, center: ArrayLike, size_lwh: ArrayLike, quaternion_xyzw: ArrayLike, *, margin: float = 0.0
) -> BoolArray:
    """Report which points lie in a box, its faces included.

    Args:
        points: (N, 3) [m], in the frame of `center`; a point with a NaN lies nowhere.
        center: (3,) [m].
        size_lwh: (3,) full length, width and height [m].
        quaternion_xyzw: (4,) orientation, normalised here.
        margin: how far outside the faces a point still counts [m].

    Returns:
        (N,) bool.
    """
    away = np.asarray(points, np.float64) - np.asarray(center, np.float64)
    points_box = rotate_vectors(conjugate_quaternion(quaternion_xyzw), away)
    inside: BoolArray = np.all(np.abs(points_box) <= np.asarray(size_lwh, np.float64) / 2.0 + margin, axis=-1)
    return inside
