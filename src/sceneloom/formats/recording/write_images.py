"""Images of a recording as videos or PNG files, and the `frames` lines that name them."""

import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import msgspec
import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, UInt8Array, UInt16Array, check_array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.base.text_tables import TimeWriter
from sceneloom.formats.recording.calibration import CameraParameters, camera_model, read_mount, read_parameters
from sceneloom.formats.recording.cameras import OWN_FIELDS, FrameNotes, choose_images, image_name
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.lines import record_keys, with_frames
from sceneloom.formats.recording.write_calibration import camera_model_entry, matrix_entry
from sceneloom.formats.recording.write_lines import LineStream, make_line
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.writer import VideoWriter, copy_to_matroska, is_lossless
from sceneloom.geometry.rigid import RigidTransform
from sceneloom.scene.cameras import (
    CameraImage,
    CameraSensor,
    DepthCameraSensor,
    DepthFrame,
    ShootingSensor,
    Shot,
    VideoContent,
    shots_of,
)

IMAGES = ("copy", "lossless", "h264", "ffv1", "png")
"""Ways to keep images."""

_ENCODED_AS = {"copy": "h264", "lossless": "ffv1"}  # codecs for videos that should have been copied and cannot be

_SPELT = {"h264": "H.264", "ffv1": "FFV1, which loses nothing"}

_PNG_EFFORT = 1  # images of scenes shrink little more with more effort, at many times the time

_EBML = b"\x1a\x45\xdf\xa3"  # how a Matroska file begins. Source: RFC 8794, section 11.2.1

_COPIED_AT_ONCE = 1 << 20
_DEFAULT_FPS = 10.0

_DEPTH_STEPS = (0.001, 0.002, 0.005, 0.01)
"""Lengths of a step that are tried, the smallest first, where the source has no steps [m]."""

_COLOR_FORMAT = "gray16"  # what the vendor's software calls images of 16-bit steps

_LARGEST = 65535

_OFF_STEP = 0.01  # share of a step that a depth may be off and still be one: float32 holds 65535 steps to 0.004 of one


class _SteppedDepth(NamedTuple):
    """A depth image in steps, 0 for none; how many depths were rounded, and how many are beyond 16 bits."""

    steps: UInt16Array
    rounded: int
    beyond: int


def to_steps(depth: Float32Array, scale: float) -> _SteppedDepth:
    """Round depths to steps; one too small for the first step becomes one step.

    Args:
        depth: (H, W) float32 [m], 0 for none.
        scale: length of a step [m].
    """
    exact = depth.astype(np.float64) / scale
    whole = np.rint(exact)
    whole[(exact > 0) & (whole == 0)] = 1
    holdable = (whole >= 0) & (whole <= _LARGEST)
    exact, whole = np.where(holdable, exact, 0.0), np.where(holdable, whole, 0.0)
    rounded = int(np.count_nonzero(np.abs(exact - whole) > _OFF_STEP))
    return _SteppedDepth(whole.astype(np.uint16), rounded, int((~holdable).sum()))


class _Pixels(Protocol):
    """Makes the images of one camera as they are encoded."""

    width: int  # as they are encoded [px]
    height: int
    blank: UInt8Array | UInt16Array  # what a line before the first image gets
    losses: list[Loss]  # added to as images are made

    def fields(self, shot: Shot) -> dict[str, Any]:
        """What the entry of an image has to report so that it can be read."""
        ...

    def of(self, shot: Shot) -> UInt8Array | UInt16Array | None:
        """What is encoded, of the shape of `blank`; None of what is no image of this camera."""
        ...


