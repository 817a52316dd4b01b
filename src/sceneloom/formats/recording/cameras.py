"""The cameras and depth cameras of a recording: intrinsics, extrinsics, images, poses and time offsets."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

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
    CameraParameters,
    RecordingContents,
    camera_model,
    read_mount,
    read_parameters,
    read_texts,
)
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.lines import (
    CameraColumns,
    FrameColumns,
    FrameEntry,
    record_keys,
    time_order,
    view,
    with_frames,
)
from sceneloom.formats.video.reader import VideoReader, open_video, open_whole_or_left
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.geometry.rotations import angle_between
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.poses import poses_along
from sceneloom.warnings import WarningKind

if TYPE_CHECKING:
    from PIL import Image

_NUMBERED = re.compile(r"(\d{8})\.png")

_EIGHT_BIT_MODES = frozenset({"1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX"})
"""Pillow's modes whose values are, or stand for, 8-bit colours; a 16-bit RGB file comes as `RGB` too."""

_STEPS = frozenset({"I", "I;16", "I;16B", "I;16L"})
"""Its modes for 16-bit grey; PNG has no wider grey."""

_DAMAGE = (OSError, ValueError, SyntaxError)
"""What Pillow raises for files that are damaged."""


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

_VIDEO_SUFFIXES = ("mkv", "mp4", "mov", "avi", "ts")
"""Endings of `data`, `data2`, … that are looked for, in this order."""

_ENDLESS = {".ts", ".avi"}
"""Endings of videos that do not state where they end."""

_IMAGES = re.compile(rf"data(?P<video>|[2-9]|[1-9]\d+)\.(?:{'|'.join(_VIDEO_SUFFIXES)})|frames(?P<folder>[1-9]\d*)")


def _video_number(camera_index: int) -> str:
    return "" if camera_index == 0 else str(camera_index + 1)


def _find_images(folder: Path, camera_index: int, ledger: Ledger) -> Path | None:
    """Find the video, or the folder of PNG images, of a camera; None where there is neither."""
    stem = f"data{_video_number(camera_index)}"
    names = [*(f"{stem}.{suffix}" for suffix in _VIDEO_SUFFIXES), f"frames{camera_index + 1}"]
    found = [folder / name for name in names if (folder / name).exists()]
    if len(found) > 1:
        listed = ", ".join(path.name for path in found)
        ledger.fault("repeated-videos", DataError(folder, "", f"{listed} for camera {camera_index}; expected one"))
    return found[0] if found else None


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
    """The fields of `FrameNotes` for the lines of a file; None where they are what would be written anyway."""
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
        for row in set(camera.rows) & named.keys():
            named[row].append(index)
    texts = []
    with open_file(data_path) as file:
        for row in rows:
            entries = [{"cameraInd": index} for index in named[row]]
            line = {"frames": entries, "number": frames.numbers[row], "time": frames.seconds[row]}
            text = msgspec.json.encode(line)
            if frames.offsets[row] >= 0:
                file.seek(frames.offsets[row])
                text = file.readline()
            texts.append(text.decode().strip())
    return texts


_HELD_KEYS = frozenset(FrameEntry.__struct_fields__)

OWN_FIELDS = frozenset({"file_seconds", "number", "line_seconds", "line", "entry"})
"""Extras of an image that are no fields of its entry; fields of these names are under "entry"."""

