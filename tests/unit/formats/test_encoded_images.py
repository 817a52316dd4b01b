"""Image files in memory: what is no image of the size that it should have is an error that says why."""

import io
import struct
import warnings

import numpy as np
import pytest
from PIL import Image

from sceneloom.errors import DataError
from sceneloom.formats.base.images import EncodedImage


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
