"""Overlaps of rotated boxes against outlines that Shapely intersects."""

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from sceneloom.detections.projection import points_in_cones
from sceneloom.kernels.boxes import find_points_in_boxes
from sceneloom.kernels.overlaps import overlaps_from_above, overlaps_in_space
from sceneloom.kernels.scores import best_columns

shapely = pytest.importorskip("shapely", reason="no shapely: pip install shapely")


def outline(box):
    x, y, _, length, width, _, yaw = box
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return shapely.Polygon(corners @ rotation.T + [x, y])


def expected(first, second):
    """Overlap from above and in space."""
    one, other = outline(first), outline(second)
    ground, top = one.intersection(other).area, min(first[2] + first[5] / 2, second[2] + second[5] / 2)
    bottom = max(first[2] - first[5] / 2, second[2] - second[5] / 2)
    room, volumes = ground * max(0.0, top - bottom), one.area * first[5] + other.area * second[5]
    return ground / (one.area + other.area - ground), room / (volumes - room)


def in_one_frame(first, second):
    first, second = np.array(first, float), np.array(second, float)
    starts = [np.array([0, count]) for count in (len(first), len(second), len(first) * len(second))]
    return [
        overlaps(first, second, *starts).reshape(len(first), -1)
        for overlaps in (overlaps_from_above, overlaps_in_space)
    ]


def some_boxes(rng, count):
    locations, sizes = rng.normal(0, 1.5, (count, 3)), rng.uniform(0.3, 5, (count, 3))
    return np.column_stack([locations, sizes, rng.uniform(-7, 7, count)])


def test_boxes_overlap_as_their_outlines_do_also_where_edges_touch_or_coincide():
    rng = np.random.default_rng(3)
    first, second = some_boxes(rng, 30), some_boxes(rng, 30)
    found = np.array(in_one_frame(first, second))
    reported = np.array([[expected(a, b) for b in second] for a in first]).transpose(2, 0, 1)
    assert 0.3 < (reported > 0).mean() < 0.9
    np.testing.assert_allclose(found, reported, rtol=0, atol=1e-9)  # sums of products of doubles
    for yaw in [0.0, np.pi / 2, np.pi, -np.pi / 2, 2 * np.pi, 1e-9, 0.3]:
        box = [[100.0, -50, 1, 4, 2, 1.5, yaw]]
        assert np.array(in_one_frame(box, box)).ravel() == pytest.approx([1, 1], abs=1e-12)
    for yaw in [0.0, np.pi / 2, np.pi, np.pi / 4]:
        first, second = [0.0, 0, 0, 4, 2, 1, 0.0], [[x, y, 0, 4, 2, 1, yaw] for x in range(5) for y in range(3)]
        above, _ = in_one_frame([first], second)
        np.testing.assert_allclose(above[0], [expected(first, box)[0] for box in second], rtol=0, atol=1e-9)  # as above


def test_boxes_of_one_frame_alone_are_held_against_each_other_and_those_without_a_size_overlap_nothing():
    above, space = in_one_frame([[0.0, 0, 0, 4, 2, 1, 0.5]], [[0.0, 0, 5, 4, 2, 1, 0.5]])
    assert (above[0, 0], space[0, 0]) == (pytest.approx(1), 0.0)
    flat = [[0.0, 0, 0, -1, -1, -1, 0], [0, 0, 0, 0, 2, 1, 0], [0, 0, 0, 4, 2, 0, 0]]
    above, space = in_one_frame([[0.0, 0, 0, 4, 2, 1, 0]], flat)
    assert above[0, :2].tolist() == [0, 0]
    assert not space.any()
    box = np.array([[0.0, 0, 0, 4, 2, 1, 0.2]] * 3)
    starts = (np.array([0, 1, 1, 3]), np.array([0, 2, 3, 3]), np.array([0, 2, 2, 2]))
    assert overlaps_from_above(box, box, *starts) == pytest.approx([1, 1])


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
        center, axes = (1 - s) * centers[k] + s * centers[j], (1 - s) * rotations[k] + s * rotations[j]
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        half = (1 - s) * halves[k] + s * halves[j]
        local = np.einsum("bji,bj->bi", axes, point - center)
        inside[n] = (np.abs(local) <= half).all(axis=1)
    return inside


def counted(points, locations, *boxes):
    counts = np.zeros(boxes[0].shape[1], np.int64)
    find_points_in_boxes(points, locations, *boxes, counts, np.zeros(0, np.int64))
    return counts


def test_counts_and_lists_are_those_of_every_pair_of_boxes_that_stand_or_move():
    for seed, spread in [(0, 20.0), (1, 3.0), (2, 4000.0)]:
        for dtype in [np.float32, np.float64]:
            points, *boxes = a_crowd(seed, spread=spread, dtype=dtype)
            expected = inside_one_by_one(points, np.zeros(len(points)), *boxes)
            counts = counted(points, np.zeros(0), *boxes)
            np.testing.assert_array_equal(counts, expected.sum(axis=0))
            starts = np.cumsum(counts) - counts
            listed, stops = np.full(max(1, counts.sum()), -1), starts.copy()
            find_points_in_boxes(points, np.zeros(0), *boxes, stops, listed)
            for b, (start, stop) in enumerate(zip(starts, stops, strict=True)):
                np.testing.assert_array_equal(listed[start:stop], np.flatnonzero(expected[:, b]))
    points, *boxes = a_crowd(3, knots=4, spread=8.0)
    locations = np.random.default_rng(4).uniform(0.0, 3.0, len(points))
    counts = counted(points, locations, *boxes)
    assert counts.sum() > 100
    np.testing.assert_array_equal(counts, inside_one_by_one(points, locations, *boxes).sum(axis=0))
    for points, expected in [
        ([[1.0, 0, 0], [0, -1, 0], [1, 1, 1], [1 + 1e-9, 0, 0]], 3),  # faces belong to it
        ([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, np.nan], [0, 0, 0]], 1),
    ]:
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
    for points, axes in ((np.ones((5, 3)), np.zeros((0, 3))), (np.zeros((0, 3)), np.eye(3))):
        assert len(points_in_cones(points.astype(np.float32), np.zeros(3), axes, np.full(len(axes), 0.5))) == 0


def check(gains):
    rows, columns = linear_sum_assignment(gains, maximize=True)
    paired = np.full(len(gains), -1)
    paired[rows] = columns
    assert best_columns(gains).tolist() == paired.tolist()


def test_rows_get_the_columns_that_scipy_gives_them():
    for kind in ["any", "whole numbers", "mostly none", "negative"]:
        rng = np.random.default_rng(1)
        for _ in range(150):
            gains = rng.random(rng.integers(0, 14, 2))
            if kind == "whole numbers":
                gains = np.round(3 * gains)
            elif kind == "mostly none":
                gains[gains < 0.7] = 0.0
            elif kind == "negative":
                gains -= 0.5
            check(gains)
    for shape in [(60, 80), (80, 60), (3, 0), (0, 3)]:
        check(np.random.default_rng(2).random(shape))
