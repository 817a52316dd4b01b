"""Folders of numbered PNG images are read like videos."""

import re

import cv2
import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError
from sceneloom.formats.recording.cameras import PngFolder


@pytest.fixture
def folder(tmp_path, videos):
    for number in range(3):
        rgb = videos.image(number, 31, 17)
        cv2.imwrite(str(tmp_path / f"{number:08d}.png"), rgb[:, :, ::-1])
    return tmp_path


def test_images_are_those_that_were_put_in(folder, videos):
    (folder / "notes.txt").write_text("not an image")
    (folder / "3.png").write_bytes(b"a name of another kind")
    images = PngFolder(folder)
    assert (images.count, images.width, images.height, images.codec) == (3, 31, 17, "png")
    for number in (2, 0, 1):
        np.testing.assert_array_equal(images.rgb(number), videos.image(number, 31, 17))


def test_grey_is_repeated_and_transparency_dropped(tmp_path):
    rng = np.random.default_rng(0)
    grey, rgba = rng.integers(0, 256, (5, 7), np.uint8), rng.integers(0, 256, (5, 7, 4), np.uint8)
    Image.fromarray(grey).save(tmp_path / "00000000.png")
    Image.fromarray(rgba).save(tmp_path / "00000001.png")
    Image.fromarray(grey > 128).save(tmp_path / "00000002.png")
    Image.fromarray(grey).convert("P").save(tmp_path / "00000003.png")
    images = PngFolder(tmp_path)
    np.testing.assert_array_equal(images.rgb(0), np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(images.rgb(1), rgba[:, :, :3])
    np.testing.assert_array_equal(images.rgb(2)[:, :, 1], np.where(grey > 128, 255, 0))
    np.testing.assert_array_equal(images.rgb(3)[:, :, 2], grey)


def test_sixteen_bit_colours_keep_their_upper_eight_bits(tmp_path):
    values = np.random.default_rng(0).integers(0, 65536, (5, 7, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "00000000.png"), values[:, :, ::-1])
    np.testing.assert_array_equal(PngFolder(tmp_path).rgb(0), values >> 8)


def test_sixteen_bit_grey_is_refused_since_it_may_be_depth(tmp_path):
    cv2.imwrite(str(tmp_path / "00000000.png"), np.full((5, 7), 4000, np.uint16))
    with pytest.raises(DataError, match=r"00000000.png: has pixels of type .*expected 8-bit"):
        PngFolder(tmp_path).rgb(0)


def test_a_missing_number_is_named_with_the_one_after(folder):
    (folder / "00000001.png").unlink()
    with pytest.raises(DataError, match=r"00000001.png: is missing; the next image is 00000002.png"):
        PngFolder(folder)


def test_a_folder_that_is_empty_or_not_there_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"holds no images; expected 00000000\.png"):
        PngFolder(tmp_path)
    with pytest.raises(DataError, match=re.escape(f"{tmp_path / 'frames1'}: no such folder")):
        PngFolder(tmp_path / "frames1")


def test_an_image_of_another_size_is_refused(folder):
    Image.new("RGB", (30, 17)).save(folder / "00000001.png")
    with pytest.raises(DataError, match=r"00000001\.png: is 30x17; expected 31x17"):
        PngFolder(folder).rgb(1)


@pytest.mark.parametrize("index", [-1, 3])
def test_an_image_beyond_the_last_is_refused(folder, index):
    with pytest.raises(DataError, match=f"image {index}: does not exist: the folder holds 3"):
        PngFolder(folder).rgb(index)


@pytest.mark.parametrize("damage", ["cut", "other"])
def test_a_damaged_image_is_named(folder, damage):
    path = folder / "00000001.png"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2] if damage == "cut" else b"GIF89a, not a PNG")
    with pytest.raises(DataError, match=r"00000001\.png"):
        PngFolder(folder).rgb(1)


def test_closing_keeps_nothing_from_being_read_again(folder):
    images = PngFolder(folder)
    images.close()
    assert images.rgb(0).shape == (17, 31, 3)
