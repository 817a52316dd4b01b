"""The cameras of a log: raw and compressed images, depth, videos of one image a message, and camera models."""

import io
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from threading import Lock
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple, cast

import numpy as np

from sceneloom.arrays import AnyArray, Float32Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.cameras.camera import MODELS, OPENCV_LENGTHS, Camera, from_opencv
from sceneloom.errors import CalibrationError, DataError, UnknownFormatError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import FileView, check_pixels
from sceneloom.formats.base.images import PNG_START, EncodedImage, decode_grey_png, grey_png_size
from sceneloom.formats.base.wire_formats import read_varint
from sceneloom.formats.messages.records import (
    CameraModelRecord,
    CompressedImageRecord,
    ImageRecord,
    Kind,
    Topic,
    TopicLog,
)
from sceneloom.formats.messages.survey import Survey, in_order
from sceneloom.scene.cameras import CameraImage, CameraSensor, DepthCameraSensor, DepthFrame, VideoContent
from sceneloom.scene.frames import LazyFrames
from sceneloom.warnings import WarningKind

if TYPE_CHECKING:
    from sceneloom.formats.video.reader import VideoReader

MILLIMETRE = 0.001
"""Metres per step of depths in whole numbers. Source: REP 118, "Depth Images"."""


class _Encoding(NamedTuple):
    """How pixels stand in the bytes; `order` are the values that are red, green and blue, () for depths."""

    dtype: str
    values: int = 1
    order: tuple[int, ...] = (0, 0, 0)
    bayer: str = ""


_BAYER = ("rggb", "bggr", "gbrg", "grbg")

_ENCODINGS: Mapping[str, _Encoding] = MappingProxyType({
    "rgb8": _Encoding("u1", 3, (0, 1, 2)), "bgr8": _Encoding("u1", 3, (2, 1, 0)),
    "rgba8": _Encoding("u1", 4, (0, 1, 2)), "bgra8": _Encoding("u1", 4, (2, 1, 0)),
    "rgb16": _Encoding("u2", 3, (0, 1, 2)), "bgr16": _Encoding("u2", 3, (2, 1, 0)), "mono8": _Encoding("u1"),
    "mono16": _Encoding("u2"), "8UC1": _Encoding("u1"), "8UC3": _Encoding("u1", 3, (2, 1, 0)),
    "8UC4": _Encoding("u1", 4, (2, 1, 0)), "16UC1": _Encoding("u2", order=()), "32FC1": _Encoding("f4", order=()),
    **{f"bayer_{pattern}8": _Encoding("u1", bayer=pattern) for pattern in _BAYER},
    **{f"bayer_{pattern}16": _Encoding("u2", bayer=pattern) for pattern in _BAYER},
})  # fmt: skip
"""Source: sensor_msgs/image_encodings.hpp of ROS; the schema RawImage of Foxglove takes the same names."""


def _encoding_of(record: ImageRecord, owner: str, location: str) -> _Encoding:
    """Find the encoding of a message."""
    encoding = _ENCODINGS.get(record.encoding)
    if encoding is None:
        known = ", ".join(_ENCODINGS)
        raise UnknownFormatError(owner, location, f"encoding {record.encoding!r}; expected one of {known}")
    return encoding


def _values_of(record: ImageRecord, owner: str, location: str) -> AnyArray:
    """Give the values of all pixels, (height, width, K) of the encoding's dtype, in native byte order."""
    encoding = _encoding_of(record, owner, location)
    dtype = np.dtype(encoding.dtype).newbyteorder(">" if record.big_endian else "<")
    row = record.width * encoding.values * dtype.itemsize
    step = record.step or row
    if record.width <= 0 or record.height <= 0 or step < row or len(record.data) < record.height * step:
        problem = (
            f"{len(record.data)} bytes in rows of {step} for {record.width}x{record.height} pixels of "
            f"{record.encoding}; expected rows of {row} or more, and all of them"
        )
        raise DataError(owner, location, problem)
    content = np.frombuffer(record.data, np.uint8, record.height * step).reshape(record.height, step)
    values = np.ascontiguousarray(content[:, :row]).view(dtype)
    native = values.astype(dtype.newbyteorder("="), copy=False)
    return native.reshape(record.height, record.width, encoding.values)


