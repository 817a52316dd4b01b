import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.errors import OptionError
from sceneloom.visualization.colour_scales import (
    COARSE_DIGITS,
    ROUND_DIGITS,
    DepthScale,
    round_down,
    round_up,
)

DEPTHS = st.floats(0.01, 5000.0)


def _round_numbers(digits):
    return sorted(digit * 10.0**power for digit in digits for power in range(-6, 8))


@pytest.mark.parametrize("digits", [ROUND_DIGITS, COARSE_DIGITS])
@given(value=st.floats(1e-4, 1e5))
def test_rounding_finds_the_nearest_round_number_on_each_side(digits, value):
    # Half a billionth: a number that is round but for its last bits counts as round.
    assert round_down(value, digits) == pytest.approx(
        max(n for n in _round_numbers(digits) if n <= value * (1 + 5e-10))
    )
    assert round_up(value, digits) == pytest.approx(
        min(n for n in _round_numbers(digits) if n >= value * (1 - 5e-10))
    )


@given(st.lists(DEPTHS, min_size=1, max_size=50))
def test_the_chosen_scale_holds_all_but_the_outermost_depths(depths):
    scale = DepthScale.of(np.array(depths, np.float32))
    low, high = np.percentile(depths, [0.6, 99.4])
    # A part in a million: depths are float32.
    assert scale.near <= low * (1 + 1e-6)
    assert scale.far >= high * (1 - 1e-6)


def test_a_scale_is_chosen_where_no_depth_is_known():
    for depths in ([], [0.0, -1.0], [np.nan, np.inf]):
        scale = DepthScale.of(np.array(depths, np.float32))
        assert 0 < scale.near < scale.far


def test_equal_ratios_of_depth_are_equal_lengths_on_the_scale():
    scale = DepthScale(2.0, 32.0)
    assert scale.fractions(np.array([2.0, 4.0, 8.0, 16.0, 32.0])) == pytest.approx([0, 0.25, 0.5, 0.75, 1])


def test_depths_of_zero_and_without_limit_take_the_colours_of_the_ends():
    scale = DepthScale(2.0, 80.0)
    assert np.array_equal(scale.colours(np.array([0.0, np.inf])), scale.map.table[[0, 255]])


@given(near=DEPTHS, ratio=st.floats(1.01, 1000.0))
def test_ticks_start_with_the_ends_and_lie_between_them(near, ratio):
    scale = DepthScale(near, near * ratio)
    ends, inner = scale.ticks()[:2], scale.ticks()[2:]
    assert ends == [scale.near, scale.far]
    assert all(scale.near < tick < scale.far for tick in inner)
    assert len(set(inner)) == len(inner)
    decades = range(math.ceil(math.log10(near * 1.01)), math.floor(math.log10(near * ratio / 1.01)) + 1)
    assert all(any(math.isclose(tick, 10.0**power) for tick in inner) for power in decades)


@pytest.mark.parametrize(
    ("near", "far"), [(0.0, 10.0), (5.0, 5.0), (8.0, 2.0), (1.0, math.inf), (math.nan, 3.0)]
)
def test_a_scale_without_extent_is_refused(near, far):
    with pytest.raises(OptionError, match="0 < near < far"):
        DepthScale(near, far)
