"""A scene as a recording: what goes into it, lidar binaries, and the whole folder."""

import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import count
from math import isfinite, radians
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import msgspec
import numpy as np

from sceneloom.arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int64Array,
    UInt8Array,
    UInt16Array,
    check_array,
    finite_rows,
)
from sceneloom.cameras.camera import MODELS, Camera
from sceneloom.cameras.fitting import nearest
from sceneloom.errors import CalibrationError, DataError, OptionError, OutputError, PoseError, SceneloomError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.losses import Loss, LossReport, Support
from sceneloom.formats.base.output import FolderKind, replacing
from sceneloom.formats.base.poses import each_mounted, mounting
from sceneloom.formats.base.text_tables import TimeWriter, nanoseconds
from sceneloom.formats.recording.contents import (
    BAROMETER,
    CALIBRATION_FILE,
    DECODER_FAULTS,
    FARTHEST_TIME,
    GPS_ORIGIN,
    LIDAR_MODELS,
    RECEIVER,
    ROOT_KEYS,
    XYZIRT,
    CameraParameters,
    Origin,
    camera_model,
    read_mount,
    read_parameters,
    record_keys,
    rigid_transform,
    with_frames,
)
from sceneloom.formats.recording.reader import OWN_FIELDS, RANKS, choose_images
from sceneloom.formats.recording.spec import DATA_FILE
from sceneloom.formats.recording.vio_config import read_vio_config
from sceneloom.formats.video.reader import VideoReader
from sceneloom.formats.video.writer import VideoWriter, copy_to_matroska, is_lossless
from sceneloom.geometry.rigid import OUT_OF_REACH, RigidTransform, angle_between, conjugate_quaternion, rotate_vectors
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
from sceneloom.scene.clouds import LidarFrame, LidarPoints, LidarSensor, PointsSensor, RadarSensor
from sceneloom.scene.ego import check_one_ego
from sceneloom.scene.motion import GnssSensor, ImuSensor, OdometrySensor, PlainSensor, VectorSamples
from sceneloom.scene.poses import Poses, PoseSource, Trajectory, same_direction
from sceneloom.scene.scene import Scene, Sensor, check_camera_models
from sceneloom.scene.types import Coordinates, PointsFrame

_BLOCK = 2048  # lines that are in memory together

_AXES: Mapping[str, int] = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3}
"""Sensors whose samples must have that many values, lest the vendor's software refuses them."""

_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(dict[str, Any]).decode
_decode_raw = msgspec.json.Decoder(dict[str, msgspec.Raw]).decode


class LineStream(NamedTuple):
    """Lines in the order of their times, (N,) int64 [ns]; each is made when it is asked for."""

    timestamps_ns: Int64Array
    texts: Iterator[str]


def merged_lines(streams: Sequence[LineStream]) -> Iterator[list[str]]:
    """Give the lines of all streams by time, those of one time in the order of the streams, block after block."""
    timestamps = np.concatenate([stream.timestamps_ns for stream in streams] or [np.zeros(0, np.int64)])
    ranks = np.repeat(np.arange(len(streams)), [len(stream.timestamps_ns) for stream in streams])
    ranks = ranks[np.argsort(timestamps, kind="stable")]
    for start in range(0, len(ranks), _BLOCK):
        yield [next(streams[rank].texts) for rank in ranks[start : start + _BLOCK].tolist()]


def _make_line(
    fields: Mapping[str, Any],
    timestamp_ns: int,
    times: TimeWriter,
    file_seconds: float | None = None,
    before: str | None = None,
) -> str:
    """Put the time, or the number that it was read from, to the fields of a line, whose unknown keys are kept."""
    text = _encode({**fields, "time": times.raw(timestamp_ns, file_seconds)}).decode()
    return text if before is None else _completed(text, before)


def _completed(text: str, before: str) -> str:
    """A line as it is made from its sample, with what else it once stated."""

    def over(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        pairs = {
            k: over(old[k], v) if isinstance(v, dict) and isinstance(old.get(k), dict) else v for k, v in new.items()
        }
        return {**old, **pairs}

    # the time may have more decimals than a 64-bit number
    return _encode({**over(_decode(before), _decode(text)), "time": _decode_raw(text)["time"]}).decode()


def _rows_of(texts: Mapping[str, str], timestamps_ns: Int64Array) -> dict[int, str]:
    """Find the rows that keys name: `TIME` [ns], or `TIME#1` for the second of that time; some may be gone."""
    found = {}
    for key, text in texts.items():
        timestamp, _, count = key.partition("#")
        if not (timestamp.removeprefix("-").isdecimal() and (count or "0").isdecimal()):
            continue
        row = int(np.searchsorted(timestamps_ns, int(timestamp))) + int(count or 0)
        if row < len(timestamps_ns) and timestamps_ns[row] == int(timestamp):
            found[row] = text
    return found


_TIME, _ROW = -1, -2  # slots of the time, and of all numbers of a row with commas between them


class _Slot(NamedTuple):
    """Where a number of a line goes: which one of a row, or `_TIME`, or `_ROW`."""

    source: int


def _template(value: object, slots: list[int]) -> str:
    """JSON text with `%s` for each slot in it; the slots are added to `slots`."""
    if isinstance(value, _Slot):
        slots.append(value.source)
        return "[%s]" if value.source == _ROW else "%s"
    if isinstance(value, dict):
        parts = [f"{_template(key, slots)}:{_template(part, slots)}" for key, part in value.items()]
        return "{" + ",".join(parts) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_template(part, slots) for part in value) + "]"
    return _encode(value).decode().replace("%", "%%")