def image_of(record: ImageRecord, owner: str, location: str) -> UInt8Array:
    """Give an image, (height, width, 3) uint8 red green blue; of 16 bits the upper eight.

    Raises:
        DataError: as for `_values_of`, or the pixels are depths.
    """
    encoding = _encoding_of(record, owner, location)
    if not encoding.order:
        raise DataError(owner, location, f"encoding {record.encoding!r} is of depths; expected an image")
    values = _values_of(record, owner, location)
    if values.dtype == np.uint16:
        values = (values >> 8).astype(np.uint8)
    if encoding.bayer:
        return _colours(values[:, :, 0], encoding.bayer)
    return np.ascontiguousarray(values[:, :, list(encoding.order)])


def _colours(mosaic: UInt8Array, pattern: str) -> UInt8Array:
    """Give each pixel the colours that it lacks as means of the nearest pixels that have them."""
    height, width = mosaic.shape
    image = np.empty((height, width, 3), np.uint8)
    for channel, letter in enumerate("rgb"):
        mask = np.zeros((height, width), np.uint16)
        for location, colour in enumerate(pattern):
            if colour == letter:
                mask[location // 2 :: 2, location % 2 :: 2] = 1
        image[:, :, channel] = _filled(mosaic.astype(np.uint16), mask)
    return image


def _filled(values: AnyArray, mask: AnyArray) -> AnyArray:
    """Keep the values where the mask is 1, and give the others the mean of those around, side before corner."""
    sums, counts = _around(values * mask), _around(mask)
    means = (sums + counts // 2) // np.maximum(counts, 1)
    return np.where(mask, values, means).astype(np.uint8)


def _around(values: AnyArray) -> AnyArray:
    """Sums over three by three pixels, weighted 1 2 1 both ways, as bilinear interpolation does."""
    padded = np.pad(values, 1)
    rows: AnyArray = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    return cast("AnyArray", rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:])


UNKNOWN_MODEL = "unknown"
"""Model of cameras without a calibration: images can be looked at, and nothing can be projected."""

OUR_PREFIX = "sceneloom:"  # begins the names of models that only we know, in calibrations of ours

_READ: Mapping[str, tuple[str, int]] = MappingProxyType(
    dict.fromkeys(("", "none", "pinhole", "plumb_bob"), ("brown_conrady", 5))
    | {"rational_polynomial": ("brown_conrady", OPENCV_LENGTHS[-1])}
    | dict.fromkeys(("equidistant", "fisheye", "kannala_brandt"), ("fisheye", 4))
)
"""Our model of each name, and how many coefficients it may have."""

_TOLERANCE = 1e-9


def _no_camera_model(width: int, height: int) -> Camera:
    """The camera model of a camera without a calibration."""
    return Camera(UNKNOWN_MODEL, width, height, 1.0, 1.0, (width - 1) / 2, (height - 1) / 2)


def read_camera_model(record: CameraModelRecord, owner: str, location: str, ledger: Ledger) -> Camera | None:
    """Read a calibration; None for one that says that the camera is not calibrated.

    Raises:
        UnknownFormatError: the model is unknown.
        DataError: its numbers are none.
    """
    k = record.k
    if len(k) != 9:
        raise DataError(owner, location, f"K of {len(k)} numbers; expected 9")
    if k[0] == 0.0:
        return None
    model, coefficients = _model(record, owner, location)
    if abs(k[1]) > _TOLERANCE * abs(k[0]):
        message = f"skew {k[1]:g} of K is not used"
        ledger.note(WarningKind.SKIPPED, "camera-model-skew", f"{owner}: {location}", message)
    try:
        return Camera(model, record.width, record.height, k[0], k[4], k[2], k[5], coefficients)
    except CalibrationError as error:
        raise DataError(owner, location, str(error)) from None


def is_known_model(record: CameraModelRecord) -> bool:
    """Whether a calibration is of a model that is read."""
    named = record.model.strip()
    return named.lower() in _READ or (named.startswith(OUR_PREFIX) and named.removeprefix(OUR_PREFIX) in MODELS)


def _model(record: CameraModelRecord, owner: str, location: str) -> tuple[str, tuple[float, ...]]:
    named = record.model.strip()
    own = named.removeprefix(OUR_PREFIX)
    if named.startswith(OUR_PREFIX) and own in MODELS:
        return own, record.coefficients
    if named.lower() not in _READ:
        known = ", ".join(filter(None, _READ))
        problem = f"{record.model!r}; expected one of {known}"
        raise UnknownFormatError(owner, f"{location}.distortion_model", problem)
    model, most = _READ[named.lower()]
    numbers = record.coefficients
    while len(numbers) > most and numbers[-1] == 0.0:
        numbers = numbers[:-1]
    if len(numbers) > most:
        problem = f"{len(numbers)} coefficients of {named or 'a camera model without model'}; expected at most {most}"
        raise DataError(owner, f"{location}.D", problem)
    if model == "fisheye":
        return model, (*numbers, *(0.0,) * (most - len(numbers)))
    if not any(numbers):
        return "pinhole", ()
    return model, from_opencv(numbers)


def _fitted(camera: Camera, size: tuple[int, int], location: str, ledger: Ledger) -> Camera:
    """Fit a camera model to the size of the images, with a warning where it is for another one."""
    if (camera.width, camera.height) == size:
        return camera
    sizes = f"the calibration is for {camera.width}x{camera.height}, the images are {size[0]}x{size[1]}"
    ledger.note(WarningKind.REPAIRED, "camera-model-scaled", location, f"{sizes}; the camera model was scaled")
    return _no_camera_model(*size) if camera.model == UNKNOWN_MODEL else camera.resized(*size)


_CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "av1"}
"""Codecs that are read from messages, by the words of messages, and as FFmpeg calls them."""


