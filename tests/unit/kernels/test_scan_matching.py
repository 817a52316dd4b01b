"""Moving points and their normal equations against slow formulas and finite differences."""

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.kernels.scan_matching import accumulate_normal_equations, move_points, thin_points
from sceneloom.motion.odometry import LocalMap

YAW_RATE, VELOCITY = np.array([0.05, -0.1, 0.8]), np.array([9.0, 2.0, -0.3])


def moved(points, seconds, rotation, position, yaw_rate, velocity):
    """World points and arms by SciPy's rotations."""
    rotated = Rotation.from_rotvec(seconds[:, None] * yaw_rate) * Rotation.from_matrix(rotation)
    arms = rotated.apply(points)
    bend = 0.5 * seconds[:, None] ** 2 * np.cross(yaw_rate, velocity)
    return position + seconds[:, None] * velocity + bend + arms, arms


def random_sweep(count=200):
    generator = np.random.default_rng(1)
    return generator.uniform(-30, 30, (count, 3)), generator.uniform(-0.05, 0.05, count)


def test_points_move_with_the_rotating_ego():
    points, seconds = random_sweep()
    rotation, position = Rotation.from_rotvec([0.1, 0.2, -0.5]).as_matrix(), np.array([5.0, -3.0, 1.0])
    world, arms = np.empty_like(points), np.empty_like(points)
    move_points(points, seconds, rotation, position, YAW_RATE, VELOCITY, world, arms)
    expected = moved(points, seconds, rotation, position, YAW_RATE, VELOCITY)
    np.testing.assert_allclose(world, expected[0], atol=1e-9)
    np.testing.assert_allclose(arms, expected[1], atol=1e-9)


def test_one_point_of_each_cube_is_chosen_the_first():
    points, _ = random_sweep(2000)
    points *= 0.2
    chosen = np.empty(len(points), np.int64)
    count = thin_points(points, 1.0, chosen)
    _, first = np.unique(np.floor(points), axis=0, return_index=True)
    np.testing.assert_array_equal(chosen[:count], np.sort(first))


def equations(local_map, points, seconds, change, scale):
    """Information, gradient and Σ w s² after a small rotation and shift of the ego, and changes of their rates."""
    rotation = Rotation.from_rotvec(change[:3]).as_matrix()
    world, arms = moved(points, seconds, rotation, change[3:6], YAW_RATE + change[6:9], VELOCITY + change[9:])
    information, gradient, sums = np.empty((3, 6, 6)), np.empty((2, 6)), np.empty(4)
    levels = [
        x
        for level in (local_map.fine, local_map.coarse)
        for x in (level.leaf, level.table, level.keys, level.surfaces)
    ]
    accumulate_normal_equations(world, arms, seconds, scale, *levels, information, gradient, sums)
    return information, gradient, sums


def test_the_gradient_is_that_of_half_the_squared_error():
    generator = np.random.default_rng(2)
    ground = np.column_stack([generator.uniform(-30, 30, (60_000, 2)), generator.normal(-1.0, 0.01, 60_000)])
    local_map = LocalMap(1.0, 0.02)
    local_map.insert(ground)
    points = np.column_stack([generator.uniform(-20, 20, (300, 2)), np.full(300, -0.99)])
    seconds = np.zeros(300)
    scale = 1e6  # every weight is that of where the surface lies, so that the error is a sum of squares
    _, gradient, _ = equations(local_map, points, seconds, np.zeros(12), scale)
    step = 1e-6
    for axis in (0, 1, 5):  # roll, pitch and height: what a level ground reports
        change = np.zeros(12)
        change[axis] = step
        ahead, behind = (
            equations(local_map, points, seconds, sign * change, scale)[2][2] for sign in (1, -1)
        )
        assert np.isclose(gradient[0, axis], (ahead - behind) / (4 * step), rtol=0.02)


def test_level_ground_states_nothing_about_the_trajectory_along_it():
    generator = np.random.default_rng(2)
    ground = np.column_stack([generator.uniform(-30, 30, (60_000, 2)), np.full(60_000, -1.0)])
    local_map = LocalMap(1.0, 0.02)
    local_map.insert(ground)
    points, seconds = generator.uniform(-20, 20, (300, 3)), np.zeros(300)
    points[:, 2] = -1.0
    information, _, sums = equations(local_map, points, seconds, np.zeros(12), 3.0)
    assert sums[0] == 300
    assert np.abs(information[0][3:5, 3:5]).max() < 1e-9 * information[0][5, 5]
    assert abs(information[0][2, 2]) < 1e-9 * information[0][0, 0]
