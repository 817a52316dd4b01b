"""Recordings in the forms of HybVIO: lines about cameras, `parameters.txt`, matrices column by column."""

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.recording.spec import FORMAT

CAMERA_FROM_IMU = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
SECOND_FROM_IMU = np.array([[0.0, -1.0, 0.0, -0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
FISHEYE = [-0.005, 0.04, -0.037, 0.006]


def by_columns(matrix):
    return matrix.T.ravel().tolist()


def parameters(*lines):
    return "".join(f"{line};\n" for line in lines)


FULL = parameters(
    "focalLengthX 20.5; focalLengthY 21.5",
    "principalPointX 15.25; principalPointY 7.75",
    "distortionCoeffs " + ",".join(map(str, FISHEYE)),
    "secondFocalLength 22; secondPrincipalPointX 16; secondPrincipalPointY 8",
    "secondDistortionCoeffs 0",
    "fisheyeCamera true; rot 0",
    "imuToCameraMatrix " + ",".join(map(str, by_columns(CAMERA_FROM_IMU))),
    "secondImuToCameraMatrix " + ",".join(map(str, by_columns(SECOND_FROM_IMU))),
    "imuToCameraShiftSeconds 0.01",
)


def stereo(recording, *header, fields=None):
    entries = [
        {"cameraInd": 0, "time": 0.0, **(fields or {})},
        {"cameraInd": 1, "time": 0.0, **(fields or {})},
    ]
    recording.lines([*header, {"frames": entries, "number": 0, "time": 0.0}])
    return recording.video("data.mkv", 1).video("data2.mkv", 1)


def test_parameters_stand_in_for_a_calibration(recording):
    stereo(recording).path.joinpath("parameters.txt").write_text(FULL)
    with FORMAT.open(recording.path) as scene:
        first, second = scene.cameras
        assert (first.camera.model, first.camera.coefficients) == ("fisheye", tuple(FISHEYE))
        camera_model = first.camera
        assert (
            camera_model.fx,
            camera_model.fy,
            camera_model.cx,
            camera_model.cy,
            camera_model.width,
            camera_model.height,
        ) == (
            20.5,
            21.5,
            15.25,
            7.75,
            32,
            16,
        )
        assert (second.camera.fx, second.camera.fy, second.camera.coefficients) == (22.0, 22.0, ())
        for camera, matrix in ((first, CAMERA_FROM_IMU), (second, SECOND_FROM_IMU)):
            np.testing.assert_allclose(camera.mount.matrix, np.linalg.inv(matrix), atol=1e-15)
        assert scene.metadata["recording"]["parameters"] == FULL
        assert {warning.code for warning in scene.warnings} == {"old-calibration", "camera-shift-not-applied"}


@pytest.mark.parametrize("nested", [True, False])
def test_lines_at_the_head_report_mountings_and_fisheye_camera_models(recording, nested):
    header = []
    for index, matrix in enumerate((CAMERA_FROM_IMU, SECOND_FROM_IMU)):
        numbers = matrix.tolist() if nested else by_columns(matrix)
        header += [
            {"cameraInd": index, "imuToCamera": numbers},
            {"cameraInd": index, "model": "KANNALA_BRANDT4", "coeffs": [*FISHEYE, 0]},
        ]
    fields = {"cameraParameters": {"focalLength": 20.0, "principalPointX": 15.0, "principalPointY": 7.0}}
    stereo(recording, *header, fields=fields)
    with FORMAT.open(recording.path) as scene:
        for camera, matrix in zip(scene.cameras, (CAMERA_FROM_IMU, SECOND_FROM_IMU), strict=True):
            assert (camera.camera.model, camera.camera.coefficients) == ("fisheye", tuple(FISHEYE))
            assert (camera.camera.fx, camera.camera.fy) == (20.0, 20.0)
            assert camera.images[0].camera == camera.camera
            np.testing.assert_allclose(camera.mount.matrix, np.linalg.inv(matrix), atol=1e-15)
        # the lines themselves stay
        assert len(scene.metadata["recording"]["other_lines"]) == 4


def test_parameters_count_before_lines_and_a_calibration_before_both(recording, pinhole):
    header = {"cameraInd": 0, "imuToCamera": by_columns(SECOND_FROM_IMU)}
    recording.lines([header, {"frames": [{"cameraInd": 0}], "number": 0, "time": 0.0}]).video("data.mkv", 1)
    (recording.path / "parameters.txt").write_text(FULL)
    with FORMAT.open(recording.path) as scene:
        np.testing.assert_allclose(scene.cameras[0].mount.matrix, np.linalg.inv(CAMERA_FROM_IMU), atol=1e-15)
    recording.calibration([pinhole])
    with FORMAT.open(recording.path) as scene:
        np.testing.assert_array_equal(scene.cameras[0].mount.matrix, np.eye(4))
        assert "old-calibration" not in {warning.code for warning in scene.warnings}


def test_a_camera_of_no_model_is_taken_for_a_pinhole(recording):
    recording.lines([{"frames": [{"cameraInd": 0}], "number": 0, "time": 0.0}]).video("data.mkv", 1)
    text = parameters("focalLength 20; principalPointX 15; principalPointY 7; imuToCameraMatrix 1,0,0,0,-1,0,0,0,-1")
    (recording.path / "parameters.txt").write_text(text)
    with FORMAT.open(recording.path) as scene:
        camera = scene.cameras[0]
        assert camera.camera.model == "pinhole"
        np.testing.assert_array_equal(camera.mount.matrix, np.diag([1.0, -1.0, -1.0, 1.0]))
        assert [n.message for n in scene.warnings][1] == "camera 0 is taken for a pinhole: no model is stated"


def test_a_rotated_video_leaves_the_mounting_open(recording):
    stereo(recording).path.joinpath("parameters.txt").write_text(FULL + "videoRotation CW90;\n")
    with pytest.raises(DataError, match="imuToCamera is missing"):
        FORMAT.open(recording.path)
    with FORMAT.open(recording.path, lenient=True) as scene:
        assert [camera.mount for camera in scene.cameras] == [None, None]
        assert any("videoRotation" in warning.message for warning in scene.warnings)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("focalLengthX 1 2;", "focalLengthX 1 2: expected a name and a value"),
        ("focalLengthX;", "focalLengthX: expected a name and a value"),
        ("rot 0; rot 1;", "rot 1: expected a name and a value, each name once"),
        ("focalLengthX wide;", "focalLengthX: 'wide'; expected numbers"),
        ("imuToCameraMatrix 1,0,x;", "imuToCameraMatrix: '1,0,x'; expected numbers"),
    ],
)
def test_parameters_that_are_none_are_refused(recording, text, problem):
    stereo(recording).path.joinpath("parameters.txt").write_text(text)
    with pytest.raises(DataError, match=problem):
        FORMAT.open(recording.path)


def test_lines_that_only_look_like_old_ones_state_nothing(recording):
    header = [
        '{"cameraInd":7,"imuToCamera":[]}',
        '{"cameraInd":"x","imuToCamera":[]}',
        '{"cameraInd":0,"speed":1}',
    ]
    recording.lines([*header, '{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":0}'])
    with FORMAT.open(recording.path) as scene:
        assert "calibration" not in scene.metadata["recording"]


def test_a_line_may_report_the_one_camera_under_frame(recording, pinhole):
    lines = [
        {
            "frame": {"time": 0.1 * k, "cameraParameters": {"focalLength": 25.0}, "shown": k},
            "number": k,
            "time": 0.1 * k,
        }
        for k in range(3)
    ]
    recording.lines(lines).calibration([pinhole]).video("data.mkv", 3)
    with FORMAT.open(recording.path) as scene:
        images = scene.cameras[0].images
        assert [image.rgb[0, 0, 0] for image in images] == [0, 10, 20]
        assert [(image.camera.fx, image.camera.fy) for image in images] == [(25.0, 25.0)] * 3
        assert [image.extras["shown"] for image in images] == [0, 1, 2]