class _ColorPixels:
    """The images of a camera; those of an odd size lose their last line or column in H.264."""

    def __init__(self, sensor: CameraSensor, codec: str) -> None:
        camera = sensor.camera
        self.width, self.height = camera.width, camera.height
        self.losses: list[Loss] = []
        self._full = (camera.height, camera.width, 3)
        if codec == "h264":
            self.width, self.height = camera.width - camera.width % 2, camera.height - camera.height % 2
            field, count = f"sensors[{sensor.id}].images[].rgb", len(sensor.images)
            what = "encoded as H.264, which changes colours a little"
            self.losses.append(Loss(field=field, what=what, count=count, support=Support.APPROXIMATED))
            if (self.width, self.height) != (camera.width, camera.height):
                sizes = f"{camera.width}x{camera.height} to {self.width}x{self.height}"
                self.losses.append(Loss(field=field, what=f"cut from {sizes}: H.264 needs even sizes", count=count))
        self.blank: UInt8Array | UInt16Array = np.broadcast_to(np.uint8(0), (self.height, self.width, 3))

    def fields(self, shot: Shot) -> dict[str, Any]:  # noqa: ARG002 - colours say what they are
        return {}

    def of(self, shot: Shot) -> UInt8Array | None:
        if not isinstance(shot, CameraImage):
            return None
        rgb = shot.rgb
        name = f"the image at {shot.timestamp_ns} ns (a recording's camera has images of one size)"
        check_array(name, rgb, self._full, np.uint8)
        return rgb[: self.height, : self.width]


class _DepthPixels:
    """The images of a depth camera as 16-bit steps, of their own length or else of one that suits them all."""

    def __init__(self, sensor: DepthCameraSensor) -> None:
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.blank: UInt8Array | UInt16Array = np.zeros((self.height, self.width), np.uint16)
        self.losses: list[Loss] = []
        self._sensor = sensor
        self._common_scale: float | None = None

    def fields(self, shot: Shot) -> dict[str, Any]:
        if not isinstance(shot, DepthFrame):
            return {}
        return {"colorFormat": shot.extras.get("colorFormat", _COLOR_FORMAT), "depthScale": self._scale(shot)}

    def of(self, shot: Shot) -> UInt16Array | None:
        if not isinstance(shot, DepthFrame):
            return None
        depth, scale = shot.depth, self._scale(shot)
        check_array("depth", depth, (self.height, self.width), np.float32)
        found = to_steps(depth, scale)
        counts = {
            f"rounded to steps of {scale:g} m": found.rounded,
            f"left out: no number, negative, or beyond {_LARGEST * scale:g} m": found.beyond,
        }
        field = f"sensors[{self._sensor.id}].frames[].depth"
        self.losses += [Loss(field=field, what=what, count=count) for what, count in counts.items() if count]
        return found.steps

    def _scale(self, frame: DepthFrame) -> float:
        """The length of an image's steps [m]."""
        if frame.scale is None:
            if self._common_scale is None:
                self._common_scale = self._find_common_scale()
            return self._common_scale
        if not 0 < frame.scale < np.inf:
            location = f"depth camera {self._sensor.id!r}: image at {frame.timestamp_ns} ns"
            raise OptionError(f"{location}: scale {frame.scale}; expected a length in metres")
        return frame.scale

    def _find_common_scale(self) -> float:
        """The smallest step that holds the largest depth [m]; each image is decoded and let go."""
        largest = 0.0
        for frame in self._sensor.frames:
            if frame.scale is None:
                depth = frame.depth
                largest = max(largest, float(depth[np.isfinite(depth)].max(initial=0.0)))
        return next((scale for scale in _DEPTH_STEPS if round(largest / scale) <= _LARGEST), _DEPTH_STEPS[-1])


