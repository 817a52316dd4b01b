"""The points of one cloud in one image: where they fall, which of them are seen, and the depth image they make."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import (
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
    check_array,
)
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.models import intrinsics_vector, projection_kernel
from sceneloom.cameras.points_in_image import PointsInImage
from sceneloom.colouring.lidar_trajectory import LidarTrajectory
from sceneloom.colouring.results import FusedView
from sceneloom.colouring.visibility import Looks, VisibilitySettings, find_visible
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.depth_images import draw_depths, mark_nearest
from sceneloom.kernels.pixel_numbers import pixel_numbers
from sceneloom.kernels.thread_pool import ThreadPool
from sceneloom.scene.types import Identifier
from sceneloom.visibility.rolling_shutter import ShutterDirection, project_by_lines


def view_points(
    points_world: Float64Array,
    camera: Camera,
    world_from_camera: RigidTransform,
    rgb: UInt8Array,
    *,
    camera_id: Identifier,
    timestamp_ns: int,
    visibility: VisibilitySettings | None = None,
    trajectory: LidarTrajectory | None = None,
    shutter: ShutterDirection | None = None,
) -> FusedView:
    """Project a cloud into an image, report what is hidden, and draw the depth image of what is seen.

    Args:
        points_world: (N, 3) float64 [m]; points that are not finite are in no image.
        camera: the camera model of the image.
        world_from_camera: where the camera was.
        rgb: (H, W, 3) uint8, of the camera model's size.
        camera_id: the camera.
        timestamp_ns: the image's time [ns].
        visibility: what counts as hidden; None for the usual settings.
        trajectory: from where the lidar measured the points; None where that is not known.
        shutter: where the camera was while the lines were taken; None where they were taken at once.

    Raises:
        ArrayError: an array has another shape or dtype.
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    check_array("points_world", points_world, (None, 3), np.float64)
    settings = VisibilitySettings() if visibility is None else visibility
    points = np.ascontiguousarray(points_world)
    thread_pool = ThreadPool.of(settings.threads, len(points))
    seen = _see(points, camera, world_from_camera, shutter, thread_pool)
    point_ids, depths = seen.point_ids, seen.depths
    visible = (
        find_visible(
            seen.cloud,
            seen.rows,
            seen.camera_from_cloud,
            settings,
            trajectory=seen.known(trajectory),
            looks=seen.looks,
        )
        if settings.enabled
        else np.ones(len(point_ids), np.bool_)
    )
    depth_image = _empty_image(camera, thread_pool)
    draw_depths(seen.pixel_numbers, depths, visible, depth_image, thread_pool=thread_pool)
    if not settings.enabled:
        mark_nearest(seen.pixel_numbers, depths, depth_image, visible)
    return FusedView(
        camera_id,
        camera,
        timestamp_ns,
        world_from_camera,
        rgb,
        point_ids,
        seen.pixels,
        seen.pixel_numbers,
        depths,
        visible,
        depth_image,
        points,
        shutter is not None,
        seen.unsettled,
    )


def _empty_image(camera: Camera, thread_pool: ThreadPool) -> Float32Array:
    """Give an image of zeros, to which all threads of a thread pool put a hand."""
    if thread_pool.size == 1:
        return np.zeros((camera.height, camera.width), np.float32)
    image = np.empty((camera.height, camera.width), np.float32)
    thread_pool.share(camera.height, lambda _, top, bottom: image[top:bottom].fill(0.0))
    return image


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The points in an image, and how the camera saw them.

    Attributes:
        point_ids, pixels, pixel_numbers, depths: as in `FusedView`.
        cloud: (C, 3) float64 [m], a frame in which the camera has one pose.
        rows: (M,) int64, the points of the image in `cloud`.
        camera_from_cloud: (4, 4) float64.
        looks: as of `find_visible`.
        world_from_cloud: None where `cloud` is the whole cloud in the world.
        unsettled: as in `FusedView`.
    """

    point_ids: Int64Array
    pixels: Float32Array
    pixel_numbers: Int32Array
    depths: Float32Array
    cloud: Float64Array
    rows: Int64Array
    camera_from_cloud: Float64Array
    looks: Looks | None = None
    world_from_cloud: RigidTransform | None = None
    unsettled: int = 0

    def known(self, trajectory: LidarTrajectory | None) -> LidarTrajectory | None:
        """The trajectory of the lidar as `cloud` needs it."""
        if trajectory is None or self.world_from_cloud is None:
            return trajectory
        ends = self.world_from_cloud.inverse().apply(trajectory.ends_world)
        return LidarTrajectory(ends, trajectory.fractions[self.point_ids])


def _see(
    points_world: Float64Array,
    camera: Camera,
    world_from_camera: RigidTransform,
    shutter: ShutterDirection | None,
    thread_pool: ThreadPool,
) -> _Seen:
    if shutter is None:
        camera_from_world = world_from_camera.inverse_matrix
        own, looks = _project(points_world, camera, camera_from_world, thread_pool)
        return _Seen(*own, points_world, own[0], camera_from_world, looks)
    rolled = project_by_lines(points_world, camera, world_from_camera, shutter)
    return _Seen(
        rolled.point_ids,
        rolled.pixels,
        pixel_numbers(rolled.pixels, camera.width, camera.height),
        rolled.points_camera[:, 2].astype(np.float32),
        rolled.points_camera,
        np.arange(len(rolled.point_ids)),
        np.eye(4),
        None,
        world_from_camera,
        rolled.unsettled,
    )


_Own = tuple[Int64Array, Float32Array, Int32Array, Float32Array]


def _project(
    points_world: Float64Array, camera: Camera, camera_from_world: Float64Array, thread_pool: ThreadPool
) -> tuple[_Own, Looks]:
    """Give ids, pixels, their numbers and depths of the points in the image, and where the camera sees them."""
    count, directions = len(points_world), np.empty((2, len(points_world)), np.float32)
    room = PointsInImage.room(count)._replace(rightward=directions[0], downward=directions[1])
    kernel, camera_model = projection_kernel(camera.model), intrinsics_vector(camera)
    found: list[tuple[int, int]] = []

    def project(_: int, a: int, b: int) -> None:
        part = room.part(a, b)
        found.append(
            (a, kernel(points_world[a:b], camera_from_world, camera_model, camera.width, camera.height, part))
        )

    thread_pool.share(count, project)
    kept = 0
    for start, size in sorted(found):
        if start > 0:
            room.point_ids[start : start + size] += start
        if start > kept:
            for rows in room:
                rows[kept : kept + size] = rows[start : start + size]
        kept += size
    looks = np.ascontiguousarray(directions[:, :kept]), room.inverse_ranges[:kept]
    own = room.point_ids[:kept], room.pixels[:kept], room.pixel_numbers[:kept], room.depths[:kept]
    if 2 * kept > count:
        return own, looks
    # The view may live long, and must not hold the room that all points would have needed.
    return (own[0].copy(), own[1].copy(), own[2].copy(), own[3].copy()), looks
