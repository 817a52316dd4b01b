"""Videos change their container without losing an image, and without being encoded anew where that can be."""

import io
from itertools import pairwise

import av
import cv2
import numpy as np
import pytest

from sceneloom.errors import ArrayError, DataError, OptionError, OutputError
from sceneloom.formats.video.writer import VideoWriter, copy_to_matroska, encode_to_mp4, remux_to_mp4

X265 = {"x265-params": "log-level=none:keyint=12:pools=1", "preset": "ultrafast"}
X264 = {"g": "12", "bf": "3", "preset": "veryfast"}
COPIED = {
    "h264 from mkv": {},
    "h264 from mp4": {"container": "mp4"},
    "h264 from ts": {"container": "mpegts"},
    "h264 that starts late": {"ticks": range(300, 340)},
    "h264 with uneven times": {"ticks": np.cumsum([0, *([1, 2, 5] * 13)]).tolist()},
    "hevc from mkv": {"codec": "libx265", "options": X265},
    "h264 without B-frames from avi": {"container": "avi", "options": X264 | {"bf": "0"}},
}
ENCODED = {
    "ffv1": ({"codec": "ffv1", "pixel_format": "bgr0", "options": {}}, "ffv1 is not copied into mp4"),
    "vp9": ({"codec": "libvpx-vp9", "options": {"deadline": "realtime", "cpu-used": "8"}}, "vp9 is not copied"),
    "h264 with B-frames from avi": ({"container": "avi"}, "does not state when its images are shown"),
}


def times_of_packets(content):
    """(pts, dts) of every packet in the order of storage [s], as FFmpeg demultiplexes them."""
    with av.open(io.BytesIO(content)) as container:
        packets = [p for p in container.demux(video=0) if p.size]
        return [(float(p.pts * p.time_base), float(p.dts * p.time_base)) for p in packets]


def read_with_opencv(content, tmp_path):
    path = tmp_path / "checked.mp4"
    path.write_bytes(content)
    capture, images = cv2.VideoCapture(str(path)), []
    while (found := capture.read())[0]:
        images.append(found[1])
    return int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), images


@pytest.mark.parametrize("kind", COPIED)
def test_a_copy_holds_the_same_images_bit_by_bit_in_the_same_order(videos, tmp_path, kind):
    content, target = videos.make(videos.Recipe(**COPIED[kind])), io.BytesIO()
    result = remux_to_mp4(lambda: io.BytesIO(content), target)
    assert (result.images, result.copied, result.reason) == (40, True, None)
    for found, expected in zip(videos.decode(target.getvalue()), videos.decode(content), strict=True):
        np.testing.assert_array_equal(found, expected)
    counted, images = read_with_opencv(target.getvalue(), tmp_path)
    assert counted == 40
    assert [videos.number(bgr) for bgr in images] == list(range(40))


@pytest.mark.parametrize("kind", COPIED)
def test_a_copy_is_decodable_in_time_and_starts_at_zero(videos, kind):
    content, target = videos.make(videos.Recipe(**COPIED[kind])), io.BytesIO()
    remux_to_mp4(content, target)
    times = times_of_packets(target.getvalue())
    assert all(dts <= pts for pts, dts in times)
    assert all(later > earlier for (_, earlier), (_, later) in pairwise(times))
    assert min(pts for pts, _ in times) == 0.0
    ticks = COPIED[kind].get("ticks", range(40))
    # Matroska rounds to its milliseconds
    assert sorted(pts for pts, _ in times) == pytest.approx((np.array(ticks) - ticks[0]) / 30, abs=1.01e-3)


@pytest.mark.slow
def test_real_recordings_with_b_frames_and_missing_decoding_times_are_copied(data_dir, videos, tmp_path):
    paths = sorted((data_dir / "recordings").glob("*/data*.mkv"))
    assert len(paths) >= 4
    for path in paths:
        target = io.BytesIO()
        assert remux_to_mp4(lambda path=path: path.open("rb"), target).copied
        expected = videos.decode(path.read_bytes())
        for found, planes in zip(videos.decode(target.getvalue()), expected, strict=True):
            np.testing.assert_array_equal(found, planes)
        counted, images = read_with_opencv(target.getvalue(), tmp_path)
        assert counted == len(images) == len(expected)


def test_given_times_replace_those_of_the_source(videos, mkv_bytes):
    timestamps = 1.7e9 + np.cumsum(np.linspace(0.01, 0.2, 40))
    target = io.BytesIO()
    remux_to_mp4(mkv_bytes, target, timestamps_seconds=timestamps)
    found = sorted(pts for pts, _ in times_of_packets(target.getvalue()))
    assert found == pytest.approx(timestamps - timestamps[0], abs=1e-6)
    assert [videos.number(frame) for frame in rgb_images(target.getvalue())] == list(range(40))


