"""Cameras whose images contradict their mountings are found by where near things are."""

import json

import av
import numpy as np
import pytest

from sceneloom.checks import validate

WIDTH, HEIGHT, FRAMES = 384, 192, 5
RULE = "stereo-images"


def camera(y):
    """A camera that looks along x of a vehicle whose z points up, `y` to the left."""
    return {
        "model": "pinhole",
        "focalLengthX": 300.0,
        "focalLengthY": 300.0,
        "principalPointX": 191.5,
        "principalPointY": 95.5,
        "imageWidth": WIDTH,
        "imageHeight": HEIGHT,
        "imuToCamera": [
            [0.0, -1.0, 0.0, y],
            [0.0, 0.0, -1.0, 0.0],
            [1.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 1.0],
        ],
    }


SOUND = (camera(0.0), camera(-0.5))


def textures():
    """Images of a wall with blots of 6 pixels, another part of it each time."""
    random = np.random.default_rng(3)
    blots = random.integers(20, 235, (FRAMES, HEIGHT // 6, WIDTH // 6), np.uint8)
    return np.repeat(np.repeat(blots, 6, axis=1), 6, axis=2)


def write_video(path, images):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10, options={"threads": "1"})
        (stream.height, stream.width), stream.pix_fmt = images[0].shape, "bgr0"
        for grey in images:
            pixels = np.repeat(grey[:, :, None], 3, axis=2)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            container.mux(stream.encode(frame.reformat(format="bgr0")))
        container.mux(stream.encode())


@pytest.fixture
def found(tmp_path):
    """What the rule says of a stereo pair, the second camera half a metre to the right of the first."""

    def run(first, second, *, cameras=SOUND):
        write_video(tmp_path / "data.mkv", first)
        write_video(tmp_path / "data2.mkv", second)
        lines = [
            {"frames": [{"cameraInd": 0}, {"cameraInd": 1}], "number": k, "time": 0.1 * k}
            for k in range(FRAMES)
        ]
        (tmp_path / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        (tmp_path / "calibration.json").write_text(json.dumps({"cameras": list(cameras)}))
        return [finding.message for finding in validate(tmp_path, rules=[RULE]).findings]

    return run


# a wall 10 m away: focal length 300 px times 0.5 m over 10 m
SHIFT = 15


def test_a_wall_that_the_right_camera_sees_farther_left_is_sound(found):
    images = textures()
    assert found(images, np.roll(images, -SHIFT, axis=2)) == []


def test_exchanged_videos_are_found(found):
    images = textures()
    messages = found(np.roll(images, -SHIFT, axis=2), images)
    assert len(messages) == 1
    assert "against the side on which their mountings put them" in messages[0]


def test_exchanged_entries_are_found(found):
    images = textures()
    shifted = np.roll(images, -SHIFT, axis=2)
    assert len(found(images, shifted, cameras=(camera(-0.5), camera(0.0)))) == 1


def test_small_images_are_looked_at_as_they_are(found):
    small = {"imageWidth": 96, "imageHeight": 96, "principalPointX": 47.5, "principalPointY": 47.5}
    camera_model = {**small, "focalLengthX": 80.0, "focalLengthY": 80.0}
    images = textures()[:, :96, :96]
    cameras = ({**camera(0.0), **camera_model}, {**camera(-0.5), **camera_model})
    # 80 px times 0.5 m over 10 m
    shifted = np.roll(images, -4, axis=2)
    assert found(images, shifted, cameras=cameras) == []
    assert len(found(shifted, images, cameras=cameras)) == 1


def test_cameras_in_one_location_report_no_side(found):
    images = textures()
    assert found(images, np.roll(images, -SHIFT, axis=2), cameras=(camera(0.0), camera(0.0))) == []


@pytest.mark.parametrize("shift", [0, -1])
def test_nothing_is_stated_where_all_is_far_away(found, shift):
    images = textures()
    assert found(images, np.roll(images, shift, axis=2)) == []


def test_nothing_is_stated_for_images_that_show_nothing_or_do_not_match(found):
    flat = np.full((FRAMES, HEIGHT, WIDTH), 90, np.uint8)
    assert found(flat, flat) == []


def test_nothing_is_stated_for_images_that_have_nothing_in_common(found):
    images = textures()
    assert found(images, images[::-1, ::-1]) == []
