"""Scenes with fewer points and fewer frames."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array, FloatArray, Int64Array
from sceneloom.editing.move_points import (
    OnPoints,
    chosen_map,
    renumbered_frames,
    renumbered_map,
    with_chosen_points,
)
from sceneloom.editing.references import with_ours, with_warnings
from sceneloom.errors import OptionError
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, chosen_shots
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.time_range import Renumbering, renumbered
from sceneloom.scene.types import Identifier, Key, key_of

_NEAREST, FIRST = "nearest", "first"

_KEEPERS = (_NEAREST, FIRST)
"""Which point of a cube stays: the one nearest to the mean of those in it, or the first."""


def one_per_cube(positions: FloatArray, side: float, *, keep: str = _NEAREST) -> Int64Array:
    """Give the rows, ascending, of one point of each cube of side `side` [m].

    Cubes begin at whole multiples of their side on either side of zero: the one at the origin is no larger than others.

    Args:
        positions: (N, 3) [m]; a point that is not finite is left out.
        side: [m].
        keep: one of `_KEEPERS`.

    Raises:
        OptionError: the side is not positive, or `keep` is not one of those.
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
    if keep not in _KEEPERS:
        raise OptionError(f"keep {keep!r}; expected one of {', '.join(_KEEPERS)}")


def evenly(count: int, wanted: int) -> Int64Array:
    """Give `wanted` of `count` rows, evenly spread; all of them where there are no more.

    Row k is the one in whose share of the rows the middle of the k-th of `wanted` equal parts falls.
    """
    if wanted >= count:
        return np.arange(count)
    return (2 * np.arange(wanted, dtype=np.int64) + 1) * count // (2 * wanted)


@dataclass(frozen=True, slots=True)
class Thinning:
    """How points are chosen; one after the other where several are given.

    Attributes:
        voxel: side of the cubes of which one point each stays [m].
        keep: which one: "nearest" to the mean of the cube's points, or the "first".
        share: how many of the points stay, 0 to 1, evenly spread over their rows.
        points: how many points of a frame stay at most, evenly spread over their rows.
    """

    voxel: float | None = None
    keep: str = _NEAREST
    share: float | None = None
    points: int | None = None

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
    read now. Points whose location is not finite go where `voxel` is given.

    Args:
        scene: as it is.
        voxel: side of the cubes of which one point each stays [m], in the frame in which the points are given.
        keep: which one: "nearest" to the mean of the cube's points, or the "first".
        share: how many of the points stay, 0 to 1, evenly spread over their rows.
        points: how many points of a frame, or of a map, stay at most.
        every: of lidars, radars and cameras only every so many-th frame stays, from the first.
        sensors: ids of the only sensors to thin; None for all.
        on_points: reported each frame that is read.

    Raises:
        OptionError: a value cannot be followed, there is nothing to do, or no sensor has such an id.
        DataError: a frame with labelled points cannot be read.
    """
    thinning = Thinning(voxel, keep, share, points)
    if every < 1:
        raise OptionError(f"every {every}; expected 1 or more")
    if every == 1 and not thinning.changes:
        raise OptionError("nothing to thin by; expected one of voxel, share, points or every")
    chosen = {key_of(s.id) for s in scene.sensors} if sensors is None else {key_of(scene.sensor(i).id) for i in sensors}
    changes: dict[Key, Renumbering] = {}
    thinned = tuple(
        _thinned(sensor, thinning, every, changes, on_points) if key_of(sensor.id) in chosen else sensor
        for sensor in scene.sensors
    )
    annotations, warnings = renumbered(scene.annotations, changes)
    stated = {
        "voxel": voxel,
        "keep": keep if voxel else None,
        "share": share,
        "points": points,
        "every": every,
    }
    entry = {name: value for name, value in stated.items() if value is not None}
    changed = replace(scene, sensors=thinned, annotations=annotations)
    return with_warnings(with_ours(changed, thinned=entry), warnings)


def _thinned(
    sensor: Sensor,
    thinning: Thinning,
    every: int,
    changes: dict[Key, Renumbering],
    on_points: OnPoints | None,
) -> Sensor:
    """Thin one sensor, and note what became of the numbers of its frames and points."""
    key = key_of(sensor.id)
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        thinned: Sensor = _every_shot(sensor, every)
        return thinned
    if isinstance(sensor, PointsSensor) and thinning.changes:
        rows = thinning.rows(sensor.positions)
        changes[key] = renumbered_map(rows)
        return chosen_map(sensor, rows)
    if not isinstance(sensor, LidarSensor | RadarSensor):
        return sensor
    frames: Any = sensor.frames
    numbers = np.arange(0, len(frames), every)
    changes[key] = Renumbering(numbers)
    if thinning.changes:
        changes[key] = renumbered_frames(numbers, frames, thinning)
        frames = with_chosen_points(frames, thinning, sensor.id, on_points)
    return replace(sensor, frames=frames[::every])


def _every_shot(camera: Any, every: int) -> Any:
    """A camera with every so many-th of its images or depth images, from the first."""
    if every == 1:
        return camera
    thinned = chosen_shots(camera, slice(None, None, every))
    return thinned if thinned.fps is None else replace(thinned, fps=thinned.fps / every)
