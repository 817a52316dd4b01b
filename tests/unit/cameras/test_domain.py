"""Where camera models end: against folds that are known on paper."""

import math

import numpy as np
import pytest

from sceneloom.cameras import Camera, domain_angle, intrinsics_vector, project_unbounded, unproject

SIZE = (640, 480, 500.0, 510.0, 318.7, 243.2)


@pytest.mark.parametrize(
    ("model", "coefficients", "angle"),
    [
        ("pinhole", (), math.pi / 2),
        ("brown_conrady", (-0.3,), math.atan(math.sqrt(1 / 0.9))),
        ("fisheye", (), math.pi),
        ("fisheye", (-0.2,), math.sqrt(1 / 0.6)),
        ("mod_equi_fish", (9.0, -0.2), math.sqrt(1 / 0.6)),
        ("mod_equi_fish", (0.0, 0.0, -0.1), (1 / 0.4) ** (1 / 3)),
        ("mod_kannala", (), math.pi),
        ("mod_kannala", (-0.5,), math.tan(math.sqrt(1 / 1.5))),
        ("ftheta", (0.0, 300.0, -75.0), 2.0),
        ("ftheta", (3.0, -300.0), 0.0),
        ("cylindrical", (), math.pi),
        ("equirectangular", (), math.pi),
        ("omnidirectional", (), math.pi / 2),
        ("omnidirectional", (0,) * 6 + (0.5,), math.acos(-0.5)),
        ("omnidirectional", (0,) * 6 + (1.0,), math.pi),
        ("omnidirectional", (0,) * 6 + (2.0,), math.acos(-0.5)),
        ("omnidirectional", (0,) * 6 + (-2.0,), 0.0),
        ("omnidirectional", (-1 / 3,) + (0,) * 5 + (1.0,), 2 * math.atan(1.0)),
        ("omnidir", (0.0, 0.0, 5.0, 2.0), math.acos(-0.5)),
        ("fisheye_rad_tan_prism", (-0.2,), math.sqrt(1 / 0.6)),
        ("fisheye_radial_custom", (0.0, -0.04), (1 / 0.2) ** 0.25),
        ("kannala_brandt18", (-0.2,), math.sqrt(1 / 0.6)),
        ("kannala_brandt18", (0,) * 4 + (0.5, 0, 0, 0, 0, 3.0), 0.0),  # inward along y from the start
    ],
)
def test_camera_models_reach_as_far_as_paper_says(model, coefficients, angle):
    camera = Camera(model, *SIZE, tuple(map(float, coefficients)))
    assert domain_angle(camera) == pytest.approx(angle, abs=2e-6)


def test_a_tangential_fisheye_ends_where_it_folds_first_in_any_direction():
    # With p1 = 0.1 in OpenCV's sense y' = y + 0.1 (x² + 3 y²): it rotates at y = -1/0.6, straight up.
    camera = Camera("fisheye_radial_custom", *SIZE, (0.0,) * 6 + (0.1, 0.0))
    assert domain_angle(camera) == pytest.approx(1 / 0.6, rel=1e-3)
    # p1 of the other model is OpenCV's p2, which bends x.
    other = Camera("fisheye_rad_tan_prism", *SIZE, (0.0,) * 6 + (0.1, 0.0))
    assert domain_angle(other) == pytest.approx(1 / 0.6, rel=1e-3)
    beyond = 1 / 0.6 + 0.02
    assert np.isnan(project_unbounded(camera, [[0.0, -math.sin(beyond), math.cos(beyond)]])).all()


@pytest.mark.parametrize("size", [1e-3, 2e-4, 1e-5, 1e-6])
def test_the_slightest_decentring_ends_a_perspective_camera_model_where_it_folds(size):
    # x' = x + 3 p2 x² along y = 0: it rotates at x = -1/(6 p2), and is back in the middle at twice that
    camera = Camera("brown_conrady", *SIZE, (0.0, 0.0, 0.0, size))
    # the limit is sought in steps of angles, whose tangents are 2 % apart here, and kept inside
    assert 0.97 / (6 * size) < math.tan(domain_angle(camera)) < 1 / (6 * size)
    seen = project_unbounded(camera, [[-0.9 / (6 * size), 0.0, 1.0], [-2 / (6 * size), 0.0, 1.0]])
    assert np.isnan(seen).all(axis=1).tolist() == [False, True]


