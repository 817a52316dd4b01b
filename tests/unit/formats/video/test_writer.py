"""Videos are encoded in order with their colours and times, or change their container without being encoded anew."""

import io
from itertools import pairwise

import av
import cv2
import numpy as np
import pytest

from sceneloom.errors import ArrayError, DataError, OptionError, OutputError
from sceneloom.formats.video.writer import VideoWriter, copy_to_matroska, encode_to_mp4, remux_to_mp4


def write(target, images, times=None, *, fps=10.0, **options):
    height, width = images[0].shape[:2]
    with VideoWriter(target, width, height, fps, **options) as writer:
        for number, rgb in enumerate(images):
            writer.add(rgb, None if times is None else times[number])
    return writer


def presentation_times(content):
    with av.open(io.BytesIO(content)) as container:
        return [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]


@pytest.mark.parametrize("name", ["data.mkv", "data.mp4", "a: strange name.mkv"])
def test_opencv_reads_as_many_images_in_the_same_order_and_the_same_images_give_the_same_bytes(tmp_path, videos, name):
    images = [videos.image(number) for number in range(40)]
    assert write(tmp_path / name, images).count == 40
    assert [videos.number(rgb) for rgb in videos.opencv(tmp_path / name)] == list(range(40))
    file = io.BytesIO()
    write(file, images, container="mp4" if name.endswith("mp4") else "matroska")
    assert file.getvalue() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize("container", ["matroska", "mp4"])
def test_uneven_times_are_kept_from_the_first_image_on_and_those_of_one_tick_stay_apart_and_in_order(videos, container):
    steps = np.cumsum([0.0, 0.1, 0.1, 0.033, 0.5, 0.1, 0.067, 2.0])
    for start in (0.0, -3.2, 1.7e9):
        file = io.BytesIO()
        write(file, [videos.image(number) for number in range(8)], list(start + steps), container=container)
        # Matroska counts milliseconds; seconds since 1970 resolve a quarter of a microsecond
        tolerance = 5.1e-4 if container == "matroska" else 1e-6
        assert presentation_times(file.getvalue()) == pytest.approx(steps, abs=tolerance)
    file = io.BytesIO()
    times = [0.0, 0.0001, 0.0002, 0.0003, 0.1]
    write(file, [videos.image(number) for number in range(5)], times, container=container)
    found = presentation_times(file.getvalue())
    assert found == sorted(set(found))


def smooth_image(seed, width=320, height=240):
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 8), None, 20, 235, cv2.NORM_MINMAX)


def test_colours_come_back_unshifted(tmp_path):
    from sceneloom.formats.video.reader import open_video

    images = [smooth_image(seed) for seed in range(3)]
    write(tmp_path / "data.mkv", images)
    with open_video(tmp_path / "data.mkv") as reader:
        errors = np.stack([reader.rgb(k).astype(int) - rgb for k, rgb in enumerate(images)])
    assert np.abs(errors.mean(axis=(0, 1, 2))).max() < 0.2  # no tint
    assert np.median(np.abs(errors)) <= 4  # what the main job allows H.264 to lose


def test_opencv_which_ignores_what_a_stream_says_of_its_colours_gets_them_right(tmp_path, videos):
    colours = np.array([(200, 40, 40), (40, 200, 40), (40, 40, 200), (220, 200, 30)], np.uint8)
    image = np.repeat(np.repeat(colours[None], 64, axis=1), 64, axis=0)
    write(tmp_path / "data.mkv", [image] * 3)
    found = videos.opencv(tmp_path / "data.mkv")[1][32, 32::64].astype(int)
    # OpenCV truncates and the encoder rounds; BT.709 taken for BT.601 is up to 17 levels off in these colours
    assert np.abs(found - colours).max() <= 5
    with av.open(str(tmp_path / "data.mkv")) as container:
        frame = next(container.decode(video=0))
    assert (frame.colorspace, frame.color_range, frame.format.name) == (6, 1, "yuv420p")


