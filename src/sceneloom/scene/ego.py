"""The ego trajectory that positions a scene, and the poses of its sensors along it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np

from sceneloom.arrays import Float64Array, Int64Array
from sceneloom.errors import PoseError, SceneloomError
from sceneloom.geometry.rigid import (
    RigidTransform,
    matrix_from_quaternion,
    multiply_quaternions,
    normalise_quaternion,
    rotate_vectors,
    thin_poses,
)
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthFrame
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.motion import ImuSensor, OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Posed, Scene, frame_times
from sceneloom.scene.time_range import Interval, cut_path
from sceneloom.scene.types import Coordinates, Key, PointsFrame, key_of
from sceneloom.warnings import DataWarning

_FAR = 1e9  # no location on earth is known by such numbers


@dataclass(frozen=True, slots=True, eq=False)
class EgoMotion:
    """The chosen ego trajectory.

    Attributes:
        name: the trajectory's name, or "identity".
        path: `world_from_ego`.
        heading: "motion" where the orientation was derived from the motion, else None.
        covariances: (N, 6, 6) float64, one per pose of the path, as in `Trajectory`; None where not known.
        warnings: what was assumed or met on the way to it.
        enu_origin_lla: latitude, longitude [deg] and height above the WGS84 ellipsoid [m] of the location whose east,
            north and up are the world's axes, where these are known; `moved` leaves it where it is.
    """

    name: str
    path: Poses
    heading: str | None = None
    covariances: Float64Array | None = None
    warnings: tuple[DataWarning, ...] = field(default=())
    enu_origin_lla: tuple[float, float, float] | None = None

    @classmethod
    def of(cls, trajectory: Trajectory) -> "EgoMotion":
        """Follow a trajectory that has orientations.

        Raises:
            PoseError: it has none.
        """
        return cls(trajectory.name, trajectory.poses, covariances=trajectory.covariances)

    def moved(self, origin_world: Float64Array) -> "EgoMotion":
        """The same trajectory seen from another origin, (3,) float64 [m]; the axes stay."""
        return replace(self, path=self.path.moved(origin_world))

    def seen_from(self, world_from_here: RigidTransform) -> "EgoMotion":
        """The same trajectory in another world, whose axes may be rotated."""
        rotation = world_from_here.rotation
        path = Poses(
            self.path.timestamps_ns,
            world_from_here.apply(self.path.positions),
            multiply_quaternions(world_from_here.quaternion_xyzw, self.path.quaternions_xyzw),
            static=self.path.static,
        )
        if self.covariances is None:
            return replace(self, path=path, enu_origin_lla=None)
        axes = np.kron(np.eye(2), rotation)
        return replace(self, path=path, covariances=axes @ self.covariances @ axes.T, enu_origin_lla=None)

    def within(self, part: Interval | None) -> "EgoMotion":
        """The way in and around a part of the drive; None: all of it."""
        if part is None:
            return self
        path = cut_path(self.path, part)
        if self.covariances is None:
            return replace(self, path=path)
        kept = np.isin(self.path.timestamps_ns, path.timestamps_ns)
        return replace(self, path=path, covariances=self.covariances[kept])


class EgoAxes(NamedTuple):
    """How the ego's frame lies on the vehicle.

    Attributes:
        body_from_ego: (3, 3) float64, rows: the vehicle's forward, left and up in the ego's frame.
        known: whether something says so; else the axes are taken as x forward, y left, z up.
    """

    body_from_ego: Float64Array
    known: bool


_LEAST_PATH = 0.5  # a path shorter than this says nothing of the forward axis [m]
_STEADY = 0.8  # least length of a mean of unit vectors that are one direction
_NEAR_AXIS = np.cos(np.pi / 4)
_GRAVITY = (8.0, 11.5)  # mean specific force of an IMU that may be taken as gravity [m/s²]


def ego_axes(scene: Scene) -> EgoAxes:
    """Find the vehicle's forward and upward direction in the ego's frame.

    Up is against gravity as accelerometers measure it, else the world's z by the poses of the ego. Forward is
    `imuForward` of a recording, else where the ego moves. Formats other than recordings define the ego's x as forward:
    there the motion counts only where it is neither along x nor backwards.
    """
    free = scene.format == "recording"
    path = _posed_path(scene)
    up = _measured_up(scene)
    if up is None and path is not None:
        up = _steady(_unrotated(path.quaternions_xyzw, np.array([[0.0, 0.0, 1.0]])))
    known_up = up is not None
    if up is None or (not free and up[2] > _NEAR_AXIS):
        up = np.array([0.0, 0.0, 1.0])
    forward = _stated_forward(scene)
    if forward is None and path is not None:
        forward = _moved_forward(path)
        if forward is not None and not free and abs(forward[0]) > _NEAR_AXIS:
            forward = None
    known = forward is not None if free else True
    if forward is None:
        forward = np.array([1.0, 0.0, 0.0])
    forward = forward - up * (forward @ up)
    length = float(np.linalg.norm(forward))
    if length < 0.1:
        return EgoAxes(np.eye(3), known=False)
    forward = forward / length
    return EgoAxes(np.stack([forward, np.cross(up, forward), up]), known and (known_up or not free))


def _posed_path(scene: Scene) -> Poses | None:
    """The first trajectory with orientations, of its first 10,000 poses."""
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None and len(trajectory.timestamps_ns) > 1:
            try:
                rows = slice(0, 10_000)
                return Poses(
                    trajectory.timestamps_ns[rows], trajectory.positions[rows], trajectory.quaternions_xyzw[rows]
                )
            except SceneloomError:
                continue
    return None


def _measured_up(scene: Scene) -> Float64Array | None:
    """Against gravity, by the mean of the first accelerometer; the first 10,000 samples."""
    for sensor in scene.sensors:
        stream = sensor.streams.get("accelerometer") if isinstance(sensor, ImuSensor) else None
        if stream is None or stream.values.shape[1] != 3 or not len(stream):
            continue
        with np.errstate(over="ignore", invalid="ignore"):
            mean = np.nanmedian(stream.values[:10_000], axis=0)
            length = float(np.linalg.norm(mean))
        if _GRAVITY[0] <= length <= _GRAVITY[1]:
            return np.asarray(mean / length, np.float64)
    return None


def _stated_forward(scene: Scene) -> Float64Array | None:
    """`imuForward` of a recording's calibration."""
    reported: Any = scene.metadata.get("recording")
    for name in ("calibration", "imuForward"):
        reported = reported.get(name) if isinstance(reported, Mapping) else None
    if isinstance(reported, Mapping):
        reported = [reported.get(axis) for axis in "xyz"]
    if not isinstance(reported, list | tuple) or len(reported) != 3:
        return None
    if not all(isinstance(each, int | float) and np.isfinite(each) for each in reported):
        return None
    length = float(np.linalg.norm(np.array(reported, np.float64)))
    return np.array(reported, np.float64) / length if 0.0 < length < np.inf else None