class _MessageVideo:
    """The video of a topic, put into a nameless mp4 file at the first image; rows are in the order of decoding."""

    def __init__(self, log: TopicLog, topic: Topic, rows: Int64Array, timestamps_ns: Int64Array, codec: str) -> None:
        """Read nothing yet."""
        self.log, self.topic, self.rows, self.timestamps_ns, self.codec = log, topic, rows, timestamps_ns, codec
        self._begin()

    def _begin(self) -> None:
        self._file: BinaryIO | None = None
        self._reader: VideoReader | None = None
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("log", "topic", "rows", "timestamps_ns", "codec")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._begin()

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"{self.log.name}: {self.topic.name}"

    def packets(self) -> Iterator[memoryview]:
        """The bytes of each message, in the order in which they are decoded."""
        for row in self.rows.tolist():
            record = self.log.read(self.topic, row)[0]
            if not isinstance(record, CompressedImageRecord) or _CODECS.get(record.form) != self.codec:
                form = getattr(record, "form", "no image")
                problem = f"{form!r}; expected {self.codec} as the first message"
                raise DataError(self.log.name, f"{self.topic.name}[{row}]", problem)
            yield record.data

    def open(self) -> BinaryIO:
        """Open the video as a file of its own."""
        with self._lock:
            if self._file is None:
                self._file = self._made()
            return cast("BinaryIO", io.BufferedReader(FileView(self._file)))

    def size(self) -> tuple[int, int]:
        """Width and height of its images [px]."""
        reader = self._opened()
        return reader.width, reader.height

    def rgb(self, k: int) -> UInt8Array:
        """Decode the image that is shown as number `k`."""
        return self._opened().rgb(k)

    def content(self) -> VideoContent:
        """The video for those who copy it."""
        return VideoContent(self.open, self.codec)

    def close(self) -> None:
        """Release the file."""
        with self._lock:
            reader, file, self._reader, self._file = self._reader, self._file, None, None
        if reader is not None:
            reader.close()
        if file is not None:
            file.close()

    def _opened(self) -> "VideoReader":
        from sceneloom.formats.video.reader import VideoReader

        reader = self._reader
        if reader is None:
            reader = self._reader = VideoReader(self.open, name=self.name)
            if reader.count != len(self.rows):
                problem = f"{reader.count} images in {len(self.rows)} messages; expected one in each"
                raise DataError(self.log.name, self.topic.name, problem)
        return reader

    def _made(self) -> BinaryIO:
        """Put the packets into a file, with the times that the messages state."""
        from sceneloom.formats.video.writer import packets_to_mp4

        with tempfile.TemporaryFile() as raw:
            raw.write(_stream_head(self.codec))
            for k, packet in enumerate(self.packets()):
                raw.write(_packet_head(self.codec, len(packet), k))
                raw.write(packet)
            target = cast("BinaryIO", tempfile.TemporaryFile())  # noqa: SIM115 - it stays open with the video
            try:
                packets_to_mp4(cast("BinaryIO", raw), target, self.timestamps_ns, self.name)
            except BaseException:
                target.close()
                raise
        return target