_OWN = -1
"""Stands for the camera model or mounting of the calibration."""


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
        indices: (N,) int64, index among the encoded images.
        camera_model_texts: (N,) int64, key in `camera_models`, -1 for none.
        mount_texts: (N,) int64, key in `mounts`, -1 for none.
        camera_models: camera models of single images.
        mounts: mountings of single images, `ego_from_camera`.
        texts: every different text of a camera model or mounting of single images.
        data_file: `data.jsonl`, as it was when its lines were read.
        files: the encoded images; None where there are none.
    """

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
    data_file: FileIdentity
    files: ImageFiles | None

    def image(self, k: int) -> CameraImage:
        """Make image `k`."""
        return CameraImage(decode=partial(self.rgb, int(self.indices[k])), **self._fields(k))

    def depth_frame(self, k: int, *, usual: float) -> DepthFrame:
        """Make depth image `k`; `usual` is the length of a step where its line has none [m]."""
        fields = self._fields(k)
        scale = self.checked_scale(fields["extras"].get("depthScale", usual))
        return DepthFrame(decode=partial(self.metres, int(self.indices[k]), scale), scale=scale, **fields)

    def _fields(self, k: int) -> dict[str, Any]:
        """What images of both kinds have."""
        extras: dict[str, Any] = {"file_seconds": float(self.seconds[k]), "number": int(self.numbers[k])}
        if self.line_seconds[k] != self.seconds[k]:
            extras["line_seconds"] = float(self.line_seconds[k])
        for name, column in (("cameraParameters", self.camera_model_texts), ("imuToCamera", self.mount_texts)):
            if column[k] != _OWN:
                extras[name] = msgspec.json.decode(self.texts[column[k]])
        return {
            "timestamp_ns": int(self.timestamps_ns[k]),
            "camera": self.camera_models.get(int(self.camera_model_texts[k]), self.camera),
            "mount": self.mounts.get(int(self.mount_texts[k])),
            "extras": MappingProxyType(
                extras | _further_fields(self.data_file, int(self.offsets[k]), self.camera_index)
            ),
        }

    def rgb(self, index: int) -> UInt8Array:
        """Decode an image."""
        return self._opened(index).rgb(index)

    def metres(self, index: int, scale: float) -> Float32Array:
        """Decode a depth image, (H, W) float32 [m]."""
        # through float64: a step times a rounded scale is off by more than a step's own rounding
        return np.multiply(self._opened(index).steps(index), scale, dtype=np.float64).astype(np.float32)

    def _opened(self, index: int) -> ImageFiles:
        if self.files is None:
            raise DataError("", f"image {index}", "there are no images")
        return self.files

    def checked_scale(self, value: object) -> float:
        """Check a `depthScale`."""
        if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= _LARGEST_SCALE:
            return float(value)
        problem = f"frames[].depthScale: {value!r} of camera {self.camera_index}; expected metres a step"
        raise DataError(self.data_file.name, "", problem)


def _further_fields(data_file: FileIdentity, offset: int, camera_index: int) -> dict[str, Any]:
    """Read again what a line says beyond the columns: lists of features can be long, so they are not kept.

    Args:
        offset: byte at which the line begins, -1 for one that says nothing more.

    Returns:
        Further fields of the entry, and under "line" those beside `frames`; under "entry" fields of the entry whose
        names are taken.
    """
    if offset < 0:
        return {}
    data_file.check()
    try:
        with open_file(data_file.path) as file:
            file.seek(offset)
            line = with_frames(msgspec.json.decode(file.readline()))
        entry = next(entry for entry in line["frames"] if entry["cameraInd"] == camera_index)
    except (OSError, *DECODER_FAULTS, AttributeError, KeyError, TypeError, StopIteration) as error:
        raise DataError(data_file.name, f"byte {offset}", "was changed after it was opened") from error
    further = {key: value for key, value in entry.items() if key not in _HELD_KEYS | OWN_FIELDS}
    hidden = {key: value for key, value in entry.items() if key in OWN_FIELDS}
    known = record_keys(line) | {"number", "time"}
    beside = {key: value for key, value in line.items() if key not in known}
    return {**further, **({"entry": hidden} if hidden else {}), **({"line": beside} if beside else {})}


_SHIFT_KEY = "imuToCameraShiftSeconds"

CAMERA_SHIFTS: Mapping[str, int] = {"ignore": 0, "apply": 1, "subtract": -1}
"""What becomes of `imuToCameraShiftSeconds`: by how many times it is added to the times of images.

The description of the format has no such field. "apply": t_imu = t_camera + shift (ASSUMED). "subtract": the sense in
which the open part of the vendor's software takes it.

