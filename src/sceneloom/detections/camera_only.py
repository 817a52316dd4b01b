"""Where an object may be of which a picture tells alone: along its ray, as far as its height in the picture says.

An object of the height h that is seen under the angle α from top to bottom is h / (2 tan(α / 2)) away. How much
heights differ within a class is how little is known of that distance; across the ray the picture knows better.
"""

from typing import NamedTuple

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import unproject
from sceneloom.detections.classes import SIZES
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels import height_placing
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

EDGES = (0.05, 2.0)
"""Deviation of an edge of a box: this share of its side, plus so many pixels."""
BORDER_PX = 2.0
"""A box that comes so near to the border of the picture may be cut there [px]."""
_CUT_SIGMA = 0.5
"""Deviation of the distance of what the picture cuts at top or bottom, as a share of it."""


class Placed(NamedTuple):
    """Objects in space by one picture.

    Attributes:
        rows: (P,) int64, which boxes: those asked for along which the lens has rays.
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


def place_by_height(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    corners_xyxy: Float64Array,
    rows: Int64Array,
    kinds: Int64Array,
) -> Placed:
    """Guess where objects are whose boxes in the picture are all that is known.

    Args:
        camera: the lens.
        camera_from_lidar: how it lies.
        corners_xyxy: (M, 4) float64 [px], boxes of the picture, corner convention, with an area.
        rows: (L,) int64, which of them are asked for.
        kinds: (M,) int64, of `classes.table_rows`.
    """
    rays = unproject(camera, height_placing.ray_places(corners_xyxy, rows, CENTRE_TO_CORNER))
    return Placed(
        *height_placing.place_by_height(
            corners_xyxy,
            rows,
            rays,
            kinds,
            SIZES,
            camera_from_lidar.rotation,
            camera_from_lidar.translation,
            float(camera.height),
            (*EDGES, BORDER_PX, _CUT_SIGMA),
        )
    )