def _moved_forward(path: Poses) -> Float64Array | None:
    """The direction in the ego's frame in which it moves; None where it hardly moves, or now this way and now that."""
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.diff(path.positions, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        total = float(lengths.sum())
        if not _LEAST_PATH <= total < 1e12:
            return None
        local = _unrotated(path.quaternions_xyzw[:-1], steps)
    return _steady(local / total * len(local))


def _unrotated(quaternions_xyzw: Float64Array, vectors: Float64Array) -> Float64Array:
    """Vectors of the parent frame, (N, 3) or (1, 3), in the frames of the body."""
    rotations = matrix_from_quaternion(normalise_quaternion(quaternions_xyzw))
    return np.asarray(np.einsum("nij,ni->nj", rotations, np.broadcast_to(vectors, (len(rotations), 3))), np.float64)


def _steady(vectors: Float64Array) -> Float64Array | None:
    """The mean direction of vectors whose mean length is 1; None where they point into several."""
    mean = np.asarray(vectors.mean(axis=0), np.float64)
    length = float(np.linalg.norm(mean))
    return mean / length if length >= _STEADY else None


def stated_origin(scene: Scene) -> tuple[float, float, float] | None:
    """The location whose east, north and up are the axes of the scene's world, as its metadata state it.

    Returns:
        latitude, longitude [deg] and height above the WGS84 ellipsoid [m]; None where nothing such is stated, or the
        world was moved since.
    """
    ours = scene.metadata.get("sceneloom")
    stated = ours.get("enu_origin") if isinstance(ours, Mapping) and "world_from_file" not in ours else None
    if not isinstance(stated, Mapping):
        return None
    numbers = [stated.get(name) for name in ("latitude", "longitude", "altitude")]
    if not all(isinstance(number, int | float) and abs(number) < _FAR for number in numbers):
        return None
    latitude, longitude, altitude = map(float, numbers)  # type: ignore[arg-type]
    return latitude, longitude, altitude


def frames_ns(scene: Scene) -> Int64Array:
    """The times (N,) int64 [ns], ascending, of all sweeps, radar cycles and images of a scene."""
    timestamps = [frame_times(sensor) for sensor in scene.sensors if isinstance(sensor, Posed)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *timestamps]))