class _PngWriter:
    """Writes images as numbered PNG files."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self._folder, self._count = folder, 0

    def add(self, image: UInt8Array | UInt16Array, timestamp_seconds: float | None = None) -> None:  # noqa: ARG002
        from PIL import Image

        file = self._folder / image_name(self._count)
        Image.fromarray(np.ascontiguousarray(image)).save(file, compress_level=_PNG_EFFORT)
        self._count += 1

    def close(self) -> None:
        """Do nothing: every file is whole."""


class _ImageSink:
    """Takes the images of one camera, one per `frames` line; a line without one gets the image before."""

    def __init__(self, pixels: _Pixels, writer: VideoWriter | _PngWriter | None) -> None:
        """Begin; there is no writer for a video that is copied, which is there already."""
        self.width, self.height, self.losses, self.fields = pixels.width, pixels.height, pixels.losses, pixels.fields
        self._pixels, self._writer, self._last, self._last_ns = pixels, writer, pixels.blank, -(2**63)

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Take an image; None for a line in which the camera has none."""
        if self._writer is None:
            return
        image = None if shot is None else self._pixels.of(shot)
        self._last = self._last if image is None else image
        # the time of a line without an image can be before that of an image whose entry has a time of its own
        self._last_ns = max(timestamp_ns, self._last_ns)
        self._writer.add(self._last, self._last_ns / 1e9)

    def close(self) -> None:
        """Finish the files."""
        if self._writer is not None:
            self._writer.close()


def _open_sink(sensor: ShootingSensor, folder: Path, index: int, rows: Int64Array, *, images: str) -> _ImageSink:
    """Choose how a camera's images are kept, and start; `rows` (N,): which of its images each line has, -1 for none."""
    # `images`: "copy" is the camera's own video where it can be copied, else H.264, or FFV1 where that video has lost
    # nothing; "lossless" the same, else FFV1; "h264" and "ffv1" the own video only if it is that already. Depth is
    # always kept as its own video, or as FFV1.
    path = folder / f"data{index + 1 if index else ''}.mkv"
    if isinstance(sensor, DepthCameraSensor):
        depth = _DepthPixels(sensor)
        if _copied(sensor, path, rows, codecs=("ffv1",)) and all(frame.scale is not None for frame in sensor.frames):
            return _ImageSink(depth, None)
        return _ImageSink(depth, VideoWriter(path, depth.width, depth.height, _fps(sensor), codec="ffv1-gray16"))
    if images == "png":
        sink = _ImageSink(_ColorPixels(sensor, "png"), _PngWriter(folder / f"frames{index + 1}"))
        if sensor.fps:
            sink.losses.append(Loss(field=f"sensors[{sensor.id}].fps", what="left out: files have no rate"))
        return sink
    if _copied(sensor, path, rows, codecs=None if images in _ENCODED_AS else (images,)):
        return _ImageSink(_ColorPixels(sensor, "copy"), None)
    codec = _ENCODED_AS.get(images, images)
    if images == "copy" and sensor.video is not None and is_lossless(sensor.video.codec):
        codec = "ffv1"
    pixels = _ColorPixels(sensor, codec)
    sink = _ImageSink(pixels, VideoWriter(path, pixels.width, pixels.height, _fps(sensor), codec=codec))
    if sensor.video is not None and images in {*_ENCODED_AS, sensor.video.codec}:
        what = f"encoded anew as {_SPELT[codec]}: the video could not be copied for these images alone"
        field = f"sensors[{sensor.id}].video"
        sink.losses.append(Loss(field=field, what=what, support=Support.APPROXIMATED))
    return sink


def _fps(sensor: ShootingSensor) -> float:
    """Nominal images a second."""
    timestamps = shots_of(sensor).timestamps_ns
    if sensor.fps:
        return sensor.fps
    span = (int(timestamps[-1]) - int(timestamps[0])) * 1e-9 if len(timestamps) > 1 else 0.0
    return (len(timestamps) - 1) / span if span > 0 else _DEFAULT_FPS


def _copied(sensor: ShootingSensor, path: Path, rows: Int64Array, *, codecs: tuple[str, ...] | None) -> bool:
    """Copy the camera's own video, cut to the images of the lines, where that needs no decoding."""
    video, count = sensor.video, len(shots_of(sensor))
    if video is None or (codecs is not None and video.codec not in codecs) or count == 0:
        return False
    whole = video.frame_indices is None
    indices = np.arange(count) if video.frame_indices is None else np.asarray(video.frame_indices, np.int64)
    taken = _images_of_lines(indices, rows)
    if taken is None:
        return False
    name = f"video of {sensor.id}"
    if whole and len(taken) == count and _is_matroska(video, count, name):
        with video.open() as source, path.open("wb") as target:
            shutil.copyfileobj(source, target, _COPIED_AT_ONCE)
        return True
    images = count if whole else None
    return copy_to_matroska(video.open, path, images=images, frame_indices=taken, name=name) is not None


