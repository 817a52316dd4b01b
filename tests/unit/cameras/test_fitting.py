"""Camera models that stand in for others: how near they come, reported by measuring them anew."""

import math

import numpy as np
import pytest

from sceneloom.cameras import MODELS, Camera, project_unbounded, unproject
from sceneloom.cameras.camera import Chart
from sceneloom.cameras.fitting import PERSPECTIVE_REACH, fit, measured_fit, nearest
from sceneloom.errors import CalibrationError, OptionError

BARREL = Camera("brown_conrady", 1920, 1080, 1200.0, 1205.0, 959.0, 541.0, (-0.2, 0.06, 1e-3, -5e-4, -0.01))
PLAIN = Camera("pinhole", 640, 480, 500.0, 510.0, 318.0, 242.0)
FISHEYE = Camera("fisheye", 1280, 960, 600.0, 601.0, 640.0, 480.0, (0.05, -0.02, 0.01, -0.003))
ALL_AROUND = Camera("fisheye", 640, 640, 140.0, 140.0, 319.5, 319.5)  # 130 degrees to each side at its corners
BACKWARDS = Camera("fisheye", 64, 64, 40.0, 40.0, 150.0, 32.0)  # looks 122 to 214 degrees aside
PRISM_AND_TILT = ("s1", "s2", "s3", "s4", "tx", "ty")
LOCATIONS = ("fx", "fy", "cx", "cy")


def largest_distance_px(exact, other, *, columns=200, rows=150):
    """Over another grid than the fit's own."""
    u, v = np.meshgrid(np.linspace(0, exact.width - 1, columns), np.linspace(0, exact.height - 1, rows))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    return np.nanmax(np.hypot(*(project_unbounded(other, unproject(exact, pixels)) - pixels).T))


def test_a_camera_model_is_found_again_by_its_own_model_and_a_pinhole_by_any_perspective_one():
    for camera in (BARREL, FISHEYE, PLAIN):
        found = fit(camera, camera.model)
        assert (found.largest_px, largest_distance_px(camera, found.camera)) == pytest.approx((0, 0), abs=1e-6)
        assert found.share == 1
    for model in MODELS:
        camera = Camera(model, 64, 48, 40.0, 40.0, 31.0, 24.0, (0.0, 40.0) if model == "ftheta" else ())
        assert fit(camera, model).largest_px < 1e-6
    other = fit(PLAIN, "brown_conrady").camera
    assert [other.fx, other.fy, other.cx, other.cy] == pytest.approx([500.0, 510.0, 318.0, 242.0])
    assert largest_distance_px(PLAIN, other) < 1e-6
    # distances are measured where both see
    measured = measured_fit(PLAIN, Camera("pinhole", 640, 480, 500.0, 510.0, 321.0, 246.0))
    assert (measured.largest_px, measured.rms_px) == pytest.approx((5.0, 5.0))
    assert (measured.share, len(measured.unheld_pixels)) == (1, 0)
    # a panorama has no distortion that could be fitted: it stands for nothing but a panorama
    for model in ("cylindrical", "equirectangular"):
        assert fit(HALF_ROUND, model).largest_px > 20
        assert fit(Camera(model, 640, 480, 200.0, 210.0, 310.0, 250.0), model).largest_px < 1e-6


def test_a_fisheye_below_eighty_degrees_is_held_by_the_rational_model_and_real_cameras_by_a_sphere_without_shift():
    found = fit(FISHEYE, "brown_conrady")
    assert found.largest_px < 0.2
    assert found.share == 1
    assert largest_distance_px(FISHEYE, found.camera) == pytest.approx(found.largest_px, rel=0.2)
    for focal, numbers in (
        (1970.0, (-0.5894, 0.66, 0.0011, -0.001, -1.0088)),
        (930.0, (-0.165, 0.0099, -7.5e-4, 5.4e-5, 0.01)),
    ):
        camera_model = Camera("brown_conrady", 1920, 1080, focal, focal, 970.0, 500.0, numbers)
        assert fit(camera_model, "omnidirectional").largest_px < 0.1


