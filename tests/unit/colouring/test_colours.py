import math

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring.blending import colour_points
from sceneloom.colouring.results import FusedView
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.kernels.projection import pixel_numbers


def make_view(point_ids, pixels, rgb, visible=None):
    height, width = rgb.shape[:2]
    count = len(point_ids)
    return FusedView(
        "c",
        Camera("pinhole", width, height, 100.0, 100.0, 0.0, 0.0),
        0,
        RigidTransform.identity(),
        rgb,
        np.array(point_ids, np.int64),
        np.array(pixels, np.float32).reshape(count, 2),
        pixel_numbers(np.array(pixels, np.float32).reshape(count, 2), width, height),
        np.ones(count, np.float32),
        np.ones(count, bool) if visible is None else np.array(visible, bool),
        np.zeros((height, width), np.float32),
        np.zeros((max(point_ids, default=-1) + 1, 3)),
    )


def plain(color, size=(4, 6)):
    return np.full((*size, 3), color, np.uint8)


def test_unseen_points_are_white_and_have_no_camera():
    colors, camera_index = colour_points(3, [make_view([1], [(2, 1)], plain((1, 2, 3)))], [4])
    assert colors.tolist() == [[255] * 3, [1, 2, 3], [255] * 3]
    assert camera_index.tolist() == [255, 4, 255]
    assert colors.dtype == camera_index.dtype == np.uint8


def test_without_views_no_point_has_a_colour():
    colors, camera_index = colour_points(2, [], [])
    assert colors.tolist() == [[255] * 3] * 2
    assert camera_index.tolist() == [255, 255]


def test_an_empty_cloud_has_no_colours():
    colors, camera_index = colour_points(
        0, [make_view([], [], plain(0)), make_view([], [], plain(0))], [0, 1]
    )
    assert colors.shape == (0, 3)
    assert camera_index.shape == (0,)


def test_hidden_points_take_no_colour():
    view = make_view([0, 1], [(1, 1), (1, 1)], plain((9, 9, 9)), visible=[False, True])
    assert colour_points(2, [view], [0])[1].tolist() == [255, 0]


def test_the_nearest_pixel_gives_the_colour():
    rgb = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    pixels = [(0.49, 0), (0.5, 0), (4.2, 2.7), (-0.5, -0.5), (5.49, 3.49)]
    colors, _ = colour_points(5, [make_view(range(5), pixels, rgb)], [0])
    nearest = [rgb[0, 0], rgb[0, 1], rgb[3, 4], rgb[0, 0], rgb[3, 5]]
    np.testing.assert_array_equal(colors, nearest)


def test_the_most_central_view_counts_in_units_of_half_the_diagonal():
    small, large = plain((1, 1, 1), (30, 40)), plain((2, 2, 2), (300, 400))
    # 5 px off the centre of the small image are a fifth of its half diagonal, 40 px of the large one 0.16.
    views = [make_view([0], [(24.5, 14.5)], small), make_view([0], [(239.5, 149.5)], large)]
    assert colour_points(1, views, [7, 8])[1].tolist() == [8]
    views = [make_view([0], [(24.5, 14.5)], small), make_view([0], [(259.5, 149.5)], large)]
    assert colour_points(1, views, [7, 8])[1].tolist() == [7]


def test_of_equally_central_views_the_first_counts():
    views = [make_view([0], [(1, 2)], plain(color)) for color in (10, 20, 30)]
    assert colour_points(1, views, [2, 1, 0])[1].tolist() == [2]


def test_a_view_that_hides_a_point_leaves_it_to_the_others():
    views = [
        make_view([0], [(2.5, 1.5)], plain((1, 1, 1)), visible=[False]),
        make_view([0], [(0, 0)], plain((2, 2, 2))),
    ]
    colors, camera_index = colour_points(1, views, [0, 1])
    assert (colors.tolist(), camera_index.tolist()) == ([[2, 2, 2]], [1])


def test_many_views_agree_with_a_choice_made_point_by_point():
    random = np.random.default_rng(1)
    views = []
    for size in ((4, 6), (9, 5), (1, 1)):
        ids = np.sort(random.permutation(50)[:35])
        pixels = random.uniform(-0.5, np.array(size[::-1]) - 0.5, (35, 2))
        rgb = random.integers(0, 255, (*size, 3), np.uint8)
        views.append(make_view(ids, pixels, rgb, random.random(35) < 0.8))
    colors, camera_index = colour_points(50, views, [5, 0, 254])
    for k in range(50):
        best, expected = math.inf, ([255] * 3, 255)
        for view, index in zip(views, (5, 0, 254), strict=True):
            for i in np.flatnonzero((view.point_ids == k) & view.visible):
                (u, v), (height, width) = view.pixels[i].tolist(), view.rgb.shape[:2]
                off = math.hypot(u - (width - 1) / 2, v - (height - 1) / 2) / math.hypot(width, height)
                if off < best:
                    color = view.rgb[math.floor(v + 0.5), math.floor(u + 0.5)]
                    best, expected = off, (color.tolist(), index)
        assert (colors[k].tolist(), camera_index[k]) == expected


def test_images_in_any_memory_order_are_taken():
    rgb = np.random.default_rng(2).integers(0, 255, (4, 6, 3), np.uint8)
    upside_down = np.ascontiguousarray(rgb[::-1])[::-1]
    upside_down.flags.writeable = False
    view = make_view([0, 1], [(5, 3), (0, 2)], upside_down)
    np.testing.assert_array_equal(colour_points(2, [view], [0])[0], [rgb[3, 5], rgb[2, 0]])


@pytest.mark.parametrize("indices", [[], [0, 1], [255], [-1]])
def test_camera_indices_that_cannot_be_written_are_refused(indices):
    with pytest.raises(OptionError, match="ind"):
        colour_points(1, [make_view([0], [(0, 0)], plain(0))], indices)