def _images_of_lines(indices: Int64Array, rows: Int64Array) -> Int64Array | None:
    """Image of the video for each line, (L,) ascending; None where the video has none for a line."""
    # `indices`: image in the video of each of the camera's; `rows` (L,): which of these each line has. A line with -1
    # takes one between its neighbours', which nobody looks at.
    known = np.flatnonzero(rows >= 0)
    if len(known) == 0:
        return None
    chosen = indices[rows[known]]
    if (np.diff(chosen) < np.diff(known)).any() or chosen[0] < known[0]:
        return None
    lines = np.arange(len(rows))
    before = np.maximum(np.searchsorted(known, lines, side="right") - 1, 0)
    taken: Int64Array = chosen[before] + lines - known[before]
    return taken


def _is_matroska(video: VideoContent, count: int, name: str) -> bool:
    """Whether a video is as we would write it, so that its file can be copied byte by byte."""
    with video.open() as file:
        if file.read(len(_EBML)) != _EBML:
            return False
    with VideoReader(video.open, name=name) as reader:
        return reader.index.timed and reader.index.hidden == 0 and reader.count == count


_DEFAULT_PERIOD_NS = 100_000_000

_ROUNDED_NS = 500
"""Scene files in microseconds round times by so much [ns]; the lines that images belong to stay the same."""

_Key = tuple[int, float, int, int]
"""Time of a line [ns] and [s], its number, and how many lines of these come before it."""


@dataclass(frozen=True, slots=True, eq=False)
class _ImageRows:
    """Which image of each camera each line has; lines in the order of time."""

    images: Int64Array  # (L, C), -1 for none
    seconds: Sequence[float] | None = None  # times of the lines [s]; None: of their first images
    lines: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)  # by row, what a line stated that lacks images
    first: int = 0  # `number` of the first line
    numbers: Sequence[int] | None = None  # as they were read; None: counted from `first` on
    losses: Sequence[Loss] = ()  # what of the lines as they were read is not written


def _image_rows(sensors: Sequence[ShootingSensor], notes: FrameNotes | None) -> _ImageRows:
    """Group images of cameras, by `cameraInd`, into lines: as in `notes` where times are still the same."""
    if not sensors:
        return _ImageRows(np.zeros((0, 0), np.int64))
    rows = _as_read(sensors, notes) if notes is not None and notes.own else None
    if rows is None:
        rows = _ImageRows(group_images([shots_of(sensor).timestamps_ns for sensor in sensors]))
    if notes is None:
        return rows
    losses, count, numbers, first = list[Loss](), len(rows.images), None, 0
    if count == notes.count and notes.first is not None:
        first = notes.first
    elif count == notes.count:
        numbers = _numbers_as_read(sensors, rows)
        if numbers is None:
            what = "counted from 0: they did not grow from line to line, and would mean other images"
            losses.append(Loss(field="frames[].number", what=what, count=count, support=Support.KEPT))
    if notes.own and rows.seconds is None:
        what = "put together anew by the times of their images, which are not those that were read"
        losses.append(Loss(field="frames", what=what, count=count, support=Support.KEPT))
    return replace(rows, first=first, numbers=numbers, losses=losses)


