"""Scenes with points, poses and annotations in the world, on the ego or in their sensors.

And scenes in another world.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.move_annotations import (
    TO_EGO,
    AnnotationMover,
    Keyframer,
    added_before,
    annotations_moved,
    frames_ns,
    seen_from,
)
from sceneloom.editing.move_points import (
    KNOWN,
    CloudMoves,
    FrameChange,
    moved_positions,
    points_change,
    poses_in_world,
    poses_on_ego,
)
from sceneloom.editing.references import assumed, ours_of, skipped, with_ours, with_warnings
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.motion.ego_trajectory import ego_motion_as_given, is_computed, with_trajectory_estimated
from sceneloom.scene.annotations import PlainAnnotation
from sceneloom.scene.annotations_at import ANNOTATIONS_FRAME, CuboidAngles, annotations_frame
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion, Posed, needs_ego
from sceneloom.scene.motion import OdometrySensor, PlainSensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor, frame_times, scene_period_ns
from sceneloom.scene.time_range import renumbered
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, Progress, key_of

EGO_ID = "ego"
"""Id of an odometry sensor that is made, if it is free."""


def _odometry_telling(scene: Scene, path: Poses) -> OdometrySensor | None:
    """The odometry sensor that reports this very path; None where there is none."""
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor) and same_direction(sensor.poses, path):
            return sensor
    return None


def with_odometry(scene: Scene, path: Poses) -> tuple[Scene, Identifier]:
    """Give the scene with an odometry sensor that reports this path, and the sensor's id."""
    reported = _odometry_telling(scene, path)
    if reported is not None:
        return scene, reported.id
    sensor = OdometrySensor(free_id(scene, EGO_ID), path)
    return replace(scene, sensors=(*scene.sensors, sensor)), sensor.id


def free_id(scene: Scene, wanted: str) -> str:
    """The id itself, or with a number where another sensor has it."""
    taken = {sensor.id for sensor in scene.sensors}
    choices = (wanted if number == 1 else f"{wanted}{number}" for number in range(1, len(taken) + 2))
    return next(choice for choice in choices if choice not in taken)


