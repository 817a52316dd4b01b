"""From where a lidar measured the points of a sweep."""

import numpy as np
import pytest

from sceneloom.colouring import LidarTrajectory
from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import LidarFrame, LidarPoints, Poses
from sceneloom.scene.poses import PoseSource

AHEAD = Poses(
    np.array([0, 1000], np.int64), np.array([[0.0, 0, 0], [10, 0, 0]]), np.array([[0.0, 0, 0, 1]] * 2)
)
MOUNT = RigidTransform(np.eye(3), np.array([0.0, 1.0, 2.0]))


def sweep(times: list[int] | None, count: int = 3) -> LidarFrame:
    timestamps = None if times is None else np.array(times, np.int64)
    return LidarFrame(400, LidarPoints(np.zeros((count, 3), np.float32), timestamps_ns=timestamps))


def test_the_ends_are_the_lidars_locations_at_the_first_and_the_last_point() -> None:
    trajectory = LidarTrajectory.of(sweep([300, 500, 350]), PoseSource(AHEAD, MOUNT))
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.ends_world, [[3, 1, 2], [5, 1, 2]])
    np.testing.assert_allclose(trajectory.fractions, [0, 1, 0.25])


def test_points_without_times_were_all_measured_at_the_timestamp_of_their_frame() -> None:
    trajectory = LidarTrajectory.of(sweep(None), PoseSource(AHEAD, MOUNT))
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.ends_world, [[4, 1, 2], [4, 1, 2]])
    np.testing.assert_array_equal(trajectory.fractions, [0, 0, 0])


def test_an_empty_sweep_has_a_trajectory_without_points() -> None:
    trajectory = LidarTrajectory.of(sweep([], 0), PoseSource(AHEAD, MOUNT))
    assert trajectory is not None
    assert trajectory.fractions.shape == (0,)


def test_a_sweep_beyond_the_poses_has_no_way() -> None:
    assert LidarTrajectory.of(sweep([900, 1000, 1001]), PoseSource(AHEAD, MOUNT)) is None


@pytest.mark.parametrize(
    ("ends", "fractions"),
    [(np.zeros((3, 3)), np.zeros(2, np.float32)), (np.zeros((2, 3)), np.zeros(2))],
)
def test_arrays_of_another_kind_are_refused(ends: np.ndarray, fractions: np.ndarray) -> None:
    with pytest.raises(ArrayError, match="trajectory"):
        LidarTrajectory(ends, fractions)
