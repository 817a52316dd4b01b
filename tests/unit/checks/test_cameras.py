"""Rules about camera models, images and videos."""

from io import BytesIO

import numpy as np
import pytest

from sceneloom.cameras.camera import Camera
from sceneloom.formats.video.writer import VideoWriter
from sceneloom.scene import DataWarning, VideoContent, WarningKind

RULES = (
    "video-or-images",
    "camera-model-known",
    "distortion-length",
    "principal-point",
    "focal-length",
    "video-count",
)


def with_camera_model(sound, **fields):
    return sound.camera(camera_model=Camera(**{**sound_camera_model(), **fields}))


def sound_camera_model():
    return {"model": "pinhole", "width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}


def test_a_sound_scene_keeps_all_of_them(sound, found):
    scene = sound.scene(sound.camera(), with_fisheye(sound))
    assert [found(scene, rule) for rule in RULES] == [[]] * len(RULES)


def with_fisheye(sound):
    camera_model = Camera("fisheye", 32, 24, 9.0, 9.0, 15.5, 11.5, (0.1, 0.0, 0.0, 0.0))
    return sound.camera(id="fish", camera_model=camera_model)


def test_an_unknown_camera_model_is_found(sound, found):
    scene = sound.scene(with_camera_model(sound, model="spherical"))
    [(path, message)] = found(scene, "camera-model-known")
    assert path == "sensors[0].intrinsics.distortion.model"
    assert "'spherical'" in message


@pytest.mark.parametrize(
    ("fields", "locations"),
    [
        ({"cx": 40.0}, ["cx"]),
        ({"cx": -3.0, "cy": 24.0}, ["cx", "cy"]),
        ({"cx": -0.5, "cy": 23.5}, []),
    ],
)
def test_a_centre_outside_the_image_is_found(sound, found, fields, locations):
    hits = found(sound.scene(with_camera_model(sound, **fields)), "principal-point")
    assert [path for path, _ in hits] == [f"sensors[0].intrinsics.{name}" for name in locations]


@pytest.mark.parametrize(
    ("fields", "wrong"),
    [
        ({"fx": 30.0, "fy": 50.0}, True),
        ({"fx": 1.0, "fy": 1.0}, True),
        ({"fx": 5000.0, "fy": 5000.0}, True),
        ({"fx": 30.0, "fy": 31.0}, False),
    ],
)
def test_focal_lengths_of_no_camera_model_are_found(sound, found, fields, wrong):
    assert bool(found(sound.scene(with_camera_model(sound, **fields)), "focal-length")) is wrong


@pytest.mark.parametrize(
    ("rule", "code"), [("video-or-images", "video-and-images"), ("distortion-length", "short-distortion")]
)
def test_what_the_reader_remarked_is_known_by_its_own_rule(sound, found, rule, code):
    warning = DataWarning(kind=WarningKind.ASSUMED, code=code, location="sensors[1]", message="so it was")
    scene = sound.scene(warnings=(warning,))
    assert found(scene, rule) == [("sensors[1]", "so it was")]
    assert found(scene, "reading-assumed") == []


@pytest.fixture
def filmed(sound, tmp_path):
    """Make a camera with a video of six images, and some number of timestamps."""
    path = tmp_path / "video.mp4"
    times = sound.times()
    with VideoWriter(path, 64, 48, fps=10) as writer:
        for timestamp_ns in times.tolist():
            writer.add(np.zeros((48, 64, 3), np.uint8), timestamp_ns / 1e9)
    content = path.read_bytes()

    def camera(count=6, **fields):
        camera_model = Camera("pinhole", 64, 48, 60.0, 60.0, 31.5, 23.5)
        video = VideoContent(lambda: BytesIO(content), "h264", **fields)
        return sound.camera(sound.times(count), camera_model=camera_model, video=video)

    return camera


@pytest.mark.parametrize("chosen", [None, (0, 1, 2, 3, 4, 5)])
def test_a_video_with_an_image_for_each_timestamp_is_sound(sound, filmed, found, chosen):
    assert found(sound.scene(filmed(frame_indices=chosen)), "video-count") == []


def test_a_video_with_more_or_fewer_images_than_timestamps_is_found(sound, filmed, found):
    problem = "4 timestamps; the video has 6 images"
    assert found(sound.scene(filmed(4)), "video-count") == [("sensors[0].video.timestamps", problem)]
    assert len(found(sound.scene(filmed(8)), "video-count")) == 1
    assert len(found(sound.scene(filmed(6, frame_indices=(0, 6))), "video-count")) == 1


def test_a_video_that_is_none_is_found(sound, found):
    video = VideoContent(lambda: BytesIO(b"no video at all"), "h264")
    [(path, _)] = found(sound.scene(sound.camera(video=video)), "video-count")
    assert path == "sensors[0].video.content"
