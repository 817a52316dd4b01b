"""Scenes with points, poses and annotations in another frame: world, ego, sensor, or another world."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from math import radians
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array, finite_rows
from sceneloom.editing.references import ours_of, with_ours, with_warnings
from sceneloom.errors import ArrayError, OptionError, PoseError, check_choice
from sceneloom.geometry.rigid import (
    RigidTransform,
    conjugate_quaternion,
    matrix_from_quaternion,
    multiply_quaternions,
    rotate_vectors,
    thin_poses,
)
from sceneloom.motion.ego_trajectory import ego_motion_as_given, is_computed, with_trajectory_estimated
from sceneloom.scene.annotations import (
    Annotation,
    CuboidAnnotation,
    LocalizationAdjustment,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    ShapeAnnotation,
    VertexPath,
    locations_of,
)
from sceneloom.scene.annotations_at import (
    ANNOTATIONS_FRAME,
    CuboidAngles,
    annotations_frame,
    cuboid_at,
    point_at,
    shape_at,
)
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor, shots_of
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import (
    EgoMotion,
    camera_path,
    ego_path,
    frames_ns,
    needs_ego,
    points_source,
    sensor_path,
    sensor_source,
)
from sceneloom.scene.motion import OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, PoseSamples, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Posed, Scene, Sensor, frame_times, scene_period_ns
from sceneloom.scene.time_range import Renumbering, renumbered, select_rows
from sceneloom.scene.types import Coordinates, Identifier, Key, PointsFrame, Progress, key_of
from sceneloom.warnings import DataWarning, assumed, skipped

KNOWN = 1
"""Greatest coverage of a pose that is used: inside its path, or extrapolated within the limit."""

_MOST_REMEMBERED = 16
"""Series of times whose changes are kept, since the annotations of one scene have the same times over and over."""

_IDENTITY = (0.0, 0.0, 0.0, 1.0)


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

    @classmethod
    def along(cls, new_from_old: Poses, *, reach_ns: int = 0, held: bool = False) -> "FrameChange":
        """The poses of the old frame in the new one."""
        return cls(PoseSource(new_from_old, RigidTransform.identity(), reach_ns), held=held)

    @property
    def _moving(self) -> list[Poses]:
        sources = (self.hub_from_old, self.hub_from_new)
        return [source.path for source in sources if source is not None and not source.path.static]

    @property
    def is_constant(self) -> bool:
        """Whether it is the same at all times."""
        return not self._moving

    @property
    def knots_ns(self) -> Int64Array:
        """Times (K,) int64 [ns], ascending, at which the paths behind it have poses."""
        return np.unique(np.concatenate([np.zeros(0, np.int64), *(path.timestamps_ns for path in self._moving)]))

    def inverse(self) -> "FrameChange":
        """`old_from_new`."""
        return FrameChange(self.hub_from_new, self.hub_from_old, self.held)

    def at(self, timestamps_ns: Int64Array) -> PoseSamples:
        """Give `new_from_old` at each time, (M,) int64 [ns]; NaN where it is not known."""
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
        if self.held and not source.path.static:
            return source.at(np.clip(timestamps_ns, source.path.start_ns, source.path.stop_ns))
        return source.at(timestamps_ns)

    def is_known(self, timestamps_ns: Int64Array) -> BoolArray:
        """Report at which of the times, (M,) int64 [ns], the change is known."""
        return self.at(timestamps_ns).coverage <= KNOWN

    def transform(self, timestamp_ns: int) -> RigidTransform:
        """`new_from_old` at a time at which it is known."""
        pose = self.at(np.array([timestamp_ns], np.int64))
        return RigidTransform.from_quaternion(pose.positions[0], pose.quaternions_xyzw[0])

    def positions(self, timestamps_ns: Int64Array, positions: FloatArray) -> Float64Array:
        """Take positions (M, ..., 3) [m] of the old frame into the new one, row k at time k; NaN where not known."""
        pose = self.at(timestamps_ns)
        lead = (len(timestamps_ns), *(1,) * (np.ndim(positions) - 2), 3)
        rotations = matrix_from_quaternion(pose.quaternions_xyzw)
        rotated = np.einsum("mij,m...j->m...i", rotations, np.asarray(positions, np.float64))
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

    def trajectory(self, trajectory: Trajectory) -> Trajectory | None:
        """Give a trajectory in the new world, at those of its times at which that is known; None where none is."""
        times_ns, quaternions = trajectory.timestamps_ns, trajectory.quaternions_xyzw
        new = self.poses(
            times_ns,
            trajectory.positions,
            np.tile(_IDENTITY, (len(times_ns), 1)) if quaternions is None else quaternions,
        )
        known = new.coverage <= KNOWN
        if not known.any():
            return None
        covariances = trajectory.covariances
        if covariances is not None:
            axes = matrix_from_quaternion(self.at(times_ns).quaternions_xyzw)
            both = np.zeros((len(axes), 6, 6))
            both[:, :3, :3] = both[:, 3:, 3:] = axes
            covariances = both @ covariances @ both.transpose(0, 2, 1)
        rotations = None if quaternions is None else new.quaternions_xyzw
        moved = replace(trajectory, positions=new.positions, quaternions_xyzw=rotations, covariances=covariances)
        return select_rows(moved, known)


def points_change(
    scene: Scene, sensor: LidarSensor | RadarSensor, ego: EgoMotion | None, frame: PointsFrame, *, reach_ns: int
) -> FrameChange | None:
    """Give what takes a sensor's points into a frame; None where they are in it already.

    Raises:
        PoseError: the poses that this needs are not known.
    """
    if sensor.points_frame is frame:
        return None
    on_ego = None
    if sensor.mount is not None:
        on_ego = PoseSource(Poses.identity(), sensor.mount)
    elif sensor.coordinates is Coordinates.EGO and sensor.poses is not None:
        static = len(sensor.poses.timestamps_ns) == 1
        on_ego = PoseSource(replace(sensor.poses, static=static), RigidTransform.identity(), reach_ns)
    if on_ego is not None and PointsFrame.WORLD not in {frame, sensor.points_frame}:
        change = FrameChange(on_ego)
        return change if frame is PointsFrame.EGO else change.inverse()
    return FrameChange(
        points_source(scene, sensor, ego, reach_ns=reach_ns),
        points_source(scene, replace(sensor, points_frame=frame), ego, reach_ns=reach_ns),
    )


_TO_EGO = "to_ego"
"""Our entry of the metadata that lists what bringing a scene onto the ego added, so that it can be removed again."""


def to_world(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    annotations_in: Coordinates | str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring points, poses and annotations into the world, each frame and keyframe at its own time.

    A frame moves as a whole: motion during a sweep is not corrected. Frames and keyframes at whose times the ego
    trajectory is not known, nor within one sweep period of it, are left out.

    Args:
        scene: the scene.
        trajectory: name of the ego trajectory, "identity", "lidar" for lidar odometry, or None for the default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        annotations_in: "world" or "ego", where the scene does not state in which frame its annotations are.
        progress: called after each sweep that the trajectory is estimated from.

    Raises:
        PoseError: the poses that this needs are not known.
        OptionError: an argument has no such value.
        DataError: a frame that this needs cannot be read.
    """
    stated = _stated_annotations_frame(scene, annotations_in)
    needed = trajectory is not None or stated is Coordinates.EGO or _depends_on_ego(scene)
    ego = ego_motion_as_given(scene, name=trajectory, heading=heading, progress=progress) if needed else None
    mover = _SensorMover(scene, ego, anew=trajectory is not None)
    changed = mover.moved(_with_trajectory(scene, ego), mover.in_world)
    if stated is Coordinates.EGO and ego is not None:
        changed = _annotations_moved(changed, _world_from_ego(scene, ego), _added_before(scene))
    return with_ours(changed, **{ANNOTATIONS_FRAME: Coordinates.WORLD.value, _TO_EGO: None})


