"""Sums over edges and shared levels, against interpolation by scipy and plain loops."""

import numpy as np
import pytest
from scipy import ndimage

from sceneloom.kernels.image_agreement import fill_histogram, sum_by_table, sum_edges

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


def test_edges_are_summed_by_cell_and_direction(placed):
    generator, ids, pixels = placed
    kinds = generator.integers(0, 4, 40).astype(np.uint8)
    weights = generator.random(40).astype(np.float32)
    cells = generator.integers(0, 5, 40).astype(np.int16)
    edges = generator.random((4, *SIZE)).astype(np.float32)
    sums, totals = np.zeros(5), np.zeros(5)
    sum_edges(ids, pixels, kinds, weights, cells, edges, sums, totals)
    values = np.array([interpolated(edges[k], p[None])[0] for k, p in zip(kinds[ids], pixels, strict=True)])
    expected = np.bincount(cells[ids], weights[ids] * values, minlength=5)
    np.testing.assert_allclose(sums, expected, rtol=1e-5)  # float32 pixels
    np.testing.assert_allclose(totals, np.bincount(cells[ids], weights[ids], minlength=5), rtol=1e-6)


def test_pixels_beyond_the_outer_centres_take_the_border(placed):
    generator, _, _ = placed
    edges = generator.random((1, *SIZE)).astype(np.float32)
    sums, totals = np.zeros(1), np.zeros(1)
    outside = np.array([[-0.5, -0.5], [29.4, 19.4]], np.float32)
    nothing = np.zeros(2, np.uint8)
    ones, cells = np.ones(2, np.float32), np.zeros(2, np.int16)
    sum_edges(np.arange(2), outside, nothing, ones, cells, edges, sums, totals)
    assert sums[0] == pytest.approx(edges[0, 0, 0] + edges[0, -1, -1], rel=1e-6)


def test_a_histogram_shares_each_point_among_four_bins(placed):
    generator, ids, pixels = placed
    levels = generator.uniform(0, 7, 40).astype(np.float32)
    image = generator.uniform(0, 7, SIZE).astype(np.float32)
    histogram = np.zeros((8, 8))
    fill_histogram(ids, pixels, levels, image, histogram)
    bins = np.arange(8)
    hats = [
        np.maximum(0.0, 1.0 - np.abs(bins - v)) for v in (levels[ids][:, None], interpolated(image, pixels)[:, None])
    ]
    np.testing.assert_allclose(histogram, hats[0].T @ hats[1], atol=1e-4)  # float32 levels
    assert histogram.sum() == pytest.approx(len(ids))


def test_a_table_is_looked_up_between_its_numbers(placed):
    generator, ids, pixels = placed
    levels = generator.uniform(0, 7, 40).astype(np.float32)
    cells = generator.integers(0, 3, 40).astype(np.int16)
    image = generator.uniform(0, 7, SIZE).astype(np.float32)
    table = generator.normal(size=(8, 8))
    sums, totals = np.zeros(3), np.zeros(3)
    sum_by_table(ids, pixels, levels, cells, image, table, sums, totals)
    looked_up = interpolated(table, np.column_stack([interpolated(image, pixels), levels[ids]]))
    np.testing.assert_allclose(sums, np.bincount(cells[ids], looked_up, minlength=3), atol=1e-4)
    assert totals.tolist() == np.bincount(cells[ids], minlength=3).tolist()
