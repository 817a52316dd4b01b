"""Frame-exact reading of a video: any image by its number, forward without seeking; videos as images of a camera."""

import io
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import chain, product
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, BinaryIO, Self, cast
from weakref import WeakValueDictionary

import av
import numpy as np
from av.codec.context import ThreadType
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from av.video.stream import VideoStream

from sceneloom.arrays import Float64Array, Int16Array, Int64Array, UInt8Array, UInt16Array
from sceneloom.errors import DataError
from sceneloom.formats.base.diagnostics import Ledger
from sceneloom.formats.base.files import (
    Bytes,
    ByteStream,
    FileIdentity,
    check_pixels,
    check_regular,
    file_faults,
    open_file,
    processors,
    why_no_file,
)

VideoSource = Path | str | bytes | bytearray | memoryview | Callable[[], BinaryIO]
"""A file, its bytes, or a function that opens them anew each time."""

_DEMUXERS = (
    "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpegts,mpeg,flv,ogg,ivf,h264,hevc,obu,mjpeg,mxf,asf,nut,yuv4mpegpipe"
)
"""Containers of one video each. Playlists are not among them: they could name any file or address."""

_MOST_AHEAD = 4  # images that are decoded at the same time at most: each is kept, and a jump waits for all of them


def _source_name(source: VideoSource, name: str | None) -> str:
    """What messages call the video: the given name, else its path, else `video`."""
    return name or (str(source) if isinstance(source, Path | str) else "video")


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
    """Turn whatever the video library raises into a DataError at `location`."""
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

        Raises:
            DataError: the source cannot be opened, is no video, or holds no video stream.
        """
        if isinstance(source, Path | str):
            path = as_path(source)
            if not path.is_file():
                raise DataError(name, "", "not a file" if path.is_dir() else why_no_file(path))
            with file_faults(path):
                check_regular(path)
        with ExitStack() as stack:
            with decoder_faults(name, ""):
                # the prefix keeps a colon in a file's name from being taken for a protocol
                target: Any = f"file:{os.fspath(source)}" if isinstance(source, Path | str) else open_bytes(source)
                if not isinstance(target, str):
                    stack.callback(target.close)
                options = {"format_whitelist": _DEMUXERS, **(options or {})}
                self.container = cast("InputContainer", av.open(target, "r", container_options=options))
                stack.callback(self.container.close)
            stream = cast("VideoStream | None", self.container.streams.best("video"))
            if stream is None:
                raise DataError(name, "", "holds no video stream")
            decoder = stream.codec_context
            if decoder is None or decoder.width <= 0 or decoder.height <= 0:
                raise DataError(name, "", "its video stream is of an unknown codec or image size")
            check_pixels(name, "", decoder.width, decoder.height)
            self.stream, self._files = stream, stack.pop_all()

    def decode_ahead(self) -> None:
        """Decode the next images in further threads while the last is used; to be called before the first image.

        Such a decoder takes for a fault what others pass over, and does not say which packet is damaged.
        """
        available = processors()
        if available == 1:
            return
        decoder = self.stream.codec_context
        decoder.thread_type = ThreadType.AUTO
        decoder.thread_count = min(available + 1, _MOST_AHEAD)
        decoder.options = {**decoder.options, "err_detect": "explode"}
        self.works_ahead = True

    def close(self) -> None:
        """Release the container and the file under it."""
        with suppress(av.FFmpegError, OSError):
            self._files.close()


_SEGMENT, _LONGEST_HEAD = b"\x18\x53\x80\x67", 12


def _matroska_stop(file: BinaryIO, size: int) -> int:
    """Where a Matroska file ends by its elements' sizes; unknown sizes are entered. Source: RFC 8794, 4 to 6."""
    location = 0
    while location < size:
        file.seek(location)
        head = file.read(_LONGEST_HEAD)
        split = _width(head, longest=4)
        width = _width(head[split:], longest=8)
        start = split + width
        if not split or not width or len(head) < start:
            break
        unknown = (1 << 7 * width) - 1
        length = int.from_bytes(head[split:start], "big") & unknown
        if length != unknown and location + start + length > size:
            return location + start + length
        location += start if length == unknown or head[:split] == _SEGMENT else start + length
    return location


