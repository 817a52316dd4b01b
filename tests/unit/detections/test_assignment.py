"""Pairs of boxes, against slow answers that one can see through."""

from itertools import permutations

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from sceneloom.detections.detectors import numbers_of
from sceneloom.detections.projection import ONE_UNKNOWN, SAME_FAMILY, SURER, assign, assign_pairs, pair_gains
from sceneloom.detections.results import NO_BOX


def random_boxes(generator, count):
    corners = generator.uniform(0, 100, (count, 2))
    return np.hstack([corners, corners + generator.uniform(5, 60, (count, 2))])


def slow_gain(a, b, weight, surer, least_iou):
    """By the definition of GIoU, in areas of intersections, unions and hulls."""
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if wide <= 0 or high <= 0:
        return 0.0
    common = wide * high
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - common
    hull = (max(a[2], b[2]) - min(a[0], b[0])) * (max(a[3], b[3]) - min(a[1], b[1]))
    iou = common / union
    giou = iou - (hull - union) / hull
    return (1 + giou) / 2 * weight * (1 + SURER * surer) if iou >= least_iou else 0.0


def test_gains_are_those_of_the_definition():
    generator = np.random.default_rng(3)
    a, b = random_boxes(generator, 30), random_boxes(generator, 25)
    words_a = [("Car", "van", "Pedestrian", "dragon")[k % 4] for k in range(30)]
    words_b = [("car", "pedestrian", "unknown")[k % 3] for k in range(25)]
    weights = {
        ("Car", "car"): 1.0,
        ("van", "car"): SAME_FAMILY,
        ("Pedestrian", "pedestrian"): 1.0,
        ("Pedestrian", "car"): 0.0,
        ("Car", "pedestrian"): 0.0,
        ("van", "pedestrian"): 0.0,
    }
    p, q = generator.random(30), generator.random(25)
    found = pair_gains(a, b, *numbers_of(words_a, words_b), p, q, least_iou=0.1)
    expected = [
        [
            slow_gain(a[i], b[j], weights.get((words_a[i], words_b[j]), ONE_UNKNOWN), (p[i] + q[j]) / 2, 0.1)
            for j in range(25)
        ]
        for i in range(30)
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert (found > 0).sum() > 20


@pytest.mark.parametrize("seed", range(12))
def test_no_other_assignment_gains_more(seed):
    generator = np.random.default_rng(seed)
    rows, columns = generator.integers(1, 7, 2)
    gains = np.where(generator.random((rows, columns)) < 0.6, generator.random((rows, columns)), 0.0)
    partners, takers = assign(gains)
    chosen = np.flatnonzero(partners >= 0), partners[partners >= 0]
    assert takers[chosen[1]].tolist() == chosen[0].tolist()
    assert (takers >= 0).sum() == len(chosen[0])
    wide = gains if rows <= columns else gains.T
    best = max(
        sum(wide[i, j] for i, j in enumerate(order))
        for order in permutations(range(wide.shape[1]), wide.shape[0])
    )
    assert gains[chosen].sum() == pytest.approx(best, rel=1e-12)
    assert (gains[chosen] > 0).all()
    assert len(set(chosen[0].tolist())) == len(set(chosen[1].tolist())) == len(chosen[0])


def test_a_box_that_is_worth_nothing_to_any_other_stays_alone():
    partners, takers = assign(np.array([[0.0, 0.0], [0.9, 0.8]]))
    assert partners.tolist() == [NO_BOX, 0]
    assert takers.tolist() == [1, NO_BOX]


@pytest.mark.parametrize("share", [0.02, 0.1, 0.5])
def test_pairs_without_rivals_are_assigned_as_in_the_whole_table(share):
    rng = np.random.default_rng(3)
    for _ in range(100):
        shape = rng.integers(1, 40, 2)
        gains = np.where(rng.random(shape) < share, rng.normal(0.5, 0.5, shape), 0.0)
        rows, columns = linear_sum_assignment(np.maximum(gains, 0.0), maximize=True)
        expected = [(i, j) for i, j in zip(rows, columns, strict=True) if gains[i, j] > 0]
        found = assign_pairs(*np.nonzero(gains), gains[gains != 0])
        assert list(zip(*found, strict=True)) == expected
        of_rows, of_columns = assign(gains)
        assert [(i, j) for i, j in enumerate(of_rows) if j != NO_BOX] == expected
        assert sorted((i, j) for j, i in enumerate(of_columns) if i != NO_BOX) == expected
