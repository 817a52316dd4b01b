"""Remuxing: the packets of a video copied into another container or Annex B messages, encoded again where needed."""

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import chain
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO, Literal, Self, cast

import av
import numpy as np
from av.codec import Codec
from av.codec.codec import UnknownCodecError
from av.container import OutputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation, VideoReformatter
from av.video.stream import VideoStream

from sceneloom.arrays import BoolArray, Float64Array, Int64Array, UInt8Array, UInt16Array, check_array
from sceneloom.errors import ArrayError, DataError, OptionError, OutputError
from sceneloom.formats.base.files import FileView
from sceneloom.formats.video.reader import OpenVideo, VideoIndex, VideoReader, VideoSource, decoder_faults, read_index
from sceneloom.scene.cameras import VideoContent

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

_LOSSY, _LOSSLESS = 1 << 1, 1 << 2  # Source: AV_CODEC_PROP_LOSSY and AV_CODEC_PROP_LOSSLESS of libavcodec/codec_desc.h


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

_KEY_FRAME_DISTANCE = 30  # images from key frame to key frame at most: what a jump to any image has to decode


@dataclass(frozen=True, slots=True)
class _Encoder:
    """How one codec is set up."""

    library: str  # FFmpeg's name of the encoder
    pixel_format: str  # what it is fed with
    options: Mapping[str, str]  # `crf` and `threads` are added where it knows them
    halves: bool = False  # chroma has half the resolution, so that sizes must be even
    sixteen_bits: bool = False  # one plane of 16-bit numbers, not colours


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


@dataclass(frozen=True, slots=True, eq=False)
class _PacketTimes:
    """When the packets of a copy are shown and decoded, (N,) [ticks] in the order of storage."""

    tick: Fraction  # [s]
    pts: Int64Array
    dts: Int64Array
    durations: Int64Array

    @classmethod
    def of(cls, index: VideoIndex, timestamps_seconds: Sequence[float] | Float64Array | None = None) -> Self:
        """Spread times, given in the order of showing, over the packets in their order of storage."""
        # An image must be decoded no later than it is shown. With the packets' times sorted, s, and d the most
        # locations that a packet is stored behind its rank in showing, dts[k] = s[k - d] fulfils that and increases;
        # before the first time it goes on backwards in steps of the first period.
        if timestamps_seconds is None:
            tick, shown = index.time_base, index.pts - index.pts[:1]
        else:
            tick, shown = MICROSECONDS, _to_ticks(timestamps_seconds, len(index))
        count = len(shown)
        periods = np.ones(count, np.int64)
        periods[:-1] = np.diff(shown)
        periods[-1:] = periods[-2:-1] if count > 1 else 1
        ranks = np.argsort(index.positions)
        delay = int((np.arange(count) - ranks).max(initial=0))
        before = -periods[:1] * np.arange(delay, 0, -1)
        return cls(tick, shown[ranks], np.concatenate([before, shown])[:count], periods[ranks])


def _copy_packets(
    source: VideoSource,
    target: VideoTarget,
    container: str,
    times: _PacketTimes,
    name: str,
    *,
    taken: BoolArray | None = None,
) -> None:
    """Copy packets that hold images, those `taken` (N,) or all, one at a time into a container of kind `container`."""
    called = target_name(target)
    with closing(OpenVideo(source, name)) as opened:
        header = len(opened.stream.codec_context.extradata or b"")
        output = open_container(target, container, images=len(times.pts), header_bytes=header)
        with ExitStack() as stack:
            stack.callback(abandon, output)
            with writing_faults(called):
                stream = _same_stream(output, opened.stream, times.tick)
            packets = enumerate(_image_packets(opened, name))
            # packets beyond those that were there before are refused
            chosen = (packet for k, packet in packets if taken is None or k >= len(taken) or taken[k])
            for position, packet in enumerate(chosen):
                if position >= len(times.pts):
                    problem = "was not there before; the file changes while it is read"
                    raise DataError(name, f"packet {position}", problem)
                packet.time_base = times.tick
                packet.pts, packet.dts = int(times.pts[position]), int(times.dts[position])
                packet.duration = int(times.durations[position])
                packet.stream = stream
                with writing_faults(called):
                    output.mux_one(packet)
            stack.pop_all()
        with writing_faults(called):
            output.close()