def test_ffv1_loses_nothing_takes_odd_sizes_and_keeps_the_order_of_images_of_one_time(tmp_path, videos):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (33, 51, 3), dtype=np.uint8) for _ in range(4)]
    write(tmp_path / "data.mkv", images, [1.0, 1.0, 1.5, 2.0], codec="ffv1")
    np.testing.assert_array_equal(videos.opencv(tmp_path / "data.mkv"), images)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"codec": "divx"}, "no video codec 'divx'; there are h264, ffv1"),
        ({"container": "avi"}, "no video container 'avi'"),
        ({"fps": 0.0}, "0.0 images a second"),
        ({"fps": float("nan")}, "nan images a second"),
        ({"width": 0}, "image size 0x64"),
        ({"width": 33}, "needs even sizes; cut them to 32x64, or keep them as PNG"),
        ({"height": 51}, "needs even sizes; cut them to 96x50, or keep them as PNG"),
        ({"target": "data.gif"}, r"no video container '.gif'; there are .mkv, .mp4"),
    ],
)
def test_impossible_requests_are_refused(tmp_path, change, problem):
    arguments = {"target": "data.mkv", "width": 96, "height": 64, "fps": 10.0} | change
    target = tmp_path / arguments.pop("target")
    with pytest.raises(OptionError, match=problem):
        VideoWriter(target, **arguments)
    assert not target.exists()


def test_images_of_another_shape_type_or_earlier_time_and_those_of_a_closed_writer_are_refused(tmp_path, videos):
    with VideoWriter(tmp_path / "data.mkv", 96, 64, 10.0) as writer:
        writer.add(videos.image(0), 1.0)
        for wrong in (videos.image(1)[:62], videos.image(1).astype(float), videos.image(1)[:, :, :1]):
            with pytest.raises(ArrayError, match=r"image 1: .*expected \(64, 96, 3\) uint8"):
                writer.add(wrong)
        for second in (0.5, float("nan")):
            with pytest.raises(ArrayError, match=r"image 1: its time .* is before 1\.0 s"):
                writer.add(videos.image(1), second)
        writer.add(videos.image(1), 2.0)
    assert len(videos.opencv(tmp_path / "data.mkv")) == 2
    with pytest.raises(KeyError), VideoWriter(tmp_path / "data.mkv", 96, 64, 10.0) as writer:
        writer.add(videos.image(0))
        raise KeyError
    writer.close()
    with pytest.raises(OutputError, match="the video is closed"):
        writer.add(videos.image(1))


def test_what_cannot_be_written_is_an_output_error(tmp_path, videos, full_disk):
    with pytest.raises(OutputError, match="needs at least one image"), VideoWriter(tmp_path / "data.mkv", 96, 64, 10):
        pass
    noise = np.random.default_rng(0).integers(0, 256, (30, 64, 96, 3), dtype=np.uint8)
    for target, problem in (
        (tmp_path / "nowhere" / "data.mkv", r"nowhere/data\.mkv: cannot be written: No such file"),
        (full_disk, "No space left"),
    ):
        with pytest.raises(OutputError, match=problem):
            write(target, noise)


X265 = {"x265-params": "log-level=none:keyint=12:pools=1", "preset": "ultrafast"}
COPIED = {
    "h264 from mkv": {},
    "h264 from mp4": {"container": "mp4"},
    "h264 from ts": {"container": "mpegts"},
    "h264 that starts late": {"ticks": range(300, 340)},
    "h264 with uneven times": {"ticks": np.cumsum([0, *([1, 2, 5] * 13)]).tolist()},
    "hevc from mkv": {"codec": "libx265", "options": X265},
    "h264 without B-frames from avi": {"container": "avi", "options": {"g": "12", "bf": "0", "preset": "veryfast"}},
}
FFV1 = {"codec": "ffv1", "pixel_format": "bgr0", "options": {}}


def times_of_packets(content):
    """(pts, dts) of every packet in the order of storage [s], as FFmpeg demultiplexes them."""
    with av.open(io.BytesIO(content)) as container:
        packets = [p for p in container.demux(video=0) if p.size]
        return [(float(p.pts * p.time_base), float(p.dts * p.time_base)) for p in packets]


def numbers_of(videos, path):
    """The numbers of all images as OpenCV reads them, which are as many as the container states."""
    images = videos.opencv(path)
    assert cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT) == len(images)
    return [videos.number(rgb) for rgb in images]


@pytest.fixture
def target(tmp_path):
    return tmp_path / "made.mp4"


def remux(source, target, **options):
    with target.open("wb") as file:
        return remux_to_mp4(source, file, **options)


