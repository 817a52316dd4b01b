"""Whatever bytes a video or a PNG folder consists of, reading gives images or raises one of our errors."""

import io
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.malformed.damage import flipped, scattered

from sceneloom.errors import DataError, OptionError, OutputError, SceneloomError
from sceneloom.formats.recording.reader import PngFolder
from sceneloom.formats.video.reader import open_video
from sceneloom.formats.video.writer import VideoWriter, remux_to_mp4

COUNT = 12


def image(number: int) -> np.ndarray:
    """A bright bar that moves on with the number over a steady ramp."""
    rgb = np.empty((48, 64, 3), np.uint8)
    rgb[:] = np.linspace(20, 120, 64, dtype=np.uint8)[None, :, None]
    rgb[:, 5 * number : 5 * number + 5] = 250
    return rgb


def bar(rgb: np.ndarray) -> int:
    """Which number the bar stands for."""
    return int(rgb[24, :60].astype(int).sum(axis=1).reshape(12, 5).sum(axis=1).argmax())


def make(container: str, codec: str) -> bytes:
    file = io.BytesIO()
    with VideoWriter(file, 64, 48, 10.0, container=container, codec=codec) as writer:
        for number in range(COUNT):
            writer.add(image(number))
    return file.getvalue()


VIDEOS = {name: make(*name.split()) for name in ("matroska h264", "mp4 h264", "matroska ffv1")}


def read_all(content: bytes) -> dict[int, np.ndarray]:
    """All images that can be had, by number; anything but a DataError passes through and fails the test."""
    found: dict[int, np.ndarray] = {}
    problems: list[str] = []
    try:
        with open_video(content, name="cut") as reader:
            for index in (*range(reader.count), reader.count // 2, 0):
                with suppress(DataError):
                    found[index] = reader.rgb(index)
    except DataError as error:
        problems.append(str(error))
    assert all(problem.startswith("cut: ") for problem in problems)
    return found


@pytest.mark.parametrize("kind", VIDEOS)
def test_a_video_cut_anywhere_gives_its_first_images_or_an_error(kind):
    content = VIDEOS[kind]
    whole = read_all(content)
    assert [bar(whole[index]) for index in range(COUNT)] == list(range(COUNT))
    for cut in np.linspace(0, len(content) - 1, 60, dtype=int):
        for index, rgb in read_all(content[:cut]).items():
            assert bar(rgb) == index, f"cut at byte {cut}"


@pytest.mark.parametrize("kind", VIDEOS)
@pytest.mark.few(1)
def test_a_video_with_any_bytes_changed_gives_images_or_an_error_and_so_does_its_copy(kind):
    rng, content = np.random.default_rng(11), VIDEOS[kind]
    for k in range(200):  # anywhere, then in the head of the container
        damaged = scattered(content, rng, int(rng.integers(1, 6))) if k < 80 else flipped(content, k - 80, 1 << k % 8)
        for rgb in read_all(damaged).values():
            assert (rgb.dtype, rgb.ndim) == (np.uint8, 3)
        if k < 30:
            with suppress(DataError, OutputError, OptionError):
                remux_to_mp4(damaged, io.BytesIO())


def refused(content: bytes) -> set[int]:
    """The images that cannot be had, read in their order."""
    with open_video(content) as reader:
        return set(range(reader.count)) - set(read_all(content))


@pytest.mark.parametrize("kind", ["mp4 h264", "matroska ffv1"])
def test_a_decoder_that_works_ahead_refuses_the_same_images_as_one_that_does_not(kind, monkeypatch):
    rng = np.random.default_rng(15)
    head, found = 600, 0
    for _ in range(40):
        content = scattered(VIDEOS[kind], rng, 3, start=head)
        with suppress(DataError):
            monkeypatch.setattr("sceneloom.formats.video.reader.processors", lambda: 4)
            ahead = refused(content)
            monkeypatch.setattr("sceneloom.formats.video.reader.processors", lambda: 1)
            assert refused(content) == ahead
            found += len(ahead)
    assert found > 0


def test_a_png_folder_with_any_bytes_changed_gives_images_or_an_error(tmp_path: Path):
    path = tmp_path / "00000000.png"
    Image.fromarray(image(3)).save(path)
    content, rng = path.read_bytes(), np.random.default_rng(14)
    cut = [content[:stop] for stop in range(0, len(content), 7)]
    for damaged in (*cut, *(scattered(content, rng, 1) for _ in range(60))):
        path.write_bytes(damaged)
        try:
            found = str(PngFolder(tmp_path).rgb(0).shape[2])
        except SceneloomError as error:
            found = str(error)
        assert found == "3" or "00000000.png" in found
