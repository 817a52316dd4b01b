import math

import numpy as np
import pytest

from sceneloom.kernels.colours import draw_depths, mark_nearest
from sceneloom.kernels.projection import pixel_numbers

WIDTH, HEIGHT = 7, 5


def pixel_of(u, v, width, height):
    """The nearest pixel, or None outside the image, whose far border counts with the last row and column."""
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        return None
    return min(math.floor(v + 0.5), height - 1), min(math.floor(u + 0.5), width - 1)


def drawn_one_by_one(pixels, depths, visible, width, height):
    image = np.zeros((height, width), np.float32)
    for (u, v), depth, seen in zip(pixels, depths, visible, strict=True):
        location = pixel_of(float(u), float(v), width, height)
        if (
            seen
            and location is not None
            and 0 < depth < math.inf
            and (image[location] == 0 or depth < image[location])
        ):
            image[location] = depth
    return image


def nearest_one_by_one(pixels, depths, image):
    locations = [pixel_of(float(u), float(v), image.shape[1], image.shape[0]) for u, v in pixels]
    return [
        location is not None and bool(depth <= max(image[location], 0))
        for location, depth in zip(locations, depths, strict=True)
    ]


def numbered(pixels, size=(WIDTH, HEIGHT)):
    return pixel_numbers(np.array(pixels, np.float32), *size)


def random_points(count, seed):
    random = np.random.default_rng(seed)
    pixels = random.uniform(-1.5, [WIDTH + 0.5, HEIGHT + 0.5], (count, 2)).astype(np.float32)
    pixels[::5] = np.round(pixels[::5] * 2) / 2  # on the borders between pixels
    depths = random.uniform(-1, 20, count).astype(np.float32)
    depths[::7] = np.round(depths[::7])
    depths[3::11] = np.array([math.nan, math.inf, -math.inf, 0])[np.arange(len(depths[3::11])) % 4]
    pixels[4::13, 0] = math.nan
    return pixels, depths, random.random(count) < 0.7


@pytest.mark.parametrize("count", [0, 1, 40, 512, 1300])
def test_each_pixel_holds_the_least_depth_of_the_visible_points_in_it(count):
    pixels, depths, visible = random_points(count, seed=count)
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    draw_depths(numbered(pixels), depths, visible, image)
    np.testing.assert_array_equal(image, drawn_one_by_one(pixels, depths, visible, WIDTH, HEIGHT))


def test_points_are_added_to_what_the_image_holds():
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    for depth in (3, 2, 4):
        draw_depths(numbered([[1, 2]]), np.array([depth], np.float32), np.ones(1, bool), image)
    assert image[2, 1] == 2


@pytest.mark.parametrize("count", [0, 1, 40, 512, 1300])
def test_a_point_is_nearest_if_its_pixel_holds_nothing_less(count):
    pixels, depths, _ = random_points(count, seed=count + 1)
    image = drawn_one_by_one(pixels, depths, np.ones(count, bool), WIDTH, HEIGHT)
    nearest = np.zeros(count, bool)
    mark_nearest(numbered(pixels), depths, image, nearest)
    assert nearest.tolist() == nearest_one_by_one(pixels, depths, image)


@pytest.mark.parametrize(
    ("u", "v", "location"),
    [
        (-0.5, -0.5, (0, 0)),
        (np.nextafter(np.float32(0.5), np.float32(0)), 0, (0, 0)),
        (0.5, 0, (0, 1)),
        (WIDTH - 0.5, HEIGHT - 0.5, (HEIGHT - 1, WIDTH - 1)),
        (np.nextafter(np.float32(0.5), np.float32(0)), 1.5, (2, 0)),
    ],
)
def test_points_on_borders_fall_into_the_pixel_after_the_border_and_never_beyond_the_last(u, v, location):
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    draw_depths(numbered([[u, v]]), np.ones(1, np.float32), np.ones(1, bool), image)
    assert np.argwhere(image).tolist() == [list(location)]


def test_an_image_of_one_pixel_takes_the_nearest_point():
    image = np.zeros((1, 1), np.float32)
    numbers = numbered([[0, 0], [0.5, 0.5], [-0.5, 0], [0.6, 0]], (1, 1))
    draw_depths(numbers, np.array([3, 2, 4, 1], np.float32), np.ones(4, bool), image)
    assert image[0, 0] == 2