def rgb_images(content):
    with av.open(io.BytesIO(content)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


@pytest.mark.parametrize("kind", ENCODED)
def test_what_cannot_be_copied_is_encoded_as_h264_and_says_why(videos, tmp_path, kind):
    recipe, reason = ENCODED[kind]
    content, target = videos.make(videos.Recipe(**recipe)), io.BytesIO()
    result = remux_to_mp4(content, target)
    assert (result.images, result.codec, result.copied) == (40, "h264", False)
    assert reason in str(result.reason)
    counted, images = read_with_opencv(target.getvalue(), tmp_path)
    assert counted == 40
    assert [videos.number(bgr) for bgr in images] == list(range(40))
    assert [pts for pts, _ in sorted(times_of_packets(target.getvalue()))] == pytest.approx(
        np.arange(40) / 30, abs=1e-3
    )


def test_some_of_the_images_are_encoded_at_their_times(videos, mkv_bytes):
    target = io.BytesIO()
    result = remux_to_mp4(mkv_bytes, target, frame_indices=[3, 4, 9, 30])
    assert (result.images, result.copied) == (4, False)
    assert [videos.number(rgb) for rgb in rgb_images(target.getvalue())] == [3, 4, 9, 30]
    times = [pts for pts, _ in sorted(times_of_packets(target.getvalue()))]
    assert times == pytest.approx((np.array([3, 4, 9, 30]) - 3) / 30, abs=1e-3)


def test_hevc_bears_the_name_that_every_player_knows(videos):
    content, target = videos.make(videos.Recipe(**COPIED["hevc from mkv"])), io.BytesIO()
    remux_to_mp4(content, target)
    assert b"hvc1" in target.getvalue()


@pytest.mark.parametrize("count", [39, 41])
def test_not_one_time_for_each_image_is_refused(mkv_bytes, count):
    with pytest.raises(ArrayError, match=f"{count} times for 40 images"):
        remux_to_mp4(mkv_bytes, io.BytesIO(), timestamps_seconds=np.arange(count) / 10)


def test_times_that_do_not_increase_are_refused(mkv_bytes):
    timestamps = np.arange(40) / 10
    timestamps[7] = timestamps[6]
    with pytest.raises(ArrayError, match=r"timestamps_seconds\[7\]: 0.6.*; expected more than 0.6"):
        remux_to_mp4(mkv_bytes, io.BytesIO(), timestamps_seconds=timestamps)


def test_odd_images_are_refused(videos):
    content = videos.make(videos.Recipe(codec="ffv1", pixel_format="bgr0", options={}, count=4, size=(97, 65)))
    with pytest.raises(OptionError, match="97x65, it needs even sizes; cut them to 96x64"):
        remux_to_mp4(content, io.BytesIO())


def test_images_are_encoded_one_at_a_time(videos):
    asked: list[int] = []

    class Target(io.BytesIO):
        first_write_after = None

        def write(self, data):
            self.first_write_after = self.first_write_after or len(asked)
            return super().write(data)

    def images():
        for number in range(100):
            asked.append(number)
            yield videos.image(number)

    target = Target()
    assert encode_to_mp4(images(), target, fps=10.0).images == 100
    assert target.first_write_after < 70
    assert [videos.number(rgb) for rgb in rgb_images(target.getvalue())] == list(range(100))


def test_encoding_nothing_or_with_a_wrong_number_of_times_is_refused(videos):
    with pytest.raises(OutputError, match="needs at least one image"):
        encode_to_mp4([], io.BytesIO())
    for count in (2, 4):
        with pytest.raises(ArrayError, match=f"{count} times for 3 images"):
            encode_to_mp4((videos.image(k) for k in range(3)), io.BytesIO(), timestamps_seconds=np.arange(count) / 10)


class CountingFile(io.BytesIO):
    """Notes how much of it was read before a first packet was written."""

    def __init__(self, content, log):
        super().__init__(content)
        self._log = log

    def read(self, size=-1):
        self._log.append(("read", size))
        return super().read(size)


def test_copying_holds_no_more_of_the_video_than_a_piece(videos):
    content = videos.make(videos.Recipe(codec="libx264", options={"g": "12", "qp": "2"}, size=(640, 480)))
    log: list[tuple[str, int]] = []

    class Target(io.BytesIO):
        def write(self, data):
            log.append(("write", len(data)))
            return super().write(data)

    remux_to_mp4(lambda: CountingFile(content, log), Target())
    assert max(size for kind, size in log if kind == "read") <= 1 << 20
    last_read = max(k for k, (kind, _) in enumerate(log) if kind == "read")
    written_before = sum(size for kind, size in log[:last_read] if kind == "write")
    assert written_before > len(content) // 2


@pytest.mark.parametrize("content", [b"no video at all" * 50, b""])
def test_a_source_that_is_no_video_is_refused(content):
    with pytest.raises(DataError, match=r"front: cannot be read as video"):
        remux_to_mp4(content, io.BytesIO(), name="front")


def test_a_full_disk_is_an_output_error(mkv_bytes):
    class FullDisk(io.BytesIO):
        def write(self, data):
            raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match="No space left"):
        remux_to_mp4(mkv_bytes, FullDisk())


