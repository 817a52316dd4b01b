"""Where the points of a lidar or radar are in the world, under each reading of the frame that they are given in."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from sceneloom.arrays import Float64Array
from sceneloom.checks.subject import Subject
from sceneloom.errors import SceneloomError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.clouds import LidarSensor, RadarSensor
from sceneloom.scene.ego import EgoMotion
from sceneloom.scene.pose_source import PoseSource
from sceneloom.scene.poses import Poses
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import points_source, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import PointsFrame

Ranging = LidarSensor | RadarSensor

_WORLD = PoseSource(Poses.identity(), RigidTransform.identity())


def _ego(scene: Scene) -> EgoMotion | None:
    trajectory = next(
        (trajectory for trajectory in scene.trajectories.values() if trajectory.quaternions_xyzw is not None),
        None,
    )
    return None if trajectory is None else EgoMotion.of(trajectory)


def sensor_position(subject: Subject, sensor: Ranging) -> PoseSource | None:
    """Give `world_from_sensor`; None where it is not known."""

    def made(inner: Subject) -> PoseSource | None:
        scene = inner.scene
        try:
            return sensor_source(scene, sensor, _ego(scene), reach_ns=scene_period_ns(scene))
        except SceneloomError:
            return None

    return subject.table(f"location of {type(sensor.id).__name__} {sensor.id}", made)


def point_positions(subject: Subject, sensor: Ranging) -> Mapping[PointsFrame, PoseSource]:
    """Give what takes the points as stored into the world, for each frame that they could be in."""

    def made(inner: Subject) -> Mapping[PointsFrame, PoseSource]:
        scene, locations = inner.scene, {PointsFrame.WORLD: _WORLD}
        own = sensor_position(inner, sensor)
        if own is not None:
            locations[PointsFrame.SENSOR] = own
        if isinstance(sensor, LidarSensor):
            rider_association = replace(sensor, points_frame=PointsFrame.EGO)
            with suppress(SceneloomError):
                on_ego = points_source(scene, rider_association, _ego(scene), reach_ns=scene_period_ns(scene))
                if on_ego is not None:
                    locations[PointsFrame.EGO] = on_ego
        return locations

    return subject.table(f"locations of points of {type(sensor.id).__name__} {sensor.id}", made)


def transform_at(source: PoseSource, timestamp_ns: int) -> RigidTransform | None:
    """Give a source's transform at one time; None beyond its reach, and where its poses are no finite numbers."""
    poses = source.at(np.array([timestamp_ns], np.int64))
    if poses.coverage[0] == 2 or not np.isfinite(poses.positions).all():
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])


def positions_at(source: PoseSource, sensor: Ranging) -> Float64Array:
    """Positions at the times of a sensor's frames, (F, 3) float64 [m]; NaN beyond the source's reach."""
    return source.at(sensor.frames.timestamps_ns).positions
