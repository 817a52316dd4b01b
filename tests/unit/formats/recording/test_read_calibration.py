"""Reading `calibration.json`: camera models against OpenCV, mountings against NumPy, and what is refused."""

import json
import re
from typing import Any

import cv2
import numpy as np
import pytest

from sceneloom.cameras import project
from sceneloom.errors import CalibrationError, DataError, OptionError
from sceneloom.formats.recording.spec import FORMAT
from sceneloom.scene import Scene, WarningKind

CAMERA_MATRIX = np.array([[420.0, 0.0, 310.0], [0.0, 415.0, 245.0], [0.0, 0.0, 1.0]])
POINTS_CAMERA = np.random.default_rng(3).uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 12.0], (50, 3))
ROTATED = np.array(
    [
        [0.000998747205656553, -0.9999903820710413, 0.004259378487635177, -0.25422760500525077],
        [0.00841690182755742, -0.004250821136069464, -0.9999555696753273, 0.7190941084821951],
        [0.9999640486966582, 0.001034553284226362, 0.008412575208732587, -1.0863370561924168],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def entry(model: str, coefficients: list[float], **further: Any) -> dict[str, Any]:
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


def open_with(recording, *cameras: dict[str, Any], lenient: bool = False, **further: Any) -> Scene:
    recording.lines(['{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":0}'])
    return FORMAT.open(recording.calibration(cameras, **further).path, lenient=lenient)


OPENCV = {
    ("pinhole", ()): lambda: np.zeros(5),
    ("pinhole", (-0.2, 0.05, -0.01)): lambda: np.array([-0.2, 0.05, 0.0, 0.0, -0.01]),
    ("brown-conrady", (-0.2, 0.05, 1e-3, -2e-3, 0.01)): lambda: None,
    ("brown-conrady", (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, -0.01)): lambda: None,
    (
        "BROWN_CONRADY",
        (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, -0.01, 1e-3, 2e-3, -1e-3, 3e-3, 0.01, -0.02),
    ): lambda: None,
}


@pytest.mark.parametrize(("model", "coefficients"), OPENCV)
def test_perspective_camera_models_project_as_opencv_does(recording, model, coefficients):
    camera = open_with(recording, entry(model, list(coefficients))).cameras[0].camera
    theirs = OPENCV[model, coefficients]()
    theirs = np.array(coefficients) if theirs is None else theirs
    expected, _ = cv2.projectPoints(POINTS_CAMERA, np.zeros(3), np.zeros(3), CAMERA_MATRIX, theirs)
    pixels, visible = project(camera, POINTS_CAMERA)
    assert visible.sum() > 40
    # both compute in float64, so only rounding is between them
    np.testing.assert_allclose(pixels[visible], expected[visible, 0], atol=1e-8)


@pytest.mark.parametrize("coefficients", [(), (-0.028, 0.0021, -0.0052, 0.0004)])
@pytest.mark.parametrize("model", ["kannala-brandt4", "KANNALA_BRANDT4", "KannalaBrandt4"])
def test_fisheye_camera_models_project_as_opencv_does(recording, model, coefficients):
    camera = open_with(recording, entry(model, list(coefficients))).cameras[0].camera
    theirs = np.array(coefficients or (0.0,) * 4)
    expected, _ = cv2.fisheye.projectPoints(POINTS_CAMERA[:, None], np.zeros(3), np.zeros(3), CAMERA_MATRIX, theirs)
    pixels, visible = project(camera, POINTS_CAMERA)
    assert visible.sum() > 40
    # both compute in float64, so only rounding is between them
    np.testing.assert_allclose(pixels[visible], expected[visible, 0], atol=1e-8)


def test_the_omnidirectional_model_projects_as_opencv_does(recording):
    coefficients = [-0.21, 0.034, 1.7, 1.23, 5e-4, -8e-4]
    camera = open_with(recording, entry("OMNIDIR", coefficients)).cameras[0].camera
    k1, k2, skew, xi, p1, p2 = coefficients
    matrix = CAMERA_MATRIX.copy()
    matrix[0, 1] = skew
    expected, _ = cv2.omnidir.projectPoints(
        POINTS_CAMERA[:, None], np.zeros(3), np.zeros(3), matrix, xi, np.array([[k1, k2, p1, p2]])
    )
    pixels, visible = project(camera, POINTS_CAMERA)
    assert visible.sum() > 40
    np.testing.assert_allclose(pixels[visible], expected[visible, 0], atol=1e-8)


def slow_kannala_brandt18(numbers, point):
    """Word by word, from the format's list k0-k3 l1-l3 i1-i4 m1-m3 j1-j4."""
    k, ls, i, m, j = numbers[:4], numbers[4:7], numbers[7:11], numbers[11:14], numbers[14:18]
    theta, phi = np.arctan2(np.hypot(point[0], point[1]), point[2]), np.arctan2(point[1], point[0])
    waves = np.array([np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi)])
    odd = np.array([theta, theta**3, theta**5])
    radius = theta * (1 + sum(k[n] * theta ** (2 * n + 2) for n in range(4)))
    along, across = radius + (odd @ ls) * (waves @ i), (odd @ m) * (waves @ j)
    return along * np.array([np.cos(phi), np.sin(phi)]) + across * np.array([-np.sin(phi), np.cos(phi)])


@pytest.mark.parametrize("count", [0, 4, 18])
def test_kannala_and_brandts_full_model_projects_as_its_formulas_state(recording, count):
    asymmetric = [0.01, 0.002, 1e-3, 0.5, 0.3, -0.2, 0.1, 4e-3, -2e-3, 1e-3, 0.2, 0.3, -0.2, 0.1]
    numbers = np.array([-0.028, 0.0021, -0.0052, 0.0004, *asymmetric])
    numbers[count:] = 0.0
    camera = open_with(recording, entry("kannala-brandt18", numbers[:count].tolist())).cameras[0].camera
    expected = np.array([slow_kannala_brandt18(numbers, point) for point in POINTS_CAMERA])
    pixels, visible = project(camera, POINTS_CAMERA)
    assert visible.sum() > 40
    expected = expected * [CAMERA_MATRIX[0, 0], CAMERA_MATRIX[1, 1]] + CAMERA_MATRIX[:2, 2]
    np.testing.assert_allclose(pixels[visible], expected[visible], atol=1e-8)


@pytest.mark.parametrize("key", ["imuToCamera", "imuToCameraMatrix"])
def test_the_mounting_is_the_inverse_of_the_matrix(recording, key):
    camera = entry("pinhole", [])
    matrix = camera.pop("imuToCamera")
    scene = open_with(recording, {**camera, key: matrix})
    mount = scene.cameras[0].mount
    assert mount is not None
    # the file's numbers are orthonormal to about 1e-7 only, and are normalised
    np.testing.assert_allclose(mount.matrix, np.linalg.inv(ROTATED), atol=1e-6)
    assert scene.warnings == ()


def test_sixteen_numbers_are_columns(recording):
    camera = entry("pinhole", [], imuToCamera=ROTATED.T.ravel().tolist())
    mount = open_with(recording, camera).cameras[0].mount
    assert mount is not None
    np.testing.assert_allclose(mount.matrix, np.linalg.inv(ROTATED), atol=1e-6)


@pytest.mark.parametrize(("scale", "noticed"), [(1.0004, False), (1.002, True)])
def test_rotations_that_are_slightly_off_are_normalised(recording, scale, noticed):
    matrix = ROTATED.copy()
    matrix[:3, :3] *= scale
    scene = open_with(recording, entry("pinhole", [], imuToCamera=matrix.tolist()))
    mount = scene.cameras[0].mount
    assert mount is not None
    np.testing.assert_allclose(mount.rotation, ROTATED[:3, :3].T, atol=1e-6)
    assert [warning.code for warning in scene.warnings] == (["rotation-normalised"] if noticed else [])
    assert all(warning.location.endswith("calibration.json: cameras[0].imuToCamera") for warning in scene.warnings)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.01, 1.0, 1.0, 1.0]).tolist(), "rotation off by 0.02"),
        (np.diag([1.0, 1.0, -1.0, 1.0]).tolist(), "mirrored or singular"),
        (np.zeros((4, 4)).tolist(), "last row"),
        (ROTATED.T.tolist(), "transposed"),
        (ROTATED.ravel().tolist(), "last row"),
        (ROTATED[:3].tolist(), "3 rows; expected 4 rows of 4 numbers"),
        (ROTATED[:, :3].tolist(), "4 rows; expected 4 rows of 4 numbers"),
        ([1.0, 2.0], "2 numbers; expected"),
        ([], "0 numbers; expected"),
    ],
)
def test_matrices_that_are_not_rigid_are_refused(recording, matrix, words):
    with pytest.raises(CalibrationError, match=r"calibration\.json: cameras\[0\]\.imuToCamera: ") as caught:
        open_with(recording, entry("pinhole", [], imuToCamera=matrix))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "omnidir9"}, ["cameras[0].model: 'omnidir9'", "pinhole, brown-conrady, kannala-brandt4"]),
        ({"model": None}, ["cameras[0].model: missing"]),
        ({"distortionCoefficients": [0.1]}, ["1 numbers; expected 0 or 3 for 'pinhole'"]),
        ({"focalLengthX": None}, ["cameras[0].focalLengthX: missing"]),
        ({"focalLengthX": "wide"}, ["cameras[0].focalLengthX", '"wide"', "a number"]),
        ({"focalLengthX": 0.0}, ["cameras[0]: focal lengths 0.0"]),
        ({"imageWidth": -640}, ["cameras[0]: imageWidth, imageHeight (-640, 480)"]),
        ({"imageWidth": 640.5}, ["(640.5, 480)", "whole numbers"]),
        ({"imuToCamera": "left"}, ["cameras[0].imuToCamera", '"left"']),
    ],
)
def test_unusable_cameras_are_named_with_file_and_path(recording, change, words):
    camera = entry("pinhole", []) | change
    with pytest.raises((CalibrationError, DataError)) as caught:
        open_with(recording, camera)
    for word in ["calibration.json", *words]:
        assert word in str(caught.value)


