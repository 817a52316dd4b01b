"""The algorithms of sensor-data fusion, by name."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Protocol

import numpy as np

from sceneloom.arrays import Float64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.colouring.blending import blend_colours
from sceneloom.colouring.colours import colour_points
from sceneloom.colouring.lidar_trajectory import LidarTrajectory
from sceneloom.colouring.normals import estimate_normals
from sceneloom.colouring.results import FusedView
from sceneloom.colouring.views import view_points
from sceneloom.colouring.visibility import VisibilitySettings
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.thread_pool import ThreadPool
from sceneloom.scene.types import Identifier
from sceneloom.visibility.rolling_shutter import ShutterDirection


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewRequest:
    """An image that a cloud is to be fused with.

    Attributes:
        camera_id: the camera.
        camera_index: its number, which the points coloured from this image will bear, 0 to 254.
        camera: the camera model of the image.
        timestamp_ns: the image's time [ns].
        world_from_camera: where the camera was at that time.
        rgb: (H, W, 3) uint8, the image.
        shutter: where the camera was while the image's lines were taken; None where they were taken at once.
    """

    camera_id: Identifier
    camera_index: int
    camera: Camera
    timestamp_ns: int
    world_from_camera: RigidTransform
    rgb: UInt8Array
    shutter: ShutterDirection | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ColouredPoints:
    """What an algorithm gives.

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
        """Fuse (N, 3) float64 points [m] with images; `trajectory` says from where they were measured."""
        ...


def fuse_by_projection(
    points_world: Float64Array,
    requests: Sequence[ViewRequest],
    visibility: VisibilitySettings,
    *,
    trajectory: LidarTrajectory | None = None,
) -> ColouredPoints:
    """Project the cloud into each image and take colours and depths where points are seen.

    Args:
        points_world: (N, 3) float64 [m].
        requests: the images.
        visibility: what counts as hidden.
        trajectory: from where the lidar measured the points; None where that is not known.

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
    """Do as `fuse_by_projection`, but with the weighted mean of the colours of all images that show a point.

    Takes and raises what `fuse_by_projection` does. Points count as measured with the images.
    """
    views = _views(points_world, requests, visibility, trajectory)
    indices = [request.camera_index for request in requests]
    normals = None
    if views:
        eyes = [request.world_from_camera.translation for request in requests]
        normals = estimate_normals(points_world, np.mean(eyes, axis=0))
    blended = blend_colours(points_world, views, indices, normals_world=normals)
    return ColouredPoints(views, blended.colors, blended.sources.camera_index)


def _views(
    points_world: Float64Array,
    requests: Sequence[ViewRequest],
    visibility: VisibilitySettings,
    trajectory: LidarTrajectory | None,
) -> tuple[FusedView, ...]:
    """The cloud in each image."""
    # Threads share the images where these are enough, which has them wait for one another once only.
    many = len(requests) >= visibility.threads
    settings = replace(visibility, threads=1) if many and visibility.threads > 1 else visibility

    def view(request: ViewRequest) -> FusedView:
        return view_points(
            points_world,
            request.camera,
            request.world_from_camera,
            request.rgb,
            camera_id=request.camera_id,
            timestamp_ns=request.timestamp_ns,
            visibility=settings,
            trajectory=trajectory,
            shutter=request.shutter,
        )

    thread_pool = ThreadPool(visibility.threads if many else 1)
    return tuple(thread_pool.gather([partial(view, request) for request in requests]))


ALGORITHMS: Mapping[str, FusionAlgorithm] = MappingProxyType(
    {"projection": fuse_by_projection, "blending": fuse_by_blending}
)
"""Name of each algorithm and the function that runs it.

Source: DB34/T 4101-2022, table 2, property `fusion_algorithm`.
"""
