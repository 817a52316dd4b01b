"""Which sensors a sample holds, which frame of each is nearest in time, and the pose of each at its own time."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import OptionError, PoseError
from sceneloom.geometry.interpolation import EXTRAPOLATED, OUT_OF_REACH
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, ShootingSensor
from sceneloom.scene.clouds import LidarFrame, LidarSensor, RadarFrame, RadarSensor
from sceneloom.scene.ego import EgoMotion, Posed, needs_ego, points_source, sensor_source
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.point_times import timed_frame
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene, scene_period_ns, sweep_period_ns, usual_period_ns
from sceneloom.scene.types import Coordinates, Identifier, PointsFrame, key_of

ALL = "all"

Choice = Identifier | Iterable[Identifier]
"""Sensors of one kind: "all", one id, or several."""

_Kind = TypeVar("_Kind", LidarSensor, CameraSensor, RadarSensor, DepthCameraSensor)


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What was asked for.

    Attributes:
        scene: the scene.
        reference: the sensor whose frames are counted.
        lidars: whose sweeps are looked for, the one of `Sample.sweep` first.
        cameras, depth_cameras, radars: whose images, depth images and frames are looked for.
        trajectory: name of the ego trajectory, the trajectory itself, or None for the default.
        tolerance_ns: how far from the moment a frame may be [ns].
    """

    scene: Scene
    reference: LidarSensor | CameraSensor
    lidars: tuple[LidarSensor, ...]
    cameras: tuple[CameraSensor, ...]
    depth_cameras: tuple[DepthCameraSensor, ...]
    radars: tuple[RadarSensor, ...]
    trajectory: str | EgoMotion | None
    tolerance_ns: int

    @property
    def shooting(self) -> tuple[ShootingSensor, ...]:
        """The cameras of colours, then those of depths."""
        return self.cameras + self.depth_cameras


def select(
    scene: Scene,
    *,
    reference: Identifier,
    lidars: Choice | None,
    cameras: Choice,
    depth_cameras: Choice,
    radars: Choice,
    trajectory: str | EgoMotion | None,
    tolerance_ns: int | None,
) -> Selection:
    """Find the sensors that were asked for.

    Raises:
        OptionError: the scene has no such sensor, or the tolerance is negative.
    """
    counted = _reference(scene, reference)
    if tolerance_ns is not None and tolerance_ns < 0:
        raise OptionError(f"tolerance {tolerance_ns} ns; expected 0 or more")
    if lidars is None:
        lidars = () if isinstance(counted, LidarSensor) else [lidar.id for lidar in scene.lidars[:1]]
    chosen_lidars = chosen_sensors(scene, "lidar", scene.lidars, lidars)
    chosen_cameras = chosen_sensors(scene, "camera", scene.cameras, cameras)
    if isinstance(counted, LidarSensor):
        chosen_lidars = (counted, *(lidar for lidar in chosen_lidars if lidar is not counted))
    elif not any(camera is counted for camera in chosen_cameras):
        chosen_cameras = (counted, *chosen_cameras)
    depths_there = tuple(sensor for sensor in scene.sensors if isinstance(sensor, DepthCameraSensor))
    radars_there = tuple(sensor for sensor in scene.sensors if isinstance(sensor, RadarSensor))
    return Selection(
        scene,
        counted,
        chosen_lidars,
        chosen_cameras,
        chosen_sensors(scene, "depth camera", depths_there, depth_cameras),
        chosen_sensors(scene, "radar", radars_there, radars),
        trajectory,
        _period_ns(counted, chosen_lidars) if tolerance_ns is None else tolerance_ns,
    )


def _reference(scene: Scene, wanted: Identifier) -> LidarSensor | CameraSensor:
    """The lidar or camera of that id, else the first one of that kind."""
    sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    for sensor in sensors:
        if _is(sensor, wanted):
            return sensor
    for sensor in sensors:
        if sensor.type == wanted:
            return sensor
    there = _listed(sensors)
    raise OptionError(f"{scene.source}: reference {wanted!r}; expected one of its lidars and cameras: {there}")


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
        found = [sensor for sensor in there if _is(sensor, wanted_id)]
        if not found:
            known = ", ".join([repr(ALL), _listed(there)])
            raise OptionError(f"{scene.source}: no {kind} {wanted_id!r}; expected some of: {known}")
        chosen[id(found[0])] = found[0]
    return tuple(chosen.values())


def _is(sensor: Posed, wanted: Identifier) -> bool:
    return key_of(sensor.id) == key_of(wanted)


def _listed(sensors: Iterable[Posed]) -> str:
    return ", ".join(repr(sensor.id) for sensor in sensors) or "none, it has no such sensor"


def _period_ns(reference: LidarSensor | CameraSensor, lidars: tuple[LidarSensor, ...]) -> int:
    """One sweep period, or the time from image to image where there is no lidar."""
    if lidars:
        return sweep_period_ns(lidars[0])
    times = reference.images.timestamps_ns if isinstance(reference, CameraSensor) else np.zeros(0, np.int64)
    return usual_period_ns(times)


_Timestamped = TypeVar("_Timestamped", CameraImage, DepthFrame, RadarFrame)
_NONE = "it has no frames"