def test_a_lenient_reading_leaves_unusable_cameras_out(recording):
    scene = open_with(recording, entry("omnidir9", []), entry("pinhole", []), lenient=True)
    assert [camera.id for camera in scene.cameras] == ["camera1"]
    assert [(warning.code, warning.kind) for warning in scene.warnings] == [("unusable-cameras", WarningKind.SKIPPED)]


def test_a_calibration_for_another_image_size_is_scaled_with_a_warning(recording, pinhole):
    recording.video("data.mkv", 1, width=32, height=16)
    recording.lines(['{"frames":[{"cameraInd":0}],"number":0,"time":0}'])
    doubled = pinhole | {
        "imageWidth": 64,
        "imageHeight": 64,
        "principalPointX": 31.5,
        "principalPointY": 20.0,
    }
    scene = FORMAT.open(recording.calibration([doubled]).path)
    camera = scene.cameras[0].camera
    assert (camera.width, camera.height) == (32, 16)
    assert (camera.fx, camera.fy) == (10.0, 5.25)
    # the edge of an image is half a pixel before the centre of its first one
    assert (camera.cx, camera.cy) == (15.5, 20.5 / 4 - 0.5)
    assert [(warning.code, warning.kind) for warning in scene.warnings] == [
        ("camera-model-scaled", WarningKind.REPAIRED)
    ]
    assert "64x64" in scene.warnings[0].message