def to_world(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    annotations_in: Coordinates | str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring points, poses and annotations into the world, each frame and keyframe at its own time.

    A frame moves as a whole: the motion during a sweep is not undone. Frames and keyframes at whose times the ego
    trajectory is not known, nor within one sweep period of it, are left out.

    Args:
        scene: as it is.
        trajectory: name of the ego trajectory, "identity", "lidar" to find it from the sweeps, or None for the default.
        heading: "motion" to derive orientations where the trajectory has positions only.
        annotations_in: "world" or "ego", where the scene does not state in which frame its annotations are.
        progress: reported after each sweep that the trajectory is found from.

    Raises:
        PoseError: the poses that this needs are not known.
        OptionError: a value cannot be followed.
        DataError: a frame that this needs cannot be read.
    """
    stated = _annotations_in(scene, annotations_in)
    needed = trajectory is not None or stated is Coordinates.EGO or _rides_on_ego(scene)
    ego = _found(scene, trajectory, heading, progress) if needed else None
    sensors = partial(_sensor_in_world, scene, ego, anew=trajectory is not None)
    changed = _moved_sensors(_with_trajectory(scene, ego), sensors)
    if stated is Coordinates.EGO and ego is not None:
        changed = annotations_moved(changed, FrameChange(_trajectory(scene, ego)), added_before(scene))
    return with_ours(changed, **{ANNOTATIONS_FRAME: Coordinates.WORLD.value, TO_EGO: None})


def annotations_to_world(scene: Scene, *, trajectory: str | None = None, heading: str | None = None) -> Scene:
    """Bring only the annotations into the world, if the scene says that they are on the ego.

    Arguments and errors as in `to_world`.
    """
    if annotations_frame(scene) is Coordinates.WORLD:
        return scene
    ego = _found(scene, trajectory, heading, None)
    moved = annotations_moved(scene, FrameChange(_trajectory(scene, ego)), added_before(scene))
    return with_ours(moved, **{ANNOTATIONS_FRAME: Coordinates.WORLD.value, TO_EGO: None})


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
    otherwise be further than 1 mm or 0.01 degrees off; what is stationary in the world moves on the ego. `to_world`
    takes these away again. Maps stay in the world, as the format has them. Arguments and errors as in `to_world`.
    """
    stated = _annotations_in(scene, annotations_in)
    ego = _found(scene, trajectory, heading, progress)
    changed, odometry_id = with_odometry(_with_trajectory(scene, ego), ego.path)
    changed = _moved_sensors(changed, partial(_sensor_on_ego, scene, ego, odometry_id))
    entry: list[dict[str, Any]] = []
    if stated is Coordinates.WORLD:
        changed = annotations_moved(changed, FrameChange(None, _trajectory(scene, ego)), {}, entry)
    elif isinstance(ours_of(scene).get(TO_EGO), list):
        entry = ours_of(scene)[TO_EGO]
    return with_ours(changed, **{ANNOTATIONS_FRAME: Coordinates.EGO.value, TO_EGO: entry or None})


def to_sensor(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Bring the points of lidars and radars into the frames of their sensors, each frame at its own time.

    Poses and annotations stay where they are. Arguments and errors as in `to_world`.
    """
    needed = trajectory is not None or bool(scene.trajectories)
    ego = _found(scene, trajectory, heading, progress) if needed else None
    return _moved_sensors(_with_trajectory(scene, ego), partial(_points_in_sensor, scene, ego))


def _rides_on_ego(scene: Scene) -> bool:
    """Whether something has its location on the ego."""
    posed = [
        s
        for s in scene.sensors
        if isinstance(s, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor)
    ]
    clouds = [s for s in posed if not isinstance(s, CameraSensor | DepthCameraSensor)]
    return (
        needs_ego(scene)
        or any(sensor.coordinates is Coordinates.EGO for sensor in posed)
        or any(sensor.points_frame is PointsFrame.EGO for sensor in clouds)
        or any(s.mount is not None and s.points_frame is not PointsFrame.WORLD for s in clouds)
    )


def _found(scene: Scene, trajectory: str | None, heading: str | None, progress: Progress | None) -> EgoMotion:
    return ego_motion_as_given(scene, name=trajectory, heading=heading, progress=progress)


def _with_trajectory(scene: Scene, ego: EgoMotion | None) -> Scene:
    """The scene with the way in it, where it was found from the sweeps, and what is to be stated of it."""
    if ego is None:
        return scene
    if is_computed(scene, ego.name):
        return with_trajectory_estimated(scene, ego)
    return replace(scene, warnings=(*scene.warnings, *ego.warnings))


def _trajectory(scene: Scene, ego: EgoMotion) -> PoseSource:
    return PoseSource(ego.path, RigidTransform.identity(), scene_period_ns(scene))


_Mover = Callable[[CloudMoves, Sensor], Sensor]


def _moved_sensors(scene: Scene, move: _Mover) -> Scene:
    """Move every sensor; labelled points follow their frames."""
    moves = CloudMoves()
    sensors = tuple(move(moves, sensor) for sensor in scene.sensors)
    annotations, reported = renumbered(scene.annotations, moves.frames)
    return with_warnings(
        replace(scene, sensors=sensors, annotations=annotations), (*moves.warnings, *reported)
    )


def _sensor_in_world(
    scene: Scene, ego: EgoMotion | None, moves: CloudMoves, sensor: Sensor, *, anew: bool
) -> Sensor:
    reach_ns, world = scene_period_ns(scene), Coordinates.WORLD
    if isinstance(sensor, PlainSensor):
        return _left(moves, sensor)
    if not isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor):
        return sensor
    poses = poses_in_world(scene, sensor, ego, reach_ns=reach_ns, anew=anew)
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        return replace(sensor, poses=poses, coordinates=world)
    change = points_change(scene, sensor, ego, PointsFrame.WORLD, reach_ns=reach_ns)
    if isinstance(sensor, LidarSensor):
        return moves.cloud(replace(sensor, poses=poses, coordinates=world), change, PointsFrame.WORLD)
    return moves.cloud(replace(sensor, poses=poses, coordinates=world), change, PointsFrame.WORLD)


def _sensor_on_ego(
    scene: Scene, ego: EgoMotion, odometry_id: Identifier, moves: CloudMoves, sensor: Sensor
) -> Sensor:
    reach_ns, on_ego = scene_period_ns(scene), Coordinates.EGO
    if isinstance(sensor, PlainSensor):
        return _left(moves, sensor)
    if isinstance(sensor, PointsSensor):
        what = "a map has no time, so it has no location on the ego; it stays in the world"
        moves.warnings.append(assumed("map-in-world", f"sensors[{sensor.id}]", what))
        return sensor
    if not isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor):
        return sensor
    poses = poses_on_ego(sensor, ego, reach_ns=reach_ns)
    parent_id = _parent(scene, sensor, odometry_id)
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        return replace(sensor, poses=poses, coordinates=on_ego, parent_id=parent_id)
    change = points_change(scene, sensor, ego, PointsFrame.EGO, reach_ns=reach_ns)
    if isinstance(sensor, LidarSensor):
        placed = replace(sensor, poses=poses, coordinates=on_ego, parent_id=parent_id)
        return moves.cloud(placed, change, PointsFrame.EGO)
    return moves.cloud(
        replace(sensor, poses=poses, coordinates=on_ego, parent_id=parent_id), change, PointsFrame.EGO
    )


def _points_in_sensor(scene: Scene, ego: EgoMotion | None, moves: CloudMoves, sensor: Sensor) -> Sensor:
    if not isinstance(sensor, LidarSensor | RadarSensor):
        return sensor
    change = points_change(scene, sensor, ego, PointsFrame.SENSOR, reach_ns=scene_period_ns(scene))
    if isinstance(sensor, LidarSensor):
        return moves.cloud(sensor, change, PointsFrame.SENSOR)
    return moves.cloud(sensor, change, PointsFrame.SENSOR)


def _left(moves: CloudMoves, sensor: PlainSensor) -> PlainSensor:
    what = f"a sensor of type {sensor.type!r}: it is not known what in it has a location; left as it is"
    moves.warnings.append(assumed("sensor-not-moved", f"sensors[{sensor.id}]", what))
    return sensor


def _parent(
    scene: Scene,
    sensor: LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor,
    odometry_id: Identifier,
) -> Identifier | None:
    """The parent of a sensor on the ego: the odometry, where there are several and it would not be clear.

    Source: READING of "GPSSensor" in docs/CONVENTIONS.md.
    """
    odometries = [key_of(other.id) for other in scene.sensors if isinstance(other, OdometrySensor)]
    if sensor.coordinates is Coordinates.EGO or not set(odometries) - {key_of(odometry_id)}:
        return sensor.parent_id
    if sensor.parent_id is not None and key_of(sensor.parent_id) not in odometries:
        raise OptionError(
            f"{scene.source}: sensor {sensor.id!r} has the parent {sensor.parent_id!r}, and several odometry sensors "
            "could be its ego; leave out all but one with `sceneloom edit crop --without ID`"
        )
    return odometry_id


def _annotations_in(scene: Scene, stated: Coordinates | str | None) -> Coordinates:
    if stated is None:
        return annotations_frame(scene)
    if stated not in tuple(Coordinates):
        raise OptionError(f"annotations in {stated!r}; expected one of {', '.join(Coordinates)}")
    return Coordinates(stated)


def moved_world(scene: Scene, change: FrameChange) -> Scene:
    """Give the scene in a world of which `new_world_from_old` is given, each thing at its own time.

    What rides on the ego or in a sensor stays there; maps move only where the change is the same at all times.

    Raises:
        DataError: a frame with labelled points cannot be read.
    """
    mover = _WorldMover(change)
    sensors = tuple(mover.sensor(sensor) for sensor in scene.sensors)
    annotations, reported = renumbered(scene.annotations, mover.moves.frames)
    keyframer = Keyframer(change, looks_ns=frames_ns(scene))
    if annotations_frame(scene) is Coordinates.WORLD:
        adjust = AnnotationMover(
            keyframer, CuboidAngles.of(scene), lambda adjustment: seen_from(change, adjustment)
        )
        annotations = adjust.moved(annotations)
    trajectories = {
        name: moved_trajectory(trajectory, change) for name, trajectory in scene.trajectories.items()
    }
    unknown = sum(isinstance(annotation, PlainAnnotation) for annotation in annotations)
    warnings = (
        *mover.moves.warnings,
        *reported,
        assumed(
            "annotations-not-moved",
            "annotations",
            "annotations of unknown types: it is not known what in them has a location; left as they are",
            count=unknown,
        ),
        skipped(
            "keyframes-left-out",
            "annotations",
            "keyframes at whose time the new world is not known",
            count=keyframer.statistics.left_out,
        ),
    )
    moved = replace(
        scene,
        sensors=sensors,
        annotations=annotations,
        trajectories={
            name: trajectory for name, trajectory in trajectories.items() if trajectory is not None
        },
    )
    return with_warnings(moved, warnings)


def moved_trajectory(trajectory: Trajectory, change: FrameChange) -> Trajectory | None:
    """A way in the new world, at those of its own times at which that is known; None where there are none."""
    unturned = np.tile([0.0, 0.0, 0.0, 1.0], (len(trajectory.timestamps_ns), 1))
    rotations = unturned if trajectory.quaternions_xyzw is None else trajectory.quaternions_xyzw
    new = change.poses(trajectory.timestamps_ns, trajectory.positions, rotations)
    known = new.coverage <= KNOWN
    if not known.any():
        return None
    covariances = trajectory.covariances
    if covariances is not None:
        axes = matrix_from_quaternion(change.at(trajectory.timestamps_ns).quaternions_xyzw)
        both = np.zeros((len(axes), 6, 6))
        both[:, :3, :3] = both[:, 3:, 3:] = axes
        covariances = (both @ covariances @ both.transpose(0, 2, 1))[known]
    return Trajectory(
        trajectory.name,
        trajectory.timestamps_ns[known],
        new.positions[known],
        None if trajectory.quaternions_xyzw is None else new.quaternions_xyzw[known],
        None if trajectory.file_seconds is None else trajectory.file_seconds[known],
        covariances,
    )


@dataclass(slots=True, eq=False)
class _WorldMover:
    """Moves sensors, and collects what is to be reported."""

    change: FrameChange
    moves: CloudMoves = field(default_factory=CloudMoves)

    def sensor(self, sensor: Sensor) -> Sensor:
        if isinstance(sensor, LidarSensor):
            placed = replace(sensor, poses=self._poses(sensor))
            return self.moves.cloud(placed, self._points(sensor), sensor.points_frame)
        if isinstance(sensor, RadarSensor):
            placed_radar = replace(sensor, poses=self._poses(sensor))
            return self.moves.cloud(placed_radar, self._points(sensor), sensor.points_frame)
        if isinstance(sensor, CameraSensor | DepthCameraSensor):
            return replace(sensor, poses=self._poses(sensor))
        if isinstance(sensor, OdometrySensor):
            return replace(
                sensor, poses=self.change.path(sensor.poses, times_ns=self._times(sensor)) or sensor.poses
            )
        if isinstance(sensor, PointsSensor):
            return self._map(sensor)
        if isinstance(sensor, PlainSensor):
            what = (
                f"a sensor of type {sensor.type!r}: it is not known what in it has a location; left as it is"
            )
            self.moves.warnings.append(assumed("sensor-not-moved", f"sensors[{sensor.id}]", what))
        return sensor

    def _points(self, sensor: LidarSensor | RadarSensor) -> FrameChange | None:
        return self.change if sensor.points_frame is PointsFrame.WORLD else None

    def _poses(self, sensor: Posed) -> Poses | None:
        if sensor.poses is None or sensor.coordinates is not Coordinates.WORLD:
            return sensor.poses
        return self.change.path(sensor.poses, times_ns=self._times(sensor))

    def _times(self, sensor: Posed | OdometrySensor) -> Int64Array | None:
        """Timestamps for the poses of something stationary where the change varies over time."""
        if sensor.poses is None or not sensor.poses.static or self.change.is_constant:
            return None
        times_ns = np.unique(frame_times(sensor))
        return times_ns if len(times_ns) else self.change.knots_ns

    def _map(self, sensor: PointsSensor) -> PointsSensor:
        if self.change.is_constant:
            return replace(sensor, positions=moved_positions(sensor.positions, self.change.transform(0)))
        what = "a map has no time, and the change is not the same at all times; left as it is"
        self.moves.warnings.append(assumed("map-not-moved", f"sensors[{sensor.id}]", what))
        return sensor
