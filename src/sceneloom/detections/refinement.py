"""Boxes of a sweep made better by their partners in the picture, which see across the line of sight what lidars guess.

The state of a box is x = (middle, size), six numbers with the covariance P. The picture gives three numbers z: the
middle of the partner across and upright, and its height. They are what the corners bound that the box has there,
h(x), but for noise with the variances R. With the slopes H of h Kalman's update is

    K = P Hᵀ (H P Hᵀ + R)⁻¹,   x' = x + K (z - h(x)),   P' = P - K H P,   the same as   P'⁻¹ = P⁻¹ + Hᵀ R⁻¹ H.

The width of the partner tells nothing: boxes of people in sweeps hold their arms and steps, those in pictures less.
Of a box that the border of the picture may cut across, only what is upright counts, and the other way round.

Source: Kalman 1960, "A New Approach to Linear Filtering and Prediction Problems"; Thrun, Burgard and Fox 2005,
"Probabilistic Robotics", ch. 3.5 for the form with inverses.
"""

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_sides import bounding_corners, shifted_corners, update_by_sides
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

MIDDLE_SIGMAS = (2.0, 0.03)
"""Deviation of the middle of a box in the picture: so many pixels for clocks and calibration, plus so much of its side.

Source: detections of KITTI's sequences against the outlines of those of the sweeps: 1.5 px and 3 % of the width.
"""
HEIGHT_SIGMAS = (2.0, 0.06)
"""Deviation of the height of a box in the picture: so many pixels, plus this share of it; source as above."""
_LEAST_PX = np.array([MIDDLE_SIGMAS[0], MIDDLE_SIGMAS[0], HEIGHT_SIGMAS[0]])
_SHARES = np.array([MIDDLE_SIGMAS[1], MIDDLE_SIGMAS[1], HEIGHT_SIGMAS[1]])
FARTHEST = 3.0
"""A number of the picture that is more deviations than this from where it is expected has another reason."""
BORDER_PX = 2.0
"""What comes so near to the border of the picture may be cut there [px]."""
_STEP = 1e-3
"""Slopes are of lines through places so far to either side [m]."""
_LEAST_SHARE = 0.1
"""No size shrinks below this share of what it was."""


def refine(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    axes_camera: Float64Array,
    corners_camera: Float64Array,
    states: Float64Array,
    covariances: Float64Array,
    partners_xyxy: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Update boxes by their partners.

    Args:
        camera: the lens.
        camera_from_lidar: takes middles into the camera's frame.
        axes_camera: (M, 3, 3), whose columns are the boxes' axes in the camera's frame.
        corners_camera: (M, 8, 3) [m].
        states: (M, 6) [m], middle in the lidar's frame, and length, width, height.
        covariances: (M, 6, 6) [m²].
        partners_xyxy: (M, 4) [px], corner convention.

    Returns:
        States and covariances afterwards.
    """
    count = len(states)
    states_after, covariances = states.copy(), covariances.copy()
    if count == 0:
        return states_after, covariances
    pixels = project_unbounded(camera, corners_camera.reshape(-1, 3)).reshape(count, 8, 2)
    pixels += CENTRE_TO_CORNER
    partners = np.ascontiguousarray(partners_xyxy)
    sides = bounding_corners(pixels, partners, float(camera.width), float(camera.height), BORDER_PX)
    shifted = project_unbounded(camera, shifted_corners(corners_camera, sides, _STEP)).reshape(count, 4, 6, 2)
    turns = np.empty((count, 2, 3, 3))
    turns[:, 0], turns[:, 1] = camera_from_lidar.rotation, axes_camera
    scales = partners.take((2, 3, 3), axis=1) - partners.take((0, 1, 1), axis=1)
    sigmas = _LEAST_PX + _SHARES * scales
    update_by_sides(
        states_after,
        covariances,
        turns,
        CORNER_SIGNS,
        pixels,
        sides,
        shifted,
        _STEP,
        partners,
        sigmas,
        FARTHEST,
    )
    states_after[:, 3:] = np.maximum(states_after[:, 3:], _LEAST_SHARE * states[:, 3:])
    return states_after, covariances
