"""The list of images by an mp4's tables is that of a walk through all its packets."""

import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.video.reader import read_index, read_table_index


class Counted:
    """Bytes that remember how many of them were looked at."""

    def __init__(self, content):
        self.content, self.looked_at = content, 0

    def __len__(self):
        return len(self.content)

    def __getitem__(self, part):
        piece = self.content[part]
        self.looked_at += len(piece)
        return piece


CASES = {
    "H.264 with images out of order": {},
    "H.264 with the tables in front": {"options": {"g": "10"}, "flags": "faststart"},
    "H.264 in fragments": {"options": {"g": "10"}, "flags": "frag_keyframe+empty_moov"},
    "H.264 in a QuickTime file": {"container": "mov"},
    "MPEG-4": {"codec": "mpeg4", "options": {}},
}


def make(videos, **recipe):
    return videos.make(videos.Recipe(**({"container": "mp4", "size": (128, 128)} | recipe)))


@pytest.mark.parametrize("recipe", CASES.values(), ids=CASES)
def test_tables_report_what_a_walk_through_all_packets_reports(videos, recipe):
    content = make(videos, **recipe)
    assert (content[4:12] == b"ftypqt  ") == (recipe.get("container") == "mov")
    expected = read_index(content, "video")
    found = read_table_index(content, "video")
    assert found.time_base == expected.time_base
    for name in ("pts", "positions", "entries"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert (found.timed, found.hidden) == (expected.timed, expected.hidden)


def test_images_are_not_read(videos):
    counted = Counted(make(videos, options={"g": "12", "qp": "2"}, size=(640, 480), count=60))
    assert len(read_table_index(counted, "video")) == 60
    assert counted.looked_at < len(counted) / 2


@pytest.mark.parametrize("part", [0.0, 0.001, 0.01, 0.5, 0.95])
def test_a_video_that_was_cut_is_an_error(videos, part):
    content = make(videos, options={"g": "10", "qp": "5"})
    with pytest.raises(DataError):
        read_table_index(content[: int(part * len(content))], "video")
