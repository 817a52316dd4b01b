"""How the points and poses of one sensor get into another frame."""

from dataclasses import replace

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.editing.frame_change import KNOWN, FrameChange
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.sensor_paths import camera_path, sensor_path
from sceneloom.scene.cameras import CameraSensor
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.depth import DepthCameraSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import ego_path, points_source, sensor_source
from sceneloom.scene.shooting import shots_of
from sceneloom.scene.span import frame_times
from sceneloom.scene.types import Coordinates, PointsFrame

PointsOf = LidarSensor | RadarSensor
Posed = LidarSensor | RadarSensor | CameraSensor | DepthCameraSensor


def points_change(
    scene: Scene, sensor: PointsOf, ego: EgoMotion | None, frame: PointsFrame, *, reach_ns: int
) -> FrameChange | None:
    """Give what takes a sensor's points into a frame; None where they are in it already.

    Raises:
        PoseError: the poses that this needs are not known.
    """
    if sensor.points_frame is frame:
        return None
    on_ego = _on_ego(sensor, reach_ns)
    if on_ego is not None and PointsFrame.WORLD not in {frame, sensor.points_frame}:
        change = FrameChange(on_ego)
        return change if frame is PointsFrame.EGO else change.inverse()
    return FrameChange(
        points_source(scene, sensor, ego, reach_ns=reach_ns),
        points_source(scene, _with_points_frame(sensor, frame), ego, reach_ns=reach_ns),
    )


def _with_points_frame(sensor: PointsOf, frame: PointsFrame) -> PointsOf:
    if isinstance(sensor, LidarSensor):
        return replace(sensor, points_frame=frame)
    return replace(sensor, points_frame=frame)


def _on_ego(sensor: PointsOf, reach_ns: int) -> PoseSource | None:
    """`ego_from_sensor`, where the sensor itself reports it."""
    if sensor.mount is not None:
        return PoseSource(Poses.identity(), sensor.mount)
    if sensor.coordinates is Coordinates.EGO and sensor.poses is not None:
        poses = sensor.poses
        if len(poses.timestamps_ns) == 1:
            poses = replace(poses, static=True)
        return PoseSource(poses, RigidTransform.identity(), reach_ns)
    return None


def poses_in_world(
    scene: Scene, sensor: Posed, ego: EgoMotion | None, *, reach_ns: int, anew: bool = False
) -> Poses | None:
    """Give where a sensor was in the world, at the times of its own poses, else as its frames need it.

    Args:
        scene: the sensor's.
        sensor: which one.
        ego: the ego trajectory, if it is needed.
        reach_ns: how far beyond a path's ends its velocity is continued.
        anew: take the ego trajectory even where the sensor reports its location in the world.

    Returns:
        The path; None where it is not known.

    Raises:
        PoseError: the sensor's location on the ego is known, and that of the ego is not.
    """
    own = sensor.poses
    if (
        own is not None
        and sensor.coordinates is Coordinates.WORLD
        and not (anew and sensor.mount is not None)
    ):
        return own
    if own is not None and len(own.timestamps_ns) > 1 and sensor.coordinates is Coordinates.EGO:
        # at its own times, not by a path composed of both: that would end where the shorter of them ends
        trajectory = PoseSource(ego_path(scene, sensor, ego), RigidTransform.identity(), reach_ns)
        return FrameChange(trajectory).path(own)
    try:
        source = sensor_source(scene, sensor, ego, reach_ns=reach_ns)
    except PoseError:
        if own is None:
            return None
        raise
    return _as_needed(source, sensor)


def _as_needed(source: PoseSource, sensor: Posed) -> Poses | None:
    """The poses at the times of a sensor's own, else as its frames need them, else as many as the trajectory has."""
    own, times_ns = sensor.poses, frame_times(sensor)
    if own is not None and len(own.timestamps_ns) > 1:
        return path_at(source, own.timestamps_ns)
    if len(times_ns) == 0:
        return path_at(source, source.path.timestamps_ns)
    if isinstance(sensor, CameraSensor | DepthCameraSensor):
        return camera_path(source, shots_of(sensor))
    return sensor_path(source, times_ns)


def poses_on_ego(sensor: Posed, ego: EgoMotion, *, reach_ns: int) -> Poses | None:
    """Give where a sensor was on the ego, at the times of its own poses; None where it has none there."""
    if sensor.poses is None or sensor.coordinates is Coordinates.EGO:
        return sensor.poses
    ego_from_world = FrameChange(None, PoseSource(ego.path, RigidTransform.identity(), reach_ns))
    times_ns = np.unique(frame_times(sensor)) if sensor.poses.static else None
    if times_ns is not None and len(times_ns) == 0:
        times_ns = ego.path.timestamps_ns
    return ego_from_world.path(sensor.poses, times_ns=times_ns)


def path_at(source: PoseSource, times_ns: Int64Array) -> Poses | None:
    """Give the poses at those of the times that the source reaches; None where it reaches none."""
    poses = source.at(times_ns)
    known = poses.coverage <= KNOWN
    if not known.any():
        return None
    return Poses(times_ns[known], poses.positions[known], poses.quaternions_xyzw[known])
