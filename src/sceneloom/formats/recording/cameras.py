"""The cameras and depth cameras of a recording: intrinsics, extrinsics, images.

Poses and time offsets brought together.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec
import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import CalibrationError, DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileIdentity, open_file
from sceneloom.formats.base.images import open_image
from sceneloom.formats.base.text_tables import nanoseconds
from sceneloom.formats.recording.calibration import (
    Calibration,
    CameraCalibration,
    camera_model,
    read_mount,
    read_parameters,
    read_texts,
)
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.legacy import has_old_frame, with_frames
from sceneloom.formats.recording.lines import CameraColumns, FrameColumns, FrameEntry, time_order, view
from sceneloom.formats.video.reader import VideoReader, open_video
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import Poses, poses_along
from sceneloom.warnings import WarningKind

if TYPE_CHECKING:
    from PIL import Image

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

    def _checked(self, index: int, modes: Collection[str], expected: str) -> "Image.Image":
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

    def _decoded(self, image: "Image.Image", mode: str, dtype: type[np.generic], index: int) -> AnyArray:
        try:
            return np.array(image.convert(mode)).astype(dtype)
        except (OSError, ValueError, SyntaxError) as error:
            raise DataError(self.name, image_name(index), f"cannot be decoded: {error}") from error

    def _open(self, index: int) -> "Image.Image":
        from PIL import UnidentifiedImageError

        location = image_name(index)
        try:
            return open_image(self._folder / location, ("PNG",))
        except UnidentifiedImageError as error:
            raise DataError(self.name, location, "is no PNG image") from error
        except (OSError, ValueError, SyntaxError) as error:
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
            raise DataError(folder, image_name(expected), f"is missing; the next image is {image_name(number)}")
    return len(numbers)


_VIDEO_SUFFIXES = ("mkv", "mp4", "mov", "avi", "ts")
"""Endings of `data`, `data2`, … that are looked for, in this order."""


_STATIC = {".ts", ".avi"}
"""Endings of videos that do not state where they end."""


_IMAGES = re.compile(rf"data(?P<video>|[2-9]|[1-9]\d+)\.(?:{'|'.join(_VIDEO_SUFFIXES)})|frames(?P<folder>[1-9]\d*)")


_ImageFiles = VideoReader | PngFolder


class OpenImages:
    """The images that a scene holds open, to be closed together."""

    def __init__(self) -> None:
        self._files: list[_ImageFiles] = []

    def add(self, files: _ImageFiles) -> None:
        """Have one more closed."""
        self._files.append(files)

    def close(self) -> None:
        """Close them all."""
        for files in self._files:
            files.close()


def _find_images(folder: Path, camera_index: int, ledger: Ledger) -> Path | None:
    """Find the video, or the folder of PNG images, of a camera; None where there is neither.

    Raises:
        DataError: there is more than one.
    """
    number = "" if camera_index == 0 else str(camera_index + 1)
    names = [*(f"data{number}.{suffix}" for suffix in _VIDEO_SUFFIXES), f"frames{camera_index + 1}"]
    found = [folder / name for name in names if (folder / name).exists()]
    if len(found) > 1:
        listed = ", ".join(path.name for path in found)
        ledger.fault("repeated-videos", DataError(folder, "", f"{listed} for camera {camera_index}; expected one"))
    return found[0] if found else None


def _unused_images(folder: Path, camera_indices: Collection[int]) -> list[Path]:
    """Find videos and image folders of other cameras than these."""
    used = {"" if index == 0 else str(index + 1) for index in camera_indices}
    used_folders = {str(index + 1) for index in camera_indices}
    found = []
    for path in sorted(folder.iterdir()):
        match = _IMAGES.fullmatch(path.name)
        if match and (match["folder"] not in used_folders if match["folder"] else match["video"] not in used):
            found.append(path)
    return found


def _expected_names(camera_index: int) -> str:
    """Name the files that could hold a camera's images, for messages."""
    number = "" if camera_index == 0 else str(camera_index + 1)
    return f"data{number}.{{{','.join(_VIDEO_SUFFIXES)}}} or frames{camera_index + 1}/00000000.png"


def _other_videos(folder: Path) -> str:
    """Name what looks like a video, but has no name of one of a recording's; "" where there is none."""
    found = [
        path.name
        for path in sorted(folder.iterdir())
        if path.suffix.lower().removeprefix(".") in _VIDEO_SUFFIXES and not _IMAGES.fullmatch(path.name)
    ]
    return f"; in the folder there is {', '.join(found)}" if found else ""


