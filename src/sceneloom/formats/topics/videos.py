"""Images of a video that come one per message, as a video file that everything else can read."""

import io
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from sceneloom.arrays import Int64Array, UInt8Array
from sceneloom.cameras.camera import Camera
from sceneloom.errors import DataError
from sceneloom.formats.topics.file_views import FileView
from sceneloom.formats.topics.log import Topic, TopicLog
from sceneloom.formats.topics.records import CompressedImageRecord
from sceneloom.scene.cameras import CameraImage, VideoContent

if TYPE_CHECKING:
    from sceneloom.formats.video.reader import VideoReader

CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc"}
"""Codecs that are read from messages, by the words of messages, and as FFmpeg calls them."""


class MessageVideo:
    """The video of a topic: put into an mp4 file of no name when its first image is asked for.

    Attributes:
        log: that the messages are in.
        topic: that they are of.
        rows: (N,) int64, number of each message in its topic, in the order in which they are decoded.
        timestamps_ns: (N,) int64 [ns], of the messages in the same order.
        codec: as FFmpeg calls it.
    """

    def __init__(
        self, log: TopicLog, topic: Topic, rows: Int64Array, timestamps_ns: Int64Array, codec: str
    ) -> None:
        """Read nothing yet."""
        self.log, self.topic, self.rows, self.timestamps_ns, self.codec = (
            log,
            topic,
            rows,
            timestamps_ns,
            codec,
        )
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
            if not isinstance(record, CompressedImageRecord) or CODECS.get(record.form) != self.codec:
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
        from sceneloom.formats.topics.video_packets import annex_b_to_mp4

        with tempfile.TemporaryFile() as raw:
            for packet in self.packets():
                raw.write(packet)
            target = cast("BinaryIO", tempfile.TemporaryFile())  # noqa: SIM115 - it stays open with the video
            try:
                annex_b_to_mp4(cast("BinaryIO", raw), target, self.timestamps_ns, self.name)
            except BaseException:
                target.close()
                raise
        return target


@dataclass(frozen=True, slots=True, eq=False)
class VideoImages:
    """Makes the images of a camera from a video of messages.

    Attributes:
        video: of the topic.
        timestamps_ns: (N,) int64 [ns], in the order of showing.
        camera_model_at: gives the camera model at a time.
    """

    video: MessageVideo
    timestamps_ns: Int64Array
    camera_model_at: Callable[[int], Camera]

    def __call__(self, k: int) -> CameraImage:
        """Make image `k` without decoding it."""
        timestamp_ns = int(self.timestamps_ns[k])
        return CameraImage(timestamp_ns, self.camera_model_at(timestamp_ns), partial(self.video.rgb, k))
