import math

import numpy as np
import pytest

from sceneloom.colouring.algorithms import mark_nearest
from sceneloom.kernels.projection import draw_depths, map_directions, pixel_numbers

WIDTH, HEIGHT = 7, 5


def pixel_of(u, v, width, height):
    """The nearest pixel, or None outside the image, whose far border counts with the last row and column."""
    if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
        return None
    return min(math.floor(v + 0.5), height - 1), min(math.floor(u + 0.5), width - 1)


def drawn_one_by_one(pixels, depths, visible):
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    for (u, v), depth, seen in zip(pixels.tolist(), depths, visible, strict=True):
        location = pixel_of(u, v, WIDTH, HEIGHT)
        if seen and location is not None and 0 < depth < math.inf and (image[location] == 0 or depth < image[location]):
            image[location] = depth
    return image


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
def test_each_pixel_holds_the_least_depth_of_its_visible_points_and_a_point_is_nearest_if_it_holds_nothing_less(count):
    pixels, depths, visible = random_points(count, seed=count)
    image, nearest = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros(count, bool)
    draw_depths(numbered(pixels), depths, visible, image)
    np.testing.assert_array_equal(image, drawn_one_by_one(pixels, depths, visible))
    image = drawn_one_by_one(pixels, depths, np.ones(count, bool))
    mark_nearest(numbered(pixels), depths, image, nearest)
    locations = [pixel_of(u, v, WIDTH, HEIGHT) for u, v in pixels.tolist()]
    assert nearest.tolist() == [
        location is not None and bool(depth <= max(image[location], 0))
        for location, depth in zip(locations, depths, strict=True)
    ]


def test_points_are_added_to_what_the_image_holds_and_on_borders_fall_into_the_pixel_after_them():
    image = np.zeros((HEIGHT, WIDTH), np.float32)
    for depth in (3, 2, 4):
        draw_depths(numbered([[1, 2]]), np.array([depth], np.float32), np.ones(1, bool), image)
    assert image[2, 1] == 2
    image = np.zeros((1, 1), np.float32)
    numbers = numbered([[0, 0], [0.5, 0.5], [-0.5, 0], [0.6, 0]], (1, 1))
    draw_depths(numbers, np.array([3, 2, 4, 1], np.float32), np.ones(4, bool), image)
    assert image[0, 0] == 2
    for u, v, location in [
        (-0.5, -0.5, (0, 0)),
        (np.nextafter(np.float32(0.5), np.float32(0)), 0, (0, 0)),
        (0.5, 0, (0, 1)),
        (WIDTH - 0.5, HEIGHT - 0.5, (HEIGHT - 1, WIDTH - 1)),
        (np.nextafter(np.float32(0.5), np.float32(0)), 1.5, (2, 0)),
    ]:
        image = np.zeros((HEIGHT, WIDTH), np.float32)
        draw_depths(numbered([[u, v]]), np.ones(1, np.float32), np.ones(1, bool), image)
        assert np.argwhere(image).tolist() == [list(location)]


ROTATION = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA_FROM_WORLD = np.column_stack([ROTATION, [0.3, -0.2, 1.1]])


def mapped(points_world, point_ids=None, camera_from_world=CAMERA_FROM_WORLD):
    ids = np.arange(len(points_world)) if point_ids is None else np.array(point_ids, np.int64)
    directions, inverse_ranges = np.full((2, len(ids)), 7, np.float32), np.full(len(ids), 7, np.float32)
    map_directions(np.array(points_world, np.float64), ids, camera_from_world, directions, inverse_ranges)
    return directions, inverse_ranges


def mapped_one_by_one(points_world):
    """Lambert's map by its definition: at the azimuth of the point, twice the sine of half its angle off the axis."""
    rows = []
    for point in points_world:
        x, y, z = ROTATION @ point + CAMERA_FROM_WORLD[:, 3]
        angle, azimuth = math.atan2(math.hypot(x, y), z), math.atan2(y, x)
        radius = 2 * math.sin(angle / 2)
        rows.append((radius * math.cos(azimuth), radius * math.sin(azimuth), 1 / math.hypot(x, y, z)))
    return np.array(rows).T


def test_directions_are_lamberts_map_of_the_sphere_of_the_points_asked_for():
    points = np.random.default_rng(0).normal(size=(2000, 3)) * 30
    right, down, inverse = mapped_one_by_one(points)
    directions, inverse_ranges = mapped(points)
    # Float32 keeps 6e-8 of each; range + depth cancels behind the camera, and loses digits there.
    np.testing.assert_allclose(directions, [right, down], atol=2e-5)
    ahead = np.hypot(right, down) < math.sqrt(2)
    np.testing.assert_allclose(directions[:, ahead], [right[ahead], down[ahead]], atol=5e-7)
    np.testing.assert_allclose(inverse_ranges, inverse, rtol=1e-6)
    points, some = np.random.default_rng(1).normal(size=(1025, 3)), [1024, 0, 511, 512, 1023]
    directions, _ = mapped(points)
    np.testing.assert_array_equal(directions[:, some], np.column_stack([mapped(points, [i])[0] for i in some]))
    np.testing.assert_array_equal(directions[:, some], mapped(points, some)[0])


def test_points_without_direction_have_inverse_range_zero_and_those_behind_the_camera_stay_in_the_map():
    for point, number in [
        *((point, 0) for point in ((math.nan, 0, 0), (0, math.inf, 0), (-1.1, 0.3, -0.2), (1e200, 0, 0))),
        *(((5, 0, 0), missing) for missing in (-1, 1, 2**62, -(2**63))),
    ]:
        directions, inverse_ranges = mapped([point], [number])
        assert (directions.tolist(), inverse_ranges.tolist()) == ([[0], [0]], [0])
    directions, inverse_ranges = mapped([(-9.1, 0.3, -0.2), (-9.1, 0.3 + 1e-7, -0.2)])
    assert np.isfinite(directions).all()
    assert np.hypot(*directions).max() <= 2.0001
    np.testing.assert_allclose(inverse_ranges, 1 / 8, rtol=1e-6)
