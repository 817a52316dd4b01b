"""Poses between poses against a slow oracle, at the ends of a path, and with times at the edge of 64 bits."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sceneloom.errors import ArrayError
from sceneloom.geometry.rigid import angle_between, interpolate_poses

EPOCH_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000


@pytest.fixture
def path() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Six uneven poses at today's epoch, rotating by up to a third of a circle from one to the next."""
    rng = np.random.default_rng(0)
    times = EPOCH_NS + np.array([0, 100, 250, 251, 400, 1000]) * 1_000_000
    rotations = Rotation.from_rotvec(np.cumsum(rng.uniform(-1, 1, (6, 3)), axis=0)).as_quat()
    return times, rng.uniform(-100, 100, (6, 3)), rotations


def slow_pose(times, positions, quaternions, query):
    """One pose, by exact integer arithmetic and scipy."""
    k = max(i for i in range(len(times) - 1) if i == 0 or times[i] <= query)
    fraction = (int(query) - int(times[k])) / (int(times[k + 1]) - int(times[k]))
    position = [(1 - fraction) * p + fraction * q for p, q in zip(positions[k], positions[k + 1], strict=True)]
    return position, Slerp([0, 1], Rotation.from_quat(quaternions[k : k + 2]))(fraction).as_quat()


def test_poses_between_are_those_of_a_slow_oracle(path):
    times, _, _ = path
    queries = np.random.default_rng(1).integers(times[0], times[-1], 300)
    positions, quaternions, coverage = interpolate_poses(*path, queries)
    expected = [slow_pose(*path, query) for query in queries]
    assert np.allclose(positions, [p for p, _ in expected], atol=1e-12)  # 1e-16 of 100 m, some operations
    assert angle_between(quaternions, np.array([q for _, q in expected])).max() < 1e-12
    assert (coverage == 0).all()


def test_at_its_own_times_the_path_gives_its_own_poses(path):
    positions, quaternions, coverage = interpolate_poses(*path, path[0])
    assert np.allclose(positions, path[1], rtol=1e-15)
    assert angle_between(quaternions, path[2]).max() < 1e-15
    assert (coverage == 0).all()


def test_a_nanosecond_counts_at_todays_epoch():
    times = EPOCH_NS + np.array([0, 1000])
    positions, _, _ = interpolate_poses(
        times, np.array([[0.0, 0, 0], [1000.0, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)), times[:1] + 1
    )
    assert positions[0, 0] == 1.0  # float64 seconds would resolve 238 ns


def test_beyond_the_ends_velocity_and_rotating_go_on_as_far_as_the_reach():
    times = np.array([0, SECOND_NS])
    rotations = Rotation.from_euler("z", [[0], [10]], degrees=True).as_quat()
    queries = np.array([-SECOND_NS - 1, -SECOND_NS, 0, SECOND_NS, 2 * SECOND_NS, 2 * SECOND_NS + 1])
    positions, quaternions, coverage = interpolate_poses(
        times, np.array([[0.0, 0, 0], [3.0, 0, 0]]), rotations, queries, reach_ns=SECOND_NS
    )
    assert coverage.tolist() == [2, 1, 0, 0, 1, 2]
    assert coverage.dtype == np.uint8
    assert np.array_equal(positions[:, 0], [np.nan, -3, 0, 3, 6, np.nan], equal_nan=True)
    yaw = Rotation.from_quat(quaternions[1:5]).as_euler("zyx", degrees=True)[:, 0]
    assert np.allclose(yaw, [-10, 0, 10, 20])
    assert np.isnan(quaternions[[0, 5]]).all()


def test_without_reach_nothing_beyond_the_ends_is_given(path):
    queries = np.array([path[0][0] - 1, path[0][-1] + 1])
    positions, quaternions, coverage = interpolate_poses(*path, queries)
    assert coverage.tolist() == [2, 2]
    assert np.isnan(positions).all()
    assert np.isnan(quaternions).all()


def test_a_path_of_one_pose_is_stationary_within_its_reach():
    positions, quaternions, coverage = interpolate_poses(
        np.array([50]), np.array([[1.0, 2, 3]]), np.array([[0.0, 0, 0, 1]]), np.array([30, 49, 50, 60, 61]), reach_ns=10
    )
    assert coverage.tolist() == [2, 1, 0, 1, 2]
    assert np.array_equal(positions[1:4], np.tile([1.0, 2, 3], (3, 1)))
    assert np.array_equal(quaternions[1:4], np.tile([0.0, 0, 0, 1], (3, 1)))


def test_times_at_the_edge_of_64_bits_are_out_of_reach_and_do_not_wrap(path):
    edges = np.array([np.iinfo(np.int64).min, np.iinfo(np.int64).max])
    for reach_ns in (0, SECOND_NS, np.iinfo(np.int64).max):
        _, _, coverage = interpolate_poses(*path, edges, reach_ns=reach_ns)
        assert coverage[0] == 2
    _, _, coverage = interpolate_poses(*path, edges, reach_ns=SECOND_NS)
    assert coverage.tolist() == [2, 2]


def test_quaternions_that_are_not_quite_unit_come_out_unit(path):
    _, quaternions, _ = interpolate_poses(path[0], path[1], 1.005 * path[2], path[0][:1] + 7)
    assert np.linalg.norm(quaternions[0]) == pytest.approx(1.0, abs=1e-15)


def test_no_question_gets_no_answer(path):
    positions, quaternions, coverage = interpolate_poses(*path, np.zeros(0, np.int64))
    assert positions.shape == (0, 3)
    assert quaternions.shape == (0, 4)
    assert coverage.shape == (0,)


def test_an_empty_path_is_refused():
    with pytest.raises(ArrayError, match="at least one"):
        interpolate_poses(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)), np.array([1]))


def test_the_inputs_are_left_alone(path):
    before = [array.copy() for array in path]
    for array in path:
        array.flags.writeable = False
    queries = path[0] + 5
    queries.flags.writeable = False
    interpolate_poses(*path, queries, reach_ns=10)
    assert all(np.array_equal(a, b) for a, b in zip(before, path, strict=True))
