"""Sensor data fusion: a sweep and the images that belong to it become coloured points and depth images."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.colouring.algorithms import FusionAlgorithm, ViewRequest
from sceneloom.colouring.results import FusedFrame, LidarTrajectory
from sceneloom.colouring.rolling_shutter import ShutterDirection
from sceneloom.errors import DataError, PoseError
from sceneloom.fusion.pairing import KnownCamera, KnownLidar, Pairing, Waiting, stationary
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import points_to_world
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.point_times import TimesFound
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class TimedSweep:
    """A sweep whose point times are on the scene's clock.

    Attributes:
        frame: the sweep.
        times: what its times were.
    """

    frame: LidarFrame
    times: TimesFound

    @property
    def timestamp_ns(self) -> int:
        """Of the sweep [ns]."""
        return self.frame.timestamp_ns


SweepPairing = Pairing[TimedSweep, CameraImage]
_Placed = Callable[[PoseSource | None], PoseSource | None]


@dataclass(slots=True)
class _Pairs:
    """The images found for one sweep, and the cameras without one."""

    extrapolated: bool
    requests: list[ViewRequest] = field(default_factory=list)
    unpaired: list[Identifier] = field(default_factory=list)
    unposed: list[Identifier] = field(default_factory=list)
    extras: dict[Identifier, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(slots=True)
class SweepFusion:
    """Fuses sweeps with images.

    Attributes:
        lidars, cameras: what is known of the sensors.
        on_unreadable: called for an image that cannot be decoded, which then counts as unpaired; None: it raises.
    """

    lidars: Mapping[Identifier, KnownLidar]
    cameras: Mapping[Identifier, KnownCamera]
    on_unreadable: Callable[[DataError], None] | None = None
    _decoded: dict[Identifier, tuple[CameraImage, UInt8Array]] = field(default_factory=dict)

    def fuse(self, waiting: Waiting[TimedSweep], pairing: SweepPairing) -> tuple[FusedFrame, ...]:
        """Fuse a sweep; where the ego trajectory does not reach, the result says so.

        Where it reaches the sweep and only some of the images, and those beyond it are to be fused as if the ego had
        not moved, these are a second result: what a camera shows does not depend on how late another's image is.
        """
        settings = waiting.configuration
        if not settings.motion_compensation:
            return (self._fuse_stationary(waiting, pairing, self.cameras),)
        fused = self._fuse(waiting, pairing, self.cameras, lambda source: source)
        if not settings.stand_beyond_trajectory or not (fused.unfused or fused.unposed):
            return (fused,)
        if not fused.views:
            return (self._fuse_stationary(waiting, pairing, self.cameras),)
        beyond = {camera_id: self.cameras[camera_id] for camera_id in fused.unposed}
        return replace(fused, unposed=()), self._fuse_stationary(waiting, pairing, beyond)

    def _fuse_stationary(
        self, waiting: Waiting[TimedSweep], pairing: SweepPairing, cameras: Mapping[Identifier, KnownCamera]
    ) -> FusedFrame:
        return replace(self._fuse(waiting, pairing, cameras, stationary), stationary=True)

    def _fuse(
        self,
        waiting: Waiting[TimedSweep],
        pairing: SweepPairing,
        cameras: Mapping[Identifier, KnownCamera],
        placed: _Placed,
    ) -> FusedFrame:
        frame, lidar = waiting.frame.frame, self.lidars[waiting.lidar_id]
        fused = FusedFrame(
            waiting.lidar_id,
            waiting.index,
            frame.timestamp_ns,
            waiting.reference_ns,
            frame.points,
            extras=frame.extras,
            times=waiting.frame.times,
        )
        source, location = placed(lidar.source), placed(lidar.location)
        try:
            positions_world, extrapolated = (
                (frame.points.positions.astype(np.float64), False) if source is None else points_to_world(frame, source)
            )
        except PoseError as error:
            return replace(fused, unfused=f"beyond the trajectory: {error}")
        points = replace(frame.points, positions=positions_world.astype(np.float32))
        if not cameras:
            return replace(fused, points=points, extrapolated=extrapolated)
        pairs = _Pairs(extrapolated=extrapolated)
        for camera in cameras.values():
            self._pair(waiting, pairing, camera, placed(camera.source) or camera.source, pairs)
        trajectory = None if location is None else LidarTrajectory.of(frame, location)
        algorithm: FusionAlgorithm = waiting.algorithm
        coloured = algorithm(positions_world, pairs.requests, waiting.configuration.visibility, trajectory=trajectory)
        return replace(
            fused,
            points=replace(points, colors=coloured.colors, camera_index=coloured.camera_index),
            views=coloured.views,
            unpaired=tuple(pairs.unpaired),
            unposed=tuple(pairs.unposed),
            extrapolated=pairs.extrapolated,
            image_extras=pairs.extras,
        )

    def _pair(
        self,
        waiting: Waiting[TimedSweep],
        pairing: SweepPairing,
        camera: KnownCamera,
        source: PoseSource,
        pairs: _Pairs,
    ) -> None:
        """Find the camera's image for a sweep and where it was taken, or note why there is none."""
        image = pairing.partner(waiting, camera.id)
        if image is None:
            pairs.unpaired.append(camera.id)
            return
        location = source.mounted(image.mount)
        pose = location.at(np.array([image.timestamp_ns], np.int64))
        if pose.coverage[0] == 2:
            pairs.unposed.append(camera.id)
            return
        rgb = self._rgb(camera.id, image)
        if rgb is None:
            pairs.unpaired.append(camera.id)
            return
        pairs.extrapolated |= bool(pose.coverage[0] == 1)
        pairs.extras[camera.id] = image.extras
        pairs.requests.append(
            ViewRequest(
                camera_id=camera.id,
                camera_index=camera.index,
                camera=image.camera,
                timestamp_ns=image.timestamp_ns,
                world_from_camera=RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0]),
                rgb=rgb,
                shutter=ShutterDirection.of(camera.shutter, image.timestamp_ns, location),
            )
        )

    def _rgb(self, camera_id: Identifier, image: CameraImage) -> UInt8Array | None:
        """Decode once where several sweeps are paired with one image."""
        kept = self._decoded.get(camera_id)
        if kept is None or kept[0] is not image:
            try:
                kept = image, image.rgb
            except DataError as error:
                if self.on_unreadable is None:
                    raise
                self.on_unreadable(error)
                return None
            self._decoded[camera_id] = kept
        return kept[1]
