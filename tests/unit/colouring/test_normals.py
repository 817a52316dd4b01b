"""Normals of surfaces out of the points of one sweep."""

import numpy as np

from sceneloom.colouring import estimate_normals


def test_planes_have_their_normals_near_and_far():
    random = np.random.default_rng(1)
    normal = np.array([0.36, 0.48, 0.8])
    axes = np.linalg.svd(normal[None])[2][1:]
    for distance in (5.0, 40.0):
        flat = random.uniform(-2, 2, (4000, 2)) @ axes + distance * normal
        found = estimate_normals(flat + 0.01 * random.normal(size=flat.shape), np.zeros(3))
        known = np.linalg.norm(found, axis=1) > 0
        assert known.mean() > 0.7
        # noise of 1 cm over cubes of 0.4 m and more rotates a plane by a few degrees
        assert np.median(np.abs(found[known] @ normal)) > np.cos(np.radians(4))


def test_lines_single_points_and_points_that_are_not_finite_have_none():
    line = np.column_stack([np.linspace(0, 0.3, 50), np.zeros(50), np.full(50, 5.0)])
    alone = np.array([[30.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    assert (estimate_normals(np.concatenate([line, alone]), np.zeros(3)) == 0).all()
    assert estimate_normals(np.zeros((0, 3)), np.zeros(3)).shape == (0, 3)
