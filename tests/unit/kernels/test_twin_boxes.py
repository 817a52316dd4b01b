"""Second boxes of one thing, against a slow answer that looks at all pairs."""

import numpy as np
import pytest

from sceneloom.kernels.tracking import without_twins

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
