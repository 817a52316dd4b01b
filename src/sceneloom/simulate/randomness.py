"""Random numbers that depend on what they are for, never on the order in which it is asked for."""

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """What random numbers are for; the values are part of what a seed means."""

    PATH = 0
    STREET = 1
    LIDAR = 2
    ACCELEROMETER = 3
    GYROSCOPE = 4
    GNSS = 5


def generator_for(seed: int, stream: Stream, index: int = 0) -> np.random.Generator:
    """Give the generator of one stream, and of one frame in it."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(stream), index)))
