"""Videos in every container, whole and cut off anywhere: which images are read, and that each is the right one."""

import av
import numpy as np
import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.errors import DataError

COUNT = 24
CODECS = {
    "data.mkv": ("libx264", "yuv420p"),
    "data.mp4": ("libx264", "yuv420p"),
    "data.mov": ("libx264", "yuv420p"),
    "data.avi": ("mpeg4", "yuv420p"),
    "data.ts": ("libx264", "yuv420p"),
}
"""By name of the video: an encoder that its container is usual with. H.264 stores images out of their order."""


def video(path, codec, pixels, *, share=1.0):
    """Images that get brighter by 8 levels each, with noise so that all take some room; cut off after a share."""
    rng = np.random.default_rng(5)
    options = {"movflags": "faststart"} if path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        stream.codec_context.gop_size = 8
        stream.options = {"bf": "2", "crf": "12"} if codec == "libx264" else {}
        for k in range(COUNT):
            image = (20 + 8 * k + rng.integers(-15, 16, (48, 64, 1))).repeat(3, axis=2).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


@pytest.fixture
def drive(recording, pinhole):
    """A recording whose video is still to be added."""
    frames = [{"frames": [{"cameraInd": 0}], "number": k, "time": 0.1 * k} for k in range(COUNT)]
    size = {"imageWidth": 64, "imageHeight": 48, "principalPointX": 31.5, "principalPointY": 23.5}
    return recording.lines(frames).calibration([{**pinhole, **size}])


def brightness(image):
    """Number of the image as its brightness reports it; encoding loses less than half of the 8 levels."""
    return round((float(image.rgb.mean()) - 20) / 8)


@pytest.mark.parametrize("name", CODECS)
def test_each_line_gets_its_image_from_a_video_of_any_container(drive, name):
    video(drive.path / name, *CODECS[name])
    with drive.open() as scene:
        camera = scene.cameras[0]
        assert [brightness(image) for image in camera.images] == list(range(COUNT))
        assert not scene.warnings


@pytest.mark.parametrize("share", [0.3, 0.55, 0.8])
@pytest.mark.parametrize("name", CODECS)
def test_of_a_video_that_is_cut_off_the_whole_images_are_read_when_lenient(drive, name, share):
    video(drive.path / name, *CODECS[name], share=share)
    with pytest.raises(DataError) as error:
        drive.open()
    assert name in str(error.value)
    with drive.open(lenient=True) as scene:
        images = scene.cameras[0].images if scene.cameras else ()
        assert [brightness(image) for image in images] == list(range(len(images)))
        assert 0 <= len(images) < COUNT
        assert {"unreadable-videos", "unmatched-images"} & {warning.code for warning in scene.warnings}
    # the tables of these stand before the images, or between them
    if name in {"data.mkv", "data.mp4", "data.ts"}:
        # a group of 8 and what is stored ahead of its time may be incomplete at the end
        assert len(images) >= COUNT * share - 10


def test_what_is_left_of_a_video_is_reported_with_its_count(drive):
    video(drive.path / "data.mkv", "ffv1", "bgr0", share=0.5)
    with pytest.raises(DataError, match=r"data\.mkv: byte \d+: is cut off: the container goes on"):
        drive.open()
    with drive.open(lenient=True) as scene:
        count = len(scene.cameras[0].images)
        assert COUNT // 2 - 3 < count < COUNT // 2 + 3
        messages = {warning.code: warning.message for warning in scene.warnings}
        assert f"its first {count} images are read" in messages["unreadable-videos"]
        assert f"{count} images, but data.jsonl has {COUNT} frames lines" in messages["unmatched-images"]
        assert "The video is cut off" in messages["unmatched-images"]
        assert "is open" not in messages["unmatched-images"]
    report = validate(drive.path)
    assert not report.passed
    assert "unreadable-videos" in {finding.rule for finding in report.findings}


@pytest.mark.parametrize("target", ["written", "written.sfs"])
def test_what_is_left_of_a_video_can_be_written(drive, tmp_path, target):
    video(drive.path / "data.mkv", "libx264", "yuv420p", share=0.5)
    with drive.open(lenient=True) as scene:
        count = len(scene.cameras[0].images)
        sceneloom.write(scene, tmp_path / target)
    with sceneloom.open(tmp_path / target) as scene:
        assert [brightness(image) for image in scene.cameras[0].images] == list(range(count))
    report = validate(drive.path, fix=tmp_path / "repaired")
    assert report.passed
    assert "unreadable-videos" in {finding.rule for finding in report.left_out}


def test_a_video_of_which_nothing_is_left_is_reported_and_left_out(drive):
    path = drive.path / "data.mp4"
    video(path, "libx264", "yuv420p")
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(DataError, match="cannot be read as video"):
        drive.open()
    with drive.open(lenient=True) as scene:
        assert [len(camera.images) for camera in scene.cameras] == [0]
