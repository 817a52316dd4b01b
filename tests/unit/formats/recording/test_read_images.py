"""Which image belongs to which line, and what single lines state about their images."""

import re
from dataclasses import replace

import av
import numpy as np
import pytest

import sceneloom
from sceneloom.checks import validate
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.recording.reader import choose_images
from sceneloom.scene import WarningKind

GREY_STEP = 10
"""Image k of the test videos is grey 10 k."""


def frames(number, time, *entries, **further):
    return {"frames": list(entries or ({"cameraInd": 0},)), "number": number, "time": time, **further}


def shown(camera):
    """Which images of the video the camera shows, by their grey."""
    return [int(image.rgb[0, 0, 0]) // GREY_STEP for image in camera.images]


@pytest.mark.parametrize(
    ("numbers", "count", "indices", "by_line"),
    [
        ([0, 1, 2, 3], 4, [0, 1, 2, 3], False),
        ([28, 29, 30], 3, [0, 1, 2], False),
        ([5, 7, 8], 4, [0, 2, 3], False),
        ([2, 0, 1], 3, [2, 0, 1], False),
        ([-4, -3, -1], 4, [0, 1, 3], False),
        ([7], 1, [0], False),
        ([], 0, [], False),
        ([5, 6, 6, 7], 3, [0, 1, 1, 2], False),  # a number that two lines have means one image
        ([5, 7, 8], 3, [0, 1, 2], True),
        ([0, 1, 0, 1], 4, [0, 1, 2, 3], True),
        ([9, 5, 7], 3, [2, 0, 1], True),
        # other counts are a problem that names both
        ([0, 1, 2, 3], 3, [0, 1, 2, -1], None),
        ([0, 1, 2, 3], 5, [0, 1, 2, 3], None),
        ([5, 7, 9], 4, [0, 2, -1], None),
        ([0, 0, 1], 4, [0, 1, 2], None),
        ([], 2, [], None),
    ],
)
def test_images_are_counted_by_number_from_the_first_or_by_line_where_only_these_counts_agree(
    numbers, count, indices, by_line
):
    choice = choose_images(np.array(numbers, np.int64), count)
    assert choice.indices.tolist() == indices
    if by_line is None:
        assert f"{count} images" in choice.problem
        assert (f"{len(numbers)} frames lines" if numbers else "no frames line") in choice.problem
    else:
        assert (choice.by_line, choice.problem) == (by_line, None)


@pytest.mark.parametrize("kind", ["video", "pngs"])
def test_images_are_those_of_the_video_or_the_png_folder(recording, pinhole, kind):
    recording.video("data.mkv", 4) if kind == "video" else recording.pngs("frames1", 4)
    scene = recording.lines([frames(k, 0.1 * k) for k in range(4)]).calibration([pinhole]).open()
    camera = scene.cameras[0]
    assert camera.id == "camera0"
    assert shown(camera) == [0, 1, 2, 3]
    assert camera.images.timestamps_ns.tolist() == [0, 100_000_000, 200_000_000, 300_000_000]
    assert camera.images[2].extras == {"file_seconds": 0.2, "number": 2}
    assert scene.warnings == ()
    assert (camera.video is None) == (kind == "pngs")
    image = camera.images[0]
    if kind == "video":
        assert (camera.video.codec, camera.video.frame_indices) == ("ffv1", None)
        with camera.video.open() as file:
            assert file.read() == (recording.path / "data.mkv").read_bytes()
        scene.close()
        with pytest.raises(DataError, match="closed"):
            _ = image.rgb


def test_lines_without_a_camera_or_without_its_bitmap_still_use_up_an_image(recording, pinhole):
    recording.video("data.mkv", 4).video("data2.mkv", 4).lines(
        [
            frames(0, 0.0, {"cameraInd": 0}, {"cameraInd": 1}),
            frames(1, 0.1, {"cameraInd": 1}),
            frames(2, 0.2, {"cameraInd": 0}, {"cameraInd": 1, "missingBitmap": True}),
            frames(3, 0.3, {"cameraInd": 0}, {"cameraInd": 1}),
        ]
    )
    with recording.calibration([pinhole, pinhole]).open() as scene:
        assert [shown(camera) for camera in scene.cameras] == [[0, 2, 3], [0, 1, 3]]
        assert scene.cameras[1].images.timestamps_ns.tolist() == [0, 100_000_000, 300_000_000]
        assert scene.cameras[0].video is not None
        assert scene.cameras[0].video.frame_indices == (0, 2, 3)
        (warning,) = scene.warnings
        assert (warning.code, warning.kind, warning.count) == ("missing-bitmaps", WarningKind.SKIPPED, 1)


def test_a_gap_in_the_numbers_is_a_gap_in_the_video_unless_the_counts_say_otherwise_and_others_are_a_fault(
    recording, pinhole
):
    recording.calibration([pinhole])
    for images, greys, found in (
        (4, [0, 2, 3], []),
        (3, [0, 1, 2], [("frame-numbers-not-used", WarningKind.REPAIRED)]),
    ):
        recording.video("data.mkv", images).lines([frames(10, 0.0), frames(12, 0.2), frames(13, 0.3)])
        with recording.open() as scene:
            assert shown(scene.cameras[0]) == greys
            assert [(warning.code, warning.kind) for warning in scene.warnings] == found
    recording.lines(frames(k, 0.1 * k) for k in range(5))
    for images, left_out in ((3, 2), (7, 1)):
        recording.video("data.mkv", images)
        with pytest.raises(DataError, match=rf"data\.mkv: {images} images, but data\.jsonl has 5 frames lines"):
            recording.open()
        with recording.open(lenient=True) as scene:
            assert shown(scene.cameras[0]) == [0, 1, 2, 3, 4][:images]
            assert [(n.code, n.count) for n in scene.warnings] == [("unmatched-images", left_out)]
    recording.video("data.mkv", 4).lines(frames(k, 0.1 * k) for k in (2, 3, 4))
    with pytest.raises(DataError, match=r"1 of 3 frames lines mean images that are not there.*image 4, while"):
        recording.open(image_index="number")
    with recording.open(image_index="number", lenient=True) as scene:
        assert (len(scene.cameras[0].images), scene.warnings[0].count) == (2, 1)


def test_unsorted_lines_show_their_own_images_by_time_and_that_of_an_entry_goes_before_that_of_its_line(
    recording, pinhole
):
    lines = [frames(2, 0.2), frames(0, 0.0), frames(1, 0.25, {"cameraInd": 0, "time": 0.125})]
    recording.video("data.mkv", 3).lines(lines).calibration([pinhole])
    with recording.open() as scene:
        images = scene.cameras[0].images
        assert shown(scene.cameras[0]) == [0, 1, 2]
        assert images.timestamps_ns.tolist() == [0, 125_000_000, 200_000_000]
        assert images[1].extras == {"file_seconds": 0.125, "line_seconds": 0.25, "number": 1}


SHIFTED = [[1.0, 0, 0, 0.5], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1]]