def _open_images(path: Path, ledger: Ledger) -> _ImageFiles:
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


def _maybe_cut_off(files: _ImageFiles, wanted: int) -> bool:
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
class _ImageChoice:
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
    ranks = np.argsort(np.argsort(numbers, kind="stable"))
    first, last = int(numbers.min()), int(numbers.max())
    distinct = len(np.unique(numbers)) == count
    if distinct and image_count == last - first + 1:
        return _ImageChoice(numbers - first)
    if image_count == count:
        return _ImageChoice(ranks if distinct else np.arange(count), by_line=True)
    if image_count == last - first + 1:
        return _ImageChoice(numbers - first)
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
    return _ImageChoice(np.where(indices < image_count, indices, -1), problem)


def _aligned(numbers: Int64Array, image_count: int, alignment: str) -> _ImageChoice:
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
class _ImageTable:
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

    def image(self, k: int, *, files: _ImageFiles | None) -> CameraImage:
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
        return {**extras, **_further_fields(self.data_file, int(self.offsets[k]), self.camera_index)}

    def first_fields(self) -> dict[str, Any]:
        """Give what the first image's line says beyond the columns."""
        return _further_fields(self.data_file, int(self.offsets[0]), self.camera_index) if len(self.offsets) else {}


def _further_fields(data_file: FileIdentity, offset: int, camera_index: int) -> dict[str, Any]:
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


