"""Sensor data fusion: a sweep and the images that belong to it become coloured points and depth images."""

from dataclasses import dataclass

from sceneloom.fusion.pairing import Pairing
from sceneloom.scene.cameras import CameraImage
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.point_times import TimesFound


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
