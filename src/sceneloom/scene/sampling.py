"""Choice of sensors and of the ego trajectory, and where sensors and their points are, as far as it is known."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.interpolation import EXTRAPOLATED, OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.cameras import CameraSensor, DepthCameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion, Posed, needs_ego, points_source, sensor_source
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, key_of

ALL = "all"

Choice = Identifier | Iterable[Identifier]
"""Sensors of one kind: "all", one id, or several."""

_Kind = TypeVar("_Kind", LidarSensor, CameraSensor, RadarSensor, DepthCameraSensor)


def chosen_sensors(scene: Scene, kind: str, there: tuple[_Kind, ...], wanted: Choice) -> tuple[_Kind, ...]:
    """Find the sensors of one kind that are wanted, in that order.

    Raises:
        OptionError: the scene has no such sensor.
    """
    if isinstance(wanted, str) and wanted == ALL:
        return there
    ids = [wanted] if isinstance(wanted, str | int) else list(wanted)
    chosen: dict[int, _Kind] = {}
    for wanted_id in ids:
        found = [sensor for sensor in there if key_of(sensor.id) == key_of(wanted_id)]
        if not found:
            known = ", ".join([repr(ALL), _listed(there)])
            raise OptionError(f"{scene.source}: no {kind} {wanted_id!r}; expected some of: {known}")
        chosen[id(found[0])] = found[0]
    return tuple(chosen.values())


def _listed(sensors: Iterable[Posed]) -> str:
    return ", ".join(repr(sensor.id) for sensor in sensors) or "none, it has no such sensor"


_IDENTITY = "identity"
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
    if trajectory == _IDENTITY:
        return EgoMotion(_IDENTITY, Poses.identity())
    choices = ", ".join([*scene.trajectories, _IDENTITY])
    raise OptionError(
        f"{scene.source}: no trajectory {trajectory!r}; there are: {choices}; "
        "one that `sceneloom.motion.ego_trajectory.find_ego_motion` finds can be handed in"
    )


def locations_of(scene: Scene, sensors: Iterable[Posed], ego: EgoMotion | None) -> dict[Identifier, Location]:
    """Give the locations of sensors by id; a sensor of which nothing is known has a location that says why."""
    found, period_ns = {}, scene_period_ns(scene)
    for sensor in sensors:
        mount, source = _static_mount(sensor), None
        problem = f"{scene.source}: no trajectory with orientations, so that it is not known where the ego was"
        try:
            source, problem = sensor_source(scene, sensor, ego, reach_ns=period_ns), ""
        except PoseError as error:
            problem = problem if mount is not None else str(error)
        found[sensor.id] = Location(source, problem, mount)
    return found


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
                away_ns = max(source.path.start_ns - int(times[k]), int(times[k]) - source.path.stop_ns)
                poses[row] = Pose(None, f"{away_ns / 1e9:.3f} s beyond the ends of the trajectory")
                continue
            moved = RigidTransform(
                rotations[k] @ source.mount.rotation,
                rotations[k] @ source.mount.translation + body.positions[k],
            )
            poses[row] = Pose(moved, extrapolated=bool(body.coverage[k] == EXTRAPOLATED))
    return poses


def _static_mount(sensor: Posed) -> RigidTransform | None:
    """The mounting on the ego, stated as such or as the one pose of a sensor in ego coordinates."""
    if sensor.mount is not None:
        return sensor.mount
    if sensor.poses is None or sensor.coordinates is not Coordinates.EGO or len(sensor.poses.positions) != 1:
        return None
    return RigidTransform.from_quaternion(sensor.poses.positions[0], sensor.poses.quaternions_xyzw[0])
