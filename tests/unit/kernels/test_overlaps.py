"""Overlaps of rotated boxes against outlines that Shapely intersects."""

import numpy as np
import pytest

from sceneloom.kernels.overlaps import overlaps_from_above, overlaps_in_space

shapely = pytest.importorskip("shapely", reason="no shapely: pip install shapely")


def outline(box):
    x, y, _, length, width, _, yaw = box
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return shapely.Polygon(corners @ rotation.T + [x, y])


def expected(first, second):
    """Overlap from above and in space."""
    one, other = outline(first), outline(second)
    ground = one.intersection(other).area
    top = min(first[2] + first[5] / 2, second[2] + second[5] / 2)
    bottom = max(first[2] - first[5] / 2, second[2] - second[5] / 2)
    room = ground * max(0.0, top - bottom)
    volumes = one.area * first[5] + other.area * second[5]
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


def test_boxes_at_any_location_overlap_as_their_outlines_do():
    rng = np.random.default_rng(3)
    first, second = some_boxes(rng, 30), some_boxes(rng, 30)
    found = np.array(in_one_frame(first, second))
    reported = np.array([[expected(a, b) for b in second] for a in first]).transpose(2, 0, 1)
    assert 0.3 < (reported > 0).mean() < 0.9
    np.testing.assert_allclose(found, reported, rtol=0, atol=1e-9)  # sums of products of doubles


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, np.pi, -np.pi / 2, 2 * np.pi, 1e-9, 0.3])
def test_a_box_and_its_copy_are_one_however_they_are_rotated(yaw):
    box = [[100.0, -50, 1, 4, 2, 1.5, yaw]]
    assert np.array(in_one_frame(box, box)).ravel() == pytest.approx([1, 1], abs=1e-12)


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, np.pi, np.pi / 4])
def test_edges_that_touch_or_coincide_are_no_trouble(yaw):
    first, second = [0.0, 0, 0, 4, 2, 1, 0.0], [[x, y, 0, 4, 2, 1, yaw] for x in range(5) for y in range(3)]
    above, _ = in_one_frame([first], second)
    np.testing.assert_allclose(above[0], [expected(first, box)[0] for box in second], rtol=0, atol=1e-9)  # as above


def test_boxes_one_over_the_other_overlap_from_above_only_and_those_without_a_size_nothing():
    above, space = in_one_frame([[0.0, 0, 0, 4, 2, 1, 0.5]], [[0.0, 0, 5, 4, 2, 1, 0.5]])
    assert (above[0, 0], space[0, 0]) == (pytest.approx(1), 0.0)
    flat = [[0.0, 0, 0, -1, -1, -1, 0], [0, 0, 0, 0, 2, 1, 0], [0, 0, 0, 4, 2, 0, 0]]
    above, space = in_one_frame([[0.0, 0, 0, 4, 2, 1, 0]], flat)
    assert above[0, :2].tolist() == [0, 0]
    assert not space.any()


def test_only_boxes_of_one_frame_are_held_against_each_other():
    box = np.array([[0.0, 0, 0, 4, 2, 1, 0.2]] * 3)
    starts = (np.array([0, 1, 1, 3]), np.array([0, 2, 3, 3]), np.array([0, 2, 2, 2]))
    assert overlaps_from_above(box, box, *starts) == pytest.approx([1, 1])
