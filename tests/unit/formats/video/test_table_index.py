"""The list of images by an mp4's tables is that of a walk through all its packets."""

import av
import numpy as np
import pytest

from sceneloom.errors import DataError
from sceneloom.formats.video.index import read_index, read_table_index


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


def encoded(path, codec, options, *, flags="", images=40, form="mp4"):
    rng = np.random.default_rng(5)
    movie = av.open(path, "w", format=form, options={"movflags": flags} if flags else {})
    stream = movie.add_stream(codec, rate=10, options=options)
    stream.width = stream.height = 128
    for _ in range(images):
        frame = av.VideoFrame.from_ndarray(rng.integers(0, 256, (128, 128, 3), np.uint8), format="rgb24")
        for packet in stream.encode(frame):
            movie.mux(packet)
    for packet in stream.encode():
        movie.mux(packet)
    movie.close()
    return path.read_bytes()


CASES = {
    "H.264 with images out of order": ("libx264", {"bf": "3", "g": "12"}, ""),
    "H.264 with the tables in front": ("libx264", {"g": "10"}, "faststart"),
    "H.264 in fragments": ("libx264", {"g": "10"}, "frag_keyframe+empty_moov"),
    "MPEG-4": ("mpeg4", {}, ""),
}


@pytest.mark.parametrize(("codec", "options", "flags"), CASES.values(), ids=CASES)
def test_tables_report_what_a_walk_through_all_packets_reports(tmp_path, codec, options, flags):
    content = encoded(tmp_path / "video.mp4", codec, options, flags=flags)
    expected = read_index(content, "video")
    found = read_table_index(content, "video")
    assert found.time_base == expected.time_base
    for name in ("pts", "positions", "entries"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert (found.timed, found.hidden) == (expected.timed, expected.hidden)


def test_a_quicktime_file_has_such_tables_too(tmp_path):
    content = encoded(tmp_path / "video.mov", "libx264", {"bf": "3", "g": "12"}, form="mov")
    assert content[4:12] == b"ftypqt  "
    found, expected = read_table_index(content, "video"), read_index(content, "video")
    for name in ("pts", "positions", "entries"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_images_are_not_read(tmp_path):
    counted = Counted(encoded(tmp_path / "video.mp4", "libx264", {"g": "10"}, images=60))
    assert len(read_table_index(counted, "video")) == 60
    assert counted.looked_at < len(counted) / 2


@pytest.mark.parametrize("length", [0, 4, 20, 5_000, 100_000])
def test_a_video_that_was_cut_is_an_error(tmp_path, length):
    content = encoded(tmp_path / "video.mp4", "libx264", {"g": "10"})[:length]
    with pytest.raises(DataError):
        read_table_index(content, "video")
