"""Aligns a scene with the fusion origin: every sensor in one world near its origin, axes kept.

And the provenance that a fused scene carries.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Float32Array, Float64Array, read_only
from sceneloom.editing.move_world import annotations_to_world, with_odometry
from sceneloom.errors import DataError, OptionError
from sceneloom.motion.ego_trajectory import find_ego_motion, is_computed, with_trajectory_estimated
from sceneloom.scene.annotations import (
    Activation,
    Annotation,
    CuboidAnnotation,
    LocalizationAdjustment,
    PlainAnnotation,
    PointPath,
    PointProjection,
    PointsAnnotation,
    Projection,
    ShapeAnnotation,
)
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, PointsSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, camera_path, must_be_placed, needs_ego, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import OdometrySensor, PlainSensor
from sceneloom.scene.poses import PoseSource, Trajectory
from sceneloom.scene.scene import Scene, Sensor, check_camera_models, frame_times
from sceneloom.scene.time_range import chosen_interval, cut_scene
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, Progress
from sceneloom.stages import stage

_WithCuboids = TypeVar("_WithCuboids", Activation, Projection)


def _annotation_can_move(annotation: Annotation) -> bool:
    """Whether all that an annotation says about locations can be seen from another origin.

    An adjustment acts on the world or leads from the ego to it, which its file does not state; what an unknown type
    says is not known.
    """
    return not isinstance(annotation, LocalizationAdjustment | PlainAnnotation)


def _moved_annotation(annotation: Annotation, origin_world: Float64Array) -> Annotation:
    """Give an annotation of a world whose origin is at (3,) float64 [m] of the old one."""
    move = _MOVES.get(type(annotation))
    return annotation if move is None else move(annotation, origin_world)


def _moved_cuboid(cuboid: CuboidAnnotation, origin_world: Float64Array) -> CuboidAnnotation:
    rows = _moved_rows(cuboid.path.values, origin_world)
    return replace(
        cuboid,
        path=replace(cuboid.path, values=rows),
        activations=tuple(_with_moved_cuboids(part, origin_world) for part in cuboid.activations),
        projections=tuple(_with_moved_cuboids(part, origin_world) for part in cuboid.projections),
    )


def _with_moved_cuboids(part: _WithCuboids, origin_world: Float64Array) -> _WithCuboids:
    if part.cuboids is None:
        return part
    return replace(part, cuboids=_moved_rows(part.cuboids, origin_world))


def _moved_rows(cuboids: Float64Array, origin_world: Float64Array) -> Float64Array:
    moved = cuboids.copy()
    moved[:, 3:6] -= origin_world
    return read_only(moved)


def _moved_shape(shape: ShapeAnnotation, origin_world: Float64Array) -> ShapeAnnotation:
    if shape.dimensions != 3:
        return shape
    vertices = tuple(read_only(locations - origin_world) for locations in shape.path.vertices)
    return replace(shape, path=replace(shape.path, vertices=vertices))


def _moved_points(points: PointsAnnotation, origin_world: Float64Array) -> PointsAnnotation:
    return replace(
        points,
        paths=tuple(_moved_path(path, origin_world) for path in points.paths),
        projections=tuple(
            tuple(_moved_projection(projection, origin_world) for projection in of_point)
            for of_point in points.projections
        ),
    )


def _moved_path(path: PointPath, origin_world: Float64Array) -> PointPath:
    shape = path.values.shape
    return replace(path, values=read_only((path.values.reshape(-1, 3) - origin_world).reshape(shape)))


def _moved_projection(projection: PointProjection, origin_world: Float64Array) -> PointProjection:
    if projection.positions is None:
        return projection
    return replace(projection, positions=read_only(projection.positions - origin_world))


_MOVES: Mapping[type, Callable[[Any, Float64Array], Annotation]] = MappingProxyType(
    {CuboidAnnotation: _moved_cuboid, ShapeAnnotation: _moved_shape, PointsAnnotation: _moved_points}
)
"""How the annotations that state locations in the world move; the others state none."""

_Posed = TypeVar("_Posed", LidarSensor, RadarSensor, CameraSensor, DepthCameraSensor)

_Cloud = TypeVar("_Cloud", LidarFrame, RadarFrame)


def _can_move(scene: Scene) -> bool:
    """Whether everything that has a location in the world can be seen from another origin."""
    return not any(isinstance(sensor, PlainSensor) for sensor in scene.sensors) and all(
        map(_annotation_can_move, scene.annotations)
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
        annotations=tuple(_moved_annotation(annotation, origin_world) for annotation in scene.annotations),
    )


def _moved_sensor(sensor: Sensor, origin_world: Float64Array) -> Sensor:
    move = next((move for kind, move in _ORIGIN_MOVES.items() if isinstance(sensor, kind)), None)
    return sensor if move is None else move(sensor, origin_world)


def _moved_poses(sensor: _Posed, origin_world: Float64Array) -> _Posed:
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
class _MovedFrames(Generic[_Cloud]):
    """Reads frames whose points are in the world, and moves them."""

    frames: LazyFrames[_Cloud]
    origin_world: Float64Array

    def __call__(self, index: int) -> _Cloud:
        frame = self.frames[index]
        positions = _origin_moved_points(frame.points.positions, self.origin_world)
        return replace(frame, points=replace(frame.points, positions=positions))


def _moved_frames(frames: LazyFrames[_Cloud], origin_world: Float64Array) -> LazyFrames[_Cloud]:
    return LazyFrames(frames.timestamps_ns, _MovedFrames(frames, origin_world))


def _origin_moved_points(positions: Float32Array, origin_world: Float64Array) -> Float32Array:
    return (positions.astype(np.float64) - origin_world).astype(np.float32)


def _moved_map(sensor: PointsSensor, origin_world: Float64Array) -> PointsSensor:
    return replace(sensor, positions=_origin_moved_points(sensor.positions, origin_world))


def _moved_odometry(sensor: OdometrySensor, origin_world: Float64Array) -> OdometrySensor:
    return replace(sensor, poses=sensor.poses.moved(origin_world))


def _moved_trajectory(trajectory: Trajectory, origin_world: Float64Array) -> Trajectory:
    return replace(trajectory, positions=trajectory.positions - origin_world)


_ORIGIN_MOVES: Mapping[type, Callable[[Any, Float64Array], Sensor]] = MappingProxyType(
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
    origin = ego.path.positions[0].copy() if _can_move(scene) else np.zeros(3)
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


def provenance(aligned: Aligned) -> Mapping[str, Any]:
    """How the fused scene came about, for its metadata; what an earlier fusion stated there is kept below `earlier`.

    The cameras stand in the order that `camera_index` counts, since a profile may have no field for some of them.
    """
    world_from_file = _earlier_world(aligned.scene)
    world_from_file[:3, 3] += world_from_file[:3, :3] @ aligned.origin_world
    fusion = {
        "trajectory": None if aligned.ego is None else aligned.ego.name,
        "heading": None if aligned.ego is None else aligned.ego.heading,
        # the name of a folder may hold bytes that are no Unicode
        "source": Path(aligned.scene.source).name.encode(errors="replace").decode(),
        "source_format": aligned.scene.format,
        "cameras": [camera.id for camera in aligned.scene.cameras],
        "earlier": _ours(aligned.scene).get("fusion"),
    }
    return {"sceneloom": {"world_from_file": world_from_file.tolist(), "fusion": fusion}}


def _ours(scene: Scene) -> Mapping[str, Any]:
    ours = scene.metadata.get("sceneloom")
    return ours if isinstance(ours, Mapping) else {}


def _earlier_world(scene: Scene) -> Float64Array:
    """The (4, 4) transform that an earlier fusion took off, else the identity."""
    earlier = _ours(scene).get("world_from_file")
    try:
        matrix = np.eye(4) if earlier is None else np.array(earlier, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        location = "metadata.sceneloom.world_from_file"
        raise DataError(scene.source, location, f"{earlier!r}; expected a 4x4 matrix of finite numbers")
    return matrix
