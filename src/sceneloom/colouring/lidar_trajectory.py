"""From where a lidar measured the points of a sweep."""

from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, check_array
from sceneloom.scene.clouds import LidarFrame
from sceneloom.scene.pose_source import PoseSource


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
        check_array("trajectory.ends_world", self.ends_world, (2, 3), np.float64)
        check_array("trajectory.fractions", self.fractions, (None,), np.float32)

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
