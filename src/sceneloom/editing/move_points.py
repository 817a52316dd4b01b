"""Points and poses of sensors from one frame into another over time, and the choice of some points of a frame."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, FloatArray, Int64Array, finite_rows
from sceneloom.editing.references import assumed, skipped
from sceneloom.errors import ArrayError, PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import (
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotate_vectors,
)
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, shots_of
from sceneloom.scene.clouds import (
    LidarFrame,
    LidarPoints,
    LidarSensor,
    PointsSensor,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)
from sceneloom.scene.ego import EgoMotion, camera_path, ego_path, points_source, sensor_path, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, PoseSamples, PoseSource
from sceneloom.scene.scene import Scene, frame_times
from sceneloom.scene.time_range import Renumbering
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, key_of
from sceneloom.warnings import DataWarning

KNOWN = 1
"""Greatest coverage of a pose that is used: inside its path, or extrapolated within reach."""

_MOST_REMEMBERED = 16
"""Series of times whose changes are kept for the next time they are asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameChange:
    """`new_from_old` over time.

    Attributes:
        hub_from_old: where the old frame is in the one between; None where it is that one.
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

    def poses(
        self, timestamps_ns: Int64Array, positions: Float64Array, quaternions_xyzw: Float64Array
    ) -> PoseSamples:
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
            times_ns: (M,) int64 [ns], ascending, the times to give instead of the path's own: what an static path
                needs where the change is not constant.
        """
        if path.static and self.is_constant:
            times_ns, static = path.timestamps_ns, True
        else:
            static = False
        times = path.timestamps_ns if times_ns is None else times_ns
        old = path.interpolate(times) if times_ns is not None else None
        positions = path.positions if old is None else old.positions
        rotations = path.quaternions_xyzw if old is None else old.quaternions_xyzw
        new = self.poses(times, positions, rotations)
        known = (new.coverage <= KNOWN) & np.isfinite(new.positions[:, 0])
        if not known.any():
            return None
        return Poses(times[known], new.positions[known], new.quaternions_xyzw[known], static=static)


_PointsOf = LidarSensor | RadarSensor

_Posed = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor


def points_change(
    scene: Scene, sensor: _PointsOf, ego: EgoMotion | None, frame: PointsFrame, *, reach_ns: int
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
        points_source(scene, _with_points_frame(sensor, frame), ego, reach_ns=reach_ns),
    )


def _with_points_frame(sensor: _PointsOf, frame: PointsFrame) -> _PointsOf:
    if isinstance(sensor, LidarSensor):
        return replace(sensor, points_frame=frame)
    return replace(sensor, points_frame=frame)


def _on_ego(sensor: _PointsOf, reach_ns: int) -> PoseSource | None:
    """`ego_from_sensor`, where the sensor itself reports it."""
    if sensor.mount is not None:
        return PoseSource(Poses.identity(), sensor.mount)
    if sensor.coordinates is Coordinates.EGO and sensor.poses is not None:
        poses = sensor.poses
        if len(poses.timestamps_ns) == 1:
            poses = replace(poses, static=True)
        return PoseSource(poses, RigidTransform.identity(), reach_ns)
    return None


def poses_in_world(
    scene: Scene, sensor: _Posed, ego: EgoMotion | None, *, reach_ns: int, anew: bool = False
) -> Poses | None:
    """Give where a sensor was in the world, at the times of its own poses, else as its frames need it.

    Args:
        scene: the sensor's.
        sensor: which one.
        ego: the ego trajectory, if it is needed.
        reach_ns: how far beyond a path's ends its velocity is continued.
        anew: take the ego trajectory even where the sensor reports its location in the world.

    Returns:
        The path; None where it is not known.

    Raises:
        PoseError: the sensor's location on the ego is known, and that of the ego is not.
    """
    own = sensor.poses
    if (
        own is not None
        and sensor.coordinates is Coordinates.WORLD
        and not (anew and sensor.mount is not None)
    ):
        return own
    if own is not None and len(own.timestamps_ns) > 1 and sensor.coordinates is Coordinates.EGO:
        # at its own times, not by a path composed of both: that would end where the shorter of them ends
        trajectory = PoseSource(ego_path(scene, sensor, ego), RigidTransform.identity(), reach_ns)
        return FrameChange(trajectory).path(own)
    try:
        source = sensor_source(scene, sensor, ego, reach_ns=reach_ns)
    except PoseError:
        if own is None:
            return None
        raise
    return _as_needed(source, sensor)


def _as_needed(source: PoseSource, sensor: _Posed) -> Poses | None:
    """The poses at the times of a sensor's own, else as its frames need them, else as many as the trajectory has."""
    own, times_ns = sensor.poses, frame_times(sensor)
    if own is not None and len(own.timestamps_ns) > 1:
        return _path_at(source, own.timestamps_ns)
    if len(times_ns) == 0:
        return _path_at(source, source.path.timestamps_ns)
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        return camera_path(source, shots_of(sensor))
    return sensor_path(source, times_ns)


def poses_on_ego(sensor: _Posed, ego: EgoMotion, *, reach_ns: int) -> Poses | None:
    """Give where a sensor was on the ego, at the times of its own poses; None where it has none there."""
    if sensor.poses is None or sensor.coordinates is Coordinates.EGO:
        return sensor.poses
    ego_from_world = FrameChange(None, PoseSource(ego.path, RigidTransform.identity(), reach_ns))
    times_ns = np.unique(frame_times(sensor)) if sensor.poses.static else None
    if times_ns is not None and len(times_ns) == 0:
        times_ns = ego.path.timestamps_ns
    return ego_from_world.path(sensor.poses, times_ns=times_ns)


