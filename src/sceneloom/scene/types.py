"""The closed sets of words and the common aliases of the scene model."""

import copyreg
from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any, TypeVar

Identifier = str | int
"""An id of a sensor or an annotation; its type is kept, and `1` is not `"1"`."""

Key = tuple[type, Identifier]
"""An id with its type, to be looked up."""


def key_of(identifier: Identifier) -> Key:
    """The id with its type."""
    return type(identifier), identifier


Progress = Callable[[int, int], None]
"""Is reported how much of some work is done, and how much there is in all."""

_Item = TypeVar("_Item")


def reporting(items: Iterable[_Item], progress: Progress | None, total: int) -> Iterator[_Item]:
    """Give items one after another, each of which is reported as done when the next one is asked for."""
    for done, item in enumerate(items, start=1):
        yield item
        if progress is not None:
            progress(done, total)


NO_FIELDS: Mapping[str, Any] = MappingProxyType({})
"""The extra fields of an object that has none."""


def _unpickled(fields: dict[Any, Any]) -> Mapping[Any, Any]:
    return MappingProxyType(fields)


def _pickled(fields: "MappingProxyType[Any, Any]") -> tuple[Any, ...]:
    return _unpickled, (dict(fields),)


# The model's records hold read-only mappings and go to other processes, but Python cannot pickle such mappings.
copyreg.pickle(MappingProxyType, _pickled)


class SensorType(StrEnum):
    """What a sensor measures: the words of SFS, and `imu`, `gnss` and `depth_camera`."""

    POINTS = "points"
    LIDAR = "lidar"
    RADAR = "radar"
    CAMERA = "camera"
    ODOMETRY = "odometry"
    IMU = "imu"
    GNSS = "gnss"
    DEPTH_CAMERA = "depth_camera"


class Coordinates(StrEnum):
    """The frame that a sensor's poses lead into."""

    WORLD = "world"
    EGO = "ego"


class PointsFrame(StrEnum):
    """The frame in which the points of a lidar or radar are given."""

    SENSOR = "sensor"
    EGO = "ego"
    WORLD = "world"
