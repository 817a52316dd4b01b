"""The kernel, and what stands in for it, against the formulas in floating point, with colours interpolated by NumPy.

Blending four pixels, against the same by hand, at the edges of the image and beyond them.
"""

import math

import numpy as np
import pytest

from sceneloom.formats.video.reader import _conversion_factors, _rgb_from_halved_chroma
from sceneloom.kernels.images import resample_bilinear, rgb_from_halved_chroma

SHARES = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722)}


def spread(plane, half_columns):
    """Interpolate colours linearly, those of a sample lying midway between its two rows."""
    height, width = plane.shape
    rows, columns = (np.arange(2 * height) - 0.5) / 2, (np.arange(2 * width) - 0.5 * half_columns) / 2
    down = np.array([np.interp(rows, np.arange(height), column) for column in plane.T.astype(float)])
    return np.array([np.interp(columns, np.arange(width), row) for row in down.T])


def rgb_by_formula(planes, shares, full, half_columns):
    """Source: ITU-R BT.601-7 and BT.709-6, clause 3."""
    red_share, blue_share = shares
    low, luma_span, chroma_span = (0, 255, 255) if full else (16, 219, 224)
    luma = (planes[0] - float(low)) * 255 / luma_span
    blue_less, red_less = ((spread(plane, half_columns) - 128) * 255 / chroma_span for plane in planes[1:])
    red, blue = luma + 2 * (1 - red_share) * red_less, luma + 2 * (1 - blue_share) * blue_less
    green = (luma - red_share * red - blue_share * blue) / (1 - red_share - blue_share)
    return np.clip(np.stack([red, green, blue], axis=-1), 0, 255)


def by_kernel_and_numpy(planes, shares, full, half_columns, *, width):
    height = len(planes[0])
    rgb = np.full((height, 3 * width), 77, np.uint8)
    rgb_from_halved_chroma(*planes, _conversion_factors(*shares, full=full), half_columns, rgb)
    by_numpy = np.full((height, width, 3), 77, np.uint8)
    _rgb_from_halved_chroma(*planes, _conversion_factors(*shares, full=full), half_columns, by_numpy)
    assert np.array_equal(by_numpy, rgb.reshape(height, width, 3))  # whichever an image is converted by
    return by_numpy


@pytest.mark.parametrize("half_columns", [0, 1])
@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", SHARES)
@pytest.mark.parametrize(("height", "width"), [(2, 2), (2, 150), (40, 4), (64, 194)])
def test_noise_comes_out_as_the_formula_says(height, width, matrix, full, half_columns):
    rng = np.random.default_rng(height + width)
    # memory beyond the image's columns, as decoders have it, must not come in
    stored = [
        rng.integers(0, 256, (height // n, width // n + extra), dtype=np.uint8)
        for n, extra in ((1, 31), (2, 15), (2, 16))
    ]
    shown = [plane[:, : width // n] for plane, n in zip(stored, (1, 2, 2), strict=True)]
    expected = rgb_by_formula(shown, SHARES[matrix], full, half_columns)
    difference = by_kernel_and_numpy(stored, SHARES[matrix], full, half_columns, width=width) - expected
    # half a level of rounding, and brightness and colours in steps of a 32nd
    assert np.abs(difference).max() < 0.6
    if difference.size > 10_000:
        # a level too dark on average was what the converter's fast way gives; 0.3 / sqrt(12,000) is noise
        assert np.abs(difference.mean(axis=(0, 1))).max() < 0.06


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
def test_every_grey_keeps_its_level_in_all_three_colours(full):
    luma, grey = np.tile(np.arange(256, dtype=np.uint8), (2, 1)), np.full((1, 128), 128, np.uint8)
    rgb = by_kernel_and_numpy([luma, grey, grey], SHARES["bt709"], full, 0, width=256).astype(int)
    levels = np.arange(256) if full else np.clip((np.arange(256) - 16) * 255 / 219, 0, 255)
    assert np.ptp(rgb, axis=2).max() <= (0 if full else 1)
    assert np.abs(rgb[0] - levels[:, None]).max() <= (0 if full else 0.55)


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
    out, filled = (np.full((1, locations.shape[1], rgb.shape[2]), 7, np.uint8), np.empty((1, locations.shape[1]), bool))
    resample_bilinear(rgb, locations, out, filled)
    return out[0], filled[0]


def test_values_are_those_of_the_four_pixels_around_and_what_lies_outside_is_left_as_it_was():
    random = np.random.default_rng(0)
    rgb = random.integers(0, 256, (9, 13, 3), np.uint8)
    locations = np.float32(random.uniform((-0.5, -0.5), (12.49, 8.49), (500, 2)))
    out, filled = resampled(rgb, locations)
    expected = np.array([slow_value(rgb, float(u), float(v)) for u, v in locations])
    assert filled.all()
    assert np.abs(out - expected).max() <= 0.5 + 1e-3  # rounded to whole levels, blended in float32
    out, filled = resampled(rgb, np.stack(np.meshgrid(np.arange(13), np.arange(9)), axis=-1))
    assert np.array_equal(out, rgb.reshape(-1, 3))
    assert filled.all()
    rgb = np.full((4, 6, 3), 200, np.uint8)
    outside = [(-0.51, 1), (5.5, 1), (2, -0.6), (2, 3.5), (np.nan, 1), (1, np.nan), (np.inf, 1), (1e30, -1e30)]
    out, filled = resampled(rgb, outside)
    assert not filled.any()
    assert (out == 7).all()
    for channels in (1, 4):
        rgb = np.random.default_rng(2).integers(0, 256, (3, 3, channels), np.uint8)
        assert np.array_equal(resampled(rgb, [(1.0, 2.0)])[0][0], rgb[2, 1])
    out, filled = resampled(np.full((1, 1, 3), 90, np.uint8), [(-0.4, 0.4), (0, 0), (0.49, -0.5)])
    assert filled.all()
    assert (out == 90).all()