def test_a_missing_image_size_is_that_of_the_images(recording, pinhole):
    recording.video("data.mkv", 1, width=48, height=32)
    recording.lines(['{"frames":[{"cameraInd":0}],"number":0,"time":0}'])
    del pinhole["imageWidth"], pinhole["imageHeight"]
    scene = FORMAT.open(recording.calibration([pinhole]).path)
    assert (scene.cameras[0].camera.width, scene.cameras[0].camera.height) == (48, 32)
    assert scene.warnings == ()


def test_a_camera_whose_image_size_nothing_reports_is_left_out_with_a_warning(recording):
    camera = entry("pinhole", [])
    del camera["imageWidth"]
    scene = open_with(recording, camera)
    assert scene.cameras == ()
    assert [warning.code for warning in scene.warnings] == ["cameras-without-size"]


def test_a_camera_without_mounting_is_an_error_and_leniently_one_without_a_location(recording):
    camera = entry("pinhole", [])
    del camera["imuToCamera"]
    with pytest.raises(DataError, match=r"cameras\[0\]: imuToCamera is missing"):
        open_with(recording, camera)
    scene = FORMAT.open(recording.path, lenient=True)
    assert scene.cameras[0].mount is None
    assert [warning.code for warning in scene.warnings] == ["mounts-missing"]


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
    with FORMAT.open(recording.path, lenient=True) as scene:
        assert [warning.code for warning in scene.warnings] == ["contradicting-mounts"]
        if listed == "cameras":
            assert scene.cameras[0].mount.translation[0] == -1.0
    sensor[f"{key}Matrix"] = one.tolist()
    with open_with(recording, camera, **further) as scene:
        assert scene.warnings == ()


