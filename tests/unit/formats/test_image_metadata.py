"""Files of images without what they state besides the image, judged by Pillow."""

import io

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from sceneloom.errors import DataError
from sceneloom.formats.base.images import without_metadata

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
def test_a_jpeg_loses_its_locations_and_comments_and_no_pixel(options):
    content = jpeg(**options) + jpeg()
    bare, left_out = without_metadata(content)
    assert SECRET in content
    assert SECRET not in bare
    assert {"APP1", "COM", "after the end"} <= set(left_out)
    before, after = pixels(content), pixels(bare)
    assert np.array_equal(before[0], after[0])
    assert after[1] == {}


def test_a_jpeg_keeps_the_profile_of_its_colours():
    content = jpeg(icc_profile=b"a profile" * 20)
    assert pixels(without_metadata(content)[0])[2]["icc_profile"] == b"a profile" * 20


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
