"""Thinned paths stay near the dense ones, keep what is required, and have few poses more."""

import numpy as np
import pytest

from sceneloom.geometry.rigid import angle_between, interpolate_poses, quaternion_from_rotation_vector, thin_poses

STEP_NS = 5_000_000
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-3, np.radians(0.01)
NEARLY = 1 + 1e-6  # two slerps of nearly one axis do not differ quite linearly between two poses


def dense_path(positions: np.ndarray, rotation_vectors: np.ndarray):
    """A path with a pose every 5 ms."""
    return np.arange(len(positions)) * STEP_NS, positions, quaternion_from_rotation_vector(rotation_vectors)


def straight_path(count: int):
    return dense_path(np.outer(np.arange(count), [0.1, 0.02, 0.0]), np.zeros((count, 3)))


def winding_path(count: int):
    s = np.arange(count) * 0.005
    positions = np.column_stack([10 * s, 2 * np.sin(s), 0.1 * np.cos(3 * s)])
    return dense_path(positions, np.column_stack([0 * s, 0.02 * np.sin(5 * s), 0.4 * np.sin(s)]))


def trembling_path(count: int):
    rng = np.random.default_rng(0)
    return dense_path(rng.normal(0, 0.01, (count, 3)), rng.normal(0, 0.01, (count, 3)))


def deviation(dense, required_ns, extra) -> tuple[float, float]:
    """Largest distance [m] and angle of the thinned path from the dense one, looked at five times per step."""
    times, positions, quaternions = dense
    knots_ns = np.union1d(required_ns, times[extra])
    knots = interpolate_poses(times, positions, quaternions, knots_ns, reach_ns=10**12)[:2]
    queries = np.arange(max(required_ns.min(), times[0]), min(required_ns.max(), times[-1]) + 1, STEP_NS // 5)
    thin, true = (
        interpolate_poses(knots_ns, *knots, queries),
        interpolate_poses(times, positions, quaternions, queries),
    )
    return np.linalg.norm(thin[0] - true[0], axis=1).max(), angle_between(thin[1], true[1]).max()


@pytest.mark.parametrize("make", [straight_path, winding_path, trembling_path])
@pytest.mark.parametrize("every", [1, 20, 333])
def test_the_thinned_path_stays_within_the_tolerances(make, every):
    dense = make(2000)
    required = dense[0][::every] + 1_234_567  # a camera's times lie between the poses, the last beyond them
    extra = thin_poses(*dense, required)
    distance, angle = deviation(dense, required, extra)
    assert distance <= POSITION_TOLERANCE * NEARLY
    assert angle <= ROTATION_TOLERANCE * NEARLY


def test_a_straight_drive_needs_no_further_poses():
    dense = straight_path(5000)
    assert len(thin_poses(*dense, dense[0][[0, -1]])) == 0


def test_a_corner_is_kept_and_only_the_corner():
    along = np.minimum(np.arange(1001), 500.0)
    across = np.maximum(np.arange(1001) - 500.0, 0.0)
    dense = dense_path(np.column_stack([along, across, 0 * along]) * 0.1, np.zeros((1001, 3)))
    assert thin_poses(*dense, dense[0][[0, -1]]).tolist() == [500]


def test_a_switch_on_the_spot_is_kept_though_nothing_moves():
    yaw = np.abs(np.arange(401) - 200) * 0.001
    dense = dense_path(np.zeros((401, 3)), np.outer(yaw, [0, 0, 1]))
    assert thin_poses(*dense, dense[0][[0, -1]]).tolist() == [200]


def test_a_smooth_curve_needs_about_as_few_poses_as_the_theory_says():
    radius, speed, count = 50.0, 10.0, 4001
    angle = np.arange(count) * 0.005 * speed / radius
    positions = radius * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    dense = dense_path(positions, np.zeros((count, 3)))
    sagitta_angle = 2 * np.sqrt(2 * POSITION_TOLERANCE / radius)  # chord whose arc bulges by the tolerance
    fewest = angle[-1] / sagitta_angle
    extra = thin_poses(*dense, dense[0][[0, -1]])
    assert fewest * 0.9 < len(extra) < fewest * 2.1  # halving lands at most one halving below the best length


def test_poses_at_required_times_and_outside_them_are_not_repeated():
    dense = trembling_path(100)
    required = dense[0][20:80:10]
    extra = thin_poses(*dense, required)
    assert extra.min() > 20
    assert extra.max() < 70
    assert not np.isin(dense[0][extra], required).any()
    assert (np.diff(extra) > 0).all()


def test_wider_tolerances_need_fewer_poses():
    dense = winding_path(2000)
    ends = dense[0][[0, -1]]
    fine = thin_poses(*dense, ends)
    coarse = thin_poses(*dense, ends, position_tolerance=0.05, rotation_tolerance=np.radians(1))
    assert 0 < len(coarse) < len(fine) < 2000


def test_required_times_come_in_any_order_and_more_than_once():
    dense = winding_path(500)
    required = dense[0][::50]
    shuffled = np.random.default_rng(0).permutation(np.repeat(required, 2))
    assert np.array_equal(thin_poses(*dense, shuffled), thin_poses(*dense, required))


def test_without_required_times_the_ends_of_the_path_count_as_required():
    dense = winding_path(500)
    assert np.array_equal(thin_poses(*dense, np.zeros(0, np.int64)), thin_poses(*dense, dense[0][[0, -1]]))


def test_paths_of_one_and_two_poses_need_nothing_more():
    for count in (1, 2):
        dense = trembling_path(count)
        assert len(thin_poses(*dense, np.array([-7, 3, 10**10]))) == (1 if count == 2 else 0)
        assert len(thin_poses(*dense, dense[0])) == 0


def test_a_staircase_of_ever_larger_steps_is_split_in_few_levels():
    count = 20_000
    positions = np.zeros((count, 3))
    positions[:, 0] = np.exp(np.linspace(0, 12, count)) * (np.arange(count) % 2)  # the worst pose is always the last
    dense = dense_path(positions, np.zeros((count, 3)))
    distance, _ = deviation(dense, dense[0][[0, -1]], thin_poses(*dense, dense[0][[0, -1]]))
    assert distance <= POSITION_TOLERANCE * NEARLY
