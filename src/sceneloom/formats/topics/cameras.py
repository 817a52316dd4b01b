"""The cameras of a log: topics of images with the camera models that belong to them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.encoded_images import EncodedImage, image_size
from sceneloom.formats.topics.camera_models import fitted, no_camera_model, read_camera_model
from sceneloom.formats.topics.log import Topic, TopicLog
from sceneloom.formats.topics.names import nearest
from sceneloom.formats.topics.pixels import MILLIMETRE, depth_of, encoding_of, image_of
from sceneloom.formats.topics.records import CameraModelRecord, CompressedImageRecord, ImageRecord, Kind
from sceneloom.formats.topics.survey import Survey
from sceneloom.formats.topics.timestamps import in_order
from sceneloom.formats.topics.videos import CODECS, MessageVideo, VideoImages
from sceneloom.scene.cameras import CameraImage, CameraSensor, VideoContent
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.warnings import WarningKind

_MARKS = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}


@dataclass(frozen=True, slots=True, eq=False)
class CameraModels:
    """The camera models of a camera over time.

    Attributes:
        since_ns: (N,) int64 [ns], ascending.
        cameras: from each time on; the first before, too.
    """

    since_ns: Int64Array
    cameras: tuple[Camera, ...]

    def at(self, timestamp_ns: int) -> Camera:
        """The camera model at a time."""
        row = int(np.searchsorted(self.since_ns, timestamp_ns, side="right")) - 1
        return self.cameras[max(row, 0)]


@dataclass(frozen=True, slots=True, eq=False)
class ImageReader:
    """Makes the images of a topic.

    Attributes:
        log: that the messages are in.
        topic: that they are of.
        rows: (N,) int64, number of each message in its topic.
        timestamps_ns: (N,) int64 [ns].
        camera_models: of the camera.
    """

    log: TopicLog
    topic: Topic
    rows: Int64Array
    timestamps_ns: Int64Array
    camera_models: CameraModels

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without reading it."""
        timestamp_ns = int(self.timestamps_ns[k])
        camera_model, encoded = self.camera_models.at(timestamp_ns), None
        if self.topic.kind is Kind.COMPRESSED_IMAGE:
            encoded = partial(self.file, k)
        return CameraImage(timestamp_ns, camera_model, partial(self.rgb, k), encoded=encoded)

    def location(self, k: int) -> str:
        """Where the message of image `k` stands, for messages."""
        return f"{self.topic.name}[{int(self.rows[k])}]"

    def record(self, k: int) -> Any:
        """Read the message of image `k`."""
        return self.log.read(self.topic, int(self.rows[k]))[0]

    def file(self, k: int) -> bytes:
        """The file of image `k`."""
        return bytes(self.record(k).data)

    def rgb(self, k: int) -> UInt8Array:
        """Decode image `k`.

        Raises:
            DataError: it is damaged, or of another size than its camera model.
        """
        record, camera_model = self.record(k), self.camera_models.at(int(self.timestamps_ns[k]))
        if isinstance(record, ImageRecord):
            image = image_of(record, self.log.name, self.location(k))
            if image.shape[:2] != (camera_model.height, camera_model.width):
                problem = f"an image of {record.width}x{record.height}; expected {camera_model.width}x{camera_model.height}"
                raise DataError(self.log.name, self.location(k), problem)
            return image
        form = image_form(record, self.log.name, self.location(k))
        file = EncodedImage(
            bytes(record.data), form, camera_model.width, camera_model.height, self.log.name, self.location(k)
        )
        return file()


@dataclass(frozen=True, slots=True, eq=False)
class DepthReader:
    """Makes the images of a camera that measures depth; fields as in `ImageReader`."""

    images: ImageReader
    scale: float | None

    def __call__(self, k: int) -> DepthFrame:
        """Make image `k` without reading it."""
        timestamp_ns = int(self.images.timestamps_ns[k])
        return DepthFrame(
            timestamp_ns, self.images.camera_models.at(timestamp_ns), partial(self.depth, k), self.scale
        )

    def depth(self, k: int) -> Float32Array:
        """Decode image `k`."""
        return depth_of(self.images.record(k), self.images.log.name, self.images.location(k))


def image_form(record: CompressedImageRecord, owner: str, location: str) -> str:
    """The form of an image's file, by how it begins.

    Raises:
        UnknownFormatError: it is neither JPEG nor PNG.
    """
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
    video: MessageVideo | None = None

    def sensor(self, sensor_id: str | int, **fields: Any) -> CameraSensor | DepthCameraSensor:
        """The sensor, with further fields."""
        if self.is_depth:
            return DepthCameraSensor(sensor_id, self.camera_model, self.frames, **fields)
        content: VideoContent | None = None if self.video is None else self.video.content()
        return CameraSensor(sensor_id, self.camera_model, self.frames, video=content, **fields)