def _path_at(source: PoseSource, times_ns: Int64Array) -> Poses | None:
    """Give the poses at those of the times that the source reaches; None where it reaches none."""
    poses = source.at(times_ns)
    known = poses.coverage <= KNOWN
    if not known.any():
        return None
    return Poses(times_ns[known], poses.positions[known], poses.quaternions_xyzw[known])


_Cloud = TypeVar("_Cloud", LidarFrame, RadarFrame)

CloudSensor = TypeVar("CloudSensor", LidarSensor, RadarSensor)

_Points = TypeVar("_Points", LidarPoints, RadarPoints)

OnPoints = Callable[[Identifier, int, int, int], None]
"""Reported of each frame that is read: its sensor, its number, how many points it had, how many it has now."""

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
class ChosenFrames(Generic[_Cloud]):
    """Reads frames, each with some of its points; what `LazyFrames` asks for.

    Attributes:
        frames: as they were.
        choose: which points stay.
        sensor_id: whose frames they are.
        on_points: reported each frame that is read.
    """

    frames: LazyFrames[_Cloud]
    choose: _Choose
    sensor_id: Identifier
    on_points: OnPoints | None = None

    def __call__(self, k: int) -> _Cloud:
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
    frames: LazyFrames[_Cloud], choose: _Choose, sensor_id: Identifier, on_points: OnPoints | None = None
) -> LazyFrames[_Cloud]:
    """Give frames with some of their points, chosen when they are read; arguments as in `ChosenFrames`."""
    return LazyFrames(frames.timestamps_ns, ChosenFrames(frames, choose, sensor_id, on_points))


@dataclass(frozen=True, slots=True, eq=False)
class MovedFrames(Generic[_Cloud]):
    """Reads frames and takes their points into another frame; what `LazyFrames` asks for.

    Attributes:
        frames: as they were.
        change: `new_from_old`, known at the times of all frames.
    """

    frames: LazyFrames[_Cloud]
    change: FrameChange

    def __call__(self, k: int) -> _Cloud:
        """Read frame `k`.

        Raises:
            DataError: it cannot be read.
        """
        frame = self.frames[k]
        new_from_old = self.change.transform(int(self.frames.timestamps_ns[k]))
        return replace(frame, points=_moved_points(frame.points, new_from_old))


def _moved_frames(frames: LazyFrames[_Cloud], change: FrameChange) -> tuple[LazyFrames[_Cloud], Int64Array]:
    """Give frames whose points are in another frame, and the old numbers (M,) of those at whose times it is known."""
    numbers = np.flatnonzero(change.at(frames.timestamps_ns).coverage <= KNOWN)
    known = chosen_frames(frames, numbers)
    return LazyFrames(known.timestamps_ns, MovedFrames(known, change)), numbers


def chosen_frames(frames: LazyFrames[_Cloud], numbers: Int64Array) -> LazyFrames[_Cloud]:
    """Give the frames with these numbers, (M,) int64."""
    if len(numbers) == len(frames):
        return frames
    return LazyFrames(frames.timestamps_ns[numbers], partial(_read, frames, numbers))


def _read(frames: LazyFrames[_Cloud], numbers: Int64Array, k: int) -> _Cloud:
    return frames[int(numbers[k])]


def _moved_points(points: _Points, new_from_old: RigidTransform) -> _Points:
    """Take the points of a frame into another frame; a radar's directions rotate, too."""
    positions = moved_positions(points.positions, new_from_old)
    if isinstance(points, RadarPoints) and points.directions is not None:
        return replace(
            points,
            positions=positions,
            directions=new_from_old.rotate(points.directions).astype(np.float32),
        )
    return replace(points, positions=positions)


def moved_positions(positions: Float32Array, new_from_old: RigidTransform) -> Float32Array:
    """Take positions (N, 3) float32 [m] into another frame, computed in float64.

    Raises:
        ArrayError: a point that has coordinates would have none there, as float32 does not reach so far.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        moved = new_from_old.apply(positions).astype(np.float32)
    lost = finite_rows(positions) & ~finite_rows(moved)
    if lost.any():
        row = int(lost.argmax())
        raise ArrayError(
            f"points.positions[{row}]: {positions[row].tolist()} moved by {new_from_old.translation.tolist()}; "
            "expected metres that float32 holds"
        )
    return moved


@dataclass(slots=True)
class CloudMoves:
    """What becomes of the frames of a scene's sensors.

    Attributes:
        frames: the numbers of those that stay, by sensor, where some go.
        warnings: what is to be reported.
    """

    frames: dict[Key, Renumbering] = field(default_factory=dict)
    warnings: list[DataWarning] = field(default_factory=list)

    def cloud(self, sensor: CloudSensor, change: FrameChange | None, frame: PointsFrame) -> CloudSensor:
        """Move the points of a sensor; note the frames that go."""
        if change is None:
            return replace(sensor, points_frame=frame)
        moved, numbers = _moved_frames(sensor.frames, change)
        location = f"sensors[{sensor.id}].frames"
        if len(numbers) < len(sensor.frames):
            self.frames[key_of(sensor.id)] = Renumbering(numbers)
            what = "frames at whose time the ego trajectory is not known"
            lost = len(sensor.frames) - len(numbers)
            self.warnings.append(skipped("frames-beyond-the-trajectory", location, what, count=lost))
        beyond = int(np.count_nonzero(change.at(moved.timestamps_ns).coverage == KNOWN))
        what = "frames beyond the ends of the trajectory, placed as if it went on"
        self.warnings.append(assumed("frames-extrapolated", location, what, count=beyond))
        return replace(sensor, frames=moved, points_frame=frame)
