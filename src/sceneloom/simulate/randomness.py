"""Random numbers that depend on what they are for, never on the order in which it is asked for."""

from enum import IntEnum, unique

import numpy as np


@unique
class Stream(IntEnum):
    """What random numbers are for; the values are part of what a seed means."""

    PATH = 0
    STREET = 1
    LIDAR = 2
    ACCELEROMETER = 3
    GYROSCOPE = 4
    GNSS = 5
    TRAFFIC = 6
    FAULTS = 20
    DETECTIONS_3D = 21
    DETECTIONS_2D = 22
    RADAR = 10
    EXPOSURE = 11


def generator_for(seed: int, stream: Stream, index: int = 0, *, sensor: int = 0) -> np.random.Generator:
    """Give the generator of one stream, of one frame in it, and of one sensor where several share the stream."""
    key = (int(stream), index, sensor) if sensor else (int(stream), index)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))
