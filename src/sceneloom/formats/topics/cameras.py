"""The cameras of a log: topics of pictures with the lenses that belong to them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from sceneloom.arrays import Float32Array, Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError, UnknownFormatError
from sceneloom.formats.encoded_pictures import EncodedPicture, picture_size
from sceneloom.formats.topics.lenses import fitted, no_lens, read_lens
from sceneloom.formats.topics.log import Topic, TopicLog
from sceneloom.formats.topics.names import nearest
from sceneloom.formats.topics.pixels import MILLIMETRE, depth_of, encoding_of, picture_of
from sceneloom.formats.topics.records import ImageRecord, Kind, LensRecord, PictureRecord
from sceneloom.formats.topics.stamps import in_order
from sceneloom.formats.topics.survey import Survey
from sceneloom.formats.topics.videos import CODECS, MessageVideo, VideoPictures
from sceneloom.scene.cameras import CameraSensor, Picture, VideoContent
from sceneloom.scene.depth import DepthCameraSensor, DepthFrame
from sceneloom.scene.frames import LazyFrames
from sceneloom.scene.notices import NoticeKind

_MARKS = {b"\xff\xd8\xff": "jpeg", b"\x89PN": "png"}


@dataclass(frozen=True, slots=True, eq=False)
class Lenses:
    """The lenses of a camera over time.

    Attributes:
        since_ns: (N,) int64 [ns], ascending.
        cameras: from each time on; the first before, too.
    """

    since_ns: Int64Array
    cameras: tuple[Camera, ...]

    def at(self, timestamp_ns: int) -> Camera:
        """The lens at a time."""
        row = int(np.searchsorted(self.since_ns, timestamp_ns, side="right")) - 1
        return self.cameras[max(row, 0)]


@dataclass(frozen=True, slots=True, eq=False)
class PictureReader:
    """Makes the pictures of a topic.

    Attributes:
        log: that the messages are in.
        topic: that they are of.
        rows: (N,) int64, number of each message in its topic.
        timestamps_ns: (N,) int64 [ns].
        lenses: of the camera.
    """

    log: TopicLog
    topic: Topic
    rows: Int64Array
    timestamps_ns: Int64Array
    lenses: Lenses

    def __call__(self, k: int) -> Picture:
        """Make picture `k` without reading it."""
        stamp_ns = int(self.timestamps_ns[k])
        lens, encoded = self.lenses.at(stamp_ns), None
        if self.topic.kind is Kind.PICTURE:
            encoded = partial(self.file, k)
        return Picture(stamp_ns, lens, partial(self.rgb, k), encoded=encoded)

    def place(self, k: int) -> str:
        """Where the message of picture `k` stands, for messages."""
        return f"{self.topic.name}[{int(self.rows[k])}]"

    def record(self, k: int) -> Any:
        """Read the message of picture `k`."""
        return self.log.read(self.topic, int(self.rows[k]))[0]

    def file(self, k: int) -> bytes:
        """The file of picture `k`."""
        return bytes(self.record(k).data)

    def rgb(self, k: int) -> UInt8Array:
        """Decode picture `k`.

        Raises:
            DataError: it is damaged, or of another size than its lens.
        """
        record, lens = self.record(k), self.lenses.at(int(self.timestamps_ns[k]))
        if isinstance(record, ImageRecord):
            picture = picture_of(record, self.log.name, self.place(k))
            if picture.shape[:2] != (lens.height, lens.width):
                problem = f"a picture of {record.width}x{record.height}; expected {lens.width}x{lens.height}"
                raise DataError(self.log.name, self.place(k), problem)
            return picture
        form = picture_form(record, self.log.name, self.place(k))
        file = EncodedPicture(bytes(record.data), form, lens.width, lens.height, self.log.name, self.place(k))
        return file()


@dataclass(frozen=True, slots=True, eq=False)
class DepthReader:
    """Makes the images of a camera that measures depth; fields as in `PictureReader`."""

    pictures: PictureReader
    scale: float | None

    def __call__(self, k: int) -> DepthFrame:
        """Make image `k` without reading it."""
        stamp_ns = int(self.pictures.timestamps_ns[k])
        return DepthFrame(stamp_ns, self.pictures.lenses.at(stamp_ns), partial(self.depth, k), self.scale)

    def depth(self, k: int) -> Float32Array:
        """Decode image `k`."""
        return depth_of(self.pictures.record(k), self.pictures.log.name, self.pictures.place(k))


def picture_form(record: PictureRecord, owner: str, place: str) -> str:
    """The form of a picture's file, by how it begins.

    Raises:
        UnknownFormatError: it is neither JPEG nor PNG.
    """
    form = _MARKS.get(bytes(record.data[:3]))
    if form is None:
        problem = f"a picture of format {record.form!r} that begins as no JPEG or PNG file does; expected one of these"
        raise UnknownFormatError(owner, place, problem)
    return form


@dataclass(frozen=True, slots=True, eq=False)
class CameraDraft:
    """A camera before it is placed.

    Attributes:
        topic: of its pictures.
        frame_id: of the camera.
        lens: of the camera.
        frames: its pictures or depth images.
        is_depth: whether it measures depth.
        video: the encoded video, where there is one.
    """

    topic: Topic
    frame_id: str
    lens: Camera
    frames: Any
    is_depth: bool
    video: MessageVideo | None = None

    def sensor(self, sensor_id: str | int, **fields: Any) -> CameraSensor | DepthCameraSensor:
        """The sensor, with further fields."""
        if self.is_depth:
            return DepthCameraSensor(sensor_id, self.lens, self.frames, **fields)
        content: VideoContent | None = None if self.video is None else self.video.content()
        return CameraSensor(sensor_id, self.lens, self.frames, video=content, **fields)


def draft_camera(survey: Survey, topic: Topic, lens_topic: Topic | None) -> CameraDraft:
    """Find out what a topic of pictures shows; its first message is read.

    Raises:
        DataError: the first message is damaged, or the lens is.
        UnknownFormatError: the pictures are of a form that is not read.
    """
    stamps = survey.times_ns[topic.number]
    place = f"{survey.log.name}: {topic.name}"
    if topic.kind is Kind.VIDEO:
        return _draft_video(survey, topic, lens_topic, stamps, place)
    rows = in_order(stamps, place, survey.ledger)
    first: Any = survey.log.read(topic, int(rows[0]))[0]
    owner, where = survey.log.name, f"{topic.name}[{int(rows[0])}]"
    if isinstance(first, ImageRecord):
        is_depth, size = not encoding_of(first, owner, where).order, (first.width, first.height)
    else:
        form = picture_form(first, owner, where)
        is_depth, size = False, picture_size(bytes(first.data), form, owner=owner, place=where)
    lenses = _lenses(survey, lens_topic, size, place)
    reader = PictureReader(survey.log, topic, rows, stamps[rows], lenses)
    make: Callable[[int], Any] = reader
    if is_depth:
        make = DepthReader(reader, MILLIMETRE if first.encoding == "16UC1" else None)
    frames = LazyFrames(stamps[rows], make)
    return CameraDraft(topic, first.frame_id, lenses.cameras[0], frames, is_depth)


def _draft_video(
    survey: Survey, topic: Topic, lens_topic: Topic | None, stamps: Int64Array, place: str
) -> CameraDraft:
    from sceneloom.formats.topics.video_packets import starts_video

    skipped, first = 0, None
    for skipped in range(len(stamps)):
        record: Any = survey.log.read(topic, skipped)[0]
        if record.form not in CODECS:
            problem = f"format {record.form!r}; expected one of {', '.join(CODECS)}"
            raise UnknownFormatError(survey.log.name, f"{topic.name}[{skipped}].format", problem)
        if starts_video(record.data, CODECS[record.form]):
            first = record
            break
    if first is None:
        problem = (
            f"none of {len(stamps)} messages holds the parameters of a video, without which none is decoded"
        )
        raise DataError(survey.log.name, topic.name, problem)
    if skipped:
        message = "pictures before the first that can be decoded without others"
        survey.ledger.note(NoticeKind.SKIPPED, "video-begins-late", place, message, count=skipped)
    rows = np.arange(skipped, len(stamps), dtype=np.int64)
    video = MessageVideo(survey.log, topic, rows, stamps[rows], CODECS[first.form])
    size = video_size(bytes(first.data), place)
    lenses = _lenses(survey, lens_topic, size, place)
    shown = np.sort(stamps[rows], kind="stable")
    frames = LazyFrames(shown, VideoPictures(video, shown, lenses.at))
    return CameraDraft(topic, first.frame_id, lenses.cameras[0], frames, is_depth=False, video=video)


def video_size(packet: bytes, name: str) -> tuple[int, int]:
    """Width and height of the picture in the first packet of a video [px]."""
    from sceneloom.formats.video.source import OpenVideo

    opened = OpenVideo(packet, name)
    try:
        decoder = opened.stream.codec_context
        return decoder.width, decoder.height
    finally:
        opened.close()


def _lenses(survey: Survey, topic: Topic | None, size: tuple[int, int], place: str) -> Lenses:
    """The lenses of a topic, fitted to the size of the pictures."""
    found: dict[int, Camera] = {}
    records = [] if topic is None else survey.of(topic, LensRecord)
    for k, record in enumerate(records):
        if k > 0 and _same(records[k - 1], record):
            continue
        where = "" if topic is None else f"{topic.name}[{k}]"
        try:
            lens = read_lens(record, survey.log.name, where, survey.ledger)
        except UnknownFormatError as error:
            survey.ledger.note(
                NoticeKind.SKIPPED, "lens-unknown", f"{error.file}: {error.place}", error.problem
            )
            continue
        if lens is not None:
            found[record.timestamp_ns] = fitted(lens, size, place, survey.ledger)
    if not found:
        message = (
            "no calibration: the pictures can be looked at, and nothing can be projected into them"
            if topic is None
            else f"{topic.name} tells no lens that is known; nothing can be projected into the pictures"
        )
        survey.ledger.note(NoticeKind.SKIPPED, "lens-missing", place, message)
        return Lenses(np.zeros(1, np.int64), (no_lens(*size),))
    since = sorted(found)
    return Lenses(np.array(since, np.int64), tuple(found[time_ns] for time_ns in since))


def _same(a: LensRecord, b: LensRecord) -> bool:
    return (a.width, a.height, a.model, a.coefficients, a.k) == (
        b.width,
        b.height,
        b.model,
        b.coefficients,
        b.k,
    )


def lens_topic_of(topic: Topic, lens_topics: Sequence[Topic]) -> Topic | None:
    """The topic of lenses that stands beside a topic of pictures."""
    by_name: Mapping[str, Topic] = MappingProxyType({other.name: other for other in lens_topics})
    name = nearest(topic.name, by_name)
    return None if name is None else by_name[name]
