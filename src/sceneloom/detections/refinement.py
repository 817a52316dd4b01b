"""Boxes of a sweep made better by their partners in the image, which see across the line of sight what lidars guess.

The state of a box is x = (middle, size), six numbers with the covariance P. The image gives three numbers z: the
middle of the partner across and upright, and its height. They are what the corners bound that the box has there,
h(x), but for noise with the variances R. With the slopes H of h Kalman's update is

    K = P Hᵀ (H P Hᵀ + R)⁻¹,   x' = x + K (z - h(x)),   P' = P - K H P,   the same as   P'⁻¹ = P⁻¹ + Hᵀ R⁻¹ H.

The width of the partner states nothing: boxes of people in sweeps hold their arms and steps, those in images less.
Of a box that the border of the image may cut across, only what is upright counts, and the other way round.

Source: Kalman 1960, "A New Approach to Linear Filtering and Prediction Problems"; Thrun, Burgard and Fox 2005,
"Probabilistic Robotics", ch. 3.5 for the form with inverses.
"""

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import project_unbounded
from sceneloom.detections.outlines import Outlines
from sceneloom.geometry.boxes import CORNER_SIGNS
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.box_sides import shifted_sides, update_by_sides
from sceneloom.visibility.outlines import CENTRE_TO_CORNER

FARTHEST = 3.0
"""A number of the image that is more deviations than this from where it is expected has another reason."""
BORDER_PX = 2.0
"""What comes so near to the border of the image may be cut there [px]."""
_STEP = 1e-3
"""Slopes are of lines through locations so far to either side [m]."""
_LEAST_SHARE = 0.1
"""No size shrinks below this share of what it was."""


def refine(
    camera: Camera,
    camera_from_lidar: RigidTransform,
    outlines: Outlines,
    boxes: Float64Array,
    covariances: Float64Array,
    partners: Int64Array,
    corners_xyxy: Float64Array,
    sigmas: Float64Array,
) -> None:
    """Update boxes by their partners.

    Args:
        camera: the camera model.
        camera_from_lidar: takes middles into the camera's frame.
        outlines: of the boxes in the image.
        boxes: (N, 7), middle in the lidar's frame, length, width, height [m] and heading [rad]; changed.
        covariances: (N, 6, 6) [m²], of middles and sizes; changed.
        partners: (N,) int64, which box of the image is the same object, NO_BOX for none.
        corners_xyxy: (M, 4) [px], boxes of the image, corner convention.
        sigmas: (N, 6), how far off partners are, of `noise.image_sigmas`.
    """
    corners, count = outlines.corners_camera, len(boxes)
    pixels = project_unbounded(camera, corners.reshape(-1, 3)).reshape(count, 8, 2)
    pixels += CENTRE_TO_CORNER
    rows, sides, shifted = shifted_sides(
        corners, pixels, partners, corners_xyxy, float(camera.width), float(camera.height), BORDER_PX, _STEP
    )
    update_by_sides(
        boxes,
        covariances,
        camera_from_lidar.rotation,
        outlines.axes_camera,
        CORNER_SIGNS,
        pixels,
        rows,
        sides,
        project_unbounded(camera, shifted).reshape(len(rows), 4, 6, 2),
        _STEP,
        partners,
        corners_xyxy,
        sigmas,
        FARTHEST,
        _LEAST_SHARE,
    )
