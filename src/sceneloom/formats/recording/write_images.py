"""Cameras of a recording: their calibration, images as videos or PNG files, and the `frames` lines that name them."""

import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import msgspec
import numpy as np

from sceneloom.arrays import (
    Float32Array,
    Int64Array,
    UInt8Array,
    UInt16Array,
    check_array,
)
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import CalibrationError, OptionError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, Support
from sceneloom.formats.base.poses import field_of
from sceneloom.formats.base.text_tables import TimeWriter
from sceneloom.formats.recording.calibration import (
    CameraParameters,
    camera_model,
    read_mount,
    read_parameters,
    rigid_transform,
)
from sceneloom.formats.recording.cameras import OWN_FIELDS, FrameNotes, choose_images, image_name
from sceneloom.formats.recording.json_faults import DECODER_FAULTS
from sceneloom.formats.recording.legacy import has_old_frame, with_frames
from sceneloom.formats.recording.write_lines import (
    FRAMES,
    LineStream,
    OneByOne,
    WrittenLine,
    main_receiver,
    make_line,
)
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.remux import copy_to_matroska
from sceneloom.formats.video.writer import VideoWriter, is_lossless
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
from sceneloom.scene.clouds import LidarSensor
from sceneloom.scene.motion import GnssSensor
from sceneloom.scene.scene import Scene


def matrix_entry(transform: RigidTransform) -> list[list[float]]:
    """A transform as four rows of four numbers."""
    rows: list[list[float]] = transform.matrix.tolist()
    return rows


def mount_entry(mount: RigidTransform, before: Mapping[str, Any], *keys: str) -> list[list[float]]:
    """Write a mounting: with the numbers of the entry that it was read from, where they still mean it.

    Args:
        mount: `ego_from_sensor`.
        before: the entry.
        keys: under which of its keys the matrix may stand.
    """
    for numbers in (before[key] for key in keys if key in before):
        if _is_square(numbers) and _means(numbers, mount):
            return [list(map(float, row)) for row in numbers]
    return matrix_entry(mount.inverse())


def _is_square(numbers: object) -> bool:
    return (
        isinstance(numbers, list)
        and len(numbers) == len(np.eye(4))
        and all(isinstance(row, list) and len(row) == len(numbers) for row in numbers)
    )


def _means(numbers: Any, mount: RigidTransform) -> bool:
    try:
        read = rigid_transform(numbers, "", Ledger(lenient=True)).inverse()
    except (CalibrationError, *DECODER_FAULTS, TypeError, ValueError):
        return False
    return np.array_equal(read.matrix, mount.matrix)


class _Writing(NamedTuple):
    model: str
    locations: tuple[int, ...]


_CAMERA_MODELS: Mapping[str, tuple[_Writing, ...]] = {
    "pinhole": (_Writing("pinhole", ()),),
    "fisheye": (_Writing("kannala-brandt4", (0, 1, 2, 3)),),
    "brown_conrady": (
        _Writing("brown-conrady", tuple(range(8))),
        _Writing("brown-conrady", (*range(8), *range(10, 16))),
    ),
    "kannala_brandt18": (_Writing("kannala-brandt18", tuple(range(18))),),
    "omnidir": (_Writing("omnidir", tuple(range(6))),),
}
"""By our model: the format's name, and which of our coefficients it has, in order; the shortest list that holds all
coefficients that are not 0 is written.

Source: "Calibration format" of the recording format's description, and the models that the vendor's software knows.
"""


_STAND_INS: Mapping[str, tuple[str, ...]] = {
    "brown_conrady": ("lx", "ly"),
    "fisheye": (),
    "omnidir": (),
    "kannala_brandt18": (),
}
"""Models that other camera models are fitted to, each with the coefficients of ours that the format does not have."""


_FARTHEST_SHARE, _LEAST_SHARE = 0.01, 0.5
"""A camera model that is further off than this share of the image's width, in the mean square.

Or holds less of the image
than that is none that stands in for another."""


