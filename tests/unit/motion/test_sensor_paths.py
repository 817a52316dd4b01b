"""The thin pose path of a sensor stays true to its dense source."""

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.geometry.rigid import RigidTransform
from sceneloom.motion.pose_source import PoseSource
from sceneloom.motion.sensor_paths import sensor_path
from sceneloom.scene import PosePath

MOUNT = RigidTransform(Rotation.from_euler("z", 0.4).as_matrix(), np.array([2.0, 0.5, 1.7]))


def winding_path(seconds: float = 4.0, rate: int = 100) -> PosePath:
    t = np.arange(0, seconds, 1 / rate)
    positions = np.stack([10 * t, 3 * np.sin(t), 0.1 * np.sin(5 * t)], axis=1)
    turns = Rotation.from_euler("zyx", np.stack([0.5 * np.sin(2 * t), 0.02 * np.sin(7 * t), 0 * t], axis=1))
    return PosePath((t * 1e9).astype(np.int64), positions, turns.as_quat())


def test_every_frame_has_its_pose_and_the_rest_stays_within_a_millimetre_and_a_hundredth_of_a_degree() -> (
    None
):
    source = PoseSource(winding_path(), MOUNT)
    frames = np.arange(100_000_000, 3_800_000_000, 100_000_000, dtype=np.int64)
    thin = sensor_path(source, frames)
    assert thin is not None
    assert np.isin(frames, thin.timestamps_ns).all()
    times = np.linspace(frames[0], frames[-1], 5001).astype(np.int64)
    truth, near = source.at(times), thin.interpolate(times)
    distance = np.linalg.norm(truth.positions - near.positions, axis=1)
    angle = (
        Rotation.from_quat(truth.quaternions_xyzw).inv() * Rotation.from_quat(near.quaternions_xyzw)
    ).magnitude()
    # the promise holds at the times looked at; between them the arc of the mounting adds less than a tenth
    assert distance.max() < 1.1e-3
    assert np.degrees(angle).max() < 0.011


def test_a_straight_way_needs_no_pose_but_the_frames_own() -> None:
    t = np.arange(0, 100, dtype=np.int64) * 10_000_000
    straight = PosePath(t, np.stack([t * 1e-8, 0 * t, 0 * t], axis=1), np.tile([0.0, 0, 0, 1], (100, 1)))
    frames = np.arange(0, 900_000_000, 100_000_000, dtype=np.int64)
    thin = sensor_path(PoseSource(straight, MOUNT), frames)
    assert thin is not None
    np.testing.assert_array_equal(thin.timestamps_ns, frames)


def test_frames_beyond_the_reach_get_no_pose() -> None:
    path = winding_path()
    frames = np.array([path.start_ns, path.stop_ns + 10, path.stop_ns + 1000], np.int64)
    thin = sensor_path(PoseSource(path, MOUNT, reach_ns=100), frames)
    assert thin is not None
    assert thin.stop_ns == path.stop_ns + 10
    assert sensor_path(PoseSource(path, MOUNT), frames[2:]) is None
