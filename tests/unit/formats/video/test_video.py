"""Videos: images come out by their number, exactly, and are encoded, or copied, with their colours and times."""

import gc
import io
import mmap
import re
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import Interpolation, VideoReformatter
from PIL import Image

from sceneloom.errors import ArrayError, DataError, OptionError, OutputError
from sceneloom.formats.recording.reader import PngFolder
from sceneloom.formats.video.reader import open_video, read_index, read_table_index
from sceneloom.formats.video.writer import VideoWriter, copy_to_matroska, encode_to_mp4, remux_to_mp4

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


def test_images_that_an_edit_list_cuts_away_do_not_count(videos):
    file, content = io.BytesIO(), videos.make(container="mp4")
    with av.open(io.BytesIO(content)) as source, av.open(file, "w", format="mp4") as output:
        original = source.streams.video[0]
        stream = output.add_stream_from_template(original, opaque=True)
        # the first five images come before time 0, which an edit list then cuts away
        shift = round(5 / 30 / original.time_base)
        for packet in [packet for packet in source.demux(original) if packet.size]:
            packet.pts, packet.dts = packet.pts - shift, packet.dts - shift
            packet.stream = stream
            output.mux(packet)
    with open_video(file.getvalue()) as reader:
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
    # threads that share a reader get the images that they asked for
    orders = np.random.default_rng(0).integers(0, 40, (3, 15)).tolist()
    with open_video(mkv_bytes) as reader, ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda order: [videos.number(reader.rgb(k)) for k in order], orders))
    assert found == orders


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


PLAYLISTS = ["ffconcat version 1.0\nfile 'data.mkv'\n", "#EXTM3U\n#EXTINF:1,\ndata.mkv\n#EXT-X-ENDLIST\n"]