def test_the_best_pinhole_for_a_barrel_magnifies_less_than_its_axis_and_numbers_that_are_fixed_stay():
    found = fit(BARREL, "pinhole")
    at_corner = np.hypot(*(project_unbounded(found.camera, unproject(BARREL, [[0.0, 0.0]])) - [0.0, 0.0])[0])
    assert found.camera.fx < BARREL.fx
    assert 10 < found.rms_px < at_corner <= found.largest_px + 1e-9
    # no other focal length does better in the mean
    for factor in (0.99, 1.01):
        worse = Camera("pinhole", 1920, 1080, *(found.camera.fx * factor, found.camera.fy * factor), 959.0, 541.0)
        assert measured_fit(BARREL, worse).rms_px > found.rms_px
    found = fit(BARREL, "fisheye", fixed=LOCATIONS)
    assert [getattr(found.camera, name) for name in LOCATIONS] == [1200.0, 1205.0, 959.0, 541.0]
    assert found.largest_px > fit(BARREL, "fisheye").largest_px
    without = fit(FISHEYE, "brown_conrady", fixed=("k4", "k5", "k6", *PRISM_AND_TILT)).camera
    assert without.coefficients[5:8] == (0, 0, 0)
    assert without.coefficients[10:] == (0,) * 6
    # prism terms that may not be are taken over by others
    prism = Camera("brown_conrady", 1920, 1080, *(1800.0, 1800.0, 959.5, 539.5), (*(0.0,) * 10, 5e-4, 0, -3e-4))
    cut = Camera("brown_conrady", 1920, 1080, 1800.0, 1800.0, 959.5, 539.5)
    found = fit(prism, "brown_conrady", fixed=PRISM_AND_TILT)
    assert found.camera.coefficients[10:] == (0,) * 6
    assert 3 * found.rms_px < measured_fit(prism, cut).rms_px


def test_what_looks_behind_the_camera_is_held_by_models_over_the_angle_or_a_sphere_but_not_by_perspective_ones():
    found = fit(ALL_AROUND, "brown_conrady")
    rays = unproject(ALL_AROUND, found.unheld_pixels)
    assert (rays[:, 2] <= math.cos(PERSPECTIVE_REACH) + 1e-12).all()
    # a disk of 140 px per radian, out to 80 degrees, in a square of 640 px
    assert found.share == pytest.approx(math.pi * (140 * PERSPECTIVE_REACH) ** 2 / 640**2, abs=0.01)
    assert found.largest_px < 1
    message = found.message(ALL_AROUND)
    assert message.startswith("fisheye camera model reported as brown_conrady, off by up to ")
    assert message.endswith(" % of the image cannot be held")
    for model in [name for name in MODELS if MODELS[name].chart in (Chart.ANGLE, Chart.SPHERE)]:
        found, over_angle = fit(HALF_ROUND, model), MODELS[model].chart is Chart.ANGLE
        assert found.share == 1 if over_angle else found.share > 0.99
        # those of four coefficients for a polynomial of other powers; offset and skew are hard to tell from others
        assert found.largest_px < (2.5 if model == "ftheta_skewed" else 1.5 if over_angle else 5)
        if over_angle:
            assert largest_distance_px(HALF_ROUND, found.camera) <= 1.01 * found.largest_px + 1e-9
    # asymmetric terms are found, though they are factors of one another
    sides = (0.01, 0.002, 0.0, 0.5, 0.3, -0.2, 0.1, 0.004, 0.0, 0.0, 0.2, 0.3, -0.2, 0.1)
    camera_model = Camera("kannala_brandt18", 640, 480, 270.0, 270.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003, *sides))
    assert fit(camera_model, "fisheye").largest_px > 1
    assert fit(camera_model, "kannala_brandt18").largest_px < 1e-3


HALF_ROUND = Camera("fisheye", 640, 480, 230.0, 230.0, 319.5, 239.5, (0.02, -0.004))  # 97 degrees at its corners


def test_of_several_models_the_nearest_is_taken_of_equals_the_first_and_what_cannot_be_fitted_is_refused():
    assert nearest(FISHEYE, {"pinhole": (), "fisheye": (), "kannala_brandt18": ()}).camera.model == "fisheye"
    assert nearest(BARREL, {"fisheye": (), "brown_conrady": ()}).camera.model == "brown_conrady"
    assert nearest(ALL_AROUND, {"pinhole": (), "mod_kannala": ()}).camera.model == "mod_kannala"
    with pytest.raises(CalibrationError, match="pinhole holds nothing"):
        nearest(BACKWARDS, {"pinhole": ()})
    for camera, model, fixed, error, message in [
        (BARREL, "fisheye", ("xi",), OptionError, "fixed 'xi'; fisheye has fx, fy, cx, cy, k1, k2, k3, k4"),
        (BARREL, "periscope", (), CalibrationError, "camera model 'periscope'; expected one of pinhole"),
        (BACKWARDS, "pinhole", (), CalibrationError, "pinhole holds nothing of what the fisheye camera model sees"),
    ]:
        with pytest.raises(error, match=message):
            fit(camera, model, fixed=fixed)
