"""Files of images: PNG and JPEG, each decoded when it is asked for."""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np
from PIL import Image, UnidentifiedImageError

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.encoded_images import open_image
from sceneloom.formats.files import read_bytes
from sceneloom.scene.cameras import CameraImage

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Endings of files that hold images."""

_FORMS = ("PNG", "JPEG")
_EIGHT_BIT_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "YCbCr", "CMYK"}
_FAULTS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError, EOFError, MemoryError)


def is_jpeg(path: Path) -> bool:
    """Whether a file's name says that it is a JPEG."""
    return path.suffix.lower() in {".jpg", ".jpeg"}


def open_image_file(path: Path) -> Image.Image:
    """Read the head of an image.

    Raises:
        DataError: it is no PNG and no JPEG, or cannot be read.
    """
    try:
        return open_image(path, _FORMS)
    except UnidentifiedImageError as error:
        raise DataError(path, "", "is no PNG and no JPEG image") from error
    except _FAULTS as error:
        raise DataError(path, "", f"cannot be read: {error}") from error


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a image [px], from its head."""
    with open_image_file(path) as image:
        width, height = image.size
    return width, height


@dataclass(frozen=True, slots=True)
class ImageFile:
    """One file; called, it gives the image.

    Attributes:
        path: the file.
        width, height: the size that it has to have [px].
    """

    path: Path
    width: int
    height: int

    def __call__(self) -> UInt8Array:
        """Decode the image.

        Returns:
            (height, width, 3) uint8, red green blue; grey is repeated, transparency dropped. A rotation that the file
            asks viewers for is not applied: calibrations are made for the sensor's pixels.

        Raises:
            DataError: it is damaged, of another size, or of more than 8 bits.
        """
        rgb = _decode_jpeg(self.path) if is_jpeg(self.path) else None
        if rgb is None:
            rgb = self._decode()
        self._check_size(rgb.shape[1], rgb.shape[0])
        return rgb

    def encoded(self) -> bytes:
        """The bytes of the file."""
        return read_bytes(self.path)

    def _decode(self) -> UInt8Array:
        with open_image_file(self.path) as image:
            self._check_size(*image.size)
            kind = _pixel_type(image)
            if kind not in _EIGHT_BIT_MODES:
                problem = f"has pixels of type {kind!r}; expected 8-bit grey or colour"
                raise DataError(self.path, "", problem)
            try:
                return np.array(image.convert("RGB"), np.uint8)
            except _FAULTS as error:
                raise DataError(self.path, "", f"cannot be decoded: {error}") from error

    def _check_size(self, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            problem = f"is {width}x{height}; expected {self.width}x{self.height} as the camera's first image"
            raise DataError(self.path, "", problem)


def _pixel_type(image: Image.Image) -> str:
    """The type of the pixels in the file: Pillow makes 8 bits of colours of 16 without a word."""
    stored = [str(arguments) for _, _, _, arguments in getattr(image, "tile", [])]
    return next((kind.rstrip("BLN") for kind in stored if ";16" in kind), image.mode)


def _decode_jpeg(path: Path) -> UInt8Array | None:
    """Decode a JPEG the quick trajectory; None where that decoder cannot, so that the other one says why."""
    from simplejpeg import decode_jpeg
    from simplejpeg import is_jpeg as begins_as_jpeg

    content = read_bytes(path)
    try:
        # a head of any size is claimed quickly: Pillow looks at it before anything is made
        if not begins_as_jpeg(content):
            return None
        image_size(path)
        return cast("UInt8Array", decode_jpeg(content, "RGB"))
    except (ValueError, RuntimeError, MemoryError):
        return None


@dataclass(frozen=True, slots=True, eq=False)
class ImageReader:
    """Makes the images of one camera from files.

    Attributes:
        files: of each image.
        names: of the files, seen from their root.
        timestamps_ns: (N,) int64 [ns].
        camera: the camera model of all.
    """

    files: tuple[Path, ...]
    names: tuple[str, ...]
    timestamps_ns: Int64Array
    camera: Camera

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        file = ImageFile(self.files[k], self.camera.width, self.camera.height)
        encoded = file.encoded if is_jpeg(file.path) else None
        extras = MappingProxyType({"file": self.names[k]})
        return CameraImage(int(self.timestamps_ns[k]), self.camera, file, extras=extras, encoded=encoded)
