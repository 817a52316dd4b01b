"""A scene seen from another origin of its world; the axes stay, so z stays up."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array
from sceneloom.pipeline.aligned.shifted_annotations import annotation_can_move, moved_annotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.plain import PlainSensor
from sceneloom.scene.poses import Trajectory
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.types import Coordinates, PointsFrame

Posed = TypeVar("Posed", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)
Cloud = TypeVar("Cloud", LidarFrame, RadarFrame)


def can_move(scene: Scene) -> bool:
    """Whether everything that has a location in the world can be seen from another origin."""
    return not any(isinstance(sensor, PlainSensor) for sensor in scene.sensors) and all(
        map(annotation_can_move, scene.annotations)
    )


def moved_scene(scene: Scene, origin_world: Float64Array) -> Scene:
    """Give a scene whose world has its origin at (3,) float64 [m] of the old one; frames are moved when read."""
    return replace(
        scene,
        sensors=tuple(_moved_sensor(sensor, origin_world) for sensor in scene.sensors),
        trajectories={
            name: _moved_trajectory(trajectory, origin_world)
            for name, trajectory in scene.trajectories.items()
        },
        annotations=tuple(moved_annotation(annotation, origin_world) for annotation in scene.annotations),
    )


def _moved_sensor(sensor: Sensor, origin_world: Float64Array) -> Sensor:
    move = next((move for kind, move in _MOVES.items() if isinstance(sensor, kind)), None)
    return sensor if move is None else move(sensor, origin_world)


def _moved_poses(sensor: Posed, origin_world: Float64Array) -> Posed:
    if sensor.poses is None or sensor.coordinates is not Coordinates.WORLD:
        return sensor
    return replace(sensor, poses=sensor.poses.moved(origin_world))


def _moved_lidar(sensor: LidarSensor, origin_world: Float64Array) -> LidarSensor:
    if sensor.points_frame is PointsFrame.WORLD:
        sensor = replace(sensor, frames=_moved_frames(sensor.frames, origin_world))
    return _moved_poses(sensor, origin_world)


def _moved_radar(sensor: RadarSensor, origin_world: Float64Array) -> RadarSensor:
    if sensor.points_frame is PointsFrame.WORLD:
        sensor = replace(sensor, frames=_moved_frames(sensor.frames, origin_world))
    return _moved_poses(sensor, origin_world)


@dataclass(frozen=True, slots=True, eq=False)
class _MovedFrames(Generic[Cloud]):
    """Reads frames whose points are in the world, and moves them."""

    frames: LazyFrames[Cloud]
    origin_world: Float64Array

    def __call__(self, index: int) -> Cloud:
        frame = self.frames[index]
        positions = _moved_points(frame.points.positions, self.origin_world)
        return replace(frame, points=replace(frame.points, positions=positions))


def _moved_frames(frames: LazyFrames[Cloud], origin_world: Float64Array) -> LazyFrames[Cloud]:
    return LazyFrames(frames.timestamps_ns, _MovedFrames(frames, origin_world))


def _moved_points(positions: Float32Array, origin_world: Float64Array) -> Float32Array:
    return (positions.astype(np.float64) - origin_world).astype(np.float32)


def _moved_map(sensor: PointsSensor, origin_world: Float64Array) -> PointsSensor:
    return replace(sensor, positions=_moved_points(sensor.positions, origin_world))


def _moved_odometry(sensor: OdometrySensor, origin_world: Float64Array) -> OdometrySensor:
    return replace(sensor, poses=sensor.poses.moved(origin_world))


def _moved_trajectory(trajectory: Trajectory, origin_world: Float64Array) -> Trajectory:
    return replace(trajectory, positions=trajectory.positions - origin_world)


_MOVES: Mapping[type, Callable[[Any, Float64Array], Sensor]] = MappingProxyType(
    {
        LidarSensor: _moved_lidar,
        RadarSensor: _moved_radar,
        CameraSensor: _moved_poses,
        DepthCameraSensor: _moved_poses,
        PointsSensor: _moved_map,
        OdometrySensor: _moved_odometry,
    }
)
"""How the sensors that have a location in the world move; the others have none."""
