"""Encoding images into a video file, and the codecs that the video library brings."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO, Literal, Self, cast

import av
import numpy as np
from av.codec import Codec
from av.codec.codec import UnknownCodecError
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream

from sceneloom.arrays import UInt8Array, UInt16Array, check_array
from sceneloom.errors import ArrayError, OptionError, OutputError

_WANTED: Mapping[str, tuple[str, Literal["r", "w"]]] = MappingProxyType(
    {
        "H.264, read": ("h264", "r"),
        "H.264, written": ("libx264", "w"),
        "FFV1, read": ("ffv1", "r"),
        "FFV1, written": ("ffv1", "w"),
        "HEVC, read": ("hevc", "r"),
        "AV1, read": ("libdav1d", "r"),
        "VP9, read": ("vp9", "r"),
        "MJPEG, read": ("mjpeg", "r"),
    }
)

NEEDED_CODECS = ("H.264, read", "H.264, written", "FFV1, read", "FFV1, written")
"""Without these, recordings cannot be read or written."""

_LOSSY, _LOSSLESS = 1 << 1, 1 << 2
"""Source: AV_CODEC_PROP_LOSSY and AV_CODEC_PROP_LOSSLESS of libavcodec/codec_desc.h."""


def is_lossless(codec: str) -> bool:
    """Whether videos of a codec, as FFmpeg calls it, never lose anything."""
    known = _codec(codec, "r")
    return known is not None and bool(known.properties & _LOSSLESS) and not known.properties & _LOSSY


def available_codecs() -> dict[str, bool]:
    """Report of each codec that drives come in whether it is there."""
    return {words: _codec(*wanted) is not None for words, wanted in _WANTED.items()}


def _codec(name: str, mode: Literal["r", "w"]) -> Codec | None:
    try:
        return Codec(name, mode)
    except (UnknownCodecError, ValueError):
        return None


VideoTarget = Path | BinaryIO
"""A file to be made, or a seekable binary file open for writing, which stays open."""

MICROSECONDS = Fraction(1, 1_000_000)

_TICKS = MappingProxyType({"matroska": Fraction(1, 1000), "mp4": MICROSECONDS})
"""Length of one tick in each container; Matroska's is the millisecond that its muxer is bound to."""

_CONTAINERS = MappingProxyType({".mkv": "matroska", ".mp4": "mp4"})
_TO_YUV = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INP | Interpolation.ACCURATE_RND

_BT601_MATRIX = 6
"""AVCOL_SPC_SMPTE170M. Readers that ignore what a stream says of its colours, OpenCV among them, take BT.601."""

_TABLE_START, _TABLE_ROW = 4096, 48
"""Bytes that are kept free for the tables of an mp4 file, at least what they need: the boxes themselves take less than
1 kB, and each image 8 in stts, 8 in ctts, 4 in stss, 4 in stsz, 12 in stsc and 8 in co64.

Source: ISO/IEC 14496-12, 8.6 and 8.7.
"""

_KEY_FRAME_DISTANCE = 30
"""Images from key frame to key frame at most: what a jump to any image has to decode."""


@dataclass(frozen=True, slots=True)
class _Encoder:
    """How one codec is set up.

    Attributes:
        library: FFmpeg's name of the encoder.
        pixel_format: what it is fed with.
        options: its settings; `crf` and `threads` are added where it knows them.
        halves: whether chroma has half the resolution, so that sizes must be even.
        sixteen_bits: whether images are one plane of 16-bit numbers, not colours.
    """

    library: str
    pixel_format: str
    options: Mapping[str, str]
    halves: bool = False
    sixteen_bits: bool = False


_X264 = "chromaloc=1:mbtree=0"
"""Chroma is averaged over each square of four pixels; H.264 supposes it at the left edge where a stream is silent.
Without macroblock trees, since with them the same images now and then gave other bytes."""

_FFV1_OPTIONS = MappingProxyType({"level": "3", "slices": "4", "slicecrc": "1", "g": "1", "threads": "2"})

