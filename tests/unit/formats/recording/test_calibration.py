"""Calibrations: camera models against OpenCV, mountings against NumPy, those of single lines, and older forms."""

import json
import re

import cv2
import numpy as np
import pytest

from sceneloom.cameras import Camera, project
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.recording.contents import CAMERA_MODEL_READINGS
from sceneloom.scene import WarningKind

CAMERA_MATRIX = np.array([[420.0, 0.0, 310.0], [0.0, 415.0, 245.0], [0.0, 0.0, 1.0]])
POINTS_CAMERA = np.random.default_rng(3).uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 12.0], (50, 3))
ORIGIN = np.zeros(3)
ROTATED = np.array([
    [0.000998747205656553, -0.9999903820710413, 0.004259378487635177, -0.25422760500525077],
    [0.00841690182755742, -0.004250821136069464, -0.9999555696753273, 0.7190941084821951],
    [0.9999640486966582, 0.001034553284226362, 0.008412575208732587, -1.0863370561924168],
    [0.0, 0.0, 0.0, 1.0],
])  # fmt: skip
IMU_LINE = '{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":0}'
FRAMES_LINE = '{"frames":[{"cameraInd":0}],"number":0,"time":0}'


def entry(model, coefficients, **further):
    return {
        "model": model,
        "distortionCoefficients": coefficients,
        "focalLengthX": CAMERA_MATRIX[0, 0],
        "focalLengthY": CAMERA_MATRIX[1, 1],
        "principalPointX": CAMERA_MATRIX[0, 2],
        "principalPointY": CAMERA_MATRIX[1, 2],
        "imageWidth": 640,
        "imageHeight": 480,
        "imuToCamera": ROTATED.tolist(),
        **further,
    }


def open_with(recording, *cameras, lenient=False, **further):
    return recording.lines([IMU_LINE]).calibration(cameras, **further).open(lenient=lenient)


def codes(scene):
    return [warning.code for warning in scene.warnings]


def perspective(coefficients):
    return cv2.projectPoints(POINTS_CAMERA, ORIGIN, ORIGIN, CAMERA_MATRIX, np.array(coefficients))[0]


def fisheye(coefficients, matrix=CAMERA_MATRIX):
    numbers = np.array(coefficients or (0.0,) * 4)
    return cv2.fisheye.projectPoints(POINTS_CAMERA[:, None], ORIGIN, ORIGIN, matrix, numbers)[0]


def omnidirectional(coefficients):
    k1, k2, skew, xi, p1, p2 = coefficients
    matrix = CAMERA_MATRIX.copy()
    matrix[0, 1] = skew
    numbers = np.array([[k1, k2, p1, p2]])
    return cv2.omnidir.projectPoints(POINTS_CAMERA[:, None], ORIGIN, ORIGIN, matrix, xi, numbers)[0]


BROWN = (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, -0.01, 1e-3, 2e-3, -1e-3, 3e-3, 0.01, -0.02)
K4 = (-0.028, 0.0021, -0.0052, 0.0004)


@pytest.mark.parametrize(
    ("model", "coefficients", "theirs"),
    [
        ("pinhole", (), lambda _: perspective(np.zeros(5))),
        ("pinhole", (-0.2, 0.05, -0.01), lambda _: perspective([-0.2, 0.05, 0.0, 0.0, -0.01])),
        ("brown-conrady", BROWN[:5], perspective),
        ("brown-conrady", BROWN[:8], perspective),
        ("BROWN_CONRADY", BROWN, perspective),
        *[
            (name, row, fisheye)
            for name in ("kannala-brandt4", "KANNALA_BRANDT4", "KannalaBrandt4")
            for row in ((), K4)
        ],
        ("OMNIDIR", (-0.21, 0.034, 1.7, 1.23, 5e-4, -8e-4), omnidirectional),
    ],
)
def test_camera_models_project_as_opencv_or_their_formulas_do(recording, model, coefficients, theirs):
    camera = open_with(recording, entry(model, list(coefficients))).cameras[0].camera
    pixels, visible = project(camera, POINTS_CAMERA)
    assert visible.sum() > 40
    # both compute in float64, so only rounding is between them
    np.testing.assert_allclose(pixels[visible], theirs(coefficients)[visible, 0], atol=1e-8)


