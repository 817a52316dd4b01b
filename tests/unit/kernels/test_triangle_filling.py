"""Triangles in a picture against SciPy's interpolation."""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from sceneloom.kernels.triangle_filling import fill_triangles, measure_triangles

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
    fill_triangles(
        pixels, depths, triangles, np.ones(count, bool), trusts, np.full(count, 9, np.float32), *images
    )
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    surface = 1 / LinearNDInterpolator(triangulation, 1 / depths.astype(float))(columns, rows)
    between = LinearNDInterpolator(triangulation, depths.astype(float))(columns, rows)
    expected = trust * surface + (1 - trust) * between
    inside = np.isfinite(expected)
    off = np.abs(images[0][inside] / expected[inside] - 1)
    # float32; pixels on the border of two triangles are told by either, or by both
    assert np.quantile(off, 0.99) < 1e-5
    assert off.max() < 0.02
    assert (images[3][inside] == 9).all()
    lone = ~inside & (images[0] > 0)
    assert lone.sum() <= 0.002 * inside.sum()  # a ten-thousandth of a triangle beside the hull


def test_across_jumps_what_the_image_told_stays(mesh):
    pixels, depths, _, triangles = mesh
    images = [np.zeros(SHAPE, np.float32) for _ in range(4)]
    images[0][20:30] = 5.0
    count = len(triangles)
    none, ones = np.zeros(count, np.float32), np.ones(count, np.float32)
    fill_triangles(pixels, depths, triangles, np.ones(count, bool), none, ones, *images)
    np.testing.assert_array_equal(images[0][20:30], 5.0)


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
