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


def test_what_is_no_folder_of_images_is_refused(folder, tmp_path):
    with pytest.raises(DataError, match=re.escape(f"{tmp_path / 'frames1'}: no such folder")):
        PngFolder(tmp_path / "frames1")
    (folder / "00000001.png").unlink()
    with pytest.raises(DataError, match=r"00000001.png: is missing; the next image is 00000002.png"):
        PngFolder(folder)
    for number in (0, 2):
        (folder / f"{number:08d}.png").unlink()
    with pytest.raises(DataError, match=r"holds no images; expected 00000000\.png"):
        PngFolder(folder)


@pytest.mark.parametrize(
    ("image", "problem"),
    [
        (np.zeros((17, 30, 3), np.uint8), r"00000001\.png: is 30x17; expected 31x17"),
        # grey of 16 bits may be depth
        (np.full((17, 31), 4000, np.uint16), r"00000001.png: has pixels of type .*expected 8-bit"),
        (None, r"00000001\.png"),
        (b"GIF89a, not a PNG", r"00000001\.png"),
    ],
)
def test_an_image_that_is_damaged_or_of_another_kind_is_refused(folder, image, problem):
    path = folder / "00000001.png"
    if isinstance(image, np.ndarray):
        cv2.imwrite(str(path), image)
    else:
        path.write_bytes(image or path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match=problem):
        PngFolder(folder).rgb(1)
