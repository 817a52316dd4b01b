"""Points of a moving sensor into the world, held against scipy point by point, and the thin pose path of a sensor."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.cameras.camera import Camera
from sceneloom.errors import PoseError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.deskew import points_at, points_to_world
from sceneloom.scene import CameraImage, LazyFrames, LidarFrame, LidarPoints, Poses, ego
from sceneloom.scene.ego import camera_path, sensor_path
from sceneloom.scene.poses import PoseSource

MOUNT = RigidTransform(Rotation.from_euler("xyz", [0.1, -0.2, 0.3]).as_matrix(), np.array([1.0, 0.2, 1.7]))


def random_path(rng, count=9):
    times = np.cumsum(rng.integers(5_000_000, 20_000_000, count)).astype(np.int64)
    rotations = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.2, size=(count, 3)), axis=0))
    return Poses(times, np.cumsum(rng.normal(size=(count, 3)), axis=0), rotations.as_quat())


def frame_at(times_ns, positions):
    return LidarFrame(int(times_ns[0]), LidarPoints(positions.astype(np.float32), timestamps_ns=times_ns))


def scipy_world(path, mount, times_ns, positions):
    slerp = Slerp(path.timestamps_ns.astype(float), Rotation.from_quat(path.quaternions_xyzw))
    locations = np.stack([np.interp(times_ns, path.timestamps_ns, path.positions[:, k]) for k in range(3)], axis=1)
    return slerp(times_ns.astype(float)).apply(positions @ mount.rotation.T + mount.translation) + locations


def test_each_point_is_placed_by_the_pose_at_its_own_time_in_the_world_or_at_any_moment():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        path = random_path(rng)
        times = rng.integers(path.start_ns, path.stop_ns, 500)
        positions = rng.normal(scale=30, size=(500, 3)).astype(np.float32)
        world, extrapolated = points_to_world(frame_at(times, positions), PoseSource(path, MOUNT))
        # 30 m at double precision; scipy's slerp and ours differ by rounding only
        np.testing.assert_allclose(world, scipy_world(path, MOUNT, times, positions.astype(float)), atol=1e-9)
        assert not extrapolated
    for share in [0.0, 0.3, 1.0]:
        rng = np.random.default_rng(7)
        path = random_path(rng)
        early, late = int(path.timestamps_ns[3]), int(path.timestamps_ns[5])
        times = rng.integers(early, late, 300)
        moment = int(path.start_ns + share * (path.stop_ns - path.start_ns))
        positions = rng.normal(scale=30, size=(300, 3)).astype(np.float32)
        moved, extrapolated = points_at(frame_at(times, positions), PoseSource(path, MOUNT), moment)
        seen_again = scipy_world(path, MOUNT, np.full(300, moment), moved)
        world = scipy_world(path, MOUNT, times, positions.astype(float))
        np.testing.assert_allclose(seen_again, world, atol=1e-9)
        assert not extrapolated
        with pytest.raises(PoseError, match="the poses reach"):
            points_at(frame_at(times, positions), PoseSource(path, MOUNT), path.stop_ns + 1)


def test_poses_are_joined_by_the_shorter_arc_and_points_beyond_follow_the_end_within_reach():
    rotations = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 0.4]]).as_quat()
    times = np.array([0, 100], np.int64)
    plain = Poses(times, np.zeros((2, 3)), rotations)
    flipped = Poses(times, np.zeros((2, 3)), rotations * [[1.0], [-1.0]])
    frame = frame_at(np.array([0, 50, 99], np.int64), np.ones((3, 3)))
    np.testing.assert_allclose(
        points_to_world(frame, PoseSource(flipped, MOUNT))[0], points_to_world(frame, PoseSource(plain, MOUNT))[0]
    )
    path = random_path(np.random.default_rng(0))
    when = int(path.timestamps_ns[3]) + 1000
    positions = np.random.default_rng(1).normal(size=(20, 3)).astype(np.float32)
    world, _ = points_to_world(LidarFrame(when, LidarPoints(positions)), PoseSource(path, MOUNT))
    expected = scipy_world(path, MOUNT, np.full(20, when), positions.astype(float))
    np.testing.assert_allclose(world, expected, atol=1e-9)
    straight = Poses(np.array([0, 10**8]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    source = PoseSource(straight, RigidTransform.identity(), reach_ns=10**8)
    world, extrapolated = points_to_world(frame_at(np.array([5, 15, 20]) * 10**7, np.zeros((3, 3))), source)
    np.testing.assert_allclose(world[:, 0], [0.5, 1.5, 2.0], atol=1e-12)
    assert extrapolated
    path = random_path(np.random.default_rng(0))
    late = np.array([path.stop_ns, path.stop_ns + 2], np.int64)
    with pytest.raises(PoseError, match=str(path.stop_ns + 2)):
        points_to_world(frame_at(late, np.zeros((2, 3))), PoseSource(path, MOUNT, reach_ns=1))
    frame = LidarFrame(0, LidarPoints(np.zeros((0, 3), np.float32), timestamps_ns=np.zeros(0, np.int64)))
    world, extrapolated = points_to_world(frame, PoseSource(random_path(np.random.default_rng(0)), MOUNT))
    assert (world.shape, bool(extrapolated)) == ((0, 3), False)
    frame = frame_at(np.array([-(10**15), 10**18], np.int64), np.ones((2, 3)))
    world, extrapolated = points_to_world(frame, PoseSource(Poses.identity(), MOUNT))
    np.testing.assert_allclose(world, MOUNT.apply(np.ones((2, 3))))
    assert not extrapolated


TURNED = RigidTransform(Rotation.from_euler("z", 0.4).as_matrix(), np.array([2.0, 0.5, 1.7]))
RAISED = RigidTransform(TURNED.rotation, np.array([2.0, 0.5, 2.7]))


def winding_path(seconds=4.0, rate=100):
    t = np.arange(0, seconds, 1 / rate)
    positions = np.stack([10 * t, 3 * np.sin(t), 0.1 * np.sin(5 * t)], axis=1)
    rotations = Rotation.from_euler("zyx", np.stack([0.5 * np.sin(2 * t), 0.02 * np.sin(7 * t), 0 * t], axis=1))
    return Poses((t * 1e9).astype(np.int64), positions, rotations.as_quat())


def test_every_frame_within_reach_has_its_pose_and_the_rest_stays_within_a_millimetre_piece_by_piece_too(monkeypatch):
    source = PoseSource(winding_path(), TURNED)
    frames = np.arange(100_000_000, 3_800_000_000, 100_000_000, dtype=np.int64)
    thin = sensor_path(source, frames)
    assert thin is not None
    assert np.isin(frames, thin.timestamps_ns).all()
    times = np.linspace(frames[0], frames[-1], 5001).astype(np.int64)
    truth, near = source.at(times), thin.interpolate(times)
    distance = np.linalg.norm(truth.positions - near.positions, axis=1)
    angle = (Rotation.from_quat(truth.quaternions_xyzw).inv() * Rotation.from_quat(near.quaternions_xyzw)).magnitude()
    # the promise holds at the times looked at; between them the arc of the mounting adds less than a tenth
    assert distance.max() < 1.1e-3
    assert np.degrees(angle).max() < 0.011
    t = np.arange(0, 100, dtype=np.int64) * 10_000_000
    straight = Poses(t, np.stack([t * 1e-8, 0 * t, 0 * t], axis=1), np.tile([0.0, 0, 0, 1], (100, 1)))
    frames = np.arange(0, 900_000_000, 100_000_000, dtype=np.int64)
    thin = sensor_path(PoseSource(straight, TURNED), frames)
    assert thin is not None
    np.testing.assert_array_equal(thin.timestamps_ns, frames)
    path = winding_path()
    frames = np.array([path.start_ns, path.stop_ns + 10, path.stop_ns + 1000], np.int64)
    thin = sensor_path(PoseSource(path, TURNED, reach_ns=100), frames)
    assert thin is not None
    assert thin.stop_ns == path.stop_ns + 10
    assert sensor_path(PoseSource(path, TURNED), frames[2:]) is None
    frames = np.arange(100_000_000, 3_800_000_000, 130_000_000, dtype=np.int64)
    whole = sensor_path(source, frames)
    monkeypatch.setattr(ego, "_FRAMES_AT_ONCE", 3)
    chunks = sensor_path(source, frames)
    assert whole is not None
    assert chunks is not None
    assert len(whole.timestamps_ns) > len(frames)
    np.testing.assert_array_equal(chunks.timestamps_ns, whole.timestamps_ns)


def images_with(mounts, times_ns):
    camera, rgb = Camera("pinhole", 1, 1, 1.0, 1.0, 0.0, 0.0), np.zeros((1, 1, 3), np.uint8)
    images = [CameraImage(t, camera, lambda: rgb, mount=m) for t, m in zip(times_ns, mounts, strict=True)]
    return LazyFrames.of(images, times_ns)


def test_each_image_has_the_pose_of_its_own_mounting_images_of_one_time_share_it_and_own_poses_stay():
    same = RigidTransform(RAISED.rotation.copy(), RAISED.translation.copy())
    mounts = [None, None, RAISED, same, None, RAISED]
    times = [400_000_000 + 100_000_000 * k for k in range(6)]
    source = PoseSource(winding_path(), TURNED)
    path = camera_path(source, images_with(mounts, times))
    assert path is not None
    for time, mount in zip(times, mounts, strict=True):
        at = np.array([time], np.int64)
        expected = PoseSource(winding_path(), mount or TURNED).at(at)
        np.testing.assert_allclose(path.interpolate(at).positions, expected.positions, atol=1e-9)
    between = np.linspace(times[2], times[3], 50).astype(np.int64)
    truth = PoseSource(winding_path(), RAISED).at(between).positions
    assert np.linalg.norm(path.interpolate(between).positions - truth, axis=1).max() < 1.1e-3
    path = camera_path(source, images_with([None, RAISED], [500, 500]))
    assert path is not None
    np.testing.assert_allclose(path.positions, source.at(np.array([500], np.int64)).positions)
    own = PoseSource(winding_path(), RigidTransform.identity(), own=True)
    path = camera_path(own, images_with([TURNED, TURNED], [0, 100_000_000]))
    assert path is not None
    np.testing.assert_allclose(path.positions[0], winding_path().positions[0])
    assert camera_path(source, images_with([], [])) is None