def draft_camera(survey: Survey, topic: Topic, camera_model_topic: Topic | None) -> CameraDraft:
    """Find out what a topic of images shows; its first message is read.

    Raises:
        DataError: the first message is damaged, or the camera model is.
        UnknownFormatError: the images are of a form that is not read.
    """
    timestamps = survey.times_ns[topic.number]
    location = f"{survey.log.name}: {topic.name}"
    if topic.kind is Kind.VIDEO:
        return _draft_video(survey, topic, camera_model_topic, timestamps, location)
    rows = in_order(timestamps, location, survey.ledger)
    first: Any = survey.log.read(topic, int(rows[0]))[0]
    owner, where = survey.log.name, f"{topic.name}[{int(rows[0])}]"
    if isinstance(first, ImageRecord):
        is_depth, size = not encoding_of(first, owner, where).order, (first.width, first.height)
    else:
        form = image_form(first, owner, where)
        is_depth, size = False, image_size(bytes(first.data), form, owner=owner, location=where)
    camera_models = _camera_models(survey, camera_model_topic, size, location)
    reader = ImageReader(survey.log, topic, rows, timestamps[rows], camera_models)
    make: Callable[[int], Any] = reader
    if is_depth:
        make = DepthReader(reader, MILLIMETRE if first.encoding == "16UC1" else None)
    frames = LazyFrames(timestamps[rows], make)
    return CameraDraft(topic, first.frame_id, camera_models.cameras[0], frames, is_depth)


def _draft_video(
    survey: Survey, topic: Topic, camera_model_topic: Topic | None, timestamps: Int64Array, location: str
) -> CameraDraft:
    from sceneloom.formats.topics.video_packets import starts_video

    skipped, first = 0, None
    for skipped in range(len(timestamps)):
        record: Any = survey.log.read(topic, skipped)[0]
        if record.form not in CODECS:
            problem = f"format {record.form!r}; expected one of {', '.join(CODECS)}"
            raise UnknownFormatError(survey.log.name, f"{topic.name}[{skipped}].format", problem)
        if starts_video(record.data, CODECS[record.form]):
            first = record
            break
    if first is None:
        problem = f"none of {len(timestamps)} messages holds the parameters of a video, without which none is decoded"
        raise DataError(survey.log.name, topic.name, problem)
    if skipped:
        message = "images before the first that can be decoded without others"
        survey.ledger.note(WarningKind.SKIPPED, "video-begins-late", location, message, count=skipped)
    rows = np.arange(skipped, len(timestamps), dtype=np.int64)
    video = MessageVideo(survey.log, topic, rows, timestamps[rows], CODECS[first.form])
    size = video_size(bytes(first.data), location)
    camera_models = _camera_models(survey, camera_model_topic, size, location)
    shown = np.sort(timestamps[rows], kind="stable")
    frames = LazyFrames(shown, VideoImages(video, shown, camera_models.at))
    return CameraDraft(topic, first.frame_id, camera_models.cameras[0], frames, is_depth=False, video=video)


def video_size(packet: bytes, name: str) -> tuple[int, int]:
    """Width and height of the image in the first packet of a video [px]."""
    from sceneloom.formats.video.source import OpenVideo

    opened = OpenVideo(packet, name)
    try:
        decoder = opened.stream.codec_context
        return decoder.width, decoder.height
    finally:
        opened.close()


def _camera_models(survey: Survey, topic: Topic | None, size: tuple[int, int], location: str) -> CameraModels:
    """The camera models of a topic, fitted to the size of the images."""
    found: dict[int, Camera] = {}
    records = [] if topic is None else survey.of(topic, CameraModelRecord)
    for k, record in enumerate(records):
        if k > 0 and _same(records[k - 1], record):
            continue
        where = "" if topic is None else f"{topic.name}[{k}]"
        try:
            camera_model = read_camera_model(record, survey.log.name, where, survey.ledger)
        except UnknownFormatError as error:
            survey.ledger.note(
                WarningKind.SKIPPED, "camera-model-unknown", f"{error.file}: {error.location}", error.problem
            )
            continue
        if camera_model is not None:
            found[record.timestamp_ns] = fitted(camera_model, size, location, survey.ledger)
    if not found:
        message = (
            "no calibration: the images can be looked at, and nothing can be projected into them"
            if topic is None
            else f"{topic.name} reports no camera model that is known; nothing can be projected into the images"
        )
        survey.ledger.note(WarningKind.SKIPPED, "camera-model-missing", location, message)
        return CameraModels(np.zeros(1, np.int64), (no_camera_model(*size),))
    since = sorted(found)
    return CameraModels(np.array(since, np.int64), tuple(found[time_ns] for time_ns in since))


def _same(a: CameraModelRecord, b: CameraModelRecord) -> bool:
    return (a.width, a.height, a.model, a.coefficients, a.k) == (
        b.width,
        b.height,
        b.model,
        b.coefficients,
        b.k,
    )


def camera_model_topic_of(topic: Topic, camera_model_topics: Sequence[Topic]) -> Topic | None:
    """The topic of camera models that stands beside a topic of images."""
    by_name: Mapping[str, Topic] = MappingProxyType({other.name: other for other in camera_model_topics})
    name = nearest(topic.name, by_name)
    return None if name is None else by_name[name]