_ENCODERS = MappingProxyType(
    {
        # fixed numbers of threads, so that every machine gives the same bytes
        "h264": _Encoder("libx264", "yuv420p", {"preset": "fast", "threads": "2", "x264-params": _X264}, halves=True),
        "ffv1": _Encoder("ffv1", "bgr0", _FFV1_OPTIONS),
        "ffv1-gray16": _Encoder("ffv1", "gray16le", _FFV1_OPTIONS, sixteen_bits=True),
    }
)


@contextmanager
def writing_faults(name: str) -> Iterator[None]:
    """Turn what the video library raises while writing into an OutputError."""
    try:
        yield
    except (av.FFmpegError, OSError, ValueError) as error:
        problem = getattr(error, "strerror", None) or str(error)
        raise OutputError(f"{name}: cannot be written: {problem}") from error


def target_name(target: VideoTarget) -> str:
    """What messages call the target."""
    return str(target) if isinstance(target, Path) else str(getattr(target, "name", "video"))


def open_container(
    target: VideoTarget, container: str, *, images: int | None = None, header_bytes: int = 0
) -> OutputContainer:
    """Start a file; the same content gives the same bytes.

    Args:
        target: the file.
        container: its kind.
        images: how many there will be at most. Then the tables of an mp4 file stand before its images: a file
            that is cut off keeps them, and one at the other end of a line is read with one request less.
        header_bytes: how long the codec's own header is, as far as it is known.

    Raises:
        OutputError: it cannot be made.
    """
    file: Any = f"file:{target}" if isinstance(target, Path) else target
    options = {"fflags": "+bitexact"}
    if container == "mp4" and images is not None:
        options["moov_size"] = str(_TABLE_START + header_bytes + _TABLE_ROW * images)
    with writing_faults(target_name(target)):
        return av.open(file, "w", format=container, container_options=options)


