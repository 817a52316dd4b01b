"""The points of a cloud in one image, and the algorithms of sensor-data fusion by name."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numba import boolean, void

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import PointsInImage, intrinsics_vector, projection_kernel
from sceneloom.colouring.blending import blend_colours, colour_points
from sceneloom.colouring.results import FusedView, LidarTrajectory
from sceneloom.colouring.rolling_shutter import ShutterDirection, project_by_lines
from sceneloom.colouring.visibility import Looks, VisibilitySettings, find_visible
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.cache import kernel
from sceneloom.kernels.projection import draw_depths, pixel_numbers
from sceneloom.kernels.signatures import IN_F32_1D, IN_F32_2D, IN_I32_1D
from sceneloom.kernels.thread_pool import Phase, ThreadPool
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewRequest:
    """An image that a cloud is to be fused with.

    Attributes:
        camera_id: the camera.
        camera_index: its number, 0 to 254, which the points coloured from this image get.
        camera: the camera model of the image.
        timestamp_ns: the image's time [ns].
        world_from_camera: pose of the camera at that time.
        rgb: (H, W, 3) uint8, the image.
        shutter: poses of the camera while the image's lines were taken; None where they were taken at once.
    """

    camera_id: Identifier
    camera_index: int
    camera: Camera
    timestamp_ns: int
    world_from_camera: RigidTransform
    rgb: UInt8Array
    shutter: ShutterDirection | None = None


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
    """Project a cloud into an image, find what is hidden, and draw the depth image of the visible points.

    Args:
        points_world: (N, 3) float64 [m]; points that are not finite are in no image.
        camera: the camera model of the image.
        world_from_camera: pose of the camera.
        rgb: (H, W, 3) uint8, of the camera model's size.
        camera_id: the camera.
        timestamp_ns: the image's time [ns].
        visibility: what counts as hidden; None for the usual settings.
        trajectory: where the lidar was when it measured the points; None where unknown.
        shutter: poses of the camera while the lines were taken; None where they were taken at once.

    Raises:
        ArrayError: an array has another shape or dtype.
        CalibrationError: the camera's model is unknown or has other coefficients.
    """
    check_array("points_world", points_world, (None, 3), np.float64)
    points, settings = np.ascontiguousarray(points_world), VisibilitySettings() if visibility is None else visibility
    request = ViewRequest(
        camera_id=camera_id, camera_index=0, camera=camera, timestamp_ns=timestamp_ns,
        world_from_camera=world_from_camera, rgb=rgb, shutter=shutter,
    )  # fmt: skip
    return _view(points, settings, trajectory, request)


def _view(
    points: Float64Array, settings: VisibilitySettings, trajectory: LidarTrajectory | None, request: ViewRequest
) -> FusedView:
    camera = request.camera
    thread_pool = ThreadPool.of(settings.threads, len(points))
    seen = _see(points, camera, request.world_from_camera, request.shutter, thread_pool)
    point_ids, depths = seen.point_ids, seen.depths
    visible = np.ones(len(point_ids), np.bool_)
    if settings.enabled:
        if trajectory is not None and seen.world_from_cloud is not None:
            ends = seen.world_from_cloud.inverse().apply(trajectory.ends_world)
            trajectory = LidarTrajectory(ends, trajectory.fractions[point_ids])
        visible = find_visible(
            seen.cloud, seen.rows, seen.camera_from_cloud, settings, trajectory=trajectory, looks=seen.looks
        )
    depth_image = np.zeros((camera.height, camera.width), np.float32)
    draw_depths(seen.pixel_numbers, depths, visible, depth_image, thread_pool=thread_pool)
    if not settings.enabled:
        mark_nearest(seen.pixel_numbers, depths, depth_image, visible)
    return FusedView(
        request.camera_id, camera, request.timestamp_ns, request.world_from_camera, request.rgb, point_ids, seen.pixels,
        seen.pixel_numbers, depths, visible, depth_image, points, request.shutter is not None, seen.unsettled,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The points in an image."""

    point_ids: Int64Array  # as in `FusedView`
    pixels: Float32Array  # as in `FusedView`
    pixel_numbers: Int32Array  # as in `FusedView`
    depths: Float32Array  # as in `FusedView`
    cloud: Float64Array  # (C, 3) float64 [m], in a frame in which the camera has one pose
    rows: Int64Array  # (M,) int64, the points of the image in `cloud`
    camera_from_cloud: Float64Array  # (4, 4) float64
    looks: Looks | None = None  # as of `find_visible`
    world_from_cloud: RigidTransform | None = None  # None where `cloud` is the whole cloud in the world
    unsettled: int = 0  # as in `FusedView`