@pytest.mark.parametrize("kind", COPIED)
def test_a_copy_holds_the_same_images_bit_by_bit_in_the_same_order_and_is_decodable_in_time(videos, target, kind):
    content = videos.make(**COPIED[kind])
    result = remux(lambda: io.BytesIO(content), target)
    assert (result.images, result.copied, result.reason) == (40, True, None)
    np.testing.assert_array_equal(videos.decode(target.read_bytes()), videos.decode(content))
    assert numbers_of(videos, target) == list(range(40))
    times = times_of_packets(target.read_bytes())
    assert all(dts <= pts for pts, dts in times)
    assert all(later > earlier for (_, earlier), (_, later) in pairwise(times))
    assert min(pts for pts, _ in times) == 0.0
    ticks = COPIED[kind].get("ticks", range(40))
    # Matroska rounds to its milliseconds
    assert sorted(pts for pts, _ in times) == pytest.approx((np.array(ticks) - ticks[0]) / 30, abs=1.01e-3)
    # the name of HEVC that every player knows
    assert (b"hvc1" in target.read_bytes()) == ("hevc" in kind)
    # given times replace those of the source
    timestamps = 1.7e9 + np.cumsum(np.linspace(0.01, 0.2, 40))
    remux(content, target, timestamps_seconds=timestamps)
    found = sorted(pts for pts, _ in times_of_packets(target.read_bytes()))
    assert found == pytest.approx(timestamps - timestamps[0], abs=1e-6)
    assert numbers_of(videos, target) == list(range(40))


SOME = [3, 4, 9, 30]


@pytest.mark.parametrize(
    ("recipe", "chosen", "reason"),
    [
        (FFV1, None, "ffv1 is not copied into mp4"),
        ({"codec": "libvpx-vp9", "options": {"deadline": "realtime", "cpu-used": "8"}}, None, "vp9 is not copied"),
        ({"container": "avi"}, None, "does not state when its images are shown"),
        ({}, SOME, ""),
    ],
)
def test_what_cannot_be_copied_is_encoded_as_h264_and_says_why(videos, target, recipe, chosen, reason):
    result = remux(videos.make(**recipe), target, frame_indices=chosen)
    expected = chosen or list(range(40))
    assert (result.images, result.codec, result.copied) == (len(expected), "h264", False)
    assert reason in str(result.reason)
    assert numbers_of(videos, target) == expected
    times = [pts for pts, _ in sorted(times_of_packets(target.read_bytes()))]
    assert times == pytest.approx((np.array(expected) - expected[0]) / 30, abs=1e-3)


def test_impossible_sources_times_counts_and_targets_are_refused(videos, mkv_bytes, full_disk):
    for count in (39, 41):
        with pytest.raises(ArrayError, match=f"{count} times for 40 images"):
            remux_to_mp4(mkv_bytes, io.BytesIO(), timestamps_seconds=np.arange(count) / 10)
    timestamps = np.arange(40) / 10
    timestamps[7] = timestamps[6]
    with pytest.raises(ArrayError, match=r"timestamps_seconds\[7\]: 0.6.*; expected more than 0.6"):
        remux_to_mp4(mkv_bytes, io.BytesIO(), timestamps_seconds=timestamps)
    with pytest.raises(OptionError, match="97x65, it needs even sizes; cut them to 96x64"):
        remux_to_mp4(videos.make(**FFV1, count=4, size=(97, 65)), io.BytesIO())
    for content in (b"no video at all" * 50, b""):
        with pytest.raises(DataError, match=r"front: cannot be read as video"):
            remux_to_mp4(content, io.BytesIO(), name="front")
    with pytest.raises(OutputError, match="No space left"):
        remux_to_mp4(mkv_bytes, full_disk)
    images = [videos.image(k) for k in range(3)]
    with pytest.raises(OutputError, match="needs at least one image"):
        encode_to_mp4([], io.BytesIO())
    for count in (2, 4):
        with pytest.raises(ArrayError, match=f"{count} times for 3 images"):
            encode_to_mp4(iter(images), io.BytesIO(), timestamps_seconds=np.arange(count) / 10)
    with pytest.raises(ArrayError, match="image 2: expected no more than 2"):
        encode_to_mp4(images, io.BytesIO(), fps=10.0, count=2)


class Watched(io.BytesIO):
    """A file that notes how much is read from it and written to it at a time [bytes]."""

    def __init__(self, log, content=b""):
        super().__init__(content)
        self.log = log

    def read(self, size=-1):
        self.log.append(("read", size))
        return super().read(size)

    def write(self, data):
        self.log.append(("write", len(data)))
        return super().write(data)


