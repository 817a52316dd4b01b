"""A folder of numbered PNG pictures with the interface of a video."""

import re
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image, UnidentifiedImageError

from sceneloom.arrays import UInt8Array
from sceneloom.errors import DataError

_NUMBERED = re.compile(r"(\d{8})\.png")
_EIGHT_BIT_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"}
"""Pillow's modes whose values are, or stand for, 8-bit colours; a 16-bit RGB file comes as `RGB` too."""


def picture_name(index: int) -> str:
    """File name of the picture with this number."""
    return f"{index:08d}.png"


class PngFolder:
    """The pictures `00000000.png`, `00000001.png`, … of a folder; decoded when asked for, none kept.

    Attributes:
        name: what messages call the folder.
        codec: "png".
        count: number of pictures.
        width, height: size of the first picture, and so of all [px].
        fps: None: the files have no times.

    Raises:
        DataError: the folder is missing or empty, a number is missing, or the first picture cannot be read.
    """

    codec = "png"
    fps: float | None = None

    def __init__(self, folder: Path) -> None:
        """List the folder and read the head of its first picture."""
        self.name = str(folder)
        self._folder = folder
        self.count = _count(folder)
        with self._open(0) as first:
            self.width, self.height = first.size

    def rgb(self, index: int) -> UInt8Array:
        """Decode one picture.

        Returns:
            (height, width, 3) uint8, red green blue; grey is repeated, transparency dropped.

        Raises:
            DataError: there is no such picture, or it is damaged, of another size, or of 16-bit grey.
        """
        if not 0 <= index < self.count:
            raise DataError(self.name, f"picture {index}", f"does not exist: the folder holds {self.count}")
        place = picture_name(index)
        with self._open(index) as image:
            if image.size != (self.width, self.height):
                size = "x".join(map(str, image.size))
                raise DataError(
                    self.name, place, f"is {size}; expected {self.width}x{self.height} as the first one"
                )
            if image.mode not in _EIGHT_BIT_MODES:
                raise DataError(
                    self.name, place, f"has pixels of type {image.mode!r}; expected 8-bit grey or colour"
                )
            try:
                return np.array(image.convert("RGB"), np.uint8)
            except (OSError, ValueError, SyntaxError) as error:
                raise DataError(self.name, place, f"cannot be decoded: {error}") from error

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _open(self, index: int) -> Image.Image:
        place = picture_name(index)
        try:
            return cast("Image.Image", Image.open(self._folder / place, formats=("PNG",)))
        except UnidentifiedImageError as error:
            raise DataError(self.name, place, "is no PNG picture") from error
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            raise DataError(self.name, place, f"cannot be read: {error}") from error


def _count(folder: Path) -> int:
    if not folder.is_dir():
        raise DataError(folder, "", "no such folder")
    matches = (_NUMBERED.fullmatch(entry.name) for entry in folder.iterdir())
    numbers = sorted(int(match[1]) for match in matches if match)
    if not numbers:
        raise DataError(folder, "", "holds no pictures; expected 00000000.png and so on")
    for expected, number in enumerate(numbers):
        if number != expected:
            raise DataError(
                folder, picture_name(expected), f"is missing; the next picture is {picture_name(number)}"
            )
    return len(numbers)