def _same_stream(output: OutputContainer, original: VideoStream, tick: Fraction) -> VideoStream:
    """Add a stream like another one to a file, with ticks of its own."""
    stream = output.add_stream_from_template(original, opaque=True)
    stream.time_base = tick
    if "matroska" in output.format.name and original.average_rate:
        # else readers take the ticks for the rate
        stream.codec_context.framerate = original.average_rate
    if output.format.name == "mp4" and original.codec_context.codec.canonical_name == "hevc":
        # of the two names of HEVC in mp4, Apple's players know this one only
        stream.codec_context.codec_tag = "hvc1"
    return stream


def _image_packets(opened: OpenVideo, name: str) -> "Iterator[Packet[VideoStream]]":
    """Give the packets that hold an image which is shown, in the order of storage."""
    with decoder_faults(name, ""):
        for packet in opened.container.demux(opened.stream):
            if packet.size and not packet.is_discard:
                yield packet


def _check_count(timestamps: int, images: int) -> None:
    if timestamps != images:
        raise ArrayError(f"timestamps_seconds: {timestamps} times for {images} images; expected one for each")


def _to_ticks(timestamps_seconds: Sequence[float] | Float64Array, count: int) -> Int64Array:
    timestamps = np.asarray(timestamps_seconds, np.float64)
    _check_count(len(timestamps), count)
    ticks = np.rint((timestamps - timestamps[:1]) / float(MICROSECONDS)).astype(np.int64)
    backwards = np.flatnonzero(np.diff(ticks) <= 0)
    if len(backwards):
        k = int(backwards[0]) + 1
        raise ArrayError(f"timestamps_seconds[{k}]: {timestamps[k]}; expected more than {timestamps[k - 1]}")
    return ticks


_MP4_CODECS = frozenset({"h264", "hevc"})  # what is copied into mp4; others either do not belong there or play nowhere

_DEFAULT_FPS = 10.0


@dataclass(frozen=True, slots=True)
class RemuxResult:
    """What was written.

    Attributes:
        images: how many.
        codec: the codec in the target.
        copied: whether the packets are the source's own.
        reason: why they are not; None where they are.
    """

    images: int
    codec: str
    copied: bool
    reason: str | None = None


def remux_to_mp4(
    source: VideoSource,
    target: BinaryIO,
    *,
    timestamps_seconds: Sequence[float] | Float64Array | None = None,
    frame_indices: Sequence[int] | None = None,
    name: str | None = None,
) -> RemuxResult:
    """Put a video into mp4, H.264 and HEVC packet by packet, others as H.264; the first image is shown at 0.

    Args:
        source: read twice or more: the packets' times have to be known before the first is written.
        target: a seekable binary file, written from where it stands at 0; it stays open.
        timestamps_seconds: when each image is shown, strictly increasing; None for the source's own times.
        frame_indices: which images to take, ascending, by the order in which they are shown; None for all.
        name: what messages call the source.

    Raises:
        DataError: the source is damaged.
        ArrayError: not one time for each image, or times that do not increase.
        OptionError: the images must be encoded, and have an odd size.
        OutputError: the target cannot be written.
    """
    with VideoReader(source, name=name) as reader:
        chosen = range(reader.count) if frame_indices is None else frame_indices
        reason = _obstacle(reader, chosen, _MP4_CODECS)
        if reason is not None:
            timestamps = timestamps_seconds
            if timestamps is None and reader.index.timed:
                timestamps = reader.timestamps[np.asarray(chosen, np.int64)]
            images = (reader.rgb(index) for index in chosen)
            fps = reader.fps or _DEFAULT_FPS
            result = encode_to_mp4(images, target, fps=fps, timestamps_seconds=timestamps, count=len(chosen))
            return RemuxResult(result.images, result.codec, copied=False, reason=reason)
        codec, index, called = reader.codec, reader.index, reader.name
    _copy_packets(source, target, "mp4", _PacketTimes.of(index, timestamps_seconds), called)
    return RemuxResult(len(index), codec, copied=True)


