"""Scenes whose lenses are told by another model."""

import numpy as np
import pytest

from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.editing import convert_lenses
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.scene import CameraSensor, LazyFrames, Picture, Scene

FISHEYE = Camera("fisheye", 640, 480, 320.0, 320.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003))
OTHER = Camera("fisheye", 640, 480, 330.0, 320.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003))
ALL_AROUND = Camera("fisheye", 640, 640, 140.0, 140.0, 319.5, 319.5)


def scene_of(*cameras):
    rgb = np.zeros((cameras[0].height, cameras[0].width, 3), np.uint8)
    pictures = [Picture.of(k, camera, rgb) for k, camera in enumerate(cameras)]
    return Scene((CameraSensor("front", cameras[0], LazyFrames.of(pictures, list(range(len(cameras))))),))


def distances_px(exact, other):
    pixels = np.stack(np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0)), axis=-1).reshape(-1, 2)
    return np.hypot(*(project_unbounded(other, unproject(exact, pixels)) - pixels).T)


def test_the_new_lens_shows_what_the_old_one_does_within_what_is_told():
    scene = convert_lenses(scene_of(FISHEYE), "brown_conrady")
    lens = scene.cameras[0].camera
    entry = scene.metadata["sceneloom"]["lenses"][0]
    assert lens.model == "brown_conrady"
    assert distances_px(FISHEYE, lens).max() <= entry["largest_px"] < 0.1
    assert entry["camera"]["model"] == "fisheye"
    assert tuple(entry["camera"]["coefficients"]) == FISHEYE.coefficients
    notice = scene.notices[0]
    assert (notice.code, notice.place) == ("lens-fitted", "sensors[front].camera")
    assert "fisheye lens told as brown_conrady, off by up to" in notice.message


def test_pictures_have_their_own_lenses_converted_too():
    scene = convert_lenses(scene_of(FISHEYE, OTHER), "brown_conrady")
    first, second = scene.cameras[0].pictures
    assert first.camera == scene.cameras[0].camera
    assert second.camera.model == "brown_conrady"
    assert np.nanmax(distances_px(OTHER, second.camera)) < 0.1  # corners may be given up, as the share tells


def test_a_lens_that_comes_no_nearer_than_the_limit_is_refused_with_its_distance():
    with pytest.raises(
        CalibrationError, match=r"sensors\[front\].camera: fisheye lens told as pinhole, off by up to"
    ):
        convert_lenses(scene_of(FISHEYE), "pinhole")
    assert convert_lenses(scene_of(FISHEYE), "pinhole", limit_px=500).cameras[0].camera.model == "pinhole"


def test_a_lens_that_holds_too_little_of_the_picture_is_refused_with_the_share():
    with pytest.raises(
        CalibrationError, match="% of the picture cannot be held; expected at most 1 px and 1 %"
    ):
        convert_lenses(scene_of(ALL_AROUND), "brown_conrady")
    found = convert_lenses(scene_of(ALL_AROUND), "brown_conrady", share=0.2)
    assert found.metadata["sceneloom"]["lenses"][0]["share"] < 0.5


def test_lenses_of_that_model_stay_as_they_are():
    scene = scene_of(FISHEYE)
    found = convert_lenses(scene, "fisheye")
    assert found.sensors == scene.sensors
    assert [notice.code for notice in found.notices] == ["nothing-to-convert"]


@pytest.mark.parametrize("limits", [{"limit_px": -1}, {"limit_px": float("nan")}, {"share": 1.5}])
def test_limits_that_are_none_are_refused(limits):
    with pytest.raises(OptionError, match="expected 0 px or more and a share of 0 to 1"):
        convert_lenses(scene_of(FISHEYE), "brown_conrady", **limits)


def test_unknown_models_and_cameras_are_refused():
    with pytest.raises(OptionError, match="camera model 'periscope'"):
        convert_lenses(scene_of(FISHEYE), "periscope")
    with pytest.raises(OptionError, match="no sensor 'rear'"):
        convert_lenses(scene_of(FISHEYE), "pinhole", cameras=["rear"])
