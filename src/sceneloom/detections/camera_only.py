"""Where an object may be of which a picture tells alone: along its ray, as far as its height in the picture says.

An object of the height h that is seen under the angle α from top to bottom is h / (2 tan(α / 2)) away. How much
heights differ within a class is how little is known of that distance; across the ray the picture knows better.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sceneloom.arrays import BoolArray, Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.detections.classes import typical_sizes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

_EDGE_SHARE, _EDGE_PX = 0.05, 2.0
"""Deviation of an edge of a box: this share of its side, plus so many pixels."""
_BORDER_PX = 2.0
"""A box that comes so near to the border of the picture may be cut there [px]."""
_CUT_SIGMA = 0.5
"""Deviation of the distance of what the picture cuts at the top or bottom, as a share of it."""
_ROWS = np.array([[0.5, 0.5], [0.5, 0.0], [0.5, 1.0], [0.0, 0.5], [1.0, 0.5]])
"""Places in a box through which rays are sent: its middle, top and bottom, left and right."""


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


def place_by_height(
    camera: Camera, camera_from_lidar: RigidTransform, corners_xyxy: Float64Array, labels: Sequence[str]
) -> Placed:
    """Guess where objects are whose boxes in the picture are all that is known.

    Args:
        camera: the lens.
        camera_from_lidar: how it lies.
        corners_xyxy: (N, 4) float64 [px], corner convention, with an area.
        labels: N classes.
    """
    corners, count = corners_xyxy, len(corners_xyxy)
    if count == 0:
        return _NONE
    wide = corners[:, 2:] - corners[:, :2]
    places = corners[:, None, :2] + _ROWS * wide[:, None] - CENTRE_TO_CORNER
    rays = unproject(camera, places.reshape(-1, 2)).reshape(count, 5, 3)
    sizes, sigmas = typical_sizes(labels)
    angles, widths = _angles(rays[:, 1::2], rays[:, 2::2]).T
    known = np.isfinite(rays).all(axis=(1, 2)) & (angles > 0.0)
    angles = np.where(known, angles, 1.0)
    ranges = sizes[:, 2] / (2.0 * np.tan(np.minimum(angles, 3.0) / 2.0)) + sizes[:, 1] / 2.0
    cut = (corners[:, 1] < _BORDER_PX) | (corners[:, 3] > camera.height - _BORDER_PX)
    edges = (_EDGE_SHARE + _EDGE_PX / wide) ** 2
    spread = (sigmas[:, 2] / sizes[:, 2]) ** 2 + 2.0 * edges[:, 1] + np.where(cut, _CUT_SIGMA**2, 0.0)
    along, across = (
        ranges**2 * spread,
        ranges**2 * np.maximum(edges[:, 0] * widths**2, edges[:, 1] * angles**2),
    )
    rays_lidar = np.where(known[:, None], rays[:, 0], 0.0) @ camera_from_lidar.rotation
    outer = rays_lidar[:, :, None] * rays_lidar[:, None]
    covariances = across[:, None, None] * (_EYE - outer) + along[:, None, None] * outer
    origin = -camera_from_lidar.rotation.T @ camera_from_lidar.translation
    centers = origin + ranges[:, None] * rays_lidar
    return Placed(known, centers, covariances, sizes, sigmas[:, :, None] ** 2 * _EYE, ranges)


def _angles(one: Float64Array, other: Float64Array) -> Float64Array:
    """Angles between unit vectors (…, 3) [rad], by the chord between them."""
    apart = one - other
    angles: Float64Array = 2.0 * np.arcsin(np.minimum(np.sqrt((apart * apart).sum(axis=-1)) / 2.0, 1.0))
    return angles


_EYE = np.eye(3)
_NONE = Placed(
    np.zeros(0, np.bool_),
    np.zeros((0, 3)),
    np.zeros((0, 3, 3)),
    np.zeros((0, 3)),
    np.zeros((0, 3, 3)),
    np.zeros(0),
)
