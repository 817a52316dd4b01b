"""The thin pose path of a sensor stays true to its dense source."""

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.cameras.camera import Camera
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraImage, LazyFrames, Poses, ego
from sceneloom.scene.ego import camera_path, sensor_path
from sceneloom.scene.poses import PoseSource

MOUNT = RigidTransform(Rotation.from_euler("z", 0.4).as_matrix(), np.array([2.0, 0.5, 1.7]))
RAISED = RigidTransform(MOUNT.rotation, np.array([2.0, 0.5, 2.7]))


def winding_path(seconds=4.0, rate=100):
    t = np.arange(0, seconds, 1 / rate)
    positions = np.stack([10 * t, 3 * np.sin(t), 0.1 * np.sin(5 * t)], axis=1)
    rotations = Rotation.from_euler("zyx", np.stack([0.5 * np.sin(2 * t), 0.02 * np.sin(7 * t), 0 * t], axis=1))
    return Poses((t * 1e9).astype(np.int64), positions, rotations.as_quat())


def test_every_frame_within_reach_has_its_pose_and_the_rest_stays_within_a_millimetre_piece_by_piece_too(monkeypatch):
    source = PoseSource(winding_path(), MOUNT)
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
    thin = sensor_path(PoseSource(straight, MOUNT), frames)
    assert thin is not None
    np.testing.assert_array_equal(thin.timestamps_ns, frames)
    path = winding_path()
    frames = np.array([path.start_ns, path.stop_ns + 10, path.stop_ns + 1000], np.int64)
    thin = sensor_path(PoseSource(path, MOUNT, reach_ns=100), frames)
    assert thin is not None
    assert thin.stop_ns == path.stop_ns + 10
    assert sensor_path(PoseSource(path, MOUNT), frames[2:]) is None
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
    source = PoseSource(winding_path(), MOUNT)
    path = camera_path(source, images_with(mounts, times))
    assert path is not None
    for time, mount in zip(times, mounts, strict=True):
        at = np.array([time], np.int64)
        expected = PoseSource(winding_path(), mount or MOUNT).at(at)
        np.testing.assert_allclose(path.interpolate(at).positions, expected.positions, atol=1e-9)
    between = np.linspace(times[2], times[3], 50).astype(np.int64)
    truth = PoseSource(winding_path(), RAISED).at(between).positions
    assert np.linalg.norm(path.interpolate(between).positions - truth, axis=1).max() < 1.1e-3
    path = camera_path(source, images_with([None, RAISED], [500, 500]))
    assert path is not None
    np.testing.assert_allclose(path.positions, source.at(np.array([500], np.int64)).positions)
    own = PoseSource(winding_path(), RigidTransform.identity(), own=True)
    path = camera_path(own, images_with([MOUNT, MOUNT], [0, 100_000_000]))
    assert path is not None
    np.testing.assert_allclose(path.positions[0], winding_path().positions[0])
    assert camera_path(source, images_with([], [])) is None
