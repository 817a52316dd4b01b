"""Where a sensor was: by its mounting, by its own poses, or relative to an odometry sensor."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.sensor_sources import points_source, sensor_source
from sceneloom.motion.trajectories import EgoMotion
from sceneloom.scene import Coordinates, LazyFrames, LidarSensor, OdometrySensor, PointsFrame, PosePath, Scene

TIMES = np.array([0, 100, 200], np.int64)
EGO = PosePath(
    TIMES,
    np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]),
    Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 0.1], [0, 0, 0.2]]).as_quat(),
)
MOUNT = RigidTransform(np.eye(3), np.array([0.0, 1.0, 2.0]))
WORLD_AT_100 = np.add(Rotation.from_rotvec([0, 0, 0.1]).apply([0, 1, 2]), [1, 0, 0])
NO_FRAMES = LazyFrames.of([], [])


def relative_path(moving: bool) -> PosePath:
    count = 3 if moving else 1
    positions = np.tile([0.0, 1.0, 2.0], (count, 1))
    return PosePath(TIMES[:count], positions, np.tile([0.0, 0, 0, 1], (count, 1)))


def test_a_mounting_rides_on_the_chosen_way() -> None:
    lidar = LidarSensor("lidar", NO_FRAMES, mount=MOUNT)
    pose = sensor_source(Scene((lidar,)), lidar, EgoMotion("groundTruth", EGO), reach_ns=0).at(TIMES[1:2])
    expected = WORLD_AT_100
    np.testing.assert_allclose(pose.positions[0], expected, atol=1e-12)


@pytest.mark.parametrize("moving", [False, True])
def test_poses_in_ego_coordinates_ride_on_the_only_odometry_sensor(moving: bool) -> None:
    lidar = LidarSensor("lidar", NO_FRAMES, poses=relative_path(moving), coordinates=Coordinates.EGO)
    scene = Scene((lidar, OdometrySensor("odometry", EGO)))
    pose = sensor_source(scene, lidar, None, reach_ns=0).at(TIMES[1:2])
    np.testing.assert_allclose(pose.positions[0], WORLD_AT_100, atol=1e-12)


def test_ego_coordinates_without_or_with_several_odometry_sensors_are_refused() -> None:
    lidar = LidarSensor("lidar", NO_FRAMES, poses=relative_path(moving=False), coordinates=Coordinates.EGO)
    two = (OdometrySensor("a", EGO), OdometrySensor("b", EGO))
    for others in ((), two):
        with pytest.raises(PoseError, match=f"{len(others)} odometry sensors"):
            sensor_source(Scene((lidar, *others)), lidar, None, reach_ns=0)


def test_the_parent_decides_between_several_odometry_sensors() -> None:
    still = PosePath.identity()
    lidar = LidarSensor(
        "lidar", NO_FRAMES, poses=relative_path(moving=False), coordinates=Coordinates.EGO, parent_id="b"
    )
    scene = Scene((lidar, OdometrySensor("a", EGO), OdometrySensor("b", still)))
    pose = sensor_source(scene, lidar, None, reach_ns=0).at(TIMES[2:])
    np.testing.assert_allclose(pose.positions[0], [0, 1, 2])


def test_world_points_need_no_source_and_ego_points_take_the_egos_own() -> None:
    world = LidarSensor("lidar", NO_FRAMES, points_frame=PointsFrame.WORLD)
    ego = LidarSensor("lidar", NO_FRAMES, points_frame=PointsFrame.EGO, mount=MOUNT)
    assert points_source(Scene((world,)), world, None, reach_ns=0) is None
    source = points_source(Scene((ego,)), ego, EgoMotion("groundTruth", EGO), reach_ns=0)
    assert source is not None
    np.testing.assert_allclose(source.at(TIMES).positions, EGO.positions)


def test_a_sensor_with_neither_poses_nor_mounting_is_named() -> None:
    lidar = LidarSensor("roof", NO_FRAMES)
    with pytest.raises(PoseError, match="'roof'"):
        sensor_source(Scene((lidar,)), lidar, None, reach_ns=0)