class FramesByTimestamp(Generic[_Timestamped]):
    """Frames that are found by their timestamps; these need not be in order."""

    def __init__(self, frames: LazyFrames[_Timestamped]) -> None:
        """Take the frames; nothing is read."""
        self.frames: LazyFrames[_Timestamped] = frames
        self._timestamps_ns: Int64Array = frames.timestamps_ns
        self._rows: Sequence[int] = range(len(frames))
        if (self._timestamps_ns[1:] < self._timestamps_ns[:-1]).any():
            order = np.argsort(self._timestamps_ns, kind="stable")
            self._timestamps_ns, self._rows = self._timestamps_ns[order], order.tolist()

    def read(self, index: int) -> tuple[_Timestamped, int]:
        """Read a frame, and give its time [ns]."""
        frame = self.frames[index]
        return frame, frame.timestamp_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[_Timestamped, int] | str:
        """Read the frame nearest in time, the earlier one of two; or state why there is none.

        Raises:
            DataError: it cannot be read.
        """
        row = self._nearest(time_ns)
        if row is None:
            return _NONE
        away_ns = abs(int(self._timestamps_ns[row]) - time_ns)
        return self.read(self._rows[row]) if away_ns <= tolerance_ns else _too_far(away_ns, tolerance_ns)

    def _nearest(self, time_ns: int) -> int | None:
        timestamps = self._timestamps_ns
        if len(timestamps) == 0:
            return None
        after = int(np.searchsorted(timestamps, time_ns))
        if after == 0:
            return 0
        before_ns = int(timestamps[after - 1])
        if after < len(timestamps) and int(timestamps[after]) - time_ns < time_ns - before_ns:
            return after
        # of frames with the same timestamp the first one counts
        return int(np.searchsorted(timestamps, before_ns))


class SweepsByReference:
    """Sweeps of a lidar that are found by their reference times, which only the sweeps themselves report.

    What was learnt of a sweep's time is kept, a number for each; the sweeps are not.
    """

    def __init__(self, frames: LazyFrames[LidarFrame], period_ns: int) -> None:
        """Take the sweeps, in the order of their timestamps, and the usual time from one to the next.

        Nothing is read.
        """
        self.frames = frames
        self._period_ns = period_ns
        self._known: dict[int, int] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_known": {}}

    def read(self, index: int) -> tuple[LidarFrame, int]:
        """Read a sweep, its point times brought onto the scene's clock, and report its reference time [ns].

        Raises:
            DataError: the sweep cannot be read.
        """
        frame = timed_frame(self.frames[index], self._period_ns).frame
        self._known[index] = frame.reference_ns
        return frame, frame.reference_ns

    def find(self, time_ns: int, tolerance_ns: int) -> tuple[LidarFrame, int] | str:
        """Read the sweep whose reference time is nearest, the earlier one of two; or state why there is none.

        Sweeps around that time whose reference times are not known yet are read for them. A reference time is taken to
        be no earlier than its sweep's timestamp, and reference times to be in the order of the timestamps.

        Raises:
            DataError: a sweep cannot be read.
        """
        if len(self.frames) == 0:
            return _NONE
        held: dict[int, LidarFrame] = {}
        index = max(int(np.searchsorted(self.frames.timestamps_ns, time_ns, side="right")) - 1, 0)
        while index > 0 and self._reference_ns(index, held) > time_ns:
            index -= 1
        while self._next_is_nearer(index, time_ns, held):
            index += 1
        reference_ns = self._reference_ns(index, held)
        away_ns = abs(reference_ns - time_ns)
        if away_ns > tolerance_ns:
            return _too_far(away_ns, tolerance_ns)
        return (held[index], reference_ns) if index in held else self.read(index)

    def _next_is_nearer(self, index: int, time_ns: int, held: dict[int, LidarFrame]) -> bool:
        timestamps = self.frames.timestamps_ns
        away_ns = abs(time_ns - self._reference_ns(index, held))
        if index + 1 == len(timestamps) or int(timestamps[index + 1]) - time_ns >= away_ns:
            return False
        return abs(time_ns - self._reference_ns(index + 1, held)) < away_ns

    def _reference_ns(self, index: int, held: dict[int, LidarFrame]) -> int:
        if index not in self._known:
            held[index], self._known[index] = self.read(index)
        return self._known[index]


def _too_far(away_ns: int, tolerance_ns: int) -> str:
    """Report that the nearest frame is not near enough."""
    return f"its nearest frame is {away_ns / 1e9:.3f} s away; expected at most {tolerance_ns / 1e9:.3f} s"


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
    if trajectory == _IDENTITY:
        return EgoMotion(_IDENTITY, Poses.identity())
    choices = ", ".join([*scene.trajectories, _IDENTITY])
    raise OptionError(
        f"{scene.source}: no trajectory {trajectory!r}; there are: {choices}; "
        "one that `sceneloom.motion.ego_trajectory.find_ego_motion` finds can be handed in"
    )


def locations_of(scene: Scene, sensors: Iterable[Posed], ego: EgoMotion | None) -> Mapping[Identifier, Location]:
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
