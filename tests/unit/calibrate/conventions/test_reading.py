"""Extrinsics in the files of others, written here as these write them."""

import json

import numpy as np
import pytest

from sceneloom.calibrate.conventions import read_extrinsics
from sceneloom.errors import DataError

ROTATION = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
TRANSLATION = [0.1, -0.2, 0.3]
ROWS = [*ROTATION[0], 0.1, *ROTATION[1], -0.2, *ROTATION[2], 0.3]
QUATERNION = [0.5, -0.5, 0.5, -0.5]


def _found(tmp_path, text):
    path = tmp_path / "calibration"
    path.write_text(text, "utf-8")
    return {extrinsic.location: extrinsic for extrinsic in read_extrinsics(path)}


def test_matrices_are_found_wherever_they_stand_in_json(tmp_path):
    matrix = [ROWS[:4], ROWS[4:8], ROWS[8:], [0, 0, 0, 1]]
    found = _found(
        tmp_path, json.dumps({"cameras": [{"name": "front", "imuToCamera": matrix}], "K": [700, 0, 600]})
    )
    assert found["cameras[0].imuToCamera"].numbers == (*ROWS, 0, 0, 0, 1)
    assert list(found) == ["cameras[0].imuToCamera"]


def test_lines_of_names_and_numbers_are_read_as_kitti_writes_them(tmp_path):
    text = f"P2: {' '.join(['700.0'] * 12)}\nTr_velo_to_cam: {' '.join(map(str, ROWS))}\n\n"
    found = _found(tmp_path, text)
    assert list(found) == ["Tr_velo_to_cam"]
    assert found["Tr_velo_to_cam"].numbers == tuple(ROWS)


def test_lines_without_colons_are_read_as_well(tmp_path):
    assert list(_found(tmp_path, f"Tr_velo_cam {' '.join(map(str, ROWS))}\n")) == ["Tr_velo_cam"]


def test_bare_numbers_over_several_lines_are_one_matrix(tmp_path):
    text = "\n".join(" ".join(map(str, row)) for row in np.reshape([*ROWS, 0, 0, 0, 1], (4, 4)))
    assert next(iter(_found(tmp_path, text).values())).numbers == (*ROWS, 0.0, 0.0, 0.0, 1.0)


def test_a_rotation_and_a_translation_side_by_side_belong_together(tmp_path):
    text = (
        f"calib_time: 09-Jan-2012\nR: {' '.join(str(n) for row in ROTATION for n in row)}\nT: 0.1 -0.2 0.3\n"
    )
    (extrinsic,) = _found(tmp_path, text).values()
    assert extrinsic.apart
    assert extrinsic.numbers == (*(n for row in ROTATION for n in row), *TRANSLATION)


def test_named_numbers_leave_no_doubt_of_their_order(tmp_path):
    pose = {
        "position": dict(zip("xyz", TRANSLATION, strict=True)),
        "heading": dict(zip("wxyz", QUATERNION, strict=True)),
    }
    (extrinsic,) = _found(tmp_path, json.dumps({"poses": [pose]})).values()
    assert extrinsic.location == "poses[0]"
    assert extrinsic.known["quaternion"] == "x y z w"
    np.testing.assert_allclose(extrinsic.numbers, [*TRANSLATION, *QUATERNION[1:], QUATERNION[0]])


def test_a_list_of_a_quaternion_leaves_its_order_open(tmp_path):
    (extrinsic,) = _found(tmp_path, json.dumps({"translation": TRANSLATION, "rotation": QUATERNION})).values()
    assert extrinsic.numbers == (*TRANSLATION, *QUATERNION)
    assert "quaternion" not in extrinsic.known


def test_toml_is_read(tmp_path):
    (extrinsic,) = _found(tmp_path, f"[camera]\nextrinsic = {ROWS}\n").values()
    assert extrinsic.location == "camera.extrinsic"


@pytest.mark.parametrize(
    "text", ["", "{}", "no numbers at all", "[1, 2, 3]", '{"a": [null, true, "x"]}', "[[1], [2, 3], 4]"]
)
def test_a_file_without_an_extrinsic_says_what_was_expected(tmp_path, text):
    with pytest.raises(DataError, match="no extrinsic in it; expected 16, 12 or 9 numbers"):
        _found(tmp_path, text)


def test_what_is_no_text_is_named(tmp_path):
    path = tmp_path / "image.png"
    path.write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(DataError, match=r"image\.png"):
        read_extrinsics(path)
    with pytest.raises(DataError, match="absent"):
        read_extrinsics(tmp_path / "absent")


def test_the_files_of_kitti_and_others_are_read(data_dir):
    kitti = read_extrinsics(data_dir / "real" / "kitti_object" / "calib" / "000001.txt")
    assert [extrinsic.location for extrinsic in kitti] == ["R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    recording = read_extrinsics(data_dir / "recordings" / "pandaset" / "calibration.json")
    assert [extrinsic.location for extrinsic in recording][:3] == [
        f"cameras[{n}].imuToCamera" for n in range(3)
    ]
    nuscenes = read_extrinsics(data_dir / "real" / "nuscenes_one_sample" / "infos.json")
    assert "data_list[0].images.CAM_FRONT.lidar2cam" in {extrinsic.location for extrinsic in nuscenes}


@pytest.mark.parametrize("text", ['{{"T": [{}]}}', "T = [{}]"])
def test_whole_numbers_that_no_float_can_hold_are_refused(tmp_path, text):
    (tmp_path / "calib").write_text(text.format(", ".join(["1" + "0" * 400] * 16)))
    with pytest.raises(DataError, match="too large to convert to float; expected the numbers"):
        read_extrinsics(tmp_path / "calib")