def _see(
    points_world: Float64Array, camera: Camera, world_from_camera: RigidTransform, shutter: ShutterDirection | None,
    thread_pool: ThreadPool,
) -> _Seen:  # fmt: skip
    if shutter is not None:
        rolled = project_by_lines(points_world, camera, world_from_camera, shutter)
        numbers = pixel_numbers(rolled.pixels, camera.width, camera.height)
        depths, rows = rolled.points_camera[:, 2].astype(np.float32), np.arange(len(rolled.point_ids))
        return _Seen(
            rolled.point_ids, rolled.pixels, numbers, depths, rolled.points_camera, rows, np.eye(4), None,
            world_from_camera, rolled.unsettled,
        )  # fmt: skip
    camera_from_world = world_from_camera.inverse_matrix
    count, directions = len(points_world), np.empty((2, len(points_world)), np.float32)
    room = PointsInImage.room(count)._replace(rightward=directions[0], downward=directions[1])
    kernel, camera_model = projection_kernel(camera.model), intrinsics_vector(camera)
    found: list[tuple[int, int]] = []

    def project(_: int, a: int, b: int) -> None:
        part = PointsInImage._make(rows[a:b] for rows in room)
        found.append((a, kernel(points_world[a:b], camera_from_world, camera_model, camera.width, camera.height, part)))

    thread_pool.share(Phase(count, project))
    kept = 0
    for start, size in sorted(found):
        if start > 0:
            room.point_ids[start : start + size] += start
        if start > kept:
            for column in room:
                column[kept : kept + size] = column[start : start + size]
        kept += size
    looks = np.ascontiguousarray(directions[:, :kept]), room.inverse_ranges[:kept]
    ids, pixels, numbers = room.point_ids[:kept], room.pixels[:kept], room.pixel_numbers[:kept]
    depths = room.depths[:kept]
    if 2 * kept <= count:
        # The view may live long, and must not hold the memory that all points would have needed.
        ids, pixels, numbers, depths = ids.copy(), pixels.copy(), numbers.copy(), depths.copy()
    return _Seen(ids, pixels, numbers, depths, points_world, ids, camera_from_world, looks)


@dataclass(frozen=True, slots=True, eq=False)
class ColouredPoints:
    """The result of an algorithm.

    Attributes:
        views: the cloud in each image, in the order of the requests.
        colors: (N, 3) uint8; 255, 255, 255 for a point that no image shows.
        camera_index: (N,) uint8, which camera coloured the point, 255 for none.
    """

    views: tuple[FusedView, ...]
    colors: UInt8Array
    camera_index: UInt8Array


class FusionAlgorithm(Protocol):
    """How an algorithm is called."""

    def __call__(
        self,
        points_world: Float64Array,
        requests: Sequence[ViewRequest],
        visibility: VisibilitySettings,
        /,
        *,
        trajectory: LidarTrajectory | None = None,
    ) -> ColouredPoints:
        """Fuse (N, 3) float64 points [m] with images; `trajectory` is that of the lidar."""
        ...


def fuse_by_projection(
    points_world: Float64Array,
    requests: Sequence[ViewRequest],
    visibility: VisibilitySettings,
    *,
    trajectory: LidarTrajectory | None = None,
) -> ColouredPoints:
    """Project the cloud into each image and take colours and depths of visible points.

    Args:
        points_world: (N, 3) float64 [m].
        requests: the images.
        visibility: what counts as hidden.
        trajectory: where the lidar was when it measured the points; None where unknown.

    Raises:
        ArrayError: an array has another shape or dtype.
        CalibrationError: a camera's model is unknown or has other coefficients.
        OptionError: a camera's index is out of range.
    """
    views = _views(points_world, requests, visibility, trajectory)
    indices = [request.camera_index for request in requests]
    colors, camera_index = colour_points(len(points_world), views, indices, threads=visibility.threads)
    return ColouredPoints(views, colors, camera_index)


def fuse_by_blending(
    points_world: Float64Array,
    requests: Sequence[ViewRequest],
    visibility: VisibilitySettings,
    *,
    trajectory: LidarTrajectory | None = None,
) -> ColouredPoints:
    """As `fuse_by_projection`, but with the mean of the colours of all images that show a point.

    Points count as measured with the images.
    """
    views = _views(points_world, requests, visibility, trajectory)
    indices = [request.camera_index for request in requests]
    blended = blend_colours(points_world, views, indices)
    return ColouredPoints(views, blended.colors, blended.sources.camera_index)


def _views(
    points_world: Float64Array,
    requests: Sequence[ViewRequest],
    visibility: VisibilitySettings,
    trajectory: LidarTrajectory | None,
) -> tuple[FusedView, ...]:
    """The cloud in each image."""
    # Threads share the images where there are enough: they then wait for one another only once.
    many = len(requests) >= visibility.threads
    settings = replace(visibility, threads=1) if many and visibility.threads > 1 else visibility
    check_array("points_world", points_world, (None, 3), np.float64)
    view = partial(_view, np.ascontiguousarray(points_world), settings, trajectory)
    thread_pool = ThreadPool(visibility.threads if many else 1)
    return tuple(thread_pool.gather([partial(view, request) for request in requests]))


ALGORITHMS: Mapping[str, FusionAlgorithm] = MappingProxyType(
    {"projection": fuse_by_projection, "blending": fuse_by_blending}
)
"""Name of each algorithm and the function that runs it.

Source: DB34/T 4101-2022, table 2, property `fusion_algorithm`.
"""

_NOTHING, _STATIC = np.float32(0.0), np.float32(math.inf)


@kernel(void(IN_I32_1D, IN_F32_1D, IN_F32_2D, boolean[::1]))
def mark_nearest(
    pixel_numbers: Int32Array, depths: Float32Array, depth_image: Float32Array, visible: BoolArray
) -> None:
    """Mark the points that are the nearest of their pixel, by a z-buffer over all of them.

    `pixel_numbers` (M,), counted row by row; negative outside the image; `depths` (M,) [m]; `depth_image` (H, W) [m],
    least depth of each pixel, 0 for nothing; `visible` (M,), written; equally near points are all visible, and so is a
    point of a very wide camera model beside or behind the camera (depth <= 0), with which no depth can be compared.
    """
    image = depth_image.reshape(depth_image.size)
    for i in range(depths.shape[0]):
        inside = (pixel_numbers[i] >= 0) & (pixel_numbers[i] < image.shape[0])
        nearest = image[np.uint32(pixel_numbers[i])] if inside else -_STATIC
        visible[i] = inside & (depths[i] <= max(nearest, _NOTHING))