def copy_to_matroska(
    source: VideoSource,
    target: VideoTarget,
    *,
    images: int | None = None,
    frame_indices: Sequence[int] | Int64Array | None = None,
    name: str | None = None,
) -> RemuxResult | None:
    """Put a video into Matroska packet by packet, whatever its codec, at its own times from 0 on.

    Args:
        source: read twice or more: the packets' times have to be known before the first is written.
        target: a path or a seekable binary file.
        images: how many images there must be; None for any number.
        frame_indices: which images to take, ascending, by the order in which they are shown; None for all.
        name: what messages call the source.

    Returns:
        What was written; None, and nothing written, where the packets cannot be copied: their times are unknown,
        some are not to be shown, they are not as many as they must be, images that are taken cannot be decoded
        without others that are not, or Matroska does not hold their codec.

    Raises:
        DataError: the source is damaged.
        OutputError: the target cannot be written.
    """
    with VideoReader(source, name=name) as reader:
        wanted = range(reader.count if images is None else images)
        if _obstacle(reader, wanted, frozenset({reader.codec})) is not None:
            return None
        codec, index, called = reader.codec, reader.index, reader.name
    taken = np.arange(len(index)) if frame_indices is None else np.asarray(frame_indices, np.int64)
    if not _can_be_cut(index, taken) or codec not in _matroska_codecs():
        return None
    is_taken = np.zeros(len(index), np.bool_)
    is_taken[index.positions[taken]] = True
    _copy_packets(source, target, "matroska", _PacketTimes.of(index.part(taken)), called, taken=is_taken)
    return RemuxResult(len(taken), codec, copied=True)


@cache
def _matroska_codecs() -> frozenset[str]:
    """Names of the codecs that can be put into Matroska."""
    with open_container(io.BytesIO(), "matroska") as container:
        return frozenset(container.supported_codecs)


def _can_be_cut(index: VideoIndex, taken: Int64Array) -> bool:
    """Whether some images can be decoded without the others: each needs all that is stored from its key frame on."""
    if len(taken) == 0 or (np.diff(taken) <= 0).any() or taken[0] < 0 or taken[-1] >= len(index):
        return False
    stored = np.zeros(len(index) + 1, np.int64)
    stored[index.positions[taken] + 1] = 1
    before = np.cumsum(stored)
    starts, stops = index.positions[index.entries[taken]], index.positions[taken] + 1
    return bool((before[stops] - before[starts] == stops - starts).all())


def encode_to_mp4(
    images: Iterable[UInt8Array],
    target: VideoTarget,
    *,
    fps: float = _DEFAULT_FPS,
    timestamps_seconds: Sequence[float] | Float64Array | None = None,
    count: int | None = None,
) -> RemuxResult:
    """Encode images as H.264 in mp4, one at a time; the first is shown at 0.

    Args:
        images: (height, width, 3) uint8 each, red green blue, all of one size.
        target: a path or a seekable binary file.
        fps: nominal images a second.
        timestamps_seconds: when each image is shown, strictly increasing; None for even steps at `fps`.
        count: how many images there are; needed only where there are no times, for the tables to stand first.

    Raises:
        ArrayError: not one time for each image, or times that do not increase.
        OptionError: the size is odd.
        OutputError: there is no image, or the target cannot be written.
    """
    timestamps = None if timestamps_seconds is None else np.asarray(timestamps_seconds, np.float64)
    remaining = iter(images)
    first = next(remaining, None)
    if first is None:
        raise OutputError(f"{target_name(target)}: cannot be written: a video needs at least one image")
    height, width = first.shape[:2]
    most, found = count if timestamps is None else len(timestamps), 0
    with VideoWriter(target, width, height, fps, container="mp4", images=most) as writer:
        for found, rgb in enumerate(chain([first], remaining), 1):
            if timestamps is None:
                writer.add(rgb)
            elif found <= len(timestamps):
                writer.add(rgb, float(timestamps[found - 1]))
        if timestamps is not None:
            _check_count(len(timestamps), found)
    return RemuxResult(writer.count, "h264", copied=False)


