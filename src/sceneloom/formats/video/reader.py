"""Frame-exact reading of a video: any image by its number; forward without seeking or decoding twice."""

from contextlib import suppress
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from av.video.frame import VideoFrame

from sceneloom.arrays import Float64Array, UInt8Array, UInt16Array
from sceneloom.errors import DataError
from sceneloom.formats.identity import FileIdentity
from sceneloom.formats.video.colours import Colours
from sceneloom.formats.video.cursor import Cursor
from sceneloom.formats.video.forking import rest_while_forking
from sceneloom.formats.video.index import VideoIndex, read_index
from sceneloom.formats.video.source import (
    OpenVideo,
    VideoSource,
    as_path,
    decoder_faults,
    open_bytes,
    source_name,
)
from sceneloom.formats.video.table_index import read_table_index

_TABLES = b"ftyp"
"""What mp4 and mov videos begin with after four bytes: their tables state where each image is. Matroska has none."""

_STEPS = ("gray16le", "gray16be")
"""FFmpeg's names of pixels that are one 16-bit number each."""


class VideoReader:
    """The images of one video, by number in the order in which they are shown.

    Nothing decoded is kept but the decoder's own state and the image it gave last; while that one is used, the
    decoder works on the next ones, four at most. Safe to share between threads, which then take rotates. A pickled
    reader takes the list of images along and opens its file again in the process that it comes to; of bytes in
    memory it takes the bytes. A forked process opens anew, too.

    Matrix and range of the colours are the stream's own; BT.601 and limited range where it names none. A rotation
    that the container asks players for is not applied: calibrations are made for the sensor's pixels.

    Attributes:
        name: what messages call the video.
        codec: "h264", "hevc", "ffv1", … as FFmpeg calls it.
        width, height: image size [px].
        has_steps: whether its images are one plane of 16-bit numbers, as depths are kept.
    """

    def __init__(
        self,
        source: VideoSource,
        *,
        name: str | None = None,
        index: VideoIndex | None = None,
        cut_off: bool = False,
    ) -> None:
        """Open the container and read its head.

        Args:
            source: a file, its bytes, or a function that opens a seekable binary file anew each time.
            name: what messages call the video, where the source is not a file.
            index: the list of its images, where it is known already.
            cut_off: read what is left of a video that breaks off.

        Raises:
            DataError: there is no such file, it is no video, or it holds no video stream.
        """
        self.name = source_name(source, name)
        self._source = source
        self._ahead = True
        self._opened: OpenVideo | None = self._open_source()
        self._identity = FileIdentity.of(as_path(source)) if isinstance(source, Path | str) else None
        decoder = self._opened.stream.codec_context
        self.codec: str = decoder.codec.canonical_name
        self.width, self.height = decoder.width, decoder.height
        self.has_steps = decoder.pix_fmt in _STEPS
        rate = self._opened.stream.average_rate
        self._rate = float(rate) if rate else None
        self._index = index
        self._cut_off = cut_off
        self._closed = False
        self._begin()

    def _begin(self) -> None:
        """Make what no other process can have a part in."""
        self._cursor: Cursor | None = None
        self._colours = Colours()
        self._lock = Lock()
        rest_while_forking(self)

    def __getstate__(self) -> dict[str, Any]:
        source = self._source
        kept = (
            "name",
            "codec",
            "width",
            "height",
            "has_steps",
            "_rate",
            "_index",
            "_identity",
            "_closed",
            "_cut_off",
            "_ahead",
        )
        return {
            **{name: getattr(self, name) for name in kept},
            "_source": bytes(source) if isinstance(source, memoryview) else source,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._opened = None
        self._begin()

    def hold(self) -> None:
        """Let no thread decode until `release`, and close the decoder: its threads and file must not be forked."""
        self._lock.acquire()
        if self._opened is not None:
            self._opened.close()
        self._opened = self._cursor = None

    def release(self) -> None:
        """Let threads decode again; the next image opens the file anew."""
        self._lock.release()

    @property
    def index(self) -> VideoIndex:
        """The list of images, made at the first call by walking through the file without decoding.

        Raises:
            DataError: the file is damaged or cut off.
        """
        with self._lock:
            return self._known_index()

    def open_file(self) -> BinaryIO:
        """Open what it reads from, as it is."""
        return open_bytes(self._source)

    @property
    def is_remainder(self) -> bool:
        """Whether it was opened as what is left of a video that breaks off."""
        return self._cut_off

    @property
    def count(self) -> int:
        """Exact number of images."""
        return len(self.index)

    @property
    def timestamps(self) -> Float64Array:
        """(N,) float64 [s], presentation time of each image as the container has it."""
        return self.index.timestamps

    @property
    def fps(self) -> float | None:
        """Images a second: what the container says, else the mean rate of the timestamps, else None."""
        if self._rate:
            return self._rate
        timestamps = self.timestamps
        span = float(timestamps[-1] - timestamps[0]) if len(timestamps) > 1 else 0.0
        return (len(timestamps) - 1) / span if span > 0 else None

    def rgb(self, index: int) -> UInt8Array:
        """Decode one image.

        Args:
            index: 0 for the image that is shown first.

        Returns:
            (height, width, 3) uint8, red green blue.

        Raises:
            DataError: there is no such image, or it cannot be decoded.
        """
        with self._lock:
            return self._convert(self._checked_frame(index), index)

    def steps(self, index: int) -> UInt16Array:
        """Decode one image of 16-bit numbers.

        Returns:
            (height, width) uint16, as they are stored.

        Raises:
            DataError: there is no such image, it cannot be decoded, or is of another kind.
        """
        with self._lock:
            frame = self._checked_frame(index)
            if frame.format.name not in _STEPS:
                problem = f"has pixels of type {frame.format.name}; expected one of {', '.join(_STEPS)}"
                raise DataError(self.name, f"image {index}", problem)
            with decoder_faults(self.name, f"image {index}"):
                return np.ascontiguousarray(frame.to_ndarray(), np.uint16)

    def close(self) -> None:
        """Release the file; the reader gives no images afterwards."""
        with self._lock:
            if self._opened is not None:
                self._opened.close()
            self._opened = self._cursor = None
            self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _known_index(self) -> VideoIndex:
        if self._index is None:
            self._check_unchanged()
            self._index = read_index(self._source, self.name, cut_off=self._cut_off)
        return self._index

    def _frame(self, index: int) -> VideoFrame:
        try:
            return self._decoded(index)
        except DataError:
            if not self._ahead or self._closed:
                raise
        # a decoder that works ahead does not state which packet is damaged
        self._stop_working_ahead()
        return self._decoded(index)

    def _decoded(self, index: int) -> VideoFrame:
        cursor = self._cursor
        if cursor is None or not cursor.reaches(index):
            if cursor is not None and index > 0 and self._ahead and self._known_index().independent:
                # of images that need no other, jumps would decode several for each one
                self._stop_working_ahead()
            cursor = self._cursor = self._seek(index) or self._restart()
        frame = cursor.advance(index)
        if frame is None and cursor.first > 0:
            # a key frame after which the decoder needs more than one image to recover
            cursor = self._cursor = self._restart()
            frame = cursor.advance(index)
        if frame is None:
            raise DataError(self.name, f"image {index}", "cannot be decoded: the decoder gives nothing")
        return frame

    def _seek(self, index: int) -> Cursor | None:
        images, opened = self._known_index(), self._open_file()
        entry = int(images.entries[index])
        if not images.timed or (entry == 0 and self._cursor is None):
            return None
        with decoder_faults(self.name, f"image {index}"):
            opened.container.seek(int(images.pts[entry]), stream=opened.stream, backward=True)
        cursor = Cursor(opened, images, self.name)
        return cursor if cursor.enter(entry) else self._restart()

    def _restart(self) -> Cursor:
        self._open_file().close()
        self._opened = None
        return Cursor(self._open_file(), self._known_index(), self.name)

    def _open_file(self) -> OpenVideo:
        if self._closed:
            raise DataError(self.name, "", "is closed")
        if self._opened is None:
            self._check_unchanged()
            self._opened = self._open_source()
        return self._opened

    def _open_source(self) -> OpenVideo:
        opened = OpenVideo(self._source, self.name)
        if self._ahead:
            opened.decode_ahead()
        return opened

    def _stop_working_ahead(self) -> None:
        self._ahead = False
        if self._opened is not None:
            self._opened.close()
        self._opened = self._cursor = None

    def _check_unchanged(self) -> None:
        if self._identity is not None:
            self._identity.check()

    def _checked_frame(self, index: int) -> VideoFrame:
        count = len(self._known_index())
        if not 0 <= index < count:
            raise DataError(self.name, f"image {index}", f"does not exist: the video holds {count}")
        frame = self._frame(index)
        if (frame.width, frame.height) != (self.width, self.height):
            found, expected = f"{frame.width}x{frame.height}", f"{self.width}x{self.height}"
            problem = f"is {found}; expected {expected} as the video's head says"
            raise DataError(self.name, f"image {index}", problem)
        return frame

    def _convert(self, frame: VideoFrame, index: int) -> UInt8Array:
        with decoder_faults(self.name, f"image {index}"):
            return self._colours.rgb(frame)


def open_video(source: VideoSource, *, name: str | None = None, cut_off: bool = False) -> VideoReader:
    """Open a video for reading by image number.

    Args:
        source: a file, its bytes, or a function that opens a seekable binary file anew each time.
        name: what messages call the video, where the source is not a file.
        cut_off: read what is left of a video that breaks off.

    Raises:
        DataError: it is no video, or holds no video stream.
    """
    in_chunks = getattr(source, "in_chunks", None)  # of a file that is not on disk yet
    content = in_chunks() if in_chunks is not None and not cut_off else None
    if content is not None and bytes(content[4:8]) == _TABLES:
        shown = source_name(source, name)
        with suppress(DataError):  # what is wrong with it, all of it reports
            return VideoReader(content, name=shown, index=read_table_index(content, shown))
    return VideoReader(source, name=name, cut_off=cut_off)
