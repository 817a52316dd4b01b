"""Detection fusion: the boxes of a sweep and those of the images that belong to it become objects."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sceneloom.cameras.camera import Camera
from sceneloom.detections.results import FusedBoxes
from sceneloom.fusion.pairing import Pairing
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.detections import Boxes2D, Boxes3D
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
