"""From a scene's sensors and the ego trajectory: where each sensor was when."""

import numpy as np

from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import multiply_quaternions, rotate_vectors
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses, same_direction
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, Key, PointsFrame, key_of

Posed = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor
"""Sensors that are somewhere."""

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
    """Whether the ego trajectory has to report where something was: a sensor without poses.

    Or points that ride on the ego.
    """
    rider_association = any(
        lidar.mount is not None and lidar.points_frame is not PointsFrame.WORLD for lidar in scene.lidars
    )
    return rider_association or any(
        must_be_placed(sensor) and (sensor.poses is None or _rides_unnamed(scene, sensor))
        for sensor in _fused(scene)
    )


def _rides_unnamed(scene: Scene, sensor: LidarSensor | CameraSensor) -> bool:
    """Whether poses lead to the ego, and no odometry sensor of the scene says where that is."""
    odometries = [other.id for other in scene.sensors if isinstance(other, OdometrySensor)]
    return (
        sensor.coordinates is Coordinates.EGO and sensor.parent_id not in odometries and len(odometries) != 1
    )


def must_be_placed(sensor: LidarSensor | CameraSensor) -> bool:
    """Whether fusing takes the sensor's location: not of points in the world, nor of a camera without images."""
    if isinstance(sensor, CameraSensor):
        return len(sensor.images) > 0
    return sensor.points_frame is not PointsFrame.WORLD


def _fused(scene: Scene) -> list[LidarSensor | CameraSensor]:
    return [*scene.cameras, *scene.lidars]


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


def lidar_position(
    scene: Scene, lidar: LidarSensor, ego: EgoMotion | None, *, reach_ns: int
) -> PoseSource | None:
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
    """The ego that a sensor in ego coordinates refers to: its parent odometry, the chosen trajectory.

    Or the only odometry.

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