def _numbers_as_read(sensors: Sequence[ShootingSensor], rows: _ImageRows) -> list[int] | None:
    """Numbers of lines that do not grow by one; None if one is unknown, or the video's image of a line is another."""
    numbers = []
    for row, images in enumerate(rows.images.tolist()):
        shots = [shots_of(sensor)[k] for sensor, k in zip(sensors, images, strict=True) if k >= 0]
        known = [shot.extras.get("number") for shot in shots] or [rows.lines.get(row, {}).get("number")]
        if type(known[0]) is not int or known.count(known[0]) < len(known):
            return None
        numbers.append(known[0])
    found = choose_images(np.array(numbers, np.int64), len(numbers)).indices
    return numbers if np.array_equal(found, np.arange(len(numbers))) else None


def group_images(timestamps: Sequence[Int64Array]) -> Int64Array:
    """Find which images share a line: those within half a period of the earliest, at most one per camera.

    Args:
        timestamps: per camera, (N,) int64 [ns], ascending.

    Returns:
        (L, C) int64: for each line and camera the index of the image, -1 for none; lines in time order.
    """
    steps = [np.diff(times) for times in timestamps]
    periods = [float(np.median(step[step > 0])) for step in steps if (step > 0).any()]
    half_ns = min(periods, default=_DEFAULT_PERIOD_NS) / 2
    cameras = np.concatenate([np.full(len(times), c, np.int64) for c, times in enumerate(timestamps)])
    indices = np.concatenate([np.arange(len(times), dtype=np.int64) for times in timestamps])
    times = np.concatenate(list(timestamps))
    lines: list[list[int]] = []
    start_ns = 0
    for k in np.argsort(times, kind="stable").tolist():
        camera, timestamp = int(cameras[k]), int(times[k])
        if not lines or lines[-1][camera] >= 0 or timestamp - start_ns >= half_ns:
            lines.append([-1] * len(timestamps))
            start_ns = timestamp
        lines[-1][camera] = int(indices[k])
    return np.array(lines, np.int64).reshape(len(lines), len(timestamps))


def _grouping_losses(sensors: Sequence[ShootingSensor], rows: _ImageRows) -> list[Loss]:
    """Report where cameras are not in step, so that lines lack some of their images, unless that was read so."""
    fresh = [row for row in range(len(rows.images)) if row not in rows.lines]
    missing = (rows.images[fresh] < 0).sum(axis=0).tolist()
    what = "is not in step with the other cameras: its video repeats an image where a line has none of its own"
    return [
        Loss(field=_field_of(sensor), what=what, count=count, support=Support.CONVERTED)
        for sensor, count in zip(sensors, missing, strict=True)
        if count
    ]


def _as_read(sensors: Sequence[ShootingSensor], notes: FrameNotes) -> _ImageRows | None:
    """Bring images together that were in one line; None where one has another time, or none reports its line."""
    members: dict[_Key, list[int]] = {}
    for location, sensor in enumerate(sensors):
        seen = Counter[tuple[int, float, int]]()
        for k, shot in enumerate(shots_of(sensor)):
            line = _line_of(shot)
            if line is None:
                return None
            members.setdefault((*line, seen[line]), [-1] * len(sensors))[location] = k
            seen[line] += 1
    lines = _kept_lines(notes.texts)
    if len(members.keys() | lines.keys()) == notes.count:
        # nothing was cut: lines without any image have their places
        members = {key: members.get(key) or [-1] * len(sensors) for key in [*members, *lines]}
    keys = sorted(members)
    return _ImageRows(
        images=np.array([members[key] for key in keys], np.int64).reshape(len(keys), len(sensors)),
        seconds=[key[1] for key in keys],
        lines={row: lines[key] for row, key in enumerate(keys) if key in lines},
    )


def _line_of(shot: Shot) -> tuple[int, float, int] | None:
    seconds, number = shot.extras.get("file_seconds"), shot.extras.get("number")
    own = shot.extras.get("line_seconds", seconds)
    if not (isinstance(seconds, float) and isfinite(seconds) and type(number) is int):
        return None
    if not (isinstance(own, float) and isfinite(own)) or abs(round(seconds * 1e9) - shot.timestamp_ns) > _ROUNDED_NS:
        return None
    return round(own * 1e9), own, number


