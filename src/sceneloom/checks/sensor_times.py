"""What several rules state about the times of a sensor: its timestamps, its typical interval, its locations."""

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.scene import Sensor
from sceneloom.scene.span import NOMINAL_PERIOD_NS


def timestamps_of(sensor: Sensor) -> Int64Array:
    """The times of a sensor's frames or images, (N,) int64 [ns]; none for sensors without frames."""
    if isinstance(sensor, CameraSensor):
        return sensor.images.timestamps_ns
    if isinstance(sensor, LidarSensor | RadarSensor | DepthCameraSensor):
        return sensor.frames.timestamps_ns
    return np.zeros(0, np.int64)


def period_ns(timestamps_ns: Int64Array) -> float:
    """The median time from frame to frame [ns]; that of 10 Hz where the timestamps report none."""
    median_ns = float(np.median(np.diff(timestamps_ns))) if len(timestamps_ns) > 1 else 0.0
    return median_ns if median_ns > 0 else float(NOMINAL_PERIOD_NS)


def frames_path(sensor_path: str, sensor: Sensor) -> str:
    """`sensors[3].frames`, or `sensors[3].images`."""
    return f"{sensor_path}.{'images' if isinstance(sensor, CameraSensor) else 'frames'}"


def seconds(nanoseconds: float) -> str:
    """A time in seconds, as findings report it."""
    return f"{nanoseconds / 1e9:.6f} s"
