"""Colours of several images become one: between pixels, by weight, without ghosts, with their provenance."""

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.colouring import BlendSettings, VisibilitySettings, blend_colours, view_points
from sceneloom.colouring.blending import NO_IMAGE_NS, near_outlines, view_weights
from sceneloom.errors import OptionError
from sceneloom.geometry.rigid import RigidTransform

CAMERA = Camera("pinhole", 101, 81, 100.0, 100.0, 50.0, 40.0)
PLAIN = VisibilitySettings(enabled=False)


def looking(x: float = 0.0) -> RigidTransform:
    return RigidTransform(np.eye(3), np.array([x, 0.0, 0.0]))


def image(level: int) -> np.ndarray:
    return np.full((81, 101, 3), level, np.uint8)


def view(points, rgb, *, x=0.0, camera_id="a", timestamp_ns=0):
    points = np.asarray(points, np.float64)
    return view_points(
        points, CAMERA, looking(x), rgb, camera_id=camera_id, timestamp_ns=timestamp_ns, visibility=PLAIN
    )


def bilinear(rgb: np.ndarray, u: float, v: float) -> np.ndarray:
    """A slow answer: the four pixels around, weighted by the areas opposite to them."""
    column, row = int(np.floor(u)), int(np.floor(v))
    total = np.zeros(3)
    for dv in (0, 1):
        for du in (0, 1):
            area = abs(1 - du - (u - column)) * abs(1 - dv - (v - row))
            total += area * rgb[row + dv, column + du]
    return total


def test_colours_are_taken_between_the_pixels():
    rgb = np.random.default_rng(0).integers(0, 255, (81, 101, 3)).astype(np.uint8)
    u, v = np.array([10.25, 50.0, 99.9]), np.array([20.75, 40.5, 3.1])
    points = np.stack([(u - 50) / 100 * 5, (v - 40) / 100 * 5, np.full(3, 5.0)], axis=1)
    blended = blend_colours(points, [view(points, rgb)], [0], settings=BlendSettings(mode="best"))
    wanted = [bilinear(rgb, a, b) for a, b in zip(u, v, strict=True)]
    np.testing.assert_allclose(blended.colors, wanted, atol=0.51)  # rounding to levels


def test_the_image_that_shows_a_point_away_from_its_border_counts():
    points = np.array(
        [[2.4, 0.0, 5.0]]
    )  # 98 px: at the border of the first, 49 px from the axis of the second
    views = [view(points, image(10)), view(points, image(200), x=1.2, camera_id="b", timestamp_ns=7)]
    blended = blend_colours(points, views, [3, 5], settings=BlendSettings(mode="best"))
    assert blended.colors.tolist() == [[200, 200, 200]]
    assert blended.sources.camera_index.tolist() == [5]
    assert blended.sources.images_ns.tolist() == [7]
    np.testing.assert_allclose(blended.sources.pixels, [[74.0, 40.0]], atol=1e-4)


def test_the_mean_holds_only_colours_that_agree_with_the_best_one():
    points = np.array([[0.0, 0.0, 5.0]])
    near = [view(points, image(100)), view(points, image(110), camera_id="b")]
    far = view(points, image(250), camera_id="c", x=0.5)
    assert blend_colours(points, near, [0, 1]).colors.tolist() == [[105, 105, 105]]
    assert blend_colours(points, [*near, far], [0, 1, 2]).colors.tolist() == [[105, 105, 105]]


def test_a_point_measured_long_before_an_image_takes_the_colour_of_the_other_one():
    points, times = np.array([[0.0, 0.0, 5.0]]), np.array([0])
    views = [view(points, image(10), timestamp_ns=200_000_000), view(points, image(200), camera_id="b")]
    blended = blend_colours(points, views, [0, 1], timestamps_ns=times, settings=BlendSettings(mode="best"))
    assert blended.colors.tolist() == [[200, 200, 200]]


def test_a_surface_seen_along_itself_takes_the_colour_of_the_camera_that_faces_it():
    points = np.array([[1.0, 0.0, 5.0]])
    along = np.array([[0.98058, 0.0, -0.19612]], np.float32)  # at a right angle to the first line of sight
    views = [view(points, image(10)), view(points, image(200), x=3.0, camera_id="b")]
    settings = BlendSettings(mode="best")
    facing = blend_colours(points, views, [0, 1], normals_world=along, settings=settings)
    assert facing.colors.tolist() == [[200, 200, 200]]
    assert blend_colours(points, views, [0, 1], settings=settings).colors.tolist() == [[10, 10, 10]]


def test_gains_multiply_colours_and_are_cut_off_at_white():
    points = np.array([[0.0, 0.0, 5.0]])
    blended = blend_colours(points, [view(points, image(100))], [4], gains={4: np.array([0.5, 1.0, 3.0])})
    assert blended.colors.tolist() == [[50, 100, 255]]


def test_points_that_no_image_shows_stay_white_and_name_no_image():
    points = np.array([[0.0, 0.0, -5.0], [np.nan, 0.0, 1.0]])
    blended = blend_colours(points, [view(points, image(10))], [0])
    assert (blended.colors == 255).all()
    assert (blended.sources.camera_index == 255).all()
    assert (blended.sources.images_ns == NO_IMAGE_NS).all()
    assert np.isnan(blended.sources.pixels).all()
    assert blend_colours(points, [], []).colors.shape == (2, 3)


def test_points_beside_an_outline_are_trusted_less():
    u = np.arange(20, 81, 2.0)
    z = np.where(u < 50, 5.0, 12.0)  # a wall that ends before a farther one
    points = np.stack([(u - 50) / 100 * z, np.zeros(len(u)), z], axis=1)
    seen = view(points, image(100))
    beside = near_outlines(seen)
    assert beside[np.abs(u - 49) < 2].all()
    assert not beside[np.abs(u - 50) > 8].any()
    weights = view_weights(points, seen, BlendSettings(even_distance=1e6))
    assert weights[14] < 0.2 * weights[0]


def test_a_road_seen_at_a_grazing_angle_is_no_outline():
    z, x = (axis.ravel() for axis in np.meshgrid(np.linspace(5, 60, 60), np.linspace(-2, 2, 9)))
    points = np.stack([x, np.full(len(z), 1.6), z], axis=1)
    assert not near_outlines(view(points, image(100))).any()


@pytest.mark.parametrize("wrong", [{"mode": "mean"}, {"even_distance": 0.0}, {"border_share": 2.0}])
def test_settings_that_mean_nothing_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        BlendSettings(**wrong)


def test_an_index_is_needed_for_each_view():
    points = np.array([[0.0, 0.0, 5.0]])
    with pytest.raises(OptionError, match="0 camera indices for 1 views"):
        blend_colours(points, [view(points, image(1))], [])
    with pytest.raises(OptionError, match="index 255"):
        blend_colours(points, [view(points, image(1))], [255])
