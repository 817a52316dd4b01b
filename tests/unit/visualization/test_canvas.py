"""Text, polygons, discs, colour maps and depth scales."""

import math
from decimal import ROUND_FLOOR, Decimal

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.errors import OptionError
from sceneloom.visualization import colour_scales as scales
from sceneloom.visualization.canvas import Canvas, draw_crosses, draw_discs, seconds_text, several, text_height
from sceneloom.visualization.colour_scales import ANCHORS, DepthScale, colour_map


@given(st.integers(-(2**63), 2**63 - 1))
def test_times_are_written_exactly_and_rounded_down(timestamp_ns):
    seconds = (Decimal(timestamp_ns) / 10**9).quantize(Decimal("0.001"), rounding=ROUND_FLOOR)
    assert seconds_text(timestamp_ns) == f"{seconds:.3f} s".replace("-0.000", "0.000")


def test_counts_agree_with_their_nouns_letters_grow_with_the_image_and_a_polygon_covers_its_area():
    assert [several(n, "point") for n in (0, 1, 12345)] == ["0 points", "1 point", "12,345 points"]
    for size, least, most in (((640, 384), 12, 13), ((1242, 375), 14, 20), ((1920, 1080), 22, 32)):
        assert least <= text_height(*size) <= most
    canvas = Canvas.blank(60, 50, text_px=12, colour=(0, 0, 0))
    canvas.polygon([(10.5, 10.0), (40.5, 10.0), (40.5, 30.0), (10.5, 30.0)], (200, 0, 0))
    red = np.asarray(canvas.image)[..., 0] / 200.0
    # 30 x 20 pixels; Pillow draws the outline too: half a fine pixel, an eighth of a pixel, on every side.
    assert red.sum() == pytest.approx(30 * 20, rel=0.025)
    rows, columns = np.indices(red.shape)
    assert (columns * red).sum() / red.sum() == pytest.approx(25.5, abs=0.13)
    assert (rows * red).sum() / red.sum() == pytest.approx(20.0, abs=0.13)


@given(st.text(max_size=60), st.floats(20, 300))
def test_fitted_text_is_never_wider_than_its_room_and_not_touched_if_it_fits(text, room):
    canvas = Canvas.blank(10, 10, text_px=16)
    assert canvas.text_width(canvas.fitted(text, room)) <= room
    assert canvas.fitted("front\n camera", 1000) == "front camera"


RED, BLUE, GROUND = (255, 0, 0), (0, 0, 255), (40, 40, 40)


def _ground(width=21, height=15):
    return np.full((height, width, 3), GROUND, np.uint8)


def _timestamp(points, *, radius=2.0, ground=None):
    """points: (u, v, depth, colour)."""
    return draw_discs(
        _ground() if ground is None else ground,
        np.array([p[:2] for p in points], np.float32).reshape(-1, 2),
        np.array([p[2] for p in points], np.float32),
        np.array([p[3] for p in points], np.uint8).reshape(-1, 3),
        np.asarray(radius, np.float64),
    )


def _slow_timestamp(points, radii, ground):
    """Painter's algorithm, cell by cell on a grid of half pixels."""
    fine = np.repeat(np.repeat(ground, 2, axis=0), 2, axis=1)
    height, width = fine.shape[:2]
    for (u, v, _, colour), radius in sorted(zip(points, radii, strict=True), key=lambda item: -item[0][2]):
        if radius < 1.0:
            u, v = float(np.rint(u)), float(np.rint(v))  # noqa: PLW2901
        # Corners between cells lie half a pixel off the pixels' centres.
        corner_u, corner_v = np.rint(np.float32([(u + 0.5) * 2, (v + 0.5) * 2]))
        reach = max(np.rint(radius * 2), 1)
        for row in range(height):
            for column in range(width):
                if (column + 0.5 - corner_u) ** 2 + (row + 0.5 - corner_v) ** 2 <= reach**2:
                    fine[row, column] = colour
    mean = fine.reshape(height // 2, 2, width // 2, 2, 3).astype(np.float64).mean(axis=(1, 3))
    return np.rint(mean).astype(np.uint8)


# Quarters of pixels lie exactly between two cells; both roundings would be right.
PIXELS = (st.integers(-30, last).map(lambda n: n / 5.1) for last in (120, 90))
POINTS = st.tuples(*PIXELS, st.integers(1, 1000), st.sampled_from([RED, BLUE, (0, 255, 0), (250, 250, 250)]))
RADII = st.sampled_from([0.5, 0.7, 1.0, 1.5, 2.2, 3.0])


@settings(max_examples=40, deadline=None)
@given(st.lists(POINTS, max_size=8, unique_by=lambda point: point[2]), st.lists(RADII, min_size=8, max_size=8))
def test_discs_are_those_of_a_painter_who_starts_with_the_farthest(points, radii):
    radii = radii[: len(points)]
    assert np.array_equal(_timestamp(points, radius=radii), _slow_timestamp(points, radii, _ground()))


def test_discs_lie_evenly_around_their_pixels_and_crosses_mark_their_diagonals_in_a_new_image():
    drawn = _timestamp([(10.0, 7.0, 5.0, RED)], radius=2.0)
    assert np.array_equal(drawn, drawn[:, ::-1])
    assert np.array_equal(drawn, drawn[::-1])
    assert tuple(drawn[7, 10]) == RED
    rows, columns = np.nonzero((drawn != GROUND).any(axis=2))
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (8, 12, 5, 9)
    ground = _ground()
    ground.flags.writeable = False
    drawn = _timestamp([(10.3, 6.6, 5.0, RED)], radius=0.5, ground=ground)
    assert (ground == GROUND).all()
    assert np.argwhere((drawn != ground).any(axis=2)).tolist() == [[7, 10]], "the smallest disc fills one pixel"
    assert np.array_equal(_timestamp([]), ground)
    assert np.array_equal(draw_crosses(ground, np.zeros((0, 2), np.float32), RED), ground)
    drawn = draw_crosses(ground, np.array([[5.0, 5.0], [0.0, 14.0]], np.float32), RED, arm_px=2)
    marked = {(int(row), int(column)) for row, column in np.argwhere((drawn == RED).all(axis=2))}
    first = {(5 + step, 5 + sign * step) for step in range(-2, 3) for sign in (1, -1)}
    assert marked == first | {(14, 0), (13, 1), (12, 2)}, "cut at the edges"


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