class NumberLines:
    """Makes the lines of streams of numbers.

    Attributes:
        losses: what could not be written.
    """

    def __init__(
        self, times: TimeWriter, further_keys: Mapping[str, Mapping[str, str]], *, sensor_barometer: bool = False
    ) -> None:
        """Begin.

        Args:
            times: writes the times.
            further_keys: by stream and key of a row, the text of a line that once stated more than its sample.
            sensor_barometer: whether the air pressure goes into `sensor` lines.
        """
        self.losses: list[Loss] = []
        self._times, self._further_keys, self._sensor_barometer = times, further_keys, sensor_barometer

    def imu(self, sensor: ImuSensor) -> list[LineStream]:
        """One stream of lines per stream of the IMU."""
        streams: list[LineStream] = []
        for name, samples in sensor.streams.items():
            location = f"sensors[{sensor.id}].streams[{name}]"
            width = samples.values.shape[1]
            if width != _AXES.get(name, width):
                what = f"left out: {width} values a sample; the format's {name} has {_AXES[name]}"
                self._lose(location, what, len(samples))
                continue
            usable = finite_rows(samples.values)
            self._lose(location, "left out: a value is not finite", int((~usable).sum()))
            fields: dict[str, Any] = {"sensor": {"type": name.removeprefix("sensor:"), "values": _Slot(_ROW)}}
            if name == BAROMETER and width == 1 and not self._sensor_barometer:
                fields = {BAROMETER: {"pressureHectopascals": _Slot(0)}}
            streams.append(self._stream(f"imu.{name}", samples, samples.values, usable, fields))
        return streams

    def gnss(self, sensor: GnssSensor, origin: Origin = GPS_ORIGIN) -> LineStream:
        """The fixes of a satellite receiver, under the root key and name of its lines."""
        usable = finite_rows(sensor.positions_lla)
        what = "left out: latitude, longitude or altitude is missing, and a fix needs all three"
        self._lose(f"sensors[{sensor.id}]", what, int((~usable).sum()))
        order = np.argsort(sensor.timestamps_ns, kind="stable")
        rows = order[usable[order]]
        name, timestamps = RECEIVER if sensor.id == RECEIVER else f"{RECEIVER}.{sensor.id}", sensor.timestamps_ns[rows]
        further = _rows_of(self._further_keys.get(name, {}), timestamps)

        def texts() -> Iterator[str]:
            for k, row in enumerate(rows.tolist()):
                latitude, longitude, altitude = sensor.positions_lla[row].tolist()
                fix: dict[str, Any] = _name_field(origin)
                fix |= {"latitude": latitude, "longitude": longitude, "altitude": altitude}
                accuracies = {"accuracy": sensor.accuracies[row], "verticalAccuracy": sensor.vertical_accuracies[row]}
                fix |= {key: float(value) for key, value in accuracies.items() if np.isfinite(value)}
                seconds = None if sensor.file_seconds is None else float(sensor.file_seconds[row])
                yield _make_line({origin[0]: fix}, int(timestamps[k]), self._times, seconds, further.get(k))

        return LineStream(timestamps, texts())

    def trajectory(self, trajectory: Trajectory, origin: Origin | None) -> LineStream:
        """The poses of a trajectory, under the root key and name that it was read with, or new ones."""
        root, name = origin or _origin_for(trajectory.name)
        values = trajectory.positions
        pose: dict[str, Any] = {"position": {axis: _Slot(k) for k, axis in enumerate("xyz")}}
        if trajectory.quaternions_xyzw is not None:
            values = np.column_stack([values, trajectory.quaternions_xyzw])
            pose["orientation"] = {axis: _Slot(3 + k) for k, axis in enumerate("xyzw")}
        pose = _name_field((root, name)) | pose
        if root == "gnssEnu" and trajectory.quaternions_xyzw is None:
            pose = {"mean": [_Slot(k) for k in range(3)]}
        every = np.ones(len(values), np.bool_)
        fields = {root: pose} if root else pose
        return self._stream(f"trajectories.{trajectory.name}", trajectory, values, every, fields)

    def _stream(
        self,
        name: str,
        samples: VectorSamples | Trajectory,
        values: Float64Array,
        usable: BoolArray,
        fields: Mapping[str, Any],
    ) -> LineStream:
        """Lines that differ in their numbers only; `values` are (N, K)."""
        order = np.argsort(samples.timestamps_ns, kind="stable")
        rows = order[usable[order]]
        timestamps, values = samples.timestamps_ns[rows], values[rows]
        file_seconds = None if samples.file_seconds is None else samples.file_seconds[rows]
        further = _rows_of(self._further_keys.get(name, {}), timestamps)
        slots: list[int] = []
        template = _template({**fields, "time": _Slot(_TIME)}, slots)

        def texts() -> Iterator[str]:
            for start in range(0, len(rows), _BLOCK):
                span = slice(start, start + _BLOCK)
                columns: dict[int, Sequence[str]] = {
                    _TIME: self._times.texts(timestamps[span], None if file_seconds is None else file_seconds[span])
                }
                if _ROW in slots:
                    columns[_ROW] = row_texts(values[span])
                else:
                    width = values.shape[1]
                    numbers = msgspec.json.encode(values[span].ravel().tolist()).decode()[1:-1].split(",")
                    columns |= {k: numbers[k::width] for k in range(width)}
                numbered = enumerate(zip(*(columns[slot] for slot in slots), strict=True), start)
                for row, numbers_of_row in numbered:
                    line = template % numbers_of_row
                    yield _completed(line, further[row]) if row in further else line

        return LineStream(timestamps, texts())

    def _lose(self, field: str, what: str, count: int) -> None:
        if count:
            self.losses.append(Loss(field=field, what=what, count=count))