def _kept_lines(texts: Sequence[str]) -> dict[_Key, Mapping[str, Any]]:
    lines: dict[_Key, Mapping[str, Any]] = {}
    seen = Counter[tuple[int, float, int]]()
    for text in texts:
        try:
            content = with_frames(msgspec.json.decode(text, type=dict[str, Any]))
            seconds, number = float(content["time"]), int(content["number"])
            timestamp, known = round(seconds * 1e9), [entry["cameraInd"] for entry in content["frames"]]
            elsewhere = record_keys(content) - {"frames"}
        except (*DECODER_FAULTS, KeyError, TypeError, ValueError, OverflowError):
            continue
        if all(type(index) is int for index in known):
            key = (timestamp, seconds, number)
            lines[(*key, seen[key])] = {k: v for k, v in content.items() if k not in elsewhere}
            seen[key] += 1
    return lines


_CAMERA_MODEL, _MOUNT = "cameraParameters", "imuToCamera"
"""Fields of an entry, and extras of an image that has been read with them."""

_NO_FILE = Path("data.jsonl")

_OWN_EXTRAS = OWN_FIELDS | {_CAMERA_MODEL, _MOUNT}  # extras of an image that its line is made from anew

_OWN_DEPTH_EXTRAS = frozenset({"colorFormat", "depthScale"})
"""Those of a depth image that are reported by how it is written."""

_FORMATS_WORDS = {"exposureTimeSeconds"}
"""Extras that mean the same whatever a scene was read from: words of the recording format that the model took over."""

_OWN_KEYS = {"frames", "number", "time"}
_CAMERA = re.compile(r"camera(\d+)")