def annotations_to_world(scene: Scene, *, trajectory: str | None = None, heading: str | None = None) -> Scene:
    """Bring only the annotations into the world, if the scene states that they are on the ego.

    Arguments and errors as in `to_world`.
    """
    if annotations_frame(scene) is Coordinates.WORLD:
        return scene
    ego = ego_motion_as_given(scene, name=trajectory, heading=heading)
    moved = _annotations_moved(scene, _world_from_ego(scene, ego), _added_before(scene))
    return with_ours(moved, **{ANNOTATIONS_FRAME: Coordinates.WORLD.value, _TO_EGO: None})


def to_ego(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    annotations_in: Coordinates | str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring points, poses and annotations onto the ego, each frame and keyframe at its own time.

    An odometry sensor reports where the ego was. Annotations get keyframes at the times of frames at which they would
    otherwise be more than 1 mm or 0.01 degrees off; what is stationary in the world moves on the ego. `to_world`
    removes these again. Maps stay in the world, as the format requires. Arguments and errors as in `to_world`.
    """
    stated = _stated_annotations_frame(scene, annotations_in)
    ego = ego_motion_as_given(scene, name=trajectory, heading=heading, progress=progress)
    changed, odometry_id = with_odometry(_with_trajectory(scene, ego), ego.path)
    mover = _SensorMover(scene, ego)
    changed = mover.moved(changed, partial(mover.on_ego, odometry_id))
    entry: list[dict[str, Any]] = []
    if stated is Coordinates.WORLD:
        changed = _annotations_moved(changed, _world_from_ego(scene, ego).inverse(), {}, entry)
    elif isinstance(ours_of(scene).get(_TO_EGO), list):
        entry = ours_of(scene)[_TO_EGO]
    return with_ours(changed, **{ANNOTATIONS_FRAME: Coordinates.EGO.value, _TO_EGO: entry or None})


def to_sensor(
    scene: Scene, *, trajectory: str | None = None, heading: str | None = None, progress: Progress | None = None
) -> Scene:
    """Bring the points of lidars and radars into the frames of their sensors, each frame at its own time.

    Poses and annotations stay where they are. Arguments and errors as in `to_world`.
    """
    needed = trajectory is not None or bool(scene.trajectories)
    ego = ego_motion_as_given(scene, name=trajectory, heading=heading, progress=progress) if needed else None
    mover = _SensorMover(scene, ego)
    return mover.moved(_with_trajectory(scene, ego), mover.in_sensor)


def _stated_annotations_frame(scene: Scene, stated: Coordinates | str | None) -> Coordinates:
    if stated is None:
        return annotations_frame(scene)
    check_choice("annotations in", stated, Coordinates)
    return Coordinates(stated)


def _depends_on_ego(scene: Scene) -> bool:
    """Whether a sensor or its points are located relative to the ego."""
    posed = [s for s in scene.sensors if isinstance(s, Posed)]
    clouds = [s for s in posed if isinstance(s, LidarSensor | RadarSensor)]
    return (
        needs_ego(scene)
        or any(sensor.coordinates is Coordinates.EGO for sensor in posed)
        or any(sensor.points_frame is PointsFrame.EGO for sensor in clouds)
        or any(s.mount is not None and s.points_frame is not PointsFrame.WORLD for s in clouds)
    )


def _with_trajectory(scene: Scene, ego: EgoMotion | None) -> Scene:
    """The scene with the ego trajectory, where that was estimated from it, and with the warnings about it."""
    if ego is None:
        return scene
    if is_computed(scene, ego.name):
        return with_trajectory_estimated(scene, ego)
    return replace(scene, warnings=(*scene.warnings, *ego.warnings))


def _world_from_ego(scene: Scene, ego: EgoMotion) -> FrameChange:
    return FrameChange.along(ego.path, reach_ns=scene_period_ns(scene))


EGO_ID = "ego"
"""Id of an odometry sensor that is added, if it is free."""


def with_odometry(scene: Scene, path: Poses, *, wanted: Identifier = EGO_ID) -> tuple[Scene, Identifier]:
    """Give the scene with an odometry sensor that reports this path, and the sensor's id.

    Args:
        wanted: id of a sensor that is added; it gets a number where another sensor has the id.
    """
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and same_direction(sensor.poses, path):
            return scene, sensor.id
    taken = {sensor.id for sensor in scene.sensors}
    choices: list[Identifier] = [wanted, *(f"{wanted}{number}" for number in range(2, len(taken) + 2))]
    odometry = OdometrySensor(next(choice for choice in choices if choice not in taken), path)
    return replace(scene, sensors=(*scene.sensors, odometry)), odometry.id


@dataclass(slots=True)
class _SensorMover:
    """Moves the sensors of a scene, and collects what is to be reported."""

    scene: Scene
    ego: EgoMotion | None = None  # if it is needed
    anew: bool = False  # place mounted sensors along the ego trajectory even where their own poses are in the world
    _renumberings: dict[Key, Renumbering] = field(default_factory=dict)
    _warnings: list[DataWarning] = field(default_factory=list)

    def moved(self, scene: Scene, move: Callable[[Sensor], Sensor]) -> Scene:
        """Give the scene with every sensor moved; labelled points follow their frames."""
        sensors = tuple(map(move, scene.sensors))
        annotations, reported = renumbered(scene.annotations, self._renumberings)
        return with_warnings(replace(scene, sensors=sensors, annotations=annotations), (*self._warnings, *reported))

    def in_world(self, sensor: Sensor) -> Sensor:
        if not isinstance(sensor, Posed):
            return self._not_posed(sensor)
        placed: Posed = replace(sensor, poses=self._poses_in_world(sensor), coordinates=Coordinates.WORLD)
        return self._with_points_in(placed, PointsFrame.WORLD, sensor)

    def on_ego(self, odometry_id: Identifier, sensor: Sensor) -> Sensor:
        if isinstance(sensor, PointsSensor):
            what = "a map has no time, so it has no position on the ego; it stays in the world"
            self._warn(assumed("map-in-world", f"sensors[{sensor.id}]", what))
        if not isinstance(sensor, Posed):
            return self._not_posed(sensor)
        parent_id = self._parent(sensor, odometry_id)
        placed: Posed = replace(
            sensor, poses=self._poses_on_ego(sensor), coordinates=Coordinates.EGO, parent_id=parent_id
        )
        return self._with_points_in(placed, PointsFrame.EGO, sensor)

    def in_sensor(self, sensor: Sensor) -> Sensor:
        return self._with_points_in(sensor, PointsFrame.SENSOR, sensor) if isinstance(sensor, Posed) else sensor

    def in_new_world(self, change: FrameChange, sensor: Sensor) -> Sensor:
        if isinstance(sensor, OdometrySensor):
            return replace(sensor, poses=_moved_poses(change, sensor) or sensor.poses)
        if isinstance(sensor, PointsSensor) and change.is_constant:
            return replace(sensor, positions=_moved_points(sensor.positions, change.transform(0)))
        if isinstance(sensor, PointsSensor):
            what = "a map has no time, and the change is not the same at all times; left as it is"
            self._warn(assumed("map-not-moved", f"sensors[{sensor.id}]", what))
        if not isinstance(sensor, Posed):
            return self._not_posed(sensor)
        if sensor.poses is not None and sensor.coordinates is Coordinates.WORLD:
            sensor = replace(sensor, poses=_moved_poses(change, sensor))
        if isinstance(sensor, LidarSensor | RadarSensor) and sensor.points_frame is PointsFrame.WORLD:
            sensor = self._with_points_moved(sensor, change)
        return sensor

    def _warn(self, warning: DataWarning) -> None:
        self._warnings.append(warning)

    def _not_posed(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, PlainSensor):
            what = f"a sensor of type {sensor.type!r}: it is not known which of its fields are positions; left as it is"
            self._warn(assumed("sensor-not-moved", f"sensors[{sensor.id}]", what))
        return sensor

    def _with_points_in(self, placed: Posed, frame: PointsFrame, before: Posed) -> Sensor:
        """Move the points of a sensor into a frame by the poses that it had before."""
        if not isinstance(placed, LidarSensor | RadarSensor) or not isinstance(before, LidarSensor | RadarSensor):
            return placed
        change = points_change(self.scene, before, self.ego, frame, reach_ns=scene_period_ns(self.scene))
        moved = placed if change is None else self._with_points_moved(placed, change)
        return replace(moved, points_frame=frame)

    def _with_points_moved(self, sensor: LidarSensor | RadarSensor, change: FrameChange) -> Any:
        """Move the points of a sensor; frames at whose times the change is not known are left out."""
        times_ns, location = sensor.frames.timestamps_ns, f"sensors[{sensor.id}].frames"
        coverage = change.at(times_ns).coverage
        numbers = np.flatnonzero(coverage <= KNOWN)
        lost = len(times_ns) - len(numbers)
        if lost:
            self._renumberings[key_of(sensor.id)] = Renumbering(numbers)
        what = "frames at whose time the ego trajectory is not known"
        self._warn(skipped("frames-beyond-the-trajectory", location, what, count=lost))
        what, beyond = "frames beyond the ends of the trajectory, which is extrapolated", coverage[numbers] == KNOWN
        self._warn(assumed("frames-extrapolated", location, what, count=int(np.count_nonzero(beyond))))
        frames: Any = sensor.frames.chosen(numbers).mapped(partial(_moved_frame, change))
        return replace(sensor, frames=frames)

    def _poses_in_world(self, sensor: Posed) -> Poses | None:
        """Where a sensor was in the world, at the times of its own poses, else as frames need it; None if unknown."""
        own, reach_ns = sensor.poses, scene_period_ns(self.scene)
        if own is not None and sensor.coordinates is Coordinates.WORLD and not (self.anew and sensor.mount is not None):
            return own
        if own is not None and len(own.timestamps_ns) > 1 and sensor.coordinates is Coordinates.EGO:
            # at its own times, not by a path composed of both: that would end where the shorter of them ends
            return FrameChange.along(ego_path(self.scene, sensor, self.ego), reach_ns=reach_ns).path(own)
        try:
            source = sensor_source(self.scene, sensor, self.ego, reach_ns=reach_ns)
        except PoseError:
            if own is None:
                return None
            raise
        times_ns = frame_times(sensor)
        if (own is None or len(own.timestamps_ns) < 2) and len(times_ns):
            if isinstance(sensor, CameraSensor | DepthCameraSensor):
                return camera_path(source, shots_of(sensor))
            return sensor_path(source, times_ns)
        at = own.timestamps_ns if own is not None and len(own.timestamps_ns) > 1 else source.path.timestamps_ns
        return FrameChange(source).path(Poses.identity(), times_ns=at)

    def _poses_on_ego(self, sensor: Posed) -> Poses | None:
        """Where a sensor was on the ego, at the times of its own poses; None where it has none there."""
        if sensor.poses is None or sensor.coordinates is Coordinates.EGO or self.ego is None:
            return sensor.poses
        times_ns = np.unique(frame_times(sensor)) if sensor.poses.static else None
        if times_ns is not None and len(times_ns) == 0:
            times_ns = self.ego.path.timestamps_ns
        return _world_from_ego(self.scene, self.ego).inverse().path(sensor.poses, times_ns=times_ns)

    def _parent(self, sensor: Posed, odometry_id: Identifier) -> Identifier | None:
        """The parent of a sensor on the ego: the odometry, where there are several and it would not be clear."""
        # Source: READING of "GPSSensor" in docs/CONVENTIONS.md
        odometries = [key_of(other.id) for other in self.scene.sensors if isinstance(other, OdometrySensor)]
        if sensor.coordinates is Coordinates.EGO or not set(odometries) - {key_of(odometry_id)}:
            return sensor.parent_id
        if sensor.parent_id is not None and key_of(sensor.parent_id) not in odometries:
            raise OptionError(
                f"{self.scene.source}: sensor {sensor.id!r} has the parent {sensor.parent_id!r}, and several odometry "
                "sensors could be its ego; leave out all but one with `sceneloom edit crop --without ID`"
            )
        return odometry_id


def _moved_poses(change: FrameChange, sensor: Posed | OdometrySensor) -> Poses | None:
    """The poses of a sensor; those of a stationary one at the times of its frames where the change varies."""
    if sensor.poses is None or not sensor.poses.static or change.is_constant:
        return None if sensor.poses is None else change.path(sensor.poses)
    times_ns = np.unique(frame_times(sensor))
    return change.path(sensor.poses, times_ns=times_ns if len(times_ns) else change.knots_ns)


def _moved_frame(change: FrameChange, frame: Any) -> Any:
    """A frame whose points are in another frame; a radar's directions rotate, too."""
    new_from_old = change.transform(frame.timestamp_ns)
    points: Any = replace(frame.points, positions=_moved_points(frame.points.positions, new_from_old))
    directions = getattr(points, "directions", None)
    if directions is not None:
        points = replace(points, directions=new_from_old.rotate(directions).astype(np.float32))
    return replace(frame, points=points)


def _moved_points(positions: Float32Array, new_from_old: RigidTransform) -> Float32Array:
    """Take positions (N, 3) float32 [m] into another frame, computed in float64."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = new_from_old.apply(positions).astype(np.float32)
    lost = finite_rows(positions) & ~finite_rows(moved)
    if lost.any():
        row = int(lost.argmax())
        raise ArrayError(
            f"points.positions[{row}]: {positions[row].tolist()} moved by {new_from_old.translation.tolist()}; "
            "expected metres within the range of float32"
        )
    return moved


def moved_world(scene: Scene, change: FrameChange) -> Scene:
    """Give the scene in another world, each thing at its own time.

    What is located on the ego or in a sensor stays there; maps move only where the change is the same at all times.

    Args:
        scene: the scene.
        change: `new_world_from_old`.

    Raises:
        DataError: a frame with labelled points cannot be read.
    """
    sensors = _SensorMover(scene)
    moved = sensors.moved(scene, partial(sensors.in_new_world, change))
    left_out = 0
    if annotations_frame(scene) is Coordinates.WORLD:
        mover = _AnnotationMover(change, CuboidAngles.of(scene), frames_ns(scene), in_world=True)
        moved = replace(moved, annotations=mover.moved(moved.annotations))
        left_out = mover.left_out
    trajectories = {name: change.trajectory(trajectory) for name, trajectory in scene.trajectories.items()}
    what = "keyframes at whose time the new world is not known"
    return with_warnings(
        replace(moved, trajectories={name: one for name, one in trajectories.items() if one is not None}),
        (_not_moved(moved.annotations), skipped("keyframes-left-out", "annotations", what, count=left_out)),
    )


def _not_moved(annotations: Iterable[Annotation]) -> DataWarning:
    what = "annotations of unknown types: it is not known which of their fields are positions; left as they are"
    count = sum(isinstance(annotation, PlainAnnotation) for annotation in annotations)
    return assumed("annotations-not-moved", "annotations", what, count=count)


# Annotations: keyframes are chosen so that interpolation in the new frame gives what it gave in the old one.

_POSITION_TOLERANCE, _ROTATION_TOLERANCE = 1e-3, radians(0.01)
"""A keyframe is added at a frame's time where without it something would be further off then [m], [rad]."""

_ROUNDED_NS = 500  # how far rounding to microseconds, the coarsest unit of files, moves a timestamp [ns]

_PathKey = tuple[type, Identifier, int]
"""A path of an annotation: type of its id, its id, number of the path among those of its points."""

_Sampler = Callable[[Int64Array], tuple[Float64Array, Float64Array | None]]
"""Gives, at times (M,), positions (M, V, 3) [m] in the old frame that must be kept, and a rotation (M, 4) or None."""


@dataclass(frozen=True, slots=True)
class _AddedKeyframes:
    """The keyframes that a path got because it moves otherwise in the new frame."""

    timestamps_ns: tuple[int, ...]
    stationary: bool  # in the old frame


def _annotations_moved(
    scene: Scene,
    change: FrameChange,
    before: Mapping[_PathKey, _AddedKeyframes],
    entry: list[dict[str, Any]] | None = None,
) -> Scene:
    """Move a scene's annotations by `new_from_old`, without keyframes of `before`; `entry` gets those it adds."""
    times = frames_ns(scene)
    times = times if len(times) else change.knots_ns
    mover = _AnnotationMover(change, CuboidAngles.of(scene), times[change.is_known(times)], before)
    moved = mover.moved(scene.annotations)
    if entry is not None:
        names = ("annotation_id", "path", "stationary", "added_ns")
        rows = ((*key[1:], added.stationary, list(added.timestamps_ns)) for key, added in mover.added.items())
        entry.extend(dict(zip(names, row, strict=True)) for row in rows)
    unplaced = "keyframes at whose time the ego trajectory is not known"
    absent = "annotations at none of whose times the ego trajectory is known"
    gone = len(scene.annotations) - len(moved)
    warnings = (
        skipped("keyframes-beyond-the-trajectory", "annotations", unplaced, count=mover.left_out),
        skipped("annotations-beyond-the-trajectory", "annotations", absent, count=gone),
        _not_moved(scene.annotations),
    )
    return with_warnings(replace(scene, annotations=moved), warnings)


def _added_before(scene: Scene) -> Mapping[_PathKey, _AddedKeyframes]:
    """The keyframes that bringing the scene onto the ego added, as far as the metadata list them as we do."""
    entries = ours_of(scene).get(_TO_EGO)
    found: dict[_PathKey, _AddedKeyframes] = {}
    for entry in entries if isinstance(entries, list) else []:
        if not isinstance(entry, Mapping):
            continue
        identifier, path, times = (entry.get(name) for name in ("annotation_id", "path", "added_ns"))
        if not (isinstance(identifier, str | int) and isinstance(path, int) and isinstance(times, list)):
            continue
        if all(isinstance(time_ns, int) for time_ns in times):
            added = _AddedKeyframes(tuple(times), bool(entry.get("stationary")))
            found[type(identifier), identifier, path] = added
    return found


@dataclass(slots=True, eq=False)
class _AnnotationMover:
    """Moves annotations into another frame, and chooses their keyframes."""

    change: FrameChange  # `new_from_old`
    angles: CuboidAngles
    frames_ns: Int64Array  # (L,), ascending, the times of the scene's frames, at which paths must be right, too
    added_before: Mapping[_PathKey, _AddedKeyframes] = field(default_factory=lambda: MappingProxyType({}))
    in_world: bool = False  # both frames are: what is stationary stays so; else it gets keyframes, first to last frame
    added: dict[_PathKey, _AddedKeyframes] = field(default_factory=dict)  # of every path if the change varies
    left_out: int = 0  # keyframes at whose times the change is not known

    def moved(self, annotations: Iterable[Annotation]) -> tuple[Annotation, ...]:
        """Give the annotations in the new frame; those that are known at no time there are left out."""
        return tuple(annotation for annotation in map(self._moved, annotations) if annotation is not None)

    def _moved(self, annotation: Annotation) -> Annotation | None:
        match annotation:
            case LocalizationAdjustment():
                return self._adjustment(annotation)
            case CuboidAnnotation():
                return self._cuboid(annotation)
            case ShapeAnnotation() if annotation.dimensions == 3 and len(annotation.path.timestamps_ns):
                return self._shape(annotation)
            case PointsAnnotation():
                return self._points(annotation)
        return annotation

    def _adjustment(self, adjustment: LocalizationAdjustment) -> LocalizationAdjustment | None:
        """The adjustment that leads from the new frame to where it led from the old one; None without common times."""
        # A'(t) = A(t) old_from_new(t), of worlds new_from_old(t) A(t) old_from_new(t)
        poses, times = adjustment.poses, self.change.knots_ns
        if not poses.static:
            inside = times[(times >= poses.start_ns) & (times <= poses.stop_ns)]
            times = np.union1d(poses.timestamps_ns, inside)
        old_from_new = self.change.inverse().path(Poses.identity(), times_ns=times if len(times) else None)
        if old_from_new is None:
            return None
        moved: Poses | None = FrameChange.along(poses, held=True).path(old_from_new) or poses
        if self.in_world and moved is not None:
            moved = self.change.path(moved)
        return None if moved is None else replace(adjustment, poses=moved)

    def _cuboid(self, annotation: CuboidAnnotation) -> CuboidAnnotation | None:
        key, path = _key(annotation), annotation.path
        if len(path.timestamps_ns):
            old = replace(annotation, path=self._own_keyframes(key, path))

            def sample(times_ns: Int64Array) -> tuple[Float64Array, Float64Array]:
                rows = cuboid_at(old, times_ns, angles=self.angles)[0]
                return rows[:, None, 3:6], self.angles.quaternions(rows[:, 6:])

            times_ns = self._times(key, old.path.timestamps_ns, sample, stationary=bool(annotation.stationary))
            if len(times_ns) == 0:
                return None
            rows = cuboid_at(old, times_ns, angles=self.angles)[0]
            path = replace(path, timestamps_ns=times_ns, values=self._cuboid_rows(times_ns, rows))
        return replace(
            annotation,
            path=path,
            stationary=self._stationary(key, was=annotation.stationary),
            activations=tuple(replace(entry, cuboids=self._seen_rows(entry)) for entry in annotation.activations),
            projections=tuple(replace(entry, cuboids=self._seen_rows(entry)) for entry in annotation.projections),
        )

    def _cuboid_rows(self, times_ns: Int64Array, rows: Float64Array) -> Float64Array:
        """Move rows (M, 9) of cuboids, row k at time k; angles are those nearest to the old ones."""
        new = self.change.poses(times_ns, rows[:, 3:6], self.angles.quaternions(rows[:, 6:]))
        angles = rows[:, 6:]
        if (self.change.at(times_ns).quaternions_xyzw != _IDENTITY).any():
            angles = self.angles.from_quaternions(new.quaternions_xyzw, near=angles)
        return np.concatenate([rows[:, :3], new.positions, angles], axis=1)

    def _seen_rows(self, entry: Any) -> Float64Array | None:
        """The cuboids of an activation or a projection at its own times, rows of NaN for null."""
        if entry.cuboids is None:
            return None
        moved = np.full(entry.cuboids.shape, np.nan)
        there = np.flatnonzero(np.isfinite(entry.cuboids).all(axis=1))
        moved[there] = self._cuboid_rows(entry.timestamps_ns[there], entry.cuboids[there])
        return moved

    def _shape(self, annotation: ShapeAnnotation) -> ShapeAnnotation | None:
        key = _key(annotation)
        old = replace(annotation, path=self._own_keyframes(key, annotation.path))
        counts = {len(vertices) for vertices in old.path.vertices}

        def sample(times_ns: Int64Array) -> tuple[Float64Array, None]:
            # vertices that come and go have no positions between keyframes
            if len(counts) > 1:
                return np.zeros((len(times_ns), 0, 3)), None
            found = shape_at(old, times_ns)
            unknown = np.full((next(iter(counts)), 3), np.nan)
            return np.stack([unknown if vertices is None else vertices for vertices in found]), None

        times_ns = self._times(key, old.path.timestamps_ns, sample, stationary=bool(annotation.stationary))
        if len(times_ns) == 0:
            return None
        found = [vertices for vertices in shape_at(old, times_ns) if vertices is not None]
        vertices = tuple(self.change.positions(times_ns[k : k + 1], one[None])[0] for k, one in enumerate(found))
        stationary = self._stationary(key, was=annotation.stationary)
        return replace(annotation, path=VertexPath(times_ns, vertices, old.path.extras), stationary=stationary)

    def _points(self, annotation: PointsAnnotation) -> PointsAnnotation | None:
        stationary = bool(annotation.stationary)
        paths = tuple(
            self._point(_key(annotation, number), path, stationary=stationary)
            for number, path in enumerate(annotation.paths)
        )
        if annotation.paths and not any(len(path.timestamps_ns) for path in paths):
            return None
        return replace(
            annotation,
            paths=paths,
            stationary=self._stationary(_key(annotation), was=annotation.stationary),
            projections=tuple(tuple(map(self._seen_point, entries)) for entries in annotation.projections),
        )

    def _point(self, key: _PathKey, path: PointPath, *, stationary: bool) -> PointPath:
        if len(path.timestamps_ns) == 0 or path.values.shape[1] % 3:
            return path
        old = self._own_keyframes(key, path)

        def sample(times_ns: Int64Array) -> tuple[Float64Array, None]:
            return locations_of(point_at(old, times_ns, stationary=stationary)[0]), None

        times_ns = self._times(key, old.timestamps_ns, sample, stationary=stationary)
        moved = self.change.positions(times_ns, sample(times_ns)[0])
        return replace(path, timestamps_ns=times_ns, values=moved.reshape(len(times_ns), path.values.shape[1]))

    def _seen_point(self, entry: PointProjection) -> PointProjection:
        if entry.positions is None:
            return entry
        return replace(entry, positions=self.change.positions(entry.timestamps_ns, entry.positions))

    def _own_keyframes(self, key: _PathKey, path: Any) -> Any:
        """A path without the keyframes that an earlier change added; with one where no others are left."""
        if key not in self.added_before:
            return path
        own = np.flatnonzero(~_near(path.timestamps_ns, np.array(self.added_before[key].timestamps_ns, np.int64)))
        return select_rows(path, own if len(own) else np.arange(1))

    def _stationary(self, key: _PathKey, *, was: bool | None) -> bool | None:
        """Whether something is stationary in the new frame, as it was, or was not, or is not stated."""
        if key in self.added_before and self.added_before[key].stationary:
            return True
        return False if was and self._sets_moving else was

    @property
    def _sets_moving(self) -> bool:
        """Whether what is stationary in the old frame moves in the new one."""
        return not self.in_world and len(self.frames_ns) > 0 and not self.change.is_constant

    def _times(self, key: _PathKey, timestamps_ns: Int64Array, sample: _Sampler, *, stationary: bool) -> Int64Array:
        """Ascending times (K,) [ns] of a path's keyframes in the new frame, by `sample` in the old; none if unknown."""
        times, moving = np.unique(timestamps_ns), stationary and self._sets_moving
        if moving:
            first, last = self.frames_ns[[0, -1]]
            times = np.union1d([first, last], times[(times >= first) & (times <= last)])
        times = times[self.change.is_known(times)]
        # what an earlier change added is removed without adding anything
        if not self.change.is_constant and len(times) > 1 and key not in self.added_before:
            between = self.frames_ns[(self.frames_ns > times[0]) & (self.frames_ns < times[-1])]
            looks = np.union1d(times, between)
            if len(looks) > len(times):
                times = np.union1d(times, looks[self._bends(looks, times, sample)])
        if not moving:
            self.left_out += len(np.setdiff1d(timestamps_ns, times))
        if not self.change.is_constant:
            added = np.setdiff1d(times, timestamps_ns)
            self.added[key] = _AddedKeyframes(tuple(added.tolist()), moving)
        return times

    def _bends(self, looks_ns: Int64Array, required_ns: Int64Array, sample: _Sampler) -> Int64Array:
        """Rows of the times that are needed besides the required ones."""
        positions, rotations = sample(looks_ns)
        change = self.change.at(looks_ns)
        known = np.flatnonzero(change.coverage <= KNOWN)
        new = self.change.positions(looks_ns[known], positions[known])
        quaternions = np.tile(_IDENTITY, (len(known), 1))
        if rotations is not None:
            quaternions = multiply_quaternions(change.quaternions_xyzw[known], rotations[known])
        rows = [
            thin_poses(
                looks_ns[known],
                np.ascontiguousarray(new[:, vertex]),
                quaternions,
                required_ns,
                position_tolerance=_POSITION_TOLERANCE,
                rotation_tolerance=_ROTATION_TOLERANCE,
            )
            for vertex in range(new.shape[1])
        ]
        return known[np.unique(np.concatenate(rows))] if rows else known[:0]


def _key(annotation: Annotation, number: int = 0) -> _PathKey:
    return type(annotation.id), annotation.id, number


def _near(timestamps_ns: Int64Array, others_ns: Int64Array) -> BoolArray:
    """Report which timestamps are one of the others, as a file of microseconds may have rounded it."""
    if len(others_ns) == 0:
        return np.zeros(len(timestamps_ns), np.bool_)
    others = np.sort(others_ns)
    after = np.searchsorted(others, timestamps_ns)
    nearest = [np.abs(timestamps_ns - others[np.clip(rows, 0, len(others) - 1)]) for rows in (after - 1, after)]
    near: BoolArray = np.minimum(*nearest) <= _ROUNDED_NS
    return near