def test_asymmetric_terms_end_a_camera_model_where_they_rotate_it_inward():
    # r = θ + θ (0.2 θ²)·(-1) along x only: l2 = 0.2, i3 = cos 2φ gives -1 along y and +1 along x.
    camera = Camera("kannala_brandt18", *SIZE, (0.0,) * 4 + (0.0, 0.2, 0.0, 0.0, 0.0, 1.0))
    assert 0.5 < domain_angle(camera) < math.sqrt(1 / 0.6)  # along y it folds there at the latest


def test_pixels_beyond_the_seam_of_a_panorama_look_nowhere():
    for model in ("cylindrical", "equirectangular"):
        camera = Camera(model, *SIZE)
        edge = SIZE[2] * math.pi
        pixels = [[SIZE[4] + 0.999 * edge, 240.0], [SIZE[4] - 1.001 * edge, 240.0], [SIZE[4] + edge, 240.0]]
        rays = unproject(camera, pixels)
        assert np.isfinite(rays).all(axis=1).tolist() == [True, False, True]
        assert rays[0, 2] < -0.99


def test_pixels_above_the_pole_of_an_equirectangular_image_look_nowhere():
    camera = Camera("equirectangular", *SIZE)
    high = SIZE[3] * math.pi / 2
    rays = unproject(
        camera, [[300.0, SIZE[5] - 0.99 * high], [300.0, SIZE[5] - 1.01 * high], [300.0, SIZE[5] + 2 * high]]
    )
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False, False]
    assert rays[0, 1] < -0.99


def test_nothing_is_seen_straight_up_or_down_in_a_panorama():
    for model in ("cylindrical", "equirectangular"):
        pixels = project_unbounded(Camera(model, *SIZE), [[0, 1, 0], [0, -3, 0], [1e-9, 1, 0], [1e-3, 1, 0]])
        assert np.isfinite(pixels).all(axis=1).tolist() == [False, False, False, True]


def test_the_middle_of_an_ftheta_image_with_an_offset_shows_nothing():
    camera = Camera("ftheta", *SIZE, (5.0, 300.0))
    assert np.isnan(project_unbounded(camera, [[0.0, 0.0, 1.0]])).all()
    rays = unproject(camera, [[SIZE[4], SIZE[5]], [SIZE[4] + 4.9, SIZE[5]], [SIZE[4] + 5.1, SIZE[5]]])
    assert np.isfinite(rays).all(axis=1).tolist() == [False, False, True]


def test_directions_that_an_ftheta_polynomial_takes_through_the_centre_have_no_pixel():
    camera = Camera("ftheta", *SIZE, (-30.0, 300.0))  # negative up to 0.1 rad
    points = [[math.sin(angle), 0.0, math.cos(angle)] for angle in (0.0, 0.05, 0.1 - 1e-9, 0.11)]
    assert np.isfinite(project_unbounded(camera, points)).all(axis=1).tolist() == [False, False, False, True]


def test_the_far_side_of_the_shifted_sphere_is_hidden():
    camera = Camera("omnidirectional", *SIZE, (0.0,) * 6 + (2.0,))
    edge = math.acos(-0.5)
    points = [[0.0, math.sin(angle), math.cos(angle)] for angle in (edge - 1e-3, edge + 1e-3, 3.1)]
    assert np.isfinite(project_unbounded(camera, points)).all(axis=1).tolist() == [True, False, False]
    farthest = SIZE[3] / math.sqrt(3.0)
    rays = unproject(camera, [[SIZE[4], SIZE[5] + 0.999 * farthest], [SIZE[4], SIZE[5] + 1.001 * farthest]])
    assert np.isfinite(rays).all(axis=1).tolist() == [True, False]


@pytest.mark.parametrize(
    "model", ["brown_conrady", "fisheye_rad_tan_prism", "kannala_brandt18", "omnidirectional"]
)
def test_a_camera_model_that_folds_at_its_centre_sees_nothing(model):
    coefficients = {
        "brown_conrady": (0.0, 0.0, 10.0, 10.0, 0.0, 0.0, 0.0, 0.0, 3.0, -3.0),
        "fisheye_rad_tan_prism": (-1e6,),
        "kannala_brandt18": (0.0,) * 4 + (1.0, 0.0, 0.0, 9.0),
        "omnidirectional": (0.0, 0.0, 0.0, 0.0, 10.0, 10.0, 1.0, 3.0, -3.0),
    }[model]
    camera = Camera(model, *SIZE, coefficients)
    assert intrinsics_vector(camera)[-1] < 1e-2
    assert np.isnan(unproject(camera, [[10.0, 10.0], [600.0, 20.0]])).all()