@lru_cache(maxsize=64)
def _holdable_camera_model(camera: Camera) -> tuple[Camera, str | None]:
    """Give the camera model that a recording can hold: the same, or the nearest one of a model that it has.

    Returns:
        The camera model, and in words how far it is off; None where it is the same.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    if camera.model in _CAMERA_MODELS and not _unplaced(camera):
        return camera, None
    if camera.model not in MODELS:
        raise CalibrationError(f"camera model {camera.model!r}; a recording can hold {', '.join(_CAMERA_MODELS)}")
    found = nearest(camera, _STAND_INS)
    if found.rms_px > _FARTHEST_SHARE * camera.width or found.share < _LEAST_SHARE:
        raise CalibrationError(
            f"{found.message(camera)}; a recording can hold {', '.join(_CAMERA_MODELS)}: leave the camera out, or "
            f"undistort "
            "its images with `sceneloom edit undistort`"
        )
    return found.camera, found.message(camera)


def _unplaced(camera: Camera) -> bool:
    """Whether a coefficient is used that no list of the format holds."""
    held = {location for row in _CAMERA_MODELS[camera.model] for location in row.locations}
    return any(value != 0 for location, value in enumerate(camera.coefficients) if location not in held)


def camera_model_entry(camera: Camera, *, model_key: str = "model") -> tuple[dict[str, Any], str | None]:
    """Write a camera model.

    Args:
        camera: the camera model.
        model_key: "model" in `calibration.json`, "distortionModel" in a line.

    Returns:
        The fields, and in words how far they are off the camera model; None where they hold it.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera, how_far = _holdable_camera_model(camera)
    used = {location for location, value in enumerate(camera.coefficients) if value != 0}
    writing = next(row for row in _CAMERA_MODELS[camera.model] if used <= set(row.locations))
    values = dict(enumerate(camera.coefficients))
    fields = {
        model_key: writing.model,
        "distortionCoefficients": [float(values.get(location, 0.0)) for location in writing.locations],
        "focalLengthX": float(camera.fx),
        "focalLengthY": float(camera.fy),
        "principalPointX": float(camera.cx),
        "principalPointY": float(camera.cy),
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return fields, how_far


def _camera_model_losses(field: str, how_far: str | None) -> list[Loss]:
    """Report that a camera model was fitted."""
    return [] if how_far is None else [Loss(field=field, what=how_far, support=Support.APPROXIMATED)]


def camera_entry(sensor: ShootingSensor, camera: Camera, mount: RigidTransform) -> tuple[dict[str, Any], list[Loss]]:
    """Write a camera.

    Args:
        sensor: whose further fields, if it came from a recording, are written back.
        camera: its camera model, for the images as they are written.
        mount: `ego_from_camera`.

    Raises:
        CalibrationError: the model is unknown, or none of the format's comes near.
    """
    camera_model, how_far = camera_model_entry(camera)
    losses = _camera_model_losses(f"sensors[{sensor.id}].camera", how_far)
    before = _entry_before(sensor)
    further = {k: v for k, v in before.items() if k not in {"imuToCameraMatrix", "distortionModel"}}
    matrix = mount_entry(mount, before, "imuToCamera", "imuToCameraMatrix")
    return {**further, **camera_model, "imuToCamera": matrix}, losses


def lidar_entry(sensor: LidarSensor, index: int, mount: RigidTransform, model: str) -> dict[str, Any]:
    """Write a lidar; `mount` is `ego_from_lidar`."""
    before = _entry_before(sensor)
    number = {"lidarInd": index} if index else {}
    unwanted = {"imuToLidarMatrix", "lidarInd"} - number.keys()
    further = {k: v for k, v in before.items() if k not in unwanted}
    matrix = mount_entry(mount, before, "imuToLidar", "imuToLidarMatrix")
    return {**further, "model": model, **number, "imuToLidar": matrix}


def antenna_entry(scene: Scene, before: Mapping[str, Any]) -> dict[str, Any]:
    """Write where the antenna of the receiver of `gps` lines sits; what a calibration stated of it before stays.

    Args:
        scene: what is written.
        before: the root of the calibration that the scene was read with.
    """
    main = main_receiver([sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)])
    mount = main[0].mount if main else None
    return {} if mount is None or "imuToGnss" in before else {"imuToGnss": matrix_entry(mount.inverse())}


def _entry_before(sensor: ShootingSensor | LidarSensor) -> dict[str, Any]:
    entry = sensor.extras.get("calibration")
    return dict(entry) if isinstance(entry, Mapping) else {}


def cropped(camera: Camera, width: int, height: int) -> Camera:
    """The camera model for images whose last rows and columns are cut off: nothing else changes."""
    return replace(camera, width=width, height=height)


_CAMERA_MODEL, _MOUNT = "cameraParameters", "imuToCamera"
"""Fields of an entry, and extras of an image that has been read with them."""


_NON_FINITE = Path("data.jsonl")