_NOT_PLACED = (
    "it has neither poses nor a mounting on the ego; give it one (in calibration.json `imuToCamera` or `imuToLidar`) "
    "or leave the sensor out"
)
_NO_TRAJECTORY = (
    "it is mounted on the ego, whose trajectory is not known; find it from the sweeps with `--trajectory lidar` or "
    "leave the "
    "sensor out"
)


def needs_ego(scene: Scene) -> bool:
    """Whether the ego trajectory is needed: for a sensor without poses, or for points in ego coordinates."""
    rider_association = any(
        lidar.mount is not None and lidar.points_frame is not PointsFrame.WORLD for lidar in scene.lidars
    )
    fused: list[LidarSensor | CameraSensor] = [*scene.cameras, *scene.lidars]
    return rider_association or any(
        must_be_placed(sensor) and (sensor.poses is None or _rides_unnamed(scene, sensor)) for sensor in fused
    )


def _rides_unnamed(scene: Scene, sensor: LidarSensor | CameraSensor) -> bool:
    """Whether poses lead to the ego, and no odometry sensor of the scene says where that is."""
    odometries = [other.id for other in scene.sensors if isinstance(other, OdometrySensor)]
    return sensor.coordinates is Coordinates.EGO and sensor.parent_id not in odometries and len(odometries) != 1


def must_be_placed(sensor: LidarSensor | CameraSensor) -> bool:
    """Whether fusing takes the sensor's location: not of points in the world, nor of a camera without images."""
    if isinstance(sensor, CameraSensor):
        return len(sensor.images) > 0
    return sensor.points_frame is not PointsFrame.WORLD


def sensor_source(scene: Scene, sensor: Posed, ego: EgoMotion | None, *, reach_ns: int) -> PoseSource:
    """Give `world_from_sensor` over time, from the ego trajectory and the mounting, else from the sensor's own poses.

    Raises:
        PoseError: neither is known.
    """
    if ego is not None and sensor.mount is not None:
        return PoseSource(ego.path, sensor.mount, reach_ns)
    if sensor.poses is None:
        lacks = _NOT_PLACED if sensor.mount is None else _NO_TRAJECTORY
        raise PoseError(f"{scene.source}: it is not known where sensor {sensor.id!r} is: {lacks}")
    if sensor.coordinates is Coordinates.WORLD:
        return PoseSource(sensor.poses, RigidTransform.identity(), reach_ns, own=True)
    return _source_on_ego(scene, sensor, ego, reach_ns)


def points_source(
    scene: Scene, lidar: LidarSensor | RadarSensor, ego: EgoMotion | None, *, reach_ns: int
) -> PoseSource | None:
    """Give what takes a lidar's or radar's points as stored into the world; None where they are there already.

    Raises:
        PoseError: the poses that this needs are not known.
    """
    if lidar.points_frame is PointsFrame.WORLD:
        return None
    if lidar.points_frame is PointsFrame.SENSOR:
        return sensor_source(scene, lidar, ego, reach_ns=reach_ns)
    return PoseSource(ego_path(scene, lidar, ego), RigidTransform.identity(), reach_ns)


