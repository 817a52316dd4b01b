"""Tests of the choice of points in cones, against angles by arc cosines."""

import numpy as np

from sceneloom.kernels.boxes import points_in_cones


def test_points_whose_angle_to_an_axis_is_small_enough_are_chosen():
    random = np.random.default_rng(3)
    points = random.normal(0.0, 10.0, (2000, 3)).astype(np.float32)
    points[:3] = np.nan, np.inf, -np.inf
    apex, axes = np.array([1.0, -2.0, 0.5]), random.normal(size=(4, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    angles = np.array([0.1, 0.4, 0.8, 1.2])
    with np.errstate(invalid="ignore"):
        lines = points - apex
        cosines = (lines @ axes.T) / np.linalg.norm(lines, axis=1)[:, None]
        inside = (np.arccos(cosines.clip(-1.0, 1.0)) <= angles).any(axis=1)
    found = points_in_cones(points, apex, axes, np.cos(angles))
    np.testing.assert_array_equal(found, np.flatnonzero(inside))
    assert 0 < len(found) < 2000


def test_without_cones_or_points_there_are_none():
    none = np.zeros((0, 3))
    assert len(points_in_cones(np.ones((5, 3), np.float32), np.zeros(3), none, np.zeros(0))) == 0
    assert len(points_in_cones(none.astype(np.float32), np.zeros(3), np.eye(3), np.full(3, 0.5))) == 0