class _ImageParameters:
    """Writes what images of a camera have of their own.

    Attributes:
        losses: camera models that the format does not have.
    """

    def __init__(self, sensor: ShootingSensor, width: int, height: int) -> None:
        """Begin.

        Args:
            sensor: the camera.
            width: of the images as they are written [px].
            height: likewise.
        """
        self.losses: list[Loss] = []
        self._sensor, self._size = sensor, (width, height)
        self._written: CameraParameters | None = None
        self._last_camera_model: tuple[bytes, Camera | None] = (b"", None)
        self._last_mount: tuple[bytes, RigidTransform | None] = (b"", None)

    def fields(self, shot: Shot, kept: Mapping[str, Any]) -> dict[str, Any]:
        """Give the camera model and the mounting of an image, as far as they are its own.

        Args:
            shot: the image.
            kept: the fields that it was read with.
        """
        sensor, fields = self._sensor, dict[str, Any]()
        if _CAMERA_MODEL in kept and self._means_camera_model(kept[_CAMERA_MODEL], shot.camera):
            fields[_CAMERA_MODEL] = kept[_CAMERA_MODEL]
        elif _CAMERA_MODEL in kept or shot.camera != sensor.camera:
            written, how_far = camera_model_entry(shot.camera, model_key="distortionModel")
            fields[_CAMERA_MODEL] = {k: v for k, v in written.items() if not k.startswith("image")}
            self.losses += _camera_model_losses(f"{field_of(sensor)}[].camera", how_far)
        if shot.mount is None:
            return fields
        if _MOUNT in kept and self._means_mount(kept[_MOUNT], shot.mount):
            fields[_MOUNT] = kept[_MOUNT]
        elif _MOUNT in kept or shot.mount is not sensor.mount:
            fields[_MOUNT] = matrix_entry(shot.mount.inverse())
        return fields

    def _means_camera_model(self, words: Any, camera: Camera) -> bool:
        text = msgspec.json.encode(words)
        if text != self._last_camera_model[0]:
            self._last_camera_model = text, self._camera_model_of(text)
        stated = self._last_camera_model[1]
        return stated is not None and _without_zeros(stated) == _without_zeros(cropped(camera, *self._size))

    def _camera_model_of(self, text: bytes) -> Camera | None:
        """What a reader of the written recording makes of it."""
        try:
            if self._written is None:
                entry, _ = camera_model_entry(cropped(self._sensor.camera, *self._size))
                self._written = msgspec.convert(entry, CameraParameters)
            parameters = read_parameters(text, 0, path=_NON_FINITE).over(self._written)
            return camera_model(parameters, self._size, "").resized(*self._size)
        except (SceneloomError, msgspec.ValidationError):
            return None

    def _means_mount(self, words: Any, mount: RigidTransform) -> bool:
        text = msgspec.json.encode(words)
        if text != self._last_mount[0]:
            self._last_mount = text, _mount_of(text)
        read = self._last_mount[1]
        return read is not None and np.array_equal(read.matrix, mount.matrix)


def _mount_of(text: bytes) -> RigidTransform | None:
    """What a reader makes of it; None where it would have to repair it."""
    ledger = Ledger(lenient=True)
    try:
        mount = read_mount(text, 0, path=_NON_FINITE, ledger=ledger)
    except SceneloomError:
        return None
    return None if ledger.warnings else mount


def _without_zeros(camera: Camera) -> Camera:
    """A camera without the zeros that other formats add at the end of its coefficients."""
    count = max((k + 1 for k, value in enumerate(camera.coefficients) if value), default=0)
    return replace(camera, coefficients=camera.coefficients[:count])


_DEPTH_STEPS = (0.001, 0.002, 0.005, 0.01)
"""Lengths of a step that are tried, the smallest first, where the source has no steps [m]."""


_COLOR_FORMAT = "gray16"
"""What the vendor's software calls images of 16-bit steps."""


_LARGEST = 65535


_OFF_STEP = 0.01
"""Share of a step that a depth may be off and still be one: float32 holds 65535 steps to 0.004 of one."""


class _SteppedDepth(NamedTuple):
    """A depth image in steps.

    Attributes:
        steps: (H, W) uint16, 0 for none.
        rounded: how many depths lie between steps.
        beyond: how many are more than 16 bits hold, or no number; they are 0.
    """

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


def _common_scale(sensor: DepthCameraSensor) -> float:
    """Find the length of a step for images that have none: the smallest one that holds the largest depth [m].

    Each image is decoded and let go.
    """
    largest = 0.0
    for frame in sensor.frames:
        if frame.scale is None:
            depth = frame.depth
            largest = max(largest, float(depth[np.isfinite(depth)].max(initial=0.0)))
    return next((scale for scale in _DEPTH_STEPS if round(largest / scale) <= _LARGEST), _DEPTH_STEPS[-1])


