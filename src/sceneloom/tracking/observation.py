"""What a tracker is reported one moment: what was found in a sweep and in the images, and where the lidar was."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Self

from sceneloom.cameras.camera import Camera
from sceneloom.detections.projection import fuse_by_projection
from sceneloom.detections.results import DetectionAlgorithm, DetectionPair, FusedBoxes
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.types import Identifier


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera at one moment.

    Attributes:
        camera: its camera model.
        camera_from_lidar: takes the lidar's frame at the time of the sweep into the camera's at that of its image.
    """

    camera: Camera
    camera_from_lidar: RigidTransform


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What was seen at one moment.

    Attributes:
        timestamp_ns: of the sweep [ns].
        world_from_lidar: takes the lidar's frame at that time into a world that is stationary, z up.
        fused: by camera, the objects behind the boxes of the sweep and those of that camera's image. A box of the
            sweep is in each of them, and known by its number in `rows_3d`. Nothing was looked at where it is empty.
        views: the cameras by which boxes are put into images. A camera of `fused` without one has no images: what
            is stated for its sweep counts, and no box in an image is given.
    """

    timestamp_ns: int
    world_from_lidar: RigidTransform
    fused: Mapping[Identifier, FusedBoxes] = field(default_factory=dict)
    views: Mapping[Identifier, View] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "fused", MappingProxyType(dict(self.fused)))
        object.__setattr__(self, "views", MappingProxyType(dict(self.views)))

    @classmethod
    def of_pairs(
        cls,
        pairs: Mapping[Identifier, DetectionPair],
        world_from_lidar: RigidTransform,
        *,
        fuse: DetectionAlgorithm = fuse_by_projection,
    ) -> Self:
        """Fuse the boxes of one sweep with those of each camera's image.

        Args:
            pairs: by camera, the same boxes of the sweep with those of its image; one at least.
            world_from_lidar: where the lidar was at the time of the sweep.
            fuse: how.

        Raises:
            OptionError: the boxes of the sweep are not in the lidar's frame.
        """
        return cls(
            next(iter(pairs.values())).boxes_3d.timestamp_ns,
            world_from_lidar,
            {camera_id: fuse(pair) for camera_id, pair in pairs.items()},
            {camera_id: View(pair.camera, pair.camera_from_lidar) for camera_id, pair in pairs.items()},
        )