def test_a_line_brings_along_a_mounting_and_a_camera_model_that_the_calibration_completes(recording, pinhole):
    own = {"cameraInd": 0, "cameraParameters": {"focalLengthX": 25.0, "focalLengthY": 26.0}, "imuToCamera": SHIFTED}
    parameters = {"distortionModel": "KANNALA_BRANDT4", "distortionCoefficients": [1e-3, 2e-3, 3e-3, 4e-3]}
    other = {"cameraInd": 0, "cameraParameters": parameters}
    lines = [frames(0, 0.0), frames(1, 0.1, own), frames(2, 0.2, other), frames(3, 0.3, own)]
    with recording.video("data.mkv", 4).lines(lines).calibration([pinhole]).open() as scene:
        camera = scene.cameras[0]
        plain, zoomed, fisheye, again = camera.images
        assert (plain.camera, plain.mount) == (camera.camera, None)
        assert zoomed.camera == again.camera == replace(camera.camera, fx=25.0, fy=26.0)
        assert zoomed.mount.translation.tolist() == [-0.5, 0.0, 0.0]
        bent = {"model": "fisheye", "coefficients": (1e-3, 2e-3, 3e-3, 4e-3)}
        assert fisheye.camera == replace(camera.camera, **bent)
    bent = {"distortionCoefficients": [-0.2, 0.1, 0.05]}
    brown = ("brown_conrady", (-0.2, 0.1, 0.0, 0.0, 0.05))
    for change, own, expected in (
        # coefficients of the calibration hold for a line of the same model only
        (bent, {"focalLengthX": 25.0, "distortionModel": "PINHOLE"}, brown),
        (bent, {"focalLengthX": 25.0, "distortionModel": "KannalaBrandt4"}, ("fisheye", ())),
        # and numbers of a line are scaled like those of the calibration
        ({"imageWidth": 64, "imageHeight": 32}, {"focalLengthX": 50.0, "principalPointX": 31.5}, ("pinhole", ())),
    ):
        recording.video("data.mkv", 1).lines([frames(0, 0.0, {"cameraInd": 0, "cameraParameters": own})])
        with recording.calibration([pinhole | change]).open() as scene:
            model = scene.cameras[0].images[0].camera
            found = (model.model, model.coefficients), model.width, model.fx, model.cx
            assert found == (expected, 32, 25.0, 15.5)


