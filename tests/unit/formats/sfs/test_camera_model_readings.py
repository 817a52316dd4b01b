"""What the numbers of a camera model mean where the format leaves it open: options, and what is recorded of them."""

from functools import partial

import numpy as np
import pytest

from sceneloom.errors import CalibrationError, OptionError
from sceneloom.formats.sfs.spec import FORMAT
from sceneloom.formats.sfs.writer import write_scene
from sceneloom.pipeline.alignment import align
from sceneloom.scene.scene import assumed_models, check_camera_models

INTRINSICS = {"fx": 100, "fy": 101.5, "cx": 3.5, "cy": 2.0, "width": 8, "height": 6}
BROWN = [0.1, 0.2, 0.003, 0.004, 0, 0, 0, 0, 0, 0]


def camera(model, params, **fields):
    poses = {"timestamps": [0], "values": [[0, 0, 0, 0, 0, 0, 1]]}
    intrinsics = {**INTRINSICS, "distortion": {"model": model, "params": params}}
    return {"id": "c", "type": "camera", "poses": poses, "intrinsics": intrinsics, "images": [], **fields}


def tangential_of(scene):
    return scene.cameras[0].camera.coefficients[2:4]


def codes(scene):
    return [warning.code for warning in scene.warnings]


@pytest.mark.parametrize(
    ("stated", "expected"), [(None, (0.003, 0.004)), ("opencv", (0.003, 0.004)), ("brown", (0.004, 0.003))]
)
def test_p1_and_p2_change_locations_where_they_are_brown_s(open_header, make, stated, expected):
    scene = open_header(make.scene(camera("brown_conrady", BROWN)), tangential=stated)
    assert tangential_of(scene) == expected
    assert scene.cameras[0].camera.coefficients[:2] == (0.1, 0.2)


def test_short_lists_change_locations_with_the_zeros_that_they_lack(open_header, make):
    scene = open_header(make.scene(camera("brown_conrady", [0.1, 0.2, 0.003])), tangential="brown")
    assert scene.cameras[0].camera.coefficients == (0.1, 0.2, 0.0, 0.003)


def test_other_models_have_no_such_terms(open_header, make):
    scene = open_header(make.scene(camera("fisheye", [0.1, 0.2, 0.3, 0.4])), tangential="brown")
    assert scene.cameras[0].camera.coefficients == (0.1, 0.2, 0.3, 0.4)


def test_terms_are_exchanged_once_however_often_a_scene_is_written_and_read(open_header, make, tmp_path):
    target = tmp_path / "again.sfs"
    scene = open_header(make.scene(camera("brown_conrady", BROWN)), tangential="brown")
    assert scene.metadata["sceneloom"]["tangential"] == "opencv"
    assert scene.metadata["sceneloom"]["tangential_before"] == "brown"
    write_scene(scene, target)
    for stated in (None, "opencv", "brown"):
        again = FORMAT.open(target, tangential=stated)
        assert tangential_of(again) == (0.004, 0.003)
        assert ("tangential-recorded" in codes(again)) is (stated == "brown")


def test_a_meaning_that_there_is_not_is_refused(open_header, make):
    with pytest.raises(OptionError, match="tangential 'euler'; expected one of opencv, brown"):
        open_header(make.scene(), tangential="euler")


FTHETA = [0.0, 100.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("model", ["ftheta", "fisheye_radial_custom"])
def test_a_camera_model_whose_formula_nothing_confirms_opens_but_is_not_computed_with(open_header, make, model):
    scene = open_header(make.scene(camera(model, FTHETA)))
    assert scene.cameras[0].camera.model == model
    assert assumed_models(scene) == ()
    with pytest.raises(CalibrationError, match=rf"sensors\[c\].camera: '{model}' .* state `--assume-model`"):
        check_camera_models(scene)
    check_camera_models(scene, [])


def test_computing_with_it_can_be_asked_for_and_stands_in_the_output(open_header, make, tmp_path):
    scene = open_header(make.scene(camera("ftheta", FTHETA)), assume_model=True)
    check_camera_models(scene)
    assert scene.metadata["sceneloom"]["assumed_models"] == ["ftheta"]
    assert codes(scene).count("assumed-model") == 1
    write_scene(scene, tmp_path / "again.sfs")
    again = FORMAT.open(tmp_path / "again.sfs")
    check_camera_models(again)
    assert codes(again).count("assumed-model") == 1


def test_asking_for_it_in_vain_says_nothing(open_header, make):
    scene = open_header(make.scene(camera("fisheye", [0.1, 0, 0, 0])), assume_model=True)
    assert "assumed-model" not in codes(scene)
    assert assumed_models(scene) == ()


def test_fusing_and_converting_such_a_camera_model_need_the_option(open_header, make, tmp_path):
    jpeg = np.frombuffer(JPEG, np.uint8)
    images = [{"timestamp": 0, "content": jpeg}]
    scene = open_header(make.scene(camera("ftheta", FTHETA, images=images, coordinates="ego")))
    with pytest.raises(CalibrationError, match="assume-model"):
        align(scene)
    from sceneloom.editing import convert_camera_models, undistort_scene
    from sceneloom.formats.base.registry import write_scene as write_any

    write_recording = partial(write_any, path=tmp_path / "drive")
    for convert in (undistort_scene, partial(convert_camera_models, model="fisheye"), write_recording):
        with pytest.raises(CalibrationError, match="assume-model"):
            convert(scene)
    assert not (tmp_path / "drive").exists()


def _jpeg():
    from simplejpeg import encode_jpeg

    return encode_jpeg(np.zeros((6, 8, 3), np.uint8))


JPEG = _jpeg()
