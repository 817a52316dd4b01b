"""Detection fusion: the boxes of a sweep and those of the images that belong to it become objects."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.cameras.camera import Camera
from sceneloom.detections.results import DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.fusion.pairing import KnownCamera, KnownLidar, Pairing, Waiting, stationary
from sceneloom.geometry.interpolation import OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.types import NO_FIELDS, Identifier


@dataclass(frozen=True, slots=True, eq=False)
class SeenBoxes:
    """The boxes of an image, and the camera model that it was seen through.

    Attributes:
        boxes: in the image.
        camera: the camera model.
        mount: `ego_from_camera` where this image has a mounting of its own, else None.
        extras: further fields, by name.
    """

    boxes: Boxes2D
    camera: Camera
    mount: RigidTransform | None = None
    extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)

    @property
    def timestamp_ns(self) -> int:
        """Of the image [ns]."""
        return self.boxes.timestamp_ns


BoxPairing = Pairing[Boxes3D, SeenBoxes]


@dataclass(frozen=True, slots=True, eq=False)
class FusedDetectionFrame:
    """The objects of one pair of a sweep and an image.

    Attributes:
        lidar_id, camera_id: the sensors.
        index: number of the list of boxes in its lidar.
        timestamp_ns: of the sweep [ns].
        image_timestamp_ns: of the image [ns].
        fused: the objects.
        camera: the camera model of the image.
        camera_from_lidar: takes the lidar's frame at the time of the sweep into the camera's at that of the image.
        last: whether no other image of the same sweep comes after it.
        stationary: whether it was fused as if the ego had not moved, because its trajectory did not reach or was not to
            count.
        sweep_extras, image_extras: further fields of the boxes of the sweep and of the image.
    """

    lidar_id: Identifier
    camera_id: Identifier
    index: int
    timestamp_ns: int
    image_timestamp_ns: int
    fused: FusedBoxes
    camera: Camera
    camera_from_lidar: RigidTransform
    last: bool = True
    stationary: bool = False
    sweep_extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)
    image_extras: Mapping[str, Any] = field(default_factory=lambda: NO_FIELDS)


@dataclass(slots=True)
class BoxFusion:
    """Fuses the boxes of sweeps with those of images.

    Attributes:
        lidars, cameras: what is known of the sensors.
    """

    lidars: Mapping[Identifier, KnownLidar]
    cameras: Mapping[Identifier, KnownCamera]

    def fuse(self, waiting: Waiting[Boxes3D], pairing: BoxPairing) -> Iterator[FusedDetectionFrame]:
        """Fuse the boxes of a sweep with those of each image that belongs to it."""
        algorithm: DetectionAlgorithm = waiting.algorithm
        seen_by = list(self._seen_by(waiting, pairing))
        points = None
        if any(len(seen.boxes) for _, seen, _, _ in seen_by):
            points = _points_lidar(self.lidars[waiting.lidar_id], waiting.reference_ns)
        for number, (camera_id, seen, camera_from_lidar, stands) in enumerate(seen_by, start=1):
            pair = DetectionPair(waiting.frame, seen.boxes, seen.camera, camera_from_lidar, points)
            yield FusedDetectionFrame(
                waiting.lidar_id,
                camera_id,
                waiting.index,
                waiting.frame.timestamp_ns,
                seen.timestamp_ns,
                algorithm(pair),
                seen.camera,
                camera_from_lidar,
                last=number == len(seen_by),
                stationary=stands,
                sweep_extras=waiting.extras,
                image_extras=seen.extras,
            )

    def _seen_by(
        self, waiting: Waiting[Boxes3D], pairing: BoxPairing
    ) -> Iterator[tuple[Identifier, SeenBoxes, RigidTransform, bool]]:
        """The boxes of each image of a sweep, `camera_from_lidar`, and whether the ego is taken to are stationary."""
        lidar = self.lidars[waiting.lidar_id]
        for camera in self.cameras.values():
            seen = pairing.partner(waiting, camera.id)
            if seen is None:
                continue
            camera_from_lidar = None
            if waiting.configuration.motion_compensation:
                camera_from_lidar = _camera_from_lidar(lidar, camera, waiting.reference_ns, seen, still=False)
            stands = camera_from_lidar is None
            if camera_from_lidar is None:
                camera_from_lidar = _camera_from_lidar(lidar, camera, waiting.reference_ns, seen, still=True)
            if camera_from_lidar is not None:
                yield camera.id, seen, camera_from_lidar, stands


def _points_lidar(lidar: KnownLidar, time_ns: int) -> Float32Array | None:
    """The points of the sweep of a time in the lidar's frame, as they were measured; None where it has not come."""
    frame = lidar.sweep_at(time_ns)
    if frame is None or len(frame.points) == 0:
        return None
    positions, source, location = frame.points.positions, lidar.source, lidar.location or lidar.source
    if location is None or source is location or (source is not None and source.mount is location.mount):
        return np.ascontiguousarray(positions)
    world_from_lidar = _at(location, time_ns)
    world_from_points = RigidTransform.identity() if source is None else _at(source, time_ns)
    if world_from_lidar is None or world_from_points is None:
        return None
    return (world_from_lidar.inverse() @ world_from_points).apply(positions).astype(np.float32)


def _camera_from_lidar(
    lidar: KnownLidar, camera: KnownCamera, reference_ns: int, seen: SeenBoxes, *, still: bool
) -> RigidTransform | None:
    """Give the transform between a sweep and an image of another time; None where the ego trajectory does not reach."""
    location = lidar.location or lidar.source
    sources = (stationary(location), stationary(camera.source)) if still else (location, camera.source)
    if sources[0] is None or sources[1] is None:
        return None
    if sources[0].path is sources[1].path and sources[0].path.static:
        return _between_mounts(sources[1].mounted(seen.mount).mount, sources[0].mount)
    world_from_lidar = _at(sources[0], reference_ns)
    world_from_camera = _at(sources[1].mounted(seen.mount), seen.timestamp_ns)
    if world_from_lidar is None or world_from_camera is None:
        return None
    return world_from_camera.inverse() @ world_from_lidar


@lru_cache(maxsize=256)
def _between_mounts(ego_from_camera: RigidTransform, ego_from_lidar: RigidTransform) -> RigidTransform:
    """Give `camera_from_lidar` of sensors on an ego that does not move; by object: they are the same for a drive."""
    return ego_from_camera.inverse() @ ego_from_lidar


def _at(source: PoseSource, time_ns: int) -> RigidTransform | None:
    body = source.path.interpolate(np.array([time_ns], np.int64), reach_ns=source.reach_ns)
    if body.coverage[0] == OUT_OF_REACH:
        return None
    return RigidTransform.from_quaternion(body.positions[0], body.quaternions_xyzw[0]) @ source.mount
