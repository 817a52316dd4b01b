"""The points of a lidar in the world at the time of an image: evidence of what hides things from the camera."""

from dataclasses import dataclass, field

import numpy as np

from sceneloom.arrays import FloatArray
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.point_times import timed_frame
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.span import sweep_period_ns
from sceneloom.visibility.points import points_in_world

_LATEST_PERIODS = 2
"""A sweep that began more than so many periods before an image is no evidence of it."""


@dataclass(slots=True)
class SweptPoints:
    """Gives the points that a lidar measured about a time; the last sweep is kept, since images follow each other.

    Attributes:
        lidar: the lidar.
        location: takes its points as stored into the world.
    """

    lidar: LidarSensor
    location: PoseSource
    _kept: tuple[int, FloatArray | None] = field(default=(-1, None))

    def at(self, time_ns: int) -> FloatArray | None:
        """Give the points (N, 3) [m] of the sweep that is under way at a time [ns]; None where there is none.

        Raises:
            DataError: the sweep cannot be read.
        """
        timestamps = self.lidar.frames.timestamps_ns
        index = int(np.searchsorted(timestamps, time_ns, side="right")) - 1
        period_ns = sweep_period_ns(self.lidar)
        if index < 0 or time_ns - int(timestamps[index]) > _LATEST_PERIODS * period_ns:
            return None
        if self._kept[0] != index:
            frame = timed_frame(self.lidar.frames[index], period_ns).frame
            times = frame.points.timestamps_ns
            if times is None:
                times = np.full(len(frame.points), frame.timestamp_ns, np.int64)
            self._kept = index, points_in_world(self.location, frame.points.positions, times)
        return self._kept[1]
