"""Some of the points of a frame, with all that is known of each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, Int64Array
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.types import Identifier

Cloud = TypeVar("Cloud", LidarFrame, RadarFrame)
CloudSensor = TypeVar("CloudSensor", LidarSensor, RadarSensor)
Points = TypeVar("Points", LidarPoints, RadarPoints)

OnPoints = Callable[[Identifier, int, int, int], None]
"""Reported of each frame that is read: its sensor, its number, how many points it had, how many it has now."""

Choose = Callable[[LidarFrame | RadarFrame], Int64Array | None]
"""Gives the rows of a frame's points that stay, ascending; None for all of them."""

_ARRAYS = (
    "positions",
    "intensities",
    "colors",
    "timestamps_ns",
    "rings",
    "camera_index",
    "directions",
    "lengths",
)


def chosen_points(points: Points, rows: Int64Array) -> Points:
    """Give some of the points, (M,) int64 rows, each with everything that is known of it."""
    arrays = {name: getattr(points, name, None) for name in _ARRAYS}
    taken: dict[str, Any] = {name: array[rows] for name, array in arrays.items() if array is not None}
    return replace(points, **taken, extras=_chosen_further(points.extras, len(points), rows))


def chosen_map(sensor: PointsSensor, rows: Int64Array) -> PointsSensor:
    """Give a points sensor with some of its points."""
    extras = dict(sensor.extras)
    if isinstance(extras.get("points"), Mapping):
        extras["points"] = _chosen_further(extras["points"], len(sensor.positions), rows)
    return replace(
        sensor,
        positions=sensor.positions[rows],
        colors=None if sensor.colors is None else sensor.colors[rows],
        extras=MappingProxyType(extras),
    )


def _chosen_further(further: Mapping[str, AnyArray], count: int, rows: Int64Array) -> Mapping[str, AnyArray]:
    """Of further arrays those rows; what has not one row per point stays whole."""
    return MappingProxyType(
        {
            name: array[rows] if isinstance(array, np.ndarray) and array.shape[:1] == (count,) else array
            for name, array in further.items()
        }
    )


@dataclass(frozen=True, slots=True, eq=False)
class ChosenFrames(Generic[Cloud]):
    """Reads frames, each with some of its points; what `LazyFrames` asks for.

    Attributes:
        frames: as they were.
        choose: which points stay.
        sensor_id: whose frames they are.
        on_points: reported each frame that is read.
    """

    frames: LazyFrames[Cloud]
    choose: Choose
    sensor_id: Identifier
    on_points: OnPoints | None = None

    def __call__(self, k: int) -> Cloud:
        """Read frame `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame = self.frames[k]
        rows = self.choose(frame)
        chosen = frame if rows is None else replace(frame, points=chosen_points(frame.points, rows))
        if self.on_points is not None:
            self.on_points(self.sensor_id, k, len(frame.points), len(chosen.points))
        return chosen


def with_chosen_points(
    frames: LazyFrames[Cloud], choose: Choose, sensor_id: Identifier, on_points: OnPoints | None = None
) -> LazyFrames[Cloud]:
    """Give frames with some of their points, chosen when they are read; arguments as in `ChosenFrames`."""
    return LazyFrames(frames.timestamps_ns, ChosenFrames(frames, choose, sensor_id, on_points))
