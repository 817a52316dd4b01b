"""Bounds on the parameters of simulated devices, and random streams that do not depend on the order of use."""

from enum import IntEnum, unique
from typing import Any

import numpy as np

from sceneloom.errors import OptionError

Bounds = tuple[float, float]
"""Least and greatest value."""


def check_bounds(device: str, spec: Any, **bounds: Bounds | tuple[Bounds, ...]) -> None:
    """Check fields of a spec against the least and the greatest that each, or each item of a tuple, may be.

    Args:
        device: what they belong to, for the message.
        spec: whose fields; one that is None is not checked.
        bounds: by the name of the field; several for the items of a tuple.

    Raises:
        OptionError: one is out of bounds, or not a number.
    """
    for name, limits in bounds.items():
        value = getattr(spec, name)
        is_tuple = isinstance(value, tuple | list)
        items = {f"{name}[{k}]": one for k, one in enumerate(value)} if is_tuple else {name: value}
        for k, (location, one) in enumerate(items.items()):
            low, high = limits[k] if isinstance(limits[0], tuple) else limits
            if one is not None and not low <= one <= high:
                raise OptionError(f"{device}.{location}: {one}; expected {low} to {high}")


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
