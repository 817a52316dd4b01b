"""What the records of table 10 report, for those in the same process who go on from there."""

from dataclasses import dataclass

from sceneloom.arrays import Float64Array
from sceneloom.fusion.detection_fusion import FusedDetectionFrame
from sceneloom.fusion.setting import Setting
from sceneloom.geometry.rigid import RigidTransform


@dataclass(frozen=True, slots=True, eq=False)
class FoundObjects:
    """The objects of a sweep and an image, and where the lidar was.

    Attributes:
        frame: the objects, in the lidar's frame of the standard axes.
        world_from_lidar: at the time of the sweep; the identity where the ego trajectory did not count.
        origin: (3,) float64 [m], where that world's origin is in the world of the vehicle's trajectory: it goes along
            with it.
        setting: the configuration in force when the sweep came.
    """

    frame: FusedDetectionFrame
    world_from_lidar: RigidTransform
    origin: Float64Array
    setting: Setting