def _width(head: bytes, *, longest: int) -> int:
    """How many bytes a number has that begins like this; 0 where none does."""
    width = 9 - head[0].bit_length() if head else 0
    return width if width <= longest else 0


_ASSUMED_RATE = Fraction(25)
"""Images a second where neither packets nor container name any time; only `timestamps` depend on it."""

_UNTIMED = frozenset({"avi", "h264", "hevc"})  # containers that state nothing of when an image is shown

_REORDERS = 1 << 3  # Source: AV_CODEC_PROP_REORDER of libavcodec/codec_desc.h

_MOST_REORDERED = 16
"""So many images at most are stored before one that is shown before them. Source: H.264, `max_num_reorder_frames`."""


@dataclass(frozen=True, slots=True, eq=False)
class VideoIndex:
    """The images of a video in the order in which they are shown.

    Attributes:
        time_base: length of one tick [s].
        pts: (N,) int64 [ticks], presentation times, ascending; counted up where the container has none.
        positions: (N,) int64, each image's location among the packets.
        entries: (N,) int64, the image at whose key frame decoding has to begin to get this one.
        timed: whether `pts` identify an image; else images are known by counting from the start only.
        hidden: packets that have to be decoded but are not shown (cut away by an edit list).
    """

    time_base: Fraction
    pts: Int64Array
    positions: Int64Array
    entries: Int64Array
    timed: bool
    hidden: int

    def __len__(self) -> int:
        return len(self.pts)

    @property
    def timestamps(self) -> Float64Array:
        """(N,) float64 [s], presentation time of each image."""
        return self.pts.astype(np.float64) * (self.time_base.numerator / self.time_base.denominator)

    @property
    def independent(self) -> bool:
        """Whether each image is a key frame."""
        return bool(np.array_equal(self.entries, np.arange(len(self))))

    def part(self, taken: Int64Array) -> "VideoIndex":
        """The list of some of the images, (M,) ascending, as if the others had never been stored."""
        order = np.argsort(np.argsort(self.positions[taken])).astype(np.int64)
        entries = np.maximum(np.searchsorted(taken, self.entries[taken], side="right") - 1, 0).astype(np.int64)
        return VideoIndex(self.time_base, self.pts[taken], order, entries, timed=self.timed, hidden=0)

    def find(self, pts: int | None) -> int | None:
        """The image that has this presentation time, or None."""
        if pts is None:
            return None
        index = int(np.searchsorted(self.pts, pts))
        return index if index < len(self) and self.pts[index] == pts else None


def codec_reorders(stream: VideoStream) -> bool:
    """Whether images of this codec may be shown in another order than they are stored in."""
    return bool(stream.codec_context.codec.properties & _REORDERS)


def presentation_ticks(packet: "Packet[VideoStream]", *, reorders: bool) -> int | None:
    """When a packet's image is shown: its pts, or its dts where the codec never reorders images."""
    if packet.pts is not None:
        return packet.pts
    return None if reorders else packet.dts


