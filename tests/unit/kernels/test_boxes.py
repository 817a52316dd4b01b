"""Points in boxes and cones, against plain formulas for every pair."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneloom.detections.projection import points_in_cones
from sceneloom.kernels.boxes import find_points_in_boxes


def a_crowd(seed, *, boxes=40, points=3_000, spread=20.0, knots=1, dtype=np.float64):
    generator = np.random.default_rng(seed)
    first = generator.uniform(-spread, spread, (boxes, 3)) * [1.0, 1.0, 0.1]
    centers = first + np.arange(knots)[:, None, None] * generator.uniform(-1.0, 1.0, (boxes, 3))
    start = Rotation.from_rotvec(np.tile(generator.uniform(-2, 2, (boxes, 3)), (knots, 1)))
    swing = np.repeat(np.arange(knots), boxes)[:, None] * np.tile([0.0, 0.0, 0.05], (knots * boxes, 1))
    rotations = (Rotation.from_rotvec(swing) * start).as_matrix()
    halves = np.tile(generator.uniform(0.2, 3.0, (1, boxes, 3)), (knots, 1, 1))
    cloud = generator.uniform(-1.1 * spread, 1.1 * spread, (points, 3)) * [1.0, 1.0, 0.15]
    return cloud.astype(dtype), centers, np.ascontiguousarray(rotations.reshape(knots, boxes, 3, 3)), halves


def inside_one_by_one(points, locations, centers, rotations, halves):
    """Every pair by the formula: (N, B) bool."""
    after = np.minimum(locations.astype(int) + 1, len(centers) - 1)
    before, share = locations.astype(int), locations - locations.astype(int)
    inside = np.zeros((len(points), centers.shape[1]), bool)
    for n, point in enumerate(points.astype(np.float64)):
        k, j, s = before[n], after[n], share[n]
        center = (1 - s) * centers[k] + s * centers[j]
        axes = (1 - s) * rotations[k] + s * rotations[j]
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        half = (1 - s) * halves[k] + s * halves[j]
        local = np.einsum("bji,bj->bi", axes, point - center)
        inside[n] = (np.abs(local) <= half).all(axis=1)
    return inside


def counted(points, locations, *boxes):
    counts = np.zeros(boxes[0].shape[1], np.int64)
    find_points_in_boxes(points, locations, *boxes, counts, np.zeros(0, np.int64))
    return counts


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("seed", "spread"), [(0, 20.0), (1, 3.0), (2, 4000.0)])
def test_counts_and_lists_are_those_of_every_pair(seed, spread, dtype):
    points, *boxes = a_crowd(seed, spread=spread, dtype=dtype)
    expected = inside_one_by_one(points, np.zeros(len(points)), *boxes)
    counts = counted(points, np.zeros(0), *boxes)
    np.testing.assert_array_equal(counts, expected.sum(axis=0))
    starts = np.cumsum(counts) - counts
    listed, stops = np.full(max(1, counts.sum()), -1), starts.copy()
    find_points_in_boxes(points, np.zeros(0), *boxes, stops, listed)
    for b, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        np.testing.assert_array_equal(listed[start:stop], np.flatnonzero(expected[:, b]))


def test_boxes_that_move_are_met_where_they_are_when_a_point_is_measured():
    points, *boxes = a_crowd(3, knots=4, spread=8.0)
    locations = np.random.default_rng(4).uniform(0.0, 3.0, len(points))
    counts = counted(points, locations, *boxes)
    assert counts.sum() > 100
    np.testing.assert_array_equal(counts, inside_one_by_one(points, locations, *boxes).sum(axis=0))


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([[1.0, 0, 0], [0, -1, 0], [1, 1, 1], [1 + 1e-9, 0, 0]], 3),  # faces belong to it
        ([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, np.nan], [0, 0, 0]], 1),
    ],
)
def test_points_on_faces_count_and_those_that_are_not_finite_do_not(points, expected):
    centers, halves = np.array([[[0.0, 0, 0], [1e7, -1e7, 0]]]), np.array([[[1.0, 1, 1], [0.0, 0, 0]]])
    rotations = np.tile(np.eye(3), (1, 2, 1, 1))
    assert counted(np.array(points), np.zeros(0), centers, rotations, halves).tolist() == [expected, 0]


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
    for points, axes in ((np.ones((5, 3)), np.zeros((0, 3))), (np.zeros((0, 3)), np.eye(3))):
        assert len(points_in_cones(points.astype(np.float32), np.zeros(3), axes, np.full(len(axes), 0.5))) == 0