def _obstacle(reader: VideoReader, chosen: Sequence[int], codecs: frozenset[str]) -> str | None:
    """Why the packets cannot be copied; None where they can."""
    index = reader.index
    if len(index) == 0:
        raise DataError(reader.name, "", "holds no images")
    obstacles = (
        (reader.codec not in codecs, f"{reader.codec} is not copied into mp4"),
        (not index.timed, "the source does not state when its images are shown"),
        (index.hidden > 0, "the source holds images that are not to be shown"),
        (not np.array_equal(chosen, np.arange(len(index))), "not all images of the source are taken"),
    )
    return next((reason for stands, reason in obstacles if stands), None)


_FILTERS = {"h264": "h264_mp4toannexb", "hevc": "hevc_mp4toannexb"}
"""FFmpeg's filters that put packets into Annex B form, with the parameters before each key image."""


def packets_to_mp4(raw: BinaryIO, target: BinaryIO, timestamps_ns: Int64Array, name: str) -> None:
    """Put a stream in Annex B form, or an IVF file, into an mp4 file.

    Args:
        raw: the packets one after another, or the file.
        target: a seekable binary file.
        timestamps_ns: (N,) int64 [ns], when each image is shown, in the order of decoding.
        name: what messages call the video.

    Raises:
        DataError: the packets cannot be read, or are more or fewer than their times.
    """
    order = np.argsort(timestamps_ns, kind="stable").astype(np.int64)
    micros = (timestamps_ns[order] - timestamps_ns[order[:1]]) // 1000
    # images of one microsecond keep their order
    steps = np.arange(len(micros))
    ticks = np.maximum.accumulate(micros - steps) + steps
    zeros = np.zeros(len(order), np.int64)
    index = VideoIndex(Fraction(1, 1_000_000), ticks, order, zeros, timed=True, hidden=0)
    source = cast("Callable[[], BinaryIO]", lambda: io.BufferedReader(FileView(raw)))
    _copy_packets(source, target, "mp4", _PacketTimes.of(index), name)


class AnnexBPackets:
    """The packets of a camera's video, one by one.

    Attributes:
        codec: "h264" or "hevc".
        obstacle: why the packets cannot be copied; None where they can.
        reordered: whether images are decoded in another order than they are shown in.
        order: (N,) int64, which image of the camera each packet is, in the order of decoding.
    """

    def __init__(self, video: VideoContent, count: int, name: str) -> None:
        """List the packets of a video that the `count` images of a camera need.

        Raises:
            DataError: the video is damaged, or has another number of images.
        """
        self.codec, self._video, self._name = video.codec, video, name
        index = read_index(video.open, name)
        indices = video.frame_indices
        chosen = np.arange(len(index)) if indices is None else np.asarray(indices, np.int64)
        if len(chosen) != count:
            raise DataError(name, "", f"{len(chosen)} images; expected {count} as the camera has")
        self.obstacle: str | None = None
        if video.codec not in _FILTERS:
            self.obstacle = f"messages hold H.264 and HEVC, the video is {video.codec}"
        elif index.hidden:
            self.obstacle = "the video holds images that are not to be shown"
        elif not _can_be_cut(index, chosen):
            self.obstacle = "images that are taken need others that are not"
        positions = index.positions[chosen] if self.obstacle is None else np.zeros(0, np.int64)
        self.order = np.argsort(positions).astype(np.int64)
        self.reordered = bool((np.diff(self.order) < 0).any())
        self._wanted = frozenset(positions.tolist())

    def __iter__(self) -> Iterator[bytes]:
        with closing(OpenVideo(self._video.open, self._name)) as opened:
            with decoder_faults(self._name, ""):
                filtered: Any = av.BitStreamFilterContext(_FILTERS[self.codec], in_stream=opened.stream)
            for position, packet in enumerate(_image_packets(opened, self._name)):
                with decoder_faults(self._name, f"packet {position}"):
                    content = b"".join(bytes(part) for part in filtered.filter(packet))
                if position in self._wanted:
                    yield content
