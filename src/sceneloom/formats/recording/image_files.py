"""Where a recording keeps the images of each camera, and which of them each `frames` line means."""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from sceneloom.arrays import Int64Array
from sceneloom.errors import DataError
from sceneloom.formats.ledger import Ledger
from sceneloom.formats.video.png_folder import PngFolder
from sceneloom.formats.video.reader import VideoReader, open_video

VIDEO_SUFFIXES = ("mkv", "mp4", "mov", "avi", "ts")
"""Endings of `data`, `data2`, … that are looked for, in this order."""

_STATIC = {".ts", ".avi"}
"""Endings of videos that do not state where they end."""

_IMAGES = re.compile(
    rf"data(?P<video>|[2-9]|[1-9]\d+)\.(?:{'|'.join(VIDEO_SUFFIXES)})|frames(?P<folder>[1-9]\d*)"
)

ImageFiles = VideoReader | PngFolder


class OpenImages:
    """The images that a scene holds open, to be closed together."""

    def __init__(self) -> None:
        self._files: list[ImageFiles] = []

    def add(self, files: ImageFiles) -> None:
        """Have one more closed."""
        self._files.append(files)

    def close(self) -> None:
        """Close them all."""
        for files in self._files:
            files.close()


def find_images(folder: Path, camera_index: int, ledger: Ledger) -> Path | None:
    """Find the video, or the folder of PNG images, of a camera; None where there is neither.

    Raises:
        DataError: there is more than one.
    """
    number = "" if camera_index == 0 else str(camera_index + 1)
    names = [*(f"data{number}.{suffix}" for suffix in VIDEO_SUFFIXES), f"frames{camera_index + 1}"]
    found = [folder / name for name in names if (folder / name).exists()]
    if len(found) > 1:
        listed = ", ".join(path.name for path in found)
        ledger.fault(
            "repeated-videos", DataError(folder, "", f"{listed} for camera {camera_index}; expected one")
        )
    return found[0] if found else None


def unused_images(folder: Path, camera_indices: Collection[int]) -> list[Path]:
    """Find videos and image folders of other cameras than these."""
    used = {"" if index == 0 else str(index + 1) for index in camera_indices}
    used_folders = {str(index + 1) for index in camera_indices}
    found = []
    for path in sorted(folder.iterdir()):
        match = _IMAGES.fullmatch(path.name)
        if match and (match["folder"] not in used_folders if match["folder"] else match["video"] not in used):
            found.append(path)
    return found


def expected_names(camera_index: int) -> str:
    """Name the files that could hold a camera's images, for messages."""
    number = "" if camera_index == 0 else str(camera_index + 1)
    return f"data{number}.{{{','.join(VIDEO_SUFFIXES)}}} or frames{camera_index + 1}/00000000.png"


def other_videos(folder: Path) -> str:
    """Name what looks like a video, but has no name of one of a recording's; "" where there is none."""
    found = [
        path.name
        for path in sorted(folder.iterdir())
        if path.suffix.lower().removeprefix(".") in VIDEO_SUFFIXES and not _IMAGES.fullmatch(path.name)
    ]
    return f"; in the folder there is {', '.join(found)}" if found else ""


def open_images(path: Path, ledger: Ledger) -> ImageFiles:
    """Open a video or a folder of PNG images; a lenient reading takes what is left of a video that is cut off.

    Raises:
        DataError: it cannot be read, or no image of it is left.
    """
    if path.is_dir():
        return PngFolder(path)
    video = open_video(path)
    try:
        video.index  # noqa: B018 - the walk through the packets finds out whether it is whole
    except DataError as error:
        video.close()
        return _what_is_left(path, error, ledger)
    return video


def maybe_cut_off(files: ImageFiles, wanted: int) -> bool:
    """Whether a video that lacks images may have been cut off: its container does not state where it ends."""
    return isinstance(files, VideoReader) and files.count < wanted and Path(files.name).suffix in _STATIC


def _what_is_left(path: Path, error: DataError, ledger: Ledger) -> VideoReader:
    if not ledger.lenient:
        raise error
    video = open_video(path, cut_off=True)
    try:
        count = video.count
    except DataError:
        count = 0
    if count == 0:
        video.close()
        raise error
    reported = DataError(error.file, error.location, f"{error.problem}; its first {count} images are read")
    ledger.fault("unreadable-videos", reported)
    return video


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
class ImageChoice:
    """Which image each `frames` line means.

    Attributes:
        indices: (N,) int64, index among the images, -1 for none.
        problem: why lines and images do not fit together, or None.
        by_line: whether the images were counted line by line although the numbers have gaps.
    """

    indices: Int64Array
    problem: str | None = None
    by_line: bool = False


def choose_images(
    numbers: Int64Array, image_count: int, *, alignment: str = "auto", cut_off: bool = False
) -> ImageChoice:
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
        return ImageChoice(numbers, problem)
    if alignment != "auto":
        return _aligned(numbers, image_count, alignment)
    ranks = np.argsort(np.argsort(numbers, kind="stable"))
    first, last = int(numbers.min()), int(numbers.max())
    distinct = len(np.unique(numbers)) == count
    if distinct and image_count == last - first + 1:
        return ImageChoice(numbers - first)
    if image_count == count:
        return ImageChoice(ranks if distinct else np.arange(count), by_line=True)
    if image_count == last - first + 1:
        return ImageChoice(numbers - first)
    used = "first" if distinct else "line"
    indices = numbers - first if distinct else np.arange(count)
    others = " or ".join(
        f"--image-index {name} ({meaning})"
        for name, meaning in ALIGNMENTS.items()
        if name not in {"auto", used} and not (name == "number" and first == 0 and distinct)
    )
    problem = (
        f"{image_count} images, but data.jsonl has {count} frames lines with numbers from {first} to {last}; "
        f"expected {count} images" + (f" or {last - first + 1}" if last - first + 1 != count else "")
    )
    problem += (
        f". The video is cut off: lines beyond its end have no image (--image-index {used}: {ALIGNMENTS[used]})"
        if cut_off
        else f". Which image a line means is open: a lenient reading takes --image-index {used} "
        f"({ALIGNMENTS[used]}); there is {others}"
    )
    return ImageChoice(np.where(indices < image_count, indices, -1), problem)


def _aligned(numbers: Int64Array, image_count: int, alignment: str) -> ImageChoice:
    """The images that lines mean by a given rule; lines that mean none are a problem."""
    by_rule = {
        "number": numbers,
        "first": numbers - numbers.min(),
        "line": np.arange(len(numbers), dtype=np.int64),
    }
    indices = by_rule[alignment]
    outside = (indices < 0) | (indices >= image_count)
    problem = None
    if outside.any():
        worst = int(indices[outside][0])
        problem = (
            f"{int(outside.sum())} of {len(numbers)} frames lines mean images that are not there, by --image-index "
            f"{alignment} ({ALIGNMENTS[alignment]}): the first image {worst}, while there are {image_count}"
        )
    return ImageChoice(np.where(outside, -1, indices), problem)
