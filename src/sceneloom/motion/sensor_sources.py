"""From a scene's sensors and the ego's way: where each sensor was when."""

import numpy as np

from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.pose_source import PoseSource
from sceneloom.motion.trajectories import EgoMotion
from sceneloom.scene import (
    CameraSensor,
    Coordinates,
    LidarSensor,
    OdometrySensor,
    PointsFrame,
    PosePath,
    Scene,
)


def sensor_source(
    scene: Scene, sensor: LidarSensor | CameraSensor, ego: EgoMotion | None, *, reach_ns: int
) -> PoseSource:
    """Give `world_from_sensor` over time, from the ego's way and the mounting, else from the sensor's own poses.

    Raises:
        PoseError: neither is known.
    """
    if ego is not None and sensor.mount is not None:
        return PoseSource(ego.path, sensor.mount, reach_ns)
    if sensor.poses is None:
        raise PoseError(
            f"{scene.source}: sensor {sensor.id!r} has neither poses nor a mounting on a moving ego"
        )
    if sensor.coordinates is Coordinates.WORLD:
        return PoseSource(sensor.poses, RigidTransform.identity(), reach_ns)
    return _source_on_ego(scene, sensor, ego, reach_ns)


def points_source(
    scene: Scene, lidar: LidarSensor, ego: EgoMotion | None, *, reach_ns: int
) -> PoseSource | None:
    """Give what takes the lidar's points as stored into the world; None where they are there already.

    Raises:
        PoseError: the poses that this needs are not known.
    """
    if lidar.points_frame is PointsFrame.WORLD:
        return None
    if lidar.points_frame is PointsFrame.SENSOR:
        return sensor_source(scene, lidar, ego, reach_ns=reach_ns)
    return PoseSource(_ego_path(scene, lidar, ego), RigidTransform.identity(), reach_ns)


def _source_on_ego(
    scene: Scene, sensor: LidarSensor | CameraSensor, ego: EgoMotion | None, reach_ns: int
) -> PoseSource:
    """Compose poses relative to the ego with the ego's way, at the times of both."""
    path, relative = _ego_path(scene, sensor, ego), sensor.poses
    if relative is None:
        raise PoseError(f"{scene.source}: sensor {sensor.id!r} has no poses")
    if len(relative.timestamps_ns) == 1:
        mount = RigidTransform.from_quaternion(relative.positions[0], relative.quaternions_xyzw[0])
        return PoseSource(path, mount, reach_ns)
    start, stop = max(path.start_ns, relative.start_ns), min(path.stop_ns, relative.stop_ns)
    times = np.unique(np.concatenate([path.timestamps_ns, relative.timestamps_ns]))
    times = times[(times >= start) & (times <= stop)]
    if len(times) == 0:
        raise PoseError(f"{scene.source}: the poses of sensor {sensor.id!r} and of the ego share no time")
    on_ego = relative.interpolate(times)
    world = PoseSource(path, RigidTransform.identity()).at(times)
    transforms = [
        RigidTransform.from_quaternion(world.positions[k], world.quaternions_xyzw[k])
        @ RigidTransform.from_quaternion(on_ego.positions[k], on_ego.quaternions_xyzw[k])
        for k in range(len(times))
    ]
    composed = PosePath(
        times,
        np.array([transform.translation for transform in transforms]),
        np.array([transform.quaternion_xyzw for transform in transforms]),
    )
    return PoseSource(composed, RigidTransform.identity(), reach_ns)


def _ego_path(scene: Scene, sensor: LidarSensor | CameraSensor, ego: EgoMotion | None) -> PosePath:
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
