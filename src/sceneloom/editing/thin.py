"""Scenes with fewer points and fewer frames; a point that stays keeps everything that is known of it."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, FloatArray, Int64Array
from sceneloom.editing.references import with_ours, with_warnings
from sceneloom.errors import OptionError, check_choice
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, chosen_shots
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
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.time_range import Renumbering, renumbered
from sceneloom.scene.types import Identifier, Key, key_of

OnPoints = Callable[[Identifier, int, int, int], None]
"""Called for each frame that is read: its sensor, its number, how many points it had, how many it has now."""

ChoosePoints = Callable[[LidarFrame | RadarFrame], Int64Array]
"""Gives the rows of a frame's points that stay, ascending."""

_Points = TypeVar("_Points", LidarPoints, RadarPoints)

_NEAREST, FIRST = "nearest", "first"
_KEEPERS = (_NEAREST, FIRST)  # which point of a cube stays: the one nearest to the mean of those in it, or the first


def chosen_points(points: _Points, rows: Int64Array) -> _Points:
    """Give some of the points, (M,) int64 rows, each with everything that is known of it."""
    arrays = {name: getattr(points, name) for name in points.__dataclass_fields__ if name != "extras"}
    taken: dict[str, Any] = {name: array[rows] for name, array in arrays.items() if array is not None}
    return replace(points, **taken, extras=_chosen_extras(points.extras, len(points), rows))


def with_map_points(sensor: PointsSensor, rows: Int64Array) -> tuple[PointsSensor, Renumbering]:
    """Give a map with some of its points, and what becomes of their numbers."""
    extras = dict(sensor.extras)
    if isinstance(extras.get("points"), Mapping):
        extras["points"] = _chosen_extras(extras["points"], len(sensor.positions), rows)
    colors = None if sensor.colors is None else sensor.colors[rows]
    chosen = replace(sensor, positions=sensor.positions[rows], colors=colors, extras=MappingProxyType(extras))
    return chosen, Renumbering(rows=lambda _: rows)


def _chosen_extras(extras: Mapping[str, AnyArray], count: int, rows: Int64Array) -> Mapping[str, AnyArray]:
    """Those rows of unknown arrays; what has not one row per point stays whole."""
    by_point = {k: isinstance(array, np.ndarray) and array.shape[:1] == (count,) for k, array in extras.items()}
    return MappingProxyType({k: array[rows] if by_point[k] else array for k, array in extras.items()})


def with_points(
    sensor: LidarSensor | RadarSensor, numbers: Int64Array, choose: ChoosePoints, on_points: OnPoints | None
) -> tuple[LidarSensor | RadarSensor, Renumbering]:
    """Give a sensor with some of its frames and, chosen when these are read, some of their points.

    Returns:
        The sensor, and what becomes of the numbers of its frames and points.
    """
    frames: Any = sensor.frames
    read = partial(_frame_of_chosen, frames.chosen(numbers), choose, sensor.id, on_points)
    chosen: Any = LazyFrames(frames.timestamps_ns[numbers], read)
    return replace(sensor, frames=chosen), Renumbering(numbers, lambda k: None if k is None else choose(frames[k]))


def _frame_of_chosen(
    frames: LazyFrames[Any], choose: ChoosePoints, sensor_id: Identifier, on_points: OnPoints | None, k: int
) -> Any:
    frame = frames[k]
    chosen = replace(frame, points=chosen_points(frame.points, choose(frame)))
    if on_points is not None:
        on_points(sensor_id, k, len(frame.points), len(chosen.points))
    return chosen


def one_per_cube(positions: FloatArray, side: float, *, keep: str = _NEAREST) -> Int64Array:
    """Give the rows, ascending, of one point of each cube of a grid through the origin.

    Args:
        positions: (N, 3) [m]; a point that is not finite is left out.
        side: of the cubes [m].
        keep: one of `_KEEPERS`.

    Raises:
        OptionError: the side is not positive, or `keep` is none of these.
    """
    from sceneloom.kernels.voxels import first_of_cubes, nearest_of_cubes, number_cubes

    _check_cubes(side, keep)
    points: Float64Array = np.ascontiguousarray(positions, np.float64)
    numbers = np.empty(len(points), np.int64)
    chosen = np.empty(number_cubes(points, side, numbers), np.int64)
    first_of_cubes(numbers, chosen)
    if keep == _NEAREST:
        nearest_of_cubes(points, numbers, chosen)
    return np.sort(chosen)


def _check_cubes(side: float, keep: str) -> None:
    if not 0 < side < np.inf:
        raise OptionError(f"voxel {side}; expected a positive number of metres")
    check_choice("keep", keep, _KEEPERS)


