"""Where the boxes of a sweep lie in a picture."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_overlaps import hide_covered
from sceneloom.kernels.upright_boxes import place_upright_boxes
from sceneloom.visibility.outlines import COARSE, box_extents

_NEAR = 0.05
"""A box nearer to the camera than this holds it, and has no outline [m]."""
_APART = 1.5
"""Boxes whose middles are nearer to each other than this along the sight stand for one thing, and hide no other [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Boxes of a sweep as a picture shows them.

    Attributes:
        corners_xyxy: (N, 4) float64 [px], corner convention, cut at the picture; zeros where it does not show them.
        seen_shares: (N,) float64, which share of a box is in the picture and not behind a nearer one.
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
    """Find where a picture shows the boxes of a sweep.

    Args:
        camera: the lens.
        camera_from_lidar: how it lies.
        boxes: (N, 7) float64, middle, size [m] and heading [rad] in the lidar's frame; finite.
        likely: (N,) float64, how likely it is that each exists, and so hides what is behind it; None for certain.

    Raises:
        CalibrationError: the lens is unknown.
    """
    axes, corners, distances, gaps = place_upright_boxes(
        boxes, CORNER_SIGNS, camera_from_lidar.rotation, camera_from_lidar.translation
    )
    extents, shares = box_extents(camera, corners, steps=COARSE)
    hide_covered(
        extents, shares, distances, gaps, np.ones(len(boxes)) if likely is None else likely, _NEAR, _APART
    )
    return Outlines(extents, shares, axes, corners)
