"""Sums over edges and shared levels, against interpolation by scipy and plain loops."""

import numpy as np
import pytest
from scipy import ndimage

from sceneloom.calibrate.measures import fill_histogram, sum_by_table, sum_edges

SIZE = (20, 30)


@pytest.fixture
def placed():
    """Forty points, thirty of them in the image."""
    generator = np.random.default_rng(2)
    ids = np.sort(generator.choice(40, 30, replace=False)).astype(np.int64)
    pixels = generator.uniform((0.0, 0.0), (SIZE[1] - 1, SIZE[0] - 1), (30, 2)).astype(np.float32)
    return generator, ids, pixels


def interpolated(image, pixels):
    """Bilinear values by scipy."""
    return ndimage.map_coordinates(np.asarray(image, np.float64), pixels[:, ::-1].T.astype(np.float64), order=1)


def test_edges_are_summed_by_cell_and_direction_and_beyond_the_outer_centres_the_border_holds(placed):
    generator, ids, pixels = placed
    kinds, cells = generator.integers(0, 4, 40).astype(np.uint8), generator.integers(0, 5, 40).astype(np.int16)
    weights, edges = generator.random(40).astype(np.float32), generator.random((4, *SIZE)).astype(np.float32)
    sums, totals = np.zeros(5), np.zeros(5)
    sum_edges(ids, pixels, kinds, weights, cells, edges, sums, totals)
    values = np.array([interpolated(edges[k], p[None])[0] for k, p in zip(kinds[ids], pixels, strict=True)])
    expected = np.bincount(cells[ids], weights[ids] * values, minlength=5)
    np.testing.assert_allclose(sums, expected, rtol=1e-5)  # float32 pixels
    np.testing.assert_allclose(totals, np.bincount(cells[ids], weights[ids], minlength=5), rtol=1e-6)
    sums, outside = np.zeros(1), np.array([[-0.5, -0.5], [29.4, 19.4]], np.float32)
    same = np.zeros(2, np.uint8), np.ones(2, np.float32), np.zeros(2, np.int16)
    sum_edges(np.arange(2), outside, *same, edges, sums, np.zeros(1))
    assert sums[0] == pytest.approx(edges[0, 0, 0] + edges[0, -1, -1], rel=1e-6)


def test_a_histogram_shares_each_point_among_four_bins_and_a_table_is_looked_up_between_its_numbers(placed):
    generator, ids, pixels = placed
    levels, cells = generator.uniform(0, 7, 40).astype(np.float32), generator.integers(0, 3, 40).astype(np.int16)
    image, table = generator.uniform(0, 7, SIZE).astype(np.float32), generator.normal(size=(8, 8))
    histogram, sums, totals, shown = np.zeros((8, 8)), np.zeros(3), np.zeros(3), interpolated(image, pixels)
    fill_histogram(ids, pixels, levels, image, histogram)
    own, other = (np.maximum(0.0, 1.0 - np.abs(np.arange(8) - v[:, None])) for v in (levels[ids], shown))
    np.testing.assert_allclose(histogram, own.T @ other, atol=1e-4)  # float32 levels
    assert histogram.sum() == pytest.approx(len(ids))
    sum_by_table(ids, pixels, levels, cells, image, table, sums, totals)
    looked_up = interpolated(table, np.column_stack([shown, levels[ids]]))
    np.testing.assert_allclose(sums, np.bincount(cells[ids], looked_up, minlength=3), atol=1e-4)
    assert totals.tolist() == np.bincount(cells[ids], minlength=3).tolist()
