"""Images of a known pattern, taken through a camera model, against the pattern itself as a pinhole sees it."""

from dataclasses import replace

import numpy as np
import pytest

from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.cameras.undistortion import WIDEST, Undistortion, undistort, undistorted_camera
from sceneloom.errors import ArrayError, CalibrationError, OptionError

BARREL = Camera("brown_conrady", 640, 400, 420.0, 430.0, 322.0, 195.0, (-0.28, 0.08, 1e-3, -5e-4, -0.01))
PINCUSHION = Camera("brown_conrady", 640, 400, 420.0, 430.0, 322.0, 195.0, (0.25, 0.05))
FISHEYE = Camera("fisheye", 640, 480, 200.0, 200.0, 318.0, 242.0, (0.05, -0.02, 0.01, -0.003))
BEYOND = Camera("fisheye", 640, 640, 180.0, 180.0, 319.5, 319.5)  # its corners look 145 degrees off the axis
CAMERAS = {"barrel": BARREL, "pincushion": PINCUSHION, "fisheye": FISHEYE, "beyond": BEYOND}


def grid_pattern(camera):
    """What a camera sees of a soft chequered pattern over directions, 0 to 255 in three colours."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = unproject(camera, np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(float))
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    waves = np.stack([np.sin(9 * x) * np.sin(9 * y), np.sin(13 * x + 1), np.cos(11 * y)], axis=-1)
    return (127.5 + 120 * waves).reshape(camera.height, camera.width, 3)


def border_of(camera):
    along, right, down = np.linspace(0.0, 1.0, 200), camera.width - 1.0, camera.height - 1.0
    sides = [(along * right, 0.0), (along * right, down), (0.0, along * down), (right, along * down)]
    return np.concatenate([np.column_stack(np.broadcast_arrays(*side)) for side in sides])


def test_a_pattern_goes_from_one_distorted_camera_model_to_another():  # `interop` has OpenCV's images for pinholes
    other = Camera("fisheye", 500, 300, 400.0, 400.0, 249.5, 149.5, (-0.1, 0.02))
    rgb, seen = undistort(BARREL, np.rint(grid_pattern(BARREL)).astype(np.uint8), to=other)
    assert 0.5 < seen.mean() <= 1
    # at the border, half a pixel is the border's own colour
    assert np.abs(rgb - grid_pattern(other))[seen].max() <= 1.3


@pytest.mark.parametrize("name", CAMERAS)
def test_keeping_valid_pixels_only_shows_nothing_that_the_image_does_not_and_keeping_all_everything(name):
    camera = CAMERAS[name]
    maps = Undistortion.between(camera)
    assert maps.seen.all()
    assert maps.target.fx / maps.target.fy == pytest.approx(camera.fx / camera.fy)
    larger = undistorted_camera(camera)
    wider = replace(larger, fx=0.97 * larger.fx, fy=0.97 * larger.fy)
    rays = unproject(wider, border_of(wider))
    beyond = project_unbounded(camera, rays)
    inside = ((beyond >= -0.5) & (beyond < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    # 3 % wider is too wide: it is the largest of its kind
    assert not inside.all() or np.arccos(rays[:, 2]).max() > WIDEST
    if name != "beyond":
        target, rays = undistorted_camera(camera, keep=1.0), unproject(camera, border_of(camera))
        locations = project_unbounded(target, rays[np.arccos(rays[:, 2]) < WIDEST])
        slack = 0.5  # the border was sampled at other locations
        assert ((locations > -slack) & (locations < [target.width - 1 + slack, target.height - 1 + slack])).all()
        touched = 5.0  # where the border is cut at WIDEST, the nearest sample of it lies a little inside
        assert (locations.min(axis=0) < touched).any()  # and not more than that: one pair of sides is touched
        assert 0.2 < Undistortion.between(camera, target).seen.mean() < 1


def test_between_all_and_valid_the_camera_model_goes_evenly_and_another_size_shows_the_same_part():
    valid, middle, everything = (undistorted_camera(BARREL, keep=keep) for keep in (0.0, 0.5, 1.0))
    assert everything.fx < middle.fx < valid.fx
    assert (middle.fx, middle.cy) == pytest.approx(((valid.fx + everything.fx) / 2, (valid.cy + everything.cy) / 2))
    target = undistorted_camera(BEYOND, keep=1.0)  # its camera sees behind itself
    corners = unproject(target, [[0.0, target.height / 2], [target.width - 1.0, target.height / 2]])
    assert np.allclose(np.arccos(corners[:, 2]), WIDEST, atol=1e-3)
    target = undistorted_camera(BARREL, width=1280, height=800)
    assert (target.width, target.height) == (1280, 800)
    assert Undistortion.between(BARREL, target).seen.all()
    folded = Camera("brown_conrady", 640, 480, 300.0, 300.0, 319.5, 239.5, (-0.45,))  # folds at 0.86 from the axis
    assert np.isnan(unproject(folded, [[0.0, 0.0]])).all()
    assert Undistortion.between(folded).seen.all()
    camera = Camera("pinhole", 320, 240, 300.0, 310.0, 150.0, 125.0)
    target = undistorted_camera(camera)
    assert [target.fx, target.fy, target.cx, target.cy] == pytest.approx([300.0, 310.0, 150.0, 125.0])
    rgb = np.random.default_rng(0).integers(0, 256, (240, 320, 3), np.uint8)
    out, seen = undistort(camera, rgb)
    assert seen.all()
    assert np.abs(out.astype(int) - rgb).max() <= 1  # float32 locations blend neighbours with weights of 1e-5


def test_pixels_that_no_old_one_fills_have_the_colour_asked_for_and_other_images_or_parts_are_refused():
    rgb, seen = undistort(BARREL, np.full((400, 640, 3), 200, np.uint8), keep=1.0, fill=9)
    assert 0 < seen.sum() < seen.size
    assert (rgb[seen] == 200).all()
    assert (rgb[~seen] == 9).all()
    maps = Undistortion.between(BARREL)
    assert not maps.locations.flags.writeable
    with pytest.raises(ArrayError, match=r"rgb: \(480, 640, 3\)"):
        maps.apply(np.zeros((480, 640, 3), np.uint8))
    with pytest.raises(ArrayError, match="float64"):
        maps.apply(np.zeros((400, 640, 3)))
    for keep in (-0.1, 1.5, float("nan")):
        with pytest.raises(OptionError, match="expected a number from 0"):
            undistorted_camera(BARREL, keep=keep)
    with pytest.raises(CalibrationError, match="the middle of its image looks nowhere, or more than 75 degrees"):
        undistorted_camera(Camera("fisheye", 64, 64, 20.0, 20.0, 90.0, 32.0))
