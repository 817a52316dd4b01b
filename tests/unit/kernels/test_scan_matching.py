"""Moving points and their normal equations against slow formulas and finite differences.

The map of surfaces against NumPy's own means, spreads and eigenvectors.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.motion.odometry import LocalMap, SurfaceLevel, accumulate_normal_equations, move_points

YAW_RATE, VELOCITY = np.array([0.05, -0.1, 0.8]), np.array([9.0, 2.0, -0.3])


def moved(points, seconds, rotation, position, yaw_rate, velocity):
    """World points and arms by SciPy's rotations."""
    rotated = Rotation.from_rotvec(seconds[:, None] * yaw_rate) * Rotation.from_matrix(rotation)
    arms = rotated.apply(points)
    bend = 0.5 * seconds[:, None] ** 2 * np.cross(yaw_rate, velocity)
    return position + seconds[:, None] * velocity + bend + arms, arms


def test_points_move_with_the_rotating_ego():
    generator = np.random.default_rng(1)
    points, seconds = generator.uniform(-30, 30, (200, 3)), generator.uniform(-0.05, 0.05, 200)
    rotation, position = Rotation.from_rotvec([0.1, 0.2, -0.5]).as_matrix(), np.array([5.0, -3.0, 1.0])
    found = np.empty_like(points), np.empty_like(points)
    move_points(points, seconds, rotation, position, YAW_RATE, VELOCITY, *found)
    np.testing.assert_allclose(found, moved(points, seconds, rotation, position, YAW_RATE, VELOCITY), atol=1e-9)


def equations(local_map, points, seconds, change, scale):
    """Information, gradient and Σ w s² after a small rotation and shift of the ego, and changes of their rates."""
    rotation = Rotation.from_rotvec(change[:3]).as_matrix()
    world, arms = moved(points, seconds, rotation, change[3:6], YAW_RATE + change[6:9], VELOCITY + change[9:])
    information, gradient, sums = np.empty((3, 6, 6)), np.empty((2, 6)), np.empty(4)
    levels = [x for level in local_map.levels for x in (level.leaf, level.table, level.keys, level.surfaces)]
    accumulate_normal_equations(world, arms, seconds, scale, *levels, information, gradient, sums)
    return information, gradient, sums


def on_ground(noise, z):
    """A map of level ground, and points above it."""
    generator = np.random.default_rng(2)
    local_map = LocalMap(1.0, 0.02)
    local_map.insert(np.column_stack([generator.uniform(-30, 30, (60_000, 2)), generator.normal(-1.0, noise, 60_000)]))
    return local_map, np.column_stack([generator.uniform(-20, 20, (300, 2)), np.full(300, z)]), np.zeros(300)


def test_the_gradient_is_that_of_half_the_squared_error():
    cloud, scale, step = on_ground(0.01, -0.99), 1e6, 1e-6
    # every weight is that of where the surface lies, so that the error is a sum of squares
    _, gradient, _ = equations(*cloud, np.zeros(12), scale)
    for axis in (0, 1, 5):  # roll, pitch and height: what a level ground reports
        change = step * (np.arange(12) == axis)
        ahead, behind = (equations(*cloud, sign * change, scale)[2][2] for sign in (1, -1))
        assert np.isclose(gradient[0, axis], (ahead - behind) / (4 * step), rtol=0.02)


def test_level_ground_states_nothing_about_the_trajectory_along_it():
    information, _, sums = equations(*on_ground(0.0, -1.0), np.zeros(12), 3.0)
    assert sums[0] == 300
    assert np.abs(information[0][3:5, 3:5]).max() < 1e-9 * information[0][5, 5]
    assert abs(information[0][2, 2]) < 1e-9 * information[0][0, 0]


NOISE = 0.02


def level_of(points: np.ndarray, leaf: float = 2.0) -> SurfaceLevel:
    level = SurfaceLevel(leaf, NOISE)
    level.insert(np.ascontiguousarray(points, dtype=np.float64))
    return level


def square(xx_xy_xz_yy_yz_zz: np.ndarray) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = xx_xy_xz_yy_yz_zz
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def tilted_patch(normal: np.ndarray, count: int = 50) -> np.ndarray:
    """Points in the cube from 0 to 2 m, on a plane through its middle, one in each part at most."""
    generator = np.random.default_rng(3)
    basis = np.linalg.svd(normal[None])[2][1:]
    spots = generator.uniform(-0.9, 0.9, (4000, 2))
    points = 1.0 + spots @ basis + generator.normal(0, 0.01, (4000, 1)) * normal
    points = points[((points > 0) & (points < 2)).all(axis=1)]
    _, first = np.unique((points / 0.5).astype(int), axis=0, return_index=True)
    return points[first][:count]


def test_a_flat_cube_informs_across_its_plane_alone_by_the_spread_there():
    normal = np.array([0.6, 0.0, 0.8])
    points = tilted_patch(normal)
    level = level_of(points)
    assert level.count == 1
    np.testing.assert_allclose(level.surfaces[0, :3], points.mean(axis=0), atol=1e-12)
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    share = 1.0 - values[0] / (0.1 * values[2])
    expected = share / (values[0] + NOISE**2) * np.outer(vectors[:, 0], vectors[:, 0])
    np.testing.assert_allclose(square(level.surfaces[0, 3:9]), expected, atol=1e-6)
    along = sum(np.outer(vectors[:, k], vectors[:, k]) / values[k] for k in (1, 2))
    np.testing.assert_allclose(square(level.surfaces[0, 9:]), along, atol=1e-6)


def test_a_level_scan_line_or_few_points_inform_about_nothing_and_a_pole_about_both_of_its_sides():
    pole = np.column_stack([np.full(12, 1.0), np.full(12, 1.0), np.linspace(0.05, 1.95, 12)])
    for points in (pole[:, [2, 0, 1]], tilted_patch(np.array([0.0, 0.0, 1.0]), count=4)):
        assert (level_of(points).surfaces[0, 3:9] == 0.0).all()
    information = square(level_of(pole).surfaces[0, 3:9])
    np.testing.assert_allclose(np.diag(information)[:2], 1 / NOISE**2, rtol=1e-6)
    assert abs(information[2, 2]) < 1e-6


def test_a_full_part_of_a_cube_stays_as_it_was_measured_first():
    points = tilted_patch(np.array([0.0, 0.0, 1.0]))
    level = level_of(points)
    for _ in range(5):
        level.insert(points + 0.001)
    before = level.surfaces[0].copy()
    level.insert(points + 0.01)
    np.testing.assert_array_equal(level.surfaces[0], before)


def test_the_map_grows_by_cubes_and_forgets_those_far_away():
    generator = np.random.default_rng(5)
    points = generator.uniform(-200.0, 200.0, (120_000, 3))
    points[:, 2] *= 0.05
    level = level_of(points, leaf=1.0)
    cubes = np.unique(np.floor(points), axis=0)
    assert level.count == len(cubes)
    level.drop_beyond(np.zeros(3), 50.0)
    assert level.count == (((cubes + 0.5) ** 2).sum(axis=1) <= 50.0**2).sum()
    count = level.count
    level.insert(np.ascontiguousarray(cubes[((cubes + 0.5) ** 2).sum(axis=1) <= 49.0**2] + 0.5))
    assert level.count == count
