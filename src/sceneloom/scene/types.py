"""The closed sets of words and the common aliases of the scene model."""

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Any

Identifier = str | int
"""An id of a sensor or an annotation; its type is kept, and `1` is not `"1"`."""

NO_FIELDS: Mapping[str, Any] = MappingProxyType({})
"""The extra fields of an object that has none."""


class SensorType(StrEnum):
    """What a sensor measures: the words of SFS, and `imu` and `gnss`."""

    POINTS = "points"
    LIDAR = "lidar"
    RADAR = "radar"
    CAMERA = "camera"
    ODOMETRY = "odometry"
    IMU = "imu"
    GNSS = "gnss"


class Coordinates(StrEnum):
    """The frame that a sensor's poses lead into."""

    WORLD = "world"
    EGO = "ego"


class PointsFrame(StrEnum):
    """The frame in which the points of a lidar or radar are given."""

    SENSOR = "sensor"
    EGO = "ego"
    WORLD = "world"
