"""When a scene begins and ends, and how long its sweeps take."""

from collections.abc import Iterable

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.scene import Scene, Sensor

NOMINAL_PERIOD_NS = 100_000_000
"""The sweep period of a lidar with a single frame, or all of one time: 10 Hz, the commonest."""


def usual_period_ns(timestamps_ns: Int64Array) -> int:
    """The median time from one timestamp to the next later one [ns]; the nominal period where there is none.

    Args:
        timestamps_ns: (N,) int64 [ns], in any order.
    """
    steps = np.diff(np.unique(timestamps_ns))
    return int(np.median(steps)) if len(steps) else NOMINAL_PERIOD_NS


def sweep_period_ns(lidar: LidarSensor) -> int:
    """The median time from sweep to sweep [ns]; the nominal one where the timestamps report none."""
    return usual_period_ns(lidar.frames.timestamps_ns)


def scene_period_ns(scene: Scene) -> int:
    """The longest sweep period of the scene's lidars [ns]: how far poses may be extrapolated."""
    return max((sweep_period_ns(lidar) for lidar in scene.lidars), default=NOMINAL_PERIOD_NS)


def frame_times(sensor: Sensor) -> Int64Array:
    """The timestamps (N,) int64 [ns] of whatever the sensor gives over time; empty where it has no time."""
    if isinstance(sensor, LidarSensor | RadarSensor | DepthCameraSensor):
        return sensor.frames.timestamps_ns
    if isinstance(sensor, CameraSensor):
        return sensor.images.timestamps_ns
    if isinstance(sensor, OdometrySensor):
        return np.zeros(0, np.int64) if sensor.poses.static else sensor.poses.timestamps_ns
    if isinstance(sensor, ImuSensor):
        streams = [stream.timestamps_ns for stream in sensor.streams.values()]
        return np.sort(np.concatenate(streams)) if streams else np.zeros(0, np.int64)
    return getattr(sensor, "timestamps_ns", np.zeros(0, np.int64))


def time_span(scene: Scene) -> tuple[int, int] | None:
    """First and last timestamp of what is measured [ns]; None for a scene without time.

    Poses of odometry count only where there is nothing else: they reach beyond what a part of a drive was cut to.
    """
    measuring = [sensor for sensor in scene.sensors if not isinstance(sensor, OdometrySensor)]
    return _span(measuring) or _span(scene.sensors)


def _span(sensors: Iterable[Sensor]) -> tuple[int, int] | None:
    timestamps = [times for times in map(frame_times, sensors) if len(times)]
    if not timestamps:
        return None
    return min(int(times.min()) for times in timestamps), max(int(times.max()) for times in timestamps)