_IVF_CODES = {"vp9": b"VP90", "av1": b"AV01"}


def _stream_head(codec: str) -> bytes:
    """What stands before the packets of a video: IVF, where they have no form of their own to tell them apart.

    Source: wiki.multimedia.cx, "Duck IVF".
    """
    if codec not in _IVF_CODES:
        return b""
    return struct.pack("<4sHH4sHHIII4x", b"DKIF", 0, 32, _IVF_CODES[codec], 0, 0, 30, 1, 0)


def _packet_head(codec: str, size: int, number: int) -> bytes:
    return struct.pack("<IQ", size, number) if codec in _IVF_CODES else b""


def _video_image(video: _MessageVideo, timestamps_ns: Int64Array, models: "_CameraModels", k: int) -> CameraImage:
    """Make image `k` of a video, in the order of showing, without decoding it."""
    timestamp_ns = int(timestamps_ns[k])
    return CameraImage(timestamp_ns, models.at(timestamp_ns), partial(video.rgb, k))


_MARKS = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}


@dataclass(frozen=True, slots=True, eq=False)
class _CameraModels:
    """The camera models of a camera from each of (N,) times on [ns]; the first holds before, too."""

    since_ns: Int64Array
    cameras: tuple[Camera, ...]

    def at(self, timestamp_ns: int) -> Camera:
        """The camera model at a time."""
        row = int(np.searchsorted(self.since_ns, timestamp_ns, side="right")) - 1
        return self.cameras[max(row, 0)]


@dataclass(frozen=True, slots=True, eq=False)
class _ImageReader:
    """Makes the images or depth images of a topic, by the number of each message; `scale` are the metres of a step."""

    log: TopicLog
    topic: Topic
    rows: Int64Array
    timestamps_ns: Int64Array
    camera_models: _CameraModels
    scale: float | None = None

    def image(self, k: int) -> CameraImage:
        """Make image `k` without reading it."""
        timestamp_ns = int(self.timestamps_ns[k])
        encoded = partial(self.file, k) if self.topic.kind is Kind.COMPRESSED_IMAGE else None
        return CameraImage(timestamp_ns, self.camera_models.at(timestamp_ns), partial(self.rgb, k), encoded=encoded)

    def depth_frame(self, k: int) -> DepthFrame:
        """Make depth image `k` without reading it."""
        timestamp_ns = int(self.timestamps_ns[k])
        return DepthFrame(timestamp_ns, self.camera_models.at(timestamp_ns), partial(self.depth, k), self.scale)

    def _message(self, k: int) -> tuple[Any, str, str]:
        """The message of image `k`, and where it stands, for messages."""
        row = int(self.rows[k])
        return self.log.read(self.topic, row)[0], self.log.name, f"{self.topic.name}[{row}]"

    def file(self, k: int) -> bytes:
        """The file of image `k`."""
        return bytes(self._message(k)[0].data)

    def depth(self, k: int) -> Float32Array:
        """Decode depth image `k`, (height, width) float32 [m], 0 for none."""
        record, owner, location = self._message(k)
        if not isinstance(record, ImageRecord):
            packed = _PackedDepth.of(record)
            if packed is None:
                raise DataError(owner, location, f"format {record.form!r}; expected depths as in the first message")
            return packed.depths(owner, location)
        values = _values_of(record, owner, location)[:, :, 0]
        if values.dtype == np.uint16:
            return (values * np.float64(MILLIMETRE)).astype(np.float32)
        return cast("Float32Array", np.where(np.isfinite(values) & (values > 0), values, np.float32(0)))

    def rgb(self, k: int) -> UInt8Array:
        """Decode image `k`."""
        record, owner, location = self._message(k)
        camera = self.camera_models.at(int(self.timestamps_ns[k]))
        if not isinstance(record, ImageRecord):
            form = _image_form(record, owner, location)
            return EncodedImage(bytes(record.data), form, camera.width, camera.height, owner, location)()
        image = image_of(record, owner, location)
        if image.shape[:2] != (camera.height, camera.width):
            problem = f"an image of {record.width}x{record.height}; expected {camera.width}x{camera.height}"
            raise DataError(owner, location, problem)
        return image


