"""The scene that a fusion writes: every sensor in one world, near its origin."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.errors import OptionError
from sceneloom.motion.pose_source import PoseSource
from sceneloom.motion.sensor_paths import sensor_path
from sceneloom.motion.sensor_sources import sensor_source
from sceneloom.motion.trajectories import EgoMotion, choose_trajectory
from sceneloom.scene import (
    Annotation,
    CameraSensor,
    Coordinates,
    CuboidAnnotation,
    CuboidPath,
    Identifier,
    LazyFrames,
    LidarFrame,
    LidarSensor,
    OdometrySensor,
    PointsFrame,
    Scene,
    Sensor,
    Trajectory,
)

EGO_ID = "ego"


@dataclass(frozen=True, slots=True, eq=False)
class Woven:
    """A scene made ready for fusion.

    Attributes:
        scene: as read, its trajectories and annotations seen from the new origin.
        ego: the chosen way of the ego from that origin; None where every sensor has poses of its own.
        origin_world: (3,) float64 [m], the new origin in the source's world: the first position of the ego.
    """

    scene: Scene
    ego: EgoMotion | None
    origin_world: Float64Array


def weave(scene: Scene, *, trajectory: str | None = None, heading: str | None = None) -> Woven:
    """Choose the ego's way and put the world's origin at its first position; the axes stay, so z stays up.

    Raises:
        PoseError: the sensors' motion is not known.
        OptionError: the trajectory is not known, or the sensors carry their own poses.
    """
    if not _needs_ego(scene):
        if trajectory is not None:
            raise OptionError(
                f"{scene.source}: its points and sensors are placed in the world already; a trajectory cannot be chosen"
            )
        return Woven(scene, None, np.zeros(3))
    ego = choose_trajectory(scene, name=trajectory, heading=heading)
    origin = ego.path.positions[0].copy()
    moved = replace(
        scene,
        trajectories={name: _moved_trajectory(way, origin) for name, way in scene.trajectories.items()},
        annotations=tuple(_moved_annotation(annotation, origin) for annotation in scene.annotations),
    )
    return Woven(moved, ego.moved(origin), origin)


def output_scene(woven: Woven, *, reach_ns: int) -> tuple[Scene, Mapping[Identifier, PoseSource]]:
    """Give the scene to be written, its lidars still without frames, and where its sensors were.

    Returns:
        scene: lidar points in the world; cameras with their poses; the ego's way as an odometry sensor.
        sources: `world_from_sensor` of the lidars and cameras.
    """
    sources = {
        sensor.id: sensor_source(woven.scene, sensor, woven.ego, reach_ns=reach_ns)
        for sensor in _posed(woven.scene)
    }
    sensors = [_output_sensor(sensor, sources) for sensor in woven.scene.sensors]
    if woven.ego is not None and not any(sensor.id == EGO_ID for sensor in sensors):
        sensors.append(OdometrySensor(EGO_ID, woven.ego.path))
    return replace(woven.scene, sensors=tuple(sensors)), sources


def _needs_ego(scene: Scene) -> bool:
    """Whether something must still be placed: a sensor without poses, or points that ride on the ego."""
    unposed = any(sensor.poses is None for sensor in _posed(scene))
    riding = any(
        lidar.mount is not None and lidar.points_frame is not PointsFrame.WORLD for lidar in scene.lidars
    )
    return unposed or riding


def _posed(scene: Scene) -> list[LidarSensor | CameraSensor]:
    return [*scene.cameras, *scene.lidars]


def _output_sensor(sensor: Sensor, sources: Mapping[Identifier, PoseSource]) -> Sensor:
    if isinstance(sensor, CameraSensor):
        path = sensor_path(sources[sensor.id], sensor.pictures.timestamps_ns)
        return replace(sensor, poses=path, coordinates=Coordinates.WORLD)
    if isinstance(sensor, LidarSensor):
        empty: LazyFrames[LidarFrame] = LazyFrames.of([], [])
        return replace(
            sensor, frames=empty, poses=None, coordinates=Coordinates.WORLD, points_frame=PointsFrame.WORLD
        )
    return sensor


def _moved_trajectory(way: Trajectory, origin_world: Float64Array) -> Trajectory:
    return replace(way, positions=way.positions - origin_world)


def _moved_annotation(annotation: Annotation, origin_world: Float64Array) -> Annotation:
    if not isinstance(annotation, CuboidAnnotation):
        return annotation
    values = annotation.path.values.copy()
    values[:, 3:6] -= origin_world
    return replace(annotation, path=CuboidPath(annotation.path.timestamps_ns, values))