class _ImageParameters:
    """Writes camera models and mountings of single images; `losses`: camera models that the format does not have."""

    def __init__(self, sensor: ShootingSensor, width: int, height: int) -> None:
        """Begin; width and height are those of the images as they are written [px]."""
        self.losses: list[Loss] = []
        self._sensor, self._size = sensor, (width, height)
        self._calibrated: CameraParameters | None = None
        self._last: dict[str, tuple[bytes, Any]] = {}

    def fields(self, shot: Shot, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Give what is an image's own: in the words that it was read with (`kept`), where they still mean it."""
        sensor, fields = self._sensor, dict[str, Any]()
        if _CAMERA_MODEL in kept and self._same_camera(kept[_CAMERA_MODEL], shot.camera):
            fields[_CAMERA_MODEL] = kept[_CAMERA_MODEL]
        elif _CAMERA_MODEL in kept or shot.camera != sensor.camera:
            written, how_far = camera_model_entry(shot.camera, model_key="distortionModel")
            fields[_CAMERA_MODEL] = {k: v for k, v in written.items() if not k.startswith("image")}
            if how_far is not None:
                field = f"{_field_of(sensor)}[].camera"
                self.losses.append(Loss(field=field, what=how_far, support=Support.APPROXIMATED))
        if shot.mount is None:
            return fields
        if _MOUNT in kept and self._same_mount(kept[_MOUNT], shot.mount):
            fields[_MOUNT] = kept[_MOUNT]
        elif _MOUNT in kept or shot.mount is not sensor.mount:
            fields[_MOUNT] = matrix_entry(shot.mount.inverse())
        return fields

    def _same_camera(self, words: Any, camera: Camera) -> bool:
        read = self._read(_CAMERA_MODEL, words)
        width, height = self._size
        return read is not None and _without_zeros(read) == _without_zeros(replace(camera, width=width, height=height))

    def _same_mount(self, words: Any, mount: RigidTransform) -> bool:
        read = self._read(_MOUNT, words)
        return read is not None and np.array_equal(read.matrix, mount.matrix)

    def _read(self, key: str, words: Any) -> Any:
        """What a reader of the written recording makes of the words; None where it would have to repair them."""
        text = msgspec.json.encode(words)
        if self._last.get(key, (b"", None))[0] != text:
            self._last[key] = text, self._read_anew(key, text)
        return self._last[key][1]

    def _read_anew(self, key: str, text: bytes) -> Camera | RigidTransform | None:
        ledger, (width, height) = Ledger(lenient=True), self._size
        try:
            if key == _MOUNT:
                mount = read_mount(text, 0, path=_NO_FILE, ledger=ledger)
                return None if ledger.warnings else mount
            if self._calibrated is None:
                entry, _ = camera_model_entry(replace(self._sensor.camera, width=width, height=height))
                self._calibrated = msgspec.convert(entry, CameraParameters)
            parameters = read_parameters(text, 0, path=_NO_FILE).over(self._calibrated)
            return camera_model(parameters, self._size, "").resized(width, height)
        except (SceneloomError, msgspec.ValidationError):
            return None


def _without_zeros(camera: Camera) -> Camera:
    """A camera without the zeros that other formats add at the end of its coefficients."""
    count = max((k + 1 for k, value in enumerate(camera.coefficients) if value), default=0)
    return replace(camera, coefficients=camera.coefficients[:count])


class FrameLines:
    """Writes the images of all cameras, and makes the `frames` lines, each after its images were written.

    Attributes:
        sizes: width and height of each camera's images as they are written [px]; empty where there are no images.
    """

    def __init__(
        self,
        sensors: Sequence[ShootingSensor],
        folder: Path,
        notes: FrameNotes | None,
        times: TimeWriter,
        *,
        images: str,
        keep_extras: bool,
    ) -> None:
        """Begin.

        Args:
            sensors: the cameras, in the order of `cameraInd`.
            folder: the recording that is being written.
            notes: what is known of the lines that the images were read from.
            times: writes the times.
            images: how images are kept, one of `IMAGES`.
            keep_extras: whether unknown fields of images are a recording's own, to be written back.
        """
        self._sensors, self._times, self._keep_extras = sensors, times, keep_extras
        self._rows = rows = _image_rows(sensors, notes)
        self._losses: list[Loss] = list(rows.losses)
        matches = [_CAMERA.fullmatch(str(sensor.id)) for sensor in sensors]
        self._read_as = [index if match is None else int(match[1]) for index, match in enumerate(matches)]
        self._not_listed = 0
        self._sinks: list[_ImageSink] = []
        with ExitStack() as unfinished:
            unfinished.callback(self.__exit__)
            for index, sensor in enumerate(sensors if len(rows.images) else ()):
                self._sinks.append(_open_sink(sensor, folder, index, rows.images[:, index], images=images))
            unfinished.pop_all()
        self.sizes = [(sink.width, sink.height) for sink in self._sinks]
        self._parameters = [_ImageParameters(sensor, *size) for sensor, size in zip(sensors, self.sizes, strict=False)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close what is not finished."""
        for sink in self._sinks:
            with suppress(SceneloomError):
                sink.close()

    def close(self) -> None:
        """Finish the files of images."""
        for sink in self._sinks:
            sink.close()

    @property
    def image_losses(self) -> list[Loss]:
        """What of the images could not be written, and where cameras are not in step."""
        return [loss for sink in self._sinks for loss in sink.losses] + _grouping_losses(self._sensors, self._rows)

    @property
    def losses(self) -> list[Loss]:
        """What could not be written."""
        what = "`frames` lines that do not list every camera, as they were read: the vendor's software refuses them"
        short = [Loss(field="replay", what=what, count=self._not_listed, support=Support.KEPT)][: self._not_listed]
        return [*self._losses, *(loss for writer in self._parameters for loss in writer.losses), *short]

    def stream(self) -> LineStream:
        """The lines, each made after its images were handed on."""
        images, seconds = self._rows.images, self._rows.seconds
        if seconds is not None:
            return LineStream(np.array([round(time * 1e9) for time in seconds], np.int64), self._lines())
        latest = np.iinfo(np.int64).max
        timestamps = np.full(images.shape, latest)
        for column, sensor in enumerate(self._sensors):
            there = images[:, column] >= 0
            timestamps[there, column] = shots_of(sensor).timestamps_ns[images[there, column]]
        return LineStream(timestamps.min(axis=1, initial=latest), self._lines())

    def _lines(self) -> Iterator[str]:
        seconds, numbers = self._rows.seconds, self._rows.numbers
        for row, images in enumerate(self._rows.images.tolist()):
            pairs = zip(self._sensors, images, strict=True)
            shots: list[Shot | None] = [shots_of(sensor)[k] if k >= 0 else None for sensor, k in pairs]
            first = min((shot for shot in shots if shot is not None), key=_time, default=None)
            kept = self._rows.lines.get(row)
            of_line = None if seconds is None else (round(seconds[row] * 1e9), seconds[row])
            of_first = None if first is None else (first.timestamp_ns, first.extras.get("file_seconds"))
            entries = [self._entry(c, shot, of_first or of_line or (0, 0.0), kept) for c, shot in enumerate(shots)]
            fields = {
                **self._beside(first, kept),
                "frames": [entry for entry in entries if entry is not None],
                "number": self._rows.first + row if numbers is None else numbers[row],
            }
            timestamp_ns, reported = of_line or of_first or (0, 0.0)
            yield make_line(fields, timestamp_ns, self._times, reported)

    def _beside(self, first: Shot | None, kept: Mapping[str, Any] | None) -> Mapping[str, Any]:
        """What the line states beside its images."""
        if kept is not None:
            return {key: value for key, value in kept.items() if key not in _OWN_KEYS}
        beside = first.extras.get("line", {}) if first is not None and self._keep_extras else {}
        return beside if isinstance(beside, Mapping) else {}

    def _entry(
        self, index: int, shot: Shot | None, time: tuple[int, float | None], kept: Mapping[str, Any] | None
    ) -> dict[str, Any] | None:
        """The entry of a camera; None for a camera that the line did not list."""
        sink = self._sinks[index]
        sink.add(shot, time[0] if shot is None else shot.timestamp_ns)
        if shot is not None:
            seconds = self._times.raw(shot.timestamp_ns, shot.extras.get("file_seconds"))
            own = self._parameters[index].fields(shot, shot.extras if self._keep_extras else {})
            return {**self._extras(index, shot), "cameraInd": index, "time": seconds, **sink.fields(shot), **own}
        read_as = self._read_as[index]
        listed = kept["frames"] if kept is not None else [{"cameraInd": read_as}]
        before = next((entry for entry in listed if entry["cameraInd"] == read_as), None)
        if before is None:
            self._not_listed += 1
            return None
        own = before if before.get("missingBitmap") is True else {}
        own_time = self._times.raw(*time) if own.get("time") is None else own["time"]
        return {**own, "cameraInd": index, "time": own_time, "missingBitmap": True}

    def _extras(self, index: int, shot: Shot) -> dict[str, Any]:
        own = _OWN_EXTRAS | (_OWN_DEPTH_EXTRAS if isinstance(shot, DepthFrame) else frozenset())
        further = {key: value for key, value in shot.extras.items() if key not in own}
        if self._keep_extras:
            hidden = shot.extras.get("entry", {})
            return {**further, **hidden} if isinstance(hidden, Mapping) else further
        for name in [name for name in further if name not in _FORMATS_WORDS]:
            field = f"{_field_of(self._sensors[index])}[].{name}"
            self._losses.append(Loss(field=field, what="left out: the format has none"))
        return {name: value for name, value in further.items() if name in _FORMATS_WORDS}


def _time(shot: Shot) -> tuple[int, float]:
    seconds = shot.extras.get("file_seconds")
    return shot.timestamp_ns, shot.timestamp_ns / 1e9 if seconds is None else seconds


def _field_of(sensor: ShootingSensor) -> str:
    """The path of a camera's images or depth images, for loss reports."""
    return f"sensors[{sensor.id}].{'images' if isinstance(sensor, CameraSensor) else 'frames'}"
