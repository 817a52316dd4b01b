"""From a scene's sensors and the ego's way: where each sensor was when."""

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
from sceneloom.scene.poses import PosePath
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates, PointsFrame

Posed = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor
"""Sensors that are somewhere."""

_NOT_PLACED = (
    "it has neither poses nor a mounting on the ego; give it one (in calibration.json `imuToCamera` or `imuToLidar`) "
    "or leave the sensor out"
)
_NO_WAY = (
    "it is mounted on the ego, whose way is not known; find it from the sweeps with `--trajectory lidar` or leave the "
    "sensor out"
)


def needs_ego(scene: Scene) -> bool:
    """Whether the ego's way has to tell where something was: a sensor without poses, or points that ride on the ego."""
    riding = any(
        lidar.mount is not None and lidar.points_frame is not PointsFrame.WORLD for lidar in scene.lidars
    )
    return riding or any(
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
    """Whether fusing takes the sensor's place: not of points in the world, nor of a camera without pictures."""
    if isinstance(sensor, CameraSensor):
        return len(sensor.pictures) > 0
    return sensor.points_frame is not PointsFrame.WORLD


def _fused(scene: Scene) -> list[LidarSensor | CameraSensor]:
    return [*scene.cameras, *scene.lidars]


def sensor_source(scene: Scene, sensor: Posed, ego: EgoMotion | None, *, reach_ns: int) -> PoseSource:
    """Give `world_from_sensor` over time, from the ego's way and the mounting, else from the sensor's own poses.

    Raises:
        PoseError: neither is known.
    """
    if ego is not None and sensor.mount is not None:
        return PoseSource(ego.path, sensor.mount, reach_ns)
    if sensor.poses is None:
        lacks = _NOT_PLACED if sensor.mount is None else _NO_WAY
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


def lidar_place(
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
    """Compose poses relative to the ego with the ego's way, at the times of both."""
    path, relative = ego_path(scene, sensor, ego), sensor.poses
    if relative is None:
        raise PoseError(f"{scene.source}: sensor {sensor.id!r} has no poses")
    if len(relative.timestamps_ns) == 1:
        mount = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
        return PoseSource(path, mount, reach_ns)
    times = np.unique(np.concatenate([path.timestamps_ns, relative.timestamps_ns]))
    for body in (path, relative):
        if not body.endless:
            times = times[(times >= body.start_ns) & (times <= body.stop_ns)]
    if len(times) == 0:
        raise PoseError(f"{scene.source}: the poses of sensor {sensor.id!r} and of the ego share no time")
    on_ego, world = relative.interpolate(times), path.interpolate(times)
    composed = PosePath(
        times,
        rotate_vectors(world.quaternions_xyzw, on_ego.positions) + world.positions,
        multiply_quaternions(world.quaternions_xyzw, on_ego.quaternions_xyzw),
    )
    return PoseSource(composed, RigidTransform.identity(), reach_ns, own=True)


def ego_path(scene: Scene, sensor: Posed, ego: EgoMotion | None) -> PosePath:
    """The ego that a sensor in ego coordinates refers to: its parent odometry, the chosen way, or the only odometry.

    Source: READING of "GPSSensor" in docs/CONVENTIONS.md.
    """
    odometries = [other for other in scene.sensors if isinstance(other, OdometrySensor)]
    parents = [odometry for odometry in odometries if odometry.id == sensor.parent_id]
    if parents:
        return parents[0].poses
    if ego is not None:
        return ego.path
    if len(odometries) != 1:
        raise PoseError(
            f"{scene.source}: sensor {sensor.id!r} is in ego coordinates and {len(odometries)} odometry sensors "
            "stand for the ego; name one as its parent_id"
        )
    return odometries[0].poses