def _image_form(record: CompressedImageRecord, owner: str, location: str) -> str:
    """The form of an image's file, by how it begins."""
    form = _MARKS.get(bytes(record.data[:3]))
    if form is None:
        problem = f"an image of format {record.form!r} that begins as no JPEG or PNG file does; expected one of these"
        raise UnknownFormatError(owner, location, problem)
    return form


@dataclass(frozen=True, slots=True, eq=False)
class CameraDraft:
    """A camera before it is placed.

    Attributes:
        topic: of its images.
        frame_id: of the camera.
        camera_model: of the camera.
        frames: its images or depth images.
        is_depth: whether it measures depth.
        video: the encoded video, where there is one.
    """

    topic: Topic
    frame_id: str
    camera_model: Camera
    frames: Any
    is_depth: bool
    video: _MessageVideo | None = None

    @classmethod
    def of(
        cls,
        survey: Survey,
        topic: Topic,
        camera_model_topic: Topic | None,
        fitted: Callable[[tuple[int, int]], Camera] | None = None,
    ) -> "CameraDraft":
        """Find out what a topic of images shows; its first message is read.

        Args:
            survey: of the log.
            topic: of the images.
            camera_model_topic: of their calibrations, or None.
            fitted: gives the camera model for images of a size, in place of calibrations.

        Raises:
            DataError: the first message is damaged, or the camera model is.
            UnknownFormatError: the images are of a form that is not read.
        """
        timestamps = survey.times_ns[topic.number]
        location = f"{survey.log.name}: {topic.name}"
        if topic.kind is Kind.VIDEO:
            return _draft_video(survey, topic, camera_model_topic, timestamps, location, fitted)
        rows = in_order(timestamps, location, survey.ledger)
        first: Any = survey.log.read(topic, int(rows[0]))[0]
        owner, where = survey.log.name, f"{topic.name}[{int(rows[0])}]"
        if isinstance(first, ImageRecord):
            is_depth, size = not _encoding_of(first, owner, where).order, (first.width, first.height)
            kind = first.encoding.lower()
        elif (packed := _PackedDepth.of(first)) is not None:
            is_depth, size, kind = True, packed.size(owner, where), packed.type
        else:
            form = _image_form(first, owner, where)
            is_depth, size, kind = False, EncodedImage(bytes(first.data), form, 0, 0, owner, where).stated_size(), ""
        camera_models = _camera_models(survey, camera_model_topic, size, location, fitted)
        scale = MILLIMETRE if is_depth and kind == "16uc1" else None
        reader = _ImageReader(survey.log, topic, rows, timestamps[rows], camera_models, scale)
        frames: LazyFrames[Any] = LazyFrames(timestamps[rows], reader.depth_frame if is_depth else reader.image)
        return cls(topic, first.frame_id, camera_models.cameras[0], frames, is_depth)

    def sensor(self, sensor_id: str | int, **fields: Any) -> CameraSensor | DepthCameraSensor:
        """The sensor, with further fields."""
        if self.is_depth:
            return DepthCameraSensor(sensor_id, self.camera_model, self.frames, **fields)
        content: VideoContent | None = None if self.video is None else self.video.content()
        return CameraSensor(sensor_id, self.camera_model, self.frames, video=content, **fields)


