"""Gains of pairs of objects and boxes, against the same formulas written one pair at a time.

Second boxes of one thing, against a slow answer that looks at all pairs.
"""

import numpy as np
import pytest

from sceneloom.tracking.tracker import add_gains_in_image, gains_in_space, without_twins

LEAST, FREEDOM, MOST = 0.09, 4.0, 2.0


def covariances(random, count):
    root = random.normal(size=(count, 3, 3)) * 0.5
    return root @ root.transpose(0, 2, 1) + 0.01 * np.eye(3)


def space(count=5, others=7):
    random = np.random.default_rng(0)
    locations, seen = random.normal(size=(count, 3)) * 2.0, random.normal(size=(others, 3)) * 2.0
    codes = np.array([[0, 0], [1, 0], [2, 1], [-1, -1], [3, -1], [4, -1], [0, 0]])
    doubts, density = -random.random(others), np.log(random.uniform(1e-4, 1e-2, count))
    ours = locations, covariances(random, count), codes[:count], density
    return ours, (seen, covariances(random, others), codes, doubts)


def test_gains_in_space_are_those_of_the_formula_and_what_is_hopelessly_far_is_no_pair():
    ours, theirs = space()
    found = np.full((5, 7), -np.inf)
    rows, columns, gains = gains_in_space(*ours, *theirs, LEAST, FREEDOM, MOST)
    found[rows, columns] = gains
    for i, (location, covariance, (name, family), density) in enumerate(zip(*ours, strict=True)):
        for j, (where, other_covariance, (other, its_family), doubt) in enumerate(zip(*theirs, strict=True)):
            if not (name == other or -1 in (name, other) or family == its_family != -1):
                assert found[i, j] == -np.inf
                continue
            spread, apart = covariance + other_covariance + LEAST * np.eye(3), where - location
            square = apart @ np.linalg.inv(spread) @ apart
            ground = -0.5 * np.log(np.linalg.det(2.0 * np.pi * spread[:2, :2]))
            expected = ground - (FREEDOM + 3) * np.log(1.0 + square / FREEDOM) / 2.0 - density + doubt
            # what images cannot make up for need not be reported
            assert found[i, j] == pytest.approx(expected, rel=1e-9) or (found[i, j] == -np.inf and expected < -MOST)
    assert np.isfinite(found).sum() > 8
    far = gains_in_space(*ours, theirs[0] + 1e3, *theirs[1:], LEAST, FREEDOM, MOST)
    assert [len(column) for column in far] == [0, 0, 0]


def test_boxes_in_images_speak_for_and_against():
    foreseen = np.array([[0.0, 0.0, 10.0, 10.0], [100.0, 0.0, 110.0, 10.0], [np.nan] * 4])
    corners = np.array([[0.0, 0.0, 10.0, 10.0], [4.0, 0.0, 14.0, 10.0], [np.nan] * 4, [8.0, 0.0, 18.0, 10.0]])
    measured = np.array([True, True, True, False])
    rows, columns = np.divmod(np.arange(12), 4)
    gains = np.zeros(12)
    add_gains_in_image(rows, columns, gains, foreseen, corners, measured, 0.25, 0.6, 0.3, FREEDOM)
    gains = gains.reshape(3, 4)

    def reported(share):
        return -0.5 * (FREEDOM + 1) * np.log(1.0 + ((1.0 - share) / 0.25) ** 2 / FREEDOM)

    assert gains[0, 0] == pytest.approx(reported(1.0) - reported(0.6))
    assert gains[0, 1] == pytest.approx(reported(60.0 / 140.0) - reported(0.6))
    assert gains[1, 0] == pytest.approx(reported(0.0) - reported(0.6))
    assert gains[:, 2].tolist() == [0.0, 0.0, 0.0]  # no box in the image says nothing
    assert gains[2, :3].tolist() == [0.0, 0.0, 0.0]  # nor does an object that it does not show
    assert (gains[:, 3] == -np.inf).all()  # a box of the image alone has to overlap


SHARE, OVERLAP = 0.5, 0.5


def overlap(a, b):
    wide, high = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    if not (wide > 0 and high > 0):
        return 0.0
    return wide * high / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - wide * high)


def are_twins(one, other):
    (location, measured, corners), (where, placed, boxes) = one, other
    if measured and np.hypot(*(location[:2] - where[:2])) < SHARE * where[2]:
        return True
    if measured and placed:
        return False
    return any(overlap(a, b) > OVERLAP for a, b in zip(corners, boxes, strict=True))


def things(rng, count):
    locations = np.column_stack([rng.uniform(0, 12, (count, 2)), rng.uniform(0.5, 2.5, count)])
    low = rng.uniform(0, 60, (2, count, 2))
    corners = np.concatenate([low, low + rng.uniform(10, 40, (2, count, 2))], axis=2)
    corners[rng.random((2, count)) < 0.3] = np.nan
    return locations, rng.random(count) < 0.6, corners


def listed(locations, measured, corners):
    return [(locations[k], measured[k], corners[:, k]) for k in range(len(locations))]


@pytest.mark.parametrize("seed", range(8))
def test_what_is_kept_is_no_second_box_of_what_is_known_or_was_kept_before(seed):
    rng = np.random.default_rng(seed)
    boxes, known = things(rng, 40), things(rng, 5 * (seed % 2))
    rows = rng.permutation(40)[:30]
    taken, expected = listed(*known), []
    for row in rows.tolist():
        box = listed(*boxes)[row]
        if not any(are_twins(box, other) for other in taken):
            expected.append(row)
            taken.append(box)
    assert 3 < len(expected) < 30
    assert without_twins(rows, *boxes, *known, SHARE, OVERLAP).tolist() == expected


def test_without_boxes_and_images_nothing_is_kept():
    none = np.zeros((0, 3)), np.zeros(0, np.bool_), np.zeros((0, 0, 4))
    assert without_twins(np.zeros(0, np.int64), *none, *none, SHARE, OVERLAP).tolist() == []
