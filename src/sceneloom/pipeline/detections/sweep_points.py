"""The points of the sweep to which boxes belong, in the lidar's frame at their time."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sceneloom.arrays import Float32Array
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.span import sweep_period_ns
from sceneloom.scene.types import Identifier, PointsFrame


@dataclass(frozen=True, slots=True, eq=False)
class SweepPoints:
    """Gives the points of a lidar by time; nothing is kept.

    Attributes:
        lidar: the lidar.
        source: `world_from_lidar`.
        period_ns: time from sweep to sweep [ns].
    """

    lidar: LidarSensor
    source: PoseSource
    period_ns: int

    @classmethod
    def of(cls, scene: Scene, lidar_id: Identifier, source: PoseSource) -> Self | None:
        """The points of a lidar of a scene; None where it has no such sweeps, or points in the ego's frame."""
        for lidar in scene.lidars:
            if lidar.id == lidar_id and len(lidar.frames) and lidar.points_frame is not PointsFrame.EGO:
                return cls(lidar, source, sweep_period_ns(lidar))
        return None

    def at(self, time_ns: int) -> Float32Array | None:
        """Points (N, 3) float32 [m] of the sweep that is under way at a time [ns]; None where there is none.

        Points of the sensor are taken as they were measured: those that it saw at that time lie exactly, others as far
        off as the ego got in between.

        Raises:
            DataError: the sweep cannot be read.
            PoseError: it is not known where the lidar was.
        """
        timestamps = self.lidar.frames.timestamps_ns
        row = int(np.searchsorted(timestamps, time_ns, side="right")) - 1
        if row < 0 or time_ns - int(timestamps[row]) > self.period_ns:
            return None
        positions = self.lidar.frames[row].points.positions
        if self.lidar.points_frame is PointsFrame.SENSOR:
            return np.ascontiguousarray(positions)
        return self._from_world(positions, time_ns)

    def _from_world(self, positions: Float32Array, time_ns: int) -> Float32Array:
        pose = self.source.at(np.array([time_ns], np.int64))
        if not np.isfinite(pose.positions).all():
            raise PoseError(f"it is not known where lidar {self.lidar.id!r} was at {time_ns} ns")
        world_from_lidar = RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])
        return world_from_lidar.inverse().apply(positions).astype(np.float32)
