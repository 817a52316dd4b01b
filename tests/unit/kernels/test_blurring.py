"""Blurs against scipy's filters."""

import numpy as np
import pytest
from scipy import ndimage

from sceneloom.kernels.blurring import blur, box_means

SHAPES = [(37, 53), (3, 60), (50, 2), (1, 1)]


def image_of(shape: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(3).uniform(0.0, 255.0, shape).astype(np.float32)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("width", [0.7, 1.5, 4.0])
def test_a_blur_is_that_of_scipy(shape: tuple[int, int], width: float) -> None:
    image = image_of(shape)
    expected = ndimage.gaussian_filter(image.astype(np.float64), width, truncate=3.0)
    # float32 sums of some twenty numbers up to 255
    np.testing.assert_allclose(blur(image, width), expected, atol=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("size", [1, 5, 61])
def test_means_over_boxes_are_those_of_scipy(shape: tuple[int, int], size: int) -> None:
    image = image_of(shape)
    expected = ndimage.uniform_filter(image.astype(np.float64), size, mode="nearest")
    np.testing.assert_allclose(box_means(image, size), expected, atol=1e-3)
