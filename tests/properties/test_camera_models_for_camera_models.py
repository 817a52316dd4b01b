"""Camera models that stand in for others, whatever the camera model: what is reported them holds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneloom.cameras import MODELS, Camera, Undistortion, fit, project_unbounded, undistorted_camera, unproject
from sceneloom.errors import CalibrationError

SMALL = (64, 48)
LARGEST = {"k": 0.05, "p": 0.01, "l": 0.02, "s": 0.01, "t": 0.1, "d": 0.5, "i": 1.0, "m": 0.02, "j": 1.0, "x": 2.0}
"""By first letter, how large a coefficient may be."""
IN_PIXELS = ((0.0, 0.0), (25.0, 60.0), (-3.0, 3.0), (-3.0, 3.0), (-1.0, 1.0))
"""Ranges of the coefficients of `ftheta`."""


def any_camera_model() -> st.SearchStrategy[Camera]:
    """Plausible camera models of all models."""
    return st.sampled_from(sorted(MODELS)).flatmap(camera_model_of)


def camera_model_of(model: str) -> st.SearchStrategy[Camera]:
    usual = [(0.0 if name == "xi" else -LARGEST[name[0]], LARGEST[name[0]]) for name in MODELS[model].coefficient_names]
    ranges = IN_PIXELS if model == "ftheta" else usual
    values = st.tuples(*(st.floats(low, high) for low, high in ranges))
    return values.map(lambda numbers: Camera(model, *SMALL, 40.0, 42.0, 31.0, 25.0, numbers))


@given(any_camera_model(), st.floats(0, 1))
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


@given(any_camera_model(), st.sampled_from(sorted(MODELS)))
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


@pytest.mark.parametrize("model", sorted(MODELS))
def test_an_exact_camera_model_needs_no_fit(model):
    camera = Camera(model, *SMALL, 40.0, 40.0, 31.0, 24.0, (0.0, 40.0) if model == "ftheta" else ())
    assert fit(camera, model).largest_px < 1e-6
