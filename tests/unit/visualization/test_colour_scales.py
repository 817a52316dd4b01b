"""Colour maps and depth scales."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.errors import OptionError
from sceneloom.visualization import colour_scales as scales
from sceneloom.visualization.colour_scales import ANCHORS, DepthScale, colour_map


def test_oklab_of_named_colours_is_what_css_prints_and_every_colour_comes_back():
    # The values that CSS Color Module Level 4 prints for its named colours.
    named = {
        (255, 255, 255): (1.0, 0.0, 0.0),
        (0, 0, 0): (0.0, 0.0, 0.0),
        (255, 0, 0): (0.62796, 0.22486, 0.12585),
        (0, 255, 0): (0.86644, -0.23389, 0.17950),
        (0, 0, 255): (0.45201, -0.03246, -0.31153),
    }
    # 1e-4: the published matrices of OKLab exist in two roundings.
    assert scales.oklab_from_srgb(np.array([*named], np.uint8)) == pytest.approx(np.array([*named.values()]), abs=1e-4)
    levels = np.arange(0, 256, 5, dtype=np.uint8)
    rgb = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
    assert np.array_equal(scales.srgb_from_oklab(scales.oklab_from_srgb(rgb)), rgb)


@pytest.mark.parametrize("name", ANCHORS)
def test_lightness_falls_in_equal_steps_along_the_whole_map_and_no_colour_had_to_be_clipped_visibly(name):
    table = colour_map(name).table
    lightness = cv2.cvtColor((table[None] / 255.0).astype(np.float32), cv2.COLOR_RGB2Lab)[0, :, 0]
    # 0.5 of 100: colours are rounded to 8 bits; over six colours the fall is far above the rounding.
    assert np.diff(lightness).max() < 0.5
    assert (lightness[6:] < lightness[:-6]).all()
    assert lightness[0] - lightness[-1] > 40
    oklab = scales.oklab_from_srgb(table)
    lengths = np.linalg.norm(oklab[15::15] - oklab[:-15:15], axis=1)
    # 8 %: rounding to 8 bits, and chords across the bends of the curve.
    assert np.abs(lengths / lengths.mean() - 1).max() < 0.08
    light, chroma, hue = np.array(ANCHORS[name]).T
    wanted = np.column_stack([light, chroma * np.cos(np.deg2rad(hue)), chroma * np.sin(np.deg2rad(hue))])
    nearest = np.linalg.norm(oklab[None] - wanted[:, None], axis=2).min(axis=1)
    # 0.02 is about the smallest difference that is seen side by side.
    assert nearest.max() < 0.02


def test_values_beyond_the_ends_take_the_colours_of_the_ends_and_equal_ratios_of_depth_are_equal_lengths():
    beacon = colour_map("beacon")
    colours = beacon.colours(np.array([-3.0, 0.0, 1.0, 7.0, np.inf]))
    assert np.array_equal(colours, beacon.table[[0, 0, 255, 255, 255]])
    with pytest.raises(OptionError, match=r"'rainbow'.*beacon"):
        colour_map("rainbow")
    scale = DepthScale(2.0, 32.0)
    assert scale.fractions(np.array([2.0, 4.0, 8.0, 16.0, 32.0])) == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert np.array_equal(scale.colours(np.array([0.0, np.inf])), scale.map.table[[0, 255]])
    for depths in ([], [0.0, -1.0], [np.nan, np.inf]):
        scale = DepthScale.of(np.array(depths, np.float32))
        assert 0 < scale.near < scale.far
    for near, far in ((0.0, 10.0), (5.0, 5.0), (8.0, 2.0), (1.0, math.inf), (math.nan, 3.0)):
        with pytest.raises(OptionError, match="0 < near < far"):
            DepthScale(near, far)


DEPTHS = st.floats(0.01, 5000.0)


def _round_numbers(digits):
    return sorted(digit * 10.0**power for digit in digits for power in range(-6, 8))


@pytest.mark.parametrize("digits", [scales.ROUND_DIGITS, scales.COARSE_DIGITS])
@given(value=st.floats(1e-4, 1e5))
def test_rounding_finds_the_nearest_round_number_on_each_side(digits, value):
    # Half a billionth: a number that is round but for its last bits counts as round.
    numbers = _round_numbers(digits)
    assert scales.round_down(value, digits) == pytest.approx(max(n for n in numbers if n <= value * (1 + 5e-10)))
    assert scales.round_up(value, digits) == pytest.approx(min(n for n in numbers if n >= value * (1 - 5e-10)))


@given(st.lists(DEPTHS, min_size=1, max_size=50))
def test_the_chosen_scale_holds_all_but_the_outermost_depths(depths):
    scale = DepthScale.of(np.array(depths, np.float32))
    low, high = np.percentile(depths, [0.6, 99.4])
    # A part in a million: depths are float32.
    assert scale.near <= low * (1 + 1e-6)
    assert scale.far >= high * (1 - 1e-6)


@given(near=DEPTHS, ratio=st.floats(1.01, 1000.0))
def test_ticks_start_with_the_ends_and_lie_between_them(near, ratio):
    scale = DepthScale(near, near * ratio)
    ends, inner = scale.ticks()[:2], scale.ticks()[2:]
    assert ends == [scale.near, scale.far]
    assert all(scale.near < tick < scale.far for tick in inner)
    assert len(set(inner)) == len(inner)
    decades = range(math.ceil(math.log10(near * 1.01)), math.floor(math.log10(near * ratio / 1.01)) + 1)
    assert all(any(math.isclose(tick, 10.0**power) for tick in inner) for power in decades)