def _name_field(origin: Origin) -> dict[str, Any]:
    """The name of a method that a `pose` line bears."""
    root, name = origin
    return {"name": name} if root == "pose" and name != "pose" else {}


def _origin_for(name: str) -> Origin:
    """A root key of its own; where the format has another meaning for that key, a `pose` that bears the name."""
    return ("pose", name) if name in ROOT_KEYS - {"groundTruth"} or not name else (name, name)


def row_texts(rows: Float64Array) -> list[str]:
    """Write rows of finite numbers, (N, K) float64, each as its numbers with commas between them."""
    return msgspec.json.encode(rows.tolist()).decode()[2:-2].split("],[") if len(rows) else []


_CAMERA_MODELS: Mapping[str, tuple[tuple[str, tuple[int, ...]], ...]] = {
    "pinhole": (("pinhole", ()),),
    "fisheye": (("kannala-brandt4", (0, 1, 2, 3)),),
    "brown_conrady": (("brown-conrady", tuple(range(8))), ("brown-conrady", (*range(8), *range(10, 16)))),
    "kannala_brandt18": (("kannala-brandt18", tuple(range(18))),),
    "omnidir": (("omnidir", tuple(range(6))),),
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
"""A camera model whose root mean square error is a greater share of the image's width, or that covers a smaller share
of the image, does not stand in for another."""


@lru_cache(maxsize=64)
def _holdable_camera_model(camera: Camera) -> tuple[Camera, str | None]:
    """The same camera model, or the nearest one that the format has, with how far it is off in words."""
    writings = _CAMERA_MODELS.get(camera.model, ())
    used = {k for k, value in enumerate(camera.coefficients) if value != 0}
    if writings and used <= {k for _, taken in writings for k in taken}:
        return camera, None
    known = f"a recording can hold {', '.join(_CAMERA_MODELS)}"
    if camera.model not in MODELS:
        raise CalibrationError(f"camera model {camera.model!r}; {known}")
    found = nearest(camera, _STAND_INS)
    if found.rms_px > _FARTHEST_SHARE * camera.width or found.share < _LEAST_SHARE:
        hint = "leave the camera out, or undistort its images with `sceneloom edit undistort`"
        raise CalibrationError(f"{found.message(camera)}; {known}: {hint}")
    return found.camera, found.message(camera)


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
    values = dict(enumerate(camera.coefficients))
    used = {k for k, value in values.items() if value != 0}
    model, taken = next((model, taken) for model, taken in _CAMERA_MODELS[camera.model] if used <= set(taken))
    fields = {
        model_key: model,
        "distortionCoefficients": [float(values.get(k, 0.0)) for k in taken],
        "focalLengthX": float(camera.fx),
        "focalLengthY": float(camera.fy),
        "principalPointX": float(camera.cx),
        "principalPointY": float(camera.cy),
        "imageWidth": camera.width,
        "imageHeight": camera.height,
    }
    return fields, how_far


_IMAGES = ("copy", "lossless", "h264", "ffv1", "png")
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

        file = self._folder / f"{self._count:08d}.png"
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


class _FrameNotes(msgspec.Struct):
    """What is kept of the `frames` lines of a recording."""

    count: int  # how many there are
    first: int | None = None  # `number` of the first, where each has one more than the one before in the order of time
    own: bool = False  # whether images share lines, or lines have times, in another way than their times would give
    texts: list[str] = []  # lines that lack the image of a camera, in the order of time


def _image_rows(sensors: Sequence[ShootingSensor], notes: _FrameNotes | None) -> _ImageRows:
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


def _as_read(sensors: Sequence[ShootingSensor], notes: _FrameNotes) -> _ImageRows | None:
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
        read = self._read(_MOUNT, kept[_MOUNT]) if _MOUNT in kept else None
        if read is not None and np.array_equal(read.matrix, shot.mount.matrix):
            fields[_MOUNT] = kept[_MOUNT]
        elif _MOUNT in kept or shot.mount is not sensor.mount:
            fields[_MOUNT] = shot.mount.inverse().matrix.tolist()
        return fields

    def _same_camera(self, words: Any, camera: Camera) -> bool:
        read = self._read(_CAMERA_MODEL, words)
        width, height = self._size
        return read is not None and _without_zeros(read) == _without_zeros(replace(camera, width=width, height=height))

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


class _FrameLines:
    """Writes the images of all cameras, and makes the `frames` lines, each after its images were written."""

    def __init__(
        self,
        sensors: Sequence[ShootingSensor],
        folder: Path,
        notes: _FrameNotes | None,
        times: TimeWriter,
        *,
        images: str,
        keep_extras: bool,
    ) -> None:
        """Begin; `keep_extras`: unknown fields of images are a recording's own, to be written back."""
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
        self.sizes = [(sink.width, sink.height) for sink in self._sinks]  # of images as they are written [px]
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
            yield _make_line(fields, timestamp_ns, self._times, reported)

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


_LIDAR_MODEL = LIDAR_MODELS[0]  # the one model that the format describes

_KIND = FolderKind(
    "recording",
    (
        r"data\d*\.(jsonl|mkv|mp4|mov|avi|ts)",
        r"calibration\.json",
        r"vio_config\.yaml",
        r"frames\d+/\d{8}\.png",
        r"lidar\d*/\w[\w.-]*\.(bin|dat|raw)",
        r"README(\.\w+)?",
    ),
    r"data\.jsonl",
)
"""What a recording's folder holds; one with anything else in it is somebody's own."""

_SAME_POSITION, _SAME_ROTATION = 1e-3, radians(0.01)
"""How far poses may be from each other and still be the same [m], [rad]: as far as those of thinned paths are."""

_NO_FIELD = "left out: the format has none"
_RECORDING_EXTRAS = {"calibration", "lidarInd"}
_NEEDED = ("accelerometer", "gyroscope")
_MOST_CAMERAS = 2


def write_recording(scene: Scene, path: Path, *, overwrite: bool = False, images: str = "copy") -> LossReport:
    """Write a scene as a recording; frames are read, written and let go one by one.

    Args:
        overwrite: replace the folder if it is a recording, or empty, but for a README; nobody else's folder is ever
            replaced.
        images: "copy" copies a camera's own video packet by packet, cut to the images that are left, where that can
            be done, and encodes H.264 else, or FFV1 where that video has lost nothing; "lossless" encodes FFV1 then;
            "h264" copies only what is H.264 already; "ffv1" (video) and "png" (files) lose nothing.

    Raises:
        OptionError: `images` is none of these.
        OutputError: the path exists, lies inside a recording, or cannot be written.
        CalibrationError: no model of the format comes near a camera model, or a camera's mounting is unknown.
        PoseError: points are in the world, and it is not known where their lidar was.
        DataError: what the scene is read from is damaged, or has nothing that a recording can hold.
    """
    if images not in _IMAGES:
        raise OptionError(f"images {images!r}; expected one of: {', '.join(_IMAGES)}")
    check_outside_recordings(path)
    plan = _WritingPlan(scene)
    check_camera_models(scene, plan.cameras)
    with replacing(path, overwrite=overwrite, folder=_KIND) as draft:
        losses = _write(plan, draft, images)
        for note in path.glob("README*"):
            if note.is_file():
                shutil.copy2(note, draft)
    return LossReport.of(losses)


def check_outside_recordings(path: Path) -> None:
    """Refuse a folder inside a recording, which would then be part of that one: of its copies, archives and checks.

    Raises:
        OutputError: a folder above the path has a `data.jsonl`.
    """
    for above in path.absolute().parents:
        if (above / DATA_FILE).is_file():
            raise OutputError(f"{path}: lies inside the recording {above}; choose a location beside it")


class _Notes(msgspec.Struct):
    """What a scene that was read from a recording keeps of it under `metadata["recording"]`."""

    calibration: dict[str, Any] = {}  # all of `calibration.json`
    vio_config: str | None = None  # the text of `vio_config.yaml`
    other_lines: list[str] = []  # unknown lines; poses at a time that is taken, or without others' orientation
    other_seconds: dict[str, float] = {}  # by index in `other_lines`, the time of the line before [s], if it has none
    further_keys: dict[str, dict[str, str]] = {}  # lines that say more, by stream ("gnss.rtkgps", "lidars.0") and key
    trajectory_origins: dict[str, tuple[str, str]] = {}  # root key ("": the root itself) and name, where renamed
    receiver_origins: dict[str, tuple[str, str]] = {}  # the same of satellite receivers but that of `gps` lines
    sensor_barometer: bool = False  # air pressure came in `sensor` lines
    frame_lines: _FrameNotes | None = None  # of lines of images that are not what would be written else


class _WritingPlan:
    """What of a scene is written, and what is known beforehand to be lost; `mounts`: of cameras, then lidars."""

    def __init__(self, scene: Scene) -> None:
        try:
            self.notes = msgspec.convert(scene.metadata.get("recording", {}), _Notes)
        except msgspec.ValidationError:
            self.notes = _Notes()
        self.of_recording = scene.format == "recording" or "recording" in scene.metadata  # be it through a scene file
        self.losses: list[Loss] = []
        self.trajectories = self._find_trajectories(scene)  # each with the root key and name it was read under
        oriented = (known.poses for known in scene.trajectories.values() if known.quaternions_xyzw is not None)
        odometry = (sensor.poses for sensor in scene.sensors if isinstance(sensor, OdometrySensor))
        self.ego_path: Poses | None = next(oriented, None) or next(odometry, None)  # `world_from_ego`
        check_one_ego(scene, self.ego_path)
        self.scene = scene = each_mounted(scene, self.ego_path)
        self.lidars: Sequence[LidarSensor] = scene.lidars
        shooting = [sensor for sensor in scene.sensors if isinstance(sensor, CameraSensor | DepthCameraSensor)]
        if not self.of_recording:
            # the vendor's software takes the first two for a pair of stereo images, or for an image and its depth
            shooting.sort(key=lambda sensor: isinstance(sensor, DepthCameraSensor))
        self.cameras: Sequence[ShootingSensor] = [camera for camera in shooting if len(shots_of(camera))] or shooting
        if self.ego_path is None and not self.trajectories:
            self.ego_path = self._ego_path_of_sensor()
        units = [sensor for sensor in scene.sensors if isinstance(sensor, ImuSensor)]
        whole = [unit for unit in units if set(_NEEDED) <= set(unit.streams)]
        self.imu = next(iter([*whole, *units]), None)
        self.receivers = [sensor for sensor in scene.sensors if isinstance(sensor, GnssSensor)]
        self.losses += [*_unwritten(self, shooting), *_renamed(self), *_unplaced(self), *_not_replayed(self)]
        self.mounts = [self._mount(sensor) for sensor in (*self.cameras, *self.lidars)]

    def _find_trajectories(self, scene: Scene) -> list[tuple[Trajectory, Origin | None]]:
        """The scene's trajectories, and paths of odometry sensors that are none of them."""
        found = list(scene.trajectories.values())
        for sensor in scene.sensors:
            path = sensor.poses if isinstance(sensor, OdometrySensor) else None
            if path is not None and not path.static and not any(same_direction(path, known) for known in found):
                found.append(Trajectory(str(sensor.id), path.timestamps_ns, path.positions, path.quaternions_xyzw))
        return [(trajectory, self.notes.trajectory_origins.get(trajectory.name)) for trajectory in found]

    def _ego_path_of_sensor(self) -> Poses | None:
        """The trajectory of the first sensor that has one, so that it and the others' positions are not lost."""
        for sensor in (*self.lidars, *self.cameras):
            path, in_world = sensor.poses, sensor.coordinates is Coordinates.WORLD
            if path is None or path.static or not in_world or sensor.mount is not None:
                continue
            name = str(sensor.id)
            trajectory = Trajectory(name, path.timestamps_ns, path.positions, path.quaternions_xyzw)
            self.trajectories.append((trajectory, ("pose", name)))
            what = f"written as trajectory {name!r}, which the ego is taken to follow: the scene has no ego trajectory"
            self.losses.append(Loss(field=f"sensors[{sensor.id}].poses", what=what, support=Support.CONVERTED))
            return path
        return None

    def _mount(self, sensor: ShootingSensor | LidarSensor) -> RigidTransform:
        mount, lost = mounting(sensor, self.ego_path, each=True)
        self.losses.extend(lost)
        if mount is not None:
            return mount
        if not isinstance(sensor, LidarSensor):
            raise CalibrationError(
                f"camera {sensor.id!r}: nothing says how it is mounted on the vehicle (neither a mounting, nor poses "
                "of both it and the ego), and a recording cannot be without imuToCamera"
            )
        what = "taken to be where the IMU is, with the same axes: nothing says how it is mounted"
        self.losses.append(Loss(field=f"sensors[{sensor.id}].mount", what=what))
        return RigidTransform.identity()


def _unwritten(plan: _WritingPlan, shooting: Sequence[ShootingSensor]) -> Iterator[Loss]:
    """Name everything of a scene that its recording will not hold; `shooting` are all of its cameras."""
    scene = plan.scene
    counts = {
        "annotations": len(scene.annotations),
        "attributes": len(scene.attributes),
        **{f"metadata.{name}": 1 for name in scene.metadata if name != "recording"},
        **{f"extras.{name}": 1 for name in scene.extras},
    }
    yield from (Loss(field=name, what=_NO_FIELD, count=count) for name, count in counts.items() if count)
    new_names = {trajectory.name for trajectory, _ in plan.trajectories} - set(scene.trajectories)
    for sensor in scene.sensors:
        field = f"sensors[{sensor.id}]"
        if isinstance(sensor, RadarSensor | PointsSensor | PlainSensor):
            yield Loss(field=field, what=_NO_FIELD)
            continue
        yield from (Loss(field=f"{field}.{k}", what=_NO_FIELD) for k in sensor.extras if k not in _RECORDING_EXTRAS)
        if sensor.parent_id is not None:
            yield Loss(field=f"{field}.parent_id", what=_NO_FIELD)
        if isinstance(sensor, OdometrySensor):
            if sensor.poses.static:
                yield Loss(field=field, what="left out: the format has no static trajectories")
            elif str(sensor.id) not in new_names:
                yield Loss(field=field, what="left out: a trajectory says the same")
            else:
                what = f"written as trajectory {str(sensor.id)!r}"
                yield Loss(field=field, what=what, support=Support.CONVERTED)
        if sensor in shooting and sensor not in plan.cameras:
            yield Loss(field=field, what="left out: it has no images, while other cameras have")
        if isinstance(sensor, ImuSensor) and sensor is not plan.imu:
            yield Loss(field=field, what=f"left out: the format has one {sensor.type} only")
        if isinstance(sensor, GnssSensor) and sensor.mount is not None and sensor not in _main_receiver(plan.receivers):
            yield Loss(field=f"{field}.mount", what=_NO_FIELD)
    names = [trajectory.name for trajectory, _ in plan.trajectories if trajectory.covariances is not None]
    yield from (Loss(field=f"trajectories.{name}.covariances", what=_NO_FIELD) for name in names)


def _renamed(plan: _WritingPlan) -> Iterator[Loss]:
    """Name what is read back with other ids, or in another order."""
    default, names = next(iter(plan.scene.trajectories), None), [trajectory.name for trajectory, _ in plan.trajectories]
    if default != "groundTruth" and "groundTruth" in names:
        yield Loss(field="trajectories.order", what=f"read back with 'groundTruth' first, not {default!r}")
    lidars, imu = plan.lidars, [] if plan.imu is None else [plan.imu]
    # the format knows sensors by number only
    read_back: list[tuple[Sensor, str]] = [(camera, f"camera{index}") for index, camera in enumerate(plan.cameras)]
    read_back += [(lidar, f"lidar{index}" if len(lidars) > 1 else "lidar") for index, lidar in enumerate(lidars)]
    read_back += [(sensor, "imu") for sensor in imu] + [(sensor, "gnss") for sensor in _main_receiver(plan.receivers)]
    for sensor, name in read_back:
        if sensor.id != name:
            yield Loss(field=f"sensors[{sensor.id}].id", what=f"read back as {name!r}")
    order = [sensor.id for sensor in (*lidars, *plan.cameras, *imu, *plan.receivers)]
    if order != [sensor.id for sensor in plan.scene.sensors if sensor.id in order]:
        what = "read back in another order: lidars, cameras, those of depth last, IMU, satellite receivers"
        yield Loss(field="sensors", what=what)


def _unplaced(plan: _WritingPlan) -> list[Loss]:
    """Sensors lose their poses where the trajectory that is read as the ego trajectory has no orientations."""

    def rank(pair: tuple[Trajectory, Origin | None]) -> int:
        return RANKS.get((pair[1] or _origin_for(pair[0].name))[0], len(RANKS))

    posed = sum(getattr(sensor, "poses", None) is not None for sensor in plan.scene.sensors)
    first = min(plan.trajectories, key=rank, default=None)
    if not posed or (first is not None and first[0].quaternions_xyzw is not None):
        return []
    what = "left out: there is no ego trajectory with orientations, which recordings locate sensors by"
    return [Loss(field="sensors[].poses", what=what, count=posed)]


def _not_replayed(plan: _WritingPlan) -> Iterator[Loss]:
    """Name what the vendor's software will not replay as it was meant: the recording holds the data all the same."""

    def loss(what: str, count: int = 1) -> Loss:
        return Loss(field="replay", what=what, count=count, support=Support.KEPT)

    cameras, streams = plan.cameras, {} if plan.imu is None else plan.imu.streams
    missing = [name for name in _NEEDED if name not in streams or not len(streams[name])]
    if missing and any(len(shots_of(camera)) for camera in cameras):
        yield loss(f"the vendor's software gives no output without {' and '.join(missing)}")
    if len(cameras) > _MOST_CAMERAS:
        names = ", ".join(str(camera.id) for camera in cameras[_MOST_CAMERAS:])
        yield loss(f"the vendor's software uses the first two cameras, not {names}", len(cameras) - _MOST_CAMERAS)
    if cameras and isinstance(cameras[0], DepthCameraSensor):
        yield loss(f"the vendor's software tracks in the first camera, and {cameras[0].id} measures depth")
    if plan.imu is not None and cameras:
        timestamps = np.unique(np.concatenate([shots_of(camera).timestamps_ns for camera in cameras]))
        measured = [streams[name].timestamps_ns for name in _NEEDED if name in streams]
        equal = int(np.isin(timestamps, np.concatenate([*measured, np.zeros(0, np.int64)])).sum())
        if equal:
            what = (
                "images have exactly the times of IMU samples, which makes the vendor's diagnosis suspect that their "
                "times were not measured; they are written as they are"
            )
            yield loss(what, equal)
    if len(plan.lidars) > 1:
        yield loss("the vendor's software does not report lidars apart (`lidarInd`)", len(plan.lidars))
    unknown = read_vio_config(plan.notes.vio_config or "").unknown_keys
    if unknown:
        named = ", ".join(unknown)
        yield loss(f"the vendor's software may stop at settings that are not publicly known: {named}", len(unknown))


def _write(plan: _WritingPlan, folder: Path, images: str) -> list[Loss]:
    """Write all files into an empty folder; give what was lost."""
    times, notes = TimeWriter(), plan.notes
    numbers = NumberLines(times, notes.further_keys, sensor_barometer=notes.sensor_barometer)
    sweeps = [_SweepWriter(plan, index, folder, times) for index in range(len(plan.lidars))]
    keep_extras = plan.of_recording
    with _FrameLines(plan.cameras, folder, notes.frame_lines, times, images=images, keep_extras=keep_extras) as frames:
        # of one time, the small lines come first: a filter then knows all up to an image when it gets it
        streams = [numbers.trajectory(trajectory, origin) for trajectory, origin in plan.trajectories]
        streams += [] if plan.imu is None else numbers.imu(plan.imu)
        for sensor in plan.receivers:
            streams.append(numbers.gnss(sensor, _receiver_origin(sensor, notes.receiver_origins, plan.receivers)))
        streams += [sweep.stream() for sweep in sweeps]
        streams += [frames.stream(), _unknown_lines(notes.other_lines, notes.other_seconds)]
        with (folder / DATA_FILE).open("wb") as file:
            for lines in merged_lines(streams):
                file.write("\n".join([*lines, ""]).encode())
        if not any(len(stream.timestamps_ns) for stream in streams):
            raise DataError(plan.scene.source, "", "holds nothing that a recording could hold")
        frames.close()
    calibration_losses = _write_calibration(plan, frames.sizes, folder)
    if notes.vio_config is not None:
        (folder / "vio_config.yaml").write_text(notes.vio_config, encoding="utf-8")
    losses = [*plan.losses, *calibration_losses, *frames.losses, *numbers.losses]
    losses += [loss for sweep in sweeps for loss in sweep.losses] + frames.image_losses
    if times.inexact:
        what = f"times written exactly, but a 64-bit number of seconds holds them within {times.worst_ns} ns only"
        worst, converted = float(times.worst_ns), Support.CONVERTED
        losses.append(Loss(field="timestamps", what=what, count=times.inexact, support=converted, largest_error=worst))
    return losses


def _write_calibration(plan: _WritingPlan, sizes: Sequence[tuple[int, int]], folder: Path) -> list[Loss]:
    """Write `calibration.json`; `sizes` are those of the images as they are written, where there are any [px]."""
    losses: list[Loss] = []
    cameras: list[dict[str, Any]] = []
    for index, sensor in enumerate(plan.cameras):
        camera = sensor.camera
        if sizes:
            # of images whose last rows and columns are cut off, nothing else changes
            camera = replace(camera, width=sizes[index][0], height=sizes[index][1])
        fields, how_far = camera_model_entry(camera)
        if how_far is not None:
            losses.append(Loss(field=f"sensors[{sensor.id}].camera", what=how_far, support=Support.APPROXIMATED))
        unknown = {k: v for k, v in _entry_before(sensor).items() if k != "distortionModel"}
        cameras.append(_with_mount({**unknown, **fields}, "imuToCamera", plan.mounts[index]))
    lidar_mounts = plan.mounts[len(cameras) :]
    lidars = [_lidar_entry(lidar, k, lidar_mounts[k]) for k, lidar in enumerate(plan.lidars)]
    further, main = dict(plan.notes.calibration), _main_receiver(plan.receivers)
    if main and main[0].mount is not None:
        further.setdefault("imuToGnss", main[0].mount.inverse().matrix.tolist())
    content = {**further, "cameras": cameras, **({"lidars": lidars} if lidars else {})}
    if cameras or lidars or further:
        text = msgspec.json.format(msgspec.json.encode(content), indent=2)
        (folder / CALIBRATION_FILE).write_bytes(text + b"\n")
    return losses


def _entry_before(sensor: ShootingSensor | LidarSensor) -> dict[str, Any]:
    entry = sensor.extras.get("calibration")
    return dict(entry) if isinstance(entry, Mapping) else {}


def _lidar_entry(sensor: LidarSensor, index: int, mount: RigidTransform) -> dict[str, Any]:
    before = {**_entry_before(sensor), "model": _LIDAR_MODEL}
    before = {k: v for k, v in before.items() if k != "lidarInd" or index} | ({"lidarInd": index} if index else {})
    return _with_mount(before, "imuToLidar", mount)


def _with_mount(entry: Mapping[str, Any], key: str, mount: RigidTransform) -> dict[str, Any]:
    """Write a mounting, `ego_from_sensor`: with the numbers that it was read from, where they still mean it."""
    matrix, unknown = mount.inverse().matrix.tolist(), {k: v for k, v in entry.items() if k != f"{key}Matrix"}
    for numbers in (entry[name] for name in (key, f"{key}Matrix") if name in entry):
        try:
            read = rigid_transform(numbers, "", Ledger(lenient=True)).inverse()
            if np.shape(numbers) == (4, 4) and np.array_equal(read.matrix, mount.matrix):
                matrix = [list(map(float, row)) for row in numbers]
                break
        except (CalibrationError, *DECODER_FAULTS, TypeError):
            continue
    return {**unknown, key: matrix}


class _SweepWriter:
    """Writes the sweeps of one lidar."""

    def __init__(self, plan: _WritingPlan, index: int, folder: Path, times: TimeWriter) -> None:
        self._sensor = sensor = plan.lidars[index]
        self._index, self._mount = index, plan.mounts[len(plan.cameras) + index]
        self._folder, self._times = folder, times
        further = plan.notes.further_keys.get(f"lidars.{sensor.extras.get('lidarInd', index)}", {})
        self._further = _rows_of(further, sensor.frames.timestamps_ns)
        self._names: set[str] = set()
        self._subfolder = f"lidar{index + 1 if index else ''}"
        in_world = sensor.points_frame is PointsFrame.WORLD
        self._world = _world_poses(sensor, self._mount, plan.ego_path) if in_world else None
        self.losses: list[Loss] = []
        field = f"sensors[{sensor.id}]"
        if sensor.model not in (None, _LIDAR_MODEL):
            what = f"{sensor.model!r} written as {_LIDAR_MODEL!r}, the one layout of files that the format has"
            self.losses.append(Loss(field=f"{field}.model", what=what))
        if sensor.points_frame is not PointsFrame.SENSOR:
            frame, converted = sensor.points_frame, Support.CONVERTED
            what = f"brought from the {frame} frame into the lidar's own, in which recordings keep points"
            self.losses.append(Loss(field=f"{field}.points_frame", what=what, support=converted))
            what, number = f"rounded to float32 in the lidar's own frame, from the {frame} frame", len(sensor.frames)
            field = f"{field}.frames[].points.positions"
            self.losses.append(Loss(field=field, what=what, count=number, support=converted))

    def stream(self) -> LineStream:
        """The lines, each made after its file was written."""
        return LineStream(self._sensor.frames.timestamps_ns, self._lines())

    def _lines(self) -> Iterator[str]:
        (self._folder / self._subfolder).mkdir(exist_ok=True)
        for k, frame in enumerate(self._sensor.frames):
            name = self._file_name(k, frame)
            (self._folder / name).write_bytes(self._records(frame).tobytes())
            sweep: dict[str, Any] = {"model": _LIDAR_MODEL, "dataFile": name}
            if self._index:
                sweep["lidarInd"] = self._index
            seconds = frame.extras.get("file_seconds")
            yield _make_line({"lidar": sweep}, frame.timestamp_ns, self._times, seconds, self._further.get(k))

    def _file_name(self, k: int, frame: LidarFrame) -> str:
        """The name that the file had in a recording, where that is free and in the lidar's folder; else a number."""
        name = frame.extras.get("dataFile")
        own = re.compile(rf"{self._subfolder}/\w[\w.-]*")
        if not isinstance(name, str) or not own.fullmatch(name) or name in self._names:
            name = next(n for n in (f"{self._subfolder}/{i:06d}.bin" for i in count(k)) if n not in self._names)
        self._names.add(name)
        return name

    def _records(self, frame: LidarFrame) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        points = frame.points
        self._note_losses(frame)
        records = np.zeros(len(points), XYZIRT)
        positions = frame.points.positions
        if self._sensor.points_frame is PointsFrame.EGO:
            positions = self._mount.inverse().apply(positions).astype(np.float32)
        elif self._world is not None:
            positions = self._from_world(frame, self._world).astype(np.float32)
        for axis, name in enumerate("xyz"):
            records[name] = positions[:, axis]
        if points.intensities is not None:
            records["intensity"] = points.intensities
        if points.rings is not None:
            records["ring"] = points.rings
        records["timestamp"] = self._seconds(frame)
        return records

    def _seconds(self, frame: LidarFrame) -> Float64Array:
        """Times as numbers: those that the file had, where they still mean the same time."""
        timestamps = frame.point_times_ns
        seconds: Float64Array = timestamps / 1e9
        before = frame.points.extras.get("file_seconds")
        if isinstance(before, np.ndarray) and before.shape == timestamps.shape:
            seconds = np.where(nanoseconds(before) == timestamps, before, seconds)
        inexact = int((nanoseconds(seconds) != timestamps).sum())
        self._lose("timestamps_ns", "rounded to what a 64-bit number of seconds holds", inexact)
        return seconds

    def _from_world(self, frame: LidarFrame, poses: PoseSource) -> Float64Array:
        """Undo what brought each point into the world at its own time."""
        if not len(frame.points):
            return np.zeros((0, 3))
        samples = poses.at(frame.point_times_ns)
        unknown = int(np.isnan(samples.positions[:, 0]).sum())
        if unknown:
            raise PoseError(
                f"lidar {self._sensor.id!r}: sweep at {frame.timestamp_ns} ns: no pose for {unknown} of its points, "
                "which are in the world and have to be brought back into the lidar's frame"
            )
        offsets = frame.points.positions.astype(np.float64) - samples.positions
        return rotate_vectors(conjugate_quaternion(samples.quaternions_xyzw), offsets)

    def _note_losses(self, frame: LidarFrame) -> None:
        points: LidarPoints = frame.points
        absent = {
            "intensities": "0 written: the source has none",
            "rings": "0 written: the source has none",
            "timestamps_ns": "the sweep's own time written: the source has none per point",
        }
        for name, what in absent.items():
            self._lose(name, what, len(points) if getattr(points, name) is None else 0)
        unwritten = [name for name in ("colors", "camera_index") if getattr(points, name) is not None]
        for name in [*unwritten, *(name for name in points.extras if name != "file_seconds")]:
            self._lose(name, _NO_FIELD, len(points))
        for name in [name for name in frame.extras if name not in {"file_seconds", "dataFile"}]:
            self.losses.append(Loss(field=f"sensors[{self._sensor.id}].frames[].{name}", what=_NO_FIELD))

    def _lose(self, name: str, what: str, count: int) -> None:
        if count:
            field = f"sensors[{self._sensor.id}].frames[].points.{name}"
            self.losses.append(Loss(field=field, what=what, count=count))


def _world_poses(sensor: LidarSensor, mount: RigidTransform, ego_path: Poses | None) -> PoseSource:
    """Poses of the lidar: its own, but the ego's with the mounting, of more times, where these state the same."""
    timestamps = sensor.frames.timestamps_ns
    reach_ns = int(np.median(np.diff(timestamps))) if len(timestamps) > 1 else 0
    along_ego = None if ego_path is None else PoseSource(ego_path, mount, reach_ns)
    if sensor.poses is not None and sensor.coordinates is Coordinates.WORLD:
        if along_ego is not None and _agree(along_ego, sensor.poses):
            return along_ego
        return PoseSource(sensor.poses, RigidTransform.identity(), reach_ns)
    if along_ego is None:
        raise PoseError(
            f"lidar {sensor.id!r}: its points are in the world and have to be brought back into its own frame, "
            "but the scene says neither where it was nor where the ego was"
        )
    return along_ego


def _agree(along_ego: PoseSource, poses: Poses) -> bool:
    """Whether a source gives the poses of a path at all its times, but for rounding."""
    if poses.static:
        return False
    samples = along_ego.at(poses.timestamps_ns)
    if (samples.coverage == OUT_OF_REACH).any():
        return False
    distances = np.linalg.norm(samples.positions - poses.positions, axis=1)
    angles = angle_between(samples.quaternions_xyzw, poses.quaternions_xyzw)
    return bool(distances.max() <= _SAME_POSITION and angles.max() <= _SAME_ROTATION)


def _unknown_lines(texts: Sequence[str], anchors: Mapping[str, float]) -> LineStream:
    """Unknown lines in time order; `anchors` are times [s] of lines before those without one, which else come first."""
    seconds = [_seconds_of(text, anchors.get(str(k))) for k, text in enumerate(texts)]
    timestamps = np.array([-(2**63) if s is None else round(s * 1e9) for s in seconds], np.int64)
    order = np.argsort(timestamps, kind="stable")
    return LineStream(timestamps[order], (texts[k].strip() for k in order.tolist()))


def _seconds_of(text: str, anchor: float | None) -> float | None:
    try:
        line = msgspec.json.decode(text)
    except DECODER_FAULTS:
        return anchor
    seconds = line.get("time") if isinstance(line, dict) else None
    return float(seconds) if isinstance(seconds, int | float) and abs(seconds) < FARTHEST_TIME else anchor


def _receiver_origin(sensor: GnssSensor, origins: Mapping[str, Origin], receivers: Sequence[GnssSensor]) -> Origin:
    """Root key and name of a receiver's lines: those that it was read under, `gps` for the first one, else its id."""
    name = str(sensor.id)
    if name in origins:
        return origins[name]
    if sensor in _main_receiver([other for other in receivers if str(other.id) not in origins]):
        return GPS_ORIGIN
    return _origin_for(name)


def _main_receiver(receivers: Sequence[GnssSensor]) -> list[GnssSensor]:
    """Give the one whose lines are `gps` lines: the one that is called so, else the first that has no other name."""
    others = [sensor for sensor in receivers if sensor.id != "rtkgps"]
    return [sensor for sensor in others if sensor.id == "gnss"][:1] or others[:1]
