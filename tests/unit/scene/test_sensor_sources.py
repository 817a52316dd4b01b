"""Where a sensor was: by its mounting, by its own poses, or relative to an odometry sensor."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import Coordinates, LazyFrames, LidarSensor, OdometrySensor, PointsFrame, Poses, Scene
from sceneloom.scene.ego import EgoMotion, lidar_position, points_source, sensor_source

TIMES = np.array([0, 100, 200], np.int64)
EGO = Poses(
    TIMES,
    np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]),
    Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 0.1], [0, 0, 0.2]]).as_quat(),
)
MOUNT = RigidTransform(np.eye(3), np.array([0.0, 1.0, 2.0]))
WORLD_AT_100 = np.add(Rotation.from_rotvec([0, 0, 0.1]).apply([0, 1, 2]), [1, 0, 0])
NO_FRAMES = LazyFrames.of([], [])


def relative_path(moving: bool) -> Poses:
    count = 3 if moving else 1
    positions = np.tile([0.0, 1.0, 2.0], (count, 1))
    return Poses(TIMES[:count], positions, np.tile([0.0, 0, 0, 1], (count, 1)))


def riding(moving: bool, **fields: str) -> LidarSensor:
    return LidarSensor("lidar", NO_FRAMES, poses=relative_path(moving), coordinates=Coordinates.EGO, **fields)


def test_a_mounting_rides_on_the_chosen_trajectory_and_ego_poses_on_the_only_odometry_sensor() -> None:
    lidar = LidarSensor("lidar", NO_FRAMES, mount=MOUNT)
    pose = sensor_source(Scene((lidar,)), lidar, EgoMotion("groundTruth", EGO), reach_ns=0).at(TIMES[1:2])
    np.testing.assert_allclose(pose.positions[0], WORLD_AT_100, atol=1e-12)
    for moving in (False, True):
        lidar = riding(moving)
        pose = sensor_source(Scene((lidar, OdometrySensor("odometry", EGO))), lidar, None, reach_ns=0).at(TIMES[1:2])
        np.testing.assert_allclose(pose.positions[0], WORLD_AT_100, atol=1e-12)


def test_ego_coordinates_without_or_with_several_odometry_sensors_are_refused() -> None:
    lidar = riding(moving=False)
    two = (OdometrySensor("a", EGO), OdometrySensor("b", EGO))
    with pytest.raises(PoseError, match="no odometry sensor says where the ego was"):
        sensor_source(Scene((lidar,)), lidar, None, reach_ns=0)
    for chosen in (None, EgoMotion("a", EGO)):
        for parent_id in (None, "lidar"):
            unclear = replace(lidar, parent_id=parent_id)
            with pytest.raises(PoseError, match="expected one of 'a', 'b' as its parent_id"):
                sensor_source(Scene((unclear, *two)), unclear, chosen, reach_ns=0)
            points = replace(unclear, poses=None, points_frame=PointsFrame.EGO)
            with pytest.raises(PoseError, match="expected one of 'a', 'b' as its parent_id"):
                points_source(Scene((points, *two)), points, chosen, reach_ns=0)


def test_the_parent_decides_between_several_odometry_sensors() -> None:
    lidar = riding(moving=False, parent_id="b")
    scene = Scene((lidar, OdometrySensor("a", EGO), OdometrySensor("b", Poses.identity())))
    pose = sensor_source(scene, lidar, None, reach_ns=0).at(TIMES[2:])
    np.testing.assert_allclose(pose.positions[0], [0, 1, 2])


def test_world_points_need_no_source_and_ego_points_take_the_egos_own() -> None:
    world = LidarSensor("lidar", NO_FRAMES, points_frame=PointsFrame.WORLD)
    ego = LidarSensor("lidar", NO_FRAMES, points_frame=PointsFrame.EGO, mount=MOUNT)
    assert points_source(Scene((world,)), world, None, reach_ns=0) is None
    source = points_source(Scene((ego,)), ego, EgoMotion("groundTruth", EGO), reach_ns=0)
    assert source is not None
    np.testing.assert_allclose(source.at(TIMES).positions, EGO.positions)


def test_poses_relative_to_an_ego_that_is_stationary_hold_at_their_own_times() -> None:
    stands = Poses(np.zeros(1, np.int64), np.array([[5.0, 0, 0]]), np.array([[0, 0, 0, 1.0]]), static=True)
    lidar = riding(moving=True)
    source = sensor_source(Scene((lidar, OdometrySensor("odometry", stands))), lidar, None, reach_ns=0)
    np.testing.assert_allclose(source.at(TIMES).positions, np.tile([5.0, 1, 2], (3, 1)))


def test_a_mounting_changes_a_sensor_on_the_ego_and_not_one_with_poses_of_its_own() -> None:
    higher = RigidTransform(np.eye(3), np.array([0.0, 0.0, 9.0]))
    on_ego = LidarSensor("lidar", NO_FRAMES, mount=MOUNT)
    rider_association = sensor_source(Scene((on_ego,)), on_ego, EgoMotion("groundTruth", EGO), reach_ns=0)
    np.testing.assert_allclose(rider_association.mounted(higher).at(TIMES[:1]).positions, [[0, 0, 9]])
    assert rider_association.mounted(None) is rider_association
    placed = LidarSensor("lidar", NO_FRAMES, poses=EGO)
    own = sensor_source(Scene((placed,)), placed, None, reach_ns=0)
    np.testing.assert_allclose(own.mounted(higher).at(TIMES).positions, EGO.positions)


def test_a_sensor_of_unknown_location_is_named_with_what_to_write() -> None:
    lidar = LidarSensor("roof", NO_FRAMES)
    with pytest.raises(PoseError, match=r"where sensor 'roof' is.*`imuToLidar`"):
        sensor_source(Scene((lidar,)), lidar, None, reach_ns=0)


def test_a_lidar_has_its_location_whatever_frame_its_points_come_in_unless_it_has_neither_poses_nor_mounting() -> None:
    ego = EgoMotion("groundTruth", EGO)
    for points_frame in PointsFrame:
        lidar = LidarSensor("lidar", NO_FRAMES, mount=MOUNT, points_frame=points_frame)
        location = lidar_position(Scene((lidar,)), lidar, ego, reach_ns=0)
        assert location is not None
        np.testing.assert_allclose(location.at(TIMES[1:2]).positions[0], WORLD_AT_100, atol=1e-12)
    for mount in (None, RigidTransform.identity()):
        lidar = LidarSensor("lidar", NO_FRAMES, mount=mount)
        assert lidar_position(Scene((lidar,)), lidar, ego, reach_ns=0) is None