def lidar_position(scene: Scene, lidar: LidarSensor, ego: EgoMotion | None, *, reach_ns: int) -> PoseSource | None:
    """Give `world_from_lidar`, from where a lidar measured; None where that is not known.

    A mounting that is exactly the identity was not measured: it says that the points come in the ego's frame.
    """
    if lidar.mount is not None and np.array_equal(lidar.mount.matrix, np.eye(4)):
        return None
    try:
        return sensor_source(scene, lidar, ego, reach_ns=reach_ns)
    except PoseError:
        return None


def _source_on_ego(scene: Scene, sensor: Posed, ego: EgoMotion | None, reach_ns: int) -> PoseSource:
    """Compose poses relative to the ego with the ego trajectory, at the times of both."""
    path, relative = ego_path(scene, sensor, ego), sensor.poses
    if relative is None:
        raise PoseError(f"{scene.source}: sensor {sensor.id!r} has no poses")
    if len(relative.timestamps_ns) == 1:
        mount = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
        return PoseSource(path, mount, reach_ns)
    times = np.unique(np.concatenate([path.timestamps_ns, relative.timestamps_ns]))
    for body in (path, relative):
        if not body.static:
            times = times[(times >= body.start_ns) & (times <= body.stop_ns)]
    if len(times) == 0:
        raise PoseError(f"{scene.source}: the poses of sensor {sensor.id!r} and of the ego share no time")
    on_ego, world = relative.interpolate(times), path.interpolate(times)
    composed = Poses(
        times,
        rotate_vectors(world.quaternions_xyzw, on_ego.positions) + world.positions,
        multiply_quaternions(world.quaternions_xyzw, on_ego.quaternions_xyzw),
    )
    return PoseSource(composed, RigidTransform.identity(), reach_ns, own=True)


def ego_path(scene: Scene, sensor: Posed, ego: EgoMotion | None) -> Poses:
    """The ego that a sensor in ego coordinates refers to: parent odometry, chosen trajectory or only odometry.

    Raises:
        PoseError: there are several odometry sensors, and the parent is none of them; or there is neither any nor a
            chosen trajectory.

    Source: READING of "GPSSensor" in docs/CONVENTIONS.md.
    """
    named = named_odometry(scene, sensor)
    if named is not None and (ego is None or key_of(named.id) == _parent_key(sensor)):
        return named.poses
    if ego is None:
        raise PoseError(
            f"{scene.source}: sensor {sensor.id!r} is in ego coordinates, and no odometry sensor says where the ego "
            "was; add one, or choose what stands in for it with `--trajectory`: lidar (found from the sweeps), "
            "identity (stationary)"
        )
    return ego.path


def named_odometry(scene: Scene, sensor: Posed) -> OdometrySensor | None:
    """The odometry sensor that a sensor in ego coordinates refers to; None where the scene has none at all.

    Raises:
        PoseError: there are several, and the parent is none of them.
    """
    odometries = [other for other in scene.sensors if isinstance(other, OdometrySensor)]
    for odometry in odometries:
        if key_of(odometry.id) == _parent_key(sensor):
            return odometry
    if len(odometries) > 1:
        names = ", ".join(repr(odometry.id) for odometry in odometries)
        raise PoseError(
            f"{scene.source}: sensor {sensor.id!r} is in ego coordinates with parent_id {sensor.parent_id!r}, and "
            f"there are {len(odometries)} odometry sensors; expected one of {names} as its parent_id (or leave out "
            "all but one with `sceneloom edit crop --without ID`)"
        )
    return odometries[0] if odometries else None


def _parent_key(sensor: Posed) -> Key | None:
    return None if sensor.parent_id is None else key_of(sensor.parent_id)


def is_on_ego(sensor: object) -> bool:
    """Whether a sensor stands in ego coordinates, by its poses or by its points."""
    if isinstance(sensor, LidarSensor | RadarSensor) and sensor.points_frame is PointsFrame.EGO:
        return True
    return isinstance(sensor, Posed) and sensor.coordinates is Coordinates.EGO and sensor.poses is not None


