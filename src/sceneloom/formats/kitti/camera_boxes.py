"""KITTI's boxes, which stand on their bottom in the rectified camera's frame, as upright boxes of the lidar's frame.

KITTI's boxes are upright about the camera's y axis, ours about the lidar's z axis: how little these differ (below 1°)
is dropped, and the heading's horizontal part is kept. Middles of boxes are kept exactly.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.geometry.rigid import RigidTransform

CENTRE_TO_CORNER = 0.5
"""KITTI counts pixels from the centre of the first one, boxes here from the image's own corner [px]."""


def lidar_boxes(
    sizes_hwl: Float64Array,
    bottoms: Float64Array,
    rotations_y: Float64Array,
    rectified_from_lidar: RigidTransform,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Give boxes in the lidar's frame.

    Args:
        sizes_hwl: (N, 3) float64 [m], height, width, length.
        bottoms: (N, 3) float64 [m], middles of the boxes' bottoms, rectified camera frame.
        rotations_y: (N,) float64 [rad], about the camera's y axis; 0 along its x axis.
        rectified_from_lidar: how the frames lie.

    Returns:
        centers: (N, 3) float64 [m].
        sizes_lwh: (N, 3) float64 [m].
        yaws: (N,) float64 [rad].

    Source: the readme of KITTI's development kit for objects.
    """
    centers = bottoms - np.array([0.0, 0.5, 0.0]) * sizes_hwl[:, :1]
    headings = np.column_stack([np.cos(rotations_y), np.zeros(len(rotations_y)), -np.sin(rotations_y)])
    lidar_from_rectified = rectified_from_lidar.inverse()
    rotated = lidar_from_rectified.rotate(headings)
    return (
        lidar_from_rectified.apply(centers),
        sizes_hwl[:, ::-1].copy(),
        np.arctan2(rotated[:, 1], rotated[:, 0]),
    )


def rectified_boxes(
    centers: Float64Array, sizes_lwh: Float64Array, yaws: Float64Array, rectified_from_lidar: RigidTransform
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Give boxes of the lidar's frame as KITTI has them: the way back of `lidar_boxes`.

    Returns:
        sizes_hwl: (N, 3) float64 [m].
        bottoms: (N, 3) float64 [m], rectified camera frame.
        rotations_y: (N,) float64 [rad], -π to π.
    """
    bottoms = rectified_from_lidar.apply(centers) + np.array([0.0, 0.5, 0.0]) * sizes_lwh[:, 2:]
    headings = np.column_stack([np.cos(yaws), np.sin(yaws), np.zeros(len(yaws))])
    rotated = rectified_from_lidar.rotate(headings)
    return sizes_lwh[:, ::-1].copy(), bottoms, np.arctan2(-rotated[:, 2], rotated[:, 0])


def observation_angles(bottoms: Float64Array, rotations_y: Float64Array) -> Float64Array:
    """Under which angle the camera sees objects, KITTI's alpha: (N,) float64 [rad], -π to π."""
    angles = rotations_y - np.arctan2(bottoms[:, 0], bottoms[:, 2])
    wrapped: Float64Array = np.arctan2(np.sin(angles), np.cos(angles))
    return wrapped