class _DepthImages:
    """The images of a depth camera as 16-bit steps, and what is lost by that."""

    codec = "ffv1-gray16"

    def __init__(self, sensor: DepthCameraSensor) -> None:
        """Begin; no image is read."""
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.blank: UInt8Array | UInt16Array = np.zeros((self.height, self.width), np.uint16)
        self.losses: list[Loss] = []
        self._scales = _DepthScales(sensor)
        self._field = f"sensors[{sensor.id}].frames[].depth"

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Name the kind of image, and the length of its steps."""
        return self._scales.fields(shot)

    def image(self, shot: Shot) -> UInt16Array | None:
        """Give an image in steps, (H, W) uint16; None of what is no depth image.

        Raises:
            OptionError: a step of the source has no length.
        """
        if not isinstance(shot, DepthFrame):
            return None
        depth, scale = shot.depth, self._scales.of(shot)
        check_array("depth", depth, (self.height, self.width), np.float32)
        found = to_steps(depth, scale)
        self._lose(f"rounded to steps of {scale:g} m", found.rounded)
        self._lose(f"left out: no number, negative, or beyond {_LARGEST * scale:g} m", found.beyond)
        return found.steps

    def _lose(self, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=self._field, what=what, count=count))


class _DepthScales:
    """The length of a step of each image of a camera: its own, else one that suits them all."""

    def __init__(self, sensor: DepthCameraSensor) -> None:
        """Begin; images are looked through when the first asks that has no step of its own."""
        self._sensor = sensor
        self._common: float | None = None

    def of(self, frame: DepthFrame) -> float:
        """Give the length of an image's steps [m].

        Raises:
            OptionError: it is no length.
        """
        if frame.scale is None:
            if self._common is None:
                self._common = _common_scale(self._sensor)
            return self._common
        if not 0 < frame.scale < np.inf:
            location = f"depth camera {self._sensor.id!r}: image at {frame.timestamp_ns} ns"
            raise OptionError(f"{location}: scale {frame.scale}; expected a length in metres")
        return frame.scale

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Name the kind of image, and the length of its steps."""
        if not isinstance(shot, DepthFrame):
            return {}
        return {"colorFormat": shot.extras.get("colorFormat", _COLOR_FORMAT), "depthScale": self.of(shot)}


IMAGES = ("copy", "lossless", "h264", "ffv1", "png")
"""Ways to keep images."""


_ENCODED_AS = {"copy": "h264", "lossless": "ffv1"}
"""Codecs for videos that should have been copied and cannot be."""


_SPELT = {"h264": "H.264", "ffv1": "FFV1, which loses nothing"}


_PNG_EFFORT = 1
"""Images of scenes shrink little more with more effort, at many times the time."""


_EBML = b"\x1a\x45\xdf\xa3"
"""How a Matroska file begins. Source: RFC 8794, section 11.2.1."""


_COPIED_AT_ONCE = 1 << 20


class ImageSink(Protocol):
    """Takes the images of one camera, one per `frames` line."""

    width: int
    height: int
    losses: list[Loss]

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Give what the entry of an image has to report it that it can be read."""
        ...

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Take an image; None for a line in which the camera has none."""
        ...

    def close(self) -> None:
        """Finish."""
        ...

    def abandon(self) -> None:
        """Let go of what is not finished."""
        ...


class _CopiedVideo:
    """The camera's own video, copied as it is or packet by packet, before the first line is written."""

    def __init__(self, sensor: ShootingSensor) -> None:
        self.width, self.height = sensor.camera.width, sensor.camera.height
        self.losses: list[Loss] = []
        self._scales = _DepthScales(sensor) if isinstance(sensor, DepthCameraSensor) else None

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Name the kind of a depth image, and the length of its steps."""
        return {} if self._scales is None else self._scales.fields(shot)

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Take nothing: the image is there already."""

    def close(self) -> None:
        """Do nothing."""

    def abandon(self) -> None:
        """Do nothing."""


class _Images(Protocol):
    """Makes the images of one camera as a video takes them.

    Attributes:
        codec: of the video, as `VideoWriter` calls it.
        width, height: of the video [px].
        blank: (height, width, 3) or (height, width), what a line before the first image gets.
        losses: what the video cannot hold, added to as images are made.
    """

    codec: str
    width: int
    height: int
    blank: UInt8Array | UInt16Array
    losses: list[Loss]

    def fields(self, shot: Shot) -> dict[str, Any]:
        """Give what the entry of an image has to report it that it can be read."""
        ...

    def image(self, shot: Shot) -> UInt8Array | UInt16Array | None:
        """Give what is encoded, of the shape of `blank`; None of what is none of this camera's."""
        ...


