from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sceneloom.visualization import DepthScale, draw_depth_image, draw_overlay
from sceneloom.visualization.canvas import STRIP, Canvas
from sceneloom.visualization.colour_scales import colour_map, placed_ticks
from sceneloom.visualization.fused_frames import NO_DEPTH, view_scale

SCALE = DepthScale(2.0, 50.0)


def _pixels(image):
    return np.asarray(image)


def _bar(image, view):
    """The row of colours in the strip that is as bright and colourful as only the scale bar is."""
    strip = _pixels(image)[view.camera.height :].astype(int)
    colourful = (strip.max(axis=2) - strip.min(axis=2)) > 60
    row = int(np.argmax(colourful.sum(axis=1)))
    columns = np.flatnonzero(colourful[row])
    return strip[row, columns[0] : columns[-1] + 1]


@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
def test_a_point_is_a_disc_in_the_colour_of_its_depth_at_its_pixel(make_view, draw):
    view = make_view([(60, 40, 10.0, True), (150, 90, 30.0, True)])
    drawn = _pixels(draw(view, scale=SCALE))
    for u, v, depth in ((60, 40, 10.0), (150, 90, 30.0)):
        share = np.log(depth / 2.0) / np.log(50.0 / 2.0)
        assert np.array_equal(drawn[v, u], colour_map("beacon").table[round(share * 255)])


def test_near_points_cover_far_ones(make_view):
    view = make_view([(60, 40, 40.0, True), (60, 40, 4.0, True), (60, 40, 20.0, True)])
    drawn = _pixels(draw_overlay(view, scale=SCALE))
    assert np.array_equal(drawn[40, 60], SCALE.colours(np.array([4.0]))[0])


def test_hidden_points_are_drawn_only_on_request_and_then_as_crosses(make_view):
    view = make_view([(60, 40, 10.0, True), (150, 90, 30.0, False)])
    without, crossed = _pixels(draw_overlay(view)), _pixels(draw_overlay(view, show_hidden=True))
    assert np.array_equal(without[90, 150], without[10, 10])
    changed = np.argwhere((without[: view.camera.height] != crossed[: view.camera.height]).any(axis=2))
    assert {(90, 150), (89, 149), (91, 151), (89, 151), (91, 149)} == {
        tuple(location) for location in changed.tolist()
    }
    assert np.ptp(crossed[90, 150].astype(int)) < 20


def test_the_image_below_is_darker_and_greyer(make_view):
    view = make_view([])
    rgb = view.rgb.copy()
    rgb[:, :] = (200, 100, 40)
    below = _pixels(draw_overlay(replace(view, rgb=rgb)))[10, 10].astype(int)
    assert below.max() < 200
    assert np.ptp(below) < 160 * below.mean() / (340 / 3)
    assert below[0] > below[1] > below[2]


def test_pixels_without_depth_are_darker_than_any_depth(make_view):
    drawn = _pixels(draw_depth_image(make_view([(60, 40, 10.0, True)])))
    assert tuple(drawn[100, 20]) == NO_DEPTH
    darkest = min(colour_map(name).table.max(axis=1).min() for name in ("beacon", "lagoon"))
    assert max(NO_DEPTH) < darkest / 4


@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
def test_the_ends_of_the_scale_bar_have_the_colours_of_the_ends_of_the_range(make_view, draw):
    view = make_view([(60, 40, 2.0, True), (150, 90, 50.0, True)])
    image = draw(view, scale=SCALE)
    bar = _bar(image, view)
    drawn = _pixels(image)
    # The outermost columns of the bar may be less colourful than what `_bar` looks for: 3 levels of 255.
    assert np.abs(bar[0] - drawn[40, 60]).max() <= 3
    assert np.abs(bar[-1] - drawn[90, 150]).max() <= 3


def test_overlay_and_depth_image_share_the_scale_of_the_visible_points(make_view):
    points = [(60, 40, 3.1, True), (100, 60, 44.0, True), (150, 90, 400.0, False)]
    view = make_view(points)
    scale = view_scale(view)
    assert (scale.near, scale.far) == (3.0, 50.0)
    overlay, depths = (_pixels(draw(view)) for draw in (draw_overlay, draw_depth_image))
    assert np.array_equal(overlay[60, 100], depths[60, 100])


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1), (97, 61), (641, 383), (1242, 375)])
@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
@pytest.mark.few(6)
def test_images_of_any_size_keep_their_pixels_and_cut_nothing_off(make_view, draw, size):
    width, height = size
    view = make_view([(width - 1, height - 1, 10.0, True)], width=width, height=height, camera_id="c" * 300)
    image = draw(view)
    assert image.width >= width
    assert image.height > height
    drawn = _pixels(image)
    assert np.array_equal(drawn[height - 1, width - 1], view_scale(view).colours(np.array([10.0]))[0])
    rim = np.concatenate([drawn[height:, :3], drawn[height:, -3:]], axis=1)
    assert (rim == STRIP).all()
    assert (drawn[-2:] == STRIP).all()


@pytest.mark.parametrize("points", [[], [(60, 40, 10.0, False)]])
@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
def test_views_without_visible_points_are_drawn_too(make_view, draw, points):
    view = make_view(points)
    drawn = _pixels(draw(view))[: view.camera.height, : view.camera.width]
    assert (drawn == drawn[0, 0]).all()


@pytest.mark.parametrize("draw", [draw_overlay, draw_depth_image])
def test_drawing_twice_gives_the_same_image(make_view, draw):
    points = [(u, v, 3.0 + (u * v) % 40, True) for u in range(5, 195, 7) for v in range(5, 115, 5)]
    assert draw(make_view(points)).tobytes() == draw(make_view(points)).tobytes()


@pytest.mark.parametrize("width", [240, 640, 1920])
@pytest.mark.parametrize(("near", "far"), [(0.3, 0.4), (1.0, 2.0), (2.0, 80.0), (0.05, 600.0), (99.0, 101.0)])
def test_labels_of_the_scale_bar_do_not_touch_and_stay_on_the_canvas(near, far, width):
    canvas = Canvas.blank(width, 100, text_px=max(12, width // 70))
    first, last = width // 2, width - 2 * canvas.text_px
    ticks = placed_ticks(canvas, DepthScale(near, far), first, last)
    spans = sorted(
        (middle - canvas.text_width(label, scale=0.86) / 2, middle + canvas.text_width(label, scale=0.86) / 2)
        for _, label, middle in ticks
    )
    assert all(right < left for (_, right), (left, _) in pairwise(spans))
    assert spans[0][0] > 0
    assert spans[-1][1] < width
    assert ticks[0][0] == near
