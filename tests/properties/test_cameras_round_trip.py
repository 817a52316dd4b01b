"""Projecting undoes unprojecting, whatever the camera model."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom.cameras import MODELS, Camera, Chart, domain_angle, project, project_unbounded, unproject

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


def camera_models(model: str, *, nasty: bool = False) -> st.SearchStrategy[Camera]:
    """Camera models of a model with any number of its coefficients."""

    def numbers(name: str) -> st.SearchStrategy[float]:
        low, high = RANGES.get((model, name), (-PLAUSIBLE.get(name[0], 1.0), PLAUSIBLE.get(name[0], 1.0)))
        return st.floats(10 * low, 10 * high) if nasty else st.floats(low, high)

    names = MODELS[model].coefficient_names
    fewest = 2 if model == "ftheta" else 0
    return st.builds(
        lambda values, count: Camera(model, *SIZE_AND_FOCUS, values[:count]),
        st.tuples(*map(numbers, names)),
        st.integers(fewest, len(names)),
    )


each_model = pytest.mark.parametrize("model", MODELS)
a_third = settings(max_examples=settings.default.max_examples // 3)
"""Of the usual examples, since there are so many models."""
locations = arrays(np.float64, (20, 2), elements=st.floats(0, 1))


def rays_in_domain(camera: Camera, locations: np.ndarray, *, part: float) -> np.ndarray:
    """Rays within part of the domain, and not so far that pixels lose their digits."""
    reach = min(domain_angle(camera), 1.3 if MODELS[camera.model].chart is Chart.PERSPECTIVE else math.pi)
    angle, about = part * reach * locations[:, 0], 2 * math.pi * locations[:, 1]
    return np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])


def in_reach(pixels: np.ndarray) -> np.ndarray:
    """Which pixels are there, and not so far out that float64 does not know them to a millionth."""
    return np.isfinite(pixels).all(axis=1) & (np.abs(pixels) < 1e6).all(axis=1)


def least_angle(camera: Camera) -> float:
    """A camera model that shows the axis as a ring of pixels shows nothing right ahead.

    No number is as near the ring.
    """
    return 1e-7 if camera.model == "ftheta" and camera.coefficients[0] != 0 else 0.0


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
    if model == "ftheta":  # an offset parts the middle of its image: on the rim of that, rounding decides
        seen &= (np.linalg.norm(pixels - (camera.cx, camera.cy), axis=1) > 1e-3) & (locations[:, 0] > 1e-9)
    # some have no pixel: behind a tilted plane, straight up of a panorama, in the middle of a camera model with an
    # offset
    excused = model in SEEN_ALL_AROUND | {"ftheta"} or any(camera.coefficients[14:])
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
    """A third oracle than the inverse: between pixels of two rays there is a trajectory.

    As there is between the rays.
    """
    camera = data.draw(camera_models(model))
    one, other = rays_in_domain(camera, locations, part=0.95), rays_in_domain(camera, others, part=0.95)
    apart = np.linalg.norm(one - other, axis=1)
    pixels = project_unbounded(camera, one) - project_unbounded(camera, other)
    held = in_reach(pixels) & (apart > 1e-3)
    assert (np.linalg.norm(pixels[held], axis=1) > 1e-6).all()


@each_model
@a_third
@given(st.data(), arrays(np.float64, (10, 3), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_whatever_the_points_the_visible_ones_lie_in_the_image(model, data, points):
    camera = data.draw(camera_models(model, nasty=True))
    pixels, visible = project(camera, points)
    assert np.isnan(pixels[~visible]).all()
    inside = (pixels[visible] >= -0.5) & (pixels[visible] < (camera.width - 0.5, camera.height - 0.5))
    assert inside.all()


@each_model
@a_third
@given(st.data(), arrays(np.float64, (10, 2), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_whatever_the_pixels_they_have_a_unit_ray_or_none(model, data, pixels):
    rays = unproject(data.draw(camera_models(model, nasty=True)), pixels)
    found = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~found]).all()
    assert np.abs(np.linalg.norm(rays[found], axis=1) - 1).max(initial=0) < 1e-12
