"""Scenes in another world: everything that has a location in the old one gets its location in the new one."""

from dataclasses import dataclass, field, replace

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.cloud_moves import CloudMoves
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.editing.frame_of_annotations import frames_ns
from sceneloom.editing.keyframes import Keyframer
from sceneloom.editing.moved_adjustments import seen_from
from sceneloom.editing.moved_annotations import AnnotationMover
from sceneloom.editing.moved_clouds import moved_positions
from sceneloom.editing.record import assumed, skipped, with_warnings
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.angles import CuboidAngles
from sceneloom.scene.annotations.plain import PlainAnnotation
from sceneloom.scene.annotations_frame import annotations_frame
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.labelled import renumbered
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Poses, Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.sensor_sources import Posed
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, PointsFrame


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
        """The times that the poses of something that is stationary get where the change is not the same at all times."""
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
