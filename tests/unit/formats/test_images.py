"""Image files: depth images judged by OpenCV, what is no image of its size, and files without metadata."""

import io
import struct
import warnings

import cv2
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from sceneloom.errors import ArrayError, DataError, OutputError
from sceneloom.formats.base.images import EncodedImage, write_depth_image
from sceneloom.pipeline.redacting import _stripped

DEPTHS = np.random.default_rng(4).uniform(0.5, 120.0, (37, 51)).astype(np.float32)
DEPTHS[::3] = 0.0


def test_opencv_reads_the_png_as_metres_times_256_and_depths_beyond_16_bits_become_nothing_and_are_counted(tmp_path):
    beyond = np.array([[255.99, 255.9961, 256.0, 1000.0, np.inf, 0.0, 0.001]], np.float32)
    counts = [write_depth_image(depths, tmp_path / f"{k}.png") for k, depths in enumerate((DEPTHS, beyond))]
    read, extremes = (cv2.imread(str(tmp_path / f"{k}.png"), cv2.IMREAD_UNCHANGED) for k in range(2))
    assert (counts, read.dtype, read.shape) == ([0, 3], np.uint16, DEPTHS.shape)
    # Half a step of 1/256 m: the values are rounded.
    assert np.abs(read / 256.0 - DEPTHS).max() <= 0.5 / 256
    assert np.array_equal(read == 0, DEPTHS == 0)
    assert extremes.tolist() == [[65533, 65535, 0, 0, 0, 0, 1]]


def test_npz_holds_the_depths_bit_by_bit_and_a_confidence_of_the_same_size_only(tmp_path):
    depths, confidence = DEPTHS.copy(), (DEPTHS > 0).astype(np.float32)
    depths[1, 1] = np.inf
    write_depth_image(depths, tmp_path / "d.npz")
    write_depth_image(depths, tmp_path / "e.npz", confidence=confidence)
    with np.load(tmp_path / "d.npz") as file, np.load(tmp_path / "e.npz") as both:
        assert (file.files, file["depth"].dtype, file["depth"].tobytes()) == (["depth"], np.float32, depths.tobytes())
        np.testing.assert_array_equal(both["confidence"], confidence)
    with pytest.raises(ArrayError, match="confidence"):
        write_depth_image(depths, tmp_path / "f.npz", confidence=confidence[1:])


@pytest.mark.parametrize("name", ["d.png", "d.npz"])
def test_what_is_no_depth_image_is_refused_and_files_are_replaced_only_on_request(tmp_path, name):
    for depths, message in (
        (np.array([[1.0, np.nan]], np.float32), r"depth_image\[0, 1\]: nan"),
        (np.array([[1.0], [-2.0]], np.float32), r"depth_image\[1, 0\]: -2.0"),
        (np.zeros((0, 5), np.float32), "at least one pixel"),
        (np.zeros((4, 5)), "float32"),
    ):
        with pytest.raises(ArrayError, match=message):
            write_depth_image(depths, tmp_path / name)
    assert not list(tmp_path.iterdir())
    (tmp_path / name).write_bytes(b"kept")
    with pytest.raises(OutputError, match="exists already"):
        write_depth_image(DEPTHS, tmp_path / name)
    assert (tmp_path / name).read_bytes() == b"kept"
    write_depth_image(DEPTHS, tmp_path / name, overwrite=True)
    assert (tmp_path / name).read_bytes() != b"kept"
    with pytest.raises(OutputError, match="missing"):
        write_depth_image(DEPTHS, tmp_path / "missing" / name)


def encoded(form, rgb=None, **options):
    file = io.BytesIO()
    (Image.new("RGB", (64, 48), (9, 9, 9)) if rgb is None else Image.fromarray(rgb)).save(file, form, **options)
    return file.getvalue()


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_of_some_scans_is_decoded_and_one_of_very_many_refused(progressive):
    content = encoded("JPEG", progressive=progressive)
    assert np.ptp(EncodedImage(content, "jpeg", 64, 48)()) == 0
    last = content.rindex(b"\xff\xda")
    many = content[:-2] + content[last:-2] * 200 + content[-2:]
    with pytest.raises(DataError, match="scans, each of which may paint the whole image; expected at most 100"):
        EncodedImage(many, "jpeg", 64, 48)()


@pytest.mark.parametrize("side", [60_000, 10_000])
def test_a_png_whose_head_declares_very_many_pixels_is_an_error_even_where_so_many_are_expected(side):
    content = encoded("PNG")
    content = content[:16] + struct.pack(">II", side, side) + content[24:]
    with pytest.raises(DataError, match=r"expected 64x48|expected 134217728 pixels at most"):
        EncodedImage(content, "png", 64, 48)()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataError, match=r"cannot be decoded as png|pixels at most"):
            EncodedImage(content, "png", side, side)()


PIXELS = np.random.default_rng(0).integers(0, 256, (40, 56, 3), np.uint8)
SECRET = b"49.011 N, taken by Ann"


def jpeg(**options):
    exif = Image.Exif()
    exif[0x010E] = SECRET.decode()
    return encoded("JPEG", PIXELS, exif=exif, comment=SECRET, **options)


def pixels(content):
    with Image.open(io.BytesIO(content)) as image:
        image.load()
        return np.array(image), dict(image.getexif()), image.info


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 2}])
def test_a_jpeg_loses_its_locations_and_comments_and_neither_pixel_nor_profile_of_colours(options):
    profile = b"a profile" * 20
    content = jpeg(icc_profile=profile, **options) + jpeg()
    bare, left_out = _stripped(content)
    assert SECRET in content
    assert SECRET not in bare
    assert {"APP1", "COM", "after the end"} <= set(left_out)
    before, after = pixels(content), pixels(bare)
    assert np.array_equal(before[0], after[0])
    assert (after[1], after[2]["icc_profile"]) == ({}, profile)


def test_a_png_loses_its_texts_and_no_pixel_and_other_files_are_refused_or_cut():
    text = PngImagePlugin.PngInfo()
    text.add_text("location", SECRET.decode())
    bare, left_out = _stripped(encoded("PNG", PIXELS, pnginfo=text) + SECRET)
    assert SECRET not in bare
    assert set(left_out) == {"tEXt", "after the end"}
    assert np.array_equal(pixels(bare)[0], PIXELS)
    for content, problem in ((b"GIF89a", "neither JPEG nor PNG"), (jpeg()[:10], "ends within a segment")):
        with pytest.raises(DataError, match=problem):
            _stripped(content)
    broken = jpeg()[:-30]
    assert _stripped(broken)[0].endswith(broken[-20:])
