"""Where the sensors of a sample were: the poses of several sensors, each at a time of its own."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.interpolation import EXTRAPOLATED, OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import Posed, needs_ego, points_source, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame

IDENTITY = "identity"
"""The trajectory of an ego that is stationary."""

WORLD = PoseSource(Poses.identity(), RigidTransform.identity())
"""Where points are that are in the world already."""


@dataclass(frozen=True, slots=True, eq=False)
class Location:
    """Where something is, as far as it is known.

    Attributes:
        source: its pose in the world over time, or None.
        problem: why there is none.
        mount: `ego_from_sensor` where it is rigid and known, or None.
    """

    source: PoseSource | None
    problem: str = ""
    mount: RigidTransform | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A pose at a time, as far as it is known.

    Attributes:
        world_from_sensor: the pose, or None.
        problem: why there is none.
        extrapolated: whether the time lies beyond the trajectory's ends.
    """

    world_from_sensor: RigidTransform | None
    problem: str = ""
    extrapolated: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class SamplePoses:
    """Where the sensors of a sample were.

    Attributes:
        world_from_sensor: the pose of each sensor at the time of its frame, by id; None where it is not known.
        ego_from_sensor: its rigid mounting on the ego, by id; None where there is none.
        world_from_points: takes the positions of the sweep, as they are stored, into the world; None where not known.
        ego_from_points: takes them into the ego's frame at the time of the sweep; None where they are in the world.
        unposed: why a pose in the world is not known, by id.
        extrapolated: sensors whose pose continues the trajectory beyond its ends.
    """

    world_from_sensor: Mapping[Identifier, RigidTransform | None]
    ego_from_sensor: Mapping[Identifier, RigidTransform | None]
    world_from_points: RigidTransform | None
    ego_from_points: RigidTransform | None
    unposed: Mapping[Identifier, str]
    extrapolated: tuple[Identifier, ...]

    def into(self, sensor_id: Identifier, body_id: Identifier | None) -> RigidTransform | None:
        """Give `sensor_from_body`, each at its own time; `body_id` None: of the points of the sweep as stored.

        Where a pose in the world is not known it comes from the mountings alone.
        """
        world_from_body, ego_from_body = self.world_from_points, self.ego_from_points
        if body_id is not None:
            world_from_body, ego_from_body = self.world_from_sensor[body_id], self.ego_from_sensor[body_id]
        world_from_sensor, ego_from_sensor = (
            self.world_from_sensor[sensor_id],
            self.ego_from_sensor[sensor_id],
        )
        if world_from_sensor is not None and world_from_body is not None:
            return world_from_sensor.inverse() @ world_from_body
        if ego_from_sensor is not None and ego_from_body is not None:
            return ego_from_sensor.inverse() @ ego_from_body
        return None


def choose_ego(scene: Scene, trajectory: str | EgoMotion | None) -> EgoMotion | None:
    """Take the ego trajectory by name, or the scene's default one; None where poses need none, or there is none.

    Raises:
        OptionError: there is none of that name, or everything is placed in the world already.
        PoseError: the named one has no orientations.
    """
    if not needs_ego(scene):
        if trajectory is not None:
            raise OptionError(
                f"{scene.source}: its points and sensors are placed in the world already; a trajectory cannot be chosen"
            )
        return None
    if isinstance(trajectory, EgoMotion):
        return trajectory
    if trajectory is None:
        default = next(iter(scene.trajectories.values()), None)
        return None if default is None or default.quaternions_xyzw is None else EgoMotion.of(default)
    if trajectory in scene.trajectories:
        return EgoMotion.of(scene.trajectories[trajectory])
    if trajectory == IDENTITY:
        return EgoMotion(IDENTITY, Poses.identity())
    choices = ", ".join([*scene.trajectories, IDENTITY])
    raise OptionError(
        f"{scene.source}: no trajectory {trajectory!r}; there are: {choices}; "
        "one that `sceneloom.motion.ego_motion.find_ego_motion` finds can be handed in"
    )


def locations_of(
    scene: Scene, sensors: Iterable[Posed], ego: EgoMotion | None
) -> Mapping[Identifier, Location]:
    """Give the locations of sensors by id; a sensor of which nothing is known has a location that says why."""
    return {sensor.id: _location(scene, sensor, ego) for sensor in sensors}


def frame_of_points(scene: Scene, lidar: LidarSensor | RadarSensor, ego: EgoMotion | None) -> Location:
    """Give what takes a lidar's or radar's points as stored into the world, and into the ego's frame where rigid."""
    mounts = {PointsFrame.SENSOR: _static_mount(lidar), PointsFrame.EGO: RigidTransform.identity()}
    mount = mounts.get(lidar.points_frame)
    try:
        source = points_source(scene, lidar, ego, reach_ns=scene_period_ns(scene))
    except PoseError as error:
        return Location(None, str(error), mount)
    return Location(source or WORLD, "", mount)


def poses_at(locations: Sequence[tuple[Location, int]]) -> list[Pose]:
    """Give the pose of each location at its time [ns]; locations on one path are interpolated in one go."""
    poses = [Pose(None, location.problem) for location, _ in locations]
    by_path: dict[int, list[int]] = {}
    for row, (location, _) in enumerate(locations):
        if location.source is not None:
            by_path.setdefault(id(location.source.path), []).append(row)
    for rows in by_path.values():
        sources = [source for row in rows if (source := locations[row][0].source) is not None]
        times = np.array([locations[row][1] for row in rows], np.int64)
        body = sources[0].path.interpolate(times, reach_ns=sources[0].reach_ns)
        rotations = matrix_from_quaternion(np.nan_to_num(body.quaternions_xyzw, nan=0.5))
        for k, (row, source) in enumerate(zip(rows, sources, strict=True)):
            if body.coverage[k] == OUT_OF_REACH:
                poses[row] = Pose(None, _beyond(source.path, int(times[k])))
                continue
            moved = RigidTransform(
                rotations[k] @ source.mount.rotation,
                rotations[k] @ source.mount.translation + body.positions[k],
            )
            poses[row] = Pose(moved, extrapolated=bool(body.coverage[k] == EXTRAPOLATED))
    return poses


def _location(scene: Scene, sensor: Posed, ego: EgoMotion | None) -> Location:
    mount = _static_mount(sensor)
    try:
        return Location(sensor_source(scene, sensor, ego, reach_ns=scene_period_ns(scene)), "", mount)
    except PoseError as error:
        if mount is None:
            return Location(None, str(error), mount)
    problem = f"{scene.source}: no trajectory with orientations, so that it is not known where the ego was"
    return Location(None, problem, mount)


def _static_mount(sensor: Posed) -> RigidTransform | None:
    """The mounting on the ego, stated as such or as the one pose of a sensor in ego coordinates."""
    if sensor.mount is not None:
        return sensor.mount
    if sensor.poses is None or sensor.coordinates is not Coordinates.EGO or len(sensor.poses.positions) != 1:
        return None
    return RigidTransform.from_quaternion(sensor.poses.positions[0], sensor.poses.quaternions_xyzw[0])


def _beyond(path: Poses, time_ns: int) -> str:
    away_ns = max(path.start_ns - time_ns, time_ns - path.stop_ns)
    return f"{away_ns / 1e9:.3f} s beyond the ends of the trajectory"
