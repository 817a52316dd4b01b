"""Scenes whose camera models are reported by another model."""

import numpy as np
import pytest

from sceneloom.cameras import Camera, project_unbounded, unproject
from sceneloom.editing import convert_camera_models
from sceneloom.errors import CalibrationError, OptionError
from sceneloom.scene import CameraImage, CameraSensor, LazyFrames, Scene

FISHEYE = Camera("fisheye", 640, 480, 320.0, 320.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003))
OTHER = Camera("fisheye", 640, 480, 330.0, 320.0, 319.5, 239.5, (0.05, -0.02, 0.01, -0.003))
ALL_AROUND = Camera("fisheye", 640, 640, 140.0, 140.0, 319.5, 319.5)


def scene_of(*cameras):
    rgb = np.zeros((cameras[0].height, cameras[0].width, 3), np.uint8)
    images = [CameraImage.of(k, camera, rgb) for k, camera in enumerate(cameras)]
    return Scene((CameraSensor("front", cameras[0], LazyFrames.of(images, list(range(len(cameras))))),))


def distances_px(exact, other):
    pixels = np.stack(np.meshgrid(np.arange(0, 640, 7.0), np.arange(0, 480, 7.0)), axis=-1).reshape(-1, 2)
    return np.hypot(*(project_unbounded(other, unproject(exact, pixels)) - pixels).T)


def test_the_new_camera_model_shows_what_the_old_one_does_within_what_is_reported():
    scene = convert_camera_models(scene_of(FISHEYE), "brown_conrady")
    camera_model = scene.cameras[0].camera
    entry = scene.metadata["sceneloom"]["camera_models"][0]
    assert camera_model.model == "brown_conrady"
    assert distances_px(FISHEYE, camera_model).max() <= entry["largest_px"] < 0.1
    assert entry["camera"]["model"] == "fisheye"
    assert tuple(entry["camera"]["coefficients"]) == FISHEYE.coefficients
    warning = scene.warnings[0]
    assert (warning.code, warning.location) == ("camera-model-fitted", "sensors[front].camera")
    assert "fisheye camera model reported as brown_conrady, off by up to" in warning.message


def test_images_have_their_own_camera_models_converted_too():
    scene = convert_camera_models(scene_of(FISHEYE, OTHER), "brown_conrady")
    first, second = scene.cameras[0].images
    assert first.camera == scene.cameras[0].camera
    assert second.camera.model == "brown_conrady"
    assert (
        np.nanmax(distances_px(OTHER, second.camera)) < 0.1
    )  # corners may be given up, as the share reports


def test_a_camera_model_that_comes_no_nearer_than_the_limit_is_refused_with_its_distance():
    with pytest.raises(
        CalibrationError,
        match=r"sensors\[front\].camera: fisheye camera model reported as pinhole, off by up to",
    ):
        convert_camera_models(scene_of(FISHEYE), "pinhole")
    assert (
        convert_camera_models(scene_of(FISHEYE), "pinhole", limit_px=500).cameras[0].camera.model == "pinhole"
    )


def test_a_camera_model_that_holds_too_little_of_the_image_is_refused_with_the_share():
    with pytest.raises(
        CalibrationError, match="% of the image cannot be held; expected at most 1 px and 1 %"
    ):
        convert_camera_models(scene_of(ALL_AROUND), "brown_conrady")
    found = convert_camera_models(scene_of(ALL_AROUND), "brown_conrady", share=0.2)
    assert found.metadata["sceneloom"]["camera_models"][0]["share"] < 0.5


def test_camera_models_of_that_model_stay_as_they_are():
    scene = scene_of(FISHEYE)
    found = convert_camera_models(scene, "fisheye")
    assert found.sensors == scene.sensors
    assert [warning.code for warning in found.warnings] == ["nothing-to-convert"]


@pytest.mark.parametrize("limits", [{"limit_px": -1}, {"limit_px": float("nan")}, {"share": 1.5}])
def test_limits_that_are_none_are_refused(limits):
    with pytest.raises(OptionError, match="expected 0 px or more and a share of 0 to 1"):
        convert_camera_models(scene_of(FISHEYE), "brown_conrady", **limits)


def test_unknown_models_and_cameras_are_refused():
    with pytest.raises(OptionError, match="camera model 'periscope'"):
        convert_camera_models(scene_of(FISHEYE), "periscope")
    with pytest.raises(OptionError, match="no sensor 'rear'"):
        convert_camera_models(scene_of(FISHEYE), "pinhole", cameras=["rear"])
