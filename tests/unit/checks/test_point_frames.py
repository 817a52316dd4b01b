"""The rule about the frame of points, on a street of poles whose frame is known."""

import numpy as np
import pytest

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import matrix_from_quaternion
from sceneloom.scene import (
    Coordinates,
    LazyFrames,
    LidarFrame,
    LidarPoints,
    LidarSensor,
    OdometrySensor,
    PointsFrame,
    Poses,
    RadarFrame,
    RadarPoints,
    RadarSensor,
)

PERIOD = 100_000_000
RULE = "points-in-another-frame"
TIMES = np.arange(8, dtype=np.int64) * PERIOD
EGO_FROM_LIDAR = RigidTransform.from_quaternion(
    np.array([1.0, 0.5, 1.8]), np.array([0, 0, np.sin(0.6), np.cos(0.6)])
)


def trajectory(speed=10.0, start=(0.0, 0.0), yaw_rate=0.3):
    """The ego trajectory: at constant speed, rotating."""
    seconds = TIMES / 1e9
    positions = np.column_stack([start[0] + speed * seconds, np.full(8, start[1]), np.zeros(8)])
    half = yaw_rate * seconds / 2
    quaternions = np.column_stack([np.zeros(8), np.zeros(8), np.sin(half), np.cos(half)])
    return Poses(TIMES, positions, quaternions)


def poles():
    """400 poles of 3 m in a square of 160 m, with ground between them, (N, 3) [m]."""
    rng = np.random.default_rng(2)
    feet = rng.uniform(-80, 80, (400, 2))
    heights = np.linspace(0, 3, 16)
    shafts = np.column_stack([np.repeat(feet, 16, axis=0), np.tile(heights, 400)])
    ground = np.column_stack([rng.uniform(-80, 80, (4_000, 2)), np.zeros(4_000)])
    return np.vstack([shafts, ground])


def seen(path, frame):
    """The points within 50 m of the lidar at each time, in a frame."""
    world, found = poles(), []
    for k in range(len(TIMES)):
        world_from_ego = RigidTransform(matrix_from_quaternion(path.quaternions_xyzw[k]), path.positions[k])
        locations = {
            PointsFrame.WORLD: RigidTransform.identity(),
            PointsFrame.EGO: world_from_ego,
            PointsFrame.SENSOR: world_from_ego @ EGO_FROM_LIDAR,
        }
        near = world + np.append(path.positions[0, :2], 0.0)
        near = near[np.linalg.norm(near - path.positions[k], axis=1) < 50]
        found.append(locations[frame].inverse().apply(near).astype(np.float32))
    return found


def drive(sound, stated, real, path=None):
    """A lidar mounted on an ego, its points stated to be in one frame and really in another."""
    path = path or trajectory()
    frames = [
        LidarFrame(int(t), LidarPoints(points)) for t, points in zip(TIMES, seen(path, real), strict=True)
    ]
    mount = Poses(
        np.zeros(1, np.int64), EGO_FROM_LIDAR.translation[None], EGO_FROM_LIDAR.quaternion_xyzw[None]
    )
    lidar = LidarSensor(
        "top", LazyFrames.of(frames, TIMES), mount, coordinates=Coordinates.EGO, points_frame=stated
    )
    return sound.scene(lidar, OdometrySensor("ego", path))


@pytest.mark.parametrize("frame", PointsFrame)
def test_points_in_the_frame_that_is_stated_are_left_alone(sound, found, frame):
    assert found(drive(sound, frame, frame), RULE) == []


@pytest.mark.parametrize("stated", PointsFrame)
@pytest.mark.parametrize("real", PointsFrame)
def test_points_in_another_frame_are_reported_by_what_meets(sound, found, stated, real):
    if stated == real:
        return
    [(path, message)] = found(drive(sound, stated, real), RULE)
    assert path == "sensors[0].frames[].points"
    assert f"taken as {real.value} coordinates" in message
    assert message.endswith(f"stated is {stated.value}")
    assert "meet points of another frame" in message


def test_points_far_from_their_sensor_are_reported_without_any_motion(sound, found):
    still = trajectory(speed=0.0, start=(500.0, 300.0), yaw_rate=0.0)
    [(_, message)] = found(drive(sound, PointsFrame.WORLD, PointsFrame.SENSOR, still), RULE)
    assert message.startswith("taken as world coordinates half of the points lie more than 58")
    assert found(drive(sound, PointsFrame.WORLD, PointsFrame.WORLD, still), RULE) == []


def test_a_sensor_that_stands_near_the_origin_shows_nothing(sound, found):
    still = trajectory(speed=0.0, yaw_rate=0.0)
    for stated in PointsFrame:
        assert found(drive(sound, stated, PointsFrame.SENSOR, still), RULE) == []


def test_a_lidar_without_a_known_location_is_left_alone(sound, found):
    frames = [
        LidarFrame(int(t), LidarPoints(points))
        for t, points in zip(TIMES, seen(trajectory(), "world"), strict=True)
    ]
    assert found(sound.scene(LidarSensor("top", LazyFrames.of(frames, TIMES))), RULE) == []


def test_radars_are_judged_by_distance(sound, found):
    path = trajectory(start=(500.0, 300.0))
    for stated, hits in ((PointsFrame.WORLD, 1), (PointsFrame.SENSOR, 0)):
        clouds = [points[:50] for points in seen(path, PointsFrame.SENSOR)]
        frames = [RadarFrame(int(t), RadarPoints(points)) for t, points in zip(TIMES, clouds, strict=True)]
        radar = RadarSensor("radar", LazyFrames.of(frames, TIMES), path, points_frame=stated)
        assert len(found(sound.scene(radar), RULE)) == hits
