"""Poses refuses what is no path, and says where."""

from typing import Any

import numpy as np
import pytest

from sceneloom.errors import ArrayError, PoseError
from sceneloom.scene import Poses, Trajectory
from sceneloom.scene.poses import same_direction

UPRIGHT = np.array([[0.0, 0.0, 0.0, 1.0]])


def path_with(times: list[int], quaternion: list[float] | None = None, location: float = 0.0) -> Poses:
    count = len(times)
    rotations = np.tile(UPRIGHT if quaternion is None else np.array([quaternion]), (count, 1))
    return Poses(np.array(times, np.int64), np.full((count, 3), location), rotations)


@pytest.mark.parametrize(
    ("times", "quaternion", "location", "problem"),
    [
        ([0, 5, 5], None, 0.0, r"timestamps_ns\[2\]: 5; expected strictly increasing"),
        ([0], [0, 0, 0, 1.02], 0.0, r"norm 1\.0200"),
        ([0], None, float("nan"), "not finite"),
        ([0], None, float("inf"), "not finite"),
        ([], None, 0.0, "at least one pose"),
    ],
)
def test_what_is_no_path_is_refused(times: list[int], quaternion: Any, location: float, problem: str) -> None:
    with pytest.raises(ArrayError, match=problem):
        path_with(times, quaternion, location)
    assert path_with([0], [0, 0, 0, 1.005]).start_ns == 0


def test_the_identity_holds_at_all_times() -> None:
    samples = Poses.identity().interpolate(np.array([-(2**60), 0, 2**60], np.int64))
    np.testing.assert_array_equal(samples.positions, 0)
    np.testing.assert_array_equal(samples.quaternions_xyzw, np.repeat(UPRIGHT, 3, axis=0))
    np.testing.assert_array_equal(samples.coverage, 0)


def test_a_pose_that_holds_always_comes_out_of_unit_length_and_a_moved_one_keeps_the_rest() -> None:
    path = Poses(np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[0, 0, 0.603, 0.804]]), static=True)
    np.testing.assert_allclose(path.interpolate(np.zeros(2, np.int64)).quaternions_xyzw, [[0, 0, 0.6, 0.8]] * 2)
    moved = Poses.identity().moved(np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(moved.positions, [[-1, -2, -3]])
    assert moved.static


def test_the_arrays_of_a_path_cannot_be_written() -> None:
    path = path_with([0, 1])
    with pytest.raises(ValueError, match="read-only"):
        path.positions[0, 0] = 1.0


def test_a_trajectory_of_positions_has_no_poses_and_says_what_to_do() -> None:
    with pytest.raises(PoseError, match="--orientation-from motion"):
        _ = Trajectory("gnssEnu", np.zeros(1, np.int64), np.zeros((1, 3))).poses


def test_ways_are_the_same_only_number_for_number():
    timestamps, rotations = np.array([0, 10]), np.array([[0.0, 0, 0, 1]] * 2)
    far_away = np.array([[500_000.0, 4_500_000.0, 0.0]] * 2)
    trajectory = Trajectory("trajectory", timestamps, far_away, rotations)
    assert same_direction(Poses(timestamps, far_away, rotations), trajectory)
    assert not same_direction(Poses(timestamps, far_away + 0.001, rotations), trajectory)
    assert not same_direction(Poses(timestamps + 1, far_away, rotations), trajectory)
    assert not same_direction(Poses(timestamps, far_away, -rotations), trajectory)
    assert not same_direction(Poses(timestamps, far_away, rotations), Trajectory("locations", timestamps, far_away))