def test_a_byte_order_mark_is_passed_over_with_a_warning(recording):
    open_with(recording, entry("pinhole", []))
    path = recording.path / "calibration.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    with FORMAT.open(recording.path) as scene:
        assert [warning.code for warning in scene.warnings] == ["byte-order-mark"]
        assert len(scene.cameras) == 1


def test_entries_are_kept_word_by_word(recording):
    camera = entry("pinhole", [], shutterRollTimeSeconds=0.03, rollingShutterLeftToRight=True, maker="ours")
    scene = open_with(recording, camera, imuForward=[1, 0, 0])
    assert scene.cameras[0].extras["calibration"] == json.loads(json.dumps(camera))
    assert scene.metadata["recording"]["calibration"]["imuForward"] == [1, 0, 0]


def test_a_clock_shift_of_the_camera_is_kept_but_not_applied(recording):
    scene = open_with(recording, entry("pinhole", [], imuToCameraShiftSeconds=0.01))
    (warning,) = scene.warnings
    assert (warning.code, warning.kind) == ("camera-shift-not-applied", WarningKind.ASSUMED)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"cameras": {}}', '{"cameras": [3]}', '{"lidars": "none"}'])
def test_a_calibration_that_is_no_calibration_is_a_fault_of_its_file(recording, text):
    recording.lines(['{"sensor":{"type":"gyroscope","values":[0,0,0]},"time":0}'])
    (recording.path / "calibration.json").write_text(text)
    with pytest.raises(DataError, match=r"calibration\.json"):
        FORMAT.open(recording.path)


FIX = '{"gps":{"latitude":60.1,"longitude":24.9,"altitude":14.0},"time":1.0}'
LEVER = [[0.0, 1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.25], [0.0, 0.0, 1.0, -1.5], [0.0, 0.0, 0.0, 1.0]]


def gnss_mount(recording, **further):
    recording.lines([FIX]).calibration((), **further)
    with FORMAT.open(recording.path) as scene:
        return scene.sensor("gnss").mount, {warning.code for warning in scene.warnings}


def test_the_antenna_sits_where_imu_to_gnss_says(recording):
    mount, warnings = gnss_mount(recording, imuToGnss=LEVER)
    # p_gnss = T p_imu, so the antenna, the origin of its own frame, is at the inverse's last column
    np.testing.assert_allclose(mount.matrix, np.linalg.inv(LEVER), atol=1e-15)
    assert not warnings


@pytest.mark.parametrize("location", [[0.5, -0.2, 1.25], {"x": 0.5, "y": -0.2, "z": 1.25}])
def test_an_antenna_given_by_its_location_is_assumed_to_be_there(recording, location):
    mount, warnings = gnss_mount(recording, imuToGnss=location)
    np.testing.assert_array_equal(mount.translation, [0.5, -0.2, 1.25])
    assert warnings == {"antenna-location"}


