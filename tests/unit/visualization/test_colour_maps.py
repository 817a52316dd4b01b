import cv2
import numpy as np
import pytest

from sceneloom.errors import OptionError
from sceneloom.visualization.colour_scales import ANCHORS, colour_map, oklab_from_srgb, srgb_from_oklab


@pytest.mark.parametrize(
    ("rgb", "oklab"),
    [
        # The values that CSS Color Module Level 4 prints for its named colours.
        ((255, 255, 255), (1.0, 0.0, 0.0)),
        ((0, 0, 0), (0.0, 0.0, 0.0)),
        ((255, 0, 0), (0.62796, 0.22486, 0.12585)),
        ((0, 255, 0), (0.86644, -0.23389, 0.17950)),
        ((0, 0, 255), (0.45201, -0.03246, -0.31153)),
    ],
)
def test_oklab_of_named_colours_is_what_css_prints(rgb, oklab):
    # 1e-4: the published matrices of OKLab exist in two roundings.
    assert oklab_from_srgb(np.array(rgb, np.uint8)) == pytest.approx(oklab, abs=1e-4)


def test_every_colour_comes_back_from_oklab():
    levels = np.arange(0, 256, 5, dtype=np.uint8)
    rgb = np.stack(np.meshgrid(levels, levels, levels), axis=-1).reshape(-1, 3)
    assert np.array_equal(srgb_from_oklab(oklab_from_srgb(rgb)), rgb)


@pytest.mark.parametrize("name", ANCHORS)
def test_lightness_falls_along_the_whole_map(name):
    table = colour_map(name).table
    lightness = cv2.cvtColor((table[None] / 255.0).astype(np.float32), cv2.COLOR_RGB2Lab)[0, :, 0]
    # 0.5 of 100: colours are rounded to 8 bits.
    assert np.diff(lightness).max() < 0.5
    # Over six colours the fall is far above the rounding.
    assert (lightness[6:] < lightness[:-6]).all()
    assert lightness[0] - lightness[-1] > 40


@pytest.mark.parametrize("name", ANCHORS)
def test_equal_steps_of_the_value_look_equally_large(name):
    oklab = oklab_from_srgb(colour_map(name).table)
    lengths = np.linalg.norm(oklab[15::15] - oklab[:-15:15], axis=1)
    # 8 %: rounding to 8 bits, and chords across the bends of the curve.
    assert np.abs(lengths / lengths.mean() - 1).max() < 0.08


@pytest.mark.parametrize("name", ANCHORS)
def test_no_colour_of_a_map_had_to_be_clipped_visibly(name):
    anchors = np.array(ANCHORS[name])
    hue = np.deg2rad(anchors[:, 2])
    wanted = np.column_stack([anchors[:, 0], anchors[:, 1] * np.cos(hue), anchors[:, 1] * np.sin(hue)])
    nearest = np.linalg.norm(oklab_from_srgb(colour_map(name).table)[None] - wanted[:, None], axis=2).min(
        axis=1
    )
    # 0.02 is about the smallest difference that is seen side by side.
    assert nearest.max() < 0.02


def test_values_beyond_the_ends_take_the_colours_of_the_ends():
    beacon = colour_map("beacon")
    colours = beacon.colours(np.array([-3.0, 0.0, 1.0, 7.0, np.inf]))
    assert np.array_equal(colours, beacon.table[[0, 0, 255, 255, 255]])


def test_an_unknown_map_is_refused_with_the_known_ones():
    with pytest.raises(OptionError, match=r"'rainbow'.*beacon"):
        colour_map("rainbow")
