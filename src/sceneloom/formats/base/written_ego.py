"""The ego trajectory that formats with one trajectory write."""

from dataclasses import replace

from sceneloom.arrays import Int64Array
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import OdometrySensor
from sceneloom.scene.poses import Poses, PoseSource
from sceneloom.scene.scene import Scene
from sceneloom.scene.types import Coordinates


def ego_trajectory(scene: Scene) -> Poses | None:
    """The ego trajectory: the first trajectory with orientations, else by odometry, else by a sensor's own poses."""
    for trajectory in scene.trajectories.values():
        if trajectory.quaternions_xyzw is not None:
            return trajectory.poses
    for sensor in scene.sensors:
        if isinstance(sensor, OdometrySensor):
            return sensor.poses
    posed_sensors: list[LidarSensor | CameraSensor] = [*scene.lidars, *scene.cameras]
    for posed in posed_sensors:
        if posed.poses is None or posed.coordinates is not Coordinates.WORLD:
            continue
        if posed.mount is None:
            return posed.poses
        egos = PoseSource(posed.poses, posed.mount.inverse()).at(posed.poses.timestamps_ns)
        return replace(posed.poses, positions=egos.positions, quaternions_xyzw=egos.quaternions_xyzw)
    return None


def egos_at(path: Poses | None, timestamps_ns: Int64Array) -> list[RigidTransform]:
    """`world_from_ego` at each time: end poses hold beyond the trajectory; without one the ego is stationary."""
    if path is None:
        return [RigidTransform.identity()] * len(timestamps_ns)
    held = path.held(timestamps_ns)
    return [*map(RigidTransform.from_quaternion, held.positions, held.quaternions_xyzw)]