def evenly(count: int, wanted: int) -> Int64Array:
    """Give `wanted` of `count` rows, evenly spread; all of them where there are no more.

    Row k is the middle of the k-th of `wanted` equal parts of the rows.
    """
    if wanted >= count:
        return np.arange(count)
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * count // (2 * wanted)


@dataclass(frozen=True, slots=True)
class _Thinning:
    """How points are chosen, as of `thin_scene`; one way after the other where several are given."""

    voxel: float | None
    keep: str
    share: float | None
    points: int | None

    def __post_init__(self) -> None:
        _check_cubes(1.0 if self.voxel is None else self.voxel, self.keep)
        if self.share is not None and not 0 < self.share <= 1:
            raise OptionError(f"share {self.share}; expected more than 0 and at most 1")
        if self.points is not None and self.points < 1:
            raise OptionError(f"points {self.points}; expected 1 or more")

    @property
    def changes(self) -> bool:
        """Whether any point can go."""
        return self.voxel is not None or self.share is not None or self.points is not None

    def rows(self, positions: FloatArray) -> Int64Array:
        """The rows that stay of points (N, 3) [m], ascending."""
        rows = np.arange(len(positions))
        if self.voxel is not None:
            rows = one_per_cube(positions, self.voxel, keep=self.keep)
        if self.share is not None:
            rows = rows[evenly(len(rows), round(len(rows) * self.share))]
        if self.points is not None:
            rows = rows[evenly(len(rows), self.points)]
        return rows

    def __call__(self, frame: LidarFrame | RadarFrame) -> Int64Array:
        """The rows that stay of a frame."""
        return self.rows(frame.points.positions)


def thin_scene(
    scene: Scene,
    *,
    voxel: float | None = None,
    keep: str = _NEAREST,
    share: float | None = None,
    points: int | None = None,
    every: int = 1,
    sensors: Iterable[Identifier] | None = None,
    on_points: OnPoints | None = None,
) -> Scene:
    """Give a scene with fewer points in its clouds, or fewer frames; points are chosen when frames are read.

    A point that stays keeps everything that is known of it, and labelled points follow: frames that have some are
    read now. Non-finite points are left out where `voxel` is given.

    Args:
        scene: the scene.
        voxel: side of the cubes of which one point each stays [m], in the frame in which the points are given.
        keep: which one: "nearest" to the mean of the cube's points, or the "first".
        share: how many of the points stay, 0 to 1, evenly spread over their rows.
        points: how many points of a frame, or of a map, stay at most, evenly spread over their rows.
        every: of lidars, radars and cameras keep only every n-th frame, from the first.
        sensors: ids of the only sensors to thin; None for all.
        on_points: called for each frame that is read.

    Raises:
        OptionError: a value is out of range, there is nothing to do, or no sensor has such an id.
        DataError: a frame with labelled points cannot be read.
    """
    thinning = _Thinning(voxel, keep, share, points)
    if every < 1:
        raise OptionError(f"every {every}; expected 1 or more")
    if every == 1 and not thinning.changes:
        raise OptionError("nothing to thin by; expected one of voxel, share, points or every")
    wanted = {key_of(s.id) for s in scene.sensors} if sensors is None else {key_of(scene.sensor(i).id) for i in sensors}
    changes: dict[Key, Renumbering] = {}

    def thinned(sensor: Sensor) -> Sensor:
        key = key_of(sensor.id)
        if key not in wanted:
            return sensor
        if isinstance(sensor, CameraSensor | DepthCameraSensor):
            fps = None if sensor.fps is None else sensor.fps / every
            return sensor if every == 1 else replace(chosen_shots(sensor, slice(None, None, every)), fps=fps)  # type: ignore[type-var]
        if isinstance(sensor, PointsSensor) and thinning.changes:
            sensor, changes[key] = with_map_points(sensor, thinning.rows(sensor.positions))
        elif isinstance(sensor, LidarSensor | RadarSensor):
            numbers = np.arange(0, len(sensor.frames), every)
            if thinning.changes:
                sensor, changes[key] = with_points(sensor, numbers, thinning, on_points)
            else:
                kept: Any = sensor.frames.chosen(numbers)
                sensor, changes[key] = replace(sensor, frames=kept), Renumbering(numbers)
        return sensor

    changed = replace(scene, sensors=tuple(map(thinned, scene.sensors)))
    annotations, warnings = renumbered(scene.annotations, changes)
    stated = {"voxel": voxel, "keep": keep if voxel else None, "share": share, "points": points, "every": every}
    entry = {name: value for name, value in stated.items() if value is not None}
    return with_warnings(with_ours(replace(changed, annotations=annotations), thinned=entry), warnings)