def read_index(
    source: VideoSource, name: str, *, options: Mapping[str, str] | None = None, cut_off: bool = False
) -> VideoIndex:
    """Walk through all packets of a video.

    Args:
        source: the video.
        name: what messages call it.
        options: further ones for the container.
        cut_off: take the images of a video that breaks off, up to the first that may be missing.

    Raises:
        DataError: the container breaks off, or a packet is damaged.
    """
    with closing(OpenVideo(source, name, options=options)) as opened, decoder_faults(name, ""):
        if "matroska" in opened.container.format.name and not cut_off:
            with open_bytes(source) as file:
                size = file.seek(0, os.SEEK_END)
                stop = _matroska_stop(file, size)
            if stop > size:
                raise DataError(name, f"byte {size}", f"is cut off: the container goes on to byte {stop} at least")
        packets, hidden = _walk(opened, name, cut_off=cut_off)
        tick, rate = opened.stream.time_base, opened.stream.average_rate
        time_base = Fraction(tick.numerator, tick.denominator) if tick else Fraction(1, av.time_base)
    pts = np.array([tick for tick, _ in packets if tick is not None], np.int64)
    if len(np.unique(pts)) == len(packets):
        order = np.argsort(pts, kind="stable")
        entries = _entries(pts, [key for _, key in packets], order)
        return VideoIndex(time_base, pts[order], order, entries, timed=True, hidden=hidden)
    period = 1 / (Fraction(rate.numerator, rate.denominator) if rate else _ASSUMED_RATE) / time_base
    pts = np.array([round(k * period) for k in range(len(packets))], np.int64)
    return VideoIndex(time_base, pts, np.arange(len(pts)), np.zeros_like(pts), timed=False, hidden=hidden)


def _walk(opened: OpenVideo, name: str, *, cut_off: bool) -> tuple[list[tuple[int | None, bool]], int]:
    """When the image of each packet is shown [ticks] and whether it is a key frame; and how many images are hidden."""
    # Of a container that breaks off, an image shown before one that is there may have been stored after it. No packet
    # after the last is decoded earlier than that, nor shown before it is decoded: images up to that time are there.
    decoder, container = opened.stream.codec_context, opened.container
    reorders = codec_reorders(opened.stream)
    # times that such containers are given are guesses
    guessed = container.format.name in _UNTIMED and reorders and decoder.has_b_frames
    found: list[tuple[int | None, bool]] = []
    last_dts, hidden = None, 0
    with suppress(*([av.FFmpegError] if cut_off else [])):
        for packet in container.demux(opened.stream):
            if packet.is_corrupt:
                if cut_off:
                    break
                raise DataError(name, f"packet {len(found) + hidden}", "is damaged or cut off")
            if packet.is_discard:
                hidden += 1
            elif packet.size:
                tick = None if guessed else presentation_ticks(packet, reorders=reorders)
                found.append((tick, packet.is_keyframe))
                last_dts = packet.dts
    if not cut_off:
        declared, count = opened.stream.frames if "mp4" in container.format.name else 0, len(found) + hidden
        if count < declared:
            raise DataError(name, "", f"is cut off: holds {count} of the {declared} images that it declares")
    elif reorders and last_dts is not None and not guessed:
        found = [(tick, key) for tick, key in found if tick is not None and tick <= last_dts]
    elif reorders and decoder.has_b_frames:
        found = found[:-_MOST_REORDERED]
    return found, hidden


def _entries(pts: Int64Array, keys: Sequence[bool], order: Int64Array) -> Int64Array:
    """For each image, the last key frame stored and shown no later; images shown before theirs may need one before."""
    ranks, entries = np.argsort(order), np.zeros(len(order), np.int64)
    key_positions = [0]
    for position, (tick, key) in enumerate(zip(pts.tolist(), keys, strict=True)):
        if key:
            key_positions.append(position)
        start = next((k for k in reversed(key_positions) if pts[k] <= tick), 0)
        entries[ranks[position]] = ranks[start]
    return entries


BY_TABLES = {"fflags": "noparse+nofillin"}
"""Options for packets as the tables list them. Source: AVFMT_FLAG_NOPARSE of libavformat/avformat.h."""

_LONG_SIZE, _TO_THE_END = 1, 0

_LOOKED_AT = 64 << 10

_MOST_BOXES = 10_000


def read_table_index(content: Bytes, name: str) -> VideoIndex:
    """Walk through all packets of an mp4 video; of the bytes of its images only the first few are fetched.

    Raises:
        DataError: the container breaks off.
    """
    return read_index(lambda: open_hollow(content), name, options=BY_TABLES)