def _draft_video(
    survey: Survey,
    topic: Topic,
    camera_model_topic: Topic | None,
    timestamps: Int64Array,
    location: str,
    fitted: Callable[[tuple[int, int]], Camera] | None,
) -> CameraDraft:
    skipped, first = 0, None
    for skipped in range(len(timestamps)):
        record: Any = survey.log.read(topic, skipped)[0]
        if record.form not in _CODECS:
            problem = f"format {record.form!r}; expected one of {', '.join(_CODECS)}"
            raise UnknownFormatError(survey.log.name, f"{topic.name}[{skipped}].format", problem)
        if _starts_video(record.data, _CODECS[record.form]):
            first = record
            break
    if first is None:
        problem = f"none of {len(timestamps)} messages holds the parameters of a video, without which none is decoded"
        raise DataError(survey.log.name, topic.name, problem)
    if skipped:
        message = "images before the first that can be decoded without others"
        survey.ledger.note(WarningKind.SKIPPED, "video-begins-late", location, message, count=skipped)
    rows = np.arange(skipped, len(timestamps), dtype=np.int64)
    video = _MessageVideo(survey.log, topic, rows, timestamps[rows], _CODECS[first.form])
    size = _video_size(bytes(first.data), _CODECS[first.form], location)
    camera_models = _camera_models(survey, camera_model_topic, size, location, fitted)
    shown = np.sort(timestamps[rows], kind="stable")
    frames = LazyFrames(shown, partial(_video_image, video, shown, camera_models))
    return CameraDraft(topic, first.frame_id, camera_models.cameras[0], frames, is_depth=False, video=video)


def _video_size(packet: bytes, codec: str, name: str) -> tuple[int, int]:
    """Width and height of the image in the first packet of a video [px]."""
    from sceneloom.formats.video.reader import OpenVideo

    opened = OpenVideo(_stream_head(codec) + _packet_head(codec, len(packet), 0) + packet, name)
    try:
        decoder = opened.stream.codec_context
        return decoder.width, decoder.height
    finally:
        opened.close()


def _camera_models(
    survey: Survey,
    topic: Topic | None,
    size: tuple[int, int],
    location: str,
    fitted: Callable[[tuple[int, int]], Camera] | None,
) -> _CameraModels:
    """The camera models of a topic, fitted to the size of the images."""
    if fitted is not None:
        return _CameraModels(np.zeros(1, np.int64), (fitted(size),))
    found: dict[int, Camera] = {}
    records = [] if topic is None else survey.of(topic, CameraModelRecord)
    before: Any = None
    for k, record in enumerate(records):
        stated = record.width, record.height, record.model, record.coefficients, record.k
        if stated == before:
            continue
        before, where = stated, "" if topic is None else f"{topic.name}[{k}]"
        try:
            camera_model = read_camera_model(record, survey.log.name, where, survey.ledger)
        except UnknownFormatError as error:
            where = f"{error.file}: {error.location}"
            survey.ledger.note(WarningKind.SKIPPED, "camera-model-unknown", where, error.problem)
            continue
        if camera_model is not None:
            found[record.timestamp_ns] = _fitted(camera_model, size, location, survey.ledger)
    if not found:
        message = (
            "no calibration: the images can be looked at, and nothing can be projected into them; state it with "
            "`--rig FILE`: camera_info or Kalibr YAML, or a rig.toml with sensors = [{ id = …, type = "
            '"camera", camera_model = { width = W, height = H, K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]] } }]'
            if topic is None
            else f"{topic.name} reports no camera model that is known; nothing can be projected into the images"
        )
        survey.ledger.note(WarningKind.SKIPPED, "camera-model-missing", location, message)
        return _CameraModels(np.zeros(1, np.int64), (_no_camera_model(*size),))
    since = sorted(found)
    return _CameraModels(np.array(since, np.int64), tuple(found[time_ns] for time_ns in since))


_START_CODE = b"\x00\x00\x01"
_PARAMETERS = {"h264": lambda byte: byte & 0x1F == 7, "hevc": lambda byte: (byte >> 1) & 0x3F == 33}
"""Whether a unit with this first byte holds the parameters of a sequence, without which nothing is decoded."""

_AV1_SEQUENCE, _AV1_HAS_SIZE, _AV1_HAS_EXTENSION = 1, 2, 4


def _starts_video(packet: bytes | memoryview, codec: str) -> bool:
    """Whether decoding can begin with a packet: whether it holds the parameters of the sequence, or a key frame."""
    content, location = bytes(packet), 0
    if codec == "vp9":
        # Source: VP9 bitstream specification, 6.2: frame marker 2, profile, (reserved), nothing shown again, key frame
        bits = f"{content[0]:08b}" if content else ""
        return bits.startswith("10") and bits[(5 if bits[2:4] == "11" else 4) :][:2] == "00"
    if codec == "av1":
        return _holds_av1_sequence(content)
    while (location := content.find(_START_CODE, location)) >= 0 and location + 3 < len(content):
        if _PARAMETERS[codec](content[location + 3]):
            return True
        location += 3
    return False