def test_a_receiver_without_a_calibrated_antenna_has_no_mounting(recording):
    assert gnss_mount(recording) == (None, set())


@pytest.mark.parametrize(
    ("further", "problem"),
    [
        (
            {"imuToGnss": [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
            "imuToGnss: rotation off by 3",
        ),
        ({"imuToGnss": [1.0, 2.0]}, "imuToGnss: 2 numbers"),
        (
            {"imuToGnss": {"x": 1.0, "y": 2.0}},
            'imuToGnss: {"x":1.0,"y":2.0}: Object missing required field `z`',
        ),
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
    assert "unusable-calibrations" in {warning.code for warning in scene.warnings}
    assert scene.metadata["recording"]["calibration"].keys() == {"cameras", *further}


def test_rotations_without_translation_are_read_by_rows_or_nine_numbers_by_columns(recording):
    rows = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    flat = np.array(rows).T.ravel().tolist()
    mounts = [
        open_with(recording, entry("pinhole", [], imuToCamera=numbers)).cameras[0].mount for numbers in (rows, flat)
    ]
    for mount in mounts:
        np.testing.assert_allclose(mount.matrix[:3, :3], np.array(rows).T, atol=1e-15)
        np.testing.assert_array_equal(mount.translation, np.zeros(3))


def test_another_frame_of_the_output_is_reported_not_applied(recording):
    scene = open_with(recording, imuToOutput=LEVER)
    assert {warning.code for warning in scene.warnings} == {"poses-of-imu"}
    assert not open_with(recording, imuToOutput=np.eye(4).tolist()).warnings


@pytest.mark.parametrize(
    "field",
    [{"shutterRollTimeSeconds": -0.01}, {"exposureTimeSeconds": "long"}, {"rollingShutterLeftToRight": 1}],
)
def test_impossible_shutters_are_refused_with_their_path(recording, field):
    name = next(iter(field))
    with pytest.raises(DataError, match=rf"cameras\[0\]\.{name}"):
        open_with(recording, entry("pinhole", [], **field))


def test_shutters_are_kept_with_the_camera(recording):
    shutter = {
        "shutterRollTimeSeconds": 0.02,
        "rollingShutterLeftToRight": True,
        "exposureTimeSeconds": 0.008,
    }
    sensor = open_with(recording, entry("pinhole", [], **shutter)).cameras[0]
    assert {name: sensor.extras["calibration"][name] for name in shutter} == shutter


@pytest.mark.parametrize(
    ("camera_shift", "expected_ns"),
    [("ignore", 1_000_000_000), ("apply", 1_015_000_000), ("subtract", 985_000_000)],
)
def test_camera_shifts_move_the_images_only_where_asked_for(recording, pinhole, camera_shift, expected_ns):
    recording.lines([{"frames": [{"cameraInd": 0}], "number": 0, "time": 1.0}]).video("data.mkv", 1)
    recording.calibration([{**pinhole, "imuToCameraShiftSeconds": 0.015}])
    with FORMAT.open(recording.path, camera_shift=camera_shift) as scene:
        camera, asked = scene.cameras[0], camera_shift != "ignore"
        assert camera.images.timestamps_ns.tolist() == [expected_ns]
        assert camera.images[0].extras["file_seconds"] == 1.0
        assert [warning.code for warning in scene.warnings] == [
            "camera-shift-applied" if asked else "camera-shift-not-applied"
        ]
        # a shift that was applied must not be applied again by those who read what is written
        assert ("imuToCameraShiftSeconds" in camera.extras["calibration"]) is not asked
        shifts = {"camera0": (expected_ns - 1_000_000_000) / 1e9}
        assert scene.metadata["recording"].get("camera_shifts") == (shifts if asked else None)


def test_an_unknown_use_of_camera_shifts_names_the_known_ones(recording):
    recording.lines([FIX])
    with pytest.raises(OptionError, match="camera_shift 'both'; expected one of: ignore, apply, subtract"):
        FORMAT.open(recording.path, camera_shift="both")
