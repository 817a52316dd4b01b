"""Encoded images come back in order, with their colours and times; impossible requests are refused."""

import io

import av
import cv2
import numpy as np
import pytest

from sceneloom.errors import ArrayError, OptionError, OutputError
from sceneloom.formats.video.writer import VideoWriter


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
@pytest.mark.parametrize("start", [0.0, -3.2, 1.7e9])
def test_uneven_times_are_kept_from_the_first_image_on(videos, container, start):
    steps = np.cumsum([0.0, 0.1, 0.1, 0.033, 0.5, 0.1, 0.067, 2.0])
    file = io.BytesIO()
    write(file, [videos.image(number) for number in range(8)], list(start + steps), container=container)
    # Matroska counts milliseconds; seconds since 1970 resolve a quarter of a microsecond
    tolerance = 5.1e-4 if container == "matroska" else 1e-6
    assert presentation_times(file.getvalue()) == pytest.approx(steps, abs=tolerance)


def test_images_closer_than_a_tick_of_the_container_stay_apart_and_in_order(videos):
    file = io.BytesIO()
    times = [0.0, 0.0001, 0.0002, 0.0003, 0.1]
    write(file, [videos.image(number) for number in range(5)], times, container="matroska")
    found = presentation_times(file.getvalue())
    assert len(set(found)) == 5
    assert found == sorted(found)


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


def test_an_image_of_another_shape_or_type_is_refused_by_its_number(tmp_path, videos):
    with VideoWriter(tmp_path / "data.mkv", 96, 64, 10.0) as writer:
        writer.add(videos.image(0))
        for wrong in (videos.image(1)[:62], videos.image(1).astype(float), videos.image(1)[:, :, :1]):
            with pytest.raises(ArrayError, match=r"image 1: .*expected \(64, 96, 3\) uint8"):
                writer.add(wrong)
        writer.add(videos.image(1))
    assert len(videos.opencv(tmp_path / "data.mkv")) == 2


@pytest.mark.parametrize("second", [0.5, float("nan")])
def test_a_time_before_the_last_one_is_refused(tmp_path, videos, second):
    with VideoWriter(tmp_path / "data.mkv", 96, 64, 10.0) as writer:
        writer.add(videos.image(0), 1.0)
        with pytest.raises(ArrayError, match=r"image 1: its time .* is before 1\.0 s"):
            writer.add(videos.image(1), second)


def test_what_cannot_be_written_is_an_output_error(tmp_path, videos, full_disk):
    with pytest.raises(OutputError, match="needs at least one image"), VideoWriter(tmp_path / "data.mkv", 96, 64, 10):
        pass
    with pytest.raises(OutputError, match=r"nowhere/data\.mkv: cannot be written: No such file"):
        write(tmp_path / "nowhere" / "data.mkv", [videos.image(0)])
    noise = np.random.default_rng(0).integers(0, 256, (30, 64, 96, 3), dtype=np.uint8)
    with pytest.raises(OutputError, match="No space left"):
        write(full_disk, noise)


def test_a_writer_that_is_closed_also_by_an_exception_takes_no_images(tmp_path, videos):
    with pytest.raises(KeyError), VideoWriter(tmp_path / "data.mkv", 96, 64, 10.0) as writer:
        writer.add(videos.image(0))
        raise KeyError
    writer.close()
    with pytest.raises(OutputError, match="the video is closed"):
        writer.add(videos.image(1))
