import math

import numpy as np
import pytest

from sceneloom.kernels.projection import map_directions

ROTATION = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA_FROM_WORLD = np.column_stack([ROTATION, [0.3, -0.2, 1.1]])


def mapped(points_world, point_ids=None, camera_from_world=CAMERA_FROM_WORLD):
    ids = np.arange(len(points_world)) if point_ids is None else np.array(point_ids, np.int64)
    directions, inverse_ranges = np.full((2, len(ids)), 7, np.float32), np.full(len(ids), 7, np.float32)
    map_directions(np.array(points_world, np.float64), ids, camera_from_world, directions, inverse_ranges)
    return directions, inverse_ranges


def mapped_one_by_one(points_world):
    """Lambert's map by its definition: at the azimuth of the point, twice the sine of half its angle off the axis."""
    rows = []
    for point in points_world:
        x, y, z = ROTATION @ point + CAMERA_FROM_WORLD[:, 3]
        angle, azimuth = math.atan2(math.hypot(x, y), z), math.atan2(y, x)
        radius = 2 * math.sin(angle / 2)
        rows.append((radius * math.cos(azimuth), radius * math.sin(azimuth), 1 / math.hypot(x, y, z)))
    return np.array(rows).T


def test_directions_are_lamberts_map_of_the_sphere():
    points = np.random.default_rng(0).normal(size=(2000, 3)) * 30
    right, down, inverse = mapped_one_by_one(points)
    directions, inverse_ranges = mapped(points)
    # Float32 keeps 6e-8 of each; range + depth cancels behind the camera, and loses digits there.
    np.testing.assert_allclose(directions, [right, down], atol=2e-5)
    ahead = np.hypot(right, down) < math.sqrt(2)
    np.testing.assert_allclose(directions[:, ahead], [right[ahead], down[ahead]], atol=5e-7)
    np.testing.assert_allclose(inverse_ranges, inverse, rtol=1e-6)


def test_more_points_than_one_block_are_all_mapped():
    points = np.random.default_rng(1).normal(size=(1025, 3))
    directions, _ = mapped(points)
    alone = np.column_stack([mapped(points, [i])[0] for i in (0, 511, 512, 1023, 1024)])
    np.testing.assert_array_equal(directions[:, [0, 511, 512, 1023, 1024]], alone)


def test_only_the_points_asked_for_are_mapped_and_in_that_order():
    points = np.random.default_rng(2).normal(size=(9, 3))
    np.testing.assert_array_equal(mapped(points, [5, 2])[0], mapped(points)[0][:, [5, 2]])


@pytest.mark.parametrize(
    "point", [(math.nan, 0, 0), (0, math.inf, 0), (-1.1, 0.3, -0.2), (1e200, 0, 0)], ids=str
)
def test_a_point_without_direction_has_inverse_range_zero(point):
    directions, inverse_ranges = mapped([point])
    assert directions.tolist() == [[0], [0]]
    assert inverse_ranges.tolist() == [0]


@pytest.mark.parametrize("missing", [-1, 1, 2**62, -(2**63)])
def test_a_point_that_does_not_exist_has_inverse_range_zero(missing):
    assert mapped([(5, 0, 0)], [missing])[1].tolist() == [0]


def test_a_point_straight_behind_the_camera_stays_inside_the_map():
    directions, inverse_ranges = mapped([(-9.1, 0.3, -0.2), (-9.1, 0.3 + 1e-7, -0.2)])
    assert np.isfinite(directions).all()
    assert np.hypot(*directions).max() <= 2.0001
    np.testing.assert_allclose(inverse_ranges, 1 / 8, rtol=1e-6)
