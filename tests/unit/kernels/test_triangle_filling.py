"""Triangles in an image against SciPy's interpolation."""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from sceneloom.kernels.completion import fill_triangles, measure_slopes, measure_triangles

SHAPE = (50, 70)


@pytest.fixture
def mesh():
    random = np.random.default_rng(4)
    pixels = random.uniform([-5, -5], [75, 55], (60, 2)).astype(np.float32)
    depths = random.uniform(4, 30, 60).astype(np.float32)
    triangulation = Delaunay(pixels.astype(float))
    return pixels, depths, triangulation, triangulation.simplices.astype(np.int32)


@pytest.mark.parametrize("trust", [1.0, 0.0, 0.3])
def test_pixels_are_filled_as_scipy_interpolates(mesh, trust):
    pixels, depths, triangulation, triangles = mesh
    count = len(triangles)
    images = [np.zeros(SHAPE, np.float32) for _ in range(4)]
    trusts = np.full(count, trust, np.float32)
    # without slopes, what corners report one another is missed by all there is
    slopes, lengths = np.zeros_like(pixels), np.full(count, 9, np.float32)
    fill_triangles(pixels, depths, slopes, triangles, np.ones(count, bool), trusts, lengths, *images)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    surface = 1 / LinearNDInterpolator(triangulation, 1 / depths.astype(float))(columns, rows)
    between = LinearNDInterpolator(triangulation, depths.astype(float))(columns, rows)
    at = triangulation.find_simplex(np.stack([columns, rows], axis=-1).astype(float))
    even = np.minimum(1, depths[triangles[at]].max(-1) / depths[triangles[at]].min(-1) - 1)
    expected = trust * ((1 - even) * surface + even * between) + (1 - trust) * between
    inside = np.isfinite(expected)
    off = np.abs(images[0][inside] / expected[inside] - 1)
    # float32; pixels on the border of two triangles are reported by either, or by both
    assert np.quantile(off, 0.99) < 1e-5
    assert off.max() < 0.02
    assert (images[3][inside] == 9).all()
    lone = ~inside & (images[0] > 0)
    assert lone.sum() <= 0.002 * inside.sum()  # a ten-thousandth of a triangle beside the hull


def test_across_jumps_what_the_image_reported_stays(mesh):
    pixels, depths, _, triangles = mesh
    images = [np.zeros(SHAPE, np.float32) for _ in range(4)]
    images[0][20:30] = 5.0
    count = len(triangles)
    none, ones = np.zeros(count, np.float32), np.ones(count, np.float32)
    slopes = np.zeros_like(pixels)
    fill_triangles(pixels, depths, slopes, triangles, np.ones(count, bool), none, ones, *images)
    np.testing.assert_array_equal(images[0][20:30], 5.0)


def bent(pixels):
    """An inverse depth that bends evenly, and its slopes."""
    u, v = pixels.astype(float).T
    inverse = 0.05 + 1e-5 * u + 2e-5 * v + 4e-8 * u * u - 3e-8 * u * v + 5e-8 * v * v
    return inverse, np.stack([1e-5 + 8e-8 * u - 3e-8 * v, 2e-5 - 3e-8 * u + 1e-7 * v], axis=1)


def test_what_bends_evenly_comes_out_as_it_is(mesh):
    pixels, _, triangulation, triangles = mesh
    inverse, slopes = bent(pixels)
    images, ones = [np.zeros(SHAPE, np.float32) for _ in range(4)], np.ones(len(triangles), np.float32)
    depths = (1 / inverse).astype(np.float32)
    fill_triangles(
        pixels, depths, slopes.astype(np.float32), triangles, ones.astype(bool), ones, ones, *images
    )
    rows, columns = np.nonzero(images[0])
    locations = np.stack([columns, rows], axis=1)
    reported, straight = bent(locations)[0], LinearNDInterpolator(triangulation, inverse)(locations)
    known = np.isfinite(straight)
    off = np.abs(1 / images[0][rows, columns] - reported)[known]
    # float32 reports 1e-8 of 0.06; where a location leaves the range of its corners, and where depth is taken as linear
    assert np.median(off) < 2e-8
    assert np.median(off) < 0.1 * np.median(np.abs(straight - reported)[known])


def test_slopes_of_a_plane_are_its_own_at_every_corner_and_jumps_report_none(mesh):
    pixels, _, _, triangles = mesh
    inverse = (0.1 + 1e-4 * pixels[:, 0] - 3e-4 * pixels[:, 1]).astype(np.float32)
    slopes, room = np.empty_like(pixels), np.empty(len(pixels), np.float32)
    measure_slopes(pixels, inverse, triangles, np.ones(len(triangles), np.float32), slopes, room)
    # differences of float32 numbers of a tenth over a pixel
    np.testing.assert_allclose(slopes, np.broadcast_to([1e-4, -3e-4], slopes.shape), atol=2e-6)
    measure_slopes(pixels, inverse, triangles, np.zeros(len(triangles), np.float32), slopes, room)
    assert not slopes.any()


def test_triangles_are_measured(mesh):
    pixels, depths, _, triangles = mesh
    measures = np.empty((len(triangles), 3), np.float32)
    measure_triangles(pixels, 1 / depths, triangles, measures)
    for triangle, (area, longest, slope) in zip(triangles, measures, strict=True):
        a, b, c = pixels[triangle].astype(float)
        assert area == pytest.approx(abs(np.linalg.det([b - a, c - a])) / 2, rel=1e-3, abs=1e-3)
        assert longest == pytest.approx(
            max(np.linalg.norm(a - b), np.linalg.norm(b - c), np.linalg.norm(c - a)), rel=1e-5
        )
        y = 1 / depths[triangle].astype(float)
        gradient = np.linalg.solve([b - a, c - a], [y[1] - y[0], y[2] - y[0]])
        assert slope == pytest.approx(np.linalg.norm(gradient), rel=1e-2)  # differences of float32
