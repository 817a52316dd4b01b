"""The change from one frame to another over time, and the choice of some points of a frame."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, Float64Array, FloatArray, Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotate_vectors,
)
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.ego import EgoMotion, points_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSamples, PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.time_range import Renumbering
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame

KNOWN = 1
"""Greatest coverage of a pose that is used: inside its path, or extrapolated within reach."""

_MOST_REMEMBERED = 16
"""Series of times whose changes are kept for the next time they are asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameChange:
    """`new_from_old` over time.

    Attributes:
        hub_from_old: pose of the old frame in a common frame, the hub; None where it is the hub.
        hub_from_new: the same of the new frame.
        held: beyond the ends of a path its end poses hold, instead of nothing.
    """

    hub_from_old: PoseSource | None = None
    hub_from_new: PoseSource | None = None
    held: bool = False
    _remembered: dict[bytes, PoseSamples] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def constant(cls, new_from_old: RigidTransform) -> "FrameChange":
        """The same change at all times."""
        return cls(PoseSource(Poses.identity(), new_from_old))

    @property
    def is_constant(self) -> bool:
        """Whether it is the same at all times."""
        return all(source.path.static for source in self._sources)

    @property
    def knots_ns(self) -> Int64Array:
        """Times (K,) int64 [ns], ascending, at which the paths behind it have poses."""
        timestamps = [source.path.timestamps_ns for source in self._sources if not source.path.static]
        return np.unique(np.concatenate(timestamps)) if timestamps else np.zeros(0, np.int64)

    @property
    def _sources(self) -> list[PoseSource]:
        return [source for source in (self.hub_from_old, self.hub_from_new) if source is not None]

    def inverse(self) -> "FrameChange":
        """`old_from_new`."""
        return FrameChange(self.hub_from_new, self.hub_from_old, self.held)

    def at(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give `new_from_old` at each time, (M,) int64 [ns]; NaN where it is not known."""
        # annotations of one scene are asked for at the same times over and over
        key = timestamps_ns.tobytes()
        if key not in self._remembered:
            if len(self._remembered) >= _MOST_REMEMBERED:
                self._remembered.clear()
            self._remembered[key] = self._computed(timestamps_ns)
        return self._remembered[key]

    def _computed(self, timestamps_ns: Int64Array) -> PoseSamples:
        hub_from_old = self._of(self.hub_from_old, timestamps_ns)
        if self.hub_from_new is None:
            return hub_from_old
        hub_from_new = self._of(self.hub_from_new, timestamps_ns)
        back = conjugate_quaternion(hub_from_new.quaternions_xyzw)
        return PoseSamples(
            rotate_vectors(back, hub_from_old.positions - hub_from_new.positions),
            multiply_quaternions(back, hub_from_old.quaternions_xyzw),
            np.maximum(hub_from_old.coverage, hub_from_new.coverage),
        )

    def _of(self, source: PoseSource | None, timestamps_ns: Int64Array) -> PoseSamples:
        if source is None:
            return Poses.identity().interpolate(timestamps_ns)
        path = source.path
        if self.held and not path.static:
            return source.at(np.clip(timestamps_ns, path.start_ns, path.stop_ns))
        return source.at(timestamps_ns)

    def transform(self, timestamp_ns: int) -> RigidTransform:
        """`new_from_old` at a time at which it is known."""
        pose = self.at(np.array([timestamp_ns], np.int64))
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])

    def locations(self, timestamps_ns: Int64Array, locations: FloatArray) -> Float64Array:
        """Take locations (M, ..., 3) [m] of the old frame into the new one, row k at time k; NaN where not known."""
        pose = self.at(timestamps_ns)
        lead = (len(timestamps_ns), *(1,) * (np.ndim(locations) - 2), 3)
        rotations = matrix_from_quaternion(pose.quaternions_xyzw)
        rotated = np.einsum("mij,m...j->m...i", rotations, np.asarray(locations, np.float64))
        moved: Float64Array = rotated + pose.positions.reshape(lead)
        return moved

    def poses(self, timestamps_ns: Int64Array, positions: Float64Array, quaternions_xyzw: Float64Array) -> PoseSamples:
        """Give `new_from_body` of a body whose `old_from_body` is given at each time, (M, 3) and (M, 4)."""
        change = self.at(timestamps_ns)
        return PoseSamples(
            rotate_vectors(change.quaternions_xyzw, positions) + change.positions,
            multiply_quaternions(change.quaternions_xyzw, quaternions_xyzw),
            change.coverage,
        )

    def path(self, path: Poses, *, times_ns: Int64Array | None = None) -> Poses | None:
        """Give `new_from_body` of a path, at its own times; None where the change is known at none of them.

        Args:
            path: `old_from_body`.
            times_ns: (M,) int64 [ns], ascending, the times to give instead of the path's own: what a static path
                needs where the change is not constant.
        """
        times = path.timestamps_ns if times_ns is None else times_ns
        old: Poses | PoseSamples = path if times_ns is None else path.interpolate(times)
        new = self.poses(times, old.positions, old.quaternions_xyzw)
        static = path.static and self.is_constant and times_ns is None
        known = (new.coverage <= KNOWN) & np.isfinite(new.positions[:, 0])
        if not known.any():
            return None
        return Poses(times[known], new.positions[known], new.quaternions_xyzw[known], static=static)


def points_change(
    scene: Scene,
    sensor: LidarSensor | RadarSensor,
    ego: EgoMotion | None,
    frame: PointsFrame,
    *,
    reach_ns: int,
) -> FrameChange | None:
    """Give what takes a sensor's points into a frame; None where they are in it already.

    Raises:
        PoseError: the poses that this needs are not known.
    """
    if sensor.points_frame is frame:
        return None
    on_ego = _on_ego(sensor, reach_ns)
    if on_ego is not None and PointsFrame.WORLD not in {frame, sensor.points_frame}:
        change = FrameChange(on_ego)
        return change if frame is PointsFrame.EGO else change.inverse()
    return FrameChange(
        points_source(scene, sensor, ego, reach_ns=reach_ns),
        points_source(scene, replace(sensor, points_frame=frame), ego, reach_ns=reach_ns),
    )


def _on_ego(sensor: LidarSensor | RadarSensor, reach_ns: int) -> PoseSource | None:
    """`ego_from_sensor`, where the sensor itself reports it."""
    if sensor.mount is not None:
        return PoseSource(Poses.identity(), sensor.mount)
    poses = sensor.poses
    if sensor.coordinates is not Coordinates.EGO or poses is None:
        return None
    poses = replace(poses, static=True) if len(poses.timestamps_ns) == 1 else poses
    return PoseSource(poses, RigidTransform.identity(), reach_ns)


_Points = TypeVar("_Points", LidarPoints, RadarPoints)
CloudSensor = TypeVar("CloudSensor", LidarSensor, RadarSensor)

OnPoints = Callable[[Identifier, int, int, int], None]
"""Called for each frame that is read: its sensor, its number, how many points it had, how many it has now."""

_Choose = Callable[[LidarFrame | RadarFrame], Int64Array | None]
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


def chosen_points(points: _Points, rows: Int64Array) -> _Points:
    """Give some of the points, (M,) int64 rows, each with everything that is known of it."""
    arrays = {name: getattr(points, name, None) for name in _ARRAYS}
    taken: dict[str, Any] = {name: array[rows] for name, array in arrays.items() if array is not None}
    return replace(points, **taken, extras=_chosen_extras(points.extras, len(points), rows))


def chosen_map(sensor: PointsSensor, rows: Int64Array) -> PointsSensor:
    """Give a points sensor with some of its points."""
    extras = dict(sensor.extras)
    if isinstance(extras.get("points"), Mapping):
        extras["points"] = _chosen_extras(extras["points"], len(sensor.positions), rows)
    colors = None if sensor.colors is None else sensor.colors[rows]
    return replace(sensor, positions=sensor.positions[rows], colors=colors, extras=MappingProxyType(extras))


def _chosen_extras(extras: Mapping[str, AnyArray], count: int, rows: Int64Array) -> Mapping[str, AnyArray]:
    """Those rows of unknown arrays; what has not one row per point stays whole."""
    by_point = {k: isinstance(array, np.ndarray) and array.shape[:1] == (count,) for k, array in extras.items()}
    return MappingProxyType({k: array[rows] if by_point[k] else array for k, array in extras.items()})


def with_chosen_points(
    frames: LazyFrames[Any], choose: _Choose, sensor_id: Identifier, on_points: OnPoints | None = None
) -> LazyFrames[Any]:
    """Give frames with some of their points, chosen when they are read, and report each frame that is read."""
    return LazyFrames(frames.timestamps_ns, partial(_frame_of_chosen, frames, choose, sensor_id, on_points))


def _frame_of_chosen(
    frames: LazyFrames[Any], choose: _Choose, sensor_id: Identifier, on_points: OnPoints | None, k: int
) -> Any:
    frame = frames[k]
    rows = choose(frame)
    chosen = frame if rows is None else replace(frame, points=chosen_points(frame.points, rows))
    if on_points is not None:
        on_points(sensor_id, k, len(frame.points), len(chosen.points))
    return chosen


def chosen_frames(frames: LazyFrames[Any], numbers: Int64Array) -> LazyFrames[Any]:
    """Give the frames with these numbers, (M,) int64, in that order; the very frames where these are all of them."""
    if np.array_equal(numbers, np.arange(len(frames))):
        return frames
    return LazyFrames(frames.timestamps_ns[numbers], partial(_numbered_frame, frames, numbers))


def _numbered_frame(frames: LazyFrames[Any], numbers: Int64Array, k: int) -> Any:
    return frames[int(numbers[k])]


def renumbered_frames(numbers: Int64Array, frames: LazyFrames[Any], choose: _Choose) -> Renumbering:
    """What becomes of the numbers of frames and of their points: frames that stay, of their points those chosen."""
    return Renumbering(numbers, partial(_chosen_rows, frames, choose))


def _chosen_rows(frames: LazyFrames[Any], choose: _Choose, number: int | None) -> Int64Array | None:
    return None if number is None else choose(frames[number])


def renumbered_map(rows: Int64Array) -> Renumbering:
    """What becomes of the numbers of a map's points of which some rows stay."""
    return Renumbering(rows=partial(_same_rows, rows))


def _same_rows(rows: Int64Array, number: int | None) -> Int64Array:  # noqa: ARG001 - a map has one frame only
    return rows