class VideoWriter:
    """Encodes images one by one; a context manager.

    Attributes:
        count: images added so far.
    """

    def __init__(
        self,
        target: VideoTarget,
        width: int,
        height: int,
        fps: float,
        *,
        codec: str = "h264",
        crf: int = 18,
        container: str | None = None,
        images: int | None = None,
    ) -> None:
        """Start the file.

        Args:
            target: a path, or a seekable binary file.
            width, height: size of every image [px].
            fps: nominal images a second; times of images that come without one.
            codec: "h264", or "ffv1", which loses nothing, or "ffv1-gray16", the same for 16-bit numbers.
            crf: quality of h264: 0 loses nothing, 18 nothing that the eye sees, 51 is the worst.
            container: "matroska" or "mp4"; None for what the path's suffix says.
            images: how many will be added at most, if that is known; see `open_container`.

        Raises:
            OptionError: an odd size for a codec that halves it, or an unknown codec or container.
            OutputError: the target cannot be written.
        """
        self._name = target_name(target)
        self._encoder = _encoder_for(codec, width, height)
        if not 0 < fps < float("inf"):
            raise OptionError(f"{fps} images a second; expected a positive number")
        self.width, self.height, self.fps, self.count = width, height, fps, 0
        suffix = target.suffix.lower() if isinstance(target, Path) else ".mp4"
        kind = container or _CONTAINERS.get(suffix, suffix)
        if kind not in _TICKS:
            known = ", ".join((*_CONTAINERS, *_TICKS))
            raise OptionError(f"no video container {kind!r}; there are {known}")
        self._tick = _TICKS[kind]
        self._most = images
        self._output: OutputContainer | None = open_container(target, kind, images=images)
        with writing_faults(self._name):
            self._stream = self._add_stream(self._output, crf)
        self._reformatter = VideoReformatter()
        self._origin_seconds: float | None = None
        self._last_seconds = 0.0
        self._last_ticks = -1

    def add(self, image: UInt8Array | UInt16Array, timestamp_seconds: float | None = None) -> None:
        """Encode the next image.

        Args:
            image: (height, width, 3) uint8, red green blue; of "ffv1-gray16" (height, width) uint16.
            timestamp_seconds: when it is shown, not before the image added last; the first image's time becomes
                0. Images of one time keep their order. None for the next at `fps`.

        Raises:
            ArrayError: the image has another shape or type, its time is before the last one's, or it is one more
                than was stated before.
            OutputError: the target cannot be written, or the writer is closed.
        """
        if self._encoder.sixteen_bits:
            check_array(f"image {self.count}", image, (self.height, self.width), np.uint16)
        else:
            check_array(f"image {self.count}", image, (self.height, self.width, 3), np.uint8)
        if self._output is None:
            raise OutputError(f"{self._name}: cannot be written: the video is closed")
        if self._most is not None and self.count >= self._most:
            raise ArrayError(f"image {self.count}: expected no more than {self._most}, as was stated before")
        ticks = self._ticks_at(timestamp_seconds)
        with writing_faults(self._name):
            frame = self._to_encoder(image)
            frame.pts, frame.time_base = ticks, self._tick
            frame.duration = round(1 / self.fps / self._tick)
            self._output.mux(self._stream.encode(frame))
        self.count += 1

    def close(self) -> None:
        """Finish the file.

        Raises:
            OutputError: no image was added, or the target cannot be written.
        """
        output, self._output = self._output, None
        if output is None:
            return
        if self.count == 0:
            abandon(output)
            raise OutputError(f"{self._name}: cannot be written: a video needs at least one image")
        with writing_faults(self._name):
            output.mux(self._stream.encode(None))
            output.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif self._output is not None:
            abandon(self._output)
            self._output = None

    def _add_stream(self, output: OutputContainer, crf: int) -> VideoStream:
        options = dict(self._encoder.options)
        if self._encoder.library == "libx264":
            options["crf"] = str(crf)
        rate = Fraction(self.fps).limit_denominator(100_000)
        stream = cast("VideoStream", output.add_stream(self._encoder.library, rate=rate, options=options))
        stream.width, stream.height, stream.pix_fmt = self.width, self.height, self._encoder.pixel_format
        stream.time_base = stream.codec_context.time_base = self._tick
        stream.codec_context.gop_size = _KEY_FRAME_DISTANCE
        if self._encoder.pixel_format.startswith("yuv"):
            stream.codec_context.colorspace = _BT601_MATRIX
            stream.codec_context.color_range = ColorRange.MPEG
        return stream

    def _to_encoder(self, image: UInt8Array | UInt16Array) -> VideoFrame:
        if self._encoder.sixteen_bits:
            return VideoFrame.from_ndarray(np.ascontiguousarray(image, np.uint16), format="gray16le")
        return self._reformatter.reformat(
            VideoFrame.from_ndarray(np.ascontiguousarray(image, np.uint8), format="rgb24"),
            format=self._encoder.pixel_format,
            dst_colorspace=Colorspace.ITU601,
            dst_color_range=ColorRange.MPEG,
            interpolation=_TO_YUV,
            threads=1,
        )

    def _ticks_at(self, timestamp_seconds: float | None) -> int:
        seconds = self.count / self.fps if timestamp_seconds is None else timestamp_seconds
        if self._origin_seconds is None:
            self._origin_seconds = self._last_seconds = seconds
        elif not seconds >= self._last_seconds:
            problem = f"its time {seconds} s is before {self._last_seconds} s, that of the image before"
            raise ArrayError(f"image {self.count}: {problem}")
        self._last_seconds = seconds
        # images of one time, or closer than one tick, keep their order
        ticks = max(round(Fraction(seconds - self._origin_seconds) / self._tick), self._last_ticks + 1)
        self._last_ticks = ticks
        return ticks


def _encoder_for(codec: str, width: int, height: int) -> _Encoder:
    encoder = _ENCODERS.get(codec)
    if encoder is None:
        raise OptionError(f"no video codec {codec!r}; there are {', '.join(_ENCODERS)}")
    if width <= 0 or height <= 0:
        raise OptionError(f"image size {width}x{height}; expected positive numbers of pixels")
    if encoder.halves and (width % 2 or height % 2):
        even = f"{width - width % 2}x{height - height % 2}"
        raise OptionError(
            f"{codec} cannot hold images of {width}x{height}, it needs even sizes; cut them to {even}, "
            "or keep them as PNG images"
        )
    return encoder


def abandon(output: OutputContainer) -> None:
    """Close a file that will not be kept."""
    with suppress(av.FFmpegError, OSError, ValueError):
        output.close()
