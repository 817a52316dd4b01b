"""Videos are cut without decoding where the images that stay need none of the others."""

import av
import numpy as np
import pytest

from sceneloom.formats.video.remux import copy_to_matroska

COUNT = 20


def make_video(path, codec, pixels, options):
    """Encode noise that changes little from image to image, so that images lean on each other."""
    random = np.random.default_rng(1)
    image = random.integers(0, 200, (32, 48, 3), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options={"threads": "1", **options})
        stream.width, stream.height, stream.pix_fmt = 48, 32, pixels
        for _ in range(COUNT):
            image = np.roll(image, 2, axis=1)
            frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format=pixels)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def decoded(path):
    """All images, as PyAV gives them."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.fixture(scope="module")
def leaning(tmp_path_factory):
    """Groups of five images, with images between that look both ways."""
    options = {"g": "5", "keyint_min": "5", "sc_threshold": "0", "bf": "2", "x264-params": "open-gop=0"}
    return make_video(tmp_path_factory.mktemp("cut") / "leaning.mkv", "libx264", "yuv420p", options)


@pytest.fixture(scope="module")
def independent(tmp_path_factory):
    """Every image by itself."""
    return make_video(tmp_path_factory.mktemp("cut") / "independent.mkv", "ffv1", "bgr0", {"g": "1"})


@pytest.mark.parametrize("taken", [range(20), range(10), range(5, 20), range(10, 15), [*range(5), *range(10, 20)]])
def test_whole_groups_are_copied_as_they_are(leaning, tmp_path, taken):
    target = tmp_path / "cut.mkv"
    result = copy_to_matroska(leaning, target, frame_indices=list(taken))
    assert result is not None
    assert result.images == len(taken)
    before, after = decoded(leaning), decoded(target)
    assert len(after) == len(taken)
    assert all(np.array_equal(after[k], before[index]) for k, index in enumerate(taken))


@pytest.mark.parametrize("taken", [range(1, 20), [0, 2, *range(3, 20)], [*range(5), *range(6, 20)], [], [3, 3], [20]])
def test_images_that_need_others_are_not_copied(leaning, tmp_path, taken):
    target = tmp_path / "cut.mkv"
    assert copy_to_matroska(leaning, target, frame_indices=list(taken)) is None
    assert not target.exists()


@pytest.mark.parametrize("taken", [[0, 3, 4, 9], [7], [1, 19]])
def test_any_of_independent_images_are_copied(independent, tmp_path, taken):
    target = tmp_path / "cut.mkv"
    assert copy_to_matroska(independent, target, frame_indices=taken) is not None
    before, after = decoded(independent), decoded(target)
    assert len(after) == len(taken)
    assert all(np.array_equal(image, before[index]) for image, index in zip(after, taken, strict=True))


def test_a_copy_keeps_the_rate_of_its_source(leaning, tmp_path):
    copy_to_matroska(leaning, tmp_path / "copy.mkv")
    with av.open(str(tmp_path / "copy.mkv")) as container:
        assert container.streams.video[0].average_rate == 10
