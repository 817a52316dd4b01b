"""Bounds on the parameters of simulated devices, and random streams that do not depend on the order of use."""

from collections.abc import Iterable, Iterator, Sequence
from enum import IntEnum, unique

import numpy as np

from sceneloom.errors import OptionError


def check_bounds(device: str, bounds: Iterable[tuple[str, float, float, float]]) -> None:
    """Check numbers against the least and the greatest that each may be.

    Args:
        device: what they belong to, for the message.
        bounds: name, value, least, greatest.

    Raises:
        OptionError: one is out of bounds, or not a number.
    """
    for name, value, low, high in bounds:
        if not low <= value <= high:
            raise OptionError(f"{device}.{name}: {value}; expected {low} to {high}")


def each_of(name: str, values: Sequence[float], low: float, high: float) -> Iterator[tuple[str, float, float, float]]:
    """Give the same bounds to each of several numbers, for `check_bounds`."""
    return ((f"{name}[{index}]", value, low, high) for index, value in enumerate(values))


def check_fan(device: str, name: str, fan_deg: tuple[float, float], limit_deg: float) -> None:
    """Check that a range of angles goes upwards and stays within `limit_deg` to either side [deg].

    Raises:
        OptionError: it does not.
    """
    low, high = fan_deg
    if not -limit_deg <= low < high <= limit_deg:
        raise OptionError(f"{device}.{name}: {fan_deg}; expected two rising angles within {limit_deg} degrees")


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
