"""Camera models and mosaics of messages against OpenCV, whose models and names they are."""

import cv2
import numpy as np
import pytest

from sceneloom.cameras import project
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.messages.cameras import image_of, read_camera_model
from sceneloom.formats.messages.records import CameraModelRecord, ImageRecord
from sceneloom.formats.messages.writer import camera_model_record

K = (500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0)
D = (0.1, -0.05, 0.001, 0.002, 0.01, 0.02, 0.003, 0.001, 0.001, 0.002, 0.003, 0.004, 0.01, 0.02)
POINTS = np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [1, 0.7, 0] + [0, 0, 3]


def camera_model(model, coefficients, k=K):
    return read_camera_model(
        CameraModelRecord(0, "c", 640, 480, model, coefficients, k), "file", "camera_model", Ledger(lenient=False)
    )


@pytest.mark.parametrize(
    ("model", "count"), [("plumb_bob", 5), ("rational_polynomial", 8), ("rational_polynomial", 14), ("equidistant", 4)]
)
def test_camera_models_project_as_opencv_does(model, count):
    camera = camera_model(model, D[:count])
    nothing, matrix = np.zeros(3), np.reshape(K, (3, 3))
    of = cv2.fisheye if model == "equidistant" else cv2
    expected = of.projectPoints(POINTS[:, None], nothing, nothing, matrix, np.array(D[:count]))[0][:, 0]
    pixels, visible = project(camera, POINTS)
    assert visible.all()
    np.testing.assert_allclose(pixels, expected, atol=1e-9)  # float64, some hundred pixels
    written = camera_model_record(camera, 0, "c", "equidistant")
    if count < 14:
        assert (written.model, written.coefficients) == (model, D[:count])
    assert read_camera_model(written, "file", "camera_model", Ledger(lenient=False)) == camera


def test_a_calibration_of_zeros_is_none_and_unknown_models_are_refused():
    assert camera_model("plumb_bob", (), (0.0,) * 9) is None
    with pytest.raises(DataError, match=r"'fisheye62'; expected one of .*plumb_bob"):
        camera_model("fisheye62", D[:7])
    with pytest.raises(DataError, match="8 coefficients of plumb_bob; expected at most 5"):
        camera_model("plumb_bob", D[:8])


MOSAICS = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}


@pytest.mark.parametrize(("pattern", "code"), MOSAICS.items())
def test_mosaics_are_filled_as_opencv_does(pattern, code):
    mosaic = np.random.default_rng(1).integers(0, 256, (20, 30), np.uint8)
    record = ImageRecord(0, "c", f"bayer_{pattern}8", 30, 20, 30, memoryview(mosaic.reshape(-1)))
    inner = slice(1, -1), slice(1, -1)  # OpenCV repeats its borders
    difference = image_of(record, "file", "image").astype(int) - cv2.cvtColor(mosaic, code)
    assert np.abs(difference[inner]).max() <= 1  # the two round halves differently