ROWS = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
ROTATION_ALONE = np.block([[np.array(ROWS), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


@pytest.mark.parametrize(
    ("key", "numbers", "matrix"),
    [
        ("imuToCamera", ROTATED.tolist(), ROTATED),
        ("imuToCameraMatrix", ROTATED.tolist(), ROTATED),
        ("imuToCamera", ROTATED.T.ravel().tolist(), ROTATED),
        ("imuToCamera", ROWS, ROTATION_ALONE),
        ("imuToCamera", np.array(ROWS).T.ravel().tolist(), ROTATION_ALONE),
    ],
)
def test_the_mounting_is_the_inverse_of_the_matrix(recording, key, numbers, matrix):
    camera = entry("pinhole", [])
    del camera["imuToCamera"]
    scene = open_with(recording, {**camera, key: numbers})
    # the file's numbers are orthonormal to about 1e-7 only, and are normalised
    np.testing.assert_allclose(scene.cameras[0].mount.matrix, np.linalg.inv(matrix), atol=1e-6)
    assert scene.warnings == ()
    # as are rotations that are slightly off
    for scale, noticed in ((1.0004, False), (1.002, True)):
        off = ROTATED * [[scale] * 3 + [1.0]]
        scene = open_with(recording, entry("pinhole", [], imuToCamera=off.tolist()))
        np.testing.assert_allclose(scene.cameras[0].mount.rotation, ROTATED[:3, :3].T, atol=1e-6)
        assert codes(scene) == (["rotation-normalised"] if noticed else [])
        assert all(warning.location.endswith("calibration.json: cameras[0].imuToCamera") for warning in scene.warnings)


def mounted(matrix):
    return {"imuToCamera": np.asarray(matrix).tolist()}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (mounted(np.diag([1.01, 1.0, 1.0, 1.0])), ["rotation off by 0.02"]),
        (mounted(np.diag([1.0, 1.0, -1.0, 1.0])), ["mirrored or singular"]),
        (mounted(np.zeros((4, 4))), ["last row"]),
        (mounted(ROTATED.T), ["transposed"]),
        (mounted(ROTATED.ravel()), ["last row"]),
        (mounted(ROTATED[:3]), ["3 rows; expected 4 rows of 4 numbers"]),
        (mounted(ROTATED[:, :3]), ["4 rows; expected 4 rows of 4 numbers"]),
        (mounted([1.0, 2.0]), ["2 numbers; expected"]),
        (mounted([]), ["0 numbers; expected"]),
        ({"imuToCamera": "left"}, ['"left"']),
        ({"model": "omnidir9"}, ["cameras[0].model: 'omnidir9'", "pinhole, brown-conrady, kannala-brandt4"]),
        ({"model": None}, ["cameras[0].model: missing"]),
        ({"distortionCoefficients": [0.1]}, ["1 numbers; expected 0 or 3 for 'pinhole'"]),
        ({"focalLengthX": None}, ["cameras[0].focalLengthX: missing"]),
        ({"focalLengthX": "wide"}, ["cameras[0].focalLengthX", '"wide"', "a number"]),
        ({"focalLengthX": 0.0}, ["cameras[0]: focal lengths 0.0"]),
        ({"imageWidth": -640}, ["cameras[0]: imageWidth, imageHeight (-640, 480)"]),
        ({"imageWidth": 640.5}, ["(640.5, 480)", "whole numbers"]),
        ({"shutterRollTimeSeconds": -0.01}, ["cameras[0].shutterRollTimeSeconds"]),
        ({"exposureTimeSeconds": "long"}, ["cameras[0].exposureTimeSeconds"]),
        ({"rollingShutterLeftToRight": 1}, ["cameras[0].rollingShutterLeftToRight"]),
    ],
)
def test_unusable_cameras_are_named_with_file_and_path(recording, change, words):
    with pytest.raises((CalibrationError, DataError)) as caught:
        open_with(recording, entry("pinhole", []) | change)
    where = ["cameras[0].imuToCamera"] if "imuToCamera" in change else []
    for word in ["calibration.json", *where, *words]:
        assert word in str(caught.value)


def test_a_calibration_for_another_image_size_is_scaled_and_without_one_it_is_that_of_the_images(recording, pinhole):
    doubled = pinhole | {"imageWidth": 64, "imageHeight": 64, "principalPointX": 31.5, "principalPointY": 20.0}
    recording.video("data.mkv", 1, size=(32, 16)).lines([FRAMES_LINE]).calibration([doubled])
    with recording.open() as scene:
        (warning,) = scene.warnings
        # the edge of an image is half a pixel before the centre of its first one
        assert scene.cameras[0].camera == Camera("pinhole", 32, 16, 10.0, 5.25, 15.5, 20.5 / 4 - 0.5)
    assert (warning.code, warning.kind) == ("camera-model-scaled", WarningKind.REPAIRED)
    assert "64x64" in warning.message
    sizeless = {name: value for name, value in pinhole.items() if not name.startswith("image")}
    with recording.calibration([sizeless]).open() as scene:
        assert (scene.cameras[0].camera.width, scene.cameras[0].camera.height) == (32, 16)
        assert scene.warnings == ()
    (recording.path / "data.mkv").unlink()
    scene = recording.lines([IMU_LINE]).open()
    assert (scene.cameras, codes(scene)) == ((), ["cameras-without-size"])


def test_a_lenient_reading_leaves_unusable_cameras_out_and_keeps_one_without_a_mounting(recording):
    scene = open_with(recording, entry("omnidir9", []), entry("pinhole", []), lenient=True)
    assert [camera.id for camera in scene.cameras] == ["camera1"]
    assert [(warning.code, warning.kind) for warning in scene.warnings] == [("unusable-cameras", WarningKind.SKIPPED)]
    with pytest.raises(DataError, match=r"cameras\[0\]: imuToCamera is missing"):
        open_with(recording, entry("pinhole", [], imuToCamera=None))
    scene = recording.open(lenient=True)
    assert (scene.cameras[0].mount, codes(scene)) == (None, ["mounts-missing"])


@pytest.mark.parametrize(("key", "listed"), [("imuToCamera", "cameras"), ("imuToLidar", "lidars")])
def test_two_matrices_that_differ_are_an_error_and_leniently_the_first_counts(recording, key, listed):
    one, other = np.eye(4), np.eye(4)
    one[0, 3], other[0, 3] = 1.0, 1.5
    camera = entry("pinhole", [])
    sensor = camera if listed == "cameras" else {}
    sensor |= {key: one.tolist(), f"{key}Matrix": other.tolist()}
    further = {} if listed == "cameras" else {"lidars": [sensor]}
    with pytest.raises(DataError, match=rf"{listed}\[0\].{key}Matrix: differs from {key} by up to 0.5"):
        open_with(recording, camera, **further)
    with recording.open(lenient=True) as scene:
        assert codes(scene) == ["contradicting-mounts"]
        assert listed == "lidars" or scene.cameras[0].mount.translation[0] == -1.0
    sensor[f"{key}Matrix"] = one.tolist()
    assert open_with(recording, camera, **further).warnings == ()


def test_entries_are_kept_as_they_are_a_byte_order_mark_is_skipped_and_what_is_no_calibration_a_fault(recording):
    shutter = {"shutterRollTimeSeconds": 0.03, "rollingShutterLeftToRight": True, "exposureTimeSeconds": 0.008}
    camera = entry("pinhole", [], **shutter, maker="ours")
    open_with(recording, camera, imuForward=[1, 0, 0])
    path = recording.path / "calibration.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    with recording.open() as scene:
        assert codes(scene) == ["byte-order-mark"]
        assert scene.cameras[0].extras["calibration"] == json.loads(json.dumps(camera))
        assert scene.metadata["recording"]["calibration"]["imuForward"] == [1, 0, 0]
    for text, problem in (
        ("", "empty; expected a JSON object"),
        ("{", "not a JSON object"),
        ("[]", "a JSON list; expected an object with `cameras`"),
        ('{"cameras": {}}', "cameras: dict; expected a list of objects"),
        ('{"cameras": [3]}', r"cameras\[0\]: 3: expected an object, not a whole number"),
        ('{"lidars": "none"}', "lidars: str; expected a list of objects"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=rf"calibration\.json: .*{problem}"):
            recording.open()


FIX = '{"gps":{"latitude":60.1,"longitude":24.9,"altitude":14.0},"time":1.0}'
LEVER = [[0.0, 1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.25], [0.0, 0.0, 1.0, -1.5], [0.0, 0.0, 0.0, 1.0]]
AT = np.block([[np.eye(3), np.array([[0.5], [-0.2], [1.25]])], [np.zeros((1, 3)), np.ones((1, 1))]])


def test_the_antenna_sits_where_imu_to_gnss_says(recording):
    for further, matrix, found in (
        # p_gnss = T p_imu, so the antenna, the origin of its own frame, is at the inverse's last column
        ({"imuToGnss": LEVER}, np.linalg.inv(LEVER), []),
        ({"imuToGnss": [0.5, -0.2, 1.25]}, AT, ["antenna-location"]),
        ({"imuToGnss": {"x": 0.5, "y": -0.2, "z": 1.25}}, AT, ["antenna-location"]),
        ({}, None, []),
    ):
        with recording.lines([FIX]).calibration((), **further).open() as scene:
            mount = scene.sensor("gnss").mount
            assert codes(scene) == found
        assert (mount is None) == (matrix is None)
        assert matrix is None or np.allclose(mount.matrix, matrix, rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("further", "problem"),
    [
        ({"imuToGnss": [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "imuToGnss: rotation off by 3"),
        ({"imuToGnss": [1.0, 2.0]}, "imuToGnss: 2 numbers"),
        ({"imuToGnss": {"x": 1.0, "y": 2.0}}, 'imuToGnss: {"x":1.0,"y":2.0}: Object missing required field `z`'),
        ({"imuToOutput": "identity"}, 'imuToOutput: "identity"'),
        ({"imuToMagnetometer": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "imuToMagnetometer: rotation mirrored"),
        ({"imuForward": [0, 0, 0]}, "imuForward: [0.0, 0.0, 0.0]; expected a direction"),
        ({"imuForward": [1, 0]}, "imuForward: [1.0, 0.0]; expected three numbers"),
        ({"imuForward": [1, 0, 1e300]}, "imuForward: [1.0, 0.0, 1e+300]; expected three numbers"),
    ],
)
def test_unusable_fields_of_the_device_are_named_and_left_out_when_lenient(recording, further, problem):
    with pytest.raises((CalibrationError, DataError), match=re.escape(problem)):
        open_with(recording, **further)
    scene = open_with(recording, lenient=True, **further)
    assert "unusable-calibrations" in codes(scene)
    assert scene.metadata["recording"]["calibration"].keys() == {"cameras", *further}
    # another frame of the output is reported, not applied
    assert codes(open_with(recording, imuToOutput=LEVER)) == ["poses-of-imu"]
    assert not open_with(recording, imuToOutput=np.eye(4).tolist()).warnings


@pytest.mark.parametrize(("camera_shift", "shift_ms"), [("ignore", 0), ("apply", 15), ("subtract", -15)])
def test_camera_shifts_move_the_images_only_where_asked_for(recording, pinhole, camera_shift, shift_ms):
    recording.lines([{"frames": [{"cameraInd": 0}], "number": 0, "time": 1.0}]).video("data.mkv", 1)
    recording.calibration([{**pinhole, "imuToCameraShiftSeconds": 0.015}])
    with recording.open(camera_shift=camera_shift) as scene:
        camera, asked = scene.cameras[0], camera_shift != "ignore"
        assert camera.images.timestamps_ns.tolist() == [1_000_000_000 + shift_ms * 1_000_000]
        assert camera.images[0].extras["file_seconds"] == 1.0
        assert codes(scene) == ["camera-shift-applied" if asked else "camera-shift-not-applied"]
        # a shift that was applied must not be applied again by those who read what is written
        assert ("imuToCameraShiftSeconds" in camera.extras["calibration"]) is not asked
        assert scene.metadata["recording"].get("camera_shifts") == ({"camera0": shift_ms / 1000} if asked else None)


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


def test_the_example_of_the_formats_owner_is_read(recording):
    size = {"size": (848, 800)}
    recording.lines(EXAMPLE).video("data.mkv", 2, **size).video("data2.mkv", 2, **size)
    with recording.open() as scene:
        assert scene.warnings == ()
        assert [camera.id for camera in scene.cameras] == ["camera0", "camera1"]
        for index, camera in enumerate(scene.cameras):
            assert camera.images.timestamps_ns.tolist() == [1436207275, 1469558594]
            stated = json.loads(EXAMPLE[0])["frames"][index]
            numbers = stated["cameraParameters"]
            fx, fy, cx, cy = (numbers[f"{name}{axis}"] for name in ("focalLength", "principalPoint") for axis in "XY")
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            expected = fisheye(numbers["distortionCoefficients"], matrix)
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
    own = {**numbers, "distortionModel": model.upper().replace("-", "_"), "distortionCoefficients": coefficients}
    lines = [{"frames": [{"cameraInd": 0, "cameraParameters": own}, {"cameraInd": 1}], "number": 0, "time": 0.0}]
    calibrated = {**pinhole, "model": model, "distortionCoefficients": coefficients}
    recording.lines(lines).calibration([pinhole, calibrated]).video("data.mkv", 1).video("data2.mkv", 1)
    with recording.open() as scene:
        from_line, from_calibration = (camera.images[0].camera for camera in scene.cameras)
        assert from_line == from_calibration
        assert from_line.model == CAMERA_MODEL_READINGS[model][count].model


CAMERA_FROM_IMU = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
SECOND_FROM_IMU = np.array([[0.0, -1.0, 0.0, -0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
FISHEYE = [-0.005, 0.04, -0.037, 0.006]


FULL = f"""\
focalLengthX 20.5; focalLengthY 21.5;
principalPointX 15.25; principalPointY 7.75;
distortionCoeffs {",".join(map(str, FISHEYE))};
secondFocalLength 22; secondPrincipalPointX 16; secondPrincipalPointY 8;
secondDistortionCoeffs 0;
fisheyeCamera true; rot 0;
imuToCameraMatrix {",".join(map(str, CAMERA_FROM_IMU.T.ravel()))};
secondImuToCameraMatrix {",".join(map(str, SECOND_FROM_IMU.T.ravel()))};
imuToCameraShiftSeconds 0.01;
"""


def stereo(recording, *header, **fields):
    entries = [{"cameraInd": index, "time": 0.0, **fields} for index in range(2)]
    recording.lines([*header, {"frames": entries, "number": 0, "time": 0.0}])
    return recording.video("data.mkv", 1).video("data2.mkv", 1)


def test_parameters_stand_in_for_a_calibration(recording):
    path = stereo(recording).path / "parameters.txt"
    path.write_text(FULL)
    with recording.open() as scene:
        first, second = (camera.camera for camera in scene.cameras)
        assert first == Camera("fisheye", 32, 16, 20.5, 21.5, 15.25, 7.75, tuple(FISHEYE))
        assert second == Camera("fisheye", 32, 16, 22.0, 22.0, 16.0, 8.0)
        mounts = [np.linalg.inv(matrix) for matrix in (CAMERA_FROM_IMU, SECOND_FROM_IMU)]
        np.testing.assert_allclose([camera.mount.matrix for camera in scene.cameras], mounts, atol=1e-15)
        assert scene.metadata["recording"]["parameters"] == FULL
        assert set(codes(scene)) == {"old-calibration", "camera-shift-not-applied"}
    path.write_text(FULL + "videoRotation CW90;\n")
    with pytest.raises(DataError, match="imuToCamera is missing"):
        recording.open()
    with recording.open(lenient=True) as scene:
        assert [camera.mount for camera in scene.cameras] == [None, None]
        assert any("videoRotation" in warning.message for warning in scene.warnings)
    for text, problem in (
        ("focalLengthX 1 2;", "focalLengthX 1 2: expected a name and a value"),
        ("focalLengthX;", "focalLengthX: expected a name and a value"),
        ("rot 0; rot 1;", "rot 1: expected a name and a value, each name once"),
        ("focalLengthX wide;", "focalLengthX: 'wide'; expected numbers"),
        ("imuToCameraMatrix 1,0,x;", "imuToCameraMatrix: '1,0,x'; expected numbers"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=problem):
            recording.open()


@pytest.mark.parametrize("nested", [True, False])
def test_lines_at_the_head_report_mountings_and_fisheye_camera_models(recording, nested):
    header = []
    for index, matrix in enumerate((CAMERA_FROM_IMU, SECOND_FROM_IMU)):
        header += [
            {"cameraInd": index, "imuToCamera": (matrix if nested else matrix.T.ravel()).tolist()},
            {"cameraInd": index, "model": "KANNALA_BRANDT4", "coeffs": [*FISHEYE, 0]},
        ]
    stereo(recording, *header, cameraParameters={"focalLength": 20.0, "principalPointX": 15.0, "principalPointY": 7.0})
    with recording.open() as scene:
        for camera, matrix in zip(scene.cameras, (CAMERA_FROM_IMU, SECOND_FROM_IMU), strict=True):
            assert camera.camera == Camera("fisheye", 32, 16, 20.0, 20.0, 15.0, 7.0, tuple(FISHEYE))
            assert camera.images[0].camera == camera.camera
            np.testing.assert_allclose(camera.mount.matrix, np.linalg.inv(matrix), atol=1e-15)
        # the lines themselves stay
        assert len(scene.metadata["recording"]["other_lines"]) == 4


def test_parameters_count_before_lines_and_a_calibration_before_both(recording, pinhole):
    header = {"cameraInd": 0, "imuToCamera": SECOND_FROM_IMU.T.ravel().tolist()}
    recording.lines([header, FRAMES_LINE]).video("data.mkv", 1)
    (recording.path / "parameters.txt").write_text(FULL)
    with recording.open() as scene:
        np.testing.assert_allclose(scene.cameras[0].mount.matrix, np.linalg.inv(CAMERA_FROM_IMU), atol=1e-15)
    text = "focalLength 20; principalPointX 15; principalPointY 7; imuToCameraMatrix 1,0,0,0,-1,0,0,0,-1;\n"
    (recording.path / "parameters.txt").write_text(text)
    with recording.open() as scene:
        assert scene.cameras[0].camera.model == "pinhole"
        np.testing.assert_array_equal(scene.cameras[0].mount.matrix, np.diag([1.0, -1.0, -1.0, 1.0]))
        assert "camera 0 is taken for a pinhole: no model is stated" in [n.message for n in scene.warnings]
    recording.calibration([pinhole])
    with recording.open() as scene:
        np.testing.assert_array_equal(scene.cameras[0].mount.matrix, np.eye(4))
        assert "old-calibration" not in codes(scene)


def test_a_line_may_report_the_one_camera_under_frame_and_those_that_only_look_like_old_ones_state_nothing(
    recording, pinhole
):
    header = ['{"cameraInd":7,"imuToCamera":[]}', '{"cameraInd":"x","imuToCamera":[]}', '{"cameraInd":0,"speed":1}']
    with recording.lines([*header, IMU_LINE]).open() as scene:
        assert "calibration" not in scene.metadata["recording"]
    own = {"focalLength": 25.0}
    frames = [{"time": 0.1 * k, "cameraParameters": own, "shown": k} for k in range(3)]
    lines = [{"frame": frame, "number": k, "time": 0.1 * k} for k, frame in enumerate(frames)]
    recording.lines(lines).calibration([pinhole]).video("data.mkv", 3)
    with recording.open() as scene:
        found = [(im.rgb[0, 0, 0], im.camera.fx, im.camera.fy, im.extras["shown"]) for im in scene.cameras[0].images]
        assert found == [(10 * k, 25.0, 25.0, k) for k in range(3)]
