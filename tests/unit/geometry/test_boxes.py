"""Corners of boxes and the points inside them."""

import numpy as np
from scipy.spatial.transform import Rotation

from sceneloom.geometry.boxes import EDGES, box_corners, points_in_box

NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


def test_corners_come_bottom_first_from_the_front_left_counter_clockwise():
    corners = box_corners((10, 20, 30), (4, 2, 1.5), NO_ROTATION)
    bottom = [(12, 21, 29.25), (8, 21, 29.25), (8, 19, 29.25), (12, 19, 29.25)]
    assert np.allclose(corners, [*bottom, *np.add(bottom, (0, 0, 1.5))])
    corners = box_corners((0, 0, 0), (4, 2, 1), Rotation.from_euler("z", 90, degrees=True).as_quat())
    assert np.allclose(corners[[0, 3], 1], 2.0)  # rotated left, the front corners lie 2 m to the left


def test_edges_join_neighbours_only():
    corners = box_corners((1, 2, 3), (4, 2, 1), Rotation.from_rotvec([0.3, 0.2, 1]).as_quat())
    lengths = [np.linalg.norm(corners[a] - corners[b]) for a, b in EDGES]
    assert np.allclose(sorted(lengths), [1] * 4 + [2] * 4 + [4] * 4)
    assert len({frozenset(edge) for edge in EDGES}) == 12


def test_many_boxes_at_once_give_what_each_gives_alone():
    rng = np.random.default_rng(0)
    centers, sizes, rotations = rng.normal(size=(5, 3)), rng.uniform(1, 5, (5, 3)), rng.normal(size=(5, 4))
    together = box_corners(centers, sizes, rotations)
    assert together.shape == (5, 8, 3)
    for k in range(5):
        assert np.allclose(together[k], box_corners(centers[k], sizes[k], rotations[k]))


def test_points_inside_are_those_between_all_six_faces():
    rng = np.random.default_rng(1)
    rotation, center, size = (Rotation.from_rotvec([0.2, -0.5, 2]), np.array([5.0, -3, 1]), np.array([4.0, 2, 1.5]))
    points = center + rng.uniform(-3, 3, (2000, 3))
    rows = rotation.as_matrix().T  # each row is one of the box's axes
    expected = [
        all(abs(sum(a * d for a, d in zip(rows[k], point - center, strict=True))) <= size[k] / 2 for k in range(3))
        for point in points
    ]
    found = points_in_box(points, center, size, rotation.as_quat())
    assert found.tolist() == expected
    assert 50 < found.sum() < 1950


def test_faces_belong_to_the_box_a_margin_widens_it_and_missing_coordinates_lie_in_none():
    points = [(2, 0, 0), (2.0001, 0, 0), (0, 0, -0.5), (2.1, 0, 0), (np.nan, 0, 0), (0, np.nan, 0), (0, 0, np.nan)]
    for margin, inside in ((0.0, [True, False, True]), (0.05, [True, True, True])):
        found = points_in_box(points, (0, 0, 0), (4, 2, 1), NO_ROTATION, margin=margin)
        assert found.tolist() == [*inside, False, False, False, False]
