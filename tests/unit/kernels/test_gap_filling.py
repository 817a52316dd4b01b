"""Closing of gaps against loops that do what is stated, pixel by pixel."""

import numpy as np
import pytest

from sceneloom.kernels.completion import blend_neighbours, fill_across, fill_down, look_up, widen_samples

SHAPE = (40, 30)
STEEPEST = 0.002


def sparse_image(seed, share=0.05):
    random = np.random.default_rng(seed)
    image = random.uniform(3, 60, SHAPE).astype(np.float32)
    image[random.random(SHAPE) > share] = 0
    return image


def joined(near, to_near, other, to_other):
    gap = to_near + to_other
    inverse = (to_other / near + to_near / other) / gap
    steepness = abs(1 / near - 1 / other) / (gap * STEEPEST)
    jump = min(1.0, max(0.0, (steepness - 0.85) / 0.45))
    return (1 - jump) / inverse + jump * (to_other * near + to_near * other) / gap


@pytest.mark.parametrize("slack", [0, 1, 3])
def test_samples_are_widened_to_the_nearer_one_within_their_row(slack):
    sparse = sparse_image(slack)
    widened = np.empty_like(sparse)
    widen_samples(sparse, slack, widened)
    for row in range(SHAPE[0]):
        known = np.flatnonzero(sparse[row])
        for column in range(SHAPE[1]):
            distances = np.abs(known - column)
            near = known[distances == distances.min()] if len(known) else known
            if len(near) == 0 or distances.min() > slack:
                assert widened[row, column] == 0
            else:
                assert widened[row, column] in sparse[row, near]


@pytest.mark.parametrize("seed", range(3))
def test_columns_are_filled_between_samples_and_a_little_beyond(seed):
    sparse, longest, reach = sparse_image(seed), 12.0, 3.0
    above, distances, depths, trusts, spreads, gaps = (np.empty_like(sparse) for _ in range(6))
    look_up(sparse, above, distances)
    fill_down(sparse, above, distances, longest, reach, STEEPEST, depths, trusts, spreads, gaps)
    for column in range(SHAPE[1]):
        known = np.flatnonzero(sparse[:, column])
        for row in range(SHAPE[0]):
            up, down = known[known <= row], known[known >= row]
            to_up, to_down = (row - up[-1] if len(up) else 1e6), (down[0] - row if len(down) else 1e6)
            if sparse[row, column] > 0:
                expected = sparse[row, column]
            elif to_up + to_down <= longest:
                expected = joined(sparse[up[-1], column], to_up, sparse[down[0], column], to_down)
            elif min(to_up, to_down) <= reach:
                expected = sparse[up[-1] if to_up < to_down else down[0], column]
            else:
                expected = 0
            assert depths[row, column] == pytest.approx(expected, rel=1e-5)  # seven digits of float32
    assert ((depths > 0) | (trusts == 0) | (gaps > longest)).all()


def test_rows_are_filled_where_that_is_the_shorter_arc():
    sparse = np.zeros(SHAPE, np.float32)
    sparse[5, 3], sparse[5, 9] = 10, 20
    depths, trusts, spreads, gaps = (np.zeros_like(sparse) for _ in range(4))
    depths[5, 6], gaps[5, 6] = 7, 4
    depths[5, 7], gaps[5, 7] = 7, 30
    fill_across(sparse, 8.0, STEEPEST, depths, trusts, spreads, gaps)
    expected = {
        4: joined(10, 1, 20, 5),
        5: joined(10, 2, 20, 4),
        6: 7,
        7: joined(10, 4, 20, 2),
        8: joined(10, 5, 20, 1),
    }
    for column, depth in expected.items():
        assert depths[5, column] == pytest.approx(depth, rel=1e-5)
    assert np.count_nonzero(depths) == 5


def test_filled_pixels_are_blended_with_filled_ones_only():
    image = sparse_image(7, share=0.6)
    blended = np.empty_like(image)
    blend_neighbours(image, np.empty((2, image.size), np.float32), blended)
    kernel = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1])
    for row in range(2, SHAPE[0] - 2):
        for column in range(2, SHAPE[1] - 2):
            window = image[row - 2 : row + 3, column - 2 : column + 3]
            weights = kernel * (window > 0)
            expected = (weights * window).sum() / weights.sum() if image[row, column] > 0 else 0
            assert blended[row, column] == pytest.approx(expected, rel=1e-5)
