"""Where the boxes of a sweep lie in a picture."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes3D
from sceneloom.visibility.outlines import box_extents

_NEAR = 0.05
"""A box nearer to the camera than this holds it, and has no outline [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlines:
    """Boxes of a sweep as a picture shows them.

    Attributes:
        corners_xyxy: (N, 4) float64 [px], corner convention, cut at the picture; zeros where it does not show them.
        depths: (N,) float64 [m], distance of the middle from the camera.
        shares: (N,) float64, which share of a box is in the picture.
    """

    corners_xyxy: Float64Array
    depths: Float64Array
    shares: Float64Array


def project_outlines(camera: Camera, camera_from_lidar: RigidTransform, boxes: Boxes3D) -> Outlines:
    """Find where a picture shows the boxes of a sweep; their numbers are finite.

    Raises:
        CalibrationError: the lens is unknown.
    """
    cosines, sines = np.cos(boxes.yaws), np.sin(boxes.yaws)
    axes = np.zeros((len(boxes), 3, 3))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 0], axes[:, 1, 1] = cosines, -sines, sines, cosines
    axes[:, 2, 2] = 1.0
    axes = camera_from_lidar.rotation @ axes
    centers = camera_from_lidar.apply(boxes.centers)
    halves = boxes.sizes_lwh / 2.0
    corners = centers[:, None] + (halves[:, None] * CORNER_SIGNS) @ axes.transpose(0, 2, 1)
    cameras_box = -np.einsum("bij,bi->bj", axes, centers)
    away = np.linalg.norm(np.maximum(np.abs(cameras_box) - halves, 0.0), axis=1) > _NEAR
    extents, shares = np.zeros((len(boxes), 4)), np.zeros(len(boxes))
    extents[away], shares[away] = box_extents(camera, corners[away])
    extents[~(extents[:, 2:] > extents[:, :2]).all(axis=1)] = 0.0
    return Outlines(extents, np.linalg.norm(centers, axis=1), shares)
