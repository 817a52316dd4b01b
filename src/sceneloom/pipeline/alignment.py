"""Aligns a scene with the fusion origin: every sensor in one world near its origin, axes kept.

`Aligned.provenance` is what a fused scene reports about how it came about.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.editing.move_world import FrameChange, annotations_to_world, moved_world, with_odometry
from sceneloom.editing.references import ours_of
from sceneloom.errors import DataError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.ego_trajectory import find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.scene.annotations import LocalizationAdjustment, PlainAnnotation
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor
from sceneloom.scene.ego import EgoMotion, camera_path, must_be_placed, needs_ego, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import PlainSensor
from sceneloom.scene.poses import PoseSource
from sceneloom.scene.samples import choose_ego
from sceneloom.scene.scene import Posed, Scene, Sensor, check_camera_models, frame_times, scene_period_ns
from sceneloom.scene.time_range import chosen_interval, cut_scene
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

    @property
    def sweeps(self) -> int:
        """Sweeps of all lidars."""
        return sum(len(lidar.frames) for lidar in self.scene.lidars)

    @property
    def trajectory(self) -> str | None:
        """Name of the ego trajectory."""
        return None if self.ego is None else self.ego.name

    def output_scene(self) -> tuple[Scene, Mapping[Identifier, PoseSource]]:
        """Give the scene to be written, its lidars still without frames, and where its sensors were.

        Returns:
            scene: lidar points in the world; cameras with their poses; the ego trajectory as an odometry sensor.
            sources: `world_from_sensor` of the lidars and cameras, as far as it is known or needed.

        Raises:
            PoseError: it is not known where a sensor was.
        """
        scene, reach_ns = self.scene, scene_period_ns(self.scene)
        posed: list[LidarSensor | CameraSensor] = [*scene.cameras, *scene.lidars]
        sources = {
            sensor.id: sensor_source(scene, sensor, self.ego, reach_ns=reach_ns)
            for sensor in posed
            if must_be_placed(sensor) or (isinstance(sensor, LidarSensor) and sensor.poses is not None)
        }
        written = replace(scene, sensors=tuple(_output_sensor(sensor, sources) for sensor in scene.sensors))
        return (written if self.ego is None else with_odometry(written, self.ego.path)[0]), sources

    def provenance(self) -> Mapping[str, Any]:
        """How the fused scene came about, for its metadata; the entry of an earlier fusion is kept below `earlier`.

        The cameras stand in the order that `camera_index` counts, since a profile may have no field for some of them.
        """
        world_from_file = _earlier_world(self.scene)
        world_from_file[:3, 3] += world_from_file[:3, :3] @ self.origin_world
        fusion = {
            "trajectory": self.trajectory,
            "heading": None if self.ego is None else self.ego.heading,
            # the name of a folder may hold bytes that are no Unicode
            "source": Path(self.scene.source).name.encode(errors="replace").decode(),
            "source_format": self.scene.format,
            "cameras": [camera.id for camera in self.scene.cameras],
            "earlier": ours_of(self.scene).get("fusion"),
        }
        return {"sceneloom": {"world_from_file": world_from_file.tolist(), "fusion": fusion}}


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
        return Aligned(part, choose_ego(scene, trajectory), np.zeros(3))  # none, and a named one is refused
    if is_computed(scene, trajectory):
        with stage("finding the trajectory"):
            ego = find_ego_motion(part, name=trajectory, heading=heading, lenient=lenient, progress=progress)
        part = with_trajectory_estimated(part, ego)
    else:
        # chosen from the whole drive: a heading comes from the trajectory before the part, too
        whole_trajectory = find_ego_motion(scene, name=trajectory, heading=heading)
        ego = whole_trajectory.within(chosen_interval(scene, start=start, stop=stop))
    # an adjustment acts on the world or leads from the ego to it, which its file does not state; what an unknown type
    # means is not known
    fixed = any(isinstance(sensor, PlainSensor) for sensor in scene.sensors) or any(
        isinstance(annotation, LocalizationAdjustment | PlainAnnotation) for annotation in scene.annotations
    )
    origin = np.zeros(3) if fixed else ego.path.positions[0].copy()
    return Aligned(moved_scene(part, origin), ego.moved(origin), origin)


def _check_order(scene: Scene) -> None:
    """Refuse times that run backwards: what is paired and what is cut off depends on their order."""
    for sensor in scene.sensors:
        if not isinstance(sensor, Posed):
            continue
        times = frame_times(sensor)
        backwards = np.flatnonzero(times[1:] < times[:-1])
        if len(backwards):
            kind = "images" if isinstance(sensor, CameraSensor) else "frames"
            k = int(backwards[0]) + 1
            location = f"sensors[{sensor.id}].{kind}[{k}].timestamp"
            problem = f"{times[k]} ns after {times[k - 1]} ns; expected {kind} in the order of their times"
            raise DataError(scene.source, location, problem)


def moved_scene(scene: Scene, origin_world: Float64Array) -> Scene:
    """Give a scene whose world has its origin at (3,) float64 [m] of the old one; frames are moved when read."""
    if not origin_world.any():
        return scene
    return moved_world(scene, FrameChange.constant(RigidTransform(np.eye(3), -origin_world)))


def _output_sensor(sensor: Sensor, sources: Mapping[Identifier, PoseSource]) -> Sensor:
    if isinstance(sensor, CameraSensor) and sensor.id in sources:
        path = camera_path(sources[sensor.id], sensor.images)
        return replace(sensor, poses=path, coordinates=Coordinates.WORLD)
    if isinstance(sensor, LidarSensor):
        empty: LazyFrames[LidarFrame] = LazyFrames.of([], [])
        return replace(sensor, frames=empty, poses=None, coordinates=Coordinates.WORLD, points_frame=PointsFrame.WORLD)
    return sensor


def _earlier_world(scene: Scene) -> Float64Array:
    """The (4, 4) transform that an earlier fusion took off, else the identity."""
    earlier = ours_of(scene).get("world_from_file")
    try:
        matrix = np.eye(4) if earlier is None else np.array(earlier, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        location = "metadata.sceneloom.world_from_file"
        raise DataError(scene.source, location, f"{earlier!r}; expected a 4x4 matrix of finite numbers")
    return matrix
