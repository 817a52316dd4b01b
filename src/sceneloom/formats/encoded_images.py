"""JPEG and PNG files in memory, decoded to red, green and blue."""

import io
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

import numpy as np

from sceneloom.arrays import UInt8Array
from sceneloom.errors import DataError
from sceneloom.formats.files import check_pixels, check_regular

if TYPE_CHECKING:
    from PIL import Image

_PNG_HEAD = struct.Struct(">8s4x4sIIBB")
_PNG_MARK = b"\x89PNG\r\n\x1a\n"
_SCAN_MARK = b"\xff\xda"
_MOST_SCANS = 100
"""Of a progressive image; encoders make some ten."""

_FAULTS = (OSError, ValueError, SyntaxError, EOFError, MemoryError, RuntimeError, struct.error)


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A JPEG or PNG file in memory; called, it gives the image.

    Attributes:
        content: the file.
        form: "jpeg" or "png".
        width, height: the size that it has to have [px].
        owner: what it belongs to, for messages.
        location: the field that holds it, for messages.
    """

    content: bytes
    form: str
    width: int
    height: int
    owner: str = "image"
    location: str = ""

    def __call__(self) -> UInt8Array:
        """Decode the image.

        Returns:
            (height, width, 3) uint8, red green blue; grey is repeated, transparency dropped.

        Raises:
            DataError: it is no such file, damaged, of another size, or of more than 8 bits.
        """
        width, height = image_size(self.content, self.form, owner=self.owner, location=self.location)
        if (width, height) != (self.width, self.height):
            problem = f"an image of {width}x{height}; expected {self.width}x{self.height}"
            raise DataError(self.owner, self.location, problem)
        try:
            return _DECODERS[self.form](self.content)
        except _FAULTS as error:
            problem = f"cannot be decoded as {self.form}: {error}"
            raise DataError(self.owner, self.location, problem) from error

    def encoded(self) -> bytes:
        """The file."""
        return self.content


def open_image(path: Path, formats: tuple[str, ...]) -> "Image.Image":
    """Open the file of an image and read its head; Pillow decodes it when its pixels are asked for.

    Args:
        path: the file.
        formats: what it may be, by Pillow's names.

    Raises:
        DataError: it has more pixels than `check_pixels` lets pass.
        OSError: it is no regular file, or none of such a format.
        ValueError, SyntaxError: Pillow cannot read its head.
    """
    from PIL import Image

    check_regular(path)
    try:
        image = Image.open(path, formats=formats)
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error
    try:
        check_pixels(path, "", *image.size)
    except DataError:
        image.close()
        raise
    return image


def image_size(content: bytes, form: str, *, owner: str = "image", location: str = "") -> tuple[int, int]:
    """Width and height of a file in memory [px], from its head.

    Args:
        form: "jpeg" or "png".
        owner: what it belongs to, for messages.
        location: the field that holds it, for messages.

    Raises:
        DataError: it is no such file, of more than 8 bits, or has more pixels than `check_pixels` lets pass.
    """
    try:
        width, height = _SIZES[form](content)
    except _FAULTS as error:
        raise DataError(owner, location, f"is no {form} file: {error}") from error
    check_pixels(owner, location, width, height)
    return width, height


def encode_png(rgb: UInt8Array) -> bytes:
    """Encode (height, width, 3) uint8, red green blue, without loss."""
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb)).save(content, "PNG", compress_level=1)
    return content.getvalue()


def _jpeg_size(content: bytes) -> tuple[int, int]:
    from simplejpeg import decode_jpeg_header

    height, width = decode_jpeg_header(content)[:2]
    return int(width), int(height)


def _png_size(content: bytes) -> tuple[int, int]:
    mark, chunk, width, height, bits, _ = _PNG_HEAD.unpack_from(content)
    if (mark, chunk) != (_PNG_MARK, b"IHDR"):
        raise ValueError("it begins otherwise")
    if bits > 8:
        raise ValueError(f"it has {bits} bits a value; expected 8 or less")
    return width, height


def _decode_jpeg(content: bytes) -> UInt8Array:
    from simplejpeg import decode_jpeg

    scans = content.count(_SCAN_MARK)
    if scans > _MOST_SCANS:
        raise ValueError(
            f"it has {scans} scans, each of which may paint the whole image; expected at most {_MOST_SCANS}"
        )
    return cast("UInt8Array", decode_jpeg(content, "RGB"))


def _decode_png(content: bytes) -> UInt8Array:
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            return np.array(image.convert("RGB"), np.uint8)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(str(error)) from error


_SIZES: Mapping[str, Callable[[bytes], tuple[int, int]]] = MappingProxyType(
    {"jpeg": _jpeg_size, "png": _png_size}
)
_DECODERS: Mapping[str, Callable[[bytes], UInt8Array]] = MappingProxyType(
    {"jpeg": _decode_jpeg, "png": _decode_png}
)
