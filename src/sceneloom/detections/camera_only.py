"""Where an object may be of which a picture tells alone: along its ray, as far as its height in the picture says.

An object of the height h that is seen under the angle α from top to bottom is h / (2 tan(α / 2)) away. How much
heights differ within a class is how little is known of that distance; across the ray the picture knows better.
"""

from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.detections.classes import typical_sizes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

_EDGE_SHARE, _EDGE_PX = 0.05, 2.0
"""Deviation of an edge of a box: this share of its side, plus so many pixels."""
_BORDER_PX = 2.0
"""A box that comes so near to the border of the picture may be cut there [px]."""
_CUT_SIGMA = 0.5
"""Deviation of the distance of what the picture cuts at the top or bottom, as a share of it."""
_ROWS = np.array([[0.5, 0.5], [0.5, 0.0], [0.5, 1.0], [0.0, 0.5], [1.0, 0.5]])


class Placed(NamedTuple):
    """Objects in space by one picture.

    Attributes:
        known: (N,) bool, whether the lens has rays there; the other rows hold no more than zeros.
        centers: (N, 3) float64 [m], lidar frame.
        center_covariances: (N, 3, 3) float64 [m²].
        sizes_lwh: (N, 3) float64 [m], typical of the class.
        size_covariances: (N, 3, 3) float64 [m²].
        ranges: (N,) float64 [m], from the camera.
    """

    known: BoolArray
    centers: Float64Array
    center_covariances: Float64Array
    sizes_lwh: Float64Array
    size_covariances: Float64Array
    ranges: Float64Array

    def some(self, rows: BoolArray) -> "Placed":
        """Those of some rows."""
        return Placed(
            self.known[rows],
            self.centers[rows],
            self.center_covariances[rows],
            self.sizes_lwh[rows],
            self.size_covariances[rows],
            self.ranges[rows],
        )


def place_by_height(camera: Camera, camera_from_lidar: RigidTransform, boxes: Boxes2D) -> Placed:
    """Guess where objects are whose boxes in the picture are all that is known."""
    corners = boxes.corners_xyxy
    wide = corners[:, 2:] - corners[:, :2]
    places = corners[:, None, :2] + _ROWS * wide[:, None] - CENTRE_TO_CORNER
    rays = unproject(camera, places.reshape(-1, 2)).reshape(-1, 5, 3)
    sizes, sigmas = typical_sizes(boxes.labels)
    angles, widths = _angle(rays[:, 1], rays[:, 2]), _angle(rays[:, 3], rays[:, 4])
    known = np.isfinite(rays).all(axis=(1, 2)) & (wide > 0.0).all(axis=1) & (angles > 0.0)
    angles = np.where(known, angles, 1.0)
    ranges = sizes[:, 2] / (2.0 * np.tan(np.minimum(angles, 3.0) / 2.0)) + sizes[:, 1] / 2.0
    cut = (corners[:, 1] < _BORDER_PX) | (corners[:, 3] > camera.height - _BORDER_PX)
    spread = (sigmas[:, 2] / sizes[:, 2]) ** 2 + 2.0 * (
        _EDGE_SHARE + _EDGE_PX / np.maximum(wide[:, 1], 1.0)
    ) ** 2
    along = ranges**2 * np.where(cut, spread + _CUT_SIGMA**2, spread)
    across = (
        ranges * (_EDGE_SHARE + _EDGE_PX / np.maximum(wide.min(axis=1), 1.0)) * np.maximum(widths, angles)
    ) ** 2
    rays_lidar = np.where(known[:, None], rays[:, 0], 0.0) @ camera_from_lidar.rotation
    outer = rays_lidar[:, :, None] * rays_lidar[:, None]
    covariances = across[:, None, None] * (np.eye(3) - outer) + along[:, None, None] * outer
    origin = -camera_from_lidar.rotation.T @ camera_from_lidar.translation
    size_covariances = (sigmas**2)[:, :, None] * np.eye(3)
    return Placed(known, origin + ranges[:, None] * rays_lidar, covariances, sizes, size_covariances, ranges)


def _angle(one: Float64Array, other: Float64Array) -> Float64Array:
    cross = np.linalg.norm(np.cross(one, other), axis=1)
    angles: Float64Array = np.arctan2(cross, (one * other).sum(axis=1))
    return angles
