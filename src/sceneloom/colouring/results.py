"""Results of sensor-data fusion: coloured points for each lidar frame, a depth image for each camera image."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array, hold_arrays
from sceneloom.cameras.camera import Camera
from sceneloom.cameras.projection import project_unbounded
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarFrame, LidarPoints
from sceneloom.scene.point_times import SOUND, TimesFound
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class LidarTrajectory:
    """The motion of a lidar during one sweep, taken as linear.

    Attributes:
        ends_world: (2, 3) float64 [m], its positions at the first and at the last point.
        fractions: (N,) float32, share of the motion at each point, 0 to 1.
    """

    ends_world: Float64Array
    fractions: Float32Array

    def __post_init__(self) -> None:
        hold_arrays(self, "trajectory", {"ends_world": (np.float64, 2, 3), "fractions": (np.float32, None)})

    @classmethod
    def of(cls, frame: LidarFrame, location: PoseSource) -> "LidarTrajectory | None":
        """The motion of the lidar during a sweep; None beyond its poses.

        Args:
            frame: the sweep; points without times of their own have the frame's.
            location: `world_from_lidar`.
        """
        times = frame.point_times_ns
        start_ns, stop_ns = (int(times.min()), int(times.max())) if len(times) else (frame.timestamp_ns,) * 2
        samples = location.at(np.array([start_ns, stop_ns], np.int64))
        if (samples.coverage == 2).any():
            return None
        fractions = (times - start_ns).astype(np.float32) / np.float32(max(stop_ns - start_ns, 1))
        return cls(samples.positions, fractions)


class PointVisibility(IntEnum):
    """Visibility of a point in an image."""

    VISIBLE = 0
    """It shows the point."""
    HIDDEN = 1
    """Something nearer hides the point."""
    OUTSIDE = 2
    """The point is in front of the camera, beyond the edges of the image."""
    BEHIND = 3
    """No pixel for the point: behind the camera, beyond the model's domain, or not finite."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedView:
    """The points of one lidar frame in one image.

    Attributes:
        camera_id: the camera.
        camera: its camera model.
        timestamp_ns: the image's time [ns].
        world_from_camera: pose of the camera at that time.
        rgb: (H, W, 3) uint8, the image.
        point_ids: (M,) int64, which points of the frame fall into the image, ascending.
        pixels: (M, 2) float32 [px], (u, v); (0, 0) is the centre of the top-left pixel.
        pixel_numbers: (M,) int32, the nearest pixel, counted row by row: `row * W + column`.
        depths: (M,) float32 [m], z in the camera frame.
        visible: (M,) bool, False for a point behind a nearer surface.
        depth_image: (H, W) float32 [m], z of the nearest visible point in each pixel, 0 for none.
        points_world: (N, 3) float64 [m], the whole cloud.
        rolled: whether each point was projected, and its depth measured, with the camera's pose when its line was
            taken.
        unsettled: number of points that may be in the image, though no line was found for them.
    """

    camera_id: Identifier
    camera: Camera
    timestamp_ns: int
    world_from_camera: RigidTransform
    rgb: UInt8Array
    point_ids: Int64Array
    pixels: Float32Array
    pixel_numbers: Int32Array
    depths: Float32Array
    visible: BoolArray
    depth_image: Float32Array
    points_world: Float64Array
    rolled: bool = False
    unsettled: int = 0

    def __post_init__(self) -> None:
        height, width = self.camera.height, self.camera.width
        in_image = {
            "point_ids": (np.int64, "N"), "pixels": (np.float32, "N", 2), "pixel_numbers": (np.int32, "N"),
            "depths": (np.float32, "N"), "visible": (np.bool_, "N"),
        }  # fmt: skip
        images = {"rgb": (np.uint8, height, width, 3), "depth_image": (np.float32, height, width)}
        hold_arrays(self, "view", {**in_image, **images, "points_world": (np.float64, None, 3)})

    @property
    def observations(self) -> UInt8Array:
        """Visibility of each point of the cloud, (N,) uint8 of `PointVisibility`; computed on access."""
        observations = np.full(len(self.points_world), PointVisibility.BEHIND, np.uint8)
        finite = np.flatnonzero(np.isfinite(self.points_world).all(axis=1))
        in_camera = self.world_from_camera.inverse().apply(self.points_world[finite])
        somewhere = np.isfinite(project_unbounded(self.camera, in_camera)).all(axis=1)
        observations[finite[somewhere]] = PointVisibility.OUTSIDE
        observations[self.point_ids] = np.where(self.visible, PointVisibility.VISIBLE, PointVisibility.HIDDEN)
        return observations


@dataclass(frozen=True, slots=True, eq=False)
class FusedFrame:
    """One lidar frame after fusion.

    Attributes:
        lidar_id: the lidar.
        index: number of the frame in its sensor.
        timestamp_ns: start of the sweep [ns].
        reference_ns: the time by which it was paired [ns].
        points: world frame (float32, relative to the scene's origin), deskewed, with colours and camera_index;
            in the frame of the source where `unfused` says why.
        views: one per image that it was paired with.
        unpaired: cameras without an image near enough in time.
        unposed: cameras whose image is beyond the extrapolation limit of the trajectory.
        extrapolated: whether poses beyond the trajectory's ends were used.
        unfused: why the frame could not be fused, or None.
        times: how the times of its points were read; `points` has them as they were read, or none.
        extras: unknown fields of the frame, by name.
        stationary: whether it was fused as if the ego were stationary, beyond its trajectory or by request.
        image_extras: unknown fields of the images that it was paired with, by camera.
    """

    lidar_id: Identifier
    index: int
    timestamp_ns: int
    reference_ns: int
    points: LidarPoints
    views: tuple[FusedView, ...] = ()
    unpaired: tuple[Identifier, ...] = ()
    unposed: tuple[Identifier, ...] = ()
    extrapolated: bool = False
    unfused: str | None = None
    times: TimesFound = SOUND
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    stationary: bool = False
    image_extras: Mapping[Identifier, Mapping[str, Any]] = field(default_factory=dict)
