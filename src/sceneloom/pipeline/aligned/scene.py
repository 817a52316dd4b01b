"""The scene that a fusion writes: every sensor in one world, near its origin."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.editing.frames import annotations_to_world
from sceneloom.editing.odometry import with_odometry
from sceneloom.errors import DataError, OptionError
from sceneloom.motion.ego_motion import find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.motion.sensor_paths import camera_path
from sceneloom.pipeline.aligned.origin import can_move, moved_scene
from sceneloom.scene.assumed_camera_models import check_camera_models
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.part import chosen_interval, cut_scene
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.scene import Scene, Sensor
from sceneloom.scene.sensor_sources import must_be_placed, needs_ego, sensor_source
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, Progress
from sceneloom.stages import stage


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A scene made ready for fusion.

    Attributes:
        scene: as read, or the chosen part of it, seen from the new origin.
        ego: the chosen ego trajectory from that origin; None where every sensor has poses of its own.
        origin_world: (3,) float64 [m], the new origin in the source's world: the first position of the ego.
    """

    scene: Scene
    ego: EgoMotion | None
    origin_world: Float64Array


def align(
    scene: Scene,
    *,
    trajectory: str | None = None,
    heading: str | None = None,
    start: float | None = None,
    stop: float | None = None,
    lenient: bool = False,
    progress: Progress | None = None,
) -> Aligned:
    """Choose the part and the ego trajectory, and put the world's origin at its first position; z stays up.

    The origin stays where it is, where points or sensors are placed in the world already, and where something in
    the scene would not move along. A trajectory that is found from the scene's own measurements becomes its first
    trajectory.

    Args:
        lenient: pass over sweeps that cannot be read while the trajectory is found.
        progress: reported after each sweep that the trajectory is found from.

    Raises:
        PoseError: the sensors' motion is not known.
        CalibrationError: nothing confirms the formula of a camera model, and computing with it was not asked for.
        OptionError: the trajectory is not known, the sensors carry their own poses, or the part is empty.
        DataError: the frames or images of a sensor do not stand in the order of their times.
    """
    scene = scene.corrected()
    _check_order(scene)
    check_camera_models(scene, [camera for camera in scene.cameras if len(camera.images)])
    scene = annotations_to_world(scene, trajectory=trajectory, heading=heading)
    part = cut_scene(scene, start=start, stop=stop)
    if not needs_ego(scene):
        if trajectory is not None:
            raise OptionError(
                f"{scene.source}: its points and sensors are placed in the world already; a trajectory cannot be chosen"
            )
        return Aligned(part, None, np.zeros(3))
    if is_computed(scene, trajectory):
        with stage("finding the trajectory"):
            ego = find_ego_motion(part, name=trajectory, heading=heading, lenient=lenient, progress=progress)
        part = with_trajectory_estimated(part, ego)
    else:
        # chosen from the whole drive: a heading comes from the trajectory before the part, too
        whole_trajectory = find_ego_motion(scene, name=trajectory, heading=heading)
        ego = whole_trajectory.within(chosen_interval(scene, start=start, stop=stop))
    origin = ego.path.positions[0].copy() if can_move(scene) else np.zeros(3)
    return Aligned(moved_scene(part, origin), ego.moved(origin), origin)


def output_scene(aligned: Aligned, *, reach_ns: int) -> tuple[Scene, Mapping[Identifier, PoseSource]]:
    """Give the scene to be written, its lidars still without frames, and where its sensors were.

    Returns:
        scene: lidar points in the world; cameras with their poses; the ego trajectory as an odometry sensor.
        sources: `world_from_sensor` of the lidars and cameras, as far as it is known or needed.

    Raises:
        PoseError: it is not known where a sensor was.
    """
    sources = {
        sensor.id: sensor_source(aligned.scene, sensor, aligned.ego, reach_ns=reach_ns)
        for sensor in _lidars_and_cameras(aligned.scene)
        if must_be_placed(sensor) or (isinstance(sensor, LidarSensor) and sensor.poses is not None)
    }
    sensors = [_output_sensor(sensor, sources) for sensor in aligned.scene.sensors]
    written = replace(aligned.scene, sensors=tuple(sensors))
    return (written if aligned.ego is None else with_odometry(written, aligned.ego.path)[0]), sources


def _check_order(scene: Scene) -> None:
    """Refuse times that run backwards: what is paired and what is cut off depends on their order."""
    for sensor in scene.sensors:
        if not isinstance(sensor, LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor):
            continue
        times = frame_times(sensor)
        backwards = np.flatnonzero(times[1:] < times[:-1])
        if len(backwards):
            kind = "images" if isinstance(sensor, CameraSensor) else "frames"
            k = int(backwards[0]) + 1
            location = f"sensors[{sensor.id}].{kind}[{k}].timestamp"
            problem = f"{times[k]} ns after {times[k - 1]} ns; expected {kind} in the order of their times"
            raise DataError(scene.source, location, problem)


def _lidars_and_cameras(scene: Scene) -> list[LidarSensor | CameraSensor]:
    return [*scene.cameras, *scene.lidars]


def _output_sensor(sensor: Sensor, sources: Mapping[Identifier, PoseSource]) -> Sensor:
    if isinstance(sensor, CameraSensor) and sensor.id in sources:
        path = camera_path(sources[sensor.id], sensor.images)
        return replace(sensor, poses=path, coordinates=Coordinates.WORLD)
    if isinstance(sensor, LidarSensor):
        empty: LazyFrames[LidarFrame] = LazyFrames.of([], [])
        return replace(
            sensor, frames=empty, poses=None, coordinates=Coordinates.WORLD, points_frame=PointsFrame.WORLD
        )
    return sensor
