"""Videos are cut without decoding where the images that stay need none of the others."""

import av
import numpy as np
import pytest

from sceneloom.formats.video.writer import copy_to_matroska

LEANING = {"g": "5", "keyint_min": "5", "sc_threshold": "0", "bf": "2", "x264-params": "open-gop=0"}
"""Groups of five images, with images between that look both ways."""


@pytest.fixture(scope="module")
def leaning(videos):
    return videos.make(videos.Recipe(options=LEANING, count=20))


@pytest.fixture(scope="module")
def independent(videos):
    """Every image by itself."""
    return videos.make(videos.Recipe(codec="ffv1", options={"g": "1"}, pixel_format="bgr0", count=20))


def copied_as_they_are(videos, content, target, taken):
    result = copy_to_matroska(content, target, frame_indices=list(taken))
    assert result is not None
    assert result.images == len(taken)
    before, after = videos.decode(content), videos.decode(target.read_bytes())
    return len(after) == len(taken) and all(np.array_equal(after[k], before[index]) for k, index in enumerate(taken))


@pytest.mark.parametrize("taken", [range(20), range(10), range(5, 20), range(10, 15), [*range(5), *range(10, 20)]])
def test_whole_groups_are_copied_as_they_are(videos, leaning, tmp_path, taken):
    assert copied_as_they_are(videos, leaning, tmp_path / "cut.mkv", taken)


@pytest.mark.parametrize("taken", [range(1, 20), [0, 2, *range(3, 20)], [*range(5), *range(6, 20)], [], [3, 3], [20]])
def test_images_that_need_others_are_not_copied(leaning, tmp_path, taken):
    target = tmp_path / "cut.mkv"
    assert copy_to_matroska(leaning, target, frame_indices=list(taken)) is None
    assert not target.exists()


@pytest.mark.parametrize("taken", [[0, 3, 4, 9], [7], [1, 19]])
def test_any_of_independent_images_are_copied(videos, independent, tmp_path, taken):
    assert copied_as_they_are(videos, independent, tmp_path / "cut.mkv", taken)


def test_a_copy_keeps_the_rate_of_its_source(leaning, tmp_path):
    copy_to_matroska(leaning, tmp_path / "copy.mkv")
    with av.open(str(tmp_path / "copy.mkv")) as container:
        assert container.streams.video[0].average_rate == 30