def _holds_av1_sequence(content: bytes) -> bool:
    """Whether a packet of AV1 holds the header of a sequence. Source: AV1 bitstream specification, 5.3 and 5.9."""
    location = 0
    while location < len(content):
        head = content[location]
        if head >> 3 & 0xF == _AV1_SEQUENCE:
            return True
        location += 2 if head & _AV1_HAS_EXTENSION else 1
        if not head & _AV1_HAS_SIZE:
            return False
        try:
            size, location = read_varint(content, location, len(content))
        except ValueError:
            return False
        location += size
    return False


_DEPTH_TYPES = ("16uc1", "32fc1")
_DEPTH_HEAD = struct.Struct("<iff")
_RVL_HEAD = struct.Struct("<II")


@dataclass(frozen=True, slots=True)
class _PackedDepth:
    """A depth image that is compressed: what it is, and where in the bytes it begins.

    Source: codec.cpp and compression_common.h of compressed_depth_image_transport: a head of a number and the two
    parameters a, b of inverse depths q, whose depth is a / (q - b); images of 16UC1 are millimetres.
    """

    type: str
    is_rvl: bool
    content: bytes
    parameters: tuple[float, float] | None

    @classmethod
    def of(cls, record: CompressedImageRecord) -> "_PackedDepth | None":
        """What a message holds; None for an image of colours."""
        kind, _, rest = (part.strip() for part in record.form.partition(";"))
        if kind not in _DEPTH_TYPES:
            return None
        content = bytes(record.data)
        if content.startswith(PNG_START) or "compresseddepth" not in rest:
            return cls(kind, "rvl" in rest, content, None)
        parameters = _DEPTH_HEAD.unpack_from(content)[1:] if len(content) >= _DEPTH_HEAD.size else None
        return cls(kind, "rvl" in rest, content[_DEPTH_HEAD.size :], parameters)

    def size(self, owner: str, location: str) -> tuple[int, int]:
        """Width and height [px].

        Raises:
            DataError: it is no PNG file of 16 bits, or no RVL.
        """
        if not self.is_rvl:
            return grey_png_size(self.content, owner, location)
        if len(self.content) < _RVL_HEAD.size:
            raise DataError(owner, location, f"{len(self.content)} bytes of RVL; expected a head of {_RVL_HEAD.size}")
        width, height = _RVL_HEAD.unpack_from(self.content)
        check_pixels(owner, location, width, height)
        return width, height

    def depths(self, owner: str, location: str) -> Float32Array:
        """Decode the image, (height, width) float32 [m], 0 for none.

        Raises:
            DataError: as for `size`, or it is damaged.
        """
        width, height = self.size(owner, location)
        steps = self._from_rvl(width, height, owner, location) if self.is_rvl else None
        if steps is None:
            steps = decode_grey_png(self.content, owner, location)
        if self.type == "16uc1":
            return (steps * np.float64(MILLIMETRE)).astype(np.float32)
        if self.parameters is None:
            raise DataError(owner, location, "inverse depths without their parameters; expected a head of 12 bytes")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            depths = np.float32(self.parameters[0]) / (steps.astype(np.float32) - np.float32(self.parameters[1]))
        known = (steps > 0) & np.isfinite(depths) & (depths > 0)
        return cast("Float32Array", np.where(known, depths, np.float32(0)))

    def _from_rvl(self, width: int, height: int, owner: str, location: str) -> UInt16Array:
        from sceneloom.kernels.packed import read_runs

        content = self.content[_RVL_HEAD.size :]
        words = np.frombuffer(content + bytes(-len(content) % 4), np.uint8)
        pixels = np.empty(width * height, np.uint16)
        if read_runs(words, pixels) != len(pixels):
            raise DataError(owner, location, f"RVL of {len(content)} bytes that are no {width}x{height} pixels")
        return pixels.reshape(height, width)