def test_images_are_encoded_one_at_a_time_also_where_no_one_says_how_many(videos):
    log = []

    def images():
        for number in range(100):
            log.append(("image", number))
            yield videos.image(number)

    target = Watched(log)
    assert encode_to_mp4(images(), target, fps=10.0).images == 100
    assert [what for what, _ in log].index("write") < 70
    assert boxes_of(target.getvalue())[-1] == b"moov"
    with av.open(io.BytesIO(target.getvalue())) as container:
        numbers = [videos.number(frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    assert numbers == list(range(100))


def test_copying_holds_no_more_of_the_video_than_a_piece(videos):
    content, log = videos.make(options={"g": "12", "qp": "2"}, size=(640, 480)), []
    remux_to_mp4(lambda: Watched(log, content), Watched(log))
    assert max(size for what, size in log if what == "read") <= 1 << 20
    last_read = max(k for k, (what, _) in enumerate(log) if what == "read")
    assert sum(size for what, size in log[:last_read] if what == "write") > len(content) // 2


def boxes_of(content):
    """The names of the outermost boxes of an mp4 file, in their order."""
    location, names = 0, []
    while location < len(content):
        names.append(content[location + 4 : location + 8])
        location += int.from_bytes(content[location : location + 4], "big")
    return names


@pytest.mark.parametrize("kind", ["copied", "remuxed", "at times", "counted"])
def test_the_tables_stand_before_the_images_and_the_bytes_are_always_the_same(videos, kind):
    rng = np.random.default_rng(3)
    images = rng.integers(0, 255, (40, 48, 64, 3), np.uint8)
    uneven = np.cumsum(rng.uniform(0.02, 0.3, 40))
    content = videos.make(**(FFV1 if kind == "remuxed" else {}))
    made = []
    for _ in range(2):
        target = io.BytesIO()
        if kind in {"copied", "remuxed"}:
            remux_to_mp4(content, target, timestamps_seconds=uneven)
        elif kind == "at times":
            encode_to_mp4(images, target, timestamps_seconds=uneven)
        else:
            encode_to_mp4(iter(images), target, fps=10.0, count=40)
        made.append(target.getvalue())
    names = boxes_of(made[0])
    assert names.index(b"moov") < names.index(b"mdat")
    assert made[0] == made[1]
    assert len(videos.decode(made[0])) == 40


def test_tables_of_very_many_uneven_key_frames_find_room():
    target = io.BytesIO()
    with VideoWriter(target, 16, 16, 10.0, container="mp4", images=3000) as writer:
        for seconds in np.cumsum(np.random.default_rng(1).uniform(1e-3, 1.0, 3000)):
            writer.add(np.full((16, 16, 3), int(seconds * 255) % 255, np.uint8), seconds)
    names = boxes_of(target.getvalue())
    assert names.index(b"moov") < names.index(b"mdat")


GROUPS = {"g": "5", "keyint_min": "5", "sc_threshold": "0", "bf": "2", "x264-params": "open-gop=0"}
"""Groups of five images, with images between that look both ways."""


@pytest.mark.parametrize(
    ("recipe", "parts"),
    [
        *((COPIED[kind], [range(40)]) for kind in ("h264 from mp4", "h264 from ts", "hevc from mkv")),
        ({"options": GROUPS, "count": 20},
         [range(20), range(10), range(5, 20), range(10, 15), [*range(5), *range(10, 20)]]),
        (FFV1 | {"options": {"g": "1"}, "count": 20}, [range(20), [0, 3, 4, 9], [7], [1, 19]]),
    ],
)  # fmt: skip
def test_matroska_takes_packets_of_any_codec_that_need_no_others_and_keeps_the_rate(videos, tmp_path, recipe, parts):
    content = videos.make(**recipe)
    expected = videos.decode(content)
    for number, taken in enumerate(parts):
        target, whole = tmp_path / f"{number}.mkv", len(taken) == len(expected)
        which = {"images": len(taken)} if whole else {"frame_indices": list(taken)}
        result = copy_to_matroska(content, target, **which)
        assert (result.images, result.copied) == (len(taken), True)
        np.testing.assert_array_equal(videos.decode(target.read_bytes()), [expected[index] for index in taken])
        with av.open(str(target)) as container:
            assert container.streams.video[0].average_rate == 30 or not whole


def test_nothing_is_written_where_packets_cannot_be_copied(videos, mkv_bytes, tmp_path):
    target, groups = tmp_path / "cut.mkv", videos.make(options=GROUPS, count=20)
    assert copy_to_matroska(videos.make(container="avi"), target) is None
    assert copy_to_matroska(mkv_bytes, target, images=39) is None
    for taken in (range(1, 20), [0, 2, *range(3, 20)], [*range(5), *range(6, 20)], [], [3, 3], [20]):
        assert copy_to_matroska(groups, target, frame_indices=list(taken)) is None
    assert not target.exists()