def open_hollow(content: Bytes) -> BinaryIO:
    """Open an mp4 video as a file whose images read as NULs, but for their first bytes, which name the codec."""
    payloads = [(start + _LOOKED_AT, stop) for start, stop in _media(content)]
    return cast("BinaryIO", io.BufferedReader(_Hollow(content, payloads), _LOOKED_AT))


class _Hollow(ByteStream):
    """A file whose payloads read as NULs."""

    def __init__(self, content: Bytes, payloads: list[tuple[int, int]]) -> None:
        super().__init__(content)
        self._payloads = payloads

    def readinto(self, buffer: Any) -> int:
        start, length = self.location, len(buffer)
        for first, stop in self._payloads:
            if first <= start < stop:
                length = min(length, stop - start)
                buffer[:length] = bytes(length)
                self.location += length
                return length
            if start < first:
                length = min(length, first - start)
        return super().readinto(memoryview(buffer)[:length])


def _media(content: Bytes) -> Iterator[tuple[int, int]]:
    """First byte, and the one after the last, of boxes that hold images. Source: ISO/IEC 14496-12, 4.2 and 8.1.1."""
    location = 0
    for _ in range(_MOST_BOXES):
        head = bytes(content[location : location + 16])
        if len(head) < 8:
            return
        size, name, header = int.from_bytes(head[:4], "big"), head[4:8], 8
        if size == _LONG_SIZE:
            size, header = int.from_bytes(head[8:16], "big"), 16
        stop = len(content) if size == _TO_THE_END else location + size
        if stop < location + header:
            return
        if name == b"mdat":
            yield location + header, min(stop, len(content))
        location = stop


class Cursor:
    """Decodes onward from where a container stands; keeps the image it gave last and nothing else.

    Attributes:
        first: the first image it can give; those before it need another start.
    """

    def __init__(self, opened: OpenVideo, images: VideoIndex, name: str) -> None:
        """Start at the container's next packet, taken to be its first.

        Raises:
            DataError: damage has changed the stream's codec to an unknown one.
        """
        self.first = 0
        self._images, self._name = images, name
        self._works_ahead = opened.works_ahead
        with decoder_faults(name, ""):
            self._reorders = codec_reorders(opened.stream)
            self._packets: Iterator[Packet[VideoStream]] = opened.container.demux(opened.stream)
        self._pending: deque[VideoFrame] = deque()
        self._current: tuple[int, VideoFrame] | None = None
        self._next = 0
        self._broken: int | None = None

    def enter(self, entry: int) -> bool:
        """Go on to the next key frame; report whether it lies early enough for what starts at `entry`."""
        with decoder_faults(self._name, f"image {entry}"):
            for packet in self._packets:
                image = self._images.find(presentation_ticks(packet, reorders=self._reorders))
                if packet.size and packet.is_keyframe and image is not None:
                    self.first = self._next = image
                    self._packets = chain([packet], self._packets)
                    return bool(self._images.positions[image] <= self._images.positions[entry])
        return False

    def reaches(self, index: int) -> bool:
        """Whether decoding on gives this image, and no key frame further on gives it sooner."""
        if self._current is not None and self._current[0] == index:
            return True
        return index >= self._next and int(self._images.entries[index]) <= self._next

    def advance(self, index: int) -> VideoFrame | None:
        """Decode on until this image; None where the decoder passes over it.

        Raises:
            DataError: the image, or one that it leans on, is damaged.
        """
        while self._current is None or self._current[0] != index:
            step = self._decode_next(index)
            if step is None:
                return None
            self._current, self._next = step, step[0] + 1
            if step[0] > index:
                return None
        frame, images, broken = self._current[1], self._images, self._broken
        leans_on_broken = (
            broken is not None
            and images.entries[index] == images.entries[broken]
            and images.positions[index] >= images.positions[broken]
        )
        if frame.is_corrupt or leans_on_broken:
            raise DataError(self._name, f"image {index}", "cannot be decoded: it or one before it is damaged")
        return frame

    def _decode_next(self, wanted: int) -> tuple[int, VideoFrame] | None:
        while True:
            while not self._pending:
                with decoder_faults(self._name, f"image {self._next}"):
                    packet = next(self._packets, None)
                if packet is None:
                    return None
                self._pending.extend(self._decode(packet, wanted))
            frame = self._pending.popleft()
            image = self._images.find(frame.pts) if self._images.timed else self._next
            if image is not None:
                return image, frame

    def _decode(self, packet: "Packet[VideoStream]", wanted: int) -> list[VideoFrame]:
        if self._images.timed and packet.size:
            packet.pts = presentation_ticks(packet, reorders=self._reorders)
        try:
            return packet.decode()
        except (av.FFmpegError, ValueError) as error:
            image = self._images.find(packet.pts) if self._images.timed else None
            entries, broken = self._images.entries, self._broken
            if image is not None and (broken is None or entries[broken] != entries[image]):
                self._broken = image  # the first one of its group
            if image is None or image == wanted or self._works_ahead:
                raise DataError(self._name, f"image {wanted}", f"cannot be decoded: {error}") from error
            return []


