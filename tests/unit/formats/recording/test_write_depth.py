"""Depth images become lossless videos of 16-bit steps, of the source's length or the smallest that holds them."""

import io
import json

import av
import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.errors import ArrayError, OptionError
from sceneloom.formats.recording.write_images import to_steps
from sceneloom.formats.recording.writer import write_recording
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, LazyFrames, Scene, VideoContent

MS = 1_000_000
CAMERA_MODEL = Camera("pinhole", 32, 16, 30.0, 31.0, 16.0, 8.0)
HERE = RigidTransform.identity()


def depth_camera(images, scales, **fields):
    timestamps = np.arange(len(images), dtype=np.int64) * 100 * MS
    frames = [
        DepthFrame(int(t), CAMERA_MODEL, lambda image=image: image, scale)
        for t, image, scale in zip(timestamps, images, scales, strict=True)
    ]
    return DepthCameraSensor("depth", CAMERA_MODEL, LazyFrames.of(frames, timestamps), mount=HERE, **fields)


def constant(metres):
    return np.full((16, 32), metres, np.float32)


def steps_of(path):
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "ffv1"
        return [frame.to_ndarray(format="gray16le") for frame in container.decode(video=0)]


def entries_of(folder):
    lines = [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]
    return [line["frames"] for line in lines]


def lost(report):
    return {loss.what: loss.count for loss in report if loss.field.endswith(".depth")}


@pytest.mark.parametrize(
    ("largest", "scale"),
    [(65.535, 0.001), (65.6, 0.002), (131.0, 0.002), (131.2, 0.005), (300.0, 0.005), (400.0, 0.01)],
)
def test_the_smallest_step_that_holds_the_largest_depth_is_taken(tmp_path, largest, scale):
    report = write_recording(Scene((depth_camera([constant(0.5), constant(largest)], [None, None]),)), tmp_path / "d")
    entries = entries_of(tmp_path / "d")
    assert [entry["depthScale"] for (entry,) in entries] == [scale, scale]
    assert [entry["colorFormat"] for (entry,) in entries] == ["gray16", "gray16"]
    first, second = steps_of(tmp_path / "d" / "data.mkv")
    assert (first == round(0.5 / scale)).all()
    assert abs(second[0, 0] * scale - largest) <= scale / 2
    assert not [what for what in lost(report) if what.startswith("left out")]


def test_the_steps_of_the_source_lose_nothing(tmp_path):
    steps = np.random.default_rng(1).integers(0, 65536, (3, 16, 32)).astype(np.uint16)
    scales = [0.001, 0.00025, 1 / 3]
    images = [(image * scale).astype(np.float32) for image, scale in zip(steps, scales, strict=True)]
    report = write_recording(Scene((depth_camera(images, scales),)), tmp_path / "d")
    assert lost(report) == {}
    assert [entry["depthScale"] for (entry,) in entries_of(tmp_path / "d")] == scales
    np.testing.assert_array_equal(steps_of(tmp_path / "d" / "data.mkv"), steps)


def test_what_steps_cannot_hold_is_counted():
    depth = np.array([[0.0, 0.001, 0.0014, 0.0002, 65.535, 65.6, -1.0, np.nan, np.inf, 0.0020001]], np.float32)
    found = to_steps(depth, 0.001)
    # what is nearer than the first step is something, not nothing
    assert found.steps.tolist() == [[0, 1, 1, 1, 65535, 0, 0, 0, 0, 2]]
    assert (found.rounded, found.beyond) == (2, 4)


def test_depth_comes_after_the_images_and_a_line_without_it_repeats_the_last(tmp_path):
    timestamps = np.arange(4, dtype=np.int64) * 100 * MS
    shots = [CameraImage.of(int(t), CAMERA_MODEL, np.zeros((16, 32, 3), np.uint8)) for t in timestamps]
    colour = CameraSensor("colour", CAMERA_MODEL, LazyFrames.of(shots, timestamps), mount=HERE)
    depth = depth_camera([constant(1.0), constant(2.0)], [0.001, 0.001])
    report = write_recording(Scene((depth, colour)), tmp_path / "d")
    scales = [[entry.get("depthScale") for entry in line] for line in entries_of(tmp_path / "d")]
    assert scales == [[None, 0.001]] * 2 + [[None, None]] * 2
    assert [line[1].get("missingBitmap") for line in entries_of(tmp_path / "d")] == [None, None, True, True]
    assert [image[0, 0] for image in steps_of(tmp_path / "d" / "data2.mkv")] == [1000, 2000, 2000, 2000]
    assert "sensors[depth].frames" in [loss.field for loss in report]


def test_a_depth_video_whose_steps_are_known_is_copied(tmp_path):
    write_recording(Scene((depth_camera([constant(1.0), constant(2.0)], [0.001] * 2),)), tmp_path / "first")
    content = (tmp_path / "first" / "data.mkv").read_bytes()
    video = VideoContent(lambda: io.BytesIO(content), "ffv1")

    def undecoded():
        raise AssertionError("decoded")

    timestamps = np.arange(2, dtype=np.int64) * 100 * MS
    frames = [DepthFrame(int(t), CAMERA_MODEL, undecoded, 0.001) for t in timestamps]
    copied = DepthCameraSensor("camera0", CAMERA_MODEL, LazyFrames.of(frames, timestamps), mount=HERE, video=video)
    report = write_recording(Scene((copied,)), tmp_path / "second")
    assert (tmp_path / "second" / "data.mkv").read_bytes() == content
    assert lost(report) == {}


@pytest.mark.parametrize("scale", [0.0, -0.001, float("nan"), float("inf"), None])
def test_a_step_that_is_no_length_and_an_image_of_another_size_are_refused(tmp_path, scale):
    small = scale is None
    camera = depth_camera([np.zeros((3, 4), np.float32) if small else constant(1.0)], [0.001 if small else scale])
    with pytest.raises(ArrayError if small else OptionError, match="depth" if small else "scale .* expected a length"):
        write_recording(Scene((camera,)), tmp_path / "d")
    assert list(tmp_path.iterdir()) == []