@pytest.mark.parametrize(
    ("entry", "kind", "words"),
    [
        ({"cameraParameters": {"focalLengthX": "x"}}, DataError, ["line 2", "cameraParameters.focalLengthX", '"x"']),
        ({"cameraParameters": {"focalLengthX": -1}}, CalibrationError, ["line 2", "focal lengths -1"]),
        ({"cameraParameters": 3}, DataError, ["line 2", "cameraParameters", "3"]),
        ({"imuToCamera": "x"}, DataError, ["line 2", "imuToCamera", '"x"']),
        ({"imuToCamera": np.diag([2, 1, 1, 1]).tolist()}, CalibrationError, ["line 2", "off"]),
    ],
)
def test_unusable_parameters_of_a_line_are_named_with_it(recording, pinhole, entry, kind, words):
    lines = [frames(0, 0.0), frames(1, 0.1, {"cameraInd": 0, **entry}), frames(2, 0.2)]
    recording.video("data.mkv", 3).lines(lines).calibration([pinhole])
    with pytest.raises(kind) as caught:
        recording.open()
    for word in ["data.jsonl", *words]:
        assert word in str(caught.value)
    with recording.open(lenient=True) as scene:
        assert shown(scene.cameras[0]) == [0, 2]
        assert [(n.code, n.count) for n in scene.warnings] == [("unusable-frame-parameters", 1)]


def test_what_a_line_says_further_is_read_with_the_image(recording, pinhole):
    entry = {"cameraInd": 0, "exposureTimeSeconds": 0.01, "features": [{"id": 1, "x": 2.5}]}
    recording.video("data.mkv", 2).lines([frames(0, 0.0), frames(1, 0.1, entry, note="é")]).calibration([pinhole])
    with recording.open() as scene:
        first, second = scene.cameras[0].images
        assert set(first.extras) == {"file_seconds", "number"}
        assert second.extras["exposureTimeSeconds"] == 0.01
        assert second.extras["features"] == [{"id": 1, "x": 2.5}]
        assert second.extras["line"] == {"note": "é"}
        (recording.path / "data.jsonl").write_text("")
        with pytest.raises(DataError, match="changed after it was opened"):
            _ = scene.cameras[0].images[1]
    # and videos that nothing names are reported
    (recording.path / "calibration.json").unlink()
    recording.pngs("frames3", 1).lines([{"sensor": {"type": "a", "values": [1]}, "time": 0}])
    (warning,) = recording.open().warnings
    assert (warning.code, warning.count) == ("videos-not-used", 2)
    assert "data.mkv, frames3" in warning.message


MISSING = r"calibration\.json: .*missing, while data\.jsonl has frames .*write its entry"
EXPECTED = r"no images of camera 0, .*expected data\.\{mkv,mp4,mov,avi,ts\} or frames1/"
VIDEO = "data.mkv"