FFV1 = {"codec": "ffv1", "pixel_format": "bgr0", "options": {}}
TO_MATROSKA = [COPIED["h264 from mp4"], COPIED["h264 from ts"], COPIED["hevc from mkv"], FFV1]


@pytest.mark.parametrize("recipe", TO_MATROSKA, ids=["mp4", "ts", "hevc", "ffv1"])
def test_matroska_takes_the_packets_of_any_codec(videos, tmp_path, recipe):
    content = videos.make(videos.Recipe(**recipe))
    result = copy_to_matroska(content, tmp_path / "data.mkv", images=40)
    assert result is not None
    assert (result.images, result.copied) == (40, True)
    for found, expected in zip(
        videos.decode((tmp_path / "data.mkv").read_bytes()), videos.decode(content), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_nothing_is_written_where_packets_cannot_be_copied(videos, mkv_bytes, tmp_path):
    untimed = videos.make(videos.Recipe(container="avi"))
    assert copy_to_matroska(untimed, tmp_path / "data.mkv") is None
    assert copy_to_matroska(mkv_bytes, tmp_path / "data.mkv", images=39) is None
    assert not (tmp_path / "data.mkv").exists()


def boxes_of(content):
    """The names of the outermost boxes of an mp4 file, in their order."""
    location, names = 0, []
    while location < len(content):
        names.append(content[location + 4 : location + 8])
        location += int.from_bytes(content[location : location + 4], "big")
    return names


def encoded_anew(videos, kind):
    """An mp4 file of forty images, and the same once more."""
    targets = io.BytesIO(), io.BytesIO()
    rng = np.random.default_rng(3)
    images = rng.integers(0, 255, (40, 48, 64, 3), np.uint8)
    uneven = np.cumsum(rng.uniform(0.02, 0.3, 40))
    content = videos.make(videos.Recipe(**(ENCODED["ffv1"][0] if kind == "remuxed" else {})))
    for target in targets:
        if kind in {"copied", "remuxed"}:
            remux_to_mp4(content, target, timestamps_seconds=uneven)
        elif kind == "at times":
            encode_to_mp4(images, target, timestamps_seconds=uneven)
        else:
            encode_to_mp4(iter(images), target, fps=10.0, count=40)
    return [target.getvalue() for target in targets]


@pytest.mark.parametrize("kind", ["copied", "remuxed", "at times", "counted"])
def test_the_tables_stand_before_the_images_and_the_bytes_are_always_the_same(videos, kind):
    first, second = encoded_anew(videos, kind)
    names = boxes_of(first)
    assert names.index(b"moov") < names.index(b"mdat")
    assert first == second
    assert len(videos.decode(first)) == 40


def test_images_of_which_no_one_says_how_many_are_still_encoded(videos):
    target = io.BytesIO()
    encode_to_mp4((np.full((48, 64, 3), k, np.uint8) for k in range(5)), target, fps=10.0)
    assert boxes_of(target.getvalue())[-1] == b"moov"
    assert len(videos.decode(target.getvalue())) == 5


def test_one_image_more_than_was_stated_is_refused():
    images = np.zeros((3, 48, 64, 3), np.uint8)
    with pytest.raises(ArrayError, match="image 2: expected no more than 2"):
        encode_to_mp4(images, io.BytesIO(), fps=10.0, count=2)


def test_tables_of_very_many_uneven_key_frames_find_room():
    timestamps = np.cumsum(np.random.default_rng(1).uniform(1e-3, 1.0, 3000))
    target = io.BytesIO()
    with VideoWriter(target, 16, 16, 10.0, container="mp4", images=3000) as writer:
        for seconds in timestamps:
            writer.add(np.full((16, 16, 3), int(seconds * 255) % 255, np.uint8), seconds)
    names = boxes_of(target.getvalue())
    assert names.index(b"moov") < names.index(b"mdat")
