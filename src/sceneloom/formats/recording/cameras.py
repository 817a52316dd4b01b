"""The cameras and depth cameras of a recording: intrinsics, extrinsics, images, poses and time offsets."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Int64Array, UInt8Array, UInt16Array
from sceneloom.errors import DataError
from sceneloom.formats.base.images import open_image
from sceneloom.formats.video.reader import VideoReader

if TYPE_CHECKING:
    from PIL import Image

_NUMBERED = re.compile(r"(\d{8})\.png")

_EIGHT_BIT_MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"})
"""Pillow's modes whose values are, or stand for, 8-bit colours; a 16-bit RGB file comes as `RGB` too."""

_STEPS = frozenset({"I", "I;16", "I;16B", "I;16L"})  # its modes for 16-bit grey; PNG has no wider grey

_DAMAGE = (OSError, ValueError, SyntaxError)  # what Pillow raises for files that are damaged


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
        self.name, self._folder = str(folder), folder
        if not folder.is_dir():
            raise DataError(folder, "", "no such folder")
        matches = (_NUMBERED.fullmatch(entry.name) for entry in folder.iterdir())
        numbers = sorted(int(match[1]) for match in matches if match)
        if not numbers:
            raise DataError(folder, "", "holds no images; expected 00000000.png and so on")
        for expected, number in enumerate(numbers):
            if number != expected:
                raise DataError(folder, image_name(expected), f"is missing; the next image is {image_name(number)}")
        self.count = len(numbers)
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
        return self._decoded(index, "RGB", _EIGHT_BIT_MODES, "8-bit grey or colour").astype(np.uint8, copy=False)

    def steps(self, index: int) -> UInt16Array:
        """Decode one image of 16-bit grey.

        Returns:
            (height, width) uint16, as they are stored.

        Raises:
            DataError: there is no such image, or it is damaged, of another size, or not of 16-bit grey.
        """
        return self._decoded(index, "I", _STEPS, "16-bit grey").astype(np.uint16)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _decoded(self, index: int, mode: str, modes: Collection[str], expected: str) -> AnyArray:
        if not 0 <= index < self.count:
            raise DataError(self.name, f"image {index}", f"does not exist: the folder holds {self.count}")
        with self._open(index) as image:
            if image.size != (self.width, self.height):
                size = "x".join(map(str, image.size))
                problem = f"is {size}; expected {self.width}x{self.height} as the first one"
            elif image.mode not in modes:
                problem = f"has pixels of type {image.mode!r}; expected {expected}"
            else:
                try:
                    return np.array(image.convert(mode))
                except _DAMAGE as error:
                    raise DataError(self.name, image_name(index), f"cannot be decoded: {error}") from error
        raise DataError(self.name, image_name(index), problem)

    def _open(self, index: int) -> "Image.Image":
        from PIL import UnidentifiedImageError

        location = image_name(index)
        try:
            return open_image(self._folder / location, ("PNG",))
        except UnidentifiedImageError as error:
            raise DataError(self.name, location, "is no PNG image") from error
        except _DAMAGE as error:
            raise DataError(self.name, location, f"cannot be read: {error}") from error


ImageFiles = VideoReader | PngFolder


ALIGNMENTS: Mapping[str, str] = MappingProxyType(
    {
        "auto": "as many images as numbers or as lines decide",
        "number": "`number` is the image's index, from 0",
        "first": "the image's index is `number` less the first `number`",
        "line": "each frames line means the next image",
    }
)
"""Ways to report which image of a video a `frames` line means."""


@dataclass(frozen=True, slots=True, eq=False)
class _ImageChoice:
    """Which image each `frames` line means, -1 for none; and whether lines were counted although numbers have gaps."""

    indices: Int64Array
    problem: str | None = None
    by_line: bool = False