def check_one_ego(scene: Scene, trajectory: Poses | None) -> None:
    """Refuse a scene whose sensors in ego coordinates refer to another ego trajectory than the one that is written.

    Args:
        scene: to be written in a format that knows one ego.
        trajectory: `world_from_ego` that is written, or None.

    Raises:
        PoseError: a sensor refers to another odometry sensor, or it is not known to which.
    """
    for sensor in scene.sensors:
        if not isinstance(sensor, Posed) or not is_on_ego(sensor):
            continue
        named = named_odometry(scene, sensor)
        if named is not None and trajectory is not None and not same_direction(named.poses, trajectory):
            raise PoseError(
                f"{scene.source}: sensor {sensor.id!r} is in the ego coordinates of odometry sensor {named.id!r}, and "
                "the target has one ego, which follows another trajectory; leave that odometry sensor out "
                "(`sceneloom edit crop --without ID`), or bring the drive into world coordinates (`sceneloom fuse`)"
            )


_BETWEEN = 4  # looks between two poses of the path: a mounted sensor moves on an arc there, not on a line
_FRAMES_AT_ONCE = 256
"""Poses between two frames depend on nothing beyond these, so long drives are looked at piece by piece."""


def sensor_path(source: PoseSource, frame_times_ns: Int64Array) -> Poses | None:
    """Give `world_from_sensor` at each frame's time, and wherever else interpolation would miss it.

    Between the first and the last frame the result stays within 1 mm and 0.01 degrees of the source.

    Args:
        frame_times_ns: (F,) int64 [ns]; times beyond the source's reach get no pose.

    Returns:
        The path, or None where no frame's time is within reach.
    """
    frames = np.unique(frame_times_ns)
    frames = frames[source.at(frames).coverage < 2]
    if len(frames) == 0:
        return None
    starts = range(0, len(frames) - 1, _FRAMES_AT_ONCE)
    between = [_times_between(source, frames[k : k + _FRAMES_AT_ONCE + 1]) for k in starts]
    times = np.unique(np.concatenate([frames, *between]))
    poses = source.at(times)
    return Poses(times, poses.positions, poses.quaternions_xyzw)


def camera_path(source: PoseSource, images: LazyFrames[CameraImage] | LazyFrames[DepthFrame]) -> Poses | None:
    """Give `world_from_camera` as `sensor_path` does, each image's pose by its own mounting where it has one.

    Raises:
        DataError: an image's record cannot be read.
    """
    if source.own:
        return sensor_path(source, images.timestamps_ns)
    mounts = [image.mount for image in images]
    timestamped = zip(images.timestamps_ns.tolist(), mounts, strict=True)
    paths = []
    for _, run in groupby(timestamped, key=lambda entry: b"" if entry[1] is None else entry[1].matrix.tobytes()):
        times, same = zip(*run, strict=True)
        path = sensor_path(source.mounted(same[0]), np.array(times, np.int64))
        if path is not None:
            paths.append(path)
    return _joined(paths) if paths else None


def _joined(paths: list[Poses]) -> Poses:
    """One path after the other; of poses at one time the first counts."""
    times, rows = np.unique(np.concatenate([path.timestamps_ns for path in paths]), return_index=True)
    return Poses(
        times,
        np.concatenate([path.positions for path in paths])[rows],
        np.concatenate([path.quaternions_xyzw for path in paths])[rows],
    )


def _times_between(source: PoseSource, frames_ns: Int64Array) -> Int64Array:
    """The times between some frames at which interpolation between the frames' poses would miss the sensor."""
    dense_ns = _dense_times(source.path.timestamps_ns, frames_ns)
    dense = source.at(dense_ns)
    return dense_ns[thin_poses(dense_ns, dense.positions, dense.quaternions_xyzw, frames_ns)]


def _dense_times(path_ns: Int64Array, frames_ns: Int64Array) -> Int64Array:
    """The frames' times, the path's own between them, and a few between each two of all these."""
    first, last = np.searchsorted(path_ns, frames_ns[[0, -1]])
    knots = np.union1d(path_ns[first:last], frames_ns)
    steps = np.diff(knots)
    between = [knots[:-1] + steps * part // _BETWEEN for part in range(1, _BETWEEN)]
    return np.unique(np.concatenate([knots, *between]))
