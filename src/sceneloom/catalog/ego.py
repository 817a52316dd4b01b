"""The ego over time, as far as a scene reports it without reading frames: location, speed, latitude and longitude."""

import math
from dataclasses import dataclass

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, geodetic_from_enu
from sceneloom.motion.gnss_receivers import usable_positions
from sceneloom.scene.ego import stated_origin
from sceneloom.scene.motion import GnssSensor, OdometrySensor
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates

WINDOW_NS = 500_000_000
"""Speeds are those over so long, so that the noise of poses does not count as motion."""

REACH_NS = 1_000_000_000
"""So far beyond its first and last point a trajectory holds."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryPoints:
    """Points over time.

    Attributes:
        timestamps_ns: (N,) int64 [ns], strictly increasing.
        positions: (N, 3) float64 [m].
    """

    timestamps_ns: Int64Array
    positions: Float64Array

    @classmethod
    def of(cls, timestamps_ns: Int64Array, positions: Float64Array) -> "TrajectoryPoints | None":
        """Make a way of points in any order, without those that are no numbers; None where none is left."""
        known = np.flatnonzero(np.isfinite(positions).all(axis=1))
        times, rows = np.unique(timestamps_ns[known], return_index=True)
        return cls(times, positions[known][rows]) if len(times) else None

    def at(self, timestamps_ns: Int64Array) -> Float64Array:
        """Give the points (M, 3) at times (M,) [ns]; NaN where it does not reach."""
        times = self._seconds(timestamps_ns)
        own = self._seconds(self.timestamps_ns)
        axes = [np.interp(times, own, axis) for axis in self.positions.T]
        points: Float64Array = np.stack(axes, axis=-1)
        reach = REACH_NS / 1e9
        points[(times < own[0] - reach) | (times > own[-1] + reach)] = np.nan
        return points

    def speeds(self, timestamps_ns: Int64Array) -> Float64Array:
        """Give the speeds (M,) [m/s] at times (M,) [ns]; NaN where it does not reach, or for a single point."""
        first, last = int(self.timestamps_ns[0]), int(self.timestamps_ns[-1])
        inside = np.clip(timestamps_ns, -(2**63) + WINDOW_NS, 2**63 - 1 - WINDOW_NS)
        start = np.clip(inside - WINDOW_NS // 2, first, max(first, last - WINDOW_NS))
        stop = np.clip(np.minimum(start, 2**63 - 1 - WINDOW_NS) + WINDOW_NS, first, last)
        seconds = (stop - start) / 1e9
        gone = np.linalg.norm(self.at(stop) - self.at(start), axis=1)
        unknown = np.full(len(seconds), np.nan)
        speeds: Float64Array = np.divide(gone, seconds, out=unknown, where=seconds > 0)
        speeds[np.isnan(self.at(timestamps_ns)[:, 0])] = np.nan
        return speeds

    @property
    def metres(self) -> float:
        """Its length [m]."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    def _seconds(self, timestamps_ns: Int64Array) -> Float64Array:
        seconds: Float64Array = (timestamps_ns - self.timestamps_ns[0]) / 1e9
        return seconds


@dataclass(frozen=True, slots=True, eq=False)
class Ego:
    """What is known of the ego.

    Attributes:
        trajectory: in the scene's world, or None.
        fixes: of the first satellite receiver that has usable ones, earth-centred, or None.
        origin_lla: the location whose east, north and up are the world's axes, or None.
    """

    trajectory: TrajectoryPoints | None
    fixes: TrajectoryPoints | None
    origin_lla: tuple[float, float, float] | None

    @classmethod
    def of(cls, scene: Scene) -> "Ego":
        """Take it from the first trajectory, the odometry, or what poses in the world a sensor has; and from fixes."""
        return cls(_trajectory(scene), _fixes(scene), stated_origin(scene))

    def positions(self, timestamps_ns: Int64Array) -> Float64Array:
        """Where it was in the world, (M, 3) [m]; NaN where that is not known."""
        return _unknown(timestamps_ns, 3) if self.trajectory is None else self.trajectory.at(timestamps_ns)

    def speeds(self, timestamps_ns: Int64Array) -> Float64Array:
        """How fast it was, (M,) [m/s]; NaN where that is not known."""
        trajectory = self.trajectory or self.fixes
        return _unknown(timestamps_ns, 1)[:, 0] if trajectory is None else trajectory.speeds(timestamps_ns)

    def positions_lla(self, timestamps_ns: Int64Array) -> Float64Array:
        """Latitude, longitude [deg] and height [m], (M, 3); NaN where they are not known."""
        if self.fixes is not None:
            return geodetic_from_ecef(self.fixes.at(timestamps_ns))
        if self.origin_lla is not None and self.trajectory is not None:
            return geodetic_from_enu(self.trajectory.at(timestamps_ns), self.origin_lla)
        return _unknown(timestamps_ns, 3)

    @property
    def metres(self) -> float:
        """Length of its trajectory [m]; NaN where that is not known."""
        return math.nan if self.trajectory is None else self.trajectory.metres


def _unknown(timestamps_ns: Int64Array, width: int) -> Float64Array:
    return np.full((len(timestamps_ns), width), np.nan)


def _trajectory(scene: Scene) -> TrajectoryPoints | None:
    for trajectory in scene.trajectories.values():
        return TrajectoryPoints.of(trajectory.timestamps_ns, trajectory.positions)
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and not sensor.poses.static:
            return TrajectoryPoints.of(sensor.poses.timestamps_ns, sensor.poses.positions)
    for sensor in scene.sensors:
        poses = getattr(sensor, "poses", None)
        in_world = getattr(sensor, "coordinates", None) is Coordinates.WORLD
        if poses is not None and in_world and not poses.static:
            return TrajectoryPoints.of(poses.timestamps_ns, poses.positions)
    return None


def _fixes(scene: Scene) -> TrajectoryPoints | None:
    for sensor in scene.sensors:
        if isinstance(sensor, GnssSensor):
            rows, locations = usable_positions(sensor)
            if len(rows):
                return TrajectoryPoints.of(sensor.timestamps_ns[rows], ecef_from_geodetic(locations))
    return None