def choose_images(
    numbers: Int64Array, image_count: int, *, alignment: str = "auto", cut_off: bool = False
) -> _ImageChoice:
    """Match `frames` lines with images.

    A line's image is `number` minus the first number where the images are as many as the numbers span; else
    images and lines are counted in parallel, if they are equally many. A number that stands in several lines means
    one image, unless images and lines are equally many. Lines that do not fit still get the images that their
    numbers mean, as far as there are any.

    Args:
        numbers: (N,) int64, `number` of all frames lines, in the order of the file.
        image_count: how many images there are.
        alignment: a key of `ALIGNMENTS`; any but "auto" decides, whatever the counts state.
        cut_off: whether images are missing because the video is cut off, which the problem then names.
    """
    count = len(numbers)
    if count == 0:
        problem = f"{image_count} images, but data.jsonl has no frames line" if image_count else None
        return _ImageChoice(numbers, problem)
    if alignment != "auto":
        return _aligned(numbers, image_count, alignment)
    first, last = int(numbers.min()), int(numbers.max())
    span, distinct = last - first + 1, len(np.unique(numbers)) == count
    if image_count == span and (distinct or image_count != count):
        return _ImageChoice(numbers - first)
    if image_count == count:
        ranks = np.argsort(np.argsort(numbers, kind="stable"))
        return _ImageChoice(ranks if distinct else np.arange(count), by_line=True)
    used = "first" if distinct else "line"
    indices = numbers - first if distinct else np.arange(count)
    others = " or ".join(
        f"--image-index {name} ({meaning})"
        for name, meaning in ALIGNMENTS.items()
        if name not in {"auto", used} and not (name == "number" and first == 0 and distinct)
    )
    problem = (
        f"{image_count} images, but data.jsonl has {count} frames lines with numbers from {first} to {last}; "
        f"expected {count} images" + (f" or {span}" if span != count else "")
    )
    problem += (
        f". The video is cut off: lines beyond its end have no image (--image-index {used}: {ALIGNMENTS[used]})"
        if cut_off
        else f". Which image a line means is open: a lenient reading takes --image-index {used} "
        f"({ALIGNMENTS[used]}); there is {others}"
    )
    return _ImageChoice(np.where(indices < image_count, indices, -1), problem)


def _aligned(numbers: Int64Array, image_count: int, alignment: str) -> _ImageChoice:
    """The images that lines mean by a given rule; lines that mean none are a problem."""
    by_rule = {"number": numbers, "first": numbers - numbers.min(), "line": np.arange(len(numbers), dtype=np.int64)}
    indices = by_rule[alignment]
    outside = (indices < 0) | (indices >= image_count)
    problem = None
    if outside.any():
        worst = int(indices[outside][0])
        problem = (
            f"{int(outside.sum())} of {len(numbers)} frames lines mean images that are not there, by --image-index "
            f"{alignment} ({ALIGNMENTS[alignment]}): the first image {worst}, while there are {image_count}"
        )
    return _ImageChoice(np.where(outside, -1, indices), problem)


class FrameNotes(msgspec.Struct):
    """What is kept of the `frames` lines of a recording.

    Attributes:
        count: how many there are.
        first: `number` of the first one, where each has one more than the one before in the order of time; else None.
        own: whether images share lines, or lines have times, in another way than images of their times would.
        texts: lines that lack the image of a camera, in the order of time.
    """

    count: int
    first: int | None = None
    own: bool = False
    texts: list[str] = []


OWN_FIELDS = frozenset({"file_seconds", "number", "line_seconds", "line", "entry"})
"""Extras of an image that are no fields of its entry; fields of these names are under "entry"."""

CAMERA_SHIFTS: Mapping[str, int] = {"ignore": 0, "apply": 1, "subtract": -1}
"""What becomes of `imuToCameraShiftSeconds`: by how many times it is added to the times of images.

The description of the format has no such field. "apply": t_imu = t_camera + shift (ASSUMED). "subtract": the sense in
which the open part of the vendor's software takes it.

Source: `imuToCameraShiftSeconds` in `codegen/parameter_definitions.c` and `src/odometry/sample_sync.cpp` of HybVIO.
"""