class _ColorImages:
    """The images of a camera; those of an odd size lose their last line or column in H.264."""

    def __init__(self, sensor: CameraSensor, codec: str) -> None:
        """Begin; no image is read."""
        camera, self.codec = sensor.camera, codec
        lossy = codec == "h264"
        cut = 2 if lossy else 1
        self.width, self.height = camera.width - camera.width % cut, camera.height - camera.height % cut
        self.blank: UInt8Array | UInt16Array = np.broadcast_to(np.uint8(0), (self.height, self.width, 3))
        self.losses = _encoding_losses(sensor, (self.width, self.height)) if lossy else []
        self._full = (camera.height, camera.width, 3)

    def fields(self, shot: Shot) -> dict[str, Any]:  # noqa: ARG002 - a video says what it is
        """Give nothing."""
        return {}

    def image(self, shot: Shot) -> UInt8Array | None:
        """Give an image, (height, width, 3), cut to the size of the video; None of what is no image."""
        if not isinstance(shot, CameraImage):
            return None
        rgb = shot.rgb
        check_array(_of_one_size(shot), rgb, self._full, np.uint8)
        return rgb[: self.height, : self.width]


def _of_one_size(image: CameraImage) -> str:
    """What a message calls an image of another size."""
    return f"the image at {image.timestamp_ns} ns (a recording's camera has images of one size)"


class _EncodedVideo:
    """Images encoded anew; a line without one gets the image before."""

    def __init__(self, images: _Images, path: Path, fps: float) -> None:
        """Start the file."""
        self.width, self.height, self.losses = images.width, images.height, images.losses
        self.fields = images.fields
        self._images, self._last = images, images.blank
        self._last_ns: int | None = None
        self._writer = VideoWriter(path, self.width, self.height, fps, codec=images.codec)

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:
        """Encode an image."""
        image = None if shot is None else self._images.image(shot)
        self._last = self._last if image is None else image
        # the time of a line without an image can be before that of an image whose entry has a time of its own
        self._last_ns = timestamp_ns if self._last_ns is None else max(timestamp_ns, self._last_ns)
        self._writer.add(self._last, self._last_ns / 1e9)

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()

    def abandon(self) -> None:
        """Close the file."""
        with suppress(SceneloomError):
            self._writer.close()


class _PngImages:
    """Images as numbered PNG files; a line without one gets the image before."""

    def __init__(self, sensor: CameraSensor, folder: Path) -> None:
        """Make the folder."""
        self.width, self.height = sensor.camera.width, sensor.camera.height
        rate = Loss(field=f"sensors[{sensor.id}].fps", what="left out: files have no rate")
        self.losses: list[Loss] = [rate] if sensor.fps else []
        folder.mkdir()
        self._folder = folder
        self._count = 0
        self._last: UInt8Array = np.broadcast_to(np.uint8(0), (self.height, self.width, 3))

    def fields(self, shot: Shot) -> dict[str, Any]:  # noqa: ARG002 - an image says what it is
        """Give nothing."""
        return {}

    def add(self, shot: Shot | None, timestamp_ns: int) -> None:  # noqa: ARG002 - the files have no times
        """Write an image."""
        if isinstance(shot, CameraImage):
            rgb = shot.rgb
            check_array(_of_one_size(shot), rgb, (self.height, self.width, 3), np.uint8)
            self._last = rgb
        from PIL import Image

        image = Image.fromarray(np.ascontiguousarray(self._last))
        image.save(self._folder / image_name(self._count), compress_level=_PNG_EFFORT)
        self._count += 1

    def close(self) -> None:
        """Do nothing: every file is whole."""

    def abandon(self) -> None:
        """Do nothing."""


def open_sink(sensor: ShootingSensor, folder: Path, index: int, rows: Int64Array, *, images: str) -> ImageSink:
    """Choose how a camera's images are kept, and start.

    Args:
        sensor: the camera.
        folder: the recording that is being written.
        index: `cameraInd`.
        rows: (N,) int64, which of its images each line has, -1 for none.
        images: "copy": the camera's own video where it can be copied, else H.264, or FFV1 where that video has lost
            nothing; "lossless": the same, else FFV1;
            "h264" and "ffv1": the own video only if it is that already; "png": PNG images. Depth is kept as its own
            video, or as FFV1, in any case.
    """
    path = folder / f"data{index + 1 if index else ''}.mkv"
    if isinstance(sensor, DepthCameraSensor):
        copied = _copied(sensor, path, rows, codecs=("ffv1",)) and _all_stepped(sensor)
        return _CopiedVideo(sensor) if copied else _EncodedVideo(_DepthImages(sensor), path, _frame_rate(sensor))
    if images == "png":
        return _PngImages(sensor, folder / f"frames{index + 1}")
    if _copied(sensor, path, rows, codecs=None if images in _ENCODED_AS else (images,)):
        return _CopiedVideo(sensor)
    codec = _ENCODED_AS.get(images, images)
    if images == "copy" and sensor.video is not None and is_lossless(sensor.video.codec):
        codec = "ffv1"
    encoded = _EncodedVideo(_ColorImages(sensor, codec), path, _frame_rate(sensor))
    if sensor.video is not None and images in {*_ENCODED_AS, sensor.video.codec}:
        what = f"encoded anew as {_SPELT[codec]}: the video could not be copied for these images alone"
        field = f"sensors[{sensor.id}].video"
        encoded.losses.append(Loss(field=field, what=what, support=Support.APPROXIMATED))
    return encoded


