"""Images come out of videos by their number, exactly, whatever the order of asking."""

import gc
import io
import mmap
import re
import threading
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import Interpolation, VideoReformatter
from PIL import Image

from sceneloom.errors import DataError
from sceneloom.formats.recording.reader import PngFolder
from sceneloom.formats.video.reader import open_video, read_index, read_table_index

X264 = {"g": "12", "bf": "3", "preset": "veryfast"}
KINDS = {
    "h264 with B-frames in mkv": {},
    "h264 with B-frames in mp4": {"container": "mp4"},
    "h264 with B-frames in ts": {"container": "mpegts"},
    "h264 with B-frames in avi, which has no presentation times": {"container": "avi"},
    "h264 without B-frames in avi": {"container": "avi", "options": X264 | {"bf": "0"}},
    "h264 as a bare stream": {"container": "h264"},
    "h264 with open groups of images": {"options": X264 | {"x264-params": "open-gop=1"}},
    "h264 that refreshes bit by bit": {"options": X264 | {"intra-refresh": "1"}, "container": "mpegts"},
    "hevc": {"codec": "libx265", "options": {"x265-params": "log-level=none:keyint=12:pools=1", "preset": "ultrafast"}},
    "mpeg4 in avi": {"codec": "mpeg4", "container": "avi", "options": {"bf": "2", "b": "2M"}},
    "mjpeg in avi": {"codec": "mjpeg", "container": "avi", "pixel_format": "yuvj420p", "options": {}},
    "vp9": {"codec": "libvpx-vp9", "options": {"g": "12", "deadline": "realtime", "cpu-used": "8"}},
    "ffv1": {"codec": "ffv1", "pixel_format": "bgr0", "options": {}},
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.few(5)
def test_every_image_is_the_one_that_was_asked_for_in_whatever_order(videos, kind):
    content = videos.make(**KINDS[kind])
    with open_video(content) as forwards, open_video(content) as jumping:
        assert forwards.count == 40
        images = [forwards.rgb(index) for index in range(40)]
        assert [videos.number(rgb) for rgb in images] == list(range(40))
        jumps = np.random.default_rng(3).permutation(40)[:15].tolist()
        for index in (25, 3, 37, 12, 11, 24, 0, *jumps, *range(39, -1, -3)):
            np.testing.assert_array_equal(jumping.rgb(index), images[index])


def test_images_and_their_order_are_those_that_opencv_reads(data_dir, tmp_path):
    for path in sorted((data_dir / "recordings").glob("*/data*.mkv")):
        capture = cv2.VideoCapture(str(path))
        with open_video(path) as reader:
            for index in range(reader.count):
                found, bgr = capture.read()
                assert found
                difference = reader.rgb(index).astype(int) - bgr[:, :, ::-1]
                # OpenCV does not interpolate the halved chroma and truncates; other images differ by 10 and more
                assert np.abs(difference).mean() < 2.5
            assert not capture.read()[0]


def test_counting_decodes_nothing_reading_on_each_packet_once_and_a_jump_from_the_key_frame(mkv_bytes, decoded_packets):
    with open_video(mkv_bytes) as reader:
        assert (reader.count, len(reader.timestamps), decoded_packets) == (40, 40, [])
        for index in range(40):
            reader.rgb(index)
    assert len(decoded_packets) == 40
    for before, after, most in (
        # inside a group: from its key frame each time there would be 27 and more; who works ahead has 3 packets more
        ((), (0, 4, 8), 15),
        # 37 is the second of its group; a decoder of 3 B-frames, and one that works ahead, take a few packets more
        ((2,), (37,), 11),
        ((30,), (30,), 0),
    ):
        with open_video(mkv_bytes) as reader:
            for index in before:
                reader.rgb(index)
            decoded_packets.clear()
            for index in after:
                reader.rgb(index)
        assert len(decoded_packets) <= most


@pytest.mark.parametrize(
    ("container", "ticks", "start"),
    [
        # mp4 counts time from its first image where no edit list says otherwise; this one says so
        ("mp4", [30 + t for t in (0, 1, 2, 5, 6, 20, 21, 22, 60, 61)], None),
        ("matroska", range(300, 310), 10.0),
    ],
)
def test_times_are_those_of_the_container_in_the_order_of_showing(videos, container, ticks, start):
    with open_video(videos.make(container=container, count=10, ticks=ticks)) as reader:
        seconds = (np.array(ticks) - ticks[0]) / 30
        # Matroska rounds to its milliseconds
        assert reader.timestamps - reader.timestamps[0] == pytest.approx(seconds, abs=1.1e-3)
        assert [videos.number(reader.rgb(index)) for index in (9, 0, 5)] == [9, 0, 5]
        if start is not None:
            assert reader.timestamps[0] == pytest.approx(start, abs=1e-3)
            assert reader.fps == pytest.approx(30.0)


def cut_by_edit_list(content: bytes, hidden: int) -> bytes:
    """Copy a video into mp4 so that its first images come before time 0, which an edit list then cuts away."""
    file = io.BytesIO()
    with av.open(io.BytesIO(content)) as source, av.open(file, "w", format="mp4") as output:
        original = source.streams.video[0]
        stream = output.add_stream_from_template(original, opaque=True)
        shift = round(hidden / 30 / original.time_base)
        packets = [packet for packet in source.demux(original) if packet.size]
        for packet in packets:
            packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
            packet.stream = stream
            output.mux(packet)
    return file.getvalue()


def test_images_that_an_edit_list_cuts_away_do_not_count(videos):
    content = cut_by_edit_list(videos.make(container="mp4"), hidden=5)
    with open_video(content) as reader:
        assert reader.count == 35
        assert reader.timestamps[0] == 0.0
        assert [videos.number(reader.rgb(index)) for index in (*range(35), 1)] == [*range(5, 40), 6]


def test_a_video_is_read_from_a_file_its_bytes_a_map_of_it_or_whatever_opens_it(videos, mkv_bytes, tmp_path):
    path = tmp_path / "drive: second try.mkv"
    path.write_bytes(mkv_bytes)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        view = memoryview(mapped)
        for source in (path, str(path), mkv_bytes, bytearray(mkv_bytes), view, lambda: path.open("rb")):
            with open_video(source) as reader:
                assert (reader.count, reader.codec, reader.width, reader.height) == (40, "h264", 96, 64)
                assert videos.number(reader.rgb(33)) == 33
        view.release()


def test_threads_that_share_a_reader_get_the_images_that_they_asked_for(videos, mkv_bytes):
    wrong: list[tuple[int, int]] = []
    with open_video(mkv_bytes) as reader:

        def ask(indices: list[int]) -> None:
            wrong.extend((k, n) for k in indices if (n := videos.number(reader.rgb(k))) != k)

        orders = np.random.default_rng(0).integers(0, 40, (3, 15)).tolist()
        threads = [threading.Thread(target=ask, args=(order,)) for order in orders]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


@pytest.mark.parametrize(
    ("processors", "options", "jumps", "decoded"),
    [
        (1, {}, [0], 1),
        (2, {}, [0, 1], 4),
        (64, {}, [0, 1], 5),
        # where no image needs another, the first is decoded together with the three after it, and then one each
        (64, {"g": "1"}, [5, 20, 3, 17, 18, 0, 39], 10),
    ],
)
def test_as_many_images_are_decoded_at_once_as_there_are_processors_for_and_four_at_most(
    videos, decoded_packets, monkeypatch, processors, options, jumps, decoded
):
    monkeypatch.setattr("sceneloom.formats.video.reader.processors", lambda: processors)
    with open_video(videos.make(codec="ffv1", pixel_format="bgr0", options=options)) as reader:
        assert [videos.number(reader.rgb(index)) for index in jumps] == jumps
    assert len(decoded_packets) == decoded


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the system does not list threads")
def test_no_thread_of_a_decoder_is_left_when_reading_stops_halfway(mkv_bytes, monkeypatch):
    monkeypatch.setattr("sceneloom.formats.video.reader.processors", lambda: 8)
    tasks = Path("/proc/self/task")
    before = set(tasks.iterdir())
    with open_video(mkv_bytes) as reader:
        reader.rgb(7)
        assert len(set(tasks.iterdir()) - before) == 4
    assert set(tasks.iterdir()) <= before
    forgotten = open_video(mkv_bytes)
    forgotten.rgb(7)
    del forgotten
    gc.collect()
    assert set(tasks.iterdir()) <= before


def sound_only() -> bytes:
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as output:
        stream = output.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return file.getvalue()


PLAYLISTS = ["ffconcat version 1.0\nfile 'data.mkv'\n", "#EXTM3U\n#EXTINF:1,\ndata.mkv\n#EXT-X-ENDLIST\n"]


def test_what_is_no_video_a_closed_reader_and_an_image_beyond_the_last_are_refused(mkv_bytes, tmp_path):
    for content, problem in (
        (b"", "cannot be read as video"),
        (b"no video" * 99, "cannot be read as video"),
        (sound_only(), "no video stream"),
        (tmp_path / "gone.mkv", r"gone.mkv: no such file"),
        (tmp_path, "not a file"),
    ):
        with pytest.raises(DataError, match=problem):
            open_video(content)
    (tmp_path / "data.mkv").write_bytes(mkv_bytes)
    for playlist in PLAYLISTS:  # which name other files
        (tmp_path / "data2.mkv").write_text(playlist)
        with pytest.raises(DataError):
            open_video(tmp_path / "data2.mkv")
    with open_video(mkv_bytes, name="front.mkv") as reader:
        for index in (-1, 40):
            with pytest.raises(DataError, match=f"front.mkv: image {index}: .*holds 40"):
                reader.rgb(index)
    reader.close()
    with pytest.raises(DataError, match="is closed"):
        reader.rgb(0)


def test_an_image_of_another_size_than_the_first_is_refused_by_its_number(videos):
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as output:
        stream = output.add_stream("mjpeg", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuvj420p"
        for number, width in enumerate((96, 96, 48, 96)):
            packet = av.Packet(cv2.imencode(".jpg", videos.image(number, width, 64))[1].tobytes())
            packet.stream, packet.time_base = stream, Fraction(1, 10)
            packet.pts = packet.dts = number
            packet.is_keyframe = True
            output.mux(packet)
    with open_video(file.getvalue()) as reader:
        assert videos.number(reader.rgb(3)) == 3
        with pytest.raises(DataError, match="image 2: is 48x64; expected 96x64"):
            reader.rgb(2)


MATRICES = {"bt601": (0.299, 0.114, 6), "bt709": (0.2126, 0.0722, 1), "unnamed": (0.299, 0.114, 2)}
SITES = {"libx264": 0.0, "ffv1": 0.5}
"""How far right of an even column its chroma sits [px], where the stream is silent: H.264 type 0; MPEG-1 else."""


def rgb_by_formula(planes: list[np.ndarray], kr: float, kb: float, *, site: float, full: bool) -> np.ndarray:
    """Decode BT.601 or BT.709; chroma linearly interpolated, midway between two rows.

    Source: ITU-R BT.601-7 and BT.709-6, clause 3; ITU-T H.264, figure E-1.
    """
    luma = planes[0].astype(float)
    height, width = luma.shape

    def spread(plane: np.ndarray) -> np.ndarray:
        rows = np.clip((np.arange(height) - 0.5) / 2, 0, plane.shape[0] - 1)
        columns = np.clip((np.arange(width) - site) / 2, 0, plane.shape[1] - 1)
        down = np.array([np.interp(rows, np.arange(plane.shape[0]), column) for column in plane.T])
        return np.array([np.interp(columns, np.arange(plane.shape[1]), row) for row in down.T])

    low, luma_span, chroma_span = (0, 255, 255) if full else (16, 219, 224)
    y = (luma - low) * 255 / luma_span
    cb, cr = ((spread(plane) - 128) * 255 / chroma_span for plane in planes[1:])
    red, blue = y + 2 * (1 - kr) * cr, y + 2 * (1 - kb) * cb
    green = (y - kr * red - kb * blue) / (1 - kr - kb)
    return np.clip(np.stack([red, green, blue], axis=-1), 0, 255)


def smooth_plane(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    noise = rng.integers(0, 256, (height, width), dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 30, 225, cv2.NORM_MINMAX)


def of_one_image(frame, codec, options, **colours):
    """A video of one image, whose pixels are given as they are stored."""
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as output:
        stream = output.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, "yuv420p"
        for name, value in colours.items():
            setattr(stream.codec_context, name, value)
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return file.getvalue()


@pytest.mark.parametrize("codec", SITES)
@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", MATRICES)
def test_colours_follow_the_matrix_range_and_chroma_site_of_the_stream(matrix, full, codec):
    kr, kb, number = MATRICES[matrix]
    rng = np.random.default_rng(5)
    planes = [smooth_plane(rng, *shape) for shape in [(64, 96), (32, 48), (32, 48)]]
    together = np.concatenate([plane.ravel() for plane in planes]).reshape(96, 96)
    frame = av.VideoFrame.from_ndarray(together, format="yuv420p")
    options = {"qp": "0"} if codec == "libx264" else {}
    content = of_one_image(frame, codec, options, colorspace=number, color_range=2 if full else 1)
    expected = rgb_by_formula(planes, kr, kb, site=SITES[codec], full=full)
    with open_video(content) as reader:
        # half a level of rounding, and the converter's fixed-point numbers
        assert np.abs(reader.rgb(0) - expected).max() < 0.6


def difference_from_ffmpeg(source):
    """The first image less that of FFmpeg's exact converter."""
    exact = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
    with av.open(str(source) if isinstance(source, Path) else io.BytesIO(source)) as container:
        frame = next(container.decode(video=0))
        expected = VideoReformatter().reformat(frame, format="rgb24", interpolation=exact, threads=1)
    with open_video(source) as reader:
        difference = reader.rgb(0) - expected.to_ndarray().astype(int)
    # both are within 0.6 of the formula; the fast converter differs by up to 130 here
    assert np.abs(difference).max() <= 1
    assert np.abs(difference.mean(axis=(0, 1))).max() < 0.06
    return difference


LOCATIONS = {
    "left": ("libx264", {"qp": "0", "x264-params": "chromaloc=0"}, 64, 96),
    "centre": ("libx264", {"qp": "0", "x264-params": "chromaloc=1"}, 64, 96),
    "top left": ("libx264", {"qp": "0", "x264-params": "chromaloc=2"}, 64, 96),
    "bottom": ("libx264", {"qp": "0", "x264-params": "chromaloc=5"}, 64, 96),
    "interlaced": ("libx264", {"qp": "0", "x264-params": "tff=1"}, 64, 96),
    "cropped": ("libx264", {"qp": "0"}, 74, 106),
    "odd height": ("ffv1", {}, 63, 96),
    "odd width": ("ffv1", {}, 64, 95),
}
"""Where the samples of colour lie, and whether there is one for each four pixels."""


@pytest.mark.parametrize("location", LOCATIONS)
def test_halved_colours_are_those_of_ffmpegs_exact_converter_within_a_level(location):
    codec, options, height, width = LOCATIONS[location]
    rng = np.random.default_rng(4)
    frame = av.VideoFrame(width, height, "yuv420p")
    for plane in frame.planes:
        # at the brightest blues FFmpeg's converter overflows, and gives black
        plane.update(rng.integers(20, 236, plane.buffer_size, dtype=np.uint8).tobytes())
    difference_from_ffmpeg(of_one_image(frame, codec, options))


def test_images_of_real_drives_are_those_of_ffmpegs_exact_converter_within_a_level(data_dir):
    for path in sorted((data_dir / "recordings").glob("*/data.mkv")):
        difference = difference_from_ffmpeg(path)
        # where a level lies midway, roundings differ
        assert np.count_nonzero(difference) < 0.04 * difference.size


def test_ten_bit_and_grey_videos_come_as_eight_bit_colours(videos):
    for codec, pixel_format in (("libx264", "yuv422p10le"), ("ffv1", "gray"), ("ffv1", "gbrp10le")):
        with open_video(videos.make(codec=codec, pixel_format=pixel_format, options={}, count=3)) as reader:
            rgb = reader.rgb(2)
        assert (rgb.dtype, rgb.shape, videos.number(rgb)) == (np.uint8, (64, 96, 3), 2)


def test_the_path_is_in_the_message_of_a_damaged_image(mkv_bytes, tmp_path):
    path, third, half = tmp_path / "front.mkv", len(mkv_bytes) // 3, len(mkv_bytes) // 2
    path.write_bytes(mkv_bytes[:third] + bytes(half - third) + mkv_bytes[half:])
    with open_video(path) as reader, pytest.raises(DataError, match=r"front\.mkv: (image|packet) \d+"):
        for index in range(40):
            reader.rgb(index)


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


TABLES = {
    "H.264 with images out of order": {},
    "H.264 with the tables in front": {"options": {"g": "10"}, "flags": "faststart"},
    "H.264 in fragments": {"options": {"g": "10"}, "flags": "frag_keyframe+empty_moov"},
    "H.264 in a QuickTime file": {"container": "mov"},
    "MPEG-4": {"codec": "mpeg4", "options": {}},
}


def make_mp4(videos, **recipe):
    return videos.make(**({"container": "mp4", "size": (128, 128)} | recipe))


@pytest.mark.parametrize("recipe", TABLES.values(), ids=TABLES)
def test_tables_report_what_a_walk_through_all_packets_reports(videos, recipe):
    content = make_mp4(videos, **recipe)
    assert (content[4:12] == b"ftypqt  ") == (recipe.get("container") == "mov")
    expected, found = read_index(content, "video"), read_table_index(content, "video")
    assert (found.time_base, found.timed, found.hidden) == (expected.time_base, expected.timed, expected.hidden)
    for name in ("pts", "positions", "entries"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_images_are_not_read_for_their_tables_and_a_video_that_was_cut_is_an_error(videos):
    counted = Counted(make_mp4(videos, options={"g": "12", "qp": "2"}, size=(640, 480), count=60))
    assert len(read_table_index(counted, "video")) == 60
    assert counted.looked_at < len(counted) / 2
    content = make_mp4(videos, options={"g": "10", "qp": "5"})
    for part in (0.0, 0.001, 0.01, 0.5, 0.95):
        with pytest.raises(DataError):
            read_table_index(content[: int(part * len(content))], "video")
    whole = make_mp4(videos, flags="faststart")
    with pytest.raises(DataError, match="cut off"):
        _ = open_video(whole[: len(whole) * 3 // 4]).count


@pytest.fixture
def folder(tmp_path, videos):
    for number in range(3):
        rgb = videos.image(number, 31, 17)
        cv2.imwrite(str(tmp_path / f"{number:08d}.png"), rgb[:, :, ::-1])
    return tmp_path


def test_images_are_those_that_were_put_in_also_after_closing_and_those_beyond_the_last_refused(folder, videos):
    (folder / "notes.txt").write_text("not an image")
    (folder / "3.png").write_bytes(b"a name of another kind")
    images = PngFolder(folder)
    assert (images.count, images.width, images.height, images.codec) == (3, 31, 17, "png")
    for number in (2, 0, 1):
        np.testing.assert_array_equal(images.rgb(number), videos.image(number, 31, 17))
    for index in (-1, 3):
        with pytest.raises(DataError, match=f"image {index}: does not exist: the folder holds 3"):
            images.rgb(index)
    images.close()
    assert images.rgb(0).shape == (17, 31, 3)


def test_grey_is_repeated_transparency_dropped_and_sixteen_bits_keep_their_upper_eight(tmp_path):
    rng = np.random.default_rng(0)
    grey, rgba = rng.integers(0, 256, (5, 7), np.uint8), rng.integers(0, 256, (5, 7, 4), np.uint8)
    deep = rng.integers(0, 65536, (5, 7, 3)).astype(np.uint16)
    pillow = map(Image.fromarray, (grey, rgba, grey > 128))
    for number, image in enumerate((*pillow, Image.fromarray(grey).convert("P"))):
        image.save(tmp_path / f"{number:08d}.png")
    cv2.imwrite(str(tmp_path / "00000004.png"), deep[:, :, ::-1])
    images = PngFolder(tmp_path)
    np.testing.assert_array_equal(images.rgb(0), np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(images.rgb(1), rgba[:, :, :3])
    np.testing.assert_array_equal(images.rgb(2)[:, :, 1], np.where(grey > 128, 255, 0))
    np.testing.assert_array_equal(images.rgb(3)[:, :, 2], grey)
    np.testing.assert_array_equal(images.rgb(4), deep >> 8)


def test_what_is_no_folder_of_images_is_refused_and_so_are_damaged_ones_and_those_of_another_kind(folder, tmp_path):
    path = folder / "00000001.png"
    content = path.read_bytes()
    for image, problem in (
        (np.zeros((17, 30, 3), np.uint8), r"00000001\.png: is 30x17; expected 31x17"),
        # grey of 16 bits may be depth
        (np.full((17, 31), 4000, np.uint16), r"00000001.png: has pixels of type .*expected 8-bit"),
        (content[: len(content) // 2], r"00000001\.png"),
        (b"GIF89a, not a PNG", r"00000001\.png"),
    ):
        if isinstance(image, np.ndarray):
            cv2.imwrite(str(path), image)
        else:
            path.write_bytes(image)
        with pytest.raises(DataError, match=problem):
            PngFolder(folder).rgb(1)
    with pytest.raises(DataError, match=re.escape(f"{tmp_path / 'frames1'}: no such folder")):
        PngFolder(tmp_path / "frames1")
    path.unlink()
    with pytest.raises(DataError, match=r"00000001.png: is missing; the next image is 00000002.png"):
        PngFolder(folder)
    for number in (0, 2):
        (folder / f"{number:08d}.png").unlink()
    with pytest.raises(DataError, match=r"holds no images; expected 00000000\.png"):
        PngFolder(folder)