def _build_table(
    camera_index: int,
    camera: Camera,
    frames: FrameColumns,
    indices: Int64Array,
    camera_models: Mapping[int, Camera],
    mounts: Mapping[int, RigidTransform],
    data_file: FileIdentity,
    *,
    shift: float = 0.0,
) -> _ImageTable:
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
    usable &= np.isin(camera_model_texts, [_ImageTable.OWN, *camera_models]) & np.isin(
        mount_texts, [_ImageTable.OWN, *mounts]
    )
    seconds = view(columns.seconds)
    chosen = np.flatnonzero(usable)[time_order(seconds[usable])]
    lines = np.asarray(columns.rows, np.int64)[chosen]
    return _ImageTable(
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


_SHIFT_KEY = "imuToCameraShiftSeconds"


CAMERA_SHIFTS: Mapping[str, int] = {"ignore": 0, "apply": 1, "subtract": -1}
"""What becomes of `imuToCameraShiftSeconds`: by how many times it is added to the times of images.

The description of the format has no such field. "apply": t_imu = t_camera + shift (ASSUMED). "subtract": the sense in
which the open part of the vendor's software takes it.

Source: `imuToCameraShiftSeconds` in `codegen/parameter_definitions.c` and `src/odometry/sample_sync.cpp` of HybVIO.
"""


def _shift_of(calibration: CameraCalibration, camera_shift: str, ledger: Ledger) -> float:
    """Give what is to be added to the times of a camera's images [s], with a warning where the calibration has any."""
    if not calibration.shift:
        return 0.0
    factor, stated = CAMERA_SHIFTS[camera_shift], f"{_SHIFT_KEY} {calibration.shift}"
    code, message = {
        0: (
            "camera-shift-not-applied",
            f"{stated} is not applied: frame times are taken to be on the recording's clock",
        ),
        1: ("camera-shift-applied", f"{stated} was added to the times of the camera's images"),
        -1: ("camera-shift-applied", f"{stated} was taken off the times of the camera's images"),
    }[factor]
    ledger.note(WarningKind.ASSUMED, code, calibration.location, message)
    return factor * calibration.shift


def _entry_after(calibration: CameraCalibration, camera_shift: str) -> Mapping[str, Any]:
    """Give the entry that holds for the images as they are read: one that was applied is not in it any more."""
    if not CAMERA_SHIFTS[camera_shift]:
        return calibration.entry
    return {key: value for key, value in calibration.entry.items() if key != _SHIFT_KEY}


def applied_shifts(calibration: Calibration, camera_shift: str) -> dict[str, Any]:
    """Record which cameras' times were shifted, and by how much [s]; nothing where none was."""
    factor = CAMERA_SHIFTS[camera_shift]
    shifts = {f"camera{index}": factor * camera.shift for index, camera in calibration.cameras.items() if camera.shift}
    return {"camera_shifts": shifts} if factor and shifts else {}


_DEFAULT_SCALE = 0.001
"""Metres a step where nothing says it: the usual unit of depth cameras. ASSUMED, with a warning."""


_DEPTH_FORMAT = "gray16"
"""`colorFormat` of lines whose image holds depths."""


_LARGEST_SCALE = 100.0


def _holds_depth(files: _ImageFiles | None) -> bool:
    """Whether images are 16-bit grey, and so hold depths."""
    return files is not None and files.has_steps


def _check_kind(files: _ImageFiles, fields: Mapping[str, Any]) -> None:
    """Check that images are of the kind that the first line names.

    Args:
        files: the images.
        fields: what the first line says of the camera beside its columns.

    Raises:
        DataError: the line says that they hold depths, and they cannot.
    """
    if fields.get("colorFormat") == _DEPTH_FORMAT and not _holds_depth(files):
        problem = f"pixels are no 16-bit grey, while lines state colorFormat {_DEPTH_FORMAT!r}"
        raise DataError(files.name, "", f"{problem}; expected a lossless video of 16 bits, as FFV1 makes them")


def _aligned_calibration(calibration: Calibration, index: int, ledger: Ledger) -> CameraCalibration | None:
    """Give the camera model and mounting of the camera that depth images without a calibration are aligned to.

    The first one.

    Returns:
        None where there is no other camera.
    """
    first = min((other for other in calibration.cameras if other != index), default=None)
    if first is None:
        return None
    message = f"depth images of camera {index} have no calibration; taken to lie in the pixels of camera {first}"
    ledger.note(WarningKind.ASSUMED, "depth-aligned", str(calibration.path), message)
    return replace(calibration.cameras[first], entry={})


def _depth_sensor(
    camera: CameraSensor, table: _ImageTable, files: _ImageFiles | None, ledger: Ledger
) -> DepthCameraSensor:
    """Make a camera with images of steps into one that measures depth.

    Args:
        camera: the same camera, as if its images were colours.
        table: its images.
        files: where they are.
        ledger: takes the warning of an assumed scale.
    """
    scale = table.first_fields().get("depthScale")
    if scale is None and len(table.seconds):
        message = f"no depthScale for camera {table.camera_index}; taken to be {_DEFAULT_SCALE:g} m a step"
        ledger.note(WarningKind.ASSUMED, "depth-scale-assumed", table.data_file.name, message)
    usual = _scale_of(_DEFAULT_SCALE if scale is None else scale, table)
    return DepthCameraSensor(
        id=camera.id,
        camera=camera.camera,
        frames=LazyFrames(table.timestamps_ns, partial(_frame, table=table, files=files, usual=usual)),
        poses=camera.poses,
        mount=camera.mount,
        coordinates=camera.coordinates,
        video=camera.video,
        fps=camera.fps,
        extras=camera.extras,
    )


def _scale_of(value: object, table: _ImageTable) -> float:
    """Check a `depthScale`.

    Raises:
        DataError: it is no length.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 < float(value) <= _LARGEST_SCALE:  # type: ignore[arg-type]
        problem = f"frames[].depthScale: {value!r} of camera {table.camera_index}; expected metres a step"
        raise DataError(table.data_file.name, "", problem)
    return float(value)  # type: ignore[arg-type]


def _frame(k: int, *, table: _ImageTable, files: _ImageFiles | None, usual: float) -> DepthFrame:
    image = table.image(k, files=None)
    scale = _scale_of(image.extras.get("depthScale", usual), table)
    return DepthFrame(
        timestamp_ns=image.timestamp_ns,
        camera=image.camera,
        decode=partial(_metres, files, int(table.indices[k]), scale),
        scale=scale,
        mount=image.mount,
        extras=MappingProxyType(dict(image.extras)),
    )


def _metres(files: _ImageFiles | None, index: int, scale: float) -> Float32Array:
    if files is None:
        raise DataError("", f"image {index}", "there are no images")
    # through float64: a step times a rounded scale is off by more than a step's own rounding
    return np.multiply(files.steps(index), scale, dtype=np.float64).astype(np.float32)


_SAME_M, _SAME_DEG = 1e-6, 1e-4
"""Mountings no further apart than this state the same."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraSources:
    """What the cameras of a recording are built from.

    Attributes:
        folder: the recording.
        data_path: `data.jsonl`.
        data_file: the same, as it was when its lines were read.
        calibration: all of `calibration.json`.
        frames: the `frames` lines.
        ego_path: `world_from_ego` of the default trajectory, or None.
        ledger: takes warnings and faults.
        open_files: takes the images of the cameras that are built.
        camera_shift: what becomes of `imuToCameraShiftSeconds`, a key of `CAMERA_SHIFTS`.
        image_index: which image a `frames` line means, a key of `ALIGNMENTS`.
    """

    folder: Path
    data_path: Path
    data_file: FileIdentity
    calibration: Calibration
    frames: FrameColumns
    ego_path: Poses | None
    ledger: Ledger
    open_files: OpenImages
    camera_shift: str = "ignore"
    image_index: str = "auto"


def build_cameras(sources: CameraSources) -> list[CameraSensor | DepthCameraSensor]:
    """Build every camera that the calibration or a line names.

    Raises:
        DataError: images are missing, unreadable, or not as many as the lines state; or there is no calibration.
        CalibrationError: a camera model or a mounting is unusable.
    """
    cameras: list[CameraSensor | DepthCameraSensor] = []
    for index in sorted({*sources.calibration.cameras, *sources.frames.cameras}):
        try:
            cameras.extend(_build(sources, index))
        except (DataError, CalibrationError) as error:
            sources.ledger.fault(_fault_code(sources, index), error)
    _note_unused(sources)
    return cameras


def _fault_code(sources: CameraSources, index: int) -> str:
    """What kind of fault it is that a camera cannot be built: one that no calibration reports can do so any time."""
    entries = sources.frames.cameras.get(index, CameraColumns()).parameters
    untold = index not in sources.calibration.cameras and (not entries or entries[0] < 0)
    return "cameras-without-calibration" if untold else "unusable-cameras"


def _note_unused(sources: CameraSources) -> None:
    unused = _unused_images(sources.folder, {*sources.calibration.cameras, *sources.frames.cameras})
    if unused:
        names = ", ".join(path.name for path in unused)
        message = f"{names}: neither calibration.json nor a frames line names the camera; not used"
        ledger, location = sources.ledger, str(sources.folder)
        ledger.note(WarningKind.SKIPPED, "videos-not-used", location, message, count=len(unused))


def _build(sources: CameraSources, index: int) -> list[CameraSensor | DepthCameraSensor]:
    """Build one camera; none where neither calibration nor images report the image's size, and no line needs it."""
    columns = sources.frames.cameras.get(index, CameraColumns())
    files, indices = _match_images(sources, index, columns)
    calibration = sources.calibration.cameras.get(index) or _calibration_of_lines(sources, index, columns, files)
    if files is None and not columns.rows and not calibration.parameters.has_size:
        message = "has no image size, and there are no images of it; the camera was left out"
        sources.ledger.note(WarningKind.SKIPPED, "cameras-without-size", calibration.location, message)
        return []
    calibration = _with_camera_model_of_lines(sources, calibration, columns)
    camera = _fitted_camera_model(sources, calibration, files)
    read_camera_model = _camera_model_reader(sources, calibration, camera)
    reading_mount = partial(read_mount, path=sources.data_path, ledger=sources.ledger)
    camera_models = read_texts(sources.frames, columns.rows, columns.parameters, read_camera_model, sources.ledger)
    mounts = read_texts(sources.frames, columns.rows, columns.mounts, reading_mount, sources.ledger)
    shift = _shift_of(calibration, sources.camera_shift, sources.ledger)
    table = _build_table(index, camera, sources.frames, indices, camera_models, mounts, sources.data_file, shift=shift)
    sensor = _sensor(sources, table, calibration, files)
    return [_depth_sensor(sensor, table, files, sources.ledger) if _holds_depth(files) else sensor]


def _calibration_of_lines(
    sources: CameraSources, index: int, columns: CameraColumns, files: _ImageFiles | None
) -> CameraCalibration:
    """Take the camera model of a camera's first line for a camera that the calibration does not have."""
    line = sources.frames.lines[columns.rows[0]]
    if columns.parameters[0] < 0:
        aligned = _aligned_calibration(sources.calibration, index, sources.ledger) if _holds_depth(files) else None
        if aligned is not None:
            return aligned
        path = sources.calibration.path
        location = f"cameras[{index}]" if path.exists() else ""
        problem = (
            f"missing, while {sources.data_path.name} has frames of camera {index} (line {line}); write its entry "
            "in `cameras` (model, focalLengthX, focalLengthY, principalPointX, principalPointY, imuToCamera), "
            "or give `cameraParameters` in every line"
        )
        raise DataError(path, location, problem)
    text = list(sources.frames.texts)[columns.parameters[0]]
    parameters = read_parameters(text, line, path=sources.data_path)
    return CameraCalibration(f"{sources.data_path}: line {line}: frames[].cameraParameters", parameters)


def _with_camera_model_of_lines(
    sources: CameraSources, calibration: CameraCalibration, columns: CameraColumns
) -> CameraCalibration:
    """Take the camera model of a camera's first line where the calibration has a mounting only.

    As old recordings have.
    """
    if calibration.parameters.focalLengthX is not None or not columns.rows or columns.parameters[0] < 0:
        return calibration
    text, line = list(sources.frames.texts)[columns.parameters[0]], sources.frames.lines[columns.rows[0]]
    parameters = read_parameters(text, line, path=sources.data_path).over(calibration.parameters)
    return replace(calibration, parameters=parameters)


def _match_images(sources: CameraSources, index: int, columns: CameraColumns) -> tuple[_ImageFiles | None, Int64Array]:
    """Open a camera's images, and find the one that each of its entries means, -1 for none."""
    ledger, rows = sources.ledger, np.asarray(columns.rows, np.int64)
    none = np.full(len(rows), -1, np.int64)
    path = _find_images(sources.folder, index, ledger)
    if path is None:
        if len(rows):
            problem = f"no images of camera {index}, while data.jsonl has {len(rows)} frames of it"
            expected = f"{_expected_names(index)}{_other_videos(sources.folder)}"
            ledger.fault("missing-videos", DataError(sources.folder, "", f"{problem}; expected {expected}"))
        return None, none
    try:
        files = _open_images(path, sources.ledger)
        sources.open_files.add(files)
        _check_kind(files, _first_fields(sources, index, columns))
        numbers = np.asarray(sources.frames.numbers, np.int64)
        cut_off = isinstance(files, VideoReader) and files.is_remainder
        choice = choose_images(numbers, files.count, alignment=sources.image_index, cut_off=cut_off)
        if choice.problem is not None and ledger.lenient and _maybe_cut_off(files, len(numbers)):
            files = open_video(path, cut_off=True)
            sources.open_files.add(files)
            left = choose_images(numbers, files.count, alignment=sources.image_index)
            choice = replace(left, problem=choice.problem)
    except DataError as error:
        ledger.fault("unreadable-videos", error)
        return None, none
    if choice.problem is not None:
        left_out = int((choice.indices[rows] < 0).sum())
        ledger.fault("unmatched-images", DataError(path, "", choice.problem), count=max(left_out, 1))
    if choice.by_line:
        message = "frame numbers have gaps, while images and lines are equally many; they were counted line by line"
        ledger.note(WarningKind.REPAIRED, "frame-numbers-not-used", str(path), message)
    return files, choice.indices[rows]


def _first_fields(sources: CameraSources, index: int, columns: CameraColumns) -> Mapping[str, Any]:
    """What a camera's first line says of it beside its columns."""
    offset = sources.frames.offsets[columns.rows[0]] if columns.rows else -1
    return _further_fields(sources.data_file, offset, index)


def _size(files: _ImageFiles | None) -> tuple[int, int] | None:
    return None if files is None else (files.width, files.height)


def _fitted_camera_model(sources: CameraSources, calibration: CameraCalibration, files: _ImageFiles | None) -> Camera:
    """Give the camera model for the images as they are, with a warning where the calibration is for another size."""
    calibrated = camera_model(calibration.parameters, _size(files), calibration.location)
    width, height = _size(files) or (calibrated.width, calibrated.height)
    if (width, height) == (calibrated.width, calibrated.height):
        return calibrated
    sizes = f"{calibrated.width}x{calibrated.height}, images are {width}x{height}"
    message = f"calibrated for {sizes}; the camera model was scaled"
    sources.ledger.note(WarningKind.REPAIRED, "camera-model-scaled", calibration.location, message)
    return calibrated.resized(width, height)


def _camera_model_reader(
    sources: CameraSources, calibration: CameraCalibration, camera: Camera
) -> Callable[[bytes, int], Camera]:
    """Give the function that reads a line's own `cameraParameters` over those of the calibration."""

    def read(text: bytes, line: int) -> Camera:
        parameters = read_parameters(text, line, path=sources.data_path).over(calibration.parameters)
        location = f"{sources.data_path}: line {line}: frames[].cameraParameters"
        return camera_model(parameters, (camera.width, camera.height), location).resized(camera.width, camera.height)

    return read


def _sensor(
    sources: CameraSources, table: _ImageTable, calibration: CameraCalibration, files: _ImageFiles | None
) -> CameraSensor:
    camera, ego_from_camera = _camera_model_in_use(table), _own_mount(sources, table, calibration)
    _note_unused_rig(sources, table, calibration, camera, ego_from_camera)
    entry = _entry_after(calibration, sources.camera_shift)
    mounts = table.mounts if ego_from_camera is None else {table.OWN: ego_from_camera, **table.mounts}
    if table.missing:
        message = f"frames of camera {table.camera_index} state `missingBitmap`; they have no image"
        location = str(sources.data_path)
        sources.ledger.note(WarningKind.SKIPPED, "missing-bitmaps", location, message, count=table.missing)
    return CameraSensor(
        id=f"camera{table.camera_index}",
        camera=camera,
        images=LazyFrames(table.timestamps_ns, partial(table.image, files=files)),
        poses=poses_along(sources.ego_path, mounts, table.mount_texts, table.timestamps_ns),
        mount=ego_from_camera,
        video=_video(files, table.indices),
        fps=None if files is None else files.fps,
        extras=MappingProxyType({"calibration": entry} if entry else {}),
    )


def _camera_model_in_use(table: _ImageTable) -> Camera:
    """The camera model of the calibration; that of the first image where each image has its own.

    So that none uses it.
    """
    if len(table.camera_model_texts) and (table.camera_model_texts != table.OWN).all():
        return table.camera_models[int(table.camera_model_texts[0])]
    return table.camera


def _own_mount(sources: CameraSources, table: _ImageTable, calibration: CameraCalibration) -> RigidTransform | None:
    """The mounting of the calibration; that of the first image where each image has its own."""
    if len(table.mount_texts) and (table.mount_texts != table.OWN).all():
        return table.mounts[int(table.mount_texts[0])]
    if calibration.camera_from_imu is not None:
        return calibration.camera_from_imu.inverse()
    first = next(iter(table.mounts.values()), None)
    if first is None:
        problem = (
            "imuToCamera is missing: where the camera is on the vehicle; expected 4 rows of 4 numbers, which take "
            "points of the IMU into the camera (a lenient reading keeps the camera without it)"
        )
        sources.ledger.fault("mounts-missing", DataError(calibration.location, "", problem))
    elif (table.mount_texts == table.OWN).any():
        message = "frames without imuToCamera, of a camera whose calibration has none: taken as in its first frame"
        sources.ledger.note(WarningKind.ASSUMED, "mounts-of-first-frame", calibration.location, message)
    return first


def _note_unused_rig(
    sources: CameraSources,
    table: _ImageTable,
    calibration: CameraCalibration,
    camera: Camera,
    ego_from_camera: RigidTransform | None,
) -> None:
    """Report which values of calibration.json no image uses, where those of the images are others."""
    location, name = calibration.location, sources.data_path.name
    if camera != table.camera:
        message = (
            f"every image has cameraParameters of its own in {name}, and they differ from these "
            f"(focalLengthX {camera.fx:.6g} px instead of {table.camera.fx:.6g}); the images' are used"
        )
        sources.ledger.note(WarningKind.SKIPPED, "calibration-not-used", location, message)
    reported = calibration.camera_from_imu
    if reported is None or ego_from_camera is None:
        return
    moved = reported @ ego_from_camera
    rotated = math.degrees(float(angle_between(moved.quaternion_xyzw, np.array([0.0, 0.0, 0.0, 1.0]))))
    metres = float(np.linalg.norm(moved.inverse().translation))
    if metres > _SAME_M or rotated > _SAME_DEG:
        message = (
            f"every image has an imuToCamera of its own in {name}, {metres:.3g} m and {rotated:.3g} degrees from this "
            "one; the images' are used"
        )
        sources.ledger.note(WarningKind.SKIPPED, "calibration-not-used", location, message)


def _video(files: _ImageFiles | None, indices: Int64Array) -> VideoContent | None:
    # of what is left of a video the images can be decoded, but its file cannot be handed on
    if not isinstance(files, VideoReader) or files.is_remainder:
        return None
    all_in_order = np.array_equal(indices, np.arange(files.count))
    return VideoContent(
        open=files.open_file,
        codec=files.codec,
        frame_indices=None if all_in_order else tuple(indices.tolist()),
    )
