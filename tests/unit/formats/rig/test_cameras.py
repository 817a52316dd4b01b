"""Cameras: camera models in all their spellings, and images from files and videos."""

import io
import os
import pickle

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from sceneloom.cameras import MODELS, project
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.rig.reader import frame_from_camera, read_camera_model
from sceneloom.scene.cameras import Shutter

from .conftest import BY_RATE, CAMERA_MODEL, codes

SIZE = (640, 480)
POINTS = np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 9], (50, 3))
K = np.array([[500.0, 0, 320], [0, 510.0, 240], [0, 0, 1]])
FISHEYE = [0.01, -0.02, 0.003, -0.0004]
TILTED = [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.003, 0.001, 0.001, 0.0005, -0.001, 0.0003, 0.01, -0.02]


@pytest.mark.parametrize(
    ("model", "given"), [("equidistant", FISHEYE), *(("plumb_bob", TILTED[:count]) for count in (4, 5, 8, 12, 14))]
)
def test_lists_of_coefficients_have_opencvs_order(model, given):
    camera_model = read_camera_model({"K": K, "coefficients": given, "model": model}, SIZE)
    judge = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    expected = judge(POINTS[:, None], np.zeros(3), np.zeros(3), K, np.array(given))[0][:, 0]
    pixels, visible = project(camera_model, POINTS)
    assert visible.any()
    # two programs, both in float64
    np.testing.assert_allclose(pixels[visible], expected[visible], atol=1e-8)


@pytest.mark.parametrize("model", [name for name in MODELS if MODELS[name].coefficient_names])
def test_every_model_of_the_table_is_read_with_its_own_coefficients(model):
    names = MODELS[model].coefficient_names
    values = {name: 1e-3 * (k + 1) for k, name in enumerate(names)}
    camera_model = read_camera_model({"K": K, "model": model.replace("_", "-").upper(), "coefficients": values}, SIZE)
    assert (camera_model.model, camera_model.coefficients) == (model, tuple(values.values()))
    if model != "brown_conrady":  # whose lists are OpenCV's, without lx and ly
        assert read_camera_model({"K": K, "model": model, "coefficients": [*values.values()]}, SIZE) == camera_model
        with pytest.raises(CalibrationError, match=f"{len(names) + 1} distortion coefficients; {model} has"):
            read_camera_model({"K": K, "model": model, "coefficients": [0.0] * (len(names) + 1)}, SIZE)


def test_coefficients_have_names_or_opencvs_order_images_may_be_rectified_and_a_projection_moves_the_camera():
    named = read_camera_model({"fx": 5.0, "cx": 1.0, "cy": 1.0, "coefficients": {"k3": 0.1, "k1": -0.2}}, SIZE)
    listed = read_camera_model({"fx": 5.0, "fy": 5.0, "cx": 1.0, "cy": 1.0, "coefficients": [-0.2, 0, 0, 0, 0.1]}, SIZE)
    probe = np.array([[0.1, 0.2, 1.0]])
    np.testing.assert_array_equal(project(named, probe)[0], project(listed, probe)[0])
    rectified = read_camera_model({"K": K, "coefficients": [-0.2, 0.1, 0, 0], "undistorted": True}, SIZE)
    assert (rectified.model, rectified.coefficients) == ("pinhole", ())
    P = np.column_stack([K, [45.0, -0.3, 0.005]])
    camera_model, shift = read_camera_model({"P": P}, SIZE), frame_from_camera({"P": P})
    homogeneous = np.column_stack([POINTS, np.ones(50)]) @ P.T
    pixels, visible = project(camera_model, shift.inverse().apply(POINTS))
    np.testing.assert_allclose(pixels[visible], (homogeneous[:, :2] / homogeneous[:, 2:])[visible], atol=1e-9)


@pytest.mark.parametrize(
    ("record", "problem"),
    [
        ({}, "no focal length; expected one of fx fy cx cy, K, P"),
        ({"fx": 5.0, "K": K}, "fx and K; expected one of"),
        ({"K": K, "cx": 3.0}, "K beside cx"),
        ({"fx": 5.0, "cx": 3.0}, "cy missing"),
        ({"K": K.T}, r"expected \[fx 0 cx; 0 fy cy; 0 0 1\]"),
        ({"K": K, "model": "pinhol"}, "'pinhol'; expected one of pinhole, .*did you mean 'pinhole'"),
        ({"K": K, "coefficients": [0.1] * 3}, "3 coefficients; expected 0, 4, 5, 8, 12, 14 in OpenCV's order"),
        ({"K": K, "coefficients": {"q1": 0.1}}, "coefficients q1; brown_conrady has k1"),
        ({"K": K, "model": "fisheye", "coefficients": [0.1] * 5}, "5 distortion coefficients; fisheye has 4"),
        ({"K": -K}, "expected"),
        ({"K": K, "width": 640}, "width without height"),
    ],
)
def test_what_is_no_camera_model_is_refused(record, problem):
    with pytest.raises(CalibrationError, match=problem):
        read_camera_model(record, SIZE)


def test_a_camera_model_for_another_size_is_scaled_and_rolling_shutters_kept_as_recordings_state_them(opened):
    scene = opened((CAMERA_MODEL, "cy = 2.5, width = 4, height = 3 }"))
    camera_model = scene.cameras[0].camera
    assert (camera_model.width, camera_model.fx, camera_model.cx) == (8, 12.0, (3.5 + 0.5) * 2 - 0.5)
    assert codes(scene) == ["camera-model-scaled"]
    rolling = (CAMERA_MODEL, CAMERA_MODEL + "\nshutter_roll_s = 0.033\nshutter_left_to_right = true")
    assert Shutter.of(opened(rolling).cameras[0]) == Shutter(0.033, over_columns=True)
    assert Shutter.of(opened().cameras[0]) == Shutter()


