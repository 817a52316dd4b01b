"""Blending four pixels, against the same by hand, at the edges of the image and beyond them."""

import math

import numpy as np

from sceneloom.kernels.images import resample_bilinear


def slow_value(rgb, u, v):
    """What an image shows at one location: the four pixels around it, the border's own beyond the border."""
    height, width, _ = rgb.shape
    total = np.zeros(rgb.shape[2])
    for column in (math.floor(u), math.floor(u) + 1):
        for row in (math.floor(v), math.floor(v) + 1):
            weight = max(0.0, 1 - abs(u - column)) * max(0.0, 1 - abs(v - row))
            total += weight * rgb[min(max(row, 0), height - 1), min(max(column, 0), width - 1)]
    return total


def resampled(rgb, locations):
    locations = np.asarray(locations, np.float32).reshape(1, -1, 2)
    out, filled = (
        np.full((1, locations.shape[1], rgb.shape[2]), 7, np.uint8),
        np.empty((1, locations.shape[1]), bool),
    )
    resample_bilinear(rgb, locations, out, filled)
    return out[0], filled[0]


def test_values_are_those_of_the_four_pixels_around():
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, (9, 13, 3), np.uint8)
    locations = np.float32(random.uniform((-0.5, -0.5), (12.49, 8.49), (500, 2)))
    out, filled = resampled(rgb, locations)
    expected = np.array([slow_value(rgb, float(u), float(v)) for u, v in locations])
    assert filled.all()
    assert np.abs(out - expected).max() <= 0.5 + 1e-3  # rounded to whole levels, blended in float32


def test_centres_of_pixels_give_the_pixels_themselves():
    rgb = np.random.default_rng(1).integers(0, 256, (5, 4, 3), np.uint8)
    locations = np.stack(np.meshgrid(np.arange(4), np.arange(5)), axis=-1).astype(np.float32)
    out, filled = np.zeros_like(rgb), np.empty((5, 4), bool)
    resample_bilinear(rgb, locations, out, filled)
    assert np.array_equal(out, rgb)
    assert filled.all()


def test_what_lies_outside_the_image_or_nowhere_is_left_as_it_was():
    rgb = np.full((4, 6, 3), 200, np.uint8)
    outside = [
        (-0.51, 1),
        (5.5, 1),
        (2, -0.6),
        (2, 3.5),
        (np.nan, 1),
        (1, np.nan),
        (np.inf, 1),
        (1e30, -1e30),
    ]
    out, filled = resampled(rgb, outside)
    assert not filled.any()
    assert (out == 7).all()


def test_any_number_of_channels_goes():
    for channels in (1, 4):
        rgb = np.random.default_rng(2).integers(0, 256, (3, 3, channels), np.uint8)
        out, _ = resampled(rgb, [(1.0, 2.0)])
        assert np.array_equal(out[0], rgb[2, 1])


def test_an_image_of_one_pixel_is_that_pixel_everywhere():
    out, filled = resampled(np.full((1, 1, 3), 90, np.uint8), [(-0.4, 0.4), (0, 0), (0.49, -0.5)])
    assert filled.all()
    assert (out == 90).all()
