"""Rules about the times of frames, pictures and poses."""

from collections.abc import Iterator

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.checks.rule import Hit, Rule
from sceneloom.checks.subject import Subject
from sceneloom.scene import CameraSensor, LidarSensor, RadarSensor, Sensor, Severity


def stamps_of(sensor: Sensor) -> Int64Array:
    """The times of a sensor's frames or pictures, (N,) int64 [ns]; none for sensors without frames."""
    if isinstance(sensor, CameraSensor):
        return sensor.pictures.timestamps_ns
    if isinstance(sensor, LidarSensor | RadarSensor):
        return sensor.frames.timestamps_ns
    return np.zeros(0, np.int64)


def frames_path(sensor_path: str, sensor: Sensor) -> str:
    """`sensors[3].frames`, or `sensors[3].pictures`."""
    return f"{sensor_path}.{'pictures' if isinstance(sensor, CameraSensor) else 'frames'}"


def _times_not_increasing(subject: Subject) -> Iterator[Hit]:
    for path, sensor in subject.sensors():
        stamps_ns = stamps_of(sensor)
        for k in np.flatnonzero(np.diff(stamps_ns) <= 0).tolist():
            problem = f"{stamps_ns[k + 1]} ns after {stamps_ns[k]} ns; expected a later time than that before"
            yield Hit(f"{frames_path(path, sensor)}[{k + 1}]", problem)


RULES: tuple[Rule, ...] = (
    Rule(
        "frame-times-increasing",
        Severity.ERROR,
        "Frames and pictures of a sensor have strictly increasing times.",
        "Sort the frames by time; give frames of equal times their own, or leave one of them out.",
        find=_times_not_increasing,
    ),
)
