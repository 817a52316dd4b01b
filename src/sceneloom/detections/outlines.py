"""Which boxes have finite numbers, and where those of a sweep lie in an image."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_overlaps import hide_covered
from sceneloom.visibility.outlines import COARSE, box_extents

_NEAR = 0.05
"""A box nearer to the camera than this holds it, and has no outline [m]."""
_APART = 1.5
"""Boxes whose middles are nearer to each other than this along the visibility stand for one thing.

And hide no other [m].
"""


def boxes_with_position(
    centers: Float64Array, sizes: Float64Array, yaws: Float64Array
) -> tuple[Float64Array, Int64Array]:
    """Take those boxes in space that have finite numbers, and sizes above 0.

    Args:
        centers, sizes: (N, 3) [m].
        yaws: (N,) [rad].

    Returns:
        (M, 7) float64, middle, size and heading of those, and (M,) int64, which they are.
    """
    boxes = np.column_stack([centers, sizes, yaws])
    rows = np.flatnonzero(np.isfinite(boxes).all(axis=1) & (boxes[:, 3:6] > 0.0).all(axis=1))
    return boxes[rows], rows


def boxes_with_area(corners: Float64Array) -> tuple[Float64Array, Int64Array]:
    """Take those boxes in an image that have finite edges, right and lower ones beyond left and upper ones.

    Args:
        corners: (N, 4) [px], left, upper, right and lower edge.

    Returns:
        (M, 4) float64 [px], their edges, and (M,) int64, which they are.
    """
    rows = np.flatnonzero(np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1))
    return corners[rows], rows


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Boxes of a sweep as an image shows them.

    Attributes:
        corners_xyxy: (N, 4) float64 [px], corner convention, cut at the image; zeros where it does not show them.
        seen_shares: (N,) float64, which share of a box is in the image and not behind a nearer one.
        axes_camera: (N, 3, 3) float64, whose columns are the boxes' axes in the camera's frame.
        corners_camera: (N, 8, 3) float64 [m], in the order of `geometry.boxes.CORNER_SIGNS`.
    """

    corners_xyxy: Float64Array
    seen_shares: Float64Array
    axes_camera: Float64Array
    corners_camera: Float64Array


def project_outlines(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    boxes: Float64Array,
    *,
    likely: Float64Array | None = None,
) -> Outlines:
    """Find where an image shows the boxes of a sweep.

    Args:
        camera: the camera model.
        camera_from_lidar: how it lies.
        boxes: (N, 7) float64, middle, size [m] and heading [rad] in the lidar's frame; finite.
        likely: (N,) float64, how likely it is that each exists, and so hides what is behind it; None for certain.

    Raises:
        CalibrationError: the camera model is unknown.
    """
    rotation, halves = camera_from_lidar.rotation, boxes[:, 3:6] / 2.0
    rotations = np.zeros((len(boxes), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(boxes[:, 6])
    rotations[:, 1, 0] = np.sin(boxes[:, 6])
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    rotations[:, 2, 2] = 1.0
    axes = rotation @ rotations
    middles = boxes[:, :3] @ rotation.T + camera_from_lidar.translation
    corners = middles[:, None] + (CORNER_SIGNS * halves[:, None]) @ axes.transpose(0, 2, 1)
    distances = np.sqrt((middles * middles).sum(axis=1))
    outside = np.maximum(np.abs((middles[:, None] @ axes)[:, 0]) - halves, 0.0)
    gaps = np.sqrt((outside * outside).sum(axis=1))
    extents, shares = box_extents(camera, corners, steps=COARSE)
    hide_covered(
        extents, shares, distances, gaps, np.ones(len(boxes)) if likely is None else likely, _NEAR, _APART
    )
    return Outlines(extents, shares, axes, corners)
