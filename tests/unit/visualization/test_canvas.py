from decimal import ROUND_FLOOR, Decimal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sceneloom.visualization.canvas import Canvas, count_text, seconds_text, text_height


@given(st.integers(-(2**63), 2**63 - 1))
def test_times_are_written_exactly_and_rounded_down(timestamp_ns):
    seconds = (Decimal(timestamp_ns) / 10**9).quantize(Decimal("0.001"), rounding=ROUND_FLOOR)
    assert seconds_text(timestamp_ns) == f"{seconds:.3f} s".replace("-0.000", "0.000")


def test_counts_agree_with_their_nouns():
    assert [count_text(n, "point") for n in (0, 1, 12345)] == ["0 points", "1 point", "12,345 points"]


@given(st.text(max_size=60), st.floats(20, 300))
def test_fitted_text_is_never_wider_than_its_room(text, room):
    canvas = Canvas.blank(10, 10, text_px=16)
    assert canvas.text_width(canvas.fitted(text, room)) <= room


def test_text_that_fits_is_not_touched():
    assert Canvas.blank(10, 10, text_px=16).fitted("front\n camera", 1000) == "front camera"


def test_a_polygon_covers_its_area_around_its_middle():
    canvas = Canvas.blank(60, 50, text_px=12, colour=(0, 0, 0))
    canvas.polygon([(10.5, 10.0), (40.5, 10.0), (40.5, 30.0), (10.5, 30.0)], (200, 0, 0))
    red = np.asarray(canvas.image)[..., 0] / 200.0
    # 30 x 20 pixels; Pillow draws the outline too: half a fine pixel, an eighth of a pixel, on every side.
    assert red.sum() == pytest.approx(30 * 20, rel=0.025)
    rows, columns = np.indices(red.shape)
    assert (columns * red).sum() / red.sum() == pytest.approx(25.5, abs=0.13)
    assert (rows * red).sum() / red.sum() == pytest.approx(20.0, abs=0.13)


@pytest.mark.parametrize(
    ("size", "least", "most"), [((640, 384), 12, 13), ((1242, 375), 14, 20), ((1920, 1080), 22, 32)]
)
def test_letters_grow_with_the_image(size, least, most):
    assert least <= text_height(*size) <= most
