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
from sceneloom.scene.poses import PosePath
from sceneloom.scene.scene import Scene
from sceneloom.scene.sensor_sources import points_source, sensor_source
from sceneloom.scene.span import scene_period_ns
from sceneloom.scene.types import PointsFrame

Ranging = LidarSensor | RadarSensor

_WORLD = PoseSource(PosePath.identity(), RigidTransform.identity())


def _ego(scene: Scene) -> EgoMotion | None:
    way = next((way for way in scene.trajectories.values() if way.quaternions_xyzw is not None), None)
    return None if way is None else EgoMotion.of(way)


def sensor_place(subject: Subject, sensor: Ranging) -> PoseSource | None:
    """Give `world_from_sensor`; None where it is not known."""

    def made(inner: Subject) -> PoseSource | None:
        scene = inner.scene
        try:
            return sensor_source(scene, sensor, _ego(scene), reach_ns=scene_period_ns(scene))
        except SceneloomError:
            return None

    return subject.table(f"place of {type(sensor.id).__name__} {sensor.id}", made)


def point_places(subject: Subject, sensor: Ranging) -> Mapping[PointsFrame, PoseSource]:
    """Give what takes the points as stored into the world, for each frame that they could be in."""

    def made(inner: Subject) -> Mapping[PointsFrame, PoseSource]:
        scene, places = inner.scene, {PointsFrame.WORLD: _WORLD}
        own = sensor_place(inner, sensor)
        if own is not None:
            places[PointsFrame.SENSOR] = own
        if isinstance(sensor, LidarSensor):
            riding = replace(sensor, points_frame=PointsFrame.EGO)
            with suppress(SceneloomError):
                on_ego = points_source(scene, riding, _ego(scene), reach_ns=scene_period_ns(scene))
                if on_ego is not None:
                    places[PointsFrame.EGO] = on_ego
        return places

    return subject.table(f"places of points of {type(sensor.id).__name__} {sensor.id}", made)


def transform_at(source: PoseSource, timestamp_ns: int) -> RigidTransform | None:
    """Give a source's transform at one time; None beyond its reach, and where its poses are no finite numbers."""
    poses = source.at(np.array([timestamp_ns], np.int64))
    if poses.coverage[0] == 2 or not np.isfinite(poses.positions).all():
        return None
    return RigidTransform.from_quaternion(poses.positions[0], poses.quaternions_xyzw[0])


def places_at(source: PoseSource, sensor: Ranging) -> Float64Array:
    """Positions at the times of a sensor's frames, (F, 3) float64 [m]; NaN beyond the source's reach."""
    return source.at(sensor.frames.timestamps_ns).positions