Source: `imuToCameraShiftSeconds` in `codegen/parameter_definitions.c` and `src/odometry/sample_sync.cpp` of HybVIO.
"""

_SHIFT_MESSAGES = {
    0: ("camera-shift-not-applied", "is not applied: frame times are taken to be on the recording's clock"),
    1: ("camera-shift-applied", "was added to the times of the camera's images"),
    -1: ("camera-shift-applied", "was subtracted from the times of the camera's images"),
}


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

_SAME_M, _SAME_DEG = 1e-6, 1e-4
"""Mountings no further apart than this state the same."""


def build_cameras(contents: RecordingContents, opened: list[ImageFiles]) -> list[CameraSensor | DepthCameraSensor]:
    """Build every camera that the calibration or a line names; the files that are opened are added to `opened`.

    Raises:
        DataError: images are missing, unreadable, or not as many as the lines state; or there is no calibration.
        CalibrationError: a camera model or a mounting is unusable.
    """
    cameras: list[CameraSensor | DepthCameraSensor] = []
    folder, ledger, calibrated = contents.folder, contents.ledger, contents.calibration.cameras
    indices = {*calibrated, *contents.columns.frames.cameras}
    for index in sorted(indices):
        builder = _CameraBuilder(contents, index, opened)
        try:
            cameras.extend(builder.build())
        except (DataError, CalibrationError) as error:
            # a camera without any calibration cannot be built however sound its images are
            entries = builder.columns.parameters
            untold = index not in calibrated and (not entries or entries[0] < 0)
            ledger.fault("cameras-without-calibration" if untold else "unusable-cameras", error)
    used = {("video", _video_number(index)) for index in indices} | {("folder", str(index + 1)) for index in indices}
    matches = [match for path in sorted(folder.iterdir()) if (match := _IMAGES.fullmatch(path.name))]
    unused = [
        match.string
        for match in matches
        if (("folder", match["folder"]) if match["folder"] else ("video", match["video"])) not in used
    ]
    if unused:
        message = f"{', '.join(unused)}: neither calibration.json nor a frames line names the camera; not used"
        ledger.note(WarningKind.SKIPPED, "videos-not-used", str(folder), message, count=len(unused))
    return cameras


class _CameraBuilder:
    """Builds one camera of a recording from its calibration, its entries in `frames` lines and its images."""

    def __init__(self, contents: RecordingContents, index: int, opened: list[ImageFiles]) -> None:
        self.contents, self.index, self.opened = contents, index, opened
        self.frames, self.ledger = contents.columns.frames, contents.ledger
        self.columns = self.frames.cameras.get(index, CameraColumns())
        self.files: ImageFiles | None = None

    def build(self) -> list[CameraSensor | DepthCameraSensor]:
        """Build it; nothing where neither calibration nor images report the image's size, and no line needs it."""
        columns, frames, ledger, path = self.columns, self.frames, self.ledger, self.contents.data_path
        indices = self._match_images()
        files, has_depth = self.files, self.files is not None and self.files.has_steps
        calibration = self.contents.calibration.cameras.get(self.index) or self._calibration_of_lines(has_depth)
        if files is None and not columns.rows and not calibration.parameters.has_size:
            message = "has no image size, and there are no images of it; the camera was left out"
            ledger.note(WarningKind.SKIPPED, "cameras-without-size", calibration.location, message)
            return []
        if calibration.parameters.focalLengthX is None and columns.rows and columns.parameters[0] >= 0:
            # calibrations of old recordings have a mounting only
            calibration = replace(calibration, parameters=self._first_parameters().over(calibration.parameters))
        camera = self._fitted_camera_model(calibration)

        def own_camera_model(text: bytes, line: int) -> Camera:
            parameters = read_parameters(text, line, path=path).over(calibration.parameters)
            location = f"{path}: line {line}: frames[].cameraParameters"
            size = (camera.width, camera.height)
            return camera_model(parameters, size, location).resized(*size)

        camera_models = read_texts(frames, columns.rows, columns.parameters, own_camera_model, ledger)
        own_mount = partial(read_mount, path=path, ledger=ledger)
        mounts = read_texts(frames, columns.rows, columns.mounts, own_mount, ledger)
        shift = self._shift(calibration)
        table = self._table(camera, indices, camera_models, mounts, shift)
        sensor = self._sensor(table, calibration)
        return [self._depth_sensor(sensor, table) if has_depth else sensor]

    def _match_images(self) -> Int64Array:
        """Open the camera's images, and find the one that each of its entries means, -1 for none."""
        folder, ledger, rows = self.contents.folder, self.ledger, np.asarray(self.columns.rows, np.int64)
        none = np.full(len(rows), -1, np.int64)
        path = _find_images(folder, self.index, ledger)
        if path is None:
            if len(rows):
                ledger.fault("missing-videos", DataError(folder, "", self._missing_images()))
            return none
        try:
            files: ImageFiles = PngFolder(path) if path.is_dir() else open_whole_or_left(path, ledger)
            self.opened.append(files)
            self._check_kind(files)
            numbers, alignment = np.asarray(self.frames.numbers, np.int64), self.contents.image_index
            is_video = isinstance(files, VideoReader)
            cut_off = isinstance(files, VideoReader) and files.is_remainder
            choice = choose_images(numbers, files.count, alignment=alignment, cut_off=cut_off)
            maybe_cut_off = is_video and files.count < len(numbers) and path.suffix in _ENDLESS
            if choice.problem is not None and ledger.lenient and maybe_cut_off:
                files = open_video(path, cut_off=True)
                self.opened.append(files)
                left = choose_images(numbers, files.count, alignment=alignment)
                choice = replace(left, problem=choice.problem)
        except DataError as error:
            ledger.fault("unreadable-videos", error)
            return none
        self.files = files
        if choice.problem is not None:
            left_out = int((choice.indices[rows] < 0).sum())
            ledger.fault("unmatched-images", DataError(path, "", choice.problem), count=max(left_out, 1))
        if choice.by_line:
            message = "frame numbers have gaps, but there are as many images as lines; they were matched line by line"
            ledger.note(WarningKind.REPAIRED, "frame-numbers-not-used", str(path), message)
        return choice.indices[rows]

    def _check_kind(self, files: ImageFiles) -> None:
        offset = self.frames.offsets[self.columns.rows[0]] if self.columns.rows else -1
        stated = _further_fields(self.contents.data_file, offset, self.index).get("colorFormat")
        if stated == _DEPTH_FORMAT and not files.has_steps:
            problem = f"pixels are no 16-bit grey, while lines state colorFormat {_DEPTH_FORMAT!r}"
            raise DataError(files.name, "", f"{problem}; expected a lossless video of 16 bits, as FFV1 makes them")

    def _missing_images(self) -> str:
        videos = f"data{_video_number(self.index)}.{{{','.join(_VIDEO_SUFFIXES)}}}"
        problem = f"no images of camera {self.index}, while data.jsonl has {len(self.columns.rows)} frames of it"
        strays = [
            path.name
            for path in sorted(self.contents.folder.iterdir())
            if path.suffix.lower().removeprefix(".") in _VIDEO_SUFFIXES and not _IMAGES.fullmatch(path.name)
        ]
        hint = f"; in the folder there is {', '.join(strays)}" if strays else ""
        return f"{problem}; expected {videos} or frames{self.index + 1}/00000000.png{hint}"

    def _calibration_of_lines(self, has_depth: bool) -> CameraCalibration:  # noqa: FBT001 - private
        """The camera model of a camera's first line, for one that the calibration does not have."""
        line, path, calibrated = (
            self.frames.lines[self.columns.rows[0]],
            self.contents.data_path,
            self.contents.calibration,
        )
        if self.columns.parameters[0] >= 0:
            return CameraCalibration(f"{path}: line {line}: frames[].cameraParameters", self._first_parameters())
        first = min((other for other in calibrated.cameras if other != self.index), default=None)
        if has_depth and first is not None:
            message = (
                f"depth images of camera {self.index} have no calibration; taken to lie in the pixels of camera {first}"
            )
            self.ledger.note(WarningKind.ASSUMED, "depth-aligned", str(calibrated.path), message)
            return replace(calibrated.cameras[first], entry={})
        location = f"cameras[{self.index}]" if calibrated.path.exists() else ""
        problem = (
            f"missing, while {path.name} has frames of camera {self.index} (line {line}); write its entry "
            "in `cameras` (model, focalLengthX, focalLengthY, principalPointX, principalPointY, imuToCamera), "
            "or give `cameraParameters` in every line"
        )
        raise DataError(calibrated.path, location, problem)

    def _first_parameters(self) -> CameraParameters:
        text, line = list(self.frames.texts)[self.columns.parameters[0]], self.frames.lines[self.columns.rows[0]]
        return read_parameters(text, line, path=self.contents.data_path)

    def _fitted_camera_model(self, calibration: CameraCalibration) -> Camera:
        """The camera model for the images as they are, with a warning where the calibration is for another size."""
        size = None if self.files is None else (self.files.width, self.files.height)
        calibrated = camera_model(calibration.parameters, size, calibration.location)
        if size is None or size == (calibrated.width, calibrated.height):
            return calibrated
        message = f"calibrated for {calibrated.width}x{calibrated.height}, images are {size[0]}x{size[1]}"
        message = f"{message}; the camera model was scaled"
        self.ledger.note(WarningKind.REPAIRED, "camera-model-scaled", calibration.location, message)
        return calibrated.resized(*size)

    def _shift(self, calibration: CameraCalibration) -> float:
        """What is to be added to the times of the camera's images [s]."""
        factor = CAMERA_SHIFTS[self.contents.camera_shift]
        if calibration.shift:
            code, message = _SHIFT_MESSAGES[factor]
            message = f"{_SHIFT_KEY} {calibration.shift} {message}"
            self.ledger.note(WarningKind.ASSUMED, code, calibration.location, message)
        return factor * calibration.shift

    def _table(
        self,
        camera: Camera,
        indices: Int64Array,
        camera_models: Mapping[int, Camera],
        mounts: Mapping[int, RigidTransform],
        shift: float,
    ) -> _ImageTable:
        """The entries in the order of time; those without image, camera model or mounting are left out."""
        columns, frames = self.columns, self.frames
        camera_model_texts, mount_texts = np.asarray(columns.parameters, np.int64), np.asarray(columns.mounts, np.int64)
        missing = np.asarray(columns.missing, np.bool_)
        usable = (indices >= 0) & ~missing
        usable &= np.isin(camera_model_texts, [_OWN, *camera_models]) & np.isin(mount_texts, [_OWN, *mounts])
        seconds = view(columns.seconds)
        chosen = np.flatnonzero(usable)[time_order(seconds[usable])]
        lines = np.asarray(columns.rows, np.int64)[chosen]
        if missing.any():
            message = f"frames of camera {self.index} state `missingBitmap`; they have no image"
            location, count = str(self.contents.data_path), int(missing.sum())
            self.ledger.note(WarningKind.SKIPPED, "missing-bitmaps", location, message, count=count)
        return _ImageTable(
            camera_index=self.index,
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
            data_file=self.contents.data_file,
            files=self.files,
        )

    def _sensor(self, table: _ImageTable, calibration: CameraCalibration) -> CameraSensor:
        camera = table.camera
        if len(table.camera_model_texts) and (table.camera_model_texts != _OWN).all():
            # none uses the camera model of the calibration
            camera = table.camera_models[int(table.camera_model_texts[0])]
        ego_from_camera = self._mount(table, calibration)
        self._note_unused(table, calibration, camera, ego_from_camera)
        entry = dict(calibration.entry)
        if CAMERA_SHIFTS[self.contents.camera_shift]:
            entry.pop(_SHIFT_KEY, None)
        mounts = table.mounts if ego_from_camera is None else {_OWN: ego_from_camera, **table.mounts}
        return CameraSensor(
            id=f"camera{self.index}",
            camera=camera,
            images=LazyFrames(table.timestamps_ns, table.image),
            poses=poses_along(self.contents.ego_path, mounts, table.mount_texts, table.timestamps_ns),
            mount=ego_from_camera,
            video=self._video(table.indices),
            fps=None if self.files is None else self.files.fps,
            extras=MappingProxyType({"calibration": entry} if entry else {}),
        )

    def _mount(self, table: _ImageTable, calibration: CameraCalibration) -> RigidTransform | None:
        """The mounting of the calibration; that of the first image where each image has its own."""
        if len(table.mount_texts) and (table.mount_texts != _OWN).all():
            return table.mounts[int(table.mount_texts[0])]
        if calibration.camera_from_imu is not None:
            return calibration.camera_from_imu.inverse()
        first = next(iter(table.mounts.values()), None)
        if first is None:
            problem = (
                "imuToCamera is missing: where the camera is on the vehicle; expected 4 rows of 4 numbers, which take "
                "points of the IMU into the camera (a lenient reading keeps the camera without it)"
            )
            self.ledger.fault("mounts-missing", DataError(calibration.location, "", problem))
        elif (table.mount_texts == _OWN).any():
            message = "frames without imuToCamera, of a camera whose calibration has none: taken as in its first frame"
            self.ledger.note(WarningKind.ASSUMED, "mounts-of-first-frame", calibration.location, message)
        return first

    def _note_unused(
        self, table: _ImageTable, calibration: CameraCalibration, camera: Camera, ego_from_camera: RigidTransform | None
    ) -> None:
        """Report which values of calibration.json no image uses, where those of the images are others."""
        location, name = calibration.location, self.contents.data_name
        if camera != table.camera:
            message = (
                f"every image has cameraParameters of its own in {name}, and they differ from these "
                f"(focalLengthX {camera.fx:.6g} px instead of {table.camera.fx:.6g}); the images' are used"
            )
            self.ledger.note(WarningKind.SKIPPED, "calibration-not-used", location, message)
        if calibration.camera_from_imu is None or ego_from_camera is None:
            return
        moved = calibration.camera_from_imu @ ego_from_camera
        rotated = math.degrees(float(angle_between(moved.quaternion_xyzw, np.array([0.0, 0.0, 0.0, 1.0]))))
        metres = float(np.linalg.norm(moved.inverse().translation))
        if metres > _SAME_M or rotated > _SAME_DEG:
            message = (
                f"every image has an imuToCamera of its own in {name}, {metres:.3g} m and {rotated:.3g} degrees from "
                "this one; the images' are used"
            )
            self.ledger.note(WarningKind.SKIPPED, "calibration-not-used", location, message)

    def _video(self, indices: Int64Array) -> VideoContent | None:
        files = self.files
        # of what is left of a video the images can be decoded, but its file cannot be handed on
        if not isinstance(files, VideoReader) or files.is_remainder:
            return None
        in_order = np.array_equal(indices, np.arange(files.count))
        frame_indices = None if in_order else tuple(indices.tolist())
        return VideoContent(open=files.open_file, codec=files.codec, frame_indices=frame_indices)

    def _depth_sensor(self, camera: CameraSensor, table: _ImageTable) -> DepthCameraSensor:
        """The camera whose images are steps of depth, made of the same one as if they were colours."""
        count = len(table.seconds)
        scale = _further_fields(table.data_file, int(table.offsets[0]), self.index).get("depthScale") if count else None
        if scale is None and count:
            message = f"no depthScale for camera {self.index}; taken to be {_DEFAULT_SCALE:g} m a step"
            self.ledger.note(WarningKind.ASSUMED, "depth-scale-assumed", table.data_file.name, message)
        usual = table.checked_scale(_DEFAULT_SCALE if scale is None else scale)
        return DepthCameraSensor(
            id=camera.id,
            camera=camera.camera,
            frames=LazyFrames(table.timestamps_ns, partial(table.depth_frame, usual=usual)),
            poses=camera.poses,
            mount=camera.mount,
            coordinates=camera.coordinates,
            video=camera.video,
            fps=camera.fps,
            extras=camera.extras,
        )
