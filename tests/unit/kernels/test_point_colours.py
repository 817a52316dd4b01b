import math

import numpy as np
import pytest

from sceneloom.kernels.colours import paint_points
from sceneloom.kernels.projection import pixel_numbers

WIDTH, HEIGHT, COUNT = 9, 6, 60


def painted_one_by_one(views, count):
    """Every point of every view in order, with plain Python numbers."""
    colors, camera_index, best = [[255] * 3 for _ in range(count)], [255] * count, [math.inf] * count
    for camera, (ids, pixels, visible, rgb) in enumerate(views):
        height, width = rgb.shape[:2]
        for k, (u, v), seen in zip(ids.tolist(), pixels.tolist(), visible, strict=True):
            inside = -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5
            if not (seen and inside and 0 <= k < count):
                continue
            off_center = math.hypot(u - (width - 1) / 2, v - (height - 1) / 2) / (
                math.hypot(width, height) / 2
            )
            if off_center < best[k]:
                best[k], camera_index[k] = off_center, camera
                row, column = min(math.floor(v + 0.5), height - 1), min(math.floor(u + 0.5), width - 1)
                colors[k] = rgb[row, column].tolist()
    return colors, camera_index


def random_view(seed, size=(HEIGHT, WIDTH)):
    random = np.random.default_rng(seed)
    pixels = random.uniform(-1, [size[1], size[0]], (COUNT, 2)).astype(np.float32)
    pixels[::9] = math.nan
    ids = random.permutation(COUNT + 10)[:COUNT] - 5
    return ids, pixels, random.random(COUNT) < 0.8, random.integers(0, 256, (*size, 3), np.uint8)


def painted(views, count, *, alone=False):
    colors, camera_index = np.full((count, 3), 255, np.uint8), np.full(count, 255, np.uint8)
    eccentricities = np.full(0 if alone else count, math.inf)
    for camera, (ids, pixels, visible, rgb) in enumerate(views):
        numbers = pixel_numbers(pixels, rgb.shape[1], rgb.shape[0])
        paint_points(ids, pixels, numbers, visible, rgb, camera, eccentricities, colors, camera_index)
    return colors.tolist(), camera_index.tolist()


@pytest.mark.parametrize("count", [0, 1, COUNT])
def test_each_point_takes_the_colour_of_the_view_that_shows_it_most_centrally(count):
    views = [random_view(1), random_view(2, (4, 5)), random_view(3)]
    assert painted(views, count) == painted_one_by_one(views, count)


def test_a_single_view_needs_no_comparison():
    views = [random_view(4)]
    assert painted(views, COUNT, alone=True) == painted_one_by_one(views, COUNT)


def test_of_two_equally_central_views_the_first_counts():
    view = np.zeros(1, np.int64), np.array([[2.0, 1.0]], np.float32), np.ones(1, bool)
    red, blue = (np.full((3, 5, 3), color, np.uint8) for color in ([200, 0, 0], [0, 0, 200]))
    assert painted([(*view, red), (*view, blue)], 1) == ([[200, 0, 0]], [0])


def test_read_only_images_are_taken():
    ids, pixels, visible, rgb = random_view(5)
    rgb.flags.writeable = False
    assert painted([(ids, pixels, visible, rgb)], COUNT) == painted_one_by_one(
        [(ids, pixels, visible, rgb)], COUNT
    )
