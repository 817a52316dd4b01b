"""A folder of numbered PNG images with the interface of a video."""

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from sceneloom.arrays import AnyArray, UInt8Array, UInt16Array
from sceneloom.errors import DataError
from sceneloom.formats.encoded_images import open_image

_NUMBERED = re.compile(r"(\d{8})\.png")
_EIGHT_BIT_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"}
"""Pillow's modes whose values are, or stand for, 8-bit colours; a 16-bit RGB file comes as `RGB` too."""

_STEPS = frozenset({"I", "I;16", "I;16B", "I;16L"})
"""Its modes for 16-bit grey; PNG has no wider grey."""


def image_name(index: int) -> str:
    """File name of the image with this number."""
    return f"{index:08d}.png"


class PngFolder:
    """The images `00000000.png`, `00000001.png`, … of a folder; decoded when asked for, none kept.

    Attributes:
        name: what messages call the folder.
        codec: "png".
        count: number of images.
        width, height: size of the first image, and so of all [px].
        fps: None: the files have no times.
        has_steps: whether the first image, and so all, are 16-bit grey, as depths are kept.

    Raises:
        DataError: the folder is missing or empty, a number is missing, or the first image cannot be read.
    """

    codec = "png"
    fps: float | None = None

    def __init__(self, folder: Path) -> None:
        """List the folder and read the head of its first image."""
        self.name = str(folder)
        self._folder = folder
        self.count = _count(folder)
        with self._open(0) as first:
            self.width, self.height = first.size
            self.has_steps = first.mode in _STEPS

    def rgb(self, index: int) -> UInt8Array:
        """Decode one image.

        Returns:
            (height, width, 3) uint8, red green blue; grey is repeated, transparency dropped.

        Raises:
            DataError: there is no such image, or it is damaged, of another size, or of 16-bit grey.
        """
        with self._checked(index, _EIGHT_BIT_MODES, "8-bit grey or colour") as image:
            return self._decoded(image, "RGB", np.uint8, index)

    def steps(self, index: int) -> UInt16Array:
        """Decode one image of 16-bit grey.

        Returns:
            (height, width) uint16, as they are stored.

        Raises:
            DataError: there is no such image, or it is damaged, of another size, or not of 16-bit grey.
        """
        with self._checked(index, _STEPS, "16-bit grey") as image:
            return self._decoded(image, "I", np.uint16, index)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _checked(self, index: int, modes: Collection[str], expected: str) -> Image.Image:
        if not 0 <= index < self.count:
            raise DataError(self.name, f"image {index}", f"does not exist: the folder holds {self.count}")
        location, image = image_name(index), self._open(index)
        if image.size != (self.width, self.height):
            size = "x".join(map(str, image.size))
            problem = f"is {size}; expected {self.width}x{self.height} as the first one"
        elif image.mode not in modes:
            problem = f"has pixels of type {image.mode!r}; expected {expected}"
        else:
            return image
        image.close()
        raise DataError(self.name, location, problem)

    def _decoded(self, image: Image.Image, mode: str, dtype: type[np.generic], index: int) -> AnyArray:
        try:
            return np.array(image.convert(mode)).astype(dtype)
        except (OSError, ValueError, SyntaxError) as error:
            raise DataError(self.name, image_name(index), f"cannot be decoded: {error}") from error

    def _open(self, index: int) -> Image.Image:
        location = image_name(index)
        try:
            return open_image(self._folder / location, ("PNG",))
        except UnidentifiedImageError as error:
            raise DataError(self.name, location, "is no PNG image") from error
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise DataError(self.name, location, f"cannot be read: {error}") from error


def _count(folder: Path) -> int:
    if not folder.is_dir():
        raise DataError(folder, "", "no such folder")
    matches = (_NUMBERED.fullmatch(entry.name) for entry in folder.iterdir())
    numbers = sorted(int(match[1]) for match in matches if match)
    if not numbers:
        raise DataError(folder, "", "holds no images; expected 00000000.png and so on")
    for expected, number in enumerate(numbers):
        if number != expected:
            raise DataError(
                folder, image_name(expected), f"is missing; the next image is {image_name(number)}"
            )
    return len(numbers)