@pytest.mark.parametrize(
    ("change", "problem", "code"),
    [
        (lambda drive: (drive.path / "calibration.json").unlink(), MISSING, None),
        (lambda drive: drive.calibration([]), MISSING, None),
        (lambda drive: (drive.path / VIDEO).unlink(), EXPECTED, "missing-videos"),
        *((lambda drive, to=to: (drive.path / VIDEO).rename(drive.path / to), f"there is {to}", "missing-videos")
          for to in ("video.mkv", "data.MKV")),
        *((lambda drive, content=content: (drive.path / VIDEO).write_bytes(content), r"data\.mkv", "unreadable-videos")
          for content in (b"", b"no video at all", b"\x1aE\xdf\xa3 almost")),
        (lambda drive: drive.video("data.avi", 1), r"data\.mkv, data\.avi for camera 0; expected one",
         "repeated-videos"),
    ],
)  # fmt: skip
def test_frames_without_their_calibration_or_images_are_an_error_that_says_what_to_do(
    recording, pinhole, change, problem, code
):
    change(recording.video("data.mkv", 1).lines([frames(0, 0.0)]).calibration([pinhole]))
    with pytest.raises(DataError, match=problem):
        recording.open()
    if code is not None:
        with recording.open(lenient=True) as scene:
            assert [warning.code for warning in scene.warnings] == [code]
            assert shown(scene.cameras[0]) == ([0] if code == "repeated-videos" else [])


@pytest.mark.parametrize(("alignment", "images"), [("number", [2, 3, 5]), ("first", [0, 1, 3]), ("line", [0, 1, 2])])
def test_where_counts_do_not_agree_the_trajectory_that_was_taken_is_named_and_others_can_be(
    recording, pinhole, alignment, images
):
    recording.video("data.mkv", 7).calibration([pinhole]).lines(frames(k, 0.1 * k) for k in (2, 3, 5))
    with pytest.raises(DataError, match=r"7 images.*3 frames lines with numbers from 2 to 5") as caught:
        recording.open()
    for words in (
        "a lenient reading takes --image-index first",
        "--image-index number (`number` is the image's index, from 0)",
        "--image-index line",
    ):
        assert words in caught.value.problem
    with recording.open(lenient=True) as scene:
        assert "takes --image-index first" in scene.warnings[0].message
    with recording.open(image_index=alignment) as scene:
        assert shown(scene.cameras[0]) == images
        assert scene.warnings == ()
    report = sceneloom.validate(recording.path, image_index=alignment, rules=["unmatched-images"])
    assert report.passed
    fixed = sceneloom.validate(recording.path, fix=recording.path.parent / "fixed")
    (left,) = [finding for finding in fixed.left_out if finding.rule == "unmatched-images"]
    assert "--image-index first" in left.message


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
def test_each_line_gets_its_image_from_a_video_of_any_container_and_of_one_that_is_cut_off_if_whole(drive, name):
    video(drive.path / name, *CODECS[name])
    with drive.open() as scene:
        assert [brightness(image) for image in scene.cameras[0].images] == list(range(COUNT))
        assert not scene.warnings
    for share in (0.3, 0.55, 0.8):
        video(drive.path / name, *CODECS[name], share=share)
        with pytest.raises(DataError, match=re.escape(name)):
            drive.open()
        with drive.open(lenient=True) as scene:
            images = scene.cameras[0].images if scene.cameras else ()
            assert [brightness(image) for image in images] == list(range(len(images)))
            assert 0 <= len(images) < COUNT
            assert {"unreadable-videos", "unmatched-images"} & {warning.code for warning in scene.warnings}
        # the tables of these stand before the images, or between them
        if name in {"data.mkv", "data.mp4", "data.ts"}:
            # a group of 8 and what is stored ahead of its time may be incomplete at the end
            assert len(images) >= COUNT * share - 10


def test_what_is_left_of_a_video_is_reported_with_its_count_and_can_be_written(drive, tmp_path):
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
    video(drive.path / "data.mkv", "libx264", "yuv420p", share=0.5)
    with drive.open(lenient=True) as scene:
        count = len(scene.cameras[0].images)
        for target in ("written", "written.sfs"):
            sceneloom.write(scene, tmp_path / target)
            with sceneloom.open(tmp_path / target) as again:
                assert [brightness(image) for image in again.cameras[0].images] == list(range(count))
    report = validate(drive.path, fix=tmp_path / "repaired")
    assert report.passed
    assert "unreadable-videos" in {finding.rule for finding in report.left_out}
    # of which nothing is left
    (drive.path / "data.mkv").unlink()
    video(drive.path / "data.mp4", "libx264", "yuv420p")
    (drive.path / "data.mp4").write_bytes((drive.path / "data.mp4").read_bytes()[:600])
    with pytest.raises(DataError, match="cannot be read as video"):
        drive.open()
    with drive.open(lenient=True) as scene:
        assert [len(camera.images) for camera in scene.cameras] == [0]
