"""Smoothing against the linear systems that it stands for, solved whole."""

import numpy as np
import pytest

from sceneloom.kernels.completion import link_pixels, smooth_downward, smooth_rightward

SHAPE = (19, 23)


def solved_along_rows(image, links, strength):
    """Each row of x that minimises sum (x - value)² + strength sum link (x - next)²."""
    solved = np.empty(image.shape)
    for row in range(image.shape[0]):
        matrix = np.eye(image.shape[1])
        for k, link in enumerate(links[row, :-1].astype(float)):
            matrix[k : k + 2, k : k + 2] += strength * link * np.array([[1, -1], [-1, 1]])
        solved[row] = np.linalg.solve(matrix, image[row].astype(float))
    return solved


@pytest.mark.parametrize("strength", [0.0, 3.0, 500.0])
def test_rows_and_columns_are_smoothed_by_least_squares(strength):
    random = np.random.default_rng(1)
    first, second, links = (random.random(SHAPE).astype(np.float32) for _ in range(3))
    links[:, -1] = 0
    expected = [solved_along_rows(image, links, strength) for image in (first, second)]
    down = [np.ascontiguousarray(image.T) for image in (first, second)]
    smooth_rightward(links, strength, first, second)
    # float32, and systems whose condition grows with the strength
    np.testing.assert_allclose([first, second], expected, atol=2e-5)
    smooth_downward(np.ascontiguousarray(links.T), strength, *down, np.empty(SHAPE[::-1], np.float32))
    np.testing.assert_allclose([image.T for image in down], expected, atol=2e-5)


def test_links_follow_the_sum_of_the_differences_of_the_channels():
    random = np.random.default_rng(2)
    rgb = random.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    table = np.linspace(1, 0, 766).astype(np.float32)
    rightward, downward = np.empty(SHAPE, np.float32), np.empty(SHAPE, np.float32)
    link_pixels(rgb, table, rightward, downward)
    wide = rgb.astype(int)
    np.testing.assert_array_equal(rightward[:, :-1], table[np.abs(np.diff(wide, axis=1)).sum(axis=2)])
    np.testing.assert_array_equal(downward[:-1], table[np.abs(np.diff(wide, axis=0)).sum(axis=2)])
    assert not rightward[:, -1].any()
    assert not downward[-1].any()
