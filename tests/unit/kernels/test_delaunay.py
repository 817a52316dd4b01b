"""Triangulation against SciPy's, and against what a triangulation is."""

import numpy as np
import pytest
from scipy.spatial import Delaunay

from sceneloom.colouring.depth_completion import triangles_between
from sceneloom.kernels.delaunay import MOST_EXTENT, hilbert_codes, triangulate


def triangulated(inner, extent=1000):
    corners = [[-extent, -extent], [2 * extent, -extent], [2 * extent, 2 * extent], [-extent, 2 * extent]]
    points = np.concatenate([np.array(corners, np.int64), np.asarray(inner, np.int64).reshape(-1, 2)])
    triangles = np.empty((2 * len(points), 3), np.int32)
    count = triangulate(points, np.arange(4, len(points)), triangles)
    return points, triangles[:count]


def doubled_areas(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


@pytest.mark.parametrize("seed", range(4))
def test_triangles_are_those_of_scipy_where_no_four_points_lie_on_a_circle(seed):
    random = np.random.default_rng(seed)
    inner = np.unique(random.integers(0, 1000, (300, 2)), axis=0)
    random.shuffle(inner)
    points, triangles = triangulated(inner)
    ours = {tuple(sorted(triangle)) for triangle in triangles.tolist()}
    theirs = Delaunay(points.astype(float))
    # points on one circle may be joined either way; with whole coordinates a few are
    shared = ours & {tuple(sorted(triangle)) for triangle in theirs.simplices.tolist()}
    assert len(ours) == len(theirs.simplices)
    assert len(shared) > 0.97 * len(ours)


@pytest.mark.parametrize("kind", ["grid", "lines", "circle", "one line", "same point twice", "one", "none"])
def test_no_circumcircle_holds_another_point_and_no_location_is_left_out(kind):
    rotation_of_vector = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    inner = {
        "grid": np.stack(np.meshgrid(np.arange(0, 100, 10), np.arange(0, 100, 10)), -1).reshape(-1, 2),
        "lines": np.array([[2 * k, 10 * line + k % 2] for line in range(4) for k in range(20)]),
        "circle": np.rint(500 + 400 * np.stack([np.cos(rotation_of_vector), np.sin(rotation_of_vector)], 1)),
        "one line": np.array([[10 * k, 50] for k in range(20)]),
        "same point twice": np.array([[5, 5], [9, 3], [5, 5], [2, 8], [9, 3]]),
        "one": np.array([[7, 7]]),
        "none": np.zeros((0, 2)),
    }[kind]
    points, triangles = triangulated(inner)
    areas = doubled_areas(points, triangles)
    assert (areas > 0).all()
    assert areas.sum() == 2 * 3000 * 3000
    distinct = len(np.unique(np.asarray(inner).reshape(-1, 2), axis=0))
    assert len(triangles) == 2 + 2 * distinct
    for triangle in triangles:
        matrix = points[triangle].astype(object)
        for point in points.astype(object):
            rows = [[x - point[0], y - point[1]] for x, y in matrix]
            (ax, ay), (bx, by), (cx, cy) = rows
            a, b, c = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
            assert ax * (by * c - cy * b) - ay * (bx * c - cx * b) + a * (bx * cy - cx * by) <= 0


def test_numbers_stay_exact_at_the_largest_extent():
    side = MOST_EXTENT // 3
    random = np.random.default_rng(0)
    inner = np.concatenate([random.integers(0, side, (200, 2)), [[0, 0], [side, 0], [side, side], [0, side]]])
    points, triangles = triangulated(inner, side)
    assert doubled_areas(points, triangles).sum() == 2 * (3 * side) ** 2


def test_the_curve_goes_through_every_location_once_in_single_steps():
    side = 32
    locations = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2).astype(np.int64)
    codes = np.empty(len(locations), np.int64)
    hilbert_codes(locations, codes)
    assert len(set(codes.tolist())) == len(locations)
    steps = np.abs(np.diff(locations[np.argsort(codes)], axis=0)).sum(axis=1)
    assert (steps == 1).all()


def test_triangles_of_an_image_leave_out_what_lies_outside_the_hull():
    pixels = np.array([[10, 10], [50.5, 12], [30, 40.25]], np.float32)
    np.testing.assert_array_equal(np.sort(triangles_between(pixels, 60, 80)), [[0, 1, 2]])
    assert triangles_between(pixels[:2], 60, 80).shape == (0, 3)
