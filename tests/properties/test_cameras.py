"""Projecting undoes unprojecting, whatever the camera model; stand-ins for others are as near as is reported."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom.cameras import MODELS, Camera, Chart, Undistortion, domain_angle, fit, undistorted_camera
from sceneloom.cameras.projection import project, project_unbounded, unproject
from sceneloom.errors import CalibrationError

SIZE_AND_FOCUS = (640, 480, 400.0, 420.0, 310.0, 250.0)
PLAUSIBLE = {"k": 0.05, "p": 0.01, "l": 0.02, "s": 0.01, "t": 0.1, "d": 5.0, "i": 1.0, "m": 0.02, "j": 1.0}
"""By first letter, how large a coefficient may be; nasty camera models have up to ten times that."""
RANGES = {
    ("brown_conrady", "k1"): (-0.4, 0.4),
    ("omnidirectional", "xi"): (0.0, 2.5),
    ("omnidir", "xi"): (0.0, 2.5),
    ("ftheta", "k1"): (-5.0, 5.0),
    ("ftheta", "k2"): (200.0, 600.0),
    ("ftheta", "k3"): (-40.0, 40.0),
    ("ftheta", "k4"): (-40.0, 40.0),
    ("ftheta", "k5"): (-10.0, 10.0),
}
SEEN_ALL_AROUND = {"cylindrical", "equirectangular"}
WITH_OFFSET = {"ftheta", "ftheta_skewed"}


def camera_models(model, *, nasty=False):
    """Camera models of a model with any number of its coefficients."""
    names = MODELS[model].coefficient_names
    usual = [(-PLAUSIBLE.get(name[0], 1.0), PLAUSIBLE.get(name[0], 1.0)) for name in names]
    ranges = [RANGES.get((model, name), ends) for name, ends in zip(names, usual, strict=True)]
    numbers = (st.floats(*(end * (10 if nasty else 1) for end in ends)) for ends in ranges)
    counts = st.integers(2 if model == "ftheta" else 0, len(names))
    return st.builds(lambda values, count: Camera(model, *SIZE_AND_FOCUS, values[:count]), st.tuples(*numbers), counts)


each_model = pytest.mark.parametrize("model", MODELS)
a_third = settings(max_examples=settings.default.max_examples // 3)
"""Of the usual examples, since there are so many models."""
locations = arrays(np.float64, (20, 2), elements=st.floats(0, 1))


def rays_in_domain(camera, locations, *, part):
    """Rays within part of the domain, and not so far that pixels lose their digits."""
    reach = min(domain_angle(camera), 1.3 if MODELS[camera.model].chart is Chart.PERSPECTIVE else math.pi)
    angle, about = part * reach * locations[:, 0], 2 * math.pi * locations[:, 1]
    return np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])


def in_reach(pixels):
    """Which pixels are there, and not so far out that float64 does not know them to a millionth."""
    return np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e6).all(axis=1)


def least_angle(camera):
    """A camera model that shows the axis as a ring of pixels shows nothing right ahead: no number is near the ring."""
    return 1e-7 if camera.model in WITH_OFFSET and any(camera.coefficients[:1]) else 0.0


@each_model
@a_third
@given(st.data(), locations, st.booleans())
def test_pixels_look_along_the_rays_that_reach_them(model, data, locations, nasty):
    camera = data.draw(camera_models(model, nasty=nasty))
    rays = rays_in_domain(camera, locations, part=0.999)
    pixels = project_unbounded(camera, rays)
    seen = in_reach(pixels) & (np.arccos(rays[:, 2].clip(-1, 1)) >= least_angle(camera))
    back = project_unbounded(camera, unproject(camera, pixels[seen]))
    # 1e-12 of the distance from the centre is what the searches promise, times what a camera model magnifies near a
    # pole
    allowed = 1e-6 * (1 + np.linalg.norm(pixels[seen] - (camera.cx, camera.cy), axis=1, keepdims=True) / 1e3)
    assert (np.abs(back - pixels[seen]) < allowed).all()


@each_model
@a_third
@given(st.data(), locations)
def test_rays_come_back_from_their_pixels(model, data, locations):
    camera = data.draw(camera_models(model))
    rays = rays_in_domain(camera, locations, part=0.95)
    pixels = project_unbounded(camera, rays)
    seen = in_reach(pixels)
    if model in WITH_OFFSET:  # an offset parts the middle of its image: on the rim of that, rounding decides
        seen &= (np.linalg.norm(pixels - (camera.cx, camera.cy), axis=1) > 1e-3) & (locations[:, 0] > 1e-9)
    # some have no pixel: behind a tilted plane, straight up of a panorama, in the middle of a camera model with an
    # offset
    excused = model in SEEN_ALL_AROUND | WITH_OFFSET or any(camera.coefficients[14:])
    assert excused or np.isfinite(pixels).all()
    assert np.abs(unproject(camera, pixels[seen]) - rays[seen]).max(initial=0) < 1e-7


@each_model
@a_third
@given(st.data(), locations, st.booleans())
def test_pixels_have_a_ray_that_comes_back_or_none(model, data, locations, nasty):
    camera = data.draw(camera_models(model, nasty=nasty))
    pixels = (locations * 3 - 1) * (camera.width, camera.height)
    rays = unproject(camera, pixels)
    found = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~found]).all()
    assert np.abs(np.linalg.norm(rays[found], axis=1) - 1).max(initial=0) < 1e-12
    assert np.abs(project_unbounded(camera, rays[found]) - pixels[found]).max(initial=0) < 1e-6


@each_model
@a_third
@given(st.data(), locations, locations)
def test_no_two_rays_of_the_domain_share_a_pixel(model, data, locations, others):
    """A third oracle than the inverse: pixels of two rays lie apart, as the rays do."""
    camera = data.draw(camera_models(model))
    one, other = rays_in_domain(camera, locations, part=0.95), rays_in_domain(camera, others, part=0.95)
    apart = np.linalg.norm(one - other, axis=1)
    pixels = project_unbounded(camera, one) - project_unbounded(camera, other)
    held = in_reach(pixels) & (apart > 1e-3)
    assert (np.linalg.norm(pixels[held], axis=1) > 1e-6).all()


@each_model
@a_third
@given(st.data(), arrays(np.float64, (10, 3), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_of_any_points_the_visible_ones_lie_in_the_image_and_any_pixels_have_a_unit_ray_or_none(model, data, points):
    camera = data.draw(camera_models(model, nasty=True))
    pixels, visible = project(camera, points)
    assert np.isnan(pixels[~visible]).all()
    inside = (pixels[visible] >= -0.5) & (pixels[visible] < (camera.width - 0.5, camera.height - 0.5))
    assert inside.all()
    rays = unproject(camera, points[:, :2].copy())
    found = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~found]).all()
    assert np.abs(np.linalg.norm(rays[found], axis=1) - 1).max(initial=0) < 1e-12


SMALL = (64, 48)
small_cameras = st.sampled_from(sorted(MODELS)).flatmap(camera_models).map(lambda camera: camera.resized(*SMALL))


@given(small_cameras, st.floats(0, 1))
@settings(max_examples=80)
def test_a_pinhole_that_keeps_valid_pixels_only_shows_nothing_else(camera, keep):
    try:
        target = undistorted_camera(camera)
    except CalibrationError:
        return  # the middle of its image looks nowhere, or too far aside
    seen = Undistortion.between(camera, target).seen
    # a border that a camera model bends in waves may cut off a corner between the locations where it was sampled
    assert seen.mean() > 0.98
    wider = undistorted_camera(camera, keep=keep)
    assert wider.fx <= target.fx * (1 + 1e-9)
    assert (wider.model, wider.width, wider.height) == ("pinhole", *SMALL)


@given(small_cameras, st.sampled_from(sorted(MODELS)))
@settings(max_examples=25)
@pytest.mark.slow
def test_a_fit_reports_how_far_off_it_is(camera, model):
    try:
        found = fit(camera, model)
    except CalibrationError:
        return  # the one sees nothing of what the other does
    assert found.camera.model == model
    assert 0 <= found.share <= 1
    columns, rows = np.meshgrid(np.linspace(0, SMALL[0] - 1, 33), np.linspace(0, SMALL[1] - 1, 25))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    rays = unproject(camera, pixels)
    off = np.hypot(*(project_unbounded(found.camera, rays) - pixels).T)
    held = np.isfinite(off) & (rays[:, 2] > np.cos(np.radians(79)))
    if held.any() and found.share == 1:
        assert off[held].max() <= 1.2 * found.largest_px + 1e-6
    if model == camera.model and found.share == 1:
        assert found.rms_px < 0.5