_READERS: "WeakValueDictionary[int, VideoReader]" = WeakValueDictionary()

_HELD: list["VideoReader"] = []


def _hold() -> None:
    """Before the process forks: close all decoders, whose threads and files must not be forked, and let none open."""
    for reference in _READERS.valuerefs():
        reader = reference()
        if reader is not None:
            reader.hold()
            _HELD.append(reader)


def _release() -> None:
    while _HELD:
        _HELD.pop().release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_release, after_in_child=_release)

_TO_RGB = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND
"""Chroma interpolated, results rounded: half a level off the formulas, where the fast way is 1 to 3 dark."""

_HALVED = frozenset({"yuv420p", "yuvj420p"})
"""FFmpeg's names of pixels in three planes of bytes, the colours at half the resolution both ways."""


_BY_NUMPY = 24
"""So many images of a video are converted without the compiler, where nobody has imported it: that takes as long."""


class _Colours:
    """Converts the images of one stream; for one thread at a time."""

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()
        self._formulas: dict[tuple[str, int, int, bool], _Formula | None] = {}
        self._left = _BY_NUMPY

    def rgb(self, frame: VideoFrame) -> UInt8Array:
        """Give (height, width, 3) uint8, red green blue."""
        # of an odd size the converter stretches the colours, and rows may stand upside down
        even = not (frame.width % 2 or frame.height % 2)
        if even and frame.format.name in _HALVED and all(plane.line_size >= plane.width for plane in frame.planes):
            kind = (frame.format.name, frame.colorspace, frame.color_range, frame.interlaced_frame)
            if kind not in self._formulas:
                self._formulas[kind] = _formula_like_converter(frame)
            formula = self._formulas[kind]
            if formula is not None:
                self._left -= 1
                return _by_formula(frame, formula, compiled=self._left < 0)
        return _by_converter(frame, self._reformatter)


def _by_converter(frame: VideoFrame, reformatter: VideoReformatter) -> UInt8Array:
    image = reformatter.reformat(frame, format="rgb24", interpolation=_TO_RGB, threads=1)
    return np.ascontiguousarray(image.to_ndarray())


_SHARES = ((0.299, 0.114), (0.2126, 0.0722))
"""Of red and of blue in brightness. Source: ITU-R BT.601-7 and BT.709-6, clause 3."""

_PROBE_WIDTH, _PROBE_HEIGHT = 32, 16  # room for a hundred samples of colour

_FRACTION_BITS = 5  # of a level, as in the kernel
_Formula = tuple[Int64Array, int]
"""(6,) factors as the kernel takes them; and how far right of the even column a sample of colour lies [px / 2]."""


