"""What sensor-data fusion gives: coloured world points for each lidar frame, a depth image for each camera image.

The lidar positions of a sweep.
"""

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
    """The short trajectory of a lidar during one sweep, taken as straight and even.

    Attributes:
        ends_world: (2, 3) float64 [m], where it was at the first and at the last point.
        fractions: (N,) float32, how far along it was at each point, 0 to 1.
    """

    ends_world: Float64Array
    fractions: Float32Array

    def __post_init__(self) -> None:
        hold_arrays(self, "trajectory", {"ends_world": (np.float64, 2, 3), "fractions": (np.float32, None)})

    @classmethod
    def of(cls, frame: LidarFrame, location: PoseSource) -> "LidarTrajectory | None":
        """Give the trajectory of the lidar during a sweep; None where its poses do not reach.

        Args:
            frame: the sweep; points without times of their own all have the frame's.
            location: `world_from_lidar`.
        """
        times = frame.points.timestamps_ns
        if times is None or len(times) == 0:
            times = np.full(len(frame.points), frame.timestamp_ns, np.int64)
        start_ns, stop_ns = (int(times.min()), int(times.max())) if len(times) else (frame.timestamp_ns,) * 2
        samples = location.at(np.array([start_ns, stop_ns], np.int64))
        if (samples.coverage == 2).any():
            return None
        fractions = (times - start_ns).astype(np.float32) / np.float32(max(stop_ns - start_ns, 1))
        return cls(samples.positions, fractions)


class PointVisibility(IntEnum):
    """How an image stands to a point."""

    VISIBLE = 0
    """It shows the point."""
    HIDDEN = 1
    """The point would fall into it, but something nearer is in the way."""
    OUTSIDE = 2
    """The point lies in front of the camera model, beyond the edges of the image."""
    BEHIND = 3
    """The camera model has no pixel for the point: behind the camera, beyond the model's domain, or not finite."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedView:
    """The points of one lidar frame in one image.

    Attributes:
        camera_id: the camera.
        camera: its camera model.
        timestamp_ns: the image's time [ns].
        world_from_camera: where the camera was at that time.
        rgb: (H, W, 3) uint8, the image.
        point_ids: (M,) int64, which points of the frame fall into the image, ascending.
        pixels: (M, 2) float32 [px], where (u, v), (0, 0) is the centre of the top-left pixel.
        pixel_numbers: (M,) int32, the nearest pixel, counted row by row: `row * W + column`.
        depths: (M,) float32 [m], z in the camera frame.
        visible: (M,) bool, False for a point behind a nearer surface.
        depth_image: (H, W) float32 [m], z of the nearest visible point in each pixel, 0 for none.
        points_world: (N, 3) float64 [m], the whole cloud, as the algorithm got it.
        rolled: whether each point was projected from where the camera was when its own line was taken, and `depths`
            are from there.
        unsettled: points of which no line was found that sees them, though they may be in the image.
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
        hold_arrays(
            self,
            "view",
            {
                "point_ids": (np.int64, "N"),
                "pixels": (np.float32, "N", 2),
                "pixel_numbers": (np.int32, "N"),
                "depths": (np.float32, "N"),
                "visible": (np.bool_, "N"),
                "rgb": (np.uint8, self.camera.height, self.camera.width, 3),
                "depth_image": (np.float32, self.camera.height, self.camera.width),
                "points_world": (np.float64, None, 3),
            },
        )

    @property
    def observations(self) -> UInt8Array:
        """How the image stands to each point of the cloud, (N,) uint8 of `PointVisibility`.

        Worked out when asked for.
        """
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
        unposed: cameras whose image lies beyond the reach of the trajectory.
        extrapolated: whether poses beyond the trajectory's ends were used.
        unfused: why the frame could not be fused, or None.
        times: what the times of its points were; where they could not be taken as they are, `points` has them as they
            were read, or none.
        extras: further fields of the frame, by name.
        stationary: whether it was fused as if the ego had not moved, because its trajectory did not reach or was not to
            count.
        image_extras: further fields of the images that it was paired with, by camera.
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