def test_what_is_no_video_a_closed_reader_and_an_image_beyond_the_last_are_refused(mkv_bytes, tmp_path):
    sound = io.BytesIO()
    with av.open(sound, "w", format="matroska") as output:
        stream = output.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    for content, problem in (
        (b"", "cannot be read as video"),
        (b"no video" * 99, "cannot be read as video"),
        (sound.getvalue(), "no video stream"),
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


def test_an_image_of_another_size_than_the_first_or_a_damaged_one_is_refused_by_its_number_and_path(
    videos, mkv_bytes, tmp_path
):
    path, third, half = tmp_path / "front.mkv", len(mkv_bytes) // 3, len(mkv_bytes) // 2
    path.write_bytes(mkv_bytes[:third] + bytes(half - third) + mkv_bytes[half:])
    with open_video(path) as reader, pytest.raises(DataError, match=r"front\.mkv: (image|packet) \d+"):
        for index in range(40):
            reader.rgb(index)
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


def rgb_by_formula(planes, kr, kb, *, site, full):
    """Decode BT.601 or BT.709; chroma linearly interpolated, midway between two rows.

    Source: ITU-R BT.601-7 and BT.709-6, clause 3; ITU-T H.264, figure E-1.
    """
    luma = planes[0].astype(float)
    height, width = luma.shape

    def spread(plane):
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


def smooth(rng, shape, sigma, low, high):
    noise = cv2.GaussianBlur(rng.integers(0, 256, shape, dtype=np.uint8), (0, 0), sigma)
    return cv2.normalize(noise, None, low, high, cv2.NORM_MINMAX)


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
    planes = [smooth(rng, shape, 2, 30, 225) for shape in [(64, 96), (32, 48), (32, 48)]]
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


def test_images_of_real_drives_are_those_of_opencv_in_order_and_of_ffmpegs_exact_converter_within_a_level(data_dir):
    for path in sorted((data_dir / "recordings").glob("*/data*.mkv")):
        difference = difference_from_ffmpeg(path)
        # where a level lies midway, roundings differ
        assert np.count_nonzero(difference) < 0.04 * difference.size
        capture = cv2.VideoCapture(str(path))
        with open_video(path) as reader:
            for index in range(reader.count):
                found, bgr = capture.read()
                assert found
                difference = reader.rgb(index).astype(int) - bgr[:, :, ::-1]
                # OpenCV does not interpolate the halved chroma and truncates; other images differ by 10 and more
                assert np.abs(difference).mean() < 2.5
            assert not capture.read()[0]


def test_ten_bit_and_grey_videos_come_as_eight_bit_colours(videos):
    for codec, pixel_format in (("libx264", "yuv422p10le"), ("ffv1", "gray"), ("ffv1", "gbrp10le")):
        with open_video(videos.make(codec=codec, pixel_format=pixel_format, options={}, count=3)) as reader:
            rgb = reader.rgb(2)
        assert (rgb.dtype, rgb.shape, videos.number(rgb)) == (np.uint8, (64, 96, 3), 2)


class Counted(bytes):
    """Bytes that remember how many of them were looked at."""

    looked_at = 0

    def __getitem__(self, part):
        piece = super().__getitem__(part)
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
    assert 0 < counted.looked_at < len(counted) / 2
    content = make_mp4(videos, options={"g": "10", "qp": "5"})
    for part in (0.0, 0.001, 0.01, 0.5, 0.95):
        with pytest.raises(DataError):
            read_table_index(content[: int(part * len(content))], "video")
    whole = make_mp4(videos, flags="faststart")
    with pytest.raises(DataError, match="cut off"):
        _ = open_video(whole[: len(whole) * 3 // 4]).count


def test_images_are_those_that_were_put_in_also_after_closing_and_what_is_no_folder_of_images_refused(tmp_path, videos):
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number:08d}.png"), videos.image(number, 31, 17)[:, :, ::-1])
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


def test_colours_come_back_unshifted_from_opencv_too_which_ignores_what_a_stream_says_of_them(tmp_path, videos):
    images = [smooth(np.random.default_rng(seed), (240, 320, 3), 8, 20, 235) for seed in range(3)]
    write(tmp_path / "data.mkv", images)
    with open_video(tmp_path / "data.mkv") as reader:
        errors = np.stack([reader.rgb(k).astype(int) - rgb for k, rgb in enumerate(images)])
    assert np.abs(errors.mean(axis=(0, 1, 2))).max() < 0.2  # no tint
    assert np.median(np.abs(errors)) <= 4  # what the main job allows H.264 to lose
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


def test_impossible_requests_and_images_of_another_shape_type_or_earlier_time_are_refused(tmp_path, videos, full_disk):
    for change, problem in (
        ({"codec": "divx"}, "no video codec 'divx'; there are h264, ffv1"),
        ({"container": "avi"}, "no video container 'avi'"),
        ({"fps": 0.0}, "0.0 images a second"),
        ({"fps": float("nan")}, "nan images a second"),
        ({"width": 0}, "image size 0x64"),
        ({"width": 33}, "needs even sizes; cut them to 32x64, or keep them as PNG"),
        ({"height": 51}, "needs even sizes; cut them to 96x50, or keep them as PNG"),
        ({"target": tmp_path / "data.gif"}, r"no video container '.gif'; there are .mkv, .mp4"),
    ):
        with pytest.raises(OptionError, match=problem):
            VideoWriter(**{"target": tmp_path / "data.mkv", "width": 96, "height": 64, "fps": 10.0} | change)
    assert not list(tmp_path.iterdir())
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
    with pytest.raises(OutputError, match="needs at least one image"), VideoWriter(tmp_path / "data.mkv", 96, 64, 10):
        pass
    noise = np.random.default_rng(0).integers(0, 256, (30, 64, 96, 3), dtype=np.uint8)
    for target, problem in (
        (tmp_path / "nowhere" / "data.mkv", r"nowhere/data\.mkv: cannot be written: No such file"),
        (full_disk, "No space left"),
    ):
        with pytest.raises(OutputError, match=problem):
            write(target, noise)


COPIED = {
    "h264 from mkv": {},
    "h264 from mp4": {"container": "mp4"},
    "h264 from ts": {"container": "mpegts"},
    "h264 that starts late": {"ticks": range(300, 340)},
    "h264 with uneven times": {"ticks": np.cumsum([0, *([1, 2, 5] * 13)]).tolist()},
    "hevc from mkv": KINDS["hevc"],
    "h264 without B-frames from avi": KINDS["h264 without B-frames in avi"],
}
FFV1 = KINDS["ffv1"]


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


def remux(source, target, **options):
    with target.open("wb") as file:
        return remux_to_mp4(source, file, **options)


@pytest.mark.parametrize("kind", COPIED)
def test_a_copy_holds_the_same_images_bit_by_bit_in_the_same_order_and_is_decodable_in_time(videos, tmp_path, kind):
    content, target = videos.make(**COPIED[kind]), tmp_path / "made.mp4"
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


def test_what_cannot_be_copied_is_encoded_as_h264_and_says_why(videos, tmp_path):
    target = tmp_path / "made.mp4"
    for recipe, chosen, reason in (
        (FFV1, None, "ffv1 is not copied into mp4"),
        (KINDS["vp9"], None, "vp9 is not copied"),
        ({"container": "avi"}, None, "does not state when its images are shown"),
        ({}, [3, 4, 9, 30], ""),
    ):
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
    # and copying holds no more of the video than a piece
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


def test_the_tables_stand_before_the_images_and_the_bytes_are_always_the_same(videos):
    rng = np.random.default_rng(3)
    images = rng.integers(0, 255, (40, 48, 64, 3), np.uint8)
    times = {"timestamps_seconds": np.cumsum(rng.uniform(0.02, 0.3, 40))}
    copied, remuxed = videos.make(), videos.make(**FFV1)
    for write_to in (
        lambda target: remux_to_mp4(copied, target, **times),
        lambda target: remux_to_mp4(remuxed, target, **times),
        lambda target: encode_to_mp4(images, target, **times),
        lambda target: encode_to_mp4(iter(images), target, fps=10.0, count=40),
    ):
        made = [io.BytesIO(), io.BytesIO()]
        for target in made:
            write_to(target)
        content, again = (target.getvalue() for target in made)
        names = boxes_of(content)
        assert names.index(b"moov") < names.index(b"mdat")
        assert content == again
        assert len(videos.decode(content)) == 40
    # very many uneven key frames find room
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