def test_jpeg_images_are_decoded_and_their_bytes_are_at_hand(opened, folder):
    rng = np.random.default_rng(1)
    smooth = cv2.resize(rng.integers(0, 255, (3, 4, 3)).astype(np.uint8), (80, 60))
    Image.fromarray(smooth).save(folder / "front" / "0.jpg", quality=98, subsampling=0)
    Image.fromarray(smooth[:, :, 0]).save(folder / "front" / "1.jpg", quality=98)
    images = opened(("front/*.png", "front/*.jpg")).cameras[0].images
    # quality 98 leaves a few levels
    assert np.abs(images[0].rgb.astype(int) - smooth).max() < 12
    assert np.abs(images[1].rgb.astype(int) - smooth[:, :, :1]).max() < 12
    assert images[0].encoded() == (folder / "front" / "0.jpg").read_bytes()


def test_images_of_8_bits_become_red_green_blue_and_those_of_16_or_another_size_are_refused(opened, folder):
    path = folder / "front" / "1.png"
    for image, problem in (
        *((Image.new(mode, (8, 6), 1), None) for mode in ("L", "P", "1")),
        (Image.new("RGBA", (8, 6), (1, 2, 3, 4)), None),
        (Image.new("I;16", (8, 6), 70), "'I;16'; expected 8-bit grey or colour"),
        *((np.full((6, 8, n), 300, np.uint16), "'RGBA?;16'; expected 8-bit grey or colour") for n in (3, 4)),
        (Image.new("RGB", (6, 8)), r"1\.png: is 6x8; expected 8x6"),
    ):
        if isinstance(image, Image.Image):
            image.save(path)
        else:
            cv2.imwrite(str(path), image)
        read = opened().cameras[0].images[1]
        if problem is None:
            assert read.rgb.shape == (6, 8, 3)
        else:
            with pytest.raises(DataError, match=problem):
                _ = read.rgb


def test_pipes_and_files_of_another_kind_among_the_images_are_refused_and_torn_ones_left_out(refused, opened, folder):
    (folder / "front" / "t.txt").write_text("1")
    refused(r"'t.txt'; expected files that end with .png .jpg .jpeg", ("front/*.png", "front/*"))
    # a lenient reading takes the size of the first image that can be read
    (folder / "front" / "0.png").write_bytes(b"torn")
    scene = opened(lenient=True)
    assert (len(scene.cameras[0].images), codes(scene)) == (2, ["unreadable-files"])
    refused(r"0\.png: is no PNG and no JPEG image")
    os.mkfifo(folder / "front" / "9.png")
    refused(r"'front/9\.png': is a named pipe; expected a regular file")


REDS = [0, 40, 80, 120, 160]
TIMES = {"t.csv": "frame,time_ms\n0,5\n1,7\n2,11\n3,13\n4,17\n", "t.txt": "5\n7\n11\n13\n17\n", "two.txt": "1\n2\n"}
AS_VIDEO = ('files = "front/*.png"', 'video = "front.mkv"')
BY_LINES = 'times = { lines = "t.txt", unit = "milliseconds" }'


@pytest.fixture
def video(folder):
    """Five images of growing brightness, 64x48 at 20 a second, and lists of times."""
    path = folder / "front.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=20)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "bgr0"
        for red in REDS:
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), red, np.uint8), "rgb24")
            container.mux(stream.encode(frame.reformat(format="bgr0")))
        container.mux(stream.encode())
    for name, text in TIMES.items():
        (folder / name).write_text(text)
    return path


def test_videos_are_images_with_times(opened, video):
    for times, expected_ms in (
        ("times = { rate_hz = 10, start_s = 1.5 }", [1500, 1600, 1700, 1800, 1900]),
        ("times = { container = true, start_s = 2 }", [2000, 2050, 2100, 2150, 2200]),
        ('times = { csv = "t.csv" }', [5, 7, 11, 13, 17]),
        (BY_LINES, [5, 7, 11, 13, 17]),
    ):
        with opened(AS_VIDEO, (BY_RATE, times)) as scene:
            camera = scene.cameras[0]
            assert camera.images.timestamps_ns.tolist() == [ms * 1_000_000 for ms in expected_ms]
            assert [int(image.rgb[0, 0, 0]) for image in camera.images] == REDS
            assert (camera.video.codec, camera.video.frame_indices) == ("ffv1", None)
            assert pickle.loads(pickle.dumps(scene)).cameras[0].images[3].rgb[0, 0, 0] == 120
            with camera.video.open() as file:
                assert isinstance(file, io.IOBase)
        with pytest.raises(DataError, match="is closed"):
            _ = camera.images[0].rgb


def test_of_a_video_that_breaks_off_a_lenient_reading_keeps_the_images_before_the_cut(refused, opened, video):
    refused("2 times for 5 files or images", AS_VIDEO, (BY_RATE, 'times = { lines = "two.txt" }'))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) * 3 // 5])
    changes = (AS_VIDEO, (BY_RATE, BY_LINES))
    refused("cut off", *changes)
    with opened(*changes, lenient=True) as scene:
        camera = scene.cameras[0]
        count = len(camera.images)
        assert 0 < count < 5
        assert [int(image.rgb[0, 0, 0]) for image in camera.images] == REDS[:count]
        assert pickle.loads(pickle.dumps(scene)).cameras[0].images[0].rgb[0, 0, 0] == 0
        assert camera.video is None
        counts = {warning.code: warning.count for warning in scene.warnings}
        assert (counts["unreadable-videos"], counts["counts-disagree"]) == (1, 5 - count)
    video.write_bytes(b"no video")
    refused("cannot be read as video", AS_VIDEO)
