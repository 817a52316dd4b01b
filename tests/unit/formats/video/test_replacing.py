"""Videos with some pictures changed: the others copied bit by bit, all times kept, readable by other programs."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from sceneloom.formats.video import VideoReader, VideoWriter
from sceneloom.formats.video.h264 import ParameterSets
from sceneloom.formats.video.h264_sequence import colour_place
from sceneloom.formats.video.replacing import replace_pictures

COUNT, GROUP = 70, 30
BLOCKS = np.kron(np.random.default_rng(0).integers(0, 256, (6, 10, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def darkened(number, image, *, halved, black):
    changed, half = image.copy(), 2 if halved else 1
    changed[16 // half : 32 // half, 16 // half : 48 // half] = black
    return changed


def write(path, *, codec="h264"):
    with VideoWriter(path, 80, 48, 10, codec=codec) as writer:
        for k in range(COUNT):
            writer.add(np.roll(BLOCKS, k, axis=1), k * 0.1 + (0.013 if k % 3 else 0.0))
    return path


@pytest.fixture(scope="module", params=[".mkv", ".mp4"])
def pair(request, tmp_path_factory):
    """A video with groups of 30, 30 and 10 pictures, and the same with one picture of the second changed."""
    folder = tmp_path_factory.mktemp("videos")
    source = write(folder / f"source{request.param}")
    touched = np.zeros(COUNT, bool)
    touched[35] = True
    target = folder / f"target{request.param}"
    done = replace_pictures(source, target, darkened, touched)
    with VideoReader(source) as before, VideoReader(target) as after:
        yield source, target, done, before, after


def test_only_the_group_of_a_touched_picture_is_encoded_anew(pair):
    _, _, done, before, after = pair
    assert (done.pictures, done.encoded, done.reason) == (COUNT, GROUP, None)
    for k in (0, 29, 60, 69):
        assert np.array_equal(before.rgb(k), after.rgb(k)), k
    for k in (30, 34, 36, 59):
        assert np.abs(before.rgb(k).astype(int) - after.rgb(k)).mean() < 3, k  # encoded again at quality 18


def test_nothing_is_left_in_the_place_that_was_changed(pair):
    assert pair[4].rgb(35)[18:30, 18:46].max() < 20  # black, but for what the edges of blocks bring in
    assert pair[3].rgb(35)[18:30, 18:46].max() > 200


def test_pictures_keep_their_times_and_any_of_them_can_be_read_first(pair):
    _, target, _, before, after = pair
    np.testing.assert_allclose(after.timestamps, before.timestamps - before.timestamps[0], atol=1e-9)
    for k in (69, 35, 59, 0, 60):
        with VideoReader(target) as alone:
            assert np.array_equal(alone.rgb(k), after.rgb(k)), k


def test_another_program_reads_all_pictures(pair):
    _, target, _, _, after = pair
    capture, count = cv2.VideoCapture(str(target)), 0
    while True:
        there, picture = capture.read()
        if not there:
            break
        # halved colours can be stretched in several ways, which changes brightness little
        ours = cv2.cvtColor(after.rgb(count), cv2.COLOR_RGB2GRAY).astype(int)
        assert np.abs(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) - ours).mean() < 8, count
        count += 1
    assert count == COUNT


def test_messages_that_an_encoder_put_into_copied_pictures_go(pair):
    source, target, done, *_ = pair
    assert b"x264 - core" in source.read_bytes()
    assert b"x264 - core" not in target.read_bytes()
    assert done.messages == 1


def test_the_description_of_the_decoder_holds_both_kinds_of_pictures(pair):
    with av.open(str(pair[1])) as container:
        sets = ParameterSets.of_record(bytes(container.streams.video[0].codec_context.extradata))
    assert (len(sets.sequence), len(sets.picture), sets.length_size) == (2, 2, 4)


def test_a_video_of_which_nothing_is_touched_is_copied_packet_by_packet(tmp_path):
    source = write(tmp_path / "source.mp4")
    done = replace_pictures(source, tmp_path / "t.mp4", darkened, np.zeros(COUNT, bool))
    assert (done.encoded, done.codec) == (0, "h264")
    with VideoReader(source) as before, VideoReader(tmp_path / "t.mp4") as after:
        assert all(np.array_equal(before.rgb(k), after.rgb(k)) for k in (0, 31, 69))


def test_groups_that_lean_on_one_another_are_encoded_anew_as_a_whole(tmp_path):
    path = tmp_path / "open.mkv"
    with av.open(str(path), "w") as container:
        options = {"x264-params": "open-gop=1:keyint=10:bframes=3:scenecut=0", "threads": "1"}
        stream = container.add_stream("libx264", rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 80, 48, "yuv420p"
        for k in range(40):
            frame = av.VideoFrame.from_ndarray(np.roll(BLOCKS, k, axis=1), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    touched = np.zeros(40, bool)
    touched[25] = True
    done = replace_pictures(path, tmp_path / "t.mkv", darkened, touched)
    assert (done.encoded, done.reason) == (40, "its groups of pictures lean on one another")
    with VideoReader(tmp_path / "t.mkv") as after:
        assert after.count == 40
        assert after.rgb(25)[18:30, 18:46].max() < 20


def test_lossless_videos_stay_lossless(tmp_path):
    source = write(tmp_path / "source.mkv", codec="ffv1")
    touched = np.zeros(COUNT, bool)
    touched[3] = True
    done = replace_pictures(source, tmp_path / "t.mkv", darkened, touched, taken=np.arange(2, 6))
    assert (done.pictures, done.codec) == (4, "ffv1")
    with VideoReader(source) as before, VideoReader(tmp_path / "t.mkv") as after:
        expected = [
            darkened(k, before.rgb(k), halved=False, black=0) if k == 3 else before.rgb(k)
            for k in range(2, 6)
        ]
        assert all(np.array_equal(after.rgb(k), expected[k]) for k in range(4))


@pytest.mark.parametrize("place", [0, 1, 2, 5])
@pytest.mark.parametrize("further", ["", ":cqm=jvt", ":sar=3/2:colormatrix=bt709"])
def test_the_place_of_colours_is_read_out_of_what_the_encoder_wrote(place, further):
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt = 80, 48, "yuv420p"
    encoder.time_base, encoder.flags = Fraction(1, 10), 1 << 22
    encoder.options = {"x264-params": f"chromaloc={place}{further}"}
    encoder.open()
    unit = bytes(encoder.extradata).split(b"\x00\x00\x01")[1].rstrip(b"\x00")
    assert colour_place(unit) == place
