"""Image files: depth images judged by OpenCV, what is no image of its size, and files without metadata."""

import io
import struct
import warnings

import cv2
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from sceneloom.errors import ArrayError, DataError, OutputError
from sceneloom.formats.base.images import (
    EncodedImage,
    without_metadata,
    write_confidence_png,
    write_depth_npz,
    write_depth_png,
)

DEPTHS = np.random.default_rng(4).uniform(0.5, 120.0, (37, 51)).astype(np.float32)
DEPTHS[::3] = 0.0


def as_opencv_reads(path):
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_opencv_reads_the_png_as_metres_times_256(tmp_path):
    assert write_depth_png(DEPTHS, tmp_path / "d.png") == 0
    read = as_opencv_reads(tmp_path / "d.png")
    assert (read.dtype, read.shape) == (np.uint16, DEPTHS.shape)
    # Half a step of 1/256 m: the values are rounded.
    assert np.abs(read / 256.0 - DEPTHS).max() <= 0.5 / 256
    assert np.array_equal(read == 0, DEPTHS == 0)


def test_depths_beyond_16_bits_become_nothing_and_are_counted_and_those_below_the_first_step_do_not(tmp_path):
    depths = np.array([[255.99, 255.9961, 256.0, 1000.0, np.inf, 0.0, 0.001]], np.float32)
    assert write_depth_png(depths, tmp_path / "d.png") == 3
    assert as_opencv_reads(tmp_path / "d.png").tolist() == [[65533, 65535, 0, 0, 0, 0, 1]]


def test_npz_holds_the_depths_bit_by_bit_and_a_confidence_of_the_same_size_only(tmp_path):
    depths, confidence = DEPTHS.copy(), (DEPTHS > 0).astype(np.float32)
    depths[1, 1] = np.inf
    write_depth_npz(depths, tmp_path / "d.npz")
    write_depth_npz(depths, tmp_path / "e.npz", confidence=confidence)
    with np.load(tmp_path / "d.npz") as file, np.load(tmp_path / "e.npz") as both:
        assert file.files == ["depth"]
        assert file["depth"].dtype == np.float32
        assert file["depth"].tobytes() == depths.tobytes()
        np.testing.assert_array_equal(both["confidence"], confidence)
    with pytest.raises(ArrayError, match="confidence"):
        write_depth_npz(depths, tmp_path / "f.npz", confidence=confidence[1:])


@pytest.mark.parametrize("write", [write_depth_png, write_depth_npz])
@pytest.mark.parametrize(
    ("depths", "message"),
    [
        (np.array([[1.0, np.nan]], np.float32), r"depth_image\[0, 1\]: nan"),
        (np.array([[1.0], [-2.0]], np.float32), r"depth_image\[1, 0\]: -2.0"),
        (np.zeros((0, 5), np.float32), "at least one pixel"),
        (np.zeros((4, 5)), "float32"),
    ],
)
def test_what_is_no_depth_image_is_refused(tmp_path, write, depths, message):
    with pytest.raises(ArrayError, match=message):
        write(depths, tmp_path / "file")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("write", [write_depth_png, write_depth_npz])
def test_existing_files_are_replaced_only_on_request_and_a_missing_folder_is_named(tmp_path, write):
    target = tmp_path / "file"
    target.write_bytes(b"kept")
    with pytest.raises(OutputError, match="exists already"):
        write(DEPTHS, target)
    assert target.read_bytes() == b"kept"
    write(DEPTHS, target, overwrite=True)
    assert target.read_bytes() != b"kept"
    with pytest.raises(OutputError, match="missing"):
        write(DEPTHS, tmp_path / "missing" / "d")


def test_opencv_reads_confidences_as_255_for_one_and_others_are_refused(tmp_path):
    confidence = np.array([[0.0, 0.5, 1.0], [0.25, 0.999, 0.001]], np.float32)
    for wrong in (np.nan, -0.1, 1.1):
        with pytest.raises(ArrayError, match="from 0 to 1"):
            write_confidence_png(np.full((2, 2), wrong, np.float32), tmp_path / "c.png")
    assert not list(tmp_path.iterdir())
    write_confidence_png(confidence, tmp_path / "c.png")
    read = as_opencv_reads(tmp_path / "c.png")
    assert read.dtype == np.uint8
    np.testing.assert_array_equal(read, [[0, 128, 255], [64, 255, 0]])


def encoded(form, size=(64, 48), **options):
    file = io.BytesIO()
    Image.new("RGB", size, (9, 9, 9)).save(file, form, **options)
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
    content, exif = io.BytesIO(), Image.Exif()
    exif[0x010E] = SECRET.decode()
    Image.fromarray(PIXELS).save(content, "JPEG", exif=exif, comment=SECRET, **options)
    return content.getvalue()


def pixels(content):
    with Image.open(io.BytesIO(content)) as image:
        image.load()
        return np.array(image), dict(image.getexif()), image.info


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 2}])
def test_a_jpeg_loses_its_locations_and_comments_and_neither_pixel_nor_profile_of_colours(options):
    profile = b"a profile" * 20
    content = jpeg(icc_profile=profile, **options) + jpeg()
    bare, left_out = without_metadata(content)
    assert SECRET in content
    assert SECRET not in bare
    assert {"APP1", "COM", "after the end"} <= set(left_out)
    before, after = pixels(content), pixels(bare)
    assert np.array_equal(before[0], after[0])
    assert (after[1], after[2]["icc_profile"]) == ({}, profile)


def test_a_png_loses_its_texts_and_no_pixel():
    text = PngImagePlugin.PngInfo()
    text.add_text("location", SECRET.decode())
    file = io.BytesIO()
    Image.fromarray(PIXELS).save(file, "PNG", pnginfo=text)
    content = file.getvalue() + SECRET
    bare, left_out = without_metadata(content)
    assert SECRET not in bare
    assert set(left_out) == {"tEXt", "after the end"}
    assert np.array_equal(pixels(bare)[0], PIXELS)


def test_files_of_another_kind_and_files_that_break_off_are_refused_or_cut():
    with pytest.raises(DataError, match="neither JPEG nor PNG"):
        without_metadata(b"GIF89a")
    with pytest.raises(DataError, match="ends within a segment"):
        without_metadata(jpeg()[:10])
    broken = jpeg()[:-30]
    assert without_metadata(broken)[0].endswith(broken[-20:])
