"""The map of surfaces against NumPy's own means, spreads and eigenvectors."""

import numpy as np

from sceneloom.motion.odometry import SurfaceLevel

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


def test_a_level_scan_line_informs_about_nothing_and_a_pole_about_both_of_its_sides():
    heights = np.linspace(0.05, 1.95, 12)
    pole = np.column_stack([np.full(12, 1.0), np.full(12, 1.0), heights])
    assert (level_of(pole[:, [2, 0, 1]]).surfaces[0, 3:9] == 0.0).all()
    information = square(level_of(pole).surfaces[0, 3:9])
    np.testing.assert_allclose(np.diag(information)[:2], 1 / NOISE**2, rtol=1e-6)
    assert abs(information[2, 2]) < 1e-6


def test_a_cube_with_few_points_informs_about_nothing():
    assert (level_of(tilted_patch(np.array([0.0, 0.0, 1.0]), count=4)).surfaces[0, 3:9] == 0.0).all()


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
