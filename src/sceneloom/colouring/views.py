"""The points of one cloud in one picture: where they fall, which of them are seen, and the depth image they make."""

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, Int64Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import lens_vector, projection_kernel
from sceneloom.colouring.lidar_way import LidarWay
from sceneloom.colouring.results import FusedView
from sceneloom.colouring.visibility import VisibilitySettings, find_visible
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.depth_images import draw_depths, mark_nearest
from sceneloom.scene import Identifier


def view_points(
    points_world: Float64Array,
    camera: Camera,
    world_from_camera: RigidTransform,
    rgb: UInt8Array,
    *,
    camera_id: Identifier,
    timestamp_ns: int,
    visibility: VisibilitySettings | None = None,
    way: LidarWay | None = None,
) -> FusedView:
    """Project a cloud into a picture, tell what is hidden, and draw the depth image of what is seen.

    Args:
        points_world: (N, 3) float64 [m]; points that are not finite are in no picture.
        camera: the lens of the picture.
        world_from_camera: where the camera was.
        rgb: (H, W, 3) uint8, of the lens's size.
        camera_id: the camera.
        timestamp_ns: the picture's time [ns].
        visibility: what counts as hidden; None for the usual settings.
        way: from where the lidar measured the points; None where that is not known.

    Raises:
        ArrayError: an array has another shape or dtype.
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    check_array("points_world", points_world, (None, 3), np.float64)
    settings = VisibilitySettings() if visibility is None else visibility
    points, camera_from_world = np.ascontiguousarray(points_world), world_from_camera.inverse().matrix
    point_ids, pixels, depths = _project(points, camera, camera_from_world)
    visible = (
        find_visible(points, point_ids, camera_from_world, settings, way=way)
        if settings.enabled
        else np.ones(len(point_ids), np.bool_)
    )
    depth_image = np.zeros((camera.height, camera.width), np.float32)
    draw_depths(pixels, depths, visible, depth_image)
    if not settings.enabled:
        mark_nearest(pixels, depths, depth_image, visible)
    return FusedView(
        camera_id,
        camera,
        timestamp_ns,
        world_from_camera,
        rgb,
        point_ids,
        pixels,
        depths,
        visible,
        depth_image,
        points,
    )


def _project(
    points_world: Float64Array, camera: Camera, camera_from_world: Float64Array
) -> tuple[Int64Array, Float32Array, Float32Array]:
    """Give ids, pixels and depths of the points that fall into the picture."""
    count = len(points_world)
    point_ids, pixels = np.empty(count, np.int64), np.empty((count, 2), np.float32)
    depths = np.empty(count, np.float32)
    kept = projection_kernel(camera.model)(
        points_world,
        camera_from_world,
        lens_vector(camera),
        camera.width,
        camera.height,
        point_ids,
        pixels,
        depths,
    )
    if 2 * kept > count:
        return point_ids[:kept], pixels[:kept], depths[:kept]
    # The view may live long, and must not hold the room that all points would have needed.
    return point_ids[:kept].copy(), pixels[:kept].copy(), depths[:kept].copy()
