"""Where an object may be of which an image reports alone: along its ray, as far as its height in the image says.

An object of the height h that is seen under the angle α from top to bottom is h / (2 tan(α / 2)) away. How much
heights differ within a class is how little is known of that distance; across the ray the image knows better.
"""

from typing import NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array, read_only
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.detections.classes import SIZES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

EDGES = (0.05, 2.0)
"""Deviation of an edge of a box: this share of its side, plus so many pixels."""
BORDER_PX = 2.0
"""A box that comes so near to the border of the image may be cut there [px]."""
_CUT_SIGMA = 0.5
"""Deviation of the distance of what the image cuts at top or bottom, as a share of it."""


_RAYS: Float64Array = read_only(
    np.array(
        [
            [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0],
            [0.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.5],
            [0.5, 0.0, 0.5, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0],
            [0.0, 0.5, 0.0, 0.0, 0.0, 1.0, 0.0, 0.5, 0.0, 0.5],
        ]
    )
)
"""From the edges of a box to five pixels: the middle, those of its top and bottom, those of its left and right."""


class Placed(NamedTuple):
    """Objects in space by one image.

    Attributes:
        rows: (P,) int64, which boxes: those asked for along which the camera model has rays.
        centers: (P, 3) float64 [m], lidar frame.
        center_covariances: (P, 3, 3) float64 [m²].
        sizes_lwh: (P, 3) float64 [m], typical of the class.
        size_covariances: (P, 3, 3) float64 [m²].
        ranges: (P,) float64 [m], from the camera.
    """

    rows: Int64Array
    centers: Float64Array
    center_covariances: Float64Array
    sizes_lwh: Float64Array
    size_covariances: Float64Array
    ranges: Float64Array


def position_by_height(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    corners_xyxy: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
) -> Placed:
    """Guess where objects are whose boxes in the image are all that is known.

    Args:
        camera: the camera model.
        camera_from_lidar: how it lies.
        corners_xyxy: (M, 4) float64 [px], boxes of the image, corner convention, with an area.
        rows: (L,) int64, which of them are asked for.
        kinds: (M,) int64, of `classes.table_rows`.
    """
    boxes = corners_xyxy[rows]
    pixels = (boxes @ _RAYS).reshape(-1, 2) - CENTRE_TO_CORNER
    rays = unproject(camera, pixels).reshape(len(rows), 5, 3)
    chords = rays[:, 1::2] - rays[:, 2::2]
    angles = 2.0 * np.arcsin(np.minimum(np.sqrt((chords * chords).sum(axis=2)) / 2.0, 1.0))
    seen = np.isfinite(rays).all(axis=(1, 2)) & (angles[:, 0] > 0.0)
    rows, boxes, sizes = rows[seen], boxes[seen], SIZES[kinds[rows[seen]]]
    angle_upright, angle_across = angles[seen].T
    distances = sizes[:, 2] / (2.0 * np.tan(np.minimum(angle_upright, 3.0) / 2.0)) + sizes[:, 1] / 2.0
    # variances along the ray and across, as shares of the distance squared
    upright = (EDGES[0] + EDGES[1] / (boxes[:, 3] - boxes[:, 1])) ** 2
    sideways = (EDGES[0] + EDGES[1] / (boxes[:, 2] - boxes[:, 0])) ** 2
    cut = (boxes[:, 1] < BORDER_PX) | (boxes[:, 3] > camera.height - BORDER_PX)
    along = (sizes[:, 5] / sizes[:, 2]) ** 2 + 2.0 * upright + np.where(cut, _CUT_SIGMA**2, 0.0)
    across = np.maximum(sideways * angle_across**2, upright * angle_upright**2)
    rays_lidar = rays[seen, 0] @ camera_from_lidar.rotation
    outer = rays_lidar[:, :, None] * rays_lidar[:, None]
    shares = across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * outer
    return Placed(
        rows,
        distances[:, None] * rays_lidar - camera_from_lidar.translation @ camera_from_lidar.rotation,
        distances[:, None, None] ** 2 * shares,
        sizes[:, :3],
        sizes[:, 3:, None] ** 2 * np.eye(3),
        distances,
    )
