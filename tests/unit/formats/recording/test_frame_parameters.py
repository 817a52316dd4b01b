"""Camera models and mountings that every line brings along: the example of the format's owner, and every model."""

import json

import cv2
import numpy as np
import pytest

from sceneloom.cameras import project
from sceneloom.formats.recording.calibration import CAMERA_MODEL_READINGS
from sceneloom.formats.recording.spec import FORMAT

# two lines of "Example data.jsonl" in the description of the format, as they stand there
FIRST = (
    '{"frames":[{"cameraInd":0,"cameraParameters":{"focalLengthX":284.929992675781,"focalLengthY":285.165496826172,'
    '"principalPointX":416.4547119140625,"principalPointY":395.77349853515625,"distortionModel":"KANNALA_BRANDT4",'
    '"distortionCoefficients":[-0.004973,0.03975,-0.0374,0.006239]},"imuToCamera":[[0.01486,0.9995,-0.02577,0.06522],'
    "[-0.9998,0.01496,0.003756,-0.0207],[0.00414,0.02571,0.9996,-0.008054],[0,0,0,1]],"
    '"time":1.436207275390625},{"cameraInd":1,"cameraParameters":{"focalLengthX":284.559509277344,'
    '"focalLengthY":284.4418029785162,"principalPointX":410.81329345703125,"principalPointY":394.1506042480469,'
    '"distortionModel":"KANNALA_BRANDT4","distortionCoefficients":[-0.006496,0.04365,-0.04025,0.006813]},'
    '"imuToCamera":[[0.01255,0.9995,-0.02538,-0.0449],[-0.9997,0.01301,0.0179,-0.02056],'
    '[0.01822,0.02515,0.9995,-0.008638],[0,0,0,1]],"time":1.436207275390625}],"number":28,"time":1.436207275390625}'
)
EXAMPLE = [FIRST, FIRST.replace('"number":28', '"number":29').replace("1.436207275390625", "1.46955859375")]
POINTS_CAMERA = np.random.default_rng(3).uniform([-1.5, -1.5, 2.0], [1.5, 1.5, 12.0], (50, 3))


def test_the_example_of_the_formats_owner_is_read(recording):
    size = {"width": 848, "height": 800}
    recording.lines(EXAMPLE).video("data.mkv", 2, **size).video("data2.mkv", 2, **size)
    with FORMAT.open(recording.path) as scene:
        assert scene.warnings == ()
        assert [camera.id for camera in scene.cameras] == ["camera0", "camera1"]
        for index, camera in enumerate(scene.cameras):
            assert camera.images.timestamps_ns.tolist() == [1436207275, 1469558594]
            stated = json.loads(EXAMPLE[0])["frames"][index]
            numbers = stated["cameraParameters"]
            matrix = np.array(
                [
                    [numbers["focalLengthX"], 0.0, numbers["principalPointX"]],
                    [0.0, numbers["focalLengthY"], numbers["principalPointY"]],
                    [0.0, 0.0, 1.0],
                ]
            )
            coefficients = np.array(numbers["distortionCoefficients"])
            expected, _ = cv2.fisheye.projectPoints(
                POINTS_CAMERA[:, None], np.zeros(3), np.zeros(3), matrix, coefficients
            )
            for image in camera.images:
                pixels, visible = project(image.camera, POINTS_CAMERA)
                assert visible.sum() > 40
                # both compute in float64, so only rounding is between them
                np.testing.assert_allclose(pixels[visible], expected[visible, 0], atol=1e-8)
            # the example's matrices are rounded, so their rotations are off by some 2e-4
            np.testing.assert_allclose(camera.mount.inverse().matrix, stated["imuToCamera"], atol=5e-4)


@pytest.mark.parametrize(("model", "count"), [(name, n) for name, row in CAMERA_MODEL_READINGS.items() for n in row])
def test_a_camera_model_of_any_model_is_the_same_from_a_line_as_from_the_calibration(recording, pinhole, model, count):
    coefficients = [1e-3 * (k + 1) for k in range(count)]
    numbers = {key: value for key, value in pinhole.items() if key.startswith(("focal", "principal"))}
    own = {
        **numbers,
        "distortionModel": model.upper().replace("-", "_"),
        "distortionCoefficients": coefficients,
    }
    lines = [{"frames": [{"cameraInd": 0, "cameraParameters": own}, {"cameraInd": 1}], "number": 0, "time": 0.0}]
    calibrated = {**pinhole, "model": model, "distortionCoefficients": coefficients}
    recording.lines(lines).calibration([pinhole, calibrated]).video("data.mkv", 1).video("data2.mkv", 1)
    with FORMAT.open(recording.path) as scene:
        from_line, from_calibration = (camera.images[0].camera for camera in scene.cameras)
        assert from_line == from_calibration
        assert from_line.model == CAMERA_MODEL_READINGS[model][count].model
