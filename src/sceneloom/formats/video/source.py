"""Where the bytes of a video come from, and how a decoder's complaints become ours."""

import io
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

import av
from av.codec.context import ThreadType
from av.container import InputContainer
from av.video.stream import VideoStream

from sceneloom.errors import DataError
from sceneloom.formats.byte_stream import ByteStream
from sceneloom.formats.files import check_pixels, check_regular, file_faults, open_file, why_no_file
from sceneloom.formats.processors import processors

VideoSource = Path | str | bytes | bytearray | memoryview | Callable[[], BinaryIO]
"""A file, its bytes, or a function that opens them anew each time."""

_DEMUXERS = (
    "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpegts,mpeg,flv,ogg,ivf,h264,hevc,obu,mjpeg,mxf,asf,nut,"
    "yuv4mpegpipe"
)
"""Containers of one video each. Playlists are not among them: they could name any file or address."""


_MOST_AHEAD = 4
"""Images that are decoded at the same time at most: each is kept, and a jump waits for all of them."""


def source_name(source: VideoSource, name: str | None) -> str:
    """What messages call the video: the given name, else its path, else `video`."""
    if name is not None:
        return name
    return str(source) if isinstance(source, Path | str) else "video"


def as_path(source: Path | str) -> Path:
    """The path of a file, of the class that it is of."""
    return source if isinstance(source, Path) else Path(source)


def open_bytes(source: VideoSource) -> BinaryIO:
    """Open the source as a new seekable binary file."""
    if isinstance(source, Path | str):
        return open_file(as_path(source))
    if callable(source):
        return source()
    return cast("BinaryIO", io.BufferedReader(ByteStream(memoryview(source).cast("B"))))


@contextmanager
def decoder_faults(name: str, location: str) -> Iterator[None]:
    """Rotate whatever the video library raises into a DataError at `location`."""
    try:
        yield
    except (av.FFmpegError, OSError, ValueError, MemoryError) as error:
        problem = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise DataError(name, location, f"cannot be read as video: {problem}") from error


class OpenVideo:
    """An open container and its video stream; closes what it opened.

    Attributes:
        container: positioned at the first packet.
        stream: the container's video.
        works_ahead: whether the decoder gives images and faults some packets late.

    Raises:
        DataError: the source cannot be opened, is no video, or holds no video stream.
    """

    container: InputContainer
    stream: VideoStream
    works_ahead: bool = False

    def __init__(self, source: VideoSource, name: str, *, options: Mapping[str, str] | None = None) -> None:
        """Open the source and find its video stream.

        Args:
            source: the video.
            name: what messages call it.
            options: further ones for the container.
        """
        if isinstance(source, Path | str):
            if not as_path(source).is_file():
                raise DataError(
                    name, "", "not a file" if as_path(source).is_dir() else why_no_file(as_path(source))
                )
            with file_faults(as_path(source)):
                check_regular(as_path(source))
        self._file: BinaryIO | None = None
        with decoder_faults(name, ""):
            self._open(source, options or {})
        try:
            self.stream = self._find_stream(name)
        except DataError:
            self.close()
            raise

    def _open(self, source: VideoSource, further: Mapping[str, str]) -> None:
        if isinstance(source, Path | str):
            # the prefix keeps a colon in a file's name from being taken for a protocol
            target: Any = f"file:{os.fspath(source)}"
        else:
            target = self._file = open_bytes(source)
        options = {"format_whitelist": _DEMUXERS, **further}
        try:
            self.container = cast("InputContainer", av.open(target, "r", container_options=options))
        except BaseException:
            self._close_file()
            raise

    def _find_stream(self, name: str) -> VideoStream:
        stream = cast("VideoStream | None", self.container.streams.best("video"))
        if stream is None:
            raise DataError(name, "", "holds no video stream")
        decoder = stream.codec_context
        if decoder is None or decoder.width <= 0 or decoder.height <= 0:
            raise DataError(name, "", "its video stream is of an unknown codec or image size")
        check_pixels(name, "", decoder.width, decoder.height)
        return stream

    def decode_ahead(self) -> None:
        """Have other processors work on the next images while the last is used; to be stated before there is one.

        What others pass over is a fault to it, too: who wants to know
        which packet is damaged, and to have what others make of it, asks one that does not work ahead.
        """
        available = processors()
        if available == 1:
            return
        decoder = self.stream.codec_context
        decoder.thread_type = ThreadType.AUTO
        decoder.thread_count = min(available + 1, _MOST_AHEAD)
        decoder.options = {**decoder.options, "err_detect": "explode"}
        self.works_ahead = True

    def _close_file(self) -> None:
        if self._file is not None:
            self._file.close()

    def close(self) -> None:
        """Release the container and the file under it."""
        with suppress(av.FFmpegError, OSError):
            self.container.close()
        self._close_file()
