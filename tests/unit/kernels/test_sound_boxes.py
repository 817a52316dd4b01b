import numpy as np

from sceneloom.kernels.sound_boxes import boxes_with_area, boxes_with_place

ODD = (0.0, -1.0, np.nan, np.inf, -np.inf)


def test_boxes_have_a_place_where_all_numbers_are_finite_and_sizes_above_0():
    numbers = np.ones((1 + 7 * len(ODD), 7))
    for k, (column, value) in enumerate((column, value) for column in range(7) for value in ODD):
        numbers[k + 1, column] = value
    expected = np.isfinite(numbers).all(axis=1) & (numbers[:, 3:6] > 0).all(axis=1)
    parts = (np.ascontiguousarray(numbers[:, part]) for part in (slice(0, 3), slice(3, 6), 6))
    boxes, rows = boxes_with_place(*parts)
    np.testing.assert_array_equal(rows, np.flatnonzero(expected))
    np.testing.assert_array_equal(boxes, numbers[expected])
    assert 0 < expected.sum() < len(expected)


def test_boxes_have_an_area_where_all_edges_are_finite_and_in_order():
    corners = np.tile([10.0, 20, 30, 40], (1 + 4 * 6, 1))
    for k, (column, value) in enumerate((column, value) for column in range(4) for value in (*ODD, 30.0)):
        corners[k + 1, column] = value
    expected = np.isfinite(corners).all(axis=1) & (corners[:, 2:] > corners[:, :2]).all(axis=1)
    boxes, rows = boxes_with_area(corners)
    np.testing.assert_array_equal(rows, np.flatnonzero(expected))
    np.testing.assert_array_equal(boxes, corners[expected])
    assert 0 < expected.sum() < len(expected)
