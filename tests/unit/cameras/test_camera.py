"""What a camera refuses, and how a camera model looks in images of another size."""

import numpy as np
import pytest

from sceneloom.cameras import Camera, project_unbounded
from sceneloom.errors import CalibrationError


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((0, 480, 500.0, 500.0, 320.0, 240.0), "image size 0x480"),
        ((640, -1, 500.0, 500.0, 320.0, 240.0), "image size 640x-1"),
        ((640, 480, -500.0, 500.0, 320.0, 240.0), "focal lengths -500.0, 500.0"),
        ((640, 480, 500.0, 0.0, 320.0, 240.0), "focal lengths 500.0, 0.0"),
        ((640, 480, 500.0, float("nan"), 320.0, 240.0), "expected finite"),
        ((640, 480, 500.0, 500.0, float("inf"), 240.0), "expected finite"),
        ((640, 480, 500.0, 500.0, 320.0, 240.0, (0.1, float("nan"))), "expected finite"),
    ],
)
def test_numbers_that_are_no_camera_model_are_refused(numbers, message):
    with pytest.raises(CalibrationError, match=message):
        Camera("brown_conrady", *numbers)


def test_an_image_of_half_the_size_shows_corners_and_centres_where_they_belong():
    camera = Camera("pinhole", 640, 480, 500.0, 510.0, 319.5, 250.0)
    half = camera.resized(320, 240)
    points = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 3), (50, 3))
    edges, edges_half = project_unbounded(camera, points) + 0.5, project_unbounded(half, points) + 0.5
    assert np.allclose(edges_half, edges / 2)  # measured from the image's corner, everything halves


def test_each_axis_is_scaled_by_its_own_factor():
    camera = Camera("fisheye", 640, 480, 500.0, 500.0, 319.5, 239.5, (0.1, 0.2)).resized(1280, 120)
    assert camera == Camera("fisheye", 1280, 120, 1000.0, 125.0, 639.5, 59.5, (0.1, 0.2))
    assert hash(camera) == hash(Camera("fisheye", 1280, 120, 1000.0, 125.0, 639.5, 59.5, (0.1, 0.2)))
    sheared = Camera("omnidir", 640, 480, 300.0, 300.0, 319.5, 239.5, (0.0, 0.0, 1.5, 1.1)).resized(1280, 480)
    assert sheared.coefficients == (0.0, 0.0, 3.0, 1.1)
    numbers = (0.0,) * 8 + (2.0, -4.0)
    shifted = Camera("fisheye_radial_custom", 640, 480, 300.0, 300.0, 319.5, 239.5, numbers).resized(1280, 240)
    assert shifted.coefficients[8:] == (4.0, -2.0)


ALL_AROUND = np.column_stack([np.sin(np.linspace(-1, 1, 40)), np.linspace(-0.4, 0.5, 40), np.full(40, 0.8)])


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("ftheta", (0.5, 300.0, 2.0, -3.0, -1.0)),
        ("omnidir", (-0.1, 0.02, 1.5, 1.1, 1e-3, -1e-3)),
        ("fisheye_radial_custom", (0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-3, -1e-3, 2.5, -1.5)),
    ],
)
def test_coefficients_in_pixels_grow_with_the_image(model, coefficients):
    camera = Camera(model, 640, 480, 300.0, 300.0, 319.5, 239.5, coefficients)
    twice = camera.resized(1280, 960)
    edges, edges_twice = (project_unbounded(camera_model, ALL_AROUND) + 0.5 for camera_model in (camera, twice))
    assert np.isfinite(edges).all()
    assert np.allclose(edges_twice, 2 * edges)


def test_an_ftheta_camera_model_cannot_be_made_wider_only():
    camera = Camera("ftheta", 640, 480, 300.0, 300.0, 319.5, 239.5, (0.0, 300.0))
    with pytest.raises(CalibrationError, match="expected the same for both axes of a ftheta camera model"):
        camera.resized(1280, 480)
    assert camera.resized(213, 160).coefficients[1] == pytest.approx(100.0, rel=1e-3)  # rounded to whole pixels