def _by_formula(frame: VideoFrame, formula: _Formula, *, compiled: bool = False) -> UInt8Array:
    # the memory of the planes themselves, (height, at least width)
    luma, blue, red = (np.frombuffer(memoryview(p), np.uint8).reshape(p.height, p.line_size) for p in frame.planes)
    rgb = np.empty((frame.height, frame.width, 3), np.uint8)
    if compiled or "numba" in sys.modules:
        from sceneloom.kernels.images import rgb_from_halved_chroma

        rgb_from_halved_chroma(luma, blue, red, *formula, rgb.reshape(frame.height, 3 * frame.width))
    else:
        _rgb_from_halved_chroma(luma, blue, red, *formula, rgb)
    return rgb


def _rgb_from_halved_chroma(
    luma: UInt8Array, blue: UInt8Array, red: UInt8Array, factors: Int64Array, half_columns: int, rgb: UInt8Array
) -> None:
    """Fill (H, W, 3) with what the kernel of the name computes, without the compiler, whose import takes longer."""
    gain, offset, *scales = factors.astype(np.int16)
    height, width = rgb.shape[:2]
    of_blue, of_red = (_centred(plane[: height // 2, : width // 2]) for plane in (blue, red))
    red_red, blue_green, red_green, blue_blue = scales
    added = (
        _high(of_red, red_red),
        _high(of_blue, blue_green) + _high(of_red, red_green) + 1,
        _high(of_blue, blue_blue),
    )
    bright = _high(_centred(luma[:, :width]), gain) + offset
    for channel, scaled in enumerate(added):
        spread = np.empty((height // 2, width), np.int16)
        a, b = scaled[:, :-1], scaled[:, 1:]
        if half_columns == 1:
            spread[:, 0], spread[:, -1] = scaled[:, 0], scaled[:, -1]
            step = (b - a + 2) >> 2
            spread[:, 1:-1:2], spread[:, 2::2] = a + step, b - step
        else:
            spread[:, ::2], spread[:, 1:-1:2], spread[:, -1] = scaled, (a + b + 1) >> 1, scaled[:, -1]
        before, after = np.vstack([spread[:1], spread[:-1]]), np.vstack([spread[1:], spread[-1:]])
        for first, far in ((0, before), (1, after)):
            levels = (bright[first::2] + spread + ((far - spread + 2) >> 2)) >> _FRACTION_BITS
            rgb[first::2, :, channel] = levels.clip(0, 255)


def _centred(levels: UInt8Array) -> Int16Array:
    """Levels without their middle, filling 16 bits."""
    return (levels.astype(np.int16) - 128) << 8


def _high(a: Int16Array, b: Any) -> Int16Array:
    """The upper half of the product of 16-bit numbers, rounded down."""
    return (a.astype(np.int32) * np.int32(b) >> 16).astype(np.int16)


def _conversion_factors(red_share: float, blue_share: float, *, full: bool) -> Int64Array:
    """Put the formula's factors into fixed point.

    Args:
        red_share, blue_share: of red and blue in brightness.
        full: whether brightness has the levels 0 to 255, not 16 to 235.

    Returns:
        (6,): gain and offset of brightness; red of the red difference; green of the blue and of the red difference;
        blue of the blue difference.

    Source: ITU-R BT.601-7 and BT.709-6, clause 3; ITU-T H.264, E.2.1, `video_full_range_flag`.
    """
    darkest, luma_gain, chroma_gain = (0, 1.0, 1.0) if full else (16, 255 / 219, 255 / 224)
    green_share = 1 - red_share - blue_share
    red, blue = 2 * (1 - red_share) * chroma_gain, 2 * (1 - blue_share) * chroma_gain
    unit = 1 << _FRACTION_BITS
    differences = np.array([red, -blue_share / green_share * blue, -red_share / green_share * red, blue])
    # the two products of a sum are rounded down: half a unit each
    offset = round((128 - darkest) * luma_gain * unit) + (unit >> 1) + 1
    # levels come eight bits up, and a product gives its upper 16 of 32 bits
    gain = luma_gain * unit * (1 << 16 - 8)
    scaled = np.rint(differences * unit * (1 << 16 - 8))
    return np.array([round(gain), offset, *scaled], np.int64)


@lru_cache(maxsize=1)
def _formulas() -> tuple[_Formula, ...]:
    return tuple(
        (_conversion_factors(*shares, full=full), half_columns)
        for shares, full, half_columns in product(_SHARES, (False, True), (0, 1))
    )


def _formula_like_converter(frame: VideoFrame) -> _Formula | None:
    """A formula that gives what the converter gives, within a level, for an image marked like this one, else None."""
    # Marks that say where samples of colour lie are shown to the converter only: it is asked by an image that it marks.
    probe = VideoReformatter().reformat(frame, width=_PROBE_WIDTH, height=_PROBE_HEIGHT)
    if probe is frame:
        return None
    random = np.random.default_rng(0)
    for plane in probe.planes:
        plane.update(random.integers(60, 190, plane.buffer_size, dtype=np.uint8).tobytes())
    expected = _by_converter(probe, VideoReformatter()).astype(np.int16)
    agreeing = (formula for formula in _formulas() if np.abs(_by_formula(probe, formula) - expected).max() <= 1)
    return next(agreeing, None)


_TABLES = b"ftyp"
"""What mp4 and mov videos begin with after four bytes: their tables state where each image is. Matroska has none."""

_STEPS = ("gray16le", "gray16be")  # FFmpeg's names of pixels that are one 16-bit number each


class VideoReader:
    """The images of one video, by number in the order in which they are shown.

    Nothing decoded is kept but the decoder's own state and the image it gave last; while that one is used, the
    decoder works on the next ones, four at most. Safe to share between threads, which then take turns. A pickled
    reader takes the list of images along and opens its file again in the process that it comes to; of bytes in
    memory it takes the bytes. A forked process opens anew, too.

    Matrix and range of the colours are the stream's own; BT.601 and limited range where it names none. A rotation
    that the container asks players for is not applied: calibrations are made for the sensor's pixels.

    Attributes:
        name: what messages call the video.
        codec: "h264", "hevc", "ffv1", … as FFmpeg calls it.
        width, height: image size [px].
        has_steps: whether its images are one plane of 16-bit numbers, as depths are kept.
        is_remainder: whether it was opened as what is left of a video that breaks off.
    """

    def __init__(
        self, source: VideoSource, *, name: str | None = None, index: VideoIndex | None = None, cut_off: bool = False
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
        self.name = _source_name(source, name)
        self._source = source
        self._ahead, self._closed = True, False
        self._identity: FileIdentity | None = None
        self._opened: OpenVideo | None = None
        decoder = self._open().stream.codec_context
        self._identity = FileIdentity.of(as_path(source)) if isinstance(source, Path | str) else None
        self.codec: str = decoder.codec.canonical_name
        self.width, self.height = decoder.width, decoder.height
        self.has_steps, self.is_remainder = decoder.pix_fmt in _STEPS, cut_off
        rate = self._open().stream.average_rate
        self._rate = float(rate) if rate else None
        self._index = index
        self._begin()

    def _begin(self) -> None:
        """Make what no other process can have a part in."""
        self._cursor: Cursor | None = None
        self._begun = False  # whether what is opened was read from
        self._colours = _Colours()
        self._lock = Lock()
        _READERS[id(self)] = self

    def __getstate__(self) -> dict[str, Any]:
        source = self._source
        left = {"_source", "_opened", "_cursor", "_colours", "_lock"}
        kept = {name: value for name, value in self.__dict__.items() if name not in left}
        return {**kept, "_source": bytes(source) if isinstance(source, memoryview) else source}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._opened = None
        self._begin()

    def hold(self) -> None:
        """Let no thread decode until `release`, and close the decoder: its threads and file must not be forked."""
        self._lock.acquire()
        self._let_go()

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
            frame = self._frame(index)
            with decoder_faults(self.name, f"image {index}"):
                return self._colours.rgb(frame)

    def steps(self, index: int) -> UInt16Array:
        """Decode one image of 16-bit numbers.

        Returns:
            (height, width) uint16, as they are stored.

        Raises:
            DataError: there is no such image, it cannot be decoded, or is of another kind.
        """
        with self._lock:
            frame = self._frame(index)
            if frame.format.name not in _STEPS:
                problem = f"has pixels of type {frame.format.name}; expected one of {', '.join(_STEPS)}"
                raise DataError(self.name, f"image {index}", problem)
            with decoder_faults(self.name, f"image {index}"):
                return np.ascontiguousarray(frame.to_ndarray(), np.uint16)

    def close(self) -> None:
        """Release the file; the reader gives no images afterwards."""
        with self._lock:
            self._let_go()
            self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _known_index(self) -> VideoIndex:
        if self._index is None:
            if self._identity is not None:
                self._identity.check()
            self._index = read_index(self._source, self.name, cut_off=self.is_remainder)
        return self._index

    def _frame(self, index: int) -> VideoFrame:
        """Decode an image of the size that the head states."""
        count = len(self._known_index())
        if not 0 <= index < count:
            raise DataError(self.name, f"image {index}", f"does not exist: the video holds {count}")
        try:
            frame = self._decoded(index)
        except DataError:
            if not self._ahead or self._closed:
                raise
            # a decoder that works ahead does not say which packet is damaged
            self._stop_working_ahead()
            frame = self._decoded(index)
        if (frame.width, frame.height) != (self.width, self.height):
            found, expected = f"{frame.width}x{frame.height}", f"{self.width}x{self.height}"
            problem = f"is {found}; expected {expected} as the video's head says"
            raise DataError(self.name, f"image {index}", problem)
        return frame

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
        """Go to the key frame at which decoding of an image begins; None where only the beginning will do."""
        images, opened = self._known_index(), self._open()
        entry = int(images.entries[index])
        if not images.timed or (entry == 0 and self._cursor is None):
            return None
        self._begun = True
        with decoder_faults(self.name, f"image {index}"):
            opened.container.seek(int(images.pts[entry]), stream=opened.stream, backward=True)
        cursor = Cursor(opened, images, self.name)
        return cursor if cursor.enter(entry) else None

    def _restart(self) -> Cursor:
        if self._begun:
            self._let_go()
        self._begun = True
        return Cursor(self._open(), self._known_index(), self.name)

    def _open(self) -> OpenVideo:
        if self._closed:
            raise DataError(self.name, "", "is closed")
        if self._opened is None:
            if self._identity is not None:
                self._identity.check()
            self._opened = OpenVideo(self._source, self.name)
            if self._ahead:
                self._opened.decode_ahead()
        return self._opened

    def _stop_working_ahead(self) -> None:
        self._ahead = False
        self._let_go()

    def _let_go(self) -> None:
        if self._opened is not None:
            self._opened.close()
        self._opened, self._cursor, self._begun = None, None, False


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
        shown = _source_name(source, name)
        with suppress(DataError):  # what is wrong with it, all of it reports
            return VideoReader(content, name=shown, index=read_table_index(content, shown))
    return VideoReader(source, name=name, cut_off=cut_off)


def open_whole_or_left(path: Path, ledger: Ledger) -> VideoReader:
    """Open a video with its list of images; a lenient reading takes what is left of one that breaks off.

    Raises:
        DataError: it cannot be read, or no image of it is left.
    """
    reader = open_video(path)
    try:
        reader.index  # noqa: B018 - the walk through the packets finds out whether it is whole
    except DataError as error:
        reader.close()
        if not ledger.lenient:
            raise
        reader = open_video(path, cut_off=True)
        try:
            count = reader.count
        except DataError:
            count = 0
        if count == 0:
            reader.close()
            raise error from None
        problem = f"{error.problem}; its first {count} images are read"
        ledger.fault("unreadable-videos", DataError(error.file, error.location, problem))
    return reader
