"""The images of a recording: where each camera's are, videos or folders of PNG.

Which of them each `frames` line means, and the table that they are made from.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import msgspec
import numpy as np
from PIL import Image, UnidentifiedImageError

from sceneloom.arrays import AnyArray, Float64Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity, open_file
from sceneloom.formats.base.images import open_image
from sceneloom.formats.recording.columns import (
    DECODER_FAULTS,
    CameraColumns,
    FrameColumns,
    FrameEntry,
    nanoseconds,
    time_order,
    view,
)
from sceneloom.formats.recording.legacy import has_old_frame, with_frames
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import CameraImage

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


_VIDEO_SUFFIXES = ("mkv", "mp4", "mov", "avi", "ts")
"""Endings of `data`, `data2`, … that are looked for, in this order."""

_STATIC = {".ts", ".avi"}
"""Endings of videos that do not state where they end."""

_IMAGES = re.compile(
    rf"data(?P<video>|[2-9]|[1-9]\d+)\.(?:{'|'.join(_VIDEO_SUFFIXES)})|frames(?P<folder>[1-9]\d*)"
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
    names = [*(f"data{number}.{suffix}" for suffix in _VIDEO_SUFFIXES), f"frames{camera_index + 1}"]
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
    return f"data{number}.{{{','.join(_VIDEO_SUFFIXES)}}} or frames{camera_index + 1}/00000000.png"


def other_videos(folder: Path) -> str:
    """Name what looks like a video, but has no name of one of a recording's; "" where there is none."""
    found = [
        path.name
        for path in sorted(folder.iterdir())
        if path.suffix.lower().removeprefix(".") in _VIDEO_SUFFIXES and not _IMAGES.fullmatch(path.name)
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


def frame_notes(frames: FrameColumns, data_path: Path) -> dict[str, Any] | None:
    """Find out what has to be kept of `frames` lines so that they can be written as they were.

    Args:
        frames: the lines.
        data_path: the file that they are in.

    Returns:
        The fields of `FrameNotes`; None where the lines are what would be written anyway.
    """
    if not frames.numbers or not frames.cameras:
        return None
    seconds = view(frames.seconds)
    order = time_order(seconds)
    numbers = np.asarray(frames.numbers, np.int64)[order]
    consecutive = bool((numbers == numbers[0] + np.arange(len(numbers))).all())
    times = _image_times(frames)[order]
    lacking = order[np.isnan(times).any(axis=1)].tolist()
    own = bool(lacking) or not _would_be_grouped(times, seconds[order])
    if consecutive and numbers[0] == 0 and not own:
        return None
    note: dict[str, Any] = {"count": len(numbers), "own": own}
    if consecutive:
        note["first"] = int(numbers[0])
    if lacking:
        note["texts"] = _texts(frames, lacking, data_path)
    return note


def _image_times(frames: FrameColumns) -> Float64Array:
    """Times of the images of each line and camera, (L, C) float64 [s], NaN where there is none."""
    times = np.full((len(frames.numbers), len(frames.cameras)), np.nan)
    for location, camera in enumerate(frames.cameras.values()):
        seconds = np.where(np.asarray(camera.missing, np.bool_), np.nan, view(camera.seconds))
        times[np.asarray(camera.rows, np.int64), location] = seconds
    return times


def _would_be_grouped(times: Float64Array, seconds: Float64Array) -> bool:
    """Whether it is sure that images of these times come into these lines, with these times, by themselves.

    Args:
        times: (L, C) float64 [s], of the images, none missing.
        seconds: (L,) float64 [s], of the lines, ascending.
    """
    if not np.array_equal(times.min(axis=1), seconds):
        return False
    if times.shape[1] == 1:
        return True
    timestamps: Int64Array = nanoseconds(times)
    earliest, latest = timestamps.min(axis=1), timestamps.max(axis=1)
    steps = np.diff(np.sort(timestamps, axis=0), axis=0)
    periods = [float(np.median(column[column > 0])) for column in steps.T if (column > 0).any()]
    spread = (latest - earliest).max()
    return bool((latest[:-1] < earliest[1:]).all()) and (
        spread == 0 or (bool(periods) and float(spread) < min(periods) / 2)
    )


def _texts(frames: FrameColumns, rows: list[int], data_path: Path) -> list[str]:
    """Lines as they stand in the file; those that state nothing but their images are made of their columns."""
    named: dict[int, list[int]] = {row: [] for row in rows}
    for index, camera in frames.cameras.items():
        for row in camera.rows:
            if row in named:
                named[row].append(index)
    with open_file(data_path) as file:
        texts = []
        for row in rows:
            if frames.offsets[row] >= 0:
                file.seek(frames.offsets[row])
                texts.append(file.readline().decode().strip())
            else:
                texts.append(_plain_text(named[row], frames.numbers[row], frames.seconds[row]))
    return texts


def _plain_text(cameras: list[int], number: int, seconds: float) -> str:
    line: Mapping[str, Any] = {
        "frames": [{"cameraInd": index} for index in cameras],
        "number": number,
        "time": seconds,
    }
    return msgspec.json.encode(line).decode()


_HELD_KEYS = frozenset(FrameEntry.__struct_fields__)

OWN_FIELDS = frozenset({"file_seconds", "number", "line_seconds", "line", "entry"})
"""Extras of an image that are no fields of its entry; fields of these names are under "entry"."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageTable:
    """The images of one camera, in time order.

    Attributes:
        camera_index: `cameraInd`.
        camera: the camera model of images that have none of their own.
        timestamps_ns: (N,) int64 [ns].
        seconds: (N,) float64 [s], as the file has them.
        line_seconds: (N,) float64 [s], `time` of the line that each image is in.
        numbers: (N,) int64, `number` of that line.
        offsets: (N,) int64, byte at which that line begins if it says more, else -1.
        indices: (N,) int64, location among the encoded images.
        camera_model_texts: (N,) int64, key in `camera_models`, -1 for none.
        mount_texts: (N,) int64, key in `mounts`, -1 for none.
        camera_models: camera models of single images.
        mounts: mountings of single images, `ego_from_camera`.
        texts: every different text of a camera model or mounting of single images.
        missing: how many entries have no image (`missingBitmap`).
        data_file: `data.jsonl`, as it was when its lines were read.
    """

    OWN: ClassVar[int] = -1

    camera_index: int
    camera: Camera
    timestamps_ns: Int64Array
    seconds: Float64Array
    line_seconds: Float64Array
    numbers: Int64Array
    offsets: Int64Array
    indices: Int64Array
    camera_model_texts: Int64Array
    mount_texts: Int64Array
    camera_models: Mapping[int, Camera]
    mounts: Mapping[int, RigidTransform]
    texts: Sequence[bytes]
    missing: int
    data_file: FileIdentity

    def image(self, k: int, *, files: ImageFiles | None) -> CameraImage:
        """Make image `k`; a table with images has files.

        Raises:
            DataError: `data.jsonl` was changed since it was opened.
        """
        decode = _no_pixels if files is None else files.rgb
        return CameraImage(
            timestamp_ns=int(self.timestamps_ns[k]),
            camera=self.camera_models.get(int(self.camera_model_texts[k]), self.camera),
            decode=partial(decode, int(self.indices[k])),
            mount=self.mounts.get(int(self.mount_texts[k])),
            extras=MappingProxyType(self._extras(k)),
        )

    def _extras(self, k: int) -> dict[str, Any]:
        extras: dict[str, Any] = {"file_seconds": float(self.seconds[k]), "number": int(self.numbers[k])}
        if self.line_seconds[k] != self.seconds[k]:
            extras["line_seconds"] = float(self.line_seconds[k])
        for name, location in (
            ("cameraParameters", self.camera_model_texts[k]),
            ("imuToCamera", self.mount_texts[k]),
        ):
            if location != self.OWN:
                extras[name] = msgspec.json.decode(self.texts[location])
        return {**extras, **further_fields(self.data_file, int(self.offsets[k]), self.camera_index)}

    def first_fields(self) -> dict[str, Any]:
        """Give what the first image's line says beyond the columns."""
        return (
            further_fields(self.data_file, int(self.offsets[0]), self.camera_index)
            if len(self.offsets)
            else {}
        )


def further_fields(data_file: FileIdentity, offset: int, camera_index: int) -> dict[str, Any]:
    """Read again what a line says beyond the columns: lists of features can be long, so they are not kept.

    Args:
        data_file: `data.jsonl`, as it was when its lines were read.
        offset: byte at which the line begins, -1 for one that says nothing more.
        camera_index: `cameraInd` of the entry.

    Returns:
        Further fields of the entry, and under "line" those beside `frames`; under "entry" fields of the entry whose
        names are taken.

    Raises:
        DataError: the file was changed since it was opened.
    """
    if offset < 0:
        return {}
    data_file.check()
    try:
        with open_file(data_file.path) as file:
            file.seek(offset)
            line = msgspec.json.decode(file.readline())
        line = with_frames(line) if has_old_frame(line) else line
        entry = next(entry for entry in line["frames"] if entry["cameraInd"] == camera_index)
    except (OSError, *DECODER_FAULTS, KeyError, TypeError, StopIteration) as error:
        raise DataError(data_file.name, f"byte {offset}", "was changed after it was opened") from error
    further = {key: value for key, value in entry.items() if key not in _HELD_KEYS | OWN_FIELDS}
    hidden = {key: value for key, value in entry.items() if key in OWN_FIELDS}
    if entry.get("missingBitmap") is False:
        further["missingBitmap"] = False
    if hidden:
        further["entry"] = hidden
    beside = {key: value for key, value in line.items() if key not in {"frames", "number", "time"}}
    return {**further, "line": beside} if beside else further


def _no_pixels(index: int) -> UInt8Array:
    raise DataError("", f"image {index}", "there are no images")


def build_table(
    camera_index: int,
    camera: Camera,
    frames: FrameColumns,
    indices: Int64Array,
    camera_models: Mapping[int, Camera],
    mounts: Mapping[int, RigidTransform],
    data_file: FileIdentity,
    *,
    shift: float = 0.0,
) -> ImageTable:
    """Bring a camera's entries into the order of time; those without image, camera model or mounting are left out.

    Args:
        camera: the camera model of entries that have none of their own.
        frames: the frames lines.
        indices: (N,) int64, the image of each entry, -1 for none.
        camera_models: by number of their text.
        mounts: by number of their text.
        shift: what is added to the file's times [s].
    """
    columns = frames.cameras.get(camera_index, CameraColumns())
    camera_model_texts, mount_texts = (
        np.asarray(columns.parameters, np.int64),
        np.asarray(columns.mounts, np.int64),
    )
    missing = np.asarray(columns.missing, np.bool_)
    usable = (indices >= 0) & ~missing
    usable &= np.isin(camera_model_texts, [ImageTable.OWN, *camera_models]) & np.isin(
        mount_texts, [ImageTable.OWN, *mounts]
    )
    seconds = view(columns.seconds)
    chosen = np.flatnonzero(usable)[time_order(seconds[usable])]
    lines = np.asarray(columns.rows, np.int64)[chosen]
    return ImageTable(
        camera_index=camera_index,
        camera=camera,
        timestamps_ns=nanoseconds(seconds[chosen] + shift),
        seconds=seconds[chosen],
        line_seconds=view(frames.seconds)[lines],
        numbers=np.asarray(frames.numbers, np.int64)[lines],
        offsets=np.asarray(frames.offsets, np.int64)[lines],
        indices=indices[chosen],
        camera_model_texts=camera_model_texts[chosen],
        mount_texts=mount_texts[chosen],
        camera_models=camera_models,
        mounts=mounts,
        texts=tuple(frames.texts),
        missing=int(missing.sum()),
        data_file=data_file,
    )