def _encoding_losses(sensor: CameraSensor, size: tuple[int, int]) -> list[Loss]:
    field, count, camera = f"sensors[{sensor.id}].images[].rgb", len(sensor.images), sensor.camera
    what = "encoded as H.264, which changes colours a little"
    losses = [Loss(field=field, what=what, count=count, support=Support.APPROXIMATED)]
    if size != (camera.width, camera.height):
        what = f"cut from {camera.width}x{camera.height} to {size[0]}x{size[1]}: H.264 needs even sizes"
        losses.append(Loss(field=field, what=what, count=count))
    return losses


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
    """Choose an image of the video for each line.

    Args:
        indices: (N,) the image in the video of each of the camera's images.
        rows: (L,) which of the camera's images each line has, -1 for none; such a line takes one of those between
            its neighbours', which nobody looks at, since there has to be one for each line.

    Returns:
        (L,) int64, ascending; None where the video has none for a line.
    """
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


def _all_stepped(sensor: DepthCameraSensor) -> bool:
    """Whether the source says of each image how long its steps are."""
    return all(frame.scale is not None for frame in sensor.frames)


_DEFAULT_PERIOD_NS = 100_000_000


_ROUNDED_NS = 500
"""Scene files in microseconds round times by so much [ns]; the lines that images belong to stay the same."""


_decode = msgspec.json.Decoder(dict[str, Any]).decode


