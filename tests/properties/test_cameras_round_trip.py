"""Projecting undoes unprojecting, whatever the lens."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from sceneloom.cameras import Camera, lens_vector, project, project_unbounded, unproject

SIZE_AND_FOCUS = (640, 480, 400.0, 420.0, 310.0, 250.0)

brown_conrady = st.tuples(
    st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), *[st.floats(-0.01, 0.01)] * 2, st.floats(-0.1, 0.1),
    *[st.floats(-0.3, 0.3)] * 3, *[st.floats(-0.02, 0.02)] * 2, *[st.floats(-0.01, 0.01)] * 4,
    *[st.floats(-0.1, 0.1)] * 2,
)  # fmt: skip
cameras = st.one_of(
    st.just(Camera("pinhole", *SIZE_AND_FOCUS)),
    st.builds(
        lambda k, n: Camera("brown_conrady", *SIZE_AND_FOCUS, k[:n]), brown_conrady, st.integers(0, 16)
    ),
    st.builds(lambda k: Camera("fisheye", *SIZE_AND_FOCUS, k), st.tuples(*[st.floats(-0.05, 0.05)] * 4)),
)
places = arrays(np.float64, (20, 2), elements=st.floats(0, 1))


def widest_angle(camera: Camera) -> float:
    """How far off the axis the lens is asked: most of its domain, and not so far that pixels lose their digits."""
    limit = float(lens_vector(camera)[-1])
    return 0.95 * limit if camera.model == "fisheye" else min(0.95 * math.atan(limit), 1.3)


@settings(max_examples=300, deadline=None)
@given(cameras, places)
def test_pixels_look_along_the_rays_that_reach_them(camera, places):
    angle, about = widest_angle(camera) * places[:, 0], 2 * math.pi * places[:, 1]
    rays = np.column_stack([np.sin(angle) * np.cos(about), np.sin(angle) * np.sin(about), np.cos(angle)])
    pixels = project_unbounded(camera, rays)
    seen = np.isfinite(pixels).all(axis=1)  # a tilted plane may turn its back on the rim
    assert seen.all() or any(camera.coefficients[14:])
    back = project_unbounded(camera, unproject(camera, pixels[seen]))
    # 1e-12 of the distance from the centre is what the iterations promise, times the focal length
    allowed = 1e-9 * (1 + np.linalg.norm(pixels[seen] - (camera.cx, camera.cy), axis=1, keepdims=True) / 400)
    assert (np.abs(back - pixels[seen]) < allowed).all()


@settings(max_examples=300, deadline=None)
@given(cameras, places)
def test_pixels_have_a_ray_that_comes_back_or_none(camera, places):
    pixels = places * (camera.width, camera.height) - 0.5
    rays = unproject(camera, pixels)
    found = np.isfinite(rays).all(axis=1)
    assert np.isnan(rays[~found]).all()
    back = project_unbounded(camera, rays[found])
    assert np.abs(back - pixels[found]).max(initial=0) < 1e-8


@settings(max_examples=200, deadline=None)
@given(cameras, arrays(np.float64, (10, 3), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_whatever_the_points_the_visible_ones_lie_in_the_picture(camera, points):
    pixels, visible = project(camera, points)
    assert np.isnan(pixels[~visible]).all()
    inside = (pixels[visible] >= -0.5) & (pixels[visible] < (camera.width - 0.5, camera.height - 0.5))
    assert inside.all()