_Key = tuple[int, float, int, int]
"""Time of a line [ns] and [s], its number, and how many lines of these come before it."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageRows:
    """Which image of each camera each line has.

    Attributes:
        images: (L, C) int64, index of the image, -1 for none; lines in the order of time.
        seconds: (L,) float64 [s], times of the lines; None: those of their first images.
        lines: by row, what a line stated that lacks images.
        first: `number` of the first line, from which numbers grow by one.
        numbers: `number` of each line, where they are kept as they were read; None: counted from `first` on.
        losses: what of the lines as they were read is not written.
    """

    images: Int64Array
    seconds: Sequence[float] | None = None
    lines: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    first: int = 0
    numbers: Sequence[int] | None = None
    losses: Sequence[Loss] = ()


def image_rows(sensors: Sequence[ShootingSensor], notes: FrameNotes | None) -> ImageRows:
    """Bring images together, as they were where that is known and their times are still the same.

    Args:
        sensors: the cameras, in the order of `cameraInd`.
        notes: what is known of the lines that the images were read from.
    """
    if not sensors:
        return ImageRows(np.zeros((0, 0), np.int64))
    found = _as_read(sensors, notes) if notes is not None and notes.own else None
    if found is None:
        found = ImageRows(group_images([shots_of(sensor).timestamps_ns for sensor in sensors]))
    if notes is None:
        return found
    untouched = len(found.images) == notes.count
    first = notes.first if untouched and notes.first is not None else 0
    numbers = _numbers_as_read(sensors, found) if untouched and notes.first is None else None
    losses = _losses(found, notes, counted_anew=untouched and notes.first is None and numbers is None)
    return ImageRows(found.images, found.seconds, found.lines, first, numbers, losses)


def _numbers_as_read(sensors: Sequence[ShootingSensor], rows: ImageRows) -> list[int] | None:
    """Numbers of lines that do not grow by one; None where one is not known, or they would mean other images.

    The video that is written has one image for each line.
    """
    numbers = []
    for row, images in enumerate(rows.images.tolist()):
        shots = [shots_of(sensor)[k] for sensor, k in zip(sensors, images, strict=True) if k >= 0]
        known = [shot.extras.get("number") for shot in shots] or [rows.lines.get(row, {}).get("number")]
        if type(known[0]) is not int or known.count(known[0]) < len(known):
            return None
        numbers.append(known[0])
    found = choose_images(np.array(numbers, np.int64), len(numbers)).indices
    return numbers if np.array_equal(found, np.arange(len(numbers))) else None


def _losses(rows: ImageRows, notes: FrameNotes, *, counted_anew: bool) -> list[Loss]:
    losses, count = list[Loss](), len(rows.images)
    if counted_anew:
        what = "counted from 0: they did not grow from line to line, and would mean other images"
        losses.append(Loss(field="frames[].number", what=what, count=count, support=Support.KEPT))
    if notes.own and rows.seconds is None:
        what = "put together anew by the times of their images, which are not those that were read"
        losses.append(Loss(field="frames", what=what, count=count, support=Support.KEPT))
    return losses


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


def grouping_losses(sensors: Sequence[ShootingSensor], rows: ImageRows) -> list[Loss]:
    """Report where cameras are not in step, so that lines lack some of their images, unless that was read so."""
    fresh = [row for row in range(len(rows.images)) if row not in rows.lines]
    missing = (rows.images[fresh] < 0).sum(axis=0).tolist()
    what = "is not in step with the other cameras: its video repeats an image where a line has none of its own"
    return [
        Loss(field=field_of(sensor), what=what, count=count, support=Support.CONVERTED)
        for sensor, count in zip(sensors, missing, strict=True)
        if count
    ]


def _as_read(sensors: Sequence[ShootingSensor], notes: FrameNotes) -> ImageRows | None:
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
        # nothing was cut: lines without any image have their locations
        members = {key: members.get(key) or [-1] * len(sensors) for key in [*members, *lines]}
    keys = sorted(members)
    return ImageRows(
        images=np.array([members[key] for key in keys], np.int64).reshape(len(keys), len(sensors)),
        seconds=[key[1] for key in keys],
        lines={row: lines[key] for row, key in enumerate(keys) if key in lines},
    )


def _line_of(shot: Shot) -> tuple[int, float, int] | None:
    seconds, number = shot.extras.get("file_seconds"), shot.extras.get("number")
    if not isinstance(seconds, float) or type(number) is not int or not isfinite(seconds):
        return None
    if abs(round(seconds * 1e9) - shot.timestamp_ns) > _ROUNDED_NS:
        return None
    own = shot.extras.get("line_seconds", seconds)
    if not isinstance(own, float) or not isfinite(own):
        return None
    return round(own * 1e9), own, number


def _kept_lines(texts: Sequence[str]) -> dict[_Key, Mapping[str, Any]]:
    lines: dict[_Key, Mapping[str, Any]] = {}
    seen = Counter[tuple[int, float, int]]()
    for text in texts:
        try:
            line = _decode(text)
            content = with_frames(line) if has_old_frame(line) else line
            seconds, number = float(content["time"]), int(content["number"])
            timestamp, known = round(seconds * 1e9), [entry["cameraInd"] for entry in content["frames"]]
        except (*DECODER_FAULTS, KeyError, TypeError, ValueError, OverflowError):
            continue
        if all(type(index) is int for index in known):
            key = (timestamp, seconds, number)
            lines[(*key, seen[key])] = content
            seen[key] += 1
    return lines


_OWN_EXTRAS = OWN_FIELDS | {_CAMERA_MODEL, _MOUNT}
"""Extras of an image that its line is made from anew."""


_OWN_DEPTH_EXTRAS = frozenset({"colorFormat", "depthScale"})
"""Those of a depth image that are reported by how it is written."""


_FORMATS_WORDS = {"exposureTimeSeconds"}
"""Extras that mean the same whatever a scene was read from: words of the recording format that the model took over."""


_OWN_KEYS = {"frames", "number", "time"}


_CAMERA = re.compile(r"camera(\d+)")


class FrameLines:
    """Makes the `frames` lines, and hands each image to the sink of its camera on the way.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self,
        sensors: Sequence[ShootingSensor],
        sinks: Sequence[ImageSink],
        rows: ImageRows,
        times: TimeWriter,
        *,
        keep_extras: bool,
    ) -> None:
        """Begin.

        Args:
            sensors: the cameras, in the order of `cameraInd`.
            sinks: where the images of each go.
            rows: which image of each camera each line has.
            times: writes the times.
            keep_extras: whether further fields of images are a recording's own, to be written back.
        """
        self._losses: list[Loss] = list(rows.losses)
        self._sensors, self._sinks, self._rows, self._times = sensors, sinks, rows, times
        self._keep_extras = keep_extras
        self._read_as = [_index_before(sensor, location) for location, sensor in enumerate(sensors)]
        self._parameters = [
            _ImageParameters(sensor, sink.width, sink.height) for sensor, sink in zip(sensors, sinks, strict=False)
        ]
        self._not_listed = 0

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
            return OneByOne(np.array([round(time * 1e9) for time in seconds], np.int64), self._lines(), FRAMES)
        timestamps = np.full(images.shape, np.iinfo(np.int64).max)
        for column, sensor in enumerate(self._sensors):
            there = images[:, column] >= 0
            timestamps[there, column] = shots_of(sensor).timestamps_ns[images[there, column]]
        return OneByOne(timestamps.min(axis=1, initial=np.iinfo(np.int64).max), self._lines(), FRAMES)

    def _lines(self) -> Iterator[WrittenLine]:
        seconds, numbers = self._rows.seconds, self._rows.numbers
        for location, row in enumerate(self._rows.images.tolist()):
            pairs = zip(self._sensors, row, strict=True)
            shots: list[Shot | None] = [shots_of(sensor)[k] if k >= 0 else None for sensor, k in pairs]
            first = min((shot for shot in shots if shot is not None), key=_time, default=None)
            if first is not None and seconds is None:
                timestamp, reported = first.timestamp_ns, first.extras.get("file_seconds")
            else:
                reported = 0.0 if seconds is None else seconds[location]
                timestamp = round(reported * 1e9)
            kept = self._rows.lines.get(location)
            time = (timestamp, reported) if first is None else (first.timestamp_ns, first.extras.get("file_seconds"))
            entries = [self._entry(c, shot, time, kept) for c, shot in enumerate(shots)]
            fields = {
                **self._beside(first, kept),
                "frames": [entry for entry in entries if entry is not None],
                "number": self._rows.first + location if numbers is None else numbers[location],
            }
            yield make_line(fields, timestamp, self._times, reported)

    def _beside(self, first: Shot | None, kept: Mapping[str, Any] | None) -> Mapping[str, Any]:
        if kept is not None:
            return {key: value for key, value in kept.items() if key not in _OWN_KEYS}
        beside = first.extras.get("line", {}) if first is not None and self._keep_extras else {}
        return beside if isinstance(beside, Mapping) else {}

    def _entry(
        self, index: int, shot: Shot | None, time: tuple[int, float | None], kept: Mapping[str, Any] | None
    ) -> dict[str, Any] | None:
        """Make the entry of a camera; None for a camera that the line did not list."""
        sink = self._sinks[index]
        if shot is None:
            sink.add(None, time[0])
            return self._without_image(index, time, kept)
        sink.add(shot, shot.timestamp_ns)
        entry = {
            "cameraInd": index,
            "time": self._times.raw(shot.timestamp_ns, shot.extras.get("file_seconds")),
        }
        before = shot.extras if self._keep_extras else {}
        own = {**sink.fields(shot), **self._parameters[index].fields(shot, before)}
        return {**self._extras(index, shot), **entry, **own}

    def _without_image(
        self, index: int, time: tuple[int, float | None], kept: Mapping[str, Any] | None
    ) -> dict[str, Any] | None:
        listed = kept["frames"] if kept is not None else [{"cameraInd": self._read_as[index]}]
        before = next((entry for entry in listed if entry["cameraInd"] == self._read_as[index]), None)
        if before is None:
            self._not_listed += 1
            return None
        own = before if before.get("missingBitmap") is True else {}
        known = own.get("time")
        seconds = self._times.raw(*time) if known is None else known
        return {**own, "cameraInd": index, "time": seconds, "missingBitmap": True}

    def _extras(self, index: int, shot: Shot) -> dict[str, Any]:
        own = _OWN_EXTRAS | (_OWN_DEPTH_EXTRAS if isinstance(shot, DepthFrame) else frozenset())
        further = {key: value for key, value in shot.extras.items() if key not in own}
        if self._keep_extras:
            hidden = shot.extras.get("entry", {})
            return {**further, **hidden} if isinstance(hidden, Mapping) else further
        for name in [name for name in further if name not in _FORMATS_WORDS]:
            self._lose(f"{field_of(self._sensors[index])}[].{name}", "left out: the format has none", 1)
        return {name: value for name, value in further.items() if name in _FORMATS_WORDS}

    def _lose(self, field: str, what: str, count: int) -> None:
        self._losses.append(Loss(field=field, what=what, count=count))


def _index_before(sensor: ShootingSensor, location: int) -> int:
    """The `cameraInd` that a camera was read with."""
    found = _CAMERA.fullmatch(str(sensor.id))
    return int(found[1]) if found else location


def _time(shot: Shot) -> tuple[int, float]:
    seconds = shot.extras.get("file_seconds")
    return shot.timestamp_ns, shot.timestamp_ns / 1e9 if seconds is None else seconds


_DEFAULT_FPS = 10.0


def _frame_rate(sensor: ShootingSensor) -> float:
    """Nominal images a second."""
    timestamps = shots_of(sensor).timestamps_ns
    if sensor.fps:
        return sensor.fps
    span = (int(timestamps[-1]) - int(timestamps[0])) * 1e-9 if len(timestamps) > 1 else 0.0
    return (len(timestamps) - 1) / span if span > 0 else _DEFAULT_FPS
